import assert from 'node:assert/strict';
import { test } from 'node:test';

/** @type {(() => void)[]} */
const resized = [];
globalThis.ResizeObserver = /** @type {any} */ (class {
  /** @param {() => void} each */
  constructor(each) { resized.push(each); }
  observe() {}
  disconnect() {}
});
const { Camera } = await import('../camera.js');

/** A window of 600 by 400 pixels, at 100 and 50, with a vertex of a drawing in it. */
function opened(/** @type {{x: number, y: number, w: number, h: number}} */ vertex) {
  /** @type {Record<string, (event: any) => void>} */
  const listeners = {};
  let scrolled = 0;
  const view = { left: 100, top: 50, right: 700, bottom: 450, width: 600, height: 400 };
  const place = () => {
    const [left, top] = [view.left + camera.x + vertex.x * camera.scale,
      view.top + camera.y + vertex.y * camera.scale];
    return { left, top, right: left + vertex.w * camera.scale, bottom: top + vertex.h * camera.scale };
  };
  const element = { getBoundingClientRect: place, scrollIntoView: () => { scrolled += 1; } };
  /** @type {any} */
  const svg = { addEventListener: (/** @type {string} */ name, /** @type {any} */ listener) => {
    listeners[name] = listener;
  }, getBoundingClientRect: () => view, querySelector: () => svg.focused, focused: null };
  const camera = new Camera(svg, /** @type {any} */ ({ setAttribute() {} }));
  const focus = () => {
    svg.focused = element;
    listeners.focusin({});
  };
  return { camera, focus, place, view, scrolls: () => scrolled };
}

test('a vertex that keys reach is moved into view, and stays there', () => {
  const { camera, focus, place, view, scrolls } = opened({ x: 2000, y: 900, w: 120, h: 34 });
  const isIn = () => place().left >= view.left && place().right <= view.right
    && place().top >= view.top && place().bottom <= view.bottom;
  assert.ok(!isIn());
  focus();
  assert.ok(isIn());
  assert.equal(scrolls(), 1);
  // The panel of details takes a part of the window, and a larger scale another.
  view.right = 400;
  resized.at(-1)?.();
  assert.ok(isIn());
  for (let step = 0; step < 3; step += 1) camera.key('+');
  assert.ok(camera.scale > 2 && isIn());
});

test('a vertex in view is not moved, and of a large one the begin is shown', () => {
  const small = opened({ x: 20, y: 20, w: 120, h: 34 });
  small.focus();
  assert.deepEqual([small.camera.x, small.camera.y], [0, 0]);
  const large = opened({ x: 5000, y: 20, w: 900, h: 34 });
  large.focus();
  assert.equal(large.place().left, large.view.left + 12);
  assert.equal(large.camera.y, 0);
});
