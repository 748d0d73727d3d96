import assert from 'node:assert/strict';
import { test } from 'node:test';

globalThis.document = /** @type {any} */ ({ addEventListener() {}, baseURI: 'http://x/' });
globalThis.window = /** @type {any} */ ({ addEventListener() {} });
globalThis.location = /** @type {any} */ ({ hash: '' });
const { huesOf, pastMoment, tinted } = await import('../views/graph.js');
const { State } = await import('../state.js');
const { build } = await import('../graph-model.js');
const { state } = await import('../store.js');

/** @type {import('../graph-model.js').Options} */
const ALL = {
  mode: 'both', hubs: false, hidden: false, boxes: 'none', toggled: new Set(), focus: null, hops: 1,
};

function robot() {
  state.apply({ open: { run: 'r', flags: [], passages: ['network'], access: 'read' } });
  state.apply({ graph: {
    participants: [[1, 'g1', 0, 'v', 'base', 11, 'driver', null], [2, 'g2', 0, 'v', 'arm', 12, 'arm', null]],
    nodes: [[1, 0, '/a', [1], 0], [2, 0, '/b', [1], 0], [3, 0, '/c', [2], 0]],
    topics: [[1, 0, '/fast', 'rt/fast', 'topic', ['T'], 0, 0, 1, 0],
      [2, 0, '/unmeasured', 'rt/unmeasured', 'topic', ['T'], 0, 0, 0, 0]],
    publishers: [[1, 1, 1, 'g1.1', 1, 'RELIABLE', 'VOLATILE'], [2, 0, 2, 'g2.1', 1, 'RELIABLE', 'VOLATILE']],
    subscriptions: [[1, 3, 2, 'g2.2', 1, 'RELIABLE', 'VOLATILE']],
  } });
  state.apply({ values: { t: 1, totals: [0, 0, 0, 1], topics: [[1, 5000, 1, 1, 0, 0, 0.01, 0.01, 0, 1, 1]] } });
  return build(state, ALL).vertices;
}

test('each colour of the graph is in its legend, with the values of its scale', () => {
  const vertices = robot();
  const named = (/** @type {string} */ name) => /** @type {any} */ (
    vertices.find((each) => each.name === name));
  const rates = tinted(vertices, 'rate');
  assert.deepEqual(rates.legend.map(({ words }) => words),
    ['at most 1 Hz', '10 Hz', '100 Hz', 'at least 1.00 kHz']);
  assert.equal(rates.of(named('/fast')), rates.legend[3].colour);
  assert.equal(rates.of(named('/unmeasured')), null);
  assert.equal(rates.ofEdge(/** @type {any} */ ({ kind: 'pair', topics: [1, 2] })), rates.legend[3].colour);
  const latencies = tinted(vertices, 'latency');
  assert.deepEqual(latencies.legend.map(({ words }) => words),
    ['at most 100 µs', '1.00 ms', '10.0 ms', '100 ms', 'at least 1.00 s']);
  assert.equal(latencies.of(named('/fast')), latencies.legend[2].colour);
  for (const [tint, words] of /** @type {[string, string[]][]} */ ([
    ['process', ['arm 12 on arm: 2 nodes', 'driver 11 on base: 2 nodes']],
    ['host', ['arm: 2 nodes', 'base: 2 nodes']]])) {
    const found = tinted(vertices, tint);
    assert.deepEqual(found.legend.map((each) => each.words).sort(), words);
    const colours = vertices.filter((each) => each.topic == null).map((each) => found.of(each));
    assert.deepEqual(new Set(colours), new Set(found.legend.map(({ colour }) => colour)));
  }
  assert.deepEqual(tinted(vertices, '').legend, []);
});

test('names have different hues as long as there are hues', () => {
  const names = Array.from({ length: 12 }, (_, at) => `process ${at}`);
  assert.equal(new Set(huesOf(names).values()).size, 12);
  assert.equal(huesOf([...names, 'another']).size, 13);
  assert.deepEqual(huesOf(['b', 'a', 'b']), huesOf(['a', 'b']));
});

test('a comparison is made again for each moment of the past, and not for each second of the present', () => {
  const own = new State();
  const lines = (/** @type {number} */ t) => [{ open: { run: 'r' } }, { values: { t, topics: [], totals: [0, 0, 0, 0] } }];
  const moments = [60, 61, 61, 120].map((t, at) => {
    if (at < 2) lines(t).forEach((line) => own.apply(line));
    else own.show(lines(t));
    return pastMoment(own);
  });
  assert.deepEqual(moments, [null, null, 61, 120]);
});
