// What all views share: the state, its stream, the route, and hooks that follow them.

import { useEffect, useReducer, useRef, useState } from './vendor/hooks.mjs';
import { json, Refusal } from './api.js';
import { pastOf } from './past.js';
import { keepTime, parse } from './router.js';
import { State } from './state.js';
import { Stream } from './stream.js';

/** @type {Set<() => void>} */
const listeners = new Set();
let scheduled = false;

function changed() {
  if (scheduled) return;
  scheduled = true;
  queueMicrotask(() => {
    scheduled = false;
    for (const listener of listeners) listener();
  });
}

export const state = new State();
export const stream = new Stream(state, changed);

/** Renders the component again after each batch. */
export function useLive() {
  const [, draw] = useReducer((/** @type {number} */ count) => count + 1, 0);
  useEffect(() => {
    const listener = () => draw(0);
    listeners.add(listener);
    return () => { listeners.delete(listener); };
  }, []);
  return state;
}

/** Requests the scripts of processes after each change of the graph. */
export function useScripts() {
  const known = stream.status === 'live' ? state.structure : null;
  useEffect(() => {
    if (known == null) return undefined;
    const abort = new AbortController();
    json('processes', { signal: abort.signal }).then(({ processes }) => state.takeProcesses(processes))
      .catch(() => { /* Processes then have the names of their programs. */ });
    return () => abort.abort();
  }, [known]);
}

/** Returns the route of the address, and keeps its time. */
function routeNow() {
  const route = parse(location.hash);
  keepTime(route?.query ?? {});
  return route;
}

/** Returns the route of the address; null if no view has it. */
export function useRoute() {
  const [route, become] = useState(routeNow);
  useEffect(() => {
    const follow = () => become(routeNow());
    window.addEventListener('hashchange', follow);
    return () => window.removeEventListener('hashchange', follow);
  }, []);
  return route;
}

/** Replaces the address without a new entry in the history. @param {string} to */
export function replaceAddress(to) {
  history.replaceState(null, '', to);
  window.dispatchEvent(new HashChangeEvent('hashchange'));
}

/** @typedef {{path: string|null, part: string, data: any, problem: Refusal|null}} Answer */

/**
 * Returns an answer after a failed request: what was known stays, unless it needs another token now.
 * @param {Answer} before
 * @param {string} path
 * @param {string} part
 * @param {Refusal} problem
 * @returns {Answer}
 */
export function afterProblem(before, path, part, problem) {
  const isSame = before.path === path && before.part === part && !problem.needsToken;
  return { path, part, problem, data: isSame ? before.data : null };
}

/** Whether a view may send a request: a paused page shows what it has. @param {boolean} isWanted */
export function mayPoll(isWanted) {
  return isWanted || stream.status !== 'paused';
}

/** Longest time until a request that was not sent, or failed, is due again. */
const RETRY_MS = 10000;

/**
 * Requests something while the tab is visible, and again if it changes with time. The answer stays
 * until the next one of the same path, or until the right to it has ended.
 * @param {string|null} path null sends no request
 * @param {string} part what of the path is requested; after an error, no other part stays
 * @param {number} every milliseconds; 0 sends requests until one is answered
 * @param {(signal: AbortSignal) => Promise<any>} ask
 * @param {(isWanted: boolean) => boolean} may whether requests make sense now; `isWanted` if there is
 *   no answer yet, or if the user asks for one
 * @returns {{data: any, problem: Refusal|null, refresh: () => void}}
 */
export function useRequest(path, part, every, ask, may) {
  const [answer, take] = useState(/** @type {Answer} */ ({ path: null, part: '', data: null, problem: null }));
  const again = useRef(() => {});
  useEffect(() => {
    if (path == null) return undefined;
    const abort = new AbortController();
    let timer = 0;
    let isKnown = false;
    const request = async (isWanted = !isKnown) => {
      clearTimeout(timer);
      let wait = every > 0 ? Math.min(every, RETRY_MS) : RETRY_MS;
      let isAnswered = false;
      if (document.visibilityState !== 'hidden' && may(isWanted)) {
        try {
          take({ path, part, data: await ask(abort.signal), problem: null });
          isKnown = true;
          wait = every;
          isAnswered = true;
        } catch (error) {
          if (abort.signal.aborted) return;
          const problem = error instanceof Refusal ? error : new Refusal(0, String(error));
          isAnswered = ![0, 503].includes(problem.status);
          take((/** @type {Answer} */ before) => afterProblem(before, path, part, problem));
        }
      }
      if ((every > 0 || !isAnswered) && !abort.signal.aborted) timer = setTimeout(request, wait);
    };
    again.current = () => { request(true); };
    request();
    return () => {
      clearTimeout(timer);
      abort.abort();
    };
  }, [path, part, every]);
  const own = answer.path === path && path != null;
  return {
    data: own ? answer.data : null,
    problem: own ? answer.problem : null,
    refresh: () => again.current(),
  };
}

/**
 * Requests an endpoint periodically. For a moment in the past it requests once what the history kept of
 * that time, and nothing if that is not kept.
 * @param {string|null} path null sends no request
 * @param {number} every milliseconds; 0 sends one request
 */
export function usePoll(path, every) {
  const { at } = stream;
  const past = path != null && at != null ? pastOf(path, at) : null;
  const key = at == null ? path : past && `${path} at ${at}`;
  return useRequest(key, '', at == null ? every : 0, async (signal) =>
    (past ? past.part(await json(past.path, { signal })) : json(String(path), { signal })), mayPoll);
}

/**
 * Keeps a value in this browser under a key.
 * @template T
 * @param {string} key
 * @param {T} initial
 * @returns {[T, (value: T) => void]}
 */
export function useKept(key, initial) {
  const [value, become] = useState(() => kept(key, initial));
  return [value, (next) => {
    keep(key, next);
    become(() => next);
  }];
}

/** @template T @param {string} key @param {T} initial @returns {T} */
export function kept(key, initial) {
  try {
    const text = localStorage.getItem(`ros2probe-${key}`);
    return text == null ? initial : JSON.parse(text);
  } catch {
    return initial;
  }
}

/** @param {string} key @param {unknown} value */
export function keep(key, value) {
  try {
    localStorage.setItem(`ros2probe-${key}`, JSON.stringify(value));
  } catch {
    // The page works without storage.
  }
}
