// Late calls of callbacks: the causes, the worst call of each callback, and the calls over time.

import { clock, count, duration, several } from './format.js';
import { trigger } from './inside.js';

/** Share of a call below which a part is not named. */
const SMALL = 0.005;
/** Width of a drawn call. */
export const WIDTH = 200;
/** Length of a period of the timeline, in seconds, and number of periods. */
const PERIOD = 10;
const PERIODS = 60;
/** Colours of causes, as CSS variables: others took the CPU, it computed, it waited, and the way of
 * its message. */
const COLOURS = Object.fromEntries(/** @type {[string, string[]][]} */ ([
  ['--line-1', ['runnable', 'throttled', 'stolen', 'stopped']],
  ['--line-2', ['cpu', 'other_callback']],
  ['--line-3', ['lock', 'sleep', 'disk', 'page_fault', 'system_call', 'blocked']],
  ['--line-4', ['send', 'transit', 'repaired', 'queue', 'middleware', 'arrival']],
]).flatMap(([colour, causes]) => causes.map((cause) => [cause, colour])));

/** Returns the causes as rows: the cause, the calls, the longest one, and what helps.
 * @param {any} why @returns {[string, string, string, string][]} */
export function causes(why) {
  return (why?.causes ?? []).map((/** @type {any} */ it) => [it.words, count(it.late_calls),
    duration(it.longest_seconds), it.remedy]);
}

/** Returns the worst call of each callback, with its parts as they are drawn.
 * @param {any} why */
export function worst(why) {
  const known = (why?.callbacks ?? []).filter((/** @type {any} */ it) => it.examples?.length > 0);
  return known.map((/** @type {any} */ it) => {
    const late = it.calls == null ? count(it.late_calls)
      : `${count(it.late_calls)} of ${count(it.calls)}`;
    return { callback: trigger(it.trigger), who: whose(it), late, ...drawn(it.examples[0]) };
  });
}

/** Returns a call with its parts as they are drawn. @param {any} call */
function drawn(call) {
  const total = (call.wait_seconds ?? 0) + call.duration_seconds;
  let at = 0;
  const parts = call.parts.map((/** @type {any} */ part) => {
    const shown = { stage: part.stage, cause: part.cause, seconds: part.seconds, from: at,
      width: total > 0 ? WIDTH * part.seconds / total : 0 };
    at += shown.width;
    return shown;
  });
  const named = parts.filter((/** @type {any} */ part) => part.seconds >= SMALL * total);
  return {
    total: duration(total), at: call.timestamp_seconds, words: call.words, parts,
    text: named.map((/** @type {any} */ part) =>
      `${inWords(part.cause)} ${duration(part.seconds)}`).concat(call.cpu_limits ?? []).join(', '),
  };
}

/** @param {any} callback */
function whose(callback) {
  return callback.node ?? `process ${callback.process_id}`;
}

/** @param {string} cause */
function inWords(cause) {
  return cause.replace('_', ' ');
}

/**
 * Returns the late calls of the last ten minutes by periods of ten seconds, the latest last, and
 * the colour of each cause, the most frequent one first. Heights are shares of the period with the most calls.
 * @param {any} why
 */
export function timeline(why) {
  const end = Math.ceil((why?.timestamp_seconds ?? 0) / PERIOD) * PERIOD;
  const from = end - PERIOD * PERIODS;
  const calls = (why?.callbacks ?? []).flatMap((/** @type {any} */ it) =>
    (it.history ?? []).map((/** @type {any} */ call) => ({ ...call, of: it })));
  const shown = calls.filter((/** @type {any} */ call) => call.timestamp_seconds >= from
    && call.timestamp_seconds < end);
  const counts = new Map();
  for (const { cause } of shown) counts.set(cause, (counts.get(cause) ?? 0) + 1);
  const ranked = [...counts.keys()].sort((one, other) => counts.get(other) - counts.get(one));
  const colours = ranked.map((cause) => ({ cause, words: inWords(cause), calls: counts.get(cause),
    colour: COLOURS[cause] ?? '--dim' }));
  const periods = new Map();
  for (const call of shown) {
    const place = Math.floor((call.timestamp_seconds - from) / PERIOD);
    periods.set(place, [...(periods.get(place) ?? []), call]);
  }
  const most = Math.max(1, ...[...periods.values()].map((list) => list.length));
  const bars = [...periods].sort(([one], [other]) => one - other).map(([place, list]) => {
    let below = 0;
    const parts = colours.flatMap(({ cause, words, colour }) => {
      const number = list.filter((/** @type {any} */ call) => call.cause === cause).length;
      const part = { cause, words: `${words} ${number}`, colour, from: below / most, height: number / most };
      below += number;
      return number > 0 ? [part] : [];
    });
    const longest = Math.max(...list.map((/** @type {any} */ call) => call.total_seconds));
    const begin = from + place * PERIOD;
    return { place, begin, parts, list,
      label: `${clock(begin)}: ${several(list.length, 'late call')}, up to ${duration(longest)}: ${
        parts.map((part) => part.words).join(', ')}` };
  });
  return { bars, colours, from, end, periods: PERIODS };
}

/**
 * Returns the period with late calls that is closest to a time, at most one period away; null if
 * there is none.
 * @param {{bars: any[]}} shown @param {number} time
 */
export function closest({ bars }, time) {
  const away = (/** @type {any} */ bar) => Math.max(bar.begin - time, time - bar.begin - PERIOD, 0);
  const near = bars.filter((bar) => away(bar) <= PERIOD);
  near.sort((one, other) => away(one) - away(other));
  return near[0] ?? null;
}

/**
 * Returns the calls of a period, the longest first. Those that are examples have their parts.
 * @param {any} bar
 */
export function callsOf(bar) {
  const list = [...bar.list].sort((one, other) => other.total_seconds - one.total_seconds);
  return list.map(({ of, ...call }) => {
    const example = (of.examples ?? []).find((/** @type {any} */ it) =>
      Math.abs(it.timestamp_seconds - call.timestamp_seconds) < 1e-6);
    return { callback: trigger(of.trigger), who: whose(of), time: clock(call.timestamp_seconds),
      total: duration(call.total_seconds), words: call.words, example: example ? drawn(example) : null };
  });
}

/** Says what is not observed; empty if everything is. @param {any} why */
export function missing(why) {
  if (!why) return '';
  if (why.observed === 'off') return why.reason ?? 'Late calls are not reported: capture.late is off.';
  return why.reason ?? '';
}
