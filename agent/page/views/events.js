// Events: those kept since the agent started, and new ones as they happen.

import { useEffect, useState } from '../vendor/hooks.mjs';
import { request } from '../api.js';
import { count, date, eventWords, several, visible, when } from '../format.js';
import { address } from '../router.js';
import { replaceAddress, state, useLive } from '../store.js';
import { inWords, useEventHistory, useTime } from '../timebar.js';
import { Failed, Filter, html, Mark, matches, Name } from '../ui.js';

/** Most events in the document; the filter finds older ones. */
const MOST_SHOWN = 300;

/** Events that each node brings by the dozen when it starts and ends. */
const ROUTINE = /^ros2\.(endpoint|participant)\./;

const SEVERITY = /** @type {Record<string, string>} */ ({
  ERROR: 'error', WARN: 'warning', INFO: 'note',
});

/**
 * Parses the events of a finished stream of server-sent events.
 * @param {string} text
 * @returns {import('../state.js').Event[]}
 */
export function parseEvents(text) {
  const events = [];
  for (const block of text.split(/\r?\n\r?\n/)) {
    const data = block.split(/\r?\n/).filter((line) => line.startsWith('data:'))
      .map((line) => line.slice(5).trimStart()).join('\n');
    if (!data || /^event: ?lagged$/m.test(block)) continue;
    events.push(JSON.parse(data));
  }
  return events;
}

/** Attributes that other parts of an event's line show. */
const SHOWN = ['topic', 'diagnosis'];

/**
 * Formats an event's attributes. A GUID with a known name becomes that name.
 * @param {Record<string, unknown>} attributes
 * @param {(guid: string) => string|undefined} [nameOf]
 */
export function attributesText(attributes, nameOf) {
  const text = (/** @type {unknown} */ value) =>
    (typeof value === 'string' ? nameOf?.(value) ?? value : JSON.stringify(value));
  return Object.entries(attributes).map(([name, value]) => `${visible(name === 'ros_node' ? 'node'
    : name.replaceAll('_', ' '))}: ${visible(Array.isArray(value) ? value.map(text).join(', ') : text(value))}`)
    .join(', ');
}

/** Names of endpoints and participants by GUID, also of departed ones. */
const owners = /** @type {Map<string, string>} */ (new Map());
const MOST_OWNERS = 20000;

/** Adds the present endpoints and participants, and returns all names. */
function ownersNow() {
  if (owners.size > MOST_OWNERS) owners.clear();
  for (const node of state.nodes.values()) {
    for (const id of node.participants) {
      const participant = state.participants.get(id);
      if (participant) owners.set(participant.guid, node.name);
    }
  }
  for (const topic of state.topics.values()) {
    for (const endpoint of [...topic.publishers, ...topic.subscriptions]) {
      const { name, node } = state.ownerOf(endpoint);
      if (node) owners.set(endpoint.guid, name);
    }
  }
  return owners;
}

/** Returns the part of a GUID that all endpoints of a participant share. @param {string} guid */
const prefixOf = (guid) => guid.slice(0, guid.lastIndexOf('.'));

/**
 * Returns a function that names a GUID: by its node, else by the nodes of its participant, else by its
 * topic or its process. Departed ones have the names that events carry.
 * @param {import('../state.js').Event[]} events
 * @param {Map<string, string>} known names of present endpoints and participants
 * @returns {(guid: string) => string|undefined}
 */
export function namesOf(events, known) {
  const names = new Map(known);
  /** @type {Map<string, Set<string>>} */
  const nodes = new Map();
  /** @type {Map<string, string>} */
  const others = new Map();
  for (const { name, attributes } of events) {
    const { participant, ros_node: node, writer, endpoint, topic, role, process, host } = (
      /** @type {Record<string, any>} */ (attributes));
    if (/^ros2\.node\./.test(name) && participant && node) {
      nodes.set(prefixOf(participant), (nodes.get(prefixOf(participant)) ?? new Set()).add(node));
    }
    if (name === 'ros2.message.lost' && writer && node) names.set(writer, node);
    if (endpoint) others.set(endpoint, `${role} of ${topic}`);
    else if (participant && (process || host)) others.set(participant, [process, host].filter(Boolean).join(' on '));
  }
  return (guid) => {
    const [one, ...more] = nodes.get(prefixOf(guid)) ?? [];
    return names.get(guid) ?? (one && (more.length ? `participant of ${one} and others` : one)) ?? others.get(guid);
  };
}

/**
 * Requests the events that the agent keeps, once for each stream: a stream has no events from before it
 * was opened. Returns why they are missing.
 */
export function useEarlier() {
  const [failed, fail] = useState('');
  const { openings } = state;
  useEffect(() => {
    const abort = new AbortController();
    request('events?after=0&follow=false', { signal: abort.signal })
      .then((response) => response.text())
      .then((text) => {
        state.addEvents(parseEvents(text));
        fail('');
      })
      .catch((error) => { if (!abort.signal.aborted) fail(error.message); });
    return () => abort.abort();
  }, [openings]);
  return failed;
}

/**
 * Returns why a list of events is empty.
 * @param {boolean} isPast whether they are those of a time
 * @param {boolean} isRead whether the events of that time are known
 * @param {number} number of events before they were filtered
 */
export function whyEmpty(isPast, isRead, number) {
  if (number) return 'No event matches.';
  if (!isPast) return 'No event yet.';
  return isRead ? 'No event in this time.' : 'Reading the history …';
}

/** @param {{query: Record<string, string>}} props */
export function Events({ query }) {
  useLive();
  const failed = useEarlier();
  const [held, hold] = useState(/** @type {import('../state.js').Event[]|null} */ (null));
  const { filter = '', severity = '' } = query;
  const change = (/** @type {Record<string, any>} */ more) => replaceAddress(
    address('events', null, { ...query, ...more }));
  const shown = useTime();
  const { events: past, isTruncated, isRead, problem } = useEventHistory(shown);
  const isPast = shown.at != null || (query.span != null && state.open?.keeps_history);
  // Events before the shown ones name what they mention.
  const names = namesOf([...past, ...state.events], ownersNow());
  const all = isPast ? past : held ?? state.events;
  const rows = all.filter((/** @type {any} */ event) =>
    (severity || filter || !ROUTINE.test(event.name))
    && (!severity || severity === 'ALL' || event.severity === severity || (severity === 'WARN' && event.severity === 'ERROR'))
    && (!filter || matches(filter, `${event.name} ${eventWords(event)} ${attributesText(event.attributes)} ${
      attributesText(event.attributes, names)}`))).reverse();
  const fresh = held ? state.events.length - held.length : 0;
  return html`<h1 tabindex="-1">Events</h1>
    ${isPast && html`<p>${inWords(shown)}</p>`}
    <div class="controls">
      <${Filter} label="Filter" value=${filter} found=${rows.length} noun="event"
        change=${(/** @type {string} */ text) => change({ filter: text })} />
      <label>Show <select value=${severity}
        onChange=${(/** @type {any} */ event) => change({ severity: event.target.value })}>
        <option value="">all but discovery</option><option value="ALL">all</option>
        <option value="WARN">warnings and errors</option>
        <option value="ERROR">errors</option></select></label>
      ${!isPast && html`<button type="button" aria-pressed=${held != null}
        onClick=${() => hold(held ? null : [...state.events])}>${held
          ? `Continue${fresh > 0 ? ` (${several(fresh, 'new event')})` : ''}` : 'Pause'}</button>`}</div>
    ${isPast ? html`<${Failed} problem=${problem} what="No events" />`
      : failed && html`<p class="problem"><${Mark} severity="warning" /> No earlier events: ${failed}</p>`}
    ${isPast && isTruncated && html`<p class="problem"><${Mark} severity="warning" /> The oldest events of
      this time are too many for one answer. A shorter time has them.</p>`}
    ${state.missedEvents > 0 && html`<p class="dim">${count(state.missedEvents)} events were
      overwritten before this page could read them.</p>`}
    ${rows.length ? html`<div class="scroll tall" tabindex="0" role="group" aria-label="Events"><table>
      <thead><tr><th scope="col">Time</th><th scope="col">Event</th><th scope="col">What</th></tr></thead>
      <tbody>${rows.slice(0, MOST_SHOWN).map((/** @type {any} */ event) => html`<tr key=${event.id}>
        <td class="number"><time datetime=${event.time} title=${event.time}>${(isPast ? date : when)(
          Date.parse(event.time) / 1000)}</time></td>
        <th scope="row"><${Mark} severity=${SEVERITY[event.severity] ?? 'note'} /> ${eventWords(event)}</th>
        <td><${Attributes} event=${event} names=${names} /></td></tr>`)}</tbody></table></div>
      ${rows.length > MOST_SHOWN && html`<p class="dim">The latest ${count(MOST_SHOWN)} of ${count(
        rows.length)}.</p>`}`
      : !(isPast && problem) && html`<p class="empty">${whyEmpty(isPast, isRead, all.length)}</p>`}`;
}

/** @param {{event: import('../state.js').Event, names: (guid: string) => string|undefined}} props */
function Attributes({ event, names }) {
  const { topic } = event.attributes;
  const rest = Object.fromEntries(Object.entries(event.attributes).filter(([name]) =>
    !SHOWN.includes(name) && (name !== 'domain_id' || state.hasDomains())));
  const link = typeof topic === 'string' && html`<a href=${address('topics', topic, {
    domain: /** @type {any} */ (event.attributes).domain_id })}><${Name} text=${topic} /></a> `;
  return html`${link}<bdi dir="ltr">${attributesText(rest, names)}</bdi>`;
}
