//! Fragmented samples: complete once every fragment number was seen.
//!
//! Writers repeat fragments, so counting bytes is not enough; each sample has a bitmap. Payloads
//! are not kept, and announced sizes are not trusted: the bitmap grows with the fragments that
//! arrived, within a budget shared by all writers. The caller first checks in
//! [`crate::measure::sequence`] whether a finished sample was seen before.

use std::time::Duration;

use crate::facts::bounded::Bounded;
use crate::facts::model_time::ModelTime;
use crate::facts::observation::{DataFrag, Sample};
use crate::facts::tables::PartialSamples;
use ros2probe_wire::{RtpsTime, SequenceNumber};

/// Maximum number of fragments per sample: 88 MB with Cyclone DDS, 4 GB with Fast DDS.
pub const MAX_FRAGMENTS: u32 = 65_536;

/// Memory budget for the bitmaps of all writers, and its evictions.
#[derive(Clone, Copy, Debug)]
pub struct Budget {
    /// Bytes in use.
    pub bytes: usize,
    /// Number of unfinished samples.
    pub samples: usize,
    /// Maximum of `bytes`.
    pub limit: usize,
    /// Number of samples dropped because of the cap.
    pub evictions: u64,
    /// Number of fragments that were rejected: contradictory numbers, or a sample with too many
    /// fragments.
    pub rejected: u64,
}

impl Budget {
    /// Creates an empty budget.
    #[must_use]
    pub const fn new(limit: usize) -> Self {
        Self {
            bytes: 0,
            samples: 0,
            limit,
            evictions: 0,
            rejected: 0,
        }
    }
}

/// The unfinished samples of one writer.
#[derive(Debug, Default)]
pub struct Samples {
    partial: Bounded<PartialSamples, Vec<Partial>>,
    /// Samples that began before this time may lack fragments that were not captured.
    complete_from: ModelTime,
    /// Whether bytes were missed since the last sample began, perhaps its next one's first
    /// fragments.
    interrupted: bool,
}

/// An unfinished sample.
#[derive(Debug)]
struct Partial {
    number: SequenceNumber,
    size: u32,
    fragment_size: u32,
    seen: u32,
    /// Whether it may lack fragments that were not captured.
    uncertain: bool,
    bitmap: Vec<u64>,
    /// Time at which the last fragment number was first seen.
    tail: Option<ModelTime>,
    latest: ModelTime,
    facts: Facts,
}

/// Facts about a complete sample.
#[derive(Clone, Copy, PartialEq, Eq, Debug, Default)]
pub struct Facts {
    /// Timestamp of the INFO_TS, which Cyclone DDS sends only with the first fragment.
    pub source: RtpsTime,
    /// Stamp in the payload of the first fragment.
    pub stamp: Option<(i32, u32)>,
    /// Size in bytes.
    pub size: u32,
    /// Time of the first datagram of the first observation.
    pub began: ModelTime,
    /// Nanoseconds from the arrival of the last fragment number to that of the last missing
    /// fragment.
    pub repaired_after: i64,
}

/// Result of a fragment.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum Progress {
    /// The fragment is new, but others are missing.
    Partial,
    /// The fragment completed the sample.
    Complete(Facts),
    /// All fragments of this DATA_FRAG were seen before.
    Duplicate,
    /// The fragment numbers or sizes are invalid, or contradict earlier fragments.
    Rejected,
    /// The sample has more fragments than are tracked, so its completeness is unknown.
    TooMany,
}

impl Samples {
    /// Processes a DATA_FRAG.
    pub fn fragment(
        &mut self,
        sample: &Sample,
        fragments: DataFrag,
        budget: &mut Budget,
    ) -> Progress {
        let now = sample.head.at;
        let (start, count) = (fragments.starting, fragments.count);
        let (size, fragment_size) = (fragments.sample_size, fragments.fragment_size);
        let total = fragments.total();
        let end = start.saturating_add(count);
        if total == 0 || start == 0 || count == 0 || end - 1 > total {
            budget.rejected += 1;
            return Progress::Rejected;
        }
        if total > MAX_FRAGMENTS {
            budget.rejected += 1;
            return Progress::TooMany;
        }
        let index = match self.place(sample.sequence_number) {
            Some(index) => index,
            None => self.open(sample, fragments, budget),
        };
        let Some(partial) = self.partial.get_mut(index) else {
            return Progress::Rejected;
        };
        if partial.size != size || partial.fragment_size != fragment_size {
            budget.rejected += 1;
            return Progress::Rejected;
        }
        let before = partial.bitmap.len();
        let new = partial.mark(start - 1, end - 1);
        budget.bytes += (partial.bitmap.len() - before) * 8;
        if new == 0 {
            return Progress::Duplicate;
        }
        partial.seen += new;
        partial.latest = now;
        if end - 1 == total && partial.tail.is_none() {
            partial.tail = Some(now);
        }
        if partial.facts.source == RtpsTime(0) {
            partial.facts.source = sample.source_timestamp;
        }
        if start == 1 {
            partial.facts.stamp = sample.header_stamp;
        }
        if partial.seen == total {
            let mut facts = partial.facts;
            facts.repaired_after = partial.tail.map_or(0, |tail| now.nanoseconds_since(tail));
            self.close(index, budget);
            return Progress::Complete(facts);
        }
        if budget.bytes > budget.limit {
            self.evict(sample.sequence_number, budget);
        }
        Progress::Partial
    }

    /// Returns whether this sample has some but not all of its fragments.
    #[must_use]
    pub fn is_partial(&self, number: SequenceNumber) -> bool {
        self.place(number).is_some()
    }

    /// Allows samples that begin before `until` to lack fragments that the kernel did not capture.
    pub const fn allow_incomplete(&mut self, until: ModelTime) {
        self.complete_from = until;
    }

    /// Allows the unfinished samples, and a next one without its first fragment, to be incomplete:
    /// bytes between their fragments were not captured.
    pub fn interrupt(&mut self) {
        self.interrupted = true;
        for partial in self.partial.iter_mut() {
            partial.uncertain = true;
        }
    }

    /// Returns whether this sample is unfinished and may lack fragments without a loss.
    #[must_use]
    pub fn is_doubtful(&self, number: SequenceNumber) -> bool {
        let partial = self.place(number).and_then(|index| self.partial.get(index));
        partial.is_some_and(|partial| partial.uncertain)
    }

    /// Returns the lowest number, not below `first`, of a sample that still receives fragments.
    /// That sample and later ones are not decided yet.
    #[must_use]
    pub fn lowest_growing(
        &self,
        now: ModelTime,
        window: Duration,
        first: SequenceNumber,
    ) -> Option<SequenceNumber> {
        let growing = self
            .partial
            .iter()
            .filter(|each| each.number >= first && each.latest + window > now);
        growing.map(|each| each.number).min()
    }

    /// Drops this sample; returns whether it was unfinished.
    pub fn forget(&mut self, number: SequenceNumber, budget: &mut Budget) -> bool {
        let index = self.place(number);
        if let Some(index) = index {
            self.close(index, budget);
        }
        index.is_some()
    }

    /// Drops all samples below this number.
    pub fn forget_below(&mut self, number: SequenceNumber, budget: &mut Budget) {
        while let Some(index) = self.partial.iter().position(|each| each.number < number) {
            self.close(index, budget);
        }
    }

    /// Drops samples without a fragment for `window`; returns their number.
    pub fn expire(&mut self, now: ModelTime, window: Duration, budget: &mut Budget) -> u64 {
        let mut expired = 0;
        while let Some(index) = self
            .partial
            .iter()
            .position(|each| each.latest + window <= now)
        {
            self.close(index, budget);
            expired += 1;
        }
        expired
    }

    /// Returns the time at which [`Self::expire`] drops the next sample; [`ModelTime::MAX`] without
    /// one.
    #[must_use]
    pub fn next_expiry(&self, window: Duration) -> ModelTime {
        let latest = self.partial.iter().map(|each| each.latest).min();
        latest.map_or(ModelTime::MAX, |latest| latest + window)
    }

    /// Moves the memory of unfinished samples from one budget to another.
    pub fn transfer(&self, from: &mut Budget, to: &mut Budget) {
        let bytes: usize = self.partial.iter().map(|each| each.bitmap.len() * 8).sum();
        from.bytes = from.bytes.saturating_sub(bytes);
        from.samples = from.samples.saturating_sub(self.partial.len());
        to.bytes += bytes;
        to.samples += self.partial.len();
    }

    /// Drops all samples and returns their memory to the budget.
    pub fn clear(&mut self, budget: &mut Budget) {
        while !self.partial.is_empty() {
            self.close(0, budget);
        }
    }

    fn place(&self, number: SequenceNumber) -> Option<usize> {
        self.partial.iter().position(|each| each.number == number)
    }

    fn open(&mut self, sample: &Sample, fragments: DataFrag, budget: &mut Budget) -> usize {
        let number = sample.sequence_number;
        if self.partial.is_full() {
            self.partial.refuse();
            self.evict(number, budget);
        }
        budget.samples += 1;
        let began = sample.head.began();
        let was_interrupted = std::mem::take(&mut self.interrupted);
        self.partial.push(Partial {
            number,
            size: fragments.sample_size,
            fragment_size: fragments.fragment_size,
            seen: 0,
            uncertain: began < self.complete_from || was_interrupted && fragments.starting > 1,
            bitmap: Vec::new(),
            tail: None,
            latest: sample.head.at,
            facts: Facts {
                size: fragments.sample_size,
                began,
                ..Facts::default()
            },
        });
        self.partial.len() - 1
    }

    /// Drops the sample that has waited longest for a fragment. The newcomer is dropped only if it
    /// is alone.
    fn evict(&mut self, newcomer: SequenceNumber, budget: &mut Budget) {
        let candidates = self.partial.iter().enumerate();
        let oldest = candidates.min_by_key(|(_, each)| (each.number == newcomer, each.latest));
        if let Some(index) = oldest.map(|(index, _)| index) {
            self.close(index, budget);
            budget.evictions += 1;
        }
    }

    fn close(&mut self, index: usize, budget: &mut Budget) {
        let partial = self.partial.swap_remove(index);
        budget.bytes = budget.bytes.saturating_sub(partial.bitmap.len() * 8);
        budget.samples = budget.samples.saturating_sub(1);
    }
}

impl Partial {
    /// Sets the bits `start..end` and returns how many of them were new.
    fn mark(&mut self, start: u32, end: u32) -> u32 {
        let words = end.div_ceil(64) as usize;
        if self.bitmap.len() < words {
            self.bitmap.resize(words, 0);
        }
        let mut new = 0;
        let mut bit = start;
        while bit < end {
            let next = (bit / 64 + 1) * 64;
            let upper = next.saturating_sub(end);
            let mask = (u64::MAX << (bit % 64)) & (u64::MAX >> upper);
            if let Some(word) = self.bitmap.get_mut(bit as usize / 64) {
                new += (mask & !*word).count_ones();
                *word |= mask;
            }
            bit = next;
        }
        new
    }
}

#[cfg(test)]
mod tests {
    use ros2probe_wire::Record;
    use ros2probe_wire::record::kind;

    use super::*;
    use crate::facts::observation::tests::{fragments, sample};

    #[test]
    fn marking_a_range_equals_marking_its_numbers_one_by_one() {
        for (start, end) in [
            (0, 1),
            (0, 64),
            (63, 65),
            (5, 5),
            (70, 200),
            (127, 128),
            (0, 300),
        ] {
            let partial = || Partial {
                uncertain: false,
                number: SequenceNumber(1),
                size: 0,
                fragment_size: 0,
                seen: 0,
                bitmap: Vec::new(),
                tail: None,
                latest: ModelTime::ZERO,
                facts: Facts::default(),
            };
            let (mut range, mut single) = (partial(), partial());
            for seen in [3, 64, 130] {
                range.mark(seen, seen + 1);
                single.mark(seen, seen + 1);
            }
            let new: u32 = (start..end).map(|bit| single.mark(bit, bit + 1)).sum();
            assert_eq!(range.mark(start, end), new, "{start}..{end}");
            range.bitmap.resize(8, 0);
            single.bitmap.resize(8, 0);
            assert_eq!(range.bitmap, single.bitmap, "{start}..{end}");
            let marked: u32 = range.bitmap.iter().map(|word| word.count_ones()).sum();
            assert_eq!(marked, new + 3, "{start}..{end}");
        }
    }

    /// Passes the DATA_FRAG of a record to [`Samples::fragment`].
    fn put(samples: &mut Samples, record: &Record, at: u64, budget: &mut Budget) -> Progress {
        let sample = sample(&Record {
            time: at,
            ..*record
        });
        samples.fragment(&sample, fragments(&sample), budget)
    }

    fn fragment(number: u64, start: u32, count: u32, size: u32) -> Record {
        Record {
            kind: kind::DATA_FRAG,
            sequence_number: number,
            fragment_start: start,
            fragments: count << 16 | 1344,
            sample_size: size,
            ..Record::default()
        }
    }

    fn budget() -> Budget {
        Budget::new(64 * 1024)
    }

    #[test]
    fn repeated_fragments_do_not_complete_a_sample() {
        let (mut samples, mut budget) = (Samples::default(), budget());
        let mut put = |start, count| {
            put(
                &mut samples,
                &fragment(1, start, count, 13_440),
                1,
                &mut budget,
            )
        };
        assert_eq!(put(1, 5), Progress::Partial);
        assert_eq!(put(1, 5), Progress::Duplicate);
        assert_eq!(put(2, 5), Progress::Partial);
        assert_eq!(put(8, 3), Progress::Partial);
        assert!(matches!(
            put(7, 1),
            Progress::Complete(Facts { size: 13_440, .. })
        ));
        assert_eq!((budget.bytes, budget.samples), (0, 0));
    }

    #[test]
    fn a_claimed_sample_size_does_not_determine_the_allocation() {
        let (mut samples, mut budget) = (Samples::default(), budget());
        let hostile = fragment(1, 1, 1, u32::MAX);
        assert_eq!(
            put(&mut samples, &hostile, 1, &mut budget),
            Progress::TooMany
        );
        let large = fragment(1, 1, 1, 88_000_000);
        assert_eq!(put(&mut samples, &large, 1, &mut budget), Progress::Partial);
        assert_eq!(budget.bytes, 8);
    }

    #[test]
    fn impossible_fragment_numbers_are_rejected() {
        let (mut samples, mut budget) = (Samples::default(), budget());
        for (start, count, size) in [
            (0, 1, 9000),
            (1, 0, 9000),
            (7, 2, 9000),
            (1, 1, 0),
            (u32::MAX, 65_535, 9000),
        ] {
            let record = fragment(1, start, count, size);
            assert_eq!(
                put(&mut samples, &record, 1, &mut budget),
                Progress::Rejected
            );
        }
        put(&mut samples, &fragment(1, 1, 1, 9000), 1, &mut budget);
        let other_size = fragment(1, 2, 1, 9001);
        assert_eq!(
            put(&mut samples, &other_size, 1, &mut budget),
            Progress::Rejected
        );
        assert_eq!(budget.rejected, 6);
    }

    #[test]
    fn a_storm_of_unfinished_samples_stays_within_the_budget() {
        let (mut samples, mut budget) = (Samples::default(), budget());
        for number in 0..10_000 {
            let last = fragment(number, 65_000, 1, 65_000 * 1344);
            put(&mut samples, &last, number, &mut budget);
        }
        assert!(budget.bytes <= budget.limit && samples.partial.len() <= PartialSamples::CAP);
        assert!(budget.evictions > 9000);
    }

    #[test]
    fn info_ts_of_the_first_fragment_is_kept() {
        let (mut samples, mut budget) = (Samples::default(), budget());
        let first = Record {
            source_timestamp: 77 << 32,
            ..fragment(1, 1, 1, 2000)
        };
        put(&mut samples, &first, 1, &mut budget);
        let done = put(&mut samples, &fragment(1, 2, 1, 2000), 9, &mut budget);
        assert!(matches!(done, Progress::Complete(facts) if facts.source == RtpsTime(77 << 32)));
    }

    #[test]
    fn stalled_samples_expire() {
        let (mut samples, mut budget) = (Samples::default(), budget());
        put(&mut samples, &fragment(4, 1, 1, 9000), 100, &mut budget);
        assert_eq!(
            samples.lowest_growing(
                ModelTime::from_nanoseconds(150),
                Duration::from_nanos(100),
                SequenceNumber(0)
            ),
            Some(SequenceNumber(4))
        );
        assert_eq!(
            samples.lowest_growing(
                ModelTime::from_nanoseconds(250),
                Duration::from_nanos(100),
                SequenceNumber(0)
            ),
            None
        );
        assert_eq!(
            samples.expire(
                ModelTime::from_nanoseconds(250),
                Duration::from_nanos(100),
                &mut budget
            ),
            1
        );
        assert_eq!(budget.bytes, 0);
    }
}
