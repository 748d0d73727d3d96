// The view of a fleet of ten robots, of which one differs and one is out of reach: robots by health,
// one robot against the others, the link to its own page, and the incident of one robot.

import assert from 'node:assert/strict';
import { reads, scenario, until } from './tab.mjs';

await scenario(async (open) => {
  const tab = await open();
  await tab.live();
  const { page } = tab;
  await page.getByRole('link', { name: 'Fleet', exact: true }).click();
  await tab.heading('Fleet');
  const incidents = page.getByRole('group', { name: 'Incidents' }).locator('tbody tr');
  const rows = page.locator('main tbody tr:not(section[aria-labelledby="incidents"] tr)');
  await until('one incident', async () => (await incidents.count()) === 1);
  await reads(incidents.first(), /robot-7[\s\S]*message_lost[\s\S]*\/scan[\s\S]*7\.5[\s\S]*3\.1/);
  await reads(incidents.first(), /incident_1[\s\S]*2 x ros2\.message\.lost/);
  const all = () => until('ten robots', async () => (await rows.count()) === 10);
  await all();
  await reads(rows.first(), /robot-3[\s\S]*out of reach/);
  const odd = rows.filter({ has: page.getByRole('rowheader', { name: 'robot-7', exact: true }) });
  const own = odd.getByRole('link', { name: 'robot-7', exact: true });
  assert.equal(await own.getAttribute('href'), 'http://robot-7.example:17401/');
  await tab.accessible('the fleet');

  await odd.getByRole('link', { name: /^\d+ lines?$/ }).click();
  await tab.heading('robot-7');
  assert.equal(tab.fragment(), '#/fleet/robot-7');
  await reads(page.locator('main'), /Nodes\s[\s\S]* is missing \(8 of 9\)/);
  await reads(page.locator('main'), /Publishers and subscriptions\s[\s\S]*usually 2 \(8 of 9\)/);
  assert.equal(await rows.count(), 1);
  await tab.accessible('a robot of the fleet');

  await page.getByRole('link', { name: 'All robots' }).click();
  await all();
});
