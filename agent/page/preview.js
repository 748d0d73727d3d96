// Small pictures of messages: images, maps, scans, point clouds and poses.

import { useEffect, useRef, useState } from './vendor/hooks.mjs';
import { count } from './format.js';
import { colour, html } from './ui.js';

/** Width and height of a drawing from above, in pixels. */
const SIDE = 320;
/** Most poses of which the way is drawn. */
const MOST_POSES = 600;

/** Returns the bytes of a text in Base64. @param {string} text */
export function bytesOf(text) {
  return Uint8Array.from(atob(text), (character) => character.charCodeAt(0));
}

/**
 * Returns the coordinates of points. @param {string} xyz little-endian floats in Base64
 * @returns {[number, number, number][]}
 */
export function pointsOf(xyz) {
  const view = new DataView(bytesOf(xyz).buffer);
  return Array.from({ length: Math.floor(view.byteLength / 12) }, (_, at) =>
    /** @type {[number, number, number]} */ ([0, 4, 8].map((place) =>
      view.getFloat32(at * 12 + place, true))));
}

/**
 * Returns how to draw places from above: x is up, y is left, and all of them fit.
 * @param {number[][]} places
 * @returns {{to: (x: number, y: number) => [number, number], metres: number}} `metres` is the width
 */
export function fromAbove(places) {
  let [left, right, low, high] = [Infinity, -Infinity, Infinity, -Infinity];
  for (const [x, y] of places) {
    [left, right, low, high] = [Math.min(left, -y), Math.max(right, -y), Math.min(low, x), Math.max(high, x)];
  }
  if (left > right) [left, right, low, high] = [-1, 1, -1, 1];
  const metres = Math.max(right - left, high - low, 0.1) * 1.1;
  const scale = SIDE / metres;
  const [middle, centre] = [(left + right) / 2, (low + high) / 2];
  return { metres, to: (x, y) => [SIDE / 2 + (-y - middle) * scale, SIDE / 2 - (x - centre) * scale] };
}

/** Formats a width in metres; one beyond a robot's world has an exponent. @param {number} metres */
export function widthOf(metres) {
  return metres < 1e5 ? metres.toFixed(1) : metres.toExponential(1);
}

/** Returns a cleared canvas's context. @param {HTMLCanvasElement} canvas @param {number} width @param {number} height */
function cleared(canvas, width, height) {
  [canvas.width, canvas.height] = [width, height];
  return /** @type {CanvasRenderingContext2D} */ (canvas.getContext('2d'));
}

/** @param {HTMLCanvasElement} canvas @param {any} picture */
function drawPicture(canvas, { width, height, rgb }) {
  if (!width || !height) return;
  const context = cleared(canvas, width, height);
  const image = context.createImageData(width, height);
  const bytes = bytesOf(rgb);
  for (let at = 0; at < width * height; at += 1) {
    image.data.set(bytes.subarray(at * 3, at * 3 + 3), at * 4);
    image.data[at * 4 + 3] = 255;
  }
  context.putImageData(image, 0, 0);
}

/** @param {HTMLCanvasElement} canvas @param {string} data */
async function drawEncoded(canvas, data) {
  const image = await createImageBitmap(new Blob([bytesOf(data)]));
  const scale = Math.min(1, (2 * SIDE) / Math.max(image.width, image.height));
  const [width, height] = [image.width, image.height].map((side) => Math.max(1, Math.round(side * scale)));
  cleared(canvas, width, height).drawImage(image, 0, 0, width, height);
  image.close();
}

/** @param {HTMLCanvasElement} canvas @param {[number, number, number][]} points */
function drawPoints(canvas, points) {
  const context = cleared(canvas, SIDE, SIDE);
  const { to } = fromAbove([...points, [0, 0, 0]]);
  const heights = points.map((point) => point[2]).sort((one, other) => one - other);
  const [least, most] = [heights[Math.floor(heights.length * 0.05)] ?? 0,
    heights[Math.floor(heights.length * 0.95)] ?? 0];
  for (const [x, y, z] of points) {
    const part = most > least ? Math.max(0, Math.min(1, (z - least) / (most - least))) : 0;
    context.fillStyle = `hsl(${220 - 220 * part} 80% 50%)`;
    const [left, top] = to(x, y);
    context.fillRect(left - 1, top - 1, 2, 2);
  }
  drawArrow(context, to(0, 0), 0);
}

/**
 * Draws an arrow for a robot.
 * @param {CanvasRenderingContext2D} context
 * @param {[number, number]} place
 * @param {number} yaw
 */
function drawArrow(context, [left, top], yaw) {
  context.save();
  context.translate(left, top);
  context.rotate(-yaw);
  context.fillStyle = colour('--error');
  context.beginPath();
  context.moveTo(0, -9);
  context.lineTo(5, 6);
  context.lineTo(-5, 6);
  context.fill();
  context.restore();
}

/** @param {HTMLCanvasElement} canvas @param {number[][]} poses */
function drawPoses(canvas, poses) {
  const context = cleared(canvas, SIDE, SIDE);
  const { to } = fromAbove(poses);
  context.strokeStyle = colour('--line-1');
  context.lineWidth = 2;
  context.beginPath();
  for (const [x, y] of poses) context.lineTo(...to(x, y));
  context.stroke();
  const last = poses.at(-1);
  if (last) drawArrow(context, to(last[0], last[1]), last[2]);
}

/**
 * Draws the preview of the newest message, and of single poses the way so far.
 * @param {{preview: any, error: string|undefined}} props
 */
export function Preview({ preview, error }) {
  const canvas = useRef(/** @type {HTMLCanvasElement|null} */ (null));
  const passed = useRef(/** @type {number[][]} */ ([]));
  const points = preview?.points ? pointsOf(preview.points.xyz) : null;
  const poses = preview?.poses;
  const [isBroken, fail] = useState(false);
  useEffect(() => {
    const own = canvas.current;
    if (!own || !preview) return;
    if (preview.picture) drawPicture(own, preview.picture);
    if (preview.encoded) {
      drawEncoded(own, preview.encoded.data).then(() => fail(false), () => fail(true));
    }
    if (points) drawPoints(own, points);
    if (!poses) return;
    if (poses.length === 1) {
      passed.current = [...passed.current, poses[0]].slice(-MOST_POSES);
      drawPoses(own, passed.current);
    } else {
      drawPoses(own, poses);
    }
  }, [preview]);
  if (error) return html`<p class="dim">No preview: ${error}</p>`;
  if (!preview) return null;
  const { picture, encoded } = preview;
  const words = picture ? `${picture.source.join(' × ')} pixels`
    : encoded ? `an image in ${encoded.format}`
      : points ? `${count(points.length)} of ${count(preview.points.total)} points from above, ${
        widthOf(fromAbove([...points, [0, 0, 0]]).metres)} m wide; colours are heights`
        : `${count(poses.length)} ${poses.length === 1 ? 'pose, and the way to it' : 'poses'} from above`;
  return html`<figure class="preview"><canvas ref=${canvas} role="img" aria-label="Preview: ${words}" />
    <figcaption class="dim">${words}${encoded && isBroken
      ? ', which this browser cannot draw' : ''}</figcaption></figure>`;
}
