// The tree of frames, from its edges.

/**
 * @typedef {{name: string, edge: any, children: Frame[]}} Frame a frame, its edge to the parent (null
 *   for a root), and the frames below it
 */

/**
 * Returns the roots, with the frames below them, sorted by name. Frames in a circle follow as roots,
 * so that each edge is shown once.
 * @param {{parent: string, child: string}[]} edges
 * @returns {Frame[]}
 */
export function roots(edges) {
  /** @type {Map<string, any[]>} */
  const below = new Map();
  const children = new Set();
  for (const edge of edges) {
    below.set(edge.parent, [...(below.get(edge.parent) ?? []), edge]);
    children.add(edge.child);
  }
  const shown = new Set();
  /** @param {string} name @param {any} edge @returns {Frame} */
  const frame = (name, edge) => {
    const own = (below.get(name) ?? []).filter((each) => !shown.has(each));
    own.forEach((each) => shown.add(each));
    own.sort((one, other) => (one.child < other.child ? -1 : 1));
    return { name, edge, children: own.map((each) => frame(each.child, each)) };
  };
  const parents = [...below.keys()].sort();
  const found = parents.filter((name) => !children.has(name)).map((name) => frame(name, null));
  for (const name of parents) {
    if ((below.get(name) ?? []).some((each) => !shown.has(each))) found.push(frame(name, null));
  }
  return found;
}
