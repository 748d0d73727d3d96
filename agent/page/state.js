// The page's view of the robot: the lines of `GET /live` merged into one state.
//
// The agent sends the whole graph when its structure changes, and only the rows whose figures
// changed. The state is bounded: series keep ten minutes, events the latest thousand.

/** Points of a sparkline, and the seconds of each: the last ten minutes. */
export const STEPS = 60;
const STEP_SECONDS = 10;
/** Most events kept. */
export const MOST_EVENTS = 1000;

/**
 * @typedef {{id: number, guid: string, domain: number, vendor: string|null, host: string|null,
 *   pid: number|null, process: string|null, cgroup: string|null, container: string|null}} Participant
 * @typedef {{id: number, domain: number, name: string, participants: number[],
 *   hidden: boolean}} Node
 * @typedef {{topic: number, node: number, participant: number, guid: string, passages: number,
 *   reliability: string, durability: string}} Endpoint
 * @typedef {{id: number, domain: number, name: string, ddsName: string, kind: string,
 *   types: string[], hidden: boolean, vanished: boolean, measured: boolean, watched: number,
 *   publishers: Endpoint[], subscriptions: Endpoint[]}} Topic
 * @typedef {{rate: number|null, bandwidth: number|null, messages: number|null,
 *   lost: number|null, lostNow: number|null, p50: number|null, p99: number|null, flags: number,
 *   last: number|null, expected: number|null}} Figures
 * @typedef {{id: string, kind: string, severity: string, domain_id: number|null,
 *   topic: number|null, node: number|null, since: number|null, text: string,
 *   remedy: string|null, writer?: string, reader?: string, policies?: string[]}} Finding
 * @typedef {{id: string, time: string, name: string, severity: string,
 *   attributes: Record<string, unknown>}} Event
 */

/** @type {Figures} */
const NO_FIGURES = Object.freeze({
  rate: null, bandwidth: null, messages: null, lost: null, lostNow: null, p50: null, p99: null,
  flags: 0, last: null, expected: null,
});

/** A series of the last ten minutes in steps; a step is the mean of its values. */
export class Series {
  constructor() {
    /** @type {(number|null)[]} */ this.points = [];
    this.sum = 0;
    this.count = 0;
  }

  /** @param {number|null} value */
  add(value) {
    if (value == null) return;
    this.sum += value;
    this.count += 1;
  }

  /** Ends a step. */
  step() {
    this.points.push(this.count ? this.sum / this.count : null);
    if (this.points.length > STEPS) this.points.shift();
    this.sum = 0;
    this.count = 0;
  }
}

export class State {
  /** @type {any} */ open = null;
  /** @type {Map<number, Participant>} */ participants = new Map();
  /** @type {Map<number, Node>} */ nodes = new Map();
  /** @type {Map<number, Topic>} */ topics = new Map();
  /** Changes with the structure of the graph, not with its figures. */
  structure = 0;
  /** Programs and scripts of interpreters, by process id. */
  scripts = /** @type {Map<number, {process: string, script: string}>} */ (new Map());
  /** @type {Map<number, Figures>} */ figures = new Map();
  /** @type {Map<number, Series>} */ series = new Map();
  /** @type {{rate: number, bandwidth: number, lost: number, measured: number}} */
  totals = { rate: 0, bandwidth: 0, lost: 0, measured: 0 };
  totalSeries = [new Series(), new Series(), new Series()];
  /** @type {Finding[]} */ findings = [];
  /** @type {any} */ agent = null;
  /** @type {Event[]} */ events = [];
  missedEvents = 0;
  /** Time of the source's clock. */
  time = 0;
  stepBegan = 0;
  stepSeconds = STEP_SECONDS;
  /** @type {{part: number|null, finished: boolean, paused: boolean, speed: number}|null} */ replay = null;
  /** @type {string|null} */ ended = null;
  /** Complete batches of this run of the agent. */
  batches = 0;
  /** Number of streams that were opened. Events between two streams are not in either. */
  openings = 0;
  /** Whether this is the state of a moment in the past. */
  past = false;
  /** Whether nothing is known of that moment. */
  unknown = false;

  /** Resets the state for another run of the agent. */
  clear() {
    Object.assign(this, new State(), {
      structure: this.structure + 1, scripts: this.scripts, openings: this.openings,
    });
  }

  /**
   * Applies one line. Returns whether it completes a batch.
   * @param {Record<string, any>} line
   * @returns {boolean}
   */
  apply(line) {
    if (line.open) this.takeOpen(line.open);
    else if (line.graph) this.takeGraph(line.graph);
    else if (line.values) this.takeValues(line.values);
    else if (line.history) this.takeHistory(line.history);
    else if (line.findings) this.findings = line.findings;
    else if (line.agent) this.agent = line.agent;
    else if (line.events) this.takeEvents(line.events);
    else if (line.end) this.ended = line.end.reason;
    return Boolean(line.values || line.end);
  }

  /** Replaces the state by that of a moment in the past. @param {Record<string, any>[]} lines */
  show(lines) {
    this.clear();
    for (const line of lines) this.apply(line);
    this.past = true;
  }

  /** Replaces the state by an empty one, of a moment in the past of which nothing is known. @param {number} at */
  showUnknown(at) {
    const { open } = this;
    this.clear();
    Object.assign(this, { open, time: at, batches: 1, past: true, unknown: true });
  }

  /** @param {any} open */
  takeOpen(open) {
    this.openings += 1;
    if (!this.open || this.open.run !== open.run || this.past) this.clear();
    this.open = open;
    this.ended = null;
    this.figures.clear();
  }

  /** @param {any} graph */
  takeGraph(graph) {
    this.structure += 1;
    this.participants = new Map(graph.participants.map((/** @type {any[]} */ row) => {
      // The history may have rows of an agent that did not send the last element.
      const [id, guid, domain, vendor, announced, pid, process, cgroup, container = null] = row;
      // Control groups are known only for processes of this host.
      const host = announced ?? (cgroup == null ? null : this.open?.host ?? null);
      return [id, { id, guid, domain, vendor, host, pid, process, cgroup, container }];
    }));
    this.nodes = new Map(graph.nodes.map((/** @type {any[]} */ row) => {
      const [id, domain, name, participants, hidden] = row;
      return [id, { id, domain, name, participants, hidden: Boolean(hidden) }];
    }));
    this.topics = new Map(graph.topics.map((/** @type {any[]} */ row) => {
      const [id, domain, name, ddsName, kind, types, hidden, vanished, measured, watched] = row;
      return [id, {
        id, domain, name, ddsName, kind, types, hidden: Boolean(hidden),
        vanished: Boolean(vanished), measured: Boolean(measured), watched: watched ?? 0,
        publishers: [], subscriptions: [],
      }];
    }));
    for (const side of /** @type {const} */ (['publishers', 'subscriptions'])) {
      for (const row of graph[side]) {
        const [topic, node, participant, guid, passages, reliability, durability] = row;
        this.topics.get(topic)?.[side].push({
          topic, node, participant, guid, passages, reliability, durability,
        });
      }
    }
    for (const kept of [this.figures, this.series]) {
      for (const id of kept.keys()) if (!this.topics.has(id)) kept.delete(id);
    }
  }

  /** Takes the scripts that interpreters run. @param {any[]} processes as `GET /processes` has them */
  takeProcesses(processes) {
    const before = JSON.stringify([...this.scripts]);
    this.scripts = new Map(processes.filter(({ script }) => script).map(({ process_id: pid, process, script }) =>
      [pid, { process, script }]));
    if (JSON.stringify([...this.scripts]) !== before) this.structure += 1;
  }

  /**
   * Returns script or program of a process with its id: "robot.py 4711"; empty if it is unknown.
   * @param {{pid: number|null, process: string|null, cgroup?: string|null}|null|undefined} process a
   *   participant without a control group is on another host
   */
  processName(process) {
    const name = [process?.process, process?.pid].filter((part) => part != null).join(' ');
    return process?.cgroup === null ? name : this.withScripts(name);
  }

  /** Returns a text with the scripts of the processes that it names. @param {string} text */
  withScripts(text) {
    return text.replace(/(\S+) (\(?)(\d+)\b/g, (whole, name, open, pid) => {
      const own = this.scripts.get(Number(pid));
      return own && (name === 'process' || name === own.process) ? `${own.script} ${open}${pid}` : whole;
    });
  }

  /** @param {any} values */
  takeValues(values) {
    for (const row of values.topics) {
      const [id, rate, bandwidth, messages, lost, lostNow, p50, p99, flags, last, expected] = row;
      if (!this.topics.has(id)) continue;
      this.figures.set(id, {
        rate, bandwidth, messages, lost, lostNow, p50, p99, flags: flags ?? 0, last, expected,
      });
    }
    const [rate, bandwidth, lost, measured] = values.totals;
    this.totals = { rate, bandwidth, lost, measured };
    if (values.replay) {
      const [part, finished, paused, speed] = values.replay;
      this.replay = { part, finished: Boolean(finished), paused: Boolean(paused), speed };
    }
    this.advance(values.t);
    this.batches += 1;
  }

  /** @param {number} time */
  advance(time) {
    // A restarted replay, or a clock set back, begins a new step.
    if (time < this.time) this.stepBegan = time;
    this.time = time;
    for (const [id, figures] of this.figures) {
      if (figures.rate == null) continue;
      let series = this.series.get(id);
      if (!series) {
        series = new Series();
        this.series.set(id, series);
      }
      series.add(figures.rate);
    }
    const { rate, bandwidth, lost } = this.totals;
    [rate, bandwidth, lost].forEach((value, at) => this.totalSeries[at].add(value));
    if (!this.stepBegan) this.stepBegan = time;
    if (time - this.stepBegan < this.stepSeconds) return;
    this.stepBegan = time;
    for (const series of [...this.series.values(), ...this.totalSeries]) series.step();
  }

  /** @param {any} history */
  takeHistory(history) {
    this.series.clear();
    for (const [id, points] of history.topics) {
      const series = new Series();
      series.points = points.slice(-STEPS);
      this.series.set(id, series);
    }
    this.totalSeries = [0, 1, 2].map((at) => {
      const series = new Series();
      series.points = (history.totals[at] ?? []).slice(-STEPS);
      return series;
    });
    this.stepSeconds = history.step_seconds ?? STEP_SECONDS;
    this.stepBegan = history.t.length ? history.t[history.t.length - 1] : 0;
    this.time = this.stepBegan;
  }

  /** @param {{missed: number, list: Event[]}} events */
  takeEvents(events) {
    this.missedEvents += events.missed;
    this.addEvents(events.list);
  }

  /** Adds events, each once, in their order. @param {Event[]} list */
  addEvents(list) {
    const known = new Set(this.events.map((event) => event.id));
    const fresh = list.filter((event) => !known.has(event.id));
    if (!fresh.length) return;
    const all = [...this.events, ...fresh];
    // Sorted by time and by number: the ids of one run end in a growing number.
    const number = (/** @type {Event} */ event) => Number(event.id.split('-')[1] ?? 0);
    all.sort((one, other) => number(one) - number(other));
    this.events = all.slice(-MOST_EVENTS);
  }

  /** Returns current figures: only flags for an unmeasured topic. @param {number} id */
  figuresOf(id) {
    const own = this.figures.get(id) ?? NO_FIGURES;
    return this.topics.get(id)?.measured === false ? { ...NO_FIGURES, flags: own.flags } : own;
  }

  /** Returns the rates of a topic over the last ten minutes. @param {number} id */
  pointsOf(id) {
    return this.series.get(id)?.points ?? [];
  }

  /** Returns the names of a topic's flags. @param {number} id @returns {string[]} */
  flagsOf(id) {
    const { flags } = this.figuresOf(id);
    return (this.open?.flags ?? []).filter((/** @type {string} */ _, /** @type {number} */ bit) =>
      flags & (1 << bit));
  }

  /** Returns the names of an endpoint's passages. @param {number} mask @returns {string[]} */
  passagesOf(mask) {
    return (this.open?.passages ?? []).filter((/** @type {string} */ _,
      /** @type {number} */ bit) => mask & (1 << bit));
  }

  /** Returns whether the listener grants `read`, `watch` or `all`. @param {string} right */
  may(right) {
    const order = ['read', 'watch', 'all'];
    return order.indexOf(this.open?.access ?? '') >= order.indexOf(right);
  }

  /**
   * Returns the node of an endpoint, or its participant if it has no node.
   * @param {Endpoint} endpoint
   * @returns {{key: string, name: string, node: Node|null}}
   */
  ownerOf(endpoint) {
    const node = this.nodes.get(endpoint.node) ?? null;
    if (node) return { key: `node:${node.domain}:${node.name}`, name: node.name, node };
    const participant = this.participants.get(endpoint.participant);
    const guid = participant?.guid ?? endpoint.guid;
    const name = participant?.process ? `${this.processName(participant).replace(/ \d+$/, '')} (no node)` : guid;
    return { key: `participant:${participant?.domain ?? 0}:${guid}`, name, node: null };
  }

  /** @param {string} name @param {number|null} domain */
  topicNamed(name, domain) {
    return find(this.topics.values(), name, domain);
  }

  /** @param {string} name @param {number|null} domain */
  nodeNamed(name, domain) {
    return find(this.nodes.values(), name, domain);
  }

  /** Returns whether the graph spans several domains, so that names alone are ambiguous. */
  hasDomains() {
    let first = null;
    for (const participant of this.participants.values()) {
      first ??= participant.domain;
      if (participant.domain !== first) return true;
    }
    return false;
  }
}

/**
 * @template {{name: string, domain: number}} T
 * @param {Iterable<T>} things
 * @param {string} name
 * @param {number|null} domain
 * @returns {T|null}
 */
function find(things, name, domain) {
  for (const thing of things) {
    if (thing.name === name && (domain == null || thing.domain === domain)) return thing;
  }
  return null;
}

/**
 * Splits a stream of text into lines and parses each as JSON. An incomplete line waits for its
 * rest; an empty line is skipped.
 */
export class Lines {
  constructor() {
    this.rest = '';
  }

  /**
   * @param {string} text
   * @returns {Record<string, any>[]}
   * @throws {SyntaxError} for a line that is not JSON
   */
  take(text) {
    const lines = (this.rest + text).split('\n');
    this.rest = lines.pop() ?? '';
    return lines.filter((line) => line !== '').map((line) => JSON.parse(line));
  }
}
