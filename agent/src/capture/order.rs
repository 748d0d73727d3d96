//! Puts what is counted back into the order in which it was captured.
//!
//! Records come from the kernel filter's ring or, of a datagram that was captured whole, from the
//! walk of its frame, and either way may be the quicker one. A retransmission must not overtake the
//! gap that it fills: it would count as a sample that was never missing. Everything waits until
//! both ways have had their time. It decides nothing and knows no writer.

use std::collections::VecDeque;

use ros2probe_wire::{Record, Timestamp};

use super::system::Clocks;

/// Records of frames that may wait: some 2.5 MB. Two thousand fit a datagram that means harm.
const MAX_WALKED: usize = 16_384;

/// The records of one tap.
#[derive(Debug, Default)]
pub struct Order {
    /// In the filter's clock.
    kernel: VecDeque<Record>,
    /// In calendar time, with the time in the filter's clock beside it.
    walked: VecDeque<(u64, Record)>,
}

/// One record whose turn it is, in calendar time.
#[derive(Clone, Copy, Debug)]
pub enum Next {
    /// Written by the filter.
    Kernel(Record),
    /// Found in a captured frame.
    Walked(Record),
}

impl Order {
    /// Takes in a record of the kernel's ring, its time in the filter's clock.
    pub fn kernel(&mut self, record: Record) {
        self.kernel.push_back(record);
    }

    /// Takes in a record of a frame, its time in calendar time; gives it back when too many wait.
    #[must_use]
    pub fn walked(&mut self, clocks: &Clocks, record: Record) -> Option<Record> {
        if self.walked.len() >= MAX_WALKED {
            return Some(record);
        }
        let at = clocks.monotonic_of(Timestamp(record.time));
        self.walked.push_back((at, record));
        None
    }

    /// The oldest record, if it is not younger than `until` in the filter's clock.
    pub fn next(&mut self, clocks: &Clocks, until: u64) -> Option<Next> {
        let kernel = self.kernel.front().map(|record| record.time);
        let walked = self.walked.front().map(|(at, _)| *at);
        if walked.is_some_and(|walked| kernel.is_none_or(|kernel| walked < kernel)) {
            walked.filter(|at| *at <= until)?;
            let (_, record) = self.walked.pop_front()?;
            return Some(Next::Walked(record));
        }
        kernel.filter(|at| *at <= until)?;
        let mut record = self.kernel.pop_front()?;
        record.time = clocks.calendar(record.time).0;
        Some(Next::Kernel(record))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const MILLISECOND: u64 = 1_000_000;
    const SETTLE: u64 = 80 * MILLISECOND;

    fn clocks(milliseconds: u64) -> Clocks {
        Clocks {
            now: Timestamp((1_000_000 + milliseconds) * MILLISECOND),
            monotonic: milliseconds * MILLISECOND,
        }
    }

    fn of_the_kernel(number: u64, milliseconds: u64) -> Record {
        Record {
            sequence_number: number,
            time: clocks(milliseconds).monotonic,
            ..Record::default()
        }
    }

    fn of_a_frame(number: u64, milliseconds: u64) -> Record {
        Record {
            sequence_number: number,
            time: clocks(milliseconds).now.0,
            ..Record::default()
        }
    }

    fn numbers(order: &mut Order, clocks: &Clocks) -> Vec<u64> {
        std::iter::from_fn(|| order.next(clocks, clocks.monotonic.saturating_sub(SETTLE)))
            .map(|next| {
                let (Next::Kernel(record) | Next::Walked(record)) = next;
                let age = clocks.now.nanoseconds_since(Timestamp(record.time));
                assert!(age >= SETTLE.cast_signed(), "{age}");
                record.sequence_number
            })
            .collect()
    }

    #[test]
    fn a_retransmission_in_a_captured_frame_does_not_overtake_the_gap_it_fills() {
        let mut order = Order::default();
        // 10 was lost; it comes again in a frame that user space gets before the record of 11.
        assert!(order.walked(&clocks(40), of_a_frame(10, 30)).is_none());
        order.kernel(of_the_kernel(9, 1));
        order.kernel(of_the_kernel(11, 20));
        order.kernel(of_the_kernel(12, 35));
        assert!(numbers(&mut order, &clocks(80)).is_empty());
        assert_eq!(numbers(&mut order, &clocks(105)), [9, 11]);
        assert_eq!(numbers(&mut order, &clocks(200)), [10, 12]);
    }

    #[test]
    fn a_clock_that_was_set_holds_nothing_up() {
        let mut order = Order::default();
        let back = of_a_frame(1, 3_600_000);
        assert!(order.walked(&clocks(10), back).is_none());
        let next = order.next(&clocks(90), 10 * MILLISECOND);
        assert!(matches!(next, Some(Next::Walked(_))), "{next:?}");
    }

    #[test]
    fn no_more_wait_than_there_is_room_for() {
        let mut order = Order::default();
        let refused = (0..20_000).filter(|number| {
            let record = of_a_frame(*number, 1);
            order.walked(&clocks(1), record).is_some()
        });
        assert_eq!(refused.count(), 20_000 - MAX_WALKED);
    }
}
