// What the robot itself says: logs, diagnostics, transforms, parameters, calls, and clocks.

import { age, clock, count, duration, rate, several } from '../format.js';
import { address, clockId, frameId, nodeAddress } from '../router.js';
import { replaceAddress, state, useLive, usePoll } from '../store.js';
import { sorted, Table } from '../table.js';
import { roots } from '../transforms.js';
import { Failed, Filter, html, Mark, matches, Name } from '../ui.js';
import { Findings } from './overview.js';

const EVERY_MS = 2000;
/** Most messages of logs and changes of parameters in the document. */
const MOST_SHOWN = 300;
/** Messages of logs that the agent keeps. */
const MOST_KEPT = 1000;

/** Severity on the page of each level of a log or of diagnostics. */
const SEVERITY = /** @type {Record<string, string>} */ ({
  ok: 'good', debug: 'note', info: 'note', warn: 'warning', stale: 'warning', error: 'error',
  fatal: 'error',
});
/** Levels of diagnostics, the worst first. */
const LEVELS = ['error', 'stale', 'warn', 'ok'];

/** @typedef {{query: Record<string, string>, change: (more: Record<string, any>) => void}} Props */

const PARTS = /** @type {[string, string, (props: Props) => any][]} */ ([
  ['logs', 'Logs', Logs], ['diagnostics', 'Diagnostics', Diagnostics],
  ['transforms', 'Transforms', Transforms], ['parameters', 'Parameters', Parameters],
  ['services', 'Services and actions', Services], ['clocks', 'Clocks', Clocks],
]);

/** @param {{name: string|null, query: Record<string, string>}} props */
export function Robot({ name, query }) {
  useLive();
  const [part, title, View] = PARTS.find(([each]) => each === name) ?? PARTS[0];
  const change = (/** @type {Record<string, any>} */ more) =>
    replaceAddress(address('robot', part, { ...query, ...more }));
  return html`<h1 tabindex="-1">${title}</h1>
    <nav class="parts" aria-label="What the robot says"><ul>${PARTS.map(([each, text]) => html`
      <li key=${each}><a href=${address('robot', each)}
        aria-current=${each === part ? 'page' : undefined}>${text}</a></li>`)}</ul></nav>
    <${View} key=${part} query=${query} change=${change} />`;
}

/** Why there is nothing: the part is off, or nothing was seen. @param {any} props */
function Nothing({ answer, part, children }) {
  if (answer.problem) return html`<${Failed} problem=${answer.problem} what="No answer" />`;
  if (!answer.data) return html`<p class="dim">Loading …</p>`;
  if (answer.data.is_on === false) {
    return html`<p class="empty">The configuration of the agent switches this off:
      <code>robot: {${part}: off}</code>.</p>`;
  }
  return html`<p class="empty">${children}</p>`;
}

/** A link to a node. @param {{name: string|null|undefined, domain: number}} props */
function Node({ name, domain }) {
  return name ? html`<a href=${nodeAddress({ name, domain })}><${Name} text=${name} /></a>` : '–';
}

/** The domain of a row, if the robot has several. @param {number} domain */
const inDomain = (domain) => (state.hasDomains() ? html` <span class="dim">domain ${domain}</span>` : '');

/** @param {Props} props */
function Logs({ query, change }) {
  const { filter = '', level = '' } = query;
  // A filter searches all messages that the agent keeps.
  const limit = filter ? MOST_KEPT : MOST_SHOWN;
  const answer = usePoll(`logs?limit=${limit}${level && `&level=${level}`}`, EVERY_MS);
  const all = answer.data?.messages ?? [];
  const rows = all.filter((/** @type {any} */ each) =>
    matches(filter, `${each.ros_node} ${each.text} ${each.level}`)).reverse();
  const nodes = answer.data?.nodes ?? [];
  return html`<div class="controls">
      <${Filter} label="Filter" value=${filter} found=${rows.length} noun="message"
        change=${(/** @type {string} */ text) => change({ filter: text })} />
      <label>Show <select value=${level}
        onChange=${(/** @type {any} */ event) => change({ level: event.target.value })}>
        <option value="">all levels</option><option value="warn">warnings and errors</option>
        <option value="error">errors</option></select></label></div>
    ${rows.length ? html`<div class="scroll tall" tabindex="0" role="group" aria-label="Messages"><table>
      <thead><tr><th scope="col">Time</th><th scope="col">Level</th><th scope="col">Node</th>
        <th scope="col">Text</th></tr></thead>
      <tbody>${rows.slice(0, MOST_SHOWN).map((/** @type {any} */ each) => html`
        <tr key=${`${each.writer} ${each.sequence_number}`}>
        <td class="number">${clock(each.timestamp_seconds)}</td>
        <td><${Mark} severity=${SEVERITY[each.level]} /> ${each.level}</td>
        <th scope="row"><${Node} name=${each.ros_node} domain=${each.domain_id} /></th>
        <td title=${`${each.file}:${each.line} ${each.function}`}><${Name} text=${each.text} /></td>
        </tr>`)}</tbody></table></div>
      ${rows.length >= MOST_SHOWN && html`<p class="dim">The latest ${count(MOST_SHOWN)}${filter
        ? ` of ${count(rows.length)}` : `; a filter searches the latest ${count(MOST_KEPT)}`}.</p>`}`
    : all.length ? html`<p class="empty">No message matches.</p>`
      : html`<${Nothing} answer=${answer} part="logs">No message of <code>/rosout</code> so far. A
        message that no subscription requests is not sent.</${Nothing}>`}
    ${nodes.length > 0 && html`<section aria-labelledby="by-node"><h2 id="by-node">By node</h2>
      <div class="scroll" tabindex="0" role="group" aria-labelledby="by-node"><table>
      <thead><tr><th scope="col">Node</th><th scope="col">Messages since the agent started</th>
      </tr></thead><tbody>${nodes.map((/** @type {any} */ node) => html`
        <tr key=${`${node.domain_id} ${node.ros_node}`}><th scope="row"><${Node} name=${node.ros_node}
          domain=${node.domain_id} />${inDomain(node.domain_id)}</th>
        <td>${node.levels.map((/** @type {any} */ each) => html`<span key=${each.level}><${Mark}
          severity=${SEVERITY[each.level]} /> ${count(each.messages)} ${each.level} </span>`)}</td>
        </tr>`)}</tbody></table></div></section>`}`;
}

/** @param {Props} props */
function Diagnostics({ query, change }) {
  const { filter = '', sort = 'level' } = query;
  const answer = usePoll('diagnostics', EVERY_MS);
  const all = answer.data?.statuses ?? [];
  const columns = [
    { key: 'level', title: 'Level', by: (/** @type {any} */ row) => LEVELS.indexOf(row.level),
      cell: (/** @type {any} */ row) => html`<${Mark} severity=${SEVERITY[row.level]} /> ${row.level}` },
    { key: 'name', title: 'Part', header: true, by: (/** @type {any} */ row) => row.name,
      cell: (/** @type {any} */ row) => html`<${Name} text=${row.name} />${inDomain(row.domain_id)}` },
    { key: 'message', title: 'Message', cell: (/** @type {any} */ row) => (row.values.length
      ? html`<details><summary><${Name} text=${row.message || 'values'} /></summary><ul class="plain">
        ${row.values.map((/** @type {any} */ each, /** @type {number} */ at) => html`<li key=${at}>
          <span class="dim"><${Name} text=${each.key} /></span> <${Name} text=${each.value} /></li>`)}
        </ul></details>` : html`<${Name} text=${row.message} />`) },
    { key: 'node', title: 'Node', kind: 'wide', by: (/** @type {any} */ row) => row.ros_node,
      cell: (/** @type {any} */ row) => html`<${Node} name=${row.ros_node} domain=${row.domain_id} />` },
    { key: 'since', title: 'For', kind: 'number', by: (/** @type {any} */ row) => -row.since_seconds,
      cell: (/** @type {any} */ row) => age(state.time - row.since_seconds) },
    { key: 'last', title: 'Last', kind: 'number wide', by: (/** @type {any} */ row) =>
      -row.timestamp_seconds, cell: (/** @type {any} */ row) => clock(row.timestamp_seconds) },
  ];
  const found = all.filter((/** @type {any} */ row) =>
    matches(filter, `${row.level} ${row.name} ${row.message} ${row.hardware_id}`));
  return html`<div class="controls"><${Filter} label="Filter" value=${filter} found=${found.length}
      noun="part" change=${(/** @type {string} */ text) => change({ filter: text })} /></div>
    ${all.length ? html`<${Table} label="Diagnostics" columns=${columns}
        rows=${sorted(found, columns, sort)} sort=${sort}
        keyOf=${(/** @type {any} */ row) => [row.domain_id, row.topic, row.name, row.hardware_id].join(' ')}
        onSort=${(/** @type {string} */ key) => change({ sort: key })} />`
      : html`<${Nothing} answer=${answer} part="diagnostics">No message of <code>/diagnostics</code> so
        far. A message that no subscription requests is not sent.</${Nothing}>`}`;
}

function Transforms() {
  const answer = usePoll('transforms', EVERY_MS);
  const trees = answer.data?.trees ?? [];
  const faults = state.findings.filter((finding) => finding.kind === 'transform_fault');
  return html`${faults.length > 0 && html`<${Findings} list=${faults} />`}
    ${trees.length ? trees.map((/** @type {any} */ tree) => html`
      <section key=${`${tree.domain_id} ${tree.namespace}`} aria-label=${`Frames ${tree.namespace}`}>
      <h2><${Name} text=${tree.namespace || '/'} />${inDomain(tree.domain_id)}</h2>
      ${tree.unread_static_publishers > 0 && html`<p class="dim">Static transforms of ${several(
        tree.unread_static_publishers, 'publisher')} are missing: the agent came later.</p>`}
      ${roots(tree.edges).map((root) => html`<${Frame} key=${root.name} frame=${root}
        tree=${tree} />`)}</section>`)
      : html`<${Nothing} answer=${answer} part="transforms">No message of <code>/tf</code> so far. A
        message that no subscription requests is not sent.</${Nothing}>`}`;
}

/** A frame, and the frames below it. @param {{frame: import('../transforms.js').Frame, tree: any}} props */
function Frame({ frame, tree }) {
  const { edge } = frame;
  const nodes = (edge?.broadcasters ?? []).map((/** @type {any} */ each) => each.ros_node ?? each.writer);
  return html`<ul class="frames"><li id=${frameId(tree.domain_id,
    tree.namespace, frame.name)}><${Name} text=${frame.name} />
    ${edge && html` <span class="dim">${edge.is_static ? 'static' : `${rate(edge.rate_hz)}, ${duration(
      Math.max(0, state.time - edge.timestamp_seconds))} ago`}${' '}
      <${Name} text=${nodes.join(', ')} />
      <span title="x, y and z in metres"> (${edge.translation.map((/** @type {number} */ each) =>
        each.toFixed(2)).join(', ')})</span></span>`}
    ${frame.children.map((child) => html`<${Frame} key=${child.name} frame=${child}
      tree=${tree} />`)}</li></ul>`;
}

/** @param {Props} props */
function Parameters({ query, change }) {
  const { filter = '', sort = 'node' } = query;
  const answer = usePoll('parameters', EVERY_MS);
  const all = answer.data?.parameters ?? [];
  const changes = [...(answer.data?.changes ?? [])].reverse();
  const columns = [
    { key: 'node', title: 'Node', header: true, by: (/** @type {any} */ row) => row.ros_node,
      cell: (/** @type {any} */ row) => html`<${Node} name=${row.ros_node}
        domain=${row.domain_id} />${inDomain(row.domain_id)}` },
    { key: 'name', title: 'Parameter', by: (/** @type {any} */ row) => row.name,
      cell: (/** @type {any} */ row) => html`<${Name} text=${row.name} />` },
    { key: 'value', title: 'Last known value', cell: (/** @type {any} */ row) => html`<${Name}
      text=${row.value} most=${120} />` },
    { key: 'time', title: 'Seen', kind: 'number wide', by: (/** @type {any} */ row) =>
      row.timestamp_seconds, cell: (/** @type {any} */ row) => clock(row.timestamp_seconds) },
  ];
  const found = all.filter((/** @type {any} */ row) =>
    matches(filter, `${row.ros_node} ${row.name} ${row.value}`));
  return html`${changes.length > 0 && html`<section aria-labelledby="changes"><h2 id="changes">Changes</h2>
      <div class="scroll tall" tabindex="0" role="group" aria-labelledby="changes"><table>
      <thead><tr><th scope="col">Time</th><th scope="col">Parameter</th><th scope="col">Before</th>
        <th scope="col">Value</th><th scope="col">Requested by</th></tr></thead>
      <tbody>${changes.slice(0, MOST_SHOWN).map((/** @type {any} */ each, /** @type {number} */ at) => html`
        <tr key=${`${each.timestamp_seconds} ${at}`}><td class="number">${clock(each.timestamp_seconds)}</td>
        <th scope="row"><${Node} name=${each.ros_node} domain=${each.domain_id} /> <${Name}
          text=${each.name} /></th>
        <td>${each.before == null ? '–' : html`<${Name} text=${each.before} most=${60} />`}</td>
        <td>${each.value == null ? 'removed' : html`<${Name} text=${each.value} most=${60} />`}</td>
        <td><${Node} name=${each.requested_by} domain=${each.domain_id} /></td></tr>`)}</tbody>
      </table></div></section>`}
    ${all.length ? html`<section aria-labelledby="values"><h2 id="values">Values</h2>
      <div class="controls"><${Filter} label="Filter" value=${filter} found=${found.length}
        noun="parameter" change=${(/** @type {string} */ text) => change({ filter: text })} /></div>
      <${Table} label="Parameters" columns=${columns} rows=${sorted(found, columns, sort)} sort=${sort}
        keyOf=${(/** @type {any} */ row) => [row.domain_id, row.ros_node, row.name].join(' ')}
        onSort=${(/** @type {string} */ key) => change({ sort: key })} /></section>`
      : !changes.length && html`<${Nothing} answer=${answer} part="parameters">No event and no reply with
        parameters so far. Values that were set before the agent started are unknown.</${Nothing}>`}`;
}

/** Nodes of servers or clients. @param {any[]} parties */
const nodesOf = (parties) => parties.map((each) => each.node ?? each.participant).join(', ');

/** @param {Props} props */
function Services({ query, change }) {
  // Most services set parameters and have no calls.
  const { filter = '', sort = '-requests' } = query;
  const services = usePoll('services', EVERY_MS);
  const actions = usePoll('actions', EVERY_MS);
  const rows = (services.data?.services ?? []).filter((/** @type {any} */ row) =>
    (!row.hidden || filter) && matches(filter, `${row.name} ${row.types.join(' ')}`));
  const number = (/** @type {string} */ key, /** @type {string} */ title, kind = 'number') => ({
    key, title, kind, by: (/** @type {any} */ row) => row.calls?.[key],
    cell: (/** @type {any} */ row) => count(row.calls?.[key] ?? null),
  });
  const time = (/** @type {string} */ key, /** @type {string} */ title) => ({
    key, title, kind: 'number wide', by: (/** @type {any} */ row) => row.calls?.[key],
    cell: (/** @type {any} */ row) => duration(row.calls?.[key]),
  });
  const columns = [
    { key: 'name', title: 'Service', header: true, by: (/** @type {any} */ row) => row.name,
      cell: (/** @type {any} */ row) => html`<${Name} text=${row.name} />${inDomain(row.domain_id)}` },
    { key: 'servers', title: 'Server', kind: 'wide', cell: (/** @type {any} */ row) => html`<${Name}
      text=${nodesOf(row.servers) || 'none'} />` },
    { key: 'clients', title: 'Clients', kind: 'wide', cell: (/** @type {any} */ row) => html`<${Name}
      text=${nodesOf(row.clients)} most=${60} />` },
    number('requests', 'Requests'), number('answered', 'Answered', 'number wide'),
    { ...number('hanging', 'Hanging'), cell: (/** @type {any} */ row) => ((row.calls?.hanging ?? 0) > 0
      ? html`<${Mark} severity="warning" /> ${count(row.calls.hanging)}` : count(row.calls?.hanging ?? null)) },
    time('latency_p50_seconds', 'p50'), time('latency_p99_seconds', 'p99'),
  ];
  const goals = (actions.data?.actions ?? []).filter((/** @type {any} */ row) => matches(filter, row.name));
  const results = ['accepted', 'succeeded', 'canceled', 'aborted', 'rejected', 'open'];
  return html`<div class="controls"><${Filter} label="Filter" value=${filter}
      found=${rows.length + goals.length} noun="name"
      change=${(/** @type {string} */ text) => change({ filter: text })} /></div>
    ${goals.length > 0 && html`<section aria-labelledby="actions"><h2 id="actions">Actions</h2>
      <div class="scroll" tabindex="0" role="group" aria-labelledby="actions"><table>
      <thead><tr><th scope="col">Action</th><th scope="col">Server</th>${results.map((each) => html`
        <th scope="col" key=${each} class="number">${each}</th>`)}
        <th scope="col" class="number">p50</th><th scope="col" class="number">p99</th></tr></thead>
      <tbody>${goals.map((/** @type {any} */ row) => html`<tr key=${`${row.domain_id} ${row.name}`}>
        <th scope="row"><${Name} text=${row.name} />${inDomain(row.domain_id)}</th>
        <td><${Name} text=${nodesOf(row.servers) || 'none'} /></td>
        ${results.map((each) => html`<td key=${each} class="number">${each === 'aborted'
          && row.goals?.aborted > 0 ? html`<${Mark} severity="warning" /> ` : ''}${count(
          row.goals?.[each] ?? null)}</td>`)}
        <td class="number">${duration(row.goals?.duration_p50_seconds)}</td>
        <td class="number">${duration(row.goals?.duration_p99_seconds)}</td></tr>`)}</tbody></table></div></section>`}
    ${rows.length ? html`<section aria-labelledby="services"><h2 id="services">Services</h2>
      <${Table} label="Services" columns=${columns} rows=${sorted(rows, columns, sort)} sort=${sort}
        keyOf=${(/** @type {any} */ row) => `${row.domain_id} ${row.name}`}
        onSort=${(/** @type {string} */ key) => change({ sort: key })} /></section>`
      : !goals.length && html`<${Nothing} answer=${services} part="services">No service${filter
        ? ' matches' : ' so far'}.</${Nothing}>`}`;
}

function Clocks() {
  const answer = usePoll('clocks', EVERY_MS);
  const { peers = [], offsets = [] } = answer.data ?? {};
  if (!peers.length) {
    return html`<${Nothing} answer=${answer} part="clocks">No message of another host so far.</${Nothing}>`;
  }
  return html`${offsets.length > 0 && html`<section aria-labelledby="offsets"><h2 id="offsets">Offsets</h2>
      <div class="scroll" tabindex="0" role="group" aria-labelledby="offsets"><table>
      <thead><tr><th scope="col">Host</th><th scope="col">Peer</th>
        <th scope="col" class="number">The peer is ahead by</th><th scope="col" class="number">±</th></tr>
      </thead><tbody>${offsets.map((/** @type {any} */ each) => html`<tr key=${`${each.host} ${each.peer}`}>
        <th scope="row"><${Name} text=${each.host} /></th><td><${Name} text=${each.peer} /></td>
        <td class="number">${duration(each.offset_seconds)}</td>
        <td class="number">${duration(each.uncertainty_seconds)}</td></tr>`)}</tbody></table></div></section>`}
    <section aria-labelledby="peers"><h2 id="peers">Hosts</h2>
    <div class="scroll" tabindex="0" role="group" aria-labelledby="peers"><table>
    <thead><tr><th scope="col">Host</th><th scope="col">Address</th>
      <th scope="col" class="number">Ahead at least</th><th scope="col" class="number">At most</th>
      <th scope="col" class="number">Steps</th></tr></thead>
    <tbody>${peers.map((/** @type {any} */ each) => html`<tr key=${each.address}
      id=${clockId(each.peer)}>
      <th scope="row"><${Name} text=${each.peer} /></th><td>${each.address}</td>
      <td class="number">${duration(each.ahead_at_least_seconds)}</td>
      <td class="number">${each.ahead_at_most_seconds == null ? 'unknown'
        : duration(each.ahead_at_most_seconds)}</td>
      <td class="number">${count(each.steps)}</td></tr>`)}</tbody></table></div>
    <p class="dim">An upper bound needs a reply or an acknowledgement from that host.</p></section>`;
}
