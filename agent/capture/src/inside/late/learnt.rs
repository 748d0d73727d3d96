//! Bounds that are learnt from the calls of the last minutes.

use std::time::Duration;

use ros2probe_wire::inside::{BUCKETS, bucket_start};

/// Minimum of a learnt bound.
pub const MIN_BOUND: Duration = Duration::from_millis(5);
/// Ratio of a learnt bound to the 99th percentile.
const BOUND_FACTOR: u64 = 3;
/// Minimum number of calls from which a bound is learnt, however rare they are.
const MIN_LEARNT_CALLS: u64 = 50;
/// Minimum weight of recent calls from which a bound changes: that of one call two minutes ago.
const MIN_RECENT_WEIGHT: f32 = 0.5;
/// Part of the calls so far that is forgotten in each round: a round is a second, so that the
/// bound describes the last minutes.
const DECAY: f32 = 1.0 / 180.0;

/// Part of a bound by which it rises in a round at most, as a divisor: it doubles in 70 s.
const RISE_DIVISOR: u64 = 100;

/// What is known about the durations of one callback.
pub(super) struct Learnt {
    /// Counts at the last round, as in `Figures::buckets`.
    known: [[u32; BUCKETS]; 2],
    /// Calls of the last minutes.
    recent: [[f32; BUCKETS]; 2],
    /// All calls so far.
    calls: [u64; 2],
    /// The learnt bounds.
    pub(super) learnt: Option<[u64; 2]>,
    /// The bounds that the programs have.
    pub(super) set: Option<[u64; 2]>,
}

impl Default for Learnt {
    fn default() -> Self {
        Self {
            known: [[0; BUCKETS]; 2],
            recent: [[0.0; BUCKETS]; 2],
            calls: [0; 2],
            learnt: None,
            set: None,
        }
    }
}

impl Learnt {
    /// Adds the calls since the last round, and learns the bounds. They rise slowly, so that a
    /// callback that becomes slow is late for minutes before that is usual.
    #[expect(clippy::cast_precision_loss, reason = "calls of a second are few")]
    pub(super) fn add(&mut self, counts: &[[u32; BUCKETS]; 2]) {
        let all = self.recent.iter_mut().zip(&mut self.known).zip(counts);
        for (((recent, known), counts), calls) in all.zip(&mut self.calls) {
            for ((recent, known), count) in recent.iter_mut().zip(known.iter_mut()).zip(counts) {
                // Smaller counts began anew.
                let new = count.checked_sub(*known).unwrap_or(*count);
                *recent = *recent * (1.0 - DECAY) + new as f32;
                *calls += u64::from(new);
                *known = *count;
            }
        }
        let Some(bounds) = self.bounds() else {
            return;
        };
        let [duration, delay] = bounds;
        let slowly = |known: u64, new: u64| new.min(known.saturating_add(known / RISE_DIVISOR));
        self.learnt = Some(match self.learnt {
            Some([known_duration, known_delay]) => {
                [slowly(known_duration, duration), slowly(known_delay, delay)]
            }
            None => bounds,
        });
    }

    /// Returns bounds of duration and delay for the calls of the last minutes, in nanoseconds;
    /// `None` before enough calls.
    fn bounds(&self) -> Option<[u64; 2]> {
        let [duration, delay] = &self.recent;
        let [durations, delays] = self.calls;
        let bound = |counts: &[f32; BUCKETS], calls: u64| {
            let least = u64::try_from(MIN_BOUND.as_nanos()).unwrap_or(u64::MAX);
            let p99 = (calls >= MIN_LEARNT_CALLS).then(|| p99(counts)).flatten()?;
            Some(p99.saturating_mul(BOUND_FACTOR).max(least))
        };
        // Some callbacks have no delay, for example those of services.
        let delay = bound(delay, delays).unwrap_or(u64::MAX);
        Some([bound(duration, durations)?, delay])
    }

    /// Returns whether bounds differ from those that the programs have: learnt ones by more than a
    /// step of the distribution.
    pub(super) fn differs(&self, bounds: Option<[u64; 2]>, is_requested: bool) -> bool {
        match (self.set, bounds) {
            (Some(set), Some(bounds)) if is_requested => set != bounds,
            (Some(set), Some(bounds)) => {
                let both = set.iter().zip(&bounds);
                both.clone()
                    .any(|(set, bound)| set.abs_diff(*bound) > set / 10)
            }
            (set, bounds) => set.is_some() != bounds.is_some(),
        }
    }
}

/// Returns the upper end of the bucket with the 99th percentile, in nanoseconds; `None` without
/// recent values.
fn p99(counts: &[f32; BUCKETS]) -> Option<u64> {
    let all: f32 = counts.iter().sum();
    if all < MIN_RECENT_WEIGHT {
        return None;
    }
    let mut below = 0.0;
    let index = counts.iter().position(|count| {
        below += count;
        below >= all * 0.99
    })?;
    Some(bucket_start(index + 1))
}

#[cfg(test)]
mod tests {
    use super::*;
    use ros2probe_wire::inside::bucket;

    fn counts(of: &[(u64, u32)]) -> [[u32; BUCKETS]; 2] {
        let mut counts = [[0; BUCKETS]; 2];
        for (milliseconds, calls) in of {
            counts[0][bucket(milliseconds * 1_000_000)] += calls;
        }
        counts
    }

    #[test]
    fn a_bound_is_three_times_the_99th_percentile() {
        let mut learnt = Learnt::default();
        learnt.add(&counts(&[(20, 49)]));
        assert_eq!(learnt.learnt, None, "too few calls");
        learnt.add(&counts(&[(20, 999), (500, 1)]));
        let [duration, delay] = learnt.learnt.unwrap();
        assert!((60_000_000..=84_000_000).contains(&duration), "{duration}");
        assert_eq!(delay, u64::MAX, "no call waited");
    }

    #[test]
    fn a_bound_of_rare_calls_is_learnt_from_50_of_them() {
        let mut learnt = Learnt::default();
        for second in 0..1000 {
            let calls = second / 20;
            learnt.add(&counts(&[(400, calls)]));
            assert_eq!(learnt.learnt.is_some(), calls >= 50, "{calls} calls");
        }
        learnt.add(&counts(&[(400, 50)]));
        let usual = learnt.learnt.unwrap();
        // Without calls, the bound stays.
        for _ in 0..100_000 {
            learnt.add(&counts(&[(400, 50)]));
        }
        assert_eq!(learnt.learnt, Some(usual));
    }

    #[test]
    fn a_bound_has_a_minimum() {
        let mut learnt = Learnt::default();
        learnt.add(&counts(&[(0, 1000)]));
        let [duration, _] = learnt.learnt.unwrap();
        assert_eq!(u128::from(duration), MIN_BOUND.as_nanos());
    }

    #[test]
    fn a_callback_that_becomes_slower_has_another_bound_within_minutes() {
        let mut learnt = Learnt::default();
        let mut calls = 0;
        for _ in 0..600 {
            calls += 10;
            learnt.add(&counts(&[(5, calls)]));
        }
        let usual = learnt.learnt.unwrap()[0];
        for round in 1..=600 {
            learnt.add(&counts(&[(5, calls), (50, round * 10)]));
            let [duration, _] = learnt.learnt.unwrap();
            match round {
                ..=60 => assert!(duration < usual * 2, "{duration} after {round} s"),
                300.. => assert!(duration >= 150_000_000, "{duration} after {round} s"),
                _ => {}
            }
        }
    }

    #[test]
    fn a_requested_bound_is_exact_and_a_learnt_one_changes_by_a_step() {
        let learnt = Learnt {
            set: Some([5_400_000; 2]),
            ..Learnt::default()
        };
        let new = Some([5_000_000; 2]);
        assert!(learnt.differs(new, true) && !learnt.differs(new, false));
        assert!(!learnt.differs(learnt.set, true));
        assert!(learnt.differs(None, false));
    }
}
