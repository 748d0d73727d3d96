// Accessibility of every view. axe finds nothing in either theme, no view scrolls sideways at 360
// px and at 400 % zoom, and every control is reached by keys. The second argument selects a test.

import assert from 'node:assert/strict';
import { scenario, until } from './tab.mjs';

/** Fragment of each view, and an element that is present when the view is drawn. */
const VIEWS = [
  ['', '.figures'],
  ['#/topics', 'main tbody tr[data-row]'],
  ['#/topics/%2Fimu?domain=0', '.plot canvas'],
  ['#/graph', '.vertex'],
  ['#/graph?services=1&actions=1&boxes=process', '.vertex.service'],
  ['#/graph?mode=nodes&hubs=1', '.vertex'],
  ['#/chains', 'main .empty, main tbody tr[data-row]'],
  ['#/nodes', 'main tbody tr[data-row]'],
  ['#/nodes/%2Flidar?domain=0', 'main ul.plain'],
  ['#/robot/services', 'main .empty, main tbody tr[data-row]'],
  ['#/events', 'main tbody tr'],
  ['#/recordings', 'form'],
  ['#/agent', 'section[aria-labelledby="limits"] tbody tr'],
  ['#/doctor', '.findings li'],
  ['#/nowhere', 'main p'],
];

/** Opens the details of a view, so that they are checked as well. */
async function unfold(tab) {
  const closed = tab.page.locator('details:not([open]) > summary');
  for (let left = await closed.count(); left > 0; left -= 1) await closed.first().click();
  const definition = tab.page.locator('section[aria-labelledby="definition"] button');
  if (await definition.count()) {
    await definition.click();
    await tab.page.locator('section[aria-labelledby="definition"] pre').waitFor();
    await tab.page.locator('.tree').waitFor();
    await tab.page.locator('.chart').first().getByRole('button', { name: 'Table' }).click();
  }
  // The graph may fold its topics at any time.
  await tab.page.evaluate(() => document.querySelector('.vertex.topic')?.focus());
}

async function dialogs(tab, what) {
  await tab.go('');
  await tab.search('i');
  await until('results', async () => (await tab.page.locator('.results li').count()) > 0);
  await tab.accessible(`${what}: search`);
  await tab.narrow(`${what}: search`);
  await tab.escape();
  await tab.page.keyboard.press('?');
  await tab.page.getByRole('dialog', { name: 'Keys' }).waitFor();
  await tab.accessible(`${what}: keys`);
  await tab.escape();
  await tab.page.evaluate(() => window.dispatchEvent(new CustomEvent('ask-token')));
  await tab.page.getByRole('dialog', { name: 'Token' }).waitFor();
  await tab.accessible(`${what}: token`);
  await tab.narrow(`${what}: token`);
  await tab.escape();
}

/** Moves from the start of the page to the first row of the topics with the Tab key only. */
async function byKeyboard(tab) {
  await tab.go('#/topics');
  await tab.page.locator('main tbody tr[data-row]').first().waitFor();
  await tab.page.keyboard.press('Tab');
  assert.equal(await tab.page.evaluate(() => document.activeElement.textContent), 'Skip to the content');
  await tab.page.keyboard.press('Enter');
  const seen = [];
  for (let step = 0; step < 40; step += 1) {
    await tab.page.keyboard.press('Tab');
    const [tag, inRow, outline] = await tab.page.evaluate(() => [document.activeElement.tagName,
      Boolean(document.activeElement.closest('tr[data-row]')),
      getComputedStyle(document.activeElement).outlineStyle]);
    seen.push(tag);
    assert.notEqual(outline, 'none', `the focus is visible at step ${step}: ${tag}`);
    if (inRow) break;
  }
  const focused = () => tab.page.evaluate(() => document.activeElement.textContent);
  const first = await focused();
  assert.ok(first.startsWith('/'), `${seen}: ${first}`);
  await tab.page.keyboard.press('ArrowDown');
  const second = await until('the next row', async () => {
    const name = await focused();
    return name.startsWith('/') && name !== first && name;
  });
  await tab.page.keyboard.press('Enter');
  await tab.heading(second.trim());
}

async function themes(open) {
  for (const theme of ['light', 'dark']) {
    const tab = await open({ theme });
    await tab.live();
    const paper = await tab.page.evaluate(() => getComputedStyle(document.body.parentElement)
      .backgroundColor);
    const light = paper.match(/\d+/g).every((part) => Number(part) > 128);
    assert.equal(light, theme === 'light', `${theme}: ${paper}`);
    for (const [fragment, ready] of VIEWS) {
      await tab.go(fragment);
      await tab.page.locator(ready).first().waitFor();
      await unfold(tab);
      await tab.accessible(`${theme} ${fragment}`);
    }
    await dialogs(tab, theme);
    await tab.page.close();
  }
  // The chosen theme persists, whatever the system prefers.
  const tab = await open({ theme: 'light' });
  await tab.live();
  await tab.page.getByRole('button', { name: /^Theme: auto/ }).click();
  await tab.page.getByRole('button', { name: /^Theme: light/ }).click();
  await tab.page.reload();
  await tab.live();
  assert.equal(await tab.page.evaluate(() => document.documentElement.dataset.theme), 'dark');
  await tab.accessible('dark by choice');
}

async function small(open, width, height, scale) {
  const tab = await open({ width, height, scale });
  await tab.go('#/topics');
  // The longest state of a topic.
  await tab.page.locator('.badge', { hasText: 'unmatched pub' }).first().waitFor();
  for (const [fragment, ready] of VIEWS) {
    await tab.go(fragment);
    await tab.page.locator(ready).first().waitFor({ state: 'attached' });
    await unfold(tab);
    await tab.narrow(`${width} px ${fragment}`);
    await tab.accessible(`${width} px ${fragment}`);
  }
  await dialogs(tab, `${width} px`);
  await tab.page.close();
}

const HOW = {
  themes,
  phone: (open) => small(open, 360, 740, 3),
  // 1280 px at 400 %, which is 320 px of CSS.
  enlarged: async (open) => {
    await small(open, 320, 256, 4);
    await byKeyboard(await open());
  },
};

await scenario(HOW[process.argv[3]]);
