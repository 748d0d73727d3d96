//! A histogram with fixed bounds: exact counts, a few hundred bytes, mergeable.

/// Upper bounds in seconds: 1-2-5 steps from 100 µs to 10 s. They fit the jitter of a 1 kHz
/// controller as well as a 0.1 Hz diagnostic.
pub const BOUNDS: [f64; 16] = [
    0.0001, 0.0002, 0.0005, 0.001, 0.002, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0,
    10.0,
];

/// Upper bounds for durations within one host: the same steps from 10 µs to 1 s.
pub const FINE_BOUNDS: [f64; 16] = [
    0.00001, 0.00002, 0.00005, 0.0001, 0.0002, 0.0005, 0.001, 0.002, 0.005, 0.01, 0.02, 0.05, 0.1,
    0.2, 0.5, 1.0,
];

/// Counts by [`BOUNDS`] or [`FINE_BOUNDS`], and one for values above the last bound.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Histogram {
    fine: bool,
    counts: [u64; BOUNDS.len() + 1],
    sum: f64,
    minimum: f64,
    maximum: f64,
}

impl Histogram {
    /// Creates an empty histogram with [`FINE_BOUNDS`].
    #[must_use]
    pub fn fine() -> Self {
        Self {
            fine: true,
            ..Self::default()
        }
    }

    /// Creates a histogram from another kind of distribution. `up_to` returns the number of values
    /// up to a bound. `range` is the smallest and largest value in seconds. Values just below a
    /// bound may be counted above it.
    #[must_use]
    pub fn of(up_to: impl Fn(f64) -> u64, count: u64, sum: f64, range: (f64, f64)) -> Self {
        let mut histogram = Self {
            sum,
            minimum: range.0.min(range.1),
            maximum: range.1,
            ..Self::default()
        };
        let bounds = BOUNDS.iter().map(|bound| up_to(*bound)).chain([count]);
        let mut below = 0;
        for (own, up_to) in histogram.counts.iter_mut().zip(bounds) {
            *own = up_to.saturating_sub(below);
            below = below.max(up_to);
        }
        histogram
    }

    /// Adds a value in seconds. A value that is not finite is ignored.
    pub fn observe(&mut self, seconds: f64) {
        let Some(bucket) = self.bucket(seconds) else {
            return;
        };
        if self.counts.iter().all(|count| *count == 0) {
            (self.minimum, self.maximum) = (seconds, seconds);
        }
        if let Some(count) = self.counts.get_mut(bucket) {
            *count += 1;
        }
        self.sum += seconds;
        self.minimum = self.minimum.min(seconds);
        self.maximum = self.maximum.max(seconds);
    }

    /// Returns the position of the bucket of this value; `None` if the value is not finite.
    #[must_use]
    pub fn bucket(&self, seconds: f64) -> Option<usize> {
        let bounds = self.bounds();
        seconds
            .is_finite()
            .then(|| bounds.partition_point(|bound| seconds > *bound))
    }

    /// Adds all values of `other`, which must have the same bounds.
    pub fn merge(&mut self, other: &Self) {
        if other.count() == 0 {
            return;
        }
        if self.count() == 0 {
            *self = *other;
            return;
        }
        for (count, more) in self.counts.iter_mut().zip(other.counts) {
            *count += more;
        }
        self.sum += other.sum;
        self.minimum = self.minimum.min(other.minimum);
        self.maximum = self.maximum.max(other.maximum);
    }

    /// Returns the values added since `earlier`, an older state of this histogram. The range of the
    /// result is as narrow as the two states allow. It is exact for a single value and for a new
    /// extreme.
    #[must_use]
    pub fn since(&self, earlier: &Self) -> Self {
        let mut difference = *self;
        // After a reset, all values are new.
        if self.count() < earlier.count() {
            return difference;
        }
        for (count, before) in difference.counts.iter_mut().zip(earlier.counts) {
            *count = count.saturating_sub(before);
        }
        difference.sum -= earlier.sum;
        let before = earlier.range();
        let is_least_open = before.is_some_and(|(least, _)| self.minimum >= least);
        let is_largest_open = before.is_some_and(|(_, largest)| self.maximum <= largest);
        difference.narrow(is_least_open, is_largest_open);
        difference
    }

    /// Estimates the quantile `part`, from 0 to 1. Values are assumed to be spread evenly within
    /// each bucket, limited to the range. Above the last bound, the estimate lies between that
    /// bound and the largest value. Returns `None` if the histogram is empty.
    #[must_use]
    #[expect(clippy::cast_precision_loss, reason = "counts far below 2^52")]
    pub fn quantile(&self, part: f64) -> Option<f64> {
        let (least, largest) = self.range()?;
        let wanted = self.count() as f64 * part;
        let (mut value, mut below) = (largest, 0.0);
        for (start, end, count) in self.filled() {
            let count = count as f64;
            if below + count >= wanted {
                let (start, end) = (start.max(least), end.min(largest));
                value = start + (end - start) * ((wanted - below).max(0.0) / count);
                break;
            }
            below += count;
        }
        Some(value.max(least).min(largest))
    }

    /// Returns the number of values.
    #[must_use]
    pub fn count(&self) -> u64 {
        self.counts.iter().sum()
    }

    /// Returns the sum of the values in seconds.
    #[must_use]
    pub const fn sum(&self) -> f64 {
        self.sum
    }

    /// Returns the smallest and largest value, or `None` if the histogram is empty.
    #[must_use]
    pub fn range(&self) -> Option<(f64, f64)> {
        (self.count() > 0).then_some((self.minimum, self.maximum))
    }

    /// Returns `(upper bound, values in this bucket)`, not cumulative; the last bound is infinite.
    pub fn buckets(&self) -> impl Iterator<Item = (f64, u64)> + '_ {
        self.bounds()
            .iter()
            .copied()
            .chain([f64::INFINITY])
            .zip(self.counts.iter().copied())
    }

    /// Moves the range into the buckets in use. Ends that are not exact are narrowed by the sum.
    #[expect(clippy::cast_precision_loss, reason = "counts far below 2^52")]
    fn narrow(&mut self, is_least_open: bool, is_largest_open: bool) {
        let mut filled = self.filled();
        let Some(lowest) = filled.next() else {
            return;
        };
        let highest = filled.last().unwrap_or(lowest);
        let mut least = self.minimum.max(lowest.0).min(lowest.1);
        let mut largest = self.maximum.max(highest.0).min(highest.1);
        if is_largest_open {
            // The bound assumes that all other values are as small as possible.
            let start = highest.0.max(least);
            let all = self
                .filled()
                .map(|(start, _, count)| start.max(least) * count as f64);
            let others = all.sum::<f64>() - start;
            largest = largest.min((self.sum - others).max(start));
        }
        if is_least_open {
            // The bound assumes that all other values are as large as possible.
            let others = (self.count() - 1) as f64 * largest;
            least = least.max((self.sum - others).min(lowest.1));
        }
        (self.minimum, self.maximum) = (least.min(largest), largest);
    }

    /// Returns the start, the end and the count of each bucket in use.
    fn filled(&self) -> impl Iterator<Item = (f64, f64, u64)> + '_ {
        let starts = [f64::NEG_INFINITY]
            .into_iter()
            .chain(self.bounds().iter().copied());
        let buckets = starts.zip(self.buckets());
        let all = buckets.map(|(start, (end, count))| (start, end, count));
        all.filter(|(_, _, count)| *count > 0)
    }

    const fn bounds(&self) -> &'static [f64; 16] {
        if self.fine { &FINE_BOUNDS } else { &BOUNDS }
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn of(values: &[f64], is_fine: bool) -> Histogram {
        let mut histogram = match is_fine {
            true => Histogram::fine(),
            false => Histogram::default(),
        };
        values.iter().for_each(|value| histogram.observe(*value));
        histogram
    }

    /// Fails if a quantile lies outside the range, or decreases.
    fn check(histogram: &Histogram) {
        let Some((least, largest)) = histogram.range() else {
            assert_eq!((histogram.count(), histogram.quantile(0.5)), (0, None));
            return;
        };
        assert!(least <= largest, "{histogram:?}");
        let mut before = least;
        for part in [-1.0, 0.0, 0.01, 0.5, 0.99, 1.0, f64::NAN] {
            let value = histogram.quantile(part).unwrap();
            assert!((before..=largest).contains(&value), "{part}: {histogram:?}");
            before = value;
        }
    }

    /// Seconds of any magnitude, and values such as NaN that no clock shows.
    fn any_seconds() -> impl Strategy<Value = f64> {
        let usual = (-9.0..9.0_f64).prop_map(|power| 10_f64.powf(power));
        prop_oneof![6 => usual, 1 => any::<f64>(), 1 => Just(f64::NAN), 1 => Just(f64::INFINITY)]
    }

    proptest! {
        #[test]
        fn any_values_have_quantiles_within_their_range(
            first in prop::collection::vec(any_seconds(), 0..20),
            then in prop::collection::vec(any_seconds(), 0..20),
            is_fine: bool,
        ) {
            let earlier = of(&first, is_fine);
            check(&earlier);
            let mut both = earlier;
            both.merge(&of(&then, is_fine));
            check(&both);
            check(&both.since(&earlier));
            check(&earlier.since(&both));
            let finite = then.iter().filter(|value| value.is_finite()).count();
            prop_assert_eq!(both.since(&earlier).count(), finite as u64);
        }

        #[test]
        fn the_range_of_a_histogram_difference_contains_all_values(
            first in prop::collection::vec(0.0..100.0_f64, 0..20),
            then in prop::collection::vec(0.0..100.0_f64, 1..20),
        ) {
            let earlier = of(&first, false);
            let mut both = earlier;
            both.merge(&of(&then, false));
            let (least, largest) = both.since(&earlier).range().unwrap();
            let noise = 1e-9;
            for value in then {
                prop_assert!(least - noise <= value && value <= largest + noise, "{value}");
            }
        }
    }

    #[test]
    fn values_above_the_last_bound_have_quantiles_up_to_the_largest() {
        let slow = of(&[40.0; 9], false);
        assert_eq!(slow.quantile(0.5), Some(40.0));
        let mixed = of(&[20.0, 30.0, 90_000.0], false);
        let median = mixed.quantile(0.5).unwrap();
        assert!((10.0..=90_000.0).contains(&median), "{median}");
        assert_eq!(mixed.quantile(1.0), Some(90_000.0));
        // One more interval is known exactly, although a longer one came before.
        let mut later = mixed;
        later.observe(41.0);
        let since = later.since(&mixed);
        assert!(
            (since.quantile(0.99).unwrap() - 41.0).abs() < 1e-6,
            "{since:?}"
        );
    }

    #[test]
    fn a_value_equal_to_a_bound_counts_below_it() {
        let mut histogram = Histogram::default();
        histogram.observe(0.001);
        histogram.observe(0.0011);
        histogram.observe(99.0);
        let filled: Vec<_> = histogram
            .buckets()
            .filter(|(_, count)| *count > 0)
            .collect();
        assert_eq!(filled, [(0.001, 1), (0.002, 1), (f64::INFINITY, 1)]);
        assert_eq!(histogram.range(), Some((0.001, 99.0)));
    }

    #[test]
    fn fine_bounds_distinguish_microseconds() {
        let mut histogram = Histogram::fine();
        histogram.observe(0.000_011);
        histogram.observe(0.000_021);
        let filled: Vec<_> = histogram
            .buckets()
            .filter(|(_, count)| *count > 0)
            .collect();
        assert_eq!(filled, [(0.000_02, 1), (0.000_05, 1)]);
        assert!(FINE_BOUNDS.is_sorted() && BOUNDS.is_sorted());
    }

    #[test]
    fn since_returns_only_values_added_later() {
        let mut histogram = Histogram::default();
        histogram.observe(0.0015);
        let earlier = histogram;
        for _ in 0..3 {
            histogram.observe(0.15);
        }
        let difference = histogram.since(&earlier);
        assert_eq!(difference.count(), 3);
        assert!(
            (0.1..=0.2).contains(&difference.quantile(0.5).unwrap()),
            "{difference:?}"
        );
        assert_eq!(earlier.since(&histogram), earlier, "it began anew");
    }

    #[test]
    fn a_merge_adds_counts_and_sums_and_widens_the_range() {
        let (mut one, mut two) = (Histogram::default(), Histogram::default());
        one.observe(0.01);
        two.observe(3.0);
        one.merge(&two);
        assert_eq!(
            (one.count(), one.sum(), one.range()),
            (2, 3.01, Some((0.01, 3.0)))
        );
    }
}
