//! How many bytes may be captured for messages that no client requests yet.

use ros2probe_wire::time::SECOND;

use crate::facts::model_time::ModelTime;
/// Counts for a datagram besides its payload, so that small ones are not free.
const OVERHEAD: usize = 64;

/// Bytes that may be captured: at once as many as `most`, and in the long run `rate` a second.
#[derive(Clone, Copy, Debug)]
pub(super) struct Allowance {
    most: u64,
    rate: u64,
    left: u64,
    /// Time for which the rate is included in `left`.
    at: ModelTime,
}

impl Allowance {
    /// Creates a full allowance.
    pub(super) const fn new(most: u64, rate: u64) -> Self {
        Self {
            most,
            rate,
            left: most,
            at: ModelTime::ZERO,
        }
    }

    /// Returns what is left at `now`.
    pub(super) fn left(&mut self, now: ModelTime) -> u64 {
        let elapsed = now - self.at;
        // A remainder below one byte waits for the next call.
        let elapsed = u64::try_from(elapsed.as_nanos()).unwrap_or(u64::MAX);
        let more = u128::from(elapsed) * u128::from(self.rate) / u128::from(SECOND);
        if more > 0 {
            let more = u64::try_from(more).unwrap_or(u64::MAX);
            self.left = self.left.saturating_add(more).min(self.most);
            self.at = self.at.max(now);
        }
        self.left
    }

    /// Takes a datagram with this payload. Returns whether the allowance covers it.
    pub(super) fn spend(&mut self, payload: usize, now: ModelTime) -> bool {
        let cost = u64::try_from(payload.saturating_add(OVERHEAD)).unwrap_or(u64::MAX);
        let left = self.left(now).checked_sub(cost);
        self.left = left.unwrap_or(0);
        left.is_some()
    }

    /// Takes all that is left.
    pub(super) const fn exhaust(&mut self) {
        self.left = 0;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_burst_is_covered_and_then_the_rate() {
        let mut allowance = Allowance::new(1_000, 100);
        let seconds = |seconds: u64| ModelTime::from_nanoseconds((1_000 + seconds) * SECOND);
        assert!((0..5).all(|_| allowance.spend(136, seconds(0))));
        assert!(!allowance.spend(136, seconds(0)));
        assert_eq!(allowance.left(seconds(3)), 300);
        // Time does not go back.
        assert_eq!(allowance.left(seconds(1)), 300);
        assert_eq!(allowance.left(seconds(3)), 300);
        assert_eq!(allowance.left(seconds(900)), 1_000);
    }
}
