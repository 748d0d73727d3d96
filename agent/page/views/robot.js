// What the robot itself says: logs, diagnostics, transforms, parameters, calls, and clocks.

import { useRef, useState } from '../vendor/hooks.mjs';
import { Bars } from '../chart.js';
import { age, clock, count, date, duration, rate, several, when } from '../format.js';
import { address, clockId, frameId, nodeAddress } from '../router.js';
import { replaceAddress, state, stream, useLive, usePoll } from '../store.js';
import { sorted, Table } from '../table.js';
import { inWords, useEvents, useTime } from '../timebar.js';
import { roots } from '../transforms.js';
import { Failed, Filter, html, Long, Mark, matches, Name } from '../ui.js';
import { useEarlier } from './events.js';
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
/** Most changes of a level in the document. */
const MOST_CHANGES = 20;
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
    <${View} key=${`${part} ${stream.at}`} query=${query} change=${change} />`;
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

/** Minutes of the chart of logs. */
const MINUTES = 30;
/** Kinds of the chart of logs, from the bottom: words and a CSS variable. */
const KINDS = /** @type {[string, string][]} */ ([['errors', '--error'], ['warnings', '--warning'],
  ['others', '--edge']]);
/** Time without an answer after which earlier minutes are unknown, in seconds. */
const GAP_S = 60;

/**
 * Counts messages of logs by minute. The first answer has the messages that the agent keeps; after it,
 * the agent's counts of each level grow.
 */
export class Minutes {
  constructor() {
    /** @type {Map<number, number[]>} */ this.counts = new Map();
    /** @type {number[]|null} */ this.totals = null;
    this.time = 0;
    /** Unix time since which the counts are complete; null since the agent started. */
    this.since = /** @type {number|null} */ (null);
  }

  /** @param {number} time @param {number} kind @param {number} messages */
  add(time, kind, messages) {
    const minute = Math.floor(time / 60);
    const own = this.counts.get(minute) ?? KINDS.map(() => 0);
    own[kind] += messages;
    this.counts.set(minute, own);
  }

  /** @param {any} answer of `GET /logs` @param {boolean} isFirst whether it has the messages of all levels */
  take(answer, isFirst) {
    if (answer.timestamp_seconds <= this.time || (!isFirst && !this.totals)) return;
    const kindOf = (/** @type {string} */ level) => ({ fatal: 0, error: 0, warn: 1 })[level] ?? 2;
    const totals = KINDS.map(() => 0);
    for (const node of answer.nodes) {
      for (const { level, messages } of node.levels) totals[kindOf(level)] += messages;
    }
    if (isFirst) {
      this.counts.clear();
      const [first] = answer.messages;
      this.since = answer.messages.length >= MOST_KEPT ? first.timestamp_seconds : null;
      for (const each of answer.messages) this.add(each.timestamp_seconds, kindOf(each.level), 1);
    } else if (answer.timestamp_seconds - this.time > GAP_S) {
      this.counts.clear();
      this.since = answer.timestamp_seconds;
    } else {
      totals.forEach((total, kind) => this.add(answer.timestamp_seconds, kind,
        Math.max(0, total - (this.totals?.[kind] ?? 0))));
    }
    this.time = answer.timestamp_seconds;
    this.totals = totals;
  }

  /** Returns the counts of the last minutes by kind, null before they are known. */
  bars() {
    const last = Math.floor(this.time / 60);
    return Array.from({ length: MINUTES }, (_, at) => {
      const minute = last - MINUTES + 1 + at;
      return this.counts.get(minute) ?? (minute + 1 <= (this.since ?? 0) / 60 ? null : KINDS.map(() => 0));
    });
  }
}

/** Messages a minute by their level. @param {{answer: any}} props the repeated answer */
function LogChart({ answer }) {
  const first = usePoll(`logs?limit=${MOST_KEPT}`, 0);
  const minutes = useRef(new Minutes());
  const { current } = minutes;
  if (first.data) current.take(first.data, !current.totals);
  if (answer.data) current.take(answer.data, false);
  if (!current.totals?.some((/** @type {number} */ total) => total > 0)) return null;
  const { since, time } = current;
  const from = 60 * (Math.floor(time / 60) - MINUTES + 1);
  return html`<${Bars} label="Messages a minute" bars=${current.bars()} kinds=${KINDS} from=${from}
    step=${60} words=${`a bar is a minute, from ${clock(from)} to ${clock(time)}${
      since == null ? '' : `, known since ${clock(since)}`}`} />`;
}

/** Returns whether any message of logs is known: one of another level may be. @param {any[]} nodes */
export function isHeard(nodes) {
  return nodes.some(({ levels }) => levels.some((/** @type {any} */ each) => each.messages > 0));
}

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
    <${LogChart} answer=${answer} />
    ${rows.length ? html`<div class="scroll tall" tabindex="0" role="group" aria-label="Messages"><table>
      <thead><tr><th scope="col">Time</th><th scope="col">Level</th><th scope="col">Node</th>
        <th scope="col">Text</th></tr></thead>
      <tbody>${rows.slice(0, MOST_SHOWN).map((/** @type {any} */ each) => html`
        <tr key=${`${each.writer} ${each.sequence_number}`}>
        <td class="number">${when(each.timestamp_seconds)}</td>
        <td class="level"><${Mark} severity=${SEVERITY[each.level]} /> ${each.level}</td>
        <th scope="row"><${Node} name=${each.ros_node} domain=${each.domain_id} /></th>
        <td>${each.file ? html`<details><summary><${Name} text=${each.text} /></summary><span class="dim"><${Name}
          text=${`${each.file}:${each.line} ${each.function}`} /></span></details>` : html`<${Name} text=${each.text} />`}</td>
        </tr>`)}</tbody></table></div>
      ${rows.length >= MOST_SHOWN && html`<p class="dim">The latest ${count(MOST_SHOWN)}${filter
        ? ` of ${count(rows.length)}` : `; a filter searches the latest ${count(MOST_KEPT)}`}.</p>`}`
    : all.length || isHeard(nodes) ? html`<p class="empty">No message matches.</p>`
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

/**
 * @typedef {{path: string, name: string, depth: number, level: string, status: any, parts: any[],
 *   children: Part[]}} Part
 *   A part of the robot: its own status or null, and the statuses of it and of the parts below it.
 */

/**
 * Returns the parts of diagnostics as a tree, by the slashes in their names. Each has the worst level
 * of the parts below it, and the worst ones come first. A part without a status that contains only one
 * other part is drawn with it.
 * @param {any[]} statuses
 * @returns {Part[]}
 */
export function partsOf(statuses) {
  const topics = new Set(statuses.map((status) => `${status.domain_id} ${status.topic}`));
  const root = /** @type {Part} */ ({ path: '', name: '', depth: -1, level: 'ok', status: null, parts: [],
    children: [] });
  for (const status of statuses) {
    const names = status.name.split('/').filter(Boolean);
    if (topics.size > 1) names.unshift(`${status.topic}${state.hasDomains() ? ` ${status.domain_id}` : ''}`);
    let at = root;
    for (const [place, name] of names.entries()) {
      const isLast = place === names.length - 1;
      let next = at.children.find((each) => each.name === name && !(isLast && each.status));
      if (!next) {
        next = { path: `${at.path}/${name}`, name, depth: place, level: 'ok', status: null, parts: [], children: [] };
        at.children.push(next);
      }
      next.parts.push(status);
      at = next;
    }
    at.status = status;
  }
  const finish = (/** @type {Part} */ part) => {
    while (!part.status && part.children.length === 1 && part.depth >= 0) {
      const [only] = part.children;
      Object.assign(part, { ...only, name: `${part.name}/${only.name}`, depth: part.depth });
    }
    part.level = LEVELS.find((level) => part.parts.some((each) => each.level === level)) ?? 'ok';
    for (const child of part.children) {
      child.depth = part.depth + 1;
      finish(child);
    }
    part.children.sort((one, other) => LEVELS.indexOf(one.level) - LEVELS.indexOf(other.level)
      || (one.name < other.name ? -1 : 1));
  };
  finish(root);
  return root.children;
}

/**
 * Returns the lines of a tree. A part in order is closed until the user opens it.
 * @param {Part[]} parts
 * @param {Set<string>} toggled paths of parts
 * @returns {(Part & {closed: boolean})[]}
 */
export function linesOf(parts, toggled) {
  return parts.flatMap((part) => {
    const closed = part.children.length > 0 && (part.level === 'ok') !== toggled.has(part.path);
    return [{ ...part, closed }, ...(closed ? [] : linesOf(part.children, toggled))];
  });
}

/**
 * Returns the changes of a status's level, the latest first.
 * @param {import('../state.js').Event[]} events
 * @param {any} status
 */
export function changesOf(events, status) {
  return events.filter(({ name, attributes }) => name === 'ros2.robot.diagnostic_changed'
    && attributes.name === status.name && attributes.topic === status.topic
    && (attributes.hardware_id ?? '') === (status.hardware_id ?? '')
    && attributes.domain_id === status.domain_id).reverse();
}

/** The values of a status, and the changes of its level. @param {{status: any, events: any[]}} props */
function Status({ status, events }) {
  const changes = changesOf(events, status);
  if (!status.values.length && !changes.length) return html`<${Name} text=${status.message} />`;
  return html`<details><summary><${Name} text=${status.message || 'values'} /></summary><ul class="plain">
    ${status.values.map((/** @type {any} */ each, /** @type {number} */ at) => html`<li key=${at}>
      <span class="dim"><${Name} text=${each.key} /></span> <${Name} text=${each.value} /></li>`)}</ul>
    ${changes.length > 0 && html`<p class="dim">Changes of its level:</p><ul class="plain">${changes.slice(
      0, MOST_CHANGES).map((each) => html`<li key=${each.id}>${date(Date.parse(each.time) / 1000)} <${Name}
      text=${`${each.attributes.from ?? 'unknown'} → ${each.attributes.to}`} /> <${Name}
      text=${each.attributes.message ?? ''} /></li>`)}</ul>`}</details>`;
}

/** Counts the statuses of each level in words. @param {any[]} parts */
function levelsOf(parts) {
  return LEVELS.map((level) => [level, parts.filter((each) => each.level === level).length])
    .filter(([, number]) => number).map(([level, number]) => `${count(Number(number))} ${level}`).join(', ');
}

/** @param {Props} props */
function Diagnostics({ query, change }) {
  const { filter = '', sort = 'level' } = query;
  const answer = usePoll('diagnostics', EVERY_MS);
  useEarlier();
  const events = useEvents(useTime());
  const [toggled, setToggled] = useState(/** @type {Set<string>} */ (new Set()));
  const all = answer.data?.statuses ?? [];
  const toggle = (/** @type {string} */ path) => {
    const next = new Set(toggled);
    if (!next.delete(path)) next.add(path);
    setToggled(next);
  };
  const since = (/** @type {Part} */ row) => row.status && row.status.since_seconds;
  const columns = [
    { key: 'level', title: 'Level', meaning: 'A part has the worst level of those below it. Stale: its messages ceased, or a monitor reports that.', by: (/** @type {any} */ row) => LEVELS.indexOf(row.level),
      cell: (/** @type {any} */ row) => html`<${Mark} severity=${SEVERITY[row.level]} /> ${row.level}` },
    { key: 'name', title: 'Part', header: true, by: (/** @type {any} */ row) => row.name,
      cell: (/** @type {any} */ row) => html`<span class="depth-${Math.min(8, row.depth)}">${
        row.children.length ? html`<button type="button" class="plain" aria-expanded=${!row.closed}
          onClick=${() => toggle(row.path)}><span aria-hidden="true">${row.closed ? '▸' : '▾'}</span> <${Name}
          text=${row.name} /></button>` : html`<${Name} text=${row.name} />`}${
        row.status && inDomain(row.status.domain_id)}</span>` },
    { key: 'message', title: 'Message', cell: (/** @type {any} */ row) => html`${row.children.length > 0
      && html`<span class="dim">${levelsOf(row.parts.filter((/** @type {any} */ each) => each !== row.status))} </span>`}${
      row.status && html`<${Status} status=${row.status} events=${events} />`}` },
    { key: 'node', title: 'Node', kind: 'wide', by: (/** @type {any} */ row) => row.status?.ros_node,
      cell: (/** @type {any} */ row) => row.status && html`<${Node} name=${row.status.ros_node}
        domain=${row.status.domain_id} />` },
    { key: 'since', title: 'For', meaning: 'How long the part has this level.', kind: 'number', by: (/** @type {any} */ row) => (row.status ? -since(row) : null),
      cell: (/** @type {any} */ row) => row.status && age(state.time - since(row)) },
    { key: 'last', title: 'Last', kind: 'number wide', by: (/** @type {any} */ row) =>
      (row.status ? -row.status.timestamp_seconds : null),
      cell: (/** @type {any} */ row) => row.status && when(row.status.timestamp_seconds) },
  ];
  const found = all.filter((/** @type {any} */ row) =>
    matches(filter, `${row.level} ${row.name} ${row.message} ${row.hardware_id}`));
  // In another order than the tree's own, and in the result of a filter, names are whole.
  const isTree = sort === 'level' && !filter;
  const rows = isTree ? linesOf(partsOf(found), toggled) : sorted(found.map((/** @type {any} */ status) => ({
    path: [status.domain_id, status.topic, status.name, status.hardware_id].join(' '), name: status.name,
    depth: 0, level: status.level, status, parts: [status], children: [], closed: false })), columns, sort);
  return html`<div class="controls"><${Filter} label="Filter" value=${filter} found=${found.length}
      noun="part" change=${(/** @type {string} */ text) => change({ filter: text })} />
      ${all.length > 0 && html`<span class="dim">${levelsOf(found)}</span>`}</div>
    ${all.length ? html`<${Table} label="Diagnostics" columns=${columns} rows=${rows} sort=${sort}
        keyOf=${(/** @type {any} */ row) => row.status && !isTree ? row.path : `${row.path} ${row.status?.hardware_id ?? ''}`}
        onSort=${(/** @type {string} */ key) => change({ sort: key })} />
`
      : html`<${Nothing} answer=${answer} part="diagnostics">No message of <code>/diagnostics</code> so
        far. A message that no subscription requests is not sent.</${Nothing}>`}`;
}

/**
 * Returns the jumps of each edge, by `domain namespace child`.
 * @param {import('../state.js').Event[]} events
 * @returns {Map<string, number>}
 */
export function jumpsOf(events) {
  const found = new Map();
  for (const { name, attributes } of events) {
    if (name !== 'ros2.robot.transform_jumped') continue;
    const key = `${attributes.domain_id} ${attributes.namespace ?? ''} ${attributes.child}`;
    found.set(key, (found.get(key) ?? 0) + 1);
  }
  return found;
}

/** Difference of clocks above which a stamp is of simulated time, in seconds. */
const OTHER_CLOCK_S = 1e6;

/**
 * Returns how old the stamp of an edge was when it arrived, in seconds; null for a static edge and
 * for simulated time. A negative age is in the future.
 * @param {any} edge
 */
export function stampAge(edge) {
  const own = edge.timestamp_seconds - edge.stamp_sec - edge.stamp_nanosec * 1e-9;
  return edge.is_static || Math.abs(own) > OTHER_CLOCK_S ? null : own;
}

/**
 * Returns by how many seconds a node that asks for the present exceeds the latest transform, about:
 * the age of its stamp, and the time until the next one. Null for a static edge, for simulated time, and
 * before a second transform.
 * @param {any} edge
 * @param {number} now time of the answer
 */
export function extrapolation(edge, now) {
  const age = stampAge(edge);
  const interval = edge.longest_interval_seconds;
  return age == null || interval == null ? null
    : Math.max(0, age + Math.max(interval, now - edge.timestamp_seconds));
}

/**
 * Returns the jumps of an edge in words, by kind. They are unknown in answers of earlier agents.
 * @param {{translation: number, rotation: number, time: number}|undefined} jumps
 */
export function jumpWords(jumps) {
  if (!jumps) return '–';
  const kinds = /** @type {[string, number][]} */ ([['position', jumps.translation],
    ['orientation', jumps.rotation], ['time', jumps.time]]);
  return kinds.filter(([, number]) => number).map(([kind, number]) => `${count(number)} ${kind}`).join(', ') || '0';
}

/** Returns frames with those below them. @param {import('../transforms.js').Frame[]} frames @returns {[import('../transforms.js').Frame, number][]} */
const below = (frames, depth = 0) => frames.flatMap((frame) => [
  /** @type {[import('../transforms.js').Frame, number]} */ ([frame, depth]), ...below(frame.children, depth + 1)]);

function Transforms() {
  const answer = usePoll('transforms', EVERY_MS);
  useEarlier();
  const time = useTime();
  const jumps = jumpsOf(useEvents(time));
  const trees = answer.data?.trees ?? [];
  const faults = state.findings.filter((finding) => finding.kind === 'transform_fault');
  return html`${faults.length > 0 && html`<${Findings} list=${faults} />`}
    ${trees.length ? html`${trees.map((/** @type {any} */ tree) => html`
      <section key=${`${tree.domain_id} ${tree.namespace}`} aria-label=${`Frames ${tree.namespace}`}>
      <h2><${Name} text=${tree.namespace || '/'} />${inDomain(tree.domain_id)}</h2>
      ${tree.unread_static_publishers > 0 && html`<p class="dim">Static transforms of ${several(
        tree.unread_static_publishers, 'publisher')} are missing: the agent came later.</p>`}
      <div class="scroll" tabindex="0" role="group" aria-label=${`Tree of frames ${tree.namespace}`}><table>
      <thead><tr><th scope="col">Frame</th><th scope="col" class="number">Rate</th>
        <th scope="col" class="number">Last</th><th scope="col" class="number">Age of stamp</th>
        <th scope="col" class="number">Extrapolation</th>
        <th scope="col" class="number">Jumps</th><th scope="col">Broadcaster</th>
        <th scope="col" class="number">x, y, z (m)</th></tr></thead>
      <tbody>${below(roots(tree.edges)).map(([frame, depth]) => html`<${Frame} key=${frame.name} depth=${depth}
        frame=${frame} tree=${tree} jumps=${jumps} now=${answer.data.timestamp_seconds} />`)}</tbody></table></div></section>`)}
      <p class="dim">Age of stamp: how old the latest transform was when it arrived. Extrapolation: a node
        that asks for the present exceeds the latest transform by about this time, and waits or extrapolates.
        Whether its lookup fails cannot be seen on the network. Jumps: since its broadcasters appeared, by
        kind; a mark means one in ${inWords(time).replace(/^The/, 'the')}.</p>`
      : html`<${Nothing} answer=${answer} part="transforms">No message of <code>/tf</code> so far. A
        message that no subscription requests is not sent.</${Nothing}>`}`;
}

/**
 * A frame with its edge to its parent.
 * @param {{frame: import('../transforms.js').Frame, depth: number, tree: any, jumps: Map<string, number>, now: number}} props
 */
function Frame({ frame, depth, tree, jumps, now }) {
  const { edge, name } = frame;
  const nodes = (edge?.broadcasters ?? []).map((/** @type {any} */ each) => each.ros_node ?? each.writer);
  const jumped = jumps.get(`${tree.domain_id} ${tree.namespace} ${name}`) ?? 0;
  const old = edge && stampAge(edge);
  return html`<tr id=${frameId(tree.domain_id, tree.namespace, name)}>
    <th scope="row"><span class="depth-${Math.min(8, depth)}"><${Name} text=${name} /></span></th>
    ${edge ? html`<td class="number">${edge.is_static ? 'static' : rate(edge.rate_hz)}</td>
      <td class="number">${edge.is_static ? when(edge.timestamp_seconds) : `${duration(
        Math.max(0, state.time - edge.timestamp_seconds))} ago`}</td>
      <td class="number">${old != null && old < 0 ? html`<${Mark} severity="warning" /> ${duration(-old)} ahead`
        : duration(old)}</td>
      <td class="number">${duration(extrapolation(edge, now))}</td>
      <td class="number">${jumped > 0 && html`<${Mark} severity="warning" /> `}${jumpWords(edge.jumps)}</td>
      <td><${Name} text=${nodes.join(', ')} /></td>
      <td class="number">(${edge.translation.map((/** @type {number} */ each) => each.toFixed(2)).join(', ')})</td>`
      : html`<td colspan="7"></td>`}</tr>`;
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
    { key: 'value', title: 'Last known value', cell: (/** @type {any} */ row) => html`<${Long}
      text=${row.value} most=${120} />` },
    { key: 'time', title: 'Seen', kind: 'number wide', by: (/** @type {any} */ row) =>
      row.timestamp_seconds, cell: (/** @type {any} */ row) => when(row.timestamp_seconds) },
  ];
  const found = all.filter((/** @type {any} */ row) =>
    matches(filter, `${row.ros_node} ${row.name} ${row.value}`));
  return html`${changes.length > 0 && html`<section aria-labelledby="changes"><h2 id="changes">Changes</h2>
      <div class="scroll tall" tabindex="0" role="group" aria-labelledby="changes"><table>
      <thead><tr><th scope="col">Time</th><th scope="col">Parameter</th><th scope="col">Before</th>
        <th scope="col">Value</th><th scope="col">Requested by</th></tr></thead>
      <tbody>${changes.slice(0, MOST_SHOWN).map((/** @type {any} */ each, /** @type {number} */ at) => html`
        <tr key=${`${each.timestamp_seconds} ${at}`}><td class="number">${when(each.timestamp_seconds)}</td>
        <th scope="row"><${Node} name=${each.ros_node} domain=${each.domain_id} /> <${Name}
          text=${each.name} /></th>
        <td>${each.before == null ? '–' : html`<${Long} text=${each.before} most=${60} />`}</td>
        <td>${each.value == null ? 'removed' : html`<${Long} text=${each.value} most=${60} />`}</td>
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

/** Time over which rates are averaged, in seconds. */
const RATE_S = 30;

/** Growing counts at several times, for their rates. */
export class Rates {
  constructor() {
    /** @type {{time: number, counts: Map<string, number>}[]} */ this.samples = [];
  }

  /** @param {number} time @param {Map<string, number>} counts */
  take(time, counts) {
    if (time <= (this.samples.at(-1)?.time ?? 0)) return;
    this.samples.push({ time, counts });
    while (this.samples.length > 2 && time - this.samples[1].time >= RATE_S) this.samples.shift();
  }

  /** Returns counts a second; null before the second answer. @param {string} key */
  of(key) {
    const [first, last] = [this.samples[0], this.samples.at(-1)];
    const now = last?.counts.get(key);
    if (!last || last === first || now == null) return null;
    return Math.max(0, now - (first.counts.get(key) ?? now)) / (last.time - first.time);
  }
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
  const number = (/** @type {string} */ key, /** @type {string} */ title, /** @type {string} */ meaning,
    kind = 'number') => ({ key, title, meaning, kind, by: (/** @type {any} */ row) => row.calls?.[key],
    cell: (/** @type {any} */ row) => count(row.calls?.[key] ?? null),
  });
  const time = (/** @type {string} */ key, /** @type {string} */ title, /** @type {string} */ meaning) => ({
    key, title, meaning, kind: 'number wide', by: (/** @type {any} */ row) => row.calls?.[key],
    cell: (/** @type {any} */ row) => duration(row.calls?.[key]),
  });
  const { current } = useRef(new Rates());
  if (services.data) {
    current.take(services.data.timestamp_seconds, new Map(services.data.services.map(
      (/** @type {any} */ row) => [`${row.domain_id} ${row.name}`, row.calls?.requests ?? 0])));
  }
  const rateOf = (/** @type {any} */ row) => row.calls && current.of(`${row.domain_id} ${row.name}`);
  const columns = [
    { key: 'name', title: 'Service', header: true, by: (/** @type {any} */ row) => row.name,
      cell: (/** @type {any} */ row) => html`<${Name} text=${row.name} />${inDomain(row.domain_id)}` },
    { key: 'servers', title: 'Server', kind: 'wide', cell: (/** @type {any} */ row) => html`<${Name}
      text=${nodesOf(row.servers) || 'none'} />` },
    { key: 'clients', title: 'Clients', kind: 'wide', cell: (/** @type {any} */ row) => html`<${Long}
      text=${nodesOf(row.clients)} most=${60} />` },
    number('requests', 'Requests', 'Calls since the agent started; a dash: none was seen.'),
    { key: 'rate', title: 'Rate', kind: 'number', by: rateOf,
      meaning: 'Calls a second over the last half minute, as this page counts them.', cell: (/** @type {any} */ row) => rate(rateOf(row)) },
    number('answered', 'Answered', 'Calls whose reply reached the client.', 'number wide'),
    { ...number('hanging', 'Hanging', 'Calls that wait for a reply longer than service_timeout_s.'), cell: (/** @type {any} */ row) => ((row.calls?.hanging ?? 0) > 0
      ? html`<${Mark} severity="warning" /> ${count(row.calls.hanging)}` : count(row.calls?.hanging ?? null)) },
    time('latency_p50_seconds', 'p50', 'Half of the latest 1024 replies came faster.'),
    time('latency_p99_seconds', 'p99', 'Of 100 replies, 99 came faster.'),
  ];
  const goals = (actions.data?.actions ?? []).filter((/** @type {any} */ row) => matches(filter, row.name));
  const results = ['accepted', 'succeeded', 'canceled', 'aborted', 'rejected', 'open'];
  return html`<div class="controls"><${Filter} label="Filter" value=${filter}
      found=${rows.length + goals.length} noun="name"
      change=${(/** @type {string} */ text) => change({ filter: text })} /></div>
    <${Failed} problem=${actions.problem} what=${actions.data ? 'The actions are not updated' : 'No actions'} />
    ${(rows.length > 0 || goals.length > 0) && html`<${Failed} problem=${services.problem}
      what=${services.data ? 'The services are not updated' : 'No services'} />`}
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
