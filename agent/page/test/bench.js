// Times the layout: node agent/page/test/bench.js

import { layout } from '../layout.js';
import { robot } from './robot.js';

for (const [nodes, topics] of [[10, 20], [40, 100], [100, 300], [200, 600]]) {
  const graph = robot(nodes, topics);
  const times = [];
  let result = layout(graph.vertices, graph.edges);
  for (let run = 0; run < 5; run += 1) {
    const began = performance.now();
    result = layout(graph.vertices, graph.edges);
    times.push(performance.now() - began);
  }
  times.sort((a, b) => a - b);
  const previous = Object.fromEntries(result.vertices.map((each) => [each.id, each]));
  const began = performance.now();
  layout(graph.vertices, graph.edges, { previous });
  const again = performance.now() - began;
  console.log(`${nodes} nodes, ${topics} topics, ${graph.edges.length} edges: `
    + `${times[2].toFixed(0)} ms (median of 5), again ${again.toFixed(0)} ms, `
    + `${result.crossings} crossings, ${result.width.toFixed(0)} x ${result.height.toFixed(0)}`);
}
