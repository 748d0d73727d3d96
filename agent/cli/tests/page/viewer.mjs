// The public client of the Foxglove WebSocket protocol subscribes to every channel of the demo's
// robot, and must understand each message. Argument: address of the agent's listener.

import assert from 'node:assert/strict';
import { createRequire } from 'node:module';
import { fileURLToPath } from 'node:url';

/** Directory of the packages that .ci/prerequisites.sh installs. */
const TOOLS = fileURLToPath(new URL('../../../../target/tools/page/', import.meta.url));
const load = createRequire(`${TOOLS}package.json`);
const { FoxgloveClient } = load('@foxglove/ws-protocol');
const WebSocket = load('ws');

/** Maximum wait for all messages. Other tests keep the machine busy. */
const PATIENCE_MS = 60_000;
const POINTS_BYTES = 640_000;
/** Topics of the robot with their types, and the messages to wait for. */
const TOPICS = {
  '/cmd_vel': ['geometry_msgs/msg/Twist', 20],
  '/imu': ['sensor_msgs/msg/Imu', 200],
  '/points': ['sensor_msgs/msg/PointCloud2', 20],
  '/scan': ['sensor_msgs/msg/LaserScan', 20],
};

const socket = new WebSocket(process.argv[2], [FoxgloveClient.SUPPORTED_SUBPROTOCOL]);
const client = new FoxgloveClient({ ws: socket });
/** Channels by topic, with their received messages. */
const channels = new Map();
const subscriptions = new Map();
const problems = [];
let server;
const graph = new Map();

client.on('error', (error) => problems.push(String(error)));
// The demo's robot does not subscribe to these topics. The agent reports this after a while.
const SILENT = '/parameter_events, /rosout: no subscriber exists, so nothing is sent';
// On a busy machine, this client or the agent reads late. The agent reports what it dropped.
const LATE = /^\d+ messages? .*because (this client|the agent) reads too slowly/;
client.on('status', ({ message }) => {
  if (message !== SILENT && !LATE.test(message)) problems.push(message);
});
client.on('serverInfo', (info) => { server = info; });
client.on('open', () => client.subscribeConnectionGraph());
client.on('connectionGraphUpdate', (update) => {
  for (const { name, publisherIds } of update.publishedTopics) graph.set(name, publisherIds);
});
client.on('advertise', (advertised) => {
  for (const channel of advertised) {
    const received = { ...channel, messages: 0, least: Infinity, last: null };
    channels.set(channel.topic, received);
    subscriptions.set(client.subscribe(channel.id), received);
  }
});
client.on('message', ({ subscriptionId, timestamp, data }) => {
  const received = subscriptions.get(subscriptionId);
  received.messages += 1;
  received.least = Math.min(received.least, data.byteLength);
  received.timestamp = timestamp;
  if (received.encoding === 'json') received.last = JSON.parse(new TextDecoder().decode(data));
});

const isComplete = () =>
  Object.entries(TOPICS).every(([topic, [, messages]]) => {
    const figures = channels.get(`/rp/topics${topic}`);
    return channels.get(topic)?.messages >= messages && figures?.last && graph.get(topic);
  });
const began = Date.now();
while (!isComplete() && Date.now() < began + PATIENCE_MS) {
  await new Promise((wake) => { setTimeout(wake, 100); });
}

const received = [...channels.values()].map(({ topic, messages }) => `${topic} ${messages}`);
assert.ok(isComplete(), `${received.join(', ')}; graph of ${[...graph.keys()]}`);
assert.deepEqual(problems, []);
assert.deepEqual(server.capabilities.filter((name) => /publish|parameter|service/i.test(name)), []);
for (const [topic, [type]] of Object.entries(TOPICS)) {
  const { encoding, schemaName, schema, timestamp } = channels.get(topic);
  assert.deepEqual([encoding, schemaName], ['cdr', type]);
  assert.match(schema, /^[a-z][\w/]* \w+/m);
  const age = BigInt(Date.now()) * 1_000_000n - timestamp;
  assert.ok(age < 60_000_000_000n, `${topic} is ${age} ns old`);
}
assert.ok(channels.get('/points').least > POINTS_BYTES);
assert.deepEqual(graph.get('/imu'), ['/imu_driver']);
console.log(received.join(', '), JSON.stringify(channels.get('/rp/topics/imu').last));
client.close();
