//! CPU allowance for listing directories and opening ports.
//!
//! A process that constantly creates and deletes files makes the tap list directories without end.
//! Files that are not ports make it open files without end. Listing and opening wait when the
//! allowance is used up. This module reads no clock.

/// Maximum CPU time that is saved, in nanoseconds, so that a starting robot is found immediately.
pub const MAX_SAVINGS: u64 = 1_000_000_000;
/// Reciprocal of the share: 1 % of a CPU.
pub const SHARE_DIVISOR: u64 = 100;

/// CPU time left for listings.
#[derive(Debug)]
pub struct CpuAllowance {
    /// Nanoseconds left; negative after overspending.
    left: i64,
    /// Time when `left` was computed, on the monotonic clock.
    at: u64,
}

impl Default for CpuAllowance {
    fn default() -> Self {
        Self {
            left: MAX_SAVINGS.cast_signed(),
            at: 0,
        }
    }
}

impl CpuAllowance {
    /// Returns whether CPU time is left at `now`, in nanoseconds of the monotonic clock.
    pub fn has_time_left(&mut self, now: u64) -> bool {
        let gained = now.saturating_sub(self.at) / SHARE_DIVISOR;
        if gained > 0 {
            self.at = now;
            let left = self.left.saturating_add_unsigned(gained);
            self.left = left.min(MAX_SAVINGS.cast_signed());
        }
        self.left > 0
    }

    /// Charges this many nanoseconds of CPU time.
    pub const fn spend(&mut self, nanoseconds: u64) {
        self.left = self.left.saturating_sub_unsigned(nanoseconds);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    use ros2probe_wire::time::SECOND;

    #[test]
    fn constant_listing_uses_no_more_cpu_than_its_share() {
        for cost in [1_000, 3_000_000, 700_000_000] {
            let (mut allowance, mut now, mut spent) = (CpuAllowance::default(), SECOND, 0);
            while now < 101 * SECOND {
                if allowance.has_time_left(now) {
                    allowance.spend(cost);
                    spent += cost;
                }
                now += cost.min(1_000_000);
            }
            // The bound is the savings, the share of a hundred seconds, and one listing in
            // progress.
            let most = MAX_SAVINGS + 101 * SECOND / SHARE_DIVISOR + cost;
            assert!(spent <= most, "{cost}: {spent}");
            assert!(spent > SECOND / 2, "{cost}: {spent}");
        }
    }
}
