//! Durations of calls or goals: all in a histogram, the latest ones exactly.

use std::time::Duration;

use crate::histogram::Histogram;
use crate::size::Size;

/// Largest number of the latest durations from which quantiles are computed.
const RECENT: usize = 1024;

/// Durations of one service or action.
#[derive(Debug, Default)]
pub struct Latencies {
    all: Histogram,
    /// The latest durations in nanoseconds; a ring once it has [`RECENT`] entries.
    recent: Vec<u64>,
    next: usize,
}

/// Durations as a snapshot shows them.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct LatencyFacts {
    /// All durations.
    pub histogram: Histogram,
    /// Median of the latest 1024 durations, in seconds; `None` before the first.
    pub p50: Option<f64>,
    /// Duration below which 99 % of them lie, in seconds.
    pub p99: Option<f64>,
}

impl Latencies {
    /// Adds a duration.
    pub fn observe(&mut self, duration: Duration) {
        self.all.observe(duration.as_secs_f64());
        let nanoseconds = u64::try_from(duration.as_nanos()).unwrap_or(u64::MAX);
        if self.recent.len() < RECENT {
            self.recent.push(nanoseconds);
        } else if let Some(oldest) = self.recent.get_mut(self.next) {
            *oldest = nanoseconds;
            self.next = (self.next + 1) % RECENT;
        }
    }

    /// Returns the histogram and the quantiles.
    #[must_use]
    pub fn facts(&self) -> LatencyFacts {
        let mut recent = self.recent.clone();
        LatencyFacts {
            histogram: self.all,
            p50: quantile(&mut recent, 50),
            p99: quantile(&mut recent, 99),
        }
    }

    /// Returns the size and cap of the list.
    #[must_use]
    pub fn size(&self) -> Size {
        // The destructuring makes a new list fail to compile until it is listed here.
        let Self {
            all: _,
            recent,
            next: _,
        } = self;
        Size::new("services.recent", recent.len(), RECENT)
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
        for number in 0..10 * RECENT as u64 {
            let milliseconds = if number < 9 * RECENT as u64 { 1 } else { 7 };
            latencies.observe(Duration::from_millis(milliseconds));
        }
        let facts = latencies.facts();
        assert_eq!((facts.p50, facts.p99), (Some(0.007), Some(0.007)));
        assert_eq!(facts.histogram.count(), 10 * RECENT as u64);
        assert_eq!(latencies.size().entries, RECENT);
    }
}
