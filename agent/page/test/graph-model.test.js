import assert from 'node:assert/strict';
import { test } from 'node:test';
import { build, differences, dot, isHub, markOf, nameOf } from '../graph-model.js';
import { layout } from '../layout.js';
import { State } from '../state.js';

/** @type {import('../graph-model.js').Options} */
const ALL = {
  mode: 'both', hubs: false, hidden: false, boxes: 'none', toggled: new Set(), focus: null, hops: 1,
};

/**
 * @param {string[]} nodes
 * @param {[string, string[], string[]][]} topics name, publishers, subscribers
 */
function robot(nodes, topics) {
  const state = new State();
  const id = new Map(nodes.map((name, at) => [name, at + 1]));
  state.apply({ open: { run: 'r', flags: [], passages: ['network'], access: 'read' } });
  const ends = (/** @type {1|2} */ side) => topics.flatMap((topic, at) => topic[side].map(
    (node, place) => [at + 1, id.get(node) ?? 0, 1 + ((id.get(node) ?? 1) % 3),
      `${side}.${at}.${place}`, 1, 'RELIABLE', 'VOLATILE']));
  state.apply({ graph: {
    participants: [1, 2, 3].map((at) => [at, `guid${at}`, 0, 'v', at === 3 ? 'b' : 'a', at, `p${at}`,
      null]),
    nodes: nodes.map((name, at) => [at + 1, 0, name, [1 + ((at + 1) % 3)],
      name.includes('/_') ? 1 : 0]),
    topics: topics.map(([name], at) => [at + 1, 0, name, `rt${name}`, 'topic', ['T'],
      name.includes('/_') ? 1 : 0, 0, 0, 0]),
    publishers: ends(1),
    subscriptions: ends(2),
  } });
  return state;
}

const CHAIN = () => robot(['/a', '/b', '/c', '/d'], [
  ['/ab', ['/a'], ['/b']], ['/bc', ['/b'], ['/c']], ['/cd', ['/c'], ['/d']],
  ['/rosout', ['/a', '/b', '/c', '/d'], []], ['/ns/tf', ['/a'], ['/d']],
]);

/** @param {import('../graph-model.js').Graph} graph */
const names = (graph) => graph.vertices.map((vertex) => vertex.name).sort();

test('hubs are folded until they are asked for', () => {
  assert.ok(isHub('/robot1/tf') && isHub('/rosout') && !isHub('/tfx') && !isHub('/clock/x'));
  const graph = build(CHAIN(), ALL);
  assert.deepEqual(names(graph), ['/a', '/ab', '/b', '/bc', '/c', '/cd', '/d']);
  assert.equal(graph.folded, 2);
  assert.ok(names(build(CHAIN(), { ...ALL, hubs: true })).includes('/rosout'));
});

test('a hub that is the focus is shown', () => {
  const graph = build(CHAIN(), { ...ALL, focus: 'topic:0:/rosout' });
  assert.deepEqual(names(graph), ['/a', '/b', '/c', '/d', '/rosout']);
});

test('a hop leads from node to node, and from a topic to its nodes', () => {
  const one = build(CHAIN(), { ...ALL, focus: 'node:0:/b' });
  assert.deepEqual(names(one), ['/a', '/ab', '/b', '/bc', '/c']);
  const topic = build(CHAIN(), { ...ALL, focus: 'topic:0:/bc' });
  assert.deepEqual(names(topic), ['/b', '/bc', '/c']);
  const two = build(CHAIN(), { ...ALL, focus: 'topic:0:/bc', hops: 2 });
  assert.deepEqual(names(two), ['/a', '/ab', '/b', '/bc', '/c', '/cd', '/d']);
  assert.equal(names(build(CHAIN(), { ...ALL, focus: 'node:0:/gone' })).length, 7);
});

test('nodes alone have one edge a pair, with all its topics', () => {
  const state = robot(['/a', '/b'], [
    ['/x', ['/a'], ['/b']], ['/y', ['/a'], ['/b', '/a']], ['/z', ['/b'], []],
  ]);
  const graph = build(state, { ...ALL, mode: 'nodes' });
  assert.deepEqual(names(graph), ['/a', '/b']);
  assert.equal(graph.edges.length, 1);
  assert.deepEqual(graph.edges[0].topics, [1, 2]);
});

test('hidden nodes and topics are shown on request', () => {
  const state = robot(['/a', '/_cli'], [['/x', ['/a'], ['/_cli']], ['/_y', ['/a'], []]]);
  assert.deepEqual(names(build(state, ALL)), ['/a', '/x']);
  assert.equal(build(state, ALL).edges.length, 1);
  assert.deepEqual(names(build(state, { ...ALL, hidden: true })), ['/_cli', '/_y', '/a', '/x']);
});

test('an endpoint without a node belongs to its participant', () => {
  const state = robot(['/a'], [['/x', ['/a'], ['nobody']]]);
  const graph = build(state, ALL);
  assert.ok(graph.vertices.some((vertex) => vertex.kind === 'participant'));
  assert.equal(graph.edges.length, 2);
});

test('namespaces are boxes, and topics between their own nodes lie in them', () => {
  const state = robot(['/r/a', '/r/b', '/s/c', '/s/d', '/lone'], [
    ['/r/x', ['/r/a'], ['/r/b']], ['/y', ['/r/a'], ['/s/c']],
  ]);
  const graph = build(state, { ...ALL, boxes: 'namespace' });
  const parent = Object.fromEntries(graph.vertices.map((vertex) => [vertex.name, vertex.parent]));
  assert.equal(parent['/r/x'], 'box:/r');
  assert.equal(parent['/y'], null);
  assert.equal(parent['/lone'], null);
  const closed = build(state, { ...ALL, boxes: 'namespace', toggled: new Set(['box:/r']) });
  assert.deepEqual(names(closed), ['/lone', '/r/', '/s/', '/s/c', '/s/d', '/y']);
  assert.deepEqual(closed.edges.map((edge) => [edge.from, edge.to]),
    [['box:/r', 'topic:0:/y'], ['topic:0:/y', 'node:0:/s/c']]);
  const box = /** @type {any} */ (closed.vertices.find((vertex) => vertex.key === 'box:/r'));
  assert.equal(box.count, 2);
});

test('above 60 nodes boxes are closed, below the one that holds everything', () => {
  const nodes = Array.from({ length: 70 }, (_, at) => `/robot/${'abcde'[at % 5]}/n${at}`);
  const graph = build(robot(nodes, []), { ...ALL, boxes: 'namespace' });
  assert.deepEqual(names(graph),
    ['/robot/', '/robot/a/', '/robot/b/', '/robot/c/', '/robot/d/', '/robot/e/']);
  const opened = build(robot(nodes, []),
    { ...ALL, boxes: 'namespace', toggled: new Set(['box:/robot/a']) });
  assert.equal(opened.vertices.length, 6 + 14);
});

test('hosts are boxes, and processes of several nodes', () => {
  const state = robot(['/a', '/b', '/c', '/d'], [['/x', ['/a'], ['/d']]]);
  const graph = build(state, { ...ALL, boxes: 'process' });
  const by = Object.fromEntries(graph.vertices.map((vertex) => [vertex.name, vertex]));
  // Nodes 1 and 4 share the participant of process 2 on host a; each other node has its own.
  assert.equal(by['/a'].parent, 'box:a 2');
  assert.equal(by['/d'].parent, 'box:a 2');
  assert.equal(by['/x'].parent, 'box:a 2');
  assert.equal(by['/b'].parent, 'box:b');
  assert.equal(by['/b'].detail, 'p3 3');
  assert.equal(by['p2 2'].parent, 'box:a');
});

test('services join nodes that are shown', () => {
  const joints = {
    nodes: [{ id: 'service:0:/s', kind: 'service', name: '/s' }, { id: 'topic:0:/x', kind: 'topic' }],
    edges: [{ source: 'node:0:/a', target: 'service:0:/s', kind: 'calls' },
      { source: 'service:0:/s', target: 'node:0:/gone', kind: 'served_by' }],
  };
  const graph = build(robot(['/a'], []), ALL, joints);
  assert.deepEqual(names(graph), ['/a', '/s']);
  assert.equal(graph.edges.length, 1);
});

test('the parameter services of every node are folded like hubs', () => {
  const joints = {
    nodes: [{ id: 'service:0:/a/get_parameters', kind: 'service', name: '/a/get_parameters' }],
    edges: [],
  };
  const folded = build(robot(['/a'], []), ALL, joints);
  assert.deepEqual([names(folded), folded.folded], [['/a'], 1]);
  const shown = build(robot(['/a'], []), { ...ALL, hubs: true }, joints);
  assert.deepEqual(names(shown), ['/a', '/a/get_parameters']);
});

test('figures leave the signature alone, another endpoint changes it', () => {
  const state = CHAIN();
  const before = build(state, ALL).signature;
  state.apply({ values: { t: 1, topics: [[1, 5, 5, 5, 0, 0, null, null, 1, 1]],
    totals: [1, 1, 0, 1] } });
  assert.equal(build(state, ALL).signature, before);
  assert.notEqual(build(CHAIN(), { ...ALL, hubs: true }).signature, before);
});

test('all of it can be laid out', () => {
  for (const boxes of /** @type {const} */ (['none', 'namespace', 'process'])) {
    const graph = build(CHAIN(), { ...ALL, boxes, hubs: true });
    const placed = layout(graph.vertices.map((each) => ({ ...each, id: each.key })), graph.edges);
    assert.equal(placed.vertices.length, graph.vertices.length);
    assert.equal(placed.edges.length, graph.edges.length);
  }
});

test('Graphviz gets quoted text only', () => {
  const state = robot(['/a"];x', '/b\\\u202e'], [['/t', ['/a"];x'], ['/b\\\u202e']]]);
  const text = dot(build(state, ALL), () => 'l"');
  assert.ok(text.includes('label="/a\\"];x"'));
  assert.ok(text.includes('label="/b\\\\\\\\\\\\u{202e}"'), text);
  assert.ok(text.includes('label="l\\""'));
});

test('folding omits topics with one neighbour, then closes namespaces, then shows nodes only', () => {
  const state = robot(['/a', '/ns/b', '/ns/c'], [
    ['/ab', ['/a'], ['/ns/b']], ['/bc', ['/ns/b'], ['/ns/c']], ['/alone', ['/a'], []],
    ['/lost', ['/a'], []],
  ]);
  state.findings = [{ id: 'f', kind: 'loss', severity: 'warning', domain_id: 0, topic: 4, node: null,
    since: null, text: '', remedy: null }];
  const folded = (/** @type {number} */ fold) => build(state, { ...ALL, boxes: 'namespace', fold });
  assert.ok(names(folded(0)).includes('/alone'));
  const one = folded(1);
  assert.equal(one.leaves, 1);
  assert.ok(!names(one).includes('/alone') && names(one).includes('/lost'));
  assert.ok(names(folded(2)).includes('/ab') && !names(folded(2)).includes('/ns/b'));
  assert.deepEqual(names(folded(3)), ['/a', '/ns/']);
  // What is searched for stays.
  assert.ok(names(build(state, { ...ALL, fold: 1, focus: 'topic:0:/alone' })).includes('/alone'));
});

test('differences name nodes, connections and QoS by names that a restart keeps', () => {
  const before = robot(['/a', '/b', '/gone'], [['/x', ['/a'], ['/b']], ['/y', ['/gone'], ['/b']],
    ['/z', ['/a'], ['/b']]]);
  const now = robot(['/a', '/b', '/came'], [['/w', ['/b'], ['/a']], ['/x', ['/a'], ['/b']],
    ['/y', ['/came'], []], ['/z', ['/a'], []]]);
  const [topic] = [...now.topics.values()].filter((each) => each.name === '/x');
  topic.publishers[0].reliability = 'BEST_EFFORT';
  const { vertices, guids, both, ...found } = differences(before, now);
  assert.deepEqual(found, {
    came: ['node:0:/came'], gone: ['node:0:/gone'], cameTopics: ['topic:0:/w'], goneTopics: [],
    joined: ['/b publishes /w', '/a subscribes to /w'],
    left: ['/b subscribes to /y', '/b subscribes to /z'],
    changed: ['/a publishes /x: RELIABLE, VOLATILE → BEST_EFFORT, VOLATILE'],
  });
  assert.deepEqual([...vertices].sort(), [['node:0:/came', 'came'], ['node:0:/gone', 'gone'],
    ['topic:0:/w', 'came'], ['topic:0:/x', 'changed']]);
  const same = differences(now, now);
  assert.deepEqual([...Object.values(same)].filter((each) => Array.isArray(each) && each.length), []);
  assert.equal(same.vertices.size + same.guids.size, 0);
  // The graph of both has what went, and marks of edges.
  const graph = build(both, ALL);
  assert.ok(graph.vertices.some((each) => each.key === 'node:0:/gone' && (each.node ?? 0) < 0));
  const marks = Object.fromEntries(graph.edges.map((edge) =>
    [`${nameOf(edge.from)} ${nameOf(edge.to)}`, markOf(edge, guids)]));
  assert.deepEqual(marks, { '/a /x': 'changed', '/x /b': null, '/a /z': null, '/z /b': 'gone',
    '/b /w': 'came', '/w /a': 'came', '/gone /y': 'gone', '/came /y': 'came', '/y /b': 'gone' });
  assert.equal(build(now, ALL).vertices.some((each) => each.name === '/gone'), false);
  // Between nodes, an edge comes and goes with either end.
  const pairs = build(both, { ...ALL, mode: 'nodes' }).edges;
  assert.deepEqual(Object.fromEntries(pairs.map((edge) =>
    [`${nameOf(edge.from)} ${nameOf(edge.to)}`, markOf(edge, guids)])), { '/a /b': 'changed',
    '/b /a': 'came', '/gone /b': 'gone', '/came /b': 'changed' });
});

test('containers and units are boxes, and processes have the name of their script', () => {
  const state = robot(['/a', '/b', '/c', '/d', '/e'], []);
  for (const own of state.participants.values()) {
    own.host = 'base';
    own.process = 'python3';
  }
  const [one, two, three] = [1, 2, 3].map((id) => /** @type {any} */ (state.participants.get(id)));
  two.cgroup = three.cgroup = '/docker/0123456789abcdef';
  two.container = three.container = 'container 0123456789ab';
  state.takeProcesses([{ process_id: two.pid, process: 'python3', script: 'robot.py' }]);
  const boxes = () => build(state, { ...ALL, boxes: 'process' }).vertices
    .filter((each) => each.kind === 'box').map((each) => `${each.parent}: ${each.name}`).sort();
  assert.deepEqual(boxes(), ['box:base container 0123456789ab: python3 3',
    'box:base container 0123456789ab: robot.py 2', 'box:base: container 0123456789ab', 'null: base']);
  one.container = two.container;
  assert.deepEqual(boxes(), ['box:base: python3 3', 'box:base: robot.py 2', 'null: base']);
});
