// A capture with losses, at the capture's own time: the page opened after the incident shows it.

import assert from 'node:assert/strict';
import { scenario, until } from './tab.mjs';

await scenario(async (open) => {
  const tab = await open();
  await tab.live();
  // The time bar: what all figures are of.
  const bar = tab.page.locator('.timebar');
  await until('the end of the capture', async () => /finished/.test(await bar.innerText()));
  assert.match(await bar.innerText(), /2026-\d\d-\d\d \d\d:\d\d:\d\d, .* after the begin/);
  assert.equal(await bar.getByRole('progressbar').getAttribute('value'), '1');

  const findings = tab.page.locator('section[aria-labelledby="wrong"]');
  await until('the loss is a finding', async () => /los(t|es)/.test(await findings.innerText()));
  assert.match(await findings.innerText(), /since \d\d:\d\d:\d\d/);
  assert.match(await findings.innerText(), /Remedy: /);
  const finding = findings.locator('li', { hasText: /los(t|es)/ }).first();
  await finding.getByRole('link').first().click();
  await tab.page.locator('.plot canvas').first().waitFor();

  const lost = await tab.page.locator('.figure', { hasText: /^lost/ }).locator('.value').innerText();
  assert.ok(Number(lost.replace(/\D/g, '')) > 0, lost);
  const chart = tab.page.getByRole('img', { name: /^Lost messages/ });
  const label = await chart.getAttribute('aria-label');
  assert.ok(Number(/maximum ([\d,]+)/.exec(label)?.[1]) > 0, label);
  // When it happened: the table of the chart has the seconds.
  const figure = tab.page.locator('figure', { hasText: 'Lost messages' });
  await figure.getByRole('button', { name: 'Table' }).click();
  assert.ok((await figure.locator('tbody tr').count()) > 0);

  // The badge in the table, and the sort that brings it up.
  await tab.go('#/topics?sort=state');
  const row = tab.page.locator('main tbody tr[data-row]').first();
  assert.match(await row.innerText(), /loss/);
  assert.match(await row.innerText(), /[\d.]+ %/);
  await tab.page.getByRole('combobox', { name: 'Show' }).selectOption('wrong');
  await until('only what is wrong', async () => tab.fragment().includes('only=wrong'));
  assert.ok((await tab.page.locator('main tbody tr[data-row]').count()) >= 1);

  // In the graph it has a mark and a word, not only a colour.
  await tab.go('#/graph');
  await tab.page.getByRole('button', { name: /with a warning/ }).first().waitFor();
  assert.ok((await tab.page.locator('.vertex.warning .sign').count()) > 0);
  await tab.go('#/agent');
  await tab.shows('a capture file');
});
