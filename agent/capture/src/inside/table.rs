//! The observed processes: their names, budgets, and changes since the last report.

use std::collections::{BTreeSet, HashMap, HashSet};
use std::path::Path;
use std::sync::Arc;
use std::time::Duration;

use ros2probe_attach::client::Broker;
use ros2probe_model::derive::chain::causality::CausalPublication;
use ros2probe_model::facts::bounded::Bounded;
use ros2probe_model::facts::calls::late::{CpuLimit, LateCall, MessageDelivery};
use ros2probe_model::facts::calls::other_thread::OtherThread;
use ros2probe_model::facts::calls::report::{
    BufferReport, CallbackReport, Durations, ProcessReport, PublisherReport, Report,
    SubscriptionReport, ThreadStates, Transition, Trigger,
};
use ros2probe_model::facts::names::{NodeName, TopicName};
use ros2probe_wire::inside::late;
use ros2probe_wire::inside::{
    self, Announcement, Figures, Handle, Process, announced, distribution, kind, state,
    thread_state,
};
use ros2probe_wire::{DomainId, Timestamp};
use zerocopy::FromBytes as _;

use super::cpu_limits;
use super::late::{MIN_BOUND, cgroup_ids, convert};
use super::names::{Endpoint, Names, text};
use super::process::Stat;
use super::programs::Tables;
use crate::cgroup;
use crate::cgroup_paths::{CgroupPaths, short_name};
use crate::error_chain::in_words;
use crate::system::Clocks;
use crate::tables::{
    CausalHops, InsideBuffers, LateCalls, NamedCgroups, NewNodes, ReportedHandles, Transitions,
};

/// Maximum calls per second of one process. Above it, its calls are no longer counted.
pub const MAX_PROCESS_HITS: u64 = 50_000;
/// Minimum time over which calls per second are evaluated: a shorter time may contain only a burst.
const MIN_EVALUATION_TIME: Duration = Duration::from_millis(500);
/// Number of items of the announcement ring that are read together: twice as many as fit into it.
/// A process that announces without end must not keep the thread from applying its budget.
const DRAIN_BATCH: usize = 10_000;
/// Step of the wall clock above which calls seem late: the minimum of a learnt bound.
const MAX_STEP: Duration = MIN_BOUND;
/// Number of rounds whose calls may have waits that include such a step.
const ROUNDS_AFTER_STEP: u32 = 2;
/// Number of rounds after which a process outside of the control group is inspected again.
const RECHECK_ROUNDS: u32 = 5;

/// The observed processes.
pub struct ProcessTable {
    known: HashMap<u32, Observed>,
    has_callbacks: bool,
    hops: Bounded<CausalHops, Vec<inside::Hop>>,
    late: Bounded<LateCalls, Vec<late::LateCall>>,
    transitions: Bounded<Transitions, Vec<Transition>>,
    cgroups: CgroupPaths,
    /// Units by the ids of control groups; `None`: it is the root, or its path is not found.
    units: Bounded<NamedCgroups, HashMap<u64, Option<Arc<str>>>>,
    rounds: u32,
    /// The wall clock minus the monotonic clock in the last round, in nanoseconds.
    ahead: Option<i64>,
    /// Number of rounds, from this one on, in which calls may only seem late.
    rounds_after_step: u32,
    /// Time since calls per second were last evaluated.
    since_evaluation: Duration,
}

/// Result of one round.
#[derive(Debug)]
pub struct Round {
    /// Changes since the last report.
    pub report: Report,
    /// Publications during callbacks, in the order of their time.
    pub publications: Vec<CausalPublication>,
    /// Calls per second of all processes; 0 if they were not evaluated.
    pub hits: u64,
    /// Whether the programs are detached until a client needs calls again.
    pub is_last: bool,
}

#[derive(Debug, Default)]
struct Observed {
    /// `None` if the process had ended before it was inspected, or if the broker did not answer.
    stat: Option<Stat>,
    /// Whether the process had ended before it was inspected. Another process may have its id by
    /// now.
    had_ended: bool,
    /// Domain of its environment; `None` until the broker has answered.
    domain: Option<DomainId>,
    /// Number of requests for it that failed.
    failed_requests: u32,
    names: Names,
    new_nodes: Bounded<NewNodes, Vec<NodeName>>,
    /// Number of calls at the last evaluation.
    hits: u64,
    is_suspended: bool,
    /// Last reported state of each handle.
    reported: Bounded<ReportedHandles, HashMap<Handle, Mark>>,
    /// Publisher of each ring buffer.
    buffers: Bounded<InsideBuffers, HashMap<u64, Handle>>,
}

/// Figures that distinguish two states of a handle.
type Mark = [u64; 5];

impl Observed {
    /// Requests the domain from the broker, and returns whether it answered. The environment of a process
    /// that cannot be read has domain 0.
    fn find_domain(&mut self, process: u32, broker: &mut Broker) -> bool {
        match broker.domain(process) {
            Ok(domain) => self.domain = Some(DomainId(domain.unwrap_or_default())),
            Err(_) => self.failed_requests = self.failed_requests.saturating_add(1),
        }
        self.domain.is_some()
    }

    fn buffer(&self, address: u64) -> Option<Endpoint> {
        let publisher = self.buffers.get(&address).copied();
        self.names.buffer(address, publisher.unwrap_or_default())
    }

    /// Remembers the publisher of a ring buffer. The table is bounded, because a process may create
    /// and destroy buffers without end.
    fn note_buffer(&mut self, address: u64, publisher: Handle) {
        if self.buffers.insert(address, publisher).is_some() {
            self.forget_reported();
        }
    }

    fn note_reported(&mut self, handle: Handle, mark: Mark) {
        if self.reported.insert(handle, mark).is_some() {
            self.forget_reported();
        }
    }

    /// Makes the next round report all handles again.
    fn forget_reported(&mut self) {
        self.reported.clear();
        self.buffers.clear();
    }

    /// Makes the next round report everything again.
    fn forget_reports(&mut self) {
        self.forget_reported();
        self.new_nodes.clear();
        for node in self.names.nodes() {
            self.new_nodes.push(node.clone());
        }
    }
}

impl ProcessTable {
    /// Creates an empty table.
    #[must_use]
    pub fn new(has_callbacks: bool) -> Self {
        Self {
            known: HashMap::new(),
            has_callbacks,
            hops: Bounded::default(),
            late: Bounded::default(),
            transitions: Bounded::default(),
            cgroups: CgroupPaths::new(cgroup::mount_point().unwrap_or_default()),
            units: Bounded::default(),
            rounds: 0,
            ahead: None,
            rounds_after_step: 0,
            since_evaluation: Duration::ZERO,
        }
    }

    /// Returns the number of processes.
    #[must_use]
    pub fn len(&self) -> usize {
        self.known.len()
    }

    /// Returns whether no process is observed.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.known.is_empty()
    }

    /// Reads the waiting announcements, at most 10,000. `broker` provides facts about the
    /// processes.
    pub fn drain(&mut self, tables: &mut Tables, clocks: &Clocks, broker: &mut Broker) {
        let items = std::iter::from_fn(|| tables.next_announcement(Item::read));
        self.apply_items(items, clocks, broker);
    }

    fn apply_items(
        &mut self,
        items: impl Iterator<Item = Option<Item>>,
        clocks: &Clocks,
        broker: &mut Broker,
    ) {
        for item in items.take(DRAIN_BATCH) {
            self.apply_item(item, clocks, broker);
        }
    }

    fn apply_item(&mut self, item: Option<Item>, clocks: &Clocks, broker: &mut Broker) {
        match item {
            Some(Item::Hop(hop)) => {
                self.hops.push(hop);
            }
            Some(Item::Late(call)) => {
                self.late.push(*call);
            }
            Some(Item::Announcement(announcement)) => {
                self.apply_announcement(&announcement, clocks, broker);
            }
            None => {}
        }
    }

    fn apply_announcement(
        &mut self,
        announcement: &Announcement,
        clocks: &Clocks,
        broker: &mut Broker,
    ) {
        let is_transition = announcement.kind == announced::TRANSITION;
        if is_transition && self.transitions.is_full() {
            self.transitions.refuse();
            return;
        }
        let observed = self.observe(announcement.process, broker);
        if is_transition {
            let transition = Transition {
                process: announcement.process,
                node: observed.names.machine(announcement.address),
                start: text(&announcement.text).into(),
                goal: text(&announcement.second).into(),
                at: clocks.wall_time_of(announcement.time),
            };
            self.transitions.push(transition);
            return;
        }
        if let Some(node) = observed.names.announce(announcement) {
            observed.new_nodes.push(node);
        }
    }

    /// Returns the state of a process, and creates it if necessary. The kernel's table bounds the
    /// number of processes.
    fn observe(&mut self, process: u32, broker: &mut Broker) -> &mut Observed {
        self.known.entry(process).or_insert_with(|| {
            // Without an answer, the process has no name, and its domain is assumed to be 0 until a
            // later round.
            let states = broker.activities(&[process]);
            let had_ended = states.as_ref().is_ok_and(Vec::is_empty);
            let state = states.unwrap_or_default().into_iter().next();
            let mut observed = Observed {
                stat: state.map(Stat::from),
                had_ended,
                ..Observed::default()
            };
            if observed.stat.is_some() {
                observed.find_domain(process, broker);
            }
            observed
        })
    }

    /// Requests missing domains of running processes, until the broker does not answer. Processes
    /// with the fewest failed requests come first, because a request may take half a second.
    fn find_domains(&mut self, running: &HashMap<u32, Stat>, broker: &mut Broker) {
        let unknown = self.known.iter_mut().filter(|(id, observed)| {
            observed.domain.is_none() && !observed.had_ended && running.contains_key(id)
        });
        let mut unknown: Vec<_> = unknown.collect();
        unknown.sort_by_key(|(_, observed)| observed.failed_requests);
        for (id, observed) in unknown {
            if !observed.find_domain(*id, broker) {
                return;
            }
        }
    }

    /// Makes the next round report everything again, after [`Tables::forget_calls`].
    pub fn forget_reports(&mut self) {
        self.hops.clear();
        self.late.clear();
        self.ahead = None;
        for observed in self.known.values_mut() {
            observed.forget_reports();
        }
    }

    /// Forgets processes that have ended, without a report: their ids may be used again.
    pub fn forget_ended(&mut self, tables: &mut Tables, clocks: &Clocks, broker: &mut Broker) {
        self.drain(tables, clocks, broker);
        let processes: Vec<_> = tables.processes().map(|(id, _)| id).collect();
        // Without an answer it is unknown which processes have ended.
        let Ok(states) = broker.activities(&processes) else {
            return;
        };
        let running = states.into_iter();
        let running: HashMap<_, _> = running
            .map(|state| (state.process, state.started))
            .collect();
        let is_running = |id: &u32, observed: Option<&Observed>| {
            let started = observed.and_then(|observed| Some(observed.stat.as_ref()?.started));
            let at = running.get(id);
            at.is_some_and(|at| started.is_none_or(|started| started == *at))
        };
        for id in &processes {
            if !is_running(id, self.known.get(id)) {
                let _ = tables.remove_process(*id);
                self.known.remove(id);
            }
        }
        let present: HashSet<_> = tables.processes().map(|(id, _)| id).collect();
        let handles: Vec<_> = tables.figures().map(|(handle, _)| handle).collect();
        for handle in handles {
            if !present.contains(&handle.process) {
                let _ = tables.remove_handle(handle);
            }
        }
        self.known.retain(|id, _| present.contains(id));
    }

    /// Reads everything once. `elapsed`: time since the last round. `shows_intra_process`: whether
    /// a process's library reports every step of messages within it. `delivery`: how the message of
    /// a late call came into its process.
    pub fn round(
        &mut self,
        tables: &mut Tables,
        clocks: &Clocks,
        elapsed: Duration,
        broker: &mut Broker,
        shows_intra_process: impl Fn(u32) -> bool,
        delivery: impl Fn(&late::LateCall) -> Option<MessageDelivery>,
    ) -> Round {
        self.rounds = self.rounds.wrapping_add(1);
        let hits = self.apply_budgets(tables, elapsed, broker);
        self.drain(tables, clocks, broker);
        let mut reports = HashMap::new();
        let processes: Vec<_> = tables.processes().collect();
        let counted = processes
            .iter()
            .filter(|(_, process)| process.state != state::OUTSIDE);
        let counted: Vec<_> = counted.map(|(id, _)| *id).collect();
        for id in &counted {
            self.observe(*id, broker);
        }
        // Without an answer it is unknown which processes have ended.
        let states = broker.activities(&counted).ok();
        let states = states.map(|states| {
            let states = states
                .into_iter()
                .map(|state| (state.process, state.into()));
            states.collect::<HashMap<u32, Stat>>()
        });
        if let Some(running) = &states {
            self.find_domains(running, broker);
        }
        for (id, process) in &processes {
            if process.state == state::OUTSIDE {
                if self.rounds.is_multiple_of(RECHECK_ROUNDS) {
                    let _ = tables.remove_process(*id);
                }
                continue;
            }
            let report = self.process(*id, process, states.as_ref());
            reports.insert(*id, report);
        }
        // A process that has ended makes no further calls, so the following figures are final.
        let ended: HashSet<_> = reports
            .iter()
            .filter(|(_, report)| report.has_ended)
            .map(|(id, _)| *id)
            .collect();
        let mut figures: Vec<_> = tables.figures().collect();
        // A buffer is named after its publisher, and a callback after its buffer.
        figures.sort_unstable_by_key(|(handle, _)| handle.kind);
        self.drain(tables, clocks, broker);
        for (handle, figures) in &figures {
            if let Some(report) = reports.get_mut(&handle.process) {
                self.handle(report, *handle, figures, clocks);
            }
        }
        let calls = self.take_late_calls(clocks);
        if self.rounds_after_step == ROUNDS_AFTER_STEP
            && let Err(error) = tables.forget_delays()
        {
            let reason = in_words(&error);
            tracing::warn!(reason, "calls may seem to wait for a step of the clock");
        }
        let cpu_limits = match calls.is_empty() {
            true => Arc::new([]),
            false => cpu_limits::read(Path::new("/sys")),
        };
        self.name_cgroups(cgroup_ids(&calls));
        let late = calls
            .iter()
            .filter_map(|call| self.late_call(call, delivery(call), &cpu_limits, &figures, clocks));
        let late = late.collect();
        let hops = self.hops.take();
        let hops = hops.iter().filter_map(|hop| self.hop(hop, clocks));
        let mut publications: Vec<_> = hops.collect();
        publications.sort_by_key(|publication| publication.published);
        for id in &ended {
            let _ = tables.remove_process(*id);
            self.known.remove(id);
        }
        // A process that began during this round is in the next report.
        let present: HashSet<_> = tables.processes().map(|(id, _)| id).collect();
        for (handle, _) in &figures {
            if !present.contains(&handle.process) {
                let _ = tables.remove_handle(*handle);
            }
        }
        self.known.retain(|id, _| present.contains(id));
        for (id, report) in &mut reports {
            report.shows_intra_process = shows_intra_process(*id);
        }
        let report = Report {
            at: clocks.now,
            has_callbacks: self.has_callbacks,
            processes: reports.into_values().collect(),
            transitions: self.transitions.take(),
            late,
        };
        Round {
            report,
            publications,
            hits,
            is_last: false,
        }
    }

    /// Returns the report of a process without its handles. `states` has the running processes, if
    /// known.
    fn process(
        &mut self,
        id: u32,
        process: &Process,
        states: Option<&HashMap<u32, Stat>>,
    ) -> ProcessReport {
        let observed = self.known.entry(id).or_default();
        let mut has_ended = observed.had_ended;
        if let Some(states) = states.filter(|_| !has_ended) {
            // Another process may have received the same id.
            let started = observed.stat.as_ref().map(|stat| stat.started);
            let stat = states
                .get(&id)
                .filter(|stat| started.is_none_or(|at| at == stat.started));
            has_ended = stat.is_none();
            observed.stat = stat.cloned().or_else(|| observed.stat.take());
        }
        let stat = observed.stat.as_ref();
        ProcessReport {
            id,
            name: stat.map(|stat| Arc::clone(&stat.name)),
            domain_id: observed.domain.unwrap_or_default(),
            cpu: stat.map(|stat| stat.cpu),
            hits: process.hits,
            refused: process.refused,
            is_suspended: observed.is_suspended,
            has_ended,
            nodes: observed.new_nodes.take(),
            ..ProcessReport::default()
        }
    }

    /// Applies the budget of each process, before its announcements are read. `elapsed`: time since
    /// the last call. Returns the calls per second of all processes; 0 if they were not evaluated.
    pub fn apply_budgets(
        &mut self,
        tables: &mut Tables,
        elapsed: Duration,
        broker: &mut Broker,
    ) -> u64 {
        self.since_evaluation += elapsed;
        if self.since_evaluation < MIN_EVALUATION_TIME {
            return 0;
        }
        let over = std::mem::take(&mut self.since_evaluation);
        let processes: Vec<_> = tables.processes().collect();
        let counted = processes
            .iter()
            .filter(|(_, process)| process.state != state::OUTSIDE);
        let hits = counted.map(|(id, process)| {
            self.observe(*id, broker);
            self.apply_budget(tables, *id, process, over)
        });
        hits.sum()
    }

    /// Applies the budget of a process to its calls over this time. Returns its calls per second.
    fn apply_budget(
        &mut self,
        tables: &mut Tables,
        id: u32,
        process: &Process,
        over: Duration,
    ) -> u64 {
        let observed = self.known.entry(id).or_default();
        let milliseconds = u64::try_from(over.as_millis()).unwrap_or(u64::MAX).max(1);
        let hits = process.hits.saturating_sub(observed.hits);
        let rate = hits.saturating_mul(1000) / milliseconds;
        observed.hits = process.hits;
        let is_suspended = match observed.is_suspended {
            true => rate > MAX_PROCESS_HITS / 2,
            false => rate > MAX_PROCESS_HITS,
        };
        if is_suspended == observed.is_suspended {
            return rate;
        }
        let state = match is_suspended {
            true => state::SUSPENDED,
            false => state::COUNTED,
        };
        let changed = match is_suspended {
            true => Ok(()),
            false => tables.forget_times(Some(id)),
        };
        let changed = changed.and_then(|()| tables.set_process(id, Process { state, ..*process }));
        if changed.is_ok() {
            observed.is_suspended = is_suspended;
            tracing::info!(
                process = id,
                calls_per_second = rate,
                is_suspended,
                "the budget of calls inside a process"
            );
        }
        rate
    }

    /// Adds a handle to its process's report, if it has changed.
    fn handle(
        &mut self,
        report: &mut ProcessReport,
        handle: Handle,
        figures: &Figures,
        clocks: &Clocks,
    ) {
        let Some(observed) = self.known.get_mut(&handle.process) else {
            return;
        };
        let mark = [
            figures.count,
            figures.failed,
            figures.within,
            u64::from(figures.depth),
            figures.trigger.address,
        ];
        if observed.reported.get(&handle) == Some(&mark) {
            return;
        }
        if handle.kind == kind::BUFFER {
            observed.note_buffer(handle.address, figures.trigger);
        }
        let names = &observed.names;
        let last = match figures.last {
            0 => Timestamp(0),
            last => clocks.wall_time_of(last),
        };
        let is_known = match handle.kind {
            kind::PUBLISHER => names.publisher(handle.address).map(|endpoint| {
                report.publishers.push(PublisherReport {
                    handle: handle.address,
                    node: endpoint.node,
                    topic: TopicName::from(&*endpoint.name),
                    middleware: endpoint.middleware,
                    published: figures.count,
                    within_process: figures.within,
                    last,
                    intervals: durations(figures, distribution::INTERVAL),
                });
            }),
            kind::SUBSCRIPTION => names.subscription(handle.address).map(|endpoint| {
                report.subscriptions.push(SubscriptionReport {
                    handle: handle.address,
                    node: endpoint.node,
                    topic: TopicName::from(&*endpoint.name),
                    middleware: endpoint.middleware,
                    taken: figures.count,
                    failed: figures.failed,
                    last,
                    intervals: durations(figures, distribution::INTERVAL),
                    latency: durations(figures, distribution::DELAY),
                });
            }),
            kind::BUFFER => {
                let endpoint = names.buffer(handle.address, figures.trigger);
                let topic = endpoint.as_ref().map(|of| TopicName::from(&*of.name));
                report.buffers.push(BufferReport {
                    handle: handle.address,
                    node: endpoint.and_then(|of| of.node),
                    topic,
                    enqueued: figures.count,
                    overwritten: figures.failed,
                    dequeued: figures.within,
                    depth: figures.depth,
                    max_depth: figures.max_depth,
                    capacity: names.capacity(handle.address),
                    last,
                    waiting: durations(figures, distribution::DELAY),
                });
                Some(())
            }
            kind::CALLBACK => {
                let buffer = |address| observed.buffer(address);
                let (trigger, node) = names.trigger(handle.address, figures, buffer);
                report.callbacks.push(CallbackReport {
                    handle: handle.address,
                    node,
                    trigger,
                    thread: figures.thread,
                    // Without observation of callbacks, only their starts are counted.
                    calls: figures.count.max(figures.within),
                    last,
                    durations: durations(figures, distribution::INTERVAL),
                    waits: durations(figures, distribution::DELAY),
                    skipped: figures.failed,
                    states: states(figures),
                });
                Some(())
            }
            _ => None,
        };
        // Without a name, the handle is reported later.
        if is_known.is_some() {
            observed.note_reported(handle, mark);
        }
    }

    /// Takes the late calls of this round. The programs compute waits with the wall clock of the last
    /// round. If it was set since then, each message seems to have waited for the step: at once, or
    /// if its sender has another clock. Then only calls count that lasted too long themselves.
    fn take_late_calls(&mut self, clocks: &Clocks) -> Vec<late::LateCall> {
        let ahead = clocks.now.0.wrapping_sub(clocks.monotonic).cast_signed();
        let before = self.ahead.replace(ahead).unwrap_or(ahead);
        self.rounds_after_step = match Duration::from_nanos(before.abs_diff(ahead)) > MAX_STEP {
            true => ROUNDS_AFTER_STEP,
            false => self.rounds_after_step.saturating_sub(1),
        };
        let mut calls = self.late.take();
        if self.rounds_after_step > 0 {
            calls.retain(|call| {
                let [longest, _] = call.bounds;
                call.ended.saturating_sub(call.started) > longest
            });
        }
        calls
    }

    /// Names the callbacks of a late call; `None` if its process has ended.
    fn late_call(
        &self,
        call: &late::LateCall,
        delivery: Option<MessageDelivery>,
        cpu_limits: &Arc<[CpuLimit]>,
        figures: &[(Handle, Figures)],
        clocks: &Clocks,
    ) -> Option<LateCall> {
        self.known.get(&call.process)?;
        let unit_of = |cgroup_id| self.units.get(&cgroup_id).cloned().flatten();
        let mut late = convert(call, clocks, delivery, cpu_limits, &unit_of, |address| {
            let key = Handle {
                address,
                process: call.process,
                kind: kind::CALLBACK,
            };
            let found = figures.iter().find(|(handle, _)| *handle == key);
            let unknown = (Trigger::Service(None), None);
            found.map_or(unknown, |(handle, figures)| {
                self.name_callback(*handle, figures)
            })
        });
        // A process that does not publish the topic sent another message to the same thread.
        if let (Some(handoff), Trigger::Subscription(topic)) = (&mut late.handoff, &late.trigger) {
            let is_publisher =
                |thread: &OtherThread| self.has_publisher(thread.process, topic, figures);
            handoff.sender = handoff.sender.take().filter(is_publisher);
        }
        Some(late)
    }

    /// Returns whether a process has a publisher of this topic.
    fn has_publisher(&self, process: u32, topic: &str, figures: &[(Handle, Figures)]) -> bool {
        let Some(observed) = self.known.get(&process) else {
            return false;
        };
        let publishers = figures
            .iter()
            .filter(|(handle, _)| handle.process == process && handle.kind == kind::PUBLISHER);
        let mut publishers =
            publishers.filter_map(|(handle, _)| observed.names.publisher(handle.address));
        publishers.any(|publisher| &*publisher.name == topic)
    }

    /// Finds the units of control groups that are not known yet.
    fn name_cgroups(&mut self, mut ids: BTreeSet<u64>) {
        ids.retain(|id| !self.units.contains_key(id));
        if ids.is_empty() {
            return;
        }
        self.cgroups.refresh(&ids);
        for id in ids {
            let path = self.cgroups.path(id).filter(|path| *path != "/");
            let unit = path.map(|path| Arc::from(short_name(path)));
            if let Some((id, unit)) = self.units.insert(id, unit) {
                self.units.clear();
                self.units.insert(id, unit);
            }
        }
    }

    /// Returns the domain of a process; 0 if it is not known.
    pub(super) fn domain_of(&self, process: u32) -> DomainId {
        let observed = self.known.get(&process);
        observed.and_then(|it| it.domain).unwrap_or_default()
    }

    /// Returns the trigger of a callback, and its node.
    pub(super) fn name_callback(
        &self,
        callback: Handle,
        figures: &Figures,
    ) -> (Trigger, Option<NodeName>) {
        let Some(observed) = self.known.get(&callback.process) else {
            return (Trigger::Service(None), None);
        };
        let buffer = |address| observed.buffer(address);
        (observed.names).trigger(callback.address, figures, buffer)
    }

    /// Names the topics of a causal publication; `None` if one is unknown.
    fn hop(&self, hop: &inside::Hop, clocks: &Clocks) -> Option<CausalPublication> {
        let observed = self.known.get(&hop.process)?;
        let names = &observed.names;
        let output = names.publisher(hop.publisher)?;
        let input = match hop.input.kind {
            kind::SUBSCRIPTION => names.subscription(hop.input.address)?,
            kind::BUFFER => observed.buffer(hop.input.address)?,
            _ => return None,
        };
        Some(CausalPublication {
            domain_id: observed.domain.unwrap_or_default(),
            process: hop.process,
            node: output.node.or(input.node),
            input: TopicName::from(&*input.name),
            input_source: Timestamp(hop.source_timestamp),
            taken: clocks.wall_time_of(hop.taken),
            started: clocks.wall_time_of(hop.started),
            output: TopicName::from(&*output.name),
            published: clocks.wall_time_of(hop.published),
        })
    }
}

/// An item of the announcement ring.
enum Item {
    Announcement(Box<Announcement>),
    Hop(inside::Hop),
    Late(Box<late::LateCall>),
}

impl Item {
    fn read(bytes: &[u8]) -> Option<Self> {
        let kind = u32::from_ne_bytes(*bytes.first_chunk()?);
        if kind == announced::HOP {
            return inside::Hop::read_from_bytes(bytes).ok().map(Self::Hop);
        }
        if kind == announced::LATE {
            let call = late::LateCall::read_from_bytes(bytes).ok()?;
            return Some(Self::Late(Box::new(call)));
        }
        let announcement = Announcement::read_from_bytes(bytes).ok()?;
        Some(Self::Announcement(Box::new(announcement)))
    }
}

fn states(figures: &Figures) -> ThreadStates {
    let of = |state: usize| figures.states.get(state).copied().unwrap_or_default();
    ThreadStates {
        calls: figures.states_known,
        cpu: of(thread_state::CPU),
        throttled: of(thread_state::THROTTLED),
        runnable: of(thread_state::RUNNABLE),
        blocked: of(thread_state::BLOCKED),
    }
}

fn durations(figures: &Figures, of: usize) -> Durations {
    let [interval, delay] = &figures.buckets;
    let counts = if of == distribution::INTERVAL {
        interval
    } else {
        delay
    };
    let of = |values: &[u64; 2]| values.get(of).copied().unwrap_or_default();
    let minimum = of(&figures.minima).saturating_sub(1);
    Durations::new(counts, of(&figures.sums), minimum, of(&figures.maxima))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::tables::tests::assert_driven;
    use zerocopy::FromZeros as _;

    fn table() -> ProcessTable {
        ProcessTable::new(false)
    }

    fn announced(table: &mut ProcessTable, kind: u32, address: u64) {
        let mut announcement = Announcement::new_zeroed();
        (
            announcement.process,
            announcement.kind,
            announcement.address,
        ) = (u32::MAX, kind, address);
        table.apply_announcement(&announcement, &Clocks::read(), &mut Broker::here());
    }

    #[test]
    fn new_nodes_and_transitions_of_a_report_are_bounded() {
        let mut table = table();
        for address in 0..2000 {
            announced(&mut table, announced::NODE, address);
            announced(&mut table, announced::TRANSITION, address);
        }
        assert_driven::<NewNodes>();
        assert_driven::<Transitions>();
        assert_eq!(table.transitions.len(), Transitions::CAP);
    }

    #[test]
    fn announcements_without_end_are_read_in_parts() {
        let (mut table, clocks) = (table(), Clocks::read());
        let mut read = 0;
        let endless = std::iter::repeat_with(|| {
            read += 1;
            Some(Item::Hop(inside::Hop::new_zeroed()))
        });
        table.apply_items(endless, &clocks, &mut Broker::here());
        assert_eq!(read, DRAIN_BATCH);
    }

    #[test]
    fn causal_publications_of_a_report_are_bounded() {
        let (mut table, clocks) = (table(), Clocks::read());
        for _ in 0..20_000 {
            let hop = inside::Hop::new_zeroed();
            table.apply_item(Some(Item::Hop(hop)), &clocks, &mut Broker::here());
        }
        assert_driven::<CausalHops>();
    }

    #[test]
    fn late_calls_of_a_report_are_bounded() {
        let (mut table, clocks) = (table(), Clocks::read());
        for _ in 0..2_000 {
            let call = Box::new(late::LateCall::new_zeroed());
            table.apply_item(Some(Item::Late(call)), &clocks, &mut Broker::here());
        }
        assert_driven::<LateCalls>();
        assert_eq!(table.late.len(), LateCalls::CAP);
    }

    #[test]
    fn a_wall_clock_that_is_set_makes_no_call_late() {
        const SECOND: u64 = 1_000_000_000;
        let mut table = table();
        let mut at = |second: u64, wall_clock: u64| {
            let clocks = Clocks {
                now: Timestamp(wall_clock * SECOND),
                monotonic: second * SECOND,
                step: 0,
            };
            // One call began late, and the other one lasted too long.
            for lasted in [1, 20] {
                let mut call = Box::new(late::LateCall::new_zeroed());
                call.bounds = [10, 10];
                (call.started, call.ended, call.delay) = (100, 100 + lasted, SECOND);
                table.apply_item(Some(Item::Late(call)), &clocks, &mut Broker::here());
            }
            table.take_late_calls(&clocks).len()
        };
        assert_eq!([at(1, 1001), at(2, 1002)], [2, 2]);
        assert_eq!([at(3, 993), at(4, 994), at(5, 995)], [1, 1, 2]);
        assert_eq!([at(6, 2000), at(7, 2001), at(8, 2002)], [1, 1, 2]);
        table.forget_reports();
        assert_eq!(table.ahead, None);
    }

    #[test]
    fn control_groups_beyond_the_cap_are_searched_again() {
        let mut table = table();
        table.name_cgroups((1..=NamedCgroups::CAP as u64).collect());
        assert_eq!(table.units.len(), NamedCgroups::CAP);
        // The id is 0 for no control group.
        table.name_cgroups([u64::MAX].into());
        assert_driven::<NamedCgroups>();
        assert_eq!(table.units.get(&u64::MAX), Some(&None));
        assert_eq!(table.units.len(), 1);
    }

    #[test]
    fn handles_beyond_the_cap_cause_a_new_report_of_all_handles() {
        let mut observed = Observed::default();
        let handle = |address| Handle {
            address,
            ..Handle::new_zeroed()
        };
        for address in 0..10_000 {
            observed.note_buffer(address, handle(1));
            observed.note_reported(handle(address), [0; 5]);
            assert!(observed.reported.len() <= ReportedHandles::CAP);
        }
        assert_driven::<InsideBuffers>();
        observed.buffers.clear();
        for address in 0..5_000 {
            observed.note_reported(handle(address), [0; 5]);
        }
        assert_driven::<ReportedHandles>();
    }
}
