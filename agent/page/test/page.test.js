import assert from 'node:assert/strict';
import { readdirSync, readFileSync } from 'node:fs';
import { dirname, join } from 'node:path';
import { test } from 'node:test';
import { fileURLToPath } from 'node:url';
import { gzipSync } from 'node:zlib';

const PAGE = join(dirname(fileURLToPath(import.meta.url)), '..');
/** Over a weak radio link of 1 Mbit/s, a page of this size loads in 1.5 s. */
const MOST_BYTES = 190_000;

/** Files that the agent serves. */
const served = readdirSync(PAGE, { recursive: true, withFileTypes: true })
  .filter((entry) => entry.isFile())
  .map((entry) => join(entry.parentPath ?? entry.path, entry.name).slice(PAGE.length + 1))
  .filter((path) => !path.startsWith('test/') && /\.(html|css|js|mjs|svg)$/.test(path))
  .sort();
const text = (/** @type {string} */ path) => readFileSync(join(PAGE, path), 'utf8');
const own = served.filter((path) => !path.startsWith('vendor/'));

test('the whole page is at most 190 KB, compressed', (context) => {
  let total = 0;
  for (const path of served) total += gzipSync(readFileSync(join(PAGE, path)), { level: 9 }).length;
  context.diagnostic(`${served.length} files, ${total} bytes compressed`);
  assert.ok(served.length > 20);
  assert.ok(total <= MOST_BYTES, `${total} bytes`);
});

test('every module is loaded ahead, and nothing that does not exist', () => {
  const named = [...text('index.html').matchAll(/(?:href|src)="page\/([^"]+)"/g)]
    .map(([, path]) => path);
  // The worker imports the layout.
  const late = new Set(['index.html', 'layout.js', 'layout-worker.js']);
  assert.deepEqual(named.sort(), served.filter((path) => !late.has(path)));
});

// Statements of modules, including minified ones in a single line.
const IMPORT = /(?:^|[;}])\s*(?:import|export)[^'"`;]*from\s*['"]([^'"]+)['"]/gm;

test('imports lead to files of the page', () => {
  for (const path of served.filter((each) => /\.m?js$/.test(each))) {
    for (const [, to] of text(path).matchAll(IMPORT)) {
      assert.match(to, /^\.\.?\//, `${path} imports ${to}`);
      assert.ok(served.includes(join(path, '..', to)), `${path} imports ${to}`);
    }
  }
});

test('nothing leads to another origin, and nothing is inline', () => {
  for (const path of own) {
    const addresses = text(path).match(/(?:https?:)?\/\/[a-z0-9.-]+\.[a-z]{2,}[^\s'"]*/gi) ?? [];
    // SVG's namespace is a name, not an address that is requested.
    const foreign = addresses.filter((each) => !each.startsWith('http://www.w3.org/'));
    assert.deepEqual(foreign, [], path);
    assert.doesNotMatch(text(path), /innerHTML|dangerouslySetInnerHTML|\beval\(|new Function/, path);
  }
  const html = text('index.html');
  assert.doesNotMatch(html, /<style|\sstyle=|\son[a-z]+=|<script(?![^>]*\ssrc=)/);
});

test('no class has a rule of its own and refines another one', () => {
  const css = text('app.css').replace(/\/\*[^]*?\*\//g, '').replace(/:not\([^)]*\)|\[[^\]]*\]/g, '');
  const alone = new Set();
  const refining = new Set();
  for (const [, selectors] of css.matchAll(/([^{}]+)\{/g)) {
    for (const selector of selectors.split(',').map((each) => each.trim())) {
      const parts = selector.replace(/::?[a-z-]+/g, '').split(/[\s>+~]+/);
      for (const part of parts) {
        const [first, ...more] = part.match(/\.[a-z][\w-]*/gi) ?? [];
        more.forEach((each) => refining.add(each));
        if (parts.length === 1 && part === first) alone.add(first);
      }
    }
  }
  assert.ok(alone.has('.reader-only') && refining.has('.unseen'), [...alone].join(' '));
  assert.deepEqual([...alone].filter((each) => refining.has(each)), []);
});

/** @param {string} colour such as `#12ab34` */
function luminance(colour) {
  const parts = [1, 3, 5].map((at) => parseInt(colour.slice(at, at + 2), 16) / 255)
    .map((part) => (part <= 0.04045 ? part / 12.92 : ((part + 0.055) / 1.055) ** 2.4));
  return 0.2126 * parts[0] + 0.7152 * parts[1] + 0.0722 * parts[2];
}

/** @param {string} one @param {string} other */
function contrast(one, other) {
  const [a, b] = [luminance(one), luminance(other)].sort((x, y) => y - x);
  return (a + 0.05) / (b + 0.05);
}

test('text has a contrast of 4.5, lines of 3, in both themes', () => {
  const blocks = [...text('app.css').matchAll(/color-scheme: (?:light|dark);([^}]+)\}/g)];
  assert.equal(blocks.length, 3);
  const themes = blocks.map(([, block]) => Object.fromEntries(
    [...block.matchAll(/(--[a-z0-9-]+): (#[0-9a-f]{6})/g)].map(([, name, value]) => [name, value])));
  assert.deepEqual(themes[1], themes[2], 'dark by choice is dark by preference');
  const papers = ['--paper', '--panel', '--error-paper', '--warning-paper', '--note-paper',
    '--good-paper', '--node'];
  for (const theme of themes) {
    for (const paper of papers) {
      for (const ink of ['--ink', '--dim', '--accent', '--error', '--warning', '--note', '--good']) {
        const found = contrast(theme[ink], theme[paper]);
        assert.ok(found >= 4.5, `${ink} on ${paper}: ${found.toFixed(2)}`);
      }
    }
    for (const line of ['--line-1', '--line-2', '--line-3', '--line-4', '--line-5',
      '--line-6', '--edge', '--focus']) {
      assert.ok(contrast(theme[line], theme['--paper']) >= 3, line);
    }
    assert.ok(contrast(theme['--accent-ink'], theme['--accent']) >= 4.5);
  }
});

test('nothing is explained only by a tooltip, which keys and touch do not open', () => {
  // A shortened name has its whole text in other places: in its view, or below it.
  const known = { 'ui.js': 1, 'views/events.js': 1 };
  const found = Object.fromEntries(own.filter((path) => path.endsWith('.js')).map((path) =>
    [path, [...text(path).matchAll(/<[a-z][^<>]*?\stitle=/g)].length]).filter(([, number]) => number));
  assert.deepEqual(found, known);
});
