// What processes show from inside: publishers, subscriptions with their queues, buffers and
// callbacks of a topic or a node.

import { count, duration, percent, rate } from './format.js';

/** Returns a table's rows as cells: text, or numbers that are already printed.
 * @param {any} inside @returns {[string, string[], [string, ...string[]][]][]} */
export function tables(inside) {
  const half = (/** @type {any} */ it) => duration(it?.p50_seconds);
  const most = (/** @type {any} */ it) => duration(it?.p99_seconds);
  const who = (/** @type {any} */ it) => it.node ?? `process ${it.process_id}`;
  const all = /** @type {[string, string[], [string, ...string[]][]][]} */ ([
    ['Publishers', ['Topic', 'Node', 'Published', 'Within the process', 'Rate', 'Interval p50', 'p99'],
      (inside.publishers ?? []).map((/** @type {any} */ it) => [it.topic, who(it),
        count(it.published_messages), count(it.within_process_messages), rate(it.rate_hertz),
        half(it.interval), most(it.interval)])],
    ['Subscriptions', ['Topic', 'Node', 'Taken', 'Without message', 'Rate', 'Latency p50', 'p99'],
      (inside.subscriptions ?? []).map((/** @type {any} */ it) => [it.topic, who(it),
        count(it.taken_messages), count(it.failed_takes), rate(it.rate_hertz), half(it.latency),
        most(it.latency)])],
    ['Reader queues', ['Topic', 'Node', 'Arrived', 'Taken', 'Lost', 'Depth'],
      (inside.reader_queues ?? []).map((/** @type {any} */ it) => [it.topic, who(it),
        count(it.arrived_messages), count(it.taken_messages), count(it.lost_messages),
        count(it.depth)])],
    ['Buffers', ['Topic', 'Node', 'Put in', 'Overwritten', 'Rate', 'Waiting p50', 'p99'],
      (inside.buffers ?? []).map((/** @type {any} */ it) => [it.topic ?? 'unknown', who(it),
        count(it.enqueued_messages), count(it.overwritten_messages), rate(it.rate_hertz),
        half(it.waiting), most(it.waiting)])],
    ['Callbacks', ['Callback', 'Node', 'Calls', 'Busy', 'Rate', 'Duration p50', 'p99', 'Wait p99',
      'Thread'],
      (inside.callbacks ?? []).map((/** @type {any} */ it) => [trigger(it.trigger), who(it),
        count(it.calls), percent(it.busy_ratio), rate(it.rate_hertz), half(it.duration),
        most(it.duration), most(it.wait), states(it.states_ratio)])],
  ]);
  return all.filter(([, , rows]) => rows.length > 0);
}

/** Names the states in which a callback's thread spent a percent of the time or more.
 * @param {any} ratio null if the kernel does not show it */
export function states(ratio) {
  return ['cpu', 'throttled', 'runnable', 'blocked'].filter((state) => ratio?.[state] >= 0.01)
    .map((state) => `${state} ${Math.round(100 * ratio[state])}%`).join(' ');
}

/** Says why nothing is shown yet. @param {any} answer null before the first one */
export function waiting(answer) {
  if (!answer) return 'The agent begins to observe calls.';
  if (answer.mode === 'off') return 'The agent observes no calls: capture.inside is off.';
  return answer.reason ?? 'No call has been observed yet.';
}

/** Names what triggers a callback. @param {any} it */
export function trigger(it) {
  if (it.kind === 'timer') {
    return it.period_seconds == null ? 'timer' : `timer ${duration(it.period_seconds)}`;
  }
  return it.name ? (it.kind === 'service' ? `service ${it.name}` : it.name) : it.kind;
}
