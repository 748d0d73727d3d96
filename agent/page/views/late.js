// A part of the views of a topic and of a node: which calls of callbacks were late, and why.

import { EventLines } from '../chart.js';
import { clock } from '../format.js';
import { callsOf, causes, closest, missing, timeline, WIDTH, worst } from '../late.js';
import { state } from '../store.js';
import { Failed, html, Name } from '../ui.js';
import { useEffect, useRef, useState } from '../vendor/hooks.mjs';

/** Size of a period in the drawing of late calls over time. */
const BAR = 10;
const HEIGHT = 60;

/** Shows the answer of the agent about late calls. `picked` is a time that was picked in a chart.
 * @param {{answer: {data: any, problem: any}, picked?: {time: number}|null}} props */
export function Late({ answer, picked = null }) {
  const rows = causes(answer.data);
  const calls = worst(answer.data);
  const note = missing(answer.data);
  return html`<section aria-labelledby="late"><h3 id="late">Late calls</h3>
    <${Failed} problem=${answer.problem} what="Late calls are not known" />
    ${note && html`<p class="dim">${note}</p>`}
    ${!note && !answer.problem && calls.length === 0 && html`<p class="dim" role="status">No call
      was late so far.</p>`}
    ${rows.length > 0 && html`<div class="scroll" tabindex="0" role="group" aria-label="Causes"><table>
      <caption>Causes</caption><thead><tr><th scope="col">Cause</th><th scope="col" class="number">Late
      calls</th><th scope="col" class="number">Longest</th><th scope="col">What helps</th></tr></thead>
      <tbody>${rows.map(([words, late, longest, remedy]) => html`<tr key=${words}><th scope="row"><${Name}
        text=${words} /></th><td class="number">${late}</td><td class="number">${longest}</td>
        <td>${remedy}</td></tr>`)}</tbody></table></div>`}
    <${Timeline} why=${answer.data} picked=${picked} />
    ${calls.length > 0 && html`<div class="scroll" tabindex="0" role="group" aria-label="Worst calls">
      <table><caption>Worst calls</caption><thead><tr><th scope="col">Callback</th><th scope="col">Node</th>
      <th scope="col" class="number">Late</th><th scope="col" class="number">Time</th>
      <th scope="col">Parts</th></tr></thead><tbody>${calls.map((/** @type {any} */ it, /** @type {number} */
        place) => html`<tr key=${place}><th scope="row"><${Name} text=${it.callback} /></th>
        <td><${Name} text=${state.withScripts(it.who)} /></td><td class="number">${it.late}</td>
        <td class="number">${it.total}</td><td><${Parts} call=${it} /></td></tr>`)}
      </tbody></table></div>`}</section>`;
}

/** Draws the late calls of the last ten minutes by cause, and lists those of a chosen period.
 * @param {{why: any, picked: {time: number}|null}} props */
function Timeline({ why, picked }) {
  const [chosen, choose] = useState(/** @type {number|null} */ (null));
  const [note, say] = useState('');
  const handled = useRef(/** @type {object|null} */ (null));
  const place = useRef(/** @type {HTMLElement|null} */ (null));
  const shown = timeline(why);
  useEffect(() => {
    if (!picked || !why || handled.current === picked) return;
    handled.current = picked;
    const near = closest(shown, picked.time);
    choose(near ? near.begin : null);
    say(near ? '' : `No late call is known near ${clock(picked.time)}.`);
    place.current?.scrollIntoView({ block: 'nearest' });
  });
  const bar = shown.bars.find((/** @type {any} */ it) => it.begin === chosen);
  const status = html`<p class="dim" role="status" ref=${place}>${note}</p>`;
  if (shown.bars.length === 0) return status;
  return html`<h4>Late calls over time</h4>
    <p>${shown.colours.map((/** @type {any} */ it) => html`<span key=${it.cause} class="cause"
      style="--cause: var(${it.colour})">${it.words} ${it.calls}</span>`)}</p>
    <svg class="timeline" viewBox="0 0 ${BAR * shown.periods} ${HEIGHT}" preserveAspectRatio="none"
      role="group" aria-label="Late calls over time">${shown.bars.map((/** @type {any} */ it) => {
    const pick = () => {
      choose(it.begin === chosen ? null : it.begin);
      say('');
    };
    return html`<g key=${it.begin} role="button" tabindex="0" aria-label=${it.label}
        aria-pressed=${it.begin === chosen} onClick=${pick}
        onKeyDown=${(/** @type {KeyboardEvent} */ event) => {
          if (event.key !== 'Enter' && event.key !== ' ') return;
          event.preventDefault();
          pick();
        }}><title>${it.label}</title>
        <rect class="hit-area" x=${BAR * it.place} y="0" width=${BAR} height=${HEIGHT} />
        ${it.parts.map((/** @type {any} */ part) => html`<rect key=${part.cause}
          x=${BAR * it.place + 1} width=${BAR - 2} y=${HEIGHT * (1 - part.from - part.height)}
          height=${HEIGHT * part.height} style="fill: var(${part.colour})" />`)}</g>`;
  })}<${EventLines} from=${shown.from} end=${shown.end} width=${BAR * shown.periods}
      height=${HEIGHT} /></svg>
    <p class="dim">${clock(shown.from)} to ${clock(shown.end)}. Choose a bar to list its calls.</p>
    ${status}
    ${bar && html`<div class="scroll" tabindex="0" role="group" aria-label="Calls of a period"><table>
      <caption>${bar.label}</caption><thead><tr><th scope="col">Time</th><th scope="col">Callback</th>
      <th scope="col">Node</th><th scope="col" class="number">Length</th><th scope="col">Why</th></tr>
      </thead><tbody>${callsOf(bar).map((it, place) => html`<tr key=${place}><th scope="row">${it.time}
        </th><td><${Name} text=${it.callback} /></td><td><${Name} text=${state.withScripts(it.who)} /></td>
        <td class="number">${it.total}</td><td>${it.example ? html`<${Parts} call=${it.example} />`
          : html`<${Name} text=${it.words} />`}</td></tr>`)}</tbody></table></div>`}`;
}

/** Draws the parts of a call in the order of their stages, and names them.
 * @param {{call: any}} props */
function Parts({ call }) {
  return html`<svg class="bar" viewBox="0 0 ${WIDTH} 8" preserveAspectRatio="none" role="img"
    aria-label=${call.text}>${call.parts.map((/** @type {any} */ part, /** @type {number} */ at) =>
      html`<rect key=${at} x=${part.from} width=${part.width} y="0" height="8" fill="currentColor"
        fill-opacity=${at % 2 ? 0.35 : 0.8}><title>${part.cause}</title></rect>`)}</svg>${' '}
    <${Name} text=${`${call.words}: ${call.text}`} />`;
}
