//! Sequence numbers of one writer whose messages are sampled in shared memory.
//!
//! The numbers between two seen messages show how many were not seen. The time of a poll hardly
//! shows when a message was sent. A message therefore counts at the writer's timestamp, which is of
//! the same host's clock. The first poll also finds earlier messages of unknown time, so the
//! measurement begins after them.

use std::collections::VecDeque;
use std::ops::RangeInclusive;

use super::SECOND;

/// Maximum gap of sequence numbers within one measurement. A larger gap restarts the measurement.
const MAX_UNSEEN: u64 = 10_000;
/// Maximum distance of a late message's number from the newest number. A lower number belongs to a
/// restarted writer.
const MAX_LATE_DISTANCE: u64 = 256;
/// Maximum time by which a message is late.
const MAX_LATENESS: i64 = 2 * SECOND;
/// Maximum time from a writer's timestamp to the poll that finds the message.
const LONGEST_POLL: i64 = 10 * SECOND;
/// Maximum number of remembered gaps, whose messages may still be seen.
const MAX_GAPS: usize = 16;

/// A message of the writer.
#[derive(Clone, Copy, Debug)]
pub(super) struct Message {
    /// Sequence number.
    pub(super) number: u64,
    /// Time of its capture.
    pub(super) captured: i64,
    /// The writer's timestamp.
    pub(super) sent: Option<i64>,
    /// Whether the message was sampled, so that others may have been missed.
    pub(super) is_sampled: bool,
}

/// Sequence numbers of one writer.
#[derive(Debug)]
pub(super) struct Numbers {
    newest: Message,
    /// Whether a message was counted.
    has_begun: bool,
    /// Numbers that were counted without being seen.
    unseen: VecDeque<RangeInclusive<u64>>,
}

/// How a message counts.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Place {
    /// The message counts at its time.
    Counts,
    /// The message is counted already, or was sent before the measurement.
    Counted,
    /// The message counts, and so do unseen messages before it.
    After {
        /// Number of unseen messages.
        unseen: u64,
        /// Time of the last seen message before the unseen ones.
        since: i64,
    },
}

impl Message {
    /// Returns the time at which the message counts.
    pub(super) fn time(&self) -> i64 {
        let age = |sent: &i64| self.captured.saturating_sub(*sent);
        let sent = self.sent.filter(|_| self.is_sampled);
        let sent = sent.filter(|sent| (0..=LONGEST_POLL).contains(&age(sent)));
        sent.unwrap_or(self.captured)
    }

    /// Returns whether the only known time of the message is that of the poll that found it.
    const fn is_undated(&self) -> bool {
        self.is_sampled && self.sent.is_none()
    }
}

impl Numbers {
    /// Begins with the first message of a writer.
    pub(super) const fn new(message: Message) -> (Self, Place) {
        let numbers = Self {
            newest: message,
            has_begun: !message.is_undated(),
            unseen: VecDeque::new(),
        };
        match numbers.has_begun {
            true => (numbers, Place::Counts),
            false => (numbers, Place::Counted),
        }
    }

    /// Adds a message.
    pub(super) fn place(&mut self, message: Message) -> Place {
        let newest = self.newest;
        if message.number <= newest.number {
            return self.add_late(message);
        }
        self.newest = message;
        if !self.has_begun {
            // A writer without timestamps counts since the second poll.
            self.has_begun = !message.is_undated() || message.captured != newest.captured;
            return match self.has_begun {
                true => Place::Counts,
                false => Place::Counted,
            };
        }
        let unseen = message.number - newest.number - 1;
        // Numbers that are missing on the network belong to lost messages.
        let may_be_unseen = message.is_sampled || newest.is_sampled;
        if !may_be_unseen || !(1..=MAX_UNSEEN).contains(&unseen) {
            return Place::Counts;
        }
        if self.unseen.len() >= MAX_GAPS {
            self.unseen.pop_front();
        }
        let gap = newest.number + 1..=message.number - 1;
        self.unseen.push_back(gap);
        Place::After {
            unseen,
            since: newest.time(),
        }
    }

    /// Adds a message with a number that is not above the newest one.
    fn add_late(&mut self, message: Message) -> Place {
        let newest = self.newest;
        let is_unseen = |gap: &RangeInclusive<u64>| gap.contains(&message.number);
        if self.unseen.iter().any(is_unseen) {
            return Place::Counted;
        }
        let is_late = newest.number - message.number < MAX_LATE_DISTANCE
            && message.captured.saturating_sub(newest.captured) < MAX_LATENESS;
        match (is_late, message.is_sampled) {
            // The message is a duplicate, or was sent before the measurement.
            (true, true) => Place::Counted,
            (true, false) => Place::Counts,
            (false, _) => {
                let (numbers, place) = Self::new(message);
                *self = numbers;
                place
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const MILLISECOND: i64 = 1_000_000;

    fn at(milliseconds: i64) -> i64 {
        1_795_142_000 * SECOND + milliseconds * MILLISECOND
    }

    /// Returns a message of the network.
    fn received(number: u64, captured: i64) -> Message {
        Message {
            number,
            captured: at(captured),
            sent: None,
            is_sampled: false,
        }
    }

    /// Returns a message of shared memory, read 3 ms after it was sent.
    fn sampled(number: u64, sent: i64) -> Message {
        Message {
            number,
            captured: at(sent + 3),
            sent: Some(at(sent)),
            is_sampled: true,
        }
    }

    /// Returns a message that was in shared memory before the first poll.
    fn undated(number: u64, captured: i64) -> Message {
        Message {
            sent: None,
            ..sampled(number, captured - 3)
        }
    }

    fn after(unseen: u64, since: i64) -> Place {
        let since = at(since);
        Place::After { unseen, since }
    }

    #[test]
    fn a_message_that_is_seen_after_it_was_estimated_counts_once() {
        let (mut numbers, first) = Numbers::new(sampled(170, 0));
        assert_eq!(first, Place::Counts);
        assert_eq!(numbers.place(sampled(199, 145)), after(28, 0));
        for number in 171..=198 {
            assert_eq!(numbers.place(received(number, 150)), Place::Counted);
        }
        assert_eq!(numbers.place(received(200, 150)), Place::Counts);
        // On the network, every message is seen: missing messages are lost, and late ones arrive.
        assert_eq!(numbers.place(received(203, 165)), Place::Counts);
        assert_eq!(numbers.place(received(202, 166)), Place::Counts);
    }

    #[test]
    fn messages_that_were_sent_before_the_first_poll_do_not_count() {
        let (mut numbers, first) = Numbers::new(undated(100, 0));
        assert_eq!(first, Place::Counted);
        for number in [101, 120, 140] {
            assert_eq!(numbers.place(undated(number, 0)), Place::Counted);
        }
        assert_eq!(numbers.place(sampled(180, 200)), Place::Counts);
        assert_eq!(numbers.place(sampled(182, 210)), after(1, 200));
    }

    #[test]
    fn a_writer_without_timestamps_counts_since_the_second_poll() {
        let (mut numbers, _) = Numbers::new(undated(100, 0));
        assert_eq!(numbers.place(undated(101, 0)), Place::Counted);
        assert_eq!(numbers.place(undated(105, 20)), Place::Counts);
        assert_eq!(numbers.place(undated(107, 30)), after(1, 20));
    }

    #[test]
    fn messages_between_network_and_shared_memory_count_as_unseen() {
        let (mut numbers, _) = Numbers::new(received(10, 0));
        assert_eq!(numbers.place(sampled(100, 450)), after(89, 0));
    }

    #[test]
    fn a_delayed_poll_does_not_change_the_time_of_a_message() {
        let late = Message {
            captured: at(900),
            ..sampled(1, 5)
        };
        assert_eq!(late.time(), at(5));
        // The timestamp is of another clock, or one of the application.
        for sent in [at(901), at(-20_000)] {
            let sent = Some(sent);
            assert_eq!(Message { sent, ..late }.time(), at(900));
        }
        assert_eq!(received(1, 7).time(), at(7));
    }

    #[test]
    fn a_restarted_writer_restarts_the_count() {
        let (mut numbers, _) = Numbers::new(sampled(900, 0));
        assert_eq!(numbers.place(sampled(1, 100)), Place::Counts);
        assert_eq!(numbers.place(sampled(2, 105)), Place::Counts);
        assert_eq!(numbers.place(sampled(1, 5_000)), Place::Counts);
        let far = 1 + MAX_UNSEEN + 2;
        assert_eq!(numbers.place(sampled(far, 5_005)), Place::Counts);
    }
}
