//! One conversation with one participant: announcement, requests, goodbye.
//!
//! A state machine without socket and clock: time and datagrams in, datagrams out. It sends at most
//! [`MAX_PACKETS`] packets whatever the participant does, and the last one is the goodbye.
//! HEARTBEATs are not answered individually: Fast DDS sends several while it repeats its
//! announcements, and restarts after each answer.

use std::collections::BTreeMap;
use std::net::SocketAddrV4;
use std::ops::RangeInclusive;
use std::time::Duration;

use ros2probe_wire::discovery::{self, Discovery, EndpointAnnouncement, Role};
use ros2probe_wire::entities::{NodeEntities, ParticipantEntities};
use ros2probe_wire::rtps::{InlineQos, Payload, VendorId};
use ros2probe_wire::walk::{self, Envelope, Found};
use ros2probe_wire::{EntityId, Guid, GuidPrefix, SequenceNumber, Timestamp};

use super::announcer::Announcer;
use super::message::{
    LocalParticipant, MAX_NUMBERS, Message, NODES_READER, PUBLICATIONS_READER, SUBSCRIPTIONS_READER,
};
use crate::tables::{DiscoveredEndpoints, PartialAnnouncements, UserWriters};
use ros2probe_model::facts::bounded::Bounded;
use ros2probe_model::facts::observation::{Content, Observation, Sample};
use ros2probe_model::facts::wall_clock::WallClock;
use ros2probe_model::graph::discovery_fragments::DiscoveryFragments;

/// Maximum number of packets sent to one participant, including the goodbye.
pub const MAX_PACKETS: u32 = 6;

/// Silence after which the announcement is repeated once. Both vendors announce
/// themselves within 2 ms.
const END_SILENCE: Duration = Duration::from_millis(500);
/// Time from the first HEARTBEAT to the request, so that the second one can arrive.
const REQUEST_DELAY: Duration = Duration::from_millis(20);
/// Maximum wait for requested samples before another request.
const REQUEST_TIMEOUT: Duration = Duration::from_millis(300);
/// Maximum wait for the node list after everything else.
const NODES_TIMEOUT: Duration = Duration::from_millis(500);
/// Maximum duration of a conversation.
const MAX_DURATION: Duration = Duration::from_secs(3);
const NODES_TOPIC: &str = "ros_discovery_info";

/// Participant that receives requests, and its addresses.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Target {
    /// GUID prefix of the participant.
    pub prefix: GuidPrefix,
    /// Address of its discovery endpoints.
    pub metatraffic: SocketAddrV4,
    /// Address of its other endpoints.
    pub default: SocketAddrV4,
}

/// A datagram to send.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Outgoing {
    /// Destination address.
    pub to: SocketAddrV4,
    /// Purpose, for people.
    pub what: &'static str,
    /// Bytes of the datagram.
    pub bytes: Vec<u8>,
}

/// Number of packets, and bytes of their UDP payload.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Traffic {
    /// Number of packets.
    pub packets: u32,
    /// Bytes of UDP payload.
    pub bytes: u64,
}

/// One conversation.
#[derive(Debug)]
pub struct Session {
    local: LocalParticipant,
    target: Target,
    wants_nodes: bool,
    began: Timestamp,
    announced: Timestamp,
    publications: Announcer,
    subscriptions: Announcer,
    /// Time of the first HEARTBEAT of either writer.
    first_heartbeat: Option<Timestamp>,
    /// Time of the last request, and number of requests.
    last_request: Option<Timestamp>,
    requests: u32,
    discovery_fragments: DiscoveryFragments,
    /// Incomplete samples, each with the time of its last fragment.
    partial: Bounded<PartialAnnouncements, BTreeMap<(EntityId, SequenceNumber), Timestamp>>,
    endpoints: Bounded<DiscoveredEndpoints, BTreeMap<Guid, EndpointAnnouncement>>,
    /// First and last sequence number of user writers, from their HEARTBEATs.
    user_writers: Bounded<UserWriters, BTreeMap<EntityId, RangeInclusive<SequenceNumber>>>,
    nodes: Nodes,
    sent: Traffic,
    received: Traffic,
    is_finished: bool,
}

#[derive(Debug)]
enum Nodes {
    /// Not requested. `since` is when everything else was complete.
    Open { since: Option<Timestamp> },
    /// Requested at this time.
    Requested(Timestamp),
    /// Received.
    Listed(Vec<NodeEntities>),
    /// Unavailable.
    Missing,
}

impl Session {
    /// Creates a session; [`Self::advance`] starts it.
    #[must_use]
    pub fn new(local: LocalParticipant, target: Target, wants_nodes: bool) -> Self {
        Self {
            local,
            target,
            wants_nodes,
            began: Timestamp(0),
            announced: Timestamp(0),
            publications: Announcer::of(Role::Writer),
            subscriptions: Announcer::of(Role::Reader),
            first_heartbeat: None,
            last_request: None,
            requests: 0,
            discovery_fragments: DiscoveryFragments::default(),
            partial: Bounded::default(),
            endpoints: Bounded::default(),
            user_writers: Bounded::default(),
            nodes: Nodes::Open { since: None },
            sent: Traffic::default(),
            received: Traffic::default(),
            is_finished: false,
        }
    }

    /// Returns the packets of a conversation without losses, with requests of maximum size.
    #[must_use]
    pub fn plan(&self) -> Vec<Outgoing> {
        let first = SequenceNumber::FIRST;
        let full = || (first, first.until(first + MAX_NUMBERS));
        let mut plan = vec![
            self.to_discovery("introduction", self.message().announce(self.local)),
            self.to_discovery("request", self.request([full(), full()])),
        ];
        if self.wants_nodes {
            let message = self.message();
            let message = message.acknack(NODES_READER, EntityId::UNKNOWN, first, [first], 1);
            plan.push(self.to_user("node request", message));
        }
        plan.push(self.to_discovery("goodbye", self.message().goodbye(self.local)));
        plan
    }

    /// Processes a datagram received at the local participant's socket.
    pub fn datagram(&mut self, now: Timestamp, bytes: &[u8]) {
        self.received.add(bytes.len());
        let vendor = bytes.get(6..8).and_then(|vendor| vendor.try_into().ok());
        let vendor = VendorId(vendor.unwrap_or_default());
        walk::datagram(bytes, &Envelope::default(), None, |found| {
            let record = &found.record;
            let for_us = [self.local.prefix, GuidPrefix::UNKNOWN];
            if record.writer().prefix == self.target.prefix
                && for_us.contains(&record.reader().prefix)
            {
                self.receive(now, &found, vendor);
            }
        });
    }

    /// Advances the time. Returns the datagrams to send now.
    pub fn advance(&mut self, now: Timestamp) -> Vec<Outgoing> {
        let mut outgoing = Vec::new();
        if self.is_finished {
            return outgoing;
        }
        if self.sent.packets == 0 {
            self.began = now;
            self.introduce(now, &mut outgoing);
        }
        let is_deaf = self.first_heartbeat.is_none() && now - self.announced >= END_SILENCE;
        if is_deaf && self.sent.packets == 1 {
            self.introduce(now, &mut outgoing);
        } else if is_deaf || now - self.began >= MAX_DURATION {
            self.end(&mut outgoing);
            return outgoing;
        }
        self.request_announcements(now, &mut outgoing);
        self.request_nodes(now, &mut outgoing);
        self.request_fragments(now, &mut outgoing);
        if self.is_complete(now) {
            self.end(&mut outgoing);
        }
        outgoing
    }

    /// Returns the goodbye, if it has not been sent.
    pub fn say_goodbye(&mut self) -> Vec<Outgoing> {
        let mut outgoing = Vec::new();
        if !self.is_finished && self.sent.packets > 0 {
            self.end(&mut outgoing);
        }
        outgoing
    }

    /// Returns the target of the session.
    #[must_use]
    pub const fn target(&self) -> &Target {
        &self.target
    }

    /// Returns whether the session has ended.
    #[must_use]
    pub const fn is_over(&self) -> bool {
        self.is_finished
    }

    /// Returns whether the participant sent a HEARTBEAT of a writer of SEDP.
    #[must_use]
    pub const fn was_answered(&self) -> bool {
        self.first_heartbeat.is_some()
    }

    /// Returns the number of available announcements that did not arrive.
    #[must_use]
    pub fn missing(&self) -> usize {
        let both = [&self.publications, &self.subscriptions];
        both.map(|announcer| announcer.missing().count())
            .iter()
            .sum()
    }

    /// Returns the endpoints of the participant.
    #[must_use]
    pub fn endpoints(&self) -> &BTreeMap<Guid, EndpointAnnouncement> {
        &self.endpoints
    }

    /// Returns the nodes of the participant; `None` if the list did not arrive.
    #[must_use]
    pub fn nodes(&self) -> Option<&[NodeEntities]> {
        match &self.nodes {
            Nodes::Listed(nodes) => Some(nodes),
            _ => None,
        }
    }

    /// Returns whether the participant has a node list and the session requests it.
    #[must_use]
    pub fn expects_nodes(&self) -> bool {
        self.wants_nodes && self.nodes_writer().is_some()
    }

    /// Returns the sent traffic and the received traffic.
    #[must_use]
    pub const fn cost(&self) -> (Traffic, Traffic) {
        (self.sent, self.received)
    }

    fn receive(&mut self, now: Timestamp, found: &Found<'_>, vendor: VendorId) {
        let observation = Observation::of(&found.record, WallClock::default());
        let entity = observation.head().writer.entity;
        let announcers = [&mut self.publications, &mut self.subscriptions];
        let announcer = announcers.into_iter().find(|it| it.writer == entity);
        match &observation {
            Observation::Heartbeat(heartbeat) => {
                let range = heartbeat.first..=heartbeat.last;
                if let Some(announcer) = announcer {
                    announcer.available = Some(range);
                    self.first_heartbeat.get_or_insert(now);
                } else if !entity.is_builtin() {
                    self.user_writers.insert(entity, range);
                }
            }
            Observation::Gap(gap) => {
                if let Some(announcer) = announcer {
                    announcer.skip(gap);
                } else if Some(entity) == self.nodes_writer() {
                    self.nodes = Nodes::Missing;
                }
            }
            Observation::Sample(sample) => {
                let number = sample.sequence_number;
                let came = match &announcer {
                    Some(announcer) => announcer.received.contains(&number),
                    None => matches!(self.nodes, Nodes::Listed(_)),
                };
                if came || announcer.is_none() && Some(entity) != self.nodes_writer() {
                    return;
                }
                let Some((payload, qos)) = self.complete_payload(now, found, sample, vendor) else {
                    return;
                };
                let payload = payload.borrow();
                if Some(entity) == self.nodes_writer() {
                    self.nodes_announced(payload);
                } else {
                    self.endpoint_announced(entity, number, vendor, payload, &qos);
                }
            }
            _ => {}
        }
    }

    /// Returns the payload of a sample; `None` until its last fragment arrives.
    fn complete_payload<'a>(
        &mut self,
        now: Timestamp,
        found: &Found<'a>,
        sample: &Sample,
        vendor: VendorId,
    ) -> Option<(SamplePayload<'a>, InlineQos)> {
        let Content::DataFrag(fragments) = sample.content else {
            let qos = found.inline_qos(vendor).ok()?;
            return Some((SamplePayload::Borrowed(found.payload()), qos));
        };
        let key = (sample.head.writer.entity, sample.sequence_number);
        let fragmented = &mut self.discovery_fragments;
        let Some(bytes) = fragmented.put(sample, fragments, found.payload) else {
            self.partial.insert(key, now);
            return None;
        };
        self.partial.remove(&key);
        let qos = InlineQos {
            status_info: sample.status_info,
            ..InlineQos::default()
        };
        Some((SamplePayload::Joined(bytes), qos))
    }

    /// Processes the announcement of an endpoint.
    fn endpoint_announced(
        &mut self,
        entity: EntityId,
        number: SequenceNumber,
        vendor: VendorId,
        payload: Payload<'_>,
        qos: &InlineQos,
    ) {
        let announcers = [&mut self.publications, &mut self.subscriptions];
        let Some(announcer) = announcers.into_iter().find(|it| it.writer == entity) else {
            return;
        };
        announcer.received.insert(number);
        match discovery::endpoint(announcer.role, vendor, payload, qos) {
            Ok(Discovery::Alive(endpoint)) if endpoint.guid.prefix == self.target.prefix => {
                self.endpoints.insert(endpoint.guid, endpoint);
            }
            Ok(Discovery::Gone { guid, .. }) => {
                self.endpoints.remove(&guid);
            }
            Ok(Discovery::Alive(_)) | Err(_) => {}
        }
    }

    fn nodes_announced(&mut self, payload: Payload<'_>) {
        if let Ok(entities) = ParticipantEntities::parse(payload.bytes())
            && entities.participant.prefix == self.target.prefix
        {
            self.nodes = Nodes::Listed(entities.nodes);
        }
    }

    /// Returns the writer of the node list; `None` before its announcement.
    fn nodes_writer(&self) -> Option<EntityId> {
        let mut endpoints = self.endpoints.values();
        let writer = endpoints.find(|endpoint| {
            endpoint.role == Role::Writer && endpoint.topic.as_str() == NODES_TOPIC
        });
        writer.map(|endpoint| endpoint.guid.entity)
    }

    fn introduce(&mut self, now: Timestamp, outgoing: &mut Vec<Outgoing>) {
        self.announced = now;
        let message = self.message().announce(self.local);
        self.send(self.to_discovery("introduction", message), outgoing);
    }

    /// Requests announcements after both writers have sent a HEARTBEAT. Repeats the request for
    /// further samples, or after a timeout.
    fn request_announcements(&mut self, now: Timestamp, outgoing: &mut Vec<Outgoing>) {
        let Some(first_heartbeat_at) = self.first_heartbeat else {
            return;
        };
        let both = self.publications.available.is_some() && self.subscriptions.available.is_some();
        let due = match self.last_request {
            None => both || now - first_heartbeat_at >= REQUEST_DELAY,
            Some(asked) => {
                let came = self.publications.is_answered() && self.subscriptions.is_answered();
                came || now - asked >= REQUEST_TIMEOUT
            }
        };
        // One of the remaining packets is for the node request and one for the goodbye.
        let reserved = 1 + u32::from(self.wants_nodes && matches!(self.nodes, Nodes::Open { .. }));
        if !due || self.missing() == 0 || self.sent.packets + reserved >= MAX_PACKETS {
            return;
        }
        let wanted = [&mut self.publications, &mut self.subscriptions].map(Announcer::next_request);
        self.requests += 1;
        let message = self.request(wanted.map(|wanted| {
            let base = wanted.first().copied().unwrap_or_default();
            (base, wanted)
        }));
        self.last_request = Some(now);
        self.send(self.to_discovery("request", message), outgoing);
    }

    /// Requests the node list: the last sample of its writer.
    fn request_nodes(&mut self, now: Timestamp, outgoing: &mut Vec<Outgoing>) {
        if !self.wants_nodes || !matches!(self.nodes, Nodes::Open { .. }) {
            return;
        }
        let Some(writer) = self.nodes_writer() else {
            return;
        };
        let Some(last) = self.user_writers.get(&writer).map(|range| *range.end()) else {
            return;
        };
        if last == SequenceNumber::ZERO || self.sent.packets + 1 >= MAX_PACKETS {
            self.nodes = Nodes::Missing;
            return;
        }
        let message = self
            .message()
            .acknack(NODES_READER, writer, last, [last], 1);
        self.nodes = Nodes::Requested(now);
        self.send(self.to_user("node request", message), outgoing);
    }

    /// Requests missing fragments of incomplete samples.
    fn request_fragments(&mut self, now: Timestamp, outgoing: &mut Vec<Outgoing>) {
        let due = |(_, at): &(&(EntityId, SequenceNumber), &Timestamp)| now - **at >= REQUEST_DELAY;
        let stuck: Vec<_> = self.partial.iter().filter(due).map(|(it, _)| *it).collect();
        if stuck.is_empty() || self.partial.values().any(|at| now - *at < REQUEST_DELAY) {
            return;
        }
        for is_builtin in [true, false] {
            let mut message = self.message();
            let mut asked = false;
            for (writer, number) in &stuck {
                if writer.is_builtin() != is_builtin {
                    continue;
                }
                let reader = match *writer {
                    EntityId::SEDP_PUBLICATIONS_WRITER => PUBLICATIONS_READER,
                    EntityId::SEDP_SUBSCRIPTIONS_WRITER => SUBSCRIPTIONS_READER,
                    _ => NODES_READER,
                };
                let guid = Guid::new(self.target.prefix, *writer);
                let missing = self.discovery_fragments.missing(guid, *number);
                self.requests += 1;
                message = message.nack_frag(reader, *writer, *number, missing, self.requests);
                asked = true;
            }
            if !asked || self.sent.packets + 1 >= MAX_PACKETS {
                continue;
            }
            let what = "request for fragments";
            let datagram = if is_builtin {
                self.to_discovery(what, message)
            } else {
                self.to_user(what, message)
            };
            self.send(datagram, outgoing);
        }
        // Fragments have the same timeout as other requests.
        let later = now + REQUEST_TIMEOUT - REQUEST_DELAY;
        for at in self.partial.values_mut() {
            *at = later;
        }
    }

    /// Returns whether all available answers have arrived.
    fn is_complete(&mut self, now: Timestamp) -> bool {
        let Some(first_heartbeat_at) = self.first_heartbeat else {
            return false;
        };
        let settled = match self.last_request {
            Some(asked) => self.missing() == 0 || now - asked >= REQUEST_TIMEOUT,
            // A participant without endpoints sends HEARTBEATs with firstSN 1 and lastSN 0.
            None => now - first_heartbeat_at >= REQUEST_DELAY && self.missing() == 0,
        };
        if !settled {
            return false;
        }
        if !self.expects_nodes() {
            return true;
        }
        match &mut self.nodes {
            Nodes::Listed(_) | Nodes::Missing => true,
            Nodes::Requested(asked) => now - *asked >= NODES_TIMEOUT,
            Nodes::Open { since: open } => now - *open.get_or_insert(now) >= NODES_TIMEOUT,
        }
    }

    fn end(&mut self, outgoing: &mut Vec<Outgoing>) {
        let message = self.message().goodbye(self.local);
        self.send(self.to_discovery("goodbye", message), outgoing);
        self.is_finished = true;
    }

    fn message(&self) -> Message {
        Message::new(self.local, self.target.prefix)
    }

    /// Returns the request for these sequence numbers, each list with its base. The first request
    /// announces the reader of the node list.
    fn request<N: IntoIterator<Item = SequenceNumber>>(
        &self,
        wanted: [(SequenceNumber, N); 2],
    ) -> Message {
        let mut message = self.message();
        if self.wants_nodes && self.last_request.is_none() {
            message = message.read_nodes(self.local);
        }
        let both = [&self.publications, &self.subscriptions];
        for (announcer, (base, numbers)) in both.into_iter().zip(wanted) {
            if base > SequenceNumber::ZERO {
                let (reader, writer) = (announcer.reader, announcer.writer);
                message = message.acknack(reader, writer, base, numbers, self.requests.max(1));
            }
        }
        message
    }

    fn to_discovery(&self, what: &'static str, message: Message) -> Outgoing {
        Outgoing {
            to: self.target.metatraffic,
            what,
            bytes: message.bytes(),
        }
    }

    fn to_user(&self, what: &'static str, message: Message) -> Outgoing {
        Outgoing {
            to: self.target.default,
            what,
            bytes: message.bytes(),
        }
    }

    fn send(&mut self, datagram: Outgoing, outgoing: &mut Vec<Outgoing>) {
        self.sent.add(datagram.bytes.len());
        outgoing.push(datagram);
    }
}

/// Payload of a sample, either borrowed or reassembled.
enum SamplePayload<'a> {
    Borrowed(Payload<'a>),
    Joined(Vec<u8>),
}

impl SamplePayload<'_> {
    fn borrow(&self) -> Payload<'_> {
        match self {
            Self::Borrowed(payload) => *payload,
            Self::Joined(bytes) => Payload::Data(bytes),
        }
    }
}

impl Traffic {
    fn add(&mut self, length: usize) {
        self.packets += 1;
        self.bytes += length as u64;
    }
}
