import assert from 'node:assert/strict';
import { test } from 'node:test';
import { address, parse, partAddress, tokenOf } from '../router.js';

test('every name comes back from its address', () => {
  for (const name of ['/points', '/a/b c?d=e&f#g', '/ü/日本', '/"><img src=x>', '%2F', '/\u202e\0']) {
    const route = parse(address('topics', name, { domain: 0, filter: 'x y&z' }));
    assert.deepEqual(route, {
      view: 'topics', name, query: { domain: '0', filter: 'x y&z' },
    });
  }
});

test('empty values leave the address', () => {
  assert.equal(address('graph', null, { hubs: true, focus: '', hidden: false, mode: null }),
    '#/graph?hubs=1');
  assert.equal(address(''), '#/');
});

test('addresses without a view', () => {
  assert.deepEqual(parse(''), { view: '', name: null, query: {} });
  assert.equal(parse('#/weather'), null);
  assert.equal(parse('#/topics/%E0%A4%A'), null);
});

test('the token is taken from the fragment alone', () => {
  assert.equal(tokenOf('#token=0a1b2c'), '0a1b2c');
  assert.equal(tokenOf('#/topics?token=0a'), null);
  assert.equal(tokenOf('#token=<b>'), null);
  assert.equal(tokenOf(''), null);
});

test('a finding about a part of the robot leads to that part', () => {
  assert.deepEqual(partAddress('transform_fault'), ['#/robot/transforms', 'Transforms']);
  assert.equal(partAddress('qos_incompatible'), null);
});
