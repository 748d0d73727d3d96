//! Messages that were sent and never came: what the original learns from its middleware, here from
//! the numbers on the wire.
//!
//! A number that was skipped counts a second later, unless its message came after all. What the
//! stream itself says was incomplete counts at once.

use std::collections::{BTreeMap, HashMap};

use crate::subscriptions::line::{MissedFacts, Reason, SampleFacts};

/// How long a skipped message may still come, as a repetition or out of order.
const SETTLED: i64 = 1_000_000_000;
/// A writer that skips more has begun anew, or is another one.
const MAX_GAP: u64 = 10_000;
/// Writers and ranges of numbers that are remembered.
const MAX_WRITERS: usize = 1024;
const MAX_RANGES: usize = 256;

/// Counts lost messages.
#[derive(Debug, Default)]
pub struct Lost {
    writers: HashMap<String, Numbers>,
    total: u64,
}

#[derive(Debug, Default)]
struct Numbers {
    highest: u64,
    /// Skipped: first number, to how many and since when.
    skipped: BTreeMap<u64, (u64, i64)>,
}

impl Lost {
    /// A message came.
    pub fn came(&mut self, sample: &SampleFacts) {
        let number = sample.sequence_number;
        if !self.writers.contains_key(&sample.writer) {
            if self.writers.len() < MAX_WRITERS {
                let numbers = Numbers {
                    highest: number,
                    ..Numbers::default()
                };
                self.writers.insert(sample.writer.clone(), numbers);
            }
            return;
        }
        let Some(numbers) = self.writers.get_mut(&sample.writer) else {
            return;
        };
        if number <= numbers.highest {
            numbers.fill(number);
            return;
        }
        let first = numbers.highest + 1;
        let gap = number - first;
        if gap > 0 && gap <= MAX_GAP && numbers.skipped.len() < MAX_RANGES {
            numbers.skipped.insert(first, (gap, sample.time_ns));
        }
        numbers.highest = number;
    }

    /// The stream says that messages will not come; the words for it where they are lost.
    pub fn missed(&mut self, missed: &MissedFacts) -> String {
        if let Some(numbers) = self.writers.get_mut(&missed.writer) {
            let MissedFacts {
                first_sequence_number: first,
                last_sequence_number: last,
                ..
            } = *missed;
            for number in first..=last.min(first.saturating_add(MAX_GAP)) {
                numbers.fill(number);
            }
            numbers.highest = numbers.highest.max(last);
        }
        match missed.reason {
            Reason::Incomplete => self.say(missed.samples),
            // They were on the wire.
            Reason::NotCaptured | Reason::QueueFull => String::new(),
        }
    }

    /// It is this late: the words for what is lost by now.
    pub fn now(&mut self, time_ns: i64) -> String {
        let mut lost = 0;
        for numbers in self.writers.values_mut() {
            numbers.skipped.retain(|_, (count, since)| {
                let settled = time_ns.saturating_sub(*since) >= SETTLED;
                lost += if settled { *count } else { 0 };
                !settled
            });
        }
        self.say(lost)
    }

    /// Without a space and an end of the line where the original has none.
    fn say(&mut self, lost: u64) -> String {
        if lost == 0 {
            return String::new();
        }
        self.total += lost;
        format!(
            "A message was lost!!!\n\ttotal count change:{lost}\n\ttotal count: {}---\n",
            self.total
        )
    }
}

impl Numbers {
    /// One that was skipped came.
    fn fill(&mut self, number: u64) {
        let before = self.skipped.range(..=number).next_back();
        let Some((&first, &(count, since))) = before else {
            return;
        };
        let end = first + count;
        if number >= end {
            return;
        }
        self.skipped.remove(&first);
        if number > first {
            self.skipped.insert(first, (number - first, since));
        }
        if number + 1 < end {
            self.skipped.insert(number + 1, (end - number - 1, since));
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn sample(number: u64, seconds: i64) -> SampleFacts {
        SampleFacts {
            topic: "/a".to_owned(),
            domain_id: 0,
            message_type: "std_msgs/msg/String".to_owned(),
            time_ns: seconds * 1_000_000_000,
            writer: "01".to_owned(),
            sequence_number: number,
            source_timestamp_ns: None,
            header_stamp_ns: None,
            size: 8,
            sampled: false,
            payload_bytes: None,
            offered: None,
        }
    }

    fn missed(first: u64, last: u64, reason: Reason) -> MissedFacts {
        MissedFacts {
            topic: "/a".to_owned(),
            domain_id: 0,
            writer: "01".to_owned(),
            samples: last - first + 1,
            first_sequence_number: first,
            last_sequence_number: last,
            reason,
        }
    }

    #[test]
    fn a_skipped_message_is_lost_unless_it_comes_after_all() {
        let mut lost = Lost::default();
        for (number, seconds) in [(7, 1), (8, 1), (12, 1), (10, 1)] {
            lost.came(&sample(number, seconds));
        }
        assert_eq!(lost.now(1_900_000_000), "");
        let text = "A message was lost!!!\n\ttotal count change:2\n\ttotal count: 2---\n";
        assert_eq!(lost.now(2_000_000_000), text);
        assert_eq!(lost.now(9_000_000_000), "");
        lost.came(&sample(14, 10));
        let text = "A message was lost!!!\n\ttotal count change:1\n\ttotal count: 3---\n";
        assert_eq!(lost.now(11_000_000_000), text);
    }

    #[test]
    fn incomplete_messages_count_once_and_what_this_reader_missed_does_not() {
        let mut lost = Lost::default();
        lost.came(&sample(1, 1));
        lost.came(&sample(5, 1));
        let text = "A message was lost!!!\n\ttotal count change:2\n\ttotal count: 2---\n";
        assert_eq!(lost.missed(&missed(2, 3, Reason::Incomplete)), text);
        assert_eq!(lost.missed(&missed(4, 4, Reason::QueueFull)), "");
        assert_eq!(lost.now(i64::MAX), "");
    }

    #[test]
    fn a_writer_that_begins_anew_loses_nothing() {
        let mut lost = Lost::default();
        lost.came(&sample(5, 1));
        lost.came(&sample(1, 2));
        lost.came(&sample(u64::MAX, 3));
        assert_eq!(lost.now(i64::MAX), "");
    }
}
