// A capture in replay: the time bar pauses it, changes its speed, and goes to the next event.

import assert from 'node:assert/strict';
import { gone, reads, scenario, until } from './tab.mjs';

await scenario(async (open) => {
  const tab = await open({ fragment: '#/events' });
  await tab.live();
  const bar = tab.page.getByRole('region', { name: 'Time of the replay' });
  const button = (name) => bar.getByRole('button', { name });
  assert.equal(await bar.getByLabel('Speed').inputValue(), '0.1');
  await button('Pause').click();
  await button('Play').waitFor();
  const time = () => bar.locator('span').first().innerText();
  await until('the time stands still', async () => {
    const before = await time();
    await new Promise((wake) => setTimeout(wake, 1500));
    return before === await time();
  });

  // One click leads from event to event.
  for (let events = 0; !/lost/i.test(await tab.text()); events += 1) {
    assert.ok(events < 10, await tab.text());
    const before = await time();
    await button('Next event').click();
    await until('a later time', async () => await time() !== before && await button('Play').isVisible());
    await new Promise((wake) => setTimeout(wake, 1500));
  }
  await tab.narrow('the time bar of a replay');
  await tab.accessible('a paused replay');

  await bar.getByLabel('Speed').selectOption('0');
  await button('Play').click();
  await reads(bar, /finished/);
  await gone(button('Pause'));

  // From the end, it goes back to an event, and to the begin. There it stands still.
  const end = await time();
  await button('Previous event').click();
  await button('Play').waitFor();
  assert.notEqual(await time(), end);
  await button('Begin').click();
  await reads(bar, /, 0 s after the begin/);
  await button('Play').click();
  await reads(bar, /finished/);
  await tab.live();

  // The address of a moment in the past has a way back.
  tab.expect(/^error: Failed to load resource.*404/);
  await tab.page.goto(`${tab.address}#/?at=1000000`);
  await reads(tab.page.locator('.notice'), 'The robot’s state at that time is unknown');
  await tab.page.getByRole('button', { name: 'Now' }).click();
  await tab.live();
  await reads(bar, /finished/);
});
