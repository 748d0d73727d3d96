//! Durations of calls or goals: all in a histogram, the latest ones exactly.

use std::collections::VecDeque;
use std::time::Duration;

use crate::facts::bounded::Bounded;
use crate::facts::histogram::Histogram;
use crate::facts::tables::RecentDurations;

/// Durations of one service or action.
#[derive(Debug, Default)]
pub struct Latencies {
    all: Histogram,
    /// The latest durations in nanoseconds.
    recent: Bounded<RecentDurations, VecDeque<u64>>,
}

/// Durations as a snapshot shows them.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct LatencyFacts {
    /// All durations.
    pub histogram: Histogram,
    /// Median of the latest 1024 durations, in seconds; `None` before the first.
    pub p50: Option<f64>,
    /// 99th percentile of the same durations, in seconds.
    pub p99: Option<f64>,
}

impl Latencies {
    /// Adds a duration.
    pub fn observe(&mut self, duration: Duration) {
        self.all.observe(duration.as_secs_f64());
        let nanoseconds = u64::try_from(duration.as_nanos()).unwrap_or(u64::MAX);
        self.recent.push_back(nanoseconds);
    }

    /// Returns the histogram and the quantiles.
    #[must_use]
    pub fn facts(&self) -> LatencyFacts {
        let mut recent: Vec<_> = self.recent.iter().copied().collect();
        LatencyFacts {
            histogram: self.all,
            p50: quantile(&mut recent, 50),
            p99: quantile(&mut recent, 99),
        }
    }
}

/// Returns the value with this rank in percent (nearest rank), in seconds.
fn quantile(values: &mut [u64], percent: usize) -> Option<f64> {
    let rank = (values.len() * percent).div_ceil(100).max(1) - 1;
    if rank >= values.len() {
        return None;
    }
    let (_, value, _) = values.select_nth_unstable(rank);
    Some(Duration::from_nanos(*value).as_secs_f64())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn quantiles_are_exact_values_by_nearest_rank() {
        let mut latencies = Latencies::default();
        assert_eq!(latencies.facts(), LatencyFacts::default());
        for milliseconds in (1..=100).rev() {
            latencies.observe(Duration::from_millis(milliseconds));
        }
        let facts = latencies.facts();
        assert_eq!((facts.p50, facts.p99), (Some(0.050), Some(0.099)));
        assert_eq!(facts.histogram.count(), 100);
    }

    #[test]
    fn only_the_latest_durations_are_kept_for_quantiles() {
        let mut latencies = Latencies::default();
        for number in 0..10 * RecentDurations::CAP as u64 {
            let milliseconds = if number < 9 * RecentDurations::CAP as u64 {
                1
            } else {
                7
            };
            latencies.observe(Duration::from_millis(milliseconds));
        }
        let facts = latencies.facts();
        assert_eq!((facts.p50, facts.p99), (Some(0.007), Some(0.007)));
        assert_eq!(facts.histogram.count(), 10 * RecentDurations::CAP as u64);
        assert!(latencies.recent.is_full());
    }
}
