// A real browser that shows the agent's page. The page must never write to the console, request
// another origin, open a dialog of the browser, or violate a rule of accessibility.
//
// A Rust test (agent/cli/tests/live/browser.rs) starts the agent and the scenario. `ask` sends that
// test a command, such as to restart the agent.

import assert from 'node:assert/strict';
import { existsSync, mkdirSync, readFileSync } from 'node:fs';
import { createRequire } from 'node:module';
import { basename } from 'node:path';
import { createInterface } from 'node:readline';
import { fileURLToPath } from 'node:url';

/** Directory of the packages that .ci/prerequisites.sh installs. */
const TOOLS = fileURLToPath(new URL('../../../../target/tools/page/', import.meta.url));
const FAILURES = fileURLToPath(new URL('../../../../target/page-failures/', import.meta.url));
const CHROMIUM = '/usr/bin/chromium-headless-shell';
/** Maximum wait for an event. Other tests keep the machine busy. */
const PATIENCE_MS = 60_000;

if (!existsSync(`${TOOLS}node_modules/playwright-core`)) {
  console.error('playwright-core is missing: run .ci/prerequisites.sh page');
  process.exit(1);
}
const load = createRequire(`${TOOLS}package.json`);
const { chromium } = load('playwright-core');
const AXE = readFileSync(load.resolve('axe-core/axe.min.js'), 'utf8');

/** Files of this folder replace the agent's own files during work on the page. */
const EDITED = process.env.ROS2PROBE_PAGE_FROM;

/** The address that the Rust test passed. */
export const ADDRESS = process.argv[2] ?? 'http://127.0.0.1:17401/';

/** Starts Debian's browser, or that of playwright-core if the system has no package. */
export function launch() {
  if (!existsSync(CHROMIUM)) process.env.PLAYWRIGHT_BROWSERS_PATH ??= `${TOOLS}browsers`;
  return chromium.launch({
    ...(existsSync(CHROMIUM) ? { executablePath: CHROMIUM } : {}),
    args: ['--no-sandbox', '--disable-gpu', '--disable-dev-shm-usage'],
  });
}

/** Waits until the function returns a true value, and returns that value. */
export async function until(what, holds, patience = PATIENCE_MS) {
  const deadline = Date.now() + patience;
  let last;
  for (;;) {
    try {
      last = await holds();
      if (last) return last;
    } catch (error) {
      last = error;
    }
    if (Date.now() > deadline) throw new Error(`${what}: not within ${patience} ms, last: ${last}`);
    await new Promise((wake) => setTimeout(wake, 100));
  }
}

/** Waits until a part of the page has this text. Parts of a view arrive one after the other. */
export const reads = (locator, pattern) => until(`${locator} reads ${pattern}`, async () => {
  const text = await locator.innerText();
  return pattern instanceof RegExp ? pattern.test(text) : text.includes(pattern);
});

/** Waits until at least one of these elements exists. */
export const there = (locator) => until(`there is ${locator}`, async () => (await locator.count()) > 0);

/** Waits until none of these elements exists. */
export const gone = (locator) => until(`there is no ${locator}`, async () =>
  (await locator.count()) === 0);

/** Answers with the agent's headers and the edited file. */
async function edited(route) {
  const response = await route.fetch();
  const path = new URL(route.request().url()).pathname.replace('/page/', '');
  await route.fulfill({ response, body: readFileSync(`${EDITED}/${path}`) });
}

/** Lets the pages of a context have the edited files, if there are any. */
export async function withEdited(context) {
  if (EDITED) await context.route('**/page/**', edited);
}

let lines = null;

/** Sends a command to the Rust test and returns the answer. */
export async function ask(question) {
  lines ??= createInterface({ input: process.stdin })[Symbol.asyncIterator]();
  process.stdout.write(`@${question}\n`);
  const { done, value } = await lines.next();
  assert.ok(!done, `no answer to "${question}"`);
  return JSON.parse(value);
}

/** Characters that are invisible or reverse text, which the document must not contain. */
const UNSEEN = /[\u0000-\u0008\u000b-\u001f\u007f-\u009f\u00ad\u061c\u200b-\u200f\u2028-\u202e\u2060-\u206f\ufeff\ufff9-\ufffc]/;

/** Returns the parts of the document that violate its rules. */
function looked(pattern) {
  const unseen = new RegExp(pattern);
  const wrong = [];
  for (const each of document.querySelectorAll('body *')) {
    if (/^(script|iframe|img|object|embed|style|base|meta|link|form.+)$/i.test(each.tagName)) {
      wrong.push(`element ${each.outerHTML.slice(0, 200)}`);
    }
    for (const { name, value } of each.attributes) {
      if (/^on/i.test(name)) wrong.push(`attribute ${name} of ${each.tagName}`);
      if (/^(href|src|action|xlink:href)$/i.test(name) && !value.startsWith('#')
        && !value.startsWith('blob:')) wrong.push(`${name}=${value.slice(0, 100)}`);
      // Keys of the page itself are never displayed.
      if (name !== 'data-key' && unseen.test(value)) wrong.push(`unseen in ${name} of ${each.tagName}: ${
        encodeURIComponent(value.slice(0, 60))}`);
    }
  }
  const walk = document.createTreeWalker(document.body, NodeFilter.SHOW_TEXT);
  while (walk.nextNode()) {
    const text = walk.currentNode.textContent;
    if (unseen.test(text)) wrong.push(`unseen text ${encodeURIComponent(text.slice(0, 80))}`);
  }
  if (globalThis.harmed) wrong.push('code of a name ran');
  if (Object.prototype.polluted !== undefined) wrong.push('a prototype was changed');
  return wrong.slice(0, 10);
}

/** What Chromium writes about a request that it ended because the network of the host changed. */
const DROPPED = /^error: Failed to load resource: net::ERR_NETWORK_CHANGED/;

/** One tab, with its messages and requests. */
export class Tab {
  constructor(page, address) {
    this.page = page;
    this.address = address;
    this.origin = new URL(address).origin;
    /** All messages on the console, and all uncaught errors. */
    this.messages = [];
    /** Requests of the tab and of its workers. */
    this.requests = [];
    this.dialogs = [];
    /** Patterns of messages that the browser itself writes about a failed request. */
    this.expected = [];
    page.on('console', (message) => this.messages.push(`${message.type()}: ${message.text()} (${
      message.location().url})`));
    page.on('pageerror', (error) => this.messages.push(`uncaught: ${error.stack}`));
    page.on('dialog', (dialog) => {
      this.dialogs.push(dialog.message());
      dialog.dismiss();
    });
    page.context().on('request', (request) => this.requests.push(request));
  }

  /** Permits messages that match, because the browser writes them and not the page. */
  expect(pattern) {
    this.expected.push(pattern);
  }

  /** Fails if the tab violated a rule. */
  verify() {
    const said = this.messages.filter((each) => !this.expected.some((known) => known.test(each)));
    assert.deepEqual(said, [], 'the console stays empty');
    assert.deepEqual(this.dialogs, [], 'the page opens no dialog of the browser');
    const foreign = this.requests.map((request) => request.url())
      .filter((url) => !url.startsWith(`${this.origin}/`) && !url.startsWith('blob:')
        && !url.startsWith('data:'));
    assert.deepEqual(foreign, [], 'no request leaves the origin');
    assert.ok(this.requests.length > 0);
  }

  /** Opens a view by its address, as a bookmark does. */
  async go(fragment) {
    await this.page.goto('about:blank');
    await this.page.goto(`${this.address}${fragment}`);
    await this.live();
  }

  /**
   * Waits for figures. Chromium ends all requests when the host gets another interface or address, as
   * hosts of tests do. A page that lacks a module for that is loaded again.
   */
  async live() {
    const isDropped = (message) => DROPPED.test(message) && message.includes('/page/');
    const lacksModule = async () => this.messages.some(isDropped)
      && !await this.page.locator('main h1').count();
    await until('figures', async () => {
      if (await lacksModule()) {
        this.messages = this.messages.filter((message) => !isDropped(message));
        await this.page.reload();
      }
      return await this.page.locator('.status', { hasText: /live/ }).count() > 0;
    });
    await this.page.locator('main h1').waitFor();
  }

  heading(name) {
    return this.page.getByRole('heading', { level: 1, name, exact: true }).waitFor();
  }

  /** Presses `g` and a key until a view is open. A busy machine may separate the two keys. */
  jump(key, name) {
    return until(`the view ${name}`, async () => {
      await this.page.keyboard.press('g');
      await this.page.keyboard.press(key);
      const heading = this.page.getByRole('heading', { level: 1, name, exact: true });
      return heading.waitFor({ timeout: 3000 }).then(() => true);
    });
  }

  fragment() {
    return new URL(this.page.url()).hash;
  }

  text(selector = 'main') {
    return this.page.locator(selector).innerText();
  }

  /** Waits until a part of the page shows a text. */
  shows(text, selector = 'main') {
    return until(`${selector} shows ${text}`, async () => {
      const shown = await this.text(selector);
      return text instanceof RegExp ? text.test(shown) : shown.includes(text);
    }).catch(async (error) => {
      throw new Error(`${error.message}\n${await this.text(selector)}`);
    });
  }

  /** Opens the search and types a text. */
  async search(text) {
    await this.page.keyboard.press('/');
    await this.page.getByRole('dialog', { name: 'Search' }).waitFor();
    await until('the focus', () => this.page.evaluate(() => document.activeElement.tagName === 'INPUT'));
    await this.page.keyboard.type(text);
  }

  /** Closes the open dialog. */
  async escape() {
    await this.page.keyboard.press('Escape');
    await gone(this.page.locator('dialog'));
  }

  /** Fails if axe finds violations of WCAG 2.2 A and AA. */
  async accessible(what) {
    await this.page.evaluate(AXE);
    const found = await this.page.evaluate(() => globalThis.axe.run(document, {
      runOnly: ['wcag2a', 'wcag2aa', 'wcag21a', 'wcag21aa', 'wcag22aa', 'best-practice'],
      resultTypes: ['violations'],
    }));
    const words = found.violations.map((each) => `${each.id}: ${each.help}\n${each.nodes.slice(0, 4)
      .map((node) => `    ${node.target.join(' ')}: ${node.html.slice(0, 300)}\n      ${
        node.failureSummary.replaceAll('\n', ' ')}`).join('\n')}`);
    assert.equal(words.length, 0, `${what}:\n${words.join('\n')}`);
  }

  /** Fails if a name from the network is more than text. */
  async harmless(what) {
    assert.deepEqual(await this.page.evaluate(looked, UNSEEN.source), [], what);
  }

  /** Fails if an edge of the graph is not drawn. Returns the number of edges by their style. */
  async inked() {
    const edges = await this.page.locator('.edge').evaluateAll((all) => all.map((edge) => {
      const line = edge.querySelector('.line');
      const [own, drawn] = [getComputedStyle(edge), getComputedStyle(line)];
      const isSeen = own.clipPath === 'none' && own.display !== 'none' && own.visibility === 'visible'
        && drawn.stroke !== 'none' && Number(drawn.strokeOpacity) > 0.3
        && parseFloat(drawn.strokeWidth) > 0 && line.getTotalLength() > 5;
      return [edge.getAttribute('class').split(' ')[1], isSeen];
    }));
    assert.deepEqual(edges.filter(([, isSeen]) => !isSeen), [], 'edges without ink');
    return edges.reduce((sum, [style]) => ({ ...sum, [style]: (sum[style] ?? 0) + 1 }), {});
  }

  /** Fails if a text of the graph has less than 11 pixels, or none is in the window. Returns the smallest size. */
  async legible(what) {
    const sizes = await this.page.locator('.canvas text').evaluateAll((all) => all.map((text) => {
      const { left, right, top, bottom } = text.getBoundingClientRect();
      const canvas = text.closest('.canvas').getBoundingClientRect();
      const isIn = right > canvas.left && left < canvas.right && bottom > canvas.top && top < canvas.bottom;
      return [parseFloat(getComputedStyle(text).fontSize) * text.getScreenCTM().a, isIn, text.textContent];
    }));
    assert.ok(sizes.some(([, isIn]) => isIn), `${what}: no text is in the window`);
    // The size is stored with four digits.
    assert.deepEqual(sizes.filter(([size]) => size < 10.99), [], `${what}: text below 11 pixels`);
    return Math.min(...sizes.map(([size]) => size));
  }

  /** Waits until the picture of the graph stays as it is. */
  async drawn() {
    let before = null;
    await until('a picture that stays', async () => {
      const now = await this.page.locator('.canvas svg').evaluate((svg) => `${svg.querySelector('g').getAttribute(
        'transform')} ${[...svg.querySelectorAll('.vertex rect')].map((rect) => rect.getAttribute('x'))}`);
      const isSame = now === before && now.length > 40;
      before = now;
      await new Promise((wake) => setTimeout(wake, 700));
      return isSame;
    });
  }

  /** Fails if the page scrolls sideways, with the names of elements that are too wide. */
  async narrow(what) {
    const wide = await this.page.evaluate(() => {
      const { scrollWidth, clientWidth } = document.documentElement;
      if (scrollWidth <= clientWidth) return null;
      const names = [];
      for (const each of document.querySelectorAll('body *')) {
        const { right } = each.getBoundingClientRect();
        if (right > clientWidth + 0.5 && !each.closest('.scroll, .canvas, pre, .plot')) {
          names.push(`${each.tagName}.${each.getAttribute('class')} to ${right.toFixed(0)}: ${
            each.textContent.slice(0, 40)}`);
        }
      }
      return `${scrollWidth} of ${clientWidth}: ${names.slice(0, 8).join('; ')}`;
    });
    assert.equal(wide, null, `${what} scrolls sideways`);
  }
}

/**
 * Runs a scenario in a separate browser and ends the process, with code 0 on success.
 * @param {(open: (options?: object) => Promise<Tab>, browser: any) => Promise<void>} story
 */
export async function scenario(story) {
  const browser = await launch();
  const tabs = [];
  const open = async ({ address = ADDRESS, context, theme = 'light', width = 1280, height = 800,
    scale = 1, fragment = '', init } = {}) => {
    const own = context ?? await browser.newContext({
      colorScheme: theme, viewport: { width, height }, deviceScaleFactor: scale,
      acceptDownloads: true, reducedMotion: 'reduce',
    });
    own.setDefaultTimeout(PATIENCE_MS);
    await withEdited(own);
    const page = await own.newPage();
    const tab = new Tab(page, address);
    tabs.push(tab);
    if (init) await page.addInitScript(init);
    await page.goto(`${address}${fragment}`);
    return tab;
  };
  let code = 0;
  try {
    await story(open, browser);
    for (const tab of tabs) tab.verify();
  } catch (error) {
    code = 1;
    console.error(error.stack ?? error);
    mkdirSync(FAILURES, { recursive: true });
    for (const [at, tab] of tabs.entries()) {
      for (const message of tab.messages) console.error(`console of tab ${at}: ${message}`);
      const file = `${FAILURES}${basename(process.argv[1], '.mjs')}-${at}.png`;
      await tab.page.screenshot({ path: file, timeout: 5000 })
        .then(() => console.error(`tab ${at} at ${tab.page.url()}: ${file}`), () => {});
    }
  }
  await browser.close();
  process.exit(code);
}
