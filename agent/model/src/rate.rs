//! Counts of the last seconds, for displayed rates and for expectations.
//!
//! Only whole seconds contribute to a rate, so a periodic topic neither flickers nor reads high at
//! its start. Exact counters are elsewhere; this module forgets after [`SECONDS`].

use ros2probe_wire::Timestamp;

/// Length of the window in seconds, one slot each.
pub const SECONDS: u64 = 10;
const SLOTS: usize = SECONDS as usize + 1;

/// Counts by whole second.
#[derive(Clone, Debug, Default)]
pub struct Window {
    /// The second that is being counted.
    second: u64,
    /// The second in which counting began.
    began: u64,
    slots: [Slot; SLOTS],
}

/// Counts of one or several seconds.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Slot {
    /// Messages.
    pub messages: u64,
    /// Payload bytes.
    pub bytes: u64,
    /// Samples settled as lost.
    pub lost: u64,
    /// Samples with a source latency.
    pub delayed: u64,
    /// Sum of their latencies in seconds.
    pub delay: f64,
}

impl Slot {
    /// Adds all of `other`.
    pub fn add(&mut self, other: &Self) {
        self.messages += other.messages;
        self.bytes += other.bytes;
        self.lost += other.lost;
        self.delayed += other.delayed;
        self.delay += other.delay;
    }
}

impl Window {
    /// Returns the counts of the second that contains `now`.
    pub fn current(&mut self, now: Timestamp) -> &mut Slot {
        self.turn(now);
        let slot = usize::try_from(self.second % SLOTS as u64).unwrap_or(0);
        // The modulus keeps the index in range; the alternative only satisfies the compiler.
        let slot = if slot < SLOTS { slot } else { 0 };
        #[expect(clippy::indexing_slicing, reason = "slot < SLOTS was just established")]
        &mut self.slots[slot]
    }

    /// Returns the sum over the last `seconds` whole seconds, and their number, which is lower if
    /// counting began later.
    #[must_use]
    pub fn sum(&self, now: Timestamp, seconds: u64) -> (Slot, u64) {
        let current = now.whole_seconds();
        let end = current.max(self.second);
        let start = end.saturating_sub(seconds.min(SECONDS));
        // The second in which counting began is incomplete.
        let start = if self.began == 0 {
            end
        } else {
            start.max(self.began + 1).min(end)
        };
        let mut sum = Slot::default();
        for second in start..end {
            // The slots contain the seconds `self.second - SECONDS ..= self.second`.
            if second <= self.second && second + SECONDS >= self.second {
                let slot = usize::try_from(second % SLOTS as u64).unwrap_or(0);
                if let Some(slot) = self.slots.get(slot) {
                    sum.add(slot);
                }
            }
        }
        (sum, end - start)
    }

    /// Clears the slots of seconds without counts.
    fn turn(&mut self, now: Timestamp) {
        let second = now.whole_seconds();
        if self.began == 0 {
            (self.began, self.second) = (second, second);
        }
        if second <= self.second {
            return;
        }
        for passed in (self.second + 1..=second).take(SLOTS) {
            let last = second - (passed - self.second - 1);
            let slot = usize::try_from(last % SLOTS as u64).unwrap_or(0);
            if let Some(slot) = self.slots.get_mut(slot) {
                *slot = Slot::default();
            }
        }
        self.second = second;
    }
}

#[cfg(test)]
mod tests {
    use ros2probe_wire::time::SECOND;

    use super::*;

    fn fill(window: &mut Window, start_ms: u64, step_ms: u64, count: u64) -> Timestamp {
        let mut at = start_ms;
        for _ in 0..count {
            let slot = window.current(Timestamp(at * 1_000_000));
            slot.messages += 1;
            slot.bytes += 100;
            at += step_ms;
        }
        Timestamp(at * 1_000_000)
    }

    #[test]
    fn a_steady_topic_reads_its_rate_from_the_second_second_on() {
        let mut window = Window::default();
        let now = fill(&mut window, 100_300, 5, 400);
        let (sum, seconds) = window.sum(now, SECONDS);
        assert_eq!((sum.messages, sum.bytes, seconds), (200, 20_000, 1));
    }

    #[test]
    fn bandwidth_is_not_five_percent_high_in_a_small_window() {
        let mut window = Window::default();
        let now = fill(&mut window, 100_001, 50, 20 * 12);
        let (sum, seconds) = window.sum(now, 1);
        assert_eq!((sum.messages, seconds), (20, 1));
    }

    #[test]
    fn silence_empties_the_window() {
        let mut window = Window::default();
        let now = fill(&mut window, 100_000, 10, 1000);
        let later = Timestamp(now.0 + 5 * SECOND);
        assert_eq!(window.sum(later, SECONDS), window.sum(later, SECONDS));
        assert!(window.sum(later, SECONDS).0.messages < 600);
        assert_eq!(
            window
                .sum(Timestamp(now.0 + 30 * SECOND), SECONDS)
                .0
                .messages,
            0
        );
        window.current(Timestamp(now.0 + 30 * SECOND)).messages += 1;
        assert_eq!(
            window
                .sum(Timestamp(now.0 + 31 * SECOND), SECONDS)
                .0
                .messages,
            1
        );
    }
}
