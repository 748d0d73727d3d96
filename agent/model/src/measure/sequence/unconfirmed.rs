//! Numbers outside a writer's live run: a jump, a restart, or a forgery.
//!
//! A single datagram proves nothing. A run is confirmed if several datagrams continue it while the
//! live run does not advance. A HEARTBEAT in a later datagram confirms it, too.

use std::collections::VecDeque;
use std::time::Duration;

use ros2probe_wire::SequenceNumber;

use super::MAX_ANNOUNCED_JUMP;
use super::MAX_WINDOW;
use crate::facts::bounded::Bounded;
use crate::facts::model_time::ModelTime;
use crate::facts::tables::UnconfirmedNumbers;

/// Number of datagrams that confirm a run.
pub(super) const REQUIRED_CONFIRMATIONS: u8 = 5;
/// Copies of one datagram arrive at several sockets within this time.
const COPY_WINDOW: Duration = Duration::from_millis(5);

/// A run that is not confirmed yet, and the claims of HEARTBEATs and GAPs.
#[derive(Debug, Default)]
pub(super) struct UnconfirmedRun {
    run: Run,
    /// Number of datagrams that continued the run since the live run last advanced.
    evidence: u8,
    /// Times of the first and last of these datagrams.
    since: ModelTime,
    latest: ModelTime,
    /// The number after lastSN of a HEARTBEAT, and its time.
    claim: (SequenceNumber, ModelTime),
}

/// Samples that were counted before their numbers were confirmed.
#[derive(Clone, Debug, Default)]
pub struct Run {
    /// Ranges without common numbers; sorted once confirmed.
    pub ranges: Bounded<UnconfirmedNumbers, VecDeque<NumberRange>>,
    /// Numbers that a GAP skipped before the run.
    pub(super) gap: (SequenceNumber, SequenceNumber),
}

/// Consecutive numbers of a run.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct NumberRange {
    /// The lowest number.
    pub first: SequenceNumber,
    /// The highest number. It equals `first` unless the samples are whole.
    pub last: SequenceNumber,
    /// Whether the samples are whole.
    pub is_whole: bool,
}

impl NumberRange {
    /// Returns the number of samples.
    #[must_use]
    pub const fn count(&self) -> u64 {
        self.last.steps_since(self.first) + 1
    }

    fn contains(&self, number: SequenceNumber) -> bool {
        self.first <= number && number <= self.last
    }

    /// Adds a number directly after or before the range. Returns whether it was added.
    fn extend(&mut self, number: SequenceNumber) -> bool {
        if !self.is_whole || self.count() >= MAX_WINDOW {
            return false;
        }
        if self.last.precedes(number) {
            self.last = number;
            return true;
        }
        if number.precedes(self.first) {
            self.first = number;
            return true;
        }
        false
    }
}

impl UnconfirmedRun {
    /// Records the number of a sample. Returns whether it begins a run, and whether it is new.
    pub(super) fn note(&mut self, number: SequenceNumber, now: ModelTime) -> (bool, bool) {
        let ranges = &mut self.run.ranges;
        if ranges.iter().any(|range| range.contains(number)) {
            return (false, false);
        }
        let last = ranges.back().map(|range| range.last);
        let opens = last.is_none_or(|last| last.distance(number) > MAX_ANNOUNCED_JUMP);
        if opens {
            ranges.clear();
            self.evidence = 0;
        }
        ranges.push_back(NumberRange {
            first: number,
            last: number,
            is_whole: false,
        });
        if self.evidence == 0 {
            self.since = now;
        }
        if self.evidence == 0 || now != self.latest {
            self.evidence += 1;
            self.latest = now;
        }
        (opens, true)
    }

    /// Marks a sample as whole. Returns whether it was recorded and not yet whole.
    pub(super) fn complete(&mut self, number: SequenceNumber) -> bool {
        let ranges = &mut self.run.ranges;
        let is_noted = |range: &NumberRange| !range.is_whole && range.contains(number);
        let Some(index) = ranges.iter().rposition(is_noted) else {
            return false;
        };
        if ranges.iter_mut().rev().any(|range| range.extend(number)) {
            ranges.remove(index);
        } else if let Some(range) = ranges.get_mut(index) {
            range.is_whole = true;
        }
        true
    }

    /// Returns whether this number continues a run below `live`.
    pub(super) fn is_continued(&self, number: SequenceNumber, live: SequenceNumber) -> bool {
        let range = self.run.ranges.back().filter(|_| self.evidence > 0);
        range.is_some_and(|range| {
            range.last < live && range.last.distance(number) <= MAX_ANNOUNCED_JUMP
        })
    }

    pub(super) fn is_whole(&self, number: SequenceNumber) -> bool {
        let mut ranges = self.run.ranges.iter();
        ranges.any(|range| range.is_whole && range.contains(number))
    }

    pub(super) const fn is_confirmed(&self) -> bool {
        self.evidence >= REQUIRED_CONFIRMATIONS
    }

    /// Resets the evidence, because the live run continued.
    pub(super) const fn contradict(&mut self) {
        self.evidence = 0;
        self.claim = (SequenceNumber::ZERO, ModelTime::ZERO);
    }

    /// Returns whether a HEARTBEAT with lastSN `next - 1` confirms the run, where `live` is the
    /// live run's next number. A HEARTBEAT that reaches `live` never confirms a run below it.
    pub(super) fn confirms(
        &self,
        next: SequenceNumber,
        live: SequenceNumber,
        now: ModelTime,
    ) -> bool {
        let end = self.end();
        let is_ahead = end > live;
        self.evidence > 0
            && now > self.since
            && (end..=end.saturating_add(MAX_ANNOUNCED_JUMP)).contains(&next)
            && (is_ahead || next < live)
    }

    /// Returns whether a HEARTBEAT at least [`COPY_WINDOW`] ago had the same lastSN, or one lower
    /// by at most `reach`.
    pub(super) fn is_claimed(&mut self, next: SequenceNumber, reach: u64, now: ModelTime) -> bool {
        let (claimed, at) = self.claim;
        let is_same = claimed > SequenceNumber::ZERO
            && (claimed..=claimed.saturating_add(reach)).contains(&next);
        if !is_same {
            self.claim = (next, now);
        }
        is_same && now - at >= COPY_WINDOW
    }

    /// Records the numbers that a GAP skips.
    pub(super) const fn note_gap(&mut self, start: SequenceNumber, end: SequenceNumber) {
        self.run.gap = (start, end);
    }

    /// Returns the samples that arrived, in ascending order.
    pub(super) fn into_run(self) -> Run {
        let mut run = self.run;
        run.ranges.make_contiguous().sort_unstable();
        let first = run.ranges.front().map(|range| range.first);
        if first.is_none_or(|first| run.gap.1 > first) {
            // The GAP contradicts the samples that arrived.
            run.gap = Default::default();
        }
        run
    }

    /// Returns the highest number of the run, plus one.
    fn end(&self) -> SequenceNumber {
        let ranges = self.run.ranges.iter();
        let ends = ranges.map(|range| range.last.next());
        ends.max().unwrap_or_default()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_long_run_drops_its_oldest_numbers() {
        let mut unconfirmed = UnconfirmedRun::default();
        for number in 1..=100 {
            assert_eq!(
                unconfirmed.note(SequenceNumber(number), ModelTime::from_nanoseconds(1)),
                (number == 1, true)
            );
        }
        assert!(unconfirmed.run.ranges.is_full());
        // A number that was dropped is new again.
        assert_eq!(
            unconfirmed.note(SequenceNumber(1), ModelTime::from_nanoseconds(1)),
            (false, true)
        );
        assert_eq!(
            unconfirmed.note(SequenceNumber(100), ModelTime::from_nanoseconds(1)),
            (false, false)
        );
        assert_eq!(unconfirmed.evidence, 1);
    }

    #[test]
    fn whole_samples_of_a_run_extend_one_range_whatever_their_order() {
        let mut unconfirmed = UnconfirmedRun::default();
        let at = ModelTime::from_nanoseconds(1);
        for number in [12, 11, 10, 13, 14].map(SequenceNumber) {
            unconfirmed.note(number, at);
            assert!(unconfirmed.complete(number) && !unconfirmed.complete(number));
            assert!(unconfirmed.is_whole(number));
        }
        let run = unconfirmed.into_run();
        assert_eq!(
            run.ranges.iter().copied().collect::<Vec<_>>(),
            [NumberRange {
                first: SequenceNumber(10),
                last: SequenceNumber(14),
                is_whole: true,
            }]
        );
    }
}
