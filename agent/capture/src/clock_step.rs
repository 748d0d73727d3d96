//! Detects a step of the wall clock, or a suspended machine, by comparison with the monotonic
//! clock. This module reads no clock.

use super::system::Clocks;

/// Minimum change that counts as a step. Time daemons correct smaller differences gradually.
const STEP_NANOSECONDS: u64 = 100_000_000;
/// How long packets with an old timestamp may still arrive.
const LATE_NANOSECONDS: u64 = 1_000_000_000;

/// Difference between the wall clock and the monotonic clock.
#[derive(Clone, Copy, Debug)]
pub struct ClockStep {
    /// Nanoseconds by which the wall clock was ahead of the monotonic clock at the last update.
    ahead: i64,
    /// Time of the last step, and the sum of all steps at that time.
    noticed: Option<(u64, i64)>,
}

impl ClockStep {
    /// Starts with the current difference.
    #[must_use]
    pub const fn new(clocks: &Clocks) -> Self {
        Self {
            ahead: ahead(clocks),
            noticed: None,
        }
    }

    /// Returns the nanoseconds by which the wall clock was set forward since the last update; 0 =
    /// no step. Stores the step in `clocks` while old timestamps may still arrive.
    pub const fn update(&mut self, clocks: &mut Clocks) -> i64 {
        let before = match self.noticed {
            Some((at, steps)) if clocks.monotonic.saturating_sub(at) < LATE_NANOSECONDS => steps,
            _ => 0,
        };
        clocks.step = before;
        let ahead = ahead(clocks);
        let step = ahead.wrapping_sub(self.ahead);
        self.ahead = ahead;
        if step.unsigned_abs() < STEP_NANOSECONDS {
            return 0;
        }
        clocks.step = before.saturating_add(step);
        self.noticed = Some((clocks.monotonic, clocks.step));
        step
    }
}

const fn ahead(clocks: &Clocks) -> i64 {
    clocks.now.0.wrapping_sub(clocks.monotonic).cast_signed()
}

#[cfg(test)]
mod tests {
    use ros2probe_wire::Timestamp;

    use super::*;

    use ros2probe_wire::time::SECOND;
    const HOUR: i64 = 3600 * SECOND.cast_signed();
    const STARTED: u64 = 1_700_000_000 * SECOND;

    /// Returns clocks `monotonic` nanoseconds after the start, with the wall clock set forward by
    /// `step`.
    fn clocks(monotonic: u64, step: i64) -> Clocks {
        Clocks {
            now: Timestamp((STARTED + monotonic).saturating_add_signed(step)),
            monotonic,
            step: 0,
        }
    }

    #[test]
    fn a_step_is_reported_once_and_kept_for_a_second_and_slewing_is_not_a_step() {
        for step in [HOUR, -HOUR] {
            let mut set = ClockStep::new(&clocks(0, 0));
            // A time daemon corrects the clock by at most 500 parts in a million.
            let mut now = clocks(SECOND, 500_000);
            assert_eq!((set.update(&mut now), now.step), (0, 0));
            let mut now = clocks(SECOND + SECOND / 4, step);
            assert_eq!(set.update(&mut now), step - 500_000);
            assert_eq!(now.step, step - 500_000);
            let mut now = clocks(2 * SECOND, step);
            assert_eq!((set.update(&mut now), now.step), (0, step - 500_000));
            let mut now = clocks(3 * SECOND, step);
            assert_eq!((set.update(&mut now), now.step), (0, 0));
        }
    }

    #[test]
    fn timestamps_from_before_a_step_are_shifted_by_the_step() {
        for step in [HOUR, -HOUR] {
            let mut set = ClockStep::new(&clocks(0, 0));
            let mut now = clocks(5 * SECOND, step);
            set.update(&mut now);
            let half = Timestamp(now.now.0 - SECOND / 2);
            let before = clocks(4 * SECOND + SECOND / 2, 0).now;
            assert_eq!(now.stamped(before), half, "before the step");
            assert_eq!(now.stamped(half), half, "after it");
            assert_eq!(now.stamped(Timestamp(1)), now.now, "of neither clock");
        }
    }
}
