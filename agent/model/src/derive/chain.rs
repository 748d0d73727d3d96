//! Causal chains: the path of a measurement from a sensor's message to an actuator's, with the time
//! that each hop takes.
//!
//! A hop is one node: it reads a message on a topic and publishes another because of it. Two
//! independent methods find hops. By stamps, a message whose header has the stamp of an input
//! continues that input ([`stamps`]). By causality, a process publishes within the callback that
//! processes the input ([`causality`]). The chains of the two methods are kept apart.
//!
//! Payloads are not needed, because records contain the stamps. A wrong chain is worse than a
//! missing one, so a hop counts only after repeated and unambiguous evidence ([`evidence`]).

pub mod causality;
mod evidence;
pub mod exemplar;
pub mod expected;
pub(crate) mod graph;
pub mod path;
mod rates;
pub mod recorded;
pub mod spans;
mod stamps;
pub mod trace;

use std::collections::BTreeSet;
use std::sync::Arc;

use foldhash::HashMap;
use ros2probe_wire::{DomainId, Guid, GuidPrefix, Timestamp};

use crate::derive::trace::share::Share;
use crate::facts::bounded::Bounded;
use crate::facts::bounded::TableFacts;
use crate::facts::diagnosis::Diagnosis;
use crate::facts::model_time::ModelTime;
use crate::facts::names::DdsName;
use crate::facts::observation::Sample;
use crate::facts::tables::ChainOwners;
use crate::facts::wall_clock::WallClock;
use crate::graph::discovery::Discovery;
use crate::measure::profiler::Profiler;
use crate::measure::topic::{Topic, Topics};
use crate::measure::writer::Counted;
use causality::{CausalPublication, Causality, Origin};
use evidence::Evidence;
use expected::{ExpectedChain, ExpectedChains};
use graph::Graph;
use path::{ChainsFacts, Paths};
use spans::{ChainSpans, ChainTracer};
use stamps::{Messages, Published};

/// All chains.
#[derive(Debug, Default)]
pub struct Chains {
    graph: Graph,
    /// Revision of discovery and number of changes of the measured topics at the last build.
    built: Option<(u64, u64)>,
    changes: u64,
    messages: Messages,
    evidence: Evidence,
    causality: Causality,
    paths: Paths,
    expected: ExpectedChains,
    tracer: ChainTracer,
    /// Participants that own receiving sockets.
    owners: Bounded<ChainOwners, HashMap<u64, Option<GuidPrefix>>>,
    findings: Vec<Diagnosis>,
    revision: u64,
}

impl Chains {
    /// Replaces the configured chains.
    pub fn expect(&mut self, chains: Arc<Vec<ExpectedChain>>) {
        self.expected.set(chains);
        self.changed();
    }

    /// Records that the set of measured topics changed.
    pub const fn changed(&mut self) {
        self.changes = self.changes.wrapping_add(1);
    }

    /// Returns a number that increases with every change of [`Self::findings`].
    #[must_use]
    pub const fn revision(&self) -> u64 {
        self.revision
    }

    /// Returns the problems of chains: nodes that replace stamps, and chains above their limit.
    #[must_use]
    pub fn findings(&self) -> &[Diagnosis] {
        &self.findings
    }

    /// Returns whether the topic may be part of a configured chain.
    #[must_use]
    pub fn needs(&self, domain_id: DomainId, dds_name: &DdsName) -> bool {
        self.expected.needs(domain_id, dds_name)
    }

    /// Returns whether messages of this writer may belong to a chain.
    #[must_use]
    pub fn follows(&self, writer: Guid) -> bool {
        self.graph.outputs.contains_key(&writer)
    }

    /// Processes a counted message. `is_local` states whether its writer uses the clock of the
    /// capture.
    pub fn counted(
        &mut self,
        writer: Guid,
        counted: &Counted,
        is_local: bool,
        wall_clock: WallClock,
    ) {
        let Some(output) = self.graph.outputs.get(&writer) else {
            return;
        };
        let Some(stamp) = counted.stamp.filter(|stamp| *stamp != (0, 0)) else {
            return;
        };
        let began = wall_clock.wall_time(counted.began);
        let message = Published {
            output: Arc::clone(output),
            writer,
            number: counted.number,
            published: stamps::publication(counted.source, began, is_local),
            began,
            at: wall_clock.wall_time(counted.at),
            size: counted.bytes.try_into().unwrap_or(u32::MAX),
            sampled: counted.sampled,
            is_local,
            arrivals: Bounded::default(),
        };
        self.evidence.stamped(&message, stamp);
        let key = (output.node.domain_id, stamp);
        if let Some(evicted) = self.messages.add(key, message, counted.at) {
            self.conclude(evicted);
        }
    }

    /// Notes the arrival of a sample at a socket of this host. `owner` returns the participant that
    /// owns the socket.
    pub fn seen(
        &mut self,
        sample: &Sample,
        clock: WallClock,
        owner: impl FnOnce() -> Option<GuidPrefix>,
    ) {
        let head = &sample.head;
        let is_arrival = head.is_at_socket() && !head.is_sent() && sample.is_delivered();
        if !is_arrival || !sample.is_end() {
            return;
        }
        let writer = head.writer;
        if self
            .graph
            .outputs
            .get(&writer)
            .is_none_or(|each| !each.is_read)
        {
            return;
        }
        if self.owners.is_full() {
            self.owners.refuse();
            self.owners.clear();
        }
        let owner = match head.socket {
            0 => owner(),
            socket => {
                let known = self.owners.get_or_insert_with(socket, owner);
                known.copied().flatten()
            }
        };
        if let Some(owner) = owner {
            let at = clock.wall_time(head.at);
            self.messages
                .arrived((writer, sample.sequence_number), owner, at);
        }
    }

    /// Processes a publication within a callback. `origin` returns the facts about its input if it
    /// begins a chain.
    pub fn publication(
        &mut self,
        publication: &CausalPublication,
        now: ModelTime,
        origin: impl FnOnce() -> Origin,
    ) {
        self.causality
            .add(publication, now, origin, &mut self.tracer);
    }

    /// Removes and returns the spans completed since the last call.
    pub fn take_spans(&mut self) -> ChainSpans {
        self.tracer.take()
    }

    /// Evaluates the messages that are old enough, and updates the findings. `share` returns the
    /// traced share of a topic, `is_local` whether a participant runs on this host. Returns the
    /// topics whose measurement the configured chains newly need or no longer need.
    pub fn advance(
        &mut self,
        (discovery, topics, profiler): (&Discovery, &Topics, &Profiler),
        (now, wall_clock): (ModelTime, WallClock),
        share: impl Fn(&Topic) -> Option<Share>,
        is_local: impl Fn(&GuidPrefix) -> bool,
    ) -> BTreeSet<(DomainId, DdsName)> {
        for due in self.messages.due(now) {
            self.conclude(due);
        }
        self.causality
            .advance(now, &mut self.paths, &mut self.expected);
        self.owners.clear();
        let built = Some((discovery.revision(), self.changes));
        let mut changed = BTreeSet::new();
        if self.built != built {
            self.built = built;
            self.evidence.retain(|topic| topics.get(topic).is_some());
            self.graph = Graph::of(discovery, topics, share, is_local);
            changed = self.expected.route(discovery, topics);
        }
        self.find((topics, profiler), (now, wall_clock));
        changed
    }

    /// Evaluates all messages at the end of the input.
    pub fn settle(
        &mut self,
        (topics, profiler): (&Topics, &Profiler),
        (now, wall_clock): (ModelTime, WallClock),
    ) {
        for due in self.messages.settle() {
            self.conclude(due);
        }
        self.causality.settle(&mut self.paths, &mut self.expected);
        self.find((topics, profiler), (now, wall_clock));
    }

    /// Returns all chains at wall time `now`.
    #[must_use]
    pub fn facts(&self, now: Timestamp) -> ChainsFacts {
        self.paths.facts(&self.expected, now)
    }

    /// Returns the size, limit and evictions of two tables: chains, and messages that wait for
    /// evaluation.
    #[must_use]
    pub fn tables(&self) -> [TableFacts; 2] {
        [self.paths.table(), self.messages.table()]
    }

    /// Evaluates all messages with one stamp.
    fn conclude(&mut self, group: stamps::Group) {
        for trace in self.evidence.conclude(group, &mut self.tracer) {
            self.paths.add(trace, &mut self.expected);
        }
    }

    fn find(
        &mut self,
        (topics, profiler): (&Topics, &Profiler),
        (now, wall_clock): (ModelTime, WallClock),
    ) {
        let rates = rates::Rates::new(topics, profiler, now);
        let mut findings = self.evidence.restamping(&rates);
        let now = wall_clock.wall_time(now);
        findings.extend(self.expected.slow(now));
        findings.sort();
        findings.dedup();
        if self.findings != findings {
            self.findings = findings;
            self.revision += 1;
        }
    }
}
