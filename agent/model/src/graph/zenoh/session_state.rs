//! State of a session: its nodes, endpoints and tokens, and its announcements in the terms of DDS.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;
use std::time::Duration;

use ros2probe_wire::discovery::ParticipantAnnouncement;
use ros2probe_wire::entities::{NodeEntities, ParticipantEntities};
use ros2probe_wire::rtps::VendorId;
use ros2probe_wire::zenoh::ZenohId;
use ros2probe_wire::{DomainId, EntityId, Guid, RtpsDuration};

use crate::facts::model_time::ModelTime;
/// A session with tokens.
#[derive(Debug)]
pub(super) struct SessionState {
    pub(super) domain: DomainId,
    pub(super) enclave: Box<str>,
    pub(super) lease: Option<Duration>,
    pub(super) nodes: BTreeMap<u64, NodeState>,
    pub(super) tokens: BTreeSet<Arc<str>>,
    /// Time of its last repeated announcement.
    pub(super) repeated: ModelTime,
}

/// A node of a session.
#[derive(Debug, Default)]
pub(super) struct NodeState {
    pub(super) namespace: Box<str>,
    pub(super) name: Box<str>,
    pub(super) has_token: bool,
    pub(super) writers: Vec<Guid>,
    pub(super) readers: Vec<Guid>,
}

impl SessionState {
    /// Returns the announcement of the session as a participant.
    pub(super) fn announcement(&self, session: ZenohId) -> ParticipantAnnouncement {
        let guid = Guid::new(session.guid_prefix(), EntityId::PARTICIPANT);
        ParticipantAnnouncement {
            lease: self
                .lease
                .map_or(RtpsDuration::Infinite, RtpsDuration::Finite),
            domain_id: Some(self.domain),
            enclave: Some(self.enclave.to_string()),
            ..ParticipantAnnouncement::new(guid, VendorId::ZENOH)
        }
    }

    /// Returns its nodes with their endpoints.
    pub(super) fn entities(&self, session: ZenohId) -> ParticipantEntities {
        let nodes = self.nodes.values().map(|node| NodeEntities {
            namespace: node.namespace.to_string(),
            name: node.name.to_string(),
            readers: node.readers.clone(),
            writers: node.writers.clone(),
        });
        ParticipantEntities {
            participant: Guid::new(session.guid_prefix(), EntityId::PARTICIPANT),
            nodes: nodes.collect(),
        }
    }
}
