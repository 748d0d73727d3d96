//! `/samples`: the lines of the stream, which the agent writes and clients read.
//!
//! Each line is a JSON object with one key, which names its kind. If the request includes payloads,
//! a sample's line is followed by `payload_bytes` raw bytes and then by the next line. Times are in
//! nanoseconds since the Unix epoch.

use serde::{Deserialize, Serialize};

/// Media type of a stream without payloads.
pub const LINES: &str = "application/x-ndjson";
/// Media type of a stream with payloads.
pub const SAMPLES: &str = "application/vnd.ros2probe.samples";

/// A line of the stream.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema), schema(as = SampleLine))]
#[serde(rename_all = "snake_case")]
pub enum Line {
    /// The first line: the subscription is active.
    Open(Open),
    /// A message.
    Sample(Sample),
    /// The stream is complete up to this time.
    Clock(Clock),
    /// Messages that are missing from the stream.
    Missed(Missed),
    /// The last line of the stream.
    End(End),
}

/// Topics that the request selects at the start of the stream. Later topics are not announced by a
/// line of this kind.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct Open {
    /// Known topics that the request selects.
    pub topics: Vec<OpenTopic>,
}

/// A topic that the request selects.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct OpenTopic {
    /// ROS name, or the DDS name if it follows no ROS convention.
    #[cfg_attr(feature = "openapi", schema(example = "/points"))]
    pub topic: String,
    /// Domain id.
    pub domain_id: u32,
    /// ROS names of the topic's types.
    pub types: Vec<String>,
}

/// A message. Each message has one line.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema), schema(as = SampleFacts))]
pub struct Sample {
    /// ROS name of the message's topic.
    #[cfg_attr(feature = "openapi", schema(example = "/points"))]
    pub topic: String,
    /// Domain id.
    pub domain_id: u32,
    /// ROS name of the message's type.
    #[serde(rename = "type")]
    #[cfg_attr(feature = "openapi", schema(example = "sensor_msgs/msg/PointCloud2"))]
    pub message_type: String,
    /// Capture time of the datagram that completed the message. A kept last message with its payload
    /// has the time of its delivery to this client.
    pub time_ns: i64,
    /// GUID of the message's writer.
    #[cfg_attr(
        feature = "openapi",
        schema(example = "010f2b7d6a474f3300000000.00001103")
    )]
    pub writer: String,
    /// Sequence number of the message, counted by the writer.
    pub sequence_number: u64,
    /// Time of writing, by the writer's clock; null if the message does not contain it.
    pub source_timestamp_ns: Option<i64>,
    /// `stamp` of the message's `Header`; null if its type does not begin with one.
    pub header_stamp_ns: Option<i64>,
    /// Size of the serialized message in bytes, including encapsulation and padding.
    pub size: u32,
    /// True if the message was sampled from shared memory; absent otherwise. Missing sequence
    /// numbers before it may still have been sent.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub sampled: bool,
    /// Number of raw bytes that follow this line; null if the request does not include payloads.
    pub payload_bytes: Option<u32>,
    /// Type hash and QoS of the writer, sent with its first message; null if the request does not
    /// include payloads.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[cfg_attr(feature = "openapi", schema(nullable = false))]
    pub offered: Option<Box<Offered>>,
}

/// Type hash and QoS that a writer announces.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct Offered {
    /// RIHS01 hash of the type; null if the writer does not announce it (Humble).
    pub type_hash: Option<String>,
    /// Hash of the complete type in XTypes (`XTYPES_` and 28 digits); null if the writer does not announce
    /// it.
    #[serde(default)]
    pub equivalence_hash: Option<String>,
    /// Quality of service.
    pub qos: OfferedQos,
}

impl Offered {
    /// Returns the hash by which a definition of the type is found.
    #[must_use]
    pub fn definition_hash(&self) -> Option<&str> {
        let hash = self.type_hash.as_deref();
        hash.or(self.equivalence_hash.as_deref())
    }
}

/// Quality of service in ROS terms. A null duration is infinite.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct OfferedQos {
    /// `RELIABLE` or `BEST_EFFORT`.
    pub reliability: String,
    /// `VOLATILE`, `TRANSIENT_LOCAL`, ...
    pub durability: String,
    /// `UNKNOWN` if the implementation does not announce it.
    #[cfg_attr(feature = "openapi", schema(example = "KEEP_LAST (10)"))]
    pub history: String,
    /// Maximum time between two messages, in seconds.
    pub deadline_seconds: Option<f64>,
    /// Age at which a message expires, in seconds.
    pub lifespan_seconds: Option<f64>,
    /// How the writer asserts its liveliness, such as `AUTOMATIC` or `MANUAL_BY_TOPIC`.
    pub liveliness: String,
    /// Time within which the writer must assert its liveliness, in seconds.
    pub liveliness_lease_seconds: Option<f64>,
}

/// Progress of the stream.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct Clock {
    /// The stream is complete up to this time, in nanoseconds since the Unix epoch.
    pub time_ns: i64,
}

/// Messages of one writer that are missing from the stream.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema), schema(as = MissedFacts))]
pub struct Missed {
    /// ROS name of the topic.
    pub topic: String,
    /// Domain id.
    pub domain_id: u32,
    /// GUID of the writer.
    pub writer: String,
    /// Number of missing messages.
    pub samples: u64,
    /// Sequence number of the first missing message.
    pub first_sequence_number: u64,
    /// Sequence number of the last missing message.
    pub last_sequence_number: u64,
    /// `incomplete`: fragments never arrived. `lost`: no part of the message arrived.
    /// `unannounced`: the message arrived before its writer's announcement and was not sent again.
    /// `not_captured`: the agent could not capture the message. `queue_full`: this client read too
    /// slowly.
    #[cfg_attr(feature = "openapi", schema(value_type = MissedReason))]
    pub reason: crate::Open<MissedReason>,
}

impl Missed {
    /// Returns the reason. One of a newer agent counts as [`MissedReason::NotCaptured`].
    #[must_use]
    pub const fn known_reason(&self) -> MissedReason {
        match self.reason {
            crate::Open::Known(reason) => reason,
            crate::Open::Unknown(_) => MissedReason::NotCaptured,
        }
    }
}

/// Why messages are missing from the stream.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(rename_all = "snake_case")]
pub enum MissedReason {
    /// Fragments never arrived.
    Incomplete,
    /// No part of the messages arrived.
    Lost,
    /// The messages arrived before their writer's announcement and were not sent again.
    Unannounced,
    /// The agent could not capture the bytes.
    NotCaptured,
    /// The client read too slowly.
    QueueFull,
}

/// Why the stream ended.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct End {
    /// `end of capture` or `agent ends`.
    pub reason: String,
}
