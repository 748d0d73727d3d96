import assert from 'node:assert/strict';
import { beforeEach, test } from 'node:test';

globalThis.document = /** @type {any} */ ({ addEventListener() {}, baseURI: 'http://x/' });
globalThis.window = /** @type {any} */ ({ addEventListener() {} });
globalThis.location = /** @type {any} */ ({ hash: '' });
globalThis.sessionStorage = /** @type {any} */ ({ getItem: () => null });
const { Measure, watch } = await import('../views/topics.js');
const { state, stream } = await import('../store.js');

/** Requests, and the codes of problems that answer them. @type {string[]} */
let asked = [];
/** @type {string[]} */
let problems = [];
globalThis.fetch = /** @type {any} */ (async (/** @type {string} */ address, /** @type {any} */ { method }) => {
  asked.push(`${method} ${address.replace('http://x/', '')}`);
  const code = problems.shift();
  return code ? { ok: false, status: 404, json: async () => ({ code }) } : { ok: true, status: 204 };
});

const topic = (/** @type {any} */ more) => /** @type {any} */ ({ id: 1, domain: 3, name: '/chatter', ddsName: 'rt/chatter',
  kind: 'topic', measured: true, watched: 3, ...more });

beforeEach(() => {
  [asked, problems] = [[], []];
});

test('a topic is measured by a watch of its domain', async () => {
  await watch(topic({ watched: 0 }));
  await watch(topic());
  assert.deepEqual(asked, ['POST watch/%2Fchatter?domain_id=3', 'DELETE watch/%2Fchatter?domain_id=3']);
});

test('a watch of all domains is switched off too', async () => {
  problems = ['no-such-watch'];
  await watch(topic());
  assert.deepEqual(asked, ['DELETE watch/%2Fchatter?domain_id=3', 'DELETE watch/%2Fchatter']);
  [asked, problems] = [[], ['watch-given']];
  await assert.rejects(watch(topic()), { code: 'watch-given' });
  assert.equal(asked.length, 1);
});

test('the switch does nothing to the present while the past is shown', () => {
  state.open = { access: 'watch' };
  const isDisabled = () => Measure({ topic: topic() }).props.disabled;
  assert.equal(isDisabled(), false);
  stream.at = 5;
  assert.equal(isDisabled(), true);
  stream.at = null;
});
