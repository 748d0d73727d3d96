// What views read in place of the present while they show a moment in the past: the answers that the
// history keeps, once a minute, each whole.

import { Refusal } from './api.js';

/** Nouns whose answers the history keeps. */
const KEPT = ['parameters', 'diagnostics', 'transforms', 'clocks', 'chains', 'actions', 'services', 'health', 'logs',
  'participants', 'nodes', 'graph', 'topics'];
/** Levels of logs from the least to the most severe. */
const LEVELS = ['debug', 'info', 'warn', 'error', 'fatal'];
/** Time before a moment in which a process has a row, in seconds. */
const ROW_S = 120;

/** Whether ROS hides a name. @param {string} name */
const isHidden = (name) => /(^|\/)_/.test(name);

/**
 * Returns the request for what another request would have answered at a moment, and the part of its
 * answer that is meant; null if that is not kept.
 * @param {string} path
 * @param {number} at Unix time
 * @returns {{path: string, part: (answer: any) => any}|null}
 */
export function pastOf(path, at) {
  const [way, query = ''] = path.split('?');
  const [noun, name, ...more] = way.split('/');
  const words = new URLSearchParams(query);
  if (way === 'processes') {
    return { path: `history/processes?from=${at - ROW_S}&to=${at}`, part: processes };
  }
  if (!KEPT.includes(noun) || more.length || (name != null && noun !== 'topics' && noun !== 'nodes')) return null;
  if (name == null) return { path: `history/moment/${noun}?at=${at}`, part: (answer) => list(noun, words, answer) };
  const domain = words.get('domain_id');
  // A list of hundreds of topics has megabytes.
  return { path: `history/moment/${noun}?at=${at}&name=${name}${domain == null ? '' : `&domain_id=${domain}`}`,
    part: (answer) => named(noun, answer, decodeURIComponent(name)) };
}

/** Returns the part of a list that a query selects. @param {string} noun @param {URLSearchParams} words @param {any} answer */
function list(noun, words, answer) {
  const domain = words.get('domain_id');
  const isMeant = (/** @type {any} */ each) => domain == null || each.domain_id === Number(domain);
  if (noun === 'logs') {
    const least = LEVELS.indexOf(words.get('level') ?? '');
    const all = answer.messages.filter((/** @type {any} */ each) => LEVELS.indexOf(each.level) >= least);
    return { ...answer, messages: all.slice(-Number(words.get('limit') ?? all.length)) };
  }
  const showsHidden = words.get('hidden') === 'true';
  if (noun === 'services' || noun === 'actions') {
    return { ...answer, [noun]: answer[noun].filter((/** @type {any} */ each) => isMeant(each)
      && (showsHidden || !(each.hidden ?? isHidden(each.name)))) };
  }
  if (noun === 'graph' && !showsHidden) {
    const nodes = answer.nodes.filter((/** @type {any} */ each) => !isHidden(each.name));
    const known = new Set(nodes.map((/** @type {any} */ each) => each.id));
    return { ...answer, nodes, edges: answer.edges.filter((/** @type {any} */ each) =>
      known.has(each.source) && known.has(each.target)) };
  }
  return answer;
}

/**
 * Returns the topic or node of an answer that has only those of one name, or of a longer one: a topic
 * `scan` of DDS has the name of the ROS topic `/scan` without its slash.
 * @param {string} noun @param {any} answer @param {string} name
 */
function named(noun, answer, name) {
  const exact = answer[noun].filter((/** @type {any} */ each) => each.name === name || each.dds_name === name);
  const all = exact.length ? exact : answer[noun];
  // Requests and replies of a service have the ROS name of the service, which a topic may have, too.
  const found = all.find((/** @type {any} */ each) => !['service_request', 'service_reply'].includes(each.kind)) ?? all[0];
  if (!found) throw new Refusal(404, 'it is not in what the history keeps of that time');
  if (noun === 'topics') return found;
  const shown = (/** @type {any[]} */ names) => names.filter((each) => !isHidden(each.name));
  return { ...found, publishers: shown(found.publishers), subscriptions: shown(found.subscriptions),
    services: shown(found.services), clients: shown(found.clients) };
}

/** Returns the last row of each process. @param {any} answer */
function processes(answer) {
  const rows = answer.processes.filter((/** @type {any} */ each) => each.times.length);
  return { unreadable: 0, processes: rows.map((/** @type {any} */ each) => ({
    process_id: each.process_id, process: each.process, cpu_cores: each.cpu_cores.at(-1),
    memory_bytes: each.memory_bytes.at(-1) })) };
}
