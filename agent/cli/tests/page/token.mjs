// If loopback lacks the rights, the page needs a token once: in the address that `rp page` prints,
// or pasted. The page removes the token from the address immediately and keeps it only in its tab.
// Arguments: address of an agent whose loopback grants `read`, address of one that requires a token.

import assert from 'node:assert/strict';
import { ADDRESS, ask, gone, scenario, until } from './tab.mjs';

const STRICT = process.argv[3];

/** The browser writes each refusal to the console, whatever the page does with it. */
const REFUSED = /Failed to load resource: the server responded with a status of (401|403)/;

async function loopback(open, browser) {
  const context = await browser.newContext({ viewport: { width: 1280, height: 800 } });
  const tab = await open({ context, fragment: '#/recordings' });
  await tab.live();
  await tab.shows('They need a token with the right all');
  assert.equal(await tab.page.getByText('New recording').count(), 0);
  await tab.page.getByRole('link', { name: 'Topics', exact: true }).click();
  const measure = tab.page.locator('main tbody tr[data-row] button.switch').first();
  if (await measure.count()) assert.ok(await measure.isDisabled(), 'reading grants no watches');
  await tab.page.getByRole('link', { name: 'Agent', exact: true }).click();
  await tab.shows(/Rights at this address\s+read/);

  // A wrong token changes nothing and is reported.
  await tab.page.getByRole('button', { name: 'Enter a token' }).click();
  await tab.page.getByLabel('Token', { exact: true }).last().fill('0'.repeat(64));
  await tab.page.getByRole('button', { name: 'Use this token' }).click();
  await tab.live();
  await tab.shows(/Rights at this address\s+read/);
  await tab.shows('The token of this tab is no longer valid', 'body');
  await tab.page.getByRole('button', { name: 'Enter a token' }).click();
  await tab.page.getByRole('button', { name: 'Forget the token' }).click();
  await tab.live();
  await gone(tab.page.locator('.notice'));

  // The page is opened at the address of `rp page`.
  const { printed } = await ask('rp page');
  const [, token] = printed.split('#token=');
  assert.match(token, /^[0-9a-f]{64}$/);
  await tab.page.goto('about:blank');
  await tab.page.goto(`${ADDRESS}#token=${token}`);
  await tab.live();
  await until('an address without it', async () => tab.fragment() === '#/');
  assert.ok(!tab.page.url().includes(token));
  const visited = await tab.page.evaluate(() => [location.href, document.referrer,
    ...performance.getEntries().map((entry) => entry.name)].join(' '));
  assert.ok(!visited.includes(`${ADDRESS}live?`), visited);
  await tab.page.getByRole('link', { name: 'Agent', exact: true }).click();
  await tab.shows(/Rights at this address\s+all/);
  await tab.page.getByRole('link', { name: 'Recordings', exact: true }).click();
  await tab.shows('Snapshots');
  // Going back does not lead to the address with the token.
  await tab.page.goBack();
  await tab.page.goBack();
  assert.ok(!tab.page.url().includes(token), tab.page.url());
  await tab.page.goForward();
  await tab.live();

  // The token is still there after a reload, but not in another tab.
  await tab.page.reload();
  await tab.page.getByRole('link', { name: 'Agent', exact: true }).click();
  await tab.shows(/Rights at this address\s+all/);
  const other = await open({ context, fragment: '#/agent' });
  await other.shows(/Rights at this address\s+read/);
  assert.equal(await other.page.evaluate(() => JSON.stringify({ ...localStorage })
    .includes('token')), false);

  const own = tab.requests.filter((request) => request.url().startsWith(ADDRESS));
  for (const request of own) {
    assert.ok(!request.url().includes(token), request.url());
    assert.ok(!(request.postData() ?? '').includes(token));
  }
  const sent = await Promise.all(own.filter((request) => request.url().endsWith('/live'))
    .map(async (request) => (await request.allHeaders()).authorization));
  assert.ok(sent.includes(`Bearer ${token}`), 'the header has it');
}

async function strict(open) {
  const tab = await open({ address: STRICT });
  tab.expect(REFUSED);
  await tab.page.getByRole('dialog', { name: 'Token' }).waitFor();
  await tab.shows('This address requires a token.', 'dialog');
  await tab.accessible('login');
  // A closed dialog opens again.
  await tab.page.keyboard.press('Escape');
  await gone(tab.page.getByRole('dialog', { name: 'Token' }));
  await tab.page.getByRole('button', { name: 'Enter a token' }).click();
  await tab.page.getByLabel('Token', { exact: true }).last().fill('not the right one');
  await tab.page.getByRole('button', { name: 'Use this token' }).click();
  await until('refused again', async () => (await tab.text('body')).includes('refused'));
  const dialog = tab.page.getByRole('dialog', { name: 'Token' });
  await dialog.waitFor();
  await tab.page.getByLabel('Token', { exact: true }).last().fill('0123456789abcdef0123');
  await tab.page.getByRole('button', { name: 'Use this token' }).click();
  await tab.live();
  await tab.heading('Overview');
  await gone(dialog);
  await tab.page.reload();
  await tab.live();
}

await scenario(async (open, browser) => {
  await loopback(open, browser);
  await strict(open);
});
