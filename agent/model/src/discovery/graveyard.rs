//! What was disposed of a moment ago: copies of an announcement and samples may still be on their
//! way, and must not raise it from the dead.

use std::collections::VecDeque;

use ros2probe_wire::time::MILLISECOND;
use ros2probe_wire::{Guid, GuidPrefix, Timestamp};

use super::facts::Origin;
use crate::size::Size;

/// Announcements older than a disposal are stale, for this long after it.
const BURIED: u64 = 500 * MILLISECOND;
const BURIALS: usize = 256;
/// Samples on their way arrive within this.
const UNDER_WAY: u64 = 4 * BURIED;

/// The latest disposals, oldest first.
#[derive(Debug, Default)]
pub(super) struct Graveyard {
    /// What, when, and by which sender's which sample.
    graves: VecDeque<(Guid, Timestamp, GuidPrefix, u64)>,
}

impl Graveyard {
    /// Entries and cap.
    pub(super) fn sizes(&self) -> [Size; 1] {
        // A new table does not compile before it has a place here.
        let Self { graves } = self;
        [Size::new("discovery.graveyard", graves.len(), BURIALS)]
    }

    pub(super) fn bury(&mut self, guid: Guid, origin: &Origin) {
        if self.graves.len() >= BURIALS {
            self.graves.pop_front();
        }
        let grave = (guid, origin.at, origin.sender, origin.sequence_number);
        self.graves.push_back(grave);
    }

    /// Whether this one was disposed of so recently that it may still be heard.
    pub(super) fn holds(&self, guid: Guid, now: Timestamp) -> bool {
        let fresh = |at: Timestamp| at.0.saturating_add(UNDER_WAY) > now.0;
        self.graves
            .iter()
            .any(|(buried, at, ..)| *buried == guid && fresh(*at))
    }

    /// A copy of an announcement that its own disposal overtook.
    pub(super) fn is_stale(&self, guid: Guid, origin: &Origin) -> bool {
        self.graves
            .iter()
            .rev()
            .any(|(buried, at, sender, number)| {
                *buried == guid
                    && *sender == origin.sender
                    && *number > origin.sequence_number
                    && at.0.saturating_add(BURIED) > origin.at.0
            })
    }
}
