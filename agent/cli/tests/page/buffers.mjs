// The endpoints of a topic with buffers show which backends they accept. Argument: address.

import { scenario, until } from './tab.mjs';

await scenario(async (open) => {
  const tab = await open();
  await tab.live();
  await tab.go('#/topics/%2Fpoints');
  for (const [list, backends] of [['Publishers', /\bcuda\b/], ['Subscriptions', /\bcpu\b/]]) {
    const table = tab.page.getByRole('group', { name: list }).locator('table');
    await until(`the buffers of the ${list}`, async () => {
      const titles = await table.locator('thead th').allInnerTexts();
      const column = titles.findIndex((title) => /Buffers in/i.test(title));
      const cell = table.locator('tbody tr').first().locator('th, td').nth(column);
      return column > 0 && backends.test(await cell.innerText());
    });
  }
});
