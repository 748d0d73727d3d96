// A section of the views of a topic and of a node: what their processes show from inside.

import { percent } from '../format.js';
import { tables, waiting } from '../inside.js';
import { state, stream, usePoll } from '../store.js';
import { Failed, html, Name } from '../ui.js';
import { useEffect, useState } from '../vendor/hooks.mjs';
import { Late } from './late.js';

/** Between requests that keep calls observed. The agent observes them for 10 s after each. */
const AGAIN_MS = 4000;

/** Shows what details say, and lets the agent observe calls on request, or once a time in a chart is
 * `picked`.
 * @param {{inside: any, name: string, domain: number, picked?: {time: number}|null}} props */
export function Inside({ inside, name, domain, picked = null }) {
  const [observes, observe] = useState(false);
  useEffect(() => {
    if (picked) observe(true);
  }, [picked]);
  const calls = usePoll(observes
    ? `inside?name=${encodeURIComponent(name)}&domain_id=${domain}` : null, AGAIN_MS);
  const late = usePoll(observes
    ? `why?name=${encodeURIComponent(name)}&domain_id=${domain}&history=true` : null, AGAIN_MS);
  const shown = inside ? tables(inside) : [];
  const isShown = shown.length > 0 || inside?.lifecycle_state;
  const isPast = stream.at != null;
  if (isPast && !isShown) return null;
  if (!observes && !isShown) {
    return html`<p id="inside"><button type="button" onClick=${() => observe(true)}>Observe calls</button>${' '}
      <span class="dim">Callbacks and queues inside the processes, while this view is open. Each call
      costs its process some microseconds.</span></p>`;
  }
  return html`<section aria-labelledby="inside"><h2 id="inside">Inside the processes</h2>
    ${observes && html`<${Failed} problem=${calls.problem} what="Calls are not observed" />`}
    ${observes && !calls.problem && !isShown && html`<p class="dim" role="status">${
      waiting(calls.data)}</p>`}
    ${inside?.lifecycle_state && html`<p>Lifecycle state: <${Name}
      text=${inside.lifecycle_state} /></p>`}
    ${inside?.busy_ratio != null && html`<p>Its callbacks take ${percent(inside.busy_ratio)} of the
      time.</p>`}
    ${shown.map(([title, head, rows]) => html`<div class="scroll" key=${title} tabindex="0"
      role="group" aria-label=${title}><table><caption>${title}</caption><thead><tr>${head.map(
      (name, at) => html`<th scope="col" class=${at > 1 ? 'number' : ''}>${name}</th>`)}</tr></thead>
      <tbody>${rows.map((row, place) => html`<tr key=${place}>${row.map((cell, at) => at === 0
        ? html`<th scope="row"><${Name} text=${cell} /></th>` : at === 1
          ? html`<td><${Name} text=${state.withScripts(cell)} /></td>` : html`<td class="number">${cell}</td>`)}</tr>`)}
      </tbody></table></div>`)}
    ${isPast ? html`<p class="dim">Late calls are not kept.</p>`
      : observes ? html`<${Late} answer=${late} picked=${picked} />`
      : html`<p><button type="button" onClick=${() => observe(true)}>Why late?</button></p>`}</section>`;
}
