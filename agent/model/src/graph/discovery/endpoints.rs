//! SEDP: writers and readers, including those that wait for their participant (RTPS 2.5, 8.5.4).

use std::sync::Arc;

use std::cmp::Reverse;

use ros2probe_wire::discovery::EndpointAnnouncement;
use ros2probe_wire::rtps::Locator;
use ros2probe_wire::{Guid, GuidPrefix};

use super::Change;
use super::Discovery;
use super::MAX_NAME_LEN;
use super::PendingEndpoint;
use super::PendingNodes;
use super::endpoints_of;
use super::entity::DiscoveredEntity;
use super::eviction::{Newcomer, Table};
use super::facts::{Endpoint, Origin};
use super::is_named;
use super::priority::Priority;
use crate::facts::churn::Event;
use crate::facts::journal::Journal;
use crate::facts::model_time::ModelTime;

impl Discovery {
    /// Records the SEDP announcement of an endpoint. `evidence` is the priority known for its
    /// participant. Returns whether the participant is thereby admitted.
    pub fn endpoint(
        &mut self,
        announcement: EndpointAnnouncement,
        origin: &Origin,
        evidence: Priority,
        journal: &mut Journal,
    ) -> bool {
        let names = [announcement.topic.as_str(), announcement.type_name.as_str()];
        if names.iter().any(|name| name.len() > MAX_NAME_LEN) {
            self.endpoints.refuse();
            return false;
        }
        if self.disposals.is_stale(announcement.guid, origin) {
            return false;
        }
        let guid = announcement.guid;
        let pending = PendingEndpoint {
            at: origin.at,
            announcement: Box::new(announcement),
        };
        let is_known = self.participants.contains_key(&guid.prefix);
        let pending = match is_known {
            true => self.admit(pending, origin.at, journal),
            false => Some(pending),
        };
        let Some(pending) = pending else {
            self.pending_endpoints.remove(&guid);
            return false;
        };
        let watched = is_named(&self.watchlist, None, &pending.announcement.topic);
        let priority = Priority {
            watched,
            ..evidence
        };
        let is_crowded = self.pending_endpoints.put(guid, priority, pending);
        self.endpoints.refuse_all(u64::from(is_known || is_crowded));
        let is_more = !is_known && self.seen(guid.prefix, origin.at, priority);
        is_more && self.learn(guid.prefix, priority, origin.at, journal)
    }

    /// Records the SEDP disposal of an endpoint.
    pub fn endpoint_gone(&mut self, guid: Guid, origin: &Origin, journal: &mut Journal) {
        self.disposals.add(guid, origin);
        self.pending_endpoints.remove(&guid);
        if let Some(participant) = self.participants.get_mut(&guid.prefix) {
            participant.endpoints.remove(&guid);
        }
        self.drop_endpoint(guid, Some(Event::Disposed), origin.at, journal);
    }

    /// Adds an announced endpoint to its known participant, or returns it if the table is full.
    fn admit(
        &mut self,
        pending: PendingEndpoint,
        at: ModelTime,
        journal: &mut Journal,
    ) -> Option<PendingEndpoint> {
        let announcement = &pending.announcement;
        let guid = announcement.guid;
        let participant = self.participants.get_mut(&guid.prefix)?;
        let domain_id = participant.domain_id;
        if let Some(known) = self.endpoints.get_mut(&guid) {
            if *known.topic == *announcement.topic.as_str() {
                let before = (
                    (known.type_hash, known.equivalence_hash),
                    Arc::clone(&known.qos),
                    known.message_type.clone(),
                    (known.backends.clone(), known.base, known.content_filter),
                );
                if *known.qos != announcement.qos {
                    known.qos = Arc::new(announcement.qos.clone());
                }
                if known.backends.as_deref() != announcement.backends.as_ref() {
                    known.backends = announcement.backends.clone().map(Arc::new);
                }
                known.base = announcement.base;
                known.content_filter = announcement.content_filter;
                known.type_hash = announcement.type_hash;
                known.equivalence_hash = announcement.equivalence_hash;
                known.message_type = announcement.type_name.message().as_str().into();
                let unchanged = before.0 == (known.type_hash, known.equivalence_hash)
                    && before.1 == known.qos
                    && before.2 == known.message_type
                    && before.3 == (known.backends.clone(), known.base, known.content_filter);
                if !unchanged {
                    let entity = DiscoveredEntity::endpoint(guid, known);
                    self.changes.push(Change::Changed(guid));
                    self.note(&entity, Event::Changed, at, journal);
                }
                return None;
            }
            // The GUID now belongs to another topic, so the agent missed its disposal.
            participant.endpoints.remove(&guid);
            self.drop_endpoint(guid, Some(Event::Disposed), at, journal);
        }
        let participant = self.participants.get(&guid.prefix)?;
        let watched = is_named(&self.watchlist, Some(domain_id), &announcement.topic);
        let priority = Priority {
            watched,
            ..participant.priority()
        };
        if participant.endpoints.is_full() {
            return Some(pending);
        }
        let is_full = self.endpoints.is_full();
        if is_full && !self.evict_for(Table::Endpoints, Newcomer { guid, priority }, at) {
            return Some(pending);
        }
        let announcement = pending.announcement;
        let unicast = &announcement.unicast;
        let shared_memory =
            (!unicast.is_empty()).then(|| unicast.iter().any(Locator::is_shared_memory));
        let tcp = (!unicast.is_empty()).then(|| Locator::are_tcp(unicast));
        let endpoint = Endpoint {
            gid: announcement.gid,
            role: announcement.role,
            domain_id,
            topic: announcement.topic.as_str().into(),
            message_type: announcement.type_name.message().as_str().into(),
            type_hash: announcement.type_hash,
            equivalence_hash: announcement.equivalence_hash,
            qos: Arc::new(announcement.qos),
            first_seen: at,
            shared_memory,
            tcp,
            data_sharing: announcement.datasharing,
            content_filter: announcement.content_filter,
            backends: announcement.backends.map(Arc::new),
            base: announcement.base,
            watched,
        };
        let entity = DiscoveredEntity::endpoint(guid, &endpoint);
        self.endpoints.insert(guid, Box::new(endpoint));
        if let Some(participant) = self.participants.get_mut(&guid.prefix) {
            participant.endpoints.insert(guid);
            participant.watched += usize::from(watched);
        }
        self.changes.push(Change::Appeared(guid));
        self.note(&entity, Event::Appeared, at, journal);
        None
    }

    /// Admits waiting endpoints and nodes of this participant, by priority, until the table is
    /// full.
    pub(super) fn adopt_pending(
        &mut self,
        prefix: GuidPrefix,
        at: ModelTime,
        journal: &mut Journal,
    ) {
        let waiting = self.pending_endpoints.range(endpoints_of(prefix));
        let mut waiting: Vec<_> = waiting.collect();
        waiting.sort_by_key(|(_, priority)| Reverse(*priority));
        for (guid, priority) in waiting {
            let Some((_, pending)) = self.pending_endpoints.remove(&guid) else {
                continue;
            };
            if let Some(pending) = self.admit(pending, at, journal) {
                self.pending_endpoints.put(guid, priority, pending);
                break;
            }
        }
        if let Some(pending) = self.pending_nodes.remove(&prefix) {
            let PendingNodes {
                writer,
                sequence_number,
                nodes,
                ..
            } = pending;
            self.set_nodes(prefix, writer, sequence_number, nodes, at, journal);
        }
    }

    pub(super) fn drop_endpoint(
        &mut self,
        guid: Guid,
        event: Option<Event>,
        at: ModelTime,
        journal: &mut Journal,
    ) {
        let Some(endpoint) = self.endpoints.remove(&guid) else {
            return;
        };
        if let Some(participant) = self.participants.get_mut(&guid.prefix) {
            let watched = usize::from(endpoint.watched);
            participant.watched = participant.watched.saturating_sub(watched);
        }
        if let Some(event) = event {
            self.note(
                &DiscoveredEntity::endpoint(guid, &endpoint),
                event,
                at,
                journal,
            );
        }
        self.changes.push(Change::Gone(guid, endpoint));
    }
}
