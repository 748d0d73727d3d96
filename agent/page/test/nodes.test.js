import assert from 'node:assert/strict';
import { test } from 'node:test';

globalThis.document = /** @type {any} */ ({ addEventListener() {}, baseURI: 'http://x/' });
globalThis.window = /** @type {any} */ ({ addEventListener() {} });
globalThis.location = /** @type {any} */ ({ hash: '' });
const { processOf, usageOf } = await import('../views/nodes.js');
const { bytes, percent } = await import('../format.js');
const { state } = await import('../store.js');

const GROUP = '/robot.slice';

/** The same id on another host and on this one. */
function robots() {
  state.apply({ open: { run: 'r', flags: [], passages: [], access: 'read', host: 'robot1' } });
  state.apply({ graph: {
    participants: [[1, 'g1', 0, 'v', 'robot2', 1234, 'python3', null],
      [2, 'g2', 0, 'v', 'robot1', 1234, 'python3', GROUP]],
    nodes: [], topics: [], publishers: [], subscriptions: [],
  } });
  state.takeProcesses([{ process_id: 1234, process: 'python3', script: 'lidar.py' }]);
  return [1, 2].map((id) => /** @type {any} */ (state.participants.get(id)));
}

test('a process of another host has no figures and no script of one here', () => {
  const [there, here] = robots();
  const byId = new Map([[1234, { process_id: 1234, part: 0.5, memory_bytes: 1000 }]]);
  assert.equal(percent(processOf(there, byId)?.part), '–');
  assert.equal(bytes(processOf(there, byId)?.memory_bytes), '–');
  assert.equal(percent(processOf(here, byId)?.part), '50.0 %');
  assert.equal(processOf(null, byId), undefined);
  assert.equal(state.processName(there), 'python3 1234');
  assert.equal(state.processName(here), 'lidar.py 1234');
});

test('charts are those of the process, not of others with its id', () => {
  const [there, here] = robots();
  const usage = (/** @type {string} */ process, /** @type {number[]} */ times, id = 1234) =>
    ({ process_id: id, process, times });
  const all = [usage('bash', [1, 2]), usage('lidar.py', [11, 12]), usage('rviz2', [11, 12], 7), usage('make', [21, 22])];
  assert.deepEqual(usageOf(all, [here, here]), [all[1]]);
  assert.deepEqual(usageOf(all, [there, null]), []);
  // A script of the past is not known any more.
  state.takeProcesses([]);
  assert.deepEqual(usageOf([all[1], all[0]], [here]), [all[1]]);
  assert.deepEqual(usageOf([usage('python3', [1])], [here]), []);
});
