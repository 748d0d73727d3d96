import assert from 'node:assert/strict';
import { test } from 'node:test';
import { causes, missing, WIDTH, worst } from '../late.js';

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
