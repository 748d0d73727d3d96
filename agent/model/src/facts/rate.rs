//! Counts of the last seconds, for displayed rates and for expectations.
//!
//! Only whole seconds contribute to a rate, so the rate of a periodic topic neither flickers nor
//! starts too high. This module keeps counts for [`SECONDS`] only; exact counters are in the
//! measurements.

use crate::facts::model_time::ModelTime;

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
    pub delayed: u32,
    /// Sum of their latencies in seconds.
    pub delay: f64,
    /// Longest time in seconds between two messages of one writer, the later of which is counted
    /// here.
    pub longest_interval: f32,
}

/// Numbers of messages and of their bytes.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Sum {
    /// Messages.
    pub messages: u64,
    /// Payload bytes.
    pub bytes: u64,
}

impl Sum {
    /// Returns the part sent from `since` to `until`, assuming an even rate from `since` to `now`.
    fn part(self, since: ModelTime, until: ModelTime, now: ModelTime) -> Self {
        let span = (now - since).as_nanos();
        let elapsed = (until - since).as_nanos().min(span);
        let share = |count: u64, part: u128, whole: u128| {
            let part = (u128::from(count) * part).checked_div(whole);
            part.map_or(0, |part| u64::try_from(part).unwrap_or(count))
        };
        let messages = share(self.messages, elapsed, span);
        Self {
            messages,
            bytes: share(self.bytes, messages.into(), self.messages.into()),
        }
    }
}

impl Slot {
    /// Adds `sent` without `counted`, the part that is already counted.
    const fn send(&mut self, sent: Sum, counted: Sum) {
        self.messages += sent.messages - counted.messages;
        self.bytes = self.bytes.saturating_add(sent.bytes - counted.bytes);
    }

    /// Adds all of `other`.
    pub fn add(&mut self, other: &Self) {
        self.messages += other.messages;
        self.bytes += other.bytes;
        self.lost += other.lost;
        self.delayed += other.delayed;
        self.delay += other.delay;
        self.longest_interval = self.longest_interval.max(other.longest_interval);
    }
}

impl Window {
    /// Returns the counts of the second that contains `at`, or of the oldest second if `at` is
    /// earlier.
    pub fn second(&mut self, at: ModelTime) -> &mut Slot {
        self.turn(at);
        let oldest = self.second.saturating_sub(SECONDS);
        let second = at.whole_seconds().clamp(oldest, self.second);
        let slot = usize::try_from(second % SLOTS as u64).unwrap_or(0);
        // The modulus keeps the index in range; the alternative only satisfies the compiler.
        let slot = if slot < SLOTS { slot } else { 0 };
        #[expect(clippy::indexing_slicing, reason = "slot < SLOTS was just established")]
        &mut self.slots[slot]
    }

    /// Clears all counts and starts counting at `now`.
    pub fn begin(&mut self, now: ModelTime) {
        *self = Self::default();
        self.turn(now);
    }

    /// Spreads `sent` evenly from `since` to `now`, the time of the last message. Returns the part
    /// that belongs to seconds before the last whole second.
    pub fn spread(&mut self, sent: Sum, since: ModelTime, now: ModelTime) -> Sum {
        self.turn(now);
        let current = now.whole_seconds();
        let first = since.whole_seconds();
        let first = first.max(current.saturating_sub(SECONDS)).min(current);
        let mut counted = sent.part(since, ModelTime::of_second(first), now);
        let mut earlier = counted;
        for second in first..current {
            let end = ModelTime::of_second(second + 1);
            let until = sent.part(since, end, now);
            self.second(ModelTime::of_second(second))
                .send(until, counted);
            counted = until;
            if second + 1 < current {
                earlier = until;
            }
        }
        self.second(now).send(sent, counted);
        earlier
    }

    /// Returns the sum over the last `seconds` whole seconds, and their number, which is lower if
    /// counting began later.
    #[must_use]
    pub fn sum(&self, now: ModelTime, seconds: u64) -> (Slot, u64) {
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

    /// Advances to the second of `now` and clears the slots of seconds without counts.
    fn turn(&mut self, now: ModelTime) {
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
    use std::time::Duration;

    use super::*;

    fn fill(window: &mut Window, start_ms: u64, step_ms: u64, count: u64) -> ModelTime {
        let mut at = start_ms;
        for _ in 0..count {
            let slot = window.second(ModelTime::from_nanoseconds(at * 1_000_000));
            slot.messages += 1;
            slot.bytes += 100;
            at += step_ms;
        }
        ModelTime::from_nanoseconds(at * 1_000_000)
    }

    #[test]
    fn a_steady_topic_has_its_exact_rate_after_one_whole_second() {
        let mut window = Window::default();
        let now = fill(&mut window, 100_300, 5, 400);
        let (sum, seconds) = window.sum(now, SECONDS);
        assert_eq!((sum.messages, sum.bytes, seconds), (200, 20_000, 1));
    }

    #[test]
    fn a_window_of_one_second_does_not_overestimate_the_rate() {
        let mut window = Window::default();
        let now = fill(&mut window, 100_001, 50, 20 * 12);
        let (sum, seconds) = window.sum(now, 1);
        assert_eq!((sum.messages, seconds), (20, 1));
    }

    #[test]
    fn late_messages_count_in_the_second_of_their_time() {
        let mut window = Window::default();
        let now = fill(&mut window, 100_000, 100, 50);
        for late in [102_500, 102_600, 50_000] {
            window
                .second(ModelTime::from_nanoseconds(late * 1_000_000))
                .messages += 1;
        }
        let (sum, seconds) = window.sum(now, 2);
        assert_eq!((sum.messages, seconds), (20, 2));
        let (sum, seconds) = window.sum(now, 3);
        assert_eq!((sum.messages, seconds), (32, 3));
    }

    #[test]
    fn messages_after_a_long_gap_are_spread_over_the_gap() {
        let mut window = Window::default();
        let at = |milliseconds: u64| ModelTime::from_nanoseconds(milliseconds * 1_000_000);
        window.second(at(100_000)).messages += 1;
        // A topic of 50 Hz is not seen for 14 s.
        let sent = |messages| Sum {
            messages,
            bytes: 100 * messages,
        };
        let earlier = window.spread(sent(702), at(100_000), at(114_040));
        let (sum, seconds) = window.sum(at(115_000), SECONDS);
        assert!((451..=453).contains(&sum.messages), "{sum:?}");
        assert!(sum.bytes.abs_diff(100 * sum.messages) <= 100, "{sum:?}");
        assert_eq!(seconds, SECONDS);
        assert!((649..=651).contains(&earlier.messages), "{earlier:?}");
        // Each message is counted once.
        let (last, _) = window.sum(at(115_000), 2);
        assert_eq!(earlier.messages + last.messages, 702);
        // The first message of a writer.
        let mut first = Window::default();
        assert_eq!(
            first.spread(sent(1), ModelTime::ZERO, at(114_040)),
            Sum::default()
        );
        assert_eq!(first.sum(at(116_000), SECONDS), (Slot::default(), 1));
        for (since, now) in [(114_040, 114_060), (114_060, 114_060), (114_080, 114_060)] {
            let earlier = window.spread(sent(3), at(since), at(now));
            assert_eq!(earlier, Sum::default());
        }
        assert_eq!(window.sum(at(115_000), 2).0.messages, last.messages + 9);
    }

    #[test]
    fn a_restarted_window_forgets_earlier_counts() {
        let mut window = Window::default();
        let now = fill(&mut window, 100_000, 10, 1000);
        window.begin(now);
        assert_eq!(window.sum(now + Duration::from_secs(1), SECONDS).1, 0);
        let later = fill(&mut window, 110_000, 20, 150);
        let (sum, seconds) = window.sum(later, SECONDS);
        assert_eq!((sum.messages, seconds), (100, 2));
    }

    #[test]
    fn silence_empties_the_window() {
        let mut window = Window::default();
        let now = fill(&mut window, 100_000, 10, 1000);
        let later = now + Duration::from_secs(5);
        assert_eq!(window.sum(later, SECONDS), window.sum(later, SECONDS));
        assert!(window.sum(later, SECONDS).0.messages < 600);
        assert_eq!(
            window
                .sum(now + Duration::from_secs(30), SECONDS)
                .0
                .messages,
            0
        );
        window.second(now + Duration::from_secs(30)).messages += 1;
        assert_eq!(
            window
                .sum(now + Duration::from_secs(31), SECONDS)
                .0
                .messages,
            1
        );
    }
}
