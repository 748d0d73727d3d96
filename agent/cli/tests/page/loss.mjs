// A capture with losses, with the times of the capture. A page that is opened later shows the
// incident.

import assert from 'node:assert/strict';
import { reads, scenario, there, until } from './tab.mjs';

await scenario(async (open) => {
  const tab = await open();
  await tab.live();
  // The time bar shows the time of all figures.
  const bar = tab.page.locator('.timebar');
  await until('the end of the capture', async () => /finished/.test(await bar.innerText()));
  await reads(bar, /2026-\d\d-\d\d \d\d:\d\d:\d\d, .* after the begin/);
  const position = bar.getByRole('slider');
  assert.equal(await position.inputValue(), await position.getAttribute('max'));

  const findings = tab.page.locator('section[aria-labelledby="wrong"]');
  await until('the loss is a finding', async () => /los(t|es)/.test(await findings.innerText()));
  // The capture is not of today, so times have their date.
  await reads(findings, /since 2026-\d\d-\d\d \d\d:\d\d:\d\d/);
  await reads(findings, /Remedy: /);
  const finding = findings.locator('li', { hasText: /los(t|es)/ }).first();
  await finding.getByRole('link').first().click();
  await tab.page.locator('.plot canvas').first().waitFor();
  // The finding leads to the section of the losses, below the charts.
  await until('the section in the window', () => tab.page.locator('section[aria-labelledby="waterfall"]')
    .evaluate((section) => section.hasAttribute('data-revealed')
      && section.getBoundingClientRect().top < innerHeight && scrollY > 0));

  await reads(tab.page.locator('.figure', { hasText: /^lost/ }).locator('.value'), /[1-9]/);
  const chart = tab.page.getByRole('img', { name: /^Lost messages/ });
  await until('the chart of what was lost', async () => Number(/maximum ([\d,]+)/.exec(
    await chart.getAttribute('aria-label'))?.[1]) > 0);
  // The table of the chart has the seconds of the incident.
  const figure = tab.page.locator('figure', { hasText: 'Lost messages' });
  await figure.getByRole('button', { name: 'Table' }).click();
  await there(figure.locator('tbody tr'));
  await reads(figure.locator('tbody'), /2026-\d\d-\d\d \d\d:\d\d:\d\d/);

  // The table has a badge, and can be sorted by it.
  await tab.go('#/topics?sort=state');
  const row = tab.page.locator('main tbody tr[data-row]').first();
  await reads(row, /loss/);
  await reads(row, /[\d.]+ %/);
  await tab.page.getByRole('combobox', { name: 'Show' }).selectOption('wrong');
  await until('only what is wrong', async () => tab.fragment().includes('only=wrong'));
  await there(tab.page.locator('main tbody tr[data-row]'));

  // In the graph, the topic has a mark and a word, not only a colour.
  await tab.go('#/graph');
  await tab.page.getByRole('button', { name: /with a warning/ }).first().waitFor();
  await there(tab.page.locator('.vertex.warning .sign'));
  await tab.go('#/agent');
  await tab.shows('a capture file');
});
