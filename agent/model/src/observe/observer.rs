//! Entry point of the core: datagrams and records in, interest and snapshots out.
//!
//! All processing uses the source's time, which the caller passes in: the same input yields the
//! same facts, live or replayed at any speed. The observer reads no clock, sends nothing and keeps
//! no packets.

mod announcements;
mod arrivals;
mod calls;
mod chains;
mod clock;
mod inside;
mod lists;
mod report;
mod samples;
mod settings;
mod zenoh;

use std::collections::{BTreeMap, HashMap};
use std::sync::Arc;
use std::time::Duration;

use ros2probe_wire::discovery::Role;
use ros2probe_wire::record::Handover;
use ros2probe_wire::walk::{self, Envelope, Found, Outcome};
use ros2probe_wire::{DomainId, EntityId, Guid, Reason, SequenceNumber, Timestamp};

use crate::derive::chain::Chains;
use crate::derive::examiner::Examiner;
use crate::derive::inside::Inside;
use crate::derive::services::Services;
use crate::derive::trace::{Tracer, WriterDescription};
use crate::facts::event::TEXT;
use crate::facts::journal::Journal;
use crate::facts::measurement::Measurement;
use crate::facts::model_time::ModelTime;
use crate::facts::names::DdsName;
use crate::facts::observation::{Observation, Path, Sample};
use crate::facts::selection::SampleRequest;
use crate::facts::wall_clock::WallClock;
use crate::facts::watch::Watchlist;
use crate::graph::discovery::{Caps, Change, Discovery, Endpoint, Memory, Priority};
use crate::graph::discovery_fragments::DiscoveryFragments;
use crate::graph::zenoh::{RestoredEndpoint, Zenoh};
use crate::measure::latched::Latched;
use crate::measure::payloads::Payloads;
use crate::measure::profiler::{ObservationOutcome, Profiler};
use crate::measure::receivers::Receivers;
use crate::measure::topic::{TopicId, Topics, Watched};
use crate::observe::input::{Captured, Input, Output};
use crate::observe::interest::Interest;
use crate::report::snapshot::Snapshot;
use crate::report::transport::{lacks_names, may_share_memory};
use lists::{traced_share, traits};
pub use settings::Settings;

/// Interval at which leases, windows and gaps are checked.
const TICK: Duration = Duration::from_millis(100);
/// A larger step of the clock means that the clock was set; it is not processed tick by tick.
const JUMP: Duration = Duration::from_secs(3600);
/// Largest number of names matched against globs at once, which takes a few milliseconds.
const MAX_MATCHES_PER_ROUND: usize = 20_000;

/// What the model needs from shared memory.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Wanted {
    /// No measured sample can use shared memory, and every name is known.
    Nothing,
    /// A name is unknown that shared memory may contain.
    Names,
    /// Samples of a measured writer may use shared memory.
    Samples,
    /// A subscription requests the samples of a writer that may use shared memory.
    EverySample,
}

/// Context of deliveries. A macro borrows only these fields, which a method cannot.
macro_rules! graph {
    ($observer:expr) => {
        $crate::measure::receivers::GraphView {
            receivers: &$observer.receivers,
            discovery: &$observer.discovery,
            topics: &$observer.topics,
            wall_clock: $observer.wall_clock,
        }
    };
}
pub(crate) use graph;

/// The core.
#[derive(Debug)]
pub struct Observer {
    pub(crate) settings: Settings,
    pub(crate) watchlist: Arc<Watchlist>,
    pub(crate) discovery: Discovery,
    pub(crate) topics: Topics,
    /// Topics to which the lists are still to be applied, the next one last.
    pending_topics: Vec<TopicId>,
    pub(crate) interest: Interest,
    pub(crate) profiler: Profiler,
    pub(crate) discovery_fragments: DiscoveryFragments,
    pub(crate) payloads: Payloads,
    pub(crate) latched: Latched,
    sample_requests: Arc<Vec<SampleRequest>>,
    /// Time at which they last changed.
    requests_changed: ModelTime,
    pub(crate) receivers: Receivers,
    pub(crate) services: Services,
    pub(crate) inside: Inside,
    pub(crate) chains: Chains,
    pub(crate) tracer: Tracer,
    pub(crate) zenoh: Zenoh,
    /// Number of the last change of the graph of Zenoh.
    zenoh_changes: SequenceNumber,
    /// Writers of Zenoh with a verdict, and their gids.
    zenoh_keys: HashMap<Guid, Guid>,
    pub(crate) examiner: Examiner,
    pub(crate) decode_errors: BTreeMap<(&'static str, &'static str), u64>,
    pub(crate) datagrams: u64,
    pub(crate) records: u64,
    journal: Journal,
    /// Time up to which all decisions are made.
    clock: ModelTime,
    /// Time from which on the source sees the traffic; silence before it is unknown.
    view_began: ModelTime,
    wall_clock: WallClock,
}

impl Observer {
    /// Creates an observer without state or watches.
    #[must_use]
    pub fn new(settings: Settings) -> Self {
        let caps = Caps {
            participants: settings.participants,
            endpoints: settings.endpoints,
            nodes: settings.nodes,
        };
        Self {
            settings,
            watchlist: Arc::default(),
            discovery: Discovery::new(caps),
            topics: Topics::default(),
            pending_topics: Vec::new(),
            interest: Interest::new(settings.interest),
            profiler: Profiler::new(
                settings.unknown_writers,
                settings.sample_bytes,
                settings.deliveries,
            ),
            discovery_fragments: DiscoveryFragments::default(),
            payloads: Payloads::new(settings.payload_bytes, settings.payload_delay),
            latched: Latched::default(),
            sample_requests: Arc::default(),
            requests_changed: ModelTime::ZERO,
            receivers: Receivers::new(settings.deliveries, settings.participants),
            services: Services::default(),
            inside: Inside::default(),
            chains: Chains::default(),
            tracer: Tracer::new(settings.directed),
            zenoh: Zenoh::default(),
            zenoh_changes: zenoh::FIRST_CHANGE,
            zenoh_keys: HashMap::new(),
            examiner: Examiner::default(),
            decode_errors: BTreeMap::new(),
            datagrams: 0,
            records: 0,
            journal: Journal::default(),
            clock: ModelTime::ZERO,
            view_began: ModelTime::ZERO,
            wall_clock: WallClock::default(),
        }
    }

    /// Processes one input.
    pub fn input(&mut self, input: Input<'_>) {
        match input {
            Input::Time(now) => self.advance(self.wall_clock.model_time(now)),
            Input::ClockSet(step) => self.wall_clock.set(step),
            Input::ViewBegan(at) => self.view_began = self.wall_clock.model_time(at),
            Input::Datagram {
                envelope,
                payload,
                handover,
            } => self.walk(Captured::new(envelope, payload, false), payload, handover),
            Input::CutDatagram {
                envelope,
                payload,
                length,
            } => self.cut_datagram(envelope, payload, length),
            Input::Submessage { captured, found } => {
                self.submessage(captured, found, EntityId::is_builtin);
            }
            Input::DatagramEnd(outcome) => self.datagram_end(outcome),
            Input::SharedMemory { envelope, payload } => {
                self.walk(Captured::new(envelope, payload, true), payload, None);
            }
            Input::SharedMemoryGap(now) => self.profiler.uncertain(self.wall_clock.model_time(now)),
            Input::ProbesDetached => self.profiler.end_exact_view(),
            Input::Zenoh(report) => self.zenoh_report(report),
            Input::Observation(observation) => self.count(observation),
            Input::ParticipantAlive(prefix, at) => {
                let at = self.wall_clock.model_time(at);
                self.discovery.seen(prefix, at, Priority::NOTHING);
            }
            Input::Socket(facts) => self.receivers.socket(facts),
            Input::SocketClosed(cookie) => self.receivers.socket_closed(cookie),
            Input::SocketForgotten(cookie) => self.receivers.socket_forgotten(cookie),
            Input::Inside(report) => self.report_inside(report),
            Input::InsideDetached => self.inside.detach(),
            Input::DecodeError { stage, reason } => self.decode_error(stage, reason),
            Input::Watchlist(watchlist) => self.set_watchlist(watchlist),
            Input::SampleRequests(sample_requests) => self.set_sample_requests(sample_requests),
            Input::ExpectedChains(chains) => self.chains.expect(chains),
            Input::CausalPublication(publication) => self.chain_published(publication),
            Input::Restored { memory, now } => {
                self.restore(memory, self.wall_clock.model_time(now));
            }
            Input::End => self.settle(),
        }
    }

    /// Removes and returns all output since the last call.
    pub fn drain(&mut self) -> Output {
        let mut output = Output {
            interest: self.interest.changes(),
            events: self.journal.events.take(self.wall_clock),
            samples: self.payloads.take(self.wall_clock),
            spans: self.tracer.take(self.wall_clock),
            chain_spans: self.chains.take_spans(),
        };
        self.keep_dispatched(&output.samples);
        self.zenoh_interest(&mut output.interest);
        output
    }

    /// Returns the clock by which sources convert the times of their observations.
    #[must_use]
    pub const fn wall_clock(&self) -> WallClock {
        self.wall_clock
    }

    /// Returns whether a subscription requests payloads.
    #[must_use]
    pub const fn wants_payloads(&self) -> bool {
        self.payloads.wants_any_bytes()
    }

    /// Returns whether so much output waits that it should be drained before further input.
    #[must_use]
    pub fn has_much_output(&self) -> bool {
        self.payloads.is_full() || self.journal.events.are_many()
    }

    /// Returns what the model needs from shared memory at present.
    #[must_use]
    pub fn wanted_of_shared_memory(&self) -> Wanted {
        let may_share = |guid: &Guid| may_share_memory(&self.discovery, *guid);
        if self.payloads.wanted().any(may_share) || self.awaits_writers() {
            Wanted::EverySample
        } else if self.profiler.iter().any(|(guid, _)| may_share(guid)) {
            Wanted::Samples
        } else if lacks_names(&self.discovery, self.clock) {
            Wanted::Names
        } else {
            Wanted::Nothing
        }
    }

    /// Returns whether a request covers topics whose writers may appear at any time. The first message
    /// of such a writer is to be seen, too.
    fn awaits_writers(&self) -> bool {
        let mut requests = self.sample_requests.iter();
        requests.any(|request| request.selection.is_open() || !self.payloads.serves(request.id))
    }

    /// Processes a truncated datagram of a capture file: submessage headers count, payloads are not
    /// read.
    fn cut_datagram(&mut self, envelope: &Envelope, payload: &[u8], length: u32) {
        self.datagrams += 1;
        self.decode_error("frame", Reason::Truncated);
        let length = length.min(u16::MAX.into()).try_into().unwrap_or(0);
        let mut padded = payload.to_vec();
        padded.resize(payload.len().max(length), 0);
        walk::datagram(&padded, envelope, None, |found| {
            self.count(&Observation::of(&found.record, self.wall_clock));
        });
    }

    /// Restores saved state, valid for at most one lease from `now` on.
    fn restore(&mut self, memory: &Memory, now: ModelTime) {
        // Watches that are applied next begin at this time.
        self.advance(now);
        self.discovery.restore(memory, now);
        self.examiner.forget();
        let prefixes: Vec<_> = self.discovery.participants().keys().copied().collect();
        for prefix in prefixes {
            self.announce(prefix);
        }
        let endpoints = self.discovery.endpoints().iter();
        let endpoints = endpoints.map(|(guid, endpoint)| RestoredEndpoint {
            guid: *guid,
            domain_id: endpoint.domain_id,
            gid: endpoint.gid,
            topic: &endpoint.topic,
        });
        self.zenoh.restore(&memory.zenoh, endpoints, now);
        self.follow_up(now);
    }

    /// Returns the discovery state to save for the next start.
    #[must_use]
    pub fn memory(&self) -> Memory {
        Memory {
            zenoh: self.zenoh.memory(),
            ..self.discovery.memory()
        }
    }

    /// Returns a number that increases with every change of [`Self::memory`].
    #[must_use]
    pub const fn memory_revision(&self) -> u64 {
        self.discovery.revision() + self.zenoh.revision()
    }

    /// Returns the latest discovery events and losses.
    #[must_use]
    pub const fn journal(&self) -> &Journal {
        &self.journal
    }

    /// Returns all facts at `now`.
    #[must_use]
    pub fn snapshot(&self, now: Timestamp) -> Snapshot {
        report::snapshot(self, now)
    }

    /// Returns the domain, DDS name and counts of each measured topic at `now`.
    pub fn measured(
        &self,
        now: Timestamp,
    ) -> impl Iterator<Item = (DomainId, &DdsName, Measurement)> {
        report::measured(self, self.wall_clock.model_time(now))
    }

    /// Counts a parse failure, including those of callers that parse for the core.
    fn decode_error(&mut self, stage: &'static str, reason: Reason) {
        *self
            .decode_errors
            .entry((stage, reason.label()))
            .or_default() += 1;
    }

    /// Counts an observation.
    fn count(&mut self, observation: &Observation) {
        self.records += 1;
        let head = observation.head();
        let (writer, sender, at) = (head.writer, observation.sender(), head.at);
        if matches!(observation, Observation::Presence(_)) {
            self.discovery.seen(sender, at, Priority::NOTHING);
            return;
        }
        let sample = observation.sample();
        let evidence = Priority {
            watched: false,
            local: match head.path {
                // A router's socket sends samples of many sessions.
                Path::Stream { .. } => self.receivers.is_local(&sender),
                Path::Wire | Path::SharedMemory { .. }
                    if self.settings.directed && head.leaves() =>
                {
                    self.receivers.found_here(sender)
                }
                _ => self.receivers.learn(observation),
            },
            sends: sample.is_some_and(Sample::is_delivered) && !writer.entity.is_builtin(),
        };
        if self.discovery.seen(sender, at, evidence) {
            let journal = &mut self.journal;
            if self.discovery.learn(sender, evidence, at, journal) {
                self.announce(sender);
            }
            self.follow_up(at);
        }
        if writer.entity.is_builtin() {
            return;
        }
        if let Some(sample) = sample {
            self.latched.seen(sample);
        }
        if self.tracer.is_wanted() {
            self.trace(observation);
        }
        // Requests and replies are seldom measured: ordinary topics need no further lookup.
        let measures_calls = self.services.has_measured();
        if let Some(sample) = sample.filter(|_| measures_calls) {
            self.call_seen(sample);
        }
        let graph = graph!(self);
        let journal = &mut self.journal;
        match self.profiler.observe(observation, journal, graph) {
            ObservationOutcome::Unmeasured => {
                if let Some(sample) = sample.filter(|_| !measures_calls) {
                    self.call_seen(sample);
                }
            }
            ObservationOutcome::Measured => {
                if let Some(sample) = sample {
                    self.chain_seen(sample, None);
                }
                if self.payloads.is_unsettled(writer) {
                    if let Some(sample) = sample {
                        self.came_again(sample);
                    }
                    self.turn(writer, at);
                }
                return;
            }
            ObservationOutcome::Counted(counted) => {
                self.report_missing();
                if let Some(sample) = sample {
                    self.chain_seen(sample, Some(&counted));
                }
                self.counted(writer, &counted);
                return;
            }
        }
        let is_strange = writer.entity.is_writer()
            && !self.discovery.endpoints().contains_key(&writer)
            && !self.discovery.was_disposed(writer, at);
        if is_strange {
            let graph = graph!(self);
            let journal = &mut self.journal;
            let outcome = self.profiler.unknown_writer(observation, journal, graph);
            if let ObservationOutcome::Counted(counted) = outcome {
                self.counted(writer, &counted);
            }
        }
    }

    fn trace(&mut self, observation: &Observation) {
        let Self {
            tracer,
            discovery,
            topics,
            watchlist,
            receivers,
            ..
        } = self;
        let writer = observation.head().writer;
        let is_local = receivers.is_local(&writer.prefix);
        tracer.observe(observation, is_local, || {
            let endpoint = discovery.endpoints().get(&writer)?;
            let naming = endpoint.naming()?;
            let topic = topics.get(topics.find(endpoint.domain_id, &naming)?)?;
            let subject = WriterDescription {
                domain_id: topic.domain_id,
                topic: topic.naming.name.bounded(TEXT),
                message_type: endpoint.message_type.bounded(TEXT),
                reliable: traits(writer, endpoint).reliable,
            };
            (topic.watched == Watched::Yes).then(|| (subject, traced_share(topic, watchlist)))
        });
    }

    /// Reads a datagram: the announcements and payloads, and counts every submessage.
    fn walk(&mut self, captured: Captured<'_>, payload: &[u8], handover: Option<&Handover>) {
        let outcome = walk::datagram(payload, captured.envelope, handover, |found| {
            self.submessage(captured, &found, |_| true);
        });
        self.datagram_end(outcome);
    }

    /// Reads the announcement or payload in a submessage, and counts it if `counts` is true for its
    /// writer.
    fn submessage(
        &mut self,
        captured: Captured<'_>,
        found: &Found<'_>,
        counts: impl Fn(EntityId) -> bool,
    ) {
        let observation = match captured.is_polled {
            true => Observation::of_polled(&found.record, self.wall_clock),
            false => Observation::of(&found.record, self.wall_clock),
        };
        self.announced(captured, found, &observation);
        if counts(observation.head().writer.entity) {
            self.count(&observation);
        }
    }

    fn datagram_end(&mut self, outcome: Outcome) {
        self.datagrams += 1;
        if outcome == Outcome::Malformed {
            self.decode_error("rtps", Reason::BadLength);
        }
    }

    /// Applies changes of discovery to topics, interest and measurement.
    fn follow_up(&mut self, now: ModelTime) {
        for change in self.discovery.changes() {
            self.receivers.changed();
            match change {
                Change::Appeared(guid) => self.appeared(guid, now),
                Change::Changed(guid) => {
                    let Some(endpoint) = self.discovery.endpoints().get(&guid) else {
                        continue;
                    };
                    self.profiler.learn(guid, traits(guid, endpoint));
                }
                Change::Gone(guid, endpoint) => self.gone(guid, &endpoint, now),
            }
        }
    }

    fn appeared(&mut self, guid: Guid, now: ModelTime) {
        let Some(endpoint) = self.discovery.endpoints().get(&guid) else {
            return;
        };
        let Some(mut naming) = endpoint.naming() else {
            return;
        };
        if naming.dds_name == endpoint.topic {
            // All owners of the name share one copy.
            naming.dds_name = endpoint.topic.clone();
        }
        let (role, message_type) = (endpoint.role, endpoint.message_type.clone());
        let (id, is_new) = self
            .topics
            .join(endpoint.domain_id, &naming, guid, role, now);
        if let Some(topic) = self.topics.get_mut(id) {
            topic.last_type = Some(message_type);
        }
        if is_new {
            self.topics.shrink(self.settings.endpoints);
            self.apply_lists(id, now);
        }
        self.apply(id, guid, now);
        let opened = self
            .topics
            .get(id)
            .filter(|topic| topic.watched == Watched::Yes);
        if let Some(topic) = opened.filter(|_| role == Role::Reader) {
            for writer in topic.writers.iter().chain(&topic.buffer_endpoints) {
                self.profiler.open(*writer, now);
            }
        }
    }

    fn gone(&mut self, guid: Guid, endpoint: &Endpoint, now: ModelTime) {
        self.interest.remove(guid);
        self.services.forget(guid);
        self.tracer.forget(guid);
        self.retire(guid, now);
        self.payloads.release(guid, now);
        self.latched.forget(guid);
        let (domain_id, topic) = (endpoint.domain_id, endpoint.topic.bounded(TEXT));
        self.journal.events.name(guid, domain_id, &topic);
        let id = endpoint
            .naming()
            .and_then(|naming| self.topics.find(endpoint.domain_id, &naming));
        if let Some(id) = id {
            self.topics.leave(id, guid, now);
        }
    }
}
