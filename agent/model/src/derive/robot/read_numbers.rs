//! The sequence numbers of a writer that were decoded.

use ros2probe_wire::{SequenceNumber, Timestamp};

use crate::measure::sequence::MIN_INCARNATION_GAP;

/// The latest numbers of a writer that were decoded.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct ReadNumbers {
    newest: SequenceNumber,
    /// Source time of the newest.
    source: Option<Timestamp>,
    /// Bit `n` stands for the number `newest - n`.
    bits: u64,
}

impl ReadNumbers {
    /// Returns whether the number was added. Numbers far below the newest count as added, as copies
    /// that a later subscriber requests.
    pub(super) fn has(&self, number: SequenceNumber, source: Option<Timestamp>) -> bool {
        match self.newest.steps_since(number) {
            _ if number > self.newest || self.is_restart(number, source) => false,
            steps => steps >= 64 || self.bits >> steps & 1 != 0,
        }
    }

    /// Adds a number. Returns whether a higher one was added before.
    pub(super) fn add(&mut self, number: SequenceNumber, source: Option<Timestamp>) -> bool {
        if self.is_restart(number, source) {
            *self = Self::default();
        }
        match number.steps_since(self.newest) {
            0 => self.bits |= 1_u64.checked_shl(steps(self.newest, number)).unwrap_or(0),
            _ => {
                let moved = steps(number, self.newest);
                self.bits = self.bits.checked_shl(moved).unwrap_or(0) | 1;
                (self.newest, self.source) = (number, source);
            }
        }
        number < self.newest
    }

    /// Returns whether the writer has restarted its numbers: a lower one was written later.
    fn is_restart(&self, number: SequenceNumber, source: Option<Timestamp>) -> bool {
        let times = source.zip(self.source);
        number < self.newest
            && times.is_some_and(|(new, newest)| new > newest + MIN_INCARNATION_GAP)
    }
}

/// Returns the steps from `lower` to `number`, as far as 32 bits hold them.
fn steps(number: SequenceNumber, lower: SequenceNumber) -> u32 {
    u32::try_from(number.steps_since(lower)).unwrap_or(u32::MAX)
}

#[cfg(test)]
mod tests {
    use super::*;

    const LATER: Timestamp = Timestamp(MIN_INCARNATION_GAP.as_nanos() as u64 + 2);

    #[test]
    fn a_sequence_number_is_new_once_and_numbers_below_the_window_are_copies() {
        let mut read = ReadNumbers::default();
        let mut is_new = |number| {
            let number = SequenceNumber(number);
            let is_new = !read.has(number, None);
            if is_new {
                let is_late = number < read.newest;
                assert_eq!(read.add(number, None), is_late);
            }
            is_new
        };
        assert!(is_new(100) && !is_new(100));
        assert!(is_new(102) && is_new(101) && !is_new(101) && !is_new(102));
        assert!(is_new(40) && !is_new(40), "within the window");
        assert!(!is_new(38), "before it");
        assert!(is_new(1 << 40) && !is_new(102) && is_new((1 << 40) - 63));
    }

    #[test]
    fn a_lower_number_with_a_later_source_time_is_that_of_a_restarted_writer() {
        let mut read = ReadNumbers::default();
        let [first, later] = [Some(Timestamp(1)), Some(LATER)];
        assert!(!read.add(SequenceNumber(1 << 40), first));
        assert!(read.has(SequenceNumber(7), first), "a copy");
        assert!(!read.has(SequenceNumber(7), later));
        assert!(!read.add(SequenceNumber(7), later), "not late");
        assert!(read.has(SequenceNumber(7), later));
        assert!(!read.has(SequenceNumber(8), later));
    }
}
