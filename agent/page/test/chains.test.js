import assert from 'node:assert/strict';
import { test } from 'node:test';
import { chainAddress, chainsThrough, chosen, graphWords, lateCallsAddress, marked, rowsOf, section,
  slowest, stepKey, throughGraph, tickText, topicsOf, waterfall, wayOf } from '../chains.js';
import { build } from '../graph-model.js';
import { parse } from '../router.js';
import { State } from '../state.js';

const times = (/** @type {number} */ ms) => ({
  p50_seconds: ms / 1e3, p99_seconds: (2 * ms) / 1e3, maximum_seconds: (3 * ms) / 1e3 });

/**
 * @param {string} input @param {string|null} node @param {string} output @param {number} ms
 * @param {Partial<import('../chains.js').Hop>} more
 * @returns {import('../chains.js').Hop}
 */
const hop = (input, node, output, ms, more = {}) => ({
  input, node, output, latency: times(ms), transit: null, wait: null, callback: null,
  processing: null, ...more });

/** @param {Partial<import('../chains.js').Chain>} more @returns {import('../chains.js').Chain} */
const pipeline = (more = {}) => ({
  domain_id: 0, method: 'stamps', from: '/points', to: '/cmd', source: '/sensor', messages: 100,
  hops: [
    hop('/points', '/filter', '/filtered', 10, { transit: times(1), processing: times(7) }),
    hop('/filtered', '/control', '/cmd', 5, {
      transit: times(1), wait: times(1), callback: times(2), processing: times(3) }),
  ],
  latency: times(15), bottleneck: 0, last_seen_seconds: 1, ...more });

test('configured chains come first, each found chain once', () => {
  const expected = (/** @type {string} */ from, /** @type {string} */ to,
    /** @type {string} */ state) => ({
    domain_id: state === 'idle' ? null : 0, from, to, max_latency_ms: 20,
    method: state === 'idle' ? null : 'stamps', state, latency: state === 'idle' ? null : times(9) });
  const list = { chains: [pipeline({ from: '/a', hops: [hop('/a', '/n', '/cmd', 1)] }), pipeline()],
    expected: [expected('/points', '/cmd', 'slow'), expected('/filtered', '/cmd', 'ok'),
      expected('/x', '/y', 'idle')] };
  const rows = rowsOf(list);
  assert.deepEqual(rows.map((row) => [row.from, row.to, row.expected?.state ?? null]), [
    ['/points', '/cmd', 'slow'], ['/filtered', '/cmd', 'ok'], ['/x', '/y', 'idle'],
    ['/a', '/cmd', null]]);
  assert.equal(rows[0].chain, list.chains[1]);
  // A part of a chain has its own hops, and the latency that is measured for it.
  assert.equal(rows[1].chain?.hops.length, 1);
  assert.equal(rows[1].latency?.p50_seconds, 0.009);
  assert.equal(rows[2].chain, null);
  assert.equal(new Set(rows.map((row) => row.key)).size, 4);
});

test('an address leads to the same chain, also among chains of the same ends', () => {
  const one = pipeline();
  const other = pipeline({ hops: [hop('/points', '/direct', '/cmd', 3)] });
  const causal = pipeline({ method: 'causality' });
  for (const chain of [one, other, causal]) {
    const route = parse(chainAddress(chain));
    assert.equal(route?.name, '/points');
    assert.equal(chosen([one, other, causal], '/points', route?.query ?? {}), chain);
    const words = /** @type {any} */ (graphWords(chain));
    const late = new URL(lateCallsAddress(chain), 'http://robot/').searchParams;
    assert.deepEqual([late.get('from'), late.get('to'), late.get('history')], ['/points', '/cmd', 'true']);
    assert.equal(chosen([one, other, causal], words.chain, words), chain);
  }
  assert.notEqual(wayOf(one), wayOf(other));
  assert.equal(chosen([one], '/points', { to: '/cmd', way: 'gone' }), one);
  assert.equal(chosen([one], '/points', { to: '/elsewhere' }), null);
  assert.equal(chosen([one], '/points', { domain: '7' }), null);
});

test('a part of a chain has its own slowest hop', () => {
  const long = pipeline({ to: '/end', bottleneck: 2,
    hops: [...pipeline().hops, hop('/cmd', '/last', '/end', 30)] });
  assert.equal(slowest(long)?.node, '/last');
  const part = section([long], '/points', { to: '/cmd' });
  assert.deepEqual([part?.from, part?.to, part?.source], ['/points', '/cmd', '/sensor']);
  assert.equal(part && slowest(part)?.node, '/filter');
  const end = section([long], '/cmd', {});
  assert.equal(end?.source, '/control');
  assert.equal(end && slowest(end), null);
  assert.equal(section([long], '/cmd', { to: '/points' }), null);
  assert.deepEqual(chainsThrough([long], { domain: 0, node: '/control' }), [long]);
  assert.deepEqual(chainsThrough([long], { domain: 1, node: '/control' }), []);
  assert.deepEqual(chainsThrough([long], { domain: 0, topic: '/control' }), []);
});

const near = (/** @type {number} */ one, /** @type {number} */ other) =>
  assert.ok(Math.abs(one - other) < 1e-9, `${one} is not ${other}`);

test('each bar begins where the one before it ends, and its parts fill it', () => {
  const { bars, total, end, ticks } = waterfall(pipeline());
  near(bars[0].start, 0);
  near(bars[0].width * end, 0.010);
  near(bars[0].whisker * end, 0.020);
  near(bars[1].start * end, 0.010);
  near(bars[1].whisker * end, 0.020);
  near(total.width * end, 0.015);
  near(total.whisker * end, 0.030);
  assert.deepEqual(bars.map((bar) => bar.parts.map((part) => part.name)),
    [['transit', 'processing'], ['transit', 'wait', 'callback']]);
  for (const bar of bars) {
    near(bar.parts.reduce((sum, part) => sum + part.width, 0), bar.width);
    near(bar.parts[0].start, bar.start);
  }
  near(bars[0].parts[1].width / bars[0].parts[0].width, 7);
  assert.ok(ticks.length > 2 && ticks.length <= 5 && ticks[ticks.length - 1] <= end);
  for (const bar of [...bars, total]) assert.ok(bar.whisker <= 1);
});

test('a limit is on the axis unless it is far away', () => {
  const close = waterfall(pipeline(), 0.05);
  near((close.limit ?? 0) * close.end, 0.05);
  assert.ok((close.limit ?? 2) < 1);
  const far = waterfall(pipeline(), 5);
  assert.equal(far.limit, null);
  assert.equal(far.end, waterfall(pipeline()).end);
});

test('hops without parts or time are drawn', () => {
  const { bars, end } = waterfall(pipeline({ hops: [hop('/points', null, '/cmd', 0)],
    latency: times(0) }), null);
  assert.deepEqual(bars[0].parts.map((part) => part.name), ['whole']);
  assert.ok(end > 0 && Number.isFinite(bars[0].width));
});

test('ticks are short', () => {
  assert.deepEqual([0, 0.005, 0.0125, 1.5, 0.1, 20, 5e-6].map(tickText),
    ['0', '5 ms', '12.5 ms', '1.5 s', '100 ms', '20 s', '5 µs']);
});

/** The pipeline's graph, with a node beside it, and its second topic named like a hub. */
function robot() {
  const state = new State();
  state.apply({ open: { run: 'r', flags: [], passages: ['network'], access: 'read' } });
  const nodes = ['/sensor', '/ns/filter', '/ns/other', '/control'];
  const topics = ['/points', '/ns/tf', '/cmd', '/side'];
  const ends = (/** @type {number[][]} */ pairs) => pairs.map(([topic, node]) =>
    [topic, node, 1, `${topic}.${node}`, 1, 'RELIABLE', 'VOLATILE']);
  state.apply({ graph: {
    participants: [[1, 'guid', 0, 'v', 'a', 1, 'p', null]],
    nodes: nodes.map((name, at) => [at + 1, 0, name, [1], 0]),
    topics: topics.map((name, at) => [at + 1, 0, name, `rt${name}`, 'topic', ['T'], 0, 0, 1, 0]),
    publishers: ends([[1, 1], [2, 2], [3, 4], [4, 3]]),
    subscriptions: ends([[1, 2], [1, 3], [2, 4], [4, 4]]),
  } });
  return state;
}

const CHAIN = pipeline({ hops: [hop('/points', '/ns/filter', '/ns/tf', 10),
  hop('/ns/tf', '/control', '/cmd', 5)] });
/** @type {import('../graph-model.js').Options} */
const ALL = { mode: 'both', hubs: false, hidden: false, boxes: 'none', toggled: new Set(),
  focus: null, hops: 1 };

test('a chain marks its nodes, topics and edges, and unfolds its hubs', () => {
  const way = throughGraph(CHAIN);
  const shown = new Set(way.keys.keys());
  const graph = build(robot(), { ...ALL, shown });
  const { vertices, edges } = marked(graph, way);
  assert.deepEqual([...vertices.keys()], ['node:0:/sensor', 'topic:0:/points', 'node:0:/ns/filter',
    'topic:0:/ns/tf', 'node:0:/control', 'topic:0:/cmd']);
  assert.deepEqual([...vertices.values()], [1, 2, 3, 4, 5, 6]);
  assert.equal(edges.size, 5);
  for (const edge of graph.edges) {
    const beside = [edge.from, edge.to].some((key) => /other|side/.test(key));
    assert.equal(edges.has(edge.id), !beside, edge.id);
  }
  assert.equal(graph.vertices.length, 8);
  assert.equal(build(robot(), { ...ALL, shown, only: true }).vertices.length, 6);
  assert.equal(topicsOf(CHAIN).length, way.topics);
});

test('a closed box stands for its part of a chain, and nodes alone are joined', () => {
  const way = throughGraph(CHAIN);
  const shown = new Set(way.keys.keys());
  const closed = build(robot(), { ...ALL, shown, boxes: 'namespace', toggled: new Set(['box:/ns']) });
  const marks = marked(closed, way);
  assert.ok(marks.vertices.has('box:/ns') && !marks.vertices.has('node:0:/ns/filter'));
  const passed = closed.edges.filter((edge) => marks.edges.has(edge.id));
  assert.deepEqual(passed.map((edge) => stepKey(edge.from, edge.to)).includes(
    stepKey('topic:0:/points', 'box:/ns')), true);
  const nodes = build(robot(), { ...ALL, shown, mode: 'nodes' });
  assert.deepEqual([...marked(nodes, way).edges].sort(), [
    'node:0:/ns/filter pair node:0:/control', 'node:0:/sensor pair node:0:/ns/filter']);
});

test('an unknown node leaves a gap', () => {
  const way = throughGraph(pipeline({ source: null, hops: [hop('/points', null, '/cmd', 1)] }));
  assert.deepEqual([...way.keys.keys()], ['topic:0:/points', 'topic:0:/cmd']);
});
