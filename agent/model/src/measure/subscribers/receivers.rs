//! Views of the deliveries, except withheld ones.

use super::Subscribers;
use crate::facts::loss_share::{LossShare, RecentLoss};
use crate::facts::route::Direction;
use crate::facts::route::Receiver;
use crate::measure::delivery::Delivery;
use crate::measure::routes::KnownRoute;

impl Subscribers {
    /// Returns each delivery, incoming or outgoing, with its routes.
    pub fn deliveries(&self) -> impl Iterator<Item = (&Delivery, Vec<&KnownRoute>)> {
        let deliveries = self.with_routes();
        deliveries.filter(|(delivery, _)| !delivery.is_withheld())
    }

    pub(super) fn with_routes(&self) -> impl Iterator<Item = (&Delivery, Vec<&KnownRoute>)> {
        self.deliveries.iter().map(|delivery| {
            let leads_there = |known: &&KnownRoute| match delivery.receiver() {
                Receiver::Route(route) => known.route == route,
                Receiver::Participant(prefix) => {
                    known.route.direction == Direction::Received && known.owner == Some(prefix)
                }
            };
            (delivery, self.routes.iter().filter(leads_there).collect())
        })
    }

    /// Returns whether the samples of any receiver are counted.
    #[must_use]
    pub fn has_receivers(&self) -> bool {
        self.received().next().is_some()
    }

    /// Returns the losses of each receiver in the last seconds.
    pub fn losses(&self) -> impl Iterator<Item = (Receiver, &RecentLoss)> {
        let received = self.received();
        received.map(|delivery| (delivery.receiver(), delivery.recent()))
    }

    /// Removes and returns the losses of the worst receiver that left since the last call.
    pub fn take_departed(&mut self) -> LossShare {
        std::mem::take(&mut self.departed)
    }

    /// Returns the number of samples that are missing at a receiver and may still arrive.
    #[must_use]
    pub fn awaited(&self) -> u64 {
        let received = self.received();
        received.map(|delivery| delivery.facts().awaited).sum()
    }

    pub(super) fn received(&self) -> impl Iterator<Item = &Delivery> {
        self.deliveries
            .iter()
            .filter(|delivery| !delivery.main_route().is_sent() && !delivery.is_withheld())
    }
}
