//! Runs of a writer's numbers: the live run, and one that further datagrams have to confirm.

use ros2probe_wire::{SequenceNumber, Timestamp};

use super::MAX_ANNOUNCED_JUMP;
use super::MAX_IRRELEVANT_AT_START;
use super::MAX_JUMP;
use super::MAX_STALE;
use super::MIN_INCARNATION_GAP;
use super::RunMembership;
use super::Sequence;
use super::Settled;
use super::unconfirmed::{REQUIRED_CONFIRMATIONS, Run};
use crate::facts::model_time::ModelTime;

impl Sequence {
    /// Checks number and source time of a sample before any other processing, to recognise a writer
    /// that jumps or restarts under its GUID. Numbers up to `reach` ahead belong to the live run.
    pub fn recognise(
        &mut self,
        number: SequenceNumber,
        source: Option<Timestamp>,
        reach: u64,
        now: ModelTime,
    ) -> RunMembership {
        if !number.is_valid() {
            return RunMembership::Live;
        }
        if self.is_unconfirmed(number, source, reach) {
            let unconfirmed = self.unconfirmed.get_or_insert_default();
            let (opens, new) = unconfirmed.note(number, now);
            self.jumps += u64::from(opens);
            if !unconfirmed.is_confirmed() {
                return RunMembership::Unconfirmed { new };
            }
            let mut run = self.confirm();
            // The caller processes this sample as one of the live run.
            run.ranges
                .retain(|range| range.is_whole || range.first != number);
            if let Some(source) = source {
                self.sourced(number, source);
            }
            return RunMembership::Confirmed(run);
        }
        if self.stale >= MAX_STALE && number < self.floor() {
            self.restart(number);
        }
        if number >= self.next && self.started() {
            self.followed = self.followed.saturating_add(1);
            self.contradict();
        }
        if let Some(source) = source {
            self.sourced(number, source);
        }
        RunMembership::Live
    }

    /// Returns whether a sample with this number and source time is outside the live run.
    #[must_use]
    pub fn is_unconfirmed(
        &self,
        number: SequenceNumber,
        source: Option<Timestamp>,
        reach: u64,
    ) -> bool {
        if !self.started() || !number.is_valid() {
            return false;
        }
        if number >= self.next {
            return number - self.next > reach;
        }
        let newer = source.is_some_and(|source| {
            self.newest_source.0 > 0 && source > self.newest_source + MIN_INCARNATION_GAP
        });
        // A restarted writer fills no gaps of its previous run.
        let unconfirmed = self.unconfirmed.as_ref();
        let continues =
            || unconfirmed.is_some_and(|unconfirmed| unconfirmed.is_continued(number, self.next));
        // The first samples may have been forged as well, so a lower number far away is
        // unconfirmed. A lower number within `MAX_ANNOUNCED_JUMP` is history.
        let is_young = self.followed < REQUIRED_CONFIRMATIONS;
        // The source time of a number above `newest` is unknown: it arrived by another route.
        let is_repeated = || number <= self.newest && self.has(number);
        newer && (is_repeated() || continues())
            || is_young && self.next - number > MAX_ANNOUNCED_JUMP
    }

    /// Marks an unconfirmed sample as whole. Returns whether that is new.
    pub fn complete_unconfirmed(&mut self, number: SequenceNumber) -> bool {
        let unconfirmed = self.unconfirmed.as_mut();
        unconfirmed.is_some_and(|unconfirmed| unconfirmed.complete(number))
    }

    /// Returns whether an unconfirmed sample arrived whole.
    #[must_use]
    pub fn has_unconfirmed(&self, number: SequenceNumber) -> bool {
        let unconfirmed = self.unconfirmed.as_ref();
        unconfirmed.is_some_and(|unconfirmed| unconfirmed.is_whole(number))
    }

    /// Records the samples of a confirmed run.
    pub fn accept(&mut self, run: &Run, now: ModelTime, settled: &mut impl FnMut(Settled)) {
        for range in &run.ranges {
            for number in range.first.until(range.last.next()) {
                self.exists(number, now, settled);
                if range.is_whole {
                    self.received.set(number);
                }
            }
        }
        let (start, end) = run.gap;
        self.mark_irrelevant(start, end);
    }

    /// Makes the unconfirmed run live: the numbers jump to it or restart.
    pub(super) fn confirm(&mut self) -> Run {
        let unconfirmed = self.unconfirmed.take();
        let run = unconfirmed.map_or_else(Run::default, |unconfirmed| unconfirmed.into_run());
        let Some(first) = run.ranges.front().map(|range| range.first) else {
            return run;
        };
        let jump = (first >= self.next).then(|| first - self.next);
        // While the live run has only a few samples, a long jump is a restart rather than a loss.
        let most = match self.followed < REQUIRED_CONFIRMATIONS {
            _ if self.is_reopened => MAX_IRRELEVANT_AT_START,
            true => MAX_ANNOUNCED_JUMP,
            false => MAX_JUMP,
        };
        if jump.is_none_or(|jump| jump > most) {
            self.restart(first);
        }
        run
    }

    /// Records that the live run continued.
    pub(super) fn contradict(&mut self) {
        if let Some(unconfirmed) = &mut self.unconfirmed {
            unconfirmed.contradict();
        }
    }
}
