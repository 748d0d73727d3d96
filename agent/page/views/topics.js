// All topics in one table: filtered, sorted, measured on request.

import { named, post, Refusal, remove } from '../api.js';
import { bandwidth, count, duration, percent, rate, visible } from '../format.js';
import { address } from '../router.js';
import { replaceAddress, state, stream, useLive } from '../store.js';
import { sorted, Table } from '../table.js';
import { Act, Badges, FLAGS, FLAG_MEANINGS, Filter, html, matches, Name, Spark, TopicLink, worst } from '../ui.js';
import { Incomplete } from './overview.js';

const SEVERITY = /** @type {Record<string, number>} */ ({ error: 0, warning: 1, note: 2, good: 3 });

/** Filters of the list of topics. */
const ONLY = /** @type {Record<string, [string, (topic: any) => boolean]>} */ ({
  all: ['all', () => true],
  wrong: ['with problems', (topic) => ['error', 'warning'].includes(worst(state.flagsOf(topic.id)))],
  measured: ['measured', (topic) => topic.measured],
  unmeasured: ['not measured', (topic) => !topic.measured],
});

/**
 * Switches measuring on or off. A watch of this domain precedes one of all domains.
 * @param {import('../state.js').Topic} topic
 */
export async function watch(topic) {
  const everywhere = named('watch', watchName(topic));
  const path = `${everywhere}?domain_id=${topic.domain}`;
  if (!topic.measured || topic.watched === 0) return post(path);
  try {
    return await remove(path);
  } catch (error) {
    if (!(error instanceof Refusal && error.code === 'no-such-watch')) throw error;
    return remove(everywhere);
  }
}

// A topic without a ROS name is watched by its DDS name.
function watchName(/** @type {import('../state.js').Topic} */ topic) {
  return topic.kind === 'dds' ? topic.ddsName : topic.name;
}

/** Returns what measures a topic and cannot be switched off here, or null. @param {any} topic */
function fixed(topic) {
  if (!topic.measured || topic.watched === 0) return null;
  if (topic.watched & 4) return 'pattern';
  if ((topic.watched & 3) === 1) return 'configuration';
  if ((topic.watched & 3) === 2) return 'command line';
  return null;
}

/** @param {{topic: import('../state.js').Topic}} props */
export function Measure({ topic }) {
  const why = fixed(topic);
  // Without a watch, a topic is measured while its messages are shown or recorded.
  const on = topic.measured && topic.watched !== 0;
  if (why) return html`<span class="dim">on (${why})</span>`;
  return html`<${Act} action=${() => watch(topic)} pressed=${on} kind="switch"
    disabled=${stream.at != null || !state.may('watch')} label="${on ? 'on' : 'off'}: measure ${visible(topic.name)}">${on ? 'on' : 'off'}</${Act}>`;
}

/** @param {{query: Record<string, string>}} props */
export function Topics({ query }) {
  useLive();
  const { filter = '', sort = 'name', only = 'all', hidden = '' } = query;
  const change = (/** @type {Record<string, any>} */ more) => replaceAddress(
    address('topics', null, { ...query, ...more }));
  const domains = state.hasDomains();
  const accepts = (ONLY[only] ?? ONLY.all)[1];
  const rows = [...state.topics.values()].filter((topic) =>
    (hidden || !topic.hidden) && !topic.vanished && accepts(topic)
    && matches(filter, `${topic.name} ${topic.types.join(' ')} ${state.flagsOf(topic.id)
      .map((flag) => FLAGS[flag]?.[1] ?? flag).join(' ')}`));
  const figures = (/** @type {any} */ topic) => state.figuresOf(topic.id);
  const loss = (/** @type {any} */ topic) => {
    const { lost, expected } = figures(topic);
    return lost == null || !expected ? null : lost / expected;
  };
  const columns = [
    { key: 'name', title: 'Topic', header: true, by: (/** @type {any} */ topic) => topic.name,
      cell: (/** @type {any} */ topic) => html`<${TopicLink} topic=${topic} most=${100} />` },
    ...(domains ? [{ key: 'domain', title: 'Domain', kind: 'number wide',
      by: (/** @type {any} */ topic) => topic.domain,
      cell: (/** @type {any} */ topic) => topic.domain }] : []),
    { key: 'type', title: 'Type', kind: 'wide type',
      by: (/** @type {any} */ topic) => topic.types.join(),
      cell: (/** @type {any} */ topic) => html`<${Name} text=${topic.types.join(', ')} most=${80} />` },
    { key: 'state', title: 'State',
      by: (/** @type {any} */ topic) => SEVERITY[worst(state.flagsOf(topic.id))],
      cell: (/** @type {any} */ topic) => html`<${Badges} flags=${state.flagsOf(topic.id)} />` },
    { key: 'rate', title: 'Rate',
      meaning: 'Messages a second over the last seconds; a dash: not measured.', kind: 'number', by: (/** @type {any} */ topic) =>
      figures(topic).rate, cell: (/** @type {any} */ topic) => rate(figures(topic).rate) },
    { key: 'course', title: '10 min',
      meaning: 'The rate over the last ten minutes.', kind: 'wide',
      cell: (/** @type {any} */ topic) => topic.measured
        && html`<${Spark} points=${state.pointsOf(topic.id)} />` },
    { key: 'bandwidth', title: 'Bandwidth',
      meaning: 'Bytes of payload a second.', kind: 'number wide',
      by: (/** @type {any} */ topic) => figures(topic).bandwidth,
      cell: (/** @type {any} */ topic) => bandwidth(figures(topic).bandwidth) },
    { key: 'loss', title: 'Loss',
      meaning: 'Share of the messages that the subscriber with most losses did not receive.', kind: 'number wide', by: loss,
      cell: (/** @type {any} */ topic) => percent(loss(topic)) },
    { key: 'latency', title: 'p99 latency',
      meaning: 'Of 100 messages, 99 arrived faster: from the timestamp of the writer to the capture.', kind: 'number wide',
      by: (/** @type {any} */ topic) => figures(topic).p99,
      cell: (/** @type {any} */ topic) => duration(figures(topic).p99) },
    { key: 'ends', title: 'Pub/Sub',
      meaning: 'Number of publishers and of subscriptions.', kind: 'number wide',
      by: (/** @type {any} */ topic) => topic.publishers.length + topic.subscriptions.length,
      cell: (/** @type {any} */ topic) =>
        `${count(topic.publishers.length)}/${count(topic.subscriptions.length)}` },
    { key: 'measured', title: 'Measure',
      meaning: 'Whether a watch measures the topic. Watches of a pattern, of the configuration and of the command line cannot be switched off here.', by: (/** @type {any} */ topic) => (topic.measured ? 0 : 1),
      cell: (/** @type {any} */ topic) => html`<${Measure} topic=${topic} />` },
  ];
  return html`<h1 tabindex="-1">Topics</h1>
    <div class="controls">
      <${Filter} label="Filter" value=${filter} found=${rows.length} noun="topic"
        change=${(/** @type {string} */ text) => change({ filter: text })} />
      <label>Show <select value=${only}
        onChange=${(/** @type {any} */ event) => change({ only: event.target.value })}>
        ${Object.entries(ONLY).map(([key, [title]]) => html`<option value=${key}>${title}</option>`)}
      </select></label>
      <label><input type="checkbox" checked=${Boolean(hidden)}
        onChange=${(/** @type {any} */ event) => change({ hidden: event.target.checked })} />
        hidden topics</label>
      <a href=${address('graph')}>Show as a graph</a>
    </div>
    <${Table} label="Topics" columns=${columns} rows=${sorted(rows, columns, sort)} sort=${sort}
      keyOf=${(/** @type {any} */ topic) => topic.id} meanings=${FLAG_MEANINGS}
      onSort=${(/** @type {string} */ next) => change({ sort: next })} />
    ${!rows.length && html`<p class="empty">${state.topics.size
      ? 'No topic matches.' : 'No topic is known.'}</p>`}
    <${Incomplete} missing="they are not in the table" />`;
}
