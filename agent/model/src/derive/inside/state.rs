//! Processes and handles of the last reports.

use std::collections::{BTreeMap, BTreeSet};
use std::time::Duration;

use foldhash::{HashMap, HashMapExt as _, HashSet};
use ros2probe_wire::{DomainId, GuidPrefix};

use super::attribution::Attribution;
use super::findings::{ThreadLoad, TimerThread, judge};
use super::late::{Late, LateCalls};
use super::reader_queue::ReaderQueue;
use super::source::{Seen, Source};
use super::topics::{Evidence, InsideTopic, InsideTopics, Live, TopicAdded};
use super::tracked::{Added, Figures, HALF_WINDOW, Kind, Tracked, ratio};
use super::witness::Witness;
use crate::facts::bounded::TableFacts;
use crate::facts::bounded::{Bounded, Counted, Sum};
use crate::facts::calls::facts::{
    InsideFacts, LifecycleState, NewLateCalls, ObservedProcess, TopicInside,
};
use crate::facts::calls::late::{LateCall, Repairs};
use crate::facts::calls::report::{ProcessReport, Report, ThreadStates, Transition, Trigger};
use crate::facts::diagnosis::Diagnosis;
use crate::facts::measurement::Measurement;
use crate::facts::model_time::ModelTime;
use crate::facts::names::{NodeName, TopicName};
use crate::facts::naming::Naming;
use crate::facts::repairs::Awaited;
use crate::facts::tables::{InsideHandles, LifecycleStates, ObservedProcesses, ReportedNodes};
use crate::facts::wall_clock::WallClock;
use crate::graph::discovery::Discovery;
use crate::measure::receivers::Receivers;
use crate::measure::topic::TopicId;

/// Time without a report after which the source counts as stopped.
const REPORT_TIMEOUT: Duration = Duration::from_secs(10);

/// Processes, handles and topics that reports have shown.
#[derive(Debug, Default)]
pub struct Inside {
    /// Time of the last report; `None` without one, or if the source has stopped.
    at: Option<ModelTime>,
    has_callbacks: bool,
    pub(super) processes: Bounded<ObservedProcesses, BTreeMap<u32, Process>>,
    /// Handles of all processes.
    handles: Sum<Counted<InsideHandles>>,
    pub(super) topics: InsideTopics,
    /// Participants of observed processes.
    participants: HashSet<GuidPrefix>,
    /// Late calls of callbacks.
    late: LateCalls,
    /// Last state of each managed node, by process and node. It is kept while there is no report,
    /// because the next report has the transitions of that time.
    states: Bounded<LifecycleStates, BTreeMap<(u32, Option<NodeName>), LifecycleState>>,
    /// Revisions of the graph that determined nodes and domains.
    graph: Option<(u64, u64)>,
    /// Number of changes of the findings.
    pub(super) revision: u64,
}

/// Returns the retransmissions for which a call waited, by the participants of its process, its topic
/// and its message.
pub type RepairsOf<'a> = &'a dyn Fn(&BTreeSet<GuidPrefix>, (DomainId, &Naming), Awaited) -> Repairs;

/// An observed process.
#[derive(Debug)]
pub(super) struct Process {
    pub(super) facts: ObservedProcess,
    /// Time of the report before the first one with this process: all its calls since then are
    /// counted.
    pub(super) counted_since: Option<ModelTime>,
    /// Its participants.
    pub(super) participants: BTreeSet<GuidPrefix>,
    /// Its domain according to its environment.
    reported_domain_id: DomainId,
    /// Nodes that it created while it was observed.
    reported: Bounded<ReportedNodes, Vec<NodeName>>,
    cpu: Option<Duration>,
    /// The earlier and the later start of a window: time, CPU time and calls.
    marks: [(ModelTime, Option<Duration>, u64); 2],
    pub(super) handles: Bounded<InsideHandles, BTreeMap<(Kind, u64), Tracked>>,
    /// Queues of its subscriptions.
    pub(super) queues: BTreeMap<(DomainId, TopicName), ReaderQueue>,
    /// Topics whose receptions within the process may show further publications.
    witnesses: BTreeMap<(DomainId, TopicName), Witness>,
}

/// Counts that a report added to a handle.
#[derive(Debug)]
struct HandleAdded {
    process: u32,
    key: (Kind, u64),
    added: Added,
}

impl Inside {
    /// Returns the number of handles, its cap, and the number of entries dropped or refused because
    /// of caps.
    #[must_use]
    pub fn table(&self) -> TableFacts {
        let mut facts = self.handles.facts();
        facts.evictions += self.topics.evictions;
        facts
    }

    /// Processes a report, whose times are wall times. `repairs` returns the retransmissions for which
    /// a call waited. Returns its transitions of managed nodes.
    /// Those of the first report happened before it, while the nodes' own messages showed them, and
    /// are not returned.
    pub fn report(
        &mut self,
        report: Report,
        clock: WallClock,
        discovery: &Discovery,
        receivers: &Receivers,
        repairs: RepairsOf<'_>,
    ) -> Vec<LifecycleState> {
        let Report {
            at,
            has_callbacks,
            processes,
            transitions,
            late,
        } = report;
        let at = clock.model_time(at);
        let began = self.at.filter(|before| *before < at);
        let is_first = self.at.replace(at).is_none();
        self.has_callbacks = has_callbacks;
        if began.is_none() {
            // Processes that ended while there was no report are not reported again.
            let running: HashSet<_> = processes.iter().map(|process| process.id).collect();
            self.states.retain(|(id, _), _| running.contains(id));
        }
        let mut added = Vec::new();
        let mut ended = Vec::new();
        for process in processes {
            if process.has_ended {
                ended.push(process.id);
            }
            self.take(process, (at, began), clock, &mut added);
        }
        self.attribute(discovery, receivers);
        self.add_to_topics(&added, &ended, at);
        for call in late {
            self.note_late(call, clock, repairs);
        }
        let transitions = transitions.into_iter();
        let mut transitions: Vec<_> = transitions.map(|each| self.transit(each, clock)).collect();
        if is_first {
            transitions.clear();
        }
        for id in ended {
            self.remove(id);
        }
        self.turn(at);
        self.judge(at);
        transitions
    }

    /// Drops topics after their grace period, and all handles if the source has stopped.
    pub fn advance(&mut self, now: ModelTime, grace: Duration) {
        self.topics.expire(now, grace);
        if self.at.is_some_and(|at| now - at >= REPORT_TIMEOUT) {
            self.detach();
        }
    }

    /// Drops all handles and processes: the source has stopped.
    pub fn detach(&mut self) {
        self.at = None;
        self.graph = None;
        self.revision += 1;
        self.handles.clear();
        self.processes.clear();
        self.participants.clear();
        self.topics.end();
        self.late.end_findings();
    }

    /// Returns a number that increases with every change of [`Self::findings`].
    #[must_use]
    pub const fn revision(&self) -> u64 {
        self.revision
    }

    /// Returns the present problems.
    #[must_use]
    pub fn findings(&self) -> Vec<Diagnosis> {
        let mut found = Vec::new();
        for (id, process) in &self.processes {
            if process.facts.is_suspended {
                found.push(Diagnosis::ObservationSuspended {
                    domain_id: process.facts.domain_id,
                    process: *id,
                    name: process.facts.name.clone(),
                });
            }
            for tracked in process.handles.values() {
                self.findings_of(*id, tracked, &mut found);
            }
            self.findings_of_queues(*id, process, &mut found);
        }
        if let Some(at) = self.at {
            let late = self.late.findings(at);
            found.extend(late.map(|late| self.late_finding(&late)));
        }
        found
    }

    /// Returns whether calls show the lifecycle state of this node at present.
    #[must_use]
    pub fn knows_state(&self, domain_id: DomainId, node: &NodeName) -> bool {
        let is_this = |state: &LifecycleState| {
            state.domain_id == domain_id && state.node.as_ref() == Some(node)
        };
        self.at.is_some() && self.states.values().any(is_this)
    }

    /// Returns whether this participant's process is observed.
    #[must_use]
    pub fn observes(&self, prefix: GuidPrefix) -> bool {
        self.participants.contains(&prefix)
    }

    /// Returns whether a node is known to run in this process.
    #[must_use]
    pub fn has_node(&self, process: u32, node: &NodeName) -> bool {
        let process = self.processes.get(&process);
        process.is_some_and(|process| process.facts.nodes.contains(node))
    }

    /// Returns a topic's figures from calls inside processes.
    #[must_use]
    pub fn topic(&self, domain_id: DomainId, naming: &Naming) -> Option<TopicInside> {
        let topic = self.find(domain_id, naming)?;
        Some(topic.facts())
    }

    /// Returns where the counts of a topic come from.
    #[must_use]
    pub fn source(&self, domain_id: DomainId, naming: &Naming) -> Source {
        let topic = self.find(domain_id, naming);
        topic.map_or(Source::Wire, InsideTopic::source)
    }

    /// Replaces the values that are known from inside in the sum over a topic's writers.
    pub fn apply(&self, domain_id: DomainId, naming: &Naming, sum: &mut Measurement) {
        if let Some(topic) = self.find(domain_id, naming) {
            topic.apply(sum);
        }
    }

    /// Returns the numbers of publishers and subscriptions of a topic, the time of its last message
    /// and its recent counts, if they come from inside.
    #[must_use]
    pub fn evidence(&self, domain_id: DomainId, naming: &Naming) -> Option<Evidence<'_>> {
        let topic = self.find(domain_id, naming)?;
        (topic.source() == Source::Inside).then_some(Evidence(topic))
    }

    /// Chooses the source of each topic. `wire` returns the network's counts, or `None` if it does
    /// not measure the topic.
    pub fn choose(&mut self, wire: impl Fn(Option<TopicId>) -> Option<Seen>) {
        for (_, topic) in self.topics.iter_mut() {
            topic.choose(wire(topic.id));
        }
    }

    /// Returns all topics: domain, names, whether a process has a publisher or subscription, and
    /// its entry among the topics of the graph, which the caller sets.
    pub fn topics(
        &mut self,
    ) -> impl Iterator<Item = (DomainId, &Naming, bool, &mut Option<TopicId>)> {
        self.topics.iter_mut().map(|((domain_id, _), topic)| {
            let is_live = topic.is_live();
            (*domain_id, &topic.naming, is_live, &mut topic.id)
        })
    }

    /// Returns the facts for a snapshot; `None` while the source is off.
    #[must_use]
    pub fn facts(&self) -> Option<InsideFacts> {
        let mut facts = InsideFacts {
            at: self.at?,
            has_callbacks: self.has_callbacks,
            states: self.states.values().cloned().collect(),
            late: self.late.facts(),
            ..InsideFacts::default()
        };
        for (id, process) in &self.processes {
            facts.processes.push(process.facts.clone());
            for tracked in process.handles.values() {
                tracked.facts(*id, &mut facts);
            }
            process.queue_facts(*id, &mut facts);
        }
        Some(facts)
    }

    /// Processes the figures of one process, and collects the counts that they add.
    fn take(
        &mut self,
        report: ProcessReport,
        (at, began): (ModelTime, Option<ModelTime>),
        clock: WallClock,
        into: &mut Vec<HandleAdded>,
    ) {
        let id = report.id;
        let mark = (at, report.cpu, report.hits);
        let new = || Process {
            facts: ObservedProcess {
                id,
                domain_id: report.domain_id,
                ..ObservedProcess::default()
            },
            reported_domain_id: report.domain_id,
            reported: Bounded::default(),
            counted_since: began,
            participants: BTreeSet::new(),
            cpu: report.cpu,
            marks: [mark, mark],
            handles: Bounded::default(),
            queues: BTreeMap::new(),
            witnesses: BTreeMap::new(),
        };
        let Some(process) = self.processes.get_or_insert_with(id, new) else {
            self.handles.refuse();
            return;
        };
        self.revision += u64::from(process.facts.is_suspended != report.is_suspended);
        let facts = &mut process.facts;
        if report.name.is_some() {
            facts.name = report.name;
        }
        facts.calls = report.hits;
        facts.refused = report.refused;
        facts.is_suspended = report.is_suspended;
        facts.shows_intra_process |= report.shows_intra_process;
        process.cpu = report.cpu.or(process.cpu);
        if process.reported_domain_id != report.domain_id {
            process.reported_domain_id = report.domain_id;
            self.graph = None;
        }
        for node in report.nodes {
            if !process.reported.contains(&node) && process.reported.push(node).is_none() {
                self.graph = None;
            }
        }
        let publishers = report.publishers.into_iter();
        let publishers = publishers.map(|each| Figures::of_publisher(each, clock));
        let subscriptions = report.subscriptions.into_iter();
        let subscriptions = subscriptions.map(|each| Figures::of_subscription(each, clock));
        let buffers = report.buffers.into_iter();
        let buffers = buffers.map(|each| Figures::of_buffer(each, clock));
        let callbacks = report.callbacks.into_iter();
        let callbacks = callbacks.map(|each| Figures::of_callback(each, clock));
        let all = publishers
            .chain(subscriptions)
            .chain(buffers)
            .chain(callbacks);
        for figures in all {
            let key = (figures.kind, figures.handle);
            let added = match process.handles.get_mut(&key) {
                Some(tracked) => {
                    let is_same = tracked.figures.topic == figures.topic;
                    if !is_same {
                        self.graph = None;
                    }
                    let added = tracked.update(figures, at);
                    tracked.took(&added);
                    added
                }
                None if self.handles.is_full() => {
                    self.handles.refuse();
                    continue;
                }
                None => {
                    self.handles.add(1);
                    self.graph = None;
                    let added = Added {
                        counts: figures.counts,
                        delay: figures.added_delay(None),
                    };
                    let mut tracked = Tracked::new(figures, at, began);
                    tracked.took(&added);
                    process.handles.insert(key, tracked);
                    added
                }
            };
            let process = id;
            into.push(HandleAdded {
                process,
                key,
                added,
            });
        }
    }

    /// Finds nodes and domains again if the graph or the handles have changed.
    fn attribute(&mut self, discovery: &Discovery, receivers: &Receivers) {
        let graph = Some((discovery.revision(), receivers.generation()));
        if self.graph == graph {
            return;
        }
        self.graph = graph;
        let ids: BTreeSet<u32> = self.processes.keys().copied().collect();
        let attribution = Attribution::of(&ids, discovery, receivers);
        for (id, process) in &mut self.processes {
            let reported = &process.reported;
            let domain_id = process.reported_domain_id;
            process.facts.domain_id = attribution.domain(*id, domain_id);
            let nodes = attribution.nodes(*id, reported);
            process.facts.nodes = nodes.into_iter().take(ReportedNodes::CAP).collect();
            process.participants = attribution.participants(*id);
            for tracked in process.handles.values_mut() {
                attribution.resolve(*id, domain_id, reported, tracked);
            }
        }
        for ((id, node), state) in &mut self.states {
            let Some(process) = self.processes.get(id) else {
                continue;
            };
            state.domain_id = process.facts.domain_id;
            if node.is_none() {
                state.node = attribution.node(*id, &process.reported);
            }
        }
        self.participants = attribution.all;
    }

    /// Adds the figures of a report to the topics.
    fn add_to_topics(&mut self, added: &[HandleAdded], ended: &[u32], at: ModelTime) {
        let mut topics: BTreeMap<(DomainId, TopicName), TopicAdded> = BTreeMap::new();
        for of_process in added.chunk_by(|one, other| one.process == other.process) {
            let id = of_process.first().map(|each| each.process);
            let Some(process) = id.and_then(|id| self.processes.get_mut(&id)) else {
                continue;
            };
            // Humble does not report publications within a process, but its callbacks show them.
            let mut received: BTreeMap<(DomainId, TopicName), (u64, u64)> = BTreeMap::new();
            for HandleAdded { key, added, .. } in of_process {
                let Some(tracked) = process.handles.get(key) else {
                    continue;
                };
                let Some(topic) = &tracked.figures.topic else {
                    continue;
                };
                let domain_id = tracked.domain_id;
                let sum = topics.entry((domain_id, topic.clone())).or_default();
                let both = received.entry((domain_id, topic.clone())).or_default();
                sum.take(tracked, added, both, process.facts.shows_intra_process);
            }
            for (key, (published, received)) in received {
                topics.entry(key.clone()).or_default().counts.published += published;
                if received > 0 || process.witnesses.contains_key(&key) {
                    process
                        .witnesses
                        .entry(key)
                        .or_default()
                        .take(published, received);
                }
            }
        }
        for (id, process) in &mut self.processes {
            let is_last = ended.contains(id);
            for (key, witness) in &mut process.witnesses {
                let shown = witness.turn(is_last);
                if shown > 0 {
                    topics.entry(key.clone()).or_default().counts.published += shown;
                }
            }
        }
        for (key, sum) in topics {
            self.topics.add(&key, sum, at);
        }
    }

    /// Records a transition of a managed node, and returns the new state.
    fn transit(&mut self, transition: Transition, clock: WallClock) -> LifecycleState {
        let Transition {
            process,
            node,
            start,
            goal,
            at,
        } = transition;
        let key = (process, node.clone());
        let known = self.processes.get(&process);
        let only = known.and_then(|known| match &known.facts.nodes[..] {
            [only] => Some(only.clone()),
            _ => None,
        });
        let state = LifecycleState {
            process,
            domain_id: known.map_or(DomainId(0), |known| known.facts.domain_id),
            node: node.or(only),
            state: goal,
            before: start,
            at: clock.model_time(at),
        };
        if self.states.insert(key, state.clone()).is_some() {
            self.handles.refuse();
        }
        state
    }

    /// Removes and returns the late calls since the last call.
    pub fn take_late_calls(&mut self) -> NewLateCalls {
        self.late.take_new()
    }

    /// Adds a late call to those of its callback.
    fn note_late(&mut self, mut call: LateCall, clock: WallClock, repairs: RepairsOf<'_>) {
        let process = self.processes.get(&call.process);
        let key = (Kind::Callback, call.handle);
        let tracked = process.and_then(|process| process.handles.get(&key));
        let mut domain_id = process.map_or(DomainId(0), |process| process.facts.domain_id);
        let mut usual = ThreadStates::default();
        if let Some(tracked) = tracked {
            domain_id = tracked.domain_id;
            usual = tracked.figures.states();
            call.node = call.node.or_else(|| tracked.node.clone());
        }
        if let (Some(process), Trigger::Subscription(topic)) = (process, &call.trigger)
            && let Some(topic) = self.topics.get(domain_id, topic)
            && let (Some(source), Some(wait)) = (call.source, call.wait)
        {
            let started = clock.model_time(call.started);
            let awaited = Awaited {
                source,
                started,
                wait,
            };
            call.repairs = repairs(&process.participants, (domain_id, &topic.naming), awaited);
        }
        self.late.add(call, domain_id, usual, clock);
    }

    /// Removes an ended process; the sums of its topics remain.
    fn remove(&mut self, id: u32) {
        if let Some(process) = self.processes.remove(&id) {
            self.handles.sub(process.handles.len());
            self.states.retain(|(process, _), _| *process != id);
            self.graph = None;
            self.revision += 1;
        }
    }

    /// Ends the window of all figures at `at`.
    fn turn(&mut self, at: ModelTime) {
        let mut live: BTreeMap<(DomainId, TopicName), Live> = BTreeMap::new();
        for process in self.processes.values_mut() {
            process.turn(at);
            for tracked in process.handles.values_mut() {
                tracked.turn(at);
                let Some(topic) = &tracked.figures.topic else {
                    continue;
                };
                let entry = live.entry((tracked.domain_id, topic.clone())).or_default();
                entry.count(tracked);
            }
        }
        self.topics.turn(&live, at);
    }

    /// Evaluates the rules for all handles.
    fn judge(&mut self, at: ModelTime) {
        self.revision += u64::from(self.late.judge(at));
        for process in self.processes.values_mut() {
            let handles = process.handles.values();
            let timers: Vec<_> = handles.clone().filter_map(TimerThread::of).collect();
            let mut threads: HashMap<u32, ThreadLoad> = HashMap::new();
            for tracked in handles {
                let Some(thread) = tracked.figures.thread() else {
                    continue;
                };
                let load = threads.entry(thread).or_default();
                let [duration, _] = tracked.recent.quantiles;
                load.longest = load.longest.max(duration.maximum);
                load.busy += tracked.busy().unwrap_or_default();
            }
            for tracked in process.handles.values_mut() {
                let thread = tracked.figures.thread();
                let load = thread.and_then(|thread| threads.get(&thread)).copied();
                let changed = judge(tracked, &timers, load.unwrap_or_default(), at);
                self.revision += u64::from(changed);
            }
        }
    }

    fn findings_of(&self, process: u32, tracked: &Tracked, found: &mut Vec<Diagnosis>) {
        let topic = || {
            let name = tracked.figures.topic.as_ref()?;
            let topic = self.topics.get(tracked.domain_id, name)?;
            Some(topic.key(tracked.domain_id))
        };
        let owner = || tracked.owner(process);
        let alarms = &tracked.alarms;
        if let Some(trigger) = tracked.figures.trigger() {
            if let Some((duration, period)) = alarms.slow.raised() {
                let is_own = matches!(trigger, Trigger::Timer(Some(own))
                    if own.as_nanos() == u128::from(period));
                found.push(Diagnosis::SlowCallback {
                    topic: topic(),
                    callback: owner(),
                    trigger: trigger.clone(),
                    duration: Duration::from_nanos(duration),
                    period: Duration::from_nanos(period),
                    is_own_period: is_own,
                });
            }
            if let Some((wait, _)) = alarms.wait.raised() {
                found.push(Diagnosis::ExecutorWait {
                    topic: topic(),
                    callback: owner(),
                    trigger: trigger.clone(),
                    wait: Duration::from_nanos(wait),
                });
            }
        }
        if let Some((permille, _)) = alarms.overwritten.raised()
            && let Some(topic) = topic()
        {
            found.push(Diagnosis::IntraProcessOverflow {
                topic,
                queue: owner(),
                overwritten_permille: permille,
            });
        }
    }

    fn late_finding(&self, late: &Late<'_>) -> Diagnosis {
        let name = late.trigger.name().map(TopicName::from);
        let topic = name.and_then(|name| self.topics.get(late.owner.domain_id, &name));
        Diagnosis::LateCallback {
            topic: topic.map(|topic| topic.key(late.owner.domain_id)),
            callback: late.owner.clone(),
            trigger: late.trigger.clone(),
            calls: late.calls,
            stage: late.stage,
            cause: late.cause,
            by: late.longest.other_thread.clone(),
            longest: late.longest.total,
        }
    }

    fn find(&self, domain_id: DomainId, naming: &Naming) -> Option<&InsideTopic> {
        if naming.kind.is_service() {
            return None;
        }
        self.topics.get(domain_id, &naming.name)
    }
}

impl Process {
    fn turn(&mut self, at: ModelTime) {
        let [(begin, cpu, calls), (middle, ..)] = self.marks;
        let span = (at - begin).as_secs_f64();
        if span > 0.0 {
            let both = self.cpu.zip(cpu);
            let spent = both.map(|(end, begin)| end.saturating_sub(begin).as_secs_f64());
            self.facts.cpu = spent.map(|spent| spent / span);
            let hits = self.facts.calls.saturating_sub(calls);
            self.facts.calls_hz = ratio(hits, 1).map(|hits| hits / span);
        }
        if at - middle >= HALF_WINDOW {
            self.marks = [self.marks[1], (at, self.cpu, self.facts.calls)];
        }
    }
}
