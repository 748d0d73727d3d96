// The views of logs, diagnostics, transforms, parameters, services and clocks. Argument: address.

import assert from 'node:assert/strict';
import { reads, scenario, there } from './tab.mjs';

/** The path of each view, and texts that it shows. */
const PARTS = [
  ['logs', [/error\s+\/lidar\s+no echo from <b>sector<\/b> 3/, /1 info/, /errors 1[^]*a bar is a minute/]],
  ['diagnostics', [/error\s+battery\s+nearly empty/, /ok\s+lidar: connection/]],
  ['transforms', [/Age of stamp\s+Extrapolation\s+Jumps/, /map\s+odom[^]*–\s+–\s+0\s+\/ekf\s+\(1\.50, 0\.00, 0\.00\)\s+base_link/]],
  ['parameters', [/\/planner speed\s+5\s+7/, /\/planner\s+speed\s+7/]],
  ['services', [/No service so far\./]],
  ['clocks', [/No message of another host so far\./]],
];

await scenario(async (open) => {
  const tab = await open();
  await tab.live();
  await tab.page.getByRole('link', { name: 'Robot', exact: true }).click();
  await tab.heading('Logs');
  for (const [part, texts] of PARTS) {
    await tab.go(`#/robot/${part}`);
    for (const text of texts) await reads(tab.page.locator('main'), text);
    await tab.harmless(part);
    await tab.accessible(`robot: ${part}`);
  }
  // The worst part is the first one, and its values are folded.
  await tab.go('#/robot/diagnostics');
  const first = tab.page.locator('main tbody tr[data-row]').first();
  await reads(first, 'battery');
  await first.locator('summary').click();
  await reads(first, /Voltage \(V\) 11\.9/);
  // The finding about a transform leads to its edge, and the one about a battery to its part.
  await tab.go(`#/robot/transforms?part=${encodeURIComponent('frame 0  base_link')}`);
  await reads(tab.page.locator('[data-revealed]'), /^base_link/);
  await tab.go('');
  await tab.page.locator('.findings li', { hasText: 'battery' }).getByRole('link').click();
  await tab.heading('Diagnostics');
  await reads(tab.page.locator('main tbody tr[data-row]'), 'battery');
  // Filters are in the address.
  await tab.go('#/robot/logs?filter=spin');
  await reads(tab.page.locator('main table').first(), /spinning/);
  assert.doesNotMatch(await tab.page.locator('main table').first().innerText(), /sector/);
  await tab.page.locator('main table').first().getByRole('link', { name: '/lidar' }).click();
  await tab.heading('/lidar');
  // A finding about a part is a sentence without backticks.
  await tab.go('');
  await there(tab.page.locator('.findings li', { hasText: 'battery' }));
  assert.doesNotMatch(await tab.page.locator('main').innerText(), /`/);

  for (const [theme, width, height, scale] of [['dark', 360, 740, 3], ['light', 320, 256, 4]]) {
    const other = await open({ theme, width, height, scale });
    await other.live();
    for (const [part, texts] of PARTS) {
      await other.go(`#/robot/${part}`);
      for (const text of texts) await reads(other.page.locator('main'), text);
      await other.narrow(`${width} px: ${part}`);
      await other.accessible(`${width} px: ${part}`);
    }
    await other.page.close();
  }
});
