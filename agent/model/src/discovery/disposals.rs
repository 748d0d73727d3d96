//! What was disposed of a moment ago: copies of an announcement and samples may still be on their
//! way, and must not raise it from the dead.

use std::collections::VecDeque;

use ros2probe_wire::time::MILLISECOND;
use ros2probe_wire::{Guid, GuidPrefix, SequenceNumber, Timestamp};

use super::facts::Origin;
use crate::size::Size;

/// Announcements older than a disposal are stale, for this long after it.
const STALE_WITHIN: u64 = 500 * MILLISECOND;
const MAX_DISPOSALS: usize = 256;
/// Samples on their way arrive within this.
const UNDER_WAY: u64 = 4 * STALE_WITHIN;

/// The latest disposals, oldest first.
#[derive(Debug, Default)]
pub(super) struct Disposals {
    /// What, when, and by which sender's which sample.
    latest: VecDeque<(Guid, Timestamp, GuidPrefix, SequenceNumber)>,
}

impl Disposals {
    /// Entries and cap.
    pub(super) fn sizes(&self) -> [Size; 1] {
        // A new table does not compile before it has a place here.
        let Self { latest } = self;
        [Size::new(
            "discovery.disposals",
            latest.len(),
            MAX_DISPOSALS,
        )]
    }

    pub(super) fn add(&mut self, guid: Guid, origin: &Origin) {
        if self.latest.len() >= MAX_DISPOSALS {
            self.latest.pop_front();
        }
        let disposal = (guid, origin.at, origin.sender, origin.sequence_number);
        self.latest.push_back(disposal);
    }

    /// Whether this one was disposed of so recently that it may still be heard.
    pub(super) fn is_recent(&self, guid: Guid, now: Timestamp) -> bool {
        let fresh = |at: Timestamp| at.0.saturating_add(UNDER_WAY) > now.0;
        self.latest
            .iter()
            .any(|(disposed, at, ..)| *disposed == guid && fresh(*at))
    }

    /// A copy of an announcement that its own disposal overtook.
    pub(super) fn is_stale(&self, guid: Guid, origin: &Origin) -> bool {
        self.latest
            .iter()
            .rev()
            .any(|(disposed, at, sender, number)| {
                *disposed == guid
                    && *sender == origin.sender
                    && *number > origin.sequence_number
                    && at.0.saturating_add(STALE_WITHIN) > origin.at.0
            })
    }
}
