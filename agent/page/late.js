// Late calls of callbacks: the causes, and the worst call of each callback.

import { count, duration } from './format.js';
import { trigger } from './inside.js';

/** Share of a call below which a part is not named. */
const SMALL = 0.005;
/** Width of a drawn call. */
export const WIDTH = 200;

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
    const [call] = it.examples;
    const total = (call.wait_seconds ?? 0) + call.duration_seconds;
    let at = 0;
    const parts = call.parts.map((/** @type {any} */ part) => {
      const drawn = { stage: part.stage, cause: part.cause, seconds: part.seconds, from: at,
        width: total > 0 ? WIDTH * part.seconds / total : 0 };
      at += drawn.width;
      return drawn;
    });
    const named = parts.filter((/** @type {any} */ part) => part.seconds >= SMALL * total);
    return {
      callback: trigger(it.trigger), who: it.node ?? `process ${it.process_id}`,
      late: it.calls == null ? count(it.late_calls) : `${count(it.late_calls)} of ${count(it.calls)}`,
      total: duration(total), at: call.timestamp_seconds, words: call.words, parts,
      text: named.map((/** @type {any} */ part) =>
        `${part.cause.replace('_', ' ')} ${duration(part.seconds)}`).concat(call.cpu_limits ?? [])
        .join(', '),
    };
  });
}

/** Says what is not observed; empty if everything is. @param {any} why */
export function missing(why) {
  if (!why) return '';
  if (why.observed === 'off') return why.reason ?? 'Late calls are not reported: capture.late is off.';
  return why.reason ?? '';
}
