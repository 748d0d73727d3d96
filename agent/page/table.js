// A table of which only the rows in sight are in the document, so that 500 topics cost what 30 do.
// It scrolls with the window, which keeps it usable on a phone and at 400 % zoom.

import { useEffect, useLayoutEffect, useRef, useState } from './vendor/hooks.mjs';
import { html } from './ui.js';

/** Rows kept above and below those in sight. */
const SPARE = 12;

/**
 * @template T
 * @typedef {{key: string, title: string, cell: (row: T) => any, by?: (row: T) => any,
 *   kind?: string, header?: boolean}} Column
 *   `by` gives what the column sorts by; `kind` is a class: `number`, `wide` (hidden on a phone).
 */

/**
 * The rows in the order of a column; equal ones keep their order.
 * @template T
 * @param {T[]} rows
 * @param {Column<T>[]} columns
 * @param {string} sort a column's key, with a leading `-` for descending
 */
export function sorted(rows, columns, sort) {
  const descending = sort.startsWith('-');
  const column = columns.find((each) => each.key === sort.replace(/^-/, ''));
  const { by } = column ?? {};
  if (!by) return rows;
  const keyed = rows.map((row, at) => ({ row, at, key: by(row) }));
  keyed.sort((one, other) => {
    const order = compare(one.key, other.key, descending);
    return order || one.at - other.at;
  });
  return keyed.map(({ row }) => row);
}

/** Absent values are last in both directions. @param {any} a @param {any} b @param {boolean} down */
function compare(a, b, down) {
  if (a == null || b == null) return Number(a == null) - Number(b == null);
  const order = a < b ? -1 : a > b ? 1 : 0;
  return down ? -order : order;
}

/**
 * @param {{label: string, columns: Column<any>[], rows: any[], keyOf: (row: any) => string,
 *   sort: string, onSort: (sort: string) => void, rowClass?: (row: any) => string}} props
 */
export function Table({ label, columns, rows, keyOf, sort, onSort, rowClass }) {
  const body = useRef(/** @type {HTMLElement|null} */ (null));
  const measured = useRef(0);
  const [height, setHeight] = useState(37);
  const [range, setRange] = useState({ first: 0, last: 40 });
  const measure = () => {
    if (!body.current) return;
    // Rows differ where names wrap: their mean is taken once for each width of the window.
    const drawn = body.current.querySelectorAll('tr[data-row]');
    if (drawn.length && measured.current !== window.innerWidth) {
      measured.current = window.innerWidth;
      let total = 0;
      for (const row of drawn) total += row.getBoundingClientRect().height;
      setHeight(Math.max(20, total / drawn.length));
    }
    const top = body.current.getBoundingClientRect().top;
    const first = Math.max(0, Math.min(rows.length, Math.floor(-top / height) - SPARE));
    const last = Math.max(first, Math.ceil((window.innerHeight - top) / height) + SPARE);
    setRange((/** @type {any} */ before) => (before.first === first && before.last === last
      ? before : { first, last }));
  };
  useLayoutEffect(measure);
  useEffect(() => {
    let asked = 0;
    const soon = () => {
      cancelAnimationFrame(asked);
      asked = requestAnimationFrame(measure);
    };
    window.addEventListener('scroll', soon, { passive: true });
    window.addEventListener('resize', soon);
    return () => {
      cancelAnimationFrame(asked);
      window.removeEventListener('scroll', soon);
      window.removeEventListener('resize', soon);
    };
  });
  const first = Math.min(range.first, Math.max(0, rows.length - 1));
  const last = Math.min(rows.length, range.last);
  const walk = (/** @type {KeyboardEvent} */ event) => {
    const by = { ArrowDown: 1, ArrowUp: -1 }[event.key];
    const row = /** @type {HTMLElement} */ (event.target).closest('tr');
    if (!by || !row || /** @type {HTMLElement} */ (event.target).tagName !== 'A') return;
    const next = by > 0 ? row.nextElementSibling : row.previousElementSibling;
    const link = /** @type {HTMLElement|null|undefined} */ (next?.querySelector('a'));
    if (!link) return;
    event.preventDefault();
    link.focus();
  };
  const head = columns.map((column) => {
    const own = sort.replace(/^-/, '') === column.key;
    const down = sort.startsWith('-');
    const order = own ? (down ? 'descending' : 'ascending') : undefined;
    const next = own && !down ? `-${column.key}` : column.key;
    return html`<th scope="col" class=${column.kind ?? ''} aria-sort=${order}>
      ${column.by
        ? html`<button type="button" class="plain" onClick=${() => onSort(next)}>${column.title}<span
          aria-hidden="true">${own ? (down ? ' ▼' : ' ▲') : ''}</span></button>`
        : column.title}</th>`;
  });
  const space = (/** @type {number} */ count) => count > 0
    && html`<tr aria-hidden="true" class="space"><td colspan=${columns.length}
      style=${{ height: `${count * height}px` }}></td></tr>`;
  return html`<div class="table" onKeyDown=${walk}>
    <table aria-label=${label} aria-rowcount=${rows.length + 1}>
    <thead><tr aria-rowindex="1">${head}</tr></thead>
    <tbody ref=${body}>
      ${space(first)}
      ${rows.slice(first, last).map((row, at) => html`<tr key=${keyOf(row)} data-row
        aria-rowindex=${first + at + 2} class=${rowClass?.(row) ?? ''}>
        ${columns.map((column) => (column.header
          ? html`<th scope="row" class=${column.kind ?? ''}>${column.cell(row)}</th>`
          : html`<td class=${column.kind ?? ''}>${column.cell(row)}</td>`))}</tr>`)}
      ${space(rows.length - last)}
    </tbody></table></div>`;
}
