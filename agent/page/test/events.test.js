import assert from 'node:assert/strict';
import { test } from 'node:test';

globalThis.document = /** @type {any} */ ({ addEventListener() {}, baseURI: 'http://x/' });
globalThis.window = /** @type {any} */ ({ addEventListener() {} });
globalThis.sessionStorage = /** @type {any} */ ({ getItem: () => null });
const { attributesText, namesOf, parseEvents, whyEmpty } = await import('../views/events.js');

test('events of a stream that has ended, without comments and lags', () => {
  const text = ': ros2probe\nretry: 2000\nid: a-0\n\nevent: ros2.x\nid: a-1\ndata: {"id":"a-1"}\n\n'
    + 'event: lagged\ndata: {"missed":3}\n\n:\nid: a-2\n\nevent:ros2.y\r\ndata:{"id":"a-3"}\r\n\r\n';
  assert.deepEqual(parseEvents(text).map((event) => event.id), ['a-1', 'a-3']);
  assert.deepEqual(parseEvents(''), []);
});

test('attributes stay text', () => {
  assert.equal(attributesText({ topic: '/a\u202eb', count: 3, list: ['<b>', 'x'], ros_node: '/n' }),
    'topic: /a\\u{202e}b, count: 3, list: <b>, x, node: /n');
});

test('a GUID with a known name becomes that name', () => {
  const nameOf = (/** @type {string} */ guid) => ({ '01': '/lidar' })[guid];
  assert.equal(attributesText({ writer: '01', reader: '02', first_sequence_number: 1, participants: ['01'] }, nameOf),
    'writer: /lidar, reader: 02, first sequence number: 1, participants: /lidar');
});

test('departed endpoints and participants have the names that events carry', () => {
  const event = (/** @type {string} */ name, /** @type {any} */ attributes) => /** @type {any} */ ({ name, attributes });
  const nameOf = namesOf([
    event('ros2.node.discovered', { ros_node: '/lidar', participant: 'aa.1c1' }),
    event('ros2.node.discovered', { ros_node: '/a', participant: 'bb.1c1' }),
    event('ros2.node.lost', { ros_node: '/b', participant: 'bb.1c1' }),
    event('ros2.message.lost', { ros_node: '/b', writer: 'bb.103' }),
    event('ros2.endpoint.lost', { endpoint: 'cc.103', topic: '/points', role: 'writer' }),
    event('ros2.participant.lost', { participant: 'dd.1c1', process: 'rviz2', host: 'desk' }),
  ], new Map([['ee.103', '/now']]));
  assert.deepEqual(['aa.1c1', 'aa.103', 'bb.103', 'bb.203', 'cc.103', 'dd.1c1', 'ee.103', 'ff.103', 'text'].map(nameOf),
    ['/lidar', '/lidar', '/b', 'participant of /a and others', 'writer of /points', 'rviz2 on desk', '/now',
      undefined, undefined]);
});

test('a time without events is not one that is being read, or whose events are filtered', () => {
  assert.equal(whyEmpty(true, false, 0), 'Reading the history …');
  assert.equal(whyEmpty(true, true, 0), 'No event in this time.');
  assert.equal(whyEmpty(true, true, 3), 'No event matches.');
  assert.equal(whyEmpty(false, false, 0), 'No event yet.');
});
