//! Expected and lost samples of a delivery, in total and in the last seconds.

use super::Delivered;
use super::Delivery;
use crate::facts::loss_share::{LossShare, RecentLoss};
use crate::facts::route::Direction;

impl Delivery {
    /// Returns the counts, including the samples that are neither delivered nor lost yet.
    #[must_use]
    pub fn facts(&self) -> Delivered {
        let awaited = match self.direction() {
            Direction::Sent => 0,
            Direction::Received => self.reception.sequence().undecided() + self.overdue,
        };
        Delivered {
            awaited,
            ..self.tally
        }
    }

    /// Returns the losses of the last seconds.
    #[must_use]
    pub const fn recent(&self) -> &RecentLoss {
        &self.recent
    }

    /// Ends one second of the recent losses.
    pub fn end_second(&mut self) {
        self.recent.end_second(self.share());
    }

    /// Returns whether the end of a second leaves the recent losses as they are.
    #[must_use]
    pub fn is_quiet(&self) -> bool {
        self.recent.is_quiet(self.share())
    }

    /// Returns the losses since the end of the last second.
    #[must_use]
    pub fn last_share(&self) -> LossShare {
        self.recent.since(self.share())
    }

    const fn share(&self) -> LossShare {
        let lost = self.tally.lost();
        LossShare {
            lost,
            expected: self.tally.messages - self.tally.history + lost,
        }
    }
}
