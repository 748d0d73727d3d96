import assert from 'node:assert/strict';
import { test } from 'node:test';

globalThis.document = /** @type {any} */ ({ addEventListener() {}, baseURI: 'http://x/' });
globalThis.window = /** @type {any} */ ({ addEventListener() {} });
globalThis.location = /** @type {any} */ ({ hash: '' });
const { Endpoints, Offered } = await import('../qos.js');

test('the row of a publisher has its figures, of the present or of a moment in the past', () => {
  const figures = { rate_hertz: 49.9, bandwidth_bytes_per_second: 12000, loss_ratio: 0.031 };
  const shown = (/** @type {any} */ more) => JSON.stringify(Endpoints({ topic: /** @type {any} */ ({ publishers: [] }),
    details: { subscriptions: [], publishers: [{ guid: 'g', backends: [], ...more }] } }));
  for (const more of [{ measurement: figures }, { measurement: null, past_figures: figures }]) {
    for (const part of ['49.9 Hz', '12.0 kB/s', '3.10 %']) assert.ok(shown(more).includes(part), shown(more));
  }
  assert.equal(shown({ measurement: null }).match(/"–"/g)?.length, 3);
});

test('the quality of service of a publisher has the strength of its exclusive ownership', () => {
  const shown = (/** @type {any} */ ownership) => {
    const publishers = [{ guid: 'g', qos: { partitions: [], ...ownership } }];
    return JSON.stringify(Offered({ details: { diagnoses: [], subscriptions: [], publishers } }));
  };
  assert.ok(shown({ ownership: 'EXCLUSIVE', ownership_strength: 8 }).includes('"EXCLUSIVE (8)"'));
  assert.ok(shown({ ownership: 'SHARED', ownership_strength: null }).includes('"SHARED"'));
});
