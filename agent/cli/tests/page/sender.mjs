// A column shows what a sender drops before its TCP connection. Arguments: address, and the number of
// lost messages.

import { scenario, until } from './tab.mjs';

await scenario(async (open) => {
  const lost = process.argv[3];
  const tab = await open();
  await tab.live();
  await tab.go('#/topics/%2Fpoints');
  const section = tab.page.locator('section[aria-labelledby="waterfall"]');
  await until('the losses at the sender', async () => {
    const titles = await section.locator('thead th').allInnerTexts();
    const column = titles.findIndex((title) => /Lost at the sender/i.test(title));
    const cell = section.locator('tbody tr').first().locator('th, td').nth(column);
    return column > 0 && (await cell.innerText()).replace(/\D/g, '') === lost;
  });
});
