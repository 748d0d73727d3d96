// Takes the screenshots of the documentation from the demo: `make screenshots`. Arguments: the
// program of the demo or the address of a running page, the directory of the pictures, and names of
// pictures (default: those of the documentation). The picture that moves is `graph.webp`. The name
// `all` takes every view as a whole at four sizes in both themes, for review.

import { execFileSync, spawn } from 'node:child_process';
import { mkdirSync, mkdtempSync, rmSync, statSync } from 'node:fs';
import { tmpdir } from 'node:os';
import { join } from 'node:path';
import { createInterface } from 'node:readline';
import { launch, Tab, until, withEdited } from './tab.mjs';

const [, , PROGRAM, DIRECTORY, ...WANTED] = process.argv;
/** Seconds before the pictures are taken, so that charts have enough points. */
const WAIT_S = Number(process.env.SCREENSHOT_WAIT_S ?? 75);

/** Name, fragment, theme, width, height, and an element that is present when the view is drawn. */
const PICTURES = [
  ['overview', '#/', 'light', 1280, 860, '.figures'],
  ['overview-dark', '#/', 'dark', 1280, 860, '.figures'],
  ['overview-phone', '#/', 'light', 390, 844, '.figures'],
  ['topics', '#/topics', 'light', 1280, 700, 'main tbody tr[data-row]'],
  ['topics-phone', '#/topics', 'dark', 390, 844, 'main tbody tr[data-row]'],
  ['topic', '#/topics/%2Fpoints?domain=0', 'light', 1200, 960, '.plot canvas'],
  ['topic-dark', '#/topics/%2Fpoints?domain=0', 'dark', 1200, 960, '.plot canvas'],
  ['topic-phone', '#/topics/%2Fpoints?domain=0', 'light', 390, 844, '.plot canvas'],
  ['graph', '#/graph', 'light', 1280, 640, '.vertex'],
  ['graph-dark', '#/graph', 'dark', 1280, 760, '.vertex'],
  ['graph-phone', '#/graph', 'light', 390, 844, '.vertex'],
  ['graph-processes', '#/graph?boxes=process&services=1', 'light', 1280, 760, '.vertex.service'],
  ['nodes', '#/nodes', 'light', 1280, 500, 'main tbody tr[data-row]'],
  ['node', '#/nodes/%2Flidar', 'light', 1280, 800, 'main ul.plain'],
  ['events', '#/events', 'light', 1280, 700, 'main tbody tr'],
  ['recordings', '#/recordings', 'light', 1280, 600, 'main form, main p'],
  ['agent', '#/agent', 'light', 1280, 900, 'section[aria-labelledby="limits"]'],
];

/** Every view with an element that is present when it is drawn. */
const VIEWS = [
  ['overview', '#/', '.figures'], ['topics', '#/topics', 'main tbody tr[data-row]'],
  ['topic', '#/topics/%2Fpoints?domain=0', '.plot canvas'],
  ['graph', '#/graph', '.vertex'], ['graph-nodes', '#/graph?mode=nodes&tint=process', '.vertex'],
  ['graph-boxes', '#/graph?boxes=process&services=1&fold=none', '.vertex.service'],
  ['graph-chosen', '#/graph?focus=topic%3A0%3A%2Fpoints&tint=rate', '#graph-panel'],
  ['chains', '#/chains', 'main p'], ['nodes', '#/nodes', 'main tbody tr[data-row]'],
  ['node', '#/nodes/%2Flidar', 'main ul.plain'],
  ...['logs', 'diagnostics', 'transforms', 'parameters', 'services', 'clocks'].map((part) =>
    [`robot-${part}`, `#/robot/${part}`, 'main p, main tr']),
  ['events', '#/events', 'main tbody tr'], ['recordings', '#/recordings', 'main form, main p'],
  ['agent', '#/agent', 'section[aria-labelledby="limits"]'], ['doctor', '#/doctor', '.findings li'],
];
/** A phone, a tablet, a laptop and a wide screen. */
const SIZES = [['phone', 390, 844], ['tablet', 768, 1024], ['laptop', 1280, 800], ['wide', 1920, 1080]];

/** Milliseconds for which a step of the picture that moves is shown. */
const STEP_MS = 2500;
/** Its steps, each of which changes the page of the one before. */
const STEPS = [
  async () => {},
  (page) => page.locator('.vertex', { hasText: '/points' }).click(),
  (page) => page.getByRole('button', { name: /^Focus/ }).click(),
  (page) => page.evaluate(() => { location.hash = '#/graph?boxes=process'; }),
  (page) => page.getByLabel('Colour').selectOption({ label: 'process' }),
];

/** Opens a view in a new tab, and returns the tab once the view is drawn. */
async function view([name, fragment, theme, width, height, ready]) {
  const context = await browser.newContext({
    colorScheme: theme, viewport: { width, height }, deviceScaleFactor: 1, reducedMotion: 'reduce',
  });
  await withEdited(context);
  const page = await context.newPage();
  const tab = new Tab(page, address);
  await page.goto(`${address}${fragment}`);
  await tab.live();
  await until(`${name}: ${ready}`, async () => (await page.locator(ready).count()) > 0);
  await new Promise((wake) => setTimeout(wake, 2500));
  return tab;
}

/** Takes a picture of each step, and joins them. */
async function animate(file) {
  const frames = mkdtempSync(join(tmpdir(), 'frames-'));
  const tab = await view(['animation', '#/graph', 'light', 1280, 640, '.vertex']);
  try {
    const options = [];
    for (const [at, step] of STEPS.entries()) {
      const frame = join(frames, `${at}.png`);
      await step(tab.page);
      await new Promise((wake) => setTimeout(wake, 2500));
      await tab.page.screenshot({ path: frame });
      options.push('-lossless', '-d', String(STEP_MS), frame);
    }
    execFileSync('img2webp', ['-loop', '0', ...options, '-o', file], { stdio: 'pipe' });
    tab.verify();
  } finally {
    rmSync(frames, { recursive: true });
    await tab.page.context().close();
  }
}

/** Takes every view at each size in both themes, and fails if a page scrolls sideways. */
async function takeAll() {
  for (const [size, width, height] of SIZES) {
    for (const theme of ['light', 'dark']) {
      const tab = await view([size, '#/', theme, width, height, '.figures']);
      for (const [name, fragment, ready] of VIEWS) {
        await tab.go(fragment);
        await until(`${name}: ${ready}`, async () => (await tab.page.locator(ready).count()) > 0);
        await new Promise((wake) => setTimeout(wake, 1200));
        await tab.narrow(`${name} at ${width} px`);
        await tab.page.screenshot({ path: `${DIRECTORY}/${name}-${size}-${theme}.png`, fullPage: true });
      }
      console.log(`${DIRECTORY}: ${VIEWS.length} views, ${size}, ${theme}`);
      tab.verify();
      await tab.page.context().close();
    }
  }
}

const isRunning = /^http:/.test(PROGRAM);
const demo = isRunning ? null : spawn(PROGRAM, [], { stdio: ['ignore', 'pipe', 'inherit'] });
const lines = demo && createInterface({ input: demo.stdout });
const address = isRunning ? PROGRAM : await new Promise((take, fail) => {
  lines.on('line', (line) => {
    const found = /(http:\/\/[^\s]+\/)\s*$/.exec(line);
    if (/page/.test(line) && found) take(found[1]);
  });
  demo.on('exit', (code) => fail(new Error(`the demo ended with ${code}`)));
});
console.log(`the demo's page: ${address}`);
const browser = await launch();
try {
  mkdirSync(DIRECTORY, { recursive: true });
  if (!isRunning) await new Promise((wake) => setTimeout(wake, WAIT_S * 1000));
  if (WANTED.includes('all')) await takeAll();
  for (const [name, fragment, theme, width, height, ready] of PICTURES) {
    if (WANTED.length && !WANTED.includes(name)) continue;
    const tab = await view([name, fragment, theme, width, height, ready]);
    const file = `${DIRECTORY}/${name}.png`;
    await tab.page.screenshot({ path: file });
    console.log(`${file}: ${Math.ceil(statSync(file).size / 1000)} kB`);
    tab.verify();
    await tab.page.context().close();
  }
  if (!WANTED.length || WANTED.includes('graph.webp')) {
    const file = `${DIRECTORY}/graph.webp`;
    await animate(file);
    console.log(`${file}: ${Math.ceil(statSync(file).size / 1000)} kB`);
  }
} finally {
  await browser.close();
  if (demo) {
    demo.removeAllListeners('exit');
    const ended = new Promise((take) => { demo.on('exit', take); });
    demo.kill('SIGTERM');
    await ended;
  }
}
