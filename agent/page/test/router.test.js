import assert from 'node:assert/strict';
import { test } from 'node:test';
import { address, findingAddress, parse, tokenOf } from '../router.js';

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

/** @param {string} id @param {string} text @param {string|null} topic @param {string|null} node */
const place = (id, text = '', topic = null, node = null) => findingAddress(
  { id, text, kind: id.split('|')[0] }, topic ? { name: topic, domain: 0 } : null,
  node ? { name: node, domain: 0 } : null)?.[0];

test('a finding leads to the section that it concerns', () => {
  const topic = '#/topics/%2Fa?domain=0';
  assert.equal(place('loss|0|rt/a', '/a loses messages', '/a'), `${topic}&part=waterfall`);
  assert.equal(place('qos_incompatible|0|rt/a', '', '/a'), `${topic}&part=qos`);
  assert.equal(place('unmatched_publisher|0|rt/a', '', '/a'), `${topic}&part=endpoints`);
  assert.equal(place('watch_violated|0|/a|/*', 'not as expected: at least 10 Hz', '/a'), `${topic}&part=course`);
  assert.equal(place('watch_violated|0|/a|/*', 'not as expected: a loss of at most 1 %', '/a'),
    `${topic}&part=waterfall`);
  assert.equal(place('watch_violated|0|/a|/*', 'not as expected: at least 1 publisher', '/a'),
    `${topic}&part=endpoints`);
  assert.equal(place('slow_callback|12|ab', '', null, '/n'), '#/nodes/%2Fn?domain=0&part=inside');
  assert.equal(place('duplicate_node|0|/n', '', null, '/n'), '#/nodes/%2Fn?domain=0&part=where');
  assert.equal(place('slow_chain|0', '', '/a'), '#/chains?filter=%2Fa');
  assert.equal(place('ability|source'), undefined);
});

test('a finding about what the robot says leads to its row', () => {
  const robot = (/** @type {string} */ part, /** @type {Record<string, string>} */ query) =>
    address('robot', part, query);
  assert.equal(place('transform_fault|0|/r1|base|link|silent'),
    robot('transforms', { part: 'frame 0 /r1 base|link' }));
  assert.equal(place('log_errors|0|/n', '', null, '/n'), robot('logs', { filter: '/n', level: 'error' }));
  assert.equal(place('parameter_drift|0|/n|speed', '', null, '/n'),
    robot('parameters', { filter: '/n speed' }));
  assert.equal(place('diagnostic_error|0|/diagnostics|battery: left|'),
    robot('diagnostics', { filter: 'battery: left' }));
  assert.equal(place('hanging_call|0|rq/map/loadRequest|01'), robot('services', { filter: '/map/load' }));
  assert.equal(place('clocks_apart|base'), robot('clocks', { part: 'clock base' }));
});
