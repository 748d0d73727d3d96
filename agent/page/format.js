// Numbers, times and names as the page prints them.
//
// Every function returns text and never markup. An absent value prints as an en dash, so that
// "not measured" is never read as zero.

/** Printed for an absent value. */
export const NOTHING = '–';

const PREFIXES = ['', 'k', 'M', 'G', 'T'];

/**
 * Formats three significant digits, without an exponent.
 * @param {number} value
 * @returns {string}
 */
function digits(value) {
  const size = Math.abs(value);
  if (size >= 100) return value.toFixed(0);
  if (size >= 10) return value.toFixed(1);
  return value.toFixed(2);
}

/**
 * Formats a quantity with a decimal prefix: 12345 and "B" give "12.3 kB".
 * @param {number|null|undefined} value
 * @param {string} unit
 * @returns {string}
 */
function scaled(value, unit) {
  if (value == null || !Number.isFinite(value)) return NOTHING;
  let power = 0;
  while (Math.abs(value) >= 999.5 && power < PREFIXES.length - 1) {
    value /= 1000;
    power += 1;
  }
  const text = power === 0 && Number.isInteger(value) ? String(value) : digits(value);
  return `${text} ${PREFIXES[power]}${unit}`;
}

/** Formats messages per second. @param {number|null|undefined} hertz */
export function rate(hertz) {
  return scaled(hertz, 'Hz');
}

/** @param {number|null|undefined} count */
export function bytes(count) {
  return scaled(count, 'B');
}

/** @param {number|null|undefined} count bytes per second */
export function bandwidth(count) {
  return count == null ? NOTHING : scaled(count, 'B/s');
}

/**
 * Formats a whole number with separators between thousands.
 * @param {number|null|undefined} value
 */
export function count(value) {
  if (value == null || !Number.isFinite(value)) return NOTHING;
  return Math.round(value).toString().replace(/\B(?=(\d{3})+$)/g, ',');
}

/**
 * Formats a duration: "350 µs", "1.25 ms", "4.0 s", "3 min 5 s", "2 h 5 min", "3 d 4 h".
 * @param {number|null|undefined} seconds
 */
export function duration(seconds) {
  if (seconds == null || !Number.isFinite(seconds)) return NOTHING;
  const sign = seconds < 0 ? '-' : '';
  const size = Math.abs(seconds);
  if (size === 0) return '0 s';
  if (size < 0.9995e-3) return `${sign}${digits(size * 1e6)} µs`;
  if (size < 0.9995) return `${sign}${digits(size * 1e3)} ms`;
  if (size < 59.95) return `${sign}${digits(size)} s`;
  const whole = Math.round(size);
  const parts = [[86400, 'd'], [3600, 'h'], [60, 'min'], [1, 's']];
  const first = parts.findIndex(([length]) => whole >= Number(length));
  const [length, unit] = parts[first];
  const [next, nextUnit] = parts[first + 1] ?? [1, ''];
  const rest = Math.floor((whole % Number(length)) / Number(next));
  const tail = rest > 0 ? ` ${rest} ${nextUnit}` : '';
  return `${sign}${Math.floor(whole / Number(length))} ${unit}${tail}`;
}

/**
 * Formats an age in whole seconds: "3 s", "2 min 5 s".
 * @param {number|null|undefined} seconds
 */
export function age(seconds) {
  if (seconds == null || !Number.isFinite(seconds)) return NOTHING;
  const whole = Math.max(0, Math.round(seconds));
  return whole < 60 ? `${whole} s` : duration(whole);
}

/**
 * Formats a fraction as a percentage. A loss above zero never prints as zero.
 * @param {number|null|undefined} part
 */
export function percent(part) {
  if (part == null || !Number.isFinite(part)) return NOTHING;
  if (part === 0) return '0 %';
  if (part > 0 && part < 0.0001) return '<0.01 %';
  if (part < 1 && part > 0.9999) return '>99.99 %';
  const hundred = part * 100;
  return `${hundred >= 10 ? hundred.toFixed(1) : hundred.toFixed(2)} %`;
}

/**
 * Formats the calls of a service: "1,000 calls, p50 4.22 ms, p99 7.50 ms, 1 hanging"; empty without
 * calls.
 * @param {any} calls as `GET /services` has them
 */
export function calls(calls) {
  if (!calls) {
    return '';
  }
  const { requests, hanging, latency_p50_seconds: p50, latency_p99_seconds: p99 } = calls;
  const parts = [several(requests, 'call')];
  if (p50 != null) {
    parts.push(`p50 ${duration(p50)}`, `p99 ${duration(p99)}`);
  }
  if (hanging > 0) {
    parts.push(`${count(hanging)} hanging`);
  }
  return parts.join(', ');
}

/**
 * Formats the time of day of a Unix time, in the browser's zone.
 * @param {number|null|undefined} seconds
 */
export function clock(seconds) {
  if (seconds == null || !Number.isFinite(seconds)) return NOTHING;
  const time = new Date(seconds * 1000);
  const two = (/** @type {number} */ value) => String(value).padStart(2, '0');
  return `${two(time.getHours())}:${two(time.getMinutes())}:${two(time.getSeconds())}`;
}

/**
 * Formats date and time of day of a Unix time, in the browser's zone.
 * @param {number|null|undefined} seconds
 */
export function date(seconds) {
  if (seconds == null || !Number.isFinite(seconds)) return NOTHING;
  const time = new Date(seconds * 1000);
  const two = (/** @type {number} */ value) => String(value).padStart(2, '0');
  const day = `${time.getFullYear()}-${two(time.getMonth() + 1)}-${two(time.getDate())}`;
  return `${day} ${clock(seconds)}`;
}

/**
 * Formats the time of day of a Unix time; of another day than today, with its date.
 * @param {number|null|undefined} seconds
 * @param {number} [now] Unix time
 */
export function when(seconds, now = Date.now() / 1000) {
  return date(seconds).slice(0, 10) === date(now).slice(0, 10) ? clock(seconds) : date(seconds);
}

/**
 * Formats a number with its noun: "1 topic", "3 topics".
 * @param {number} number
 * @param {string} noun
 * @param {string} [plural]
 */
export function several(number, noun, plural = `${noun}s`) {
  return `${count(number)} ${number === 1 ? noun : plural}`;
}

// Control, format (bidi, zero width), surrogate, private and unassigned characters, separators,
// spaces other than U+0020, fillers that print nothing, variation selectors. The backslash is
// escaped too, so that an escape in the text cannot be mistaken for one of ours.
const UNSEEN = new RegExp(
  '[\\p{Cc}\\p{Cf}\\p{Cs}\\p{Co}\\p{Cn}\\p{Zl}\\p{Zp}\\\\' +
    '\\u034f\\u115f\\u1160\\u17b4\\u17b5\\u180b-\\u180f\\u2800\\u3164\\uffa0\\ufe00-\\ufe0f' +
    '\\u{e0100}-\\u{e01ef}]|(?! )\\p{Zs}',
  'gu',
);

/**
 * Returns a name or other text from the network with escapes such as `\u{202e}` for characters that
 * print nothing or reorder their neighbours.
 * @param {unknown} text
 * @returns {string}
 */
export function visible(text) {
  return String(text ?? '').replace(UNSEEN, (found) => {
    if (found === '\\') return '\\\\';
    if (found === '\n') return '\\n';
    if (found === '\t') return '\\t';
    return `\\u{${/** @type {number} */ (found.codePointAt(0)).toString(16)}}`;
  });
}

/**
 * Returns at most `most` characters of a visible text: its beginning and end.
 * @param {unknown} text
 * @param {number} most
 */
export function shortened(text, most) {
  const characters = Array.from(visible(text));
  if (characters.length <= most) return characters.join('');
  const head = Math.ceil((most - 1) / 2);
  const tail = most - 1 - head;
  const end = tail > 0 ? characters.slice(-tail) : [];
  return `${characters.slice(0, head).join('')}…${end.join('')}`;
}

/** Words for each event. */
export const EVENTS = /** @type {Record<string, string>} */ ({
  'ros2.participant.discovered': 'participant appeared', 'ros2.participant.changed': 'participant changed',
  'ros2.participant.lost': 'participant left', 'ros2.endpoint.discovered': 'endpoint appeared',
  'ros2.endpoint.changed': 'endpoint changed', 'ros2.endpoint.lost': 'endpoint left',
  'ros2.node.discovered': 'node appeared', 'ros2.node.lost': 'node left',
  'ros2.node.lifecycle_transition': 'lifecycle state changed',
  'ros2.robot.diagnostic_changed': 'diagnostic level changed',
  'ros2.robot.parameter_changed': 'parameter changed', 'ros2.robot.transform_jumped': 'transform jumped',
  'ros2.message.lost': 'messages lost', 'ros2.topic.expectation_changed': 'expectation of a watch',
  'ros2.topic.silent': 'topic silent', 'ros2.qos.incompatible': 'QoS incompatible',
  'ros2.qos.resolved': 'QoS compatible again', 'ros2.graph.diagnosed': 'finding',
  'ros2.graph.resolved': 'finding resolved', 'ros2.service.call_hanging': 'call hangs',
  'ros2.service.call_resolved': 'call hangs no longer', 'ros2probe.agent.started': 'agent started',
  'ros2probe.capture.dropped': 'agent dropped packets', 'ros2probe.capture.blind': 'agent sees nothing',
  'ros2probe.capture.seeing': 'agent sees the robot again',
  'ros2probe.config.reloaded': 'configuration applied',
  'ros2probe.config.reload_failed': 'configuration rejected', 'ros2probe.watch.added': 'watch added',
  'ros2probe.watch.removed': 'watch removed', 'ros2probe.recording.started': 'recording started',
  'ros2probe.recording.ended': 'recording ended', 'ros2probe.snapshot.taken': 'snapshot taken',
  'ros2probe.events.suppressed': 'too many events',
});

/**
 * Returns an event in words: "node appeared", "finding: slow callback".
 * @param {{name: string, attributes: Record<string, unknown>}} event
 */
export function eventWords({ name, attributes }) {
  const words = EVENTS[name] ?? name.replace(/^ros2(probe)?\./, '').replace(/[._]/g, ' ');
  const { diagnosis } = attributes;
  return typeof diagnosis === 'string' ? `${words}: ${diagnosis.replaceAll('_', ' ')}` : words;
}

/** What became of the last message of a transient-local writer, by its state in the API. */
const LATCHED = /** @type {Record<string, string>} */ ({
  kept: 'kept for recordings and viewers',
  unseen: 'not seen by the agent',
  too_large: 'too large to be kept',
  paused: 'not captured: its publisher sends much',
  no_room: 'not kept: no room',
});

/**
 * Formats what became of the last message of a transient-local writer.
 * @param {{state: string, bytes: number|null}} latched
 */
export function lastMessage({ state, bytes: size }) {
  const text = LATCHED[state] ?? state;
  return size == null ? text : `${text} (${bytes(size)})`;
}
