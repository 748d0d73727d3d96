// Every view of a robot that runs: what it shows, its address, the keys that lead to it.
// Arguments: address, process id of the node /lidar.

import assert from 'node:assert/strict';
import { readFileSync } from 'node:fs';
import { ask, scenario, until } from './tab.mjs';

const LIDAR = process.argv[3];

/** The number at the begin of a text such as "20.0 Hz". */
const leading = (text) => Number(/-?[\d.]+/.exec(text)?.[0]);

async function overview(tab) {
  await tab.heading('Overview');
  await tab.shows('/points', 'section[aria-labelledby="busiest"]');
  const messages = await until('messages a second', async () => {
    const text = await tab.page.locator('.figure', { hasText: 'messages a second' })
      .locator('.value').innerText();
    return leading(text) > 30 && text;
  });
  assert.match(messages, /\/s$/);
  const first = tab.page.locator('section[aria-labelledby="busiest"] tbody tr').first();
  await until('/points is the busiest', async () => (await first.innerText()).includes('/points'));
  assert.match(await first.innerText(), /MB\/s/);
  // The robot has no mistake in it that stops messages.
  const errors = await tab.page.locator('.findings li.error').allInnerTexts();
  // A machine that is busy with other tests loses messages, which is true and found.
  assert.deepEqual(errors.filter((text) => !text.includes('loses messages')), []);
}

async function topics(tab) {
  await tab.page.getByRole('link', { name: 'Topics', exact: true }).click();
  await tab.heading('Topics');
  assert.equal(tab.fragment(), '#/topics');
  const names = async () => (await tab.page.locator('main tbody tr[data-row] th').allInnerTexts())
    .map((text) => text.trim());
  await until('topics of the robot', async () => {
    const all = await names();
    return ['/cmd_vel', '/imu', '/points', '/scan'].every((name) => all.includes(name));
  });
  assert.ok(!(await names()).includes('/rosout') || (await names()).length > 4);
  // Sorted by rate, the fastest first; an absent rate is last.
  await tab.page.getByRole('button', { name: /^Rate/ }).click();
  await tab.page.getByRole('button', { name: /^Rate/ }).click();
  await until('sorted by rate', async () => (await names())[0] === '/imu');
  assert.equal(await tab.page.locator('th[aria-sort]').getAttribute('aria-sort'), 'descending');
  await tab.page.getByLabel('Filter').fill('point cloud2');
  await until('words filter', async () => JSON.stringify(await names()) === '["/points"]');
  const row = await tab.page.locator('main tbody tr[data-row]').innerText();
  assert.match(row, /sensor_msgs\/msg\/PointCloud2/);
  assert.match(row, /[1-9][\d.]* Hz/, 'the rate of /points');
  // The address has it all: it survives a reload and can be passed on.
  assert.equal(tab.fragment(), '#/topics?sort=-rate&filter=point+cloud2');
  await tab.page.reload();
  await tab.live();
  await until('the filter stays', async () => JSON.stringify(await names()) === '["/points"]');
  await tab.page.getByLabel('Filter').fill('nothing has this name');
  await tab.shows('No topic matches.');
  await tab.page.getByLabel('Filter').fill('');
  await until('no filter', async () => (await names()).length > 3);
}

async function topic(tab) {
  await tab.page.getByRole('link', { name: '/points', exact: true }).click();
  await tab.heading('/points');
  assert.equal(tab.fragment(), '#/topics/%2Fpoints?domain=0');
  await until('charts', async () => (await tab.page.locator('.plot canvas').count()) === 5);
  const chart = tab.page.getByRole('img', { name: /^Rate over the last ten minutes/ });
  assert.match(await chart.getAttribute('aria-label'), /rate: last [1-9]/);
  // The chart goes on: a second later there is another second.
  const seconds = () => tab.page.evaluate(() =>
    document.querySelector('.plot .uplot') && performance.now());
  assert.ok(await seconds());
  const table = tab.page.locator('figure', { hasText: 'Bandwidth' }).first();
  await table.getByRole('button', { name: 'Table' }).click();
  await until('values as a table', async () => (await table.locator('tbody tr').count()) > 0);
  assert.match(await table.locator('tbody tr').first().innerText(), /\d\d:\d\d:\d\d\s+[\d.]+ MB\/s/);
  await table.getByRole('button', { name: 'Table' }).click();
  // One cursor for all charts, moved by keys.
  await chart.focus();
  await tab.page.keyboard.press('ArrowLeft');
  const shown = () => tab.page.locator('.u-legend .u-series:first-child .u-value').allInnerTexts();
  await until('one time in every chart', async () => {
    const times = await shown();
    return times.length === 5 && times.every((each) => each === times[0]
      && /\d\d:\d\d/.test(each));
  });

  const publishers = tab.page.getByRole('group', { name: 'Publishers', exact: true });
  await until('the publisher', async () => (await publishers.innerText()).includes('/lidar'));
  assert.ok((await publishers.innerText()).includes(LIDAR), 'its process');
  const subscriptions = tab.page.getByRole('group', { name: 'Subscriptions', exact: true });
  assert.match(await subscriptions.innerText(), /\/monitor|\/viz|\/[a-z_]+/);
  const qos = tab.page.locator('section[aria-labelledby="qos"]');
  assert.match(await qos.innerText(), /Reliability/);
  assert.equal(await qos.locator('td.bad').count(), 0);
  const fall = tab.page.locator('section[aria-labelledby="waterfall"]');
  await until('deliveries', async () => (await fall.locator('tbody tr').count()) > 0);
  const cells = await fall.locator('tbody tr').first().locator('td').allInnerTexts();
  const [sent, ...rest] = cells.map((text) => Number(text.replace(/[^\d]/g, '')));
  assert.ok(sent > 20, `sent: ${cells}`);
  const [before, reassembly, socket, unknown, delivered] = rest;
  assert.equal(before + reassembly + socket + unknown + delivered, sent, `adds up: ${cells}`);
  await tab.page.locator('section[aria-labelledby="definition"]')
    .getByRole('button', { name: 'Show' }).click();
  await tab.shows('uint32 height', 'section[aria-labelledby="definition"]');
}

async function graph(tab) {
  await tab.page.getByRole('link', { name: 'In the graph' }).click();
  await tab.heading('Graph');
  assert.match(tab.fragment(), /focus=topic%3A0%3A%2Fpoints/);
  const vertex = (name) => tab.page.getByRole('button', { name: new RegExp(`^${name} `) });
  await vertex('/points').waitFor();
  await vertex('/lidar').waitFor();
  assert.equal(await vertex('/cmd_vel').count(), 0, 'one hop from /points');
  await tab.page.getByRole('button', { name: 'Show all' }).click();
  await vertex('/cmd_vel').waitFor();
  assert.equal(await vertex('/rosout').count(), 0, 'hubs are folded');
  // What flows: the edges of /points carry megabytes and are wide.
  const widths = await until('edges', async () => {
    const all = await tab.page.locator('.edge .line').evaluateAll((lines) => lines.map((line) =>
      [line.parentNode.querySelector('title')?.textContent, Number(line.getAttribute('stroke-width'))]));
    return all.some(([, width]) => width > 4) && all;
  });
  const wide = widths.filter(([, width]) => width > 4);
  assert.ok(wide.every(([title]) => /MB\/s/.test(title)), JSON.stringify(widths));
  // From left to right: a publisher stands left of its topic.
  const [lidar, points] = [await vertex('/lidar').boundingBox(), await vertex('/points').boundingBox()];
  assert.ok(lidar.x + lidar.width <= points.x, 'left to right');
  // Keys walk along the edges and choose.
  await vertex('/lidar').focus();
  await tab.page.keyboard.press('ArrowRight');
  await until('a key walks to a topic', async () => /class|topic/.test(
    await tab.page.evaluate(() => document.activeElement.getAttribute('class'))));
  assert.match(await tab.page.evaluate(() => document.activeElement.getAttribute('class')), /topic/);
  await tab.page.keyboard.press('Enter');
  assert.equal(await tab.page.evaluate(() => document.activeElement.id), 'graph-panel');
  const scale = () => tab.page.locator('.canvas svg > g').getAttribute('transform');
  const before = await scale();
  await tab.page.getByRole('button', { name: 'Zoom in' }).click();
  assert.notEqual(await scale(), before);
  await tab.page.getByRole('button', { name: 'Fit' }).click();
  // Positions stay while figures change.
  const place = await vertex('/lidar').boundingBox();
  await new Promise((wake) => setTimeout(wake, 2500));
  assert.deepEqual(await vertex('/lidar').boundingBox(), place, 'the picture is stable');

  const file = async (name) => {
    const waiting = tab.page.waitForEvent('download');
    await tab.page.getByRole('button', { name, exact: true }).click();
    return readFileSync(await (await waiting).path(), 'utf8');
  };
  const svg = await file('SVG');
  assert.match(svg, /^<svg[^>]*xmlns="http:\/\/www.w3.org\/2000\/svg"/);
  assert.ok(svg.includes('/points') && !svg.includes('var(--missing'));
  const dot = await file('DOT');
  assert.match(dot, /^digraph/);
  assert.ok(dot.includes('/lidar') && dot.includes('->'), dot);

  await tab.page.getByRole('checkbox', { name: /^services/ }).check();
  await until('services', async () => (await tab.page.locator('.vertex.service').count()) > 0);
  assert.ok(await vertex('/add_two_ints').count(), 'the service of /base');
  await tab.page.getByRole('checkbox', { name: /^services/ }).uncheck();
  await tab.page.getByRole('combobox', { name: 'Boxes' }).selectOption('process');
  await until('boxes of processes', async () => (await tab.page.locator('.box').count()) >= 3);
  assert.match(await tab.page.locator('.canvas').innerText(), new RegExp(LIDAR));
  // A box closes and opens.
  const box = tab.page.locator('.box [role="button"]', { hasText: new RegExp(LIDAR) }).first();
  await box.focus();
  await tab.page.keyboard.press('Enter');
  await until('a closed box', async () => (await tab.page.locator('.vertex.box').count()) === 1);
  assert.match(tab.fragment(), /boxed=/);
  await tab.page.locator('.vertex.box').focus();
  await tab.page.keyboard.press('Enter');
  await until('an open box', async () => (await tab.page.locator('.vertex.box').count()) === 0);
  await tab.page.getByRole('combobox', { name: 'Boxes' }).selectOption('none');
  await tab.page.getByRole('combobox', { name: 'Show' }).selectOption('nodes');
  await until('nodes only', async () => (await tab.page.locator('.vertex.topic').count()) === 0
    && (await tab.page.locator('.edge.active, .edge').count()) > 0);
  await tab.page.getByRole('checkbox', { name: /^hubs/ }).check();
  await until('hubs', async () => (await tab.page.locator('.edge').count()) > 0);
}

async function nodes(tab) {
  await tab.page.getByRole('link', { name: 'Nodes', exact: true }).click();
  await tab.heading('Nodes');
  const row = tab.page.locator('main tbody tr', { hasText: '/lidar' });
  await until('CPU and memory of the process', async () => /[\d.]+ %.*[\d.]+ MB/s
    .test(await row.innerText()));
  assert.ok((await row.innerText()).includes(LIDAR));
  await tab.page.getByRole('link', { name: '/lidar', exact: true }).click();
  await tab.heading('/lidar');
  for (const part of ['Publishers (', '/points', '/scan', 'sensor_msgs/msg/PointCloud2', LIDAR,
    /Parameters: the node has (no )?parameter services\./]) {
    await tab.shows(part);
  }
  await tab.go('#/nodes/%2Fbase');
  await tab.shows('/add_two_ints');
}

async function events(tab) {
  await tab.page.getByRole('link', { name: 'Events', exact: true }).click();
  await tab.heading('Events');
  await tab.shows('ros2.node.');
  const rows = () => tab.page.locator('main tbody tr').count();
  const all = await rows();
  await tab.page.getByLabel('Filter').fill('/lidar');
  await until('filtered events', async () => (await rows()) > 0 && (await rows()) < all);
  await tab.page.getByRole('button', { name: 'Pause' }).last().click();
  const held = await rows();
  // Another node comes while the list stands still.
  await ask('another node');
  await tab.page.getByLabel('Filter').fill('late_comer');
  await tab.shows(/Continue \(\d+ new event/);
  assert.equal(await rows(), 0, `${held} rows are held`);
  await tab.page.getByRole('button', { name: /^Continue/ }).click();
  await until('events go on', async () => (await rows()) > 0);
}

async function agent(tab) {
  await tab.page.getByRole('link', { name: 'Agent', exact: true }).click();
  await tab.heading('Agent');
  await tab.shows('The agent sees the robot.');
  await tab.shows('Limits in use');
  const text = await tab.text();
  for (const part of ['the sockets of this host', 'Abilities', 'Not counted or dropped', 'topics']) {
    assert.ok(text.includes(part), part);
  }
}

async function keys(tab) {
  await tab.go('');
  await tab.page.keyboard.press('/');
  await tab.page.getByRole('dialog', { name: 'Search' }).waitFor();
  await tab.page.keyboard.type('imu');
  await tab.shows(/topic\s+\/imu\s/, 'dialog');
  await tab.shows(/node\s+\/imu_driver\s/, 'dialog');
  await tab.page.keyboard.press('Enter');
  await until('the first result', async () => /#\/(topics|nodes)\/%2Fimu/.test(tab.fragment()));
  assert.equal(await tab.page.locator('dialog').count(), 0);
  // A service is found as well, and the arrow keys lead to results.
  await tab.page.keyboard.press('/');
  await tab.page.keyboard.type('add_two');
  await tab.shows(/service\s+\/add_two_ints/, 'dialog');
  await tab.page.keyboard.press('ArrowDown');
  assert.match(await tab.page.evaluate(() => document.activeElement.textContent), /add_two_ints/);
  await tab.page.keyboard.press('Escape');
  await until('no dialog', async () => (await tab.page.locator('dialog').count()) === 0);
  await tab.page.keyboard.press('?');
  await tab.page.getByRole('dialog', { name: 'Keys' }).waitFor();
  await tab.page.keyboard.press('Escape');
  for (const [key, name] of [['t', 'Topics'], ['g', 'Graph'], ['n', 'Nodes'], ['e', 'Events'],
    ['r', 'Recordings'], ['a', 'Agent'], ['o', 'Overview']]) {
    await tab.page.keyboard.press('g');
    await tab.page.keyboard.press(key);
    await tab.heading(name);
    await until('the title', async () => (await tab.page.title()).startsWith(`${name} · `));
  }
  // Pause closes the stream; the figures stand still and say so.
  await tab.page.keyboard.press('p');
  await tab.shows('Paused: the figures below stand still.', 'body');
  await tab.page.keyboard.press('p');
  await tab.live();
}

async function links(tab) {
  await tab.go('#/topics?filter=imu');
  await tab.page.getByRole('link', { name: '/imu', exact: true }).click();
  await tab.heading('/imu');
  await tab.page.getByRole('link', { name: 'Graph', exact: true }).click();
  await tab.heading('Graph');
  await tab.page.goBack();
  await tab.heading('/imu');
  await tab.page.goBack();
  await tab.heading('Topics');
  assert.equal(await tab.page.getByLabel('Filter').inputValue(), 'imu');
  await tab.page.goForward();
  await tab.heading('/imu');
  for (const [fragment, heading] of [['#/topics/%2Fscan', '/scan'], ['#/nodes/%2Fmonitor', '/monitor'],
    ['#/graph?mode=nodes', 'Graph'], ['#/events?severity=WARN', 'Events'], ['#/agent', 'Agent'],
    ['#/nowhere', 'No such view'], ['#/topics/%2Fno_such_topic', '/no_such_topic'],
    ['#/topics/%', 'No such view']]) {
    await tab.go(fragment);
    await tab.heading(heading);
  }
}

await scenario(async (open) => {
  const tab = await open();
  await tab.live();
  for (const part of [overview, topics, topic, graph, nodes, events, agent, keys, links]) {
    const began = Date.now();
    await part(tab);
    console.log(`${part.name}: ${Date.now() - began} ms`);
  }
});
