// Measures the page: first useful paint with 500 topics, layout of large graphs in the worker, frames
// while the graph is moved, and memory of a tab. Prints the figures, and fails if one exceeds its
// budget. The cost of tabs for the agent: make bench BENCH_OPTIONS="--only tabs".
// MEASURE_MINUTES is the duration of the measurement of memory (default: 2).

import assert from 'node:assert/strict';
import { robot } from '../../../page/test/robot.js';
import { ADDRESS, scenario, until } from './tab.mjs';

const MINUTES = Number(process.env.MEASURE_MINUTES ?? 2);
const PAINT_MS = 1000;
/** Budgets of layouts: nodes, topics, milliseconds. */
const LAYOUTS = [[100, 300, 1000], [200, 600, 3000]];
/** Maximum growth of a tab's memory over the second half of its time, in bytes. */
const GROWTH_BYTES = 3_000_000;

const sleep = (ms) => new Promise((wake) => setTimeout(wake, ms));
const median = (all) => all.toSorted((one, other) => one - other)[Math.floor(all.length / 2)];

/** Stores the time at which the first row of a table, or the first figure, is painted. */
function mark() {
  const seen = () => {
    if (globalThis.usefulAt || !document.querySelector('main tbody tr[data-row], main .figures')) return;
    // The element is painted with the next frame.
    requestAnimationFrame(() => setTimeout(() => { globalThis.usefulAt ??= performance.now(); }));
  };
  new MutationObserver(seen).observe(document, { childList: true, subtree: true });
}

async function paint(browser) {
  for (const [view, fragment] of [['overview', ''], ['topics', '#/topics']]) {
    const times = [];
    for (let run = 0; run < 5; run += 1) {
      const context = await browser.newContext({ viewport: { width: 1280, height: 800 } });
      const page = await context.newPage();
      await page.addInitScript(mark);
      await page.goto(`${ADDRESS}${fragment}`);
      times.push(await until('a useful page', () => page.evaluate(() => globalThis.usefulAt)));
      await context.close();
    }
    console.log(`first useful paint, ${view} with 500 topics: ${median(times).toFixed(0)} ms (${times
      .map((time) => time.toFixed(0)).join(', ')})`);
    assert.ok(median(times) < PAINT_MS, `${view}: ${times}`);
  }
}

async function layouts(open) {
  const tab = await open();
  await tab.live();
  for (const [nodes, topics, budget] of LAYOUTS) {
    const { vertices, edges } = robot(nodes, topics);
    const times = [];
    for (let run = 0; run < 3; run += 1) {
      times.push(await tab.page.evaluate(([own, joined]) => new Promise((take, fail) => {
        const worker = new Worker(new URL('page/layout-worker.js', document.baseURI), { type: 'module' });
        worker.onerror = () => fail(new Error('the worker failed'));
        worker.onmessage = ({ data }) => {
          worker.terminate();
          take(data.milliseconds);
        };
        worker.postMessage({ number: 1, vertices: own, edges: joined, options: {} });
      }), [vertices, edges]));
    }
    console.log(`layout of ${nodes} nodes and ${topics} topics in the worker: ${
      median(times).toFixed(0)} ms (${times.map((time) => time.toFixed(0)).join(', ')})`);
    assert.ok(median(times) < budget, `${nodes}/${topics}: ${times}`);
  }
  await tab.page.close();
}

/** Moves the graph to and fro with the pointer, and measures the time between two frames. */
async function panning(open) {
  const tab = await open({ fragment: '#/graph?fold=none' });
  await tab.live();
  const vertices = tab.page.locator('.vertex');
  await until('the whole graph', async () => (await vertices.count()) > 500);
  await sleep(2000);
  const gaps = await tab.page.evaluate((seconds) => new Promise((take) => {
    const svg = document.querySelector('.vertex').closest('svg');
    const { left, top, width, height } = svg.getBoundingClientRect();
    const at = (kind, offset) => svg.dispatchEvent(new PointerEvent(kind, {
      pointerId: 1, button: 0, bubbles: true, clientX: left + width / 2 + offset,
      clientY: top + height / 2 + offset / 3,
    }));
    // The browser has no pointer of this number, and refuses to capture it.
    svg.setPointerCapture = () => {};
    at('pointerdown', 0);
    const began = performance.now();
    const times = [];
    const next = (now) => {
      times.push(now);
      at('pointermove', 200 * Math.sin((now - began) / 300));
      if (now - began < seconds * 1000) requestAnimationFrame(next);
      else take(times.slice(1).map((time, place) => time - times[place]));
    };
    requestAnimationFrame(next);
  }), 5);
  const sorted = gaps.toSorted((one, other) => one - other);
  const per = (share) => sorted[Math.floor(share * (sorted.length - 1))].toFixed(1);
  console.log(`frames while ${await vertices.count()} nodes and topics with ${await tab.page
    .locator('.edge').count()} edges move: ${(1000 * gaps.length / gaps.reduce((sum, gap) => sum
    + gap, 0)).toFixed(0)} a second, median ${per(0.5)} ms, 95 % within ${per(0.95)} ms`);
  await tab.page.close();
}

async function memory(open) {
  const tab = await open({ fragment: '#/topics' });
  await tab.live();
  const session = await tab.page.context().newCDPSession(tab.page);
  await session.send('Performance.enable');
  const heap = async () => {
    await session.send('HeapProfiler.collectGarbage');
    const { metrics } = await session.send('Performance.getMetrics');
    return metrics.find(({ name }) => name === 'JSHeapUsedSize').value;
  };
  const samples = [];
  const steps = 12;
  // The history of the page covers at most 10 min, and is filled in the first of them.
  for (let step = 0; step <= steps; step += 1) {
    samples.push(await heap());
    // Every view is opened and left, as by a user.
    for (const view of ['#/', '#/graph', '#/nodes', '#/events', '#/topics']) {
      await tab.page.evaluate((to) => { location.hash = to; }, view);
      await sleep(300);
    }
    await sleep(Math.max(0, (MINUTES * 60_000) / steps - 1500));
  }
  const megabytes = samples.map((each) => (each / 1e6).toFixed(1));
  console.log(`heap of a tab over ${MINUTES} min with 500 topics: ${megabytes.join(', ')} MB`);
  const half = samples.slice(samples.length / 2);
  const grown = median(half.slice(-3)) - median(half.slice(0, 3));
  console.log(`grown in the second half: ${(grown / 1e6).toFixed(2)} MB`);
  assert.ok(grown < GROWTH_BYTES, `${megabytes}`);
  await tab.page.close();
}

await scenario(async (open, browser) => {
  await paint(browser);
  await layouts(open);
  await panning(open);
  await memory(open);
});
