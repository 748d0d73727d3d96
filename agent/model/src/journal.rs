//! The latest events, oldest first: bounded lists for whoever asks what happened, not how often.

use std::collections::VecDeque;
use std::sync::Arc;

use ros2probe_wire::{DomainId, Guid, SequenceNumber, Timestamp};

use super::dispatch::MissedReason;
use super::event::Events;
use super::loss::{DeliveryLoss, Loss};
use super::size::Size;

/// Entries kept of discovery events and of writers' losses each.
const LIMIT: usize = 1024;
/// Entries kept of receivers' losses: several receivers may miss what one writer sent.
const DELIVERY_LIMIT: usize = 4096;
/// Latest entries among which a loss looks for the one it continues.
const RECENT: usize = 16;

/// What happened to one participant, endpoint or node.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct DiscoveryEvent {
    /// When.
    pub at: Timestamp,
    /// In which domain.
    pub domain_id: DomainId,
    /// `participant`, `writer`, `reader`, `node`.
    pub entity: &'static str,
    /// `appeared`, `changed`, `disposed`, `expired`, `cascaded`.
    pub event: &'static str,
    /// Which one; the participant's for a node.
    pub guid: Guid,
    /// Topic of an endpoint, name of a node, empty for a participant.
    pub name: Arc<str>,
}

/// Consecutive samples that subscriptions will not get, until they are taken.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Missing {
    /// Whose.
    pub writer: Guid,
    /// First sequence number.
    pub first: SequenceNumber,
    /// Last sequence number.
    pub last: SequenceNumber,
    /// Why; an incomplete one stands alone.
    pub reason: MissedReason,
}

/// All lists.
#[derive(Debug, Default)]
pub struct Journal {
    discovery: VecDeque<DiscoveryEvent>,
    losses: VecDeque<Loss>,
    delivery_losses: VecDeque<DeliveryLoss>,
    missing: Vec<Missing>,
    /// What waits to be told.
    pub events: Events,
}

impl Journal {
    /// Entries and cap of every list.
    #[must_use]
    pub fn sizes(&self) -> Vec<Size> {
        // A new list does not compile before it has a place here.
        let Self {
            discovery,
            losses,
            delivery_losses,
            missing,
            events,
        } = self;
        let mut sizes = events.sizes();
        sizes.extend([
            Size::new("journal.discovery", discovery.len(), LIMIT),
            Size::new("journal.losses", losses.len(), LIMIT),
            Size::new(
                "journal.delivery_losses",
                delivery_losses.len(),
                DELIVERY_LIMIT,
            ),
            Size::new("journal.missing", missing.len(), LIMIT),
        ]);
        sizes
    }

    /// Discovery events, oldest first.
    pub fn discovery(&self) -> impl Iterator<Item = &DiscoveryEvent> {
        self.discovery.iter()
    }

    /// Losses, oldest first.
    pub fn losses(&self) -> impl Iterator<Item = &Loss> {
        self.losses.iter()
    }

    /// Losses of receivers, by the time when their cause was settled.
    pub fn delivery_losses(&self) -> impl Iterator<Item = &DeliveryLoss> {
        self.delivery_losses.iter()
    }

    /// Adds an event.
    pub fn note(&mut self, event: DiscoveryEvent) {
        if self.discovery.len() >= LIMIT {
            self.discovery.pop_front();
        }
        self.discovery.push_back(event);
    }

    /// Keeps samples that will not come for the subscriptions until the next
    /// [`Self::take_missing`].
    pub fn leave_missing(&mut self, missing: Missing) {
        if let Some(last) = self.missing.last_mut()
            && (last.writer, last.reason) == (missing.writer, missing.reason)
            && missing.reason != MissedReason::Incomplete
            && last.last.precedes(missing.first)
        {
            last.last = missing.last;
        } else if self.missing.len() < LIMIT {
            self.missing.push(missing);
        }
    }

    /// Those since the last call.
    pub fn take_missing(&mut self) -> Vec<Missing> {
        std::mem::take(&mut self.missing)
    }

    /// Adds a loss, to the last entry when it continues that one.
    pub fn lose(&mut self, loss: Loss) {
        self.events.lose(&loss);
        if let Some(last) = self.losses.back_mut()
            && last.writer == loss.writer
            && last.last.precedes(loss.first)
        {
            (last.last, last.at) = (loss.last, loss.at);
            return;
        }
        if self.losses.len() >= LIMIT {
            self.losses.pop_front();
        }
        self.losses.push_back(loss);
    }

    /// Adds a receiver's loss, to an entry of the latest when it continues that one.
    pub fn lose_delivery(&mut self, loss: DeliveryLoss) {
        let whose = |loss: &DeliveryLoss| {
            let DeliveryLoss {
                writer,
                participant,
                socket,
                destination,
                cause,
                ..
            } = *loss;
            (writer, participant, socket, destination, cause)
        };
        let mut recent = self.delivery_losses.iter_mut().rev().take(RECENT);
        let continued =
            recent.find(|entry| whose(entry) == whose(&loss) && entry.last.precedes(loss.first));
        if let Some(entry) = continued {
            (entry.last, entry.at) = (loss.last, loss.at);
            return;
        }
        if self.delivery_losses.len() >= DELIVERY_LIMIT {
            self.delivery_losses.pop_front();
        }
        self.delivery_losses.push_back(loss);
    }
}
