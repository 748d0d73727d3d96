import assert from 'node:assert/strict';
import { test } from 'node:test';

globalThis.document = /** @type {any} */ ({ addEventListener() {}, baseURI: 'http://x/' });
globalThis.window = /** @type {any} */ ({ addEventListener() {} });
globalThis.location = /** @type {any} */ ({ hash: '' });
const { byPart, faults, incidentLines, incidentNotes, nothingDiffers, stateOf } = await import('../views/fleet.js');
const { address, parse } = await import('../router.js');

const difference = (/** @type {string} */ part, /** @type {string} */ text) => ({ part, text });
const robot = {
  violated: [['/scan', 'min_rate_hz']],
  findings: { qos_incompatible: 2 },
  differences: [
    difference('rates', 'rate of /scan: 5.0 Hz, usually 10.0 Hz (2 of 3)'),
    difference('nodes', 'node /planner is missing (2 of 3)'),
    difference('of_a_newer_agent', 'weight: 3, usually 4 (2 of 3)'),
    difference('nodes', 'node /other is only here (2 of 3)'),
  ],
};

test('what is wrong with a robot is one line each', () => {
  assert.deepEqual(faults(robot), ['/scan: min_rate_hz is violated', '2 x qos_incompatible']);
});

test('differences are grouped, the graph first, and none is left out', () => {
  const groups = byPart(robot).map(([title, those]) => [title, those.length]);
  assert.deepEqual(groups, [['Nodes', 2], ['Rates', 1], ['Others', 1]]);
  assert.deepEqual(byPart({ differences: [] }), []);
});

test('a robot that was not compared is not called usual', () => {
  const ok = { state: 'ok' };
  const lost = { state: 'out_of_reach' };
  const three = { in_reach: 3, minimum: 3 };
  assert.deepEqual(nothingDiffers(ok, three)[0], 'good');
  assert.match(nothingDiffers(lost, three)[1], /out of reach/);
  assert.match(nothingDiffers(ok, { in_reach: 2, minimum: 3 })[1], /2 in reach, of 3 at least/);
  assert.deepEqual(nothingDiffers({ state: 'not_ready' }, three)[0], null);
});

test('an incident has its findings, and what is missing', () => {
  const findings = { 'ros2.message.lost': 2 };
  assert.deepEqual(incidentLines({ findings, is_complete: true }), ['2 x ros2.message.lost']);
  assert.equal(incidentLines({ findings: null, is_complete: false }).length, 2);
});

test('a store that cannot be read does not have no incident', () => {
  const some = { at: 1, problem: null, unread: 0, unfinished: 0, is_cut: false };
  assert.deepEqual(incidentNotes(some, 1), []);
  assert.match(incidentNotes(some, 0)[0], /no incident/);
  assert.deepEqual(incidentNotes({ ...some, problem: 'out of reach' }, 0), []);
  assert.match(incidentNotes({ ...some, at: null }, 0)[0], /being read/);
  assert.equal(incidentNotes({ ...some, unread: 2, unfinished: 1, is_cut: true }, 1).length, 3);
});

test('a state of a newer agent is shown as it is', () => {
  assert.deepEqual(stateOf('out_of_reach'), ['error', 'out of reach']);
  assert.deepEqual(stateOf('asleep'), ['note', 'asleep']);
});

test('a robot has an address of its own', () => {
  const route = parse(address('fleet', 'robot/7'));
  assert.equal(route?.view, 'fleet');
  assert.equal(route?.name, 'robot/7');
  const scraped = address('fleet', 'host:17401');
  assert.equal(scraped, '#/fleet/host:17401');
  assert.equal(parse(scraped)?.name, 'host:17401');
});
