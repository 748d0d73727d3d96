import assert from 'node:assert/strict';
import { readFileSync } from 'node:fs';
import { test } from 'node:test';
import * as format from '../format.js';

test('rates and sizes keep three digits and a prefix', () => {
  for (const [value, text] of [
    [0, '0 Hz'], [9.98, '9.98 Hz'], [10, '10 Hz'], [99.96, '100.0 Hz'], [999.4, '999 Hz'],
    [999.6, '1.00 kHz'], [1234, '1.23 kHz'], [0.004, '0.00 Hz'],
  ]) {
    assert.equal(format.rate(/** @type {number} */ (value)), text);
  }
  assert.equal(format.bytes(512), '512 B');
  assert.equal(format.bytes(54e6), '54.0 MB');
  assert.equal(format.bandwidth(1500), '1.50 kB/s');
  assert.equal(format.bytes(3e17), '300000 TB');
});

test('an absent value is not zero', () => {
  for (const print of [format.rate, format.bytes, format.bandwidth, format.count, format.duration,
    format.percent, format.clock, format.date, format.when]) {
    assert.equal(print(null), format.NOTHING);
    assert.equal(print(undefined), format.NOTHING);
    assert.equal(print(NaN), format.NOTHING);
  }
});

test('durations change their unit where a person would', () => {
  for (const [value, text] of [
    [0, '0 s'], [0.00035, '350 µs'], [0.0009996, '1.00 ms'], [0.00125, '1.25 ms'],
    [0.9996, '1.00 s'], [4, '4.00 s'], [59.96, '1 min'], [185, '3 min 5 s'], [3600, '1 h'],
    [7500, '2 h 5 min'], [273600, '3 d 4 h'], [-0.002, '-2.00 ms'],
  ]) {
    assert.equal(format.duration(/** @type {number} */ (value)), text);
  }
});

test('a loss never prints as none, and all but one never as all', () => {
  assert.equal(format.percent(0), '0 %');
  assert.equal(format.percent(0.000001), '<0.01 %');
  assert.equal(format.percent(0.0123), '1.23 %');
  assert.equal(format.percent(0.999999), '>99.99 %');
  assert.equal(format.percent(1), '100.0 %');
});

test('counts and plurals', () => {
  assert.equal(format.count(1234567), '1,234,567');
  assert.equal(format.count(999), '999');
  assert.equal(format.several(1, 'topic'), '1 topic');
  assert.equal(format.several(2000, 'entry', 'entries'), '2,000 entries');
});

test('hostile names stay text, with what cannot be seen shown', () => {
  assert.equal(format.visible('/a<b>&"\''), '/a<b>&"\'');
  assert.equal(format.visible('/rtl\u202egpj'), '/rtl\\u{202e}gpj');
  assert.equal(format.visible('/zero\u200bwidth\ufeff'), '/zero\\u{200b}width\\u{feff}');
  assert.equal(format.visible('/nul\0\n\t\x1b[31m'), '/nul\\u{0}\\n\\t\\u{1b}[31m');
  assert.equal(format.visible('/filler\u3164\u2800\u00a0'), '/filler\\u{3164}\\u{2800}\\u{a0}');
  assert.equal(format.visible('\ud800'), '\\u{d800}');
  assert.equal(format.visible('\u{e0101}\u{1f600}'), '\\u{e0101}\u{1f600}');
  assert.equal(format.visible('/ü/日本/שלום'), '/ü/日本/שלום');
  // A text that looks like an escape is distinguishable from one.
  assert.notEqual(format.visible('\\u{202e}'), format.visible('\u202e'));
  assert.equal(format.visible(null), '');
});

test('long names keep both ends and never split a character', () => {
  const name = `/${'x'.repeat(254)}\u{1f600}`;
  const short = format.shortened(name, 21);
  assert.equal(Array.from(short).length, 21);
  assert.ok(short.startsWith('/xxx') && short.endsWith('\u{1f600}'));
  assert.equal(format.shortened('/short', 21), '/short');
  assert.equal(format.shortened('/short', 1), '…');
});

test('a time of another day has its date', () => {
  const at = (/** @type {number} */ day, /** @type {number} */ hour) => new Date(2026, 6, day, hour, 5, 9).getTime() / 1000;
  assert.equal(format.when(at(2, 0), at(2, 23)), '00:05:09');
  assert.equal(format.when(at(1, 23), at(2, 0)), '2026-07-01 23:05:09');
  assert.equal(format.when(at(3, 0), at(2, 23)), '2026-07-03 00:05:09');
});

test('an age is in whole seconds', () => {
  for (const [seconds, text] of [[0.2, '0 s'], [3.16, '3 s'], [-1, '0 s'], [59.6, '1 min'],
    [125, '2 min 5 s'], [null, '–']]) {
    assert.equal(format.age(seconds), text);
  }
});

test('the calls of a service are one line', () => {
  assert.equal(format.calls(null), '');
  assert.equal(format.calls({ requests: 1, hanging: 0 }), '1 call');
  const all = { requests: 3, hanging: 1, latency_p50_seconds: 0.00422, latency_p99_seconds: 0.0075 };
  assert.equal(format.calls(all), '3 calls, p50 4.22 ms, p99 7.50 ms, 1 hanging');
});

test('the last message of a publisher is kept, or the reason is given', () => {
  assert.equal(format.lastMessage({ state: 'kept', bytes: 3000 }),
    'kept for recordings and viewers (3.00 kB)');
  assert.equal(format.lastMessage({ state: 'too_large', bytes: 54e6 }),
    'too large to be kept (54.0 MB)');
  assert.equal(format.lastMessage({ state: 'unseen', bytes: null }), 'not seen by the agent');
  assert.equal(format.lastMessage({ state: 'of a newer agent', bytes: null }), 'of a newer agent');
});

test('every event of the documentation has words', () => {
  const rows = readFileSync(new URL('../../../docs/events.md', import.meta.url), 'utf8')
    .matchAll(/^\| `(ros2[a-z._]+)` \|/gm);
  const names = [...rows].map(([, name]) => name);
  assert.ok(names.length > 20);
  assert.deepEqual(names.filter((name) => !format.EVENTS[name]), []);
  assert.equal(format.eventWords({ name: 'ros2.graph.diagnosed', attributes: { diagnosis: 'slow_callback' } }),
    'finding: slow callback');
  assert.equal(format.eventWords({ name: 'ros2.new.thing_done', attributes: {} }), 'new thing done');
});
