// Chains of messages through nodes: a list, and a waterfall of the hops of one.

import { chainAddress, chainsThrough, chosen, graphWords, lateCallsAddress, NO_CHAIN, partsOf,
  rowsOf, section, slowest, tickText, topicsOf, waterfall, wayOf } from '../chains.js';
import { count, duration, several, shortened, visible, when } from '../format.js';
import { address } from '../router.js';
import { replaceAddress, state, stream, useLive, usePoll } from '../store.js';
import { sorted, Table } from '../table.js';
import { Failed, Figure, Filter, html, Mark, matches, Name } from '../ui.js';
import { useState } from '../vendor/hooks.mjs';
import { Late } from './late.js';

const EVERY_MS = 2000;
/** Between requests of views that only name chains. */
const RARELY_MS = 5000;
/** Between requests that keep calls observed. The agent observes them for 10 s after each. */
const LATE_MS = 4000;
/** Most chains named beside a topic or node. */
const MOST_NAMED = 5;

/** Severity, word and meaning of each state of a configured chain. */
const STATES = /** @type {Record<string, [string, string]>} */ ({
  ok: ['good', 'The chain is configured and within its limit.'],
  slow: ['warning', 'The 99th percentile of the last 10 s exceeds the limit.'],
  idle: ['note', 'No message passed the chain in the last 10 s.'],
});

/** Each state with its meaning. */
const MEANINGS = /** @type {[string, string][]} */ (Object.entries(STATES).map(([state, [, meaning]]) =>
  [state, meaning]));

/** @param {{expected: import('../chains.js').Expected|null}} props */
function ChainState({ expected }) {
  if (!expected) return null;
  const [severity] = STATES[expected.state] ?? ['note', ''];
  return html`<span class="badge ${severity}"><${Mark} severity=${severity} />${' '}
    <${Name} text=${expected.state} /></span>`;
}

/** @param {{from: string, to: string, most?: number}} props */
function Ends({ from, to, most }) {
  return html`<${Name} text=${from} most=${most} /> → <${Name} text=${to} most=${most} />`;
}

/** @param {import('../chains.js').Expected|null} expected in seconds */
const limitOf = (expected) => (expected?.max_latency_ms == null ? null
  : expected.max_latency_ms / 1000);

/** @param {{query: Record<string, string>}} props */
export function Chains({ query }) {
  useLive();
  const { filter = '', sort = '' } = query;
  const { data, problem } = usePoll('chains?calls=true', EVERY_MS);
  const change = (/** @type {Record<string, any>} */ more) => replaceAddress(
    address('chains', null, { ...query, ...more }));
  const all = data ? rowsOf(data) : [];
  const rows = all.filter((row) => matches(filter, [row.from, row.to, row.method,
    row.expected?.state, ...(row.chain ? topicsOf(row.chain) : []),
    ...(row.chain?.hops ?? []).map((hop) => hop.node)].join(' ')));
  const columns = [
    { key: 'chain', title: 'Chain', header: true,
      by: (/** @type {any} */ row) => `${row.from} ${row.to}`,
      cell: (/** @type {any} */ row) => html`<a href=${row.href}><${Ends} from=${row.from}
        to=${row.to} most=${60} /></a>` },
    ...(state.hasDomains() ? [{ key: 'domain', title: 'Domain', kind: 'number wide',
      by: (/** @type {any} */ row) => row.domain,
      cell: (/** @type {any} */ row) => row.domain ?? 'all' }] : []),
    { key: 'state', title: 'State', by: (/** @type {any} */ row) =>
      row.expected && ['slow', 'idle', 'ok'].indexOf(row.expected.state),
      cell: (/** @type {any} */ row) => html`<${ChainState} expected=${row.expected} />` },
    { key: 'limit', title: 'Limit',
      meaning: 'The maximum latency that the configuration expects (max_latency_ms).', kind: 'number wide',
      by: (/** @type {any} */ row) => limitOf(row.expected),
      cell: (/** @type {any} */ row) => duration(limitOf(row.expected)) },
    { key: 'p50', title: 'p50',
      meaning: 'Half of the messages passed the chain faster.', kind: 'number',
      by: (/** @type {any} */ row) => row.latency?.p50_seconds,
      cell: (/** @type {any} */ row) => duration(row.latency?.p50_seconds) },
    { key: 'p99', title: 'p99',
      meaning: 'Of 100 messages, 99 passed the chain faster.', kind: 'number',
      by: (/** @type {any} */ row) => row.latency?.p99_seconds,
      cell: (/** @type {any} */ row) => duration(row.latency?.p99_seconds) },
    { key: 'hops', title: 'Hops', kind: 'number wide',
      by: (/** @type {any} */ row) => row.chain?.hops.length,
      cell: (/** @type {any} */ row) => count(row.chain?.hops.length) },
    { key: 'bottleneck', title: 'Bottleneck',
      meaning: 'The node that takes most of the time.', kind: 'wide', cell: (/** @type {any} */ row) => {
      const hop = row.chain && slowest(row.chain);
      return hop && html`<${Name} text=${hop.node ?? 'unknown node'} most=${60} />`;
    } },
    { key: 'messages', title: 'Messages', kind: 'number wide',
      by: (/** @type {any} */ row) => row.chain?.messages,
      cell: (/** @type {any} */ row) => count(row.chain?.messages) },
    { key: 'last', title: 'Last', kind: 'number wide',
      by: (/** @type {any} */ row) => row.chain?.last_seen_seconds,
      cell: (/** @type {any} */ row) => when(row.chain?.last_seen_seconds) },
    { key: 'method', title: 'Method',
      meaning: 'How messages are followed: by their stamps, or by calls inside processes.', kind: 'wide', by: (/** @type {any} */ row) => row.method,
      cell: (/** @type {any} */ row) => html`<${Name} text=${row.method ?? ''} />` },
  ];
  return html`<h1 tabindex="-1">Chains</h1>
    <p class="dim">The way of a measurement through nodes, from its first publication to its last,
      with the time that each node takes.</p>
    <div class="controls"><${Filter} label="Filter" value=${filter} found=${rows.length}
      noun="chain" change=${(/** @type {string} */ text) => change({ filter: text })} /></div>
    <${Failed} problem=${problem} what=${data ? 'The chains are not updated' : 'No chains'} />
    ${data && rows.length > 0 && html`<${Table} label="Chains" columns=${columns} meanings=${MEANINGS}
      rows=${sorted(rows, columns, sort)} sort=${sort}
      keyOf=${(/** @type {any} */ row) => row.key}
      rowClass=${(/** @type {any} */ row) => (row.expected?.state === 'slow' ? 'bad' : '')}
      onSort=${(/** @type {string} */ next) => change({ sort: next })} />`}
    ${data && all.length > 0 && !rows.length && html`<p class="empty">No chain matches.</p>`}
    ${data && !all.length && html`<${NoChain} />`}`;
}

/** Names what makes chains appear. */
function NoChain() {
  if (stream.at != null) return html`<p class="empty">No chain was known at that time.</p>`;
  const measured = [...state.topics.values()].filter((topic) => topic.measured).length;
  return html`<div class="empty"><p>No chain has been found. A chain appears after 5 messages, if:</p>
    <ul><li>its topics are measured (<a href=${address('topics', null, { only: 'measured' })}
        >${several(measured, 'topic')} now</a>) or belong to a configured chain,</li>
      <li>their types begin with a header, and they have subscriptions,</li>
      <li>the nodes between them copy the stamp of their input into their output.</li></ul>
    <p>Where calls inside processes are observed, as they are while this view is open, neither headers
      nor stamps are necessary.</p></div>`;
}

/** @param {{from: string, query: Record<string, string>}} props */
export function ChainView({ from, query }) {
  useLive();
  const { to = '', domain = '' } = query;
  const words = new URLSearchParams({
    from, ...(to && { to }), ...(domain && { domain_id: domain }) });
  const { data, problem } = usePoll(`chains?calls=true&${words}`, EVERY_MS);
  // Answers of the past have whole chains only.
  const chain = data && (stream.at == null ? chosen : section)(data.chains, from, query);
  const end = chain?.to ?? to;
  const expected = data?.expected.find((/** @type {any} */ each) => each.from === from
    && each.to === end && (!chain || (each.domain_id === chain.domain_id
    && each.method === chain.method))) ?? null;
  const limit = limitOf(expected);
  return html`<h1 tabindex="-1"><${Ends} from=${from} to=${end} /></h1>
    <p class="facts">${chain && html`<span class="dim">Recognised by</span>
        <${Name} text=${chain.method} />
        <span class="dim">Published by</span> <${NodeName} name=${chain.source}
          domain=${chain.domain_id} />
        ${state.hasDomains() && html`<span class="dim">Domain</span> ${chain.domain_id} `}
        <a href=${address('graph', null, graphWords(chain))}>In the graph</a>`}
      <a href=${address('chains')}>All chains</a></p>
    ${expected && html`<p><${ChainState} expected=${expected} />${' '}
      ${STATES[expected.state]?.[1] ?? ''}</p>`}
    <${Failed} problem=${problem} what=${data ? 'The chain is not updated' : 'No chain'} />
    ${data && !chain && html`<p class="empty">${expected
      ? 'The chain is configured, and no message has passed it so far.'
      : `No such chain ${stream.at == null ? 'now' : 'at that time'}. It may have had no message since the agent started.`}</p>`}
    ${chain && html`<div class="figures">
      <${Figure} label="end to end p50" value=${duration(chain.latency.p50_seconds)} />
      <${Figure} label="end to end p99" value=${duration(chain.latency.p99_seconds)} />
      <${Figure} label="maximum" value=${duration(chain.latency.maximum_seconds)} />
      ${limit != null && html`<${Figure} label="limit" value=${duration(limit)} />`}
      <${Figure} label="messages" value=${count(chain.messages)} />
      <${Figure} label="last message" value=${when(chain.last_seen_seconds)} /></div>
      <${Waterfall} chain=${chain} limit=${limit} />
      ${stream.at == null ? html`<${WhyLate} key=${chainAddress(chain)} chain=${chain} />`
        : html`<p class="dim">Late calls of its callbacks are not kept.</p>`}`}`;
}

/** Shows the late calls of a chain's callbacks on request.
 * @param {{chain: import('../chains.js').Chain}} props */
function WhyLate({ chain }) {
  const [observes, observe] = useState(false);
  const answer = usePoll(observes ? lateCallsAddress(chain) : null, LATE_MS);
  return html`<section aria-labelledby="why"><h2 id="why">Late calls of its callbacks</h2>
    ${observes ? html`<${Late} answer=${answer} />`
      : html`<p><button type="button" onClick=${() => observe(true)}>Why late?</button></p>`}</section>`;
}

/** @param {{name: string|null, domain: number}} props */
function NodeName({ name, domain }) {
  if (name == null) return html`<span>unknown node</span>`;
  return html`<a href=${address('nodes', name, { domain })}><${Name} text=${name} /></a>`;
}

/** @param {{name: string, domain: number}} props */
function TopicName({ name, domain }) {
  return html`<a href=${address('topics', name, { domain })}><${Name} text=${name} /></a>`;
}

/** Returns a share of the axis as a coordinate. @param {number} share */
const at = (share) => `${(share * 100).toFixed(3)}%`;

/** @param {{chain: import('../chains.js').Chain, limit: number|null}} props */
function Waterfall({ chain, limit }) {
  const { bars, total, ticks, end, limit: line } = waterfall(chain, limit);
  const worst = slowest(chain);
  const rows = [...chain.hops.map((hop, place) => ({
    key: String(place), hop, figures: hop.latency, bar: bars[place], parts: partsOf(hop),
  })), { key: 'total', hop: null, figures: chain.latency, bar: total, parts: [] }];
  const used = new Map(rows.flatMap((row) => row.parts.map(({ name, title }) => [name, title])));
  const track = (/** @type {any} */ row) => html`<${Track} bar=${row.bar} line=${line}
    ticks=${ticks.map((tick) => tick / end)} />`;
  const figure = (/** @type {string} */ key, /** @type {string} */ title,
    /** @type {'p50_seconds'|'p99_seconds'|'maximum_seconds'} */ of) => ({
    key, title, kind: `number ${key}`,
    cell: (/** @type {any} */ row) => duration(row.figures[of]) });
  const columns = [
    { key: 'hop', title: 'Hop', header: true, kind: 'hop', cell: (/** @type {any} */ { hop }) => (hop
      ? html`<${NodeName} name=${hop.node} domain=${chain.domain_id} />${hop === worst
        ? html` <span class="badge">◆ bottleneck</span>` : ''}<br /><span class="dim"><${TopicName}
        name=${hop.input} domain=${chain.domain_id} /> → <${TopicName} name=${hop.output}
        domain=${chain.domain_id} /></span>`
      : 'End to end') },
    { key: 'time', title: html`<span class="reader-only">Parts</span><${Axis} ticks=${ticks}
        end=${end} />`, kind: 'time',
      cell: (/** @type {any} */ row) => html`${track(row)}${row.parts.length > 0 && html`<span
        class="parts">${row.parts.map((/** @type {any} */ part) => html`<span key=${part.name}
        ><${Swatch} name=${part.name} /> ${part.title} ${duration(part.figures.p50_seconds)} <span
        class="dim">p99 ${duration(part.figures.p99_seconds)}</span></span> `)}</span>`}` },
    figure('p50', 'p50', 'p50_seconds'), figure('p99', 'p99', 'p99_seconds'),
    figure('most', 'max', 'maximum_seconds'),
  ];
  return html`<section class="waterfall" aria-labelledby="waterfall"><h2 id="waterfall">Hops on one
      axis of time</h2>
    <${Table} label="Hops of the chain" columns=${columns} rows=${rows} sort=""
      keyOf=${(/** @type {any} */ row) => row.key} onSort=${() => {}}
      rowClass=${(/** @type {any} */ row) => (!row.hop ? 'total'
        : row.hop === worst ? 'worst' : '')} />
    <p class="dim">A bar is the median of a hop, and begins where the one before it ends. ${used.size > 0
      && html`It is divided in proportion to the medians of its parts. `}The thin line ends at the
      99th percentile.${line != null && html` The dashed line is the limit of ${duration(limit)}.`}${
      limit != null && line == null && html` The limit of ${duration(limit)} is beyond the axis.`}${
      used.has('processing') && html` The node’s part includes the wait for its callback.`}${
      chain.hops.some((hop) => !partsOf(hop).length)
        && html` Hops without parts: the arrival at the node was not observed.`}</p></section>`;
}

/** @param {{name: string}} props */
function Swatch({ name }) {
  return html`<svg class="swatch" viewBox="0 0 10 10" aria-hidden="true"><rect class="part ${name}"
    width="10" height="10" /></svg>`;
}

/** @param {{ticks: number[], end: number}} props */
function Axis({ ticks, end }) {
  return html`<svg class="track axis" aria-hidden="true" width="100%" height="16">${ticks.map((tick) =>
    html`<text key=${tick} x=${at(tick / end)} y="12" class=${tick === 0 ? 'first'
      : tick / end > 0.92 ? 'last' : ''}>${tickText(tick)}</text>`)}</svg>`;
}

/** @param {{bar: import('../chains.js').Bar, ticks: number[], line: number|null}} props */
function Track({ bar, ticks, line }) {
  const ended = bar.start + bar.width;
  return html`<svg class="track" aria-hidden="true" width="100%" height="20">
    ${ticks.map((tick) => html`<line key=${tick} class="tick" x1=${at(tick)} x2=${at(tick)} y1="0"
      y2="20" />`)}
    ${line != null && html`<line class="limit" x1=${at(line)} x2=${at(line)} y1="0" y2="20" />`}
    <line class="whisker" x1=${at(ended)} x2=${at(bar.whisker)} y1="10" y2="10" />
    <line class="whisker" x1=${at(bar.whisker)} x2=${at(bar.whisker)} y1="6" y2="14" />
    ${bar.parts.map((part) => html`<rect key=${part.name} class="part ${part.name}"
      x=${at(part.start)} y="3" width=${at(Math.max(0.002, part.width))} height="14" />`)}</svg>`;
}

/** Most chains to choose from, and characters of each topic there. */
const [MOST_CHAINS, MOST_CHARACTERS] = [200, 32];

/** Chooses the chain that the graph highlights. @param {any} props */
export function ChainField({ chains, chain, query, change }) {
  const all = (chains.data?.chains ?? []).slice(0, MOST_CHAINS);
  if (!query.chain && !all.length) return null;
  const own = chain && all.findIndex((/** @type {any} */ each) => wayOf(each) === wayOf(chain)
    && each.method === chain.method && each.domain_id === chain.domain_id);
  const pick = (/** @type {any} */ event) => {
    const picked = event.target.value && all[Number(event.target.value)];
    change(picked ? { ...NO_CHAIN, ...graphWords(picked) } : NO_CHAIN);
  };
  return html`<div class="controls"><label>Chain <select value=${chain ? String(own) : ''}
      onChange=${pick}>
      <option value="">none</option>
      ${chain && own < 0 && html`<option value="-1">${endsText(chain)}</option>`}
      ${all.map((/** @type {any} */ each, /** @type {number} */ at) => html`<option key=${at}
        value=${String(at)}>${endsText(each)} (${visible(each.method)})</option>`)}</select></label>
    ${chain && html`<label><input type="checkbox" checked=${Boolean(query.only)}
        onChange=${(/** @type {any} */ event) => change({ only: event.target.checked })} />
        only this chain</label>
      <a href=${chainAddress(chain)}>Open the chain</a>`}
    ${query.chain && !chain && chains.data && html`<span class="problem"><${Mark}
      severity="warning" /> The chain from <${Name} text=${query.chain} most=${40} /> does not exist${' '}
      ${state.past ? 'at that time' : 'now'}.</span>`}</div>`;
}

/** @param {import('../chains.js').Chain} chain */
function endsText(chain) {
  return `${shortened(chain.from, MOST_CHARACTERS)} → ${shortened(chain.to, MOST_CHARACTERS)}`;
}

/** Links to chains. @param {{chains: import('../chains.js').Chain[], filter: string}} props */
export function ChainLinks({ chains, filter }) {
  return html`${chains.slice(0, MOST_NAMED).map((chain, place) => html`${place > 0 ? ', ' : ''}<a
    key=${chainAddress(chain)} href=${chainAddress(chain)}><${Ends} from=${chain.from} to=${chain.to}
    most=${40} /></a>`)}${chains.length > MOST_NAMED && html` and <a href=${address('chains', null,
    { filter })}>${count(chains.length - MOST_NAMED)} more</a>`}`;
}

/**
 * Names the chains of a topic or node.
 * @param {{domain: number, topic?: string, node?: string}} props
 */
export function InChains(props) {
  const { data } = useChains();
  const found = chainsThrough(data?.chains ?? [], props);
  if (!found.length) return null;
  return html`<p>Part of ${found.length === 1 ? 'the chain' : 'the chains'}${' '}
    <${ChainLinks} chains=${found} filter=${props.topic ?? props.node ?? ''} /></p>`;
}

/** Requests all chains, for views that name them. */
export function useChains() {
  return usePoll('chains', RARELY_MS);
}
