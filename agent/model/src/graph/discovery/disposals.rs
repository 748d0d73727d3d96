//! Recent disposals, so that delayed announcements or samples do not bring the entity back.

use std::collections::VecDeque;
use std::time::Duration;

use ros2probe_wire::{Guid, GuidPrefix, SequenceNumber};

use super::facts::Origin;
use crate::facts::bounded::Bounded;
use crate::facts::model_time::ModelTime;
use crate::facts::tables::LatestDisposals;

/// Time after a disposal during which older announcements are ignored.
const STALE_WITHIN: Duration = Duration::from_millis(500);
/// Time after a disposal during which samples that were sent before may still arrive.
const MAX_TRANSMISSION_TIME: Duration = Duration::from_secs(2);

/// The latest disposals, oldest first.
#[derive(Debug, Default)]
pub(super) struct Disposals {
    /// The GUID, the time, and the sender and sequence number of the disposal.
    latest: Bounded<LatestDisposals, VecDeque<(Guid, ModelTime, GuidPrefix, SequenceNumber)>>,
}

impl Disposals {
    pub(super) fn add(&mut self, guid: Guid, origin: &Origin) {
        let disposal = (guid, origin.at, origin.sender, origin.sequence_number);
        self.latest.push_back(disposal);
    }

    /// Returns whether the entity was disposed so recently that its samples may still arrive.
    pub(super) fn is_recent(&self, guid: Guid, now: ModelTime) -> bool {
        let fresh = |at: ModelTime| at + MAX_TRANSMISSION_TIME > now;
        self.latest
            .iter()
            .any(|(disposed, at, ..)| *disposed == guid && fresh(*at))
    }

    /// Returns whether an announcement is a delayed copy from before the entity's disposal.
    pub(super) fn is_stale(&self, guid: Guid, origin: &Origin) -> bool {
        self.latest
            .iter()
            .rev()
            .any(|(disposed, at, sender, number)| {
                *disposed == guid
                    && *sender == origin.sender
                    && *number > origin.sequence_number
                    && *at + STALE_WITHIN > origin.at
            })
    }
}
