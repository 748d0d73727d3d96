//! Entry point of the core: datagrams and records in, interest and snapshots out.
//!
//! All processing uses the source's time, which the caller passes in: the same input yields the
//! same facts, live or replayed at any speed. The observer reads no clock, sends nothing and keeps
//! no packets.
//!
//! Its parts, and when they run:
//! - This module: leases, and a submessage's numbers at its writer and receivers; per observation.
//! - `announcements`: SPDP, SEDP, `ros_discovery_info`; per captured sample.
//! - `clocks`: stamps beside arrivals; per observation.
//! - `samples`, `calls`, `chains`: payloads, requests and replies, stamps; per sample.
//! - `zenoh`: connections of Zenoh; per report.
//! - `inside`, `arrivals`: calls inside processes, and their queues; per report.
//! - `lists`, `settings`: which topics are measured; when a list changes.
//! - `clock`: what time decides, such as leases, gaps that become losses, findings; per tick.
//! - `report`: the snapshot; on request.

mod announcements;
mod arrivals;
mod calls;
mod chains;
mod clock;
mod clocks;
mod inside;
mod lists;
mod references;
mod report;
mod samples;
mod settings;
mod zenoh;

use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::Duration;

use ros2probe_wire::discovery::Role;
use ros2probe_wire::record::Handover;
use ros2probe_wire::walk::{self, Envelope, Found, Outcome};
use ros2probe_wire::{DomainId, Guid, GuidPrefix, Reason, Timestamp};

use crate::derive::chain::Chains;
use crate::derive::clocks::Clocks;
use crate::derive::examiner::Examiner;
use crate::derive::inside::Inside;
use crate::derive::robot::Robot;
use crate::derive::services::Services;
use crate::derive::stamps::Stamps;
use crate::derive::trace::{Tracer, WriterDescription};
use crate::derive::type_descriptions::TypeDescriptions;
use crate::facts::event::MAX_TEXT;
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
use crate::measure::history::TopicCounts;
use crate::measure::latched::Latched;
use crate::measure::links::Links;
use crate::measure::payloads::Payloads;
use crate::measure::profiler::{ObservationOutcome, Profiler};
use crate::measure::receivers::{Graph, Receivers};
use crate::measure::tls::TlsConnections;
use crate::measure::topic::{Accelerated, TopicId, Topics, Watched};
use crate::observe::input::{Captured, Input, NewLog, Output};
use crate::observe::interest::Interest;
use crate::report::snapshot::Snapshot;
use crate::report::transport::{has_missing_names, may_share_memory};
use lists::{traced_share, traits};
use references::{CountedAs, References};
pub use settings::Settings;
use zenoh::ZenohNames;

/// Interval at which leases, windows and gaps are checked.
const TICK: Duration = Duration::from_millis(100);
/// A larger step of the clock means that the clock was set; it is not processed tick by tick.
const MAX_CLOCK_STEP: Duration = Duration::from_secs(3600);
/// Maximum number of names matched against globs per round, which takes a few milliseconds.
const MAX_MATCHES_PER_ROUND: usize = 20_000;

/// Which content of shared memory the model needs.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Wanted {
    /// No measured sample can use shared memory, and every name is known.
    Nothing,
    /// Shared memory may contain a name that is unknown.
    Names,
    /// Samples of a measured writer may use shared memory.
    Samples,
    /// A subscription requests the samples of a writer that may use shared memory.
    EverySample,
}

/// The core.
#[derive(Debug)]
pub struct Observer {
    pub(crate) settings: Settings,
    pub(crate) graph: Graph,
    pub(crate) requested: Requested,
    pub(crate) measure: Measure,
    pub(crate) derive: Derive,
    pub(crate) zenoh: Zenoh,
    zenoh_names: ZenohNames,
    references: References,
    pub(crate) counts: Counts,
    journal: Journal,
    /// Time of the latest decisions.
    clock: ModelTime,
    /// Time at which the source began to see the traffic; silence before it is unknown.
    view_began: ModelTime,
}

/// Topics to measure, and samples to dispatch.
#[derive(Debug)]
pub(crate) struct Requested {
    pub(crate) watchlist: Arc<Watchlist>,
    /// Topics to which the lists have yet to be applied, the next one last.
    pending_topics: Vec<TopicId>,
    sample_requests: Arc<Vec<SampleRequest>>,
    /// Time of the last change of `sample_requests`.
    requests_changed: ModelTime,
    pub(crate) interest: Interest,
}

/// Samples: their figures and their bytes.
#[derive(Debug)]
pub(crate) struct Measure {
    pub(crate) profiler: Profiler,
    pub(crate) discovery_fragments: DiscoveryFragments,
    pub(crate) payloads: Payloads,
    pub(crate) latched: Latched,
    pub(crate) links: Links,
    pub(crate) tls: TlsConnections,
}

/// State derived from graph and samples.
#[derive(Debug)]
pub(crate) struct Derive {
    pub(crate) services: Services,
    pub(crate) inside: Inside,
    pub(crate) chains: Chains,
    pub(crate) clocks: Clocks,
    pub(crate) stamps: Stamps,
    pub(crate) tracer: Tracer,
    pub(crate) examiner: Examiner,
    pub(crate) robot: Robot,
    type_descriptions: TypeDescriptions,
}

/// Counts of the input.
#[derive(Debug, Default)]
pub(crate) struct Counts {
    pub(crate) decode_errors: BTreeMap<(&'static str, &'static str), u64>,
    pub(crate) datagrams: u64,
    pub(crate) records: u64,
}

/// Where the observations of a captured datagram's user data come from.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum UserData {
    /// The datagram is their only source.
    Here,
    /// The source sorts them among others, and passes them as [`Input::Observation`].
    Separate,
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
            graph: Graph {
                receivers: Receivers::new(settings.deliveries, settings.participants),
                discovery: Discovery::new(caps),
                topics: Topics::default(),
                wall_clock: WallClock::default(),
            },
            requested: Requested {
                watchlist: Arc::default(),
                pending_topics: Vec::new(),
                sample_requests: Arc::default(),
                requests_changed: ModelTime::ZERO,
                interest: Interest::new(settings.interest),
            },
            measure: Measure {
                profiler: Profiler::new(
                    settings.unknown_writers,
                    settings.sample_bytes,
                    settings.deliveries,
                ),
                discovery_fragments: DiscoveryFragments::default(),
                payloads: Payloads::new(settings.payload_bytes, settings.payload_delay),
                latched: Latched::default(),
                links: Links::default(),
                tls: TlsConnections::default(),
            },
            derive: Derive {
                services: Services::default(),
                inside: Inside::default(),
                chains: Chains::default(),
                clocks: Clocks::default(),
                stamps: Stamps::default(),
                tracer: Tracer::new(settings.directed),
                examiner: Examiner::default(),
                robot: Robot::default(),
                type_descriptions: TypeDescriptions::default(),
            },
            zenoh: Zenoh::default(),
            references: References::default(),
            zenoh_names: ZenohNames::default(),
            counts: Counts::default(),
            journal: Journal::default(),
            clock: ModelTime::ZERO,
            view_began: ModelTime::ZERO,
        }
    }

    /// Processes one input.
    pub fn input(&mut self, input: Input<'_>) {
        match input {
            Input::Time(now) => self.advance(self.graph.wall_clock.model_time(now)),
            Input::ClockSet(step) => {
                self.graph.wall_clock.set(step);
                self.correct_latencies(self.clock);
            }
            Input::ViewBegan(at) => self.view_began = self.graph.wall_clock.model_time(at),
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
            Input::MessageBeginning {
                envelope,
                payload,
                length,
            } => self.message_beginning(envelope, payload, length),
            Input::Submessage { captured, found } => {
                self.submessage(captured, found, UserData::Separate);
            }
            Input::DatagramEnd(outcome) => self.datagram_end(outcome),
            Input::SharedMemory { envelope, payload } => {
                self.walk(Captured::new(envelope, payload, true), payload, None);
            }
            Input::SharedMemoryGap(now) => self
                .measure
                .profiler
                .note_uncertain(self.graph.wall_clock.model_time(now)),
            Input::StreamGap(destination, at) => {
                let at = self.graph.wall_clock.model_time(at);
                self.measure.profiler.missed(destination, at);
            }
            Input::ProbesDetached => {
                self.measure.profiler.end_exact_view();
                self.derive.robot.end_exact_view();
            }
            Input::Link(report) => {
                let now = self.clock;
                self.measure.links.report(report, now);
            }
            Input::ClientHello(flow) => self.measure.tls.hello(flow, self.clock),
            Input::Zenoh(report) => self.zenoh_report(report),
            Input::Observation(observation) => self.observe(observation),
            Input::ParticipantAlive(prefix, at) => {
                let at = self.graph.wall_clock.model_time(at);
                self.graph.discovery.seen(prefix, at, Priority::NO_EVIDENCE);
            }
            Input::Socket(facts) => self.graph.receivers.socket(facts),
            Input::SocketsRead => self.link_sessions(),
            Input::SocketClosed(cookie) => {
                self.measure.links.forget(cookie);
                self.graph.receivers.socket_closed(cookie);
            }
            Input::SocketForgotten(cookie) => self.graph.receivers.socket_forgotten(cookie),
            Input::Inside(report) => self.report_inside(report),
            Input::InsideDetached => self.derive.inside.detach(),
            Input::DecodeError { stage, reason } => self.decode_error(stage, reason),
            Input::Watchlist(watchlist) => self.set_watchlist(watchlist),
            Input::MoreLists => self.apply_more_lists(),
            Input::SampleRequests(sample_requests) => self.set_sample_requests(sample_requests),
            Input::ExpectedChains(chains) => self.derive.chains.expect(chains),
            Input::SharedMemoryUsed(memory) => self.derive.robot.use_shared_memory(&memory),
            Input::RobotExpectations(expected) => self.derive.robot.expect(expected),
            Input::CausalPublication(publication) => self.add_causal_publication(publication),
            Input::Restored { memory, now } => {
                self.restore(memory, self.graph.wall_clock.model_time(now));
            }
            Input::Stopping => self.release_waiting(),
            Input::End => self.settle(),
        }
    }

    /// Removes and returns all output since the last call.
    pub fn drain(&mut self) -> Output {
        let clock = self.graph.wall_clock;
        let new = self.derive.robot.take_logs();
        let tracer = &self.derive.tracer;
        let logs = new.messages.into_iter().map(|message| NewLog {
            arrival: clock.wall_time(message.at),
            trace_id: tracer.trace_of(message.writer, message.number),
            message,
        });
        let mut output = Output {
            logs: logs.collect(),
            lost_logs: new.lost,
            interest: self.requested.interest.changes(),
            events: self.journal.events.take(clock),
            samples: self.measure.payloads.take(clock),
            spans: self.derive.tracer.take(clock),
            chain_spans: self.derive.chains.take_spans(),
            late_calls: self.derive.inside.take_late_calls(),
            type_sources: self.derive.type_descriptions.take(),
        };
        self.keep_dispatched(&output.samples);
        self.zenoh_interest(&mut output.interest);
        output
    }

    /// Returns the clock by which sources convert the times of their observations.
    #[must_use]
    pub const fn wall_clock(&self) -> WallClock {
        self.graph.wall_clock
    }

    /// Returns whether a subscription requests payloads.
    #[must_use]
    pub const fn needs_payloads(&self) -> bool {
        self.measure.payloads.needs_any_payload()
    }

    /// Returns whether so much output waits that it should be drained before further input.
    #[must_use]
    pub fn has_much_output(&self) -> bool {
        self.measure.payloads.is_full()
            || self.journal.events.are_many()
            || self.derive.type_descriptions.are_many()
    }

    /// Returns which content of shared memory the model needs at present.
    #[must_use]
    pub fn wanted_of_shared_memory(&self) -> Wanted {
        let may_share = |guid: &Guid| may_share_memory(&self.graph.discovery, *guid);
        if self.measure.payloads.requested_writers().any(may_share) || self.awaits_writers() {
            Wanted::EverySample
        } else if self
            .measure
            .profiler
            .iter()
            .any(|(guid, _)| may_share(guid))
        {
            Wanted::Samples
        } else if has_missing_names(&self.graph.discovery, self.clock) {
            Wanted::Names
        } else {
            Wanted::Nothing
        }
    }

    /// Returns whether a request covers topics whose writers may appear at any time. The first
    /// message of such a writer must not be missed.
    fn awaits_writers(&self) -> bool {
        let mut requests = self.requested.sample_requests.iter();
        requests.any(|request| {
            request.selection.is_open() || !self.measure.payloads.has_request(request.id)
        })
    }

    /// Processes a truncated datagram of a capture file: submessage headers count, payloads are not
    /// read.
    fn cut_datagram(&mut self, envelope: &Envelope, payload: &[u8], length: u32) {
        self.counts.datagrams += 1;
        self.decode_error("frame", Reason::Truncated);
        let length = length.min(u16::MAX.into()).try_into().unwrap_or(0);
        let mut padded = payload.to_vec();
        padded.resize(payload.len().max(length), 0);
        walk::datagram(&padded, envelope, None, |found| {
            let clock = self.graph.wall_clock;
            Observation::each(&found.record, clock, |observation| {
                self.observe(observation);
            });
        });
    }

    /// Records that the participant that sent this RTPS message uses TCP, if the message came so.
    fn note_tcp_sender(&mut self, envelope: &Envelope, payload: &[u8]) {
        if envelope.logical_port != 0
            && let Some(prefix) = payload.get(8..20)
            && let Ok(prefix) = prefix.try_into()
        {
            self.graph.discovery.note_tcp(GuidPrefix(prefix));
        }
    }

    fn message_beginning(&mut self, envelope: &Envelope, payload: &[u8], length: u32) {
        self.note_tcp_sender(envelope, payload);
        let outcome = walk::beginning(payload, length, envelope, |found| {
            let clock = self.graph.wall_clock;
            Observation::each(&found.record, clock, |observation| {
                self.observe(observation);
            });
        });
        self.datagram_end(outcome);
    }

    /// Restores saved state, valid for at most one lease from `now` on.
    fn restore(&mut self, memory: &Memory, now: ModelTime) {
        // Watches that are applied next begin at this time.
        self.advance(now);
        self.graph.discovery.restore(memory, now);
        self.derive.examiner.forget();
        let prefixes: Vec<_> = self
            .graph
            .discovery
            .participants()
            .keys()
            .copied()
            .collect();
        for prefix in prefixes {
            self.announce(prefix);
        }
        let endpoints = self.graph.discovery.endpoints().iter();
        let endpoints = endpoints.map(|(guid, endpoint)| RestoredEndpoint {
            guid: *guid,
            domain_id: endpoint.domain_id,
            gid: endpoint.gid,
            topic: &endpoint.topic,
        });
        self.zenoh.restore(&memory.zenoh, endpoints, now);
        self.apply_discovery_changes(now);
    }

    /// Returns the discovery state to save for the next start.
    #[must_use]
    pub fn memory(&self) -> Memory {
        Memory {
            zenoh: self.zenoh.memory(),
            ..self.graph.discovery.memory()
        }
    }

    /// Returns a number that increases with every change of [`Self::memory`].
    #[must_use]
    pub const fn memory_revision(&self) -> u64 {
        self.graph.discovery.revision() + self.zenoh.revision()
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
    ) -> TopicCounts<impl Iterator<Item = (DomainId, &DdsName, Measurement)>> {
        let at = self.graph.wall_clock.model_time(now);
        let topics = report::measured(self, at);
        TopicCounts { at, topics }
    }

    /// Counts a parse failure. Callers that parse for the core report failures, too.
    fn decode_error(&mut self, stage: &'static str, reason: Reason) {
        *self
            .counts
            .decode_errors
            .entry((stage, reason.label()))
            .or_default() += 1;
    }

    /// Processes a submessage that a source saw: renews the lease of its sender, and measures user
    /// data. Losses are not decided here: [`Self::tick`] turns gaps into losses.
    fn observe(&mut self, observation: &Observation) {
        self.counts.records += 1;
        let writer = observation.head().writer;
        if matches!(observation, Observation::Presence(_)) {
            let (sender, at) = (observation.sender(), observation.head().at);
            self.graph.discovery.seen(sender, at, Priority::NO_EVIDENCE);
            return;
        }
        self.renew_lease(observation);
        self.compare_clocks(observation);
        self.check_stamp(observation);
        if writer.entity.is_builtin() {
            return;
        }
        if let Some(sample) = observation.sample() {
            self.measure.latched.seen(sample);
        }
        if self.derive.tracer.is_wanted() {
            self.trace(observation);
        }
        self.measure_user_data(observation);
    }

    /// Renews the lease of the participant that sent an observation, or admits it.
    fn renew_lease(&mut self, observation: &Observation) {
        let head = observation.head();
        let (sender, at) = (observation.sender(), head.at);
        let sample = observation.sample();
        let evidence = Priority {
            watched: false,
            local: match head.path {
                // A router's socket sends samples of many sessions.
                Path::Stream { .. } => self.graph.receivers.is_local(&sender),
                Path::Wire | Path::SharedMemory { .. }
                    if self.settings.directed && head.is_outgoing() =>
                {
                    self.graph.receivers.note_local(sender)
                }
                _ => self.graph.receivers.learn(observation),
            },
            sends: sample.is_some_and(Sample::is_delivered) && !head.writer.entity.is_builtin(),
        };
        if self.graph.discovery.seen(sender, at, evidence) {
            let journal = &mut self.journal;
            if self.graph.discovery.learn(sender, evidence, at, journal) {
                self.announce(sender);
            }
            self.apply_discovery_changes(at);
        }
    }

    /// Returns whether an observation of a writer counts, if it sends references to buffers. With
    /// Zenoh, this is decided before.
    fn counts_reference(&mut self, observation: &Observation) -> bool {
        let head = observation.head();
        let reference = self.references.get(head.writer);
        let Some(reference) = reference.filter(|_| !head.writer.prefix.is_zenoh()) else {
            return true;
        };
        let (publisher, channel) = (reference.publisher, head.writer.to_bytes());
        if reference.accelerated != Accelerated::All {
            return false;
        }
        if observation.sample().is_none() {
            return self.references.leads(publisher, channel);
        }
        let counted = self.references.count(publisher, channel, head.at);
        if counted == CountedAs::FirstMessage {
            self.measure.profiler.skip_numbers(head.writer, head.at);
        }
        counted != CountedAs::Copy
    }

    /// Measures user data of a measured topic, or of an unknown writer.
    fn measure_user_data(&mut self, observation: &Observation) {
        let (writer, sample) = (observation.head().writer, observation.sample());
        if !self.counts_reference(observation) {
            return;
        }
        // The profiler needs to know calls first. Requests and replies are seldom measured, so
        // ordinary topics skip this lookup.
        let measures_calls = self.derive.services.has_measured();
        if let Some(sample) = sample.filter(|_| measures_calls) {
            self.count_call(sample);
        }
        let journal = &mut self.journal;
        match (self.measure.profiler).observe(observation, journal, &self.graph) {
            ObservationOutcome::Unmeasured => {
                if let Some(sample) = sample.filter(|_| !measures_calls) {
                    self.count_call(sample);
                }
                self.measure_unknown_writer(observation);
            }
            ObservationOutcome::Measured => {
                if let Some(sample) = sample {
                    self.add_to_chains(sample, None);
                }
                if self.measure.payloads.is_unsettled(writer) {
                    if let Some(sample) = sample {
                        self.note_retransmitted(sample);
                    }
                    self.turn(writer, observation.head().at);
                }
            }
            ObservationOutcome::Counted(counted) => {
                self.report_missing();
                if let Some(sample) = sample {
                    self.add_to_chains(sample, Some(&counted));
                }
                self.counted(writer, &counted);
            }
        }
    }

    /// Measures the writer of an observation if no announcement of it is known.
    fn measure_unknown_writer(&mut self, observation: &Observation) {
        let head = observation.head();
        let (writer, discovery) = (head.writer, &self.graph.discovery);
        if !writer.entity.is_writer()
            || discovery.endpoints().contains_key(&writer)
            || discovery.was_disposed(writer, head.at)
        {
            return;
        }
        let journal = &mut self.journal;
        let outcome = (self.measure.profiler).unknown_writer(observation, journal, &self.graph);
        if let ObservationOutcome::Counted(counted) = outcome {
            self.counted(writer, &counted);
        }
    }

    fn trace(&mut self, observation: &Observation) {
        let (graph, watchlist) = (&self.graph, &self.requested.watchlist);
        let writer = observation.head().writer;
        let is_local = graph.receivers.is_local(&writer.prefix);
        self.derive.tracer.observe(observation, is_local, || {
            let endpoint = graph.discovery.endpoints().get(&writer)?;
            let naming = endpoint.naming()?;
            let topics = &graph.topics;
            let topic = topics.get(topics.find(endpoint.domain_id, &naming)?)?;
            let subject = WriterDescription {
                domain_id: topic.domain_id,
                topic: topic.naming.name.bounded(MAX_TEXT),
                message_type: endpoint.message_type.bounded(MAX_TEXT),
                reliable: traits(writer, endpoint).reliable,
            };
            (topic.watched == Watched::Yes).then(|| (subject, traced_share(topic, watchlist)))
        });
    }

    /// Reads the announcements and payloads of a datagram, and observes every submessage.
    fn walk(&mut self, captured: Captured<'_>, payload: &[u8], handover: Option<&Handover>) {
        self.note_tcp_sender(captured.envelope, payload);
        let outcome = walk::datagram(payload, captured.envelope, handover, |found| {
            self.submessage(captured, &found, UserData::Here);
        });
        self.datagram_end(outcome);
    }

    /// Reads the announcement or payload in a submessage, and observes it.
    fn submessage(&mut self, captured: Captured<'_>, found: &Found<'_>, user_data: UserData) {
        let clock = self.graph.wall_clock;
        let observe = |observation: &Observation| {
            if !found.is_batch() {
                self.announced(captured, found, observation);
            }
            if user_data == UserData::Here || observation.head().writer.entity.is_builtin() {
                self.observe(observation);
            }
        };
        match captured.is_polled {
            true => Observation::for_each_polled(&found.record, clock, observe),
            false => Observation::each(&found.record, clock, observe),
        }
    }

    fn datagram_end(&mut self, outcome: Outcome) {
        self.counts.datagrams += 1;
        if outcome == Outcome::Malformed {
            self.decode_error("rtps", Reason::BadLength);
        }
    }

    /// Applies changes of discovery to topics, interest and measurement.
    fn apply_discovery_changes(&mut self, now: ModelTime) {
        for change in self.graph.discovery.changes() {
            self.graph.receivers.changed();
            match change {
                Change::Appeared(guid) => self.appeared(guid, now),
                Change::Changed(guid) => {
                    let Some(endpoint) = self.graph.discovery.endpoints().get(&guid) else {
                        continue;
                    };
                    let has_buffers = endpoint.backends.is_some();
                    let has_filter = endpoint.content_filter;
                    let topic = endpoint
                        .naming()
                        .and_then(|naming| self.graph.topics.find(endpoint.domain_id, &naming));
                    self.measure.profiler.learn(guid, traits(guid, endpoint));
                    if let Some(topic) = topic {
                        if let Some(topic) = self.graph.topics.get_mut(topic) {
                            topic.has_buffers |= has_buffers;
                            topic.has_filters |= has_filter;
                        }
                        self.find_references(topic);
                    }
                }
                Change::Gone(guid, endpoint) => self.remove_discovered(guid, &endpoint, now),
            }
        }
    }

    fn appeared(&mut self, guid: Guid, now: ModelTime) {
        let Some(endpoint) = self.graph.discovery.endpoints().get(&guid) else {
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
        let has_buffers = endpoint.backends.is_some() || naming.is_buffer;
        let has_filter = endpoint.content_filter;
        let (id, is_new) = self
            .graph
            .topics
            .join(endpoint.domain_id, &naming, guid, role, now);
        if let Some(topic) = self.graph.topics.get_mut(id) {
            topic.last_type = Some(message_type);
            topic.has_buffers |= has_buffers;
            topic.has_filters |= has_filter;
        }
        if is_new {
            self.graph.topics.shrink(self.settings.endpoints);
            self.apply_lists(id, now);
        }
        self.apply(id, guid, now, true);
        self.find_references(id);
        let opened = self
            .graph
            .topics
            .get(id)
            .filter(|topic| topic.watched == Watched::Yes);
        if let Some(topic) = opened.filter(|_| role == Role::Reader) {
            for writer in topic.writers.iter().chain(&topic.buffer_endpoints) {
                self.measure.profiler.open(*writer, now);
            }
        }
    }

    fn remove_discovered(&mut self, guid: Guid, endpoint: &Endpoint, now: ModelTime) {
        self.requested.interest.remove(guid);
        self.derive.services.forget(guid);
        self.derive.tracer.forget(guid);
        self.retire(guid, now);
        self.measure.payloads.release(guid, now);
        self.measure.latched.forget(guid);
        self.derive.robot.forget(guid);
        self.derive.stamps.forget(guid);
        self.derive.clocks.forget(guid);
        self.references.remove(guid);
        let (domain_id, topic) = (endpoint.domain_id, endpoint.topic.bounded(MAX_TEXT));
        self.journal.events.name(guid, domain_id, &topic);
        let id = endpoint
            .naming()
            .and_then(|naming| self.graph.topics.find(endpoint.domain_id, &naming));
        if let Some(id) = id {
            self.graph.topics.leave(id, guid, now);
            self.find_references(id);
        }
    }
}
