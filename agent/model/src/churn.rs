//! How often participants, endpoints and nodes came and went: the counters behind an alert on a
//! flapping robot. Bounded: few kinds, and no more domains than ports allow.

use std::collections::BTreeMap;

use ros2probe_wire::DomainId;
use ros2probe_wire::discovery::Role;

use super::size::Size;

/// Who.
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

/// What happened.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Event {
    /// Announced for the first time, or again after it was gone.
    Appeared,
    /// Announced with other properties.
    Changed,
    /// It said goodbye.
    Disposed,
    /// Its lease ran out.
    Expired,
    /// It went with its participant.
    Cascaded,
}

impl Entity {
    /// Of an endpoint.
    #[must_use]
    pub const fn of(role: Role) -> Self {
        match role {
            Role::Writer => Self::Writer,
            Role::Reader => Self::Reader,
        }
    }

    /// Label value.
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
    /// Label value.
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

/// One kind of discovery event.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ChurnCount {
    /// Domain.
    pub domain_id: DomainId,
    /// `participant`, `writer`, `reader`, `node`.
    pub entity: &'static str,
    /// `appeared`, `changed`, `disposed`, `expired`, `cascaded`.
    pub event: &'static str,
    /// How often.
    pub count: u64,
}

/// The counters.
#[derive(Debug, Default)]
pub struct Churn {
    counts: BTreeMap<(DomainId, Entity, Event), u64>,
}

impl Churn {
    /// Entries and cap: of every domain that UDP has ports for, each entity and event.
    #[must_use]
    pub fn sizes(&self) -> [Size; 1] {
        // A new table does not compile before it has a place here.
        let Self { counts } = self;
        let cap = 233 * 4 * 5;
        [Size::new("discovery.churn", counts.len(), cap)]
    }

    /// Counts one.
    pub fn count(&mut self, domain_id: DomainId, entity: Entity, event: Event) {
        *self.counts.entry((domain_id, entity, event)).or_default() += 1;
    }

    /// All counters that are not zero, sorted.
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
