import assert from 'node:assert/strict';
import { test } from 'node:test';
import { roots } from '../transforms.js';

const edges = (/** @type {string[]} */ ...all) => all.map((text) => {
  const [parent, child] = text.split('>');
  return { parent, child };
});

/** @param {import('../transforms.js').Frame} frame @returns {any} */
const shape = (frame) => (frame.children.length
  ? { [frame.name]: frame.children.map(shape) } : frame.name);

test('frames are below their parents, sorted by name', () => {
  const found = roots(edges('odom>base_link', 'map>odom', 'base_link>lidar', 'base_link>camera'));
  assert.deepEqual(found.map(shape), [{ map: [{ odom: [{ base_link: ['camera', 'lidar'] }] }] }]);
  assert.equal(found[0].edge, null);
  assert.equal(found[0].children[0].edge.child, 'odom');
});

test('several trees have several roots', () => {
  assert.deepEqual(roots(edges('map>odom', 'world>arm')).map(shape),
    [{ map: ['odom'] }, { world: ['arm'] }]);
});

test('a circle ends, and each of its edges is shown once', () => {
  const found = roots(edges('map>odom', 'a>b', 'b>c', 'c>a'));
  assert.deepEqual(found.map(shape), [{ map: ['odom'] }, { a: [{ b: [{ c: ['a'] }] }] }]);
  assert.deepEqual(roots(edges('a>a')).map(shape), [{ a: ['a'] }]);
});
