//! Counts that are kept back until the participant that receives is known.

use super::Delivery;
use super::Totals;
use crate::facts::journal::Journal;
use crate::measure::samples::Budget;

impl Delivery {
    /// Keeps all counts back until [`Self::publish`] or [`Self::discard`].
    pub fn withhold(&mut self) {
        self.withheld.get_or_insert_default();
    }

    /// Returns whether its counts are kept back.
    #[must_use]
    pub const fn is_withheld(&self) -> bool {
        self.withheld.is_some()
    }

    /// Adds the counts that were kept back to those of the writer.
    pub fn publish(&mut self, journal: &mut Journal, totals: &mut Totals) {
        let Some(losses) = self.withheld.take() else {
            return;
        };
        totals.received.add(&self.tally);
        for loss in losses {
            journal.lose_delivery(loss);
        }
    }

    /// Ends a delivery that was kept back: its samples reached a process without a reader.
    pub fn discard(&mut self, budget: &mut Budget, totals: &mut Totals) {
        totals.received.unmatched += self.tally.messages;
        self.reception.discard(budget);
    }
}
