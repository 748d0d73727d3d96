import assert from 'node:assert/strict';
import { test } from 'node:test';
import { callsOf, causes, closest, missing, timeline, WIDTH, worst } from '../late.js';

const why = {
  observed: 'events', reason: null,
  causes: [{ words: 'chromium ran instead', late_calls: 34, longest_seconds: 0.105,
    remedy: 'limit the other process' }],
  callbacks: [
    { process_id: 42, node: '/filter', trigger: { kind: 'subscription', name: '/points' },
      calls: 600, late_calls: 14,
      examples: [{ timestamp_seconds: 1, duration_seconds: 0.15, wait_seconds: 0.05,
        words: 'chromium ran instead',
        parts: [{ stage: 'wait', cause: 'other_callback', seconds: 0.05 },
          { stage: 'callback', cause: 'cpu', seconds: 0.0499 },
          { stage: 'callback', cause: 'stolen', seconds: 0.0001 },
          { stage: 'callback', cause: 'runnable', seconds: 0.1 }] }] },
    { process_id: 43, node: null, trigger: { kind: 'timer' }, calls: null, late_calls: 1,
      examples: [] },
  ],
};

test('the causes are rows with what helps', () => {
  assert.deepEqual(causes(why)[0].slice(0, 2), ['chromium ran instead', '34']);
  assert.deepEqual(causes(null), []);
});

test('the parts of the worst call fill its bar, and small ones are not named', () => {
  const [call, ...others] = worst(why);
  assert.equal(others.length, 0);
  assert.equal(call.late, '14 of 600');
  const drawn = call.parts.reduce((sum, part) => sum + part.width, 0);
  assert.ok(Math.abs(drawn - WIDTH) < 1e-9);
  assert.equal(call.parts[1].from, call.parts[0].width);
  assert.match(call.text, /^other callback .*, cpu .*, runnable /);
  assert.doesNotMatch(call.text, /stolen/);
});

test('what is not observed is said', () => {
  assert.equal(missing(null), '');
  assert.equal(missing(why), '');
  assert.match(missing({ observed: 'off', reason: null }), /capture\.late is off/);
  assert.equal(missing({ observed: 'sums', reason: 'needs Linux 5.15' }), 'needs Linux 5.15');
});

const moment = (timestamp_seconds, cause, total_seconds = 0.02) => ({ timestamp_seconds, cause, total_seconds,
  stage: 'callback', words: `because of ${cause}` });
const late = {
  timestamp_seconds: 1003,
  callbacks: [{ ...why.callbacks[0], history: [moment(409, 'lock'), moment(411, 'cpu'),
    moment(995, 'runnable', 0.2), moment(996, 'lock'), moment(1001, 'lock')],
  examples: [{ ...why.callbacks[0].examples[0], timestamp_seconds: 995 }] },
  { ...why.callbacks[1], history: [moment(997, 'lock', 0.3)] }],
};

test('late calls are counted in periods of ten seconds by cause, those before ten minutes left out', () => {
  const { bars, colours, from, end } = timeline(late);
  assert.deepEqual([from, end], [410, 1010]);
  assert.deepEqual(bars.map((bar) => [bar.begin, bar.list.length]), [[410, 1], [990, 3], [1000, 1]]);
  assert.deepEqual(colours.map(({ cause, calls }) => [cause, calls])[0], ['lock', 3]);
  const [, most] = bars;
  assert.deepEqual(most.parts.map((part) => part.from), [0, most.parts[0].height]);
  const height = most.parts.reduce((sum, part) => sum + part.height, 0);
  assert.ok(Math.abs(height - 1) < 1e-9, 'the period with the most calls has the full height');
  assert.match(most.label, /: 3 late calls, up to 300 ms: lock 2, runnable 1$/);
  assert.deepEqual(timeline(null).bars, []);
});

test('the period closest to a picked time has its calls, the longest first, with known parts', () => {
  const shown = timeline(late);
  assert.equal(closest(shown, 985).begin, 990);
  assert.equal(closest(shown, 1019).begin, 1000);
  assert.equal(closest(shown, 700), null);
  const calls = callsOf(closest(shown, 992));
  assert.deepEqual(calls.map((call) => call.who), ['process 43', '/filter', '/filter']);
  assert.deepEqual(calls.map((call) => call.example != null), [false, true, false]);
  assert.equal(calls[0].words, 'because of lock');
});

test('each cause keeps its colour whatever its rank', () => {
  const one = timeline({ timestamp_seconds: 5, callbacks: [{ history: [moment(1, 'cpu'), moment(2, 'cpu'),
    moment(3, 'lock'), moment(4, 'sleep'), moment(4, 'queue'), moment(4, 'new_cause')] }] });
  const colours = Object.fromEntries(one.colours.map(({ cause, colour }) => [cause, colour]));
  assert.deepEqual(colours, { cpu: '--line-2', lock: '--line-3', sleep: '--line-3', queue: '--line-4',
    new_cause: '--dim' });
  const [bar] = one.bars;
  assert.equal(new Set(bar.parts.map((part) => part.cause)).size, 5);
});
