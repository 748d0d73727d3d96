// What the charts of a view have in common: marks of events, and one cursor.

import { until } from './tab.mjs';

/** What Chromium writes when a test reads pixels back, which the page does not. */
export const READBACK = /^warning: Canvas2D: Multiple readback/;

/** Lets the history answer with one warning, some seconds before the end of a time. */
export async function warn(page, before) {
  await page.route('**/history/events*', (route) => {
    const to = Number(new URL(route.request().url()).searchParams.get('to'));
    const time = new Date(1000 * (to - before)).toISOString();
    const event = { id: 4e9, name: 'ros2.test', severity: 'WARN', time, attributes: {} };
    return route.fulfill({ contentType: 'application/x-ndjson', body: `${JSON.stringify(event)}\n` });
  });
}

/** Returns the most pixels in one column of each chart that have the colour of a warning. */
const longest = (page) => page.locator('.plot canvas').evaluateAll((all) => {
  const style = getComputedStyle(document.documentElement);
  const colour = style.getPropertyValue('--warning').trim();
  const wanted = [1, 3, 5].map((at) => parseInt(colour.slice(at, at + 2), 16));
  return all.map((canvas) => {
    const { width, height } = canvas;
    const { data } = canvas.getContext('2d').getImageData(0, 0, width, height);
    const columns = new Array(width).fill(0);
    for (let at = 0; at < data.length; at += 4) {
      const isMark = data[at + 3] > 60
        && wanted.every((value, part) => Math.abs(data[at + part] - value) < 36);
      if (isMark) columns[(at / 4) % width] += 1;
    }
    return Math.max(...columns);
  });
});

/** Waits until a view has this many charts, each with the dashed line of a warning. */
export const marked = (page, number) => until(`a mark in each of ${number} charts`, async () => {
  const found = await longest(page);
  if (found.length === number && found.every((pixels) => pixels > 20)) return true;
  throw new Error(`pixels: ${found}`);
});

/** Moves the mouse over a chart, and waits until every chart has its cursor at that time. */
export async function shared(page, chart) {
  const over = chart.locator('.u-over');
  await over.scrollIntoViewIfNeeded();
  let step = 0;
  await until('one cursor in every chart', async () => {
    step += 1;
    const { x, y, width } = await over.boundingBox();
    await page.mouse.move(x + width * 0.3 + (step % 2), y + 20);
    const all = await page.locator('.uplot').evaluateAll((plots) => plots.map((plot) => {
      const [cursor, begin] = ['.u-cursor-x', '.u-over'].map((part) =>
        plot.querySelector(part).getBoundingClientRect().left);
      const time = /(\d\d):(\d\d):(\d\d)/.exec(plot.querySelector('.u-legend .u-value').textContent);
      return cursor >= begin && time ? time[1] * 3600 + time[2] * 60 + Number(time[3]) : null;
    }));
    if (all.every((time) => time != null && Math.abs(time - all[0]) <= 2)) return true;
    throw new Error(`seconds of the day: ${all}`);
  });
}
