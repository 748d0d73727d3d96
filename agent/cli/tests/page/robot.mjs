// Every view of a running robot: its content, its address, and the keys that open it.
// Arguments: address, process id of the node /lidar.

import assert from 'node:assert/strict';
import { readFileSync } from 'node:fs';
import { show } from './scenes.mjs';
import { ask, gone, reads, scenario, there, until } from './tab.mjs';

const LIDAR = process.argv[3];

/** Returns the number at the start of a text such as "20.0 Hz". */
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
  await reads(first, /MB\/s/);
  // The robot has no fault that stops messages.
  const errors = await tab.page.locator('.findings li.error').allInnerTexts();
  // On a busy machine, messages may really be lost, which the page then reports.
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
  // The topics are sorted by rate, with the fastest first and absent rates last.
  await tab.page.getByRole('button', { name: /^Rate/ }).click();
  await until('sorted by rate', async () => (await names())[0] === '/imu');
  assert.equal(await tab.page.locator('th[aria-sort]').getAttribute('aria-sort'), 'descending');
  await tab.page.getByLabel('Filter').fill('point cloud2');
  await until('words filter', async () => JSON.stringify(await names()) === '["/points"]');
  const row = tab.page.locator('main tbody tr[data-row]');
  await reads(row, /sensor_msgs\/msg\/PointCloud2/);
  await reads(row, /[1-9][\d.]* Hz/);
  // The address has the sort key and the filter, so both survive a reload.
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
  await until('a rate', async () => /rate: last [1-9]/.test(await chart.getAttribute('aria-label')));
  // The chart continues, with one more second after each second.
  const seconds = () => tab.page.evaluate(() =>
    document.querySelector('.plot .uplot') && performance.now());
  assert.ok(await seconds());
  const table = tab.page.locator('figure', { hasText: 'Bandwidth' }).first();
  await table.getByRole('button', { name: 'Table' }).click();
  await until('values as a table', async () => (await table.locator('tbody tr').count()) > 0);
  await reads(table.locator('tbody tr').first(), /\d\d:\d\d:\d\d\s+[\d.]+ MB\/s/);
  await table.getByRole('button', { name: 'Table' }).click();
  // Keys move one cursor in all charts.
  await chart.focus();
  const shown = () => tab.page.locator('.u-legend .u-series:first-child .u-value').allInnerTexts();
  // New values redraw a chart and may take its cursor away.
  await until('one time in every chart', async () => {
    await tab.page.keyboard.press('ArrowLeft');
    const times = await shown();
    return times.length === 5 && times.every((each) => each === times[0]
      && /\d\d:\d\d/.test(each));
  });

  const publishers = tab.page.getByRole('group', { name: 'Publishers', exact: true });
  await until('the publisher', async () => (await publishers.innerText()).includes('/lidar'));
  await reads(publishers, LIDAR);
  const subscriptions = tab.page.getByRole('group', { name: 'Subscriptions', exact: true });
  await reads(subscriptions, /\/monitor|\/viz|\/[a-z_]+/);
  const qos = tab.page.locator('section[aria-labelledby="qos"]');
  await reads(qos, /Reliability/);
  assert.equal(await qos.locator('td.bad').count(), 0);
  const fall = tab.page.locator('section[aria-labelledby="waterfall"]');
  await until('deliveries', async () => (await fall.locator('tbody tr').count()) > 0);
  const cells = await until('more than 20 sent', async () => {
    const texts = await fall.locator('tbody tr').first().locator('td').allInnerTexts();
    const numbers = texts.map((text) => Number(text.replace(/[^\d]/g, '')));
    return numbers[0] > 20 && numbers;
  });
  const [sent, before, reassembly, socket, unknown, queue, delivered] = cells;
  const lost = before + reassembly + socket + unknown + queue;
  assert.equal(lost + delivered, sent, `adds up: ${cells}`);
  await tab.page.locator('section[aria-labelledby="definition"]')
    .getByRole('button', { name: 'Show' }).click();
  await tab.shows('uint32 height', 'section[aria-labelledby="definition"]');
}

/** Zooms with the wheel at the upper left corner of the graph, which moves the rest out of view. */
async function enlarge(tab, isEnough = async (scale) => scale > 2) {
  const canvas = tab.page.locator('.canvas');
  await until('a larger picture', async () => {
    const { x, y } = await canvas.boundingBox();
    await tab.page.mouse.move(x + 5, y + 5);
    await tab.page.mouse.wheel(0, -200);
    const transform = await canvas.locator('svg > g').getAttribute('transform');
    return isEnough(Number(/scale\(([\d.]+)\)/.exec(transform)[1]));
  });
}

/** Waits until a graph that was enlarged is shown anew: legible, in the window, not enlarged. */
const refitted = (tab, what) => until(`${what}, shown anew`, async () =>
  (await tab.legible(what)) < 15);

/** A wide window has the drawing alone, until something is chosen. */
async function alone(tab) {
  const { page } = tab;
  await page.setViewportSize({ width: 1920, height: 1080 });
  const canvas = page.locator('.canvas');
  const rest = async () => (await page.evaluate(() => document.documentElement.clientWidth))
    - (await canvas.boundingBox()).width;
  await until('a drawing as wide as the window', async () => (await rest()) < 40);
  assert.equal(await page.locator('#graph-panel').count(), 0);
  await page.getByRole('button', { name: /^\/lidar / }).focus();
  await until('details beside the drawing', async () => (await rest()) > 300
    && (await page.locator('#graph-panel').isVisible()));
  await page.getByRole('button', { name: 'Close the details' }).click();
  await page.setViewportSize({ width: 1280, height: 800 });
  await gone(page.locator('#graph-panel'));
}

/** The wheel zooms, as a hint says. Vertices out of view that keys reach are moved into view. */
async function walk(tab, vertex) {
  const { page } = tab;
  await page.getByText('The wheel zooms, dragging moves').waitFor();
  /** Whether a vertex is in the window of the graph as a whole. */
  const isSeen = (element) => {
    const [own, canvas] = [element, element.closest('.canvas') ?? document.querySelector('.canvas')]
      .map((each) => each.getBoundingClientRect());
    return element.hasAttribute('data-key') && own.left >= canvas.left && own.right <= canvas.right
      && own.top >= Math.max(0, canvas.top) && own.bottom <= Math.min(innerHeight, canvas.bottom);
  };
  await enlarge(tab);
  await vertex('/lidar').focus();
  const reached = new Set();
  for (const to of ['Right', 'Right', 'Down', 'Left', 'Down', 'Up']) {
    await page.keyboard.press(`Arrow${to}`);
    const focused = page.locator(':focus');
    await until(`the vertex to the ${to} is seen`, () => focused.evaluate(isSeen));
    reached.add(await focused.getAttribute('data-key'));
  }
  assert.ok(reached.size >= 2, `${[...reached]}`);
  // So does Tab.
  await page.getByRole('button', { name: 'Fit' }).click();
  const points = vertex('/points');
  await points.focus();
  await enlarge(tab, async () => !await points.evaluate(isSeen));
  await page.getByRole('button', { name: 'Zoom in' }).focus();
  await page.keyboard.press('Shift+Tab');
  await until('the vertex that Tab reaches is seen', () => points.evaluate(isSeen));
  assert.ok(await points.evaluate((own) => own === document.activeElement));
  await page.getByRole('button', { name: 'Fit' }).click();
  await page.getByRole('button', { name: 'Close the details' }).click();
  await gone(page.locator('#graph-panel'));
}

async function graph(tab) {
  await tab.page.getByRole('link', { name: 'In the graph' }).click();
  await tab.heading('Graph');
  assert.match(tab.fragment(), /focus=topic%3A0%3A%2Fpoints/);
  const vertex = (name) => tab.page.getByRole('button', { name: new RegExp(`^${name} `) });
  await vertex('/points').waitFor();
  await vertex('/lidar').waitFor();
  await gone(vertex('/cmd_vel'));
  await enlarge(tab);
  await tab.page.getByRole('button', { name: 'Show all' }).click();
  await vertex('/cmd_vel').waitFor();
  await refitted(tab, 'the graph without a focus');
  await gone(vertex('/rosout'));
  // One pair is within a process.
  const styles = await tab.inked();
  assert.ok(styles.network > 1 && styles.shared_memory && styles.unseen, JSON.stringify(styles));
  // The edges of /points transport megabytes and are wide.
  const widths = await until('edges', async () => {
    const all = await tab.page.locator('.edge .line').evaluateAll((lines) => lines.map((line) =>
      [line.parentNode.querySelector('title')?.textContent, Number(line.getAttribute('stroke-width'))]));
    return all.some(([, width]) => width > 4) && all;
  });
  const wide = widths.filter(([, width]) => width > 4);
  assert.ok(wide.every(([title]) => /MB\/s/.test(title)), JSON.stringify(widths));
  // The graph goes from left to right: a publisher is left of its topic.
  const [lidar, points] = [await vertex('/lidar').boundingBox(), await vertex('/points').boundingBox()];
  assert.ok(lidar.x + lidar.width <= points.x, 'left to right');
  // Keys move along the edges and select.
  await vertex('/lidar').focus();
  await tab.page.keyboard.press('ArrowRight');
  const focused = (name) => tab.page.evaluate((attribute) =>
    document.activeElement.getAttribute(attribute), name);
  await until('a key walks to a topic', async () => /topic/.test(await focused('class')));
  await tab.page.keyboard.press('Enter');
  await until('the panel', async () => (await focused('id')) === 'graph-panel');
  const scale = () => tab.page.locator('.canvas svg > g').getAttribute('transform');
  const before = await scale();
  await tab.page.getByRole('button', { name: 'Zoom in' }).click();
  await until('a larger picture', async () => (await scale()) !== before);
  await tab.page.getByRole('button', { name: 'Fit' }).click();
  // Names are legible, a field finds a vertex, and colours can mean something else.
  await tab.drawn();
  await tab.legible('the graph of the robot');
  await tab.page.getByRole('button', { name: 'Close the details' }).click();
  await gone(tab.page.locator('#graph-panel'));
  await alone(tab);
  await walk(tab, vertex);
  await tab.page.getByLabel('Find', { exact: true }).fill('imu_dri');
  await tab.page.keyboard.press('Enter');
  await reads(tab.page.locator('#graph-panel'), '/imu_driver');
  await tab.page.getByRole('combobox', { name: 'Colour' }).selectOption('process');
  await until('colours of processes', async () => (await tab.page.locator('.vertex.tinted').count()) >= 3);
  await tab.page.getByRole('combobox', { name: 'Colour' }).selectOption('');
  await gone(tab.page.locator('.vertex.tinted'));
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
  await there(vertex('/add_two_ints'));
  await tab.page.getByRole('checkbox', { name: /^services/ }).uncheck();
  await enlarge(tab);
  await tab.page.getByRole('combobox', { name: 'Boxes' }).selectOption('process');
  await until('boxes of processes', async () => (await tab.page.locator('.box').count()) >= 3);
  await refitted(tab, 'boxes of processes');
  await reads(tab.page.locator('.canvas'), LIDAR);
  // A box is closed and opened.
  const box = tab.page.locator('.box [role="button"]', { hasText: new RegExp(LIDAR) }).first();
  await box.focus();
  await tab.page.keyboard.press('Enter');
  await until('a closed box', async () => (await tab.page.locator('.vertex.box').count()) === 1);
  assert.match(tab.fragment(), /boxed=/);
  await tab.page.locator('.vertex.box').focus();
  await tab.page.keyboard.press('Enter');
  await until('an open box', async () => (await tab.page.locator('.vertex.box').count()) === 0);
  await tab.page.getByRole('combobox', { name: 'Boxes' }).selectOption('none');
  await enlarge(tab);
  await tab.page.getByRole('combobox', { name: 'Show' }).selectOption('nodes');
  await until('nodes only', async () => (await tab.page.locator('.vertex.topic').count()) === 0
    && (await tab.page.locator('.edge.active, .edge').count()) > 0);
  await refitted(tab, 'nodes only');
  await tab.page.getByRole('checkbox', { name: /^hubs/ }).check();
  await until('hubs', async () => (await tab.page.locator('.edge').count()) > 0);
}

/** Graphs of larger robots, on a laptop and on a phone: legible at first, and each edge is drawn. */
async function graphs(_, open, browser) {
  for (const [nodes, query, boxes] of [[60, '', 1], [200, '', 20], [200, '?fold=none&boxes=process', 50]]) {
    for (const [width, height] of [[1280, 800], [390, 844]]) {
      const context = await browser.newContext({ viewport: { width, height }, reducedMotion: 'reduce' });
      await show(context, nodes);
      const tab = await open({ context, fragment: `#/graph${query}` });
      await tab.page.locator('.vertex').first().waitFor();
      await tab.drawn();
      const what = `${nodes} nodes${query} at ${width} px`;
      const size = await tab.legible(what);
      const styles = await tab.inked();
      const edges = Object.values(styles).reduce((sum, each) => sum + each, 0);
      const shown = await tab.page.locator('.box, .vertex.box').count();
      assert.ok(edges >= 15 && shown >= boxes, `${what}: ${edges} edges, ${shown} boxes`);
      console.log(`${what}: ${size.toFixed(1)} px, ${edges} edges, ${shown} boxes`);
      // From one node to all: the picture of all decides what is folded, not that of the node.
      if (nodes === 200 && !query) {
        await tab.page.evaluate((key) => {
          location.hash = `#/graph?focus=${encodeURIComponent(key)}`;
        }, 'node:0:/part_0/node_0');
        await tab.page.reload();
        await tab.page.locator('.vertex').first().waitFor();
        await tab.page.getByRole('button', { name: 'Show all' }).click();
        await until(`${what}, after one`, async () =>
          (await tab.page.locator('.box, .vertex.box').count()) >= boxes
          && (await tab.legible(what)) < 15);
      }
      await tab.page.close();
      await context.close();
    }
  }
}

async function nodes(tab) {
  await tab.page.getByRole('link', { name: 'Nodes', exact: true }).click();
  await tab.heading('Nodes');
  const row = tab.page.locator('main tbody tr', { hasText: '/lidar' });
  await until('CPU and memory of the process', async () => /[\d.]+ %.*[\d.]+ MB/s
    .test(await row.innerText()));
  await reads(row, LIDAR);
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
  await tab.shows('node appeared');
  const rows = () => tab.page.locator('main tbody tr').count();
  // Endpoints come by the dozen with each node and are hidden at first.
  const notable = await rows();
  assert.equal(await tab.page.getByText('endpoint appeared').count(), 0);
  await tab.page.getByRole('combobox', { name: /^Show/ }).last().selectOption('ALL');
  const all = await until('all events', async () => (await rows()) > notable && rows());
  await tab.page.getByLabel('Filter').fill('/lidar');
  await until('filtered events', async () => (await rows()) > 0 && (await rows()) < all);
  await tab.page.getByRole('button', { name: 'Pause' }).last().click();
  const held = await rows();
  // Another node appears while the list is not scrolled.
  await ask('another node');
  await tab.page.getByLabel('Filter').fill('late_comer');
  await tab.shows(/Continue \(\d+ new event/);
  await until(`none of the ${held} rows that are held`, async () => (await rows()) === 0);
  await tab.page.getByRole('button', { name: /^Continue/ }).click();
  await until('events go on', async () => (await rows()) > 0);
}

async function agent(tab) {
  await tab.page.getByRole('link', { name: 'Agent', exact: true }).click();
  await tab.heading('Agent');
  await tab.shows('The agent sees the robot.');
  for (const part of ['Limits in use', 'the sockets of this host', 'Abilities',
    'Not counted or dropped', 'topics']) {
    await tab.shows(part);
  }
}

async function keys(tab) {
  await tab.go('');
  await tab.search('imu');
  await tab.shows(/topic\s+\/imu\s/, 'dialog');
  await tab.shows(/node\s+\/imu_driver\s/, 'dialog');
  await tab.page.keyboard.press('Enter');
  await until('the first result', async () => /#\/(topics|nodes)\/%2Fimu/.test(tab.fragment()));
  await gone(tab.page.locator('dialog'));
  // A service is found as well, and the arrow keys lead to results.
  await tab.search('add_two');
  await tab.shows(/service\s+\/add_two_ints/, 'dialog');
  await tab.page.keyboard.press('ArrowDown');
  await until('a result has the focus', async () => /add_two_ints/.test(
    await tab.page.evaluate(() => document.activeElement.textContent)));
  await tab.escape();
  await tab.page.keyboard.press('?');
  await tab.page.getByRole('dialog', { name: 'Keys' }).waitFor();
  await tab.escape();
  for (const [key, name] of [['t', 'Topics'], ['g', 'Graph'], ['c', 'Chains'], ['n', 'Nodes'],
    ['e', 'Events'], ['r', 'Recordings'], ['a', 'Agent'], ['o', 'Overview']]) {
    await tab.jump(key, name);
    await until('the title', async () => (await tab.page.title()).startsWith(`${name} · `));
  }
  // Pause closes the stream; a notice explains that the figures are not updated.
  await tab.page.keyboard.press('p');
  await tab.shows('Paused: the figures below are not updated.', 'body');
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
  await until('the filter of before', async () =>
    (await tab.page.getByLabel('Filter').inputValue()) === 'imu');
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

await scenario(async (open, browser) => {
  const tab = await open();
  await tab.live();
  for (const part of [overview, topics, topic, graph, graphs, nodes, events, agent, keys, links]) {
    const began = Date.now();
    await part(tab, open, browser);
    console.log(`${part.name}: ${Date.now() - began} ms`);
  }
});
