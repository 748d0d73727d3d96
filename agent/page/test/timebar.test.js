import assert from 'node:assert/strict';
import { test } from 'node:test';
import { address, keepTime, parse } from '../router.js';

// The module reads the address of the page.
Object.assign(globalThis, {
  location: { hash: '' },
  document: { addEventListener() {}, visibilityState: 'visible' },
  window: { addEventListener() {} },
});
const { againAfter, eventBefore, eventsOf, inWords, marksOf, showTime, timeOf } = await import(
  '../timebar.js');

test('the time of an address is bounded', () => {
  assert.deepEqual(timeOf({}), { span: 600, at: null });
  assert.deepEqual(timeOf({ span: '3600', at: '1790000000' }), { span: 3600, at: 1790000000 });
  for (const [span, at] of [['-1', '-1'], ['x', 'x'], ['1e99', '1e99'], ['', '']]) {
    assert.deepEqual(timeOf({ span, at }), { span: 600, at: null });
  }
});

test('every address keeps the time until it is given up', () => {
  keepTime({ span: '3600', at: '1790000000', filter: 'x' });
  assert.equal(address('topics', '/a'), '#/topics/%2Fa?span=3600&at=1790000000');
  assert.equal(address('topics', null, { at: null, sort: 'name' }), '#/topics?span=3600&sort=name');
  keepTime({});
  assert.equal(address('topics'), '#/topics');
});

test('a change of the time keeps the rest of the address', () => {
  const hash = () => globalThis.location.hash;
  globalThis.location.hash = '#/topics/%2Fa?domain=0';
  showTime({ span: 3600 });
  assert.deepEqual(parse(hash())?.query, { domain: '0', span: '3600' });
  showTime({ at: 1790000000.4 });
  assert.deepEqual(parse(hash())?.query, { domain: '0', span: '3600', at: '1790000000' });
  showTime({ at: null, span: 600 });
  assert.equal(hash(), '#/topics/%2Fa?domain=0');
});

test('a long time is requested less often, and one of the past once', () => {
  const seconds = [60, 3600, 86400, 604800].map((span) => againAfter({ span, at: null }) / 1000);
  assert.deepEqual(seconds, [10, 10, 240, 1680]);
  assert.equal(againAfter({ span: 604800, at: 1790000000 }), 0);
});

test('a time is named', () => {
  assert.equal(inWords({ span: 3600, at: null }), 'The last hour');
  assert.match(inWords({ span: 60, at: 1790000000 }), / to /);
});

test('the events of a topic mark its charts, and warnings about no topic', () => {
  const event = (/** @type {string} */ severity, /** @type {string|undefined} */ topic) => /** @type {any} */ (
    { severity, time: '1970-01-01T00:00:05Z', attributes: { topic } });
  const all = [event('INFO', '/a'), event('WARN', '/b'), event('ERROR', undefined), event('INFO', undefined)];
  const own = eventsOf(all, '/a');
  assert.deepEqual(own, [all[0], all[2]]);
  assert.deepEqual(marksOf(own), [{ time: 5, severity: 'INFO' }, { time: 5, severity: 'ERROR' }]);
});

test('the event before a time is no arrival of a participant or endpoint', () => {
  const event = (/** @type {string} */ name, /** @type {number} */ seconds) => /** @type {any} */ ({
    id: String(seconds), name, severity: 'INFO', time: new Date(seconds * 1000).toISOString(), attributes: {},
  });
  const events = [event('ros2.message.lost', 10), event('ros2.endpoint.discovered', 12), event('ros2.topic.x', 15)];
  assert.equal(eventBefore(events, 20), 15);
  assert.equal(eventBefore(events, 15.5), 10);
  assert.equal(eventBefore(events, 10), null);
});
