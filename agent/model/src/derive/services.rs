//! Latency of services and actions: which reply answers which request, and how long that takes.
//!
//! A request and its reply share an identity: rmw_fastrtps puts it into their inline QoS,
//! rmw_cyclonedds before their payload. The writers of service topics are therefore captured,
//! within a budget. Every copy of a request or reply, even one that is only metered, is then
//! recognised by writer and sequence number.
//!
//! A call begins when its request is first seen, which is at the client's socket if the client is
//! on this host. It ends when the reply is complete and, for a client on this host, has arrived at
//! the client's socket. Otherwise it ends when the reply is first seen. Messages that are only
//! sampled in shared memory are ignored, because requests with unseen replies would seem
//! unanswered.

pub mod action;
pub mod facts;
pub mod latency;
pub mod service;

use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::sync::Arc;
use std::time::Duration;

use foldhash::HashMap;
use ros2probe_wire::names::{ActionPart, RosName};
use ros2probe_wire::rtps::{RequestHeader, VendorId};
use ros2probe_wire::walk::Found;
use ros2probe_wire::{DomainId, Guid, GuidPrefix, SequenceNumber, WireError};

use self::facts::{ActionFacts, ServiceFacts};
use crate::facts::bounded::{Bounded, Counted, Sum, TableFacts};
use crate::facts::diagnosis::TopicKey;
use crate::facts::model_time::ModelTime;
use crate::facts::names::TopicName;
use crate::facts::naming::Naming;
use crate::facts::observation::{Head, Sample};
use crate::facts::tables::{CallIdentities, OpenCalls, ServiceFigures, ServiceWriters};
use crate::facts::topic_kind::TopicKind;
use action::Action;
use service::{CallId, Capture, Position, Service};

/// Maximum bytes per second of one writer. A writer that exceeds it is not captured for a while.
const MAX_BYTES_PER_SECOND: usize = 4 << 20;
/// Time for which a writer above the maximum is not captured.
const SUSPENSION_TIME: Duration = Duration::from_secs(10);

/// End of the name of a node's service for descriptions of types (REP-2016).
const TYPE_DESCRIPTION: &str = "/get_type_description";

/// Domain and ROS name of a service or action.
type Key = (DomainId, TopicName);

/// All services with calls.
#[derive(Debug, Default)]
pub struct Services {
    writers: Bounded<ServiceWriters, HashMap<Guid, ServiceWriter>>,
    identities: Identities,
    services: Bounded<ServiceFigures, BTreeMap<Key, Service>>,
    actions: Bounded<ServiceFigures, BTreeMap<Key, Action>>,
    /// Calls without a reply, of all services.
    open: Sum<Counted<OpenCalls>>,
    revision: u64,
    /// Whether a topic of a service is or was measured.
    has_measured: bool,
}

/// A writer of requests or replies.
#[derive(Debug)]
struct ServiceWriter {
    half: Half,
    service: Arc<ServiceName>,
    /// Whether it sends responses of `get_type_description`.
    describes_types: bool,
    /// Second of the source's clock in which `bytes` were captured.
    second: u64,
    bytes: usize,
    suspended: Option<ModelTime>,
}

/// One half of a call.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Half {
    /// The topic of requests.
    Requests,
    /// The topic of replies.
    Replies,
}

/// The names of a service.
#[derive(Debug)]
struct ServiceName {
    key: Key,
    /// The action to which it belongs, and its role in the action.
    action: Option<(Key, ActionPart)>,
}

/// The identities of the latest requests and replies.
#[derive(Debug, Default)]
struct Identities {
    known: Bounded<CallIdentities, HashMap<(Guid, SequenceNumber), Identity>>,
    order: Bounded<CallIdentities, VecDeque<(Guid, SequenceNumber)>>,
}

/// Data from the first captured copy of a request or reply.
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
        if self.writers.is_full() {
            self.writers.refuse();
            self.open.refuse();
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
            describes_types: half == Half::Replies && naming.name.ends_with(TYPE_DESCRIPTION),
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
            self.open.sub(before - service.open());
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

    /// Returns whether this writer sends responses of `get_type_description`.
    #[must_use]
    pub fn describes_types(&self, guid: Guid) -> bool {
        let writer = self.writers.get(&guid);
        writer.is_some_and(|writer| writer.describes_types)
    }

    /// Reads the identity of a captured request or reply. Returns whether its writer has exceeded
    /// the budget and should not be captured now.
    ///
    /// # Errors
    /// Fails if the message has no valid identity.
    pub fn identify(
        &mut self,
        found: &Found<'_>,
        sample: &Sample,
        vendor: VendorId,
    ) -> Result<bool, WireError> {
        let Head {
            writer: guid, at, ..
        } = sample.head;
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
                .put((guid, sample.sequence_number), identity);
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
        at: ModelTime,
    ) -> bool {
        if !self.writers.contains_key(&guid) {
            return false;
        }
        if self.charge(guid, payload.len(), at) {
            return true;
        }
        let identity = Identity::of(call, payload.get(ENCAPSULATION_BYTES..).unwrap_or_default());
        self.identities.put((guid, number), identity);
        false
    }

    /// Charges captured bytes of a writer; returns whether it has exceeded its budget.
    fn charge(&mut self, guid: Guid, bytes: usize, at: ModelTime) -> bool {
        let Some(writer) = self.writers.get_mut(&guid) else {
            return false;
        };
        if !writer.is_over_budget(bytes, at) {
            return false;
        }
        let until = at + SUSPENSION_TIME;
        writer.suspended = Some(until);
        let key = writer.service.key.clone();
        self.suspend(&key, until, at);
        true
    }

    /// Records a copy of a request or reply; `receiver` determines which participant receives it.
    /// If a reply ends its call, returns the time of the request and the writer that sent it.
    pub fn seen(
        &mut self,
        sample: &Sample,
        receiver: impl FnOnce() -> Option<GuidPrefix>,
    ) -> Option<(ModelTime, Guid)> {
        let head = &sample.head;
        let guid = head.writer;
        let message = (guid, sample.sequence_number);
        if head.is_polled() {
            return None;
        }
        let writer = self.writers.get(&guid)?;
        let identity = self.identities.known.get(&message).copied()?;
        let service = Arc::clone(&writer.service);
        let position = position(sample);
        let mut sighting = Capture {
            at: head.at,
            socket: head.socket,
            position,
            receiver: None,
        };
        match writer.half {
            Half::Requests => {
                // A fragmented request begins with its first fragment.
                sighting.at = head.began();
                self.requested(&service, guid, identity, sighting);
                if head.is_exact()
                    && let Some(service) = self.services.get_mut(&service.key)
                {
                    service.is_exact = true;
                }
                None
            }
            Half::Replies => {
                if position == Position::Arriving {
                    sighting.receiver = receiver();
                }
                self.replied(&service, guid, identity, sample, sighting)
            }
        }
    }

    /// Marks hanging calls, and drops services for which `is_known` is false. Returns the writers
    /// that are to be captured again.
    pub fn advance(
        &mut self,
        timeout: Duration,
        now: ModelTime,
        is_known: impl Fn(DomainId, &str) -> bool,
    ) -> Vec<Guid> {
        let mut changed = false;
        self.services.retain(|(domain_id, name), service| {
            // `get_result` is answered only when the goal ends, however long that takes.
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
        self.open.clear();
        self.open
            .add(self.services.values().map(Service::open).sum());
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

    /// Returns the statistics of all services with calls, sorted by domain and name.
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

    /// Returns the statistics of all actions with goals, sorted by domain and name.
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

    /// Returns the number of calls without a reply, its cap, and the number of entries that caps
    /// dropped.
    #[must_use]
    pub fn table(&self) -> TableFacts {
        let mut facts = self.open.facts();
        let goals = self.actions.values().map(|action| action.evictions);
        facts.evictions += goals.sum::<u64>();
        facts
    }

    fn requested(
        &mut self,
        name: &ServiceName,
        writer: Guid,
        identity: Identity,
        sighting: Capture,
    ) {
        if !self.services.contains_key(&name.key) && !self.make_room(sighting.at) {
            return;
        }
        let key = name.key.clone();
        let Some(service) = self.services.get_or_insert_with(key, Service::default) else {
            return;
        };
        let goal = identity.goal.filter(|_| name.action.is_some());
        if !service.request(identity.call, writer, sighting, goal) {
            return;
        }
        self.open.add(1);
        if self.open.is_exceeded() {
            self.open.refuse();
            self.open.sub(service.drop_oldest_call().into());
            self.revision += 1;
        }
    }

    fn replied(
        &mut self,
        name: &ServiceName,
        writer: Guid,
        identity: Identity,
        sample: &Sample,
        sighting: Capture,
    ) -> Option<(ModelTime, Guid)> {
        let service = self.services.get_mut(&name.key)?;
        let answered = service.reply(identity.call, writer, sample, sighting)?;
        let request = Some((answered.sent, answered.client));
        self.open.sub(1);
        self.revision += u64::from(answered.was_hanging);
        let (Some((key, part)), Some(goal)) = (&name.action, answered.goal) else {
            return request;
        };
        if !self.actions.contains_key(key) && self.actions.is_full() {
            self.actions.refuse();
            self.open.refuse();
            return request;
        }
        match part {
            ActionPart::SendGoal => {
                let key = key.clone();
                if let Some(action) = self.actions.get_or_insert_with(key, Action::default) {
                    action.replied(goal, answered.sent, identity.first != 0);
                }
            }
            ActionPart::GetResult => {
                if let Some(action) = self.actions.get_mut(key) {
                    action.result(goal, identity.first, sighting.at);
                }
            }
            ActionPart::CancelGoal | ActionPart::Feedback | ActionPart::Status => {}
        }
        request
    }

    /// Returns whether one more service can be added. If necessary, the service without open calls
    /// whose last request is oldest is dropped.
    fn make_room(&mut self, at: ModelTime) -> bool {
        if !self.services.is_full() {
            return true;
        }
        self.services.refuse();
        self.open.refuse();
        let idle = self.services.iter().filter(|(_, it)| it.open() == 0);
        let oldest = idle.min_by_key(|(_, service)| service.last_request);
        let oldest = oldest.filter(|(_, service)| service.last_request < at);
        let oldest = oldest.map(|(key, _)| key.clone());
        oldest.is_some_and(|key| self.services.remove(&key).is_some())
    }

    /// Drops the open calls of a service, because one of its writers is no longer captured.
    fn suspend(&mut self, key: &Key, until: ModelTime, at: ModelTime) {
        self.open.refuse();
        if !self.services.contains_key(key) && !self.make_room(at) {
            return;
        }
        let key = key.clone();
        let Some(service) = self.services.get_or_insert_with(key, Service::default) else {
            return;
        };
        service.suspended = Some(until);
        self.open.sub(service.open());
        self.revision += u64::from(service.forget_calls());
    }
}

impl ServiceWriter {
    /// Charges captured bytes; returns whether they exceed the budget of this second.
    const fn is_over_budget(&mut self, bytes: usize, at: ModelTime) -> bool {
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
        if !self.known.contains_key(&message)
            && let Some(oldest) = self.order.push_back(message)
        {
            self.known.remove(&oldest);
        }
        self.known.insert(message, identity);
    }
}

/// Reads the identity of a request or reply; `None` if this fragment does not contain it, or if the
/// middleware does not relate replies to requests.
fn identity(
    half: Half,
    found: &Found<'_>,
    sample: &Sample,
    vendor: VendorId,
) -> Result<Option<Identity>, WireError> {
    let number = sample.sequence_number;
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
            // A request has the number of its own sample.
            (Half::Requests, Some(related)) if related.writer != Guid::default() => CallId {
                client: related.writer.to_bytes(),
                number,
            },
            (Half::Requests, _) if sample.is_start() => CallId {
                client: sample.head.writer.to_bytes(),
                number,
            },
            (Half::Replies, Some(related)) => CallId {
                client: related.writer.to_bytes(),
                number: related.sequence_number,
            },
            _ => return Ok(None),
        };
        (call, ENCAPSULATION_BYTES)
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

/// Returns the identity of the call to which a whole request or reply belongs; `None` if the
/// middleware does not relate replies to requests.
#[must_use]
pub fn call(half: Half, found: &Found<'_>, sample: &Sample, vendor: VendorId) -> Option<CallId> {
    let identity = identity(half, found, sample, vendor).ok()?;
    identity.map(|identity| identity.call)
}

/// Bytes of the encapsulation header (RTPS 2.5, 10.2).
const ENCAPSULATION_BYTES: usize = 4;

/// Returns where the sample was seen.
fn position(sample: &Sample) -> Position {
    if !sample.is_delivered() {
        Position::Dropped
    } else if !sample.head.is_at_socket() {
        Position::Elsewhere
    } else if sample.head.is_sent() {
        Position::Leaving
    } else {
        Position::Arriving
    }
}
