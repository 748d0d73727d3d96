// The page: navigation, status, dialogs, and the view of the address.

import { render } from './vendor/preact.mjs';
import { useEffect, useRef, useState } from './vendor/hooks.mjs';
import { keepToken, token } from './api.js';
import { count, date, visible } from './format.js';
import { address, parse, tokenOf } from './router.js';
import { Keys, Search, Token } from './dialogs.js';
import { kept, keep, state, stream, useLive, useRoute, useScripts } from './store.js';
import { AskButton, html, Mark } from './ui.js';
import { PresentOnly, TimeBar } from './timebar.js';
import { Agent } from './views/agent.js';
import { Doctor } from './views/doctor.js';
import { ChainView, Chains } from './views/chains.js';
import { Events } from './views/events.js';
import { Fleet } from './views/fleet.js';
import { Graph } from './views/graph.js';
import { NodeView, Nodes } from './views/nodes.js';
import { Overview } from './views/overview.js';
import { Recordings } from './views/recordings.js';
import { Robot } from './views/robot.js';
import { Topic } from './views/topic.js';
import { Topics } from './views/topics.js';

// Before anything else: the token leaves the address and the history.
takeToken();
const theme = kept('theme', 'auto');
applyTheme(theme);

/** @type {[string, string, string][]} view, title, second key of its shortcut */
const VIEWS = [
  ['', 'Overview', 'o'], ['topics', 'Topics', 't'], ['graph', 'Graph', 'g'],
  ['chains', 'Chains', 'c'], ['nodes', 'Nodes', 'n'], ['robot', 'Robot', 'b'], ['events', 'Events', 'e'],
  ['recordings', 'Recordings', 'r'], ['agent', 'Agent', 'a'], ['fleet', 'Fleet', 'f'],
];

/** Returns the views that this agent has. */
function ownViews() {
  return VIEWS.filter(([view]) => view !== 'fleet' || state.open?.has_fleet);
}

/** Views that have no past, and why. */
const PRESENT_ONLY = /** @type {Record<string, [string, string]>} */ ({
  recordings: ['Recordings', 'Bags are those that the robot has at present.'],
  doctor: ['Doctor', 'The doctor examines the host as it is at present.'],
  fleet: ['Fleet', 'The robots are shown as they are at present.'],
});

function takeToken() {
  const given = tokenOf(location.hash);
  if (!given) return;
  keepToken(given);
  history.replaceState(null, '', address(''));
}

/** @param {string} name `auto`, `light` or `dark` */
function applyTheme(name) {
  document.documentElement.dataset.theme = name;
  window.dispatchEvent(new Event('theme'));
}

function App() {
  useLive();
  useScripts();
  const route = useRoute();
  const [dialog, show] = useState(/** @type {string|null} */ (null));
  const main = useRef(/** @type {HTMLElement|null} */ (null));
  useEffect(() => keyboard(show), []);
  useEffect(() => {
    const ask = () => show('token');
    const given = () => {
      if (!tokenOf(location.hash)) return;
      takeToken();
      stream.reopen();
    };
    window.addEventListener('ask-token', ask);
    window.addEventListener('hashchange', given);
    return () => {
      window.removeEventListener('ask-token', ask);
      window.removeEventListener('hashchange', given);
    };
  }, []);
  const refused = stream.status === 'refused';
  useEffect(() => { if (refused) show('token'); }, [refused]);
  // Chains of the same first topic are different places.
  const rest = route?.view === 'chains' && route.name != null ? JSON.stringify(route.query) : '';
  const place = `${route?.view}/${route?.name}${rest}`;
  const first = useRef(true);
  useEffect(() => {
    const [, title] = VIEWS.find(([view]) => view === route?.view) ?? ['', 'Not found'];
    const host = state.open?.host;
    document.title = `${route?.name ? `${visible(route.name)} · ` : ''}${title}`
      + ` · ${host ? visible(host) : 'ros2probe'}`;
  }, [place, state.open]);
  useEffect(() => {
    // A new view starts at its top, and a screen reader at its heading.
    if (!first.current) {
      window.scrollTo(0, 0);
      main.current?.querySelector('h1')?.focus({ preventScroll: true });
    }
    // On a phone, the views are one row that scrolls.
    for (const here of document.querySelectorAll('nav [aria-current]')) {
      here.scrollIntoView({ block: 'nearest', inline: 'nearest' });
    }
    first.current = false;
  }, [place]);
  useEffect(() => reveal(main.current, route?.query.part), [place, route?.query.part]);
  return html`
    <a class="skip" href="#main" onClick=${(/** @type {Event} */ event) => {
      event.preventDefault();
      main.current?.focus();
    }}>Skip to the content</a>
    <${Header} route=${route} show=${show} />
    <${TimeBar} />
    <${Notice} />
    <main id="main" tabindex="-1" ref=${main}>
      ${state.batches > 0 || route?.view === 'token'
        ? html`<${View} key=${place} route=${route} />`
        : html`<h1 tabindex="-1">${refused ? 'The agent requires a token' : 'Connecting …'}</h1>${refused
          && html`<p><${AskButton} /></p>`}`}
    </main>
    <${News} />
    ${dialog === 'search' && html`<${Search} close=${() => show(null)} />`}
    ${dialog === 'keys' && html`<${Keys} views=${ownViews()} close=${() => show(null)} />`}
    ${dialog === 'token' && html`<${Token} close=${() => show(null)} />`}`;
}

/** Time in which the part of a view must arrive, and then the parts above it. */
const [ARRIVES_MS, SETTLES_MS] = [15000, 2500];

/**
 * Scrolls to a part of a view, and again while parts above it arrive, until the user moves. Returns a
 * function that ends this.
 * @param {HTMLElement|null} main
 * @param {string|undefined} id of an element
 */
function reveal(main, id) {
  if (!main || !id) return undefined;
  /** @type {Element|null} */
  let found = null;
  const show = () => {
    const own = document.getElementById(id);
    if (!own || !main.contains(own)) return;
    const place = own.closest('section[aria-labelledby]') ?? own;
    const isSection = place.getAttribute('aria-labelledby') === id;
    const target = isSection ? place : own;
    if (target !== found) {
      found?.removeAttribute('data-revealed');
      target.setAttribute('data-revealed', '');
      own.setAttribute('tabindex', '-1');
      own.focus({ preventScroll: true });
      found = target;
      clearTimeout(timer);
      timer = setTimeout(stop, SETTLES_MS);
    }
    target.scrollIntoView({ block: isSection ? 'start' : 'center' });
  };
  const observer = new MutationObserver(show);
  const stop = () => {
    observer.disconnect();
    clearTimeout(timer);
    for (const name of ['wheel', 'touchmove', 'keydown', 'pointerdown']) removeEventListener(name, stop);
  };
  for (const name of ['wheel', 'touchmove', 'keydown', 'pointerdown']) addEventListener(name, stop);
  let timer = setTimeout(stop, ARRIVES_MS);
  observer.observe(main, { childList: true, subtree: true });
  show();
  return () => {
    stop();
    found?.removeAttribute('data-revealed');
  };
}

/** @param {{route: import('./router.js').Route|null}} props */
function View({ route }) {
  const query = route?.query ?? {};
  const presentOnly = stream.at == null ? null : PRESENT_ONLY[route?.view ?? ''];
  if (presentOnly) return html`<${PresentOnly} title=${presentOnly[0]} why=${presentOnly[1]} />`;
  switch (route?.view) {
    case '': return html`<${Overview} />`;
    case 'topics': return route.name == null
      ? html`<${Topics} query=${query} />`
      : html`<${Topic} name=${route.name} query=${query} />`;
    case 'graph': return html`<${Graph} query=${query} />`;
    case 'chains': return route.name == null
      ? html`<${Chains} query=${query} />`
      : html`<${ChainView} from=${route.name} query=${query} />`;
    case 'nodes': return route.name == null
      ? html`<${Nodes} query=${query} />`
      : html`<${NodeView} name=${route.name} query=${query} />`;
    case 'robot': return html`<${Robot} name=${route.name} query=${query} />`;
    case 'events': return html`<${Events} query=${query} />`;
    case 'recordings': return html`<${Recordings} />`;
    case 'agent': return html`<${Agent} />`;
    case 'doctor': return html`<${Doctor} />`;
    case 'fleet': return html`<${Fleet} name=${route.name} />`;
    default: return html`<h1 tabindex="-1">No such view</h1>
      <p><a href=${address('')}>Overview</a></p>`;
  }
}

const SIGNS = /** @type {Record<string, string>} */ ({ auto: '◐', light: '☀', dark: '☾' });

/** @param {{route: import('./router.js').Route|null, show: (name: string) => void}} props */
function Header({ route, show }) {
  const errors = state.findings.filter((finding) => finding.severity === 'error').length;
  const [own, become] = useState(theme);
  const next = /** @type {Record<string, string>} */ ({ auto: 'light', light: 'dark', dark: 'auto' });
  const turn = () => {
    keep('theme', next[own]);
    become(next[own]);
    applyTheme(next[own]);
  };
  return html`<header>
    <div class="bar">
      <span class="host"><strong>${visible(state.open?.host ?? 'ros2probe')}</strong> <${Status} /></span>
      <span class="tools">
        <button type="button" onClick=${() => show('search')}>Search <kbd>/</kbd></button>
        <${PauseButton} />
        <button type="button" onClick=${turn} aria-label="Theme: ${own}. Change to ${next[own]}."
          >${SIGNS[own]}</button>
        <button type="button" onClick=${() => show('keys')} aria-label="Keys and help">?</button>
      </span>
    </div>
    <nav aria-label="Views"><ul>
      ${ownViews().map(([view, title]) => html`<li key=${view}><a href=${address(view)}
        aria-current=${route?.view === view ? 'page' : undefined}>${title}${
        view === '' && errors > 0
          ? html` <span class="badge error"><${Mark} severity="error" /> ${errors}</span>` : ''}</a></li>`)}
    </ul></nav>
  </header>`;
}

function PauseButton() {
  // The time bar of a replay pauses the replay itself.
  if (stream.at != null || state.open?.replay) return null;
  const paused = stream.status === 'paused';
  return html`<button type="button" aria-pressed=${paused}
    onClick=${() => (paused ? stream.resume() : stream.pause())}>${paused ? 'Paused' : 'Pause'}</button>`;
}

function Status() {
  const words = {
    connecting: ['note', 'connecting'], live: ['good', 'live'], paused: ['note', 'paused'],
    past: ['note', 'past'], asleep: ['note', 'asleep'], lost: ['warning', 'no connection'], refused: ['warning', 'refused'],
  };
  const [severity, word] = words[stream.status];
  return html`<span class="status"><${Mark} severity=${severity} /> ${word}</span>`;
}

/** Explains why the page shows no live figures. */
function Notice() {
  if (stream.status === 'lost') {
    const why = stream.problem?.message ?? 'the connection was lost';
    return html`<p class="notice" role="status"><${Mark} severity="warning" /> No connection: ${why}.
      ${state.batches > 0 ? ' The figures below are the last ones.' : ''} Trying again.</p>`;
  }
  if (stream.status === 'refused' && state.batches > 0) {
    return html`<p class="notice" role="status"><${Mark} severity="warning" /> The agent requires a token:${' '}
      ${stream.problem?.message}.${state.past ? '' : ' The figures below are the last ones.'} <${AskButton} /></p>`;
  }
  if (stream.status === 'paused') {
    return html`<p class="notice" role="status">Paused: the figures below are not updated.${' '}
      <button type="button" onClick=${() => stream.resume()}>Continue</button></p>`;
  }
  if (stream.status === 'live' && token() && state.open?.access !== 'all') {
    return html`<p class="notice" role="status"><${Mark} severity="warning" /> The token of this tab is
      no longer valid: the agent was restarted, or newer tokens replaced it.${' '}
      <button type="button" onClick=${() => window.dispatchEvent(new Event('ask-token'))}>Another
      token</button></p>`;
  }
  if (stream.status === 'past') {
    return html`<p class="notice" role="status">${stream.problem
      ? html`<${Mark} severity="warning" /> The robot’s state at that time is unknown:${' '}
        ${stream.problem.message}. ${stream.isRetrying ? 'Trying again.' : 'Only charts and events may show it.'}`
      : `The robot as it was at ${date(state.time)}.`}</p>`;
  }
  return null;
}

/** The only polite live region: announces findings that appear while the page is open. */
function News() {
  const known = useRef(/** @type {Set<string>|null} */ (null));
  const [text, say] = useState('');
  const ids = state.findings.map((finding) => finding.id).join('\n');
  useEffect(() => {
    // Findings of the past are not news, and those of the present are not new after it.
    if (!state.batches || state.past) return;
    const before = known.current;
    known.current = new Set(state.findings.map((finding) => finding.id));
    if (!before) return;
    const fresh = state.findings.filter((finding) =>
      !before.has(finding.id) && finding.severity !== 'note');
    if (!fresh.length) return;
    const more = fresh.length > 1 ? ` And ${count(fresh.length - 1)} more.` : '';
    say(`New finding: ${visible(state.withScripts(fresh[0].text))}.${more}`);
  }, [ids, state.batches > 0]);
  return html`<div class="reader-only" role="status" aria-live="polite">${text}</div>`;
}

/**
 * Handles single keys: `/`, `?`, `p`, and `g` with a second one. They can be switched off.
 * @param {(dialog: string) => void} show
 */
function keyboard(show) {
  let first = '';
  let timer = 0;
  const press = (/** @type {KeyboardEvent} */ event) => {
    const target = /** @type {HTMLElement} */ (event.target);
    if (event.ctrlKey || event.metaKey || event.altKey || !kept('keys', true)) return;
    if (target.closest('input, textarea, select, dialog')) return;
    const before = first;
    first = '';
    clearTimeout(timer);
    if (before === 'g') {
      const found = ownViews().find(([, , key]) => key === event.key);
      if (found) location.hash = address(found[0]);
    } else if (event.key === '/') {
      event.preventDefault();
      show('search');
    } else if (event.key === '?') {
      show('keys');
    } else if (event.key === 'p') {
      if (stream.status === 'paused') stream.resume();
      else if (stream.at == null) stream.pause();
    } else if (event.key === 'g') {
      first = 'g';
      timer = setTimeout(() => { first = ''; }, 1500);
    }
  };
  document.addEventListener('keydown', press);
  return () => document.removeEventListener('keydown', press);
}

// A fragment that is neither a view nor a token is shown by the view `No such view`.
if (!location.hash && parse('')) history.replaceState(null, '', address(''));
const place = /** @type {HTMLElement} */ (document.getElementById('app'));
place.textContent = '';
render(html`<${App} />`, place);
stream.open();
