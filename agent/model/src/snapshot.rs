//! What the agent knows at one moment, for whoever asks: immutable, sorted, complete.
//!
//! The model builds one about once a second; surfaces read it without ever blocking the model.
//! Nothing here computes: every number was settled when the snapshot was taken.

mod delivery;

use std::sync::Arc;

use ros2probe_wire::discovery::TypeHash;
use ros2probe_wire::qos::Qos;
use ros2probe_wire::rtps::VendorId;
use ros2probe_wire::{DomainId, Duration, Guid, Timestamp};

pub use super::churn::ChurnCount;
use super::diagnosis::Diagnoses;
use super::discovery::Addresses;
pub use super::expectation::WatchState;
pub use super::measurement::{Breakdown, Delivered, Measurement, SampledFacts};
use super::names::{DdsName, NodeName, TopicName, TypeName};
pub use super::route::Direction;
pub use super::sockets::SocketFacts;
use super::topic_kind::TopicKind;
use super::watch::Watch;
pub use delivery::{AcknowledgementFacts, DeliveryFacts, Subscriber};

/// All facts at `at`. Lists are sorted by their identity.
#[derive(Clone, Debug, Default)]
pub struct Snapshot {
    /// When it was taken, in the source's clock (capture time on replays).
    pub at: Timestamp,
    /// Participants that are alive.
    pub participants: Vec<ParticipantFacts>,
    /// ROS nodes of live participants.
    pub nodes: Vec<NodeFacts>,
    /// DDS topics with at least one endpoint, and those that had one within the grace period.
    pub topics: Vec<TopicFacts>,
    /// Writers seen sending whose announcement was not seen.
    pub unknown_writers: Vec<UnknownWriterFacts>,
    /// Sockets by which measured samples come or leave, as far as they are known, by cookie.
    pub sockets: Vec<SocketFacts>,
    /// Watchlist entries, in configuration order.
    pub watches: Vec<WatchFacts>,
    /// What is wrong with the graph; the same value as long as nothing changes.
    pub diagnoses: Arc<Diagnoses>,
    /// When each of them was found, in their order.
    pub diagnosed: Arc<Vec<Timestamp>>,
    /// Discovery churn since the start.
    pub churn: Vec<ChurnCount>,
    /// Parse failures since the start.
    pub decode_errors: Vec<DecodeErrorCount>,
    /// Sizes, limits and evictions of the model's tables.
    pub tables: Vec<TableFacts>,
    /// Datagrams looked at in user space.
    pub datagrams: u64,
    /// Records taken in, from the kernel or from user-space walks.
    pub records: u64,
    /// Topics that are measured, vanished ones included.
    pub topics_measured: u64,
    /// Topics that the watchlist matched but the cap kept out.
    pub topics_rejected: u64,
}

/// One DDS participant.
#[derive(Clone, Debug)]
pub struct ParticipantFacts {
    /// Its GUID (entity 000001c1).
    pub guid: Guid,
    /// Domain, when announced or derivable from the discovery port.
    pub domain_id: DomainId,
    /// Its implementation.
    pub vendor: VendorId,
    /// ROS enclave; `None` means it is no ROS participant.
    pub enclave: Option<Arc<str>>,
    /// Where it lives.
    pub process: ProcessFacts,
    /// When its first announcement was seen.
    pub first_seen: Timestamp,
    /// When anything of it was last seen.
    pub last_seen: Timestamp,
    /// How long it is believed alive without a sign of life.
    pub lease: Duration,
    /// Announces security: its user data may be encrypted.
    pub secured: bool,
    /// Known from before the agent's start and not heard since.
    pub restored: bool,
    /// Where its discovery endpoints and its other ones are reached over UDP.
    pub addresses: Addresses,
}

/// Where something lives, as far as it is announced or its socket's holder is known.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct ProcessFacts {
    /// Host name when announced.
    pub host: Option<Arc<str>>,
    /// Process id: of the socket's holder, else as announced, perhaps in a container's count, or
    /// its low 16 bits where the GUID holds those.
    pub id: Option<u32>,
    /// Process name: as announced, else that of the socket's holder.
    pub name: Option<Arc<str>>,
    /// Control group of the socket, as a path below the root: which container.
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
    /// ROS name for topics, the DDS name where it follows no ROS convention.
    pub name: TopicName,
    /// DDS name.
    pub dds_name: DdsName,
    /// What kind of ROS channel.
    pub kind: TopicKind,
    /// Hidden by ROS convention (a token begins with `_`).
    pub hidden: bool,
    /// Message types announced on it, ROS form, sorted; more than one is a fault.
    pub message_types: Vec<TypeName>,
    /// RIHS01 type hashes announced, sorted.
    pub type_hashes: Vec<TypeHash>,
    /// Live writers.
    pub publishers: Vec<EndpointFacts>,
    /// Live readers.
    pub subscriptions: Vec<EndpointFacts>,
    /// Present when somebody is or was interested in the topic: the sum over its writers, also
    /// those that have gone.
    pub measurement: Option<Box<Measurement>>,
    /// Sum over all receivers and writers, also those that have gone; present once a sample of the
    /// topic was seen arriving while it was measured.
    pub received: Option<Box<Delivered>>,
    /// Likewise over all destinations to which samples were seen leaving this host.
    pub sent: Option<Box<Delivered>>,
    /// Where its samples spent their time, as far as this host sees it.
    pub breakdown: Option<Box<Breakdown>>,
    /// Every receiver and destination of live writers, sorted by writer, direction, destination and
    /// subscriber.
    pub deliveries: Vec<DeliveryFacts>,
    /// Every reliable reader that acknowledges, sorted by writer and reader.
    pub acknowledgements: Vec<AcknowledgementFacts>,
    /// The last endpoint has gone; kept for the grace period.
    pub vanished: bool,
    /// Pairs of its live writers and readers by how messages pass between them; those that there
    /// are.
    pub transports: Vec<TransportCount>,
    /// Its samples are given one by one.
    pub is_read: bool,
}

/// How messages pass between a writer and a reader, as both announce it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Transport {
    /// By the network, where all of them can be seen.
    Network,
    /// Through Fast DDS's shared memory, which is looked at now and then.
    SharedMemory,
    /// The reader reads the writer's history in memory: not seen.
    DataSharing,
    /// Within one process: not seen.
    SameProcess,
    /// Through Cyclone DDS's iceoryx: not seen.
    Iceoryx,
}

/// Pairs of writer and reader.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct TransportCount {
    /// How messages pass between them.
    pub transport: Transport,
    /// How many pairs.
    pub pairs: usize,
}

impl Transport {
    /// All of them.
    pub const ALL: [Self; 5] = [
        Self::Network,
        Self::SharedMemory,
        Self::DataSharing,
        Self::SameProcess,
        Self::Iceoryx,
    ];

    /// Its place in a set of ways.
    #[must_use]
    pub const fn bit(self) -> u8 {
        1 << self as u8
    }

    /// Label value.
    #[must_use]
    pub const fn label(self) -> &'static str {
        match self {
            Self::Network => "network",
            Self::SharedMemory => "shared_memory",
            Self::DataSharing => "data_sharing",
            Self::SameProcess => "same_process",
            Self::Iceoryx => "iceoryx",
        }
    }
}

/// One writer or reader.
#[derive(Clone, Debug)]
pub struct EndpointFacts {
    /// GUID.
    pub guid: Guid,
    /// Node name when `ros_discovery_info` told.
    pub node: Option<NodeName>,
    /// Quality of service.
    pub qos: Arc<Qos>,
    /// ROS type.
    pub message_type: TypeName,
    /// RIHS01 hash.
    pub type_hash: Option<TypeHash>,
    /// When it was announced.
    pub first_seen: Timestamp,
    /// What was measured of this writer while its topic was watched.
    pub measurement: Option<Box<Measurement>>,
    /// How messages pass between it and its counterparts: [`Transport::bit`] of each way.
    pub transports: u8,
}

impl EndpointFacts {
    /// Its history in words: `KEEP_LAST (10)`, `KEEP_ALL` or, as it is often not announced,
    /// `UNKNOWN`.
    #[must_use]
    pub fn history(&self) -> String {
        let history = self.qos.history;
        history.map_or_else(|| "UNKNOWN".to_owned(), |history| history.to_string())
    }
}

/// A writer that sends without a known announcement.
#[derive(Clone, Debug)]
pub struct UnknownWriterFacts {
    /// GUID.
    pub guid: Guid,
    /// Vendor: its participant's, else the one whose mark its GUID bears.
    pub vendor: Option<VendorId>,
    /// Where it lives.
    pub process: ProcessFacts,
    /// First record.
    pub first_seen: Timestamp,
    /// Measured like any writer.
    pub measurement: Measurement,
}

/// One watchlist entry and the topics it covers now.
#[derive(Clone, Debug)]
pub struct WatchFacts {
    /// The entry as configured.
    pub watch: Arc<Watch>,
    /// Covered topics with their state; a literal name that does not exist yet is listed with
    /// [`WatchState::NotPublished`].
    pub topics: Vec<WatchedTopicFacts>,
}

/// One watched topic under one entry.
#[derive(Clone, Debug)]
pub struct WatchedTopicFacts {
    /// Domain.
    pub domain_id: DomainId,
    /// ROS name.
    pub topic: TopicName,
    /// Where it stands.
    pub state: WatchState,
    /// Which expectations are broken: `min_rate_hz`, `max_loss_ratio`, ...
    pub violations: Vec<&'static str>,
}

/// Parse failures of one kind.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct DecodeErrorCount {
    /// What was being read: `frame`, `rtps`, `spdp`, `sedp`, `entities`.
    pub stage: &'static str,
    /// [`ros2probe_wire::Reason::label`].
    pub reason: &'static str,
    /// How often.
    pub count: u64,
}

/// One bounded table.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct TableFacts {
    /// `participants`, `endpoints`, `topics`, `nodes`, `writers`, `unknown_writers`, `samples`,
    /// `reassembly`, `interest`, `deliveries`, `sockets`, `diagnoses`, `spans`, `payloads`,
    /// `history`.
    pub table: &'static str,
    /// Entries (bytes for `reassembly` and `payloads`).
    pub size: u64,
    /// Cap.
    pub limit: u64,
    /// Entries given up because of the cap.
    pub evictions: u64,
}
