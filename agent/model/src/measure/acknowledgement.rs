//! Acknowledgements of the readers of one reliable writer, and how far each reader lags behind.
//!
//! The age of the oldest unacknowledged sample requires the times of samples. The latest times are
//! exact; older ones are thinned out, so a reader that hangs for an hour needs bounded memory.
//! The tracker keeps no state for writers without acknowledgements.

use std::collections::VecDeque;

use ros2probe_wire::record::SequenceNumberSet;
use ros2probe_wire::{Guid, SequenceNumber};

use crate::facts::bounded::Bounded;
use crate::facts::model_time::ModelTime;
use crate::facts::names::NodeName;
use crate::facts::observation::AckNack;
use crate::facts::tables::{AcknowledgingReaders, SampleTimes};

/// State of acknowledgement between a reliable reader and a writer.
#[derive(Clone, Debug)]
pub struct AcknowledgementFacts {
    /// GUID of the writer.
    pub writer: Guid,
    /// GUID of the reader.
    pub reader: Guid,
    /// The reader's node.
    pub node: Option<NodeName>,
    /// All samples up to this number are acknowledged; 0 for none.
    pub acknowledged: SequenceNumber,
    /// Samples that the reader requested in its last ACKNACK.
    pub missing: u64,
    /// Samples requested again since the start, counted per request.
    pub requested: u64,
    /// Number of ACKNACKs.
    pub acknacks: u64,
    /// Samples that exist but are not acknowledged.
    pub lag_samples: u64,
    /// Age in seconds of the oldest such sample; 0 without one, `None` if it is no longer known.
    pub lag_seconds: Option<f64>,
    /// Time of the last ACKNACK.
    pub last_seen: ModelTime,
}

/// All readers that send ACKNACKs to one writer.
#[derive(Debug, Default)]
pub struct Acknowledgements {
    /// Readers, sorted by GUID.
    readers: Bounded<AcknowledgingReaders, Vec<Reader>>,
    /// Sequence numbers and the times at which they were first seen, sorted by number.
    times: Bounded<SampleTimes, VecDeque<(SequenceNumber, ModelTime)>>,
    /// Readers that were not added because the list was full.
    pub refused: u64,
}

#[derive(Clone, Copy, Debug)]
struct Reader {
    guid: Guid,
    /// All samples below this number are acknowledged.
    base: SequenceNumber,
    missing: u64,
    requested: u64,
    acknacks: u64,
    last_seen: ModelTime,
    /// The last ACKNACK that was observed as sent but not yet as received.
    leaving: Option<SequenceNumberSet>,
}

impl Acknowledgements {
    /// Returns whether no reader has acknowledged.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.readers.is_empty()
    }

    /// Records an ACKNACK.
    pub fn acknack(&mut self, acknack: &AckNack) {
        let guid = acknack.head.reader;
        let place = self.readers.binary_search_by_key(&guid, |each| each.guid);
        let index = match place {
            Ok(index) => index,
            Err(index) => {
                if self.readers.insert(index, Reader::new(guid)).is_some() {
                    self.refused += 1;
                    return;
                }
                index
            }
        };
        if let Some(reader) = self.readers.get_mut(index) {
            reader.acknack(acknack);
        }
        self.trim();
    }

    /// Returns the number below which all readers that `is_meant` selects have acknowledged every
    /// sample; `None` if none of them has sent an ACKNACK.
    pub fn floor(&self, is_meant: impl Fn(Guid) -> bool) -> Option<SequenceNumber> {
        let meant = self.readers.iter().filter(|reader| is_meant(reader.guid));
        meant.map(|reader| reader.base).min()
    }

    /// Records the writer's newest sample and its time.
    pub fn wrote(&mut self, number: SequenceNumber, at: ModelTime) {
        if self.readers.is_empty() {
            return;
        }
        if self.times.back().is_some_and(|(last, _)| *last >= number) {
            // The numbers restart, so the writer restarted under its GUID.
            self.times.clear();
        }
        if self.times.is_full() {
            let mut index = 0;
            self.times.refuse();
            self.times.retain(|_| {
                index += 1;
                index % 2 == 1 || index > SampleTimes::CAP / 2
            });
        }
        self.times.push_back((number, at));
    }

    /// Removes readers for which `is_there` returns false.
    pub fn retain(&mut self, is_there: impl Fn(Guid) -> bool) {
        self.readers.retain(|reader| is_there(reader.guid));
        if self.readers.is_empty() {
            self.times.take();
        }
    }

    /// Returns the state of each reader of `writer`; `next` is the number of its next sample.
    pub fn facts(
        &self,
        writer: Guid,
        next: SequenceNumber,
        now: ModelTime,
    ) -> impl Iterator<Item = AcknowledgementFacts> + '_ {
        self.readers.iter().map(move |reader| AcknowledgementFacts {
            writer,
            reader: reader.guid,
            node: None,
            acknowledged: reader.base.previous(),
            missing: reader.missing,
            requested: reader.requested,
            acknacks: reader.acknacks,
            lag_samples: next.steps_since(reader.base.max(SequenceNumber::FIRST)),
            lag_seconds: self.lag(reader.base.max(SequenceNumber::FIRST), next, now),
            last_seen: reader.last_seen,
        })
    }

    #[expect(
        clippy::cast_precision_loss,
        reason = "nanoseconds of a delay stay exact to 104 days"
    )]
    fn lag(&self, base: SequenceNumber, next: SequenceNumber, now: ModelTime) -> Option<f64> {
        if base >= next {
            return Some(0.0);
        }
        let after = self.times.partition_point(|(number, _)| *number < base);
        let (number, at) = self.times.get(after)?;
        // A sample between two known times was written no earlier than the first of them.
        let at = match after
            .checked_sub(1)
            .and_then(|before| self.times.get(before))
        {
            Some((_, before)) if *number > base => before,
            None if *number > base => return None,
            _ => at,
        };
        Some(now.nanoseconds_since(*at).max(0) as f64 / 1e9)
    }

    /// Removes the times of samples that all readers acknowledged.
    fn trim(&mut self) {
        let Some(base) = self.readers.iter().map(|reader| reader.base).min() else {
            return;
        };
        // One earlier time stays: it is the lower bound for the samples after it.
        while let Some((second, _)) = self.times.get(1)
            && *second < base
        {
            self.times.pop_front();
        }
    }
}

impl Reader {
    const fn new(guid: Guid) -> Self {
        Self {
            guid,
            base: SequenceNumber::ZERO,
            missing: 0,
            requested: 0,
            acknacks: 0,
            last_seen: ModelTime::ZERO,
            leaving: None,
        }
    }

    fn acknack(&mut self, acknack: &AckNack) {
        let content = acknack.missing;
        self.last_seen = self.last_seen.max(acknack.head.at);
        self.base = acknack.base();
        self.missing = content.iter().count() as u64;
        // If both ends are on this host, the ACKNACK is observed as sent and then as received.
        let is_leaving = acknack.head.is_sent();
        if !is_leaving && self.leaving.take() == Some(content) {
            return;
        }
        self.leaving = is_leaving.then_some(content);
        self.acknacks += 1;
        self.requested += self.missing;
    }
}

#[cfg(test)]
mod tests {
    use ros2probe_wire::record::{flag, guid_words, kind};
    use ros2probe_wire::{EntityId, GuidPrefix, Record};

    use super::*;
    use crate::facts::observation::Observation;
    use crate::facts::observation::tests::observed;

    fn guid(number: u8) -> Guid {
        Guid::new(GuidPrefix([number; 12]), EntityId([0, 0, number, 4]))
    }

    /// Passes the ACKNACK of a record to [`Acknowledgements::acknack`].
    fn put(all: &mut Acknowledgements, record: &Record) {
        let Observation::AckNack(acknack) = observed(record) else {
            panic!("{record:?}")
        };
        all.acknack(&acknack);
    }

    fn acknack(reader: u8, base: u64, bits: u32, bitmap: u32) -> Record {
        Record {
            kind: kind::ACKNACK,
            reader: guid_words(guid(reader)),
            sequence_number: base,
            stamp_seconds: bits,
            stamp_nanoseconds: bitmap,
            time: 1,
            ..Record::default()
        }
    }

    fn facts(all: &Acknowledgements, next: u64, seconds: u64) -> Vec<AcknowledgementFacts> {
        let now = ModelTime::from_nanoseconds(seconds * 1_000_000_000);
        all.facts(guid(9), SequenceNumber(next), now).collect()
    }

    #[test]
    fn a_reader_that_hangs_falls_behind_in_samples_and_in_time() {
        let mut all = Acknowledgements::default();
        put(&mut all, &acknack(1, 1, 0, 0));
        put(&mut all, &acknack(2, 1, 0, 0));
        for number in 1..=100 {
            all.wrote(
                SequenceNumber(number),
                ModelTime::from_nanoseconds(number * 1_000_000_000),
            );
        }
        put(&mut all, &acknack(2, 101, 0, 0));
        put(&mut all, &acknack(1, 41, 3, 0b101 << 29));
        let [hangs, keeps_up] = &facts(&all, 101, 110)[..] else {
            panic!("two readers")
        };
        assert_eq!((hangs.acknowledged.0, hangs.missing), (40, 2));
        assert_eq!((hangs.lag_samples, hangs.lag_seconds), (60, Some(69.0)));
        assert_eq!((keeps_up.acknowledged.0, keeps_up.missing), (100, 0));
        assert_eq!((keeps_up.lag_samples, keeps_up.lag_seconds), (0, Some(0.0)));
    }

    #[test]
    fn an_hour_without_acknacks_is_reported_in_bounded_memory() {
        let mut all = Acknowledgements::default();
        put(&mut all, &acknack(1, 1, 0, 0));
        for number in 1..=360_000 {
            all.wrote(
                SequenceNumber(number),
                ModelTime::from_nanoseconds(number * 10_000_000),
            );
        }
        assert!(all.times.len() <= SampleTimes::CAP);
        put(&mut all, &acknack(1, 180_001, 0, 0));
        let lag = facts(&all, 360_001, 3600)
            .first()
            .and_then(|each| each.lag_seconds);
        assert!(
            lag.is_some_and(|lag| (1800.0..3700.0).contains(&lag)),
            "{lag:?}"
        );
    }

    #[test]
    fn an_acknack_observed_as_sent_and_as_received_counts_once() {
        let mut all = Acknowledgements::default();
        let leaving = Record {
            flags: flag::OUTGOING,
            ..acknack(1, 5, 1, 1 << 31)
        };
        put(&mut all, &leaving);
        put(&mut all, &acknack(1, 5, 1, 1 << 31));
        let [reader] = &facts(&all, 6, 1)[..] else {
            panic!("one reader")
        };
        assert_eq!((reader.acknacks, reader.requested), (1, 1));
        all.retain(|_| false);
        assert!(all.readers.is_empty() && all.times.capacity() == 0);
    }
}
