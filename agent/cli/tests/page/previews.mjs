// Messages with a small picture: an image, a compressed one, a map, a scan, poses and a path. The
// pixels of the canvas are those of the messages.

import assert from 'node:assert/strict';
import { reads, scenario, until } from './tab.mjs';

/** Colour of the line of a path (`--line-1`). */
const LINE = [11, 92, 173];
const TOPICS = [
  ['/image', /20 × 10 pixels/, [[5, 5, [200, 30, 10]]], /data \(600\)/],
  ['/jpeg', /an image in png/, [[0, 0, [255, 0, 0]]], null],
  // The free, the occupied and the unknown cell.
  ['/map', /3 × 1 pixels/, [[0, 0, [255, 255, 255]], [1, 0, [0, 0, 0]], [2, 0, [150, 170, 180]]], null],
  ['/scan', /100 of 100 points from above, \d\.\d m wide/, [], /ranges \(100\)/],
  ['/odom', /1 pose, and the way to it from above/, [], null],
  ['/goal', /1 pose, and the way to it from above/, [], null],
  // A metre ahead, which is up on the right side, and then a metre to the left, which is at the top.
  ['/plan', /3 poses from above/, [[305, 160, LINE], [160, 14, LINE]], null],
];

await scenario(async (open) => {
  const tab = await open({ fragment: '#/topics' });
  await tab.live();
  // This test reads pixels back; the page does not.
  tab.expect(/^warning: Canvas2D: Multiple readback/);
  for (const [topic, words, pixels, folded] of TOPICS) {
    await tab.go(`#/topics/${encodeURIComponent(topic)}?domain=0`);
    const section = tab.page.locator('section[aria-labelledby="live"]');
    const canvas = section.locator('canvas[aria-label^="Preview"]');
    await reads(section, words);
    const colour = (x, y) => canvas.evaluate((own, [left, top]) =>
      [...own.getContext('2d').getImageData(left, top, 1, 1).data].slice(0, 3), [x, y]);
    for (const [x, y, expected] of pixels) {
      await until(`${topic} at ${x}, ${y}`, async () => {
        const found = await colour(x, y);
        return expected.every((part, at) => Math.abs(part - found[at]) <= 2);
      });
    }
    const painted = () => canvas.evaluate((own) => {
      const { data } = own.getContext('2d').getImageData(0, 0, own.width, own.height);
      return data.filter((value, at) => at % 4 === 3 && value > 0).length;
    });
    await until(`${topic} is drawn`, async () => (await painted()) > (pixels.length ? 0 : 50));
    // A long array takes one line until it is opened.
    if (folded) {
      await reads(section, folded);
      assert.equal(await section.getByRole('rowheader', { name: '[0]', exact: true }).count(), 0);
    }
    await tab.accessible(`the picture of ${topic}`);
  }
});
