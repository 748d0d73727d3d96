//! Latency of services and actions: which reply answers which request, and after what time.
//!
//! A request and its reply share an identity: rmw_fastrtps puts it into their inline QoS,
//! rmw_cyclonedds before their payload. So the writers of service topics are captured, within a
//! budget. Every copy of a request or reply, also one that is only metered, is then recognised by
//! writer and sequence number.
//!
//! A call begins when its request is first seen, which is at the client's socket if that is on this
//! host. It ends when the reply is whole and, for such a client, has arrived at the client's socket.
//! Otherwise it ends when the reply is first seen. Messages that are only sampled in shared memory
//! are left out, because missing ones would look unanswered.

pub mod action;
pub mod latency;
pub mod service;

use std::collections::{BTreeMap, BTreeSet, HashMap, VecDeque};
use std::sync::Arc;
use std::time::Duration;

use ros2probe_wire::names::{ActionPart, RosName};
use ros2probe_wire::record::{Sample, flag};
use ros2probe_wire::rtps::{RequestHeader, VendorId};
use ros2probe_wire::walk::Found;
use ros2probe_wire::{DomainId, Guid, GuidPrefix, Record, SequenceNumber, Timestamp, WireError};

use crate::diagnosis::TopicKey;
use crate::names::TopicName;
use crate::naming::Naming;
use crate::profiler::UNDELIVERED;
use crate::size::Size;
use crate::snapshot::{ActionFacts, ServiceFacts};
use crate::topic_kind::TopicKind;
use action::Action;
use service::{CallId, Position, Service, Sighting};

/// Largest number of writers of requests and replies that are captured.
pub const MAX_WRITERS: usize = 4096;
/// Largest number of services, and of actions, with figures.
const MAX_SERVICES: usize = 512;
/// Largest number of calls without a reply, of all services.
const MAX_CALLS: usize = 4096;
/// Largest number of messages whose identity is remembered, for further copies of them.
const MAX_IDENTITIES: usize = 4096;
/// Bytes per second of one writer above which it is not captured for a while.
const MAX_BYTES_PER_SECOND: usize = 4 << 20;
/// Time for which such a writer is not captured.
const SUSPENDED: Duration = Duration::from_secs(10);

/// Domain and ROS name of a service or action.
type Key = (DomainId, TopicName);

/// All services with calls.
#[derive(Debug, Default)]
pub struct Services {
    writers: HashMap<Guid, ServiceWriter>,
    identities: Identities,
    services: BTreeMap<Key, Service>,
    actions: BTreeMap<Key, Action>,
    /// Calls without a reply, of all services.
    open: usize,
    evictions: u64,
    revision: u64,
    /// Whether a topic of a service is or was measured.
    has_measured: bool,
}

/// A writer of requests or replies.
#[derive(Debug)]
struct ServiceWriter {
    half: Half,
    service: Arc<ServiceName>,
    /// Second of the source's clock in which `bytes` were captured.
    second: u64,
    bytes: usize,
    suspended: Option<Timestamp>,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Half {
    Requests,
    Replies,
}

/// The names of a service.
#[derive(Debug)]
struct ServiceName {
    key: Key,
    /// The action that it belongs to, and its role there.
    action: Option<(Key, ActionPart)>,
}

/// The identities of the latest requests and replies.
#[derive(Debug, Default)]
struct Identities {
    known: HashMap<(Guid, SequenceNumber), Identity>,
    order: VecDeque<(Guid, SequenceNumber)>,
}

/// What the first captured copy of a request or reply shows.
#[derive(Clone, Copy, Debug)]
struct Identity {
    call: CallId,
    /// First 16 bytes of a request: the goal's id in the services of an action.
    goal: Option<[u8; 16]>,
    /// First byte of a reply: `accepted` of `send_goal`, `status` of `get_result`.
    first: u8,
}

impl Services {
    /// Adds a writer of requests or replies; returns whether it is to be captured.
    pub fn announce(&mut self, guid: Guid, domain_id: DomainId, naming: &Naming) -> bool {
        let half = match naming.kind {
            TopicKind::ServiceRequest => Half::Requests,
            TopicKind::ServiceReply => Half::Replies,
            _ => return false,
        };
        if let Some(known) = self.writers.get(&guid) {
            return known.suspended.is_none();
        }
        if self.writers.len() >= MAX_WRITERS {
            self.evictions += 1;
            return false;
        }
        let action = RosName::parse(&naming.name).ok();
        let action = action.and_then(|name| name.action());
        let service = ServiceName {
            key: (domain_id, naming.name.clone()),
            action: action.map(|(name, part)| ((domain_id, name.as_str().into()), part)),
        };
        let writer = ServiceWriter {
            half,
            service: Arc::new(service),
            second: 0,
            bytes: 0,
            suspended: None,
        };
        self.writers.insert(guid, writer);
        true
    }

    /// Removes a writer that is gone, with its open calls.
    pub fn forget(&mut self, guid: Guid) {
        let Some(writer) = self.writers.remove(&guid) else {
            return;
        };
        if writer.half == Half::Requests
            && let Some(service) = self.services.get_mut(&writer.service.key)
        {
            let before = service.open();
            let changed = service.forget_client(guid);
            self.open -= before - service.open();
            self.revision += u64::from(changed);
        }
    }

    /// Records that a topic of a service is measured.
    pub const fn note_measured(&mut self) {
        self.has_measured = true;
    }

    /// Returns whether a topic of a service is or was measured.
    #[must_use]
    pub const fn has_measured(&self) -> bool {
        self.has_measured
    }

    /// Returns whether this writer sends requests or replies that are captured.
    #[must_use]
    pub fn follows(&self, guid: Guid) -> bool {
        self.writers.contains_key(&guid)
    }

    /// Reads the identity of a captured request or reply. Returns whether its writer has exceeded
    /// the budget and should not be captured now.
    ///
    /// # Errors
    /// Fails if the message has no valid identity.
    pub fn identify(
        &mut self,
        found: &Found<'_>,
        sample: Sample<'_>,
        vendor: VendorId,
        at: Timestamp,
    ) -> Result<bool, WireError> {
        let guid = found.record.writer();
        let Some(half) = self.writers.get(&guid).map(|writer| writer.half) else {
            return Ok(false);
        };
        if self.charge(guid, found.payload.len(), at) {
            return Ok(true);
        }
        if sample.is_message()
            && let Some(identity) = identity(half, found, sample, vendor)?
        {
            self.identities
                .put((guid, sample.sequence_number()), identity);
        }
        Ok(false)
    }

    /// Records the identity of a captured request or reply that its middleware sends beside
    /// the payload. Returns the same as [`Self::identify`].
    pub fn identified(
        &mut self,
        guid: Guid,
        number: SequenceNumber,
        call: CallId,
        payload: &[u8],
        at: Timestamp,
    ) -> bool {
        if !self.writers.contains_key(&guid) {
            return false;
        }
        if self.charge(guid, payload.len(), at) {
            return true;
        }
        let identity = Identity::of(call, payload.get(ENCAPSULATION..).unwrap_or_default());
        self.identities.put((guid, number), identity);
        false
    }

    /// Charges captured bytes of a writer; returns whether it has exceeded its budget.
    fn charge(&mut self, guid: Guid, bytes: usize, at: Timestamp) -> bool {
        let Some(writer) = self.writers.get_mut(&guid) else {
            return false;
        };
        if !writer.is_over_budget(bytes, at) {
            return false;
        }
        let until = at + SUSPENDED;
        writer.suspended = Some(until);
        let key = writer.service.key.clone();
        self.suspend(&key, until, at);
        true
    }

    /// Records a copy of a request or reply; `receiver` determines which participant receives it.
    pub fn seen(
        &mut self,
        record: &Record,
        sample: Sample<'_>,
        receiver: impl FnOnce() -> Option<GuidPrefix>,
    ) {
        let guid = record.writer();
        let message = (guid, sample.sequence_number());
        if record.flags & (flag::SHM | flag::EXACT) == flag::SHM {
            return;
        }
        let Some(writer) = self.writers.get(&guid) else {
            return;
        };
        let Some(identity) = self.identities.known.get(&message).copied() else {
            return;
        };
        let service = Arc::clone(&writer.service);
        let position = position(record);
        let mut sighting = Sighting {
            at: Timestamp(record.time),
            socket: record.socket,
            position,
            receiver: None,
        };
        match writer.half {
            Half::Requests => {
                // A fragmented request begins with its first fragment.
                sighting.at = record.began();
                self.requested(&service, guid, identity, sighting);
                if record.flags & flag::EXACT != 0
                    && let Some(service) = self.services.get_mut(&service.key)
                {
                    service.is_exact = true;
                }
            }
            Half::Replies => {
                if position == Position::Arriving {
                    sighting.receiver = receiver();
                }
                self.replied(&service, guid, identity, sample, sighting);
            }
        }
    }

    /// Marks hanging calls, and drops services for which `is_known` is false. Returns the writers
    /// that are to be captured again.
    pub fn advance(
        &mut self,
        timeout: Duration,
        now: Timestamp,
        is_known: impl Fn(DomainId, &str) -> bool,
    ) -> Vec<Guid> {
        let mut changed = false;
        self.services.retain(|(domain_id, name), service| {
            // The result of a goal is late by design.
            let timeout = match name.ends_with("/_action/get_result") {
                true => Duration::MAX,
                false => timeout,
            };
            changed |= service.advance(timeout, now);
            service.suspended = service.suspended.filter(|until| now < *until);
            is_known(*domain_id, name)
        });
        self.actions.retain(|(domain_id, name), _| {
            is_known(*domain_id, &format!("{name}/_action/send_goal"))
        });
        self.open = self.services.values().map(Service::open).sum();
        self.revision += u64::from(changed);
        let mut resumed = Vec::new();
        for (guid, writer) in &mut self.writers {
            if writer.suspended.is_some_and(|until| until <= now) {
                writer.suspended = None;
                resumed.push(*guid);
            }
        }
        resumed.sort_unstable();
        resumed
    }

    /// Returns a number that increases when the hanging calls change.
    #[must_use]
    pub const fn revision(&self) -> u64 {
        self.revision
    }

    /// Returns the topic and writer of the requests of each client with hanging calls.
    #[must_use]
    pub fn hanging(&self) -> BTreeSet<(TopicKey, Guid)> {
        let mut hanging = BTreeSet::new();
        for ((domain_id, name), service) in &self.services {
            for client in service.hanging_clients() {
                let topic = TopicKey {
                    domain_id: *domain_id,
                    dds_name: format!("rq{name}Request").into(),
                    name: name.clone(),
                    kind: TopicKind::ServiceRequest,
                };
                hanging.insert((topic, client));
            }
        }
        hanging
    }

    /// Returns the figures of all services with calls, sorted by domain and name.
    #[must_use]
    pub fn facts(&self) -> Vec<ServiceFacts> {
        let facts = |((domain_id, name), service): (&Key, &Service)| ServiceFacts {
            domain_id: *domain_id,
            name: name.clone(),
            requests: service.requests,
            answered: service.answered,
            unanswered: service.unanswered,
            open: service.open(),
            hanging: service.hanging(),
            latency: service.latencies.facts(),
            suspended: service.suspended.is_some(),
            exact: service.is_exact,
        };
        self.services.iter().map(facts).collect()
    }

    /// Returns the figures of all actions with goals, sorted by domain and name.
    #[must_use]
    pub fn action_facts(&self) -> Vec<ActionFacts> {
        let facts = |((domain_id, name), action): (&Key, &Action)| ActionFacts {
            domain_id: *domain_id,
            name: name.clone(),
            goals: action.counts,
            open: action.open(),
            duration: action.durations.facts(),
        };
        self.actions.iter().map(facts).collect()
    }

    /// Returns the number of open calls, their cap, and the entries of every table that were
    /// dropped because of a cap.
    #[must_use]
    pub fn size(&self) -> (usize, usize, u64) {
        let goals: u64 = self.actions.values().map(|action| action.evictions).sum();
        (self.open, MAX_CALLS, self.evictions + goals)
    }

    /// Returns the size and cap of each table.
    #[must_use]
    pub fn sizes(&self) -> Vec<Size> {
        // The destructuring makes a new table fail to compile until it is listed here.
        let Self {
            writers,
            identities,
            services,
            actions,
            open: _,
            evictions: _,
            revision: _,
            has_measured: _,
        } = self;
        let Identities { known, order } = identities;
        let mut sizes = vec![
            Size::new("services.writers", writers.len(), MAX_WRITERS),
            Size::new("services.identities", known.len(), MAX_IDENTITIES),
            Size::new("services.order", order.len(), MAX_IDENTITIES),
            Size::new("services.services", services.len(), MAX_SERVICES),
            Size::new("services.actions", actions.len(), MAX_SERVICES),
        ];
        // The empty ones list the tables of an agent without calls.
        let (no_service, no_action) = (Service::default(), Action::default());
        let each = services.values().chain([&no_service]);
        let each = each.flat_map(|each| each.sizes(MAX_CALLS));
        let actions = actions.values().chain([&no_action]);
        let all = each.chain(actions.flat_map(Action::sizes));
        sizes.extend(crate::size::largest(all));
        sizes
    }

    fn requested(
        &mut self,
        name: &ServiceName,
        writer: Guid,
        identity: Identity,
        sighting: Sighting,
    ) {
        if !self.services.contains_key(&name.key) && !self.has_place(sighting.at) {
            return;
        }
        let service = self.services.entry(name.key.clone()).or_default();
        let goal = identity.goal.filter(|_| name.action.is_some());
        if !service.request(identity.call, writer, sighting, goal) {
            return;
        }
        self.open += 1;
        if self.open > MAX_CALLS {
            self.evictions += 1;
            self.open -= usize::from(service.forget_one());
            self.revision += 1;
        }
    }

    fn replied(
        &mut self,
        name: &ServiceName,
        writer: Guid,
        identity: Identity,
        sample: Sample<'_>,
        sighting: Sighting,
    ) {
        let Some(service) = self.services.get_mut(&name.key) else {
            return;
        };
        let Some(answered) = service.reply(identity.call, writer, sample, sighting) else {
            return;
        };
        self.open -= 1;
        self.revision += u64::from(answered.was_hanging);
        let (Some((key, part)), Some(goal)) = (&name.action, answered.goal) else {
            return;
        };
        if !self.actions.contains_key(key) && self.actions.len() >= MAX_SERVICES {
            self.evictions += 1;
            return;
        }
        match part {
            ActionPart::SendGoal => {
                let action = self.actions.entry(key.clone()).or_default();
                action.replied(goal, answered.sent, identity.first != 0);
            }
            ActionPart::GetResult => {
                if let Some(action) = self.actions.get_mut(key) {
                    action.result(goal, identity.first, sighting.at);
                }
            }
            ActionPart::CancelGoal | ActionPart::Feedback | ActionPart::Status => {}
        }
    }

    /// Returns whether one more service has room: if necessary, the one with the oldest request
    /// and without open calls is dropped.
    fn has_place(&mut self, at: Timestamp) -> bool {
        if self.services.len() < MAX_SERVICES {
            return true;
        }
        self.evictions += 1;
        let idle = self.services.iter().filter(|(_, it)| it.open() == 0);
        let oldest = idle.min_by_key(|(_, service)| service.last_request);
        let oldest = oldest.filter(|(_, service)| service.last_request < at);
        let oldest = oldest.map(|(key, _)| key.clone());
        oldest.is_some_and(|key| self.services.remove(&key).is_some())
    }

    /// Drops the open calls of a service, since one of its writers is no longer captured.
    fn suspend(&mut self, key: &Key, until: Timestamp, at: Timestamp) {
        self.evictions += 1;
        if !self.services.contains_key(key) && !self.has_place(at) {
            return;
        }
        let service = self.services.entry(key.clone()).or_default();
        service.suspended = Some(until);
        self.open -= service.open();
        self.revision += u64::from(service.forget_calls());
    }
}

impl ServiceWriter {
    /// Charges captured bytes; returns whether they exceed the budget of this second.
    const fn is_over_budget(&mut self, bytes: usize, at: Timestamp) -> bool {
        let second = at.whole_seconds();
        if second != self.second {
            (self.second, self.bytes) = (second, 0);
        }
        self.bytes += bytes;
        self.bytes > MAX_BYTES_PER_SECOND && self.suspended.is_none()
    }
}

impl Identities {
    fn put(&mut self, message: (Guid, SequenceNumber), identity: Identity) {
        if self.known.insert(message, identity).is_some() {
            return;
        }
        self.order.push_back(message);
        if self.order.len() > MAX_IDENTITIES
            && let Some(oldest) = self.order.pop_front()
        {
            self.known.remove(&oldest);
        }
    }
}

/// Reads the identity of a request or reply; `None` if this fragment does not contain it, or if the
/// middleware does not relate replies to requests.
fn identity(
    half: Half,
    found: &Found<'_>,
    sample: Sample<'_>,
    vendor: VendorId,
) -> Result<Option<Identity>, WireError> {
    let number = sample.sequence_number();
    let (call, body) = if vendor == VendorId::CYCLONE {
        if !sample.is_start() {
            return Ok(None);
        }
        let header = RequestHeader::parse(found.payload)?;
        let mut client = [0; 16];
        for (into, from) in client.iter_mut().zip(header.client_id) {
            *into = from;
        }
        let number = header.sequence_number;
        (CallId { client, number }, RequestHeader::END)
    } else {
        let related = found.inline_qos(vendor)?.related_sample_identity;
        let call = match (half, related) {
            // The number of a request is that of its own sample.
            (Half::Requests, Some(related)) if related.writer != Guid::default() => CallId {
                client: related.writer.to_bytes(),
                number,
            },
            (Half::Requests, _) if sample.is_start() => CallId {
                client: found.record.writer().to_bytes(),
                number,
            },
            (Half::Replies, Some(related)) => CallId {
                client: related.writer.to_bytes(),
                number: related.sequence_number,
            },
            _ => return Ok(None),
        };
        (call, ENCAPSULATION)
    };
    let body = if sample.is_start() {
        found.payload.get(body..).unwrap_or_default()
    } else {
        &[]
    };
    Ok(Some(Identity::of(call, body)))
}

impl Identity {
    /// Returns the identity of a message with this body.
    fn of(call: CallId, body: &[u8]) -> Self {
        Self {
            call,
            goal: body.first_chunk().copied(),
            first: body.first().copied().unwrap_or_default(),
        }
    }
}

/// Bytes of the encapsulation header (RTPS 2.5, 10.2).
const ENCAPSULATION: usize = 4;

/// Returns where the record was seen.
const fn position(record: &Record) -> Position {
    if record.flags & UNDELIVERED != 0 {
        Position::Dropped
    } else if record.flags & flag::HOST == 0 {
        Position::Elsewhere
    } else if record.flags & flag::OUTGOING != 0 {
        Position::Leaving
    } else {
        Position::Arriving
    }
}
