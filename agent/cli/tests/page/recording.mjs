// A recording from its start to the downloaded file, and a snapshot.

import assert from 'node:assert/strict';
import { readFileSync } from 'node:fs';
import { ask, gone, scenario, until } from './tab.mjs';

await scenario(async (open) => {
  const tab = await open({ fragment: '#/recordings' });
  await tab.live();
  // The browser itself writes a refusal to the console.
  tab.expect(/the server responded with a status of 422/);
  await tab.shows('No recording yet.');
  // Without a robot the form has a field for the domain.
  await gone(tab.page.getByRole('spinbutton', { name: 'Domain' }));
  await tab.page.getByRole('combobox', { name: 'Topics' }).fill('/imu /scan');
  await tab.page.getByLabel('Name').fill('lap one');
  await tab.page.getByRole('button', { name: 'Start', exact: true }).click();
  // An invalid file name is refused with a message, and the form keeps its values.
  await tab.page.locator('main [role="alert"]').waitFor();
  assert.equal(await tab.page.getByLabel('Name').inputValue(), 'lap one');
  await tab.page.getByLabel('Name').fill('lap-one');
  await tab.page.getByRole('button', { name: 'Start', exact: true }).click();
  const card = tab.page.getByRole('region', { name: 'Recording lap-one' });
  await card.waitFor();
  await until('messages', async () => /[1-9][\d,]* messages/.test(await card.innerText()));
  assert.deepEqual((await ask('recordings')).names, ['lap-one']);
  assert.match(await card.innerText(), /, domain 0: /);

  await card.getByRole('button', { name: 'Pause lap-one' }).click();
  await until('paused', async () => (await card.innerText()).includes('paused'));
  await card.getByRole('button', { name: 'Continue lap-one' }).click();
  await until('recording', async () => (await card.innerText()).includes('recording'));
  await card.getByRole('button', { name: /^Split/ }).click();
  await until('two files', async () => (await card.innerText()).includes('in 2 files'));
  await tab.accessible('a recording');
  await card.getByRole('button', { name: 'Stop lap-one' }).click();
  await until('ended', async () => (await card.innerText()).includes('ended'));
  await gone(card.getByRole('button', { name: /^Pause/ }));

  await card.getByRole('button', { name: 'Files of lap-one' }).click();
  await card.getByText('metadata.yaml').waitFor();
  await until('both files', async () => (await card.innerText()).match(/\S+\.mcap/g)?.length === 2);
  const fetched = async (name) => {
    const waiting = tab.page.waitForEvent('download');
    await card.getByRole('button', { name: `Download ${name}`, exact: true }).click();
    const download = await waiting;
    assert.equal(download.suggestedFilename(), name);
    return readFileSync(await download.path());
  };
  const metadata = (await fetched('metadata.yaml')).toString();
  assert.match(metadata, /rosbag2_bagfile_information/);
  assert.ok(metadata.includes('/imu') && metadata.includes('/scan'), metadata);
  const names = (await card.locator('li').allInnerTexts()).map((text) => /\S+\.mcap/.exec(text)?.[0])
    .filter(Boolean);
  assert.equal(names.length, 2, await card.innerText());
  for (const name of names) {
    const bytes = await fetched(name);
    assert.equal(bytes.subarray(1, 5).toString(), 'MCAP', name);
    assert.equal(bytes.subarray(-7, -3).toString(), 'MCAP', `${name} is whole`);
    const { size } = await ask(`size ${name}`);
    assert.equal(bytes.length, size, `${name} is the agent's file`);
  }

  const row = tab.page.locator('section[aria-labelledby="snapshots"] tr', { hasText: 'incident' });
  await until('messages in memory', async () => /[1-9][\d,]* messages?,/.test(await row.innerText()));
  await row.getByRole('button', { name: 'Write now: snapshot incident' }).click();
  await until('a bag of it', async () => /[1-9][\d,]* messages in /.test(await row.innerText()));

  // The bags stay in the list after a restart of the agent. The browser reports the lost requests.
  tab.expect(/ERR_|Failed to load|Failed to fetch|NetworkError/);
  await ask('restart');
  await tab.go('#/recordings');
  const earlier = tab.page.locator('section[aria-labelledby="kept"]');
  await until('the earlier bags', async () => (await earlier.locator('tbody tr').count()) >= 3);
  const kept = earlier.locator('tr', { hasText: 'lap-one' });
  assert.doesNotMatch(await kept.innerText(), /cut off/);
  await kept.getByRole('button', { name: 'Files of lap-one' }).click();
  const waiting = tab.page.waitForEvent('download');
  await kept.getByRole('button', { name: 'Download metadata.yaml' }).click();
  assert.equal(readFileSync(await (await waiting).path()).toString(), metadata);
  await tab.accessible('earlier bags');

  // A bag of an incident leads to the robot as it was then.
  await earlier.getByRole('link', { name: /^expectation, / }).last().click();
  await tab.page.locator('.notice', { hasText: 'The robot as it was' }).waitFor();
  await tab.page.getByRole('heading', { name: '/imu', level: 1 }).waitFor();
  assert.match(await tab.page.evaluate(() => location.hash), /[?&]at=\d{10}/);
});
