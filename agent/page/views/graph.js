// The graph: nodes and topics from left to right, with traffic and failures.

import { useEffect, useMemo, useRef, useState } from '../vendor/hooks.mjs';
import { bandwidth, count, date, duration, rate, several, shortened, visible } from '../format.js';
import { build, differences, dot, MANY_NODES, markOf, MOST_LABEL, nameOf, participantsOf }
  from '../graph-model.js';
import { address, nodeAddress, topicAddress } from '../router.js';
import { State } from '../state.js';
import { replaceAddress, state, useLive, usePoll } from '../store.js';
import { moment } from '../stream.js';
import { Badges, download, Failed, html, Mark, Name, PASSAGES, Sentence, worst }
  from '../ui.js';
import { Camera } from '../camera.js';
import { chainsThrough, graphWords, marked, NO_CHAIN, section, throughGraph, wayOf }
  from '../chains.js';
import { ChainField, ChainLinks, useChains } from './chains.js';
import { Incomplete } from './overview.js';

/** Delay between a change of the structure and its layout. */
const SETTLE_MS = 500;

/** Returns an edge's style for its passages. @param {number} mask @param {string} kind */
function way(mask, kind) {
  if (kind === 'calls' || kind === 'served_by') return 'service';
  const names = state.passagesOf(mask);
  if (!names.length) return 'unmatched';
  return ['network', 'shared_memory'].find((name) => names.includes(name)) ?? 'unseen';
}

/** Returns an edge's width in pixels for its bytes per second. @param {number} bytes */
export function thickness(bytes) {
  return bytes > 0 ? Math.min(7, 1 + Math.log10(1 + bytes / 1000) * 1.2) : 1;
}

/** @param {import('../graph-model.js').Edge} edge */
function load(edge) {
  let [bytes, hertz] = [0, 0];
  let measured = false;
  let severity = 'good';
  for (const id of edge.topics) {
    const figures = state.figuresOf(id);
    if (figures.bandwidth != null) {
      bytes += figures.bandwidth;
      hertz += figures.rate ?? 0;
      measured = true;
    }
    const own = worst(state.flagsOf(id).filter((flag) => flag !== 'qos'));
    severity = worse(severity, own);
  }
  return { bytes, hertz, measured, severity };
}

/** Signs and words of what came, went or changed since a moment before. */
const CHANGES = /** @type {Record<string, [string, string]>} */ ({
  came: ['+', 'new'], gone: ['−', 'went'], changed: ['≠', 'changed'],
});

const ORDER = ['error', 'warning', 'note', 'good'];

/** @param {string} one @param {string} other */
function worse(one, other) {
  return ORDER[Math.min(ORDER.indexOf(one), ORDER.indexOf(other))];
}

/** Returns the endpoints of incompatible pairs. */
function brokenEnds() {
  const guids = new Set();
  for (const finding of state.findings) {
    if (finding.kind !== 'qos_incompatible') continue;
    guids.add(finding.writer);
    guids.add(finding.reader);
  }
  return guids;
}

/** Returns the worst severity of each topic and node. */
function healths() {
  /** @type {Map<number, string>} */
  const nodes = new Map();
  for (const finding of state.findings) {
    if (finding.node == null) continue;
    nodes.set(finding.node, worse(nodes.get(finding.node) ?? 'good', finding.severity));
  }
  return nodes;
}

/** Levels of folding that the first view may need. */
const MOST_FOLDED = 3;
/** What colours the vertices, besides their health. */
const TINTS = /** @type {[string, string][]} */ ([['', 'health'], ['rate', 'rate'],
  ['latency', 'latency'], ['process', 'process'], ['host', 'host']]);
/** Times before the shown one that can be compared, in seconds. */
const BEFORE = /** @type {[number, string][]} */ ([[60, 'a minute before'],
  [600, 'ten minutes before'], [3600, 'an hour before'], [86400, 'a day before']]);
/** Hues of processes and hosts. */
const HUES = 12;
/** Most names in a legend. */
const MOST_NAMES = 40;

/** Values at both ends of a logarithmic scale of colours, and how they are printed. */
const SCALES = /** @type {Record<string, {low: number, decades: number, what: string,
  print: (value: number) => string}>} */ ({
  rate: { low: 1, decades: 3, what: 'Messages a second of a topic', print: rate },
  latency: { low: 1e-4, decades: 4, what: 'p99 latency of a topic', print: duration },
});

/** Returns a colour between green and red on a logarithmic scale. @param {number} part 0 to 1 */
function heat(part) {
  return `hsl(${140 - 140 * Math.max(0, Math.min(1, part))} 65% 45%)`;
}

/**
 * Returns a hue for each name. While there are hues left, each name has its own, which depends on the
 * names before it as little as possible.
 * @param {string[]} names
 */
export function huesOf(names) {
  const taken = new Set();
  return new Map([...new Set(names)].sort().map((name) => {
    let slot = 0;
    for (const character of name) slot = (slot * 31 + (character.codePointAt(0) ?? 0)) % 65521;
    slot %= HUES;
    while (taken.size < HUES && taken.has(slot)) slot = (slot + 1) % HUES;
    taken.add(slot);
    return [name, `hsl(${slot * (360 / HUES)} 65% 50%)`];
  }));
}

/**
 * Returns the colours of vertices besides those of their health, and the legend that explains them.
 * An edge that stands for topics has the colour of its highest value.
 * @param {import('../graph-model.js').Vertex[]} vertices
 * @param {string} tint
 * @returns {{of: (vertex: import('../graph-model.js').Vertex) => string|null,
 *   ofEdge: (edge: import('../graph-model.js').Edge) => string|null, what: string,
 *   legend: {colour: string, words: string}[]}}
 */
export function tinted(vertices, tint) {
  const scale = SCALES[tint];
  if (scale) {
    const { low, decades, what, print } = scale;
    const most = (/** @type {number[]} */ topics) => {
      const values = topics.map((id) => state.figuresOf(id)[tint === 'rate' ? 'rate' : 'p99'] ?? 0);
      const value = Math.max(0, ...values);
      return value > 0 ? heat(Math.log10(value / low) / decades) : null;
    };
    const legend = Array.from({ length: decades + 1 }, (_, at) => ({ colour: heat(at / decades),
      words: `${at === decades ? 'at least ' : at ? '' : 'at most '}${print(low * 10 ** at)}` }));
    return { legend, what: `${what}, without a colour if it is not measured`,
      of: (vertex) => (vertex.topic == null ? null : most([vertex.topic])),
      ofEdge: (edge) => (edge.kind === 'pair' ? most(edge.topics) : null) };
  }
  const participants = participantsOf(state);
  const name = (/** @type {import('../graph-model.js').Vertex} */ vertex) => {
    const own = participants(vertex);
    if (!own) return null;
    const host = own.host ?? 'unknown host';
    if (tint === 'host') return host;
    return own.pid == null ? `unknown process on ${host}`
      : `${state.processName(own)} on ${host}`;
  };
  /** @type {Map<string, number>} */
  const nodes = new Map();
  for (const own of ['process', 'host'].includes(tint) ? vertices.map(name) : []) {
    if (own != null) nodes.set(own, (nodes.get(own) ?? 0) + 1);
  }
  const hues = huesOf([...nodes.keys()]);
  return {
    of: (vertex) => hues.get(name(vertex) ?? '') ?? null,
    ofEdge: () => null,
    what: tint === 'host' ? 'Hosts of nodes' : 'Processes of nodes',
    legend: [...hues].map(([own, colour]) => ({ colour,
      words: `${own}: ${several(nodes.get(own) ?? 0, 'node')}` })),
  };
}

/** What the colours of vertices mean. @param {{tint: string, colours: ReturnType<typeof tinted>}} props */
function Scale({ tint, colours }) {
  const { what, legend } = colours;
  if (!tint) {
    return html`<p class="scale dim"><span>Health: <${Mark} severity="error" /> an error, <${Mark}
      severity="warning" /> a warning, without a mark no finding.</span></p>`;
  }
  return html`<p class="scale"><span class="dim">${what}:</span>${legend.slice(0, MOST_NAMES).map(
    ({ colour, words }) => html`<span key=${words}><i style=${`--tint: ${colour}`} /> <${Name}
      text=${words} /></span>`)}${legend.length > MOST_NAMES && html`<span>${count(
    legend.length - MOST_NAMES)} more</span>`}</p>`;
}

/** Seconds after which a moment that is missing is requested again. */
const AGAIN = 5;

/**
 * Returns the time of a state in the past. The present is null: it does not become another one each
 * second.
 * @param {State} shown
 */
export function pastMoment(shown) {
  return shown.past ? shown.time : null;
}

/**
 * Returns what has changed since a moment before.
 * @param {number} seconds 0 = no comparison
 */
function useDifferences(seconds) {
  const [before, take] = useState(/** @type {State|null} */ (null));
  const [failed, fail] = useState('');
  const at = Math.floor(state.time) - seconds;
  // The first state of a busy agent is old, and a new agent writes its first state after a minute.
  const attempt = failed ? Math.floor(state.time / AGAIN) : 0;
  useEffect(() => {
    take(null);
    if (!seconds) fail('');
    if (!seconds) return undefined;
    const abort = new AbortController();
    moment(at, abort.signal)
      .then((lines) => {
        const past = new State();
        past.show(lines);
        take(past);
        fail('');
      })
      .catch((error) => { if (!abort.signal.aborted) fail(error.message); });
    return () => abort.abort();
  }, [seconds, pastMoment(state), attempt]);
  const found = useMemo(() => before && differences(before, state), [before, state.structure]);
  return { found, failed, since: before?.time ?? null };
}

/** @param {{found: ReturnType<typeof differences>|null, failed: string, since: number|null}} props */
function Differences({ found, failed, since }) {
  if (failed) return html`<p class="problem">Nothing to compare with: ${failed}</p>`;
  if (!found) return null;
  const lists = /** @type {[string, string[]][]} */ ([['New nodes', found.came.map(nameOf)],
    ['Nodes that went', found.gone.map(nameOf)], ['New topics', found.cameTopics.map(nameOf)],
    ['Topics that went', found.goneTopics.map(nameOf)], ['New', found.joined], ['Ended', found.left],
    ['Other QoS', found.changed]]);
  const known = lists.filter(([, list]) => list.length);
  return html`<section aria-label="Differences" class="differences">
    <p>Since ${date(since)}: ${known.length
      ? html`in the graph, <strong>+</strong> is new, <strong>−</strong> went, and <strong>≠</strong> has
        other QoS or other ends.` : 'the same nodes, topics and QoS.'}</p>
    ${known.map(([title, list]) => html`<details key=${title} open=${list.length <= 5}>
      <summary>${title} (${count(list.length)})</summary><ul class="plain">${list.slice(0, 200).map((text) =>
        html`<li key=${text}><${Name} text=${text} /></li>`)}</ul></details>`)}</section>`;
}

/** @param {{query: Record<string, string>}} props */
export function Graph({ query }) {
  useLive();
  const change = (/** @type {Record<string, any>} */ more) => replaceAddress(
    address('graph', null, { ...query, ...more }));
  const focus = query.focus ?? null;
  const hops = Math.max(1, Math.min(9, Number(query.hops) || 1));
  const wantsJoints = Boolean(query.services || query.actions);
  const asked = usePoll(wantsJoints ? `graph${query.hidden ? '?hidden=true' : ''}` : null, 5000);
  const joints = wantsJoints && asked.data ? {
    nodes: asked.data.nodes.filter((/** @type {any} */ each) =>
      (query.services && each.kind === 'service') || (query.actions && each.kind === 'action')),
    edges: asked.data.edges,
  } : null;
  const chains = useChains();
  const chain = query.chain ? section(chains.data?.chains ?? [], query.chain, query) : null;
  const trail = useMemo(() => chain && throughGraph(chain), [chain && JSON.stringify([
    chain.domain_id, wayOf(chain)])]);
  const toggled = (query.boxed ?? '').split(' ').filter(Boolean).map(decodeURIComponent);
  const options = /** @type {import('../graph-model.js').Options} */ ({
    mode: query.mode === 'nodes' ? 'nodes' : 'both',
    hubs: Boolean(query.hubs),
    hidden: Boolean(query.hidden),
    boxes: ['none', 'process'].includes(query.boxes) ? query.boxes : 'namespace',
    toggled: new Set(toggled),
    focus,
    hops,
    shown: trail ? new Set(trail.keys.keys()) : undefined,
    only: Boolean(query.only),
  });
  // The first view folds as much as legible names need, until the user decides.
  const scene = JSON.stringify([options.mode, options.boxes, focus, hops, query.hubs, query.hidden,
    query.services, query.actions, query.chain, query.only, query.fold]);
  const [folding, setFolding] = useState({ scene, level: 0 });
  const isAutomatic = !query.fold && !trail && !query.boxed;
  const level = query.fold ? 0 : folding.scene === scene ? folding.level : 0;
  options.fold = level;
  const against = Number(query.against) || 0;
  const compared = useDifferences(state.open?.keeps_history && !state.unknown ? against : 0);
  const drawn = compared.found?.both ?? state;
  const graph = useMemo(() => build(drawn, options, joints), [
    drawn, state.structure, JSON.stringify(query), asked.data, trail, level]);
  const raise = () => {
    // A topic in focus is not folded into an edge.
    const most = focus?.startsWith('topic:') ? MOST_FOLDED - 1 : MOST_FOLDED;
    for (let next = level + 1; isAutomatic && next <= most; next += 1) {
      const folded = build(drawn, { ...options, fold: next }, joints);
      if (folded.signature !== graph.signature) {
        setFolding({ scene, level: next });
        return true;
      }
    }
    return false;
  };
  const marks = useMemo(() => trail && marked(graph, trail), [graph, trail]);
  const { picture, isCurrent, milliseconds, failed } = useLayout(graph, JSON.stringify([
    options.mode, options.boxes, focus, query.chain, query.only]));
  const [chosen, choose] = useState(/** @type {string|null} */ (focus));
  /** Moves the drawing to a vertex. */
  const camera = useRef(/** @type {((key: string) => void)|null} */ (null));
  const find = (/** @type {string} */ key) => camera.current?.(key);
  const toggle = (/** @type {string} */ box) => {
    const next = new Set(toggled);
    if (!next.delete(box)) next.add(box);
    change({ boxed: [...next].map(encodeURIComponent).join(' ') });
  };
  const isPicked = graph.vertices.some((/** @type {any} */ each) => each.key === chosen)
    || graph.edges.some((/** @type {any} */ each) => each.id === chosen);
  const drawing = useRef(/** @type {SVGSVGElement|null} */ (null));
  const host = state.open?.host ?? 'robot';
  const tint = TINTS.some(([each]) => each === query.tint) ? query.tint : '';
  const colours = tinted(graph.vertices, tint);
  const vertexNames = new Map(graph.vertices.map(
    (/** @type {any} */ each) => [each.key, each.name]));
  return html`<h1 tabindex="-1">Graph</h1>
    <div class="controls">
      <label>Show <select value=${options.mode}
        onChange=${(/** @type {any} */ event) => change({ mode: event.target.value })}>
        <option value="both">nodes and topics</option><option value="nodes">nodes only</option>
      </select></label>
      <label>Boxes <select value=${options.boxes}
        onChange=${(/** @type {any} */ event) => change({ boxes: event.target.value, boxed: '' })}>
        <option value="namespace">namespaces</option>
        <option value="process">hosts and processes</option><option value="none">none</option>
      </select></label>
      ${[['hubs', `hubs${graph.folded ? ` (${graph.folded} folded)` : ''}`], ['hidden', 'hidden'],
        ['services', 'services'], ['actions', 'actions']].map(([key, title]) => html`
        <label key=${key}><input type="checkbox" checked=${Boolean(query[key])}
          onChange=${(/** @type {any} */ event) => change({ [key]: event.target.checked })} />
          ${title}</label>`)}
      <label>Colour <select value=${tint}
        onChange=${(/** @type {any} */ event) => change({ tint: event.target.value })}>
        ${TINTS.map(([tint, title]) => html`<option value=${tint}>${title}</option>`)}</select></label>
      ${state.open?.keeps_history && html`<label>Compare with <select value=${String(against || '')}
        onChange=${(/** @type {any} */ event) => change({ against: event.target.value })}>
        <option value="">nothing</option>
        ${BEFORE.map(([seconds, title]) => html`<option value=${String(seconds)}>${title}</option>`)}
        </select></label>`}
      <${FindField} graph=${graph} find=${(/** @type {string} */ key) => { choose(key); find(key); }} />
      <${FocusField} focus=${focus} hops=${hops} change=${change} />
    </div>
    <${Differences} ...${compared} />
    <${ChainField} chains=${chains} chain=${chain} query=${query} change=${change} />
    <div class="controls">
      <button type="button" onClick=${() => download(`${host}.svg`, new Blob(
        [standalone(drawing.current)], { type: 'image/svg+xml' }))}>SVG</button>
      <button type="button" onClick=${() => download(`${host}.dot`, new Blob(
        [dot(graph, label)], { type: 'text/vnd.graphviz' }))}>DOT</button>
      <a href=${address(options.mode === 'nodes' ? 'nodes' : 'topics')}>Show as a list</a>
      <span class="dim">${several(graph.nodes, 'node')}, ${several(graph.edges.length, 'edge')}${
        milliseconds != null ? `; laid out in ${milliseconds.toFixed(0)} ms` : ''}${
        options.boxes === 'namespace' && (graph.nodes > MANY_NODES || level >= 2)
          ? '; namespaces are closed at first' : ''}${level > 2 && options.mode === 'both'
        ? '; topics are folded into edges' : graph.leaves ? html`; ${several(graph.leaves,
        'topic')} with one neighbour folded` : ''}</span>
      ${level > 0 && html`<button type="button" class="small"
        onClick=${() => change({ fold: 'none' })}>Show everything</button>`}
      ${query.fold && html`<button type="button" class="small"
        onClick=${() => change({ fold: '' })}>Fold</button>`}
      <span class="dim by-mouse">The wheel zooms, dragging moves, <kbd>0</kbd> shows all.</span>
    </div>
    <${Failed} problem=${asked.problem} what="No services and actions" />
    ${failed && html`<p class="problem">${failed}</p>`}
    ${!graph.vertices.length && html`<p class="empty">${focus
      ? `The selected node or topic does not exist ${state.past ? 'at that time' : 'now'}.` : 'No node is known.'}</p><${Incomplete} missing="the graph lacks them" />`}
    ${graph.vertices.length > 0 && html`<${Scale} tint=${tint} colours=${colours} />`}
    ${picture && graph.vertices.length > 0 && html`<div class="graph ${isPicked
      ? 'beside' : ''}">
      <${Drawing} graph=${graph} picture=${picture} isCurrent=${isCurrent} chosen=${chosen}
        choose=${choose} toggle=${toggle} own=${drawing} marks=${marks} scene=${scene}
        raise=${raise} goTo=${camera} colours=${colours} changes=${compared.found} />
      <${Panel} graph=${graph} chosen=${chosen} change=${change} toggle=${toggle}
        choose=${choose} names=${vertexNames} chains=${chains.data?.chains ?? []} /></div>`}
    <${Legend} />`;
}

/** A field that jumps to a vertex. @param {{graph: any, find: (key: string) => void}} props */
function FindField({ graph, find }) {
  const [missing, miss] = useState(false);
  const vertices = graph.vertices.filter((/** @type {any} */ each) => each.kind !== 'box');
  const go = (/** @type {string} */ text) => {
    const own = text.trim().toLowerCase();
    const found = own && (vertices.find((/** @type {any} */ each) => each.name.toLowerCase() === own)
      ?? vertices.find((/** @type {any} */ each) => each.name.toLowerCase().includes(own)));
    miss(Boolean(own) && !found);
    if (found) find(found.key);
  };
  return html`<label>Find <input type="search" list="vertices" size="14" aria-invalid=${missing}
      onChange=${(/** @type {any} */ event) => go(event.target.value)} /></label>
    ${missing && html`<span class="dim" role="status">not in this picture</span>`}
    <datalist id="vertices">${vertices.slice(0, 500).map((/** @type {any} */ each) => html`
      <option key=${each.key} value=${visible(each.name)} />`)}</datalist>`;
}

/** @param {{focus: string|null, hops: number, change: (more: any) => void}} props */
function FocusField({ focus, hops, change }) {
  if (!focus) return null;
  return html`<span class="focus">Focus <${Name} text=${nameOf(focus)}
      most=${40} />
    <label>hops <input type="number" min="1" max="9" value=${hops}
      onInput=${(/** @type {any} */ event) => change({ hops: event.target.value })} /></label>
    <button type="button" onClick=${() => change({ focus: '', hops: '' })}>Show all</button></span>`;
}

/**
 * Returns the layout of a graph, computed in a worker some time after a change of the structure. The
 * order of the one before stays while `kind` does. `isCurrent` is whether the picture is that of
 * this graph, and not of an earlier one.
 * @param {import('../graph-model.js').Graph} graph
 * @param {string} kind
 */
function useLayout(graph, kind) {
  const worker = useRef(/** @type {Worker|null} */ (null));
  const number = useRef(0);
  const [answer, take] = useState(/** @type {any} */ ({
    picture: null, kind, signature: '', milliseconds: null, failed: '',
  }));
  const latest = useRef(answer);
  latest.current = answer;
  useEffect(() => {
    const own = new Worker(new URL('../layout-worker.js', import.meta.url), { type: 'module' });
    worker.current = own;
    own.onerror = () => take({ ...latest.current, failed: 'The layout failed.' });
    return () => own.terminate();
  }, []);
  useEffect(() => {
    const ask = () => {
      const mine = number.current + 1;
      number.current = mine;
      const own = worker.current;
      if (!own) return;
      own.onmessage = (/** @type {MessageEvent} */ { data }) => {
        if (data.number !== number.current) return;
        take({
          picture: index(data.result), kind, signature: graph.signature,
          milliseconds: data.milliseconds, failed: '',
        });
      };
      /** @type {Record<string, {x: number, y: number}>} */
      const previous = {};
      const before = latest.current.kind === kind ? latest.current.picture?.at : null;
      for (const [key, { x, y }] of before ?? []) previous[key] = { x, y };
      own.postMessage({
        number: mine,
        vertices: graph.vertices.map(({ key, w, h, parent }) => ({ id: key, w, h, parent, title: 20 })),
        edges: graph.edges.map(({ id, from, to }) => ({ id, from, to })),
        options: { previous },
      });
    };
    const timer = setTimeout(ask, latest.current.picture ? SETTLE_MS : 0);
    return () => clearTimeout(timer);
  }, [graph.signature, kind]);
  const isCurrent = answer.kind === kind && answer.signature === graph.signature;
  return { ...answer, isCurrent };
}

/**
 * @typedef {{width: number, height: number, at: Map<string, import('../layout.js').Placed>,
 *   routes: Map<string, import('../layout.js').Point[]>}} Picture
 * @param {import('../layout.js').Layout} result
 * @returns {Picture}
 */
function index(result) {
  return {
    width: result.width,
    height: result.height,
    at: new Map(result.vertices.map((each) => [each.id, each])),
    routes: new Map(result.edges.map((each) => [each.id, each.points])),
  };
}

/**
 * Returns a smooth path through an edge's points.
 * @param {import('../layout.js').Point[]} points
 */
export function curve(points) {
  let path = `M${points[0].x.toFixed(1)} ${points[0].y.toFixed(1)}`;
  for (let at = 1; at < points.length; at += 1) {
    const [a, b] = [points[at - 1], points[at]];
    const middle = ((a.x + b.x) / 2).toFixed(1);
    path += `C${middle} ${a.y.toFixed(1)} ${middle} ${b.y.toFixed(1)} `
      + `${b.x.toFixed(1)} ${b.y.toFixed(1)}`;
  }
  return path;
}

/** @param {import('../graph-model.js').Edge} edge */
function label(edge) {
  const { bytes, hertz, measured } = load(edge);
  const figures = measured ? `${rate(hertz)}, ${bandwidth(bytes)}` : '';
  if (edge.kind !== 'pair') return figures;
  const names = edge.topics.map((id) => visible(state.topics.get(id)?.name)).join(', ');
  return figures ? `${names} (${figures})` : names;
}

/**
 * @param {{graph: import('../graph-model.js').Graph, picture: Picture, isCurrent: boolean,
 *   chosen: string|null, choose: (key: string|null) => void, toggle: (key: string) => void,
 *   own: any,
 *   marks: {vertices: Map<string, number>, edges: Set<string>}|null, scene: string,
 *   raise: () => boolean, goTo: any, colours: ReturnType<typeof tinted>,
 *   changes: ReturnType<typeof differences>|null}} props
 *   `isCurrent` is whether the picture is that of the graph, which it follows some time later;
 *   `marks` are the vertices and edges of a chain; a new `scene` is shown like the first one;
 *   `raise` folds more, and returns whether it can; `goTo` receives a function that moves to a vertex
 */
function Drawing({ graph, picture, isCurrent, chosen, choose, toggle, own, marks, scene, raise,
  goTo, colours, changes }) {
  const stage = useRef(/** @type {SVGGElement|null} */ (null));
  const camera = useRef(/** @type {Camera|null} */ (null));
  useEffect(() => {
    const made = new Camera(own.current, /** @type {SVGGElement} */ (stage.current));
    camera.current = made;
    return () => made.end();
  }, []);
  const shownScene = useRef(scene);
  const renewed = useRef(false);
  useEffect(() => {
    // The picture of the scene before would decide what is legible.
    if (!isCurrent) return;
    if (shownScene.current !== scene) {
      shownScene.current = scene;
      renewed.current = false;
      camera.current?.renew();
    }
    const worstFinding = state.findings.find((finding) => finding.topic != null
      && finding.severity !== 'note');
    const place = graph.vertices.find((each) => each.topic === worstFinding?.topic);
    const legible = camera.current?.frame(picture.width, picture.height,
      place && picture.at.get(place.key));
    // After the first legible picture, nothing more is folded.
    const isOver = legible || renewed.current || !raise();
    if (!isOver) camera.current?.renew();
    renewed.current = Boolean(isOver);
  }, [picture, scene]);
  useEffect(() => {
    goTo.current = (/** @type {string} */ key) => {
      const at = picture.at.get(key);
      if (at) camera.current?.part([at]);
    };
  }, [picture]);
  const passed = marks ? [...marks.vertices.keys()].join('\n') : '';
  const framed = useRef('');
  useEffect(() => {
    const places = [...marks?.vertices.keys() ?? []].map((key) => picture.at.get(key));
    if (!isCurrent || passed === framed.current || places.includes(undefined)) return;
    framed.current = passed;
    camera.current?.part(/** @type {any[]} */ (places));
  }, [passed, picture]);
  const ends = brokenEnds();
  const nodes = healths();
  const near = useMemo(() => neighbours(graph), [graph]);
  const shown = graph.vertices.filter((each) => picture.at.has(each.key));
  const roving = shown.some((each) => each.key === chosen) ? chosen : shown[0]?.key;
  const keys = (/** @type {KeyboardEvent} */ event) => {
    if (camera.current?.key(event.key)) {
      event.preventDefault();
      return;
    }
    const key = /** @type {HTMLElement} */ (event.target).closest('[data-key]')
      ?.getAttribute('data-key');
    const next = key && step(picture, near, key, event.key);
    if (!next) return;
    event.preventDefault();
    choose(next);
    for (const element of own.current.querySelectorAll('[data-key]')) {
      if (element.getAttribute('data-key') === next) element.focus();
    }
  };
  const labelled = useMemo(() => freeLabels(graph, picture), [graph, picture]);
  const few = graph.edges.length <= 400;
  return html`<div class="canvas"><svg ref=${own} role="group" onKeyDown=${keys}
    class=${marks ? 'traced' : ''}
    aria-label="Graph of ${several(graph.nodes, 'node')}. Arrow keys move along the edges. The list
      of topics shows the same."
    onClick=${(/** @type {MouseEvent} */ event) => {
      if (event.target === own.current && !camera.current?.moved) choose(null);
    }}>
    <defs>${[...ORDER, 'passed'].map((severity) => html`<marker id="arrow-${severity}"
      viewBox="0 0 8 8" refX="7" refY="4" markerWidth="8" markerHeight="8" markerUnits="userSpaceOnUse" orient="auto">
      <path d="M0 0.5L8 4L0 7.5Z" class="arrow ${severity}" /></marker>`)}</defs>
    <g ref=${stage}>
      ${shown.filter((each) => each.kind === 'box' && !each.closed).map((each) => html`<${Box}
        key=${each.key} vertex=${each} at=${picture.at.get(each.key)} toggle=${toggle}
        roving=${roving === each.key} choose=${choose} />`)}
      ${graph.edges.map((edge) => {
        const points = picture.routes.get(edge.id);
        if (!points) return null;
        const { bytes, severity, measured } = load(edge);
        const broken = edge.guids.some((guid) => ends.has(guid))
          && edge.topics.some((id) => state.flagsOf(id).includes('qos'));
        const health = broken ? 'error' : severity;
        const isPassed = marks?.edges.has(edge.id);
        const active = chosen != null && (edge.from === chosen || edge.to === chosen
          || edge.id === chosen);
        const { x, y } = middleOf(points);
        const tint = colours.ofEdge(edge);
        const mark = changes && markOf(edge, changes.guids);
        return html`<g key=${edge.id} style=${tint ? `--tint: ${tint}` : undefined} class="edge ${way(edge.passages, edge.kind)} ${health} ${active
          ? 'active' : ''} ${measured ? '' : 'unmeasured'} ${isPassed ? 'passed' : ''} ${
          tint ? 'tinted' : ''} ${mark ?? ''}" onClick=${() => choose(edge.id)}>
          ${few && html`<path class="touch" d=${curve(points)} />`}
          <path class="line" d=${curve(points)} stroke-width=${Math.max(
            isPassed ? 3 : 0, thickness(bytes)).toFixed(1)}
            marker-end="url(#arrow-${isPassed ? 'passed' : health})" />
          ${(health === 'error' || health === 'warning') && edge.kind !== 'feeds' && html`<text
            class="sign ${health}" x=${x} y=${y + 4}>${health === 'error' ? '✖' : '▲'}</text>`}
          ${mark && html`<text class="sign ${mark}" x=${x} y=${y - 6}>${CHANGES[mark][0]}</text>`}
          ${edge.kind === 'pair' && (labelled.has(edge.id) || active) && html`<text class="edge-label" x=${x}
            y=${y - 5}>${edge.topics.length === 1
              ? shortened(state.topics.get(edge.topics[0])?.name, 24)
              : several(edge.topics.length, 'topic')}${measured
              ? ` ${rate(load(edge).hertz)}` : ''}</text>`}
          <title>${mark ? `${CHANGES[mark][1]}: ` : ''}${label(edge)}</title></g>`;
      })}
      ${shown.filter((each) => each.kind !== 'box' || each.closed).map((each) => html`<${Shape}
        key=${each.key} vertex=${each} at=${picture.at.get(each.key)} nodes=${nodes}
        chosen=${chosen === each.key} roving=${roving === each.key} choose=${choose}
        toggle=${toggle} camera=${camera} tint=${colours.of(each)}
        mark=${changes && markOfVertex(each, changes.vertices)} position=${marks?.vertices.get(each.key)}
        positions=${marks?.vertices.size} />`)}
    </g></svg>
    <div class="zoom"><button type="button" aria-label="Zoom in"
        onClick=${() => camera.current?.key('+')}>+</button>
      <button type="button" aria-label="Zoom out"
        onClick=${() => camera.current?.key('-')}>−</button>
      <button type="button" onClick=${() => camera.current?.key('0')}>Fit</button></div></div>`;
}

/** Size of an edge's label, in pixels. */
const [CHARACTER, LINE] = [7.3, 14];
const MOST_LABEL_CHARACTERS = 34;

/**
 * Returns the edges whose labels cover neither a vertex nor another label.
 * @param {import('../graph-model.js').Graph} graph
 * @param {Picture} picture
 */
function freeLabels(graph, picture) {
  const taken = graph.vertices.filter((each) => each.kind !== 'box' || each.closed)
    .map((each) => picture.at.get(each.key)).filter((at) => at != null);
  const free = new Set();
  for (const edge of graph.edges) {
    const points = edge.kind === 'pair' ? picture.routes.get(edge.id) : null;
    if (!points) continue;
    const { x, y } = middleOf(points);
    const name = edge.topics.length === 1 ? state.topics.get(edge.topics[0])?.name ?? '' : '12 topics';
    const own = { x, y: y - LINE / 2, h: LINE,
      w: Math.min(MOST_LABEL_CHARACTERS, name.length + 9) * CHARACTER };
    const overlaps = taken.some((other) => Math.abs(own.x - other.x) < (own.w + other.w) / 2
      && Math.abs(own.y - other.y) < (own.h + other.h) / 2);
    if (overlaps) continue;
    taken.push(/** @type {any} */ (own));
    free.add(edge.id);
  }
  return free;
}

/** Returns the middle of a route. @param {import('../layout.js').Point[]} points */
function middleOf(points) {
  const at = Math.floor((points.length - 1) / 2);
  const [middle, after] = [points[at], points[at + 1]];
  return { x: (middle.x + after.x) / 2, y: (middle.y + after.y) / 2 };
}

/** @param {import('../graph-model.js').Graph} graph */
function neighbours(graph) {
  /** @type {Map<string, {out: string[], into: string[]}>} */
  const found = new Map(graph.vertices.map((each) => [each.key, { out: [], into: [] }]));
  for (const edge of graph.edges) {
    found.get(edge.from)?.out.push(edge.to);
    found.get(edge.to)?.into.push(edge.from);
  }
  return found;
}

/**
 * Returns the target of an arrow key: along an edge, or the next vertex in the column.
 * @param {Picture} picture
 * @param {Map<string, {out: string[], into: string[]}>} near
 * @param {string} from
 * @param {string} key
 * @returns {string|null}
 */
function step(picture, near, from, key) {
  const own = picture.at.get(from);
  if (!own) return null;
  const distance = (/** @type {string} */ to) => {
    const at = picture.at.get(to);
    return at ? Math.abs(at.y - own.y) + Math.abs(at.x - own.x) / 10 : Infinity;
  };
  const nearest = (/** @type {string[]} */ list) => {
    const reached = list.filter((to) => picture.at.has(to));
    return reached.sort((one, other) => distance(one) - distance(other))[0] ?? null;
  };
  const column = (/** @type {number} */ by) => nearest([...picture.at].filter(([to, at]) =>
    to !== from && Math.abs(at.x - own.x) < Math.max(60, (at.w + own.w) / 2)
    && Math.sign(at.y - own.y) === by && near.has(to)).map(([to]) => to));
  switch (key) {
    case 'ArrowRight': return nearest(near.get(from)?.out ?? []);
    case 'ArrowLeft': return nearest(near.get(from)?.into ?? []);
    case 'ArrowDown': return column(1);
    case 'ArrowUp': return column(-1);
    default: return null;
  }
}

/** Returns whether a key activates a button. @param {KeyboardEvent} event */
const pressed = (event) => event.key === 'Enter' || event.key === ' ';

/** @param {any} props */
function Box({ vertex, at, toggle, roving, choose }) {
  const [left, top] = [at.x - at.w / 2, at.y - at.h / 2];
  const name = visible(vertex.name);
  return html`<g class="box"><rect x=${left} y=${top} width=${at.w} height=${at.h} rx="8" />
    <g role="button" aria-expanded="true" tabindex=${roving ? 0 : -1} data-key=${vertex.key}
      aria-label="▾ ${name}: close the box" onFocus=${() => choose(vertex.key)}
      onClick=${() => toggle(vertex.key)} onKeyDown=${(/** @type {KeyboardEvent} */ event) => {
        if (!pressed(event)) return;
        event.preventDefault();
        toggle(vertex.key);
      }}>
      <rect class="grip" x=${left} y=${top} width=${at.w} height="22" rx="8" />
      <text x=${left + 10} y=${top + 16}>▾ ${shortened(vertex.name, Math.max(8,
        Math.floor((at.w - 34) / 7)))}</text></g></g>`;
}

const SIGNS = /** @type {Record<string, string>} */ ({ error: '✖', warning: '▲' });

/** @param {any} props */
function Shape({ vertex, at, nodes, chosen, roving, choose, toggle, camera, position,
  positions, tint, mark }) {
  const figures = vertex.topic == null ? null : state.figuresOf(vertex.topic);
  const flags = vertex.topic == null ? [] : state.flagsOf(vertex.topic);
  let severity = vertex.topic != null ? worst(flags) : nodes.get(vertex.node) ?? 'good';
  if (vertex.closed) {
    for (const key of vertex.members) severity = worse(severity, healthOf(key, nodes));
  }
  const detail = mark === 'gone' && figures ? CHANGES.gone[1] : vertex.closed ? several(vertex.count, 'node')
    : figures ? (figures.rate == null ? 'not measured'
      : `${rate(figures.rate)} · ${bandwidth(figures.bandwidth)}`)
      : shortened(vertex.detail, MOST_LABEL);
  const label = shortened(vertex.name, MOST_LABEL);
  const closing = (vertex.closed ? '▸ ' : '') + (mark ? `${CHANGES[mark][0]} ` : '');
  const [left, top] = [at.x - at.w / 2, at.y - at.h / 2];
  const sign = SIGNS[severity];
  const press = () => {
    if (camera.current?.moved) return;
    if (vertex.closed) toggle(vertex.key);
    else choose(vertex.key);
  };
  const words = (sign ? `, with ${severity === 'error' ? 'an error' : 'a warning'}` : '')
    + (mark ? `, ${CHANGES[mark][1]}` : '') + (position ? `, ${position} of ${positions} in the chain` : '');
  return html`<g class="vertex ${vertex.kind} ${severity} ${chosen ? 'chosen' : ''} ${position
    ? 'passed' : ''} ${tint ? 'tinted' : ''} ${mark ?? ''}" role="button"
    style=${tint ? `--tint: ${tint}` : undefined}
    tabindex=${roving ? 0 : -1} data-key=${vertex.key} onClick=${press}
    aria-expanded=${vertex.closed ? 'false' : undefined}
    aria-pressed=${vertex.closed ? undefined : chosen}
    onFocus=${() => choose(vertex.key)}
    aria-label="${closing}${label} ${detail} (${vertex.closed ? 'closed box' : vertex.kind}${words}${
      label === visible(vertex.name) ? '' : `, ${visible(vertex.name)}`})"
    onKeyDown=${(/** @type {KeyboardEvent} */ event) => {
      if (!pressed(event)) return;
      event.preventDefault();
      if (vertex.closed) toggle(vertex.key);
      else document.getElementById('graph-panel')?.focus();
    }}>
    <rect x=${left} y=${top} width=${at.w} height=${at.h}
      rx=${vertex.kind === 'topic' ? 3 : vertex.kind === 'service' || vertex.kind === 'action'
        ? 0 : 14} />
    <text x=${left + 12} y=${top + (detail ? 17 : at.h / 2 + 4)}><tspan>${closing}${label}</tspan>${' '}${detail
      && html`<tspan class="detail" x=${left + 12} y=${top + 32}>${detail}</tspan>`}</text>
    ${sign && html`<text class="sign ${severity}" aria-hidden="true" x=${left + at.w - 9} y=${top + 14}>${sign}</text>`}
    ${label !== visible(vertex.name) && html`<title>${visible(vertex.name)}</title>`}</g>`;
}

/**
 * Returns the mark of a vertex. A closed box has changed if a part of it has.
 * @param {import('../graph-model.js').Vertex} vertex
 * @param {Map<string, import('../graph-model.js').Mark>} marks
 */
function markOfVertex(vertex, marks) {
  return marks.get(vertex.key) ?? (vertex.closed && vertex.members.some((key) => marks.has(key))
    ? 'changed' : null);
}

/** @param {string} key @param {Map<number, string>} nodes */
function healthOf(key, nodes) {
  const [kind, domain] = key.split(':');
  const name = nameOf(key);
  if (kind === 'topic') {
    const topic = state.topicNamed(name, Number(domain));
    return topic ? worst(state.flagsOf(topic.id)) : 'good';
  }
  const node = kind === 'node' ? state.nodeNamed(name, Number(domain)) : null;
  return node ? nodes.get(node.id) ?? 'good' : 'good';
}

/** Describes the selection in words and with links. @param {any} props */
function Panel({ graph, chosen, change, toggle, choose, names, chains }) {
  const vertex = graph.vertices.find((/** @type {any} */ each) => each.key === chosen);
  const edge = vertex ? null : graph.edges.find((/** @type {any} */ each) => each.id === chosen);
  const title = vertex ? html`<${Name} text=${vertex.name} />`
    : edge ? html`<${Name} text=${names.get(edge.from) ?? ''} /> → <${Name}
      text=${names.get(edge.to) ?? ''} />` : 'Details';
  const link = (/** @type {string} */ key) => html`<button type="button" class="plain"
    onClick=${() => choose(key)}><${Name} text=${names.get(key) ?? key} /></button>`;
  const sides = (/** @type {string} */ name, /** @type {any[]} */ edges,
    /** @type {'from'|'to'} */ side) => edges.length > 0 && html`<h3>${name} (${count(edges.length)})</h3>
    <ul>${edges.slice(0, 40).map((each) => html`<li key=${each.id}>${link(each[side])}${' '}
      <span class="dim">${wayWords(each)}${each.topics.length > 1
        ? `, ${several(each.topics.length, 'topic')}` : ''}</span></li>`)}</ul>`;
  const went = vertex && (vertex.node ?? vertex.topic ?? 0) < 0;
  const topic = vertex?.topic != null ? state.topics.get(vertex.topic) : null;
  const node = vertex?.node != null ? state.nodes.get(vertex.node) : null;
  const figures = topic && state.figuresOf(topic.id);
  const place = topic ?? node;
  const through = place ? chainsThrough(chains, { domain: place.domain,
    [topic ? 'topic' : 'node']: place.name }) : [];
  if (!vertex && !edge) return null;
  return html`<aside class="panel" id="graph-panel" tabindex="-1" aria-label="Details">
    <h2>${title} <button type="button" class="small" aria-label="Close the details"
      onClick=${() => choose(null)}>×</button></h2>
    ${went && html`<p>It went since the moment that is compared.</p>`}
    ${vertex && html`<p>${topic && html`<a href=${topicAddress(topic)}>Open the topic</a> `}
      ${node && html`<a href=${nodeAddress(node)}>Open the node</a> `}
      ${vertex.kind !== 'box' && html`<button type="button"
        onClick=${() => change({ focus: vertex.key, hops: 1 })}>Focus</button> `}
      ${vertex.kind === 'box' && html`<button type="button" onClick=${() => toggle(vertex.key)}>${
        vertex.closed ? 'Open the box' : 'Close the box'}</button>`}</p>
      ${topic && html`<p><${Name} text=${topic.types.join(', ')} /><br />${figures?.rate == null
        ? 'not measured' : `${rate(figures.rate)}, ${bandwidth(figures.bandwidth)}, ${count(
          figures.lost)} lost`}</p><p><${Badges} flags=${state.flagsOf(topic.id)} /></p>`}
      ${state.findings.filter((finding) => (topic && finding.topic === topic.id)
        || (node && finding.node === node.id)).slice(0, 8).map((finding) => html`<p
        key=${finding.id}><${Mark} severity=${finding.severity} /> <${Sentence}
        text=${state.withScripts(finding.text)} /></p>`)}
      ${through.length > 0 && html`<p>In ${through.length === 1 ? 'the chain' : 'the chains'}${' '}
        <${ChainLinks} chains=${through} filter=${place?.name ?? ''} />${' '}
        <button type="button" class="small" onClick=${() => change({ ...NO_CHAIN,
          ...graphWords(through[0]) })}>Highlight${through.length > 1 ? ' the first' : ''}</button></p>`}
      ${sides('From', graph.edges.filter((/** @type {any} */ each) => each.to === chosen), 'from')}
      ${sides('To', graph.edges.filter((/** @type {any} */ each) => each.from === chosen), 'to')}`}
    ${edge && html`<p>${wayWords(edge)}</p><ul>${edge.topics.map((/** @type {number} */ id) => {
      const each = state.topics.get(id);
      const own = state.figuresOf(id);
      return each && html`<li key=${id}><a href=${topicAddress(each)}><${Name}
        text=${each.name} /></a> ${rate(own.rate)}, ${bandwidth(own.bandwidth)} <${Badges}
        flags=${state.flagsOf(id)} /></li>`;
    })}</ul>`}</aside>`;
}

/** @param {import('../graph-model.js').Edge} edge */
function wayWords(edge) {
  if (edge.kind === 'calls' || edge.kind === 'served_by') return edge.kind.replace('_', ' ');
  const names = state.passagesOf(edge.passages);
  return names.length ? names.map((name) => PASSAGES[name] ?? name).join(', ') : 'no counterpart';
}

function Legend() {
  const rows = [['network', 'network'], ['shared_memory', 'shared memory'],
    ['unseen', 'same process, data sharing or iceoryx: not observed'], ['unmatched', 'no counterpart'],
    ['service', 'service or action']];
  return html`<details class="legend"><summary>Legend</summary><ul>
    ${rows.map(([kind, words]) => html`<li key=${kind}><svg viewBox="0 0 48 12" aria-hidden="true"
      class="edge ${kind}"><path class="line" d="M2 6L46 6" stroke-width="2.5" /></svg> ${words}</li>`)}
    <li>Width: bytes per second of the edge’s topics.</li>
    <li><${Mark} severity="error" /> incompatible QoS, types or a violated expectation;
      <${Mark} severity="warning" /> loss or silence.</li>
    <li>Round: node. Square: topic. Boxes: namespaces, or hosts and processes.</li></ul></details>`;
}

// CSS variables whose colours are copied into an exported picture.
const VARIABLES = ['--paper', '--ink', '--dim', '--grid', '--panel', '--node', '--error',
  '--warning', '--note', '--accent', '--edge'];

/** Returns the drawing as a standalone file. @param {SVGSVGElement|null} svg */
export function standalone(svg) {
  if (!svg) return '';
  const copy = /** @type {SVGSVGElement} */ (svg.cloneNode(true));
  const stage = /** @type {SVGGElement} */ (copy.querySelector('g'));
  stage.removeAttribute('transform');
  const size = /** @type {any} */ (svg.querySelector('g')).getBBox();
  copy.setAttribute('xmlns', 'http://www.w3.org/2000/svg');
  copy.setAttribute('viewBox', [size.x - 10, size.y - 10, size.width + 20, size.height + 20].join(' '));
  copy.setAttribute('width', String(Math.ceil(size.width + 20)));
  copy.setAttribute('height', String(Math.ceil(size.height + 20)));
  for (const element of [copy, ...copy.querySelectorAll('*')]) {
    for (const name of ['tabindex', 'role', 'data-key', 'aria-pressed', 'aria-expanded']) {
      element.removeAttribute(name);
    }
  }
  for (const touch of copy.querySelectorAll('.touch')) touch.remove();
  const style = getComputedStyle(document.documentElement);
  const variables = VARIABLES.map((name) => `${name}:${style.getPropertyValue(name).trim()}`);
  const rules = [];
  for (const sheet of document.styleSheets) {
    if (!sheet.href?.endsWith('/app.css')) continue;
    for (const rule of sheet.cssRules) {
      if (/\.(edge|vertex|box|sign|arrow)/.test(rule.cssText)) {
        rules.push(rule.cssText.replaceAll('.graph ', ''));
      }
    }
  }
  const css = `svg{${variables.join(';')};background:var(--paper)}${rules.join('')}`;
  const text = new XMLSerializer().serializeToString(copy);
  const escaped = css.replaceAll('&', '&amp;').replaceAll('<', '&lt;');
  return text.replace(/^(<svg[^>]*>)/, `$1<style>${escaped}</style>`);
}
