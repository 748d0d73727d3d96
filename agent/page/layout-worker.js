// Computes layouts outside of the page's thread. A result carries the number of its request.

import { layout } from './layout.js';

self.onmessage = ({ data }) => {
  const began = performance.now();
  const result = layout(data.vertices, data.edges, data.options);
  self.postMessage({ number: data.number, result, milliseconds: performance.now() - began });
};
