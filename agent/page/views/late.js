// A part of the views of a topic and of a node: which calls of callbacks were late, and why.

import { causes, missing, WIDTH, worst } from '../late.js';
import { Failed, html, Name } from '../ui.js';

/** Shows the answer of the agent about late calls.
 * @param {{answer: {data: any, problem: any}}} props */
export function Late({ answer }) {
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
    ${calls.length > 0 && html`<div class="scroll" tabindex="0" role="group" aria-label="Worst calls">
      <table><caption>Worst calls</caption><thead><tr><th scope="col">Callback</th><th scope="col">Node</th>
      <th scope="col" class="number">Late</th><th scope="col" class="number">Time</th>
      <th scope="col">Parts</th></tr></thead><tbody>${calls.map((/** @type {any} */ it, /** @type {number} */
        place) => html`<tr key=${place}><th scope="row"><${Name} text=${it.callback} /></th>
        <td><${Name} text=${it.who} /></td><td class="number">${it.late}</td>
        <td class="number">${it.total}</td><td><${Parts} call=${it} /></td></tr>`)}
      </tbody></table></div>`}</section>`;
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
