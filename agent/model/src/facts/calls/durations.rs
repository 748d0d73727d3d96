//! A cumulative distribution of durations, with four buckets for each power of two.
//!
//! The range is always ordered and lies within the buckets in use. Every constructor ensures this,
//! because the kernel programs update range and buckets without a lock. A difference of two states
//! knows only the buckets. The last bucket has no upper bound but the largest duration.

use std::time::Duration;

use ros2probe_wire::inside::{BUCKETS, bucket, bucket_start};

use crate::facts::histogram::Histogram;

/// Number of values of a bucket's count in the kernel, after which it wraps to zero.
const COUNT_WRAP: u64 = 1 << 32;

/// A distribution of durations.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Durations {
    /// Counts by [`bucket`].
    counts: Box<[u64; BUCKETS]>,
    sum: u64,
    /// The smallest and largest duration in nanoseconds; `None` if there is no duration.
    range: Option<(u64, u64)>,
}

/// A bucket in use.
#[derive(Clone, Copy)]
struct Filled {
    /// Smallest and largest duration of the bucket.
    start: u64,
    end: u64,
    count: u64,
}

impl Default for Durations {
    fn default() -> Self {
        Self {
            counts: Box::new([0; BUCKETS]),
            sum: 0,
            range: None,
        }
    }
}

impl Durations {
    /// Creates a distribution from the kernel's counts, and from sum, minimum and maximum in
    /// nanoseconds. The counts may have been read at another time than these three values.
    #[must_use]
    pub fn new(counts: &[u32; BUCKETS], sum: u64, minimum: u64, maximum: u64) -> Self {
        let counts = Box::new(counts.map(u64::from));
        Self {
            sum,
            ..Self::of(counts, sum, (minimum, maximum))
        }
    }

    /// Adds one duration.
    pub fn observe(&mut self, duration: Duration) {
        let nanoseconds = u64::try_from(duration.as_nanos()).unwrap_or(u64::MAX);
        if let Some(count) = self.counts.get_mut(bucket(nanoseconds)) {
            *count = count.saturating_add(1);
        }
        self.sum = self.sum.saturating_add(nanoseconds);
        let (least, largest) = self.range.unwrap_or((nanoseconds, nanoseconds));
        self.range = Some((least.min(nanoseconds), largest.max(nanoseconds)));
    }

    /// Returns the number of durations.
    #[must_use]
    pub fn count(&self) -> u64 {
        self.counts.iter().copied().fold(0, u64::saturating_add)
    }

    /// Returns the sum of the durations.
    #[must_use]
    pub const fn sum(&self) -> Duration {
        Duration::from_nanos(self.sum)
    }

    /// Returns the smallest and largest duration; `None` if the distribution is empty.
    #[must_use]
    pub fn range(&self) -> Option<(Duration, Duration)> {
        let (least, largest) = self.range?;
        Some((Duration::from_nanos(least), Duration::from_nanos(largest)))
    }

    /// Estimates the quantile `part`, from 0 to 1. The estimate lies within the range and within
    /// the bucket of the exact value, whose bounds differ by at most a quarter. The last bucket
    /// begins at 15 s and ends at the largest duration. Returns `None` if the distribution is
    /// empty.
    #[must_use]
    #[expect(
        clippy::cast_precision_loss,
        clippy::cast_possible_truncation,
        clippy::cast_sign_loss,
        reason = "an estimate; the cast of a float saturates"
    )]
    pub fn quantile(&self, part: f64) -> Option<Duration> {
        let (least, largest) = self.range?;
        let wanted = self.count() as f64 * part;
        let mut below = 0.0;
        let mut value = largest;
        for filled in self.filled() {
            let count = filled.count as f64;
            if below + count >= wanted {
                let (start, end) = (filled.start.max(least), filled.end.min(largest));
                let share = (wanted - below).max(0.0) / count;
                let step = end.saturating_sub(start) as f64 * share;
                value = match share < 1.0 {
                    true => start.saturating_add(step as u64).min(end),
                    false => end,
                };
                break;
            }
            below += count;
        }
        Some(Duration::from_nanos(value.max(least).min(largest)))
    }

    /// Returns the durations added since `earlier`, an older state of this distribution. The range
    /// of the result is as narrow as the two states allow. It is exact for a single duration and
    /// for a new extreme.
    #[must_use]
    pub fn since(&self, earlier: &Self) -> Self {
        if self.count() < earlier.count() {
            return self.clone();
        }
        let mut counts = self.counts.clone();
        for (count, before) in counts.iter_mut().zip(earlier.counts.iter()) {
            *count = count.saturating_sub(*before);
        }
        let sum = self.sum.saturating_sub(earlier.sum);
        let (least, largest) = self.range.unwrap_or_default();
        let before = earlier.range;
        let is_new_largest = before.is_none_or(|(_, before)| largest > before);
        let is_new_least = before.is_none_or(|(before, _)| least < before);
        let mut since = Self::of(counts, sum, (least, largest));
        // A sum that saturated or wrapped to zero narrows nothing.
        if earlier.sum <= self.sum && self.sum < u64::MAX {
            since.narrow(!is_new_least, !is_new_largest);
        }
        since
    }

    /// Continues the counts of `earlier`, the state of the same handle in the previous report. The
    /// kernel's counts of 32 bits wrap to zero.
    pub fn continue_from(&mut self, earlier: &Self) {
        let mut is_wrapped = false;
        for (count, before) in self.counts.iter_mut().zip(earlier.counts.iter()) {
            let added = (*count % COUNT_WRAP + COUNT_WRAP - before % COUNT_WRAP) % COUNT_WRAP;
            // A larger difference means another object at the same address.
            if *count < *before && added < COUNT_WRAP / 2 {
                *count = before.saturating_add(added);
                is_wrapped = true;
            }
        }
        if is_wrapped && let Some((least, largest)) = earlier.range {
            let range = self.range.unwrap_or((least, largest));
            let range = (range.0.min(least), range.1.max(largest));
            // An extreme of `earlier` may lie in a bucket that is empty now.
            self.range = Self::of(self.counts.clone(), self.sum, range).range;
        }
    }

    /// Adds all durations of another distribution.
    pub fn merge(&mut self, other: &Self) {
        let Some((least, largest)) = other.range else {
            return;
        };
        for (count, more) in self.counts.iter_mut().zip(other.counts.iter()) {
            *count = count.saturating_add(*more);
        }
        self.sum = self.sum.saturating_add(other.sum);
        let range = self.range.unwrap_or((least, largest));
        self.range = Some((range.0.min(least), range.1.max(largest)));
    }

    /// Returns the number of durations in the buckets below that of `nanoseconds`. The number is
    /// exact if `nanoseconds` is the start of a bucket.
    #[must_use]
    pub fn up_to(&self, nanoseconds: u64) -> u64 {
        let below = self.counts.iter().take(bucket(nanoseconds));
        below.copied().fold(0, u64::saturating_add)
    }

    /// Returns the number of durations in the buckets above that of `limit`. All of them exceed it.
    #[must_use]
    pub fn above(&self, limit: Duration) -> u64 {
        let nanoseconds = u64::try_from(limit.as_nanos()).unwrap_or(u64::MAX);
        let above = self.counts.iter().skip(bucket(nanoseconds) + 1);
        above.copied().fold(0, u64::saturating_add)
    }

    /// Returns the sum of the durations, each cut to `limit`. It is exact if none is longer.
    #[must_use]
    pub fn sum_within(&self, limit: Duration) -> Duration {
        let limit = u64::try_from(limit.as_nanos()).unwrap_or(u64::MAX);
        let Some((least, largest)) = self.range.filter(|(_, largest)| *largest > limit) else {
            return self.sum();
        };
        let mut sum = 0_u64;
        for Filled { start, end, count } in self.filled() {
            let (start, end) = (start.max(least), end.min(largest));
            let middle = start + end.saturating_sub(start) / 2;
            sum = sum.saturating_add(middle.min(limit).saturating_mul(count));
        }
        Duration::from_nanos(sum.min(self.sum))
    }

    /// Returns the durations in the buckets of the metrics. A bucket that straddles a bound counts
    /// above it, so that no duration appears shorter than it is.
    #[must_use]
    #[expect(
        clippy::cast_possible_truncation,
        clippy::cast_sign_loss,
        reason = "the bounds are between 100 microseconds and 10 seconds"
    )]
    pub fn histogram(&self) -> Histogram {
        let up_to = |seconds: f64| self.up_to((seconds * 1e9) as u64);
        let range = self.range().unwrap_or_default();
        let range = (range.0.as_secs_f64(), range.1.as_secs_f64());
        Histogram::of(up_to, self.count(), self.sum().as_secs_f64(), range)
    }

    /// Creates a distribution whose range and sum are corrected to what the counts allow.
    fn of(counts: Box<[u64; BUCKETS]>, sum: u64, (minimum, maximum): (u64, u64)) -> Self {
        let mut durations = Self {
            counts,
            sum,
            range: None,
        };
        durations.range = durations.ends().map(|(lowest, highest)| {
            let maximum = maximum.max(highest.start).min(highest.end);
            let minimum = minimum.max(lowest.start).min(lowest.end);
            (minimum.min(maximum), maximum)
        });
        let (low, high) = durations.sums();
        durations.sum = sum.max(low).min(high);
        durations
    }

    /// Narrows the inexact ends of the range by the sum of all durations.
    fn narrow(&mut self, is_least_open: bool, is_largest_open: bool) {
        let (Some((least, largest)), Some((lowest, highest))) = (self.range, self.ends()) else {
            return;
        };
        let (mut least, mut largest) = (least, largest);
        if is_largest_open {
            // The bound assumes that all other durations are as short as possible.
            let start = highest.start.max(least);
            let others = self.sums().0.saturating_sub(start);
            largest = largest.min(self.sum.saturating_sub(others).max(start));
        }
        if is_least_open {
            // The bound assumes that all other durations are as long as possible.
            let others = (self.count() - 1).saturating_mul(largest);
            let shortest = self.sum.saturating_sub(others).min(lowest.end);
            least = least.max(shortest);
        }
        self.range = Some((least.min(largest), largest));
    }

    /// Returns the smallest and the largest sum that counts and range allow.
    fn sums(&self) -> (u64, u64) {
        let Some((least, largest)) = self.range else {
            return (0, 0);
        };
        let (mut low, mut high) = (0_u64, 0_u64);
        for Filled { start, end, count } in self.filled() {
            low = low.saturating_add(start.max(least).saturating_mul(count));
            high = high.saturating_add(end.min(largest).saturating_mul(count));
        }
        (low, high)
    }

    /// Returns the buckets in use, in ascending order.
    fn filled(&self) -> impl DoubleEndedIterator<Item = Filled> + '_ {
        let bounds = |index: usize| match index + 1 {
            BUCKETS => (bucket_start(index), u64::MAX),
            next => (bucket_start(index), bucket_start(next) - 1),
        };
        let filled = self.counts.iter().enumerate();
        filled
            .filter(|(_, count)| **count > 0)
            .map(move |(index, count)| {
                let (start, end) = bounds(index);
                let count = *count;
                Filled { start, end, count }
            })
    }

    /// Returns the lowest and the highest bucket in use.
    fn ends(&self) -> Option<(Filled, Filled)> {
        Some((self.filled().next()?, self.filled().next_back()?))
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    const PARTS: [f64; 7] = [-1.0, 0.0, 0.01, 0.5, 0.99, 1.0, f64::NAN];

    fn of(nanoseconds: &[u64]) -> Durations {
        let mut durations = Durations::default();
        for each in nanoseconds {
            durations.observe(Duration::from_nanos(*each));
        }
        durations
    }

    /// Durations of any magnitude: each number of bits is as likely as any other.
    fn any_duration() -> impl Strategy<Value = u64> {
        (0_u32..=64, any::<u64>()).prop_map(|(bits, any)| any.checked_shr(bits).unwrap_or(0))
    }

    /// Fails if a quantile lies outside the range or its own bucket, or decreases.
    fn check(durations: &Durations) {
        let Some((least, largest)) = durations.range() else {
            assert_eq!((durations.count(), durations.quantile(0.5)), (0, None));
            return;
        };
        assert!(least <= largest && durations.count() > 0, "{durations:?}");
        let (lowest, highest) = durations.ends().unwrap();
        let nanoseconds = |duration: Duration| u64::try_from(duration.as_nanos()).unwrap();
        assert!((lowest.start..=lowest.end).contains(&nanoseconds(least)));
        assert!((highest.start..=highest.end).contains(&nanoseconds(largest)));
        let mut before = least;
        for part in PARTS {
            let value = durations.quantile(part).unwrap();
            assert!((before..=largest).contains(&value), "{part}: {durations:?}");
            before = value;
        }
        assert_eq!(durations.quantile(1.0), Some(largest));
        let _ = durations.histogram();
    }

    #[test]
    fn quantiles_differ_from_exact_values_by_at_most_a_quarter() {
        let mut durations = Durations::default();
        for microseconds in 1..=1000 {
            durations.observe(Duration::from_micros(microseconds));
        }
        assert_eq!(durations.count(), 1000);
        for part in [0.5, 0.9, 0.99] {
            let truth = 0.001 * part;
            let found = durations.quantile(part).unwrap().as_secs_f64();
            assert!((found / truth - 1.0).abs() < 0.2, "{part}: {found}");
        }
        assert_eq!(durations.quantile(1.0), Some(Duration::from_millis(1)));
        assert_eq!(Durations::default().quantile(0.5), None);
    }

    #[test]
    fn since_returns_the_difference_and_merge_the_sum() {
        let mut durations = Durations::default();
        durations.observe(Duration::from_millis(1));
        let earlier = durations.clone();
        durations.observe(Duration::from_millis(200));
        let since = durations.since(&earlier);
        let expected = of(&[200_000_000]);
        assert_eq!(since, expected);
        let mut both = earlier;
        both.merge(&since);
        assert_eq!(both, durations);
        assert_eq!(both.up_to(bucket_start(50)), 1);
        assert_eq!(both.above(Duration::from_millis(1)), 1);
    }

    #[test]
    fn intervals_longer_than_17_s_have_quantiles() {
        const SECOND: u64 = 1_000_000_000;
        let earlier = of(&[40 * SECOND]);
        let mut durations = earlier.clone();
        durations.observe(Duration::from_secs(41));
        let since = durations.since(&earlier);
        assert_eq!(since.quantile(0.5), Some(Duration::from_secs(41)));
        // For several durations, only the start of the last bucket and the largest duration are
        // known.
        let hour = of(&[20 * SECOND, 25 * SECOND, 3_600 * SECOND]);
        let median = hour.quantile(0.5).unwrap();
        let bounds = Duration::from_secs(15)..=Duration::from_secs(3_600);
        assert!(bounds.contains(&median), "{median:?}");
        let range = (Duration::from_secs(20), Duration::from_secs(3_600));
        assert_eq!(hour.range(), Some(range));
    }

    #[test]
    fn shorter_calls_after_a_long_one_do_not_get_its_duration() {
        let mut durations = of(&[3_600_000_000_000, 1_000_000]);
        let earlier = durations.clone();
        durations.observe(Duration::from_secs(20));
        durations.observe(Duration::from_secs(30));
        let since = durations.since(&earlier);
        // 50 s in two calls of at least 15 s: neither took longer than 35 s.
        let (least, largest) = since.range().unwrap();
        let bounds = Duration::from_secs(30)..=Duration::from_secs(35);
        assert!(bounds.contains(&largest), "{largest:?}");
        assert!(least <= Duration::from_secs(20), "{least:?}");
    }

    #[test]
    fn a_call_longer_than_the_window_counts_as_one_whole_window() {
        let window = Duration::from_secs(10);
        let durations = of(&[3_600_000_000_000]);
        assert_eq!(durations.sum_within(window), window);
        let busy = of(&[4_000_000; 20]).sum_within(window);
        assert_eq!(busy, Duration::from_millis(80));
    }

    #[test]
    fn kernel_counts_that_wrap_to_zero_continue() {
        let mut counts = [0; BUCKETS];
        let index = bucket(1_000_000);
        counts[index] = u32::MAX - 1;
        let earlier = Durations::new(&counts, 1 << 52, 1_000_000, 1_000_000);
        counts[index] = 3;
        let mut now = Durations::new(&counts, (1 << 52) + 5_000_000, 1_000_000, 1_000_000);
        now.continue_from(&earlier);
        let since = now.since(&earlier);
        assert_eq!((since.count(), since.sum()), (5, Duration::from_millis(5)));
        // Another object at the same address has smaller counts, too.
        let mut fresh = of(&[1_000_000]);
        fresh.continue_from(&of(&[1_000_000; 9]));
        assert_eq!(fresh.count(), 1);
    }

    #[test]
    fn a_range_continued_from_a_wrapped_report_stays_within_the_buckets_in_use() {
        let counts = |bucket: usize, count: u32| {
            let mut counts = [0_u32; BUCKETS];
            counts[bucket] = count;
            counts
        };
        let mut wrapped = counts(5, u32::MAX);
        wrapped[90] = 1;
        let earlier = Durations::new(&wrapped, u64::MAX, 1, u64::MAX);
        let mut now = Durations::new(&counts(5, 3), 1, 1, 1);
        now.continue_from(&earlier);
        check(&now);
    }

    proptest! {
        #[test]
        fn any_durations_have_quantiles_within_their_range(
            first in prop::collection::vec(any_duration(), 0..20),
            then in prop::collection::vec(any_duration(), 0..20),
        ) {
            let mut durations = of(&first);
            check(&durations);
            let earlier = durations.clone();
            durations.merge(&of(&then));
            check(&durations);
            let since = durations.since(&earlier);
            check(&since);
            check(&earlier.since(&durations));
            prop_assert_eq!(since.count(), then.len() as u64);
            if let (Some(least), Some(largest)) = (then.iter().min(), then.iter().max()) {
                let truth = (Duration::from_nanos(*least), Duration::from_nanos(*largest));
                let found = since.range().unwrap();
                prop_assert!(found.0 <= truth.0 && truth.1 <= found.1, "{:?} {:?}", found, truth);
                if then.len() == 1 && durations.sum < u64::MAX {
                    prop_assert_eq!(found, truth);
                }
            }
        }

        /// The kernel's figures are read while other threads change them.
        #[test]
        fn inconsistent_figures_of_the_kernel_still_yield_quantiles(
            counts in prop::collection::vec(prop_oneof![3 => Just(0_u32), 1 => any::<u32>()], BUCKETS),
            later in prop::collection::vec(prop_oneof![3 => Just(0_u32), 1 => any::<u32>()], BUCKETS),
            sums in any::<[u64; 2]>(),
            minima in any::<[u64; 2]>(),
            maxima in any::<[u64; 2]>(),
        ) {
            let kernel = |counts: &[u32], of: usize| {
                let counts = counts.try_into().unwrap();
                Durations::new(&counts, sums[of], minima[of], maxima[of])
            };
            let (earlier, mut now) = (kernel(&counts, 0), kernel(&later, 1));
            check(&earlier);
            check(&now);
            check(&now.since(&earlier));
            now.continue_from(&earlier);
            let _ = now.quantile(0.99);
            check(&now.since(&earlier));
            let mut both = now.clone();
            both.merge(&earlier);
            let _ = (both.quantile(0.5), both.sum_within(Duration::from_secs(10)));
        }
    }
}
