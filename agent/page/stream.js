// The only stream of a tab: `GET /live`, reopened if it breaks, closed while the tab is hidden.

import { Refusal, request } from './api.js';
import { Lines } from './state.js';

/** Silence after which the connection counts as dead. */
const SILENCE_MS = 5000;
/** A hidden tab closes its stream after this; a quick change of tabs keeps it. */
const SLEEP_MS = 10000;
const FIRST_WAIT_MS = 1000;
const LONGEST_WAIT_MS = 10000;
/** Status of a busy agent. */
const BUSY = 503;

/** @typedef {'connecting'|'live'|'paused'|'past'|'asleep'|'lost'|'refused'} Status */

/**
 * Requests the state of the robot at a moment.
 * @param {number} at Unix time
 * @param {AbortSignal} signal
 * @returns {Promise<Record<string, any>[]>} its lines
 */
export async function moment(at, signal) {
  const response = await request(`history/moment?at=${at}`, { signal });
  return new Lines().take(await response.text());
}

export class Stream {
  /**
   * @param {import('./state.js').State} state
   * @param {() => void} changed called after each batch, and when the status changes
   */
  constructor(state, changed) {
    this.state = state;
    this.changed = changed;
    /** @type {Status} */ this.status = 'connecting';
    /** @type {Refusal|null} */ this.problem = null;
    /** @type {AbortController|null} */ this.connection = null;
    /** @type {number|null} Unix time of a moment in the past that is shown. */ this.at = null;
    /** Whether a moment is read again because its agent was out of reach or busy. */
    this.isRetrying = false;
    this.wait = FIRST_WAIT_MS;
    this.retry = 0;
    this.sleep = 0;
    document.addEventListener('visibilitychange', () => this.seen());
    // A page in the back-forward cache must not hold a stream.
    window.addEventListener('pagehide', () => this.close('asleep'));
    window.addEventListener('pageshow', (event) => {
      if (event.persisted) this.seen();
    });
  }

  /** Opens the stream unless it is open, paused or refused. */
  open() {
    if (this.connection || this.status === 'paused') return;
    clearTimeout(this.retry);
    this.isRetrying = false;
    this.become('connecting', this.problem);
    const connection = new AbortController();
    this.connection = connection;
    const { at } = this;
    const read = at == null ? this.follow(connection) : this.visit(connection, at);
    read.then(() => null, (error) => error).then((error) => {
      if (this.connection !== connection) return;
      this.connection = null;
      if (at == null) this.broken(error);
      else if (error) this.missed(at, error);
      else this.become('past', null);
    });
  }

  /** Shows a moment in the past, or the present. @param {number|null} at Unix time */
  go(at) {
    if (at === this.at) return;
    this.at = at;
    this.reopen();
  }

  /** Reads the state at a moment. @param {AbortController} connection @param {number} at */
  async visit(connection, at) {
    const lines = await moment(at, connection.signal);
    if (this.connection !== connection) return;
    this.wait = FIRST_WAIT_MS;
    this.state.show(lines);
  }

  /** @param {Status} status */
  close(status) {
    clearTimeout(this.retry);
    this.isRetrying = false;
    const connection = this.connection;
    this.connection = null;
    connection?.abort();
    this.become(status, null);
  }

  pause() {
    this.close('paused');
  }

  resume() {
    this.status = 'connecting';
    this.open();
  }

  /** Reopens the stream, for example with another token. */
  reopen() {
    this.close('connecting');
    this.wait = FIRST_WAIT_MS;
    this.open();
  }

  /** Handles that the tab was hidden or shown. */
  seen() {
    clearTimeout(this.sleep);
    if (document.visibilityState === 'hidden') {
      this.sleep = setTimeout(() => {
        if (this.status !== 'paused' && this.status !== 'refused') this.close('asleep');
      }, SLEEP_MS);
    } else if (this.status === 'asleep' || this.status === 'lost' || this.isRetrying) {
      this.wait = FIRST_WAIT_MS;
      this.open();
    }
  }

  /** @param {AbortController} connection */
  async follow(connection) {
    const silence = () => setTimeout(() => connection.abort(), SILENCE_MS);
    let watchdog = silence();
    try {
      const response = await request('live', { signal: connection.signal });
      const reader = /** @type {ReadableStream<Uint8Array>} */ (response.body).getReader();
      const decoder = new TextDecoder();
      const lines = new Lines();
      for (;;) {
        const { done, value } = await reader.read();
        if (done || this.connection !== connection) return;
        clearTimeout(watchdog);
        watchdog = silence();
        let whole = false;
        for (const line of lines.take(decoder.decode(value, { stream: true }))) {
          whole = this.state.apply(line) || whole;
        }
        if (whole) {
          this.wait = FIRST_WAIT_MS;
          this.become('live', null);
        }
      }
    } finally {
      clearTimeout(watchdog);
      connection.abort();
    }
  }

  /** @param {unknown} error */
  broken(error) {
    const refusal = error instanceof Refusal ? error : null;
    if (refusal?.status === 401) {
      this.become('refused', refusal);
      return;
    }
    this.become('lost', refusal);
    this.openAgain();
  }

  /**
   * Handles that a moment could not be read: its state is unknown, and that of no other time is shown.
   * @param {number} at @param {unknown} error
   */
  missed(at, error) {
    const refusal = error instanceof Refusal ? error : new Refusal(0, 'the connection was lost');
    if (refusal.status === 401) {
      if (this.state.batches > 0) this.state.showUnknown(at);
      this.become('refused', refusal);
      return;
    }
    this.state.showUnknown(at);
    this.isRetrying = refusal.status === 0 || refusal.status === BUSY;
    this.become('past', refusal);
    if (this.isRetrying) this.openAgain();
  }

  /** Opens again after a time that grows with each failure. A hidden tab waits until it is visible. */
  openAgain() {
    if (document.visibilityState === 'hidden') return;
    this.retry = setTimeout(() => this.open(), this.wait);
    this.wait = Math.min(LONGEST_WAIT_MS, this.wait * 2);
  }

  /** @param {Status} status @param {Refusal|null} problem */
  become(status, problem) {
    this.status = status;
    this.problem = problem;
    this.changed();
  }
}
