// Layered layout of a directed graph, left to right, with boxes.
//
// A depth-first search breaks cycles, ranks are the longest paths pulled together, and long edges
// bend through one dummy per rank. Barycentre sweeps reduce crossings, and least squares with
// separations (pooled adjacent violators) give y. The same input gives the same picture. Positions
// in `previous` give the initial order; only a clear gain in crossings replaces it. So a picture
// keeps its order while the graph changes.

/**
 * @typedef {{id: string, w: number, h: number, parent?: string|null, title?: number}} Vertex
 *   `parent` is the id of its box; `title` the height that a box keeps free above its content.
 * @typedef {{id: string, from: string, to: string}} Edge
 * @typedef {{x: number, y: number}} Point
 * @typedef {{id: string, x: number, y: number, w: number, h: number, box: boolean}} Placed
 *   Centre and size.
 * @typedef {{id: string, points: Point[]}} Routed From the right of `from` to the left of `to`; the
 *   other way round if `to` lies to the left. All points lead into that direction.
 * @typedef {{width: number, height: number, crossings: number, vertices: Placed[],
 *   edges: Routed[]}} Layout
 * @typedef {{gapX?: number, gapY?: number, sweeps?: number, padding?: number,
 *   previous?: Record<string, Point>}} Options
 */

/** Minimum pixels between an edge and a vertex that it passes. */
const CLEAR = 4;
const SWEEPS = 24;
const SETTLES = 24;
// Number of vertices and dummies above which half the sweeps are made.
const LARGE = 4000;
// Weight of an edge, by its number of dummy ends: long edges become straight first.
const FORCE = [1, 2, 8];
// A new order replaces the previous one if it has at most this fraction of its crossings.
const GAIN = 0.75;

/**
 * Places vertices, boxes and edges.
 * @param {Vertex[]} vertices a vertex that is another one's `parent` is a box
 * @param {Edge[]} edges between vertices that are not boxes
 * @param {Options} [options]
 * @returns {Layout}
 */
export function layout(vertices, edges, options = {}) {
  const known = new Map(vertices.map((vertex) => [vertex.id, vertex]));
  /** @type {Map<string|null, Vertex[]>} */
  const children = new Map();
  const parentOf = (/** @type {Vertex} */ vertex) =>
    vertex.parent != null && known.has(vertex.parent) ? vertex.parent : null;
  for (const vertex of vertices) {
    const parent = parentOf(vertex);
    const list = children.get(parent);
    if (list) list.push(vertex);
    else children.set(parent, [vertex]);
  }
  const chain = (/** @type {string} */ id) => {
    const found = [];
    let at = /** @type {string|null} */ (id);
    while (at != null && found.length < 64) {
      found.push(at);
      at = parentOf(/** @type {Vertex} */ (known.get(at)));
    }
    return found;
  };
  // Each edge belongs to the innermost box around both ends, between children of that box.
  /** @type {Map<string|null, Link[]>} */
  const inner = new Map();
  edges.forEach((edge, index) => {
    if (!known.has(edge.from) || !known.has(edge.to)) return;
    const from = chain(edge.from);
    const to = chain(edge.to);
    while (from.length && to.length && from[from.length - 1] === to[to.length - 1]) {
      from.pop();
      to.pop();
    }
    if (!from.length || !to.length) return;
    const [a, b] = [from[from.length - 1], to[to.length - 1]];
    const owner = parentOf(/** @type {Vertex} */ (known.get(a)));
    const list = inner.get(owner);
    const item = { from: a, to: b, edge: index };
    if (list) list.push(item);
    else inner.set(owner, [item]);
  });

  const padding = options.padding ?? 12;
  const previous = options.previous ?? {};
  let crossings = 0;
  /** @type {Map<string, Placed>} */
  const placed = new Map();
  /** @type {Map<string|null, Layered & Point>} */
  const layers = new Map();
  /** @type {Map<string, {w: number, h: number}>} */
  const sizes = new Map();

  const measure = (/** @type {string|null} */ owner) => {
    const own = children.get(owner) ?? [];
    for (const child of own) {
      if (children.has(child.id)) {
        const content = measure(child.id);
        const title = child.title ?? 20;
        sizes.set(child.id, {
          w: Math.max(child.w, content.width + 2 * padding),
          h: content.height + 2 * padding + title,
        });
      } else {
        sizes.set(child.id, { w: child.w, h: child.h });
      }
    }
    const items = own.map((child) => ({ id: child.id, ...size(sizes, child.id) }));
    const result = arrange(items, inner.get(owner) ?? [], previous, options);
    crossings += result.crossings;
    layers.set(owner, { ...result, x: 0, y: 0 });
    return result;
  };
  const place = (/** @type {string|null} */ owner, /** @type {number} */ x,
    /** @type {number} */ y) => {
    const result = layers.get(owner);
    if (!result) return;
    result.x = x;
    result.y = y;
    for (const item of result.items) {
      const box = children.has(item.id);
      placed.set(item.id, { ...item, x: x + item.x, y: y + item.y, box });
      if (box) {
        const title = known.get(item.id)?.title ?? 20;
        const left = x + item.x - item.w / 2 + padding;
        place(item.id, left, y + item.y - item.h / 2 + padding + title);
      }
    }
  };
  /**
   * Returns the points from the side of a vertex to the border of the column of the box `last`,
   * which may be the vertex itself. They pass between the vertices of the boxes on the way.
   */
  const leave = (/** @type {string} */ id, /** @type {string} */ last,
    /** @type {number} */ side) => {
    const { x, y, w } = /** @type {Placed} */ (placed.get(id));
    const points = [{ x: x + (side * w) / 2, y }];
    for (let item = id; ;) {
      const owner = parentOf(/** @type {Vertex} */ (known.get(item)));
      const level = /** @type {Layered & Point} */ (layers.get(owner));
      const place = /** @type {Lane} */ (level.lanes.get(item));
      const beside = (/** @type {Column} */ { left, right }) => [left + level.x, right + level.x];
      let height = points[points.length - 1].y;
      points.push({ x: beside(place.columns[place.at])[side > 0 ? 1 : 0], y: height });
      if (item === last || owner == null) return points;
      for (let at = place.at + side; place.columns[at]; at += side) {
        height = free(place.columns[at].items, height - level.y) + level.y;
        const [left, right] = beside(place.columns[at]);
        for (const border of side > 0 ? [left, right] : [right, left]) {
          points.push({ x: border, y: height });
        }
      }
      item = owner;
    }
  };
  const whole = measure(null);
  place(null, 0, 0);

  const routed = [];
  for (const [owner, links] of inner) {
    const { x, y, paths, lanes } = /** @type {Layered & Point} */ (layers.get(owner));
    for (const link of links) {
      const [from, to] = [link.from, link.to].map((id) => lanes.get(id)?.at ?? 0);
      const edge = edges[link.edge];
      // An edge to the left leaves on that side, so that it passes under neither of its ends.
      const side = to < from ? -1 : 1;
      const bends = paths.get(link.edge) ?? [];
      routed.push({
        id: edge.id,
        points: distinct([
          ...leave(edge.from, link.from, side),
          ...bends.map((point) => ({ x: point.x + x, y: point.y + y })),
          ...leave(edge.to, link.to, side > 0 ? -1 : 1).reverse(),
        ]),
      });
    }
  }
  return {
    width: whole.width,
    height: whole.height,
    crossings,
    vertices: [...placed.values()],
    edges: routed,
  };
}

/** Leaves out points that repeat the previous one. @param {Point[]} points */
function distinct(points) {
  return points.filter(({ x, y }, at) => {
    const before = points[at - 1];
    return !before || Math.abs(before.x - x) + Math.abs(before.y - y) > 0.5;
  });
}

/**
 * Returns the height nearest to `y` that passes none of these items.
 * @param {{y: number, h: number}[]} items
 * @param {number} y
 */
function free(items, y) {
  const hides = (/** @type {number} */ at) => items.some(
    (item) => Math.abs(item.y - at) < item.h / 2 + CLEAR);
  if (!hides(y)) return y;
  const sides = items.flatMap(
    (item) => [-1, 1].map((side) => item.y + side * (item.h / 2 + CLEAR)));
  sides.sort((one, other) => Math.abs(one - y) - Math.abs(other - y));
  return sides.find((at) => !hides(at)) ?? y;
}

/** @param {Map<string, {w: number, h: number}>} sizes @param {string} id */
function size(sizes, id) {
  return sizes.get(id) ?? { w: 0, h: 0 };
}

/**
 * @typedef {{id: string, w: number, h: number}} Item
 * @typedef {{from: string, to: string, edge: number}} Link
 * @typedef {{id: string, x: number, y: number, w: number, h: number}} Arranged
 * @typedef {{left: number, right: number, items: Arranged[]}} Column
 * @typedef {{columns: Column[], at: number}} Lane the columns of a part, and that of the item
 * @typedef {{width: number, height: number, crossings: number, items: Arranged[],
 *   lanes: Map<string, Lane>, paths: Map<number, Point[]>}} Layered
 */

/**
 * Arranges one level: each connected part is layered separately, the parts are stacked, and vertices
 * without an edge fill rows below.
 * @param {Item[]} items
 * @param {Link[]} links
 * @param {Record<string, Point>} previous
 * @param {Options} options
 * @returns {Layered}
 */
function arrange(items, links, previous, options) {
  const gapX = options.gapX ?? 56;
  const gapY = options.gapY ?? 10;
  const index = new Map(items.map((item, place) => [item.id, place]));
  const root = items.map((_, place) => place);
  const find = (/** @type {number} */ at) => {
    while (root[at] !== at) {
      root[at] = root[root[at]];
      at = root[at];
    }
    return at;
  };
  for (const link of links) {
    const a = find(/** @type {number} */ (index.get(link.from)));
    const b = find(/** @type {number} */ (index.get(link.to)));
    if (a !== b) root[Math.max(a, b)] = Math.min(a, b);
  }
  /** @type {Map<number, {items: Item[], links: Link[]}>} */
  const parts = new Map();
  items.forEach((item, place) => {
    const key = find(place);
    const part = parts.get(key);
    if (part) part.items.push(item);
    else parts.set(key, { items: [item], links: [] });
  });
  for (const link of links) {
    parts.get(find(/** @type {number} */ (index.get(link.from))))?.links.push(link);
  }
  const joined = [];
  const alone = [];
  for (const part of parts.values()) {
    if (part.items.length > 1) joined.push(part);
    else alone.push(part.items[0]);
  }
  // Known parts keep their order; new ones follow, the largest first.
  const top = (/** @type {{items: Item[]}} */ part) => {
    let least = Infinity;
    for (const item of part.items) least = Math.min(least, previous[item.id]?.y ?? Infinity);
    return least;
  };
  const tops = new Map(joined.map((part) => [part, top(part)]));
  joined.sort((one, other) => {
    const [a, b] = [tops.get(one) ?? Infinity, tops.get(other) ?? Infinity];
    if (a !== b) return a < b ? -1 : 1;
    return other.items.length - one.items.length;
  });

  /** @type {Layered} */
  const all = {
    width: 0, height: 0, crossings: 0, items: [], lanes: new Map(), paths: new Map(),
  };
  for (const part of joined) {
    const result = layered(part.items, part.links, previous, gapX, gapY, options.sweeps ?? SWEEPS);
    const y = all.height > 0 ? all.height + 3 * gapY : 0;
    for (const item of result.items) item.y += y;
    all.items.push(...result.items);
    for (const [id, lane] of result.lanes) all.lanes.set(id, lane);
    for (const [edge, points] of result.paths) {
      all.paths.set(edge, points.map((point) => ({ x: point.x, y: point.y + y })));
    }
    all.width = Math.max(all.width, result.width);
    all.height = y + result.height;
    all.crossings += result.crossings;
  }
  if (alone.length) {
    let area = 0;
    for (const item of alone) area += (item.w + gapY * 2) * (item.h + gapY);
    const width = Math.max(all.width, Math.sqrt(area * 2.5));
    let x = 0;
    let y = all.height > 0 ? all.height + 3 * gapY : 0;
    let row = 0;
    /** @type {Column[]} */
    let columns = [];
    for (const item of alone) {
      if (x > 0 && x + item.w > width) {
        x = 0;
        y += row + gapY;
        row = 0;
        columns = [];
      }
      const arranged = { ...item, x: x + item.w / 2, y: y + item.h / 2 };
      all.items.push(arranged);
      all.lanes.set(item.id, { columns, at: columns.length });
      columns.push({ left: x, right: x + item.w, items: [arranged] });
      all.width = Math.max(all.width, x + item.w);
      x += item.w + gapY * 2;
      row = Math.max(row, item.h);
    }
    all.height = y + row;
  }
  return all;
}

/**
 * Layers one connected part.
 * @param {Item[]} items
 * @param {Link[]} links
 * @param {Record<string, Point>} previous
 * @param {number} gapX
 * @param {number} gapY
 * @param {number} sweeps
 * @returns {Layered}
 */
function layered(items, links, previous, gapX, gapY, sweeps) {
  const index = new Map(items.map((item, place) => [item.id, place]));
  // Each pair once, however many links it has.
  /** @type {Map<number, [number, number]>} */
  const pairs = new Map();
  for (const link of links) {
    const a = /** @type {number} */ (index.get(link.from));
    const b = /** @type {number} */ (index.get(link.to));
    if (a !== b) pairs.set(a * items.length + b, [a, b]);
  }
  const directed = acyclic(items, [...pairs.values()], previous);
  const rank = ranks(items.length, directed);
  const columns = new Columns(items, rank);
  /** @type {Map<number, number[]>} */
  const routes = new Map();
  for (const [a, b] of directed) {
    const key = a < b ? a * items.length + b : b * items.length + a;
    if (!routes.has(key)) routes.set(key, columns.join(a, b));
  }
  columns.seal();
  const crossings = order(columns, items, previous, sweeps);
  settle(columns, gapY);

  /** @type {{left: number, middle: number, right: number}[]} */
  const x = [];
  let width = 0;
  for (const column of columns.list) {
    let widest = 0;
    for (const vertex of column) widest = Math.max(widest, columns.width[vertex]);
    x.push({ left: width, middle: width + widest / 2, right: width + widest });
    width += widest + gapX;
  }
  width -= gapX;
  let least = Infinity;
  let most = -Infinity;
  for (let vertex = 0; vertex < columns.size; vertex += 1) {
    least = Math.min(least, columns.y[vertex] - columns.height[vertex] / 2);
    most = Math.max(most, columns.y[vertex] + columns.height[vertex] / 2);
  }
  /** @type {Map<number, Point[]>} */
  const paths = new Map();
  for (const link of links) {
    const a = /** @type {number} */ (index.get(link.from));
    const b = /** @type {number} */ (index.get(link.to));
    const route = routes.get(a < b ? a * items.length + b : b * items.length + a) ?? [];
    // A dummy is as wide as its column: two points make an edge horizontal there.
    const points = [];
    for (const vertex of route) {
      const { left, right } = x[columns.rank[vertex]];
      const y = columns.y[vertex] - least;
      points.push({ x: left, y }, { x: right, y });
    }
    if (rank[a] > rank[b]) points.reverse();
    paths.set(link.edge, points);
  }
  const arranged = items.map((item, vertex) => ({
    ...item, x: x[rank[vertex]].middle, y: columns.y[vertex] - least,
  }));
  /** @type {Column[]} */
  const sides = x.map(({ left, right }) => ({ left, right, items: [] }));
  arranged.forEach((item, vertex) => { sides[rank[vertex]].items.push(item); });
  const lanes = new Map(items.map((item, vertex) => [item.id, { columns: sides, at: rank[vertex] }]));
  return { width, height: most - least, crossings, items: arranged, lanes, paths };
}

/**
 * Removes cycles: pairs that lead backwards in a sequence of all vertices are reversed. The sequence
 * takes sources first and sinks last, else the vertex with most outgoing and fewest incoming edges.
 * @param {Item[]} items
 * @param {[number, number][]} pairs
 * @param {Record<string, Point>} previous
 * @returns {[number, number][]}
 */
function acyclic(items, pairs, previous) {
  /** @type {number[][]} */
  const out = items.map(() => []);
  /** @type {number[][]} */
  const into = items.map(() => []);
  for (const [a, b] of pairs) {
    out[a].push(b);
    into[b].push(a);
  }
  const giving = Int32Array.from(out, (list) => list.length);
  const taking = Int32Array.from(into, (list) => list.length);
  const sequence = new Int32Array(items.length).fill(-1);
  let first = 0;
  let last = items.length - 1;
  const ready = { sources: /** @type {number[]} */ ([]), sinks: /** @type {number[]} */ ([]) };
  const remove = (/** @type {number} */ vertex, /** @type {number} */ place) => {
    sequence[vertex] = place;
    for (const other of out[vertex]) {
      taking[other] -= 1;
      if (!taking[other]) ready.sources.push(other);
    }
    for (const other of into[vertex]) {
      giving[other] -= 1;
      if (!giving[other]) ready.sinks.push(other);
    }
  };
  items.forEach((_, vertex) => {
    if (!taking[vertex]) ready.sources.push(vertex);
    else if (!giving[vertex]) ready.sinks.push(vertex);
  });
  while (first <= last) {
    const source = ready.sources.pop();
    if (source !== undefined) {
      if (sequence[source] < 0) remove(source, first++);
      continue;
    }
    const sink = ready.sinks.pop();
    if (sink !== undefined) {
      if (sequence[sink] < 0) remove(sink, last--);
      continue;
    }
    // Vertices stay in their previous order: a new edge reverses no existing one.
    let best = -1;
    let most = -Infinity;
    for (let vertex = 0; vertex < items.length; vertex += 1) {
      if (sequence[vertex] >= 0) continue;
      const x = previous[items[vertex].id]?.x;
      const value = x === undefined ? giving[vertex] - taking[vertex] - 1e6 : -x;
      if (value > most) {
        most = value;
        best = vertex;
      }
    }
    remove(best, first++);
  }
  return pairs.map(([a, b]) => (sequence[a] < sequence[b] ? [a, b] : [b, a]));
}

/**
 * Ranks by longest paths, then moves each vertex to where its edges are shortest.
 * @param {number} size
 * @param {[number, number][]} directed
 */
function ranks(size, directed) {
  /** @type {number[][]} */
  const out = Array.from({ length: size }, () => []);
  /** @type {number[][]} */
  const into = Array.from({ length: size }, () => []);
  for (const [a, b] of directed) {
    out[a].push(b);
    into[b].push(a);
  }
  const rank = new Int32Array(size);
  const waiting = Int32Array.from(into, (list) => list.length);
  const sorted = [];
  for (let vertex = 0; vertex < size; vertex += 1) if (!waiting[vertex]) sorted.push(vertex);
  for (let place = 0; place < sorted.length; place += 1) {
    for (const next of out[sorted[place]]) {
      rank[next] = Math.max(rank[next], rank[sorted[place]] + 1);
      waiting[next] -= 1;
      if (!waiting[next]) sorted.push(next);
    }
  }
  for (let round = 0; round < 8; round += 1) {
    let moved = false;
    const turn = round % 2 === 0 ? sorted.slice().reverse() : sorted;
    for (const vertex of turn) {
      const pull = out[vertex].length - into[vertex].length;
      let least = 0;
      let most = Infinity;
      for (const before of into[vertex]) least = Math.max(least, rank[before] + 1);
      for (const after of out[vertex]) most = Math.min(most, rank[after] - 1);
      const wanted = pull > 0 && most !== Infinity ? most : pull < 0 ? least : rank[vertex];
      if (wanted !== rank[vertex]) {
        rank[vertex] = wanted;
        moved = true;
      }
    }
    if (!moved) break;
  }
  let least = Infinity;
  for (const value of rank) least = Math.min(least, value);
  for (let vertex = 0; vertex < size; vertex += 1) rank[vertex] -= least;
  return rank;
}

/** Concatenated lists of neighbours: those of `v` are from `begin[v]` to `begin[v + 1]`. */
class Neighbours {
  /** @param {number[][]} lists */
  constructor(lists) {
    this.begin = new Int32Array(lists.length + 1);
    lists.forEach((list, at) => { this.begin[at + 1] = this.begin[at] + list.length; });
    this.list = new Int32Array(this.begin[lists.length]);
    lists.forEach((list, at) => { this.list.set(list, this.begin[at]); });
  }
}

/** Vertices and dummies by rank, with their neighbours left and right. */
class Columns {
  /** @param {Item[]} items @param {Int32Array} rank */
  constructor(items, rank) {
    /** @type {number[]} */ this.rank = [...rank];
    this.width = items.map((item) => item.w);
    this.height = items.map((item) => item.h);
    /** @type {number[][]} */ this.left = items.map(() => []);
    /** @type {number[][]} */ this.right = items.map(() => []);
    this.real = items.length;
    /** @type {number[][]} */ this.list = [];
    for (let vertex = 0; vertex < items.length; vertex += 1) this.enter(vertex);
    /** @type {Float64Array} */ this.y = new Float64Array(0);
    this.toLeft = new Neighbours([]);
    this.toRight = new Neighbours([]);
  }

  get size() {
    return this.rank.length;
  }

  /** Packs the neighbours; no more can be added afterwards. */
  seal() {
    this.toLeft = new Neighbours(this.left);
    this.toRight = new Neighbours(this.right);
    this.y = new Float64Array(this.size);
  }

  /** @param {number} vertex */
  enter(vertex) {
    const rank = this.rank[vertex];
    while (this.list.length <= rank) this.list.push([]);
    this.list[rank].push(vertex);
  }

  /**
   * Connects two vertices through dummies, which it returns.
   * @param {number} a
   * @param {number} b
   */
  join(a, b) {
    const dummies = [];
    let before = a;
    for (let rank = this.rank[a] + 1; rank < this.rank[b]; rank += 1) {
      const dummy = this.size;
      this.rank.push(rank);
      this.width.push(0);
      this.height.push(4);
      this.left.push([before]);
      this.right.push([]);
      this.right[before].push(dummy);
      this.enter(dummy);
      dummies.push(dummy);
      before = dummy;
    }
    this.right[before].push(b);
    this.left[b].push(before);
    return dummies;
  }
}

/**
 * Orders each column; returns the crossings.
 * @param {Columns} columns
 * @param {Item[]} items
 * @param {Record<string, Point>} previous
 * @param {number} sweeps
 */
function order(columns, items, previous, sweeps) {
  const place = new Int32Array(columns.size);
  const mostly = startOrder(columns, items, previous);
  for (const column of columns.list) column.forEach((vertex, at) => { place[vertex] = at; });
  const kept = items.map((item) => previous[item.id]?.y);
  // First only new vertices move, then all, which requires a clear gain.
  const gentle = mostly ? swept(columns, place, sweeps / 2, kept) : Infinity;
  const initial = columns.list.map((column) => column.slice());
  const free = swept(columns, place, sweeps, null);
  if (free < gentle * GAIN || !mostly) return free;
  columns.list = initial;
  return gentle;
}

/**
 * Sweeps over the columns, leaves them in the best order found, and returns its crossings.
 * @param {Columns} columns
 * @param {Int32Array} place
 * @param {number} sweeps
 * @param {(number|undefined)[]|null} kept the y of vertices that keep their order
 */
function swept(columns, place, sweeps, kept) {
  const tree = new Int32Array(Math.max(...columns.list.map((column) => column.length)) + 2);
  let best = crossed(columns, place, tree);
  let chosen = columns.list.map((column) => column.slice());
  const key = new Float64Array(columns.size);
  let idle = 0;
  for (let sweep = 0; sweep < sweeps && best > 0 && idle < 6; sweep += 1) {
    const rightwards = sweep % 2 === 0;
    const near = rightwards ? columns.toLeft : columns.toRight;
    const last = columns.list.length - 1;
    for (let step = kept ? 0 : 1; step <= last; step += 1) {
      const column = columns.list[rightwards ? step : last - step];
      for (const vertex of column) {
        let sum = 0;
        for (let at = near.begin[vertex]; at < near.begin[vertex + 1]; at += 1) {
          sum += place[near.list[at]];
        }
        const count = near.begin[vertex + 1] - near.begin[vertex];
        key[vertex] = count ? sum / count : place[vertex];
      }
      column.sort((a, b) => key[a] - key[b] || place[a] - place[b]);
      if (kept) {
        const isKept = (/** @type {number} */ vertex) => kept[vertex] !== undefined;
        const own = column.filter(isKept);
        own.sort((a, b) => Number(kept[a]) - Number(kept[b]));
        let next = 0;
        column.forEach((vertex, at) => {
          if (isKept(vertex)) column[at] = own[next++];
        });
      }
      column.forEach((vertex, at) => { place[vertex] = at; });
    }
    // Counting is slower than sweeping: for a large graph it happens every other time.
    if (columns.size > LARGE && rightwards) continue;
    const found = crossed(columns, place, tree);
    idle += columns.size > LARGE ? 2 : 1;
    if (found < best) {
      best = found;
      chosen = columns.list.map((column) => column.slice());
      idle = 0;
    }
  }
  columns.list = chosen;
  for (const column of chosen) column.forEach((vertex, at) => { place[vertex] = at; });
  return best;
}

/**
 * Restores the previous order, with new vertices beside their neighbours. Returns whether any
 * vertex was known.
 * @param {Columns} columns
 * @param {Item[]} items
 * @param {Record<string, Point>} previous
 */
function startOrder(columns, items, previous) {
  const y = new Float64Array(columns.size).fill(NaN);
  let known = 0;
  items.forEach((item, vertex) => {
    const before = previous[item.id];
    if (before) {
      y[vertex] = before.y;
      known += 1;
    }
  });
  if (!known) return false;
  // Dummies and new vertices take the mean of their neighbours on both sides, until all have one.
  for (let round = 0; round < columns.list.length + 2; round += 1) {
    let missing = 0;
    for (let vertex = 0; vertex < columns.size; vertex += 1) {
      if (!Number.isNaN(y[vertex])) continue;
      let sum = 0;
      let count = 0;
      for (const other of [...columns.left[vertex], ...columns.right[vertex]]) {
        if (!Number.isNaN(y[other])) {
          sum += y[other];
          count += 1;
        }
      }
      if (count) y[vertex] = sum / count;
      else missing += 1;
    }
    if (!missing) break;
  }
  for (const column of columns.list) {
    column.sort((a, b) => {
      const [one, other] = [y[a], y[b]].map((value) => (Number.isNaN(value) ? 1e9 : value));
      return one - other || a - b;
    });
  }
  return known * 2 >= items.length;
}

/**
 * Counts the crossings between adjacent columns, by a Fenwick tree.
 * @param {Columns} columns
 * @param {Int32Array} place
 * @param {Int32Array} tree
 */
function crossed(columns, place, tree) {
  const { begin, list } = columns.toRight;
  let crossings = 0;
  for (let rank = 0; rank + 1 < columns.list.length; rank += 1) {
    const length = columns.list[rank + 1].length;
    tree.fill(0, 0, length + 2);
    let entered = 0;
    for (const vertex of columns.list[rank]) {
      // Edges of one vertex do not cross each other: count all of them before entering any.
      for (let edge = begin[vertex]; edge < begin[vertex + 1]; edge += 1) {
        let below = 0;
        for (let at = place[list[edge]] + 1; at > 0; at -= at & -at) below += tree[at];
        crossings += entered - below;
      }
      for (let edge = begin[vertex]; edge < begin[vertex + 1]; edge += 1) {
        for (let at = place[list[edge]] + 1; at <= length; at += at & -at) tree[at] += 1;
        entered += 1;
      }
    }
  }
  return crossings;
}

/**
 * Sets y of each vertex: near its neighbours, in the column's order, with a gap between them.
 * @param {Columns} columns
 * @param {number} gapY
 */
function settle(columns, gapY) {
  const { height, y } = columns;
  for (const column of columns.list) {
    let top = 0;
    for (const vertex of column) {
      y[vertex] = top + height[vertex] / 2;
      top += height[vertex] + gapY;
    }
  }
  const sides = [columns.toLeft, columns.toRight];
  const wanted = new Float64Array(columns.size);
  const weight = new Float64Array(columns.size);
  const rounds = columns.size > LARGE ? SETTLES / 2 : SETTLES;
  for (let round = 0; round < rounds; round += 1) {
    for (let step = 0; step < columns.list.length; step += 1) {
      const column = columns.list[round % 2 === 0 ? step : columns.list.length - 1 - step];
      for (const vertex of column) {
        let sum = 0;
        let total = 0;
        const own = vertex >= columns.real ? 1 : 0;
        for (const { begin, list } of sides) {
          for (let at = begin[vertex]; at < begin[vertex + 1]; at += 1) {
            const force = FORCE[own + (list[at] >= columns.real ? 1 : 0)];
            sum += force * y[list[at]];
            total += force;
          }
        }
        wanted[vertex] = total ? sum / total : y[vertex];
        weight[vertex] = total || 0.1;
      }
      separate(column, wanted, weight, height, gapY, y);
    }
  }
}

/**
 * Computes the positions nearest to `wanted` that keep order and gap: pooled adjacent violators.
 * @param {number[]} column
 * @param {Float64Array} wanted
 * @param {Float64Array} weight
 * @param {number[]} height
 * @param {number} gapY
 * @param {Float64Array} y receives the positions
 */
function separate(column, wanted, weight, height, gapY, y) {
  const offset = new Float64Array(column.length);
  /** @type {{sum: number, weight: number, size: number}[]} */
  const pools = [];
  column.forEach((vertex, at) => {
    if (at > 0) {
      const before = column[at - 1];
      offset[at] = offset[at - 1] + (height[before] + height[vertex]) / 2 + gapY;
    }
    let pool = {
      sum: (wanted[vertex] - offset[at]) * weight[vertex], weight: weight[vertex], size: 1,
    };
    while (pools.length) {
      const last = pools[pools.length - 1];
      if (last.sum / last.weight <= pool.sum / pool.weight) break;
      pools.pop();
      pool = {
        sum: last.sum + pool.sum, weight: last.weight + pool.weight, size: last.size + pool.size,
      };
    }
    pools.push(pool);
  });
  let at = 0;
  for (const pool of pools) {
    const base = pool.sum / pool.weight;
    for (let member = 0; member < pool.size; member += 1, at += 1) {
      y[column[at]] = base + offset[at];
    }
  }
}
