//! The latest events, oldest first: bounded lists for whoever asks what happened, not how often.

use std::collections::VecDeque;
use std::sync::Arc;

use ros2probe_wire::{Guid, Timestamp};

/// Entries kept of either kind.
const LIMIT: usize = 1024;

/// What happened to one participant, endpoint or node.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct DiscoveryEvent {
    /// When.
    pub at: Timestamp,
    /// In which domain.
    pub domain_id: u32,
    /// `participant`, `writer`, `reader`, `node`.
    pub entity: &'static str,
    /// `appeared`, `changed`, `disposed`, `expired`, `cascaded`.
    pub event: &'static str,
    /// Which one; the participant's for a node.
    pub guid: Guid,
    /// Topic of an endpoint, name of a node, empty for a participant.
    pub name: Arc<str>,
}

/// Consecutive samples that were settled as lost.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Loss {
    /// When it was settled.
    pub at: Timestamp,
    /// Whose.
    pub writer: Guid,
    /// First lost sequence number.
    pub first: u64,
    /// Last lost sequence number.
    pub last: u64,
}

/// Both lists.
#[derive(Debug, Default)]
pub struct Journal {
    discovery: VecDeque<DiscoveryEvent>,
    losses: VecDeque<Loss>,
}

impl Journal {
    /// Discovery events, oldest first.
    pub fn discovery(&self) -> impl Iterator<Item = &DiscoveryEvent> {
        self.discovery.iter()
    }

    /// Losses, oldest first.
    pub fn losses(&self) -> impl Iterator<Item = &Loss> {
        self.losses.iter()
    }

    /// Adds an event.
    pub fn note(&mut self, event: DiscoveryEvent) {
        if self.discovery.len() >= LIMIT {
            self.discovery.pop_front();
        }
        self.discovery.push_back(event);
    }

    /// Adds a loss, to the last entry when it continues that one.
    pub fn lose(&mut self, loss: Loss) {
        if let Some(last) = self.losses.back_mut()
            && last.writer == loss.writer
            && last.last.checked_add(1) == Some(loss.first)
        {
            (last.last, last.at) = (loss.last, loss.at);
            return;
        }
        if self.losses.len() >= LIMIT {
            self.losses.pop_front();
        }
        self.losses.push_back(loss);
    }
}
