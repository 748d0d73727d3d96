// 500 topics with hostile names: markup, quotes, marks that reverse text, 256 bytes of junk. The
// names stay text, every topic is listed and found by its own address, and the page stays usable.
// Arguments: address, number of topics.

import assert from 'node:assert/strict';
import { scenario, until } from './tab.mjs';

const TOPICS = Number(process.argv[3]);
await scenario(async (open) => {
  // Names that begin with an underscore are hidden at first.
  const tab = await open({ fragment: '#/topics?hidden=1' });
  await tab.live();
  const harmless = (what) => tab.harmless(what);
  await tab.page.locator('main tbody tr[data-row]').first().waitFor();
  await harmless('topics');

  // All topics are found by scrolling, though only a few are in the document at the same time.
  const links = new Map();
  let most = 0;
  await until('every topic', async () => {
    const rows = await tab.page.locator('main tbody tr[data-row]').evaluateAll((all) => all.map(
      (row) => [row.querySelector('a')?.getAttribute('href'), row.querySelector('a')?.textContent]));
    most = Math.max(most, rows.length);
    for (const [href, text] of rows) links.set(href, text);
    await tab.page.mouse.wheel(0, 700);
    return links.size >= TOPICS;
  }, 60_000);
  assert.equal(links.size, TOPICS);
  assert.ok(most < 120, `${most} rows in the document`);
  await harmless('topics at the end');
  const texts = [...links.values()];
  assert.equal(new Set(texts).size, TOPICS, 'no two names look alike');
  for (const part of ['<img src=x onerror=', '><script>', '\\u{200f}', '__proto__', 'javascript:',
    '\\u{200b}', '&quot; onmouseover=', '&lt;b&gt;', '\\u{61c}']) {
    assert.ok(texts.some((text) => text.includes(part)), `a name with ${part}`);
  }
  assert.ok(!texts.some((text) => text.includes('refused')), 'the agent takes no quotes and controls');
  await tab.page.evaluate(() => scrollTo(0, 0));
  await tab.narrow('topics');

  // One topic of each kind is opened by its link. The address leads to exactly that topic.
  const kinds = [...links].slice(0, 40);
  for (const [href, text] of kinds) {
    await tab.page.goto(`${tab.address}${href}`);
    await tab.live();
    // A long name is shortened in the middle in the table, and complete in the heading.
    const [begin, end] = text.split('…');
    await until(`the view of ${text}`, async () => {
      const heading = await tab.page.locator('main h1').textContent();
      return end == null ? heading === text : heading.startsWith(begin) && heading.endsWith(end);
    });
    await until('details', async () => (await tab.page.locator('section[aria-labelledby="qos"]').count()) > 0);
    await harmless(text);
  }
  await tab.accessible('a topic of a hostile name');

  await tab.go('#/');
  await harmless('overview');
  await tab.go('#/nodes?hidden=1');
  await tab.page.locator('main tbody tr[data-row]').first().waitFor();
  await harmless('nodes');
  await tab.accessible('nodes of hostile names');
  const node = tab.page.locator('main tbody tr[data-row] a').first();
  const nodeName = await node.textContent();
  await node.click();
  await until('the view of the node', async () =>
    (await tab.page.locator('main h1').textContent()) === nodeName);
  await tab.shows('Publishers (');
  await harmless('a node');
  await tab.go('#/events');
  await tab.page.locator('main tbody tr').first().waitFor();
  await harmless('events');

  // The worker computes the layout of the graph of all topics while the page stays responsive.
  await tab.go('#/graph?boxes=none&hidden=1&fold=none');
  await until('the layout', async () => /laid out in \d+ ms/.test(await tab.text()), 60_000);
  await harmless('graph');
  const shown = await tab.page.locator('.vertex').count();
  assert.ok(shown >= TOPICS, `${shown} vertices`);
  const words = /laid out in (\d+) ms/.exec(await tab.text());
  console.log(`${shown} vertices: ${words[0]}`);
  await tab.search('<img');
  await until('results', async () => (await tab.page.locator('.results li').count()) > 1);
  await harmless('search');
  await tab.escape();
  // Topics between two nodes are words of an edge.
  await tab.go('#/graph?boxes=none&hidden=1&mode=nodes');
  const folded = tab.page.locator('.edge title', { hasText: '/s' });
  await until('names at an edge', async () => (await folded.count()) > 0, 60_000);
  await harmless('a graph of nodes');

  const phone = await open({ fragment: '#/topics', width: 360, height: 740 });
  await phone.live();
  await phone.page.locator('main tbody tr[data-row]').first().waitFor();
  await phone.narrow('topics of hostile names on a phone');
  for (const [href] of kinds.slice(0, 12)) {
    await phone.page.goto(`${phone.address}${href}`);
    await phone.live();
    await phone.page.locator('section[aria-labelledby="qos"]').waitFor();
    await phone.narrow(href);
  }
});
