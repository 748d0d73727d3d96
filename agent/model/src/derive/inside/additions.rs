//! Counts that a report adds to the topics, from the figures of each handle.

use super::topics::{Live, TopicAdded};
use super::tracked::{Added, Detail, Kind, Tracked};
use crate::facts::calls::report::Trigger;

impl Live {
    /// Counts a live handle.
    pub(super) fn count(&mut self, tracked: &Tracked) {
        match (tracked.figures.kind, &tracked.figures.detail) {
            (Kind::Publisher, _) => self.publishers += 1,
            (Kind::Subscription, _) => self.subscriptions += 1,
            (Kind::Buffer, Detail::Buffer { depth, .. }) => {
                self.subscriptions += 1;
                self.depth += u64::from(*depth);
            }
            // Humble shows a subscription within a process only by its callback.
            (Kind::Callback, _)
                if matches!(tracked.figures.trigger(), Some(Trigger::IntraProcess(_))) =>
            {
                self.receivers += 1;
            }
            (Kind::Buffer | Kind::Callback, _) => {}
        }
    }
}

impl TopicAdded {
    /// Adds the new counts of one handle. `both` has the publications of the process, and the
    /// receptions of the callback with the most receptions.
    pub(super) fn take(
        &mut self,
        tracked: &Tracked,
        added: &Added,
        both: &mut (u64, u64),
        shows_intra_process: bool,
    ) {
        let counts = added.counts;
        if counts.count == 0 && counts.failed == 0 && counts.within == 0 {
            return;
        }
        let sums = &mut self.counts;
        match tracked.figures.kind {
            Kind::Publisher => {
                both.0 += counts.count;
                sums.within_process += counts.within;
            }
            Kind::Subscription => {
                sums.taken += counts.count;
                sums.failed += counts.failed;
                self.taken_by_one = self.taken_by_one.max(counts.count);
            }
            Kind::Buffer => {
                sums.enqueued += counts.count;
                sums.overwritten += counts.failed;
                sums.dequeued += counts.within;
            }
            Kind::Callback => {
                if !matches!(tracked.figures.trigger(), Some(Trigger::IntraProcess(_))) {
                    return;
                }
                sums.receptions += counts.count;
                if !shows_intra_process {
                    both.1 = both.1.max(counts.count);
                }
            }
        }
        self.last = self.last.max(Some(tracked.figures.last));
        let delays = match tracked.figures.kind {
            Kind::Subscription => &mut self.latency,
            Kind::Buffer => &mut self.waiting,
            Kind::Publisher | Kind::Callback => return,
        };
        if let Some(delay) = &added.delay {
            delays.get_or_insert_default().merge(delay);
        }
    }
}
