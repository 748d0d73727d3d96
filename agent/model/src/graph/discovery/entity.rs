//! The subject of a discovery event, in the forms for counters, journal and events.

use std::sync::Arc;

use ros2probe_wire::discovery::Role;
use ros2probe_wire::{DomainId, Guid};

use super::facts::{Endpoint, ParticipantProxy};
use crate::facts::churn::{Entity, Event};
use crate::facts::event::{EventKind, MAX_TEXT, truncated};
use crate::facts::names::{DdsName, NodeName, TypeName};

/// A participant, endpoint or node.
pub(super) struct DiscoveredEntity<'a> {
    pub(super) domain_id: DomainId,
    pub(super) guid: Guid,
    details: EntityDetails<'a>,
}

/// Kind and details. Names are shared, since an endpoint is often removed before its event.
enum EntityDetails<'a> {
    Participant(&'a ParticipantProxy),
    Endpoint(Role, DdsName, TypeName),
    Node(&'a NodeName),
}

impl<'a> DiscoveredEntity<'a> {
    pub(super) const fn participant(
        domain_id: DomainId,
        guid: Guid,
        proxy: &'a ParticipantProxy,
    ) -> Self {
        Self {
            domain_id,
            guid,
            details: EntityDetails::Participant(proxy),
        }
    }

    pub(super) fn endpoint(guid: Guid, endpoint: &Endpoint) -> DiscoveredEntity<'static> {
        let (topic, message_type) = (endpoint.topic.clone(), endpoint.message_type.clone());
        DiscoveredEntity {
            domain_id: endpoint.domain_id,
            guid,
            details: EntityDetails::Endpoint(endpoint.role, topic, message_type),
        }
    }

    /// Describes a node of this participant.
    pub(super) const fn node(domain_id: DomainId, participant: Guid, name: &'a NodeName) -> Self {
        Self {
            domain_id,
            guid: participant,
            details: EntityDetails::Node(name),
        }
    }

    pub(super) const fn entity(&self) -> Entity {
        match self.details {
            EntityDetails::Participant(_) => Entity::Participant,
            EntityDetails::Endpoint(role, ..) => Entity::of(role),
            EntityDetails::Node(_) => Entity::Node,
        }
    }

    /// Returns the topic of an endpoint or the name of a node; empty for a participant.
    pub(super) fn name(&self) -> Arc<str> {
        match &self.details {
            EntityDetails::Participant(_) => Arc::default(),
            EntityDetails::Endpoint(_, topic, _) => topic.shared(),
            EntityDetails::Node(name) => name.shared(),
        }
    }

    /// Returns the event for this change of the entity.
    pub(super) fn event(&self, change: Event) -> EventKind {
        let Self {
            domain_id,
            guid,
            details,
        } = self;
        let (domain_id, guid) = (*domain_id, *guid);
        match details {
            EntityDetails::Participant(proxy) => {
                let text = |text: &Option<Arc<str>>| text.as_deref().map(truncated).map(Into::into);
                EventKind::Participant {
                    change,
                    domain_id,
                    guid,
                    vendor: proxy.vendor,
                    host: text(&proxy.host),
                    process: text(&proxy.process_name),
                }
            }
            EntityDetails::Endpoint(role, topic, message_type) => EventKind::Endpoint {
                change,
                domain_id,
                guid,
                role: *role,
                topic: topic.bounded(MAX_TEXT),
                message_type: message_type.bounded(MAX_TEXT),
            },
            EntityDetails::Node(name) => EventKind::Node {
                change,
                domain_id,
                participant: guid,
                name: name.bounded(MAX_TEXT),
            },
        }
    }
}
