// The current message of a topic: a tree that can be collapsed, and a chart of a number in it. The
// agent decodes messages only while the tree is open.

import assert from 'node:assert/strict';
import { marked, READBACK, shared, warn } from './charts.mjs';
import { ask, gone, reads, scenario, until } from './tab.mjs';

await scenario(async (open) => {
  const tab = await open({ fragment: '#/topics/%2Fimu?domain=0' });
  await tab.live();
  const section = tab.page.locator('section[aria-labelledby="live"]');
  const followed = () => tab.requests.filter((request) => request.url().includes('/messages?')).length;
  // The message is the first section, and open.
  assert.equal(await tab.page.locator('main h2').first().innerText(), 'Live message');
  const tree = section.getByRole('group', { name: 'Fields of the message' });
  await tree.waitFor();
  const field = (name) => tree.locator('tr', { has: tab.page.getByRole('rowheader', { name, exact: true }) });
  await reads(tree, /header \(2\)/);
  await reads(field('sec'), /sec\s+1\d{9}/);
  const before = await field('nanosec').innerText();
  await until('the next message', async () => (await field('nanosec').innerText()) !== before);
  await reads(section, /by \/imu_driver/);

  // A branch is collapsed and expanded again.
  await tree.getByRole('button', { name: /^header/ }).click();
  await gone(field('nanosec'));
  await tree.getByRole('button', { name: /^header/ }).click();
  await field('nanosec').waitFor();
  // A covariance is an array of nine numbers.
  await reads(tree, /orientation_covariance \(9\)/);

  await tree.getByRole('button', { name: 'Plot linear_acceleration.z' }).click();
  const chart = section.getByRole('img', { name: /^linear_acceleration.z/ });
  await until('a chart of it', async () => /last -?[\d.]+, minimum/.test(
    await chart.getAttribute('aria-label')));
  await until('points', async () => (await chart.locator('canvas').count()) === 1);
  // It marks the same events as the five charts of the topic, and has the same cursor.
  tab.expect(READBACK);
  await warn(tab.page, 2);
  await marked(tab.page, 6);
  await shared(tab.page, chart);
  const values = section.locator('figure', { hasText: 'linear_acceleration.z' });
  await values.getByRole('button', { name: 'Table' }).click();
  await until('its values', async () => (await values.locator('tbody tr').count()) >= 1);
  await tab.accessible('a message with a chart');
  // Several fields have a chart each, or one together.
  await tree.getByRole('button', { name: 'Plot linear_acceleration.x' }).click();
  const plots = section.locator('figure.chart');
  await until('two charts', async () => (await plots.count()) === 2);
  await section.getByLabel('One chart each').uncheck();
  await until('one chart', async () => (await plots.count()) === 1);
  await reads(plots, 'linear_acceleration.z, linear_acceleration.x');
  await section.getByLabel('One chart each').check();

  // At most five messages per second are shown, and the number of omitted messages.
  await until('what was not shown', async () => /\d+ not shown before it/
    .test(await section.innerText()));
  // While the tree is closed, the agent decodes nothing.
  await until('one stream', async () => (await ask('streams')).messages === 1);
  await section.getByRole('button', { name: 'Close' }).click();
  await until('the agent is left alone', async () => (await ask('streams')).messages === 0);
  // A busy agent may have ended a stream, which the page opens again.
  const requested = followed();
  assert.ok(requested >= 1);
  // The next topic stays closed, too.
  await tab.go('#/topics/%2Fscan?domain=0');
  await section.getByRole('button', { name: 'Show messages' }).waitFor();
  assert.equal(followed(), requested);
});
