// Graphs of robots for tests and the benchmark: the same number gives the same graph.

/** @param {number} seed */
function random(seed) {
  let state = seed >>> 0;
  return () => {
    state = (Math.imul(state, 1664525) + 1013904223) >>> 0;
    return state / 2 ** 32;
  };
}

/**
 * Nodes and topics as vertices. Each topic has one publisher and up to three subscribers, most of
 * them behind the publisher, as in a pipeline; some edges lead back.
 * @param {number} nodes
 * @param {number} topics
 * @param {number} [seed]
 */
export function robot(nodes, topics, seed = 1) {
  const next = random(seed);
  const vertices = [];
  const edges = [];
  for (let node = 0; node < nodes; node += 1) vertices.push({ id: `n${node}`, w: 160, h: 30 });
  for (let topic = 0; topic < topics; topic += 1) {
    vertices.push({ id: `t${topic}`, w: 140, h: 22 });
    const publisher = Math.floor(next() * nodes);
    edges.push({ id: `p${topic}`, from: `n${publisher}`, to: `t${topic}` });
    const readers = new Set();
    for (let reader = 0; reader < 1 + Math.floor(next() * 3); reader += 1) {
      const ahead = 1 + Math.floor(next() * Math.max(2, nodes / 8));
      const back = next() < 0.1;
      readers.add((publisher + (back ? nodes - ahead : ahead)) % nodes);
    }
    for (const reader of readers) {
      edges.push({ id: `s${topic}-${reader}`, from: `t${topic}`, to: `n${reader}` });
    }
  }
  return { vertices, edges };
}
