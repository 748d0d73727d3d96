import assert from 'node:assert/strict';
import { test } from 'node:test';

// message.js imports rendering modules, which access a document when they are loaded.
globalThis.document = /** @type {any} */ ({ addEventListener() {}, baseURI: 'http://x/' });
globalThis.window = /** @type {any} */ ({ addEventListener() {} });
globalThis.sessionStorage = /** @type {any} */ ({ getItem: () => null });
const { flatten } = await import('../message.js');
const { fromAbove, pointsOf, widthOf } = await import('../preview.js');

test('points are read as little-endian floats, and an incomplete one is left out', () => {
  const floats = new Float32Array([1, 2, 3, -4, 5.5, 6]);
  const text = Buffer.from(floats.buffer).toString('base64');
  assert.deepEqual(pointsOf(text), [[1, 2, 3], [-4, 5.5, 6]]);
  assert.deepEqual(pointsOf(Buffer.from(floats.buffer).subarray(0, 20).toString('base64')), [[1, 2, 3]]);
  assert.deepEqual(pointsOf(''), []);
});

test('forward is up and left is left, and everything fits', () => {
  const { to, metres } = fromAbove([[0, 0], [10, 0], [0, 5]]);
  assert.ok(Math.abs(metres - 11) < 1e-9);
  const [[x0, y0], [x1, y1], [x2, y2]] = [to(0, 0), to(10, 0), to(0, 5)];
  assert.ok(y1 < y0 && Math.abs(x1 - x0) < 1e-9, 'forward is up');
  assert.ok(x2 < x0 && Math.abs(y2 - y0) < 1e-9, 'left is left');
  for (const place of [x0, y0, x1, y1, x2, y2]) assert.ok(place >= 0 && place <= 320, String(place));
  assert.ok(fromAbove([]).metres > 0 && fromAbove([[1, 1]]).metres > 0);
});

test('a long array is closed until it is opened', () => {
  const value = { ranges: Array.from({ length: 100 }, (_, at) => at), short: [1, 2] };
  const paths = (/** @type {string[]} */ ...toggled) => flatten(value, new Set(toggled))
    .map((line) => line.path);
  assert.deepEqual(paths(), ['ranges', 'short', 'short[0]', 'short[1]']);
  assert.equal(paths('ranges').length, 104);
  assert.deepEqual(paths('short'), ['ranges', 'short']);
});

test('a width beyond the world of robots stays short', () => {
  assert.deepEqual([5.44, 99999, 5.445e38].map(widthOf), ['5.4', '99999.0', '5.4e+38']);
});
