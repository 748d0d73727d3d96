// The agent stops answering, ends, and restarts. The page reports this and keeps the last figures.
// It continues without a reload, with only the new agent's state.

import assert from 'node:assert/strict';
import { ask, gone, reads, scenario, until } from './tab.mjs';

await scenario(async (open) => {
  const tab = await open({ fragment: '#/topics' });
  await tab.live();
  // The browser logs failed requests to an agent that has ended.
  tab.expect(/^error: Failed to load resource: net::ERR_/);
  const row = (name) => tab.page.locator('main tbody tr[data-row]', { hasText: name });
  await until('figures', async () => /Hz/.test(await row('/imu').innerText()));

  // The agent hangs: no line arrives, and no connection breaks.
  await ask('freeze');
  await tab.shows('No connection', 'body');
  assert.match(await row('/imu').innerText(), /Hz/, 'the last figures stay');
  await tab.accessible('without a connection');
  await ask('thaw');
  await tab.live();
  await gone(tab.page.locator('.notice'));

  // The agent shuts down, and later another one starts.
  const first = await ask('run');
  await ask('stop');
  await tab.shows('No connection', 'body');
  await ask('forget the robot');
  await ask('start');
  await ask('another robot');
  await tab.live();
  const second = await ask('run');
  assert.notEqual(first.run, second.run);
  // The new agent observes a robot with other topics. No topic of the first robot remains.
  await row('/after_restart').waitFor();
  await until('the old robot is gone', async () => (await row('/imu').count()) === 0);
  await until('figures of the new one', async () => /Hz/.test(await row('/after_restart').innerText()));
  await tab.page.getByRole('link', { name: 'Agent', exact: true }).click();
  await tab.shows(/Stream\s+live/);

  // The agent is killed while messages are shown. They go on with the next agent.
  await tab.page.getByRole('navigation').getByRole('link', { name: 'Topics' }).click();
  await row('/after_restart').getByRole('link').click();
  const message = tab.page.locator('section[aria-labelledby="live"]');
  await reads(message, /number [\d,]+ by \/other/);
  // No connection breaks, as without a network. The messages begin again with the stream.
  const followed = () => tab.requests.filter((request) => request.url().includes('/messages?')).length;
  const earlier = followed();
  await ask('freeze');
  await tab.shows('No connection', 'body');
  await ask('thaw');
  await tab.live();
  await until('the messages begin again', async () => followed() > earlier);
  // The page shows the last message of the first stream until the next one has some.
  const number = async () => Number(
    /number ([\d,]+) by/.exec(await message.innerText())?.[1].replaceAll(',', ''));
  const shown = await number();
  await until('a later message', async () => (await number()) > shown);
  // The next agent does not know the topic before its robot starts.
  tab.expect(/404 .*topics\/%2Fafter_restart/);
  await ask('kill');
  await tab.shows('No connection', 'body');
  await reads(message, 'the connection was lost');
  await message.getByRole('button', { name: 'Again' }).waitFor();
  await ask('start');
  await tab.live();
  await ask('another robot');
  await gone(message.getByText('the connection was lost'));
  await reads(message, /number [\d,]+ by \/other/);
});
