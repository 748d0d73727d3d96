// Dialogs over every view: search, keys, token. The browser keeps the focus inside them.

import { useLayoutEffect, useRef, useState } from './vendor/hooks.mjs';
import { keepToken, token } from './api.js';
import { several } from './format.js';
import { address, nodeAddress, topicAddress } from './router.js';
import { state, stream, useKept, usePoll } from './store.js';
import { html, Mark, matches, Name } from './ui.js';
import { placeOf } from './views/overview.js';

/** @param {{title: string, close: () => void, children: any}} props */
function Dialog({ title, close, children }) {
  const own = useRef(/** @type {HTMLDialogElement|null} */ (null));
  // Before the next key event, so that fast typing of `/imu` loses no letter.
  useLayoutEffect(() => {
    const before = /** @type {HTMLElement|null} */ (document.activeElement);
    own.current?.showModal();
    return () => before?.focus?.();
  }, []);
  const outside = (/** @type {MouseEvent} */ event) => {
    if (event.target === own.current) close();
  };
  // Otherwise a search field consumes the first Escape.
  const leave = (/** @type {KeyboardEvent} */ event) => {
    if (event.key !== 'Escape') return;
    event.preventDefault();
    close();
  };
  return html`<dialog ref=${own} onClose=${close} onClick=${outside}
    onKeyDown=${leave} aria-label=${title}>
    <div class="dialog"><div class="title"><h2>${title}</h2>
      <button type="button" onClick=${close} aria-label="Close">✕</button></div>
      ${children}</div></dialog>`;
}

const MOST_FOUND = 60;

/** Searches topics, nodes, services and findings by name and type. @param {any} props */
export function Search({ close }) {
  const [words, look] = useState('');
  const field = useRef(/** @type {HTMLInputElement|null} */ (null));
  const services = usePoll('services', 0);
  const found = words.trim() ? search(words.trim(), services.data?.services ?? []) : [];
  const walk = (/** @type {KeyboardEvent} */ event) => {
    const by = { ArrowDown: 1, ArrowUp: -1 }[event.key];
    if (!by) return;
    const dialog = /** @type {HTMLElement} */ (event.currentTarget);
    const links = [...dialog.querySelectorAll('a')];
    const at = links.indexOf(/** @type {any} */ (document.activeElement));
    event.preventDefault();
    if (at + by < 0) field.current?.focus();
    else links[Math.min(links.length - 1, at + by)]?.focus();
  };
  const enter = (/** @type {Event} */ event) => {
    event.preventDefault();
    if (!found.length) return;
    location.hash = found[0].href;
    close();
  };
  return html`<${Dialog} title="Search" close=${close}><div onKeyDown=${walk}>
    <form onSubmit=${enter}><label class="filter">Words of a name or type
      <input type="search" ref=${field} autofocus=${true} value=${words} autocomplete="off" spellcheck=${false}
        onInput=${(/** @type {any} */ event) => look(event.target.value)} /></label></form>
    <p class="dim" role="status">${words.trim()
      ? several(found.length, 'result') + (found.length === MOST_FOUND ? ' shown; more exist' : '')
      : 'Topics, nodes, services and findings.'}</p>
    <ul class="results">${found.map((each) => html`<li key=${each.kind + each.href + each.name}>
      <a href=${each.href} onClick=${close}><span class="kind">${each.kind}</span>${' '}
      <${Name} text=${each.name} /> <span class="dim"><${Name} text=${each.more} /></span></a>
      </li>`)}</ul></div></${Dialog}>`;
}

/** @param {string} words @param {any[]} services */
function search(words, services) {
  const found = [];
  const domain = (/** @type {{domain: number}} */ thing) =>
    (state.hasDomains() ? `domain ${thing.domain}` : '');
  for (const finding of state.findings) {
    const name = state.withScripts(finding.text);
    if (matches(words, name)) {
      const [href] = placeOf(finding) ?? [address('')];
      found.push({ kind: 'finding', name, more: '', href });
    }
  }
  for (const node of state.nodes.values()) {
    if (matches(words, node.name)) {
      found.push({ kind: 'node', name: node.name, more: domain(node), href: nodeAddress(node) });
    }
  }
  for (const topic of state.topics.values()) {
    const types = topic.types.join(', ');
    if (matches(words, `${topic.name} ${types}`)) {
      const more = [types, domain(topic)].filter(Boolean).join(', ');
      found.push({ kind: 'topic', name: topic.name, more, href: topicAddress(topic) });
    }
  }
  for (const service of services) {
    if (!matches(words, `${service.name} ${service.types.join(' ')}`)) continue;
    const server = service.servers.find((/** @type {any} */ party) => party.node)?.node;
    const more = [service.types.join(', '), server ?? 'no server'].join(', ');
    const href = server
      ? address('nodes', server, { domain: service.domain_id })
      : address('graph', null, { services: true });
    found.push({ kind: 'service', name: service.name, more, href });
  }
  return found.sort((one, other) => rank(one, words) - rank(other, words)).slice(0, MOST_FOUND);
}

/**
 * Returns the rank of a result: the exact name, names whose last part begins with the words, names
 * that contain them, types that do, and sentences.
 * @param {{kind: string, name: string}} result
 * @param {string} words
 */
export function rank({ kind, name }, words) {
  if (kind === 'finding') return 4;
  const [own, wanted] = [name.toLowerCase(), words.toLowerCase()];
  if (own === wanted || own === `/${wanted}`) return 0;
  if (own.slice(own.lastIndexOf('/') + 1).startsWith(wanted)) return 1;
  return own.includes(wanted) ? 2 : 3;
}

/** @param {{views: [string, string, string][], close: () => void}} props */
export function Keys({ views, close }) {
  const [on, turn] = useKept('keys', true);
  const rows = [
    ['/', 'Search everywhere'], ['?', 'This list'], ['p', 'Pause and continue the stream'],
    ...views.map(([, title, key]) => [`g ${key}`, title]),
    ['↑ ↓', 'In a table: the row above, the row below'],
    ['← →', 'In a chart: move the cursor of all charts; PageUp and PageDown by a minute'],
    ['← → ↑ ↓', 'In the graph: move along edges, or within a column'],
    ['+ − 0', 'In the graph: zoom in, zoom out, fit'],
    ['Enter', 'In the graph: show details, open or close a box'],
  ];
  return html`<${Dialog} title="Keys" close=${close}>
    <table aria-label="Keys"><tbody>${rows.map(([key, text]) => html`<tr key=${key + text}>
      <th scope="row"><kbd>${key}</kbd></th><td>${text}</td></tr>`)}</tbody></table>
    <label><input type="checkbox" checked=${on}
      onChange=${(/** @type {any} */ event) => turn(event.target.checked)} /> Single-key shortcuts
      (<kbd>/</kbd>, <kbd>?</kbd>, <kbd>p</kbd>, <kbd>g</kbd>)</label></${Dialog}>`;
}

/** Asks for a token, which stays in this tab. @param {{close: () => void}} props */
export function Token({ close }) {
  const field = useRef(/** @type {HTMLInputElement|null} */ (null));
  const access = state.open?.access;
  const submit = (/** @type {Event} */ event) => {
    event.preventDefault();
    const value = field.current?.value.trim() ?? '';
    if (!value) return;
    keepToken(value);
    stream.reopen();
    close();
  };
  const forget = () => {
    keepToken(null);
    stream.reopen();
    close();
  };
  return html`<${Dialog} title="Token" close=${close}>
    <p>${access
      ? html`This address grants the right <strong>${access}</strong>. Live messages, recordings and
        snapshots need <strong>all</strong>.`
      : 'This address requires a token.'}</p>
    <p>Run <code>rp page</code> on the robot and open the address it prints, or paste the token here.
      It stays in this tab and is sent in a header only.</p>
    ${token() && access !== 'all' && html`<p><${Mark} severity="warning" /> The token of this tab is no
      longer valid: the agent was restarted, or newer tokens replaced it. <code>rp page</code> prints
      another one.</p>`}
    ${stream.problem && html`<p><${Mark} severity="warning" /> ${stream.problem.message}</p>`}
    <form onSubmit=${submit}>
      <label class="filter">Token <input type="password" ref=${field} autofocus=${true} autocomplete="off"
        spellcheck=${false} required /></label>
      <button type="submit">Use this token</button>
      ${token() && html` <button type="button" onClick=${forget}>Forget the token</button>`}
    </form></${Dialog}>`;
}
