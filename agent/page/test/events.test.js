import assert from 'node:assert/strict';
import { test } from 'node:test';

globalThis.document = /** @type {any} */ ({ addEventListener() {}, baseURI: 'http://x/' });
globalThis.window = /** @type {any} */ ({ addEventListener() {} });
globalThis.sessionStorage = /** @type {any} */ ({ getItem: () => null });
const { attributesText, parseEvents } = await import('../views/events.js');

test('events of a stream that has ended, without comments and lags', () => {
  const text = ': ros2probe\nretry: 2000\nid: a-0\n\nevent: ros2.x\nid: a-1\ndata: {"id":"a-1"}\n\n'
    + 'event: lagged\ndata: {"missed":3}\n\n:\nid: a-2\n\nevent:ros2.y\r\ndata:{"id":"a-3"}\r\n\r\n';
  assert.deepEqual(parseEvents(text).map((event) => event.id), ['a-1', 'a-3']);
  assert.deepEqual(parseEvents(''), []);
});

test('attributes stay text', () => {
  assert.equal(attributesText({ topic: '/a\u202eb', count: 3, list: ['<b>'] }),
    'topic: /a\\u{202e}b, count: 3, list: ["<b>"]');
});

test('a GUID with a known name becomes that name', () => {
  const names = new Map([['01', '/lidar']]);
  assert.equal(attributesText({ writer: '01', reader: '02', count: 1 }, names),
    'writer: /lidar, reader: 02, count: 1');
});
