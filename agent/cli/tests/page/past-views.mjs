// What the robot said before it said something else: each view in the present, and then at a moment
// before. Argument: address.

import assert from 'node:assert/strict';
import { ask, gone, reads, scenario } from './tab.mjs';

/** Views, what they show of the present, and of the past. */
const VIEWS = [
  ['robot/parameters', /\/planner\s+speed\s+7/, /\/planner\s+speed\s+5/],
  ['robot/diagnostics', /ok\s+battery\s+full/, /error\s+battery\s+nearly empty/],
  ['robot/logs', /error\s+\/lidar\s+motor is cool/, /error\s+\/lidar\s+motor too hot/],
];
/** Views of the past that the agent's history also has. */
const OTHERS = [
  ['robot/transforms', /No message of \/tf/],
  ['robot/services', /No service so far|Services/],
  ['robot/clocks', /Hosts|No message of another host/],
  ['chains', /No chain was known at that time/],
  ['agent', /Abilities[^]*Limits in use/],
  ['topics/%2Fdiagnostics?domain=0', /Publishers and\s+subscriptions[^]*\/monitor[^]*Reliability\s+BEST_EFFORT/],
  ['nodes/%2Fmonitor?domain=0', /Publishers \(1\)\s+\/diagnostics/],
];

await scenario(async (open) => {
  const { end } = await ask('another agent and other words');
  const tab = await open();
  await tab.live();
  const { page } = tab;
  const main = page.locator('main');
  const at = (view) => `#/${view}${view.includes('?') ? '&' : '?'}at=${end}`;
  for (const [view, now] of VIEWS) {
    await tab.go(`#/${view}`);
    await reads(main, now);
  }
  for (const [view, now, then] of VIEWS) {
    await page.goto(`${tab.address}${at(view)}`);
    await reads(page.locator('.notice'), 'The robot as it was');
    await tab.shows(then);
    assert.doesNotMatch(await main.innerText(), now, `${view} of the past`);
    await tab.harmless(view);
    await tab.accessible(`the past of ${view}`);
  }
  // The chart of logs has the messages of that time.
  await reads(main, /errors 1[^]*a bar is a minute/);
  for (const [view, then] of OTHERS) {
    await page.goto(`${tab.address}${at(view)}`);
    await reads(page.locator('.notice'), 'The robot as it was');
    await tab.shows(then);
    await tab.accessible(`the past of ${view}`);
  }
  for (const [view, why] of [['recordings', 'Bags are those'], ['doctor', 'The doctor examines']]) {
    await page.goto(`${tab.address}${at(view)}`);
    await reads(main, new RegExp(`${why}[^]*This view has no history`));
  }
  // The present is back with one click, also in a view that has both.
  await page.goto(`${tab.address}${at('robot/parameters')}`);
  await reads(main, VIEWS[0][2]);
  await page.getByRole('button', { name: 'Now' }).click();
  await reads(main, VIEWS[0][1]);
  await gone(page.locator('.notice'));
  // Nothing is known of a time before the first answer.
  tab.expect(/^error: Failed to load resource.*404/);
  await page.getByRole('button', { name: 'Earlier' }).click();
  await page.getByRole('link', { name: 'Diagnostics' }).click();
  assert.match(page.url(), /diagnostics\?.*at=\d+/);
  await page.goto(`${tab.address}#/robot/parameters?at=1000000`);
  await reads(main, /No answer: no answer of \/parameters of that time is kept/);
  await page.goto(`${tab.address}${at('robot/parameters')}`);
  await reads(main, VIEWS[0][2]);
});
