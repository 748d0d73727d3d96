//! Counters of participants, endpoints and nodes that appeared, changed and vanished, for alerts on
//! unstable robots. The number of counters is bounded by the kinds of events and the domains that
//! ports allow.

use std::collections::BTreeMap;

use crate::facts::bounded::Bounded;
use crate::facts::tables::ChurnCounts;
use ros2probe_wire::DomainId;
use ros2probe_wire::discovery::Role;

/// Kind of the entity.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Entity {
    /// A participant.
    Participant,
    /// A writer.
    Writer,
    /// A reader.
    Reader,
    /// A node.
    Node,
}

/// Kind of the change.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Event {
    /// Announced for the first time, or again after its removal.
    Appeared,
    /// Announced with other properties.
    Changed,
    /// Removed by its own disposal.
    Disposed,
    /// Removed because its lease expired.
    Expired,
    /// Removed together with its participant.
    Cascaded,
}

impl Entity {
    /// Returns the entity for an endpoint of this role.
    #[must_use]
    pub const fn of(role: Role) -> Self {
        match role {
            Role::Writer => Self::Writer,
            Role::Reader => Self::Reader,
        }
    }

    /// Returns the label value.
    #[must_use]
    pub const fn label(self) -> &'static str {
        match self {
            Self::Participant => "participant",
            Self::Writer => "writer",
            Self::Reader => "reader",
            Self::Node => "node",
        }
    }
}

impl Event {
    /// Returns the label value.
    #[must_use]
    pub const fn label(self) -> &'static str {
        match self {
            Self::Appeared => "appeared",
            Self::Changed => "changed",
            Self::Disposed => "disposed",
            Self::Expired => "expired",
            Self::Cascaded => "cascaded",
        }
    }
}

/// The number of discovery events of one kind.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ChurnCount {
    /// Domain of the entities.
    pub domain_id: DomainId,
    /// `participant`, `writer`, `reader`, `node`.
    pub entity: &'static str,
    /// `appeared`, `changed`, `disposed`, `expired`, `cascaded`.
    pub event: &'static str,
    /// Number of events.
    pub count: u64,
}

/// The counters of all domains.
#[derive(Debug, Default)]
pub struct Churn {
    counts: Bounded<ChurnCounts, BTreeMap<(DomainId, Entity, Event), u64>>,
}

impl Churn {
    /// Increments a counter.
    pub fn count(&mut self, domain_id: DomainId, entity: Entity, event: Event) {
        let key = (domain_id, entity, event);
        if let Some(count) = self.counts.get_or_insert_with(key, u64::default) {
            *count += 1;
        }
    }

    /// Returns all counters above zero, sorted.
    #[must_use]
    pub fn facts(&self) -> Vec<ChurnCount> {
        let fact =
            |((domain_id, entity, event), count): (&(DomainId, Entity, Event), &u64)| ChurnCount {
                domain_id: *domain_id,
                entity: entity.label(),
                event: event.label(),
                count: *count,
            };
        self.counts.iter().map(fact).collect()
    }
}
