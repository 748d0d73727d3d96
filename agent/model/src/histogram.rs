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

    /// Creates a histogram from another kind of distribution: `up_to` returns the number of values
    /// of at most a bound, `range` the smallest and largest value in seconds.
    #[must_use]
    pub fn of(up_to: impl Fn(f64) -> u64, count: u64, sum: f64, range: (f64, f64)) -> Self {
        let mut histogram = Self {
            sum,
            minimum: range.0,
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

    /// Adds a value in seconds.
    pub fn observe(&mut self, seconds: f64) {
        if self.counts.iter().all(|count| *count == 0) {
            (self.minimum, self.maximum) = (seconds, seconds);
        }
        let bucket = self.bounds().partition_point(|bound| seconds > *bound);
        if let Some(count) = self.counts.get_mut(bucket) {
            *count += 1;
        }
        self.sum += seconds;
        self.minimum = self.minimum.min(seconds);
        self.maximum = self.maximum.max(seconds);
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

    /// Returns the values added since `earlier`, an older state of this histogram. Its range is
    /// unknown.
    #[must_use]
    pub fn since(&self, earlier: &Self) -> Self {
        let mut difference = *self;
        // The histogram was reset, so all values are new.
        if self.count() < earlier.count() {
            return difference;
        }
        for (count, before) in difference.counts.iter_mut().zip(earlier.counts) {
            *count = count.saturating_sub(before);
        }
        difference.sum -= earlier.sum;
        difference
    }

    /// Estimates the value below which this share of the values lies, as Prometheus does: values
    /// are spread evenly within a bucket. Returns `f64::MAX` if it lies above all bounds.
    #[must_use]
    #[expect(clippy::cast_precision_loss, reason = "counts far below 2^52")]
    pub fn quantile(&self, part: f64) -> f64 {
        let wanted = self.count() as f64 * part;
        let (mut lower, mut below) = (0.0, 0.0);
        for (upper, count) in self.buckets() {
            let count = count as f64;
            if count > 0.0 && below + count >= wanted {
                if upper.is_infinite() {
                    return f64::MAX;
                }
                return lower + (upper - lower) * (wanted - below) / count;
            }
            (lower, below) = (upper, below + count);
        }
        lower
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

    const fn bounds(&self) -> &'static [f64; 16] {
        if self.fine { &FINE_BOUNDS } else { &BOUNDS }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_bound_belongs_to_its_own_bucket() {
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
    fn fine_bounds_tell_microseconds_apart() {
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
    fn what_came_after_is_the_difference() {
        let mut histogram = Histogram::default();
        histogram.observe(0.0015);
        let earlier = histogram;
        for _ in 0..3 {
            histogram.observe(0.15);
        }
        let difference = histogram.since(&earlier);
        assert_eq!(difference.count(), 3);
        assert!(
            (0.1..=0.2).contains(&difference.quantile(0.5)),
            "{difference:?}"
        );
        assert_eq!(earlier.since(&histogram), earlier, "it began anew");
    }

    #[test]
    fn merging_adds_up() {
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
