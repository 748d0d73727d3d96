// One topic: its figures over time, its endpoints and their QoS, its losses, and its messages.

import { useRef, useState } from '../vendor/hooks.mjs';
import { named } from '../api.js';
import { Chart } from '../chart.js';
import { bandwidth, count, date, duration, eventWords, percent, rate, several, when } from '../format.js';
import { address } from '../router.js';
import { topicKey } from '../graph-model.js';
import { LiveMessage } from '../message.js';
import { Endpoints, Offered } from '../qos.js';
import { state, stream, useLive, usePoll } from '../store.js';
import { eventsOf, inWords, marksOf, useEvents, useHistory, useTime, zoom } from '../timebar.js';
import { Badges, Failed, Figure, html, Mark, Name, PASSAGES, Text } from '../ui.js';
import { InChains } from './chains.js';
import { Inside } from './inside.js';
import { Findings } from './overview.js';
import { Measure } from './topics.js';

const COLUMNS = ['times', 'rate_hertz', 'bandwidth_bytes_per_second', 'lost_messages',
  'latency_p50_seconds', 'latency_p99_seconds', 'interarrival_p50_seconds',
  'interarrival_p99_seconds'];
const HISTORY_AGAIN_MS = 10000;
/** Time of the charts that the stream continues, in seconds. */
const LIVE_SPAN = 600;
/** Most events in the list below the charts. */
const MOST_MARKED = 100;

/** @param {{name: string, query: Record<string, string>}} props */
export function Topic({ name, query }) {
  useLive();
  const domain = query.domain ? Number(query.domain) : null;
  const topic = state.topicNamed(name, domain);
  const scope = topic ? `?domain_id=${topic.domain}` : domain == null ? '' : `?domain_id=${domain}`;
  const [picked, pick] = useState(/** @type {{time: number, topic?: number}|null} */ (null));
  const known = useEvents(useTime());
  const details = usePoll(topic ? named('topics', apiName(topic), scope) : null, 2000);
  if (!topic) {
    return html`<h1 tabindex="-1"><${Name} text=${name} /></h1>
      <p>No such topic ${stream.at == null ? 'now. It may have had no endpoint since the agent started'
        : state.unknown ? 'is known of that time' : 'at that time'}.${' '}
      <a href=${address('topics')}>All topics</a></p>
      ${state.unknown && html`<${Charts} topic=${{ id: 0, name, ddsName: name, kind: 'topic', measured: true }}
        scope=${scope} events=${eventsOf(known, name)} pick=${() => {}} />`}`;
  }
  const events = eventsOf(known, topic.name);
  const figures = state.figuresOf(topic.id);
  const findings = state.findings.filter((finding) => finding.topic === topic.id);
  const reasons = details.data?.reasons ?? [];
  return html`<h1 tabindex="-1"><${Name} text=${topic.name} /></h1>
    <p class="facts"><span class="dim">Type</span> ${topic.types.map((type) => html`<${Name}
        text=${type} /> `)}
      ${state.hasDomains() && html`<span class="dim">Domain</span> ${topic.domain} `}
      <span class="dim">Measure</span> <${Measure} topic=${topic} />
      <a href=${address('graph', null, { focus: topicKey(topic), hops: 1 })}>In the graph</a>
      <a href=${address('events', null, { filter: topic.name })}>Events</a></p>
    <p><${Badges} flags=${state.flagsOf(topic.id)} explained /></p>
    <${InChains} domain=${topic.domain} topic=${topic.name} />
    ${findings.length > 0 && html`<section aria-label="Findings"><${Findings} list=${findings} />
      </section>`}
    ${reasons.length > 0 && html`<ul class="findings">${reasons.map((/** @type {any} */ reason) =>
      html`<li key=${reason.code}><${Mark} severity="note" /> <${Name} text=${reason.detail} /></li>`)}
      </ul>`}
    ${details.data?.source === 'inside' && html`<p class="dim">Rate and messages come from inside
      the processes; the network shows none, and sizes are unknown.</p>`}
    ${stream.at == null && html`<${LiveMessage} key=${`message ${state.open?.run} ${topic.id}`} topic=${topic} scope=${scope}
      name=${apiName(topic)} events=${events} />`}
    <div class="figures">
      <${Figure} label="rate" value=${rate(figures.rate)} />
      <${Figure} label="bandwidth" value=${bandwidth(figures.bandwidth)} />
      <${Figure} label="messages" value=${count(figures.messages)} />
      <${Figure} label="lost" value=${count(figures.lost)} />
      <${Figure} label="latency p50" value=${duration(figures.p50)} />
      <${Figure} label="latency p99" value=${duration(figures.p99)} />
      <${Figure} label="last message" value=${when(figures.last)} />
    </div>
    <${Clocks} publishers=${details.data?.publishers ?? []} />
    <${Charts} key=${topic.id} topic=${topic} scope=${scope} events=${events} pick=${(/** @type {{time: number}} */
      { time }) => pick({ time, topic: topic.id })} />
    <${Failed} problem=${details.problem} what="No details" />
    ${details.data && html`
      <${Endpoints} details=${details.data} topic=${topic} />
      <${Offered} details=${details.data} />
      <${Inside} key=${`inside ${topic.id}`} inside=${details.data.inside} name=${topic.name}
        domain=${topic.domain} picked=${picked?.topic === topic.id ? picked : null} />
      <${Waterfall} details=${details.data} />
      <${Passages} details=${details.data} />`}
    ${stream.at == null && html`<${Definition} key=${`definition ${topic.id}`}
      path=${named('topics', apiName(topic), `/definition${scope}`)} />`}`;
}

/** Returns the name for addresses: the DDS name if it has no ROS name. @param {any} topic */
function apiName(topic) {
  return topic.kind === 'dds' ? topic.ddsName : topic.name;
}

/** How wrong latencies from other hosts are. @param {{publishers: any[]}} props */
function Clocks({ publishers }) {
  const hosts = new Map(publishers.filter((each) => each.clock).map((each) =>
    [each.clock.peer, each.clock]));
  return html`${[...hosts.values()].map((each) => html`<p key=${each.peer} class="dim">
    ${each.correction_seconds == null
      ? html`The clock of <${Name} text=${each.peer} /> has an unknown offset: latencies from there
        may be wrong by any time.`
      : html`Latencies from <${Name} text=${each.peer} /> ${each.correction_seconds === 0
        ? 'need no correction'
        : `are corrected by ${duration(each.correction_seconds)}`}, and wrong by at most
        ${' '}${duration(each.uncertainty_seconds)}: its clock.`}</p>`)}`;
}

/** @param {{topic: import('../state.js').Topic, scope: string, events: import('../state.js').Event[],
 *   pick: (picked: {time: number}) => void}} props */
function Charts({ topic, scope, events, pick }) {
  const shown = useTime();
  const path = named('topics', apiName(topic), `/history${scope}`);
  const isLive = shown.at == null && shown.span === LIVE_SPAN && isInMemory();
  const latest = useLatest(isLive ? path : null, topic);
  const past = useHistory(isLive ? null : path, shown);
  const columns = isLive ? latest : COLUMNS.map((column) => past.data?.[column] ?? []);
  const marks = marksOf(events);
  const [times, rates, sizes, lost, half, most, gapHalf, gapMost] = columns;
  const title = inWords(isLive ? { at: null, span: liveSpan() } : shown);
  if (!times.length) {
    return html`<p class="dim">${past.problem ? `No history: ${past.problem.message}`
      : !isLive && !past.data ? 'Reading the history …'
        : topic.measured ? 'No second has been measured yet.'
          : 'The topic is not measured: no charts.'}</p>`;
  }
  const own = /** @type {number[]} */ (times);
  const chart = (/** @type {Record<string, any>} */ props) => html`<${Chart} times=${own} range=${title}
    marks=${marks} select=${state.open?.keeps_history ? zoom : undefined} ...${props} />`;
  return html`<section aria-labelledby="course"><h2 id="course">${title}</h2>
    ${state.open?.keeps_history && html`<p class="dim by-mouse">Drag over a part of a chart to see it alone.</p>`}
    <div class="charts">
    ${chart({ title: 'Rate', print: rate,
      lines: [{ label: 'rate', colour: '--line-1', values: rates, fill: true }] })}
    ${chart({ title: 'Bandwidth', print: bandwidth,
      lines: [{ label: 'bandwidth', colour: '--line-2', values: sizes, fill: true }] })}
    ${chart({ title: 'Time between messages', print: duration, lines: [
      { label: 'p50', colour: '--line-1', values: gapHalf },
      { label: 'p99', colour: '--line-3', values: gapMost }] })}
    ${chart({ title: 'Latency', print: duration, lines: [
      { label: 'p50', colour: '--line-1', values: half },
      { label: 'p99', colour: '--line-3', values: most }],
      note: `From the writer’s timestamp to the capture; between hosts it is corrected by the known offset of their clocks.${
        shown.at == null ? ` A click, or Enter at the cursor, observes calls and lists the late ones of
        that time` : ''}`, pick: shown.at == null ? pick : undefined })}
    ${chart({ title: 'Lost messages', print: count, whole: true,
      lines: [{ label: 'lost', colour: '--line-4', values: lost, fill: true }] })}
    </div><${Marked} events=${events} /></section>`;
}

/** Returns the seconds of the charts that the stream continues: the agent may keep less in memory. */
export function liveSpan() {
  return Math.min(LIVE_SPAN, state.open?.history_seconds ?? LIVE_SPAN);
}

/** Returns whether the stream continues charts: the disk may have more of their time. */
export function isInMemory() {
  return liveSpan() === LIVE_SPAN || !state.open?.keeps_history;
}

/**
 * Removes the rows that are older than the charts.
 * @param {(number|null)[][]} columns the first one has the times
 * @param {number} now
 */
export function shorten(columns, now) {
  const first = columns[0].findIndex((time) => Number(time) > now - liveSpan());
  for (const column of columns) column.splice(0, first < 0 ? column.length : first);
}

/** The events that the charts mark. @param {{events: import('../state.js').Event[]}} props */
function Marked({ events }) {
  if (!events.length) return null;
  return html`<details><summary>${several(events.length, 'event')} in this time</summary>
    <ul class="plain">${events.slice(-MOST_MARKED).map((event) => html`<li key=${event.id}>
      ${date(Date.parse(event.time) / 1000)} ${eventWords(event)}</li>`)}</ul></details>`;
}

/**
 * Returns the columns of the last minutes. Between two requests the stream provides the latest
 * second.
 * @param {string|null} path
 * @param {import('../state.js').Topic} topic
 */
function useLatest(path, topic) {
  const { data } = usePoll(path, HISTORY_AGAIN_MS);
  const latest = useRef({ data, columns: /** @type {(number|null)[][]} */ (COLUMNS.map(() => [])) });
  if (data && data !== latest.current.data) {
    const columns = COLUMNS.map((column) => [...(data[column] ?? [])]);
    shorten(columns, data.timestamp_seconds);
    latest.current = { data, columns };
  }
  const { columns } = latest.current;
  const [times] = columns;
  const { rate: hertz, bandwidth: size, lostNow, p50, p99 } = state.figuresOf(topic.id);
  const last = times[times.length - 1] ?? 0;
  if (path != null && hertz != null && state.time >= Number(last) + 0.9) {
    [state.time, hertz, size, lostNow, p50, p99, null, null].forEach((value, at) => columns[at].push(value));
    shorten(columns, state.time);
  }
  return columns;
}

/** The definition of the topic's type, requested when it is opened. @param {{path: string}} props */
function Definition({ path }) {
  const [open, turn] = useState(false);
  const { data, problem } = usePoll(open ? path : null, 0);
  return html`<section aria-labelledby="definition"><h2 id="definition">Type definition</h2>
    <p><button type="button" aria-expanded=${open} onClick=${() => turn(!open)}>${open
      ? 'Close' : 'Show'}</button></p>
    ${open && html`<${Failed} problem=${problem} what="No definition" />`}
    ${open && data && (data.known
      ? html`<${Text} text=${data.definition} />`
      : html`<p><${Mark} severity="note" /> The definition of <${Name} text=${data.name} /> is not
        known: <${Name} text=${data.reason ?? 'no file has it'} /></p>`)}</section>`;
}

/** Places at which a message can be lost, in order of its path. */
const STATIONS = /** @type {[string, string, string][]} */ ([
  ['lost_at_sender_messages', 'at the sender', 'lost-4'],
  ['lost_before_host_messages', 'before this host', 'lost-0'],
  ['lost_in_reassembly_messages', 'in IP reassembly', 'lost-1'],
  ['lost_in_socket_buffer_messages', 'in the socket buffer', 'lost-2'],
  ['pending_messages', 'or late, not known so far', 'lost-3'],
]);
/** The last place: a message is delivered there, and then dropped. */
const QUEUE = 'in the reader’s queue';

/** Messages sent, lost at each place, and delivered, per subscriber. @param {{details: any}} props */
function Waterfall({ details }) {
  const received = details.deliveries.filter((/** @type {any} */ each) =>
    each.direction === 'received');
  const sent = details.deliveries.filter((/** @type {any} */ each) => each.direction === 'sent');
  const owners = new Map([...details.publishers, ...details.subscriptions].map(
    (/** @type {any} */ each) => [each.guid, each.node]));
  const title = html`<h2 id="waterfall">Where messages are lost</h2>`;
  if (!received.length) {
    const out = sent.reduce((/** @type {number} */ sum, /** @type {any} */ each) =>
      sum + each.delivered.messages, 0);
    return html`<section aria-labelledby="waterfall">${title}
      <p class="dim">${sent.length
        ? `${several(out, 'message')} left this host; what arrives elsewhere is seen there.`
        : 'No delivery to a subscriber’s socket has been seen yet.'}</p></section>`;
  }
  // Only TCP shows what a sender drops.
  const stations = STATIONS.filter(([key]) => key !== 'lost_at_sender_messages'
    || received.some((/** @type {any} */ each) => each.delivered[key] > 0));
  return html`<section aria-labelledby="waterfall">${title}
    <div class="scroll" tabindex="0" role="group" aria-labelledby="waterfall"><table>
    <thead><tr><th scope="col">Publisher → subscriber</th><th scope="col" class="number">Sent</th>
      ${[...stations.map(([, name]) => name), QUEUE].map((name) => html`<th scope="col"
        class="number">Lost ${name}</th>`)}
      <th scope="col" class="number">Delivered</th><th scope="col">Share</th></tr></thead>
    <tbody>${received.map((/** @type {any} */ each) => {
      const { delivered, lost_in_reader_queue_messages: queue } = each;
      const total = delivered.messages + delivered.lost_messages + delivered.pending_messages;
      const cell = (/** @type {number|null} */ lost) => html`<td class="number ${(lost ?? 0) > 0
        ? 'bad' : ''}">${(lost ?? 0) > 0 ? html`<${Mark} severity="warning" /> ` : ''}${count(
        lost)}</td>`;
      const who = each.nodes.length ? each.nodes.join(', ')
        : each.process ? state.processName({ process: each.process, pid: each.process_id })
          : each.subscriber || each.destination;
      return html`<tr key=${`${each.writer} ${each.destination} ${each.subscriber}`}>
        <th scope="row"><${Name} text=${owners.get(each.writer) ?? each.writer} /> → <${Name}
          text=${who} /></th>
        <td class="number">${count(total)}</td>
        ${stations.map(([key]) => cell(delivered[key]))}
        ${cell(queue)}
        <td class="number">${count(delivered.messages - (queue ?? 0))}</td>
        <td><${Bar} delivered=${delivered} queue=${queue ?? 0} total=${total} /></td></tr>`;
    })}</tbody></table></div>
    ${received.some((/** @type {any} */ each) => each.lost_in_reader_queue_messages == null)
      && html`<p class="dim">–: the queue is not observed, because the takes of that subscriber are not
        observed, or not alone (capture.inside).</p>`}</section>`;
}

/** @param {{delivered: any, queue: number, total: number}} props */
function Bar({ delivered, queue, total }) {
  if (!total) return null;
  let x = 0;
  const part = (/** @type {number} */ number, /** @type {string} */ kind) => {
    const width = (number / total) * 160;
    const own = width > 0 && html`<rect x=${x} y="0" width=${Math.max(1.5, width)} height="12"
      class=${kind} />`;
    x += width;
    return own;
  };
  return html`<svg class="bar" viewBox="0 0 160 12" aria-hidden="true">
    ${part(delivered.messages - queue, 'delivered')}
    ${STATIONS.map(([key, , kind]) => part(delivered[key], kind))}
    ${part(queue, 'lost-2')}</svg>
    ${' '}${percent((delivered.messages - queue) / total)}`;
}

/** The passages of messages to subscribers. @param {{details: any}} props */
function Passages({ details }) {
  const { passages, acknowledgements, breakdown } = details;
  const late = acknowledgements.filter((/** @type {any} */ each) => each.lag_messages > 0);
  const stages = /** @type {[string, string][]} */ ([
    ['send_delay', 'from the timestamp to sending'], ['transit', 'from sending to arrival'],
    ['transfer', 'first to last datagram'], ['retransmission', 'until a lost datagram was repeated']]);
  const spent = stages.filter(([key]) => breakdown?.[key]);
  if (!passages.length && !late.length && !spent.length) return null;
  return html`<section aria-labelledby="ways"><h2 id="ways">Paths of messages</h2>
    ${passages.length > 0 && html`<p>${passages.map((/** @type {any} */ each) =>
      `${PASSAGES[each.passage] ?? each.passage}: ${count(each.pairs)} ${each.pairs === 1
        ? 'pair' : 'pairs'}${each.observed_pairs
        ? `, ${count(each.observed_pairs)} seen inside` : ''}${each.view ? ` (view: ${each.view})` : ''}`).join('; ')}</p>`}
    ${spent.length > 0 && html`<table><caption>Delays on this host</caption><thead><tr>
      <th scope="col">Part</th><th scope="col" class="number">p50</th>
      <th scope="col" class="number">p99</th></tr></thead><tbody>${spent.map(([key, name]) => html`
      <tr key=${key}><th scope="row">${name}</th><td class="number">${duration(
        breakdown[key].p50_seconds)}</td><td class="number">${duration(
        breakdown[key].p99_seconds)}</td></tr>`)}</tbody></table>`}
    ${late.length > 0 && html`<table><caption>Readers that lag behind</caption><thead><tr>
      <th scope="col">Reader</th><th scope="col" class="number">Messages</th>
      <th scope="col" class="number">Time</th></tr></thead><tbody>${late.map(
      (/** @type {any} */ each) => html`<tr key=${each.writer + each.reader}><th scope="row">
        <${Name} text=${each.node ?? each.reader} /></th><td class="number">${count(
        each.lag_messages)}</td><td class="number">${duration(each.lag_seconds)}</td></tr>`)}
      </tbody></table>`}</section>`;
}
