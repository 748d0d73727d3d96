//! `/samples`: the lines of the stream, which the agent writes and clients read.
//!
//! Each line is a JSON object with one key, which names its kind. Where payloads were asked for, a
//! sample's line is followed by as many raw bytes as it says, and then the next line. Times are
//! nanoseconds since the Unix epoch.

use serde::{Deserialize, Serialize};

/// Media type of a stream without payloads.
pub const LINES: &str = "application/x-ndjson";
/// Media type of a stream with payloads.
pub const SAMPLES: &str = "application/vnd.ros2probe.samples";

/// One line.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema), schema(as = SampleLine))]
#[serde(rename_all = "snake_case")]
pub enum Line {
    /// The first line: the subscription is in force.
    Open(Open),
    /// A message.
    Sample(Sample),
    /// The stream is complete up to this time.
    Clock(Clock),
    /// Messages that the stream lacks.
    Missed(Missed),
    /// The last line.
    End(End),
}

/// Topics known at the start of the stream. Messages of later topics need no new line here.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct Open {
    /// Topics that were asked for and are known.
    pub topics: Vec<OpenTopic>,
}

/// A topic that was asked for.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct OpenTopic {
    /// ROS name, or the DDS name where it follows no ROS convention.
    #[cfg_attr(feature = "openapi", schema(example = "/points"))]
    pub topic: String,
    /// Domain.
    pub domain_id: u32,
    /// ROS names of its types.
    pub types: Vec<String>,
}

/// One message. Each message has one line.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema), schema(as = SampleFacts))]
pub struct Sample {
    /// ROS name of its topic.
    #[cfg_attr(feature = "openapi", schema(example = "/points"))]
    pub topic: String,
    /// Domain.
    pub domain_id: u32,
    /// ROS name of its type.
    #[serde(rename = "type")]
    #[cfg_attr(feature = "openapi", schema(example = "sensor_msgs/msg/PointCloud2"))]
    pub message_type: String,
    /// When the datagram was captured that completed it.
    pub time_ns: i64,
    /// GUID of its writer.
    #[cfg_attr(
        feature = "openapi",
        schema(example = "010f2b7d6a474f3300000000.00001103")
    )]
    pub writer: String,
    /// Its number among those of this writer.
    pub sequence_number: u64,
    /// When it was written, by the writer's clock; null where the writer does not say.
    pub source_timestamp_ns: Option<i64>,
    /// The stamp of its header, where its type begins with one.
    pub header_stamp_ns: Option<i64>,
    /// Bytes of the serialized message, encapsulation and padding included.
    pub size: u32,
    /// Present and true where it was seen in shared memory by looking now and then: the numbers
    /// before it that the stream lacks may have been sent all the same.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub sampled: bool,
    /// So many raw bytes follow this line; null where payloads were not asked for.
    pub payload_bytes: Option<u32>,
    /// What the writer announced: with the first of its messages, where payloads were asked for.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[cfg_attr(feature = "openapi", schema(nullable = false))]
    pub offered: Option<Box<Offered>>,
}

/// What a writer announced.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct Offered {
    /// RIHS01 hash of the type; null where it is not announced (Humble).
    pub type_hash: Option<String>,
    /// Quality of service.
    pub qos: OfferedQos,
}

/// Quality of service in ROS's words; durations are null when they are infinite.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct OfferedQos {
    /// `RELIABLE` or `BEST_EFFORT`.
    pub reliability: String,
    /// `VOLATILE`, `TRANSIENT_LOCAL`, ...
    pub durability: String,
    /// `UNKNOWN` where the implementation does not say.
    #[cfg_attr(feature = "openapi", schema(example = "KEEP_LAST (10)"))]
    pub history: String,
    /// Longest time between two messages.
    pub deadline_seconds: Option<f64>,
    /// Age at which messages become void.
    pub lifespan_seconds: Option<f64>,
    /// Who says that the writer is alive.
    pub liveliness: String,
    /// Time within which that is said.
    pub liveliness_lease_seconds: Option<f64>,
}

/// How far the stream has come.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct Clock {
    /// The stream is complete up to this time, in nanoseconds since the Unix epoch.
    pub time_ns: i64,
}

/// Messages of one writer that the stream lacks.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema), schema(as = MissedFacts))]
pub struct Missed {
    /// ROS name of the topic.
    pub topic: String,
    /// Domain.
    pub domain_id: u32,
    /// GUID of the writer.
    pub writer: String,
    /// How many.
    pub samples: u64,
    /// Number of the first.
    pub first_sequence_number: u64,
    /// Number of the last.
    pub last_sequence_number: u64,
    /// `incomplete`: fragments were never seen; `lost`: nothing of it was seen; `unannounced`: it
    /// came before its writer was announced, and not again; `not_captured`: its bytes were lost on the
    /// way to the agent; `queue_full`: this reader was too slow.
    pub reason: MissedReason,
}

/// Why the stream lacks messages.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(rename_all = "snake_case")]
pub enum MissedReason {
    /// Fragments were never seen.
    Incomplete,
    /// Nothing of them was seen, and they are lost.
    Lost,
    /// They came before their writer was announced, and not again.
    Unannounced,
    /// The bytes were lost on the way to the agent.
    NotCaptured,
    /// The reader was too slow.
    QueueFull,
}

/// Why nothing follows.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct End {
    /// `end of capture` or `agent ends`.
    pub reason: String,
}
