import assert from 'node:assert/strict';
import { test } from 'node:test';
import { layout } from '../layout.js';
import { robot } from './robot.js';

/** @param {string} text such as "a>b b>c" */
function graph(text) {
  const edges = text.split(' ').map((pair) => {
    const [from, to] = pair.split('>');
    return { id: pair, from, to };
  });
  const ids = [...new Set(edges.flatMap((edge) => [edge.from, edge.to]))];
  return { vertices: ids.map((id) => ({ id, w: 100, h: 20 })), edges };
}

/** @param {import('../layout.js').Layout} result */
function byId(result) {
  return new Map(result.vertices.map((vertex) => [vertex.id, vertex]));
}

/** @param {import('../layout.js').Placed} a @param {import('../layout.js').Placed} b */
function overlap(a, b) {
  return Math.abs(a.x - b.x) < (a.w + b.w) / 2 - 0.01
    && Math.abs(a.y - b.y) < (a.h + b.h) / 2 - 0.01;
}

test('a pipeline goes from left to right', () => {
  const { vertices, edges } = graph('a>b b>c a>c');
  const at = byId(layout(vertices, edges));
  const [a, b, c] = ['a', 'b', 'c'].map((id) => /** @type {any} */ (at.get(id)));
  assert.ok(a.x < b.x && b.x < c.x);
});

test('a cycle is drawn, with one edge that leads back', () => {
  const { vertices, edges } = graph('a>b b>c c>a');
  const result = layout(vertices, edges);
  const at = byId(result);
  const back = edges.filter((edge) => {
    const from = /** @type {any} */ (at.get(edge.from));
    const to = /** @type {any} */ (at.get(edge.to));
    return from.x > to.x;
  });
  assert.equal(back.length, 1);
  assert.equal(result.edges.length, 3);
  // It leaves its source to the left and passes under neither of its ends.
  const route = /** @type {any} */ (result.edges.find((edge) => edge.id === back[0].id));
  const from = /** @type {any} */ (at.get(back[0].from));
  const to = /** @type {any} */ (at.get(back[0].to));
  assert.equal(route.points[0].x, from.x - from.w / 2);
  assert.equal(route.points.at(-1).x, to.x + to.w / 2);
});

test('a node that talks to itself, and two edges of one pair', () => {
  const { vertices, edges } = graph('a>a a>b');
  edges.push({ id: 'again', from: 'a', to: 'b' });
  const result = layout(vertices, edges);
  assert.equal(result.edges.filter((edge) => edge.id === 'again').length, 1);
  for (const edge of result.edges) {
    for (const point of edge.points) assert.ok(Number.isFinite(point.x + point.y));
  }
});

test('nothing overlaps, and the picture holds everything', () => {
  const { vertices, edges } = robot(60, 150);
  const result = layout(vertices, edges);
  assert.equal(result.vertices.length, vertices.length);
  for (const [place, one] of result.vertices.entries()) {
    for (const other of result.vertices.slice(place + 1)) {
      assert.ok(!overlap(one, other), `${one.id} and ${other.id}`);
    }
    assert.ok(one.x - one.w / 2 > -0.01 && one.x + one.w / 2 < result.width + 0.01);
    assert.ok(one.y - one.h / 2 > -0.01 && one.y + one.h / 2 < result.height + 0.01);
  }
});

test('a simple bipartite graph is untangled', () => {
  const { vertices, edges } = graph('a>x b>y c>z');
  vertices.reverse();
  const joined = [...edges, ...graph('s>c s>a s>b x>t z>t y>t').edges];
  const all = [...vertices, { id: 's', w: 100, h: 20 }, { id: 't', w: 100, h: 20 }];
  assert.equal(layout(all, joined).crossings, 0);
});

test('the same graph gives the same picture', () => {
  const { vertices, edges } = robot(40, 100);
  assert.deepEqual(layout(vertices, edges), layout(vertices, edges));
});

test('a picture keeps its order when a node joins', () => {
  const { vertices, edges } = robot(30, 60);
  const before = layout(vertices, edges);
  const previous = Object.fromEntries(before.vertices.map((each) => [each.id, each]));
  const joined = [...vertices, { id: 'new', w: 160, h: 30 }];
  const after = layout(joined, [...edges, { id: 'e', from: 't7', to: 'new' }], { previous });
  const at = byId(before);
  const now = byId(after);
  let kept = 0;
  let pairs = 0;
  for (const one of vertices) {
    for (const other of vertices) {
      const [a, b] = [at.get(one.id), at.get(other.id)].map((each) => /** @type {any} */ (each));
      const [c, d] = [now.get(one.id), now.get(other.id)].map((each) => /** @type {any} */ (each));
      if (one.id >= other.id || a.x !== b.x || c.x !== d.x) continue;
      pairs += 1;
      if ((a.y < b.y) === (c.y < d.y)) kept += 1;
    }
  }
  assert.ok(pairs > 50, `${pairs}`);
  assert.ok(kept / pairs > 0.97, `${kept} of ${pairs}`);
});

test('vertices without an edge fill rows instead of one column', () => {
  const vertices = Array.from({ length: 100 }, (_, at) => ({ id: `v${at}`, w: 100, h: 20 }));
  const result = layout(vertices, []);
  assert.ok(result.height < 1000, `${result.height}`);
  assert.ok(result.width < 2000, `${result.width}`);
});

test('boxes hold their own and nothing else', () => {
  const { vertices, edges } = robot(24, 50);
  /** @type {import('../layout.js').Vertex[]} */
  const boxed = vertices.map((vertex, at) => ({
    ...vertex, parent: vertex.id.startsWith('n') ? `process${at % 6}` : null,
  }));
  for (let at = 0; at < 6; at += 1) {
    boxed.push({ id: `process${at}`, w: 60, h: 0, parent: `host${at % 2}`, title: 18 });
  }
  for (let at = 0; at < 2; at += 1) boxed.push({ id: `host${at}`, w: 60, h: 0 });
  const result = layout(boxed, edges);
  assert.equal(result.vertices.length, boxed.length);
  assert.equal(result.edges.length, edges.length);
  const at = byId(result);
  const parents = new Map(boxed.map((vertex) => [vertex.id, vertex.parent ?? null]));
  const within = (/** @type {string} */ id, /** @type {string} */ box) => {
    for (let up = parents.get(id); up; up = parents.get(up)) if (up === box) return true;
    return false;
  };
  for (const box of result.vertices.filter((vertex) => vertex.box)) {
    for (const other of result.vertices) {
      if (other.id === box.id || within(box.id, other.id)) continue;
      if (within(other.id, box.id)) {
        assert.ok(Math.abs(other.x - box.x) + other.w / 2 <= box.w / 2 + 0.01, other.id);
        assert.ok(Math.abs(other.y - box.y) + other.h / 2 <= box.h / 2 + 0.01, other.id);
      } else {
        assert.ok(!overlap(box, other), `${box.id} and ${other.id}`);
      }
    }
  }
  assert.ok(at.get('host0'));
});

test('no edge passes under a foreign vertex, into boxes and out of them', () => {
  for (const [nodes, topics] of [[24, 50], [60, 150], [120, 300]]) {
    const { vertices, edges } = robot(nodes, topics);
    vertices.forEach((vertex, at) => { vertex.w = 60 + ((at * 37) % 140); });
    /** @type {import('../layout.js').Vertex[]} */
    const boxed = vertices.map((vertex, at) => ({ ...vertex, parent: `process${at % 6}` }));
    for (let at = 0; at < 6; at += 1) {
      boxed.push({ id: `process${at}`, w: 60, h: 0, parent: at < 4 ? `host${at % 2}` : null });
    }
    for (const id of ['host0', 'host1']) boxed.push({ id, w: 60, h: 0, title: 18 });
    for (const all of [vertices, boxed]) {
      const result = layout(all, edges);
      assert.equal(result.edges.length, edges.length);
      const plain = result.vertices.filter((vertex) => !vertex.box);
      for (const route of result.edges) {
        const { from, to } = /** @type {any} */ (edges.find((edge) => edge.id === route.id));
        const foreign = plain.filter((vertex) => vertex.id !== from && vertex.id !== to);
        const drawn = along(route.points);
        const hit = foreign.find((vertex) => drawn.some(({ x, y }) => (
          Math.abs(x - vertex.x) < vertex.w / 2 && Math.abs(y - vertex.y) < vertex.h / 2)));
        assert.equal(hit, undefined, `${route.id} of ${nodes} nodes`);
      }
    }
  }
});

/** Returns points of the curve that the page draws. @param {import('../layout.js').Point[]} points */
function along(points) {
  return points.slice(1).flatMap((b, at) => {
    const a = points[at];
    return Array.from({ length: 17 }, (_, step) => {
      const t = step / 16;
      const part = t * t * (3 - 2 * t);
      const x = (1 - t) ** 3 * a.x + 3 * t * (1 - t) * ((a.x + b.x) / 2) + t ** 3 * b.x;
      return { x, y: a.y + part * (b.y - a.y) };
    });
  });
}

test('an edge to a vertex that does not exist is left out', () => {
  const { vertices, edges } = graph('a>b');
  const result = layout(vertices, [...edges, { id: 'lost', from: 'a', to: 'gone' }]);
  assert.equal(result.edges.length, 1);
});

test('an empty graph has a size', () => {
  const result = layout([], []);
  assert.deepEqual([result.width, result.height, result.vertices.length], [0, 0, 0]);
});
