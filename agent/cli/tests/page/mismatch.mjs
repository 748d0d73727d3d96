// A best-effort publisher and a reliable subscriber: the finding is the first, and has a link to
// the two endpoints with the incompatible policy.

import assert from 'node:assert/strict';
import { reads, scenario, there, until } from './tab.mjs';

await scenario(async (open) => {
  const tab = await open();
  await tab.live();
  const first = tab.page.locator('.findings li').first();
  await first.waitFor();
  assert.equal(await first.getAttribute('class'), 'error');
  await reads(first, /reliab/i);
  await reads(first, /Remedy: /);
  await tab.shows(/Overview\s+✖\s*error\s*1/, 'nav');
  await first.getByRole('link').click();
  const qos = tab.page.locator('section[aria-labelledby="qos"]');
  await qos.waitFor();
  await reads(qos, /offers less than .* requests: reliability/);
  await until('the section in the window', () => qos.evaluate((section) =>
    section.hasAttribute('data-revealed') && section.getBoundingClientRect().top < innerHeight && scrollY > 0));
  const row = qos.locator('tr', { hasText: 'Reliability' });
  const cells = await row.locator('td').evaluateAll((all) => all.map((cell) =>
    [cell.className, cell.textContent.replace(/^✖error/, '').trim()]));
  const bad = cells.filter(([kind]) => kind === 'bad').map(([, text]) => text);
  assert.ok(bad.some((text) => /BEST_EFFORT/.test(text)) && bad.some((text) => /✖?.*RELIABLE/.test(text)),
    JSON.stringify(cells));
  const durability = await qos.locator('tr', { hasText: 'Durability' }).locator('td.bad').count();
  assert.equal(durability, 0, 'only the policy that does not fit');
  await tab.accessible('a mismatch');

  // The topic has the badge, the graph has the mark, and the node has the finding.
  await tab.go('#/topics?sort=state');
  await reads(tab.page.locator('main tbody tr[data-row]').first(), /QoS/);
  await tab.go('#/graph');
  await tab.page.locator('.edge.error').first().waitFor();
  await there(tab.page.locator('.edge .sign.error'));
  await tab.page.getByRole('combobox', { name: 'Show' }).selectOption('nodes');
  await until('the pair', async () => (await tab.page.locator('.edge.pair, .edge').count()) > 0);
  // A screen reader announces only new findings. There was none since the page was opened.
  assert.equal(await tab.page.locator('[aria-live="polite"]').innerText(), '');
});
