// The report of `rp doctor`: what the agent's host hinders, and the remedies.

import { useState } from '../vendor/hooks.mjs';
import { address } from '../router.js';
import { usePoll } from '../store.js';
import { Failed, html, Mark, Name, Sentence } from '../ui.js';

/** Verdicts from bad to good, with the mark of each. */
const VERDICTS = /** @type {Record<string, string>} */ ({
  problem: 'error', warning: 'warning', unknown: 'note', note: 'note', ok: 'good',
});

const AREAS = /** @type {Record<string, string>} */ ({
  agent: 'Agent', sight: 'What it sees', kernel: 'Kernel', privileges: 'Privileges',
  interfaces: 'Interfaces', shell: 'ROS in this shell', processes: 'ROS processes', graph: 'Graph',
  buffers: 'Buffers', clock: 'Clock',
});

/** Where the line of a remedy belongs. */
const PLACES = /** @type {Record<string, string>} */ ({
  command: 'in a shell', configuration: "in the agent's configuration", elsewhere: 'elsewhere',
});

/** @param {{finding: any}} props */
function Finding({ finding }) {
  const { check, verdict, sentence, evidence, remedies } = finding;
  const severity = VERDICTS[verdict] ?? 'note';
  return html`<li key=${check} class=${severity}><${Mark} severity=${severity} /> <span>
    <${Sentence} text=${sentence} />
    ${remedies.map((/** @type {any} */ remedy) => html`<br /><span class="remedy">Remedy, ${
      PLACES[remedy.kind] ?? remedy.kind}: <code><${Name} text=${remedy.line} /></code>${
      remedy.comment ? html` (<${Sentence} text=${remedy.comment} />)` : ''}</span>`)}
    ${evidence.length > 0 && html`<details><summary>Evidence</summary>${evidence.map(
      (/** @type {any} */ each) => html`<div><${Name} text=${each.value} /> <span class="dim">from${' '}
        <${Name} text=${each.from} /></span></div>`)}</details>`}</span></li>`;
}

export function Doctor() {
  const { data, problem, refresh } = usePoll('doctor', 0);
  const [all, showAll] = useState(false);
  const findings = /** @type {any[]} */ (data?.findings ?? []);
  const counts = Object.keys(VERDICTS).map((verdict) => [verdict, findings.filter(
    (finding) => finding.verdict === verdict).length]);
  const shown = findings.filter((finding) => all || finding.verdict !== 'ok');
  const areas = Object.keys(AREAS).filter((area) => shown.some((finding) => finding.area === area));
  return html`<h1 tabindex="-1">Doctor</h1>
    <p>The checks of <code>rp doctor</code> on the agent's host, with the rights of the agent.${' '}
      <a href=${address('agent')}>The agent</a></p>
    <${Failed} problem=${problem} what="No report" />
    ${!data && !problem && html`<p role="status">Examining…</p>`}
    ${data && html`<p class="controls"><span>${counts.filter(([, count]) => Number(count) > 0).map(
      ([verdict, count]) => `${count} ${verdict}`).join(', ')}</span>
      <label><input type="checkbox" checked=${all}
        onChange=${() => showAll(!all)} /> also what is well</label>
      <button type="button" onClick=${refresh}>Examine again</button></p>
    ${areas.map((area) => html`<section key=${area} aria-labelledby=${`area-${area}`}>
      <h2 id=${`area-${area}`}>${AREAS[area]}</h2><ul class="findings">${
        shown.filter((finding) => finding.area === area).map((finding) => html`<${Finding}
          finding=${finding} />`)}</ul></section>`)}
    ${areas.length === 0 && html`<p><${Mark} severity="good" /> Every check passed.</p>`}`}`;
}
