//! HEARTBEAT, GAP and ACKNACK: which numbers exist, and which of them readers miss (RTPS 2.5,
//! 8.3.8).

use ros2probe_wire::SequenceNumber;

use super::MAX_ANNOUNCED_JUMP;
use super::MAX_JUMP;
use super::MAX_TRUSTED_JUMP;
use super::Sequence;
use super::Settled;
use super::unconfirmed::Run;
use crate::facts::model_time::ModelTime;

impl Sequence {
    /// Processes a HEARTBEAT: the writer has `first..=last`. It sends nothing below `first` again,
    /// and all numbers up to `last` exist.
    pub fn heartbeat(
        &mut self,
        first: SequenceNumber,
        last: SequenceNumber,
        now: ModelTime,
        settled: &mut impl FnMut(Settled),
    ) {
        if !self.started() || first == SequenceNumber::ZERO || first > last.next() {
            return;
        }
        let next = last.next();
        let (is_confirmed, run) = self.claim(next, MAX_TRUSTED_JUMP, now);
        if let Some(run) = run {
            self.accept(&run, now, settled);
        }
        if !is_confirmed {
            return;
        }
        if next > self.next {
            self.note_gap(self.next, next, now);
            self.extend(next.previous(), next, now, settled);
        }
        let available = first.min(self.next);
        if available > self.available {
            self.available = available;
            self.withdrawn.get_or_insert((now, available));
        }
    }

    /// Enlarges the window for the history from `first` on, which a new reader may request.
    pub fn expect_history(&mut self, first: SequenceNumber) {
        let floor = self.floor();
        // Numbers below the window that counted before must not count again.
        let is_new = self.started() && self.first >= floor;
        if is_new && first > SequenceNumber::ZERO && first < floor {
            self.widen(self.next.steps_since(first));
        }
    }

    /// Processes a HEARTBEAT's lastSN, `next - 1`. Returns whether it is confirmed, and the run
    /// that it confirms.
    pub fn claim(
        &mut self,
        next: SequenceNumber,
        reach: u64,
        now: ModelTime,
    ) -> (bool, Option<Run>) {
        let live = self.next;
        let unconfirmed = self.unconfirmed.as_mut();
        if unconfirmed.is_some_and(|unconfirmed| unconfirmed.confirms(next, live, now)) {
            return (true, Some(self.confirm()));
        }
        let ahead = next.steps_since(live);
        if ahead <= reach {
            if next >= live {
                self.contradict();
            }
            return (true, None);
        }
        let unconfirmed = self.unconfirmed.get_or_insert_default();
        if ahead <= MAX_ANNOUNCED_JUMP && unconfirmed.is_claimed(next, reach, now) {
            return (true, None);
        }
        self.jumps += 1;
        (false, None)
    }

    /// Returns whether an ACKNACK is refused because it acknowledges numbers far above the known
    /// ones.
    pub const fn is_too_far_ahead(&mut self, base: SequenceNumber) -> bool {
        let refuses = self.started() && base.steps_since(self.next) > MAX_ANNOUNCED_JUMP;
        self.jumps += refuses as u64;
        refuses
    }

    /// Processes an ACKNACK: the readers have all numbers below `base`, observed or not, except
    /// samples that the writer had withdrawn before.
    pub fn acknowledged(&mut self, base: SequenceNumber) {
        if self.started() {
            self.mark_irrelevant(self.available, base);
            self.acknowledged = self.acknowledged.max(base);
        }
    }

    /// Processes a GAP: `start..base` and the numbers in `set` will never arrive.
    pub fn gap(
        &mut self,
        start: SequenceNumber,
        base: SequenceNumber,
        set: impl Iterator<Item = SequenceNumber>,
        now: ModelTime,
        settled: &mut impl FnMut(Settled),
    ) {
        if !self.started() || start == SequenceNumber::ZERO || base < start {
            return;
        }
        let ahead = base.steps_since(self.next);
        if ahead > MAX_TRUSTED_JUMP {
            self.jumps += 1;
            if ahead <= MAX_JUMP {
                self.unconfirmed
                    .get_or_insert_default()
                    .note_gap(start, base);
            }
            return;
        }
        let mut one = |sequence: &mut Self, start: SequenceNumber, end: SequenceNumber| {
            if end > sequence.next {
                if end - sequence.next > MAX_TRUSTED_JUMP {
                    return;
                }
                sequence.extend(end.previous(), end, now, settled);
            }
            sequence.mark_irrelevant(start.max(sequence.settled), end);
        };
        one(self, start, base);
        for number in set {
            one(self, number, number.next());
        }
    }

    /// Processes an ACKNACK in which a reader requests these numbers again.
    pub fn requested(&mut self, mut set: impl Iterator<Item = SequenceNumber>) {
        if self.gaps.is_empty() {
            return;
        }
        let (Some(low), high) = (set.next(), set.last()) else {
            return;
        };
        let high = high.unwrap_or(low);
        for gap in &mut self.gaps {
            gap.requested |= gap.start <= high && low < gap.end;
        }
    }

    /// Marks `start..end` irrelevant, so that no number in it is lost.
    pub fn mark_irrelevant(&mut self, start: SequenceNumber, end: SequenceNumber) {
        let start = start.max(self.floor()).max(self.settled);
        self.irrelevant.set_all(start, end.min(self.next));
    }
}
