// Chains of topics and nodes with hostile names. The names stay text, each chain is found by its
// own address, and its path is in the graph. Arguments: address, number of chains, hops of the
// longest chain.

import assert from 'node:assert/strict';
import { scenario, there, until } from './tab.mjs';

const CHAINS = Number(process.argv[3]);
const LONGEST = Number(process.argv[4]);

await scenario(async (open) => {
  const tab = await open({ fragment: '#/chains' });
  await tab.live();
  const rows = tab.page.locator('main tbody tr[data-row]');
  await until(`${CHAINS} chains`, async () => (await rows.count()) === CHAINS);
  await tab.harmless('chains');
  await tab.accessible('chains of hostile names');
  const links = await rows.locator('a').evaluateAll((all) => all.map((each) =>
    [each.getAttribute('href'), each.textContent]));
  assert.equal(new Set(links.map(([href]) => href)).size, CHAINS);
  for (const part of ['<img src=x onerror=', '><script>', '\\u{200f}', '__proto__', 'javascript:']) {
    assert.ok(links.some(([, text]) => text.includes(part)), `a chain with ${part}`);
  }

  for (const [href, text] of links) {
    await tab.page.goto(`${tab.address}${href}`);
    await tab.live();
    const [from] = text.split(' → ').map((end) => end.split('…')[0]);
    await until(`the view of ${text}`, async () =>
      (await tab.page.locator('main h1').textContent()).startsWith(from));
    await there(tab.page.locator('.track .part'));
    await tab.harmless(text);
    await tab.narrow(text);
  }
  // The longest chain shows all its hops, also in the graph.
  await tab.go('#/chains?sort=-hops');
  await until('the longest first', async () =>
    (await rows.first().innerText()).includes(`\t${LONGEST}\t`));
  await rows.first().locator('a').click();
  const scroll = async () => tab.page.mouse.wheel(0, 5000);
  await until('the last hop', async () => {
    await scroll();
    return (await rows.last().innerText()).startsWith('End to end');
  });
  assert.equal(await tab.page.getByRole('table', { name: 'Hops of the chain' })
    .getAttribute('aria-rowcount'), String(LONGEST + 2));
  await tab.accessible('a long chain of hostile names');
  await tab.page.getByRole('link', { name: 'In the graph' }).click();
  // With more than 60 nodes the boxes are closed, and represent their content.
  await tab.page.getByRole('combobox', { name: 'Boxes' }).selectOption('none');
  const passed = tab.page.locator('.vertex.passed');
  await until('its way', async () => (await passed.count()) === 2 * (LONGEST + 1), 60_000);
  assert.equal(await tab.page.locator('.edge.passed').count(), 2 * LONGEST + 1);
  await tab.harmless('the graph');
  await tab.accessible('the graph');
  await passed.nth(3).focus();
  await there(tab.page.locator('#graph-panel').getByRole('button', { name: 'Highlight' }));
  await tab.harmless('the panel');
  await tab.page.locator('#graph-panel').getByRole('link', { name: /^Open the (topic|node)/ }).click();
  await tab.shows('Part of the chain');
  await tab.harmless('a topic or node of a chain');

  const phone = await open({ fragment: '#/chains', width: 360, height: 740 });
  await phone.live();
  await phone.page.locator('main tbody tr[data-row]').first().waitFor();
  await phone.narrow('chains on a phone');
  for (const [href] of links) {
    await phone.page.goto(`${phone.address}${href}`);
    await phone.live();
    await there(phone.page.locator('.track .part'));
    await phone.narrow(href);
  }
});
