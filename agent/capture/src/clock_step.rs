//! Notices a step of the calendar's clock, or a suspended machine, by the clock
//! that goes on evenly. It reads no clock.

use super::system::Clocks;

/// Time servers correct less than this bit by bit.
const STEP_NANOSECONDS: u64 = 100_000_000;
/// For how long what bears an old time may still come.
const LATE_NANOSECONDS: u64 = 1_000_000_000;

/// How the calendar's clock stands against the even one.
#[derive(Clone, Copy, Debug)]
pub struct ClockStep {
    /// Nanoseconds that it was ahead at the last update.
    ahead: i64,
    /// When a step was noticed last, and all steps of that moment.
    noticed: Option<(u64, i64)>,
}

impl ClockStep {
    /// As it stands.
    #[must_use]
    pub const fn new(clocks: &Clocks) -> Self {
        Self {
            ahead: ahead(clocks),
            noticed: None,
        }
    }

    /// By how many nanoseconds the clock was set forward since the last update; 0 = it was not. Notes in
    /// the clocks that it was, for as long as that matters.
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

    /// So many nanoseconds after the start, with a calendar that has been set by `step` since.
    fn clocks(monotonic: u64, step: i64) -> Clocks {
        Clocks {
            now: Timestamp((STARTED + monotonic).saturating_add_signed(step)),
            monotonic,
            step: 0,
        }
    }

    #[test]
    fn a_step_is_noticed_once_and_remembered_for_a_second_and_slewing_is_none() {
        for step in [HOUR, -HOUR] {
            let mut set = ClockStep::new(&clocks(0, 0));
            // 500 parts in a million, as fast as a time server goes.
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
    fn what_came_before_the_step_is_taken_for_what_it_is() {
        for step in [HOUR, -HOUR] {
            let mut set = ClockStep::new(&clocks(0, 0));
            let mut now = clocks(5 * SECOND, step);
            set.update(&mut now);
            let half = Timestamp(now.now.0 - SECOND / 2);
            let before = clocks(4 * SECOND + SECOND / 2, 0).now;
            assert_eq!(now.stamped(before), half, "before the step");
            assert_eq!(now.stamped(half), half, "after it");
            assert_eq!(now.stamped(Timestamp(1)), now.now, "of neither calendar");
        }
    }
}
