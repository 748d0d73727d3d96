// Chains of real nodes in a capture: the list with configured chains first, the waterfall whose
// bars agree with GET /chains, and the path in the graph. Then no chain, thousands, and no agent.
// Argument: address. Configured: /points to /cmd with 20 ms, /points to /filtered with 50 ms, and
// /camera to /steering, which does not exist.

import assert from 'node:assert/strict';
import { ask, gone, reads, scenario, there, until } from './tab.mjs';

const CHAIN = '#/chains/%2Fpoints?to=%2Fcmd';
const WAY = ['/sensor', '/points', '/filter', '/filtered', '/controller', '/cmd'];

const UNITS = { 's': 1, 'ms': 1e-3, 'µs': 1e-6 };
/** Returns the seconds of a text such as "13.0 ms". */
const seconds = (text) => {
  const [, number, unit] = /([\d.]+) (s|ms|µs)/.exec(text);
  return Number(number) * UNITS[unit];
};

function close(found, wanted, what, part = 0.006) {
  assert.ok(Math.abs(found - wanted) <= part * Math.abs(wanted),
    `${what}: ${found}, not ${wanted}`);
}

const rows = (tab) => tab.page.locator('main tbody tr[data-row]');

/** Returns the positions of the bar of a row, as ratios of the axis. */
const bar = (row) => row.evaluate((element) => {
  const share = (each, name) => Number(each.getAttribute(name).replace('%', '')) / 100;
  const svg = element.querySelector('svg.track');
  const parts = [...svg.querySelectorAll('rect.part')].map((each) => ({
    name: each.getAttribute('class').replace('part ', ''), x: share(each, 'x'),
    width: share(each, 'width'), drawn: each.getBoundingClientRect().width }));
  const limit = svg.querySelector('.limit');
  return { parts, start: parts[0].x, width: parts.reduce((sum, { width }) => sum + width, 0),
    drawn: parts.reduce((sum, { drawn }) => sum + drawn, 0),
    whisker: share(svg.querySelector('.whisker'), 'x2'), limit: limit && share(limit, 'x1') };
});

async function list(tab) {
  await tab.go('#/chains');
  await tab.heading('Chains');
  await until('three chains', async () => (await rows(tab).count()) === 3);
  const { expected } = await ask('/chains');
  const found = await rows(tab).allInnerTexts();
  for (const [at, [name, state]] of [['/points → /cmd', 'slow'], ['/points → /filtered', 'ok'],
    ['/camera → /steering', 'idle']].entries()) {
    assert.ok(found[at].startsWith(name), found[at]);
    assert.ok(found[at].includes(state), found[at]);
    assert.equal(expected[at].state, state);
  }
  const cells = await rows(tab).first().locator('td.number').allInnerTexts();
  const [limit, p50, p99] = cells.map((text) => /\ds$|s$/.test(text) && seconds(text));
  close(limit, 0.02, 'limit');
  close(p50, expected[0].latency.p50_seconds, 'p50');
  close(p99, expected[0].latency.p99_seconds, 'p99');
  // The address has the sort key p99 and the filter, which matches a node within the chains.
  await tab.page.getByRole('button', { name: 'p99' }).click();
  await tab.page.getByRole('button', { name: 'p99' }).click();
  await until('the fastest first', async () =>
    (await rows(tab).first().innerText()).startsWith('/points → /filtered'));
  await tab.page.getByLabel('Filter').fill('controller');
  await until('one chain', async () => (await rows(tab).count()) === 1);
  assert.equal(tab.fragment(), '#/chains?sort=p99&filter=controller');
  await tab.page.getByLabel('Filter').fill('no such chain');
  await tab.shows('No chain matches.');
}

/** Moves from the list to the second chain with keys only. */
async function keys(tab) {
  await tab.go('#/chains');
  await there(rows(tab));
  await rows(tab).first().locator('a').focus();
  await tab.page.keyboard.press('ArrowDown');
  await until('the next chain', async () => (await tab.page.evaluate(
    () => document.activeElement.textContent)) === '/points → /filtered');
  await tab.page.keyboard.press('Enter');
  await tab.heading('/points → /filtered');
  // A part of a longer chain, with a single hop, so that no hop is marked as the slowest.
  await until('one hop', async () => (await rows(tab).count()) === 2);
  assert.equal(await tab.page.locator('.waterfall .badge').count(), 0);
  await tab.jump('c', 'Chains');
}

async function bars(tab) {
  await tab.go(CHAIN);
  await tab.heading('/points → /cmd');
  await until('hops', async () => (await rows(tab).count()) === 3);
  const { chains: [chain] } = await ask('/chains?from=/points&to=/cmd');
  assert.equal(chain.hops.length, 2);
  const all = [];
  for (const row of await rows(tab).all()) all.push(await bar(row));
  const [total] = all.slice(-1);
  const scale = total.width / chain.latency.p50_seconds;
  let begin = 0;
  for (const [at, hop] of chain.hops.entries()) {
    const { start, width, drawn, whisker, parts } = all[at];
    const { p50_seconds: p50, p99_seconds: p99 } = hop.latency;
    assert.ok(Math.abs(start - begin) < 1e-4, `hop ${at} begins at ${start}, not ${begin}`);
    begin += width;
    close(width, p50 * scale, `width of hop ${at}`);
    close(drawn / total.drawn, p50 / chain.latency.p50_seconds, `pixels of hop ${at}`, 0.02);
    close(whisker - start, p99 * scale, `whisker of hop ${at}`);
    assert.deepEqual(parts.map(({ name }) => name), ['transit', 'processing']);
    close(parts[1].width / width, hop.processing.p50_seconds
      / (hop.processing.p50_seconds + hop.transit.p50_seconds), `parts of hop ${at}`);
    assert.ok(parts[0].x < parts[1].x, 'transit comes first');
    const row = rows(tab).nth(at);
    await reads(row, hop.node);
    await reads(row, `${hop.input} → ${hop.output}`);
    const figures = await row.locator('td.number').allInnerTexts();
    [p50, p99, hop.latency.maximum_seconds].forEach((wanted, place) =>
      close(seconds(figures[place]), wanted, `figure ${place} of hop ${at}`));
    const texts = await row.locator('.parts').innerText();
    close(seconds(/transit ([\d.]+ \S+)/.exec(texts)[1]), hop.transit.p50_seconds, 'transit');
    close(seconds(/node ([\d.]+ \S+)/.exec(texts)[1]), hop.processing.p50_seconds, 'node');
    assert.equal(await row.locator('.badge', { hasText: 'bottleneck' }).count(),
      at === chain.bottleneck ? 1 : 0);
  }
  close(total.whisker, chain.latency.p99_seconds * scale, 'whisker of the whole');
  close(total.limit, 0.02 * scale, 'the limit');
  await reads(rows(tab).last(), 'End to end');
  await tab.shows(/Recognised by\s+stamps/);
  await tab.shows(/slow/);
  // A capture has no calls, and the agent says so.
  await tab.page.getByRole('button', { name: 'Why late?' }).click();
  await tab.shows(/Late calls are not reported/);
  // Screen readers have a table with a name for each column and row.
  const table = tab.page.getByRole('table', { name: 'Hops of the chain' });
  assert.deepEqual((await table.getByRole('columnheader').allInnerTexts()).map((text) =>
    text.trim().split('\n')[0]).filter((text) => /^(Hop|p50|p99|max)/.test(text)),
  ['Hop', 'p50', 'p99', 'max']);
  assert.equal(await table.getByRole('rowheader').count(), 3);
  await tab.page.reload();
  await tab.live();
  await tab.heading('/points → /cmd');
}

async function graph(tab) {
  await tab.go(CHAIN);
  await tab.page.getByRole('link', { name: 'In the graph' }).click();
  await tab.heading('Graph');
  const passed = tab.page.locator('.vertex.passed');
  await until('the way', async () => (await passed.count()) === WAY.length);
  const names = await passed.evaluateAll((all) => all.map((each) => [
    Number(/(\d+) of 6 in the chain/.exec(each.getAttribute('aria-label'))[1]),
    each.querySelector('tspan').textContent.trim()]).sort().map(([, name]) => name));
  assert.deepEqual(names, WAY);
  assert.equal(await tab.page.locator('.edge.passed').count(), 5);
  const beside = tab.page.locator('.vertex:not(.passed)', { hasText: '/restamper' });
  assert.equal(await beside.count(), 1);
  const stroke = (locator) => locator.first().evaluate((each) => {
    const { stroke: colour, strokeWidth } = getComputedStyle(each.querySelector('rect, .line'));
    return [colour, parseFloat(strokeWidth)];
  });
  const edges = tab.page.locator('.edge:not(.passed)');
  for (const [one, other] of [[passed, beside], [tab.page.locator('.edge.passed'), edges]]) {
    const [[colour, width], [faded, thin]] = [await stroke(one), await stroke(other)];
    assert.notEqual(colour, faded);
    assert.ok(width > thin, `${width} and ${thin} wide`);
  }
  // The whole path is visible, and keys move along it.
  const { x, width } = await tab.page.locator('.canvas').boundingBox();
  for (const vertex of await passed.all()) {
    const box = await vertex.boundingBox();
    assert.ok(box.x >= x && box.x + box.width <= x + width, 'in view');
  }
  await tab.page.getByRole('button', { name: /^\/controller / }).focus();
  await tab.page.keyboard.press('ArrowRight');
  await until('a key walks to /cmd', async () => /^\/cmd .*6 of 6 in the chain/.test(
    await tab.page.evaluate(() => document.activeElement.getAttribute('aria-label'))));
  await reads(tab.page.locator('#graph-panel'), /In the chain\s+\/points → \/cmd/);

  await tab.page.getByRole('checkbox', { name: 'only this chain' }).check();
  await until('the chain alone', async () => (await tab.page.locator('.vertex').count()) === 6);
  await tab.page.getByRole('combobox', { name: 'Show' }).selectOption('nodes');
  await until('its nodes', async () => (await passed.count()) === 3
    && (await tab.page.locator('.edge.passed').count()) === 2);
  await tab.page.getByRole('combobox', { name: 'Show' }).selectOption('both');
  await tab.page.getByRole('combobox', { name: 'Chain' }).selectOption('');
  await until('no chain', async () => (await passed.count()) === 0
    && (await tab.page.locator('.traced').count()) === 0);
  await until('all others', async () => (await tab.page.locator('.vertex').count()) > 6);
  assert.doesNotMatch(tab.fragment(), /chain|only|way/);
  // A topic of a chain offers to highlight it.
  await tab.page.getByRole('button', { name: /^\/filtered / }).focus();
  await tab.page.locator('#graph-panel').getByRole('button', { name: 'Highlight' }).click();
  await until('the way again', async () => (await passed.count()) === WAY.length);
  await tab.page.getByRole('link', { name: 'Open the chain' }).click();
  await tab.heading('/points → /cmd');

  await tab.go('#/graph?chain=%2Fno_such_topic');
  await tab.shows('The chain from /no_such_topic does not exist now.');
  assert.equal(await tab.page.locator('.traced').count(), 0);
}

async function links(tab) {
  for (const [view, name] of [['topics', '/filtered'], ['nodes', '/filter']]) {
    await tab.go(`#/${view}/${encodeURIComponent(name)}`);
    await tab.shows('Part of the chain /points → /cmd');
    await tab.page.getByRole('link', { name: '/points → /cmd' }).click();
    await tab.heading('/points → /cmd');
    await tab.page.locator('.waterfall').getByRole('link', { name, exact: true }).first().click();
    await tab.heading(name);
  }
  await tab.go('#/topics/%2Ffresh');
  await tab.shows('sensor_msgs/msg/PointCloud2');
  assert.doesNotMatch(await tab.text(), /Part of/);
  await tab.go('#/chains/%2Fcamera?to=%2Fsteering');
  await tab.shows('no message has passed it so far');
  await tab.go('#/chains/%2Fcmd?to=%2Fpoints');
  await tab.shows('No such chain now.');
  // The finding about the slow chain has a link to the chain.
  await tab.go('#/');
  const finding = tab.page.locator('.findings li', { hasText: 'chain from /points to /cmd' });
  await finding.getByRole('link', { name: 'Chains' }).click();
  await tab.heading('Chains');
  await until('the slow chain', async () => (await rows(tab).count()) === 1);
}

async function everywhere(open) {
  for (const [theme, width, height, scale] of [['light', 1280, 800, 1], ['dark', 1280, 800, 1],
    ['light', 360, 740, 3], ['dark', 320, 256, 4]]) {
    const tab = await open({ theme, width, height, scale });
    await tab.live();
    for (const [fragment, ready] of [['#/chains', 'tbody tr[data-row]'], [CHAIN, '.track'],
      ['#/chains/%2Fcamera?to=%2Fsteering', '.empty'],
      ['#/graph?chain=%2Fpoints&to=%2Fcmd', '.vertex.passed']]) {
      await tab.go(fragment);
      await tab.page.locator(ready).first().waitFor({ state: 'attached' });
      await tab.accessible(`${theme}, ${width} px: ${fragment}`);
      await tab.narrow(`${theme}, ${width} px: ${fragment}`);
    }
    await tab.page.close();
  }
}

/** Shows thousands of chains, of which only a few rows are in the document at the same time. */
async function thousands(open) {
  const tab = await open();
  await tab.live();
  const { chains: [one] } = await ask('/chains');
  let answer = { chains: [], expected: [] };
  await tab.page.route(/^http:\/\/[^/]+\/chains(\?|$)/, (route) => route.fulfill({ json: answer }));
  await tab.go('#/chains');
  await tab.shows('No chain has been found.');
  await tab.shows('their types begin with a header');
  await tab.accessible('no chain');

  answer = { expected: [], chains: Array.from({ length: 3000 }, (_, at) => ({
    ...one, from: `/from_${at}`, hops: one.hops.map((hop, place) => (place ? hop
      : { ...hop, input: `/from_${at}` })) })) };
  await tab.go('#/chains');
  await tab.shows('3,000 chains');
  await there(rows(tab));
  assert.ok((await rows(tab).count()) < 120, `${await rows(tab).count()} rows`);
  await tab.go('#/topics/%2Fcmd');
  await tab.shows(/Part of the chains .* and 2,995 more/);
  await tab.go('#/graph');
  const options = tab.page.getByRole('combobox', { name: 'Chain' }).locator('option');
  await until('chains to choose from', async () => (await options.count()) === 201);

  const name = (at) => (at === 0 ? '/points' : `/topic_${at}`);
  answer = { expected: [], chains: [{ ...one, to: name(2000), bottleneck: 1999,
    hops: Array.from({ length: 2000 }, (_, at) => ({ ...one.hops[at % 2], node: `/node_${at}`,
      input: name(at), output: name(at + 1) })) }] };
  await tab.go('#/chains/%2Fpoints');
  await until('hops', async () => (await rows(tab).count()) > 3);
  assert.ok((await rows(tab).count()) < 120, `${await rows(tab).count()} rows`);
  await until('the end', async () => {
    await tab.page.mouse.wheel(0, 100_000);
    const last = await rows(tab).last().innerText();
    return last.startsWith('End to end') && (await rows(tab).count()) < 120;
  });
  await tab.page.close();
}

await scenario(async (open) => {
  const tab = await open();
  await tab.live();
  for (const part of [list, keys, bars, graph, links]) {
    const began = Date.now();
    await part(tab);
    console.log(`${part.name}: ${Date.now() - began} ms`);
  }
  await everywhere(open);
  await thousands(open);

  // The agent has ended: the figures stay, and the page shows why they are old.
  await tab.go(CHAIN);
  await until('hops', async () => (await rows(tab).count()) === 3);
  tab.expect(/^error: Failed to load resource: net::ERR_/);
  await ask('end');
  await tab.shows('No connection', 'body');
  await tab.shows('The chain is not updated: the agent does not answer.');
  assert.equal(await rows(tab).count(), 3);
  await tab.accessible('without an agent');
  await gone(tab.page.locator('dialog'));
});
