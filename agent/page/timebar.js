// The time of a replay, to which the figures of every view refer.

import { date, duration, percent } from './format.js';
import { state, useLive } from './store.js';
import { html } from './ui.js';

export function TimeBar() {
  useLive();
  const begin = state.open?.replay?.begin;
  if (begin == null || !state.replay) return null;
  const { part, finished } = state.replay;
  const elapsed = Math.max(0, state.time - begin);
  const done = finished ? 1 : part;
  return html`<section class="timebar" aria-label="Time of the replay">
    <label>Replay
      <progress max="1" value=${done ?? undefined}></progress></label>
    <span>${date(state.time)}, ${duration(elapsed)} after the begin${
      finished ? ', finished' : done == null ? '' : `, ${percent(done)} read`}</span></section>`;
}
