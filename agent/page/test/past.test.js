import assert from 'node:assert/strict';
import { test } from 'node:test';

globalThis.document = /** @type {any} */ ({ addEventListener() {}, baseURI: 'http://x/' });
globalThis.sessionStorage = /** @type {any} */ ({ getItem: () => null });
globalThis.window = /** @type {any} */ ({ addEventListener() {} });
globalThis.location = /** @type {any} */ ({ hash: '' });
const { pastOf } = await import('../past.js');

/** @param {string} path @param {any} answer */
const of = (path, answer) => {
  const past = pastOf(path, 1000);
  assert.ok(past, path);
  return past.part(structuredClone(answer));
};

test('a request of the present has its counterpart of the past, or none', () => {
  for (const [path, expected] of [
    ['parameters', 'history/moment/parameters?at=1000'],
    ['chains?calls=true&from=%2Fpoints', 'history/moment/chains?at=1000'],
    ['logs?limit=300&level=warn', 'history/moment/logs?at=1000'],
    ['topics/%2Fimu?domain_id=0', 'history/moment/topics?at=1000&name=%2Fimu&domain_id=0'],
    ['topics/a%26at%3D1', 'history/moment/topics?at=1000&name=a%26at%3D1'],
    ['nodes/robot%2Flidar', 'history/moment/nodes?at=1000&name=robot%2Flidar'],
    ['processes', 'history/processes?from=880&to=1000'],
    ['recordings', null], ['doctor', null], ['snapshots', null],
    ['why?from=a&history=true', null], ['inside?name=%2Fimu', null],
    ['topics/%2Fimu/definition?domain_id=0', null], ['chains/x', null],
  ]) assert.equal(pastOf(String(path), 1000)?.path ?? null, expected, String(path));
});

test('logs of the past are filtered as the agent filters those of the present', () => {
  const answer = { nodes: [], messages: ['debug', 'warn', 'info', 'fatal', 'error'].map((level, at) => ({ level, at })) };
  const levels = (/** @type {string} */ path) => of(path, answer).messages.map((/** @type {any} */ each) => each.level);
  assert.deepEqual(levels('logs?limit=1000'), ['debug', 'warn', 'info', 'fatal', 'error']);
  assert.deepEqual(levels('logs?limit=2'), ['fatal', 'error']);
  assert.deepEqual(levels('logs?limit=2&level=warn'), ['fatal', 'error']);
  assert.deepEqual(levels('logs?limit=300&level=error'), ['fatal', 'error']);
});

test('a topic or node of the past is the one of its name, or the request fails as in the present', () => {
  const topics = { topics: [{ name: '/go', kind: 'service_request' }, { name: '/go', kind: 'topic', types: ['a'] },
    { name: '/go', kind: 'service_reply' }] };
  assert.deepEqual(of('topics/%2Fgo?domain_id=0', topics), topics.topics[1]);
  assert.equal(of('topics/%2Fgo', { topics: topics.topics.slice(2) }).kind, 'service_reply');
  assert.throws(() => of('topics/%2Fother', { topics: [] }), { status: 404 });
  const named = (/** @type {string} */ name) => ({ name, types: [] });
  const nodes = { nodes: [{ domain_id: 0, name: '/robot/lidar', publishers: [named('/points'), named('/go/_action/status')],
    subscriptions: [], services: [named('/_hidden')], clients: [] }] };
  const node = of('nodes/robot%2Flidar?domain_id=0', nodes);
  assert.deepEqual([node.publishers.map((/** @type {any} */ each) => each.name), node.services], [['/points'], []]);
});

test('hidden names of the past are left out unless they are requested', () => {
  const services = { services: [{ domain_id: 0, name: '/go', hidden: false }, { domain_id: 0, name: '/_go', hidden: true },
    { domain_id: 1, name: '/go', hidden: false }] };
  assert.equal(of('services', services).services.length, 2);
  assert.equal(of('services?hidden=true', services).services.length, 3);
  assert.equal(of('services?domain_id=1&hidden=true', services).services.length, 1);
  assert.deepEqual(of('actions', { actions: [{ name: '/a/_b' }, { name: '/a/b' }] }).actions, [{ name: '/a/b' }]);
  const graph = { nodes: [{ id: 'a', name: '/a' }, { id: 'b', name: '/_b' }], edges: [{ source: 'a', target: 'b' }] };
  assert.deepEqual(of('graph', graph), { nodes: [{ id: 'a', name: '/a' }], edges: [] });
  assert.deepEqual(of('graph?hidden=true', graph), graph);
});

test('processes of the past have the usage of their last row', () => {
  const answer = { processes: [{ process_id: 7, process: 'robot.py', times: [990, 1000], cpu_cores: [0.1, 0.2], memory_bytes: [1, 2] },
    { process_id: 8, process: 'gone', times: [], cpu_cores: [], memory_bytes: [] }] };
  assert.deepEqual(of('processes', answer).processes,
    [{ process_id: 7, process: 'robot.py', cpu_cores: 0.2, memory_bytes: 2 }]);
});
