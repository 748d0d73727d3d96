//! Known causes of losses on this host for one receiver, and losses whose cause may still be
//! reported.
//!
//! The kernel reports a full socket buffer immediately. It reports a failed IP reassembly half a
//! minute later, with IPv6 a minute. A loss that may be a failed reassembly stays pending until
//! then.

use std::collections::BTreeMap;
use std::time::Duration;

use ros2probe_wire::SequenceNumber;

use crate::facts::bounded::Bounded;
use crate::facts::loss::LossCause;
use crate::facts::model_time::ModelTime;
use crate::facts::route::Destination;
use crate::facts::tables::{KnownLosses, OpenLosses};

/// By default, the kernel waits 30 s for fragments of IPv4 (`net.ipv4.ipfrag_time`).
const REASSEMBLY_TIMEOUT: Duration = Duration::from_secs(35);
/// By default, the kernel waits 60 s for fragments of IPv6 (`net.ipv6.ip6frag_time`).
const REASSEMBLY_TIMEOUT_IPV6: Duration = Duration::from_secs(65);

/// Returns how long after its departure a sample to this destination may fail in IP reassembly.
/// Messages without a network have the address zero.
#[must_use]
pub fn reassembly_timeout(destination: &Destination) -> Duration {
    let address = destination.socket_address().ip();
    if address.is_ipv6() && !address.is_unspecified() {
        REASSEMBLY_TIMEOUT_IPV6
    } else {
        REASSEMBLY_TIMEOUT
    }
}

/// Known causes and pending losses.
#[derive(Debug, Default)]
pub struct LossCauses {
    known: Bounded<KnownLosses, BTreeMap<SequenceNumber, KnownLoss>>,
    /// Pending runs, by their first number.
    pending: Bounded<OpenLosses, BTreeMap<SequenceNumber, Run>>,
}

/// Where a sample, or part of it, was lost.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub struct KnownLoss {
    /// Cause nearest to the reader.
    pub cause: LossCause,
    /// Time at which its first part was lost.
    pub at: ModelTime,
}

#[derive(Clone, Copy, Debug)]
struct Run {
    last: SequenceNumber,
    until: ModelTime,
}

impl LossCauses {
    /// Records the loss of some or all of this sample. Returns whether an older entry was dropped.
    pub fn note(&mut self, number: SequenceNumber, cause: LossCause, at: ModelTime) -> bool {
        if let Some(known_loss) = self.known.get_mut(&number) {
            known_loss.cause = known_loss.cause.max(cause);
            return false;
        }
        self.known.insert(number, KnownLoss { cause, at }).is_some()
    }

    /// Removes and returns the known loss of a sample that arrived after all or became irrelevant.
    pub fn forget(&mut self, number: SequenceNumber) -> Option<KnownLoss> {
        if self.known.is_empty() {
            return None;
        }
        self.known.remove(&number)
    }

    /// Removes the known causes of `first..=last`. Visits each number with a known cause alone, and
    /// the others as runs without a cause.
    pub fn explain(
        &mut self,
        first: SequenceNumber,
        last: SequenceNumber,
        mut show: impl FnMut(SequenceNumber, SequenceNumber, Option<LossCause>),
    ) {
        let mut next = first;
        while let Some((number, _)) = self.known.range(next..=last).next() {
            let number = *number;
            if number > next {
                show(next, number.previous(), None);
            }
            if let Some(known_loss) = self.known.remove(&number) {
                show(number, number, Some(known_loss.cause));
            }
            next = number + 1;
            if number == last {
                return;
            }
        }
        show(next, last, None);
    }

    /// Removes all samples below this number, which are decided.
    pub fn settled(&mut self, below: SequenceNumber) {
        if self
            .known
            .first_key_value()
            .is_some_and(|(number, _)| *number < below)
        {
            self.known.take_below(&below);
        }
    }

    /// Keeps the cause of these samples open until `until`. Returns a run that must be decided now
    /// because the table is full.
    pub fn wait(
        &mut self,
        first: SequenceNumber,
        last: SequenceNumber,
        until: ModelTime,
    ) -> Option<(SequenceNumber, SequenceNumber)> {
        if let Some((_, run)) = self.pending.range_mut(..first).next_back()
            && run.last.precedes(first)
            && run.until == until
        {
            run.last = last;
            return None;
        }
        let decided = self.pending.insert(first, Run { last, until });
        decided.map(|(first, run)| (first, run.last))
    }

    /// Removes this sample from the pending ones and returns whether it was pending. If the split
    /// of its run would exceed the cap, the sample stays and its cause is decided with the others.
    pub fn resolve(&mut self, number: SequenceNumber) -> bool {
        let Some((first, run)) = self.pending.range(..=number).next_back() else {
            return false;
        };
        let (first, run) = (*first, *run);
        let splits = first < number && number < run.last;
        if number > run.last || splits && self.pending.is_full() {
            return false;
        }
        self.pending.remove(&first);
        if first < number {
            let last = number.previous();
            self.pending.insert(first, Run { last, ..run });
        }
        if number < run.last {
            self.pending.insert(number + 1, run);
        }
        true
    }

    /// Removes and returns the runs that are due at `now`.
    pub fn due(&mut self, now: ModelTime) -> Vec<(SequenceNumber, SequenceNumber)> {
        let mut due = Vec::new();
        self.pending.retain(|first, run| {
            let is_due = run.until <= now;
            if is_due {
                due.push((*first, run.last));
            }
            !is_due
        });
        due
    }

    /// Returns the time at which the next run is due; [`ModelTime::MAX`] without one.
    #[must_use]
    pub fn next_due(&self) -> ModelTime {
        let times = self.pending.values().map(|run| run.until);
        times.min().unwrap_or(ModelTime::MAX)
    }

    /// Merges the causes of `other`.
    pub fn absorb(&mut self, other: Self) {
        for (number, known_loss) in other.known {
            self.note(number, known_loss.cause, known_loss.at);
        }
    }
}

#[cfg(test)]
mod tests {
    use std::net::SocketAddr;

    use super::*;

    fn at(seconds: u64) -> ModelTime {
        ModelTime::from_nanoseconds(seconds * 1_000_000_000)
    }

    fn explained(
        loss_causes: &mut LossCauses,
        first: u64,
        last: u64,
    ) -> Vec<(u64, u64, Option<LossCause>)> {
        let (first, last) = (SequenceNumber(first), SequenceNumber(last));
        let mut runs = Vec::new();
        loss_causes.explain(first, last, |first, last, cause| {
            runs.push((first.0, last.0, cause));
        });
        runs
    }

    #[test]
    fn a_loss_by_ipv6_stays_pending_as_long_as_the_kernel_waits_for_fragments() {
        let timeout = |address: &str| {
            let address: SocketAddr = address.parse().unwrap();
            reassembly_timeout(&Destination::from(address)).as_secs()
        };
        assert_eq!(timeout("[fd00::2]:7411"), 65);
        assert_eq!(timeout("[ff02::1]:7400"), 65);
        assert_eq!(timeout("10.0.0.2:7411"), 35);
        assert_eq!(reassembly_timeout(&Destination::default()).as_secs(), 35);
    }

    #[test]
    fn of_two_causes_the_one_nearest_to_the_reader_applies() {
        let mut loss_causes = LossCauses::default();
        loss_causes.note(SequenceNumber(5), LossCause::Reassembly, at(1));
        loss_causes.note(SequenceNumber(5), LossCause::SocketBuffer, at(2));
        loss_causes.note(SequenceNumber(7), LossCause::SocketBuffer, at(2));
        loss_causes.note(SequenceNumber(7), LossCause::Reassembly, at(3));
        let socket = Some(LossCause::SocketBuffer);
        assert_eq!(
            explained(&mut loss_causes, 4, 7),
            [(4, 4, None), (5, 5, socket), (6, 6, None), (7, 7, socket)]
        );
        assert_eq!(explained(&mut loss_causes, 4, 7), [(4, 7, None)]);
    }

    #[test]
    fn pending_samples_are_resolved_one_by_one() {
        let mut loss_causes = LossCauses::default();
        assert_eq!(
            loss_causes.wait(SequenceNumber(10), SequenceNumber(12), at(5)),
            None
        );
        assert_eq!(
            loss_causes.wait(SequenceNumber(13), SequenceNumber(13), at(5)),
            None
        );
        assert!(
            loss_causes.resolve(SequenceNumber(11))
                && !loss_causes.resolve(SequenceNumber(11))
                && !loss_causes.resolve(SequenceNumber(14))
        );
        assert!(loss_causes.due(at(4)).is_empty());
        assert_eq!(
            loss_causes.due(at(5)),
            [(10, 10), (12, 13)].map(|(first, last)| (SequenceNumber(first), SequenceNumber(last)))
        );
        assert!(loss_causes.due(at(9)).is_empty());
    }

    #[test]
    fn both_lists_are_bounded_and_evictions_are_reported() {
        let mut loss_causes = LossCauses::default();
        let forgotten = (0..10_000).filter(|number| {
            loss_causes.note(SequenceNumber(2 * number), LossCause::SocketBuffer, at(1))
        });
        assert_eq!(forgotten.count(), 10_000 - KnownLosses::CAP);
        let losses = (0..2000).filter_map(|number| {
            let number = SequenceNumber(2 * number);
            loss_causes.wait(number, number, at(1))
        });
        assert_eq!(losses.count(), 2000 - OpenLosses::CAP);
    }

    #[test]
    fn resolving_every_other_sample_of_a_long_run_keeps_the_number_of_runs_bounded() {
        let mut loss_causes = LossCauses::default();
        loss_causes.wait(SequenceNumber(1), SequenceNumber(100_000), at(1));
        let resolved = (1..50_000).filter(|number| loss_causes.resolve(SequenceNumber(2 * number)));
        assert_eq!(resolved.count(), OpenLosses::CAP - 1);
        assert!(loss_causes.pending.is_full());
        // Removing the end of a run needs no further entry.
        assert!(loss_causes.resolve(SequenceNumber(1)));
        let left = loss_causes.due(at(1)).into_iter();
        let left: u64 = left.map(|(first, last)| last - first + 1).sum();
        assert_eq!(left, 100_000 - OpenLosses::CAP as u64);
    }
}
