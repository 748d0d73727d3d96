//! Stamps in the headers of messages: publishers whose stamps cannot be right.
//!
//! A stamp is compared with INFO_TS of the same message. Both come from the publisher's host, so
//! offsets between hosts do not matter.

use std::collections::{BTreeSet, VecDeque};
use std::time::Duration;

use foldhash::HashMap;
use ros2probe_wire::time::SECOND;
use ros2probe_wire::{DomainId, Guid, SequenceNumber, Timestamp};

use crate::facts::bounded::{Bounded, Counted, TableFacts};
use crate::facts::diagnosis::{Diagnosis, StampFault, TopicKey};
use crate::facts::header::MAX_PLAUSIBLE_OFFSET;
use crate::facts::model_time::ModelTime;
use crate::facts::tables::StampWriters;

/// Nanoseconds by which a stamp may be later than the publication of its message.
const MAX_LEAD_NANOSECONDS: i64 = 20_000_000;
/// Number of messages in a row that begin or end a fault.
const MIN_STREAK: u8 = 3;
/// Time for which a stamp that went back is a fault.
const FAULT_LIFETIME: Duration = Duration::from_secs(60);
/// Time over which the least age of a stamp is taken.
const WINDOW: Duration = Duration::from_secs(30);
/// Number of windows that must drift in one direction.
const DRIFTING_WINDOWS: usize = 4;
/// Least drift from one window to the next, in nanoseconds: 33 ppm.
const MIN_DRIFT_NANOSECONDS: i64 = 1_000_000;

/// The stamps of all publishers whose messages are measured and begin with a header.
#[derive(Debug, Default)]
pub struct Stamps {
    writers: Bounded<Counted<StampWriters>, HashMap<Guid, StampWriter>>,
    revision: u64,
}

/// The stamps of one publisher.
#[derive(Debug)]
struct StampWriter {
    topic: TopicKey,
    newest: SequenceNumber,
    /// Stamp and publication of the newest message.
    last: Option<(Timestamp, Timestamp)>,
    future: Streak,
    other_clock: Streak,
    /// Time and distance of the last stamp that went back.
    back: Option<(ModelTime, i64)>,
    /// Start of the present window, and the least age in it.
    window: (ModelTime, Option<i64>),
    /// Least ages of the last windows.
    least: VecDeque<i64>,
    /// The fault that is reported.
    reported: Option<(StampFault, i64)>,
}

/// A condition that begins and ends after some messages in a row.
#[derive(Clone, Copy, Debug, Default)]
struct Streak {
    count: u8,
    /// The value with which it began.
    value: Option<i64>,
}

impl Stamps {
    /// Adds a message of a publisher. `stamp` is that of its header, `published` is its INFO_TS.
    pub fn add(
        &mut self,
        (writer, number): (Guid, SequenceNumber),
        (stamp, published): ((i32, u32), Timestamp),
        at: ModelTime,
        topic: impl FnOnce() -> Option<TopicKey>,
    ) {
        // A header without a stamp says nothing.
        if stamp == (0, 0) {
            return;
        }
        if !self.writers.contains_key(&writer) {
            let Some(topic) = topic() else {
                return;
            };
            let new = || StampWriter {
                topic,
                newest: SequenceNumber::ZERO,
                last: None,
                future: Streak::default(),
                other_clock: Streak::default(),
                back: None,
                window: (at, None),
                least: VecDeque::new(),
                reported: None,
            };
            self.writers.get_or_insert_with(writer, new);
        }
        if let Some(known) = self.writers.get_mut(&writer)
            && number > known.newest
        {
            known.newest = number;
            known.add(stamp, published, at);
        }
    }

    /// Forgets a publisher.
    pub fn forget(&mut self, writer: Guid) {
        if let Some(known) = self.writers.remove(&writer) {
            self.revision += u64::from(known.reported.is_some());
        }
    }

    /// Ends a second: faults begin and end. Stamps of another clock are no fault in a domain of
    /// `simulated` time.
    pub fn end_second(&mut self, now: ModelTime, simulated: impl Iterator<Item = DomainId>) {
        if self.writers.is_empty() {
            return;
        }
        let simulated: BTreeSet<_> = simulated.collect();
        for known in self.writers.values_mut() {
            let fault = known.fault(now, &simulated);
            let kind = |fault: &Option<(StampFault, i64)>| fault.as_ref().map(|(kind, _)| *kind);
            // The value of a fault is the one with which it began.
            if kind(&fault) != kind(&known.reported) {
                known.reported = fault;
                self.revision += 1;
            }
        }
    }

    /// Returns the number of changes of [`Self::findings`].
    #[must_use]
    pub const fn revision(&self) -> u64 {
        self.revision
    }

    /// Returns the publishers whose stamps cannot be right.
    pub fn findings(&self) -> impl Iterator<Item = Diagnosis> {
        let writers = self.writers.iter();
        writers.filter_map(|(writer, known)| {
            let (fault, nanoseconds) = known.reported?;
            Some(Diagnosis::WrongStamps {
                topic: known.topic.clone(),
                writer: *writer,
                fault,
                nanoseconds,
            })
        })
    }

    /// Returns size, cap and evictions of the table.
    #[must_use]
    pub fn table(&self) -> TableFacts {
        self.writers.facts()
    }
}

impl StampWriter {
    fn add(&mut self, (seconds, nanoseconds): (i32, u32), published: Timestamp, at: ModelTime) {
        let seconds = u64::try_from(seconds).unwrap_or(0);
        let stamp = Timestamp(seconds * SECOND + u64::from(nanoseconds));
        let age = published.nanoseconds_since(stamp);
        let is_far = stamp.distance(published) > MAX_PLAUSIBLE_OFFSET;
        self.other_clock.note(is_far, age);
        let last = self.last.replace((stamp, published));
        if is_far {
            return;
        }
        self.future.note(age < -MAX_LEAD_NANOSECONDS, -age);
        if let Some((last_stamp, last_published)) = last
            && stamp < last_stamp
            && published > last_published
        {
            self.back = Some((at, last_stamp.nanoseconds_since(stamp)));
        }
        let least = &mut self.window.1;
        *least = Some(least.map_or(age, |least| least.min(age)));
    }

    fn fault(
        &mut self,
        now: ModelTime,
        simulated: &BTreeSet<DomainId>,
    ) -> Option<(StampFault, i64)> {
        self.turn(now);
        if let Some(age) = self.other_clock.value {
            let is_fault = !simulated.contains(&self.topic.domain_id);
            return is_fault.then_some((StampFault::OtherClock, age));
        }
        let back = self.back.filter(|(at, _)| now - *at < FAULT_LIFETIME);
        let back = back.map(|(_, by)| (StampFault::WentBack, by));
        let future = self.future.value.map(|by| (StampFault::Future, by));
        back.or(future).or(self.drift())
    }

    /// Ends the window, if it has lasted.
    fn turn(&mut self, now: ModelTime) {
        if now - self.window.0 < WINDOW {
            return;
        }
        match self.window.1.take() {
            Some(least) => self.least.push_back(least),
            None => self.least.clear(),
        }
        if self.least.len() > DRIFTING_WINDOWS + 1 {
            self.least.pop_front();
        }
        self.window.0 = now;
    }

    /// Returns the drift of the least age from the first to the last window, if it goes in one
    /// direction.
    fn drift(&self) -> Option<(StampFault, i64)> {
        if self.least.len() <= DRIFTING_WINDOWS {
            return None;
        }
        let steps = self.least.iter().zip(self.least.iter().skip(1));
        let steps: Vec<_> = steps.map(|(before, after)| after - before).collect();
        let is_steady = steps.iter().all(|step| *step >= MIN_DRIFT_NANOSECONDS)
            || steps.iter().all(|step| *step <= -MIN_DRIFT_NANOSECONDS);
        let sum: i64 = steps.iter().sum();
        is_steady.then_some((StampFault::Drifting, sum))
    }
}

impl Streak {
    fn note(&mut self, holds: bool, value: i64) {
        if holds == self.value.is_some() {
            self.count = 0;
            return;
        }
        self.count += 1;
        if self.count >= MIN_STREAK {
            self.count = 0;
            self.value = holds.then_some(value);
        }
    }
}
