import assert from 'node:assert/strict';
import { test } from 'node:test';

globalThis.document = /** @type {any} */ ({ addEventListener() {}, baseURI: 'http://x/' });
globalThis.window = /** @type {any} */ ({ addEventListener() {} });
globalThis.location = /** @type {any} */ ({ hash: '' });
const { rank } = await import('../dialogs.js');

test('the best name precedes others, types and sentences', () => {
  const results = [
    { kind: 'finding', name: '/imu loses messages' }, { kind: 'topic', name: '/other' },
    { kind: 'node', name: '/simulator' }, { kind: 'topic', name: '/front/imu_raw' },
    { kind: 'topic', name: '/imu' },
  ];
  const sorted = (/** @type {string} */ words) => [...results]
    .sort((one, other) => rank(one, words) - rank(other, words)).map((each) => each.name);
  assert.equal(rank({ kind: 'topic', name: '/front/imu_raw' }, 'imu'), 1);
  const found = sorted('imu');
  assert.deepEqual([...found.slice(0, 2), found.at(-1)],
    ['/imu', '/front/imu_raw', '/imu loses messages']);
  assert.equal(sorted('IMU')[0], '/imu');
});
