import assert from 'node:assert/strict';
import { test } from 'node:test';

globalThis.document = /** @type {any} */ ({ addEventListener() {}, baseURI: 'http://x/' });
globalThis.window = /** @type {any} */ ({ addEventListener() {} });
globalThis.location = /** @type {any} */ ({ hash: '' });
const { domainOf, domainsNow } = await import('../views/recordings.js');
const { state } = await import('../store.js');

test('domains have the order of numbers', () => {
  const participant = (/** @type {number} */ id, /** @type {number} */ domain) => [id, `g${id}`, domain, 'v', null, null, null, null];
  state.apply({ open: { run: 'r', flags: [], passages: [], access: 'all' } });
  state.apply({ graph: { participants: [participant(1, 10), participant(2, 2), participant(3, 2)], nodes: [], topics: [],
    publishers: [], subscriptions: [] } });
  assert.deepEqual(domainsNow(), [2, 10]);
});

test('a recording needs a domain while none is known', () => {
  for (const chosen of [undefined, '', ' ', '-1', '1.5', '233', '1e1', 'x']) {
    assert.throws(() => domainOf(chosen, []), /a number from 0 to 232/, chosen);
  }
  assert.deepEqual([domainOf('0', []), domainOf('232', []), domainOf('10', [2, 10]), domainOf(undefined, [7])], [0, 232, 10, 7]);
});
