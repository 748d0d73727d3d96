// What a team does when a robot misbehaves, with the number of clicks and the seconds of each task.
// Every task begins at the overview. Arguments: address, and the names of the tasks.

import assert from 'node:assert/strict';
import { ask, reads, scenario, there, until } from './tab.mjs';

/** Most clicks of a task. Keys count as none. */
const MOST_CLICKS = 4;
const NAMES = process.argv.slice(3);

/** @type {Record<string, (tab: any, click: (locator: any) => Promise<void>) => Promise<void>>} */
const TASKS = {
  async 'why does /points lose'(tab, click) {
    await click(tab.page.locator('.findings li', { hasText: /los(t|es)/ }).first().getByRole('link').first());
    await there(tab.page.locator('section[aria-labelledby="waterfall"]'));
    await reads(tab.page.locator('.figure', { hasText: /^lost/ }), /[1-9]/);
  },
  async 'the QoS mismatch'(tab, click) {
    await click(tab.page.locator('.findings li').first().getByRole('link').first());
    await reads(tab.page.locator('section[aria-labelledby="qos"]'), /offers less than .* requests: reliability/);
  },
  async 'which node needs most CPU'(tab, click) {
    await click(tab.page.getByRole('navigation').getByRole('link', { name: 'Nodes' }));
    await click(tab.page.getByRole('columnheader', { name: /CPU/ }).getByRole('button'));
    const cells = tab.page.locator('main tbody tr[data-row] td', { hasText: '%' });
    await until('the order', async () => {
      const all = (await cells.allInnerTexts()).map(parseFloat);
      return all.length > 1 && all[0] > 0 && all.every((each, at) => !at || each <= all[at - 1]);
    });
  },
  async 'content and plot of a number'(tab, click) {
    await tab.search('/imu');
    await tab.page.keyboard.press('Enter');
    const section = tab.page.locator('section[aria-labelledby="live"]');
    await click(section.getByRole('button', { name: 'Plot linear_acceleration.z' }));
    await there(section.getByRole('img', { name: /^linear_acceleration.z/ }));
  },
  async 'ten seconds recorded and downloaded'(tab, click) {
    await click(tab.page.getByRole('navigation').getByRole('link', { name: 'Recordings' }));
    await click(tab.page.getByRole('button', { name: 'Start', exact: true }));
    const stop = tab.page.getByRole('button', { name: /^Stop/ });
    await stop.waitFor();
    await new Promise((wake) => setTimeout(wake, 10_000));
    await click(stop);
    const waiting = tab.page.waitForEvent('download');
    await click(tab.page.getByRole('button', { name: /as an archive$/ }).first());
    assert.match((await waiting).suggestedFilename(), /\.tar$/);
  },
  async 'what happened before the restart'(tab, click) {
    const { end } = await ask('when');
    const own = new Date(end * 1000);
    const value = new Date(own.getTime() - own.getTimezoneOffset() * 60_000).toISOString().slice(0, 19);
    const field = tab.page.getByLabel('until');
    await click(field);
    await field.fill(value);
    await reads(tab.page.locator('.notice'), 'The robot as it was');
    await click(tab.page.getByRole('navigation').getByRole('link', { name: 'Events' }));
    await reads(tab.page.locator('main'), 'node appeared');
  },
  async 'share this view'(tab, click) {
    await click(tab.page.getByRole('navigation').getByRole('link', { name: 'Topics' }));
    const other = await tab.page.context().newPage();
    await other.goto(tab.page.url());
    await other.getByRole('heading', { name: 'Topics' }).waitFor();
    await other.close();
  },
  async 'a node among many'(tab) {
    const { node } = await ask('node');
    await tab.search(node);
    await tab.page.keyboard.press('Enter');
    await until('its view', async () => tab.fragment().includes(encodeURIComponent(node)));
    await reads(tab.page.locator('main'), 'Process');
  },
};

await scenario(async (open) => {
  const tab = await open();
  for (const name of NAMES) {
    await tab.go('#/');
    await tab.live();
    let clicks = 0;
    const begun = Date.now();
    await TASKS[name](tab, async (locator) => {
      clicks += 1;
      await locator.click();
    });
    console.log(`${name}: ${clicks} clicks, ${((Date.now() - begun) / 1000).toFixed(1)} s`);
    assert.ok(clicks <= MOST_CLICKS, `${name}: ${clicks} clicks`);
  }
});
