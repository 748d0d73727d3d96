// The time that the page shows: the present, or a part of the last days. It is part of every address.

import { useEffect, useState } from './vendor/hooks.mjs';
import { json, post, request } from './api.js';
import { date, duration, percent } from './format.js';
import { address } from './router.js';
import { Lines } from './state.js';
import { state, stream, useLive, useRequest, useRoute } from './store.js';
import { html } from './ui.js';

/** Times to choose from, in seconds. */
const SPANS = /** @type {[number, string][]} */ ([
  [60, 'minute'], [600, 'ten minutes'], [3600, 'hour'], [21600, '6 hours'], [86400, '24 hours'], [604800, '7 days'],
]);
const DEFAULT_SPAN = 600;
const LONGEST_SPAN = 31 * 86400;
/** Shortest time between two requests for charts whose end is the present. */
const AGAIN_MS = 10000;
/** A chart is requested again after this part of its time: one pixel of a small screen. */
const AGAIN_PARTS = 360;

/** @typedef {{span: number, at: number|null}} Shown seconds, and the Unix time of their end */

/**
 * Returns the time in an address.
 * @param {Record<string, string>} query
 * @returns {Shown}
 */
export function timeOf(query) {
  const span = Math.round(Number(query.span));
  const at = Math.round(Number(query.at));
  return {
    span: span >= 1 && span <= LONGEST_SPAN ? span : DEFAULT_SPAN,
    at: at > 0 && at < 2 ** 32 ? at : null,
  };
}

/** Returns the time of the present address. */
export function useTime() {
  return timeOf(useRoute()?.query ?? {});
}

/** Changes the time of the address. @param {Partial<Shown>} time */
export function showTime(time) {
  const [path, query = ''] = location.hash.slice(1).split('?');
  const parameters = new URLSearchParams(query);
  for (const [key, value] of Object.entries(time)) {
    if (value == null || (key === 'span' && value === DEFAULT_SPAN)) parameters.delete(key);
    else parameters.set(key, String(Math.round(Number(value))));
  }
  const rest = parameters.toString();
  location.hash = `#${path}${rest ? `?${rest}` : ''}`;
}

/** Shows the part of a chart that was selected. @param {number} from @param {number} to */
export function zoom(from, to) {
  showTime({ at: Math.ceil(to), span: Math.max(5, Math.ceil(to) - Math.floor(from)) });
}

/** Returns a time as words for a heading. @param {Shown} shown */
export function inWords({ span, at }) {
  const known = SPANS.find(([seconds]) => seconds === span)?.[1] ?? duration(span);
  return at == null ? `The last ${known}` : `${date(at - span)} to ${date(at)}`;
}

/**
 * Returns the milliseconds between two requests for a part of the history: more for a long one, which
 * takes the agent more reading. Returns 0 if the part ends in the past, which does not change.
 * @param {Shown} shown
 */
export function againAfter({ span, at }) {
  return at == null ? Math.max(AGAIN_MS, span * 1000 / AGAIN_PARTS) : 0;
}

/**
 * Requests a part of the history, again while its end is the present.
 * @param {string|null} path null sends no request
 * @param {Shown} shown
 * @param {(path: string, options: RequestInit) => Promise<any>} [ask]
 */
export function useHistory(path, { span, at }, ask = json) {
  return useRequest(path, `${span} ${at}`, againAfter({ span, at }), (signal) => {
    const to = at ?? Math.floor(state.time);
    return ask(`${path}${path?.includes('?') ? '&' : '?'}from=${to - span}&to=${to}`, { signal });
  }, (isWanted) => mayRead(at, isWanted));
}

/**
 * Whether a part of the history may be requested. If it ends in the present, its time is that of the stream.
 * @param {number|null} at @param {boolean} isWanted
 */
export function mayRead(at, isWanted) {
  return at != null || stream.status === 'live' || (isWanted && stream.status === 'paused');
}

/** Requests lines of JSON. @param {string} path @param {RequestInit} options */
async function lines(path, options) {
  const response = await request(path, options);
  return { list: new Lines().take(await response.text()),
    isTruncated: response.headers.get('ros2probe-truncated') === 'true' };
}

/** Returns the events of a time, as `useEventHistory` does. @param {Shown} shown */
export function useEvents(shown) {
  return useEventHistory(shown).events;
}

/**
 * Returns the events of a time, whether the oldest are missing, and whether the history has answered.
 * Without a history on disk, these are the ones that the page knows.
 * @param {Shown} shown
 * @returns {{events: import('./state.js').Event[], isTruncated: boolean, isRead: boolean,
 *   problem: import('./api.js').Refusal|null}}
 */
export function useEventHistory(shown) {
  const isKept = state.open ? state.open.keeps_history : shown.at != null;
  const { data, problem } = useHistory(isKept ? 'history/events' : null, shown, lines);
  const to = shown.at ?? state.time;
  const all = new Map([...(data?.list ?? []), ...(shown.at == null ? state.events : [])]
    .map((event) => [event.id, event]));
  const events = [...all.values()].filter((event) => {
    const time = Date.parse(event.time) / 1000;
    return time > to - shown.span && time <= to + 1;
  });
  return { events, isTruncated: Boolean(data?.isTruncated), isRead: data != null, problem };
}

/**
 * Returns the events that matter for a topic: its own ones, and warnings and errors of no topic.
 * @param {import('./state.js').Event[]} events
 * @param {string} topic
 */
export function eventsOf(events, topic) {
  return events.filter(({ attributes, severity }) => attributes.topic === topic
    || (attributes.topic == null && severity !== 'INFO'));
}

/** Returns the marks of events in a chart. @param {import('./state.js').Event[]} events */
export function marksOf(events) {
  return events.map(({ time, severity }) => ({ time: Date.parse(time) / 1000, severity }));
}

/** Unix time as the value of an input, in the time zone of the browser. @param {number} time */
function forInput(time) {
  const moment = new Date(time * 1000);
  return new Date(moment.getTime() - moment.getTimezoneOffset() * 60000).toISOString().slice(0, 19);
}

export function TimeBar() {
  useLive();
  const shown = useTime();
  const { span, at } = shown;
  useEffect(() => stream.go(at), [at]);
  // A replay has no history: the address of a moment in the past came from another agent.
  if (state.open?.replay && at == null) return html`<${Replay} />`;
  if (!state.open?.keeps_history && at == null) return null;
  const known = SPANS.some(([seconds]) => seconds === span);
  const end = at ?? state.time;
  return html`<section class="timebar" aria-label="Time">
    <label>Show the last <select value=${span}
      onChange=${(/** @type {any} */ event) => showTime({ span: Number(event.target.value) })}>
      ${!known && html`<option value=${span}>${duration(span)}</option>`}
      ${SPANS.map(([seconds, words]) => html`<option value=${seconds}>${words}</option>`)}</select></label>
    <label>until <input type="datetime-local" step="1" value=${at == null ? '' : forInput(at)}
      onChange=${(/** @type {any} */ event) => {
        const time = Date.parse(event.target.value) / 1000;
        showTime({ at: Number.isFinite(time) ? time : null });
      }} /></label>
    <button type="button" onClick=${() => showTime({ at: end - span })}>Earlier</button>
    ${at != null && html`<button type="button" onClick=${() => showTime({
      at: at + span >= Date.now() / 1000 ? null : at + span })}>Later</button>
      <button type="button" onClick=${() => showTime({ at: null })}>Now</button>`}</section>`;
}

/** Speeds of a replay; 0 is without waiting. */
const SPEEDS = [0.1, 0.5, 1, 2, 5, 10, 60, 0];

/** @param {number} speed */
const speedInWords = (speed) => (speed === 0 ? 'without waiting' : `${speed} times`);

/** The latest time that a replay has reached, by the time of its begin. @type {Map<number, number>} */
const reached = new Map();

/**
 * Returns the time of the last event at least a second before another time; null if there is none.
 * @param {import('./state.js').Event[]} events
 * @param {number} time
 */
export function eventBefore(events, time) {
  const times = events.filter(({ name }) => !/^ros2\.(participant|endpoint)\./.test(name))
    .map((event) => Date.parse(event.time) / 1000).filter((each) => each <= time - 1);
  return times.length ? Math.max(...times) : null;
}

/** The time of a replay, to which the figures of every view refer, and its pace. */
function Replay() {
  const [problem, take] = useState('');
  const { begin, incident } = state.open?.replay ?? {};
  if (begin == null || !state.replay) return null;
  const { part, finished, paused, speed } = state.replay;
  const end = Math.max(reached.get(begin) ?? begin, state.time);
  reached.set(begin, end);
  const elapsed = Math.max(0, state.time - begin);
  const before = eventBefore(state.events, state.time);
  /** @param {Record<string, any>} change */
  const go = async (change) => {
    try {
      const now = await post('replay', change);
      state.replay = { part, finished: now.is_finished, paused: now.is_paused, speed: now.speed };
      take('');
    } catch (error) {
      take(String(error instanceof Error ? error.message : error));
    }
  };
  // Without waiting, it would be at its end again.
  /** @param {number} time @param {boolean} [pauses] */
  const goTo = (time, pauses = speed === 0) => go({ to_timestamp_seconds: Math.max(begin, time),
    ...(pauses ? { is_paused: true } : {}) });
  const speeds = SPEEDS.includes(speed) ? SPEEDS : [speed, ...SPEEDS];
  return html`<section class="timebar" aria-label="Time of the replay">
    ${!finished && html`<button type="button" onClick=${() => go({ is_paused: !paused })}>${
      paused ? 'Play' : 'Pause'}</button>`}
    <button type="button" disabled=${state.time <= begin} onClick=${() => goTo(begin)}>Begin</button>
    <label>Replay <input type="range" min="0" max=${Math.max(1, Math.ceil(end - begin))} step="1"
      value=${Math.round(elapsed)}
      aria-valuetext=${`${duration(elapsed)} after the begin`}
      onChange=${(/** @type {any} */ event) => goTo(begin + Number(event.target.value))} /></label>
    <span>${date(state.time)}, ${duration(elapsed)} after the begin${
      finished ? ', finished' : part == null ? '' : `, ${percent(part)} read`}</span>
    ${incident && html`<button type="button" onClick=${() => goTo(Date.parse(incident.time) / 1000, true)}>
      Incident</button> <span>${incident.trigger}, ${date(Date.parse(incident.time) / 1000)}</span>`}
    <button type="button" disabled=${before == null} onClick=${() => goTo(before ?? begin, true)}>Previous event</button>
    <button type="button" disabled=${state.time <= begin} onClick=${() => goTo(state.time - 60)}>−1 min</button>
    ${!finished && html`<button type="button" onClick=${() => go({ to_next_event: true })}>Next event</button>
    <button type="button" onClick=${() => goTo(state.time + 60)}>+1 min</button>
    <label>Speed <select value=${speed}
      onChange=${(/** @type {any} */ event) => go({ speed: Number(event.target.value) })}>
      ${speeds.map((each) => html`<option value=${each}>${speedInWords(each)}</option>`)}</select></label>`}
    ${problem && html`<span class="problem" role="alert">${problem}</span>`}</section>`;
}

/** What a view without a history shows in place of a moment in the past. @param {{title: string, why: string}} props */
export function PresentOnly({ title, why }) {
  return html`<h1 tabindex="-1">${title}</h1><p>${why} This view has no history. <button type="button"
    onClick=${() => showTime({ at: null })}>Show the present</button> or look at the${' '}
    <a href=${address('')}>overview</a> of that time.</p>`;
}
