import assert from 'node:assert/strict';
import { beforeEach, test } from 'node:test';

let visibilityState = 'visible';
Object.assign(globalThis, {
  document: { addEventListener() {}, baseURI: 'http://x/', get visibilityState() { return visibilityState; } },
  window: { addEventListener() {} },
  sessionStorage: { getItem: () => null },
});
const { State } = await import('../state.js');
const { Stream } = await import('../stream.js');

const OPEN = { run: 'r1', host: 'robot1', access: 'watch', flags: [], passages: [], keeps_history: true };
const LINES = (/** @type {number} */ t) => [{ open: OPEN },
  { graph: { participants: [], nodes: [[1, 0, '/lidar', [], 0]], topics: [], publishers: [], subscriptions: [] } },
  { findings: [{ id: 'f', kind: 'loss', severity: 'error', text: 'x' }] },
  { values: { t, topics: [], totals: [1, 1, 0, 1] } }];
const MOMENT = `${LINES(40).map((line) => JSON.stringify(line)).join('\n')}\n`;

/** Answers of the agent, one for each request. @type {(() => Promise<any>)[]} */
let answers = [];
/** Addresses that were requested. @type {string[]} */
let asked = [];
globalThis.fetch = /** @type {any} */ (async (/** @type {string} */ address) => {
  asked.push(address);
  return (answers.shift() ?? refuse(404))();
});

const refuse = (/** @type {number} */ status) => async () => ({ ok: false, status,
  json: async () => ({ detail: 'no state', code: 'no-history' }) });
const read = (/** @type {() => Promise<string>} */ text) => async () => ({ ok: true, text });
const lost = async () => { throw new TypeError('failed'); };

/** Lets all promises go on. */
const settled = () => new Promise((done) => setImmediate(done));

/** Returns a stream whose state is that of the present. */
function present() {
  const state = new State();
  LINES(100).forEach((line) => state.apply(line));
  return new Stream(state, () => {});
}

/** @param {any} stream */
function nothing({ state, status }) {
  return [status, state.past, state.unknown, state.batches, state.time, state.nodes.size,
    state.findings.length, state.totals.rate, state.open?.host];
}

beforeEach(() => {
  [answers, asked, visibilityState] = [[], [], 'visible'];
});

test('a moment is shown as it was', async () => {
  const stream = present();
  answers = [read(async () => MOMENT)];
  stream.go(50);
  await settled();
  assert.equal(asked[0], 'http://x/history/moment?at=50');
  assert.deepEqual([stream.status, stream.problem, stream.state.time, stream.state.nodes.size], ['past', null, 40, 1]);
});

test('a moment that is not kept shows no other time, and is requested once', async (context) => {
  context.mock.timers.enable({ apis: ['setTimeout'] });
  const stream = present();
  answers = [refuse(404)];
  stream.go(50);
  await settled();
  assert.deepEqual(nothing(stream), ['past', true, true, 1, 50, 0, 0, 0, 'robot1']);
  assert.equal(stream.problem?.message, 'no state');
  context.mock.timers.tick(60_000);
  await settled();
  assert.equal(asked.length, 1);
  // The next moment is known, and then the present.
  answers = [read(async () => MOMENT)];
  stream.go(45);
  await settled();
  assert.deepEqual([stream.status, stream.problem, stream.state.unknown, stream.state.nodes.size],
    ['past', null, false, 1]);
  stream.state.showUnknown(50);
  LINES(100).forEach((line) => stream.state.apply(line));
  assert.deepEqual([stream.state.unknown, stream.state.past, stream.state.nodes.size], [false, false, 1]);
});

test('a bookmark of a time that is not kept does not wait for ever', async () => {
  const stream = new Stream(new State(), () => {});
  stream.go(50);
  await settled();
  assert.deepEqual([stream.status, stream.state.batches, stream.state.open], ['past', 1, null]);
});

for (const [what, answer, words] of /** @type {[string, () => Promise<any>, RegExp][]} */ ([
  ['a lost connection', lost, /does not answer/],
  ['an answer that breaks off', read(lost), /connection was lost/],
  ['a busy agent', refuse(503), /no state/],
])) {
  test(`${what} is tried again`, async (context) => {
    context.mock.timers.enable({ apis: ['setTimeout'] });
    const stream = present();
    answers = [answer, answer, read(async () => MOMENT)];
    stream.go(50);
    await settled();
    assert.deepEqual(nothing(stream), ['past', true, true, 1, 50, 0, 0, 0, 'robot1']);
    assert.match(stream.problem?.message ?? '', words);
    assert.ok(stream.isRetrying);
    for (const wait of [1000, 2000]) {
      context.mock.timers.tick(wait);
      await settled();
    }
    assert.equal(asked.length, 3);
    assert.deepEqual([stream.status, stream.problem, stream.isRetrying, stream.state.time], ['past', null, false, 40]);
  });
}

test('a hidden tab requests a moment again when it is visible', async (context) => {
  context.mock.timers.enable({ apis: ['setTimeout'] });
  const stream = present();
  visibilityState = 'hidden';
  answers = [lost, read(async () => MOMENT)];
  stream.go(50);
  await settled();
  context.mock.timers.tick(5000);
  await settled();
  assert.equal(asked.length, 1);
  visibilityState = 'visible';
  stream.seen();
  await settled();
  assert.deepEqual([stream.status, stream.state.time], ['past', 40]);
});

test('without the right to read, a moment shows no other time either', async () => {
  const stream = present();
  answers = [refuse(401)];
  stream.go(50);
  await settled();
  assert.deepEqual([stream.status, stream.state.unknown], ['refused', true]);
});
