import assert from 'node:assert/strict';
import { test } from 'node:test';

globalThis.document = /** @type {any} */ ({ addEventListener() {}, baseURI: 'http://x/' });
globalThis.window = /** @type {any} */ ({ addEventListener() {} });
globalThis.location = /** @type {any} */ ({ hash: '' });
const { Findings, grouped, Incomplete, Totals } = await import('../views/overview.js');
const { state } = await import('../store.js');
const { Badges, FLAG_MEANINGS, FLAGS, Meanings } = await import('../ui.js');

test('endpoints of a topic without a counterpart are one finding, others stay', () => {
  const finding = (/** @type {string} */ kind, /** @type {number|null} */ topic) => ({ kind, topic });
  const list = [finding('loss', 1), finding('unmatched_subscription', 2), finding('unmatched_subscription', 2),
    finding('unmatched_publisher', 2), finding('loss', 1), finding('unmatched_subscription', 2),
    finding('unmatched_subscription', null)];
  const [firsts, more] = grouped(/** @type {any} */ (list));
  assert.deepEqual(firsts, [list[0], list[1], list[3], list[4], list[6]]);
  assert.deepEqual([...more], [[list[1], 2]]);
});

test('a mismatch of QoS is one finding, although both endpoints have no counterpart', () => {
  const finding = (/** @type {string} */ kind, /** @type {number} */ topic) => ({ kind, topic });
  const list = [finding('qos_incompatible', 1), finding('unmatched_publisher', 1),
    finding('unmatched_subscription', 1), finding('unmatched_publisher', 2)];
  assert.deepEqual(grouped(/** @type {any} */ (list))[0], [list[0], list[3]]);
});

test('a page without topics says that writers send whose announcement was missed', () => {
  state.findings = [];
  assert.equal(Incomplete({ missing: 'this lacks them' }), undefined);
  state.findings = [/** @type {any} */ ({ kind: 'unknown_writers', severity: 'warning',
    text: 'Writers are active', remedy: 'sudo rp discover --all' })];
  const shown = JSON.stringify(Incomplete({ missing: 'this lacks them' }));
  for (const part of ['Writers are active', 'this lacks them', 'sudo rp discover --all']) {
    assert.ok(shown.includes(part), `${part}: ${shown}`);
  }
});

test('the loss of a finding is that of the table of topics', () => {
  state.apply({ open: { run: 'r', flags: [], passages: [], access: 'read' } });
  state.apply({ graph: { participants: [], nodes: [], publishers: [], subscriptions: [],
    topics: [[1, 0, '/points', 'rt/points', 'topic', ['T'], 0, 0, 1, 3]] } });
  const row = (/** @type {number|null} */ expected) => state.apply({ values: { t: 1, totals: [0, 0, 0, 1],
    topics: [[1, 10, 1, 100, 50, 0, null, null, 0, 1, expected]] } });
  const shown = () => JSON.stringify(Findings({ list: [/** @type {any} */ ({ id: 'l', kind: 'loss', severity: 'warning',
    topic: 1, node: null, since: null, text: 'messages are lost', remedy: null })] }));
  row(100);
  assert.ok(shown().includes('50.0 % since it is measured'), shown());
  row(null);
  assert.ok(!shown().includes('since it is measured'));
});

test('every state of a topic is explained where keys and touch reach it', () => {
  const below = JSON.stringify(Meanings({ rows: FLAG_MEANINGS }));
  for (const [flag, [, , meaning]] of Object.entries(FLAGS)) {
    assert.ok(meaning && below.includes(meaning), flag);
    assert.ok(JSON.stringify(Badges({ flags: [flag], explained: true })).includes(meaning), flag);
  }
});

test('figures of a moment in the past are not called those of now', () => {
  state.apply({ open: { run: 'r', flags: [], passages: [], access: 'read' } });
  state.apply({ graph: { participants: [], nodes: [], publishers: [], subscriptions: [],
    topics: [[1, 0, '/scan', 'rt/scan', 'topic', ['T'], 0, 0, 1, 3]] } });
  state.apply({ values: { t: 1, totals: [0, 0, 0, 1], topics: [[1, 84, 1, 100, 0, 0, null, null, 0, 1, 100]] } });
  const shown = () => JSON.stringify([Totals(), Findings({ list: [/** @type {any} */ ({ id: 'v', kind: 'watch_violated',
    severity: 'warning', topic: 1, node: null, since: null, text: 'at least 85 Hz', remedy: null })] })]);
  assert.match(shown(), /"Now".*\(now 84 Hz\)/);
  state.past = true;
  assert.match(shown(), /"At that time".*\(then 84 Hz\)/);
  state.past = false;
});
