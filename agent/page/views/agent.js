// The agent itself: its source, its abilities, the use of limits, and its drops.

import { bytes, count, duration, percent, several } from '../format.js';
import { address } from '../router.js';
import { state, stream, useLive, usePoll } from '../store.js';
import { AskButton, Failed, html, Mark, Name } from '../ui.js';

const SOURCES = /** @type {Record<string, string>} */ ({
  host: 'the sockets of this host', wire: 'network interfaces', replay: 'a capture file',
});

/** @param {{title: string, rows: [any, any][], id?: string}} props */
function Facts({ title, rows, id }) {
  return html`<section aria-label=${title} id=${id}><h2>${title}</h2><table class="short" aria-label=${title}><tbody>
    ${rows.map(([name, value]) => html`<tr key=${name}><th scope="row">${name}</th>
      <td>${value}</td></tr>`)}</tbody></table></section>`;
}

export function Agent() {
  useLive();
  const { data, problem } = usePoll('health', 2000);
  const open = state.open ?? {};
  const drops = data ? /** @type {[string, number|null][]} */ ([
    ['Packets the kernel dropped before the agent', data.dropped_packets],
    ['Records that did not fit the ring', data.dropped_records],
    ['Datagrams that did not fit the ring', data.dropped_datagrams],
    ['Datagrams skipped because too many programs ran at once', data.contended_datagrams],
    ['Topics not measured because limits.topics is reached', data.topics_rejected],
    ['Active writers whose announcement was missed', data.unknown_writers],
    ...(data.zenoh ? [['Gaps in connections of Zenoh', data.zenoh.gaps]] : []),
    ...(data.zenoh?.unseen ?? []).map((/** @type {any} */ each) => [
      `Connections of Zenoh ${each.text}, ${each.reason === 'shared_memory'
        ? 'whose payloads are' : 'which are'} not read`, each.connections]),
  ]) : [];
  return html`<h1 tabindex="-1">Agent</h1>
    <${Failed} problem=${problem} what="No facts about the agent" />
    ${state.agent && html`<p>${state.agent.ready
      ? html`<${Mark} severity="good" /> The agent sees the robot.`
      : html`<${Mark} severity="error" /> The agent is not ready: <${Name}
        text=${state.agent.reason ?? ''} />`}</p>`}
    <p><a href=${address('doctor')}>Doctor</a>: kernel, buffers, interfaces and processes of this host</p>
    ${state.ended && html`<p><${Mark} severity="warning" /> <${Name} text=${state.ended} /></p>`}
    <${Facts} title="This agent" rows=${[
      ['Host', html`<${Name} text=${open.host ?? data?.host ?? 'unknown'} />`],
      ['Version', open.version ?? '–'],
      ['Looks at', html`${SOURCES[open.source] ?? open.source ?? '–'} ${data?.source_reason
        ? html`<span class="dim"><${Name} text=${data.source_reason} /></span>` : ''}`],
      ...(stream.at == null ? [['Rights at this address', html`${open.access ?? '–'} ${open.access !== 'all'
        && html`<${AskButton} />`}`]] : []),
      ['Running for', duration(data?.uptime_seconds)],
      ['Process', data?.process_id ?? '–'],
      ['Capabilities', html`<${Name} text=${data ? data.capabilities.join(', ') || 'none' : '–'} />`],
      ['Watches', html`${count(data?.watches)} <a href=${address('topics', null,
        { only: 'measured' })}>measured topics</a>`],
      ...(stream.at == null ? [['Stream', stream.status]] : []),
      ...(data?.zenoh ? [['Zenoh', `${several(data.zenoh.connections, 'connection')}, ${
        several(data.zenoh.routers, 'router')}`]] : []),
    ]} />
    ${data && html`
    <section aria-labelledby="abilities"><h2 id="abilities">Abilities</h2><table class="short"
      aria-labelledby="abilities"><tbody>${data.abilities.map((/** @type {any} */ each) => html`
      <tr key=${each.ability}><th scope="row"><${Mark} severity=${each.able ? 'good' : 'note'} /> ${
        each.ability.replaceAll('_', ' ')}</th><td>${each.able ? 'yes' : each.reason
        ? html`no: <${Name} text=${each.reason} />` : 'no'}</td></tr>`)}</tbody></table></section>
    <${Facts} id="drops" title="Not counted or dropped" rows=${drops.map(([name, value]) => [name,
      html`${value ? html`<${Mark} severity="warning" /> ` : ''}${count(value)}`])} />
    <section aria-labelledby="limits"><h2 id="limits">Limits in use</h2><div class="scroll"
      tabindex="0" role="group" aria-labelledby="limits"><table><thead><tr><th scope="col">Limit</th>
      <th scope="col" class="number">Used</th><th scope="col" class="number">Of</th>
      <th scope="col" class="number">Part</th><th scope="col" class="number">Times reached</th></tr></thead>
      <tbody>${[...data.limits].sort((one, other) => part(other) - part(one)).map(
        (/** @type {any} */ each) => html`<tr key=${each.limit}><th scope="row">${each.limit}</th>
        <td class="number">${amount(each, each.used)}</td>
        <td class="number">${amount(each, each.cap)}</td>
        <td class="number">${percent(part(each))}</td>
        <td class="number">${each.reached > 0 ? html`<${Mark} severity="warning" /> ` : ''}${count(
          each.reached)}</td></tr>`)}</tbody></table></div></section>
    ${data.interfaces.length > 0 && html`<section aria-labelledby="interfaces">
      <h2 id="interfaces">Interfaces</h2><table aria-labelledby="interfaces"><thead><tr>
      <th scope="col">Interface</th><th scope="col" class="number">Packets</th>
      <th scope="col" class="number">Dropped</th></tr></thead><tbody>${data.interfaces.map(
      (/** @type {any} */ each) => html`<tr key=${each.interface}><th scope="row"><${Name}
        text=${each.interface} /></th><td class="number">${count(each.packets)}</td>
        <td class="number">${count(each.dropped_packets)}</td></tr>`)}</tbody></table></section>`}`}`;
}

/** @param {{used: number, cap: number}} limit */
function part(limit) {
  return limit.cap > 0 ? limit.used / limit.cap : 0;
}

/** @param {{limit: string}} limit @param {number} value */
function amount(limit, value) {
  return limit.limit.includes('bytes') ? bytes(value) : count(value);
}
