// What the robot said before it said something else: each view in the present, and then at a moment
// before. Argument: address.

import assert from 'node:assert/strict';
import { warn } from './charts.mjs';
import { ask, gone, reads, scenario, there } from './tab.mjs';

/** Views, what they show of the present, and of the past. The past shows nothing of the present. */
const viewsOf = (process) => [
  ['robot/parameters', /\/planner\s+speed\s+7/, /\/planner\s+speed\s+5/],
  ['robot/diagnostics', /ok\s+battery\s+full/, /error\s+battery\s+nearly empty/],
  ['robot/logs', /error\s+\/lidar\s+motor is cool/, /error\s+\/lidar\s+motor too hot/],
  ['robot/transforms', /map\s+odom[^]*\/base\s+\(9\.25, 0\.00, 0\.00\)/, /map\s+odom[^]*\/base\s+\(1\.50, 0\.00, 0\.00\)/],
  ['robot/services', /\/calibrate\s/, /\/reset\s/],
  ['robot/clocks', /Ahead at least[^]*\s(6\.\d\d|7\.00) s/, /Ahead at least[^]*\s(2\.\d\d|3\.00) s/],
  ['chains', /\/tf → \/parameter_events\s/, /\/tf → \/diagnostics\s/],
  ['agent', new RegExp(`Process\\s+${process.now}\\s[^]*Limits in use`), new RegExp(`Process\\s+${process.then}\\s[^]*Limits in use`)],
  ['topics/%2Fdiagnostics?domain=0', /Publishers \(2\)[^]*\/watchdog/,
    /Publishers \(1\)[^]*Rate\s+Bandwidth\s+Loss[^]*\/monitor[^]*Reliability\s+BEST_EFFORT/],
  ['nodes/%2Fbase?domain=0', /Publishers \(2\)[^]*\/odom/, /Publishers \(1\)\s+\/tf/],
];

await scenario(async (open) => {
  const { end, process } = await ask('another agent and other words');
  const views = viewsOf(process);
  const [[, parametersNow, parametersThen]] = views;
  const tab = await open();
  await tab.live();
  const { page } = tab;
  const main = page.locator('main');
  const at = (view) => `#/${view}${view.includes('?') ? '&' : '?'}at=${end}`;
  for (const [view, now, then] of views) {
    await tab.go(`#/${view}`);
    await tab.shows(now);
    assert.doesNotMatch(await main.innerText(), then, `${view} of the present`);
  }
  for (const [view, now, then] of views) {
    await page.goto(`${tab.address}${at(view)}`);
    await reads(page.locator('.notice'), 'The robot as it was');
    await tab.shows(then);
    assert.doesNotMatch(await main.innerText(), now, `${view} of the past`);
    await tab.harmless(view);
    await tab.accessible(`the past of ${view}`);
    // The chart of logs has the messages of that time.
    if (view === 'robot/logs') await reads(main, /errors 1[^]*a bar is a minute/);
  }
  // The chart of logs marks the events of that time.
  await warn(page, 15);
  await page.goto(`${tab.address}${at('robot/logs')}`);
  await there(page.locator('.bars line'));
  await page.unroute('**/history/events*');
  for (const [view, why] of [['recordings', 'Bags are those'], ['doctor', 'The doctor examines']]) {
    await page.goto(`${tab.address}${at(view)}`);
    await reads(main, new RegExp(`${why}[^]*This view has no history`));
  }
  // The present is back with one click, also in a view that has both.
  await page.goto(`${tab.address}${at('robot/parameters')}`);
  await reads(main, parametersThen);
  await page.getByRole('button', { name: 'Now' }).click();
  await reads(main, parametersNow);
  await gone(page.locator('.notice'));
  // Nothing is known of a time before the first answer.
  tab.expect(/^error: Failed to load resource.*404/);
  await page.getByRole('button', { name: 'Earlier' }).click();
  await page.getByRole('link', { name: 'Diagnostics' }).click();
  assert.match(page.url(), /diagnostics\?.*at=\d+/);
  await page.goto(`${tab.address}#/robot/parameters?at=1000000`);
  await reads(main, /No answer: no answer of \/parameters of that time is kept/);
  await page.goto(`${tab.address}${at('robot/parameters')}`);
  await reads(main, parametersThen);
});
