// Findings with their age and remedy, then totals, then the agent's blind spots.

import { age, bandwidth, count, duration, percent, rate, several, when } from '../format.js';
import { address, findingAddress } from '../router.js';
import { state, useLive } from '../store.js';
import { Figure, html, Mark, Name, Sentence, TopicLink, worst, Badges } from '../ui.js';

const MOST_SHOWN = 50;

export function Overview() {
  useLive();
  if (state.unknown) return html`<h1 tabindex="-1">Overview</h1><p>What was wrong at that time is not known.</p>`;
  const unseen = state.findings.filter((finding) => finding.kind === 'ability');
  const findings = state.findings.filter((finding) => finding.kind !== 'ability');
  const serious = findings.filter((finding) => finding.severity !== 'note');
  const notes = findings.filter((finding) => finding.severity === 'note');
  return html`<h1 tabindex="-1">Overview</h1>
    <section aria-labelledby="wrong"><h2 id="wrong">Findings</h2>
      ${serious.length
        ? html`<${Findings} list=${serious} />`
        : html`<p class="fine"><${Mark} severity="good" /> ${notes.length
          ? 'Nothing is broken. The notes below may explain what you see.'
          : 'Nothing is broken.'}</p>`}
      ${notes.length > 0 && html`<details open=${!serious.length}>
        <summary>${several(notes.length, 'note')}</summary><${Findings} list=${notes} /></details>`}
    </section>
    <${Totals} />
    <${Busiest} />
    <section aria-labelledby="blind"><h2 id="blind">What the agent cannot see</h2>
      ${unseen.length
        ? html`<ul class="findings">${unseen.map((finding) => html`<li key=${finding.id}>
          <${Mark} severity="note" /> <span><${Sentence} text=${finding.text} />
          ${finding.remedy && html`<br /><span class="dim">Remedy: <${Sentence} text=${finding.remedy}
            /></span>`}</span></li>`)}</ul>`
        : html`<p>${state.open?.source === 'replay'
          ? 'This is a capture: it contains the traffic of an interface, but nothing about sockets, processes and shared memory.'
          : 'The agent has all of its abilities.'}${' '}
          <a href=${address('agent')}>Abilities and limits</a></p>`}
    </section>`;
}

/** @param {{list: import('../state.js').Finding[]}} props */
export function Findings({ list }) {
  const [firsts, more] = grouped(list);
  return html`<ul class="findings">${firsts.slice(0, MOST_SHOWN).map((finding) => html`
    <li key=${finding.id} class=${finding.severity}><${Mark} severity=${finding.severity} />
      <span><${Place} finding=${finding} /> <${Sentence} text=${rest(finding)} />${now(finding)}
      ${more.has(finding) && html`
        <span class="dim"> and ${several(more.get(finding) ?? 0, 'other')} of this topic</span>`}
      ${finding.since != null && html` <span class="dim">since ${when(finding.since)} (${age(state.time - finding.since)})</span>`}
      ${finding.remedy && html`<br /><span class="remedy">Remedy: <${Sentence} text=${finding.remedy}
        /></span>`}</span></li>`)}</ul>
    ${firsts.length > MOST_SHOWN && html`<p class="dim">${count(firsts.length - MOST_SHOWN)} more.
      The <a href=${address('topics', null, { sort: 'state' })}>table of topics</a> has them
      all.</p>`}`;
}

/** Findings that also leave endpoints of their topic without a counterpart. */
const CAUSES = ['qos_incompatible', 'type_conflict'];

/**
 * Groups unmatched endpoints of a topic into one finding: all nodes may subscribe to `/clock`. Those
 * of a topic with a finding that is their cause are left out.
 * @param {import('../state.js').Finding[]} list
 * @returns {[import('../state.js').Finding[], Map<import('../state.js').Finding, number>]} the first
 *   of each topic, and how many more it has
 */
export function grouped(list) {
  /** @type {Map<string, import('../state.js').Finding>} */
  const seen = new Map();
  const more = new Map();
  const explained = new Set(list.filter((finding) => CAUSES.includes(finding.kind))
    .map((finding) => finding.topic));
  const firsts = list.filter((finding) => {
    if (finding.topic == null || !/^unmatched_/.test(finding.kind)) return true;
    if (explained.has(finding.topic)) return false;
    const key = `${finding.kind} ${finding.topic}`;
    const first = seen.get(key);
    if (first) more.set(first, (more.get(first) ?? 0) + 1);
    else seen.set(key, finding);
    return !first;
  });
  return [firsts, more];
}

/** Returns the figures of the shown time beside what is expected. @param {import('../state.js').Finding} finding */
function now(finding) {
  if (finding.topic == null) return '';
  const figures = state.figuresOf(finding.topic);
  const { lost, expected } = figures;
  if (finding.kind === 'loss' && lost != null && lost > 0 && expected) {
    return `, ${percent(lost / expected)} since it is measured`;
  }
  if (finding.kind === 'watch_violated' && figures.rate != null) {
    const latency = /latency/.test(finding.text) && figures.p99 != null
      ? `, latency p99 ${duration(figures.p99)}` : '';
    return ` (${state.past ? 'then' : 'now'} ${rate(figures.rate)}${latency})`;
  }
  return '';
}

/** Returns a finding's text without its leading topic name. @param {any} finding */
function rest(finding) {
  const name = state.topics.get(finding.topic)?.name;
  const text = state.withScripts(finding.text);
  return name && text.startsWith(`${name} `) ? text.slice(name.length + 1) : text;
}

/**
 * Returns address and title of the section that a finding is about; null if it is the agent.
 * @param {import('../state.js').Finding} finding
 */
export function placeOf(finding) {
  return findingAddress(finding, state.topics.get(finding.topic ?? -1) ?? null,
    state.nodes.get(finding.node ?? -1) ?? null);
}

/** A link to a finding's subject. @param {{finding: import('../state.js').Finding}} props */
function Place({ finding }) {
  const [href, title] = placeOf(finding) ?? [address('agent'), 'Agent'];
  return html`<a href=${href}><${Name} text=${title} /></a>:`;
}

export function Totals() {
  const { rate: messages, bandwidth: bytes, lost, measured } = state.totals;
  const [rates, sizes, losses] = state.totalSeries.map((series) => series.points);
  const shown = [...state.topics.values()].filter((topic) => !topic.hidden && !topic.vanished);
  const nodes = [...state.nodes.values()].filter((node) => !node.hidden);
  const unknown = state.agent?.unknown_writers ?? 0;
  return html`<section aria-labelledby="totals"><h2 id="totals">${state.past ? 'At that time' : 'Now'}</h2><div class="figures">
    <${Figure} label="messages a second" value=${rate(messages).replace('Hz', '/s')} points=${rates} />
    <${Figure} label="bytes a second" value=${bandwidth(bytes)} points=${sizes} />
    <${Figure} label="lost a second" value=${count(lost)} points=${losses} />
    <${Figure} label="nodes" value=${count(nodes.length)} href=${address('nodes')} />
    <${Figure} label="topics" value=${count(shown.length)} href=${address('topics')} />
    <${Figure} label="topics measured" value=${count(measured)}
      href=${address('topics', null, { only: 'measured' })} />
    ${unknown > 0 && html`<${Figure} label="writers without a known topic"
      value=${count(unknown)} href=${address('agent')} />`}
  </div><${Incomplete} missing="the other figures leave them out" /></section>`;
}

/**
 * What is missing because the agent started late: writers that send on unknown topics.
 * @param {{missing: string}} props what a view leaves out
 */
export function Incomplete({ missing }) {
  const finding = state.findings.find((each) => each.kind === 'unknown_writers');
  return finding && html`<p class="incomplete"><${Mark} severity="warning" />
    ${' '}${finding.text}: ${missing}. <span class="remedy">Remedy: <${Sentence}
    text=${finding.remedy ?? ''} /></span></p>`;
}

function Busiest() {
  const rows = [...state.topics.values()]
    .map((topic) => ({ topic, figures: state.figuresOf(topic.id) }))
    .filter(({ figures }) => figures.bandwidth != null && figures.bandwidth > 0)
    .sort((one, other) => Number(other.figures.bandwidth) - Number(one.figures.bandwidth))
    .slice(0, 8);
  if (!rows.length) return null;
  const all = [...state.figures.keys()].map((id) => state.figuresOf(id).bandwidth ?? 0);
  const total = all.reduce((sum, each) => sum + each, 0) || 1;
  return html`<section aria-labelledby="busiest"><h2 id="busiest">Busiest topics</h2>
    <div class="scroll" tabindex="0" role="group" aria-labelledby="busiest"><table>
    <thead><tr><th scope="col">Topic</th><th scope="col" class="number">Bandwidth</th>
      <th scope="col" class="number">Share</th><th scope="col" class="number">Rate</th>
      <th scope="col">State</th></tr></thead>
    <tbody>${rows.map(({ topic, figures }) => {
      const flags = state.flagsOf(topic.id);
      return html`<tr key=${topic.id}><th scope="row"><${TopicLink} topic=${topic} /></th>
        <td class="number">${bandwidth(figures.bandwidth)}</td>
        <td class="number">${percent(Number(figures.bandwidth) / total)}</td>
        <td class="number">${rate(figures.rate)}</td>
        <td>${worst(flags) === 'good' ? 'ok' : html`<${Badges} flags=${flags} />`}</td></tr>`;
    })}</tbody></table></div></section>`;
}
