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
/// Minimum number of messages in a window: the least age of fewer ones is chance.
const MIN_WINDOW_MESSAGES: u32 = 20;
/// Minimum drift from one window to the next, as a multiple of the distance between the two least
/// ages of any window. The least age varies by about that distance.
const DRIFT_FACTOR: i64 = 2;

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
    /// Start of the present window, and the ages in it.
    window: (ModelTime, Ages),
    /// Ages of the last windows.
    least: VecDeque<Ages>,
    /// The fault that is reported.
    reported: Option<(StampFault, i64)>,
}

/// Ages of the stamps of one window, in nanoseconds.
#[derive(Clone, Copy, Debug)]
struct Ages {
    messages: u32,
    least: i64,
    /// The second-lowest age.
    next: i64,
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
        // A header without a stamp is not evidence.
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
                window: (at, Ages::default()),
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
        self.window.1.add(age);
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
        let (_, ages) = std::mem::replace(&mut self.window, (now, Ages::default()));
        if ages.messages < MIN_WINDOW_MESSAGES {
            self.least.clear();
            return;
        }
        self.least.push_back(ages);
        if self.least.len() > DRIFTING_WINDOWS + 1 {
            self.least.pop_front();
        }
    }

    /// Returns the drift of the least age from the first to the last window, if it goes in one
    /// direction.
    fn drift(&self) -> Option<(StampFault, i64)> {
        if self.least.len() <= DRIFTING_WINDOWS {
            return None;
        }
        let steps = self.least.iter().zip(self.least.iter().skip(1));
        let steps: Vec<_> = steps
            .map(|(before, after)| after.least - before.least)
            .collect();
        let distance = self.least.iter().map(Ages::distance).max();
        let chance = distance.unwrap_or(0).saturating_mul(DRIFT_FACTOR);
        let minimum = MIN_DRIFT_NANOSECONDS.max(chance);
        let is_steady =
            steps.iter().all(|step| *step >= minimum) || steps.iter().all(|step| *step <= -minimum);
        let sum: i64 = steps.iter().sum();
        is_steady.then_some((StampFault::Drifting, sum))
    }
}

impl Ages {
    fn add(&mut self, age: i64) {
        self.messages = self.messages.saturating_add(1);
        (self.least, self.next) = match age < self.least {
            true => (age, self.least),
            false => (self.least, self.next.min(age)),
        };
    }

    /// Returns the distance between the two least ages.
    const fn distance(&self) -> i64 {
        self.next.saturating_sub(self.least)
    }
}

impl Default for Ages {
    fn default() -> Self {
        Self {
            messages: 0,
            least: i64::MAX,
            next: i64::MAX,
        }
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::facts::topic_kind::TopicKind;

    /// Publishes for a day, one message each `interval` seconds, with ages from `age`. Returns
    /// whether they were ever a drift.
    fn drifts(interval: u64, mut age: impl FnMut(u64) -> u64) -> bool {
        const START: u64 = 1_795_143_000;
        let mut stamps = Stamps::default();
        let mut has_drifted = false;
        for second in 0..86_400 {
            let now = (START + second) * SECOND;
            let at = ModelTime::from_nanoseconds(now);
            if second.is_multiple_of(interval) {
                let stamp = now - age(second);
                let nanoseconds = u32::try_from(stamp % SECOND).unwrap();
                let stamp = (i32::try_from(stamp / SECOND).unwrap(), nanoseconds);
                let number = SequenceNumber(second + 1);
                stamps.add(
                    (Guid::default(), number),
                    (stamp, Timestamp(now)),
                    at,
                    || {
                        Some(TopicKey {
                            domain_id: DomainId(0),
                            dds_name: "rt/map".into(),
                            name: "/map".into(),
                            kind: TopicKind::Topic,
                        })
                    },
                );
            }
            stamps.end_second(at, std::iter::empty());
            let is_drift = |found: &Diagnosis| {
                let fault = StampFault::Drifting;
                matches!(found, Diagnosis::WrongStamps { fault: found, .. } if *found == fault)
            };
            has_drifted |= stamps.findings().any(|found| is_drift(&found));
        }
        has_drifted
    }

    #[test]
    fn random_ages_are_not_a_drift() {
        for (interval, range) in [(5, 100), (1, 100), (1, 1000), (1, 20)] {
            let mut dice = 1_u64;
            let random = |_| {
                dice = dice.wrapping_mul(6_364_136_223_846_793_005) + 1;
                50_000_000 + (dice >> 33) % (range * 1_000_000)
            };
            assert!(!drifts(interval, random), "{interval} s, {range} ms");
        }
    }

    #[test]
    fn ages_that_grow_at_one_hertz_are_a_drift() {
        // 100 µs a second, and each message up to 1 ms late.
        assert!(drifts(1, |second| second * 100_000 + second * 7 % 11 * 100_000));
    }
}
