import assert from 'node:assert/strict';
import { test } from 'node:test';

globalThis.document = /** @type {any} */ ({ addEventListener() {}, baseURI: 'http://x/' });
globalThis.window = /** @type {any} */ ({ addEventListener() {} });
globalThis.location = /** @type {any} */ ({ hash: '' });
const { Refusal } = await import('../api.js');
const { afterProblem, mayPoll, stream } = await import('../store.js');
const { mayRead } = await import('../timebar.js');

test('a view that opens while the page is paused has its answer, and then none until it goes on', () => {
  const may = () => [mayPoll(true), mayPoll(false), mayRead(null, true), mayRead(null, false), mayRead(5, false)];
  for (const [status, expected] of /** @type {[any, boolean[]][]} */ ([
    ['live', [true, true, true, true, true]], ['paused', [true, false, true, false, true]],
    // The time of the present is unknown.
    ['connecting', [true, true, false, false, true]]])) {
    stream.status = status;
    assert.deepEqual(may(), expected, status);
  }
});

test('contents go with the right to them, and stay while the agent is out of reach', () => {
  const before = { path: 'logs', part: '', data: { messages: [] }, problem: null };
  const data = (/** @type {any} */ problem, path = 'logs') => afterProblem(before, path, '', problem).data;
  for (const problem of [new Refusal(401, ''), new Refusal(403, '', 'needs-socket')]) assert.equal(data(problem), null);
  for (const problem of [new Refusal(0, ''), new Refusal(503, ''), new Refusal(404, '')]) {
    assert.equal(data(problem), before.data);
  }
  assert.equal(data(new Refusal(0, ''), 'parameters'), null);
});
