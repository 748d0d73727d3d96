// The robots of a fleet: which is in trouble, and what differs from the others.

import { age, bytes, count, date, duration, percent, several } from '../format.js';
import { address } from '../router.js';
import { usePoll } from '../store.js';
import { Failed, html, Mark, Name, Sentence } from '../ui.js';

const EVERY_MS = 5000;
/** Lines of a part of a robot that are shown, alone and among the others. */
const MOST_LINES = 200;
const FEW_LINES = 8;

/** States from bad to good: severity and words. */
const STATES = /** @type {Record<string, [string, string]>} */ ({
  out_of_reach: ['error', 'out of reach'], not_ready: ['error', 'not ready'],
  violated: ['error', 'violated'], findings: ['warning', 'findings'], ok: ['good', 'ok'],
});

/** Parts of a robot. The first three are its graph. */
export const PARTS = /** @type {Record<string, string>} */ ({
  nodes: 'Nodes', topics: 'Topics', endpoints: 'Publishers and subscriptions',
  qos: 'Quality of service', rates: 'Rates', agent: 'Agent',
});

/** Returns the severity and the words of a state. @param {string} state @returns {[string, string]} */
export function stateOf(state) {
  return STATES[state] ?? ['note', state];
}

/** Returns what is wrong with a robot apart from differences, as lines. @param {any} robot */
export function faults({ violated, findings }) {
  return [
    ...violated.map((/** @type {[string, string]} */ [topic, expectation]) =>
      `${topic}: ${expectation} is violated`),
    ...Object.entries(findings).map(([kind, number]) => `${number} x ${kind}`),
  ];
}

/**
 * Returns the differences of a robot by part, the graph first.
 * @param {any} robot
 * @returns {[string, any[]][]}
 */
export function byPart({ differences }) {
  const parts = [...Object.keys(PARTS), ''];
  return parts.map((part) => /** @type {[string, any[]]} */ ([PARTS[part] ?? 'Others',
    differences.filter((/** @type {any} */ each) => (part ? each.part === part : !PARTS[each.part]))]))
    .filter(([, those]) => those.length > 0);
}

/** @param {{robots: any[]}} props */
function Robots({ robots }) {
  return html`<div class="scroll" tabindex="0" role="group" aria-label="Robots"><table>
    <thead><tr><th scope="col">Robot</th><th scope="col">State</th><th scope="col">Last sample</th>
    <th scope="col" class="number">Nodes</th><th scope="col" class="number">Topics</th>
    <th scope="col" class="number">Loss</th><th scope="col">Version</th><th scope="col">Details</th>
    </tr></thead><tbody>${robots.map((robot) => {
      const [severity, words] = stateOf(robot.state);
      const known = robot.state !== 'out_of_reach';
      const lines = faults(robot).length + robot.differences.length;
      return html`<tr key=${robot.name}>
        <th scope="row">${robot.page
          ? html`<a href=${robot.page} rel="noreferrer"><${Name} text=${robot.name} /></a>`
          : html`<${Name} text=${robot.name} />`}</th>
        <td><${Mark} severity=${severity} /> ${words}</td>
        <td>${age(robot.age_s)}</td>
        <td class="number">${known ? count(robot.nodes) : '–'}</td>
        <td class="number">${known ? count(robot.topics) : '–'}</td>
        <td class="number">${known && robot.loss != null ? percent(robot.loss) : '–'}</td>
        <td>${robot.version != null ? html`<${Name} text=${robot.version} />` : '–'}</td>
        <td>${lines > 0 && html`<a href=${address('fleet', robot.name)}>${several(lines, 'line')}</a>`}</td>
        </tr>`;
    })}</tbody></table></div>`;
}

/** @param {{title: string, lines: string[], most: number, name: string}} props */
function Lines({ title, lines, most, name }) {
  const more = lines.length - most;
  return html`<h3>${title}</h3><ul>${lines.slice(0, most).map((line, index) => html`<li key=${index}
    ><${Sentence} text=${line} /></li>`)}${more > 0 && html`<li>and ${count(more)} more: <code>rp fleet
    ${name}</code> prints them</li>`}</ul>`;
}

/**
 * Returns what a robot without faults and differences says: a severity, if it is known, and a sentence.
 * @param {any} robot @param {{in_reach: number, minimum: number}} comparison
 * @returns {[string|null, string]}
 */
export function nothingDiffers(robot, { in_reach: inReach, minimum }) {
  if (robot.state === 'out_of_reach') {
    return [null, 'It was not compared with the others: it is out of reach.'];
  }
  if (inReach < minimum) {
    return [null, `It was not compared with others: ${inReach} in reach, of ${minimum} at least.`];
  }
  return robot.state === 'ok' ? ['good', 'Nothing is wrong, and nothing differs from the other robots.']
    : [null, 'Nothing differs from the other robots.'];
}

/** @param {{robot: any, comparison: any, index: number, most: number}} props */
function Details({ robot, comparison, index, most }) {
  const wrong = faults(robot);
  const parts = byPart(robot);
  const [severity, sentence] = nothingDiffers(robot, comparison);
  return html`<section key=${robot.name} aria-labelledby=${`robot-${index}`}>
    <h2 id=${`robot-${index}`}><${Name} text=${robot.name} /></h2>
    ${wrong.length > 0 && html`<${Lines} title="In trouble" lines=${wrong} most=${most} name=${robot.name} />`}
    ${parts.map(([title, those]) => html`<${Lines} key=${title} title=${title} most=${most} name=${robot.name}
      lines=${those.map((each) => each.text)} />`)}
    ${wrong.length + parts.length === 0 && html`<p>${severity && html`<${Mark} severity=${severity} /> `}
      ${sentence}</p>`}</section>`;
}

/**
 * Returns what is known of an incident beside its time, as lines.
 * @param {any} incident
 */
export function incidentLines({ findings, is_complete: isComplete }) {
  return [
    ...findings == null ? ['findings unknown: the agent did not answer']
      : Object.entries(findings).map(([event, number]) => `${number} x ${event}`),
    ...isComplete ? [] : ['the recording did not end in order: rp bag reindex'],
  ];
}

/**
 * Returns what a list of incidents lacks, as sentences.
 * @param {any} incidents @param {number} shown
 */
export function incidentNotes({ at, problem, unread, unfinished, is_cut: isCut }, shown) {
  return [
    ...at == null && !problem ? ['The store is being read…'] : [],
    ...at != null && !problem && shown === 0 ? ['The store has no incident.'] : [],
    ...unread > 0 ? [`The manifests of ${several(unread, 'bag')} were not read: older ones, or not yet.`] : [],
    ...unfinished > 0 ? [`${several(unfinished, 'bag')} on the way to the store.`] : [],
    ...isCut ? ['The store has more objects than are listed.'] : [],
  ];
}

/** @param {{incidents: any, name: string|null}} props */
function Incidents({ incidents, name }) {
  const shown = incidents.bags.filter((/** @type {any} */ each) => name == null || each.robot === name);
  const seconds = (/** @type {any} */ time) => (time == null ? null : Date.parse(time) / 1000);
  return html`<section aria-labelledby="incidents"><h2 id="incidents">Incidents</h2>
    ${incidents.problem && html`<p role="alert"><${Mark} severity="error" />${' '}
      <${Sentence} text=${`The store cannot be read: ${incidents.problem}`} /></p>`}
    ${shown.length > 0 && html`<div class="scroll" tabindex="0" role="group" aria-label="Incidents"><table>
    <thead><tr><th scope="col">Begin</th><th scope="col">Robot</th><th scope="col">Trigger</th>
    <th scope="col" class="number">Length</th><th scope="col" class="number">Size</th>
    <th scope="col">Bag</th><th scope="col">Findings</th></tr></thead><tbody>${shown.map(
      (/** @type {any} */ each) => {
        const [start, end] = [seconds(each.start), seconds(each.end)];
        return html`<tr key=${`${each.robot}/${each.bag}`}>
          <td>${start == null ? 'no messages' : date(start)}</td>
          <td><a href=${address('fleet', each.robot)}><${Name} text=${each.robot} /></a></td>
          <td><${Name} text=${each.trigger} />${each.topic && html` <${Name} text=${each.topic} />`}</td>
          <td class="number">${start == null || end == null ? '–' : duration(end - start)}</td>
          <td class="number">${bytes(each.bytes)}</td>
          <td><${Name} text=${each.bag} /></td>
          <td>${incidentLines(each).map((line, index) => html`<div key=${index}><${Sentence}
            text=${line} /></div>`)}</td></tr>`;
      })}</tbody></table></div>`}
    ${incidentNotes(incidents, shown.length).map((note) => html`<p key=${note} class="dim">${note}</p>`)}
    </section>`;
}

/** @param {{name: string|null}} props a robot, or null for all */
export function Fleet({ name }) {
  const { data, problem } = usePoll('fleet', EVERY_MS);
  const robots = /** @type {any[]} */ (data?.robots ?? []);
  const shown = robots.filter((robot) => name == null || robot.name === name);
  const counts = Object.keys(STATES).map((state) => [stateOf(state)[1],
    robots.filter((robot) => robot.state === state).length]);
  return html`<h1 tabindex="-1">${name == null ? 'Fleet' : html`<${Name} text=${name} />`}</h1>
    ${name != null && html`<p><a href=${address('fleet')}>All robots</a></p>`}
    <${Failed} problem=${problem} what="No robots" />
    ${data?.problem && html`<p role="alert"><${Mark} severity="error" />${' '}
      <${Sentence} text=${`The engine: ${data.problem}`} /></p>`}
    ${data && data.at == null && !data.problem && html`<p role="status">Asking the engine…</p>`}
    ${data?.at != null && html`<p>${robots.length ? counts.filter(([, number]) => Number(number) > 0).map(
      ([words, number]) => `${number} ${words}`).join(', ') : ''}
      <span class="dim"> State of ${date(data.at)}</span></p>
    ${robots.length === 0 && html`<p class="empty">No robot delivers to the engine.</p>`}
    ${robots.length > 0 && shown.length === 0 && html`<p class="empty">The engine has no robot of
      this name.</p>`}
    ${shown.length > 0 && html`<${Robots} robots=${shown} />`}
    ${shown.filter((robot) => name != null || faults(robot).length + robot.differences.length > 0).map(
      (robot, index) => html`<${Details} key=${robot.name} robot=${robot} comparison=${data.comparison} index=${index}
        most=${name == null ? FEW_LINES : MOST_LINES} />`)}`}
    ${data?.incidents && html`<${Incidents} incidents=${data.incidents} name=${name} />`}`;
}
