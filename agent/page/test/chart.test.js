import assert from 'node:assert/strict';
import { test } from 'node:test';

globalThis.document = /** @type {any} */ ({ addEventListener() {}, baseURI: 'http://x/' });
globalThis.window = /** @type {any} */ ({ addEventListener() {} });
globalThis.location = /** @type {any} */ ({ hash: '' });
const { around, summary } = await import('../chart.js');

test('an axis spans the values, also one value and none', () => {
  assert.deepEqual(around(1000, 1010), [999, 1011]);
  assert.deepEqual(around(-5, -5), [-5.05, -4.95]);
  assert.deepEqual(around(0, 0), [-0.1, 0.1]);
  assert.deepEqual(around(null, null), [0, 1]);
});

test('a summary has the last, the least and the greatest value', () => {
  const line = { label: 'rate', colour: '--line-1', values: [3, null, 1, 2] };
  assert.equal(summary(line, String), 'rate: last 2, minimum 1, maximum 3');
  assert.equal(summary({ ...line, values: [null] }, String), 'rate: no values');
});
