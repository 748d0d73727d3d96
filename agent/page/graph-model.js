// Converts the state to the graph view's vertices, edges and boxes.
// Figures are not used here, so that they change the look but never the layout.

import { shortened, visible } from './format.js';

/** Number of nodes above which namespace boxes are initially closed. */
export const MANY_NODES = 60;

// Topics that connect most nodes, by the last part of their names.
const HUBS = new Set(['rosout', 'parameter_events', 'tf', 'tf_static', 'clock', 'diagnostics',
  'diagnostics_agg', 'diagnostics_toplevel_state', 'bond']);

/**
 * @typedef {{mode: 'both'|'nodes', hubs: boolean, hidden: boolean,
 *   boxes: 'none'|'namespace'|'process', toggled: Set<string>, focus: string|null,
 *   hops: number, shown?: Set<string>, only?: boolean, fold?: number}} Options
 *   `toggled` holds the boxes whose initial state the user has changed; `shown` what is neither
 *   folded nor hidden. `only` omits everything else. `fold` 1 omits topics with one neighbour; 2
 *   also closes namespaces; 3 also shows nodes only.
 * @typedef {{key: string, kind: 'node'|'participant'|'topic'|'service'|'action'|'box',
 *   name: string, detail: string, parent: string|null, topic: number|null, node: number|null,
 *   closed: boolean, count: number, members: string[], w: number, h: number}} Vertex
 *   A closed box is a vertex without content; `members` are the nodes and topics in it.
 * @typedef {{id: string, from: string, to: string, kind: string, topics: number[],
 *   guids: string[], passages: number}} Edge
 * @typedef {{vertices: Vertex[], edges: Edge[], signature: string, folded: number, leaves: number,
 *   nodes: number}} Graph
 *   `folded` counts the omitted hubs, `leaves` the omitted topics with one neighbour; `nodes` the
 *   nodes before boxes were closed.
 */

// Services that every node has.
const PARAMETERS = new Set(['describe_parameters', 'get_parameter_types', 'get_parameters',
  'list_parameters', 'set_parameters', 'set_parameters_atomically', 'get_type_description']);

/** @param {string} name */
export function isHub(name) {
  return HUBS.has(name.slice(name.lastIndexOf('/') + 1));
}

/** @param {{domain: number, name: string}} topic */
export function topicKey(topic) {
  return `topic:${topic.domain}:${topic.name}`;
}

/** @param {{domain: number, name: string}} node */
export function nodeKey(node) {
  return `node:${node.domain}:${node.name}`;
}

/** Returns the name in a key. @param {string} key */
export function nameOf(key) {
  return key.split(':').slice(2).join(':');
}

/**
 * @param {import('./state.js').State} state
 * @param {Options} options
 * @param {{nodes: any[], edges: any[]}|null} [joints] services and actions, as `GET /graph` has them
 * @returns {Graph}
 */
export function build(state, options, joints = null) {
  const base = gather(state, options, joints);
  const near = options.focus ? around(base, options.focus, options.hops) : null;
  if (near) {
    for (const key of [...base.vertices.keys()]) if (!near.has(key)) base.vertices.delete(key);
  }
  const { shown } = options;
  if (options.only && shown?.size) {
    for (const key of [...base.vertices.keys()]) if (!shown.has(key)) base.vertices.delete(key);
  }
  let joined = base.edges.filter((edge) =>
    base.vertices.has(edge.from) && base.vertices.has(edge.to));
  const fold = options.fold ?? 0;
  const leaves = fold >= 1 && options.mode === 'both' ? leavesOf(state, base.vertices, joined, options)
    : new Set();
  for (const key of leaves) base.vertices.delete(key);
  joined = joined.filter((edge) => !leaves.has(edge.from) && !leaves.has(edge.to));
  let edges = joined;
  if (options.mode === 'nodes' || fold >= 3) {
    edges = [...pairs(base.vertices, joined),
      ...joined.filter((edge) => edge.kind === 'calls' || edge.kind === 'served_by')];
    for (const vertex of [...base.vertices.values()]) {
      if (vertex.kind === 'topic') base.vertices.delete(vertex.key);
    }
  }
  const isNode = (/** @type {Vertex} */ vertex) =>
    vertex.kind === 'node' || vertex.kind === 'participant';
  const nodes = [...base.vertices.values()].filter(isNode).length;
  const boxes = options.boxes === 'namespace' ? namespaces(base.vertices)
    : options.boxes === 'process' ? processes(state, base.vertices) : new Map();
  enclose(base.vertices, edges, boxes);
  const closed = options.boxes === 'namespace'
    ? closedBoxes(boxes, options.toggled, fold >= 2 || nodes > MANY_NODES)
    : new Set([...boxes.keys()].filter((key) => options.toggled.has(key)));
  const graph = close(base.vertices, boxes, edges, closed);
  for (const vertex of graph.vertices) measure(vertex);
  const signature = JSON.stringify([
    graph.vertices.map((vertex) => [vertex.key, vertex.parent, vertex.closed, vertex.w]),
    graph.edges.map((edge) => edge.id),
  ]);
  return { ...graph, signature, folded: base.folded, leaves: leaves.size, nodes };
}

/**
 * Returns the topics with one neighbour and no finding.
 * @param {import('./state.js').State} state
 * @param {Map<string, Vertex>} vertices
 * @param {Edge[]} edges
 * @param {Options} options
 */
function leavesOf(state, vertices, edges, options) {
  const serious = new Set(state.findings.filter((finding) => finding.severity !== 'note')
    .map((finding) => finding.topic));
  /** @type {Map<string, Set<string>>} */
  const neighbours = new Map();
  for (const { from, to } of edges) {
    for (const [own, other] of [[from, to], [to, from]]) {
      neighbours.set(own, (neighbours.get(own) ?? new Set()).add(other));
    }
  }
  return new Set([...vertices.values()].filter((each) => each.kind === 'topic'
    && (neighbours.get(each.key)?.size ?? 0) <= 1 && !serious.has(each.topic)
    && options.focus !== each.key && !options.shown?.has(each.key)).map((each) => each.key));
}

/**
 * @typedef {'came'|'gone'|'changed'} Mark
 * @typedef {{text: string, qos: string, node: string, topic: string, side: 'publishers'|'subscriptions',
 *   endpoints: import('./state.js').Endpoint[]}} End endpoints of one node at one topic
 */

/**
 * Returns each node, each topic, and each end of a topic by a name that a restart keeps.
 * @param {import('./state.js').State} state
 */
function named(state) {
  const nodes = new Map([...state.nodes.values()].filter((node) => !node.hidden)
    .map((node) => [nodeKey(node), node]));
  const topics = new Map([...state.topics.values()].filter((topic) => !topic.hidden && !topic.vanished)
    .map((topic) => [topicKey(topic), topic]));
  /** @type {Map<string, End>} */
  const ends = new Map();
  for (const [topic, { name, ...own }] of topics) {
    for (const [side, word] of /** @type {const} */ ([['publishers', 'publishes'],
      ['subscriptions', 'subscribes to']])) {
      for (const endpoint of own[side]) {
        const owner = state.ownerOf(endpoint);
        if (!owner.node || owner.node.hidden) continue;
        const key = `${owner.key} ${side} ${topic}`;
        const qos = `${endpoint.reliability}, ${endpoint.durability}`;
        const known = ends.get(key) ?? { text: `${owner.name} ${word} ${name}`, qos, node: owner.key,
          topic, side, endpoints: [] };
        ends.set(key, { ...known, qos, endpoints: [...known.endpoints, endpoint] });
      }
    }
  }
  return { nodes, topics, ends };
}

/**
 * Returns what came, went or changed its QoS between two states.
 * @param {import('./state.js').State} before
 * @param {import('./state.js').State} now
 * @returns {{came: string[], gone: string[], cameTopics: string[], goneTopics: string[],
 *   joined: string[], left: string[], changed: string[], vertices: Map<string, Mark>,
 *   guids: Map<string, Mark>, both: import('./state.js').State}}
 *   `came`, `gone`, `cameTopics` and `goneTopics` are keys; the next three are sentences about nodes
 *   that were there before and are there now. `vertices` and `guids` are the marks of all of them, and
 *   `both` is the state now with what went.
 */
export function differences(before, now) {
  const [one, other] = [named(before), named(now)];
  /** @template T @param {Map<string, T>} all @param {Map<string, T>} from @returns {[string, T][]} */
  const missing = (all, from) => [...all].filter(([key]) => !from.has(key));
  const keys = (/** @type {[string, any][]} */ list) => list.map(([key]) => key);
  const [came, gone] = [missing(other.nodes, one.nodes), missing(one.nodes, other.nodes)];
  const [cameTopics, goneTopics] = [missing(other.topics, one.topics), missing(one.topics, other.topics)];
  const [joined, left] = [missing(other.ends, one.ends), missing(one.ends, other.ends)];
  const changed = [...other.ends].filter(([key, { qos }]) => (one.ends.get(key)?.qos ?? qos) !== qos);
  /** @type {Map<string, Mark>} */
  const vertices = new Map([
    ...changed.map(([, end]) => /** @type {[string, Mark]} */ ([end.topic, 'changed'])),
    ...[...came, ...cameTopics].map(([key]) => /** @type {[string, Mark]} */ ([key, 'came'])),
    ...[...gone, ...goneTopics].map(([key]) => /** @type {[string, Mark]} */ ([key, 'gone']))]);
  /** @type {Map<string, Mark>} */
  const guids = new Map();
  for (const [mark, ends] of /** @type {[Mark, [string, End][]][]} */ ([['came', joined], ['gone', left],
    ['changed', changed]])) {
    for (const [, { endpoints }] of ends) {
      for (const { guid } of endpoints) guids.set(mark === 'gone' ? `gone ${guid}` : guid, mark);
    }
  }
  const stayed = (/** @type {[string, End]} */ [, end]) => !['came', 'gone'].includes(vertices.get(end.node) ?? '');
  const texts = (/** @type {[string, End][]} */ ends) => ends.filter(stayed).map(([, end]) => end.text);
  return {
    came: keys(came), gone: keys(gone), cameTopics: keys(cameTopics), goneTopics: keys(goneTopics),
    joined: texts(joined), left: texts(left),
    changed: changed.map(([key, { text, qos }]) => `${text}: ${one.ends.get(key)?.qos} → ${qos}`),
    vertices, guids, both: withGone(now, gone.map(([, node]) => node),
      goneTopics.map(([, topic]) => topic), left.map(([, end]) => end)),
  };
}

/**
 * Returns a state with nodes, topics and ends that it no longer has. Their numbers are negative, so
 * that they have neither figures nor findings.
 * @param {import('./state.js').State} now
 * @param {import('./state.js').Node[]} nodes
 * @param {import('./state.js').Topic[]} topics
 * @param {End[]} ends
 */
function withGone(now, nodes, topics, ends) {
  const both = /** @type {import('./state.js').State} */ (
    Object.assign(Object.create(Object.getPrototypeOf(now)), now));
  both.nodes = new Map(now.nodes);
  for (const node of nodes) both.nodes.set(-node.id, { ...node, id: -node.id, participants: [] });
  both.topics = new Map([...now.topics].map(([id, topic]) => [id, { ...topic,
    publishers: [...topic.publishers], subscriptions: [...topic.subscriptions] }]));
  for (const topic of topics) {
    both.topics.set(-topic.id, { ...topic, id: -topic.id, publishers: [], subscriptions: [] });
  }
  const byKey = new Map([...[...both.nodes.values()].map((node) => /** @type {[string, any]} */ (
    [nodeKey(node), node])), ...[...both.topics.values()].map((topic) => /** @type {[string, any]} */ (
    [topicKey(topic), topic]))]);
  for (const { node, topic, side, endpoints } of ends) {
    for (const endpoint of endpoints) {
      byKey.get(topic)?.[side].push({ ...endpoint, topic: byKey.get(topic).id,
        node: byKey.get(node)?.id ?? 0, guid: `gone ${endpoint.guid}` });
    }
  }
  return both;
}

/**
 * Returns the mark of an edge by those of its endpoints.
 * @param {Edge} edge
 * @param {Map<string, Mark>} guids
 * @returns {Mark|null}
 */
export function markOf(edge, guids) {
  const marks = new Set(edge.guids.map((guid) => guids.get(guid) ?? null));
  // A pair of nodes at one topic comes and goes with either end.
  if (edge.kind === 'pair' && edge.topics.length === 1) marks.delete(null);
  const [first = null] = marks;
  return marks.size > 1 ? 'changed' : first;
}

/**
 * @param {string} key @param {Vertex['kind']} kind @param {string} name
 * @param {Partial<Vertex>} more
 * @returns {Vertex}
 */
function vertex(key, kind, name, more = {}) {
  return {
    key, kind, name, detail: '', parent: null, topic: null, node: null, closed: false, count: 0,
    members: [], w: 0, h: 0, ...more,
  };
}

/**
 * Collects nodes and topics with the edges between them.
 * @param {import('./state.js').State} state
 * @param {Options} options
 * @param {{nodes: any[], edges: any[]}|null} joints
 */
function gather(state, options, joints) {
  /** @type {Map<string, Vertex>} */
  const vertices = new Map();
  /** @type {Edge[]} */
  const edges = [];
  /** @type {Map<string, Edge>} */
  const known = new Map();
  let folded = 0;
  const isShown = (/** @type {string} */ key) => options.focus === key || options.shown?.has(key);
  for (const node of state.nodes.values()) {
    const key = nodeKey(node);
    if (node.hidden && !options.hidden && !isShown(key)) continue;
    vertices.set(key, vertex(key, 'node', node.name, { node: node.id }));
  }
  const join = (/** @type {Omit<Edge, 'id'>} */ edge) => {
    const id = `${edge.from} ${edge.kind} ${edge.to}`;
    const before = known.get(id);
    if (before) {
      before.guids.push(...edge.guids);
      before.passages |= edge.passages;
      return;
    }
    const own = { id, ...edge };
    known.set(id, own);
    edges.push(own);
  };
  for (const topic of state.topics.values()) {
    const key = topicKey(topic);
    if (topic.vanished || (topic.hidden && !options.hidden && !isShown(key))) continue;
    if (!options.hubs && isHub(topic.name) && !isShown(key)) {
      folded += 1;
      continue;
    }
    vertices.set(key, vertex(key, 'topic', topic.name, { topic: topic.id }));
    for (const side of /** @type {const} */ (['publishers', 'subscriptions'])) {
      for (const endpoint of topic[side]) {
        const owner = state.ownerOf(endpoint);
        if (owner.node?.hidden && !options.hidden && !isShown(owner.key)) continue;
        if (!vertices.has(owner.key)) {
          vertices.set(owner.key, vertex(owner.key, owner.node ? 'node' : 'participant',
            owner.name, { node: owner.node?.id ?? null }));
        }
        const publishes = side === 'publishers';
        join({
          from: publishes ? owner.key : key, to: publishes ? key : owner.key,
          kind: publishes ? 'publishes' : 'feeds', topics: [topic.id], guids: [endpoint.guid],
          passages: endpoint.passages,
        });
      }
    }
  }
  for (const joint of joints?.nodes ?? []) {
    if (joint.kind !== 'service' && joint.kind !== 'action') continue;
    if (!options.hubs && PARAMETERS.has(joint.name.slice(joint.name.lastIndexOf('/') + 1))) {
      folded += 1;
      continue;
    }
    vertices.set(joint.id, vertex(joint.id, joint.kind, joint.name));
  }
  for (const edge of joints?.edges ?? []) {
    if (edge.kind !== 'calls' && edge.kind !== 'served_by') continue;
    if (!vertices.has(edge.source) || !vertices.has(edge.target)) continue;
    join({ from: edge.source, to: edge.target, kind: edge.kind, topics: [], guids: [],
      passages: 0 });
  }
  return { vertices, edges, folded };
}

/**
 * Returns the vertices within `hops` of one vertex. A hop leads from node to node, or from a topic
 * to its nodes. Null if the vertex does not exist.
 * @param {{vertices: Map<string, Vertex>, edges: Edge[]}} base
 * @param {string} focus
 * @param {number} hops
 */
function around(base, focus, hops) {
  const start = base.vertices.get(focus);
  if (!start) return null;
  /** @type {Map<string, string[]>} */
  const near = new Map();
  const add = (/** @type {string} */ a, /** @type {string} */ b) => {
    const list = near.get(a);
    if (list) list.push(b);
    else near.set(a, [b]);
  };
  for (const edge of base.edges) {
    add(edge.from, edge.to);
    add(edge.to, edge.from);
  }
  const isNode = start.kind === 'node' || start.kind === 'participant';
  const steps = isNode ? 2 * hops : 2 * hops - 1;
  const found = new Set([focus]);
  let edge = [focus];
  for (let step = 0; step < steps && edge.length; step += 1) {
    const next = [];
    for (const key of edge) {
      for (const other of near.get(key) ?? []) {
        if (found.has(other)) continue;
        found.add(other);
        next.push(other);
      }
    }
    edge = next;
  }
  return found;
}

/**
 * Returns one edge per pair of nodes, with all topics from one to the other.
 * @param {Map<string, Vertex>} vertices
 * @param {Edge[]} edges
 */
function pairs(vertices, edges) {
  /** @type {Map<string, {from: Edge[], to: Edge[]}>} */
  const topics = new Map();
  for (const edge of edges) {
    const publishes = edge.kind === 'publishes';
    if (!publishes && edge.kind !== 'feeds') continue;
    const key = publishes ? edge.to : edge.from;
    const ends = topics.get(key) ?? { from: [], to: [] };
    (publishes ? ends.from : ends.to).push(edge);
    topics.set(key, ends);
  }
  /** @type {Map<string, Edge>} */
  const found = new Map();
  for (const ends of topics.values()) {
    for (const one of ends.from) {
      for (const other of ends.to) {
        if (one.from === other.to) continue;
        const id = `${one.from} to ${other.to}`;
        const guids = [...one.guids, ...other.guids];
        const before = found.get(id);
        if (before) {
          before.topics.push(...one.topics);
          before.guids.push(...guids);
          before.passages |= one.passages & other.passages;
        } else {
          found.set(id, {
            id, from: one.from, to: other.to, kind: 'pair', topics: [...one.topics], guids,
            passages: one.passages & other.passages,
          });
        }
      }
    }
  }
  return [...found.values()];
}

/**
 * Returns nested boxes of namespaces that contain at least two nodes.
 * @param {Map<string, Vertex>} vertices
 * @returns {Map<string, Vertex>}
 */
function namespaces(vertices) {
  /** @type {Map<string, number>} */
  const sizes = new Map();
  const spaces = (/** @type {string} */ name) => {
    const parts = name.split('/').slice(1, -1);
    return parts.map((_, at) => `/${parts.slice(0, at + 1).join('/')}`);
  };
  const nodes = [...vertices.values()].filter((each) => each.kind === 'node');
  for (const node of nodes) {
    for (const space of spaces(node.name)) sizes.set(space, (sizes.get(space) ?? 0) + 1);
  }
  /** @type {Map<string, Vertex>} */
  const boxes = new Map();
  for (const node of nodes) {
    let parent = null;
    const own = spaces(node.name);
    for (const [depth, space] of own.entries()) {
      const size = sizes.get(space) ?? 0;
      // A namespace with a single inner namespace is drawn as the inner one.
      const inner = own[depth + 1];
      if (size < 2 || (inner && sizes.get(inner) === size)) continue;
      const key = `box:${space}`;
      if (!boxes.has(key)) boxes.set(key, vertex(key, 'box', `${space}/`, { parent }));
      parent = key;
    }
    node.parent = parent;
  }
  return boxes;
}

/**
 * Returns a function that returns the participant of a node, the first one if it has several, or of
 * a vertex without a node.
 * @param {import('./state.js').State} state
 * @returns {(vertex: Vertex) => import('./state.js').Participant|undefined}
 */
export function participantsOf(state) {
  const byGuid = new Map([...state.participants.values()].map((each) => [each.guid, each]));
  return (each) => (each.kind === 'participant' ? byGuid.get(nameOf(each.key))
    : state.participants.get(state.nodes.get(each.node ?? -1)?.participants[0] ?? -1));
}

/**
 * Returns boxes of hosts, and in them of containers, systemd units and processes with at least two
 * nodes.
 * @param {import('./state.js').State} state
 * @param {Map<string, Vertex>} vertices
 * @returns {Map<string, Vertex>}
 */
function processes(state, vertices) {
  /** @type {Map<string, Vertex>} */
  const boxes = new Map();
  const participants = participantsOf(state);
  const place = (/** @type {Vertex} */ each) => {
    const participant = participants(each);
    if (!participant) return null;
    const host = participant.host ?? 'unknown host';
    const group = participant.container ?? '';
    return { host, group: group && `box:${host} ${group}`, groupName: group,
      process: participant.pid == null ? '' : `box:${host} ${participant.pid}`,
      name: state.processName(participant) };
  };
  /** @type {Map<string, number>} */
  const sizes = new Map();
  /** Groups of each host. @type {Map<string, Set<string>>} */
  const groups = new Map();
  const places = [...vertices.values()].filter((each) =>
    each.kind === 'node' || each.kind === 'participant').map((each) => ({ each, at: place(each) }));
  for (const { at } of places) {
    if (!at) continue;
    groups.set(at.host, (groups.get(at.host) ?? new Set()).add(at.group));
    for (const key of [at.group, at.process]) sizes.set(key, (sizes.get(key) ?? 0) + 1);
  }
  for (const { each, at } of places) {
    if (!at) continue;
    const enter = (/** @type {string} */ key, /** @type {string} */ name) => {
      if (!boxes.has(key)) boxes.set(key, vertex(key, 'box', name, { parent: each.parent }));
      each.parent = key;
    };
    enter(`box:${at.host}`, at.host);
    // A container or unit with all nodes of the host would be drawn as the host.
    const isPart = (groups.get(at.host)?.size ?? 0) > 1;
    if (at.group && isPart && (sizes.get(at.group) ?? 0) > 1) enter(at.group, at.groupName);
    if (!at.process) continue;
    if ((sizes.get(at.process) ?? 0) > 1) enter(at.process, at.name);
    else each.detail = at.name;
  }
  return boxes;
}

/**
 * Puts topics, services and actions into the innermost box that contains all their nodes.
 * @param {Map<string, Vertex>} vertices
 * @param {Edge[]} edges
 * @param {Map<string, Vertex>} boxes
 */
function enclose(vertices, edges, boxes) {
  if (!boxes.size) return;
  const chain = (/** @type {string|null} */ key) => {
    const found = [];
    for (let at = key; at != null; at = boxes.get(at)?.parent ?? null) found.unshift(at);
    return found;
  };
  /** @type {Map<string, string[]>} */
  const common = new Map();
  for (const edge of edges) {
    for (const [joint, owner] of [[edge.from, edge.to], [edge.to, edge.from]]) {
      const kind = vertices.get(joint)?.kind;
      if (kind === 'node' || kind === 'participant' || kind === undefined) continue;
      const own = chain(vertices.get(owner)?.parent ?? null);
      const before = common.get(joint);
      if (!before) {
        common.set(joint, own);
      } else {
        let same = 0;
        while (same < own.length && own[same] === before[same]) same += 1;
        common.set(joint, before.slice(0, same));
      }
    }
  }
  for (const [key, path] of common) {
    const own = vertices.get(key);
    if (own) own.parent = path[path.length - 1] ?? null;
  }
}

/**
 * @param {Map<string, Vertex>} boxes
 * @param {Set<string>} toggled
 * @param {boolean} many whether boxes are closed at first
 */
function closedBoxes(boxes, toggled, many) {
  const closed = new Set();
  if (many) {
    const below = (/** @type {string|null} */ parent) =>
      [...boxes.values()].filter((box) => box.parent === parent);
    // A single box around everything is useless: its inner ones are closed instead.
    let level = below(null);
    while (level.length === 1 && below(level[0].key).length) level = below(level[0].key);
    for (const box of level) closed.add(box.key);
  }
  for (const key of toggled) {
    if (closed.has(key)) closed.delete(key);
    else if (boxes.has(key)) closed.add(key);
  }
  return closed;
}

/**
 * Replaces the content of closed boxes by the boxes.
 * @param {Map<string, Vertex>} vertices
 * @param {Map<string, Vertex>} boxes
 * @param {Edge[]} edges
 * @param {Set<string>} closed
 */
function close(vertices, boxes, edges, closed) {
  const standsFor = (/** @type {string} */ key) => {
    let found = key;
    const parent = vertices.get(key)?.parent ?? boxes.get(key)?.parent ?? null;
    for (let at = parent; at != null; at = boxes.get(at)?.parent ?? null) {
      if (closed.has(at)) found = at;
    }
    return found;
  };
  /** @type {Vertex[]} */
  const shown = [];
  const inner = new Set();
  for (const each of vertices.values()) {
    const own = standsFor(each.key);
    for (let at = each.parent; at != null; at = boxes.get(at)?.parent ?? null) {
      const box = /** @type {Vertex} */ (boxes.get(at));
      box.members.push(each.key);
      if (each.kind === 'node' || each.kind === 'participant') box.count += 1;
      inner.add(at);
    }
    if (own === each.key) shown.push(each);
  }
  for (const box of boxes.values()) {
    if (!inner.has(box.key) || standsFor(box.key) !== box.key) continue;
    box.closed = closed.has(box.key);
    shown.push(box);
  }
  /** @type {Map<string, Edge>} */
  const joined = new Map();
  for (const edge of edges) {
    const [from, to] = [standsFor(edge.from), standsFor(edge.to)];
    if (from === to) continue;
    const id = `${from} ${edge.kind} ${to}`;
    const before = joined.get(id);
    if (before) {
      before.topics = [...new Set([...before.topics, ...edge.topics])];
      before.guids = [...before.guids, ...edge.guids];
      before.passages |= edge.passages;
    } else {
      joined.set(id, { ...edge, id, from, to });
    }
  }
  return { vertices: shown, edges: [...joined.values()] };
}

/** Returns the width in pixels in the graph's monospaced font. @param {string} text */
function textWidth(text) {
  let units = 0;
  // East Asian characters are twice as wide.
  for (const character of text) units += /[\u1100-\uffdc\u{1f000}-\u{3ffff}]/u.test(character) ? 2 : 1;
  return units * 7.3;
}

/** The longest text of a topic's figures. */
const FIGURES = '99.9 kHz · 99.9 MB/s';

/** Most characters of a name in the graph. */
export const MOST_LABEL = 32;

/** @param {Vertex} own */
function measure(own) {
  const label = shortened(own.name, MOST_LABEL);
  // Figures appear without another layout, so room is reserved for them.
  const detail = own.kind === 'topic' ? FIGURES : shortened(own.detail, MOST_LABEL);
  own.w = Math.max(96, Math.ceil(Math.max(textWidth(label), textWidth(detail)) + 34));
  own.h = own.kind === 'topic' || own.detail || own.closed ? 40 : 28;
  if (own.kind === 'box' && !own.closed) own.h = 0;
}

/**
 * Returns the graph in Graphviz's language.
 * @param {Graph} graph
 * @param {(edge: Edge) => string} labelOf
 */
export function dot(graph, labelOf) {
  const quoted = (/** @type {string} */ text) => {
    const own = visible(text).replaceAll('\\', '\\\\').replaceAll('"', '\\"');
    return `"${own}"`;
  };
  const number = new Map(graph.vertices.map((each, at) => [each.key, `v${at}`]));
  const lines = ['digraph ros {', '  rankdir=LR;'];
  const shapes = /** @type {Record<string, string>} */ ({
    topic: 'box', service: 'hexagon', action: 'octagon', box: 'folder', participant: 'component',
  });
  const draw = (/** @type {string|null} */ parent, /** @type {string} */ indent) => {
    for (const each of graph.vertices) {
      if (each.parent !== parent) continue;
      const id = number.get(each.key);
      if (each.kind === 'box' && !each.closed) {
        lines.push(`${indent}subgraph cluster_${id} {`, `${indent}  label=${quoted(each.name)};`);
        draw(each.key, `${indent}  `);
        lines.push(`${indent}}`);
      } else {
        lines.push(`${indent}${id} [label=${quoted(each.name)},`
          + ` shape=${shapes[each.kind] ?? 'ellipse'}];`);
      }
    }
  };
  draw(null, '  ');
  for (const edge of graph.edges) {
    lines.push(`  ${number.get(edge.from)} -> ${number.get(edge.to)}`
      + ` [label=${quoted(labelOf(edge))}];`);
  }
  lines.push('}', '');
  return lines.join('\n');
}
