//! The core's entry: datagrams and records in, interest and snapshots out.
//!
//! Everything happens in the source's time, which the caller passes in: the same input gives the
//! same facts, live or replayed at any speed. It reads no clock, sends nothing and keeps no packet.

use std::collections::BTreeMap;
use std::sync::Arc;

use ros2probe_wire::discovery::{self, Role};
use ros2probe_wire::entities::ParticipantEntities;
use ros2probe_wire::names::DdsTopic;
use ros2probe_wire::qos::{Durability, Reliability};
use ros2probe_wire::record::{Body, Handover, Sample, Verdict, flag};
use ros2probe_wire::rtps::{InlineQos, Payload, StatusInfo, VendorId};
use ros2probe_wire::time::SECOND;
use ros2probe_wire::walk::{self, Envelope, Found, Outcome};
use ros2probe_wire::{DomainId, EntityId, Guid, GuidPrefix, Reason, Record, Timestamp, WireError};

use super::diagnosis::{self, Examiner};
use super::discovery::{Caps, Change, Discovery, Endpoint, Memory, Origin, Priority, endpoints_of};
use super::discovery_fragments::DiscoveryFragments;
use super::event::{EventKind, bounded, bounded_finding, bounded_shared};
use super::expectation::Evidence;
use super::header::begins_with_header;
use super::input::{Input, Output};
use super::interest::Interest;
use super::journal::Journal;
use super::payloads::{self, Offered, Payloads};
use super::profiler::{Measured, Profiler, RecordOutcome, UNDELIVERED};
use super::rate::Slot;
use super::receivers::{GraphView, Receivers};
use super::route::Destination;
use super::selection::SampleRequest;
use super::size::Size;
use super::snapshot::{Measurement, Snapshot, WatchState};
use super::topic::{Naming, Topic, TopicId, Topics, Watched};
use super::topic_kind::TopicKind;
use super::trace::{Tracer, WriterDescription};
use super::transport::{lacks_names, may_share_memory};
use super::wall_clock::WallClock;
use super::writer::{Counted, Traits};
use crate::limits::Limits;
use crate::watch::{Watch, Watchlist};

/// How often leases, windows and gaps are looked at.
const TICK: u64 = SECOND / 10;
/// A clock that jumps further than this is set, not followed tick by tick.
const JUMP: u64 = 3600 * SECOND;
/// Names matched against globs in one go: a few milliseconds.
const MATCHES_AT_ONCE: usize = 20_000;

/// Caps and times.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Settings {
    /// Participants.
    pub participants: usize,
    /// Endpoints.
    pub endpoints: usize,
    /// Nodes.
    pub nodes: usize,
    /// Topics that are measured.
    pub topics: usize,
    /// Writers that send without a known announcement.
    pub unknown_writers: usize,
    /// Receivers and destinations of all measured writers; likewise sockets.
    pub deliveries: usize,
    /// Entries of the kernel's interest map.
    pub interest: usize,
    /// Bytes for the bitmaps of fragmented samples.
    pub sample_bytes: usize,
    /// Bytes of samples that are put together for those who want them whole.
    pub payload_bytes: usize,
    /// Nanoseconds for which a topic without endpoints is still reported.
    pub topic_grace: u64,
    /// Nanoseconds after which the bytes of samples come at the latest once they are wanted.
    pub payload_delay: u64,
    /// Records say who sent: not so those of a capture file.
    pub directed: bool,
}

/// What is wanted of messages in shared memory.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Wanted {
    /// Nothing that is measured can pass there, and every name is known.
    Nothing,
    /// A name is lacking that may be said there.
    Names,
    /// Samples of a measured writer may pass there.
    Samples,
    /// Those of a writer whose samples are to be given one by one.
    EverySample,
}

impl Default for Settings {
    fn default() -> Self {
        Self {
            participants: 1024,
            endpoints: 16_384,
            nodes: 4096,
            topics: 1000,
            unknown_writers: 256,
            deliveries: 4096,
            interest: 16_384,
            sample_bytes: 1 << 20,
            payload_bytes: 20 << 20,
            topic_grace: 600 * SECOND,
            payload_delay: payloads::PAYLOAD_DELAY,
            directed: true,
        }
    }
}

impl Settings {
    /// With the caps of the configuration.
    #[must_use]
    pub fn with_limits(self, limits: &Limits) -> Self {
        Self {
            participants: limits.participants,
            endpoints: limits.endpoints,
            topics: limits.topics,
            unknown_writers: limits.unknown_writers,
            deliveries: limits.flows,
            // The other half is for what waits to be read.
            payload_bytes: limits.payload_bytes / 2,
            ..self
        }
    }
}

/// What deliveries are seen against. Borrows these fields alone, which a method could not.
macro_rules! graph {
    ($observer:expr) => {
        GraphView {
            receivers: &$observer.receivers,
            discovery: &$observer.discovery,
            topics: &$observer.topics,
            wall_clock: $observer.wall_clock,
        }
    };
}

/// The core.
#[derive(Debug)]
pub struct Observer {
    pub(super) settings: Settings,
    pub(super) watchlist: Arc<Watchlist>,
    pub(super) discovery: Discovery,
    pub(super) topics: Topics,
    /// Topics about which the lists are still to be asked, the next one last.
    pending_topics: Vec<TopicId>,
    pub(super) interest: Interest,
    pub(super) profiler: Profiler,
    pub(super) discovery_fragments: DiscoveryFragments,
    pub(super) payloads: Payloads,
    sample_requests: Arc<Vec<SampleRequest>>,
    pub(super) receivers: Receivers,
    pub(super) tracer: Tracer,
    pub(super) examiner: Examiner,
    pub(super) decode_errors: BTreeMap<(&'static str, &'static str), u64>,
    pub(super) datagrams: u64,
    pub(super) records: u64,
    journal: Journal,
    /// Time up to which everything is settled.
    clock: Timestamp,
    wall_clock: WallClock,
}

impl Observer {
    /// Nothing seen, nothing watched.
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
            sample_requests: Arc::default(),
            receivers: Receivers::new(settings.deliveries, settings.participants),
            tracer: Tracer::new(settings.directed),
            examiner: Examiner::default(),
            decode_errors: BTreeMap::new(),
            datagrams: 0,
            records: 0,
            journal: Journal::default(),
            clock: Timestamp(0),
            wall_clock: WallClock::default(),
        }
    }

    /// Takes in one input.
    pub fn input(&mut self, input: Input<'_>) {
        match input {
            Input::Time(now) => self.advance(now),
            Input::ClockSet(step) => self.wall_clock.set(step),
            Input::Datagram {
                envelope,
                payload,
                handover,
            } => self.walk(envelope, payload, handover, 0, Self::count),
            Input::CutDatagram {
                envelope,
                payload,
                length,
            } => self.cut_datagram(envelope, payload, length),
            Input::Announcements {
                envelope,
                payload,
                records,
            } => self.walk(envelope, payload, None, 0, |observer, record| {
                if record.writer().entity.is_builtin() {
                    observer.count(record);
                } else {
                    records.push(*record);
                }
            }),
            Input::SharedMemory { envelope, payload } => {
                self.walk(envelope, payload, None, flag::SHM, Self::count);
            }
            Input::SharedMemoryGap(now) => self.profiler.uncertain(self.wall_clock.model_time(now)),
            Input::ProbesDetached => self.profiler.end_exact_view(),
            Input::Record(record) => self.count(record),
            Input::ParticipantAlive(prefix, at) => {
                let at = self.wall_clock.model_time(at);
                self.discovery.seen(prefix, at, Priority::NOTHING);
            }
            Input::Socket(facts) => self.receivers.socket(facts),
            Input::SocketClosed(cookie) => self.receivers.socket_closed(cookie),
            Input::SocketForgotten(cookie) => self.receivers.socket_forgotten(cookie),
            Input::DecodeError { stage, reason } => self.decode_error(stage, reason),
            Input::Watchlist(watchlist) => self.set_watchlist(watchlist),
            Input::SampleRequests(sample_requests) => self.set_sample_requests(sample_requests),
            Input::Restored { memory, now } => self.restore(memory, now),
            Input::End => self.settle(),
        }
    }

    /// Takes out what has come up since the last call.
    pub fn drain(&mut self) -> Output {
        let mut output = Output {
            interest: self.interest.changes(),
            events: self.journal.events.take(),
            samples: self.payloads.take(),
            spans: self.tracer.take(),
        };
        self.wall_clock.convert_events(&mut output.events);
        self.wall_clock.convert_dispatches(&mut output.samples);
        self.wall_clock.convert_spans(&mut output.spans);
        output
    }

    /// Watches these from now on, once [`Self::apply_more_lists`] has come to all topics. What was counted of
    /// a topic that is no more watched stays, and so does how a topic stands with an entry that is in
    /// the new list as it was.
    fn set_watchlist(&mut self, watchlist: Arc<Watchlist>) {
        let before = std::mem::replace(&mut self.watchlist, watchlist);
        let moved = |watch: &Arc<Watch>| {
            let place = self.watchlist.position(&watch.pattern, watch.domain_id)?;
            let after = self.watchlist.watches().get(place)?;
            (after.expectations == watch.expectations).then_some(place)
        };
        let moved: Vec<_> = before.watches().iter().map(moved).collect();
        self.topics.renumber(&moved);
        self.discovery.watch(Arc::clone(&self.watchlist));
        let watches = self.watchlist.watches();
        self.tracer
            .restart(watches.iter().any(|watch| watch.trace > 0.0));
        self.apply_lists_to_all();
    }

    /// Gives the samples that these wish for, and no others, once [`Self::apply_more_lists`] has come to all
    /// topics. Their topics are measured
    /// meanwhile, whether they are watched or not; what was counted stays.
    fn set_sample_requests(&mut self, sample_requests: Arc<Vec<SampleRequest>>) {
        self.sample_requests = sample_requests;
        if self.sample_requests.is_empty() {
            self.payloads.retain_unknown_writers(|_| false);
        }
        self.apply_lists_to_all();
    }

    /// The time up to which all samples were given, or told as missing, that have come by `now`.
    #[must_use]
    pub fn dispatched_until(&self, now: Timestamp) -> Timestamp {
        let writers = self.payloads.wanted();
        let writers = writers.filter_map(|writer| self.profiler.get(*writer));
        let unseen = writers.filter_map(|measured| measured.writer.unseen_since());
        unseen.fold(now, |until, since| {
            until.min(self.wall_clock.wall_time(since))
        })
    }

    /// Whether somebody wants samples whole.
    #[must_use]
    pub const fn wants_payloads(&self) -> bool {
        self.payloads.wants_any_bytes()
    }

    /// So much waits to be given that it should be taken before more comes.
    #[must_use]
    pub const fn has_much_output(&self) -> bool {
        self.payloads.is_full() || self.journal.events.are_many()
    }

    /// Entries, or bytes, and cap of every table of the model, by name.
    #[must_use]
    pub fn sizes(&self) -> Vec<Size> {
        // A new component does not compile before it has a place here.
        let Self {
            settings,
            watchlist,
            discovery,
            topics,
            pending_topics,
            interest,
            profiler,
            discovery_fragments,
            payloads,
            sample_requests,
            receivers,
            tracer,
            examiner,
            decode_errors,
            datagrams: _,
            records: _,
            journal,
            clock: _,
            wall_clock: _,
        } = self;
        let mut sizes = discovery.sizes();
        sizes.push(Size::new(
            "observer.pending_topics",
            pending_topics.len(),
            settings.endpoints,
        ));
        sizes.extend(topics.sizes(
            settings.endpoints,
            settings.topics,
            watchlist.watches().len(),
        ));
        sizes.extend(interest.sizes());
        sizes.extend(profiler.sizes(settings.endpoints));
        sizes.extend(discovery_fragments.sizes());
        sizes.extend(payloads.sizes(
            settings.endpoints,
            settings.unknown_writers,
            sample_requests.len(),
        ));
        sizes.extend(receivers.sizes());
        sizes.extend(tracer.sizes());
        sizes.extend(examiner.sizes(settings.endpoints));
        sizes.extend(journal.sizes());
        // Of each stage every reason.
        let reasons = Size::new("observer.decode_errors", decode_errors.len(), 64);
        sizes.push(reasons);
        sizes
    }

    /// What is wanted of shared memory at the moment.
    #[must_use]
    pub fn wanted_of_shared_memory(&self) -> Wanted {
        let may_share = |guid: &Guid| may_share_memory(&self.discovery, *guid);
        if self.payloads.wanted().any(may_share) {
            Wanted::EverySample
        } else if self.profiler.iter().any(|(guid, _)| may_share(guid)) {
            Wanted::Samples
        } else if lacks_names(&self.discovery, self.clock) {
            Wanted::Names
        } else {
            Wanted::Nothing
        }
    }

    /// Takes in a datagram of which a capture kept only the beginning: what it says about its
    /// submessages counts, its payloads are not read.
    fn cut_datagram(&mut self, envelope: &Envelope, payload: &[u8], length: u32) {
        self.datagrams += 1;
        self.decode_error("frame", Reason::Truncated);
        let length = length.min(u16::MAX.into()).try_into().unwrap_or(0);
        let mut padded = payload.to_vec();
        padded.resize(payload.len().max(length), 0);
        walk::datagram(&padded, envelope, None, |found| self.count(&found.record));
    }

    /// Says what time it is: ends leases, settles gaps, judges expectations.
    fn advance(&mut self, now: Timestamp) {
        let now = self.wall_clock.model_time(now);
        if self.clock.0 == 0 || now.0.saturating_sub(self.clock.0) > JUMP {
            self.clock = Timestamp(now.0 - now.0 % TICK);
            self.tick(self.clock);
        }
        while now.0.saturating_sub(self.clock.0) >= TICK {
            self.clock = Timestamp(self.clock.0 + TICK);
            self.tick(self.clock);
        }
    }

    /// Nothing more will come: decides what is still open, without letting time pass.
    fn settle(&mut self) {
        let graph = graph!(self);
        self.profiler.settle(self.clock, &mut self.journal, graph);
        self.report_missing();
        for writer in self.payloads.unsettled() {
            self.payloads.give_all(writer, self.clock);
        }
        self.report_losses();
        self.examine(self.clock);
    }

    /// Takes over what was known before the start, until one lease from `now` on at most.
    fn restore(&mut self, memory: &Memory, now: Timestamp) {
        let now = self.wall_clock.model_time(now);
        self.discovery.restore(memory, now);
        self.examiner.forget();
        let prefixes: Vec<_> = self.discovery.participants().keys().copied().collect();
        for prefix in prefixes {
            self.announce(prefix);
        }
        self.follow_up(now);
    }

    /// What is known of who is there, to be kept for the next start.
    #[must_use]
    pub fn memory(&self) -> Memory {
        self.discovery.memory()
    }

    /// Rises with every change of what [`Self::memory`] says.
    #[must_use]
    pub const fn memory_revision(&self) -> u64 {
        self.discovery.revision()
    }

    /// The latest discovery events and losses.
    #[must_use]
    pub const fn journal(&self) -> &Journal {
        &self.journal
    }

    /// All facts at this moment.
    #[must_use]
    pub fn snapshot(&self, now: Timestamp) -> Snapshot {
        let mut snapshot = super::report::snapshot(self, self.wall_clock.model_time(now));
        self.wall_clock.convert_snapshot(&mut snapshot);
        snapshot
    }

    /// All that was counted by `now` of each topic that is measured: domain, DDS name and counts.
    pub fn measured(
        &self,
        now: Timestamp,
    ) -> impl Iterator<Item = (DomainId, &Arc<str>, Measurement)> {
        super::report::measured(self, self.wall_clock.model_time(now))
    }

    /// Counts a parse failure, also of those outside who parse for the core.
    fn decode_error(&mut self, stage: &'static str, reason: Reason) {
        *self
            .decode_errors
            .entry((stage, reason.label()))
            .or_default() += 1;
    }

    fn count(&mut self, record: &Record) {
        self.records += 1;
        let moved = self.wall_clock.model_record(record);
        let record = moved.as_ref().unwrap_or(record);
        let (writer, at) = (record.writer(), Timestamp(record.time));
        let sender = record.sender();
        if matches!(record.body(), Body::Handover | Body::Undelivered) {
            self.discovery.seen(sender, at, Priority::NOTHING);
            return;
        }
        let evidence = Priority {
            watched: false,
            local: self.receivers.learn(record),
            sends: record.is_sample()
                && record.flags & UNDELIVERED == 0
                && !writer.entity.is_builtin(),
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
        if self.tracer.is_wanted() {
            self.trace(record);
        }
        let graph = graph!(self);
        let journal = &mut self.journal;
        match self.profiler.record(writer, record, journal, graph) {
            RecordOutcome::Unmeasured => {}
            RecordOutcome::Measured => {
                if self.payloads.is_unsettled(writer) {
                    self.came_again(writer, record);
                    self.turn(writer, at);
                }
                return;
            }
            RecordOutcome::Counted(counted) => {
                self.report_missing();
                self.counted(writer, &counted);
                return;
            }
        }
        let is_strange = writer.entity.is_writer()
            && !self.discovery.endpoints().contains_key(&writer)
            && !self.discovery.was_disposed(writer, at);
        if is_strange {
            let outcome = self.profiler.unknown_writer(writer, record, journal, graph);
            if let RecordOutcome::Counted(counted) = outcome {
                self.counted(writer, &counted);
            }
        }
    }

    /// Gives a sample, when it is its turn, or remembers that it was of a stranger.
    fn counted(&mut self, writer: Guid, counted: &Counted) {
        if self.sample_requests.is_empty() {
            return;
        }
        if !self.payloads.wants(writer) {
            let known = self.profiler.get(writer);
            if known.is_some_and(|known| known.topic.is_none()) {
                let sample_requests = self.sample_requests.iter().map(|request| request.id);
                let number = counted.number;
                // Those that the profiler gave up since the last second make room.
                if self.payloads.unknown_writers() >= self.settings.unknown_writers {
                    let profiler = &self.profiler;
                    self.payloads.retain_unknown_writers(|writer| {
                        let known = profiler.get(writer);
                        known.is_some_and(|known| known.topic.is_none())
                    });
                }
                self.payloads
                    .counted_of_unknown_writer(writer, number, sample_requests);
            }
            return;
        }
        let progress = self.profiler.progress(writer, counted.at, graph!(self));
        if let Some(progress) = progress {
            let skip = self.payloads.counted(writer, counted, &progress);
            self.skip(writer, skip);
        }
    }

    /// Gives a sample that was counted while its writer was a stranger, now that it comes again.
    fn came_again(&mut self, writer: Guid, record: &Record) {
        let Some(sample) = record.sample() else {
            return;
        };
        let (number, at) = (sample.sequence_number(), Timestamp(record.time));
        let stamp = match sample {
            Sample::Data(_) => sample.header_stamp(),
            Sample::DataFrag(_) => None,
        };
        if record.flags & UNDELIVERED != 0 || !self.payloads.lacks(writer, number) {
            return;
        }
        let has_header = |known: &Measured| known.writer.traits().has_header;
        let counted = Counted {
            number,
            bytes: sample.size().into(),
            source: record.source_timestamp(),
            stamp: stamp.filter(|_| self.profiler.get(writer).is_some_and(has_header)),
            at,
            began: at,
            sampled: false,
            unconfirmed: false,
        };
        let progress = self.profiler.progress(writer, at, graph!(self));
        if let Some(progress) =
            progress.filter(|_| sample.is_end() || self.payloads.wants_bytes(writer))
        {
            let skip = self.payloads.came_again(writer, &counted, &progress);
            self.skip(writer, skip);
        }
    }

    /// Gives the samples of this writer whose turn it is.
    fn turn(&mut self, writer: Guid, now: Timestamp) {
        let progress = self.profiler.progress(writer, now, graph!(self));
        if let Some(progress) = progress {
            let skip = self.payloads.turn(writer, &progress, now);
            self.skip(writer, skip);
        }
    }

    fn skip(&mut self, writer: Guid, number: Option<u64>) {
        if let Some(number) = number {
            self.profiler.skip(writer, number);
        }
    }

    fn trace(&mut self, record: &Record) {
        let Self {
            tracer,
            discovery,
            topics,
            watchlist,
            ..
        } = self;
        tracer.record(record, || {
            let endpoint = discovery.endpoints().get(&record.writer())?;
            let naming = naming(endpoint)?;
            let topic = topics.get(topics.find(endpoint.domain_id, &naming)?)?;
            let covering = topic.judgements.iter();
            let ratios =
                covering.filter_map(|(index, _)| Some(watchlist.watches().get(*index)?.trace));
            let subject = WriterDescription {
                domain_id: topic.domain_id,
                topic: bounded_shared(&topic.naming.name),
                message_type: bounded_shared(&endpoint.message_type),
                reliable: traits(endpoint).reliable,
            };
            (topic.watched == Watched::Yes).then(|| (subject, ratios.fold(0.0, f64::max)))
        });
    }

    fn walk(
        &mut self,
        envelope: &Envelope,
        payload: &[u8],
        handover: Option<&Handover>,
        flags: u16,
        mut count: impl FnMut(&mut Self, &Record),
    ) {
        self.datagrams += 1;
        let vendor = payload
            .get(6..8)
            .and_then(|bytes| <[u8; 2]>::try_from(bytes).ok());
        let vendor = vendor.filter(|vendor| *vendor != [0, 0]).map(VendorId);
        let outcome = walk::datagram(payload, envelope, handover, |mut found| {
            found.record.flags |= flags;
            self.announced(&found, vendor, envelope);
            count(self, &found.record);
        });
        if outcome == Outcome::Malformed {
            self.decode_error("rtps", Reason::BadLength);
        }
    }

    fn announced(&mut self, found: &Found<'_>, vendor: Option<VendorId>, envelope: &Envelope) {
        let record = &found.record;
        if let Some(sample) = record.sample() {
            let prefix = record.writer().prefix;
            let [first, second, ..] = prefix.0;
            let vendor = vendor.unwrap_or(VendorId([first, second]));
            let origin = Origin {
                at: self.wall_clock.model_time(Timestamp(envelope.time)),
                sender: prefix,
                sequence_number: sample.sequence_number(),
                destination: envelope.destination,
                port: envelope.destination_port,
            };
            self.read(found, sample, vendor, &origin);
            self.follow_up(origin.at);
            self.keep(found);
        }
    }

    /// Keeps the bytes of a sample that somebody wants and that was not counted yet.
    fn keep(&mut self, found: &Found<'_>) {
        let writer = found.record.writer();
        if self.payloads.wants_bytes(writer) {
            let moved = self.wall_clock.model_record(&found.record);
            let record = moved.as_ref().unwrap_or(&found.record);
            let known = self.profiler.get(writer);
            let Some(sample) = record.sample() else {
                return;
            };
            let lacks = self.payloads.lacks(writer, sample.sequence_number());
            if lacks || known.is_some_and(|known| !known.writer.has(sample)) {
                self.payloads.keep(sample, found.payload);
            }
        }
    }

    /// Tells the subscriptions which samples will not come.
    fn report_missing(&mut self) {
        for missing in self.journal.take_missing() {
            self.payloads.missing(&missing);
        }
    }

    /// Reads what is of use to discovery.
    fn read(&mut self, found: &Found<'_>, sample: Sample<'_>, vendor: VendorId, origin: &Origin) {
        let writer = found.record.writer();
        let stage = match writer.entity {
            EntityId::SPDP_WRITER | EntityId::SPDP_SECURE_WRITER => "spdp",
            EntityId::SEDP_PUBLICATIONS_WRITER
            | EntityId::SEDP_SUBSCRIPTIONS_WRITER
            | EntityId::SEDP_PUBLICATIONS_SECURE_WRITER
            | EntityId::SEDP_SUBSCRIPTIONS_SECURE_WRITER => "sedp",
            entity if !entity.is_builtin() && self.may_be_entities(found, sample) => "entities",
            _ => return,
        };
        let whole;
        let (payload, inline_qos) = if let Sample::DataFrag(fragments) = sample {
            let Some(bytes) = self.discovery_fragments.put(fragments, found.payload) else {
                return;
            };
            whole = bytes;
            let status_info = sample.status_info();
            (
                Payload::Data(&whole),
                Ok(InlineQos {
                    status_info,
                    ..InlineQos::default()
                }),
            )
        } else {
            (found.payload(), found.inline_qos(vendor))
        };
        let told = inline_qos.and_then(|inline_qos| match stage {
            "spdp" => self.participant(vendor, payload, &inline_qos, origin),
            "sedp" => self.endpoint(writer.entity, vendor, payload, &inline_qos, origin),
            _ => self.entities(writer, payload, origin),
        });
        if let Err(error) = told {
            self.decode_error(stage, error.reason);
        }
    }

    /// Announced on `ros_discovery_info`, or not announced yet and of its form: the sample is sent
    /// once, perhaps before the announcement is understood.
    fn may_be_entities(&self, found: &Found<'_>, sample: Sample<'_>) -> bool {
        let writer = found.record.writer();
        if sample.status_info() != StatusInfo::ALIVE {
            return false;
        }
        if let Some(endpoint) = self.discovery.endpoints().get(&writer) {
            return &*endpoint.topic == "ros_discovery_info";
        }
        let own = Guid::new(writer.prefix, EntityId::PARTICIPANT).to_bytes();
        let begins = found.payload.get(4..20).is_some_and(|gid| *gid == own);
        match sample {
            Sample::Data(_) => begins,
            Sample::DataFrag(fragments) => {
                sample.is_start() && begins || self.discovery_fragments.holds(fragments)
            }
        }
    }

    fn participant(
        &mut self,
        vendor: VendorId,
        payload: Payload<'_>,
        inline_qos: &InlineQos,
        origin: &Origin,
    ) -> Result<(), WireError> {
        match discovery::participant(vendor, payload, inline_qos)? {
            discovery::Discovery::Alive(announcement) => {
                let prefix = announcement.guid.prefix;
                let evidence = self.evidence(prefix);
                let journal = &mut self.journal;
                self.discovery
                    .participant(&announcement, origin, evidence, journal);
                self.announce(prefix);
            }
            discovery::Discovery::Gone { guid, .. } => {
                self.discovery
                    .participant_gone(guid, origin, &mut self.journal);
            }
        }
        Ok(())
    }

    fn endpoint(
        &mut self,
        entity: EntityId,
        vendor: VendorId,
        payload: Payload<'_>,
        inline_qos: &InlineQos,
        origin: &Origin,
    ) -> Result<(), WireError> {
        let role = match entity {
            EntityId::SEDP_PUBLICATIONS_WRITER | EntityId::SEDP_PUBLICATIONS_SECURE_WRITER => {
                Role::Writer
            }
            _ => Role::Reader,
        };
        match discovery::endpoint(role, vendor, payload, inline_qos)? {
            discovery::Discovery::Alive(announcement) => {
                let prefix = announcement.guid.prefix;
                let evidence = self.evidence(prefix);
                let journal = &mut self.journal;
                if self
                    .discovery
                    .endpoint(announcement, origin, evidence, journal)
                {
                    self.announce(prefix);
                }
            }
            discovery::Discovery::Gone { guid, .. } => {
                self.discovery
                    .endpoint_gone(guid, origin, &mut self.journal);
            }
        }
        Ok(())
    }

    fn entities(
        &mut self,
        writer: Guid,
        payload: Payload<'_>,
        origin: &Origin,
    ) -> Result<(), WireError> {
        let entities = ParticipantEntities::parse(payload.bytes())?;
        let evidence = self.evidence(writer.prefix);
        let journal = &mut self.journal;
        self.discovery
            .entities(&entities, writer, origin, evidence, journal);
        Ok(())
    }

    /// What is known in favour of a participant of which something is announced.
    fn evidence(&self, prefix: GuidPrefix) -> Priority {
        Priority {
            watched: false,
            local: self.receivers.is_local(&prefix),
            sends: self.profiler.has_unknown_writer(endpoints_of(prefix)),
        }
    }

    /// A participant that is known is reached where it announces.
    fn announce(&mut self, prefix: GuidPrefix) {
        if let Some(participant) = self.discovery.participants().get(&prefix) {
            let addresses = &participant.addresses;
            let addresses = addresses.default.iter().chain(&addresses.metatraffic);
            self.receivers
                .announce(prefix, addresses.copied().map(Destination::from));
        }
    }

    /// Lets topics, interest and measurement follow discovery.
    fn follow_up(&mut self, now: Timestamp) {
        for change in self.discovery.changes() {
            self.receivers.changed();
            match change {
                Change::Appeared(guid) => self.appeared(guid, now),
                Change::Changed(guid) => {
                    let Some(endpoint) = self.discovery.endpoints().get(&guid) else {
                        continue;
                    };
                    self.profiler.learn(guid, traits(endpoint));
                }
                Change::Gone(guid, endpoint) => self.gone(guid, &endpoint, now),
            }
        }
    }

    fn appeared(&mut self, guid: Guid, now: Timestamp) {
        let Some(endpoint) = self.discovery.endpoints().get(&guid) else {
            return;
        };
        let Some(mut naming) = naming(endpoint) else {
            return;
        };
        if naming.dds_name == endpoint.topic {
            // One copy of the name for all who keep it.
            naming.dds_name = Arc::clone(&endpoint.topic);
        }
        let (role, message_type) = (endpoint.role, Arc::clone(&endpoint.message_type));
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

    fn gone(&mut self, guid: Guid, endpoint: &Endpoint, now: Timestamp) {
        self.interest.remove(guid);
        self.tracer.forget(guid);
        self.retire(guid, now);
        self.payloads.release(guid, now);
        let (domain_id, topic) = (endpoint.domain_id, bounded_shared(&endpoint.topic));
        self.journal.events.name(guid, domain_id, &topic);
        let id = naming(endpoint).and_then(|naming| self.topics.find(endpoint.domain_id, &naming));
        if let Some(id) = id {
            self.topics.leave(id, guid, now);
        }
    }

    /// Tells the losses of the last second.
    fn report_losses(&mut self) {
        let discovery = &self.discovery;
        self.journal.events.end_bursts(|burst| {
            if let Some(endpoint) = discovery.endpoints().get(&burst.writer) {
                burst.topic = Some((endpoint.domain_id, bounded_shared(&endpoint.topic)));
            }
            let participant = discovery.participants().get(&burst.writer.prefix);
            let mut nodes = participant.into_iter().flat_map(|known| &known.nodes);
            let node = nodes.find(|node| node.writers.contains(&burst.writer));
            burst.node = node.map(|node| bounded_shared(&node.name));
        });
    }

    /// Asks about every topic.
    fn apply_lists_to_all(&mut self) {
        let is_watched = |id: &TopicId| {
            let topic = self.topics.get(*id);
            topic.is_some_and(|topic| topic.watched == Watched::Yes)
        };
        let (watched, others): (Vec<_>, Vec<_>) =
            self.topics.ids().into_iter().partition(is_watched);
        // First give places back, then hand them out.
        self.pending_topics = others.into_iter().rev().collect();
        self.pending_topics.extend(watched.into_iter().rev());
        self.apply_more_lists();
    }

    /// Asks the watchlist and the wishes about further topics, as many as take some milliseconds.
    /// Until a topic's turn comes, what was decided by the lists before holds. Returns whether all
    /// topics had their turn.
    pub fn apply_more_lists(&mut self) -> bool {
        if self.has_applied_lists() {
            return true;
        }
        let requested = |request: &SampleRequest| {
            request.selection.globs().count() + request.selection.regexes()
        };
        let patterns =
            self.watchlist.globs() + self.sample_requests.iter().map(requested).sum::<usize>();
        for _ in 0..(MATCHES_AT_ONCE / patterns.max(1)).max(1) {
            let Some(id) = self.pending_topics.pop() else {
                break;
            };
            self.apply_lists(id, self.clock);
        }
        self.has_applied_lists()
    }

    /// Whether the lists were asked about all topics since they last changed.
    #[must_use]
    pub const fn has_applied_lists(&self) -> bool {
        self.pending_topics.is_empty()
    }

    /// Asks the watchlist and the wishes about a topic and lets its endpoints follow.
    fn apply_lists(&mut self, id: TopicId, now: Timestamp) {
        let displaced = self.topics.apply_lists(
            id,
            &self.watchlist,
            &self.sample_requests,
            self.settings.topics,
            now,
        );
        if let Some(id) = displaced {
            self.apply_all(id, now);
            self.topics.forget_measurement(id);
        }
        self.apply_all(id, now);
    }

    /// Lets the endpoints of a topic follow it.
    fn apply_all(&mut self, id: TopicId, now: Timestamp) {
        let Some(topic) = self.topics.get(id) else {
            return;
        };
        let lists = [&topic.writers, &topic.readers, &topic.buffer_endpoints];
        let guids: Vec<_> = lists.into_iter().flatten().copied().collect();
        for guid in guids {
            self.apply(id, guid, now);
        }
    }

    /// Decides about one endpoint of a topic.
    fn apply(&mut self, id: TopicId, guid: Guid, now: Timestamp) {
        let Some(topic) = self.topics.get(id) else {
            return;
        };
        let Some(endpoint) = self.discovery.endpoints().get(&guid) else {
            return;
        };
        let is_watched = topic.watched == Watched::Yes;
        match endpoint.role {
            Role::Reader if is_watched => self.interest.set(guid, Verdict::Meter),
            Role::Reader => self.interest.remove(guid),
            Role::Writer => {
                let counts = naming(endpoint).is_some_and(|naming| naming.counts);
                let measured = is_watched && counts;
                let verdict = match topic.naming.kind {
                    TopicKind::Discovery => Verdict::Capture,
                    _ if measured && wants_bytes(topic) => Verdict::Capture,
                    _ if measured => Verdict::Meter,
                    _ => Verdict::Ignore,
                };
                self.interest.set(guid, verdict);
                match &topic.requested {
                    Some(requested) if measured => {
                        let topic = payloads::Topic {
                            domain_id: topic.domain_id,
                            name: Arc::clone(&topic.naming.name),
                            dds_name: Arc::clone(&topic.naming.dds_name),
                            message_type: Arc::clone(&endpoint.message_type),
                            offered: Some(Arc::new(Offered {
                                type_hash: endpoint.type_hash,
                                qos: endpoint.qos.clone(),
                            })),
                        };
                        let known = self.profiler.get(guid);
                        let next = known.map_or(0, |known| known.writer.next());
                        self.payloads.want(guid, topic, requested, (next, now));
                    }
                    _ => self.payloads.release(guid, now),
                }
                if measured {
                    let (traits, opened) = (traits(endpoint), topic.reader_appeared);
                    self.profiler.measure(guid, id, traits, opened, now);
                } else {
                    self.retire(guid, now);
                }
            }
        }
    }

    /// Measures this writer no more; its topic keeps what it had counted.
    fn retire(&mut self, guid: Guid, now: Timestamp) {
        let graph = graph!(self);
        let Some(retired) = self.profiler.stop(guid, now, &mut self.journal, graph) else {
            return;
        };
        self.report_missing();
        if let Some(topic) = self.topics.get_mut(retired.topic) {
            topic.retire(&retired.measurement, retired.totals.as_ref());
        }
    }

    fn tick(&mut self, now: Timestamp) {
        self.discovery.advance(now, &mut self.journal);
        self.follow_up(now);
        let graph = graph!(self);
        let unknown_writers = self.profiler.advance(now, &mut self.journal, graph);
        for guid in unknown_writers.metered {
            self.interest.set(guid, Verdict::Meter);
        }
        for guid in unknown_writers.forgotten {
            self.interest.remove(guid);
        }
        self.report_missing();
        for writer in self.payloads.unsettled() {
            self.turn(writer, now);
        }
        if now.0.is_multiple_of(SECOND) {
            self.payloads.expire(now);
            let profiler = &self.profiler;
            self.payloads.retain_unknown_writers(|writer| {
                let known = profiler.get(writer);
                known.is_some_and(|known| known.topic.is_none())
            });
            self.topics.expire(now, self.settings.topic_grace);
            self.receivers.tidy(&self.discovery);
            self.discovery
                .locate(|prefix| self.receivers.is_local(prefix));
            self.promote();
            self.judge(now);
            self.report_losses();
            self.examine(now);
            self.tracer.advance(now);
        }
    }

    fn examine(&mut self, now: Timestamp) {
        let before = Arc::clone(self.examiner.current());
        self.examiner.examine(&self.discovery, &self.topics, now);
        let after = self.examiner.current();
        if Arc::ptr_eq(&before, after) {
            return;
        }
        for change in diagnosis::changes(&before.list, &after.list) {
            let (resolved, finding) = match change {
                diagnosis::Change::Appeared(finding) | diagnosis::Change::Changed(finding) => {
                    (false, finding)
                }
                diagnosis::Change::Resolved(finding) => (true, finding),
            };
            let finding = bounded_finding(finding);
            let kind = EventKind::Diagnosis { resolved, finding };
            self.journal.events.push(now, kind);
        }
    }

    /// Gives free measuring places, and those of vanished topics, to topics that were kept out.
    fn promote(&mut self) {
        if !self.topics.has_place(self.settings.topics) {
            return;
        }
        let rejected = self
            .topics
            .iter()
            .filter(|(_, topic)| topic.watched == Watched::Rejected && !topic.is_vanished());
        let rejected: Vec<_> = rejected.map(|(id, _)| id).collect();
        for id in rejected {
            if !self.topics.has_place(self.settings.topics) {
                return;
            }
            self.apply_lists(id, self.clock);
        }
    }

    /// Judges every watched topic under every entry that covers it.
    fn judge(&mut self, now: Timestamp) {
        for id in self.topics.ids() {
            let Some(topic) = self.topics.get(id) else {
                continue;
            };
            if topic.judgements.is_empty() {
                continue;
            }
            let writers: Vec<_> = topic
                .writers
                .iter()
                .chain(&topic.buffer_endpoints)
                .filter_map(|guid| self.profiler.get(*guid))
                .collect();
            let last_message = writers
                .iter()
                .filter_map(|each| each.writer.last_message())
                .max();
            let retired = topic
                .retired
                .as_ref()
                .and_then(|retired| retired.last_message);
            let recent = |seconds: u64| {
                writers
                    .iter()
                    .fold((Slot::default(), 0), |(mut sum, longest), each| {
                        let (slot, seconds) = each.writer.recent(now, seconds);
                        sum.add(&slot);
                        (sum, seconds.max(longest))
                    })
            };
            let evidence = Evidence {
                now,
                publishers: topic.writers.len(),
                subscriptions: topic.readers.len(),
                last_message: last_message.max(retired),
                since: topic.published,
                recent: &recent,
            };
            let mut judgements = topic.judgements.clone();
            for (index, judgement) in &mut judgements {
                let Some(watch) = self.watchlist.watches().get(*index) else {
                    continue;
                };
                let changed = judgement.judge(&watch.expectations, &evidence);
                let Some(from) = changed else { continue };
                let to = judgement.state();
                let (domain_id, name) = (topic.domain_id, &topic.naming.name);
                let kind = EventKind::Expectation {
                    domain_id,
                    topic: bounded_shared(name),
                    watch: bounded(&watch.pattern).into(),
                    from,
                    to,
                    violations: judgement.violations(),
                };
                self.journal.events.push(now, kind);
                if to == WatchState::Silent {
                    let kind = EventKind::Silence {
                        domain_id,
                        topic: bounded_shared(name),
                        watch: bounded(&watch.pattern).into(),
                        last_message: evidence.last_message,
                    };
                    self.journal.events.push(now, kind);
                }
            }
            if let Some(topic) = self.topics.get_mut(id) {
                topic.judgements = judgements;
            }
        }
    }
}

/// Whether somebody wants its samples whole.
fn wants_bytes(topic: &Topic) -> bool {
    let requested = topic.requested.as_ref();
    requested.is_some_and(|requested| !requested.payloads.is_empty())
}

pub(super) fn naming(endpoint: &Endpoint) -> Option<Naming> {
    DdsTopic::parse(&endpoint.topic)
        .ok()
        .map(|topic| Naming::of(&topic))
}

fn traits(endpoint: &Endpoint) -> Traits {
    Traits {
        reliable: endpoint.qos.reliability == Reliability::RELIABLE,
        keeps_history: endpoint.qos.durability != Durability::VOLATILE,
        has_header: begins_with_header(&endpoint.message_type),
    }
}
