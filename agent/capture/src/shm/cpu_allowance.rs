//! What listing directories and opening ports may cost.
//!
//! Who creates and deletes files all the time makes the tap list without end, and who leaves files
//! that are no ports makes it open them without end. Both wait when their share of a CPU is used up.
//! Knows no clock but what it is told.

/// CPU nanoseconds that may be saved, so that a robot that starts is met at once.
pub const SAVINGS: u64 = 1_000_000_000;
/// One of so many nanoseconds may be spent.
pub const SHARE: u64 = 100;

/// CPU time for listings that is left.
#[derive(Debug)]
pub struct CpuAllowance {
    /// Nanoseconds; below zero what was spent too much.
    left: i64,
    /// When that was so, on the monotonic clock.
    at: u64,
}

impl Default for CpuAllowance {
    fn default() -> Self {
        Self {
            left: SAVINGS.cast_signed(),
            at: 0,
        }
    }
}

impl CpuAllowance {
    /// Whether anything is left at `now`, in nanoseconds of the monotonic clock.
    pub fn is_left(&mut self, now: u64) -> bool {
        let gained = now.saturating_sub(self.at) / SHARE;
        if gained > 0 {
            self.at = now;
            let left = self.left.saturating_add_unsigned(gained);
            self.left = left.min(SAVINGS.cast_signed());
        }
        self.left > 0
    }

    /// So many nanoseconds of CPU time were used.
    pub const fn spend(&mut self, nanoseconds: u64) {
        self.left = self.left.saturating_sub_unsigned(nanoseconds);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    use ros2probe_wire::time::SECOND;

    #[test]
    fn listings_that_are_always_wanted_cost_no_more_than_their_share() {
        for cost in [1_000, 3_000_000, 700_000_000] {
            let (mut allowance, mut now, mut spent) = (CpuAllowance::default(), SECOND, 0);
            while now < 101 * SECOND {
                if allowance.is_left(now) {
                    allowance.spend(cost);
                    spent += cost;
                }
                now += cost.min(1_000_000);
            }
            // What was saved, the share of a hundred seconds, and one that was begun.
            let most = SAVINGS + 101 * SECOND / SHARE + cost;
            assert!(spent <= most, "{cost}: {spent}");
            assert!(spent > SECOND / 2, "{cost}: {spent}");
        }
    }
}
