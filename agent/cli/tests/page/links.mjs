// TCP links to other hosts are listed beside the nodes, the worst first. Arguments: address, and the
// addresses of the link.

import assert from 'node:assert/strict';
import { scenario, until } from './tab.mjs';

await scenario(async (open) => {
  const [, , , source, destination] = process.argv;
  const tab = await open();
  await tab.live();
  await tab.go('#/nodes');
  const table = tab.page.locator('section[aria-labelledby="links"] table');
  const row = table.locator('tbody tr', { hasText: `${source} → ${destination}` });
  await until('segments that were sent again', async () => {
    const cells = await row.locator('td').allInnerTexts();
    const [protocol, connections, roundTrip, unsent, , , again] = cells;
    return protocol === 'RTPS' && Number(connections) >= 1 && /[\d.]+ (µs|ms)/.test(roundTrip)
      && /^[\d.]+ [kM]?B$/.test(unsent)
      && /^[1-9][\d,]* \([\d.]+ %\)$/.test(again);
  });
  assert.match(await tab.page.locator('#links').innerText(), /TCP links to other hosts/);
});
