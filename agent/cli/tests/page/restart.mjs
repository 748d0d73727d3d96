// The agent stops answering, ends, and restarts: the page reports it, keeps the last figures, and
// continues without a reload with the new agent's state and nothing of the old one.

import assert from 'node:assert/strict';
import { ask, gone, scenario, until } from './tab.mjs';

await scenario(async (open) => {
  const tab = await open({ fragment: '#/topics' });
  await tab.live();
  // The browser logs requests to an agent that is gone.
  tab.expect(/^error: Failed to load resource: net::ERR_/);
  const row = (name) => tab.page.locator('main tbody tr[data-row]', { hasText: name });
  await until('figures', async () => /Hz/.test(await row('/imu').innerText()));

  // It hangs: no line arrives and no connection breaks.
  await ask('freeze');
  await tab.shows('No connection', 'body');
  assert.match(await row('/imu').innerText(), /Hz/, 'the last figures stay');
  await tab.accessible('without a connection');
  await ask('thaw');
  await tab.live();
  await gone(tab.page.locator('.notice'));

  // It ends in order, and later there is another.
  const first = await ask('run');
  await ask('stop');
  await tab.shows('No connection', 'body');
  await ask('forget the robot');
  await ask('start');
  await ask('another robot');
  await tab.live();
  const second = await ask('run');
  assert.notEqual(first.run, second.run);
  // The robot it sees now has other topics: nothing of the first is left.
  await row('/after_restart').waitFor();
  await until('the old robot is gone', async () => (await row('/imu').count()) === 0);
  await until('figures of the new one', async () => /Hz/.test(await row('/after_restart').innerText()));
  await tab.page.getByRole('link', { name: 'Agent', exact: true }).click();
  await tab.shows(/Stream\s+live/);

  // Killed without a word.
  await ask('kill');
  await tab.shows('No connection', 'body');
  await ask('start');
  await tab.live();
});
