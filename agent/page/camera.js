// Pan and zoom of a drawing: wheel, drag, two fingers, keys. Neither redraws anything.

const LEAST = 0.05;
const MOST = 4;
/** Least distance between a vertex that was moved into view and the border, in pixels. */
const MARGIN = 12;
/** Smallest scale at which names are legible: 11 of the 12 pixels of their font. */
export const LEGIBLE = 11 / 12;

export class Camera {
  /** @param {SVGSVGElement} svg @param {SVGGElement} stage */
  constructor(svg, stage) {
    this.svg = svg;
    this.stage = stage;
    this.x = 0;
    this.y = 0;
    this.scale = 1;
    this.size = { width: 0, height: 0 };
    this.fitted = true;
    /** Whether the last press moved the drawing and so is not a click. */
    this.moved = false;
    /** @type {Map<number, {x: number, y: number}>} */ this.pointers = new Map();
    const on = (/** @type {string} */ name, /** @type {(event: any) => void} */ listener) =>
      svg.addEventListener(name, listener, { passive: false });
    on('wheel', (event) => this.wheel(event));
    on('pointerdown', (event) => this.down(event));
    on('pointermove', (event) => this.move(event));
    on('pointerup', (event) => this.up(event));
    on('pointercancel', (event) => this.up(event));
    on('focusin', () => this.follow()?.scrollIntoView({ block: 'nearest', inline: 'nearest' }));
    this.watch = new ResizeObserver(() => {
      if (this.fitted && this.size.width) this.fit();
      this.follow();
    });
    this.watch.observe(svg);
  }

  end() {
    this.watch.disconnect();
  }

  /** Lets the next drawing be shown like the first one. */
  renew() {
    this.size = { width: 0, height: 0 };
    this.fitted = true;
  }

  /**
   * Sets the size of the drawing; a fitted view stays fitted. Of a first drawing that would be
   * illegible as a whole, it shows the part around a place. Returns whether the whole is legible.
   * @param {number} width
   * @param {number} height
   * @param {{x: number, y: number}} [place]
   * @returns {boolean}
   */
  frame(width, height, place) {
    const first = this.size.width === 0;
    this.size = { width: Math.max(1, width), height: Math.max(1, height) };
    const legible = this.fitting() >= LEGIBLE;
    if (this.fitted) this.fit();
    if (first && !legible) this.begin(place);
    return legible;
  }

  /** Shows a legible part: the one around a place, or the left one. @param {{x: number, y: number}} [place] */
  begin(place) {
    const view = this.view();
    const { width, height } = this.size;
    this.scale = LEGIBLE;
    const start = (/** @type {number} */ room, /** @type {number} */ all, /** @type {number} */ at) =>
      (all * LEGIBLE <= room - 24 ? (room - all * LEGIBLE) / 2
        : Math.min(12, Math.max(room - 12 - all * LEGIBLE, room / 2 - at * LEGIBLE)));
    this.x = start(view.width, width, place?.x ?? 0);
    this.y = start(view.height, height, place?.y ?? height / 2);
    this.fitted = false;
    this.apply();
  }

  /** Returns the scale at which the whole drawing is visible. */
  fitting() {
    const { width, height } = this.view();
    const margin = 16;
    return Math.min((width - 2 * margin) / this.size.width,
      (height - 2 * margin) / this.size.height, 1.2);
  }

  fit() {
    const { width, height } = this.view();
    this.scale = Math.max(LEAST, this.fitting());
    this.x = (width - this.size.width * this.scale) / 2;
    this.y = (height - this.size.height * this.scale) / 2;
    this.fitted = true;
    this.apply();
  }

  view() {
    const { width, height } = this.svg.getBoundingClientRect();
    return { width: width || 600, height: height || 400 };
  }

  apply() {
    this.stage.setAttribute('transform',
      `translate(${this.x.toFixed(1)} ${this.y.toFixed(1)}) scale(${this.scale.toFixed(4)})`);
  }

  /** Zooms about a point of the view. @param {number} by @param {number} x @param {number} y */
  zoom(by, x, y) {
    const scale = Math.max(LEAST, Math.min(MOST, this.scale * by));
    this.x = x - ((x - this.x) * scale) / this.scale;
    this.y = y - ((y - this.y) * scale) / this.scale;
    this.scale = scale;
    this.fitted = false;
    this.apply();
  }

  /** Keeps the vertex with the keyboard's focus in view. Returns it. @returns {Element|null} */
  follow() {
    const focused = this.svg.querySelector(':focus-visible');
    if (focused) this.show(focused);
    return focused;
  }

  /** Moves the view to a vertex if a part of it is outside. @param {Element} vertex */
  show(vertex) {
    const [view, own] = [this.svg, vertex].map((each) => each.getBoundingClientRect());
    const shift = (/** @type {'left'|'top'} */ from, /** @type {'right'|'bottom'} */ to) => {
      if (own[from] >= view[from] && own[to] <= view[to]) return 0;
      const toMiddle = (view[from] + view[to] - own[from] - own[to]) / 2;
      // Of a vertex that is larger than the view, its begin is shown.
      return Math.max(toMiddle, view[from] + MARGIN - own[from]);
    };
    const [x, y] = [shift('left', 'right'), shift('top', 'bottom')];
    if (!x && !y) return;
    this.x += x;
    this.y += y;
    this.fitted = false;
    this.apply();
  }

  /**
   * Shows a part of the drawing as a whole, or its first place if it would be illegible.
   * @param {{x: number, y: number, w: number, h: number}[]} places centres and sizes, in order
   */
  part(places) {
    const [first] = places;
    if (!first) return;
    const [left, right] = [Math.min(...places.map(({ x, w }) => x - w / 2)),
      Math.max(...places.map(({ x, w }) => x + w / 2))];
    const [top, bottom] = [Math.min(...places.map(({ y, h }) => y - h / 2)),
      Math.max(...places.map(({ y, h }) => y + h / 2))];
    const { width, height } = this.view();
    const scale = Math.min((width - 32) / (right - left), (height - 32) / (bottom - top), 1.2);
    this.scale = Math.max(LEGIBLE, scale);
    const isWhole = scale >= LEGIBLE;
    this.x = isWhole ? width / 2 - ((left + right) / 2) * this.scale
      : 16 - (first.x - first.w / 2) * this.scale;
    this.y = height / 2 - (isWhole ? (top + bottom) / 2 : first.y) * this.scale;
    this.fitted = false;
    this.apply();
  }

  /** Handles a key; returns whether it has a function here. @param {string} key */
  key(key) {
    const { width, height } = this.view();
    if (key === '+' || key === '=') this.zoom(1.3, width / 2, height / 2);
    else if (key === '-' || key === '−') this.zoom(1 / 1.3, width / 2, height / 2);
    else if (key === '0') this.fit();
    else return false;
    this.follow();
    return true;
  }

  /** @param {WheelEvent} event */
  wheel(event) {
    event.preventDefault();
    const { left, top } = this.svg.getBoundingClientRect();
    this.zoom(Math.exp(-event.deltaY * 0.0015), event.clientX - left, event.clientY - top);
  }

  /** @param {PointerEvent} event */
  down(event) {
    if (event.button !== 0) return;
    this.moved = false;
    this.pointers.set(event.pointerId, { x: event.clientX, y: event.clientY });
  }

  /** @param {PointerEvent} event */
  move(event) {
    const before = this.pointers.get(event.pointerId);
    if (!before) return;
    const now = { x: event.clientX, y: event.clientY };
    const distance = Math.hypot(now.x - before.x, now.y - before.y);
    if (!this.moved && distance < 4) return;
    if (!this.moved) {
      this.moved = true;
      this.svg.setPointerCapture(event.pointerId);
    }
    const others = [...this.pointers].filter(([id]) => id !== event.pointerId);
    if (others.length === 1) {
      const [, other] = others[0];
      const [was, is] = [before, now].map((each) => Math.hypot(each.x - other.x, each.y - other.y));
      const { left, top } = this.svg.getBoundingClientRect();
      if (was > 0) this.zoom(is / was, (now.x + other.x) / 2 - left, (now.y + other.y) / 2 - top);
    } else {
      this.x += now.x - before.x;
      this.y += now.y - before.y;
      this.fitted = false;
      this.apply();
    }
    this.pointers.set(event.pointerId, now);
  }

  /** @param {PointerEvent} event */
  up(event) {
    this.pointers.delete(event.pointerId);
    // The click event that follows still sees `moved`.
    setTimeout(() => { if (!this.pointers.size) this.moved = false; }, 0);
  }
}
