// A button starts and stops the measurement of a topic. The agent's list of watches, the kernel's
// map of writers, and the figures follow.

import assert from 'node:assert/strict';
import { ask, scenario, until } from './tab.mjs';

await scenario(async (open) => {
  const tab = await open({ fragment: '#/topics' });
  await tab.live();
  const row = tab.page.locator('main tbody tr[data-row]', { hasText: '/scan' });
  await row.waitFor();
  // The agent knows all writers once two answers are the same.
  let before = null;
  await until('the same writers as before', async () => {
    const now = await ask('watches');
    const isSame = before?.interest === now.interest;
    before = now;
    return isSame;
  });
  assert.deepEqual(before.topics, [], 'nothing is measured at first');
  assert.match(await row.innerText(), /–/, 'no rate');

  await row.getByRole('button', { name: 'off: measure /scan' }).click();
  await row.getByRole('button', { name: 'on: measure /scan' }).waitFor();
  const measured = await until('the kernel knows the writer', async () => {
    const now = await ask('watches');
    return now.interest > before.interest && now;
  });
  assert.deepEqual(measured.topics, ['/scan']);
  // A measured scan has a rate, however busy the machine is.
  await until('its rate', async () => /[1-9][\d.]* Hz/.test(await row.innerText()));
  // The other topics are unchanged.
  const other = tab.page.locator('main tbody tr[data-row]', { hasText: '/points' });
  assert.ok(await other.getByRole('button', { name: 'off: measure /points' }).isVisible());

  // The view of the topic has the same button with the same effect.
  await tab.page.getByRole('link', { name: '/scan', exact: true }).click();
  await tab.page.locator('.plot canvas').first().waitFor();
  // Its messages are open at first, and are measured without a watch.
  await tab.page.locator('section[aria-labelledby="live"]').getByRole('button', { name: 'Close' }).click();
  await tab.page.getByRole('button', { name: 'on: measure /scan' }).click();
  await tab.page.getByRole('button', { name: 'off: measure /scan' }).waitFor();
  await until('the kernel forgets the writer', async () => {
    const now = await ask('watches');
    return now.topics.length === 0 && now.interest === before.interest;
  });
  await tab.shows(/rate\s+–/);
});
