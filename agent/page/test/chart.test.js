import assert from 'node:assert/strict';
import { test } from 'node:test';

globalThis.document = /** @type {any} */ ({ addEventListener() {}, baseURI: 'http://x/' });
globalThis.window = /** @type {any} */ ({ addEventListener() {} });
globalThis.location = /** @type {any} */ ({ hash: '' });
const { around, printersOf, summary } = await import('../chart.js');

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

test('times have their day unless all are of today', () => {
  const at = (/** @type {number} */ day, /** @type {number} */ hour) => new Date(2026, 6, day, hour).getTime() / 1000;
  const printed = (/** @type {number[]} */ times) => {
    const { tick, whole } = printersOf(times, at(2, 23));
    return times.map((time) => [tick(time), whole(time)]);
  };
  assert.deepEqual(printed([at(2, 1), at(2, 20)]), [['01:00:00', '01:00:00'], ['20:00:00', '20:00:00']]);
  assert.deepEqual(printed([at(1, 1), at(2, 1)]), [['07-01\n01:00:00', '2026-07-01 01:00:00'],
    ['07-02\n01:00:00', '2026-07-02 01:00:00']]);
  assert.deepEqual(printed([]), []);
});
