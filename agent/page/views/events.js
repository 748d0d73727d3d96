// Events: those kept since the agent started, and new ones as they happen.

import { useEffect, useState } from '../vendor/hooks.mjs';
import { request } from '../api.js';
import { clock, count, several, visible } from '../format.js';
import { address } from '../router.js';
import { replaceAddress, state, useLive } from '../store.js';
import { Filter, html, Mark, matches, Name } from '../ui.js';

/** Most events in the document; the filter finds older ones. */
const MOST_SHOWN = 300;

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

/** Formats an event's attributes. @param {Record<string, unknown>} attributes */
export function attributesText(attributes) {
  return Object.entries(attributes).map(([name, value]) => {
    const text = typeof value === 'string' ? value : JSON.stringify(value);
    return `${visible(name)}: ${visible(text)}`;
  }).join(', ');
}

/** @param {{query: Record<string, string>}} props */
export function Events({ query }) {
  useLive();
  const [failed, fail] = useState('');
  const [held, hold] = useState(/** @type {import('../state.js').Event[]|null} */ (null));
  const run = state.open?.run;
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
  }, [run]);
  const { filter = '', severity = '' } = query;
  const change = (/** @type {Record<string, any>} */ more) => replaceAddress(
    address('events', null, { ...query, ...more }));
  const rows = (held ?? state.events).filter((/** @type {any} */ event) =>
    (!severity || event.severity === severity || (severity === 'WARN' && event.severity === 'ERROR'))
    && matches(filter, `${event.name} ${attributesText(event.attributes)}`)).reverse();
  const fresh = held ? state.events.length - held.length : 0;
  return html`<h1 tabindex="-1">Events</h1>
    <div class="controls">
      <${Filter} label="Filter" value=${filter} found=${rows.length} noun="event"
        change=${(/** @type {string} */ text) => change({ filter: text })} />
      <label>Show <select value=${severity}
        onChange=${(/** @type {any} */ event) => change({ severity: event.target.value })}>
        <option value="">all</option><option value="WARN">warnings and errors</option>
        <option value="ERROR">errors</option></select></label>
      <button type="button" aria-pressed=${held != null}
        onClick=${() => hold(held ? null : [...state.events])}>${held
          ? `Continue${fresh > 0 ? ` (${several(fresh, 'new event')})` : ''}` : 'Pause'}</button></div>
    ${failed && html`<p class="problem"><${Mark} severity="warning" /> No earlier events: ${failed}</p>`}
    ${state.missedEvents > 0 && html`<p class="dim">${count(state.missedEvents)} events were
      overwritten before this page could read them.</p>`}
    ${rows.length ? html`<div class="scroll tall" tabindex="0" role="group" aria-label="Events"><table>
      <thead><tr><th scope="col">Time</th><th scope="col">Event</th><th scope="col">What</th></tr></thead>
      <tbody>${rows.slice(0, MOST_SHOWN).map((/** @type {any} */ event) => html`<tr key=${event.id}>
        <td class="number"><time datetime=${event.time} title=${event.time}>${clock(
          Date.parse(event.time) / 1000)}</time></td>
        <th scope="row"><${Mark} severity=${SEVERITY[event.severity] ?? 'note'} /> ${event.name}</th>
        <td><${Attributes} event=${event} /></td></tr>`)}</tbody></table></div>
      ${rows.length > MOST_SHOWN && html`<p class="dim">The latest ${count(MOST_SHOWN)} of ${count(
        rows.length)}.</p>`}`
      : html`<p class="empty">${state.events.length ? 'No event matches.' : 'No event yet.'}</p>`}`;
}

/** @param {{event: import('../state.js').Event}} props */
function Attributes({ event }) {
  const { topic, ...rest } = event.attributes;
  const link = typeof topic === 'string' && html`<a href=${address('topics', topic, {
    domain: /** @type {any} */ (event.attributes).domain_id })}><${Name} text=${topic} /></a> `;
  const text = attributesText(rest);
  return html`${link}<bdi dir="ltr">${text}</bdi>`;
}
