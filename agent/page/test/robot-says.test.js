import assert from 'node:assert/strict';
import { test } from 'node:test';

globalThis.document = /** @type {any} */ ({ addEventListener() {}, baseURI: 'http://x/' });
globalThis.window = /** @type {any} */ ({ addEventListener() {} });
globalThis.location = /** @type {any} */ ({ hash: '' });
const { changesOf, extrapolation, isHeard, jumpsOf, jumpWords, linesOf, Minutes, partsOf, Rates, stampAge } = await import('../views/robot.js');

const status = (/** @type {string} */ name, /** @type {string} */ level, topic = '/diagnostics') =>
  ({ domain_id: 0, topic, name, level, hardware_id: '', message: '', values: [] });

/** @param {any[]} statuses @param {string[]} toggled */
const lines = (statuses, ...toggled) => linesOf(partsOf(statuses), new Set(toggled)).map((line) =>
  `${' '.repeat(line.depth)}${line.closed ? '+' : ''}${line.name} ${line.level}`);

test('diagnostics are a tree with the worst level of the parts below', () => {
  const all = [status('/Robot/Sensors/lidar', 'ok'), status('/Robot/Sensors/imu', 'stale'),
    status('/Robot/Base', 'ok'), status('/Robot/Base/left', 'ok'), status('/Robot/Base/right', 'ok'),
    status('battery: charge', 'error'), status('/Robot/Sensors/camera', 'warn')];
  assert.deepEqual(lines(all), ['battery: charge error', 'Robot stale', ' Sensors stale', '  imu stale',
    '  camera warn', '  lidar ok', ' +Base ok']);
  assert.deepEqual(lines(all, '/Robot/Base', '/Robot/Sensors').slice(2), [' +Sensors stale', ' Base ok',
    '  left ok', '  right ok']);
  // A part that contains only one is drawn with it, and topics are parts if there are several.
  assert.deepEqual(lines([status('a/b/c', 'ok')]), ['a/b/c ok']);
  assert.deepEqual(lines([status('a/b', 'warn'), status('c', 'ok', '/diagnostics_agg')]),
    ['/diagnostics/a/b warn', '/diagnostics_agg/c ok']);
  // Two statuses of one name, such as of two hardware ids, are two parts.
  assert.deepEqual(lines([status('a', 'ok'), status('a', 'error')]), ['a error', 'a ok']);
});

test('changes of a level are those of the same status', () => {
  const event = (/** @type {any} */ attributes) => /** @type {any} */ ({
    name: 'ros2.robot.diagnostic_changed', attributes: { domain_id: 0, topic: '/diagnostics', ...attributes } });
  const events = [event({ name: 'a', to: 'warn' }), event({ name: 'b', to: 'ok' }),
    event({ name: 'a', to: 'error' }), event({ name: 'a', hardware_id: '7' })];
  assert.deepEqual(changesOf(events, status('a', 'error')).map((each) => each.attributes.to), ['error', 'warn']);
});

test('jumps of transforms are counted by edge, and stamps have an age', () => {
  const jump = (/** @type {string} */ child, name = 'ros2.robot.transform_jumped') => /** @type {any} */ ({
    name, attributes: { domain_id: 0, parent: 'map', child } });
  assert.deepEqual([...jumpsOf([jump('odom'), jump('odom'), jump('x', 'ros2.x')])], [['0  odom', 2]]);
  const edge = (/** @type {number} */ arrival, isStatic = false) => ({ is_static: isStatic,
    timestamp_seconds: arrival, stamp_sec: 100, stamp_nanosec: 500_000_000 });
  assert.equal(stampAge(edge(100.75)), 0.25);
  assert.equal(stampAge(edge(100.25)), -0.25);
  assert.equal(stampAge(edge(100.75, true)), null);
  assert.equal(stampAge(edge(1.7e9)), null);
  assert.equal(jumpWords({ translation: 12, rotation: 0, time: 2 }), '12 position, 2 time');
  assert.equal(jumpWords({ translation: 0, rotation: 0, time: 0 }), '0');
  assert.equal(jumpWords(undefined), '–');
});

test('a lookup for the present exceeds the latest transform by its age and the time to the next one', () => {
  const edge = { is_static: false, timestamp_seconds: 100.75, stamp_sec: 100, stamp_nanosec: 500_000_000,
    longest_interval_seconds: 0.5 };
  assert.equal(extrapolation(edge, 101), 0.75);
  // It is silent for longer than usual.
  assert.equal(extrapolation(edge, 102.75), 2.25);
  // A stamp ahead of its arrival covers a part of the interval, or all of it.
  assert.equal(extrapolation({ ...edge, stamp_nanosec: 1_000_000_000 }, 101), 0.25);
  assert.equal(extrapolation({ ...edge, stamp_sec: 102 }, 101), 0);
  assert.equal(extrapolation({ ...edge, is_static: true }, 101), null);
  assert.equal(extrapolation({ ...edge, timestamp_seconds: 1.7e9 }, 1.7e9), null);
});

test('messages of logs are counted by minute, first as kept, then as the counts grow', () => {
  const answer = (/** @type {number} */ time, /** @type {number} */ errors, /** @type {number} */ infos,
    /** @type {[number, string][]} */ messages = []) => ({ timestamp_seconds: time,
    nodes: [{ levels: [{ level: 'error', messages: errors }, { level: 'info', messages: infos }] }],
    messages: messages.map(([at, level]) => ({ timestamp_seconds: at, level })) });
  const minutes = new Minutes();
  minutes.take(answer(6000, 9, 9), false);
  assert.equal(minutes.totals, null, 'the first answer must have all messages');
  minutes.take(answer(6001, 1, 2, [[5900, 'info'], [5970, 'fatal'], [6001, 'info']]), true);
  minutes.take(answer(6003, 3, 2), false);
  minutes.take(answer(6003, 99, 2), false);
  assert.deepEqual(minutes.bars().slice(-3), [[0, 0, 1], [1, 0, 0], [2, 0, 1]]);
  assert.equal(minutes.since, null);
  // After a gap, earlier minutes are unknown.
  minutes.take(answer(6300, 50, 2), false);
  assert.deepEqual(minutes.bars().slice(-3), [null, null, [0, 0, 0]]);
  assert.equal(minutes.since, 6300);
});

test('rates are averages of the last half minute', () => {
  const rates = new Rates();
  const take = (/** @type {number} */ time, /** @type {number} */ requests) =>
    rates.take(time, new Map([['0 /s', requests]]));
  take(100, 5);
  assert.equal(rates.of('0 /s'), null);
  take(102, 9);
  take(102, 9);
  assert.equal(rates.of('0 /s'), 2);
  for (let time = 104; time <= 140; time += 2) take(time, 9);
  assert.equal(rates.of('0 /s'), 0);
  assert.equal(rates.of('0 /other'), null);
});

test('logs of other levels than the chosen one are not no logs', () => {
  const node = (/** @type {number[]} */ ...numbers) => ({ levels: numbers.map((messages) => ({ messages })) });
  assert.ok(isHeard([node(0), node(0, 3)]));
  assert.ok(!isHeard([node(0), node()]));
});
