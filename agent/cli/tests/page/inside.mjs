// Data from inside a process, on the views of its node and of its topics. The process calls the
// functions that rclcpp calls. Argument: address.

import assert from 'node:assert/strict';
import { ask, reads, scenario, there, until } from './tab.mjs';

const NODE = '#/nodes/%2Frobot1%2Ffilter?domain=0';

/** Returns the rows of a table as lists of texts. */
const cells = (table) => table.locator('tbody tr').evaluateAll((rows) => rows.map((row) =>
  [...row.children].map((cell) => cell.textContent.trim())));

await scenario(async (open) => {
  const tab = await open();
  await tab.live();
  const inside = tab.page.locator('section[aria-labelledby="inside"]');
  // A node without observed calls has no such section.
  await until('the node', async () => {
    await tab.go(NODE);
    return (await tab.page.locator('main ul.plain').count()) > 0;
  });
  await tab.shows('Publishers (');
  assert.equal(await inside.count(), 0);

  await until('the library is observed', async () =>
    (await ask('/inside')).libraries.some((each) => each.processes > 0 && !each.refused));
  await ask('create');
  await ask('work');
  await there(inside);
  await tab.shows('Lifecycle state: active', 'section[aria-labelledby="inside"]');
  const table = (name) => inside.getByRole('group', { name, exact: true }).getByRole('table');
  const first = async (name, wanted) => {
    const [row] = await until(`${name} ${wanted}`, async () => {
      const all = await cells(table(name));
      return wanted.every((text, at) => text == null || all[0]?.[at] === text) && all;
    }).catch(async (error) => {
      throw new Error(`${error.message}\n${await inside.innerText()}`);
    });
    return row;
  };
  // The page shows the figures of the API: 10 + 30 + 20 published messages, 30 within the process.
  await first('Publishers', ['/out', '/robot1/filter', '60', '30']);
  await first('Subscriptions', ['/in', '/robot1/filter', '20', '3']);
  const buffer = await first('Buffers', ['/in', '/robot1/filter', '30', '26']);
  assert.equal(buffer.length, 7);
  const { inside: shown } = await ask('/nodes/robot1%2Ffilter?domain_id=0');
  assert.deepEqual([shown.publishers[0].published_messages, shown.subscriptions[0].taken_messages,
    shown.buffers[0].overwritten_messages], [60, 20, 26]);
  const callbacks = await until('callbacks', async () => {
    const all = await cells(table('Callbacks'));
    return all.length === shown.callbacks.length && all;
  });
  const calls = Object.fromEntries(callbacks.map(([name, , number]) => [name, number]));
  assert.equal(calls['timer 1.00 ms'], '20');
  // Callbacks of messages take 2 ms, those within the process 1 ms, and more on a busy machine.
  const [taken] = callbacks.filter(([name]) => name === '/in');
  assert.match(taken[5], /^[1-9][\d.]* ms$/, JSON.stringify(callbacks));
  await tab.accessible('a node from inside');

  // While the process works, rates and busy times appear.
  const working = (async () => { for (let at = 0; at < 4; at += 1) await ask('work'); })();
  await until('rates', async () => /Hz/.test((await cells(table('Publishers')))[0][4]));
  await reads(inside, /Its callbacks take [\d.]+ % of the\s+time/);
  await working;

  // After calls that show what is usual, a call that sleeps is late. On a busy machine, calls before
  // it may be late too.
  const late = inside.locator('section[aria-labelledby="late"]');
  assert.equal(await late.count(), 0);
  await inside.getByRole('button', { name: 'Why late?' }).click();
  await reads(late, /No call\s+was late so far|Worst calls/);
  const slept = late.getByRole('group', { name: 'Causes', exact: true })
    .getByRole('row', { name: /it slept/ });
  const drawn = late.getByRole('group', { name: 'Worst calls', exact: true })
    .getByRole('row', { name: /it slept: .*sleep [\d.]+ ms/ })
    .getByRole('img', { name: /sleep [\d.]+ ms/ });
  // Each late call also changes what is usual, therefore others accompany it.
  await until('a call that slept', async () => {
    await ask('usual');
    await ask('late');
    return (await slept.count()) === 1 && (await drawn.count()) > 0;
  });
  const bars = late.getByRole('group', { name: 'Late calls over time', exact: true })
    .getByRole('button', { name: /late calls?, up to .*sleep/ });
  await bars.last().click();
  const chosen = late.getByRole('group', { name: 'Calls of a period', exact: true });
  await there(chosen.getByRole('row', { name: /it slept/ }).first());
  await tab.accessible('late calls of a node');
  await bars.last().press('Enter');
  await until('no chosen period', async () => (await chosen.count()) === 0);

  // The topics of the process, which do not use the network.
  await tab.go('#/topics/%2Fout?domain=0');
  await tab.shows('Rate and messages come from inside');
  const published = await first('Publishers', ['/out', '/robot1/filter', '300', '150']);
  assert.equal(published.length, 7);
  const messages = tab.page.locator('.figure', { hasText: 'messages' }).locator('.value');
  await until('messages of the topic', async () => (await messages.innerText()) === '300');
  await tab.accessible('a topic from inside');
  await tab.go('#/topics/%2Fin?domain=0');
  await first('Subscriptions', ['/in', '/robot1/filter', '100', '15']);
  // A click into the chart of the latency shows the late calls of that time. On a busy machine there
  // may be some.
  await tab.page.locator('figure.chart', { hasText: 'Latency' }).locator('.u-over').click();
  await reads(late, /Choose a bar|No late call is known near \d\d:\d\d:\d\d/);

  // The process publishes within the callback of its input. This is a chain by causality. Its parts
  // are the wait and the callback of at least 2 ms.
  await tab.go('#/chains');
  const row = tab.page.locator('main tbody tr[data-row]', { hasText: '/in → /out' });
  await there(row);
  await reads(row, 'causality');
  await row.locator('a').click();
  await tab.heading('/in → /out');
  const hop = tab.page.locator('main tbody tr[data-row]').first();
  await reads(hop, /wait [\d.]+ [µm]s/);
  await reads(hop, /callback (?:[2-9]|\d{2,})[\d.]* ms/);
  assert.deepEqual(await hop.locator('.track rect').evaluateAll((all) => all.map((each) =>
    each.getAttribute('class'))), ['part transit', 'part wait', 'part callback']);
  await tab.accessible('a chain by causality');

  for (const [theme, width, height, scale] of [['dark', 1280, 800, 1], ['light', 360, 740, 3],
    ['dark', 320, 256, 4]]) {
    const other = await open({ theme, width, height, scale });
    await other.live();
    for (const fragment of [NODE, '#/topics/%2Fout?domain=0', '#/topics/%2Fin?domain=0']) {
      await other.go(fragment);
      await there(other.page.locator('section[aria-labelledby="inside"] table'));
      await other.accessible(`${theme}, ${width} px: ${fragment}`);
      await other.narrow(`${theme}, ${width} px: ${fragment}`);
    }
    await other.page.close();
  }
});
