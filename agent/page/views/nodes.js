// ROS nodes: host and process, resource usage, and connections.

import { useRef } from '../vendor/hooks.mjs';
import { named } from '../api.js';
import { bytes, calls, count, date, duration, percent, several } from '../format.js';
import { nodeKey } from '../graph-model.js';
import { address } from '../router.js';
import { Chart } from '../chart.js';
import { replaceAddress, state, stream, useLive, usePoll } from '../store.js';
import { inWords, marksOf, useEvents, useHistory, useTime, zoom } from '../timebar.js';
import { sorted, Table } from '../table.js';
import { Failed, Filter, html, Mark, matches, Name, NodeLink } from '../ui.js';
import { InChains } from './chains.js';
import { Inside } from './inside.js';
import { Findings } from './overview.js';
import { Incomplete } from './overview.js';

const EVERY_MS = 2000;
const LINKS_EVERY_MS = 5000;

/** Services that identify a node with parameters. */
const PARAMETER_SERVICES = ['list_parameters', 'get_parameters'];

/**
 * Returns processes by id, each with its share of a core between the last two answers.
 * @returns {{byId: Map<number, any>, answer: {data: any, problem: any}}}
 */
function useProcesses() {
  const answer = usePoll('processes', EVERY_MS);
  const before = useRef({ time: 0, seconds: /** @type {Map<number, number>} */ (new Map()),
    part: /** @type {Map<number, number>} */ (new Map()) });
  const byId = new Map();
  const { data } = answer;
  if (data && stream.at != null) {
    for (const each of data.processes) byId.set(each.process_id, { ...each, part: each.cpu_cores });
  } else if (data) {
    const { time, seconds, part } = before.current;
    const elapsed = data.timestamp_seconds - time;
    if (elapsed > 0.2) {
      const fresh = new Map();
      for (const each of data.processes) {
        const was = seconds.get(each.process_id);
        if (was != null) fresh.set(each.process_id, (each.cpu_seconds - was) / elapsed);
      }
      before.current = {
        time: data.timestamp_seconds,
        seconds: new Map(data.processes.map((/** @type {any} */ each) =>
          [each.process_id, each.cpu_seconds])),
        part: time ? fresh : part,
      };
    }
    for (const each of data.processes) {
      // The first answer has the average since the process started.
      const lasted = data.timestamp_seconds - (each.started_timestamp_seconds ?? NaN);
      const average = lasted > 1 ? each.cpu_seconds / lasted : null;
      byId.set(each.process_id, { ...each, part: before.current.part.get(each.process_id) ?? average });
    }
  }
  return { byId, answer };
}

/**
 * Returns a participant's process. The ids of other hosts, which have no control group here, belong to
 * other processes.
 * @template T
 * @param {import('../state.js').Participant|null|undefined} participant
 * @param {Map<number, T>} byId
 */
export function processOf(participant, byId) {
  return participant?.cgroup == null ? undefined : byId.get(participant.pid ?? -1);
}

/**
 * Returns the usage of the participants' processes. A process id is used again in the course of days:
 * the processes are those of this name, or without one the latest.
 * @param {any[]} processes as `GET /history/processes` has them
 * @param {(import('../state.js').Participant|null|undefined)[]} participants
 */
export function usageOf(processes, participants) {
  const found = participants.flatMap((own) => {
    if (own?.cgroup == null) return [];
    const all = processes.filter((each) => each.process_id === own.pid && each.times.length > 1);
    const names = [own.process, state.scripts.get(own.pid ?? -1)?.script];
    const named = all.filter((each) => names.includes(each.process));
    return named.length ? named : all.sort((one, other) => other.times.at(-1) - one.times.at(-1)).slice(0, 1);
  });
  return [...new Set(found)];
}

/** Returns the topics that each node publishes and subscribes to. */
function ends() {
  /** @type {Map<number, {publishers: Set<number>, subscriptions: Set<number>}>} */
  const found = new Map();
  for (const topic of state.topics.values()) {
    for (const side of /** @type {const} */ (['publishers', 'subscriptions'])) {
      for (const endpoint of topic[side]) {
        const own = found.get(endpoint.node) ?? { publishers: new Set(), subscriptions: new Set() };
        own[side].add(topic.id);
        found.set(endpoint.node, own);
      }
    }
  }
  return found;
}

/** @param {{query: Record<string, string>}} props */
export function Nodes({ query }) {
  useLive();
  const { filter = '', sort = 'name', hidden = '' } = query;
  const { byId, answer } = useProcesses();
  const change = (/** @type {Record<string, any>} */ more) => replaceAddress(
    address('nodes', null, { ...query, ...more }));
  const joined = ends();
  const participant = (/** @type {any} */ node) => state.participants.get(node.participants[0]);
  const process = (/** @type {any} */ node) => processOf(participant(node), byId);
  const where = (/** @type {any} */ node) => [state.processName(participant(node)),
    participant(node)?.container].filter(Boolean).join(', ');
  const number = (/** @type {any} */ node, /** @type {'publishers'|'subscriptions'} */ side) =>
    joined.get(node.id)?.[side].size ?? 0;
  const worstOf = (/** @type {any} */ node) => {
    const own = state.findings.filter((finding) => finding.node === node.id);
    return own[0]?.severity ?? null;
  };
  const rows = [...state.nodes.values()].filter((node) => (hidden || !node.hidden)
    && matches(filter, `${node.name} ${where(node)} ${participant(node)?.host ?? ''}`));
  const columns = [
    { key: 'name', title: 'Node', header: true, by: (/** @type {any} */ node) => node.name,
      cell: (/** @type {any} */ node) => html`<${NodeLink} node=${node} most=${100} />${
        node.participants.length > 1 ? html` <span class="badge error"><${Mark} severity="error" />${' '}
          ${node.participants.length} of this name</span>` : ''}${worstOf(node) === 'error'
        && node.participants.length < 2 ? html` <${Mark} severity="error" />` : ''}` },
    ...(state.hasDomains() ? [{ key: 'domain', title: 'Domain', kind: 'number wide',
      by: (/** @type {any} */ node) => node.domain,
      cell: (/** @type {any} */ node) => node.domain }] : []),
    { key: 'host', title: 'Host', kind: 'wide',
      by: (/** @type {any} */ node) => participant(node)?.host,
      cell: (/** @type {any} */ node) => html`<${Name} text=${participant(node)?.host ?? 'unknown'} />` },
    { key: 'process', title: 'Process',
      meaning: 'Script or program with its id, and its container or systemd service.', by: where,
      cell: (/** @type {any} */ node) => html`<${Name} text=${where(node) || 'unknown'} />` },
    { key: 'cpu', title: 'CPU',
      meaning: 'CPU time by time: 100 % is one busy core. Nodes of one process share the value.', kind: 'number', by: (/** @type {any} */ node) => process(node)?.part,
      cell: (/** @type {any} */ node) => percent(process(node)?.part) },
    { key: 'memory', title: 'Memory',
      meaning: 'Resident memory of the process.', kind: 'number',
      by: (/** @type {any} */ node) => process(node)?.memory_bytes,
      cell: (/** @type {any} */ node) => bytes(process(node)?.memory_bytes) },
    { key: 'publishers', title: 'Publishes', kind: 'number wide',
      by: (/** @type {any} */ node) => number(node, 'publishers'),
      cell: (/** @type {any} */ node) => count(number(node, 'publishers')) },
    { key: 'subscriptions', title: 'Subscribes', kind: 'number wide',
      by: (/** @type {any} */ node) => number(node, 'subscriptions'),
      cell: (/** @type {any} */ node) => count(number(node, 'subscriptions')) },
  ];
  return html`<h1 tabindex="-1">Nodes</h1>
    <div class="controls">
      <${Filter} label="Filter" value=${filter} found=${rows.length} noun="node"
        change=${(/** @type {string} */ text) => change({ filter: text })} />
      <label><input type="checkbox" checked=${Boolean(hidden)}
        onChange=${(/** @type {any} */ event) => change({ hidden: event.target.checked })} />
        hidden nodes</label>
      <a href=${address('graph', null, { mode: 'nodes' })}>Show as a graph</a></div>
    <${Failed} problem=${answer.problem} what="No CPU and memory" />
    ${answer.data?.unreadable > 0 && html`<p class="dim">${several(answer.data.unreadable,
      'process', 'processes')} of this host cannot be read by the agent.</p>`}
    <${Table} label="Nodes" columns=${columns} rows=${sorted(rows, columns, sort)} sort=${sort}
      keyOf=${(/** @type {any} */ node) => node.id}
      onSort=${(/** @type {string} */ next) => change({ sort: next })} />
    ${!rows.length && html`<p class="empty">${state.nodes.size ? 'No node matches.'
      : 'No node is known.'}</p>`}
    <${Incomplete} missing="their nodes may be missing here" />
    <${Links} />`;
}

/** TCP connections to other hosts that carry RTPS or Zenoh, the worst first. */
function Links() {
  const { data } = usePoll('participants', LINKS_EVERY_MS);
  if (!data?.links.length) return null;
  const again = (/** @type {any} */ link) =>
    (link.sent_segments ? link.retransmitted_segments / link.sent_segments : 0);
  const links = [...data.links].sort((one, other) => again(other) - again(one));
  return html`<section aria-labelledby="links"><h2 id="links">TCP links to other hosts</h2>
    <div class="scroll" tabindex="0" role="group" aria-labelledby="links"><table>
    <thead><tr><th scope="col">From → to</th><th scope="col">Protocol</th>
      <th scope="col" class="number">Connections</th><th scope="col" class="number">Round trip</th>
      <th scope="col" class="number">Unsent</th><th scope="col" class="number">Unacknowledged</th>
      <th scope="col" class="number">Segments</th>
      <th scope="col" class="number">Sent again</th></tr></thead>
    <tbody>${links.map((/** @type {any} */ link) => html`
      <tr key=${`${link.protocol} ${link.source} ${link.destination}`}>
      <th scope="row">${link.source} → ${link.destination}</th>
      <td>${link.protocol === 'rtps' ? 'RTPS' : 'Zenoh'}</td>
      <td class="number">${count(link.connections)}</td>
      <td class="number">${duration(link.round_trip_seconds)}</td>
      <td class="number">${bytes(link.unsent_bytes)}</td>
      <td class="number">${bytes(link.unacknowledged_bytes)}</td>
      <td class="number">${count(link.sent_segments)}</td>
      <td class="number">${count(link.retransmitted_segments)} (${percent(again(link))})</td></tr>`)}
    </tbody></table></div></section>`;
}

/**
 * CPU and memory of a node's processes over time.
 * @param {{participants: (import('../state.js').Participant|null|undefined)[]}} props
 */
function ProcessCharts({ participants }) {
  const shown = useTime();
  const { data, problem } = useHistory(state.open?.keeps_history ? 'history/processes' : null, shown);
  const own = usageOf(data?.processes ?? [], participants);
  const title = inWords(shown);
  const events = useEvents(shown).filter(({ severity }) => severity !== 'INFO');
  const marks = marksOf(events);
  return html`<${Failed} problem=${problem} what="No CPU and memory over time" />${data?.is_truncated && !own.length && html`<p class="problem"><${Mark} severity="warning" /> Processes that
    ended early in this time are too many for one answer. A shorter time has them.</p>`}${own.map((/** @type {any} */ each) => html`<section key=${`${each.process_id} ${each.process}`}
    aria-label="CPU and memory of ${each.process}"><h2>${title}: <${Name}
      text=${`${each.process} ${each.process_id}`} /></h2><div class="charts">
    <${Chart} title="CPU" times=${each.times} print=${percent} range=${title} select=${zoom}
      marks=${marks}
      lines=${[{ label: 'of a core', colour: '--line-1', values: each.cpu_cores, fill: true }]} />
    <${Chart} title="Memory" times=${each.times} print=${bytes} range=${title} select=${zoom} fitted
      marks=${marks}
      lines=${[{ label: 'resident', colour: '--line-2', values: each.memory_bytes }]} />
    </div></section>`)}`;
}

/** @param {{name: string, query: Record<string, string>}} props */
export function NodeView({ name, query }) {
  useLive();
  const domain = query.domain ? Number(query.domain) : null;
  const node = state.nodeNamed(name, domain);
  const scope = node ? `?domain_id=${node.domain}` : '';
  const details = usePoll(node ? named('nodes', name.replace(/^\//, ''), scope) : null, 5000);
  const services = usePoll(node ? `services${scope}${scope ? '&' : '?'}hidden=true` : null, 5000);
  const { byId } = useProcesses();
  if (!node) {
    return html`<h1 tabindex="-1"><${Name} text=${name} /></h1>
      <p>No such node ${stream.at == null ? 'now' : state.unknown ? 'is known of that time' : 'at that time'}. <a href=${address('nodes')}>All nodes</a></p>`;
  }
  const { data } = details;
  const findings = state.findings.filter((finding) => finding.node === node.id);
  const instances = node.participants.map((id) => state.participants.get(id)).filter(Boolean);
  const byName = new Map((services.data?.services ?? []).map((/** @type {any} */ each) =>
    [each.name, each]));
  const known = PARAMETER_SERVICES.filter((each) => byName.has(`${name}/${each}`));
  const list = (/** @type {string} */ title, /** @type {any[]|undefined} */ rows,
    /** @type {string|null} */ view) => rows && rows.length > 0 && html`<section
    aria-label=${title}><h2>${title} (${count(rows.length)})</h2><ul class="plain">${rows.map((row) => html`
    <li key=${row.name}>${view ? html`<a href=${address(view, row.name, { domain: node.domain })}><${Name}
      text=${row.name} /></a>` : html`<${Name} text=${row.name} />`} <span class="dim"><${Name}
      text=${row.types.join(', ')} /></span> ${view ? '' : calls(byName.get(row.name)?.calls)}</li>`)}
    </ul></section>`;
  return html`<h1 tabindex="-1"><${Name} text=${node.name} /></h1>
    <p class="facts">${state.hasDomains() && html`<span class="dim">Domain</span> ${node.domain} `}
      <a href=${address('graph', null, { focus: nodeKey(node), hops: 1 })}>In the graph</a></p>
    <${InChains} domain=${node.domain} node=${node.name} />
    ${findings.length > 0 && html`<section aria-label="Findings"><${Findings} list=${findings} />
      </section>`}
    <section aria-labelledby="where"><h2 id="where">${instances.length > 1
      ? 'Processes of this name' : 'Process'}</h2>
    <div class="scroll" tabindex="0" role="group" aria-labelledby="where"><table><thead><tr>
      <th scope="col">Process</th><th scope="col">Host</th><th scope="col" class="number">CPU</th>
      <th scope="col" class="number">Memory</th><th scope="col" class="number">Threads</th>
      <th scope="col">Started</th><th scope="col">Control group</th><th scope="col">Participant</th></tr></thead>
    <tbody>${instances.map((own) => {
      const process = processOf(own, byId);
      return own && html`<tr key=${own.guid}><th scope="row"><${Name}
        text=${state.processName(own) || 'unknown'} /></th>
        <td><${Name} text=${own.host ?? 'unknown'} /></td>
        <td class="number">${percent(process?.part)}</td>
        <td class="number">${bytes(process?.memory_bytes)}</td>
        <td class="number">${count(process?.threads)}</td>
        <td>${date(process?.started_timestamp_seconds)}</td>
        <td>${own.container && html`<${Name} text=${own.container} /><br />`}<span
          class="dim"><${Name} text=${own.cgroup ?? ''} /></span></td>
        <td>${own.vendor ?? ''} <${Name} text=${own.guid} /></td></tr>`;
    })}</tbody></table></div></section>
    <${ProcessCharts} participants=${instances} />
    <${Failed} problem=${details.problem} what="No details" />
    <p>Parameters: ${services.data
      ? known.length ? 'the node has parameter services.' : 'the node has no parameter services.'
      : '–'}</p>
    <${Inside} key=${`inside ${node.id}`} inside=${data?.inside} name=${node.name} domain=${node.domain} />
    ${list('Publishers', data?.publishers, 'topics')}
    ${list('Subscriptions', data?.subscriptions, 'topics')}
    ${list('Services', data?.services, null)}
    ${list('Clients of services', data?.clients, null)}
    ${list('Action servers', data?.action_servers, null)}
    ${list('Action clients', data?.action_clients, null)}`;
}
