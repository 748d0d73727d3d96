//! Counts that are withheld until the receiving participant is known.

use super::Delivery;
use super::Totals;
use crate::facts::journal::Journal;
use crate::measure::samples::Budget;

impl Delivery {
    /// Withholds all counts until [`Self::publish`] or [`Self::discard`].
    pub fn withhold(&mut self) {
        self.withheld.get_or_insert_default();
    }

    /// Returns whether the counts are withheld.
    #[must_use]
    pub const fn is_withheld(&self) -> bool {
        self.withheld.is_some()
    }

    /// Adds the withheld counts to the totals of the writer.
    pub fn publish(&mut self, journal: &mut Journal, totals: &mut Totals) {
        let Some(losses) = self.withheld.take() else {
            return;
        };
        totals.received.add(&self.tally);
        for loss in losses {
            journal.add_delivery_loss(loss);
        }
    }

    /// Ends a withheld delivery: its samples reached a process without a reader.
    pub fn discard(&mut self, budget: &mut Budget, totals: &mut Totals) {
        totals.received.unmatched += self.tally.messages;
        self.reception.discard(budget);
    }
}
