//! Discovered participants, their endpoints and their nodes.
//!
//! Identity is read from payloads. A participant is removed, with its endpoints and nodes, when it
//! is disposed or its lease expires. An endpoint lives on its own: a repeated announcement of its
//! participant does not change it. Every table is capped. During a flood of forged announcements,
//! existing entries stay and a newcomer of no higher priority is refused until an entry is free.

mod disposals;
mod endpoints;
mod entity;
mod eviction;
mod facts;
mod memory;
mod nodes;
mod pending;
mod priority;

use std::collections::{BTreeSet, HashMap};
use std::ops::RangeInclusive;
use std::sync::Arc;
use std::time::Duration;

use ros2probe_wire::discovery::{EndpointAnnouncement, ParticipantAnnouncement};
use ros2probe_wire::names::DdsTopic;
use ros2probe_wire::{DomainId, EntityId, Guid, GuidPrefix, SequenceNumber, Timestamp};

use super::churn::{Churn, Event};
use super::journal::{DiscoveryEvent, Journal};
use super::naming::Naming;
use super::size::Size;
use crate::watch::Watchlist;
use disposals::Disposals;
use entity::DiscoveredEntity;
use eviction::{Newcomer, Table, Victims};
use facts::{ADDRESSES, domain, named};
pub use facts::{Addresses, DomainSource, Endpoint, Node, Origin, Participant, ParticipantProxy};
pub use memory::{Memory, hexadecimal};
use pending::PendingTable;
pub use priority::Priority;

/// Most endpoints and node lists that wait for their participant.
const PENDING: usize = 1024;
/// Most participants that wait for a free entry.
const APPLICANTS: usize = 128;
const PENDING_NODES: usize = PENDING / 8;
/// Most bytes of waiting node lists.
const PENDING_NODE_BYTES: usize = 1 << 20;
const PENDING_FOR: Duration = Duration::from_secs(60);
/// Longest topic or type name: `string<256>` in the builtin topics of DDS. Longer names are
/// rejected to bound memory.
const MAX_NAME_LEN: usize = 256;
/// Most endpoints of one participant.
const PER_PARTICIPANT: usize = 4096;

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
    at: Timestamp,
    announcement: Box<EndpointAnnouncement>,
}

/// Samples of `ros_discovery_info` that wait for their participant.
#[derive(Debug)]
struct PendingNodes {
    at: Timestamp,
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
    participants: HashMap<GuidPrefix, Box<Participant>>,
    endpoints: HashMap<Guid, Box<Endpoint>>,
    applicants: PendingTable<GuidPrefix, Box<Participant>>,
    pending_endpoints: PendingTable<Guid, PendingEndpoint>,
    pending_nodes: HashMap<GuidPrefix, PendingNodes>,
    disposals: Disposals,
    node_count: usize,
    /// Number of writers and readers that nodes list.
    named: usize,
    changes: Vec<Change>,
    /// Counters of discovery events.
    pub churn: Churn,
    evictions: Evictions,
    participant_victims: Victims,
    endpoint_victims: Victims,
    node_victims: Victims,
    revision: u64,
}

/// Entries refused or evicted because a table was full.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Evictions {
    /// Participants.
    pub participants: u64,
    /// Endpoints, including waiting ones.
    pub endpoints: u64,
    /// Nodes.
    pub nodes: u64,
}

impl PendingNodes {
    /// Returns the bytes of the waiting nodes.
    fn held(&self) -> usize {
        // The destructuring makes a new list fail to compile until it is listed here.
        let Self {
            at: _,
            writer: _,
            sequence_number: _,
            nodes,
            bytes: _,
            priority: _,
        } = self;
        nodes.iter().map(Node::bytes).sum()
    }
}

impl Discovery {
    /// Creates an empty discovery.
    #[must_use]
    pub fn new(caps: Caps) -> Self {
        Self {
            caps,
            watchlist: Arc::default(),
            participants: HashMap::new(),
            endpoints: HashMap::new(),
            applicants: PendingTable::new(APPLICANTS),
            pending_endpoints: PendingTable::new(PENDING),
            pending_nodes: HashMap::new(),
            disposals: Disposals::default(),
            node_count: 0,
            named: 0,
            changes: Vec::new(),
            churn: Churn::default(),
            evictions: Evictions::default(),
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
    pub const fn participants(&self) -> &HashMap<GuidPrefix, Box<Participant>> {
        &self.participants
    }

    /// Returns all endpoints of known participants.
    #[must_use]
    pub const fn endpoints(&self) -> &HashMap<Guid, Box<Endpoint>> {
        &self.endpoints
    }

    /// Returns the number of nodes of all participants.
    #[must_use]
    pub const fn node_count(&self) -> usize {
        self.node_count
    }

    /// Returns the entries refused or evicted because a table was full.
    #[must_use]
    pub const fn evictions(&self) -> Evictions {
        self.evictions
    }

    /// Returns the size and cap of each table.
    #[must_use]
    pub fn sizes(&self) -> Vec<Size> {
        // The destructuring makes a new table fail to compile until it is listed here.
        let Self {
            caps,
            watchlist: _,
            participants,
            endpoints,
            applicants,
            pending_endpoints,
            pending_nodes,
            disposals,
            node_count: _,
            named: _,
            changes,
            churn,
            evictions: _,
            participant_victims,
            endpoint_victims,
            node_victims,
            revision: _,
        } = self;
        let waiting = pending_nodes.values().map(|pending| pending.held()).sum();
        let (applicants, pending_endpoints) = (applicants.sizes(), pending_endpoints.sizes());
        let each = || participants.values().map(|each| each.lists());
        let nodes = each().map(|lists| lists.nodes).sum();
        let named = each().map(|lists| lists.named).sum();
        let of_one = each().map(|lists| lists.endpoints).max().unwrap_or(0);
        let addresses = each().map(|lists| lists.addresses).max().unwrap_or(0);
        let mut sizes = vec![
            Size::new(
                "discovery.participants",
                participants.len(),
                caps.participants,
            ),
            Size::new("discovery.participant.endpoints", of_one, PER_PARTICIPANT),
            Size::new("discovery.participant.addresses", addresses, ADDRESSES),
            Size::new("discovery.endpoints", endpoints.len(), caps.endpoints),
            Size::new("discovery.applicants", applicants.0, APPLICANTS),
            Size::new("discovery.applicants.places", applicants.1, APPLICANTS),
            Size::new(
                "discovery.participant_victims",
                participant_victims.len(),
                Victims::CAP,
            ),
            Size::new(
                "discovery.endpoint_victims",
                endpoint_victims.len(),
                Victims::CAP,
            ),
            Size::new("discovery.node_victims", node_victims.len(), Victims::CAP),
            Size::new("discovery.pending_endpoints", pending_endpoints.0, PENDING),
            Size::new(
                "discovery.pending_endpoints.places",
                pending_endpoints.1,
                PENDING,
            ),
            Size::new(
                "discovery.pending_nodes",
                pending_nodes.len(),
                PENDING_NODES,
            ),
            Size::new("discovery.pending_nodes.bytes", waiting, PENDING_NODE_BYTES),
            Size::new("discovery.nodes", nodes, caps.nodes),
            Size::new("discovery.nodes.named", named, caps.endpoints),
            // The changes are taken after each datagram.
            Size::new("discovery.changes", changes.len(), caps.endpoints),
        ];
        sizes.extend(disposals.sizes());
        sizes.extend(churn.sizes());
        sizes
    }

    /// Returns whether this endpoint was disposed so recently that its samples may still arrive.
    #[must_use]
    pub fn was_disposed(&self, guid: Guid, now: Timestamp) -> bool {
        self.disposals.is_recent(guid, now)
    }

    /// Removes and returns the changes of endpoints since the last call.
    pub fn changes(&mut self) -> Vec<Change> {
        std::mem::take(&mut self.changes)
    }

    /// Returns whether this participant exists, or waits for a free entry.
    #[must_use]
    pub fn knows(&self, prefix: GuidPrefix) -> bool {
        let mut waiting = self.pending_endpoints.range(endpoints_of(prefix));
        self.participants.contains_key(&prefix)
            || self.applicants.priority(&prefix).is_some()
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

    /// Records a packet of this participant and renews its lease. Returns whether its priority
    /// increased, as [`Self::learn`] does.
    pub fn seen(&mut self, prefix: GuidPrefix, at: Timestamp, evidence: Priority) -> bool {
        let priority = match self.participants.get_mut(&prefix) {
            Some(participant) => {
                participant.seen(at);
                Some(participant.priority())
            }
            None if evidence == Priority::NOTHING => None,
            None => self.applicants.priority(&prefix),
        };
        priority.is_some_and(|priority| priority.or(evidence) != priority)
    }

    /// Raises the priority of a participant. Returns whether it is admitted because of it.
    pub fn learn(
        &mut self,
        prefix: GuidPrefix,
        evidence: Priority,
        at: Timestamp,
        journal: &mut Journal,
    ) -> bool {
        if let Some(participant) = self.participants.get_mut(&prefix) {
            participant.local |= evidence.local;
            participant.sends |= evidence.sends;
            self.adopt_pending(prefix, at, journal);
            return false;
        }
        let Some((priority, participant)) = self.applicants.remove(&prefix) else {
            return false;
        };
        self.enter(prefix, participant, priority.or(evidence), at, journal)
    }

    /// Updates which participants a socket of this host sends for.
    pub fn locate(&mut self, is_local: impl Fn(&GuidPrefix) -> bool) {
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
        let (domain_id, source) = domain(announcement.domain_id, origin);
        let proxy = ParticipantProxy::of(announcement);
        if let Some(participant) = self.participants.get_mut(&guid.prefix) {
            participant.seen(origin.at);
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
            self.move_to(guid.prefix, domain_id, source);
            self.learn(guid.prefix, evidence, origin.at, journal);
            return;
        }
        let waiting = self.pending_endpoints.range(endpoints_of(guid.prefix));
        let known = waiting.map(|(_, priority)| priority);
        let known = known.fold(evidence, Priority::or);
        let before = self.applicants.remove(&guid.prefix);
        let priority = before.map_or(known, |(priority, _)| priority.or(known));
        let participant = Box::new(Participant {
            proxy,
            addresses: Addresses::of(announcement),
            restored: None,
            domain_id,
            first_seen: origin.at,
            last_seen: origin.at,
            endpoints: BTreeSet::new(),
            nodes: Vec::new(),
            watched: 0,
            local: false,
            sends: false,
            domain_source: source,
            nodes_from: None,
        });
        self.enter(guid.prefix, participant, priority, origin.at, journal);
    }

    /// Records the SPDP disposal of a participant.
    pub fn participant_gone(&mut self, guid: Guid, origin: &Origin, journal: &mut Journal) {
        if guid.entity != EntityId::PARTICIPANT {
            return;
        }
        self.disposals.add(guid, origin);
        self.applicants.remove(&guid.prefix);
        self.remove(guid.prefix, origin.at, Some(Event::Disposed), journal);
    }

    /// Returns the end of the lease that ends first, as far as participants were heard.
    pub fn next_expiry(&self) -> Option<Timestamp> {
        let participants = self.participants.values();
        participants
            .filter_map(|participant| participant.lease_end())
            .min()
    }

    /// Removes participants whose lease has expired at `now`.
    pub fn advance(&mut self, now: Timestamp, journal: &mut Journal) {
        let mut expired: Vec<_> = self
            .participants
            .iter()
            .filter_map(|(prefix, participant)| Some((participant.lease_end()?, *prefix)))
            .filter(|(end, _)| *end <= now)
            .collect();
        expired.sort_unstable();
        for (end, prefix) in expired {
            self.remove(prefix, end, Some(Event::Expired), journal);
        }
        let fresh = |at: Timestamp| at + PENDING_FOR > now;
        let participants = &self.participants;
        self.pending_endpoints
            .retain(|guid, pending| fresh(pending.at) || participants.contains_key(&guid.prefix));
        self.applicants
            .retain(|_, applicant| fresh(applicant.last_seen));
        self.pending_nodes.retain(|_, pending| fresh(pending.at));
    }

    /// Adds a new participant and returns true, or keeps it waiting if the table is full.
    fn enter(
        &mut self,
        prefix: GuidPrefix,
        mut participant: Box<Participant>,
        priority: Priority,
        at: Timestamp,
        journal: &mut Journal,
    ) -> bool {
        let guid = Guid::new(prefix, EntityId::PARTICIPANT);
        let is_full = self.participants.len() >= self.caps.participants;
        if is_full && !self.evict_for(Table::Participants, Newcomer { guid, priority }, at) {
            self.evictions.participants += 1;
            self.applicants.put(prefix, priority, participant);
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

    /// Removes a participant with its endpoints and nodes. `event` is `None` for a silent eviction.
    fn remove(
        &mut self,
        prefix: GuidPrefix,
        at: Timestamp,
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
        self.node_count = self.node_count.saturating_sub(participant.nodes.len());
        self.named = self.named.saturating_sub(named(&participant.nodes));
        if let Some(event) = cascade {
            for node in participant.nodes {
                let entity = DiscoveredEntity::node(domain_id, guid, &node.name);
                self.note(&entity, event, at, journal);
            }
        }
    }

    /// Changes a participant's domain after a more reliable source, with its endpoints and nodes.
    fn move_to(&mut self, prefix: GuidPrefix, domain_id: DomainId, source: DomainSource) {
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
        at: Timestamp,
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
pub(super) const fn endpoints_of(prefix: GuidPrefix) -> RangeInclusive<Guid> {
    let [first, last] = [EntityId([0; 4]), EntityId([0xff; 4])];
    Guid::new(prefix, first)..=Guid::new(prefix, last)
}

/// Returns whether the DDS topic is watched by exact name, in this domain or, with `None`, in any.
fn is_named(watchlist: &Watchlist, domain_id: Option<DomainId>, topic: &DdsTopic) -> bool {
    watchlist.has_names() && Naming::of(topic).is_named_by(domain_id, watchlist)
}
