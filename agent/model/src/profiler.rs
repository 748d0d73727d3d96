//! The writers that are measured: those of watched topics, and strangers that send without a known
//! announcement.
//!
//! Strangers are few: beyond the cap a new one is refused until one has been silent for a while.
//! What was there before a flood of invented GUIDs keeps its place.

use std::collections::{BTreeSet, HashMap};
use std::ops::RangeInclusive;

use ros2probe_wire::qos::Reliability;
use ros2probe_wire::record::{Body, flag};
use ros2probe_wire::time::SECOND;
use ros2probe_wire::{Guid, Record, Timestamp};

use super::calendar::Calendar;
use super::delivery::Totals;
use super::in_order::Progress;
use super::journal::Journal;
use super::receivers::Around;
use super::samples::Budget;
use super::size::{Size, largest};
use super::snapshot::Measurement;
use super::subscribers::{Room, Sight, Stage, Subscribers};
use super::topic::TopicId;
use super::writer::{Counted, Scene, Traits, Writer};

/// A stranger is shown and metered after this long: announcements come within a second or so.
const STRANGE: u64 = 3 * SECOND;
/// A stranger that is silent this long is forgotten; one that sent little makes room sooner.
const FORGET: u64 = 30 * SECOND;
const DOUBTFUL: u64 = 3 * SECOND;
/// Messages after which a stranger is somebody.
const SOMEBODY: u64 = 10;
/// How long the kernel may take to be told of a writer: a round of the capture thread on a busy
/// machine. Until then it hands over as much as of a stranger, which a point cloud exceeds.
const TELLING: u64 = SECOND / 5;
/// Strangers may use this part of the memory for fragmented samples.
const STRANGERS_SHARE: usize = 4;
/// Deliveries that make room for new ones: silent for so long, so many at once.
const SILENT: u64 = 10 * SECOND;
const GIVEN_UP: usize = 64;
/// Records of what did not arrive: nothing that was sent.
pub(super) const UNDELIVERED: u16 = flag::NO_ROOM | flag::NOT_REASSEMBLED;

/// One measured writer.
#[derive(Debug)]
pub struct Measured {
    /// What is measured.
    pub writer: Box<Writer>,
    /// Who gets its samples; only of a writer of a topic.
    pub subscribers: Option<Box<Subscribers>>,
    /// Its topic; `None` for a stranger.
    pub topic: Option<TopicId>,
    /// First record or announcement.
    pub first_seen: Timestamp,
    /// Last record.
    pub last_seen: Timestamp,
    /// A stranger that has been one for long enough.
    pub metered: bool,
    /// Of a stranger, the cookie of the socket it sends by; 0 = unknown.
    pub sent_from: u64,
    opened: Timestamp,
    /// A hole was waited for, and no ACKNACK came.
    unacknowledged: bool,
    /// From here on the kernel hands over all of its fragments.
    sure_from: Timestamp,
}

/// All measured writers.
#[derive(Debug)]
pub struct Profiler {
    writers: HashMap<Guid, Measured>,
    strangers: BTreeSet<Guid>,
    stranger_limit: usize,
    stranger_evictions: u64,
    shared: Shared,
    search_after: Timestamp,
}

/// What all writers draw on.
#[derive(Debug)]
struct Shared {
    budget: Budget,
    strangers_budget: Budget,
    deliveries_budget: Budget,
    room: Room,
}

/// Whose samples something is about.
#[derive(Clone, Copy)]
struct Subject {
    writer: Guid,
    reliable: bool,
    topic: Option<TopicId>,
}

/// What had been counted of a writer that is measured no more.
#[derive(Debug)]
pub struct Retired {
    /// Its topic.
    pub topic: TopicId,
    /// What was measured of it.
    pub measurement: Measurement,
    /// What became of its samples.
    pub totals: Option<Totals>,
}

/// What a record was to the profiler.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Sighting {
    /// Of a writer that is not measured.
    Unmeasured,
    /// Of one that is.
    Measured,
    /// It completed a message, which was counted.
    Counted(Counted),
}

/// What became of the strangers.
#[derive(Debug, Default)]
pub struct Strangers {
    /// To be metered from now on.
    pub metered: Vec<Guid>,
    /// Forgotten.
    pub forgotten: Vec<Guid>,
}

impl Measured {
    fn sizes(&self) -> impl Iterator<Item = Size> {
        // A new list does not compile before it has a place here.
        let Self {
            writer,
            subscribers,
            topic: _,
            first_seen: _,
            last_seen: _,
            metered: _,
            sent_from: _,
            opened: _,
            unacknowledged: _,
            sure_from: _,
        } = self;
        let subscribers = subscribers.iter().flat_map(|each| each.sizes());
        writer.sizes().chain(subscribers)
    }
}

impl Profiler {
    /// Nobody measured.
    #[must_use]
    pub fn new(stranger_limit: usize, sample_bytes: usize, deliveries: usize) -> Self {
        Self {
            writers: HashMap::new(),
            strangers: BTreeSet::new(),
            stranger_limit,
            stranger_evictions: 0,
            shared: Shared {
                budget: Budget::new(sample_bytes),
                strangers_budget: Budget::new(sample_bytes / STRANGERS_SHARE),
                deliveries_budget: Budget::new(sample_bytes),
                room: Room {
                    used: 0,
                    limit: deliveries,
                    evictions: 0,
                    wanted: false,
                },
            },
            search_after: Timestamp(0),
        }
    }

    /// Entries, or bytes, and cap of every table; of what writers have each, of the largest.
    #[must_use]
    pub fn sizes(&self, endpoints: usize) -> Vec<Size> {
        // A new table does not compile before it has a place here.
        let Self {
            writers,
            strangers,
            stranger_limit,
            stranger_evictions: _,
            shared,
            search_after: _,
        } = self;
        let Shared {
            budget,
            strangers_budget,
            deliveries_budget,
            room,
        } = shared;
        let own = writers.len() - strangers.len();
        let mut sizes = vec![
            Size::new("profiler.writers", own, endpoints),
            Size::new("profiler.strangers", strangers.len(), *stranger_limit),
            Size::new("profiler.samples.bytes", budget.bytes, budget.limit),
            Size::new(
                "profiler.strangers.samples.bytes",
                strangers_budget.bytes,
                strangers_budget.limit,
            ),
            Size::new(
                "profiler.deliveries.samples.bytes",
                deliveries_budget.bytes,
                deliveries_budget.limit,
            ),
            Size::new("profiler.deliveries", room.used, room.limit),
        ];
        sizes.extend(largest(writers.values().flat_map(Measured::sizes)));
        sizes
    }

    /// One of them.
    #[must_use]
    pub fn get(&self, guid: Guid) -> Option<&Measured> {
        self.writers.get(&guid)
    }

    /// All of them.
    pub fn iter(&self) -> impl Iterator<Item = (&Guid, &Measured)> {
        self.writers.iter()
    }

    /// How far the samples of this writer are decided.
    pub fn progress(&mut self, guid: Guid, now: Timestamp, around: Around<'_>) -> Option<Progress> {
        let measured = self.writers.get_mut(&guid)?;
        let acknowledged = measured.is_acknowledged()
            || !measured.unacknowledged && measured.has_reliable_reader(around);
        Some(measured.writer.progress(acknowledged, now))
    }

    /// Nothing below `number` of this writer is waited for any more.
    pub fn skip(&mut self, guid: Guid, number: u64) {
        if let Some(measured) = self.writers.get_mut(&guid) {
            measured.unacknowledged = !measured.is_acknowledged();
            measured.writer.skip(number);
        }
    }

    /// Writers of topics, strangers, the strangers' cap, and strangers refused or forgotten for it.
    #[must_use]
    pub fn size(&self) -> (usize, usize, usize, u64) {
        let known = self.writers.len() - self.strangers.len();
        (
            known,
            self.strangers.len(),
            self.stranger_limit,
            self.stranger_evictions,
        )
    }

    /// Memory for fragmented samples: of writers of topics, of strangers, and of deliveries.
    #[must_use]
    pub const fn budgets(&self) -> [&Budget; 3] {
        [
            &self.shared.budget,
            &self.shared.strangers_budget,
            &self.shared.deliveries_budget,
        ]
    }

    /// Room for deliveries.
    #[must_use]
    pub const fn room(&self) -> &Room {
        &self.shared.room
    }

    /// Takes in a record, if it is of a measured writer.
    pub fn record(
        &mut self,
        guid: Guid,
        record: &Record,
        journal: &mut Journal,
        around: Around<'_>,
    ) -> Sighting {
        let Some(measured) = self.writers.get_mut(&guid) else {
            return Sighting::Unmeasured;
        };
        let now = Timestamp(record.time);
        measured.last_seen = measured.last_seen.max(now);
        if measured.topic.is_none() && !measured.metered {
            // The kernel filter's budget for strangers may leave samples out: no gap is a loss.
            measured.opened = now;
        }
        const LEFT: u16 = flag::HOST | flag::OUTGOING;
        if measured.topic.is_none() && record.flags & LEFT == LEFT {
            measured.sent_from = record.socket;
        }
        if let Body::AckNack(acknack) = record.body()
            && measured.writer.refuses(acknack)
        {
            return Sighting::Measured;
        }
        let subject = measured.subject(guid);
        let mut sight = Sight::New;
        // What is announced in shared memory is read by whom it concerns or not: nobody sees that.
        if measured.topic.is_some() && record.flags & flag::SHM == 0 {
            let mut stage = self.shared.stage(subject, now, journal, around);
            let subscribers = measured
                .subscribers
                .get_or_insert_with(|| Box::new(Subscribers::new(measured.sure_from)));
            sight = subscribers.record(record, &mut stage);
            if record.is_acknack()
                && let Some(below) = subscribers.acknowledged_below()
            {
                measured.writer.acknowledged(below);
            }
        }
        if record.flags & UNDELIVERED != 0 || sight == Sight::Covered {
            return Sighting::Measured;
        }
        let next = measured.writer.next();
        let counted = measured.writer.record(
            record,
            measured.opened,
            &mut self.shared.scene(subject, now, journal, around.calendar),
        );
        if sight == Sight::Again && record.flags & flag::HOST != 0 {
            measured.writer.came_again();
        }
        if let Some(subscribers) = &mut measured.subscribers
            && measured.writer.next() > next
        {
            subscribers.wrote(measured.writer.next() - 1, now);
        }
        counted.map_or(Sighting::Measured, Sighting::Counted)
    }

    /// The tap on shared memory cannot tell what passed before `now`.
    pub fn uncertain(&mut self, now: Timestamp) {
        for measured in self.writers.values_mut() {
            measured.writer.uncertain(now);
        }
    }

    /// Writers are no longer seen in the processes that they belong to.
    pub fn seen_exactly_no_longer(&mut self) {
        for measured in self.writers.values_mut() {
            measured.writer.seen_exactly_no_longer();
        }
    }

    /// Whether one of these writers sends without being announced.
    #[must_use]
    pub fn has_stranger(&self, writers: RangeInclusive<Guid>) -> bool {
        self.strangers.range(writers).next().is_some()
    }

    /// Takes in a record of a writer nobody announced.
    pub fn stranger(
        &mut self,
        guid: Guid,
        record: &Record,
        journal: &mut Journal,
        around: Around<'_>,
    ) -> Sighting {
        if !record.is_sample() || record.flags & UNDELIVERED != 0 {
            return Sighting::Unmeasured;
        }
        let now = Timestamp(record.time);
        if self.strangers.len() >= self.stranger_limit && !self.make_room(now, around) {
            self.stranger_evictions += 1;
            return Sighting::Unmeasured;
        }
        self.strangers.insert(guid);
        self.writers.insert(
            guid,
            Measured::new(Writer::new(guid, Traits::default()), None, now),
        );
        self.record(guid, record, journal, around)
    }

    /// Measures this writer of a topic from now on; what it was measured as a stranger comes along.
    pub fn measure(
        &mut self,
        guid: Guid,
        topic: TopicId,
        traits: Traits,
        opened: Timestamp,
        now: Timestamp,
    ) {
        if let Some(known) = self.writers.get_mut(&guid) {
            known.writer.learn(traits);
            known.opened = opened;
            if known.topic.is_none() {
                known.opened = opened.max(now);
                // Its unfinished samples are paid for by the other budget from now on.
                known
                    .writer
                    .transfer(&mut self.shared.strangers_budget, &mut self.shared.budget);
                self.strangers.remove(&guid);
                known.doubt(now);
            }
            known.topic = Some(topic);
            return;
        }
        let mut measured = Measured::new(Writer::new(guid, traits), Some(topic), now);
        measured.opened = opened;
        measured.doubt(now);
        self.writers.insert(guid, measured);
    }

    /// Discovery says more of this writer.
    pub fn learn(&mut self, guid: Guid, traits: Traits) {
        if let Some(measured) = self.writers.get_mut(&guid) {
            measured.writer.learn(traits);
        }
    }

    /// A new reader makes the samples of this writer come where they can be seen.
    pub fn open(&mut self, guid: Guid, at: Timestamp) {
        if let Some(measured) = self.writers.get_mut(&guid) {
            measured.opened = at;
        }
    }

    /// Measures this writer no more; what it had counted, if it belonged to a topic.
    pub fn stop(
        &mut self,
        guid: Guid,
        now: Timestamp,
        journal: &mut Journal,
        around: Around<'_>,
    ) -> Option<Retired> {
        let mut measured = self.writers.remove(&guid)?;
        let subject = measured.subject(guid);
        measured
            .writer
            .settle(&mut self.shared.scene(subject, now, journal, around.calendar));
        self.strangers.remove(&guid);
        let subscribers = measured.subscribers.take();
        let totals = subscribers.map(|subscribers| {
            subscribers.stop(&mut self.shared.stage(subject, now, journal, around))
        });
        Some(Retired {
            topic: subject.topic?,
            measurement: measured.writer.measurement(now),
            totals,
        })
    }

    /// Settles what has waited long enough.
    pub fn advance(
        &mut self,
        now: Timestamp,
        journal: &mut Journal,
        around: Around<'_>,
    ) -> Strangers {
        let mut strangers = Strangers::default();
        for (guid, measured) in &mut self.writers {
            let subject = measured.subject(*guid);
            measured
                .writer
                .advance(&mut self.shared.scene(subject, now, journal, around.calendar));
            if measured.topic.is_some() {
                if let Some(subscribers) = &mut measured.subscribers {
                    subscribers.advance(&mut self.shared.stage(subject, now, journal, around));
                }
                continue;
            }
            if measured.last_seen.0.saturating_add(FORGET) <= now.0 {
                strangers.forgotten.push(*guid);
            } else if !measured.metered && measured.first_seen.0.saturating_add(STRANGE) <= now.0 {
                (measured.metered, measured.opened) = (true, now);
                strangers.metered.push(*guid);
            }
        }
        strangers.metered.sort_unstable();
        strangers.forgotten.sort_unstable();
        for guid in &strangers.forgotten {
            self.stop(*guid, now, journal, around);
        }
        if std::mem::take(&mut self.shared.room.wanted) {
            self.give_up_silent(now, journal, around);
        }
        strangers
    }

    /// Settles everything: nothing more will come.
    pub fn settle(&mut self, now: Timestamp, journal: &mut Journal, around: Around<'_>) {
        let mut guids: Vec<_> = self.writers.keys().copied().collect();
        guids.sort_unstable();
        for guid in guids {
            let Some(measured) = self.writers.get_mut(&guid) else {
                continue;
            };
            let subject = measured.subject(guid);
            measured
                .writer
                .settle(&mut self.shared.scene(subject, now, journal, around.calendar));
            if let Some(subscribers) = &mut measured.subscribers {
                subscribers.settle(&mut self.shared.stage(subject, now, journal, around));
            }
            // Who sent twice and was not announced until the end is a stranger.
            measured.metered |= measured.topic.is_none() && measured.writer.messages() > 1;
        }
    }

    /// Gives up the deliveries that have been silent longest: somebody found no room.
    fn give_up_silent(&mut self, now: Timestamp, journal: &mut Journal, around: Around<'_>) {
        let mut silent: Vec<_> = self
            .writers
            .iter()
            .filter_map(|(guid, measured)| Some((guid, measured.subscribers.as_ref()?)))
            .flat_map(|(guid, subscribers)| subscribers.silent_since().map(|at| (at, *guid)))
            .filter(|(at, _)| at.0.saturating_add(SILENT) <= now.0)
            .collect();
        silent.sort_unstable();
        for (at, guid) in silent.into_iter().take(GIVEN_UP) {
            let Some(measured) = self.writers.get_mut(&guid) else {
                continue;
            };
            let subject = measured.subject(guid);
            if let Some(subscribers) = &mut measured.subscribers {
                let mut stage = self.shared.stage(subject, now, journal, around);
                subscribers.give_up(at, 1, &mut stage);
            }
        }
    }

    /// Forgets the stranger that has been silent longest, if it never was anybody.
    fn make_room(&mut self, now: Timestamp, around: Around<'_>) -> bool {
        if now < self.search_after {
            return false;
        }
        let doubtful = self.writers.iter().filter(|(_, measured)| {
            measured.topic.is_none()
                && measured.writer.messages() < SOMEBODY
                && measured.last_seen.0.saturating_add(DOUBTFUL) <= now.0
        });
        let oldest = doubtful.min_by_key(|(guid, measured)| (measured.last_seen, **guid));
        let Some(guid) = oldest.map(|(guid, _)| *guid) else {
            self.search_after = Timestamp(now.0.saturating_add(SECOND / 10));
            return false;
        };
        self.stranger_evictions += 1;
        self.stop(guid, now, &mut Journal::default(), around);
        true
    }
}

impl Shared {
    fn scene<'a>(
        &'a mut self,
        subject: Subject,
        now: Timestamp,
        journal: &'a mut Journal,
        calendar: Calendar,
    ) -> Scene<'a> {
        let budget = match subject.topic {
            Some(_) => &mut self.budget,
            None => &mut self.strangers_budget,
        };
        Scene {
            now,
            budget,
            journal,
            calendar,
        }
    }

    fn stage<'a>(
        &'a mut self,
        subject: Subject,
        now: Timestamp,
        journal: &'a mut Journal,
        around: Around<'a>,
    ) -> Stage<'a> {
        Stage {
            now,
            writer: subject.writer,
            reliable: subject.reliable,
            topic: subject.topic,
            budget: &mut self.deliveries_budget,
            journal,
            room: &mut self.room,
            around,
        }
    }
}

impl Measured {
    fn subject(&self, writer: Guid) -> Subject {
        Subject {
            writer,
            reliable: self.writer.traits().reliable,
            topic: self.topic,
        }
    }

    fn is_acknowledged(&self) -> bool {
        let subscribers = self.subscribers.as_ref();
        subscribers.is_some_and(|subscribers| subscribers.acknowledged_below().is_some())
    }

    /// Whether a reader of its topic asks for repairs, as far as discovery knows.
    fn has_reliable_reader(&self, around: Around<'_>) -> bool {
        let topic = self.topic.and_then(|topic| around.topics.get(topic));
        let readers = topic.into_iter().flat_map(|topic| &topic.readers);
        let mut known = readers.filter_map(|guid| around.discovery.endpoints().get(guid));
        known.any(|reader| reader.qos.reliability == Reliability::RELIABLE)
    }

    fn new(writer: Writer, topic: Option<TopicId>, now: Timestamp) -> Self {
        Self {
            writer: Box::new(writer),
            subscribers: None,
            topic,
            first_seen: now,
            last_seen: now,
            metered: false,
            sent_from: 0,
            opened: Timestamp(0),
            unacknowledged: false,
            sure_from: Timestamp(0),
        }
    }

    /// It is metered once the kernel has been told.
    const fn doubt(&mut self, now: Timestamp) {
        self.sure_from = Timestamp(now.0.saturating_add(TELLING));
        self.writer.doubt(self.sure_from);
    }
}
