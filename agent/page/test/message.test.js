import assert from 'node:assert/strict';
import { test } from 'node:test';

// message.js imports rendering modules, which access a document when they are loaded.
globalThis.document = /** @type {any} */ ({ addEventListener() {}, baseURI: 'http://x/' });
globalThis.window = /** @type {any} */ ({ addEventListener() {} });
globalThis.location = /** @type {any} */ ({ hash: '' });
globalThis.sessionStorage = /** @type {any} */ ({ getItem: () => null });
const { flatten, numberAt, plotsOf, sinceFirst } = await import('../message.js');

const IMU = {
  header: { stamp: { sec: 5, nanosec: 7 }, frame_id: 'imu' },
  ranges: { $length: 1000, $items: [1.5, 'NaN'] },
  covariance: [0, 1],
  big: '9007199254740993',
  note: { $length: 5000, $text: 'abc' },
  ok: true,
};

test('a message becomes lines in the order of its definition', () => {
  const lines = flatten(IMU, new Set(['ranges']));
  assert.deepEqual(lines.map((line) => line.path), ['header', 'header.stamp', 'header.stamp.sec',
    'header.stamp.nanosec', 'header.frame_id', 'ranges', 'ranges[0]', 'ranges[1]', 'covariance',
    'covariance[0]', 'covariance[1]', 'big', 'note', 'ok']);
  const by = Object.fromEntries(lines.map((line) => [line.path, line]));
  assert.equal(by.ranges.count, 1000);
  assert.equal(by.note.value, 'abc… (5000 characters)');
  assert.equal(by['header.stamp.sec'].depth, 2);
});

test('closed members take no lines, and a large message is cut', () => {
  assert.ok(!flatten(IMU, new Set(['header'])).some((line) => line.path.startsWith('header.')));
  const large = { a: Array.from({ length: 5000 }, (_, at) => at) };
  assert.equal(flatten(large, new Set(['a'])).length, 400);
});

test('numbers are found by their path, and nothing else is', () => {
  assert.equal(numberAt(IMU, 'header.stamp.sec'), 5);
  assert.equal(numberAt(IMU, 'ranges[0]'), 1.5);
  assert.equal(numberAt(IMU, 'ranges[1]'), null);
  assert.equal(numberAt(IMU, 'covariance[1]'), 1);
  assert.equal(numberAt(IMU, 'ok'), 1);
  assert.equal(numberAt(IMU, 'header.frame_id'), null);
  assert.equal(numberAt(IMU, 'gone.x'), null);
  assert.equal(numberAt(null, 'x'), null);
});

test('changes count from the first value, and gaps stay', () => {
  assert.deepEqual(sinceFirst([null, 5, 7, null, 4]), [null, 0, 2, null, -1]);
  assert.deepEqual(sinceFirst([]), []);
});

test('fields have a chart each, or one together in different colours', () => {
  const fields = /** @type {[string, number[]][]} */ (
    ['a', 'b', 'c', 'd', 'e', 'f'].map((path) => [path, [5, 7]]));
  assert.deepEqual(plotsOf(fields, true, false).map((lines) => lines.map(({ label }) => label)),
    [['a'], ['b'], ['c'], ['d'], ['e'], ['f']]);
  const [together, ...more] = plotsOf(fields, false, true);
  assert.equal(more.length, 0);
  assert.equal(new Set(together.map(({ colour }) => colour)).size, 6);
  assert.deepEqual(together[5].values, [0, 2]);
  assert.deepEqual(plotsOf([], false, false), []);
});
