// The current message of a topic: a tree of its fields, and charts of selected numbers.
// The agent sends at most five messages per second, and only while this is open.

import { useEffect, useRef, useState } from './vendor/hooks.mjs';
import { named, Refusal, request } from './api.js';
import { Chart } from './chart.js';
import { bytes, count, visible, when } from './format.js';
import { Preview } from './preview.js';
import { Lines } from './state.js';
import { state, stream, useKept } from './store.js';
import { marksOf } from './timebar.js';
import { AskButton, Failed, html, Mark, Name, Text } from './ui.js';

const HERTZ = 5;
/** Points of a field's chart: two minutes at five per second. */
const MOST_POINTS = 600;
/** Most lines of a tree: a message may have thousands of fields. */
const MOST_LINES = 400;

/**
 * @typedef {{path: string, depth: number, key: string, value: unknown, count: number|null,
 *   closed: boolean}} Leaf
 *   `count` is the number of members of an object or array, null for a value.
 */

/** Arrays with more members are closed at first. */
const LONG = 40;

/**
 * Returns a message as lines; arrays and texts truncated by the agent show their full length.
 * @param {unknown} value
 * @param {Set<string>} toggled paths of objects and arrays that the user has opened or closed
 * @param {number} [most]
 * @returns {Leaf[]}
 */
export function flatten(value, toggled, most = MOST_LINES) {
  /** @type {Leaf[]} */
  const lines = [];
  const walk = (/** @type {unknown} */ each, /** @type {string} */ key, /** @type {string} */ path,
    /** @type {number} */ depth) => {
    if (lines.length >= most) return;
    const [members, length, cut] = inside(each);
    if (!members) {
      lines.push({ path, depth, key, value: cut ?? each, count: null, closed: false });
      return;
    }
    const isLong = typeof members[0]?.[0] === 'number' && length > LONG;
    const closed = toggled.has(path) !== isLong;
    if (depth >= 0) lines.push({ path, depth, key, value: null, count: length, closed });
    if (closed) return;
    for (const [name, member] of members) {
      const isPlace = typeof name === 'number';
      walk(member, isPlace ? `[${name}]` : name,
        isPlace ? `${path}[${name}]` : path ? `${path}.${name}` : name, depth + 1);
    }
  };
  walk(value, '', '', -1);
  return lines;
}

/**
 * Returns the members of an object or array with their number; for a truncated text, the text.
 * @param {unknown} value
 * @returns {[[string|number, unknown][]|null, number, string|null]}
 */
function inside(value) {
  if (value === null || typeof value !== 'object') return [null, 0, null];
  if (Array.isArray(value)) return [value.map((each, at) => [at, each]), value.length, null];
  const own = /** @type {Record<string, any>} */ (value);
  if (typeof own.$text === 'string') return [null, 0, `${own.$text}… (${own.$length} characters)`];
  if (Array.isArray(own.$items)) {
    return [own.$items.map((/** @type {unknown} */ each, /** @type {number} */ at) => [at, each]),
      own.$length, null];
  }
  const members = Object.entries(own);
  return [members, members.length, null];
}

/**
 * Returns the number at a path such as `pose.position.x` or `ranges[3]`; null for other values.
 * @param {unknown} value
 * @param {string} path
 * @returns {number|null}
 */
export function numberAt(value, path) {
  let at = value;
  for (const part of path.match(/[^.[\]]+/g) ?? []) {
    if (at === null || typeof at !== 'object') return null;
    const own = /** @type {any} */ (at);
    at = Array.isArray(own.$items) ? own.$items[Number(part)] : own[part];
  }
  if (typeof at === 'boolean') return Number(at);
  const number = typeof at === 'string' && at.trim() !== '' ? Number(at) : at;
  return typeof number === 'number' && Number.isFinite(number) ? number : null;
}

/** Returns values minus the first of them. @param {(number|null)[]} values */
export function sinceFirst(values) {
  const first = values.find((value) => value != null) ?? 0;
  return values.map((value) => (value == null ? null : value - first));
}

/** Colours of plotted fields, as CSS variables. */
const COLOURS = [1, 2, 3, 4, 5, 6].map((number) => `--line-${number}`);

/**
 * Returns the lines of each chart of fields.
 * @param {[string, (number|null)[]][]} fields paths and values
 * @param {boolean} isApart whether each field has a chart of its own
 * @param {boolean} isRelative whether lines begin at zero
 * @returns {import('./chart.js').Line[][]}
 */
export function plotsOf(fields, isApart, isRelative) {
  const lines = fields.map(([label, values], at) => ({ label, colour: COLOURS[at % COLOURS.length],
    values: isRelative ? sinceFirst(values) : values }));
  return isApart ? lines.map((line) => [line]) : lines.length ? [lines] : [];
}

/** @param {{topic: import('./state.js').Topic, scope: string, name: string,
 *   events: import('./state.js').Event[]}} props */
export function LiveMessage({ topic, scope, name, events }) {
  // A capture that was read to its end has no more messages.
  const [wanted, want] = useKept('live message', true);
  const [open, turn] = useState(wanted && !state.replay?.finished);
  const may = state.may('all');
  return html`<section aria-labelledby="live"><h2 id="live">Live message</h2>
    ${!may && html`<p>Messages may contain anything the robot sees. Showing them needs a token with the
      right <strong>all</strong>: run <code>rp page</code> on the robot. <${AskButton} /></p>`}
    ${may && html`<p><button type="button" aria-expanded=${open} onClick=${() => {
      turn(!open);
      want(!open);
    }}>${open
      ? 'Close' : 'Show messages'}</button> <span class="dim">at most ${HERTZ} per second; the topic
      is measured while they are shown</span></p>`}
    ${may && open && html`<${Follow} scope=${scope} name=${name} topic=${topic} events=${events} />`}</section>`;
}

/** @param {{scope: string, name: string, topic: import('./state.js').Topic,
 *   events: import('./state.js').Event[]}} props */
function Follow({ scope, name, topic, events }) {
  const [type, setType] = useState(/** @type {any} */ (null));
  const [message, setMessage] = useState(/** @type {any} */ (null));
  const [problem, refuse] = useState(/** @type {Refusal|null} */ (null));
  const [end, setEnd] = useState('');
  const [toggled, setToggled] = useState(/** @type {Set<string>} */ (new Set()));
  const [plotted, plot] = useKept(`plot ${topic.types[0]}`, /** @type {string[]} */ ([]));
  const [isRelative, setRelative] = useKept('relative plots', false);
  const [isApart, setApart] = useKept('one chart each', true);
  const [run, again] = useState(0);
  const points = useRef({ times: /** @type {number[]} */ ([]),
    values: /** @type {Map<string, (number|null)[]>} */ (new Map()) });
  const wanted = useRef(plotted);
  wanted.current = plotted;
  useEffect(() => {
    const abort = new AbortController();
    const take = (/** @type {any} */ line) => {
      if (line.type) setType(line.type);
      if (line.end) setEnd(line.end.reason);
      if (!line.message || stream.status === 'paused') return;
      setMessage(line.message);
      const { times, values } = points.current;
      times.push(line.message.time);
      for (const path of wanted.current) {
        const own = values.get(path) ?? times.slice(1).map(() => null);
        own.push(numberAt(line.message.value, path));
        values.set(path, own);
      }
      for (const path of [...values.keys()]) {
        if (!wanted.current.includes(path)) values.delete(path);
      }
      while (times.length > MOST_POINTS) {
        times.shift();
        for (const own of values.values()) own.shift();
      }
    };
    const follow = async () => {
      const rest = `/messages${scope}${scope ? '&' : '?'}max_hertz=${HERTZ}&preview=true`;
      const response = await request(named('topics', name, rest), { signal: abort.signal });
      const reader = /** @type {ReadableStream<Uint8Array>} */ (response.body).getReader();
      const [decoder, lines] = [new TextDecoder(), new Lines()];
      for (;;) {
        const { done, value } = await reader.read();
        if (done) return;
        for (const line of lines.take(decoder.decode(value, { stream: true }))) take(line);
      }
    };
    refuse(null);
    setEnd('');
    follow().then(() => setEnd((/** @type {string} */ reason) => reason || 'the connection was lost'), (error) => {
      if (abort.signal.aborted) return;
      refuse(error instanceof Refusal ? error : new Refusal(0, 'the connection was lost'));
    });
    // A hidden tab sends no requests.
    const hidden = () => {
      if (document.visibilityState === 'hidden') abort.abort();
      else if (abort.signal.aborted) again((/** @type {number} */ value) => value + 1);
    };
    document.addEventListener('visibilitychange', hidden);
    return () => {
      document.removeEventListener('visibilitychange', hidden);
      abort.abort();
    };
  }, [name, scope, run]);
  // A stream that was opened again, after an agent that was out of reach, has messages again. Without
  // a network, a connection ends without a notice, so its messages begin again in any case.
  const { openings } = state;
  const opened = useRef(openings);
  useEffect(() => {
    if (opened.current === openings) return;
    opened.current = openings;
    // A hidden tab begins again when it is shown.
    if (document.visibilityState !== 'hidden') again((/** @type {number} */ value) => value + 1);
  }, [openings]);
  const toggle = (/** @type {string} */ path) => {
    const next = new Set(toggled);
    if (!next.delete(path)) next.add(path);
    setToggled(next);
  };
  const choose = (/** @type {string} */ path) => plot(plotted.includes(path)
    ? plotted.filter((each) => each !== path) : [...plotted, path].slice(-6));
  const lines = message?.value != null ? flatten(message.value, toggled) : [];
  const { times, values } = points.current;
  const plots = plotsOf(plotted.filter((path) => values.has(path)).map((path) =>
    [path, values.get(path) ?? []]), isApart, isRelative);
  const marks = marksOf(events);
  const button = html`<button type="button" onClick=${() => again(run + 1)}>Again</button>`;
  return html`
    ${problem && html`<div><${Failed} problem=${problem} what="No messages" /><p>${button}</p></div>`}
    ${end && html`<p class="problem"><${Mark} severity="warning" /> The messages end: ${end}.${' '}
      ${button}</p>`}
    ${type && !type.known && html`<p><${Mark} severity="note" /> The definition of <${Name}
      text=${type.name} /> is not known: ${type.reason ?? 'no file has it'}. Sizes are shown, fields
      are not.</p>`}
    ${!message && !problem && !end && html`<p class="dim">${!topic.publishers.length
      ? 'Nobody publishes the topic now.' : !topic.subscriptions.length
        ? 'Nobody subscribes, so nothing is sent.' : stream.status === 'paused'
          ? 'Paused: new messages are not shown.' : 'Waiting for a message …'}</p>`}
    ${plotted.length > 0 && html`<p><label><input type="checkbox" checked=${isRelative}
      onChange=${(/** @type {any} */ event) => setRelative(event.target.checked)} />
      Changes since the first value</label>${plotted.length > 1 && html` <label><input type="checkbox"
        checked=${isApart} onChange=${(/** @type {any} */ event) => setApart(event.target.checked)} />
        One chart each</label>`}</p>`}
    ${plots.length > 0 && html`<div class="charts">${plots.map((lines) => html`<${Chart}
      key=${lines[0].label} title=${lines.map(({ label }) => label).join(', ')} times=${times}
      print=${printNumber} fitted marks=${marks} range="the last messages" lines=${lines} />`)}</div>`}
    ${message && html`<p class="dim">${when(message.time)}, ${bytes(message.bytes)}${
      message.sequence_number != null ? `, number ${count(message.sequence_number)}` : ''}${
      message.node ? html` by <${Name} text=${message.node} />` : ''}${message.skipped
      ? `, ${count(message.skipped)} not shown before it` : ''}</p>`}
    ${message?.error && html`<p><${Mark} severity="warning" /> <${Name} text=${message.error} /></p>`}
    <div class="message">${message && html`<${Preview} preview=${message.preview}
      error=${message.preview_error} />`}
    ${lines.length > 0 && html`<div class="scroll tree" tabindex="0" role="group"
      aria-label="Fields of the message"><table><thead><tr><th scope="col">Field</th>
      <th scope="col">Value</th><th scope="col"><span class="reader-only">Plot</span></th></tr></thead>
      <tbody>${lines.map((line) => html`<${FieldRow} key=${line.path} line=${line}
        closed=${line.closed} toggle=${toggle} choose=${choose}
        plotted=${plotted.includes(line.path)} />`)}</tbody></table></div>`}</div>
    ${lines.length >= MOST_LINES && html`<p class="dim">The first ${count(MOST_LINES)} fields.</p>`}
    ${type?.definition && html`<details><summary>Definition of <${Name} text=${type.name} /></summary>
      <${Text} text=${type.definition} />
      ${type.source && html`<p class="dim">From <${Name} text=${type.source} /></p>`}</details>`}`;
}

/**
 * @param {{line: Leaf, closed: boolean, toggle: (path: string) => void,
 *   choose: (path: string) => void, plotted: boolean}} props
 */
function FieldRow({ line, closed, toggle, choose, plotted }) {
  const own = typeof line.value === 'number' || typeof line.value === 'boolean';
  const name = html`<${Name} text=${line.key} />`;
  return html`<tr><th scope="row" class="depth-${Math.min(8, line.depth)}">${line.count == null ? name
    : html`<button type="button" class="plain" aria-expanded=${!closed}
      onClick=${() => toggle(line.path)}><span aria-hidden="true">${closed ? '▸' : '▾'}</span> ${name}${' '}
      <span class="dim">(${count(line.count)})</span></button>`}</th>
    <td class="value">${line.count == null ? printValue(line.value) : ''}</td>
    <td>${own && html`<button type="button" class="small" aria-pressed=${plotted}
      aria-label="Plot ${line.path}" onClick=${() => choose(line.path)}>plot</button>`}</td></tr>`;
}

/** @param {unknown} value */
function printValue(value) {
  if (typeof value === 'number') return printNumber(value);
  if (typeof value === 'string') return html`<${Name} text=${value} />`;
  return visible(String(value));
}

/** @param {number|null} value */
function printNumber(value) {
  if (value == null) return '–';
  if (Number.isInteger(value)) return String(value);
  return String(Number(value.toPrecision(9)));
}
