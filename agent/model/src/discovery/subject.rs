//! Whom an event of discovery is about, in the forms in which counters, journal and events keep it.

use std::sync::Arc;

use ros2probe_wire::Guid;
use ros2probe_wire::discovery::Role;

use super::facts::{Endpoint, Portrait};
use crate::churn::{Entity, Event};
use crate::event::{EventKind, bounded, bounded_shared};

/// One participant, endpoint or node.
pub(super) struct Subject<'a> {
    pub(super) domain_id: u32,
    pub(super) guid: Guid,
    who: Who<'a>,
}

/// What it is. An endpoint's names are shared, for it is often taken out before it is told of.
enum Who<'a> {
    Participant(&'a Portrait),
    Endpoint(Role, Arc<str>, Arc<str>),
    Node(&'a Arc<str>),
}

impl<'a> Subject<'a> {
    pub(super) const fn participant(domain_id: u32, guid: Guid, portrait: &'a Portrait) -> Self {
        Self {
            domain_id,
            guid,
            who: Who::Participant(portrait),
        }
    }

    pub(super) fn endpoint(guid: Guid, endpoint: &Endpoint) -> Subject<'static> {
        let names = [&endpoint.topic, &endpoint.message_type];
        let [topic, message_type] = names.map(Arc::clone);
        Subject {
            domain_id: endpoint.domain_id,
            guid,
            who: Who::Endpoint(endpoint.role, topic, message_type),
        }
    }

    /// A node of this participant.
    pub(super) const fn node(domain_id: u32, participant: Guid, name: &'a Arc<str>) -> Self {
        Self {
            domain_id,
            guid: participant,
            who: Who::Node(name),
        }
    }

    pub(super) const fn entity(&self) -> Entity {
        match self.who {
            Who::Participant(_) => Entity::Participant,
            Who::Endpoint(role, ..) => Entity::of(role),
            Who::Node(_) => Entity::Node,
        }
    }

    /// Topic of an endpoint, name of a node, empty for a participant.
    pub(super) fn name(&self) -> Arc<str> {
        match &self.who {
            Who::Participant(_) => Arc::default(),
            Who::Endpoint(_, topic, _) => Arc::clone(topic),
            Who::Node(name) => Arc::clone(name),
        }
    }

    /// This happened to it.
    pub(super) fn happened(&self, change: Event) -> EventKind {
        let Self {
            domain_id,
            guid,
            who,
        } = self;
        let (domain_id, guid) = (*domain_id, *guid);
        match who {
            Who::Participant(portrait) => {
                let text = |text: &Option<Box<str>>| text.as_deref().map(bounded).map(Into::into);
                EventKind::Participant {
                    change,
                    domain_id,
                    guid,
                    vendor: portrait.vendor,
                    host: text(&portrait.host),
                    process: text(&portrait.process_name),
                }
            }
            Who::Endpoint(role, topic, message_type) => EventKind::Endpoint {
                change,
                domain_id,
                guid,
                role: *role,
                topic: bounded_shared(topic),
                message_type: bounded_shared(message_type),
            },
            Who::Node(name) => EventKind::Node {
                change,
                domain_id,
                participant: guid,
                name: bounded_shared(name),
            },
        }
    }
}
