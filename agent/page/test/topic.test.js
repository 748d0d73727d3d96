import assert from 'node:assert/strict';
import { test } from 'node:test';

globalThis.document = /** @type {any} */ ({ addEventListener() {}, baseURI: 'http://x/' });
globalThis.window = /** @type {any} */ ({ addEventListener() {} });
globalThis.location = /** @type {any} */ ({ hash: '' });
const { isInMemory, liveSpan, shorten } = await import('../views/topic.js');
const { state } = await import('../store.js');

test('charts of the last ten minutes have ten minutes, whatever the agent keeps', () => {
  const times = Array.from({ length: 3600 }, (_, at) => at + 1);
  for (const [kept, onDisk, span, isLive] of /** @type {[number, boolean, number, boolean][]} */ ([
    [600, true, 600, true], [3600, true, 600, true], [60, true, 60, false], [60, false, 60, true], [0, false, 0, true]])) {
    state.open = { history_seconds: kept, keeps_history: onDisk };
    assert.deepEqual([liveSpan(), isInMemory()], [span, isLive], `${kept} ${onDisk}`);
    const columns = [[...times], [...times]];
    shorten(columns, 3600);
    assert.deepEqual(columns.map((column) => [column.length, column[0]]), Array(2).fill([span, span ? 3601 - span : undefined]));
  }
});
