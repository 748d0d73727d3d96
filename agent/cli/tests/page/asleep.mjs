// A tab in the background, which the browser freezes for a minute, and a hidden tab. A hidden tab
// needs no work of the agent, and shows the current state when it is visible again.

import assert from 'node:assert/strict';
import { ask, scenario, until } from './tab.mjs';

const MINUTE_MS = 60_000;

/** Lets the test hide the tab, because a browser without a window cannot change between tabs. */
function hideable() {
  let state = 'visible';
  Object.defineProperty(Document.prototype, 'visibilityState', { get: () => state });
  Object.defineProperty(Document.prototype, 'hidden', { get: () => state === 'hidden' });
  globalThis.becomeVisible = (visible) => {
    state = visible ? 'visible' : 'hidden';
    document.dispatchEvent(new Event('visibilitychange'));
  };
}

await scenario(async (open) => {
  const tab = await open({ fragment: '#/topics', init: hideable });
  await tab.live();
  const row = (name) => tab.page.locator('main tbody tr[data-row]', { hasText: name });
  await until('figures', async () => /Hz/.test(await row('/imu').innerText()));

  const session = await tab.page.context().newCDPSession(tab.page);
  await session.send('Page.setWebLifecycleState', { state: 'frozen' });
  await new Promise((wake) => setTimeout(wake, MINUTE_MS / 2));
  await ask('another topic');
  await new Promise((wake) => setTimeout(wake, MINUTE_MS / 2));
  await session.send('Page.setWebLifecycleState', { state: 'active' });
  await row('/while_asleep').waitFor();
  await tab.live();
  // The figures are current: the time of the last message advances with the clock.
  await tab.page.getByRole('link', { name: '/imu', exact: true }).click();
  await until('a message of now', async () => {
    const text = await tab.page.locator('.figure', { hasText: 'last message' })
      .locator('.value').innerText();
    const now = await tab.page.evaluate(() => {
      const date = new Date();
      return date.getHours() * 3600 + date.getMinutes() * 60 + date.getSeconds();
    });
    const [hours, minutes, seconds] = text.split(':').map(Number);
    return Math.abs(now - (hours * 3600 + minutes * 60 + seconds)) <= 3;
  });

  // Hidden: after ten seconds the agent has one stream less to compute.
  await tab.page.getByRole('navigation').getByRole('link', { name: 'Events' }).click();
  await tab.shows('/night_watch');
  await until('one stream', async () => (await ask('streams')).live === 1);
  await tab.page.evaluate(() => globalThis.becomeVisible(false));
  await until('the stream is closed', async () => (await ask('streams')).live === 0);
  await ask('a node while hidden');
  await tab.page.evaluate(() => globalThis.becomeVisible(true));
  await tab.live();
  // Events of the hidden time are in the list.
  await tab.shows('/while_hidden');
  await until('the stream is open', async () => (await ask('streams')).live === 1);
  // The stream stays open while the tab is hidden only briefly.
  const opened = () => tab.requests.filter((request) => request.url().endsWith('/live')).length;
  let isBrief = false;
  for (let round = 0; !isBrief; round += 1) {
    assert.ok(round < 10, 'each time the tab was hidden for long');
    const [before, began] = [opened(), Date.now()];
    await tab.page.evaluate(() => globalThis.becomeVisible(false));
    await new Promise((wake) => setTimeout(wake, 2000));
    await tab.page.evaluate(() => globalThis.becomeVisible(true));
    // A busy machine may hide the tab for longer.
    isBrief = Date.now() < began + 8000;
    await tab.live();
    if (isBrief) assert.equal(opened(), before);
  }
});
