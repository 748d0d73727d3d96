// Graphs of larger robots than the tests start: lines of `GET /live` that take the place of the
// agent's, so that the page draws them. The same size gives the same graph.

import { robot } from '../../../page/test/robot.js';

/** Nodes of one namespace, of one process, and of one host. */
const [SPACE, PROCESS, HOST] = [8, 4, 25];
const QOS = ['RELIABLE', 'VOLATILE'];

/** Returns the lines of a robot with this many nodes, in namespaces, processes and hosts. */
function lines(count) {
  const { vertices, edges } = robot(count, Math.round(count * 1.3));
  const numbers = (letter) => vertices.filter(({ id }) => id.startsWith(letter)).map(({ id }) =>
    Number(id.slice(1)));
  const participant = (node) => Math.floor(node / PROCESS) + 1;
  const space = (node) => `/part_${Math.floor(node / SPACE)}`;
  const publishers = new Map();
  const ends = { p: [], s: [] };
  for (const { id, from, to } of edges) {
    const [node, topic] = (id.startsWith('p') ? [from, to] : [to, from]).map((each) => Number(each.slice(1)));
    if (id.startsWith('p')) publishers.set(topic, node);
    // A third of the topics is within a host, some have no counterpart that is seen.
    const passages = topic % 17 === 5 ? 0 : topic % 3 ? 1 : 2;
    ends[id[0]].push([topic + 1, node + 1, participant(node), `${id}.end`, passages, ...QOS]);
  }
  const graph = {
    participants: [...new Set(numbers('n').map(participant))].map((id) => [id, `participant.${id}`, 0, 'vendor',
      `host${Math.floor((id * PROCESS) / HOST)}`, 1000 + id, 'component_container', null]),
    nodes: numbers('n').map((node) => [node + 1, 0, `${space(node)}/node_${node}`, [participant(node)], 0]),
    topics: numbers('t').map((topic) => [topic + 1, 0, `${space(publishers.get(topic) ?? 0)}/topic_${topic}`,
      `rt/topic_${topic}`, 'topic', ['sensor_msgs/msg/Imu'], 0, 0, 1, 0]),
    publishers: ends.p,
    subscriptions: ends.s,
  };
  const now = Date.now() / 1000;
  const rows = graph.topics.map(([id]) => [id, 10 + id, 1000 * id, 100, 0, 0, 0.001, 0.004, 0, now, 100]);
  return [
    { open: { run: `scene-${count}`, host: 'scene', version: '0', source: 'host', access: 'read', interval_seconds: 1,
      history_seconds: 600, flags: ['qos'], passages: ['network', 'shared_memory'], replay: null } },
    { graph: { version: 1, ...graph } }, { findings: [] },
    { values: { t: now, topics: rows, totals: [1, 1, 0, rows.length] } },
  ];
}

/** Lets the next pages of a context show a robot with this many nodes. */
export async function show(context, count) {
  const body = lines(count).map((line) => `${JSON.stringify(line)}\n`).join('');
  await context.route('**/live', (route) => route.fulfill({ contentType: 'application/x-ndjson', body }));
}
