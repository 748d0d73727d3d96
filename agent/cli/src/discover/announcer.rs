//! One builtin writer of a participant, with its received and missing announcements.

use ros2probe_wire::SequenceNumber;
use std::collections::BTreeSet;
use std::ops::RangeInclusive;

use ros2probe_model::facts::observation::Gap;
use ros2probe_wire::EntityId;
use ros2probe_wire::discovery::Role;

use crate::tables::ReceivedAnnouncements;
use ros2probe_model::facts::bounded::Bounded;

use super::message::{MAX_NUMBERS, PUBLICATIONS_READER, SUBSCRIPTIONS_READER};

/// A writer of announcements and its state.
#[derive(Debug)]
pub(super) struct Announcer {
    pub(super) writer: EntityId,
    pub(super) reader: EntityId,
    pub(super) role: Role,
    /// First and last sequence number in its HEARTBEAT.
    pub(super) available: Option<RangeInclusive<SequenceNumber>>,
    pub(super) received: Bounded<ReceivedAnnouncements, BTreeSet<SequenceNumber>>,
    /// Sequence numbers of the last request.
    requested: BTreeSet<SequenceNumber>,
}

impl Announcer {
    pub(super) fn of(role: Role) -> Self {
        let (writer, reader) = match role {
            Role::Writer => (EntityId::SEDP_PUBLICATIONS_WRITER, PUBLICATIONS_READER),
            Role::Reader => (EntityId::SEDP_SUBSCRIPTIONS_WRITER, SUBSCRIPTIONS_READER),
        };
        Self {
            writer,
            reader,
            role,
            available: None,
            received: Bounded::default(),
            requested: BTreeSet::new(),
        }
    }

    /// Returns the available sequence numbers that have not arrived, lowest first.
    pub(super) fn missing(&self) -> impl Iterator<Item = SequenceNumber> + '_ {
        let (first, last) = match &self.available {
            Some(range) => (*range.start(), *range.end()),
            None => (SequenceNumber::FIRST, SequenceNumber::ZERO),
        };
        let first = first.max(SequenceNumber::FIRST);
        let last = last.min(first.saturating_add(ReceivedAnnouncements::CAP as u64 - 1));
        first
            .until(last.next())
            .filter(|number| !self.received.contains(number))
    }

    /// Returns the sequence numbers for the next request, at most as many as one request holds.
    pub(super) fn next_request(&mut self) -> BTreeSet<SequenceNumber> {
        let first = self.missing().next().unwrap_or_default();
        let wanted: BTreeSet<_> = self
            .missing()
            .take_while(|number| *number - first < MAX_NUMBERS)
            .collect();
        self.requested.clone_from(&wanted);
        wanted
    }

    /// Returns whether all requested samples have arrived.
    pub(super) fn is_answered(&self) -> bool {
        self.requested.is_subset(&self.received)
    }

    /// Handles a GAP: these samples will never arrive.
    pub(super) fn skip(&mut self, gap: &Gap) {
        let (irrelevant, list) = (gap.start..gap.list.base, gap.list);
        let listed: BTreeSet<SequenceNumber> = list.iter().collect();
        let skipped: Vec<SequenceNumber> = self
            .missing()
            .filter(|number| irrelevant.contains(number) || listed.contains(number))
            .collect();
        for number in skipped {
            self.received.insert(number);
        }
    }
}
