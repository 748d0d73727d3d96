// Chains of messages as the page shows them: their addresses, the rows of their list, the bars of
// their waterfall, and their way through the graph.

import { duration } from './format.js';
import { nodeKey, topicKey } from './graph-model.js';
import { address } from './router.js';

/**
 * @typedef {{p50_seconds: number, p99_seconds: number, maximum_seconds: number}} Quantiles
 * @typedef {{input: string, node: string|null, output: string, latency: Quantiles,
 *   transit: Quantiles|null, wait: Quantiles|null, callback: Quantiles|null,
 *   processing: Quantiles|null}} Hop
 * @typedef {{domain_id: number, method: string, from: string, to: string, source: string|null,
 *   hops: Hop[], messages: number, latency: Quantiles, bottleneck: number|null,
 *   last_seen_seconds: number}} Chain
 * @typedef {{domain_id: number|null, from: string, to: string, max_latency_ms: number|null,
 *   method: string|null, state: string, latency: Quantiles|null}} Expected
 * @typedef {{chains: Chain[], expected: Expected[]}} ChainList
 * @typedef {{key: string, domain: number|null, from: string, to: string, method: string|null,
 *   href: string, expected: Expected|null, chain: Chain|null, latency: Quantiles|null}} Row
 */

/** Returns the topics of a chain, in order. @param {Chain} chain */
export function topicsOf(chain) {
  return [chain.from, ...chain.hops.map((hop) => hop.output)];
}

/** Returns the nodes of a chain; null for one that is not known. @param {Chain} chain */
export function nodesOf(chain) {
  return [chain.source, ...chain.hops.map((hop) => hop.node)];
}

/** Returns the hop with the largest median; null with a single hop. @param {Chain} chain */
export function slowest(chain) {
  if (chain.hops.length < 2 || chain.bottleneck == null) return null;
  return chain.hops[chain.bottleneck] ?? null;
}

/**
 * Returns a short name of a chain's way, the same in every run. It keeps chains with equal ends
 * apart.
 * @param {Chain} chain
 */
export function wayOf(chain) {
  const text = JSON.stringify([topicsOf(chain), nodesOf(chain)]);
  let hash = 0x811c9dc5;
  for (let at = 0; at < text.length; at += 1) {
    hash = Math.imul(hash ^ text.charCodeAt(at), 0x01000193);
  }
  return (hash >>> 0).toString(16);
}

/**
 * Returns the part of an address that names a chain.
 * @param {Chain} chain
 * @returns {Record<string, string|number>}
 */
function wordsOf(chain) {
  return { to: chain.to, domain: chain.domain_id, method: chain.method, way: wayOf(chain) };
}

/** Returns the address of a chain's view. @param {Chain} chain */
export function chainAddress(chain) {
  return address('chains', chain.from, wordsOf(chain));
}

/** Returns the request for late calls of a chain's callbacks. @param {Chain} chain */
export function lateCallsAddress(chain) {
  const words = { from: chain.from, to: chain.to, domain_id: String(chain.domain_id) };
  return `why?${new URLSearchParams({ ...words, history: 'true' })}`;
}

/** Returns the words of the graph's address that select a chain. @param {Chain} chain */
export function graphWords(chain) {
  const { to, domain, method, way } = wordsOf(chain);
  return { chain: chain.from, to, domain, method, way };
}

/** The same words without a chain. */
export const NO_CHAIN = { chain: '', to: '', domain: '', method: '', way: '', only: '' };

/**
 * Returns the chain that an address names: the one of its way, otherwise the first of its ends.
 * @param {Chain[]} chains
 * @param {string} from
 * @param {Record<string, string>} query `to`, `domain`, `method` and `way`
 * @returns {Chain|null}
 */
export function chosen(chains, from, query) {
  const meant = chains.filter((chain) => chain.from === from
    && (!query.to || chain.to === query.to)
    && (!query.domain || chain.domain_id === Number(query.domain))
    && (!query.method || chain.method === query.method));
  return meant.find((chain) => wayOf(chain) === query.way) ?? meant[0] ?? null;
}

/**
 * Returns the chain that an address names, or the part of a longer chain between its ends. Such a
 * part has the messages and the latency of the whole.
 * @param {Chain[]} chains
 * @param {string} from
 * @param {Record<string, string>} query
 * @returns {Chain|null}
 */
export function section(chains, from, query) {
  const parts = chains.flatMap((chain) => {
    const topics = topicsOf(chain);
    const first = topics.indexOf(from);
    const last = query.to ? topics.lastIndexOf(query.to) : topics.length - 1;
    if (first < 0 || last <= first) return [];
    const hops = chain.hops.slice(first, last);
    const median = (/** @type {Hop} */ hop) => hop.latency.p50_seconds;
    const most = Math.max(...hops.map(median));
    return [{ ...chain, from, to: topics[last], source: nodesOf(chain)[first], hops,
      bottleneck: hops.findLastIndex((hop) => median(hop) === most) }];
  });
  return chosen(parts, from, query);
}

/**
 * Returns configured chains, then the others that were found.
 * @param {ChainList} list
 * @returns {Row[]}
 */
export function rowsOf(list) {
  /** @type {Set<Chain>} */
  const taken = new Set();
  /** @type {Row[]} */
  const rows = list.expected.map((expected, at) => {
    const { from, to, domain_id: domain, method } = expected;
    const alike = list.chains.filter((each) => each.domain_id === domain && each.method === method);
    const whole = alike.find((each) => each.from === from && each.to === to);
    if (whole) taken.add(whole);
    const chain = whole ?? section(alike, from, { to });
    return {
      key: `configured ${at}`, domain, from, to, method, expected, chain,
      latency: expected.latency ?? whole?.latency ?? null,
      href: chain ? chainAddress(chain) : address('chains', from, { to, domain, method }),
    };
  });
  for (const chain of list.chains) {
    if (taken.has(chain)) continue;
    const { from, to, domain_id: domain, method } = chain;
    rows.push({
      key: `${domain} ${method} ${from} ${wayOf(chain)}`, domain, from, to, method, expected: null,
      chain, latency: chain.latency, href: chainAddress(chain),
    });
  }
  return rows;
}

/**
 * Returns the chains with this topic or node.
 * @param {Chain[]} chains
 * @param {{domain: number, topic?: string, node?: string}} place
 */
export function chainsThrough(chains, { domain, topic, node }) {
  return chains.filter((chain) => chain.domain_id === domain
    && (topic == null || topicsOf(chain).includes(topic))
    && (node == null || nodesOf(chain).includes(node)));
}

/**
 * Returns the parts of a hop that were observed, in their order.
 * @param {Hop} hop
 * @returns {{name: string, title: string, figures: Quantiles}[]}
 */
export function partsOf(hop) {
  const parts = /** @type {[string, string, Quantiles|null][]} */ ([
    ['transit', 'transit', hop.transit], ['wait', 'wait', hop.wait],
    ['callback', 'callback', hop.callback],
    // The sum of both, if they are not known.
    ['processing', 'node', hop.callback ? null : hop.processing],
  ]);
  return parts.flatMap(([name, title, figures]) => (figures ? [{ name, title, figures }] : []));
}

/**
 * @typedef {{start: number, width: number, whisker: number,
 *   parts: {name: string, start: number, width: number}[]}} Bar shares of the axis, from 0 to 1
 * @typedef {{end: number, ticks: number[], bars: Bar[], total: Bar, limit: number|null}} Waterfall
 *   `end` is the time at the end of the axis, in seconds; `ticks` are times
 */

/**
 * Returns the bars of a chain's hops on one axis of time. Each hop begins where the median of the
 * hop before it ends. The parts of a hop divide its bar in proportion to their medians; its whisker
 * ends at its 99th percentile.
 * @param {Chain} chain
 * @param {number|null} [limit] seconds
 * @returns {Waterfall}
 */
export function waterfall(chain, limit = null) {
  let start = 0;
  const times = chain.hops.map((hop) => {
    const median = Math.max(0, hop.latency.p50_seconds);
    const most = Math.max(median, hop.latency.p99_seconds);
    const begin = start;
    start += median;
    return { begin, median, most };
  });
  const whole = Math.max(0, chain.latency.p50_seconds);
  const longest = Math.max(start, whole, chain.latency.p99_seconds,
    ...times.map(({ begin, most }) => begin + most));
  // A limit far above the figures would press them together; it is then only in the text.
  const isNear = limit != null && limit <= 2.5 * longest;
  const end = Math.max(longest, isNear ? Number(limit) : 0) * 1.02 || 1e-6;
  const bars = times.map(({ begin, median, most }, at) => {
    const own = partsOf(chain.hops[at]).map(({ name, figures }) => ({
      name, size: Math.max(0, figures.p50_seconds) }));
    const sum = own.reduce((all, { size }) => all + size, 0);
    let from = begin / end;
    const parts = sum > 0 ? own.map(({ name, size }) => {
      const width = (size / sum) * (median / end);
      const part = { name, start: from, width };
      from += width;
      return part;
    }) : [{ name: 'whole', start: from, width: median / end }];
    return { start: begin / end, width: median / end, whisker: (begin + most) / end, parts };
  });
  const total = {
    start: 0, width: whole / end, whisker: Math.max(whole, chain.latency.p99_seconds) / end,
    parts: [{ name: 'total', start: 0, width: whole / end }],
  };
  return { end, ticks: ticks(end), bars, total, limit: isNear ? Number(limit) / end : null };
}

/** Returns round times from 0 on, at most five of them. @param {number} end */
function ticks(end) {
  const power = 10 ** Math.floor(Math.log10(end / 4));
  const step = [1, 2, 5, 10].map((each) => each * power).find((each) => end / each <= 4.6)
    ?? 10 * power;
  const found = [];
  for (let at = 0; at * step <= end; at += 1) found.push(at * step);
  return found;
}

/** Formats the time of a tick: "0", "5 ms", "1.5 s". @param {number} seconds */
export function tickText(seconds) {
  return seconds === 0 ? '0' : duration(seconds).replace(/(\.\d*?)0+(?= )/, '$1').replace('. ', ' ');
}

/**
 * @typedef {{keys: Map<string, number>, steps: Set<string>, topics: number}} Way a chain in the
 *   graph: its nodes and topics with their positions, and the steps between them
 */

/** Returns the key of a step from one vertex to another. @param {string} from @param {string} to */
export function stepKey(from, to) {
  return JSON.stringify([from, to]);
}

/**
 * Returns the path of a chain through the graph.
 * @param {Chain} chain
 * @returns {Way}
 */
export function throughGraph(chain) {
  const domain = chain.domain_id;
  const topics = topicsOf(chain).map((name) => topicKey({ domain, name }));
  const nodes = nodesOf(chain).map((name) => (name == null ? null : nodeKey({ domain, name })));
  /** @type {Map<string, number>} */
  const keys = new Map();
  const steps = new Set();
  let before = /** @type {string|null} */ (null);
  topics.forEach((topic, at) => {
    for (const key of [nodes[at], topic]) {
      if (key != null && !keys.has(key)) keys.set(key, keys.size + 1);
      if (key != null && before != null) steps.add(stepKey(before, key));
      before = key;
    }
    // Without topics in the picture, one node leads to the next.
    const [node, next] = [nodes[at], nodes[at + 1]];
    if (node != null && next != null) steps.add(stepKey(node, next));
  });
  return { keys, steps, topics: topics.length };
}

/**
 * Returns which vertices and edges of a graph a chain passes. A closed box stands for its members.
 * @param {import('./graph-model.js').Graph} graph
 * @param {Way} way
 * @returns {{vertices: Map<string, number>, edges: Set<string>}} vertices with their positions
 */
export function marked(graph, way) {
  const standsFor = new Map();
  for (const vertex of graph.vertices) {
    if (way.keys.has(vertex.key)) standsFor.set(vertex.key, vertex.key);
    if (!vertex.closed) continue;
    for (const member of vertex.members) {
      if (way.keys.has(member)) standsFor.set(member, vertex.key);
    }
  }
  /** @type {Map<string, number>} */
  const vertices = new Map();
  for (const [key, position] of way.keys) {
    const shown = standsFor.get(key);
    if (shown != null && !vertices.has(shown)) vertices.set(shown, position);
  }
  const steps = new Set([...way.steps].flatMap((step) => {
    const [from, to] = JSON.parse(step).map((/** @type {string} */ key) => standsFor.get(key));
    return from != null && to != null && from !== to ? [stepKey(from, to)] : [];
  }));
  const isData = (/** @type {string} */ kind) => ['publishes', 'feeds', 'pair'].includes(kind);
  const edges = new Set(graph.edges.filter((edge) => isData(edge.kind)
    && steps.has(stepKey(edge.from, edge.to))).map((edge) => edge.id));
  return { vertices, edges };
}
