//! Discovered participants, their endpoints and their nodes.
//!
//! Identities come from payloads, because a packet's sender may relay announcements of others. A
//! participant is removed, with its endpoints and nodes, when it is disposed or its lease expires.
//! The lease of one that only others have announced does not expire: they announce it once, and
//! dispose of it. A repeated announcement of a participant does not change its endpoints. Every
//! table is capped. In a full table, a new entry replaces only silent entries or entries with a
//! lower priority. Forged announcements therefore do not displace real entries.

mod disposals;
mod endpoints;
mod entity;
mod eviction;
mod facts;
mod memory;
mod nodes;
mod pending;
mod priority;

use std::ops::RangeInclusive;
use std::sync::Arc;
use std::time::Duration;

use foldhash::HashMap;
use ros2probe_wire::discovery::{EndpointAnnouncement, ParticipantAnnouncement};
use ros2probe_wire::names::DdsTopic;
use ros2probe_wire::{DomainId, EntityId, Guid, GuidPrefix, SequenceNumber};

use crate::facts::bounded::TableFacts;
use crate::facts::bounded::{Bounded, Counted, Sum};
use crate::facts::churn::{Churn, Event};
use crate::facts::journal::{DiscoveryEvent, Journal};
use crate::facts::model_time::ModelTime;
use crate::facts::naming::Naming;
use crate::facts::tables::{
    Applicants, Endpoints, Nodes, Participants, PendingEndpoints, PendingNodeLists,
};
use crate::facts::watch::Watchlist;
use disposals::Disposals;
use entity::DiscoveredEntity;
use eviction::{Newcomer, Table, Victims};
pub use facts::{Addresses, DomainSource, Endpoint, Node, Origin, Participant, ParticipantProxy};
use facts::{Relayers, domain, named};
pub use memory::{Memory, hexadecimal};
use pending::PendingTable;
pub use priority::Priority;

const PENDING_TIMEOUT: Duration = Duration::from_secs(60);
/// Maximum length of a topic or type name: `string<256>` in the builtin topics of DDS. Longer names
/// are rejected to bound memory.
const MAX_NAME_LEN: usize = 256;

/// Capacities of the tables.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Caps {
    /// Participants.
    pub participants: usize,
    /// Endpoints.
    pub endpoints: usize,
    /// Nodes.
    pub nodes: usize,
}

/// A change that the rest of the model has to apply.
#[derive(Debug)]
pub enum Change {
    /// The endpoint is new.
    Appeared(Guid),
    /// The endpoint has another type or QoS.
    Changed(Guid),
    /// The endpoint is gone.
    Gone(Guid, Box<Endpoint>),
}

/// An endpoint that waits for its participant or for a free entry.
#[derive(Debug)]
struct PendingEndpoint {
    at: ModelTime,
    announcement: Box<EndpointAnnouncement>,
}

/// Nodes of a `ros_discovery_info` sample that wait for their participant.
#[derive(Debug)]
struct PendingNodes {
    at: ModelTime,
    priority: Priority,
    writer: Guid,
    sequence_number: SequenceNumber,
    nodes: Vec<Node>,
    bytes: usize,
}

/// All participants, endpoints and nodes.
///
/// Values are boxed: a hash table under churn allocates up to four slots per entry.
#[derive(Debug)]
pub struct Discovery {
    caps: Caps,
    watchlist: Arc<Watchlist>,
    participants: Bounded<Counted<Participants>, HashMap<GuidPrefix, Box<Participant>>>,
    endpoints: Bounded<Counted<Endpoints>, HashMap<Guid, Box<Endpoint>>>,
    pending_participants: PendingTable<Applicants, GuidPrefix, Box<Participant>>,
    pending_endpoints: PendingTable<PendingEndpoints, Guid, PendingEndpoint>,
    pending_nodes: Bounded<PendingNodeLists, HashMap<GuidPrefix, PendingNodes>>,
    disposals: Disposals,
    node_count: Sum<Counted<Nodes>>,
    /// Number of writers and readers that nodes list.
    named: usize,
    changes: Vec<Change>,
    /// Counters of discovery events.
    pub churn: Churn,
    participant_victims: Victims,
    endpoint_victims: Victims,
    node_victims: Victims,
    revision: u64,
}

impl Discovery {
    /// Creates an empty discovery.
    #[must_use]
    pub fn new(caps: Caps) -> Self {
        Self {
            caps,
            watchlist: Arc::default(),
            participants: Bounded::capped(caps.participants),
            endpoints: Bounded::capped(caps.endpoints),
            pending_participants: PendingTable::new(),
            pending_endpoints: PendingTable::new(),
            pending_nodes: Bounded::default(),
            disposals: Disposals::default(),
            node_count: Sum::capped(caps.nodes),
            named: 0,
            changes: Vec::new(),
            churn: Churn::default(),
            participant_victims: Victims::default(),
            endpoint_victims: Victims::default(),
            node_victims: Victims::default(),
            revision: 0,
        }
    }

    /// Returns a number that increases with every change of [`Self::memory`].
    #[must_use]
    pub const fn revision(&self) -> u64 {
        self.revision
    }

    /// Returns all participants.
    #[must_use]
    pub fn participants(&self) -> &HashMap<GuidPrefix, Box<Participant>> {
        &self.participants
    }

    /// Returns the node that has this writer.
    #[must_use]
    pub fn node_of(&self, writer: Guid) -> Option<&Node> {
        let mut nodes = self.participants.get(&writer.prefix)?.nodes.iter();
        nodes.find(|node| node.writers.contains(&writer))
    }

    /// Returns all endpoints of known participants.
    #[must_use]
    pub fn endpoints(&self) -> &HashMap<Guid, Box<Endpoint>> {
        &self.endpoints
    }

    /// Returns size, cap and evictions of the tables of participants, endpoints and nodes.
    #[must_use]
    pub fn tables(&self) -> [TableFacts; 3] {
        [
            self.participants.facts(),
            self.endpoints.facts(),
            self.node_count.facts(),
        ]
    }

    /// Returns whether this endpoint was disposed so recently that its samples may still arrive.
    #[must_use]
    pub fn was_disposed(&self, guid: Guid, now: ModelTime) -> bool {
        self.disposals.is_recent(guid, now)
    }

    /// Removes and returns the changes of endpoints since the last call.
    pub fn changes(&mut self) -> Vec<Change> {
        std::mem::take(&mut self.changes)
    }

    /// Returns whether this participant exists, waits for a free entry, or has waiting endpoints.
    #[must_use]
    pub fn knows(&self, prefix: GuidPrefix) -> bool {
        let mut waiting = self.pending_endpoints.range(endpoints_of(prefix));
        self.participants.contains_key(&prefix)
            || self.pending_participants.priority(&prefix).is_some()
            || waiting.next().is_some()
    }

    /// Sets the watchlist; topics that it names exactly have a higher priority.
    pub fn watch(&mut self, watchlist: Arc<Watchlist>) {
        self.watchlist = watchlist;
        let prefixes: Vec<_> = self.participants.keys().copied().collect();
        for prefix in prefixes {
            self.rate(prefix);
        }
        let watchlist = &self.watchlist;
        self.pending_endpoints.rate(|priority, pending| Priority {
            watched: is_named(watchlist, None, &pending.announcement.topic),
            ..priority
        });
        self.participant_victims = Victims::default();
        self.endpoint_victims = Victims::default();
        self.node_victims = Victims::default();
    }

    /// Records a packet of this participant and renews its lease. Returns whether `evidence` would
    /// raise its priority in [`Self::learn`].
    pub fn seen(&mut self, prefix: GuidPrefix, at: ModelTime, evidence: Priority) -> bool {
        let priority = match self.participants.get_mut(&prefix) {
            Some(participant) => {
                participant.seen(at);
                Some(participant.priority())
            }
            None if evidence == Priority::NO_EVIDENCE => None,
            None => self.pending_participants.priority(&prefix),
        };
        priority.is_some_and(|priority| priority.or(evidence) != priority)
    }

    /// Records that a message of this participant came by TCP.
    pub fn note_tcp(&mut self, prefix: GuidPrefix) {
        if let Some(participant) = self.participants.get_mut(&prefix) {
            participant.came_by_tcp = true;
        }
    }

    /// Raises the priority of a participant. Returns whether the participant is thereby admitted.
    pub fn learn(
        &mut self,
        prefix: GuidPrefix,
        evidence: Priority,
        at: ModelTime,
        journal: &mut Journal,
    ) -> bool {
        if let Some(participant) = self.participants.get_mut(&prefix) {
            participant.local |= evidence.local;
            participant.sends |= evidence.sends;
            self.adopt_pending(prefix, at, journal);
            return false;
        }
        let Some((priority, participant)) = self.pending_participants.remove(&prefix) else {
            return false;
        };
        self.admit_participant(prefix, participant, priority.or(evidence), at, journal)
    }

    /// Updates for which participants a socket of this host sends.
    pub fn update_locality(&mut self, is_local: impl Fn(&GuidPrefix) -> bool) {
        for (prefix, participant) in &mut self.participants {
            participant.local = is_local(prefix);
        }
    }

    /// Records the SPDP announcement of a participant. `evidence` is its known priority.
    pub fn participant(
        &mut self,
        announcement: &ParticipantAnnouncement,
        origin: &Origin,
        evidence: Priority,
        journal: &mut Journal,
    ) {
        let guid = announcement.guid;
        if self.disposals.is_stale(guid, origin) {
            return;
        }
        let (domain_id, source) = domain(announcement, origin);
        let relayer = (origin.sender != guid.prefix).then_some(origin.sender);
        let proxy = ParticipantProxy::of(announcement);
        if let Some(participant) = self.participants.get_mut(&guid.prefix) {
            participant.seen(origin.at);
            match (&mut participant.relayers, relayer) {
                (Some(relayers), Some(relayer)) => {
                    self.revision += u64::from(relayers.add(relayer));
                }
                (relayers @ Some(_), None) => {
                    *relayers = None;
                    self.revision += 1;
                }
                (None, _) => {}
            }
            let addresses = Addresses::of(announcement);
            if participant.addresses != addresses {
                participant.addresses = addresses;
                self.revision += 1;
            }
            if participant.proxy != proxy {
                participant.proxy = proxy;
                let domain_id = participant.domain_id;
                let proxy = ParticipantProxy::of(announcement);
                let entity = DiscoveredEntity::participant(domain_id, guid, &proxy);
                self.note(&entity, Event::Changed, origin.at, journal);
            }
            self.set_domain(guid.prefix, domain_id, source);
            self.learn(guid.prefix, evidence, origin.at, journal);
            return;
        }
        let waiting = self.pending_endpoints.range(endpoints_of(guid.prefix));
        let known = waiting.map(|(_, priority)| priority);
        let known = known.fold(evidence, Priority::or);
        let before = self.pending_participants.remove(&guid.prefix);
        let priority = before.map_or(known, |(priority, _)| priority.or(known));
        let participant = Box::new(Participant {
            proxy,
            addresses: Addresses::of(announcement),
            restored: None,
            domain_id,
            first_seen: origin.at,
            last_seen: origin.at,
            endpoints: Bounded::default(),
            nodes: Vec::new(),
            watched: 0,
            local: false,
            came_by_tcp: false,
            relayers: relayer.map(|relayer| Relayers::of([relayer])),
            sends: false,
            domain_source: source,
            nodes_from: None,
        });
        self.admit_participant(guid.prefix, participant, priority, origin.at, journal);
    }

    /// Records the SPDP disposal of a participant.
    pub fn participant_gone(&mut self, guid: Guid, origin: &Origin, journal: &mut Journal) {
        if guid.entity != EntityId::PARTICIPANT {
            return;
        }
        self.disposals.add(guid, origin);
        self.pending_participants.remove(&guid.prefix);
        self.remove(guid.prefix, origin.at, Some(Event::Disposed), journal);
    }

    /// Returns the earliest end of a lease, unless further packets renew it.
    pub fn next_expiry(&self) -> Option<ModelTime> {
        let participants = self.participants.values();
        participants
            .filter_map(|participant| self.lease_end(participant))
            .min()
    }

    /// Returns the end of a participant's lease. A server that others relay may be gone as well, so
    /// it keeps no participant.
    fn lease_end(&self, participant: &Participant) -> Option<ModelTime> {
        let relayers = participant.relayers.iter().flat_map(Relayers::iter);
        let mut relayers = relayers.filter_map(|prefix| self.participants.get(&prefix));
        participant.lease_end(relayers.any(|relayer| relayer.relayers.is_none()))
    }

    /// Removes participants whose lease has expired at `now`.
    pub fn advance(&mut self, now: ModelTime, journal: &mut Journal) {
        let mut expired: Vec<_> = self
            .participants
            .iter()
            .filter_map(|(prefix, participant)| Some((self.lease_end(participant)?, *prefix)))
            .filter(|(end, _)| *end <= now)
            .collect();
        expired.sort_unstable();
        for (end, prefix) in expired {
            self.remove(prefix, end, Some(Event::Expired), journal);
        }
        let fresh = |at: ModelTime| at + PENDING_TIMEOUT > now;
        let participants = &self.participants;
        self.pending_endpoints
            .retain(|guid, pending| fresh(pending.at) || participants.contains_key(&guid.prefix));
        self.pending_participants
            .retain(|_, applicant| fresh(applicant.last_seen));
        self.pending_nodes.retain(|_, pending| fresh(pending.at));
    }

    /// Adds a new participant and returns true. If the table is full, the participant waits.
    fn admit_participant(
        &mut self,
        prefix: GuidPrefix,
        mut participant: Box<Participant>,
        priority: Priority,
        at: ModelTime,
        journal: &mut Journal,
    ) -> bool {
        let guid = Guid::new(prefix, EntityId::PARTICIPANT);
        let is_full = self.participants.is_full();
        if is_full && !self.evict_for(Table::Participants, Newcomer { guid, priority }, at) {
            self.participants.refuse();
            self.pending_participants.put(prefix, priority, participant);
            return false;
        }
        (participant.local, participant.sends) = (priority.local, priority.sends);
        let proxy = participant.proxy.clone();
        let entity = DiscoveredEntity::participant(participant.domain_id, guid, &proxy);
        self.participants.insert(prefix, participant);
        self.note(&entity, Event::Appeared, at, journal);
        self.adopt_pending(prefix, at, journal);
        true
    }

    /// Removes a participant with its endpoints and nodes. `event` is `None` for an eviction, which
    /// is not an event.
    fn remove(
        &mut self,
        prefix: GuidPrefix,
        at: ModelTime,
        event: Option<Event>,
        journal: &mut Journal,
    ) {
        self.pending_nodes.remove(&prefix);
        let waiting = self.pending_endpoints.range(endpoints_of(prefix));
        let waiting: Vec<_> = waiting.map(|(guid, _)| guid).collect();
        for guid in waiting {
            self.pending_endpoints.remove(&guid);
        }
        let Some(participant) = self.participants.remove(&prefix) else {
            return;
        };
        for relayed in self.participants.values_mut() {
            if let Some(relayers) = &mut relayed.relayers {
                relayers.remove(prefix, at);
            }
        }
        let domain_id = participant.domain_id;
        let guid = Guid::new(prefix, EntityId::PARTICIPANT);
        if let Some(event) = event {
            let entity = DiscoveredEntity::participant(domain_id, guid, &participant.proxy);
            self.note(&entity, event, at, journal);
        }
        let cascade = event.map(|_| Event::Cascaded);
        for endpoint in participant.endpoints {
            self.drop_endpoint(endpoint, cascade, at, journal);
        }
        self.node_count.sub(participant.nodes.len());
        self.named = self.named.saturating_sub(named(&participant.nodes));
        if let Some(event) = cascade {
            for node in participant.nodes {
                let entity = DiscoveredEntity::node(domain_id, guid, &node.name);
                self.note(&entity, event, at, journal);
            }
        }
    }

    /// Moves a participant with its endpoints and nodes to a domain from a more reliable source.
    fn set_domain(&mut self, prefix: GuidPrefix, domain_id: DomainId, source: DomainSource) {
        let Some(participant) = self.participants.get_mut(&prefix) else {
            return;
        };
        if source <= participant.domain_source {
            return;
        }
        participant.domain_source = source;
        self.revision += 1;
        if participant.domain_id == domain_id {
            return;
        }
        participant.domain_id = domain_id;
        for guid in &participant.endpoints {
            if let Some(endpoint) = self.endpoints.get_mut(guid) {
                self.changes.push(Change::Gone(*guid, endpoint.clone()));
                endpoint.domain_id = domain_id;
                self.changes.push(Change::Appeared(*guid));
            }
        }
        self.rate(prefix);
    }

    /// Updates which of a participant's endpoints are watched by exact name.
    fn rate(&mut self, prefix: GuidPrefix) {
        let Some(participant) = self.participants.get_mut(&prefix) else {
            return;
        };
        participant.watched = 0;
        for guid in &participant.endpoints {
            if let Some(endpoint) = self.endpoints.get_mut(guid) {
                let domain_id = Some(endpoint.domain_id);
                let topic = DdsTopic::parse(&endpoint.topic);
                let is_named = |topic| is_named(&self.watchlist, domain_id, &topic);
                endpoint.watched = topic.is_ok_and(is_named);
                participant.watched += usize::from(endpoint.watched);
            }
        }
    }

    fn note(
        &mut self,
        entity: &DiscoveredEntity<'_>,
        event: Event,
        at: ModelTime,
        journal: &mut Journal,
    ) {
        self.revision += 1;
        self.churn.count(entity.domain_id, entity.entity(), event);
        journal.note(DiscoveryEvent {
            at,
            domain_id: entity.domain_id,
            entity: entity.entity().label(),
            event: event.label(),
            guid: entity.guid,
            name: entity.name(),
        });
        journal.events.push(at, entity.event(event));
    }
}

/// Returns the range of GUIDs that this participant's endpoints can have.
pub(crate) const fn endpoints_of(prefix: GuidPrefix) -> RangeInclusive<Guid> {
    let [first, last] = [EntityId([0; 4]), EntityId([0xff; 4])];
    Guid::new(prefix, first)..=Guid::new(prefix, last)
}

/// Returns whether the DDS topic is watched by exact name, in this domain or, with `None`, in any.
fn is_named(watchlist: &Watchlist, domain_id: Option<DomainId>, topic: &DdsTopic) -> bool {
    watchlist.has_names() && Naming::of(topic).is_named_by(domain_id, watchlist)
}
