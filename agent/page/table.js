// A table with only the visible rows in the document, so that 500 topics cost as much as 30.
// It scrolls with the window, so that it is usable on a phone and at 400 % zoom.

import { useEffect, useLayoutEffect, useRef, useState } from './vendor/hooks.mjs';
import { html, Meanings } from './ui.js';

/** Rows rendered above and below the visible ones. */
const SPARE = 12;

/**
 * @template T
 * @typedef {{key: string, title: string, cell: (row: T) => any, by?: (row: T) => any,
 *   kind?: string, header?: boolean, meaning?: string}} Column
 *   `by` returns the sort key; `kind` is a class: `number`, `wide` (hidden on a phone). `meaning`
 *   explains the column below the table.
 */

/**
 * Returns the rows in the order of a column; equal ones keep their order.
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
 *   sort: string, onSort: (sort: string) => void, rowClass?: (row: any) => string,
 *   meanings?: [any, string][]}} props
 *   `meanings` explains states in the table.
 */
export function Table({ label, columns, rows, keyOf, sort, onSort, rowClass, meanings = [] }) {
  const body = useRef(/** @type {HTMLElement|null} */ (null));
  /** Heights in pixels of rendered rows, by key: names wrap, so rows differ. */
  const heights = useRef(/** @type {Map<string, number>} */ (new Map()));
  const known = useRef({ width: 0, mean: 37 });
  const [range, setRange] = useState({ first: 0, last: 40 });
  const first = Math.min(range.first, Math.max(0, rows.length - 1));
  const last = Math.min(rows.length, range.last);
  const high = (/** @type {any} */ row) => heights.current.get(keyOf(row)) ?? known.current.mean;
  const total = (/** @type {any[]} */ some) => some.reduce((sum, row) => sum + high(row), 0);
  const measure = () => {
    if (!body.current) return;
    if (known.current.width !== window.innerWidth || heights.current.size > 4 * rows.length + 400) {
      known.current.width = window.innerWidth;
      heights.current.clear();
    }
    const drawn = [...body.current.querySelectorAll('tr[data-row]')];
    let sum = 0;
    drawn.forEach((row, at) => {
      const { height } = row.getBoundingClientRect();
      sum += height;
      if (rows[first + at]) heights.current.set(keyOf(rows[first + at]), height);
    });
    if (sum > 0) known.current.mean = Math.max(20, sum / drawn.length);
    // Rows that cover the window stay, whatever was estimated: other rows would change the widths of
    // columns, then the heights of rows, and then which rows are visible.
    const top = drawn[0]?.getBoundingClientRect().top ?? 0;
    const covers = drawn.length > 0 && (first === 0 || top <= 0)
      && (last === rows.length || top + sum >= window.innerHeight);
    if (covers) return;
    let y = body.current.getBoundingClientRect().top;
    let from = 0;
    while (from < rows.length && y + high(rows[from]) <= 0) {
      y += high(rows[from]);
      from += 1;
    }
    let to = from;
    while (to < rows.length && y < window.innerHeight) {
      y += high(rows[to]);
      to += 1;
    }
    const next = { first: Math.max(0, from - SPARE), last: to + SPARE };
    setRange((/** @type {any} */ before) => (before.first === next.first && before.last === next.last
      ? before : next));
  };
  useLayoutEffect(measure, [rows.length]);
  useEffect(() => {
    // At most once per frame: a table that never settles must not block the page.
    let asked = requestAnimationFrame(measure);
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
    // The highest number matters first, and the first name.
    const isNumber = column.kind?.includes('number');
    const next = (own ? !down : isNumber) ? `-${column.key}` : column.key;
    return html`<th scope="col" class=${column.kind ?? ''} aria-sort=${order}>
      ${column.by
        ? html`<button type="button" class="plain" onClick=${() => onSort(next)}>${column.title}<span
          aria-hidden="true">${own ? (down ? ' ▼' : ' ▲') : ''}</span></button>`
        : column.title}</th>`;
  });
  const space = (/** @type {any[]} */ left) => left.length > 0
    && html`<tr aria-hidden="true" class="space"><td colspan=${columns.length}
      style=${{ height: `${total(left)}px` }}></td></tr>`;
  const explained = columns.filter((column) => column.meaning).map(({ title, meaning }) =>
    /** @type {[any, string]} */ ([title, meaning]));
  return html`<div class="table" onKeyDown=${walk}>
    <table aria-label=${label} aria-rowcount=${rows.length + 1}>
    <thead><tr aria-rowindex="1">${head}</tr></thead>
    <tbody ref=${body}>
      ${space(rows.slice(0, first))}
      ${rows.slice(first, last).map((row, at) => html`<tr key=${keyOf(row)} data-row
        aria-rowindex=${first + at + 2} class=${rowClass?.(row) ?? ''}>
        ${columns.map((column) => (column.header
          ? html`<th scope="row" class=${column.kind ?? ''}>${column.cell(row)}</th>`
          : html`<td class=${column.kind ?? ''}>${column.cell(row)}</td>`))}</tr>`)}
      ${space(rows.slice(last))}
    </tbody></table></div>
    ${explained.length + meanings.length > 0 && html`<${Meanings} rows=${[...explained, ...meanings]} />`}`;
}
