// Lays graphs out beside the page's own thread. Answers bear the number of their question.

import { layout } from './layout.js';

self.onmessage = ({ data }) => {
  const began = performance.now();
  const result = layout(data.vertices, data.edges, data.options);
  self.postMessage({ number: data.number, result, milliseconds: performance.now() - began });
};
