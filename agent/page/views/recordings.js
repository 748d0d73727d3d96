// Recordings of the agent, and snapshots of the last seconds in its memory.

import { useRef, useState } from '../vendor/hooks.mjs';
import { json, post, Refusal, remove, request } from '../api.js';
import { bytes, count, date, several } from '../format.js';
import { address } from '../router.js';
import { state, useLive, usePoll } from '../store.js';
import { Act, AskButton, download, Failed, html, Mark, Name } from '../ui.js';

const EVERY_MS = 2000;
/** Seconds before and after an incident that its link shows. */
const AROUND = 60;

export function Recordings() {
  useLive();
  const may = state.may('all');
  const recordings = usePoll(may ? 'recordings' : null, EVERY_MS);
  const snapshots = usePoll(may ? 'snapshots' : null, EVERY_MS);
  if (!may) {
    return html`<h1 tabindex="-1">Recordings</h1>
      <p>Recordings contain what the robot sees. They need a token with the right <strong>all</strong>:
      run <code>rp page</code> on the robot. <${AskButton} /></p>`;
  }
  const { data } = recordings;
  const again = () => recordings.refresh();
  return html`<h1 tabindex="-1">Recordings</h1>
    <${Failed} problem=${recordings.problem} what="No recordings" />
    ${data && !data.directory && html`<p><${Mark} severity="note" /> The agent records nothing:${' '}
      <code>recordings.directory</code> is not set in its configuration.</p>`}
    ${data?.directory && html`<${Start} again=${again} />`}
    ${data && (data.recordings.length
      ? data.recordings.map((/** @type {any} */ each) => html`<${Recording} key=${each.name}
        recording=${each} again=${again} />`)
      : data.directory && html`<p class="empty">No recording yet.</p>`)}
    ${data?.kept?.length > 0 && html`<section aria-labelledby="kept"><h2 id="kept">Earlier bags</h2>
      <p class="dim">Bags of earlier runs of the agent, and snapshots, in <${Name}
        text=${data.directory} />. <code>rp run --replay BAG --watch '/**' --api 127.0.0.1:17411 --api-loopback all
        --metrics off --foxglove off</code> plays one in this page, at port 17411.</p>
      <div class="scroll tall" tabindex="0" role="group" aria-labelledby="kept"><table>
      <thead><tr><th scope="col">Bag</th><th scope="col">Last change</th>
        <th scope="col" class="number">Size</th><th scope="col">Trigger</th>
        <th scope="col">Files</th></tr></thead>
      <tbody>${data.kept.map((/** @type {any} */ each) => html`<tr key=${each.name}>
        <th scope="row"><${Name} text=${each.name} />${each.is_complete ? '' : html`
          <span class="badge warning"><${Mark} severity="warning" /> cut off</span> <span class="dim"><code>rp bag
          reindex</code> writes its metadata</span>`}</th>
        <td>${date(each.modified_timestamp_seconds)}</td>
        <td class="number">${bytes(each.file_bytes)}</td>
        <td>${each.trigger ? html`<${Incident} trigger=${each.trigger} />` : 'none'}</td>
        <td><${Files} path=${`recordings/${encodeURIComponent(each.name)}`} name=${each.name} /></td>
        </tr>`)}</tbody></table></div></section>`}
    <section aria-labelledby="snapshots"><h2 id="snapshots">Snapshots</h2>
    <p class="dim">The agent keeps the last seconds of these topics in memory. It writes them as a bag
      on request, and with the seconds that follow on an event.</p>
    <${Failed} problem=${snapshots.problem} what="No snapshots" />
    ${snapshots.data && (snapshots.data.snapshots.length
      ? html`<div class="scroll" tabindex="0" role="group" aria-labelledby="snapshots"><table>
        <thead><tr><th scope="col">Snapshot</th><th scope="col">Topics</th>
        <th scope="col">Events</th><th scope="col" class="number">Seconds</th><th scope="col" class="number">In memory</th>
        <th scope="col" class="number">Written</th><th scope="col">Write</th></tr></thead>
        <tbody>${snapshots.data.snapshots.map((/** @type {any} */ each) => html`<tr key=${each.name}>
          <th scope="row"><${Name} text=${each.name} /></th>
          <td><${Name} text=${each.topics.join(', ')} /></td>
          <td>${each.trigger.length ? each.trigger.join(', ') : 'none'}</td>
          <td class="number">${count(each.seconds)}${each.seconds_after > 0
            ? ` + ${count(each.seconds_after)}` : ''}</td>
          <td class="number">${several(each.messages, 'message')}, ${bytes(each.bytes)} of ${bytes(
            each.max_bytes)}</td>
          <td class="number">${count(each.written)}${each.failed > 0
            ? `, ${count(each.failed)} failed` : ''}</td>
          <td><${Write} name=${each.name} again=${snapshots.refresh} /></td></tr>`)}
        </tbody></table></div>`
      : html`<p class="empty">The configuration names no snapshot (<code>snapshots</code>).</p>`)}
    </section>`;
}

/** Names what triggered a bag, and links to that time. @param {{trigger: any}} props */
function Incident({ trigger }) {
  const at = Date.parse(trigger.time) / 1000;
  const words = html`${trigger.trigger}, ${date(at)}`;
  if (!state.open?.keeps_history) return words;
  const end = Math.min(Math.ceil(at) + AROUND, Math.floor(state.time));
  const time = { at: end, span: end - Math.floor(at) + AROUND };
  return html`<a href=${trigger.topic == null ? address('', null, time)
    : address('topics', trigger.topic, { ...time, domain: trigger.domain_id })}
    >${words}</a>: the robot as it was`;
}

/** @param {{name: string, again: () => void}} props */
function Write({ name, again }) {
  const [written, setWritten] = useState('');
  return html`<${Act} label="Write now: snapshot ${name}" action=${async () => {
    const answer = await post(`snapshots/${encodeURIComponent(name)}`);
    setWritten(`${several(answer.messages, 'message')} in ${answer.directory}`);
    again();
  }}>Write now</${Act}> <span role="status"><${Name} text=${written} /></span>`;
}

const MOST_DOMAIN = 232;

/** Returns the domains of known participants, in their order. */
export function domainsNow() {
  const domains = new Set([...state.participants.values()].map((each) => each.domain));
  return [...domains].sort((one, other) => one - other);
}

/**
 * Returns the domain to record: the chosen one, else the only one that is known.
 * @param {string|undefined} chosen
 * @param {number[]} domains that are known
 * @throws {Refusal} without a domain
 */
export function domainOf(chosen, domains) {
  if (chosen == null && domains.length === 1) return domains[0];
  const domain = Number(chosen);
  if (/^\d+$/.test(chosen?.trim() ?? '') && domain <= MOST_DOMAIN) return domain;
  throw new Refusal(0, `enter the domain, a number from 0 to ${MOST_DOMAIN}`);
}

/** @param {{again: () => void}} props */
function Start({ again }) {
  const name = useRef(/** @type {HTMLInputElement|null} */ (null));
  const topics = useRef(/** @type {HTMLInputElement|null} */ (null));
  const domain = useRef(/** @type {HTMLInputElement|HTMLSelectElement|null} */ (null));
  const domains = domainsNow();
  const start = async () => {
    const chosen = (topics.current?.value ?? '').split(/[\s,]+/).filter(Boolean);
    const own = name.current?.value.trim();
    await post('recordings', {
      ...(own ? { name: own } : {}),
      domain_id: domainOf(domain.current?.value, domains),
      topics: chosen.length ? { topics: chosen } : { all_topics: true },
    });
    if (name.current) name.current.value = '';
    again();
  };
  return html`<section aria-labelledby="start"><h2 id="start">New recording</h2>
    <form class="controls" onSubmit=${(/** @type {Event} */ event) => event.preventDefault()}>
    <label>Topics <input ref=${topics} placeholder="all" spellcheck=${false} autocomplete="off"
      list="topic-names" /></label>
    <datalist id="topic-names">${[...state.topics.values()].filter((topic) => !topic.hidden)
      .slice(0, 500).map((topic) => html`<option key=${topic.id} value=${topic.name} />`)}</datalist>
    <label>Name <input ref=${name} placeholder="date and time" spellcheck=${false}
      autocomplete="off" /></label>
    ${domains.length > 1 && html`<label>Domain <select ref=${domain}>${domains.map((each) => html`
      <option key=${each}>${each}</option>`)}</select></label>`}
    ${!domains.length && html`<label>Domain <input ref=${domain} type="number" min="0" max=${MOST_DOMAIN}
      required placeholder="none is known" /></label>`}
    <${Act} action=${start}>Start</${Act}></form></section>`;
}

/** @param {{recording: any, again: () => void}} props */
function Recording({ recording, again }) {
  const { name, report } = recording;
  const path = `recordings/${encodeURIComponent(name)}`;
  const running = recording.state !== 'ended';
  const act = (/** @type {string} */ rest) => async () => {
    await post(`${path}/${rest}`);
    again();
  };
  return html`<section class="card" aria-label="Recording ${name}">
    <h2><${Name} text=${name} /> <span class="badge ${running ? 'good' : 'note'}">${recording.state}</span></h2>
    <p>${date(recording.began_timestamp_seconds)}, domain ${recording.domain_id}: ${several(report.messages, 'message')}, ${bytes(
      recording.file_bytes)} in ${several(recording.files, 'file')}${report.missing > 0
      ? html`; <${Mark} severity="warning" /> ${count(report.missing)} missing` : '; none missing'}
      <br /><span class="dim"><${Name} text=${recording.directory} /></span></p>
    ${recording.error && html`<p><${Mark} severity="error" /> <${Name} text=${recording.error} /></p>`}
    ${report.limit_reached && html`<p><${Mark} severity="warning" /> <${Name}
      text=${report.limit_reached} /></p>`}
    <p>${running && html`
      ${recording.state === 'paused'
        ? html`<${Act} action=${act('resume')} label="Continue ${name}">Continue</${Act}> `
        : html`<${Act} action=${act('pause')} label="Pause ${name}">Pause</${Act}> `}
      <${Act} action=${act('split')} label="Split: begin the next file of ${name}">Split</${Act}>${' '}
      <${Act} label="Stop ${name}" action=${async () => {
        await remove(path);
        again();
      }}>Stop</${Act}> `}</p>
    <${Files} path=${path} name=${name} /></section>`;
}

/** @param {{path: string, name: string}} props */
function Files({ path, name }) {
  const [files, take] = useState(/** @type {any[]|null} */ (null));
  const fetchFile = (/** @type {string} */ file) => async () => {
    const response = await request(`${path}/files/${encodeURIComponent(file)}`);
    download(file, await response.blob());
  };
  if (!files) {
    return html`<${Act} label="Download ${name} as an archive" action=${async () => {
      download(`${name}.tar`, await (await request(`${path}/archive`)).blob());
    }}>Download</${Act}> <${Act} label="Files of ${name}" action=${async () => {
      take((await json(`${path}/files`)).files);
    }}>Files</${Act}>`;
  }
  return html`<ul class="plain">${files.map((/** @type {any} */ each) => html`<li key=${each.file}><${Act}
    action=${fetchFile(each.file)} label="Download ${each.file}">Download</${Act}> <${Name}
    text=${each.file} /> <span class="dim">${bytes(each.bytes)}</span></li>`)}</ul>`;
}
