// Small components shared by the views.

import { h } from './vendor/preact.mjs';
import { useEffect, useRef, useState } from './vendor/hooks.mjs';
import htm from './vendor/htm.mjs';
import { Refusal } from './api.js';
import { several, shortened, visible } from './format.js';
import { nodeAddress, topicAddress } from './router.js';

export const html = htm.bind(h);

/**
 * A name from the network, isolated from the text around it, with invisible characters escaped.
 * @param {{text: string, most?: number}} props
 */
export function Name({ text, most = 0 }) {
  const whole = visible(text);
  const shown = most ? shortened(text, most) : whole;
  return html`<bdi class="name" dir="ltr" title=${shown === whole ? undefined : whole}
    >${shown}</bdi>`;
}

/** A sentence from the agent, whose commands are in backticks. @param {{text: string}} props */
export function Sentence({ text }) {
  return String(text).split('`').map((part, at) => (at % 2
    ? html`<code key=${at}><${Name} text=${part} /></code>` : html`<${Name} key=${at} text=${part} />`));
}

/** @param {{topic: import('./state.js').Topic, most?: number}} props */
export function TopicLink({ topic, most }) {
  return html`<a href=${topicAddress(topic)}><${Name} text=${topic.name} most=${most} /></a>`;
}

/** @param {{node: import('./state.js').Node, most?: number}} props */
export function NodeLink({ node, most }) {
  return html`<a href=${nodeAddress(node)}><${Name} text=${node.name} most=${most} /></a>`;
}

/** Mark and word of each severity. */
const MARKS = /** @type {Record<string, [string, string]>} */ ({
  error: ['✖', 'error'],
  warning: ['▲', 'warning'],
  note: ['●', 'note'],
  good: ['✔', 'good'],
});

/** @param {{severity: string}} props */
export function Mark({ severity }) {
  const [sign, word] = MARKS[severity] ?? MARKS.note;
  return html`<span class="mark ${severity}"><span aria-hidden="true">${sign}</span
    ><span class="reader-only">${word}</span></span>`;
}

/** Each flag of a topic: severity, word, and explanation. */
export const FLAGS = /** @type {Record<string, [string, string, string]>} */ ({
  qos: ['error', 'QoS', 'A publisher and a subscription have incompatible QoS.'],
  type: ['error', 'type', 'Publishers and subscriptions have different types.'],
  definition: ['error', 'definition', 'Endpoints have different definitions of the type.'],
  violated: ['error', 'violated', 'An expectation of a watch is violated.'],
  loss: ['warning', 'loss', 'Messages were lost in the last minute.'],
  silent: ['warning', 'silent', 'It was sent regularly, and now there is no message for long.'],
  rejected: ['warning', 'rejected', 'limits.topics is reached: the topic is not measured.'],
  unmatched_publisher: ['note', 'unmatched pub', 'A publisher has no matching subscription.'],
  unmatched_subscription: ['note', 'unmatched sub', 'A subscription has no matching publisher.'],
  unseen: ['note', 'not observed', 'Messages of a pair take a path that the agent cannot observe.'],
  sampled: ['note', 'sampled', 'Counts come from samples of shared memory.'],
  encrypted: ['note', 'encrypted', 'A participant announces DDS security.'],
});

/** Words for the passages of messages. */
export const PASSAGES = /** @type {Record<string, string>} */ ({
  network: 'network',
  shared_memory: 'shared memory',
  data_sharing: 'data sharing (not observed)',
  same_process: 'same process (not observed)',
  iceoryx: 'iceoryx (not observed)',
  tcp: 'TCP',
});

/**
 * The states of a topic. Views of several topics explain them once, see `Meanings`.
 * @param {{flags: string[], explained?: boolean}} props
 */
export function Badges({ flags, explained = false }) {
  return flags.map((flag) => {
    const [severity, word, meaning] = FLAGS[flag] ?? ['note', flag, ''];
    return html`<span class="badge ${severity}"><${Mark} severity=${severity} /> ${word}</span> ${explained
      && html`<span class="dim">${meaning} </span>`}`;
  });
}

/** Each state of a topic with its meaning. */
export const FLAG_MEANINGS = /** @type {[any, string][]} */ (Object.entries(FLAGS).map(
  ([flag, [, , meaning]]) => [html`<${Badges} flags=${[flag]} />`, meaning]));

/** Explains columns and states of a table. @param {{rows: [any, string][]}} props */
export function Meanings({ rows }) {
  return html`<details class="meanings"><summary>What the columns and states mean</summary><dl>${rows.map(
    ([term, meaning]) => html`<div><dt>${term}</dt><dd>${meaning}</dd></div>`)}</dl></details>`;
}

/**
 * A text from the network that opens if it is long.
 * @param {{text: string, most: number}} props
 */
export function Long({ text, most }) {
  if (shortened(text, most) === visible(text)) return html`<${Name} text=${text} />`;
  return html`<details><summary><bdi class="name" dir="ltr">${shortened(text, most)}</bdi></summary><${Name}
    text=${text} /></details>`;
}

/** Returns the worst flag: `error`, `warning`, `note` or `good`. @param {string[]} flags */
export function worst(flags) {
  const order = ['error', 'warning', 'note'];
  const found = flags.map((flag) => FLAGS[flag]?.[0] ?? 'note');
  return order.find((severity) => found.includes(severity)) ?? 'good';
}

/**
 * A sparkline of the last ten minutes. Screen readers read the number beside it instead.
 * @param {{points: (number|null)[], steps?: number}} props
 */
export function Spark({ points, steps = 60 }) {
  const [width, height] = [120, 24];
  let most = 0;
  for (const point of points) if (point != null) most = Math.max(most, point);
  let path = '';
  let drawing = false;
  points.forEach((point, at) => {
    if (point == null) {
      drawing = false;
      return;
    }
    const x = ((at + steps - points.length) / (steps - 1)) * width;
    const y = height - 2 - (most > 0 ? point / most : 0) * (height - 4);
    path += `${drawing ? 'L' : 'M'}${x.toFixed(1)} ${y.toFixed(1)}`;
    drawing = true;
  });
  return html`<svg class="spark" viewBox="0 0 ${width} ${height}" aria-hidden="true"
    preserveAspectRatio="none"><path d=${path || 'M0 0'} /></svg>`;
}

/** @param {{problem: Refusal|null, what: string}} props */
export function Failed({ problem, what }) {
  if (!problem) return null;
  return html`<p class="problem"><${Mark} severity="warning" /> ${what}: ${problem.message}.
    ${problem.needsToken && html` <${AskButton} />`}</p>`;
}

/** A button that opens the token dialog. */
export function AskButton() {
  return html`<button type="button" onClick=${() => askToken()}>Enter a token</button>`;
}

export function askToken() {
  window.dispatchEvent(new CustomEvent('ask-token'));
}

/**
 * A button that runs one action at a time and shows its error.
 * @param {{action: () => Promise<unknown>, children: any, label?: string, disabled?: boolean,
 *   pressed?: boolean, kind?: string}} props
 */
export function Act({ action, children, label, disabled, pressed, kind = '' }) {
  const [busy, work] = useState(false);
  const [problem, refuse] = useState(/** @type {Refusal|null} */ (null));
  const alive = useRef(true);
  useEffect(() => () => { alive.current = false; }, []);
  const press = async () => {
    work(true);
    refuse(null);
    try {
      await action();
    } catch (error) {
      const refusal = error instanceof Refusal ? error : new Refusal(0, String(error));
      if (alive.current) refuse(refusal);
      if (refusal.needsToken) askToken();
    }
    if (alive.current) work(false);
  };
  return html`<button type="button" class=${kind} aria-label=${label} aria-pressed=${pressed}
    disabled=${disabled || busy} onClick=${press}>${children}</button>
    ${problem && html` <span class="problem" role="alert">${problem.message}</span>`}`;
}

/**
 * A number with its label.
 * @param {{label: string, value: string, points?: (number|null)[], href?: string}} props
 */
export function Figure({ label, value, points, href }) {
  const text = html`<span class="label">${label}</span><span class="value">${value}</span>
    ${points && html`<${Spark} points=${points} />`}`;
  return html`<div class="figure">${href ? html`<a href=${href}>${text}</a>` : text}</div>`;
}

/** @param {{count: number, noun: string, children?: any}} props */
export function Empty({ children }) {
  return html`<p class="empty">${children}</p>`;
}

/**
 * Returns whether a text contains all words of a filter.
 * @param {string} filter
 * @param {string} text
 */
export function matches(filter, text) {
  const own = text.toLowerCase();
  return filter.toLowerCase().split(/\s+/).every((word) => own.includes(word));
}

/**
 * A field that filters a list.
 * @param {{value: string, change: (value: string) => void, label: string, found: number,
 *   noun: string}} props
 */
export function Filter({ value, change, label, found, noun }) {
  return html`<label class="filter">${label}
    <input type="search" value=${value} spellcheck=${false} autocomplete="off"
      onInput=${(/** @type {any} */ event) => change(event.target.value)} />
    <span class="dim">${several(found, noun)}</span></label>`;
}

/** Downloads text or bytes as a file. @param {string} file @param {Blob} blob */
export function download(file, blob) {
  const link = document.createElement('a');
  link.href = URL.createObjectURL(blob);
  link.download = file;
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 10000);
}

/** Lines of text from the network, escaped like names. @param {{text: string}} props */
export function Text({ text }) {
  return html`<pre tabindex="0">${String(text).split(/\r?\n/).map(visible).join('\n')}</pre>`;
}

/** Returns the colour of a CSS variable, such as `--line-1`. @param {string} variable */
export function colour(variable) {
  return getComputedStyle(document.documentElement).getPropertyValue(variable).trim();
}
