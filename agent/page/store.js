// What all views share: the state, its stream, the route, and hooks that follow them.

import { useEffect, useReducer, useRef, useState } from './vendor/hooks.mjs';
import { json, Refusal } from './api.js';
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

/**
 * Requests an endpoint periodically while the view is shown and the stream runs. It has the present,
 * so a moment in the past needs no request.
 * @param {string|null} path null sends no request
 * @param {number} every milliseconds; 0 sends one request
 * @returns {{data: any, problem: Refusal|null, refresh: () => void}}
 */
export function usePoll(path, every) {
  const [answer, take] = useState(
    /** @type {{path: string|null, data: any, problem: Refusal|null}} */
    ({ path: null, data: null, problem: null }),
  );
  const again = useRef(() => {});
  const past = stream.at != null;
  useEffect(() => {
    if (path == null || past) return undefined;
    const abort = new AbortController();
    let timer = 0;
    const ask = async () => {
      clearTimeout(timer);
      if (document.visibilityState !== 'hidden' && stream.status !== 'paused') {
        try {
          take({ path, data: await json(path, { signal: abort.signal }), problem: null });
        } catch (error) {
          if (abort.signal.aborted) return;
          const problem = error instanceof Refusal ? error : new Refusal(0, String(error));
          take((/** @type {any} */ before) => ({ path, data: before.path === path ? before.data : null, problem }));
        }
      }
      if (every > 0 && !abort.signal.aborted) timer = setTimeout(ask, every);
    };
    again.current = ask;
    ask();
    return () => {
      clearTimeout(timer);
      abort.abort();
    };
  }, [path, every, past]);
  const own = answer.path === path && !past;
  return {
    data: own ? answer.data : null,
    problem: own ? answer.problem : null,
    refresh: () => again.current(),
  };
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
