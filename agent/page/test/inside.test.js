import assert from 'node:assert/strict';
import { test } from 'node:test';
import { tables, waiting } from '../inside.js';

const owner = { process_id: 42, node: '/nav' };

test('each kind of entity has a table, and empty ones are left out', () => {
  const shown = tables({
    publishers: [{ ...owner, topic: '/scan', published_messages: 1200,
      within_process_messages: 0, rate_hertz: 10, interval: null }],
    subscriptions: [],
    callbacks: [
      { ...owner, node: null, trigger: { kind: 'timer', name: null, period_seconds: 0.05 },
        calls: 7, busy_ratio: 0.4, rate_hertz: 20,
        states_ratio: { cpu: 0.204, throttled: 0, runnable: 0.796, blocked: 0 },
        duration: { p50_seconds: 0.012, p99_seconds: 0.12 }, wait: null },
      { ...owner, trigger: { kind: 'service', name: '/plan' }, calls: 1 },
      { ...owner, trigger: { kind: 'intra_process', name: null }, calls: 1 },
    ],
  });
  assert.deepEqual(shown.map(([title]) => title), ['Publishers', 'Callbacks']);
  for (const [title, head, rows] of shown) {
    for (const row of rows) assert.equal(row.length, head.length, title);
  }
  const [publishers, callbacks] = shown.map(([, , rows]) => rows);
  assert.deepEqual(publishers[0].slice(0, 2), ['/scan', '/nav']);
  assert.match(publishers[0][4], /^10/);
  assert.match(callbacks[0][0], /^timer 50/);
  assert.equal(callbacks[0][1], 'process 42');
  assert.deepEqual(callbacks.map((row) => row[8]), ['cpu 20% runnable 80%', '', '']);
  assert.deepEqual(callbacks.map((row) => row[0]).slice(1), ['service /plan', 'intra_process']);
});

test('an agent without the source has no table', () => {
  assert.deepEqual(tables({}), []);
});

test('while nothing is shown the reason is', () => {
  assert.match(waiting(null), /begins/);
  assert.match(waiting({ mode: 'off' }), /capture\.inside is off/);
  assert.equal(waiting({ mode: 'auto', reason: 'no broker' }), 'no broker');
  assert.match(waiting({ mode: 'auto', reason: null }), /No call/);
});
