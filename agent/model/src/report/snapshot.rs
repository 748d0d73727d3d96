//! The agent's state at one moment: immutable, sorted, complete.
//!
//! The model builds about one snapshot per second, and readers never block the model. All values
//! were settled when the snapshot was taken.

mod delivery;

use std::collections::HashMap;
use std::sync::Arc;

use ros2probe_wire::backends::Backends;
use ros2probe_wire::discovery::{EquivalenceHash, TypeHash};
use ros2probe_wire::qos::Qos;
use ros2probe_wire::rtps::VendorId;
use ros2probe_wire::{DomainId, Guid, GuidPrefix, RtpsDuration, Timestamp};

pub use crate::derive::chain::path::{ChainFacts, ChainsFacts};
pub use crate::derive::clocks::{ClockFacts, ClockOffset, PeerClock};
pub use crate::derive::inside::source::Source;
pub use crate::derive::robot::diagnostics::DiagnosticFacts;
pub use crate::derive::robot::fields::FieldMessage;
pub use crate::derive::robot::lifecycle::{LifecycleFacts, ManagedNode};
pub use crate::derive::robot::logs::{LogFacts, LogMessage, NodeLogFacts};
pub use crate::derive::robot::parameters::{ParameterFacts, ParametersFacts};
pub use crate::derive::robot::transforms::{
    Broadcaster, EdgeFacts, Jumps, TransformFacts, TreeFacts,
};
pub use crate::derive::services::action::GoalCounts;
pub use crate::derive::services::facts::{ActionFacts, ServiceFacts};
pub use crate::derive::services::latency::LatencyFacts;
pub use crate::facts::bounded::TableFacts;
use crate::facts::calls::facts::{InsideFacts, TopicInside};
pub use crate::facts::churn::ChurnCount;
use crate::facts::diagnosis::Diagnoses;
use crate::facts::dispatch::definition_hash;
pub use crate::facts::measurement::{
    Breakdown, Delivered, EarlierCounts, Measurement, SampledFacts,
};
use crate::facts::model_time::ModelTime;
use crate::facts::names::{DdsName, NodeName, TopicName, TypeName};
pub use crate::facts::robot::{DiagnosticStatus, ParameterChange, Requester};
pub use crate::facts::route::Direction;
use crate::facts::selection::Candidate;
use crate::facts::topic_kind::TopicKind;
use crate::facts::wall_clock::WallClock;
use crate::facts::watch::Watch;
pub use crate::facts::watch::WatchState;
use crate::graph::discovery::Addresses;
pub use crate::graph::sockets::SocketFacts;
pub use crate::graph::zenoh::ZenohFacts;
pub use crate::measure::acknowledgement::AcknowledgementFacts;
pub use crate::measure::latched::LatchedFacts;
use crate::measure::links::LinkFacts;
pub use delivery::{DeliveryFacts, Subscriber};

/// All facts at the time `at`. Lists are sorted by identity.
#[derive(Clone, Debug, Default)]
pub struct Snapshot {
    /// Time of the snapshot. All times but those of chains are model time, so a step of the clock
    /// does not change the intervals between them.
    pub at: ModelTime,
    /// Converts the times to wall time. In a replay, this is the wall time of the capture.
    pub wall_clock: WallClock,
    /// Live participants.
    pub participants: Vec<ParticipantFacts>,
    /// ROS nodes of live participants.
    pub nodes: Vec<NodeFacts>,
    /// DDS topics with at least one endpoint, and those that had one within the grace period.
    pub topics: Vec<TopicFacts>,
    /// Active writers whose announcement was missed.
    pub unknown_writers: Vec<UnknownWriterFacts>,
    /// Known sockets of measured samples, sorted by cookie.
    pub sockets: Vec<SocketFacts>,
    /// Watchlist entries, in configuration order.
    pub watches: Vec<WatchFacts>,
    /// Services with calls, sorted by domain and name.
    pub services: Vec<ServiceFacts>,
    /// Actions with goals, sorted by domain and name.
    pub actions: Vec<ActionFacts>,
    /// Facts from inside processes; `None` while that source is off.
    pub inside: Option<Arc<InsideFacts>>,
    /// Figures of Zenoh; `None` until Zenoh was observed.
    pub zenoh: Option<ZenohFacts>,
    /// Chains of messages.
    pub chains: ChainsFacts,
    /// TCP connections to other hosts, by pair of addresses.
    pub links: Vec<LinkFacts>,
    /// TCP connections of RTPS that begin with a handshake of TLS, since the start.
    pub tls_connections: u64,
    /// Logs of nodes.
    pub logs: LogFacts,
    /// Diagnostics.
    pub diagnostics: DiagnosticFacts,
    /// Transforms.
    pub transforms: TransformFacts,
    /// States of managed nodes.
    pub lifecycle: LifecycleFacts,
    /// Last messages whose fields have metrics, sorted by domain and topic, the latest first.
    pub fields: Vec<FieldMessage>,
    /// Parameters of nodes.
    pub parameters: ParametersFacts,
    /// Clocks of hosts.
    pub clocks: ClockFacts,
    /// Problems of the graph; the same value while nothing changes.
    pub diagnoses: Arc<Diagnoses>,
    /// Time at which each problem appeared, in the same order.
    pub diagnosed: Arc<Vec<ModelTime>>,
    /// Counters of discovery events since the start.
    pub churn: Vec<ChurnCount>,
    /// Parse failures since the start.
    pub decode_errors: Vec<DecodeErrorCount>,
    /// Sizes, limits and evictions of the model's tables.
    pub tables: Vec<TableFacts>,
    /// Datagrams processed in user space.
    pub datagrams: u64,
    /// Records processed, from the kernel or from parsing in user space.
    pub records: u64,
    /// Measured topics, including vanished ones.
    pub topics_measured: u64,
    /// Topics that match the watchlist but exceed the cap.
    pub topics_rejected: u64,
}

impl Snapshot {
    /// Returns the wall time of the snapshot.
    #[must_use]
    pub const fn time(&self) -> Timestamp {
        self.wall_time(self.at)
    }

    /// Converts a time of the snapshot to wall time.
    #[must_use]
    pub const fn wall_time(&self, at: ModelTime) -> Timestamp {
        self.wall_clock.wall_time(at)
    }

    /// Returns the clocks of participants on other hosts. A participant has none if no message of
    /// its host arrived, or if clocks are not compared.
    #[must_use]
    pub fn peer_clocks(&self) -> HashMap<GuidPrefix, &PeerClock> {
        let mut clocks = HashMap::new();
        for participant in &self.participants {
            let address = participant.addresses.reachable();
            let mut peers = self.clocks.peers.iter();
            if let Some(peer) = peers.find(|peer| Some(peer.address) == address) {
                clocks.insert(participant.guid.prefix, peer);
            }
        }
        clocks
    }
}

/// One DDS participant.
#[derive(Clone, Debug)]
pub struct ParticipantFacts {
    /// Its GUID (entity 000001c1).
    pub guid: Guid,
    /// Domain, as announced or derived from the discovery port.
    pub domain_id: DomainId,
    /// Its implementation.
    pub vendor: VendorId,
    /// Version of the implementation, if announced.
    pub product_version: Option<Arc<str>>,
    /// ROS enclave; `None` if the participant does not use ROS.
    pub enclave: Option<Arc<str>>,
    /// Host and process of the participant.
    pub process: ProcessFacts,
    /// Time of its first announcement.
    pub first_seen: ModelTime,
    /// Time of its last packet.
    pub last_seen: ModelTime,
    /// Time after which a silent participant is removed.
    pub lease: RtpsDuration,
    /// Whether it announces security: its user data may be encrypted.
    pub secured: bool,
    /// Whether it announces its endpoints by TCP and not by UDP.
    pub announces_by_tcp: bool,
    /// Whether it does so, and none of its messages by TCP was seen.
    pub announces_unseen: bool,
    /// Whether it is a Discovery Server of Fast DDS.
    pub discovery_server: bool,
    /// Whether it is restored from saved state without a packet so far.
    pub restored: bool,
    /// UDP addresses of its discovery endpoints and of its other endpoints.
    pub addresses: Addresses,
}

/// Host and process, as announced or known from the owner of the socket.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct ProcessFacts {
    /// Host name, if announced.
    pub host: Option<Arc<str>>,
    /// Process id of the socket's owner, otherwise as announced. An announced id may be from a
    /// container's namespace, or only the low 16 bits if it comes from the GUID.
    pub id: Option<u32>,
    /// Process name as announced, otherwise that of the socket's owner.
    pub name: Option<Arc<str>>,
    /// Control group of the socket, as a path below the root; it identifies the container.
    pub cgroup: Option<Arc<str>>,
}

/// One ROS node.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct NodeFacts {
    /// Domain of its participant.
    pub domain_id: DomainId,
    /// Fully qualified name, `/robot1/lidar`.
    pub name: NodeName,
    /// Its participant.
    pub participant: Guid,
    /// Its writers.
    pub writers: Vec<Guid>,
    /// Its readers.
    pub readers: Vec<Guid>,
}

/// One topic of one domain.
#[derive(Clone, Debug)]
pub struct TopicFacts {
    /// Domain.
    pub domain_id: DomainId,
    /// ROS name, or the DDS name if the topic follows no ROS convention.
    pub name: TopicName,
    /// DDS name.
    pub dds_name: DdsName,
    /// Role of the topic in ROS.
    pub kind: TopicKind,
    /// Whether it is hidden by ROS convention (a token begins with `_`).
    pub hidden: bool,
    /// Announced message types in ROS form, sorted; more than one is a fault.
    pub message_types: Vec<TypeName>,
    /// Announced RIHS01 type hashes, sorted.
    pub type_hashes: Vec<TypeHash>,
    /// Live writers.
    pub publishers: Vec<EndpointFacts>,
    /// Live readers.
    pub subscriptions: Vec<EndpointFacts>,
    /// Sum over its writers, including vanished ones; present if the topic is or was watched or
    /// requested.
    pub measurement: Option<Box<Measurement>>,
    /// Sum over all receivers and writers, including vanished ones; present once a measured sample
    /// arrived.
    pub received: Option<Box<Delivered>>,
    /// Sum over all destinations to which samples left this host; present once one left.
    pub sent: Option<Box<Delivered>>,
    /// Time that its samples spent in each stage on this host.
    pub breakdown: Option<Box<Breakdown>>,
    /// Every receiver and destination of live writers, sorted by writer, direction, destination and
    /// subscriber.
    pub deliveries: Vec<DeliveryFacts>,
    /// Every reliable reader that acknowledges, sorted by writer and reader.
    pub acknowledgements: Vec<AcknowledgementFacts>,
    /// Whether the last endpoint is gone; the topic is kept for the grace period.
    pub vanished: bool,
    /// Number of pairs of live writers and readers for each transport in use.
    pub transports: Vec<TransportCount>,
    /// Whether a subscription requests its samples.
    pub is_read: bool,
    /// Source of its messages, their rate and the time of the last one.
    pub source: Source,
    /// Figures of the topic from inside observed processes.
    pub inside: Option<Box<TopicInside>>,
    /// Number of pairs with both ends in observed processes, for each transport.
    pub observed_pairs: Vec<TransportCount>,
}

/// Number of intervals after which a topic counts as sent regularly.
const MIN_REGULAR_INTERVALS: u64 = 10;

/// Transport between a writer and a reader, as both announce it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Transport {
    /// The network by UDP, or by TCP of Zenoh, where all messages can be captured.
    Network,
    /// Fast DDS's shared memory, which is sampled.
    SharedMemory,
    /// The reader accesses the writer's history in shared memory, which cannot be observed.
    DataSharing,
    /// The same process, which cannot be observed.
    SameProcess,
    /// Cyclone DDS's iceoryx, which cannot be observed.
    Iceoryx,
    /// The network by TCP, where all messages can be captured.
    Tcp,
}

/// Number of pairs with one transport.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct TransportCount {
    /// The transport.
    pub transport: Transport,
    /// Number of pairs.
    pub pairs: usize,
}

impl Transport {
    /// All transports.
    pub const ALL: [Self; 6] = [
        Self::Network,
        Self::SharedMemory,
        Self::DataSharing,
        Self::SameProcess,
        Self::Iceoryx,
        Self::Tcp,
    ];

    /// Returns whether messages cross the network, where they are captured.
    #[must_use]
    pub const fn is_network(self) -> bool {
        matches!(self, Self::Network | Self::Tcp)
    }

    /// Returns the bit of the transport in a set.
    #[must_use]
    pub const fn bit(self) -> u8 {
        1 << self as u8
    }

    /// Returns the label value.
    #[must_use]
    pub const fn label(self) -> &'static str {
        match self {
            Self::Network => "network",
            Self::SharedMemory => "shared_memory",
            Self::DataSharing => "data_sharing",
            Self::SameProcess => "same_process",
            Self::Iceoryx => "iceoryx",
            Self::Tcp => "tcp",
        }
    }
}

/// One writer or reader.
#[derive(Clone, Debug)]
pub struct EndpointFacts {
    /// GUID.
    pub guid: Guid,
    /// Identity that ROS prints: the GUID, or with Zenoh the hash of the liveliness token.
    pub gid: [u8; 16],
    /// Node name, if `ros_discovery_info` announces it.
    pub node: Option<NodeName>,
    /// Quality of service.
    pub qos: Arc<Qos>,
    /// ROS type.
    pub message_type: TypeName,
    /// RIHS01 hash.
    pub type_hash: Option<TypeHash>,
    /// Hash of its complete type in XTypes.
    pub equivalence_hash: Option<EquivalenceHash>,
    /// Time of its first announcement.
    pub first_seen: ModelTime,
    /// Counts and times of this writer while its topic was watched.
    pub measurement: Option<Box<Measurement>>,
    /// Set of the transports to its counterparts, as [`Transport::bit`].
    pub transports: u8,
    /// The last message of a transient-local writer; `None` if none is kept.
    pub latched: Option<LatchedFacts>,
    /// Backends of buffers that it accepts; `None` if it has none.
    pub backends: Option<Arc<Backends>>,
    /// Its endpoints on the buffer topics. `measurement` contains theirs.
    pub buffers: Box<[Guid]>,
}

impl TopicFacts {
    /// Returns whether observed processes publish the topic and subscribe to it.
    #[must_use]
    pub fn is_connected_inside(&self) -> bool {
        let inside = self.inside.as_deref();
        inside.is_some_and(|inside| inside.publishers > 0 && inside.subscriptions > 0)
    }

    /// Returns whether nothing is sent because no subscriber exists: the topic is published, no
    /// subscription is known, not even within a process, and no message is counted at present.
    #[must_use]
    pub fn is_unsubscribed(&self) -> bool {
        let is_alone = !self.publishers.is_empty() && self.subscriptions.is_empty();
        let is_flowing = self.rate_hz().is_some_and(|rate| rate > 0.0);
        is_alone && !self.is_connected_inside() && !is_flowing
    }

    /// Returns the number of pairs with this transport and with both ends in observed processes.
    #[must_use]
    pub fn observed_pairs(&self, transport: Transport) -> usize {
        let mut observed = self.observed_pairs.iter();
        let own = observed.find(|count| count.transport == transport);
        own.map_or(0, |count| count.pairs)
    }

    /// Returns the messages per second of the last window. Returns `None` if the topic is not
    /// measured. Also returns `None` if no message was seen and all pairs use transports that are
    /// not observed.
    #[must_use]
    pub fn rate_hz(&self) -> Option<f64> {
        let measured = self.measurement.as_deref()?;
        (measured.rate_hz > 0.0 || !self.is_unseen()).then_some(measured.rate_hz)
    }

    /// Returns the payload bytes per second of the last window. `None` if the rate is unknown, or
    /// if messages were seen without their size.
    #[must_use]
    pub fn bandwidth(&self) -> Option<f64> {
        let measured = self.measurement.as_deref()?;
        let rate_hz = self.rate_hz()?;
        let has_sizes = self.source == Source::Wire && measured.bytes > 0;
        (rate_hz == 0.0 || has_sizes).then_some(measured.bandwidth)
    }

    /// Returns whether a regularly sent topic was silent for 10 s and for five times its longest
    /// interval so far. A topic without regular messages is never silent.
    #[must_use]
    pub fn is_silent(&self, now: ModelTime) -> bool {
        let Some(measured) = self.measurement.as_deref() else {
            return false;
        };
        let (Some(last), Some((_, longest))) =
            (measured.last_message, measured.interarrival.range())
        else {
            return false;
        };
        let is_regular = measured.interarrival.count() >= MIN_REGULAR_INTERVALS;
        let silence = (now - last).as_secs_f64();
        self.rate_hz() == Some(0.0) && is_regular && silence >= longest * 5.0
    }

    /// Returns whether all pairs use transports that the network does not show, and not all of
    /// their processes are observed.
    fn is_unseen(&self) -> bool {
        let is_hidden = |count: &TransportCount| {
            let is_inner = matches!(
                count.transport,
                Transport::SameProcess | Transport::DataSharing | Transport::Iceoryx
            );
            is_inner && self.observed_pairs(count.transport) < count.pairs
        };
        self.source == Source::Wire
            && !self.transports.is_empty()
            && self.transports.iter().all(is_hidden)
    }
}

impl EndpointFacts {
    /// Returns the hash by which a definition of its type is found.
    #[must_use]
    pub fn definition_hash(&self) -> Option<String> {
        definition_hash(self.type_hash, self.equivalence_hash)
    }

    /// Returns whether messages of this writer, or of its writers on the buffer topics, have this
    /// GUID.
    #[must_use]
    pub fn writes_as(&self, guid: Guid) -> bool {
        self.guid == guid || self.buffers.contains(&guid)
    }

    /// Returns the history as text: `KEEP_LAST (10)`, `KEEP_ALL` or, if not announced, `UNKNOWN`.
    #[must_use]
    pub fn history(&self) -> String {
        let history = self.qos.history;
        history.map_or_else(|| "UNKNOWN".to_owned(), |history| history.to_string())
    }
}

/// An active writer whose announcement was missed.
#[derive(Clone, Debug)]
pub struct UnknownWriterFacts {
    /// GUID.
    pub guid: Guid,
    /// Vendor of its participant, otherwise the one that its GUID indicates.
    pub vendor: Option<VendorId>,
    /// Host and process of the writer.
    pub process: ProcessFacts,
    /// Time of the first observation.
    pub first_seen: ModelTime,
    /// Counts and times, as for any writer.
    pub measurement: Measurement,
}

/// A watchlist entry and the topics that it covers now.
#[derive(Clone, Debug)]
pub struct WatchFacts {
    /// The entry as configured.
    pub watch: Arc<Watch>,
    /// Covered topics with their states. An exact name without a topic is listed with
    /// [`WatchState::NotPublished`].
    pub topics: Vec<WatchedTopicFacts>,
}

/// State of a watched topic under one entry.
#[derive(Clone, Debug)]
pub struct WatchedTopicFacts {
    /// Domain.
    pub domain_id: DomainId,
    /// ROS name.
    pub topic: TopicName,
    /// State of the topic.
    pub state: WatchState,
    /// Violated expectations: `min_rate_hz`, `max_loss_ratio`, ...
    pub violations: Vec<&'static str>,
}

/// Number of parse failures of one kind.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct DecodeErrorCount {
    /// Stage of parsing: `frame`, `rtps`, `spdp`, `sedp`, `entities`, `request`,
    /// `type_description`, `type_information`, `type_object`.
    pub stage: &'static str,
    /// Reason, from [`ros2probe_wire::Reason::label`], or `hash_mismatch`.
    pub reason: &'static str,
    /// Number of failures.
    pub count: u64,
}

impl<'a> From<&'a TopicFacts> for Candidate<'a> {
    fn from(topic: &'a TopicFacts) -> Self {
        Self {
            domain_id: topic.domain_id,
            kind: topic.kind,
            name: &topic.name,
            dds_name: &topic.dds_name,
            hidden: topic.hidden,
        }
    }
}
