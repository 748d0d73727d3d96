// Addresses of views: `#/topics/%2Fpoints?domain=0`. The fragment never reaches the agent.

/**
 * @typedef {{view: string, name: string|null, query: Record<string, string>}} Route
 *   `name` is that of the topic or node in the view, if any.
 */

const VIEWS = ['', 'topics', 'graph', 'chains', 'nodes', 'robot', 'events', 'recordings', 'agent',
  'doctor', 'token'];

/**
 * @param {string} fragment with or without its `#`
 * @returns {Route|null} null if no view has that address
 */
export function parse(fragment) {
  const text = fragment.replace(/^#/, '').replace(/^\/?/, '');
  const [path, query = ''] = split(text, '?');
  const [view, name] = split(path, '/');
  if (!VIEWS.includes(view)) return null;
  try {
    return {
      view,
      name: name ? decodeURIComponent(name) : null,
      query: Object.fromEntries(new URLSearchParams(query)),
    };
  } catch {
    // A fragment typed by hand may contain an invalid escape.
    return null;
  }
}

/** Keys of the time that the page shows, which every address keeps. */
const TIME = ['span', 'at'];
/** @type {Record<string, string>} */
let time = {};

/** Keeps the time of an address for the following ones. @param {Record<string, string>} query */
export function keepTime(query) {
  time = Object.fromEntries(TIME.filter((key) => query[key]).map((key) => [key, query[key]]));
}

/**
 * @param {string} view
 * @param {string|null} [name]
 * @param {Record<string, string|number|boolean|null|undefined>} [query] empty values are omitted
 */
export function address(view, name = null, query = {}) {
  const given = Object.entries({ ...time, ...query })
    .filter(([, value]) => value != null && value !== '' && value !== false)
    .map(([key, value]) => [key, value === true ? '1' : String(value)]);
  const rest = new URLSearchParams(given).toString();
  const path = name == null ? view : `${view}/${encodeURIComponent(name)}`;
  return `#/${path}${rest ? `?${rest}` : ''}`;
}

/** @param {{name: string, domain: number}} topic */
export function topicAddress(topic) {
  return address('topics', topic.name, { domain: topic.domain });
}

/** @param {{name: string, domain: number}} node */
export function nodeAddress(node) {
  return address('nodes', node.name, { domain: node.domain });
}

/** Parts of the view of the robot by the kind of a finding. */
const PARTS = /** @type {Record<string, [string, string]>} */ ({
  log_errors: ['logs', 'Logs'], diagnostic_error: ['diagnostics', 'Diagnostics'],
  transform_fault: ['transforms', 'Transforms'], parameter_drift: ['parameters', 'Parameters'],
  mixed_time: ['parameters', 'Parameters'], hanging_call: ['services', 'Services'],
  clocks_apart: ['clocks', 'Clocks'],
});

/**
 * Returns address and title of the part of the robot that a finding is about, or null.
 * @param {string} kind
 * @returns {[string, string]|null}
 */
export function partAddress(kind) {
  const found = PARTS[kind];
  return found ? [address('robot', found[0]), found[1]] : null;
}

/**
 * Returns the token that `rp page` puts into the fragment, or null.
 * @param {string} fragment
 */
export function tokenOf(fragment) {
  const found = /^#?token=([0-9A-Za-z._~+/-]+=*)$/.exec(fragment);
  return found ? found[1] : null;
}

/** @param {string} text @param {string} by @returns {[string, string|undefined]} */
function split(text, by) {
  const at = text.indexOf(by);
  return at < 0 ? [text, undefined] : [text.slice(0, at), text.slice(at + 1)];
}
