// A chart over time: uPlot on a canvas, a summary in words, and a table.
// All charts of a view share one cursor, which the arrow keys move as well.

import { useEffect, useRef, useState } from './vendor/hooks.mjs';
import { clock, date, NOTHING, when } from './format.js';
import { stream } from './store.js';
import { marksOf, useEvents } from './timebar.js';
import { colour, html } from './ui.js';

const uPlot = /** @type {any} */ (globalThis).uPlot;
const HEIGHT = 150;
/** Steps of an axis of counts, which are whole numbers. */
const WHOLE = [1, 2, 5].flatMap((step) => [0, 1, 2, 3, 4, 5, 6, 7, 8].map((power) => step * 10 ** power))
  .sort((one, other) => one - other);

/**
 * @typedef {{label: string, colour: string, values: (number|null)[], fill?: boolean}} Line
 *   `colour` is a CSS variable, such as `--line-1`.
 */

/**
 * Returns a summary of a line in words.
 * @param {Line} line
 * @param {(value: number|null) => string} print
 */
export function summary(line, print) {
  let least = Infinity;
  let most = -Infinity;
  let last = null;
  for (const value of line.values) {
    if (value == null) continue;
    least = Math.min(least, value);
    most = Math.max(most, value);
    last = value;
  }
  if (last == null) return `${line.label}: no values`;
  return `${line.label}: last ${print(last)}, minimum ${print(least)}, maximum ${print(most)}`;
}

/**
 * Returns an axis around values, so that small changes of a large value are visible.
 * @param {number|null} least
 * @param {number|null} most
 * @returns {[number, number]}
 */
export function around(least, most) {
  if (least == null || most == null) return [0, 1];
  const span = most - least || Math.abs(most) * 0.1 || 1;
  return [least - span * 0.1, most + span * 0.1];
}

/**
 * Returns how times of a chart are printed: with the day, unless all are of today.
 * @param {number[]} times Unix times
 * @param {number} [now] Unix time
 * @returns {{tick: (time: number) => string, whole: (time: number) => string}} on the axis, and elsewhere
 */
export function printersOf(times, now = Date.now() / 1000) {
  const isToday = [times[0], times[times.length - 1]].every((time) => when(time, now) === clock(time));
  if (isToday) return { tick: clock, whole: clock };
  return { tick: (time) => `${date(time).slice(5, 10)}\n${clock(time)}`, whole: date };
}

/** @param {string} variable @param {number} alpha a byte */
function faint(variable, alpha) {
  return `${colour(variable)}${alpha.toString(16).padStart(2, '0')}`;
}

/** Colours of the marks of events, by severity. */
const MARKS = /** @type {Record<string, string>} */ ({ ERROR: '--error', WARN: '--warning', INFO: '--dim' });
/** Least width of a selection, in pixels; less is a click. */
const LEAST_SELECTION = 6;

/**
 * Draws a line for each event.
 * @param {any} plot
 * @param {{time: number, severity: string}[]} marks
 */
function drawMarks(plot, marks) {
  const { ctx, bbox } = plot;
  ctx.save();
  ctx.setLineDash([4, 4]);
  for (const { time, severity } of marks) {
    if (time < plot.scales.x.min || time > plot.scales.x.max) continue;
    const x = Math.round(plot.valToPos(time, 'x', true));
    ctx.strokeStyle = colour(MARKS[severity] ?? '--dim');
    ctx.beginPath();
    ctx.moveTo(x, bbox.top);
    ctx.lineTo(x, bbox.top + bbox.height);
    ctx.stroke();
  }
  ctx.restore();
}

/**
 * @param {{title: string, times: number[], lines: Line[], print: (value: number|null) => string,
 *   note?: string, whole?: boolean, fitted?: boolean, range?: string,
 *   marks?: {time: number, severity: string}[],
 *   pick?: (picked: {time: number}) => void, select?: (from: number, to: number) => void}} props
 *   `whole`: values are counts. `fitted`: the axis spans the values, without 0. `range`: the time in
 *   words. `pick` receives the time of a click, or of Enter at the cursor; `select` the part that was
 *   dragged over.
 */
export function Chart({ title, times, lines, print, note, whole, fitted, pick, select,
  range = 'the last ten minutes', marks = [] }) {
  const place = useRef(/** @type {HTMLElement|null} */ (null));
  const plot = useRef(/** @type {any} */ (null));
  /** Returns the place of the latest second with a value. */
  const last = () => {
    let place = times.length - 1;
    while (place > 0 && lines.every((line) => line.values[place] == null)) place -= 1;
    return place;
  };
  const printers = printersOf(times);
  const latest = useRef({ marks, select, last, printers });
  latest.current = { marks, select, last, printers };
  const selected = useRef(false);
  const [asTable, showTable] = useState(false);
  const names = lines.map((line) => line.label).join();
  const data = [times, ...lines.map((line) => line.values)];
  useEffect(() => {
    if (asTable || !place.current) return undefined;
    const axis = {
      stroke: () => colour('--dim'),
      grid: { stroke: () => colour('--grid'), width: 1 },
      ticks: { stroke: () => colour('--grid'), width: 1 },
      font: '12px system-ui, sans-serif',
    };
    const host = place.current;
    const own = new uPlot({
      width: host.clientWidth || 300,
      height: HEIGHT,
      cursor: { sync: { key: 'topic' }, drag: { x: Boolean(select), y: false, setScale: false } },
      hooks: {
        ready: [(/** @type {any} */ drawn) => drawn.setLegend({ idx: latest.current.last() })],
        draw: [(/** @type {any} */ drawn) => drawMarks(drawn, latest.current.marks)],
        setSelect: [(/** @type {any} */ drawn) => {
          const { left, width } = drawn.select;
          if (width < LEAST_SELECTION || selected.current) return;
          // The click at the end of dragging selects no time.
          selected.current = true;
          setTimeout(() => { selected.current = false; }, 100);
          drawn.setSelect({ left: 0, width: 0, top: 0, height: 0 }, false);
          latest.current.select?.(drawn.posToVal(left, 'x'), drawn.posToVal(left + width, 'x'));
        }],
      },
      legend: { live: true },
      scales: { y: { range: (/** @type {any} */ _, /** @type {number} */ least,
        /** @type {number} */ most) => (fitted ? around(least, most)
        : [Math.min(0, least ?? 0), (most || 1) * 1.1]) } },
      axes: [
        { ...axis, values: (/** @type {any} */ _, /** @type {number[]} */ ticks) =>
          ticks.map(latest.current.printers.tick), space: 80 },
        { ...axis, values: (/** @type {any} */ _, /** @type {number[]} */ ticks) =>
          ticks.map(print), size: 78, ...(whole ? { incrs: WHOLE } : {}) },
      ],
      series: [
        { label: 'time', value: (/** @type {any} */ _, /** @type {number} */ time) =>
          latest.current.printers.whole(time) },
        ...lines.map((line) => ({
          label: line.label,
          stroke: () => colour(line.colour),
          fill: line.fill ? () => faint(line.colour, 0x30) : undefined,
          width: 1.5,
          points: { show: false },
          value: (/** @type {any} */ _, /** @type {number|null} */ value) =>
            (value == null ? NOTHING : print(value)),
        })),
      ],
    }, data, host);
    plot.current = own;
    const resize = new ResizeObserver(() => {
      if (host.clientWidth > 0) own.setSize({ width: host.clientWidth, height: HEIGHT });
    });
    resize.observe(host);
    const redraw = () => own.redraw(false);
    window.addEventListener('theme', redraw);
    return () => {
      resize.disconnect();
      window.removeEventListener('theme', redraw);
      own.destroy();
      plot.current = null;
    };
  }, [asTable, names]);
  useEffect(() => {
    const own = plot.current;
    if (!own) return;
    own.setData(data);
    // Without a cursor the legend shows the latest values.
    if (own.cursor.idx != null) return;
    own.setLegend({ idx: last() });
  });
  const pickCursor = () => {
    const time = times[plot.current?.cursor.idx ?? -1];
    if (pick && time != null && !selected.current) pick({ time });
  };
  const move = (/** @type {KeyboardEvent} */ event) => {
    const by = { ArrowLeft: -1, ArrowRight: 1, PageUp: -60, PageDown: 60 }[event.key];
    const own = plot.current;
    if (event.key === 'Enter') pickCursor();
    if (!by || !own || !times.length) return;
    event.preventDefault();
    const at = own.cursor.idx ?? times.length - 1;
    const next = Math.max(0, Math.min(times.length - 1, at + by));
    // The second `true` moves the cursors of the other charts.
    own.setCursor({ left: own.valToPos(times[next], 'x'), top: HEIGHT / 3 }, true, true);
  };
  const words = lines.map((line) => summary(line, print)).join('; ');
  return html`<figure class="chart">
    <figcaption><h3>${title}</h3>
      <button type="button" class="small" aria-pressed=${asTable}
        onClick=${() => showTable(!asTable)}>Table</button></figcaption>
    ${asTable
      ? html`<${ValueTable} title=${title} times=${times} lines=${lines} print=${print} />`
      : html`<div class="plot" ref=${place} role="img" tabindex="0" onKeyDown=${move}
        onClick=${pickCursor}
        aria-label="${title} over ${range.replace(/^The/, 'the')}. ${words}."></div>`}
    <p class="dim">${words}${note ? html`. ${note}` : ''}</p></figure>`;
}

/**
 * Lines over bars for warnings and errors.
 * @param {{from: number, end: number, width: number, height: number}} props
 *   `from` and `end` are the Unix times at both sides; the others are the size of the drawing
 */
export function EventLines({ from, end, width, height }) {
  const events = useEvents({ at: stream.at, span: end - from });
  const marks = marksOf(events.filter(({ severity }) => severity !== 'INFO'));
  return marks.filter(({ time }) => time >= from && time <= end).map(({ time, severity }, key) => {
    const x = (width * (time - from)) / (end - from);
    return html`<line key=${key} x1=${x} x2=${x} y1="0" y2=${height}
      style="stroke: var(${MARKS[severity] ?? '--dim'})" />`;
  });
}

/**
 * A bar for each step of a time, whose parts have the colours of a legend.
 * @param {{label: string, bars: (number[]|null)[], kinds: [string, string][], words: string,
 *   from: number, step: number}} props
 *   `bars` are the values of each kind, null while unknown; `kinds` are words and CSS variables;
 *   `words` say what one bar and the range are; `from` is the Unix time at which the first bar
 *   begins, and `step` the seconds of each
 */
export function Bars({ label, bars, kinds, words, from, step }) {
  const sums = kinds.map((_, kind) => bars.reduce((sum, bar) => sum + (bar?.[kind] ?? 0), 0));
  const highest = Math.max(1, ...bars.map((bar) => (bar ?? []).reduce((sum, value) => sum + value, 0)));
  const text = kinds.map(([kind], at) => `${sums[at]} ${kind}`).join(', ');
  return html`<figure class="bars"><svg class="timeline" viewBox="0 0 ${10 * bars.length} 100" role="img"
      preserveAspectRatio="none" aria-label="${label}: ${text}. ${words}">${bars.flatMap((bar, place) => {
    let top = 100;
    return (bar ?? []).map((value, kind) => {
      const height = (100 * value) / highest;
      top -= height;
      return html`<rect key=${`${place} ${kind}`} x=${10 * place + 1} width="8" y=${top} height=${height}
        style="fill: var(${kinds[kind][1]})" />`;
    });
  })}<${EventLines} from=${from} end=${from + step * bars.length} width=${10 * bars.length}
    height=${100} /></svg><figcaption>
    <span>${kinds.map(([kind, variable], at) => html`<span key=${kind} class="cause"
      style="--cause: var(${variable})">${kind} ${sums[at]}</span>`)}</span>
    <span class="dim">${words}; the highest bar is ${highest}</span></figcaption></figure>`;
}

/**
 * A table of every tenth value, the latest first.
 * @param {{title: string, times: number[], lines: Line[],
 *   print: (value: number|null) => string}} props
 */
function ValueTable({ title, times, lines, print }) {
  const places = [];
  const { whole } = printersOf(times);
  for (let at = times.length - 1; at >= 0; at -= 10) places.push(at);
  return html`<div class="scroll" tabindex="0" role="group" aria-label="${title}, as a table">
    <table><thead><tr><th scope="col">time</th>
    ${lines.map((line) => html`<th scope="col" class="number">${line.label}</th>`)}</tr></thead>
    <tbody>${places.map((at) => html`<tr key=${times[at]}><th scope="row">${whole(times[at])}</th>
      ${lines.map((line) => html`<td class="number">${print(line.values[at] ?? null)}</td>`)}
      </tr>`)}</tbody></table></div>`;
}
