//! Measured writers: those of watched topics, and unknown writers, whose announcement was missed.
//!
//! The number of unknown writers is capped: a new one is refused until a known one is silent for a
//! while. Writers that were known before a flood of forged GUIDs stay.

mod unknown_writers;

use std::collections::{BTreeSet, VecDeque};
use std::time::Duration;

use foldhash::{HashMap, HashMapExt as _};
use ros2probe_wire::qos::Reliability;
use ros2probe_wire::{Guid, SequenceNumber};

use crate::facts::bounded::TableFacts;
use crate::facts::bounded::{self, Bounded};
use crate::facts::journal::Journal;
use crate::facts::loss_share::LossShare;
use crate::facts::measurement::Measurement;
use crate::facts::model_time::ModelTime;
use crate::facts::observation::{Observation, Path};
use crate::facts::route::Destination;
use crate::facts::tables;
use crate::facts::wall_clock::WallClock;
use crate::measure::delivery::Totals;
use crate::measure::in_order::Progress;
use crate::measure::receivers::Graph;
use crate::measure::samples::Budget;
use crate::measure::subscribers::{DeliveryQuota, Novelty, Subscribers, WriterContext};
use crate::measure::topic::TopicId;
use crate::measure::writer::{Counted, MeasurementContext, Traits, Writer};
pub use unknown_writers::UnknownWriters;

/// An unknown writer is shown and metered after this time; announcements usually arrive within a
/// second.
const UNKNOWN_AFTER: Duration = Duration::from_secs(3);
/// An unknown writer is dropped after this silence, or earlier if the table is full and it sent
/// little. A slow one is dropped after [`SILENT_INTERVALS`].
const UNKNOWN_WRITER_TIMEOUT: Duration = Duration::from_secs(30);
/// Minimum silence after which an unknown writer of a known participant is dropped, until it is
/// established: its interval may be long.
const SLOW_WRITER_TIMEOUT: Duration = Duration::from_secs(120);
/// Number of mean intervals of an unknown writer after which it is dropped, at most an hour.
const SILENT_INTERVALS: u32 = 4;
const LONGEST_SILENCE: Duration = Duration::from_secs(3600);
const EVICTABLE_AFTER: Duration = Duration::from_secs(3);
/// Minimum number of messages of an unknown writer that is never evicted.
const ESTABLISHED_MESSAGES: u64 = 10;
/// Maximum time until the kernel knows a writer: a round of the capture thread on a busy machine.
/// Until then the kernel limits captures as for an unknown writer, and a point cloud exceeds that
/// limit.
const KERNEL_UPDATE_TIME: Duration = Duration::from_millis(200);
/// Unknown writers may use the memory for fragmented samples divided by this number.
const UNKNOWN_WRITERS_SHARE: usize = 4;
/// Deliveries that are dropped for new ones: minimum silence, and maximum number per tick.
const DELIVERY_TIMEOUT: Duration = Duration::from_secs(10);
const MAX_DROPPED_DELIVERIES: usize = 64;

/// A measured writer.
#[derive(Debug)]
pub struct Measured {
    /// Its measurement.
    pub writer: Box<Writer>,
    /// Its receivers; only for a writer of a known topic.
    pub subscribers: Option<Box<Subscribers>>,
    /// Its topic; `None` for an unknown writer.
    pub topic: Option<TopicId>,
    /// Time of the first observation or announcement.
    pub first_seen: ModelTime,
    /// Time of the last observation.
    pub last_seen: ModelTime,
    /// Whether an unknown writer has existed long enough to be metered.
    pub metered: bool,
    /// Cookie of the socket through which an unknown writer sends; 0 if not known.
    pub socket: u64,
    /// Whether the participant of an unknown writer was known at its first message.
    has_participant: bool,
    opened: ModelTime,
    /// Whether the wait for a gap ended without an ACKNACK.
    unacknowledged: bool,
    /// Time at which the kernel begins to capture all fragments of the writer.
    complete_from: ModelTime,
    /// A tick from this time on visits the writer.
    due: ModelTime,
}

/// All measured writers.
#[derive(Debug)]
pub struct Profiler {
    writers: HashMap<Guid, Measured>,
    unknown_writers: Bounded<bounded::Counted<tables::UnknownWriters>, BTreeSet<Guid>>,
    /// The latest observations of unknown writers.
    latest_unknown: Bounded<tables::LatestUnknown, VecDeque<Observation>>,
    shared: SharedBudgets,
    search_after: ModelTime,
    /// No writer is due before this time.
    earliest: ModelTime,
    /// Generation of the receivers at the last tick.
    generation: u64,
}

/// Budgets that all writers share.
#[derive(Debug)]
struct SharedBudgets {
    budget: Budget,
    unknown_writers_budget: Budget,
    deliveries_budget: Budget,
    quota: DeliveryQuota,
}

/// The writer to which an observation belongs.
#[derive(Clone, Copy)]
struct WriterRef {
    writer: Guid,
    reliable: bool,
    topic: Option<TopicId>,
    has_receivers: bool,
}

/// Counts of a writer that is no longer measured.
#[derive(Debug)]
pub struct Retired {
    /// Its topic.
    pub topic: TopicId,
    /// Its measurement.
    pub measurement: Measurement,
    /// Sums over its deliveries.
    pub totals: Option<Totals>,
    /// Losses of its worst receiver in this second.
    pub departed: LossShare,
}

/// The result of an observation.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ObservationOutcome {
    /// Its writer is not measured.
    Unmeasured,
    /// Its writer is measured.
    Measured,
    /// It completed a message, which was counted.
    Counted(Counted),
}

impl Profiler {
    /// Creates a profiler without writers.
    #[must_use]
    pub fn new(unknown_writer_limit: usize, sample_bytes: usize, deliveries: usize) -> Self {
        Self {
            writers: HashMap::new(),
            unknown_writers: Bounded::capped(unknown_writer_limit),
            latest_unknown: Bounded::default(),
            shared: SharedBudgets {
                budget: Budget::new(sample_bytes),
                unknown_writers_budget: Budget::new(sample_bytes / UNKNOWN_WRITERS_SHARE),
                deliveries_budget: Budget::new(sample_bytes),
                quota: DeliveryQuota {
                    used: 0,
                    limit: deliveries,
                    evictions: 0,
                    wanted: false,
                },
            },
            search_after: ModelTime::ZERO,
            earliest: ModelTime::MAX,
            generation: 0,
        }
    }

    /// Returns a measured writer.
    #[must_use]
    pub fn get(&self, guid: Guid) -> Option<&Measured> {
        self.writers.get(&guid)
    }

    /// Returns a measured writer.
    pub fn get_mut(&mut self, guid: Guid) -> Option<&mut Measured> {
        self.writers.get_mut(&guid)
    }

    /// Returns all measured writers.
    pub fn iter(&self) -> impl Iterator<Item = (&Guid, &Measured)> {
        self.writers.iter()
    }

    /// Returns which samples of this writer are decided; `None` if it is not measured.
    pub fn progress(&mut self, guid: Guid, now: ModelTime, graph: &Graph) -> Option<Progress> {
        let measured = self.writers.get_mut(&guid)?;
        let acknowledged = measured.is_acknowledged()
            || !measured.unacknowledged && measured.has_reliable_reader(graph);
        Some(measured.writer.progress(acknowledged, now))
    }

    /// Stops waiting for samples of this writer below `number`.
    pub fn settle_below(&mut self, guid: Guid, number: SequenceNumber) {
        if let Some(measured) = self.writers.get_mut(&guid) {
            measured.unacknowledged = !measured.is_acknowledged();
            measured.writer.skip(number);
        }
    }

    /// Returns the number of writers with a topic, and the size and limit of the table of unknown
    /// writers.
    #[must_use]
    pub fn size(&self) -> (usize, TableFacts) {
        let known = self.writers.len() - self.unknown_writers.len();
        (known, self.unknown_writers.facts())
    }

    /// Returns the memory budgets for fragmented samples: for writers with a topic, unknown
    /// writers, and deliveries.
    #[must_use]
    pub const fn budgets(&self) -> [&Budget; 3] {
        [
            &self.shared.budget,
            &self.shared.unknown_writers_budget,
            &self.shared.deliveries_budget,
        ]
    }

    /// Returns the quota of deliveries.
    #[must_use]
    pub const fn quota(&self) -> &DeliveryQuota {
        &self.shared.quota
    }

    /// Processes an observation if its writer is measured.
    pub fn observe(
        &mut self,
        observation: &Observation,
        journal: &mut Journal,
        graph: &Graph,
    ) -> ObservationOutcome {
        let head = observation.head();
        let (guid, now) = (head.writer, head.at);
        let Some(measured) = self.writers.get_mut(&guid) else {
            return ObservationOutcome::Unmeasured;
        };
        (measured.due, self.earliest) = (ModelTime::ZERO, ModelTime::ZERO);
        measured.last_seen = measured.last_seen.max(now);
        if measured.topic.is_none() && !measured.metered {
            // The kernel filter may omit samples beyond its budget for unknown writers, so a gap is
            // not a loss.
            measured.opened = now;
        }
        if measured.topic.is_none() && head.is_at_socket() && head.is_sent() {
            measured.socket = head.socket;
        }
        if let Observation::AckNack(acknack) = observation
            && measured.writer.refuses(acknack)
        {
            return ObservationOutcome::Measured;
        }
        let writer_ref = measured.writer_ref(guid);
        let mut novelty = Novelty::New;
        // HEARTBEATs in shared memory do not show which readers receive the samples.
        let is_delivery = !matches!(
            head.path,
            Path::SharedMemory { .. } | Path::Stream { relayed: true, .. }
        );
        if measured.topic.is_none() && is_delivery {
            self.latest_unknown.add(*observation);
        } else if is_delivery {
            let mut context = self.shared.writer_context(writer_ref, now, journal, graph);
            let subscribers = measured
                .subscribers
                .get_or_insert_with(|| Box::new(Subscribers::new(measured.complete_from)));
            novelty = subscribers.observe(observation, &mut context);
            measured.writer.filter(subscribers.is_filtered());
            if matches!(observation, Observation::AckNack(_))
                && let Some(below) = subscribers.acknowledged_below()
            {
                measured.writer.acknowledged(below);
            }
        }
        let is_undelivered = matches!(observation, Observation::Sample(it) if !it.is_delivered());
        if is_undelivered || novelty == Novelty::SeenAtSocket {
            return ObservationOutcome::Measured;
        }
        let next = measured.writer.next();
        let counted = measured.writer.observe(
            observation,
            measured.opened,
            &mut self
                .shared
                .measurement_context(writer_ref, now, journal, graph.wall_clock),
        );
        if novelty == Novelty::Duplicate && head.path != Path::Wire {
            measured.writer.note_retransmission();
        }
        if let Some(subscribers) = &mut measured.subscribers
            && measured.writer.next() > next
        {
            subscribers.wrote(measured.writer.next().previous(), now);
        }
        counted.map_or(ObservationOutcome::Measured, ObservationOutcome::Counted)
    }

    /// Records that samples in shared memory before `now` may have been missed.
    pub fn note_uncertain(&mut self, now: ModelTime) {
        for measured in self.writers.values_mut() {
            measured.writer.uncertain(now);
        }
    }

    /// Records that bytes for this destination were not captured.
    pub fn missed(&mut self, destination: Destination, at: ModelTime) {
        for measured in self.writers.values_mut() {
            if let Some(subscribers) = &mut measured.subscribers
                && subscribers.missed(destination, at)
            {
                measured.opened = at;
                measured.writer.interrupt();
            }
        }
    }

    /// Records that uprobes no longer observe writers.
    pub fn end_exact_view(&mut self) {
        for measured in self.writers.values_mut() {
            measured.writer.end_exact_view();
        }
    }

    /// Begins to measure a writer with a topic, and keeps its measurements from before the
    /// announcement. Returns whether it was an unknown writer.
    pub fn measure(
        &mut self,
        guid: Guid,
        topic: TopicId,
        traits: Traits,
        opened: ModelTime,
        now: ModelTime,
    ) -> bool {
        if let Some(known) = self.writers.get_mut(&guid) {
            (known.due, self.earliest) = (ModelTime::ZERO, ModelTime::ZERO);
            known.writer.learn(traits);
            known.opened = known.opened.max(opened);
            let was_unknown = known.topic.is_none();
            if was_unknown {
                known.opened = known.opened.max(now);
                known.writer.begin_window(now);
                // The other budget accounts for its unfinished samples from now on.
                known.writer.transfer(
                    &mut self.shared.unknown_writers_budget,
                    &mut self.shared.budget,
                );
                self.unknown_writers.remove(&guid);
                known.allow_incomplete(now);
            }
            known.topic = Some(topic);
            return was_unknown;
        }
        let mut measured = Measured::new(Writer::new(guid, traits), Some(topic), now);
        measured.opened = opened;
        measured.allow_incomplete(now);
        self.writers.insert(guid, measured);
        false
    }

    /// Replaces the GUID of an unknown writer by the announced one.
    pub fn rename(&mut self, before: Guid, guid: Guid) {
        if self.unknown_writers.contains(&before)
            && !self.writers.contains_key(&guid)
            && let Some(mut measured) = self.writers.remove(&before)
        {
            measured.writer.rename(guid);
            self.rename_latest(before, guid);
            self.unknown_writers.remove(&before);
            self.unknown_writers.insert(guid);
            self.writers.insert(guid, measured);
        }
    }

    /// Sets the nanoseconds by which the clock of each writer's host is ahead.
    pub fn set_clocks(&mut self, ahead: impl Fn(&Guid) -> i64) {
        for (guid, measured) in &mut self.writers {
            measured.writer.set_clock(ahead(guid));
        }
    }

    /// Updates the properties of a writer from discovery.
    pub fn learn(&mut self, guid: Guid, traits: Traits) {
        if let Some(measured) = self.writers.get_mut(&guid) {
            (measured.due, self.earliest) = (ModelTime::ZERO, ModelTime::ZERO);
            measured.writer.learn(traits);
        }
    }

    /// Records that a new reader makes samples of this writer visible.
    pub fn open(&mut self, guid: Guid, at: ModelTime) {
        if let Some(measured) = self.writers.get_mut(&guid) {
            measured.opened = at;
        }
    }

    /// Records that the numbers of this writer before its next sample may belong to other samples.
    pub fn skip_numbers(&mut self, guid: Guid, at: ModelTime) {
        if let Some(measured) = self.writers.get_mut(&guid) {
            measured.opened = at;
            if let Some(subscribers) = &mut measured.subscribers {
                subscribers.skip_numbers(at);
            }
        }
    }

    /// Stops measuring a writer; returns its counts if it belonged to a topic.
    pub fn stop(
        &mut self,
        guid: Guid,
        now: ModelTime,
        journal: &mut Journal,
        graph: &Graph,
    ) -> Option<Retired> {
        let mut measured = self.writers.remove(&guid)?;
        let writer_ref = measured.writer_ref(guid);
        measured.writer.settle(&mut self.shared.measurement_context(
            writer_ref,
            now,
            journal,
            graph.wall_clock,
        ));
        self.unknown_writers.remove(&guid);
        let subscribers = measured.subscribers.take();
        let stopped = subscribers.map(|subscribers| {
            subscribers.stop(&mut self.shared.writer_context(writer_ref, now, journal, graph))
        });
        let (totals, departed) = stopped.unzip();
        Some(Retired {
            topic: writer_ref.topic?,
            measurement: measured.writer.measurement(now),
            totals,
            departed: departed.unwrap_or_default(),
        })
    }

    /// Returns the time from which [`Self::advance`] has an effect without an observation:
    /// [`ModelTime::ZERO`] for the next tick, [`ModelTime::MAX`] if never.
    #[must_use]
    pub fn next_due(&self, graph: &Graph) -> ModelTime {
        let has_changed = self.generation != graph.receivers.generation();
        match has_changed || self.shared.quota.wanted {
            true => ModelTime::ZERO,
            false => self.earliest,
        }
    }

    /// Settles the samples for which the settle window is over. Visits only writers that are due,
    /// or all after a change of receivers. Returns the changes of unknown writers.
    pub fn advance(
        &mut self,
        now: ModelTime,
        journal: &mut Journal,
        graph: &Graph,
    ) -> UnknownWriters {
        let mut unknown_writers = UnknownWriters::default();
        let generation = graph.receivers.generation();
        if std::mem::replace(&mut self.generation, generation) != generation {
            self.visit_all();
        }
        if self.earliest <= now {
            self.earliest = ModelTime::MAX;
            for (guid, measured) in &mut self.writers {
                if measured.due <= now {
                    self.shared.advance((*guid, measured), now, journal, graph);
                    if measured.topic.is_none() {
                        unknown_writers.advance((*guid, measured), now);
                    }
                    measured.due = measured.next_due(now);
                }
                self.earliest = self.earliest.min(measured.due);
            }
        }
        unknown_writers.metered.sort_unstable();
        unknown_writers.forgotten.sort_unstable();
        for guid in &unknown_writers.forgotten {
            self.stop(*guid, now, journal, graph);
        }
        if std::mem::take(&mut self.shared.quota.wanted) {
            self.drop_silent(now, journal, graph);
        }
        unknown_writers
    }

    /// Stops waiting for samples in shared memory.
    pub fn settle_sampled(&mut self, now: ModelTime, journal: &mut Journal, graph: &Graph) {
        for (guid, measured) in &mut self.writers {
            let writer_ref = measured.writer_ref(*guid);
            let context =
                &mut self
                    .shared
                    .measurement_context(writer_ref, now, journal, graph.wall_clock);
            measured.writer.settle_sampled(context);
        }
    }

    /// Makes the next tick visit every writer.
    pub fn visit_all(&mut self) {
        self.earliest = ModelTime::ZERO;
        for measured in self.writers.values_mut() {
            measured.due = ModelTime::ZERO;
        }
    }

    /// Settles all samples at the end of the input.
    pub fn settle(&mut self, now: ModelTime, journal: &mut Journal, graph: &Graph) {
        let mut guids: Vec<_> = self.writers.keys().copied().collect();
        guids.sort_unstable();
        for guid in guids {
            let Some(measured) = self.writers.get_mut(&guid) else {
                continue;
            };
            (measured.due, self.earliest) = (ModelTime::ZERO, ModelTime::ZERO);
            let writer_ref = measured.writer_ref(guid);
            measured.writer.settle(&mut self.shared.measurement_context(
                writer_ref,
                now,
                journal,
                graph.wall_clock,
            ));
            if let Some(subscribers) = &mut measured.subscribers {
                subscribers
                    .settle(&mut self.shared.writer_context(writer_ref, now, journal, graph));
                subscribers.end_second();
            }
            // A writer that sent more than once and was never announced is an unknown writer.
            measured.metered |= measured.topic.is_none() && measured.writer.messages() > 1;
        }
    }

    /// Drops the deliveries that have been silent longest, because a new one was refused.
    fn drop_silent(&mut self, now: ModelTime, journal: &mut Journal, graph: &Graph) {
        let mut silent: Vec<_> = self
            .writers
            .iter()
            .filter_map(|(guid, measured)| Some((guid, measured.subscribers.as_ref()?)))
            .flat_map(|(guid, subscribers)| subscribers.last_seen_times().map(|at| (at, *guid)))
            .filter(|(at, _)| *at + DELIVERY_TIMEOUT <= now)
            .collect();
        silent.sort_unstable();
        for (at, guid) in silent.into_iter().take(MAX_DROPPED_DELIVERIES) {
            let Some(measured) = self.writers.get_mut(&guid) else {
                continue;
            };
            (measured.due, self.earliest) = (ModelTime::ZERO, ModelTime::ZERO);
            let writer_ref = measured.writer_ref(guid);
            if let Some(subscribers) = &mut measured.subscribers {
                let mut context = self.shared.writer_context(writer_ref, now, journal, graph);
                subscribers.drop_oldest(at, 1, &mut context);
            }
        }
    }
}

impl SharedBudgets {
    /// Settles the samples of a writer for which the settle window is over.
    fn advance(
        &mut self,
        (guid, measured): (Guid, &mut Measured),
        now: ModelTime,
        journal: &mut Journal,
        graph: &Graph,
    ) {
        let writer_ref = measured.writer_ref(guid);
        measured.writer.advance(&mut self.measurement_context(
            writer_ref,
            now,
            journal,
            graph.wall_clock,
        ));
        if measured.topic.is_some()
            && let Some(subscribers) = &mut measured.subscribers
        {
            subscribers.advance(&mut self.writer_context(writer_ref, now, journal, graph));
        }
    }

    fn measurement_context<'a>(
        &'a mut self,
        writer_ref: WriterRef,
        now: ModelTime,
        journal: &'a mut Journal,
        wall_clock: WallClock,
    ) -> MeasurementContext<'a> {
        let budget = match writer_ref.topic {
            Some(_) => &mut self.budget,
            None => &mut self.unknown_writers_budget,
        };
        MeasurementContext {
            now,
            budget,
            journal,
            wall_clock,
            has_receivers: writer_ref.has_receivers,
        }
    }

    fn writer_context<'a>(
        &'a mut self,
        writer_ref: WriterRef,
        now: ModelTime,
        journal: &'a mut Journal,
        graph: &'a Graph,
    ) -> WriterContext<'a> {
        WriterContext {
            now,
            writer: writer_ref.writer,
            reliable: writer_ref.reliable,
            topic: writer_ref.topic,
            budget: &mut self.deliveries_budget,
            journal,
            quota: &mut self.quota,
            graph,
        }
    }
}

impl Measured {
    fn writer_ref(&self, writer: Guid) -> WriterRef {
        let subscribers = self.subscribers.as_ref();
        WriterRef {
            writer,
            reliable: self.writer.traits().reliable,
            topic: self.topic,
            has_receivers: subscribers.is_some_and(|subscribers| subscribers.has_receivers()),
        }
    }

    fn is_acknowledged(&self) -> bool {
        let subscribers = self.subscribers.as_ref();
        subscribers.is_some_and(|subscribers| subscribers.acknowledged_below().is_some())
    }

    /// Returns whether discovery knows a reliable reader of its topic.
    fn has_reliable_reader(&self, graph: &Graph) -> bool {
        let topic = self.topic.and_then(|topic| graph.topics.get(topic));
        let readers = topic.into_iter().flat_map(|topic| &topic.readers);
        let mut known = readers.filter_map(|guid| graph.discovery.endpoints().get(guid));
        known.any(|reader| reader.qos.reliability == Reliability::RELIABLE)
    }

    fn new(writer: Writer, topic: Option<TopicId>, now: ModelTime) -> Self {
        Self {
            writer: Box::new(writer),
            subscribers: None,
            topic,
            first_seen: now,
            last_seen: now,
            metered: false,
            socket: 0,
            has_participant: false,
            opened: ModelTime::ZERO,
            unacknowledged: false,
            complete_from: ModelTime::ZERO,
            due: ModelTime::MAX,
        }
    }

    /// Returns the time of the next decision without an observation, after the tick at `now`;
    /// [`ModelTime::MAX`] without one.
    fn next_due(&self, now: ModelTime) -> ModelTime {
        let own = self.writer.next_due();
        own.min(match (self.topic, &self.subscribers) {
            (None, _) if self.metered => self.last_seen + self.silence_timeout(),
            (None, _) => self.first_seen + UNKNOWN_AFTER,
            (Some(_), Some(known)) => known.next_due(self.writer.traits().reliable, now),
            (Some(_), None) => ModelTime::MAX,
        })
    }

    /// Returns the silence after which it is dropped as an unknown writer.
    fn silence_timeout(&self) -> Duration {
        let messages = self.writer.messages();
        let least = match self.has_participant && messages < ESTABLISHED_MESSAGES {
            true => SLOW_WRITER_TIMEOUT,
            false => UNKNOWN_WRITER_TIMEOUT,
        };
        let Some(last) = self.writer.last_message().filter(|_| messages > 1) else {
            return least;
        };
        let intervals = u32::try_from(messages - 1).unwrap_or(u32::MAX);
        let mean = (last - self.first_seen) / intervals;
        (SILENT_INTERVALS * mean).clamp(least, LONGEST_SILENCE)
    }

    /// Allows samples to lack fragments until the kernel knows the writer.
    fn allow_incomplete(&mut self, now: ModelTime) {
        self.complete_from = now + KERNEL_UPDATE_TIME;
        self.writer.allow_incomplete(self.complete_from);
    }
}
