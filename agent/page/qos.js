// Offered and requested QoS of endpoints, side by side, with incompatible policies marked.

import { bandwidth, count, duration, lastMessage, percent, rate } from './format.js';
import { address } from './router.js';
import { html, Mark, Name } from './ui.js';
import { state } from './store.js';

/** Most endpoints side by side; those of incompatible pairs come first. */
const MOST_COLUMNS = 8;

const infinite = (/** @type {number|null} */ seconds) =>
  (seconds == null ? 'infinite' : duration(seconds));

/** Each policy: its name in findings, its title, and its value. */
const POLICIES = /** @type {[string, string, (qos: any) => string][]} */ ([
  ['reliability', 'Reliability', (qos) => qos.reliability],
  ['durability', 'Durability', (qos) => qos.durability],
  ['history', 'History', (qos) => qos.history],
  ['deadline', 'Deadline', (qos) => infinite(qos.deadline_seconds)],
  ['lifespan', 'Lifespan', (qos) => infinite(qos.lifespan_seconds)],
  ['liveliness', 'Liveliness', (qos) => qos.liveliness],
  ['liveliness', 'Liveliness lease', (qos) => infinite(qos.liveliness_lease_seconds)],
  ['ownership', 'Ownership', (qos) => (qos.ownership_strength == null ? qos.ownership
    : `${qos.ownership} (${qos.ownership_strength})`)],
  ['partition', 'Partitions', (qos) => qos.partitions.join(', ') || 'default'],
]);

/** @param {{endpoint: any}} props */
function Owner({ endpoint }) {
  if (!endpoint.node) return html`<${Name} text=${endpoint.guid} most=${26} />`;
  return html`<a href=${address('nodes', endpoint.node)}><${Name} text=${endpoint.node} /></a>`;
}

/** @param {{details: any, topic: import('./state.js').Topic}} props */
export function Endpoints({ details, topic }) {
  const hasBuffers = [...details.publishers, ...details.subscriptions].some(
    (/** @type {any} */ each) => each.backends.length);
  const latches = details.publishers.some((/** @type {any} */ each) => each.latched);
  const row = (/** @type {any} */ endpoint, /** @type {boolean} */ publishes) => {
    const own = (publishes ? topic.publishers : topic.subscriptions)
      .find((each) => each.guid === endpoint.guid);
    const participant = own && state.participants.get(own.participant);
    const figures = endpoint.measurement ?? endpoint.past_figures;
    return html`<tr key=${endpoint.guid}><th scope="row"><${Owner} endpoint=${endpoint} /></th>
      <td><${Name} text=${[participant?.host, state.processName(participant),
        participant?.container].filter(Boolean).join(', ') || 'unknown'} /></td>
      <td>${endpoint.vendor ?? ''}</td>
      <td><${Name} text=${endpoint.message_type} /></td>
      ${hasBuffers && html`<td><${Name} text=${endpoint.backends.join(', ')} /></td>`}
      ${publishes && html`<td class="number">${rate(figures?.rate_hertz)}</td>
      <td class="number">${bandwidth(figures?.bandwidth_bytes_per_second)}</td>
      <td class="number">${percent(figures?.loss_ratio)}</td>`}
      ${publishes && latches && html`<td>${endpoint.latched && lastMessage(endpoint.latched)}</td>`}
      <td><${Name} text=${endpoint.guid} /></td></tr>`;
  };
  const table = (/** @type {any[]} */ list, /** @type {boolean} */ publishes) => html`
    <div class="scroll" tabindex="0" role="group"
      aria-label=${publishes ? 'Publishers' : 'Subscriptions'}><table>
    <caption>${publishes ? 'Publishers' : 'Subscriptions'} (${count(list.length)})</caption>
    <thead><tr><th scope="col">Node</th><th scope="col">Where</th>
      <th scope="col">Implementation</th><th scope="col">Type</th>
      ${hasBuffers && html`<th scope="col">Buffers in</th>`}
      ${publishes && html`<th scope="col" class="number">Rate</th>
      <th scope="col" class="number">Bandwidth</th><th scope="col" class="number">Loss</th>`}
      ${publishes && latches && html`<th scope="col">Last message</th>`}
      <th scope="col">GUID</th></tr></thead>
    <tbody>${list.map((endpoint) => row(endpoint, publishes))}</tbody></table></div>`;
  return html`<section aria-labelledby="endpoints"><h2 id="endpoints">Publishers and
    subscriptions</h2>
    ${details.publishers.length ? table(details.publishers, true)
      : html`<p class="dim">No publisher.</p>`}
    ${details.subscriptions.length ? table(details.subscriptions, false)
      : html`<p class="dim">No subscription.</p>`}</section>`;
}

/** @param {{details: any}} props */
export function Offered({ details }) {
  const broken = details.diagnoses.filter((/** @type {any} */ each) =>
    each.kind === 'qos_incompatible');
  // GUID of an endpoint to its policies that are incompatible with some counterpart.
  /** @type {Map<string, Set<string>>} */
  const bad = new Map();
  for (const each of broken) {
    for (const guid of [each.writer, each.reader]) {
      const policies = bad.get(guid) ?? new Set();
      for (const policy of each.policies) policies.add(policy);
      bad.set(guid, policies);
    }
  }
  const first = (/** @type {any} */ endpoint) => (bad.has(endpoint.guid) ? 0 : 1);
  const sorted = (/** @type {any[]} */ list) =>
    [...list].sort((one, other) => first(one) - first(other)).slice(0, MOST_COLUMNS);
  const publishers = sorted(details.publishers);
  const subscriptions = sorted(details.subscriptions);
  const all = [...publishers, ...subscriptions];
  if (!all.length) return null;
  const left = details.publishers.length + details.subscriptions.length - all.length;
  const nameOf = (/** @type {string} */ guid) => [...details.publishers, ...details.subscriptions]
    .find((each) => each.guid === guid)?.node ?? guid;
  const cell = (/** @type {any} */ endpoint, /** @type {string} */ policy,
    /** @type {(qos: any) => string} */ print) => {
    const wrong = bad.get(endpoint.guid)?.has(policy);
    return html`<td key=${endpoint.guid} class=${wrong ? 'bad' : ''}>${wrong
      ? html`<${Mark} severity="error" /> ` : ''}<${Name} text=${print(endpoint.qos)} /></td>`;
  };
  return html`<section aria-labelledby="qos"><h2 id="qos">Quality of service</h2>
    ${broken.map((/** @type {any} */ each) => html`<p class="bad" key=${each.writer + each.reader}>
      <${Mark} severity="error" /> <${Name} text=${nameOf(each.writer)} /> offers less than <${Name}
      text=${nameOf(each.reader)} /> requests: ${each.policies.join(', ').replaceAll('_', ' ')}.
      No message passes between them.</p>`)}
    <div class="scroll" tabindex="0" role="group" aria-labelledby="qos"><table class="side">
    <thead><tr><td></td>
      ${publishers.length > 0 && html`<th scope="colgroup" colspan=${publishers.length}>offered by</th>`}
      ${subscriptions.length > 0 && html`<th scope="colgroup"
        colspan=${subscriptions.length}>requested by</th>`}</tr>
      <tr><th scope="col">Policy</th>${all.map((endpoint) => html`<th scope="col"
        key=${endpoint.guid}><${Owner} endpoint=${endpoint} /></th>`)}</tr></thead>
    <tbody>${POLICIES.map(([policy, title, print]) => html`<tr key=${title}>
      <th scope="row">${title}</th>${all.map((endpoint) => cell(endpoint, policy, print))}</tr>`)}
    </tbody></table></div>
    ${left > 0 && html`<p class="dim">${count(left)} more endpoints are in the tables above.</p>`}
    </section>`;
}
