//! The latest events, oldest first, in bounded lists.

use std::collections::VecDeque;
use std::sync::Arc;

use ros2probe_wire::{DomainId, Guid, SequenceNumber};

use crate::facts::bounded::Bounded;
use crate::facts::dispatch::MissedReason;
use crate::facts::event::Events;
use crate::facts::loss::{DeliveryLoss, Loss};
use crate::facts::model_time::ModelTime;
use crate::facts::repairs::RepairLog;
use crate::facts::tables::{DiscoveryEvents, LatestDeliveryLosses, LatestLosses, MissingSamples};

/// Number of the latest entries that a new loss may extend.
const MAX_EXTENDED: usize = 16;

/// A change of a participant, endpoint or node.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct DiscoveryEvent {
    /// Time of the event.
    pub at: ModelTime,
    /// Domain of the entity.
    pub domain_id: DomainId,
    /// `participant`, `writer`, `reader`, `node`.
    pub entity: &'static str,
    /// `appeared`, `changed`, `disposed`, `expired`, `cascaded`.
    pub event: &'static str,
    /// GUID of the entity; for a node, its participant's.
    pub guid: Guid,
    /// Topic of an endpoint or name of a node; empty for a participant.
    pub name: Arc<str>,
}

/// Consecutive samples that subscriptions will not receive.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Missing {
    /// GUID of the writer.
    pub writer: Guid,
    /// First sequence number.
    pub first: SequenceNumber,
    /// Last sequence number.
    pub last: SequenceNumber,
    /// Reason; an incomplete sample has an entry of its own.
    pub reason: MissedReason,
}

/// All lists.
#[derive(Debug, Default)]
pub struct Journal {
    discovery: Bounded<DiscoveryEvents, VecDeque<DiscoveryEvent>>,
    losses: Bounded<LatestLosses, VecDeque<Loss>>,
    delivery_losses: Bounded<LatestDeliveryLosses, VecDeque<DeliveryLoss>>,
    missing: Bounded<MissingSamples, Vec<Missing>>,
    /// Events that wait to be taken.
    pub events: Events,
    /// Retransmissions that arrived.
    pub repairs: RepairLog,
}

impl Journal {
    /// Returns discovery events, oldest first.
    pub fn discovery(&self) -> impl Iterator<Item = &DiscoveryEvent> {
        self.discovery.iter()
    }

    /// Returns losses, oldest first.
    pub fn losses(&self) -> impl Iterator<Item = &Loss> {
        self.losses.iter()
    }

    /// Returns losses of receivers, in the order in which their causes were settled.
    pub fn delivery_losses(&self) -> impl Iterator<Item = &DeliveryLoss> {
        self.delivery_losses.iter()
    }

    /// Adds an event.
    pub fn note(&mut self, event: DiscoveryEvent) {
        self.discovery.push_back(event);
    }

    /// Records samples that subscriptions will not receive, until the next [`Self::take_missing`].
    pub fn add_missing(&mut self, missing: Missing) {
        if let Some(last) = self.missing.last_mut()
            && (last.writer, last.reason) == (missing.writer, missing.reason)
            && missing.reason != MissedReason::Incomplete
            && last.last.precedes(missing.first)
        {
            last.last = missing.last;
        } else {
            self.missing.push(missing);
        }
    }

    /// Removes and returns the missing samples since the last call.
    pub fn take_missing(&mut self) -> Vec<Missing> {
        self.missing.take()
    }

    /// Adds a loss, extending the last entry if the loss continues it. The loss becomes an event
    /// unless its receivers report it.
    pub fn add_loss(&mut self, loss: Loss, has_receivers: bool) {
        if !has_receivers {
            self.events.add_loss(&loss);
        }
        if let Some(last) = self.losses.back_mut()
            && last.writer == loss.writer
            && last.last.precedes(loss.first)
        {
            (last.last, last.at) = (loss.last, loss.at);
            return;
        }
        self.losses.push_back(loss);
    }

    /// Adds a receiver's loss, extending one of the latest entries if the loss continues it.
    pub fn add_delivery_loss(&mut self, loss: DeliveryLoss) {
        let key_of = |loss: &DeliveryLoss| {
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
        let mut recent = self.delivery_losses.iter_mut().rev().take(MAX_EXTENDED);
        let continued =
            recent.find(|entry| key_of(entry) == key_of(&loss) && entry.last.precedes(loss.first));
        if let Some(entry) = continued {
            (entry.last, entry.at) = (loss.last, loss.at);
            return;
        }
        self.delivery_losses.push_back(loss);
    }
}
