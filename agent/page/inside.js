// What processes show from inside: publishers, subscriptions with their queues, buffers and
// callbacks of a topic or a node.

import { count, duration, percent, rate } from './format.js';
import { html, Name } from './ui.js';

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
    ['Callbacks', ['Callback', 'Node', 'Calls', 'Busy', 'Rate', 'Duration p50', 'p99', 'Wait p99'],
      (inside.callbacks ?? []).map((/** @type {any} */ it) => [trigger(it.trigger), who(it),
        count(it.calls), percent(it.busy_ratio), rate(it.rate_hertz), half(it.duration),
        most(it.duration), most(it.wait)])],
  ]);
  return all.filter(([, , rows]) => rows.length > 0);
}

/** @param {any} it */
function trigger(it) {
  if (it.kind === 'timer') {
    return it.period_seconds == null ? 'timer' : `timer ${duration(it.period_seconds)}`;
  }
  return it.name ? (it.kind === 'service' ? `service ${it.name}` : it.name) : it.kind;
}

/** @param {{inside: any}} props */
export function Inside({ inside }) {
  const shown = inside ? tables(inside) : [];
  if (!shown.length && !inside?.lifecycle_state) return null;
  return html`<section aria-labelledby="inside"><h2 id="inside">Inside the processes</h2>
    ${inside.lifecycle_state && html`<p>Lifecycle state: <${Name}
      text=${inside.lifecycle_state} /></p>`}
    ${inside.busy_ratio != null && html`<p>Its callbacks take ${percent(inside.busy_ratio)} of the
      time.</p>`}
    ${shown.map(([title, head, rows]) => html`<div class="scroll" key=${title} tabindex="0"
      role="group" aria-label=${title}><table><caption>${title}</caption><thead><tr>${head.map(
      (name, at) => html`<th scope="col" class=${at > 1 ? 'number' : ''}>${name}</th>`)}</tr></thead>
      <tbody>${rows.map((row, place) => html`<tr key=${place}>${row.map((cell, at) => at === 0
        ? html`<th scope="row"><${Name} text=${cell} /></th>` : at === 1
          ? html`<td><${Name} text=${cell} /></td>` : html`<td class="number">${cell}</td>`)}</tr>`)}
      </tbody></table></div>`)}</section>`;
}
