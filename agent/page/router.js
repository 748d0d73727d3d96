// Addresses of views: `#/topics/%2Fpoints?domain=0`. The fragment never reaches the agent.

/**
 * @typedef {{view: string, name: string|null, query: Record<string, string>}} Route
 *   `name` is that of the topic or node in the view, if any.
 */

const VIEWS = ['', 'topics', 'graph', 'chains', 'nodes', 'robot', 'events', 'recordings', 'agent',
  'doctor', 'fleet', 'token'];

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
 * Returns the address of a view. Names of robots are HOST:PORT, and a fragment may have colons.
 * @param {string} view
 * @param {string|null} [name]
 * @param {Record<string, string|number|boolean|null|undefined>} [query] empty values are omitted
 */
export function address(view, name = null, query = {}) {
  const given = Object.entries({ ...time, ...query })
    .filter(([, value]) => value != null && value !== '' && value !== false)
    .map(([key, value]) => [key, value === true ? '1' : String(value)]);
  const rest = new URLSearchParams(given).toString();
  const path = name == null ? view : `${view}/${encodeURIComponent(name).replaceAll('%3A', ':')}`;
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

/** Sections of the view of a topic by the kind of a finding. */
const SECTIONS = /** @type {Record<string, string>} */ ({
  loss: 'waterfall', watch_violated: 'course', watch_silent: 'course', wrong_stamps: 'course',
  qos_incompatible: 'qos', type_conflict: 'endpoints', type_hash_conflict: 'endpoints',
  unmatched_publisher: 'endpoints', unmatched_subscription: 'endpoints', near_miss: 'endpoints',
  buffers_by_cpu: 'endpoints', slow_callback: 'inside', executor_wait: 'inside',
  late_callback: 'inside', intra_process_overflow: 'inside', reader_queue_overflow: 'inside',
});

/**
 * Returns the section of a topic that a finding is about, or undefined.
 * @param {{kind: string, text: string}} finding
 */
function sectionOf({ kind, text }) {
  // An expectation names its limits: only that of losses is not a figure over time.
  if (kind === 'watch_violated' && /a loss of at most/.test(text)) return 'waterfall';
  if (kind === 'watch_violated' && /at least \d+ (publisher|subscriber)/.test(text)) return 'endpoints';
  return SECTIONS[kind];
}

/**
 * Returns address and title of the part of the robot or of the agent that a finding is about, or
 * null. The id of a finding has the names that its text only mentions.
 * @param {{kind: string, id: string}} finding
 * @param {{name: string}|null} node
 * @returns {[string, string]|null}
 */
function partAddress({ kind, id }, node) {
  const [, domain, first, ...more] = id.split('|');
  const robot = (/** @type {string} */ part, /** @type {string} */ title,
    /** @type {Record<string, string|undefined>} */ query = {}) =>
    /** @type {[string, string]} */ ([address('robot', part, query), title]);
  switch (kind) {
    case 'log_errors': return robot('logs', node ? `Logs of ${node.name}` : 'Logs',
      { filter: node?.name, level: 'error' });
    case 'diagnostic_error': return robot('diagnostics', 'Diagnostics', { filter: more[0] });
    case 'transform_fault': return robot('transforms', 'Transforms',
      { part: frameId(Number(domain), first ?? '', more.slice(0, -1).join('|')) });
    case 'parameter_drift': return robot('parameters', 'Parameters',
      { filter: [node?.name, ...more].join(' ').trim() });
    case 'mixed_time': return robot('parameters', 'Parameters', { filter: 'use_sim_time' });
    case 'hanging_call': return robot('services', 'Services',
      { filter: first?.replace(/^r[qr]\//, '/').replace(/Re(quest|ply)$/, '') });
    case 'clocks_apart': return robot('clocks', 'Clocks', { part: clockId(domain ?? '') });
    case 'lossy_link': return [address('nodes', null, { part: 'links' }), 'TCP links'];
    case 'agent_drops': return [address('agent', null, { part: 'drops' }), 'Agent'];
    case 'topics_rejected': return [address('agent', null, { part: 'limits' }), 'Agent'];
    default: return null;
  }
}

/** Returns the id of a frame's element. @param {number} domain @param {string} namespace @param {string} name */
export function frameId(domain, namespace, name) {
  return `frame ${domain} ${namespace} ${name}`;
}

/** Returns the id of the element of a host's clock. @param {string} peer */
export function clockId(peer) {
  return `clock ${peer}`;
}

/**
 * Returns address and title of the section that a finding is about; null if it is the agent.
 * @param {{kind: string, id: string, text: string}} finding
 * @param {{name: string, domain: number}|null} topic
 * @param {{name: string, domain: number}|null} node
 * @returns {[string, string]|null}
 */
export function findingAddress(finding, topic, node) {
  if (finding.kind === 'slow_chain') return [address('chains', null, { filter: topic?.name }), 'Chains'];
  const part = sectionOf(finding);
  if (topic) return [address('topics', topic.name, { domain: topic.domain, part }), topic.name];
  const place = partAddress(finding, node);
  if (place || !node) return place;
  return [address('nodes', node.name, { domain: node.domain,
    part: finding.kind.startsWith('duplicate') || finding.kind.startsWith('node_in_') ? 'where' : part }), node.name];
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
