//! Who is there: participants, their endpoints and nodes, as discovery told.
//!
//! Identity comes from payloads. A participant lives until it is disposed or its lease ends; with
//! it go its endpoints and nodes. An endpoint's life is its own: that its participant is announced
//! again says nothing about it. Every table is capped: what was there before a flood of forgeries
//! stays, newcomers are refused until there is room.

mod facts;
mod graveyard;
mod memory;
mod subject;

use std::collections::{BTreeSet, HashMap, VecDeque};
use std::sync::Arc;

use ros2probe_wire::discovery::{EndpointAnnouncement, ParticipantAnnouncement, Role};
use ros2probe_wire::entities::ParticipantEntities;
use ros2probe_wire::rtps::Locator;
use ros2probe_wire::{Duration, EntityId, Guid, GuidPrefix, Timestamp};

use facts::{ADDRESSES, domain, named};
pub use facts::{Addresses, DomainSource, Endpoint, Node, Origin, Participant, Portrait};
use graveyard::Graveyard;
pub use memory::{Memory, hexadecimal};
use subject::Subject;

use super::churn::{Churn, Event};
use super::journal::{DiscoveryEvent, Journal};
use super::size::Size;

const SECOND: u64 = 1_000_000_000;
/// A participant that was seen over this span is no forgery of the moment.
const ESTABLISHED: u64 = 2 * SECOND;
/// One that is not established makes room after this long without a word.
const DOUBTFUL: u64 = 5 * SECOND;
/// Any participant makes room after this long without a word, whatever its lease: real ones repeat
/// themselves at least every 30 seconds (RTPS 2.5, 8.5.3.3.2).
const FORSAKEN: u64 = 90 * SECOND;
/// How often a full table is searched for room.
const SEARCH: u64 = SECOND / 10;
/// Endpoints and nodes whose participant is not known yet: how many and how long.
const PENDING: usize = 1024;
const PENDING_NODES: usize = PENDING / 8;
/// Bytes of those nodes together.
const PENDING_NODE_BYTES: usize = 1 << 20;
const PENDING_FOR: u64 = 60 * SECOND;
/// Longest topic or type name: `string<256>` in the builtin topics of DDS. What is longer is no
/// name but an attempt on our memory.
const MAX_NAME_LEN: usize = 256;
/// Most endpoints of one participant.
const PER_PARTICIPANT: usize = 4096;

/// Caps.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Caps {
    /// Participants.
    pub participants: usize,
    /// Endpoints.
    pub endpoints: usize,
    /// Nodes.
    pub nodes: usize,
}

/// What the rest of the model has to follow up.
#[derive(Debug)]
pub enum Change {
    /// An endpoint is there.
    Appeared(Guid),
    /// Its type or QoS is another.
    Changed(Guid),
    /// It is no more.
    Gone(Guid, Box<Endpoint>),
}

/// An endpoint that came before its participant.
#[derive(Debug)]
struct PendingEndpoint {
    at: Timestamp,
    tells_readers: bool,
    announcement: Box<EndpointAnnouncement>,
}

/// Samples of `ros_discovery_info` that came before their participant.
#[derive(Debug)]
struct PendingNodes {
    at: Timestamp,
    writer: Guid,
    sequence_number: u64,
    nodes: Vec<Node>,
    bytes: usize,
}

/// All participants, endpoints and nodes.
///
/// Boxed: a table in which much comes and goes has up to four places for each entry.
#[derive(Debug)]
pub struct Discovery {
    caps: Caps,
    participants: HashMap<GuidPrefix, Box<Participant>>,
    endpoints: HashMap<Guid, Box<Endpoint>>,
    pending_endpoints: VecDeque<PendingEndpoint>,
    pending_nodes: HashMap<GuidPrefix, PendingNodes>,
    graveyard: Graveyard,
    node_count: usize,
    /// Writers and readers that nodes name.
    named: usize,
    changes: Vec<Change>,
    /// Counters of events.
    pub churn: Churn,
    evictions: Evictions,
    search_after: Timestamp,
    revision: u64,
}

/// Entries refused or given up because of a cap.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Evictions {
    /// Participants.
    pub participants: u64,
    /// Endpoints, pending ones included.
    pub endpoints: u64,
    /// Nodes.
    pub nodes: u64,
}

impl Discovery {
    /// Nobody there.
    #[must_use]
    pub fn new(caps: Caps) -> Self {
        Self {
            caps,
            participants: HashMap::new(),
            endpoints: HashMap::new(),
            pending_endpoints: VecDeque::new(),
            pending_nodes: HashMap::new(),
            graveyard: Graveyard::default(),
            node_count: 0,
            named: 0,
            changes: Vec::new(),
            churn: Churn::default(),
            evictions: Evictions::default(),
            search_after: Timestamp(0),
            revision: 0,
        }
    }

    /// Rises with every change of what [`Self::memory`] says.
    #[must_use]
    pub const fn revision(&self) -> u64 {
        self.revision
    }

    /// Everybody.
    #[must_use]
    pub const fn participants(&self) -> &HashMap<GuidPrefix, Box<Participant>> {
        &self.participants
    }

    /// All endpoints of known participants.
    #[must_use]
    pub const fn endpoints(&self) -> &HashMap<Guid, Box<Endpoint>> {
        &self.endpoints
    }

    /// Nodes of all participants.
    #[must_use]
    pub const fn node_count(&self) -> usize {
        self.node_count
    }

    /// What the caps cost.
    #[must_use]
    pub const fn evictions(&self) -> Evictions {
        self.evictions
    }

    /// Entries and cap of every table.
    #[must_use]
    pub fn sizes(&self) -> Vec<Size> {
        // A new table does not compile before it has a place here.
        let Self {
            caps,
            participants,
            endpoints,
            pending_endpoints,
            pending_nodes,
            graveyard,
            node_count,
            named,
            changes,
            churn,
            evictions: _,
            search_after: _,
            revision: _,
        } = self;
        let waiting = self.pending_node_bytes();
        let most = |count: fn(&Participant) -> usize| {
            let each = participants.values();
            each.map(|participant| count(participant))
                .max()
                .unwrap_or(0)
        };
        let of_one = most(|participant| participant.endpoints.len());
        let addresses = most(|participant| {
            let Addresses {
                metatraffic,
                default,
            } = &participant.addresses;
            metatraffic.len().max(default.len())
        });
        vec![
            Size::new(
                "discovery.participants",
                participants.len(),
                caps.participants,
            ),
            Size::new("discovery.participant.endpoints", of_one, PER_PARTICIPANT),
            Size::new("discovery.participant.addresses", addresses, ADDRESSES),
            Size::new("discovery.endpoints", endpoints.len(), caps.endpoints),
            Size::new(
                "discovery.pending_endpoints",
                pending_endpoints.len(),
                PENDING,
            ),
            Size::new(
                "discovery.pending_nodes",
                pending_nodes.len(),
                PENDING_NODES,
            ),
            Size::new("discovery.pending_nodes.bytes", waiting, PENDING_NODE_BYTES),
            Size::new("discovery.graveyard", graveyard.len(), Graveyard::CAP),
            Size::new("discovery.nodes", *node_count, caps.nodes),
            Size::new("discovery.nodes.named", *named, caps.endpoints),
            // Taken after each datagram.
            Size::new("discovery.changes", changes.len(), caps.endpoints),
            Size::new("discovery.churn", churn.len(), Churn::CAP),
        ]
    }

    /// Whether this endpoint was disposed of a moment ago: what it sent may still be on its way.
    #[must_use]
    pub fn was_buried(&self, guid: Guid, now: Timestamp) -> bool {
        self.graveyard.holds(guid, now)
    }

    /// What happened to endpoints since the last call.
    pub fn changes(&mut self) -> Vec<Change> {
        std::mem::take(&mut self.changes)
    }

    /// Something of this participant was seen: its lease begins anew.
    pub fn seen(&mut self, prefix: GuidPrefix, at: Timestamp) {
        if let Some(participant) = self.participants.get_mut(&prefix) {
            participant.seen(at);
        }
    }

    /// SPDP: it is there.
    pub fn participant(
        &mut self,
        announcement: &ParticipantAnnouncement,
        origin: &Origin,
        journal: &mut Journal,
    ) {
        let guid = announcement.guid;
        if self.graveyard.is_stale(guid, origin) {
            return;
        }
        let (domain_id, source) = domain(announcement.domain_id, origin);
        let portrait = Portrait::of(announcement);
        if let Some(participant) = self.participants.get_mut(&guid.prefix) {
            participant.seen(origin.at);
            let addresses = Addresses::of(announcement);
            if participant.addresses != addresses {
                participant.addresses = addresses;
                self.revision += 1;
            }
            if participant.portrait != portrait {
                participant.portrait = portrait;
                let domain_id = participant.domain_id;
                let portrait = Portrait::of(announcement);
                let subject = Subject::participant(domain_id, guid, &portrait);
                self.note(&subject, Event::Changed, origin.at, journal);
            }
            self.move_to(guid.prefix, domain_id, source);
            return;
        }
        if self.participants.len() >= self.caps.participants && !self.make_room(origin.at) {
            self.evictions.participants += 1;
            return;
        }
        self.participants.insert(
            guid.prefix,
            Box::new(Participant {
                portrait: portrait.clone(),
                addresses: Addresses::of(announcement),
                restored: None,
                domain_id,
                first_seen: origin.at,
                last_seen: origin.at,
                endpoints: BTreeSet::new(),
                nodes: Vec::new(),
                readers_told: false,
                domain_source: source,
                nodes_from: None,
            }),
        );
        let subject = Subject::participant(domain_id, guid, &portrait);
        self.note(&subject, Event::Appeared, origin.at, journal);
        self.adopt_pending(guid.prefix, origin.at, journal);
    }

    /// SPDP: it says goodbye.
    pub fn participant_gone(&mut self, guid: Guid, origin: &Origin, journal: &mut Journal) {
        if guid.entity != EntityId::PARTICIPANT {
            return;
        }
        self.graveyard.bury(guid, origin);
        self.remove(guid.prefix, origin.at, Some(Event::Disposed), journal);
    }

    /// SEDP: an endpoint is there.
    pub fn endpoint(
        &mut self,
        announcement: EndpointAnnouncement,
        origin: &Origin,
        journal: &mut Journal,
    ) {
        let names = [announcement.topic.as_str(), announcement.type_name.as_str()];
        if names.iter().any(|name| name.len() > MAX_NAME_LEN) {
            self.evictions.endpoints += 1;
            return;
        }
        if self.graveyard.is_stale(announcement.guid, origin) {
            return;
        }
        let tells_readers = announcement.role == Role::Reader && origin.sequence_number == 1;
        if let Some(participant) = self.participants.get_mut(&announcement.guid.prefix) {
            participant.readers_told |= tells_readers;
            self.admit(announcement, origin.at, journal);
            return;
        }
        let guid = announcement.guid;
        self.pending_endpoints
            .retain(|pending| pending.announcement.guid != guid);
        if self.pending_endpoints.len() >= PENDING {
            self.pending_endpoints.pop_front();
            self.evictions.endpoints += 1;
        }
        self.pending_endpoints.push_back(PendingEndpoint {
            at: origin.at,
            tells_readers,
            announcement: Box::new(announcement),
        });
    }

    /// SEDP: an endpoint says goodbye.
    pub fn endpoint_gone(&mut self, guid: Guid, origin: &Origin, journal: &mut Journal) {
        self.graveyard.bury(guid, origin);
        self.pending_endpoints
            .retain(|pending| pending.announcement.guid != guid);
        if let Some(participant) = self.participants.get_mut(&guid.prefix) {
            participant.endpoints.remove(&guid);
        }
        self.drop_endpoint(guid, Some(Event::Disposed), origin.at, journal);
    }

    /// `ros_discovery_info`: these are the participant's nodes now.
    pub fn entities(
        &mut self,
        entities: &ParticipantEntities,
        writer: Guid,
        origin: &Origin,
        journal: &mut Journal,
    ) {
        // A participant tells of its own nodes only.
        let prefix = entities.participant.prefix;
        if prefix != writer.prefix {
            return;
        }
        let room = self.caps.nodes.saturating_sub(self.node_count);
        let known: &[Node] = match self.participants.get(&prefix) {
            Some(known) => &known.nodes,
            None => &[],
        };
        let mut names = self.caps.endpoints.saturating_sub(self.named) + named(known);
        names = names.min(PER_PARTICIPANT);
        let mut nodes: Vec<Node> = entities
            .nodes
            .iter()
            .take(room + known.len())
            .map(Node::of)
            .collect();
        self.evictions.nodes += (entities.nodes.len() - nodes.len()) as u64;
        for node in &mut nodes {
            self.evictions.nodes += u64::from(node.cut(&mut names));
        }
        if self.participants.contains_key(&prefix) {
            self.set_nodes(
                prefix,
                writer,
                origin.sequence_number,
                nodes,
                origin.at,
                journal,
            );
            return;
        }
        let older = |pending: &PendingNodes| {
            pending.writer == writer && pending.sequence_number >= origin.sequence_number
        };
        if self.pending_nodes.get(&prefix).is_some_and(older) {
            return;
        }
        self.pending_nodes.remove(&prefix);
        let bytes = nodes.iter().map(Node::bytes).sum();
        while self.pending_nodes.len() >= PENDING_NODES
            || self.pending_node_bytes() + bytes > PENDING_NODE_BYTES
        {
            let pending = self.pending_nodes.iter();
            let oldest = pending.min_by_key(|(_, pending)| pending.at);
            let Some(oldest) = oldest.map(|(prefix, _)| *prefix) else {
                break;
            };
            self.pending_nodes.remove(&oldest);
            self.evictions.nodes += 1;
        }
        let sequence_number = origin.sequence_number;
        let pending = PendingNodes {
            at: origin.at,
            writer,
            sequence_number,
            nodes,
            bytes,
        };
        self.pending_nodes.insert(prefix, pending);
    }

    /// Ends leases that have run out at `now`.
    pub fn advance(&mut self, now: Timestamp, journal: &mut Journal) {
        let mut expired: Vec<_> = self
            .participants
            .iter()
            .filter_map(|(prefix, participant)| {
                let lease = match participant.portrait.lease {
                    Duration::Finite(lease) => lease,
                    // Who went while nobody looked is not believed in for ever.
                    Duration::Infinite if participant.restored.is_some() => FORSAKEN,
                    Duration::Infinite => return None,
                };
                let end = participant.last_seen.0.saturating_add(lease);
                (end <= now.0).then_some((end, *prefix))
            })
            .collect();
        expired.sort_unstable();
        for (end, prefix) in expired {
            self.remove(prefix, Timestamp(end), Some(Event::Expired), journal);
        }
        let fresh = |at: Timestamp| at.0.saturating_add(PENDING_FOR) > now.0;
        while self
            .pending_endpoints
            .front()
            .is_some_and(|pending| !fresh(pending.at))
        {
            self.pending_endpoints.pop_front();
        }
        self.pending_nodes.retain(|_, pending| fresh(pending.at));
    }

    fn pending_node_bytes(&self) -> usize {
        self.pending_nodes
            .values()
            .map(|pending| pending.bytes)
            .sum()
    }

    /// Puts an announced endpoint into its known participant.
    fn admit(&mut self, announcement: EndpointAnnouncement, at: Timestamp, journal: &mut Journal) {
        let guid = announcement.guid;
        let Some(participant) = self.participants.get(&guid.prefix) else {
            return;
        };
        let domain_id = participant.domain_id;
        if let Some(known) = self.endpoints.get_mut(&guid) {
            if *known.topic == *announcement.topic.as_str() {
                let before = (
                    known.type_hash,
                    known.qos.clone(),
                    Arc::clone(&known.message_type),
                );
                known.qos = announcement.qos;
                known.type_hash = announcement.type_hash;
                known.message_type = announcement.type_name.message().as_str().into();
                let unchanged = before.0 == known.type_hash
                    && before.1 == known.qos
                    && before.2 == known.message_type;
                if !unchanged {
                    let subject = Subject::endpoint(guid, known);
                    self.changes.push(Change::Changed(guid));
                    self.note(&subject, Event::Changed, at, journal);
                }
                return;
            }
            // The same GUID on another topic: its dispose was missed.
            self.drop_endpoint(guid, Some(Event::Disposed), at, journal);
        }
        let own = self
            .participants
            .get(&guid.prefix)
            .map_or(0, |known| known.endpoints.len());
        let full = self.endpoints.len() >= self.caps.endpoints && !self.make_room(at);
        if full || own >= PER_PARTICIPANT {
            self.evictions.endpoints += 1;
            return;
        }
        let unicast = &announcement.unicast;
        let shared_memory =
            (!unicast.is_empty()).then(|| unicast.iter().any(Locator::is_shared_memory));
        let endpoint = Endpoint {
            role: announcement.role,
            domain_id,
            topic: announcement.topic.as_str().into(),
            message_type: announcement.type_name.message().as_str().into(),
            type_hash: announcement.type_hash,
            qos: announcement.qos,
            first_seen: at,
            shared_memory,
            data_sharing: announcement.datasharing,
        };
        let subject = Subject::endpoint(guid, &endpoint);
        self.endpoints.insert(guid, Box::new(endpoint));
        if let Some(participant) = self.participants.get_mut(&guid.prefix) {
            participant.endpoints.insert(guid);
        }
        self.changes.push(Change::Appeared(guid));
        self.note(&subject, Event::Appeared, at, journal);
    }

    /// What waited for this participant.
    fn adopt_pending(&mut self, prefix: GuidPrefix, at: Timestamp, journal: &mut Journal) {
        let (adopted, waiting) = std::mem::take(&mut self.pending_endpoints)
            .into_iter()
            .partition(|pending| pending.announcement.guid.prefix == prefix);
        self.pending_endpoints = waiting;
        let adopted: VecDeque<PendingEndpoint> = adopted;
        for pending in adopted {
            if let Some(participant) = self.participants.get_mut(&prefix) {
                participant.readers_told |= pending.tells_readers;
            }
            self.admit(*pending.announcement, at, journal);
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

    fn set_nodes(
        &mut self,
        prefix: GuidPrefix,
        writer: Guid,
        sequence_number: u64,
        nodes: Vec<Node>,
        at: Timestamp,
        journal: &mut Journal,
    ) {
        let Some(participant) = self.participants.get_mut(&prefix) else {
            return;
        };
        let older = |(from, number): (Guid, u64)| from == writer && number >= sequence_number;
        if participant.nodes_from.is_some_and(older) {
            return;
        }
        participant.nodes_from = Some((writer, sequence_number));
        let domain_id = participant.domain_id;
        let before = std::mem::replace(&mut participant.nodes, nodes);
        self.named = self.named.saturating_sub(named(&before)) + named(&participant.nodes);
        let after: Vec<_> = participant
            .nodes
            .iter()
            .map(|node| Arc::clone(&node.name))
            .collect();
        self.node_count = self.node_count + after.len() - before.len().min(self.node_count);
        let before: Vec<_> = before.into_iter().map(|node| node.name).collect();
        let guid = Guid::new(prefix, EntityId::PARTICIPANT);
        for name in difference(&before, &after) {
            let subject = Subject::node(domain_id, guid, &name);
            self.note(&subject, Event::Disposed, at, journal);
        }
        for name in difference(&after, &before) {
            let subject = Subject::node(domain_id, guid, &name);
            self.note(&subject, Event::Appeared, at, journal);
        }
    }

    /// Takes a participant out with all it has; `event` is `None` for a silent eviction.
    fn remove(
        &mut self,
        prefix: GuidPrefix,
        at: Timestamp,
        event: Option<Event>,
        journal: &mut Journal,
    ) {
        self.pending_nodes.remove(&prefix);
        self.pending_endpoints
            .retain(|pending| pending.announcement.guid.prefix != prefix);
        let Some(participant) = self.participants.remove(&prefix) else {
            return;
        };
        let domain_id = participant.domain_id;
        let guid = Guid::new(prefix, EntityId::PARTICIPANT);
        if let Some(event) = event {
            let subject = Subject::participant(domain_id, guid, &participant.portrait);
            self.note(&subject, event, at, journal);
        }
        let cascade = event.map(|_| Event::Cascaded);
        for endpoint in participant.endpoints {
            self.drop_endpoint(endpoint, cascade, at, journal);
        }
        self.node_count = self.node_count.saturating_sub(participant.nodes.len());
        self.named = self.named.saturating_sub(named(&participant.nodes));
        if let Some(event) = cascade {
            for node in participant.nodes {
                let subject = Subject::node(domain_id, guid, &node.name);
                self.note(&subject, event, at, journal);
            }
        }
    }

    fn drop_endpoint(
        &mut self,
        guid: Guid,
        event: Option<Event>,
        at: Timestamp,
        journal: &mut Journal,
    ) {
        let Some(endpoint) = self.endpoints.remove(&guid) else {
            return;
        };
        if let Some(event) = event {
            self.note(&Subject::endpoint(guid, &endpoint), event, at, journal);
        }
        self.changes.push(Change::Gone(guid, endpoint));
    }

    /// A participant's domain is told better than before: all it has moves along.
    fn move_to(&mut self, prefix: GuidPrefix, domain_id: u32, source: DomainSource) {
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
    }

    /// Gives up a participant that said something once and nothing since.
    fn make_room(&mut self, now: Timestamp) -> bool {
        if now < self.search_after {
            return false;
        }
        let doubtful = self.participants.iter().filter(|(_, participant)| {
            let span = participant
                .last_seen
                .0
                .saturating_sub(participant.first_seen.0);
            let patience = if span < ESTABLISHED {
                DOUBTFUL
            } else {
                FORSAKEN
            };
            participant.last_seen.0.saturating_add(patience) <= now.0
        });
        let oldest = doubtful.min_by_key(|(prefix, participant)| (participant.last_seen, **prefix));
        let Some(prefix) = oldest.map(|(prefix, _)| *prefix) else {
            self.search_after = Timestamp(now.0.saturating_add(SEARCH));
            return false;
        };
        self.evictions.participants += 1;
        self.revision += 1;
        self.remove(prefix, now, None, &mut Journal::default());
        self.participants.len() < self.caps.participants
            && self.endpoints.len() < self.caps.endpoints
    }

    fn note(&mut self, subject: &Subject<'_>, event: Event, at: Timestamp, journal: &mut Journal) {
        self.revision += 1;
        self.churn.count(subject.domain_id, subject.entity(), event);
        journal.note(DiscoveryEvent {
            at,
            domain_id: subject.domain_id,
            entity: subject.entity().label(),
            event: event.label(),
            guid: subject.guid,
            name: subject.name(),
        });
        journal.events.push(at, subject.happened(event));
    }
}

/// Names of `one` that are not in `other`, each as often as it is missing there.
fn difference(one: &[Arc<str>], other: &[Arc<str>]) -> Vec<Arc<str>> {
    let mut rest: Vec<_> = other.to_vec();
    let mut missing = Vec::new();
    for name in one {
        match rest.iter().position(|each| each == name) {
            Some(index) => drop(rest.swap_remove(index)),
            None => missing.push(Arc::clone(name)),
        }
    }
    missing
}
