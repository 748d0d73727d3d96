import assert from 'node:assert/strict';
import { test } from 'node:test';

globalThis.document = /** @type {any} */ ({ addEventListener() {}, baseURI: 'http://x/' });
globalThis.window = /** @type {any} */ ({ addEventListener() {} });
globalThis.location = /** @type {any} */ ({ hash: '' });
const { grouped } = await import('../views/overview.js');

test('endpoints of a topic without a counterpart are one finding, others stay', () => {
  const finding = (/** @type {string} */ kind, /** @type {number|null} */ topic) => ({ kind, topic });
  const list = [finding('loss', 1), finding('unfed_subscriber', 2), finding('unfed_subscriber', 2),
    finding('unheard_publisher', 2), finding('loss', 1), finding('unfed_subscriber', 2),
    finding('unfed_subscriber', null)];
  const [firsts, more] = grouped(/** @type {any} */ (list));
  assert.deepEqual(firsts, [list[0], list[1], list[3], list[4], list[6]]);
  assert.deepEqual([...more], [[list[1], 2]]);
});
