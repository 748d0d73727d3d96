// A chart of the last ten minutes: uPlot on a canvas, a summary in words, and a table.
// All charts of a view share one cursor, which the arrow keys move as well.

import { useEffect, useRef, useState } from './vendor/hooks.mjs';
import { clock, NOTHING } from './format.js';
import { html } from './ui.js';

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

/** @param {string} variable */
function colour(variable) {
  return getComputedStyle(document.documentElement).getPropertyValue(variable).trim();
}

/** @param {string} variable @param {number} alpha a byte */
function faint(variable, alpha) {
  return `${colour(variable)}${alpha.toString(16).padStart(2, '0')}`;
}

/**
 * @param {{title: string, times: number[], lines: Line[], print: (value: number|null) => string,
 *   note?: string, whole?: boolean, pick?: (picked: {time: number}) => void}} props
 *   `whole`: values are counts. `pick` receives the time of a click, or of Enter at the cursor.
 */
export function Chart({ title, times, lines, print, note, whole, pick }) {
  const place = useRef(/** @type {HTMLElement|null} */ (null));
  const plot = useRef(/** @type {any} */ (null));
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
      cursor: { sync: { key: 'topic' }, drag: { x: false, y: false } },
      legend: { live: true },
      scales: { y: { range: (/** @type {any} */ _, /** @type {number} */ least,
        /** @type {number} */ most) => [Math.min(0, least ?? 0), (most || 1) * 1.1] } },
      axes: [
        { ...axis, values: (/** @type {any} */ _, /** @type {number[]} */ ticks) =>
          ticks.map(clock), space: 80 },
        { ...axis, values: (/** @type {any} */ _, /** @type {number[]} */ ticks) =>
          ticks.map(print), size: 78, ...(whole ? { incrs: WHOLE } : {}) },
      ],
      series: [
        { label: 'time', value: (/** @type {any} */ _, /** @type {number} */ time) => clock(time) },
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
    let latest = times.length - 1;
    while (latest > 0 && lines.every((line) => line.values[latest] == null)) latest -= 1;
    own.setLegend({ idx: latest });
  });
  const pickCursor = () => {
    const time = times[plot.current?.cursor.idx ?? -1];
    if (pick && time != null) pick({ time });
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
        aria-label="${title} over the last ten minutes. ${words}."></div>`}
    <p class="dim">${words}${note ? html`. ${note}` : ''}</p></figure>`;
}

/**
 * A table of every tenth value, the latest first.
 * @param {{title: string, times: number[], lines: Line[],
 *   print: (value: number|null) => string}} props
 */
function ValueTable({ title, times, lines, print }) {
  const places = [];
  for (let at = times.length - 1; at >= 0; at -= 10) places.push(at);
  return html`<div class="scroll" tabindex="0" role="group" aria-label="${title}, as a table">
    <table><thead><tr><th scope="col">time</th>
    ${lines.map((line) => html`<th scope="col" class="number">${line.label}</th>`)}</tr></thead>
    <tbody>${places.map((at) => html`<tr key=${times[at]}><th scope="row">${clock(times[at])}</th>
      ${lines.map((line) => html`<td class="number">${print(line.values[at] ?? null)}</td>`)}
      </tr>`)}</tbody></table></div>`;
}
