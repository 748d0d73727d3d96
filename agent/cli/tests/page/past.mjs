// What happened before the agent and the robot were restarted: the history on disk shows the former
// robot's topics, charts, processes and events, and the page returns to the present.

import assert from 'node:assert/strict';
import { marked, READBACK, shared, warn } from './charts.mjs';
import { ask, gone, reads, scenario, there, until } from './tab.mjs';

await scenario(async (open) => {
  const { begin, end } = await ask('another robot after a restart');
  const tab = await open({ fragment: '#/topics' });
  await tab.live();
  const { page } = tab;
  const row = (name) => page.locator('main tbody tr[data-row]', { hasText: name });
  await row('/after_restart').waitFor();
  assert.equal(await row('/imu').count(), 0, 'the former robot is gone');

  // An address of the past shows the robot as it was.
  await page.goto(`${page.url().split('#')[0]}#/topics?at=${end}&span=${end - begin}`);
  await reads(page.locator('.notice'), 'The robot as it was');
  await until('its figures', async () => /Hz/.test(await row('/imu').innerText()));
  assert.equal(await row('/after_restart').count(), 0);
  const chart = row('/imu').locator('.spark path');
  await until('its small chart', async () => /L/.test(await chart.getAttribute('d')));
  await tab.accessible('the past');
  // No switch of the past changes what is measured now.
  assert.equal(await page.locator('main button.switch:enabled').count(), 0);

  // Its links keep the time.
  await row('/imu').getByRole('link', { name: '/imu' }).click();
  const charts = page.locator('.chart');
  await there(charts);
  assert.ok(page.url().includes(`at=${end}`), page.url());
  const rate = charts.filter({ has: page.getByRole('heading', { name: 'Rate' }) });
  // The chart has the maximum of the history, which a busy machine changes.
  const { rate_hertz: hertz } = await page.evaluate((path) => fetch(path).then((answer) => answer.json()),
    `topics/%2Fimu/history?from=${begin}&to=${end}`);
  const most = Math.max(...hertz.filter((value) => value != null));
  const shown = await until('the maximum rate', async () =>
    Number(/maximum (\d[\d.]*) Hz/.exec(await rate.innerText())?.[1]));
  assert.ok(most > 20 && Math.abs(shown - most) < 0.02 * most, `${shown} Hz, not ${most} Hz`);
  await tab.accessible('a topic of the past');

  // A part of a chart is dragged over, and shown alone; the browser's Back returns.
  const before = page.url();
  const over = rate.locator('.u-over');
  const box = await over.boundingBox();
  await page.mouse.move(box.x + box.width * 0.4, box.y + 40);
  await page.mouse.down();
  await page.mouse.move(box.x + box.width * 0.8, box.y + 40, { steps: 4 });
  await page.mouse.up();
  await until('a shorter time', async () => {
    const span = Number(/span=(\d+)/.exec(page.url())?.[1]);
    return span >= 5 && span < end - begin;
  });
  await page.goBack();
  await until('the time before', async () => page.url() === before);

  // Every chart of a topic and of a process marks the events of its time, and has the same cursor.
  tab.expect(READBACK);
  await warn(page, 15);
  await page.reload();
  await marked(page, 5);
  await shared(page, rate);
  await page.goto(`${before.split('#')[0]}#/nodes/%2Flidar?at=${end}&span=${end - begin}`);
  await marked(page, 2);
  await shared(page, charts.first());
  await page.unroute('**/history/events*');

  // Events and processes of that time.
  await page.getByRole('link', { name: 'Events', exact: true }).first().click();
  await reads(page.locator('main'), 'node appeared');
  await page.getByRole('navigation').getByRole('link', { name: 'Nodes' }).click();
  await page.getByRole('link', { name: '/lidar', exact: true }).first().click();
  await there(page.locator('.chart').filter({ has: page.getByRole('heading', { name: 'CPU' }) }));
  // The QoS of a topic that no longer exists, CPU and services of a node, and a view without a past.
  await page.goto(`${page.url().split('#')[0]}#/topics/%2Fimu?at=${end}&span=${end - begin}`);
  await reads(page.locator('main'), /Quality of service[^]*offered by[^]*Reliability/);
  // The rate of its publisher.
  await reads(page.getByRole('group', { name: 'Publishers' }), /Rate[^]*\d Hz\s/);
  await reads(page.locator('main'), /Where messages are lost[^]*Delivered/);
  await tab.accessible('the QoS of the past');
  await page.goto(`${page.url().split('#')[0]}#/nodes?at=${end}&span=${end - begin}`);
  await until('its CPU', async () => /%/.test(await row('/lidar').innerText()));
  await page.getByRole('navigation').getByRole('link', { name: 'Recordings' }).click();
  await reads(page.locator('main'), 'This view has no history');

  // A time without an agent.
  await page.goto(`${page.url().split('#')[0]}#/topics?at=1000000`);
  await reads(page.locator('.notice'), 'The robot’s state at that time is unknown');
  tab.expect(/^error: Failed to load resource.*404/);
  // No other time is shown in its place.
  await gone(page.locator('main tbody tr[data-row]'));
  await page.goto(`${page.url().split('#')[0]}#/?at=1000000`);
  await reads(page.locator('main'), 'not known');
  assert.doesNotMatch(await tab.text(), /Nothing is broken/);
  // A bookmark of it is not stuck, and one of a moment that is lost on the way is read again.
  await page.goto('about:blank');
  await page.goto(`${tab.address}#/topics?at=1000000`);
  await reads(page.locator('.notice'), 'The robot’s state at that time is unknown');
  await tab.accessible('a time without an agent');
  tab.expect(/^error: Failed to load resource: net::ERR_/);
  await page.route('**/history/moment*', (route) => route.abort());
  await page.goto(`${page.url().split('#')[0]}#/topics?at=${end}`);
  await reads(page.locator('.notice'), 'Trying again');
  await gone(page.locator('main tbody tr[data-row]'));
  await page.unroute('**/history/moment*');
  await reads(page.locator('.notice'), 'The robot as it was');
  await row('/imu').waitFor();

  await page.getByRole('button', { name: 'Now' }).click();
  await tab.live();
  await row('/after_restart').waitFor();
  await gone(page.locator('.notice'));

  // The present has its events again after the past.
  await page.getByRole('navigation').getByRole('link', { name: 'Events' }).click();
  await reads(page.locator('main'), '/other');
  await page.getByRole('button', { name: 'Earlier' }).click();
  await page.getByRole('button', { name: 'Now' }).click();
  await tab.live();
  await reads(page.locator('main'), /node appeared[^]*\/other/);

  // The graph compared with a moment before the restart. The new agent may have written a state since.
  await page.goto(`${page.url().split('#')[0]}#/graph?against=${Math.floor(Date.now() / 1000) - end}`);
  const differences = page.getByRole('region', { name: 'Differences' });
  await reads(differences, /New nodes[^]*\/other/);
  await reads(differences, /Nodes that went[^]*\/lidar/);
  for (const what of ['.vertex.node.came', '.vertex.node.gone', '.vertex.topic.came', '.edge.came', '.edge.gone']) {
    await there(page.locator(what));
  }
  await there(page.getByRole('button', { name: /^− \/lidar .*, went/ }));
  await tab.inked();

  // In the past, each moment has a comparison of its own. Two moments without /lidar are shown: a minute
  // before the first one it was still there.
  const [first, second] = [end + 100, end + 200];
  const former = await page.evaluate((at) => fetch(`history/moment?at=${at}`).then((answer) => answer.text()), end);
  const without = former.split('\n').map((line) => {
    const { graph } = line.startsWith('{"graph"') ? JSON.parse(line) : {};
    return graph ? JSON.stringify({ graph: { ...graph, nodes: graph.nodes.filter((row) => row[2] !== '/lidar') } }) : line;
  }).join('\n');
  await page.route('**/history/moment*', async (route) => {
    const at = Number(new URL(route.request().url()).searchParams.get('at'));
    const lines = (at < first ? former : without).replace(/"t":[\d.]+/, `"t":${at}`);
    await route.fulfill({ contentType: 'application/x-ndjson', body: lines });
  });
  await page.goto(`${page.url().split('#')[0]}#/graph?against=60&at=${first}`);
  await reads(differences, /Nodes that went[^]*\/lidar/);
  await page.goto(`${page.url().split('#')[0]}#/graph?against=60&at=${second}`);
  await reads(differences, /the same nodes, topics and QoS/);
  const moved = await differences.innerText();
  await page.goto('about:blank');
  await page.goto(`${tab.address}#/graph?against=60&at=${second}`);
  await reads(differences, /the same nodes, topics and QoS/);
  assert.equal(await differences.innerText(), moved);
});
