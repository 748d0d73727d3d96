import assert from 'node:assert/strict';
import { test } from 'node:test';
import { Lines, MOST_EVENTS, STEPS, State } from '../state.js';

const OPEN = {
  run: 'r1', host: 'robot1', access: 'watch', history_seconds: 600,
  flags: ['qos', 'type', 'loss'], passages: ['network', 'shared_memory'], replay: null,
};
const GRAPH = {
  version: 1,
  participants: [[1, 'aa', 0, 'eProsima Fast DDS', 'robot1', 4711, 'driver', null]],
  nodes: [[1, 0, '/lidar', [1], 0]],
  topics: [[1, 0, '/points', 'rt/points', 'topic', ['T'], 0, 0, 1, 3],
    [2, 0, '/idle', 'rt/idle', 'topic', ['T'], 0, 0, 0, 0]],
  publishers: [[1, 1, 1, 'aa.1', 2, 'RELIABLE', 'VOLATILE']],
  subscriptions: [[1, 0, 1, 'aa.2', 3, 'BEST_EFFORT', 'VOLATILE']],
};

/** @param {number} t @param {any[]} topics */
function values(t, topics) {
  return { values: { t, topics, totals: [10, 1000, 0, topics.length] } };
}

/** @param {State} state @param {any[]} lines */
function feed(state, ...lines) {
  return lines.map((line) => state.apply(line));
}

function ready() {
  const state = new State();
  feed(state, { open: OPEN }, { graph: GRAPH }, values(100, [
    [1, 10, 500, 1000, 3, 1, 0.001, 0.004, 4, 99.9],
  ]));
  return state;
}

test('a batch is whole with its values', () => {
  const state = new State();
  assert.deepEqual(feed(state, { open: OPEN }, { graph: GRAPH }, { findings: [] },
    values(100, [])), [false, false, false, true]);
});

test('rows replace rows, and rows that are not sent stay', () => {
  const state = ready();
  assert.equal(state.figuresOf(1).rate, 10);
  assert.deepEqual(state.flagsOf(1), ['loss']);
  feed(state, values(101, []));
  assert.equal(state.figuresOf(1).rate, 10);
  feed(state, values(102, [[1, 11, 500, 1010, 3, 0, null, null, 0, 101.9]]));
  assert.equal(state.figuresOf(1).rate, 11);
  assert.deepEqual(state.flagsOf(1), []);
  assert.equal(state.figuresOf(2).rate, null);
});

test('an unmeasured row is no rate of zero', () => {
  const state = ready();
  feed(state, values(101, [[2, null, null, null, null, null, null, null, 1, null]]));
  assert.equal(state.figuresOf(2).rate, null);
  assert.deepEqual(state.flagsOf(2), ['qos']);
});

test('endpoints belong to their node, or to their participant', () => {
  const state = ready();
  const topic = /** @type {any} */ (state.topicNamed('/points', 0));
  assert.equal(state.ownerOf(topic.publishers[0]).name, '/lidar');
  assert.equal(state.ownerOf(topic.subscriptions[0]).name, 'driver (no node)');
  assert.deepEqual(state.passagesOf(3), ['network', 'shared_memory']);
  assert.equal(state.hasDomains(), false);
});

test('a topic that goes takes its figures along', () => {
  const state = ready();
  const before = state.structure;
  feed(state, { graph: { ...GRAPH, topics: [GRAPH.topics[1]] } });
  assert.equal(state.figures.size, 0);
  assert.equal(state.series.size, 0);
  assert.ok(state.structure > before);
  // A late row for it is ignored.
  feed(state, values(103, [[1, 5, 5, 5, 0, 0, null, null, 0, 1]]));
  assert.equal(state.figures.size, 0);
});

test('figures change no structure', () => {
  const state = ready();
  const before = state.structure;
  feed(state, values(101, [[1, 12, 500, 1010, 3, 0, null, null, 0, 101]]));
  assert.equal(state.structure, before);
});

test('another run of the agent forgets everything, the same one keeps events', () => {
  const state = ready();
  feed(state, { events: { missed: 0, list: [{ id: 'r1-1', time: '', name: 'x', severity: 'INFO',
    attributes: {} }] } });
  feed(state, { open: OPEN });
  assert.equal(state.events.length, 1);
  assert.equal(state.figures.size, 0, 'all rows come again');
  feed(state, { open: { ...OPEN, run: 'r2' } });
  assert.equal(state.events.length, 0);
  assert.equal(state.topics.size, 0);
  assert.equal(state.batches, 0);
});

test('each stream is counted, because events between two streams are in neither', () => {
  const state = ready();
  assert.equal(state.openings, 1);
  feed(state, { open: OPEN });
  assert.equal(state.openings, 2);
  state.showUnknown(5);
  feed(state, { open: OPEN });
  state.show([{ open: { ...OPEN, run: 'r0' } }]);
  feed(state, { open: { ...OPEN, run: 'r2' } });
  assert.equal(state.openings, 5);
});

test('history comes first, steps are appended, and ten minutes are kept', () => {
  const state = ready();
  feed(state, { history: {
    step_seconds: 10, t: [80, 90], totals: [[1, 2], [3, 4], [0, 0]], topics: [[1, [8, null]]],
  } });
  assert.deepEqual(state.pointsOf(1), [8, null]);
  for (let t = 91; t <= 100; t += 1) {
    feed(state, values(t, [[1, t <= 95 ? 10 : 20, 0, 0, 0, 0, null, null, 0, t]]));
  }
  assert.deepEqual(state.pointsOf(1), [8, null, 15]);
  for (let t = 101; t <= 2000; t += 1) feed(state, values(t, []));
  assert.equal(state.pointsOf(1).length, STEPS);
  assert.equal(state.totalSeries[0].points.length, STEPS);
});

test('steps have the length of the history before them, whatever the agent keeps', () => {
  for (const history_seconds of [60, 600, 3600]) {
    const state = new State();
    feed(state, { open: { ...OPEN, history_seconds } }, { graph: GRAPH },
      { history: { step_seconds: 10, t: [80, 90], totals: [[1, 2], [3, 4], [0, 0]], topics: [[1, [8, 9]]] } });
    for (let t = 91; t <= 690; t += 1) feed(state, values(t, [[1, t, 0, 0, 0, 0, null, null, 0, t]]));
    assert.equal(state.pointsOf(1).length, STEPS, 'ten minutes');
    assert.deepEqual(state.pointsOf(1).slice(0, 2), [95.5, 105.5]);
  }
});

test('events are kept once, in order, and not without end', () => {
  const state = ready();
  const event = (/** @type {number} */ number) => ({
    id: `r1-${number}`, time: '', name: 'x', severity: 'INFO', attributes: {},
  });
  feed(state, { events: { missed: 2, list: [event(5), event(10)] } });
  state.addEvents([event(9), event(10), event(1)]);
  assert.deepEqual(state.events.map((each) => each.id), ['r1-1', 'r1-5', 'r1-9', 'r1-10']);
  assert.equal(state.missedEvents, 2);
  state.addEvents(Array.from({ length: 2000 }, (_, at) => event(at + 11)));
  assert.equal(state.events.length, MOST_EVENTS);
  assert.equal(state.events[MOST_EVENTS - 1].id, 'r1-2010');
});

test('rights are ordered', () => {
  const state = ready();
  assert.deepEqual(['read', 'watch', 'all'].map((right) => state.may(right)),
    [true, true, false]);
  assert.equal(new State().may('read'), false);
});

test('lines of later agents change nothing', () => {
  const state = ready();
  assert.equal(state.apply({ weather: 'fine' }), false);
  feed(state, values(101, [[1, 9, 1, 1, 0, 0, null, null, 0, 101, 'more', 'columns']]));
  assert.equal(state.figuresOf(1).rate, 9);
});

test('the end of a replay is known', () => {
  const state = ready();
  feed(state, { values: { t: 120, topics: [], totals: [0, 0, 0, 0], replay: [1, 1, 0, 2] } });
  assert.deepEqual(state.replay, { part: 1, finished: true, paused: false, speed: 2 });
  feed(state, { end: { reason: 'agent ends' } });
  assert.equal(state.ended, 'agent ends');
});

test('lines are cut anywhere', () => {
  const text = '{"a":1}\n\n{"b":"ü\\n"}\n{"c":3}\n';
  for (let cut = 0; cut <= text.length; cut += 1) {
    const lines = new Lines();
    const found = [...lines.take(text.slice(0, cut)), ...lines.take(text.slice(cut))];
    assert.deepEqual(found, [{ a: 1 }, { b: 'ü\n' }, { c: 3 }]);
  }
  assert.throws(() => new Lines().take('{"a":\n'), SyntaxError);
});

test('processes have the name of their script, in texts of the agent too', () => {
  const state = ready();
  const { structure } = state;
  const local = [...GRAPH.participants[0].slice(0, 7), '/robot.slice'];
  feed(state, { graph: { ...GRAPH, participants: [local] } });
  state.takeProcesses([{ process_id: 4711, process: 'driver', script: 'lidar.py' },
    { process_id: 12, process: 'rviz2', script: null }]);
  assert.equal(state.structure, structure + 2);
  const participant = state.participants.get(1);
  assert.equal(state.processName(participant), 'lidar.py 4711');
  assert.equal(state.processName({ pid: 12, process: 'rviz2' }), 'rviz2 12');
  assert.equal(state.processName({ pid: null, process: null }), '');
  assert.equal(state.ownerOf(/** @type {any} */ ({ node: 0, participant: 1 })).name, 'lidar.py (no node)');
  assert.equal(state.withScripts('Calls of driver (4711), in process 4711, of process 47111, driver 12'),
    'Calls of lidar.py (4711), in lidar.py 4711, of process 47111, driver 12');
  // The id belongs to another program now.
  state.takeProcesses([{ process_id: 4711, process: 'bash', script: null }]);
  assert.equal(state.processName({ pid: 4711, process: 'bash' }), 'bash 4711');
  const again = state.structure;
  state.takeProcesses([]);
  assert.equal(state.structure, again);
  // A process that has ended.
  state.takeProcesses([{ process_id: 4711, process: 'driver', script: 'lidar.py' }]);
  state.takeProcesses([{ process_id: 12, process: 'rviz2', script: null }]);
  assert.equal(state.processName({ pid: 4711, process: 'driver' }), 'driver 4711');
});
