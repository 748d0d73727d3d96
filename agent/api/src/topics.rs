//! `/topics`, `/topics/{topic}` and `/topics/{topic}/history`.

use std::borrow::Cow;

use serde::{Deserialize, Serialize};

use crate::Open;
use crate::diagnosis::{Diagnosis, Finding};
use crate::endpoints::Endpoint;
use crate::measurement::{Breakdown, Bucket, Delivered, Measurement};
use crate::watches::Expectations;

/// Topics.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(default)]
pub struct TopicList<'a> {
    /// Unix time of the facts.
    pub timestamp_seconds: f64,
    /// By domain and DDS name.
    pub topics: Vec<Topic<'a>>,
}

/// One topic.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(default)]
pub struct Topic<'a> {
    /// Domain.
    pub domain_id: u32,
    /// ROS name; the DDS name where it follows no ROS convention.
    #[cfg_attr(feature = "openapi", schema(example = "/points"))]
    pub name: Cow<'a, str>,
    /// DDS name.
    #[cfg_attr(feature = "openapi", schema(example = "rt/points"))]
    pub dds_name: Cow<'a, str>,
    /// What it is to ROS: `topic`, `service_request`, `service_reply`, `service_event`,
    /// `action_feedback`, `action_status`, `discovery` or `dds`.
    pub kind: Cow<'a, str>,
    /// Hidden by ROS convention.
    pub hidden: bool,
    /// Its last endpoint has gone; it is shown for some minutes more.
    pub vanished: bool,
    /// ROS types announced on it; more than one is a fault.
    pub message_types: Vec<Cow<'a, str>>,
    /// RIHS01 hashes announced on it.
    pub type_hashes: Vec<Cow<'a, str>>,
    /// Its writers.
    pub publishers: Vec<Endpoint<'a>>,
    /// Its readers.
    pub subscriptions: Vec<Endpoint<'a>>,
    /// Watches that cover it, and how it stands with what they expect.
    pub watches: Vec<Watching<'a>>,
    /// Sum over its writers; null while it is not watched.
    pub measurement: Option<Measurement>,
    /// What reached receivers on this host, each counted.
    pub received: Option<Delivered>,
    /// What was seen leaving this host, once for each destination.
    pub sent: Option<Delivered>,
    /// Where messages spent their time on this host.
    pub breakdown: Option<Breakdown>,
    /// Pairs of its publishers and subscribers by how messages pass between them.
    pub passages: Vec<Passage>,
    /// What is wrong with it.
    #[cfg_attr(feature = "openapi", schema(value_type = Vec<Diagnosis<'static>>))]
    pub diagnoses: Vec<Finding<'a>>,
    /// Why it is silent, or why nothing is counted; empty where messages are counted.
    pub reasons: Vec<Reason>,
}

/// One topic with every way its messages go.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(default)]
#[expect(
    missing_docs,
    reason = "the document describes the topic where it is declared"
)]
pub struct TopicDetails<'a> {
    #[serde(flatten)]
    pub topic: Topic<'a>,
    /// Times between consecutive messages of one writer, in buckets.
    pub interarrival_buckets: Vec<Bucket>,
    /// Times from the writer's timestamp to the capture, in buckets.
    pub latency_buckets: Vec<Bucket>,
    /// Every receiver and destination of its writers.
    pub deliveries: Vec<Delivery<'a>>,
    /// Every reliable reader that acknowledges.
    pub acknowledgements: Vec<Acknowledgement<'a>>,
}

/// Pairs of publisher and subscriber between which messages pass in one way.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(default)]
pub struct Passage {
    /// `network`; `shared_memory`, of which samples are seen; `data_sharing`, `same_process` or
    /// `iceoryx`, which are not seen.
    pub passage: Cow<'static, str>,
    /// How many pairs.
    pub pairs: usize,
    /// Of `shared_memory`, how it is seen just now: `exact`, every message in the process that sends
    /// it; `close`, by as many looks as `capture.shm.reading_cpu_percent` allows, because its samples
    /// are read; `sampled`, by fewer looks; `none`.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[cfg_attr(feature = "openapi", schema(nullable = false))]
    pub view: Option<Cow<'static, str>>,
}

/// A watch that covers the topic.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(default)]
pub struct Watching<'a> {
    /// Its name or glob.
    pub watch: Cow<'a, str>,
    /// The domain it is for; null for every domain.
    pub watch_domain_id: Option<u32>,
    /// Who asked for it: `config`, `command_line` or `api`; null when it has just gone.
    pub origin: Option<Cow<'static, str>>,
    /// How the topic stands: `ok`, `violated`, `silent`, `not_published` or `no_subscriber`.
    pub state: Cow<'static, str>,
    /// Expectations that are broken.
    pub violations: Vec<Cow<'a, str>>,
    /// What it expects of the topic.
    #[serde(flatten)]
    pub expectations: Expectations,
}

/// One writer's messages to one receiver, or to a destination where they leave.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(default)]
pub struct Delivery<'a> {
    /// Whose messages.
    pub writer: String,
    /// `sent` or `received`.
    pub direction: Cow<'static, str>,
    /// Address and port.
    #[cfg_attr(feature = "openapi", schema(example = "10.0.0.2:7411"))]
    pub destination: String,
    /// The receiver: participant, process or socket; empty where receivers cannot be distinguished.
    pub subscriber: Cow<'a, str>,
    /// Readers of the topic in that participant.
    pub readers: Vec<String>,
    /// Their nodes.
    pub nodes: Vec<Cow<'a, str>>,
    /// Process of the socket.
    pub process_id: Option<u32>,
    /// Its name.
    pub process: Option<Cow<'a, str>>,
    /// Its control group.
    pub cgroup: Option<Cow<'a, str>>,
    /// What became of the messages.
    pub delivered: Delivered,
}

/// What one reliable reader acknowledged to one writer.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(default)]
pub struct Acknowledgement<'a> {
    /// To whom.
    pub writer: String,
    /// By whom.
    pub reader: String,
    /// The reader's node.
    pub node: Option<Cow<'a, str>>,
    /// All messages up to this sequence number.
    pub acknowledged_sequence_number: u64,
    /// Messages it asked for in its last ACKNACK.
    pub missing_messages: u64,
    /// Messages it asked for again, every request counted.
    pub requested_messages: u64,
    /// Messages that exist and are not acknowledged.
    pub lag_messages: u64,
    /// Age of the oldest of them; null when it is too old to know.
    pub lag_seconds: Option<f64>,
}

/// One reason.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(default)]
pub struct Reason {
    /// Which one.
    #[cfg_attr(feature = "openapi", schema(value_type = ReasonCode))]
    pub code: Open<ReasonCode>,
    /// In words.
    pub detail: String,
}

/// Why nothing, or not everything, is seen of a topic.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(rename_all = "snake_case")]
pub enum ReasonCode {
    /// The agent does not see the robot at the moment.
    AgentNotReady,
    /// Nobody publishes it.
    NoPublisher,
    /// Nobody subscribes: most writers send nothing then.
    NoSubscriber,
    /// There are subscriptions, and none matches a publisher.
    NoMatchedSubscriber,
    /// A publisher's participant uses DDS security: messages may be encrypted.
    Encrypted,
    /// Nobody asked for it to be measured.
    NotWatched,
    /// It is watched, but `limits.topics` are measured already.
    WatchRejected,
    /// All its endpoints are on other hosts, and the agent looks at this host's sockets.
    OutsideView,
    /// Messages go through Fast DDS's shared memory, and none was seen there.
    SharedMemory,
    /// Subscribers read the publisher's history in memory: invisible.
    DataSharing,
    /// Publishers and subscribers are in one process: invisible.
    SameProcess,
    /// Messages go through Cyclone DDS's iceoryx: invisible.
    Iceoryx,
    /// All is as it should be, and no message was seen, or none lately.
    Quiet,
}

/// The last seconds of a topic. Columns have one length; null = not measured then, or no such value
/// in that second.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(default)]
pub struct History {
    /// ROS name.
    #[cfg_attr(feature = "openapi", schema(example = "/points"))]
    pub topic: String,
    /// Domain.
    pub domain_id: u32,
    /// Time between two rows.
    pub interval_seconds: u32,
    /// Unix time of the facts.
    pub timestamp_seconds: f64,
    /// Unix time at which each second ended, in the source's clock.
    pub times: Vec<f64>,
    /// Messages received whole in each.
    pub messages: Vec<Option<u32>>,
    /// Messages settled as lost in each.
    pub lost_messages: Vec<Option<u32>>,
    /// Messages a second over the 10 s before.
    pub rate_hertz: Vec<Option<f64>>,
    /// Payload bytes a second over the 10 s before.
    pub bandwidth_bytes_per_second: Vec<Option<f64>>,
    /// Median time from the writer's timestamp to the capture.
    pub latency_p50_seconds: Vec<Option<f64>>,
    /// Its 99th percentile.
    pub latency_p99_seconds: Vec<Option<f64>>,
    /// Median time between messages of one writer.
    pub interarrival_p50_seconds: Vec<Option<f64>>,
    /// Its 99th percentile.
    pub interarrival_p99_seconds: Vec<Option<f64>>,
}
