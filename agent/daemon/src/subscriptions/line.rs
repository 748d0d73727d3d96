//! What the API's stream of samples says, line by line: the same types write and read it.
//!
//! Each line is a JSON object with one key, which names its kind. Where payloads were asked for, a
//! sample's line is followed by as many raw bytes as it says, and then the next line. Times are
//! nanoseconds since the Unix epoch.

use ros2probe_wire::discovery::TypeHash;
use ros2probe_wire::qos::{Durability, History, HistoryKind, Liveliness, Qos, Reliability, Role};
use ros2probe_wire::rtps::VendorId;
use ros2probe_wire::{Duration, Timestamp};
use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

use super::Item;
use ros2probe_model::payloads::{Missed, MissedReason, Offered, Sample, Topic};

/// Media type of a stream without payloads.
pub const LINES: &str = "application/x-ndjson";
/// Media type of a stream with payloads.
pub const SAMPLES: &str = "application/vnd.ros2probe.samples";

/// One line.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "snake_case")]
#[schema(as = SampleLine)]
pub enum Line {
    /// The first line: the subscription is in force.
    Open(Open),
    /// A message.
    Sample(SampleFacts),
    /// Everything up to this time has been told.
    Clock(Clock),
    /// Messages that are not told.
    Missed(MissedFacts),
    /// The last line.
    End(End),
}

/// What is there when the stream begins; topics that appear later are told as well.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
pub struct Open {
    /// Topics that were asked for and are known.
    pub topics: Vec<OpenTopic>,
}

/// A topic that was asked for.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
pub struct OpenTopic {
    /// ROS name, or the DDS name where it follows no ROS convention.
    #[schema(example = "/points")]
    pub topic: String,
    /// Domain.
    pub domain_id: u32,
    /// ROS names of its types.
    pub types: Vec<String>,
}

/// A message, told once.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct SampleFacts {
    /// ROS name of its topic.
    #[schema(example = "/points")]
    pub topic: String,
    /// Domain.
    pub domain_id: u32,
    /// ROS name of its type.
    #[serde(rename = "type")]
    #[schema(example = "sensor_msgs/msg/PointCloud2")]
    pub message_type: String,
    /// When the datagram was captured that completed it.
    pub time_ns: i64,
    /// GUID of its writer.
    #[schema(example = "010f2b7d6a474f3300000000.00001103")]
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
    /// before it that were not told may have been sent all the same.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub sampled: bool,
    /// So many raw bytes follow this line; null where payloads were not asked for.
    pub payload_bytes: Option<u32>,
    /// What the writer announced: with the first of its messages, where payloads were asked for.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schema(nullable = false)]
    pub offered: Option<Box<OfferedFacts>>,
}

/// What a writer announced.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, ToSchema)]
#[schema(as = Offered)]
pub struct OfferedFacts {
    /// RIHS01 hash of the type; null where it is not announced (Humble).
    pub type_hash: Option<String>,
    /// Quality of service.
    pub qos: QosFacts,
}

/// Quality of service in ROS's words; durations are null when they are infinite.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, ToSchema)]
#[schema(as = OfferedQos)]
pub struct QosFacts {
    /// `RELIABLE` or `BEST_EFFORT`.
    pub reliability: String,
    /// `VOLATILE`, `TRANSIENT_LOCAL`, ...
    pub durability: String,
    /// `UNKNOWN` where the implementation does not say.
    #[schema(example = "KEEP_LAST (10)")]
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
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
pub struct Clock {
    /// Everything captured up to here has been told.
    pub time_ns: i64,
}

/// Messages of one writer that are not told.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
pub struct MissedFacts {
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
    pub reason: Reason,
}

/// Why messages are not told.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "snake_case")]
#[schema(as = MissedReason)]
pub enum Reason {
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
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
pub struct End {
    /// `end of capture` or `agent ends`.
    pub reason: String,
}

impl From<&Item> for Line {
    fn from(item: &Item) -> Self {
        match item {
            Item::Sample(sample) => Self::Sample(sample.as_ref().into()),
            Item::Clock(now) => Self::Clock(Clock {
                time_ns: nanoseconds(*now),
            }),
            Item::Missed(missed) => Self::Missed(missed.into()),
            Item::End(reason) => Self::End(End {
                reason: (*reason).to_owned(),
            }),
        }
    }
}

impl From<&Sample> for SampleFacts {
    fn from(sample: &Sample) -> Self {
        let Topic {
            domain_id,
            name,
            message_type,
            ..
        } = sample.topic.as_ref();
        let stamp =
            |(seconds, nanoseconds)| i64::from(seconds) * 1_000_000_000 + i64::from(nanoseconds);
        let len = |payload: &bytes::Bytes| u32::try_from(payload.len()).unwrap_or(u32::MAX);
        Self {
            topic: name.to_string(),
            domain_id: domain_id.0,
            message_type: message_type.to_string(),
            time_ns: nanoseconds(sample.time),
            writer: sample.writer.to_string(),
            sequence_number: sample.sequence_number,
            source_timestamp_ns: sample.source_timestamp.map(nanoseconds),
            header_stamp_ns: sample.header_stamp.map(stamp),
            size: sample.size,
            sampled: sample.sampled,
            payload_bytes: sample.payload.as_ref().map(len),
            offered: None,
        }
    }
}

impl From<&Missed> for MissedFacts {
    fn from(missed: &Missed) -> Self {
        Self {
            topic: missed.topic.name.to_string(),
            domain_id: missed.topic.domain_id.0,
            writer: missed.writer.to_string(),
            samples: missed.samples,
            first_sequence_number: missed.first,
            last_sequence_number: missed.last,
            reason: match missed.reason {
                MissedReason::Incomplete => Reason::Incomplete,
                MissedReason::Lost => Reason::Lost,
                MissedReason::Unannounced => Reason::Unannounced,
                MissedReason::NotCaptured => Reason::NotCaptured,
                MissedReason::QueueFull => Reason::QueueFull,
            },
        }
    }
}

impl From<&Offered> for OfferedFacts {
    fn from(offered: &Offered) -> Self {
        Self {
            type_hash: offered.type_hash.as_ref().map(ToString::to_string),
            qos: QosFacts::from(&offered.qos),
        }
    }
}

impl OfferedFacts {
    /// As discovery told.
    #[must_use]
    pub fn offered(&self) -> Offered {
        Offered {
            type_hash: self.type_hash.as_deref().and_then(TypeHash::parse),
            qos: self.qos.qos(),
        }
    }
}

impl From<&Qos> for QosFacts {
    fn from(qos: &Qos) -> Self {
        let finite = |duration| match duration {
            Duration::Finite(nanoseconds) => Some(seconds(nanoseconds)),
            Duration::Infinite => None,
        };
        Self {
            reliability: qos.reliability.to_string(),
            durability: qos.durability.to_string(),
            history: match qos.history {
                None => "UNKNOWN".to_owned(),
                Some(history) => history.to_string(),
            },
            deadline_seconds: finite(qos.deadline),
            lifespan_seconds: finite(qos.lifespan),
            liveliness: qos.liveliness.to_string(),
            liveliness_lease_seconds: finite(qos.liveliness_lease),
        }
    }
}

impl QosFacts {
    /// As policies; what has no word stays unknown.
    #[must_use]
    pub fn qos(&self) -> Qos {
        let unknown = u32::MAX;
        Qos {
            reliability: match self.reliability.as_str() {
                "RELIABLE" => Reliability::RELIABLE,
                "BEST_EFFORT" => Reliability::BEST_EFFORT,
                _ => Reliability(unknown),
            },
            durability: durability(&self.durability),
            history: history(&self.history),
            deadline: duration(self.deadline_seconds),
            lifespan: duration(self.lifespan_seconds),
            liveliness: match self.liveliness.as_str() {
                "AUTOMATIC" => Liveliness::AUTOMATIC,
                "MANUAL_BY_PARTICIPANT" => Liveliness::MANUAL_BY_PARTICIPANT,
                "MANUAL_BY_TOPIC" => Liveliness::MANUAL_BY_TOPIC,
                _ => Liveliness(unknown),
            },
            liveliness_lease: duration(self.liveliness_lease_seconds),
            ..Qos::defaults(Role::Writer, VendorId([0, 0]))
        }
    }
}

fn durability(word: &str) -> Durability {
    match word {
        "VOLATILE" => Durability::VOLATILE,
        "TRANSIENT_LOCAL" => Durability::TRANSIENT_LOCAL,
        "TRANSIENT" => Durability::TRANSIENT,
        "PERSISTENT" => Durability::PERSISTENT,
        _ => Durability(u32::MAX),
    }
}

fn history(words: &str) -> Option<History> {
    if words == "KEEP_ALL" {
        let kind = HistoryKind::KEEP_ALL;
        return Some(History { kind, depth: 0 });
    }
    let depth = words.strip_prefix("KEEP_LAST (")?.strip_suffix(')')?;
    Some(History {
        kind: HistoryKind::KEEP_LAST,
        depth: depth.parse().ok()?,
    })
}

fn duration(seconds: Option<f64>) -> Duration {
    let Some(seconds) = seconds else {
        return Duration::Infinite;
    };
    let duration = std::time::Duration::try_from_secs_f64(seconds).ok();
    let nanoseconds = duration.and_then(|duration| u64::try_from(duration.as_nanos()).ok());
    nanoseconds.map_or(Duration::Infinite, Duration::Finite)
}

#[expect(
    clippy::cast_precision_loss,
    reason = "durations of QoS are given in milliseconds"
)]
pub(crate) fn seconds(nanoseconds: u64) -> f64 {
    nanoseconds as f64 / 1e9
}

fn nanoseconds(time: Timestamp) -> i64 {
    i64::try_from(time.0).unwrap_or(i64::MAX)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_line_is_read_as_it_was_written() {
        let lines = [
            (
                Line::Clock(Clock { time_ns: 17 }),
                r#"{"clock":{"time_ns":17}}"#,
            ),
            (
                Line::End(End {
                    reason: "agent ends".to_owned(),
                }),
                r#"{"end":{"reason":"agent ends"}}"#,
            ),
            (
                Line::Missed(MissedFacts {
                    topic: "/a".to_owned(),
                    domain_id: 0,
                    writer: "01".to_owned(),
                    samples: 2,
                    first_sequence_number: 4,
                    last_sequence_number: 5,
                    reason: Reason::QueueFull,
                }),
                r#"{"missed":{"topic":"/a","domain_id":0,"writer":"01","samples":2,"first_sequence_number":4,"last_sequence_number":5,"reason":"queue_full"}}"#,
            ),
        ];
        for (line, text) in lines {
            assert_eq!(serde_json::to_string(&line).unwrap(), text);
            assert_eq!(serde_json::from_str::<Line>(text).unwrap(), line);
        }
    }

    #[test]
    fn quality_of_service_survives_being_told() {
        let qos = Qos {
            reliability: Reliability::BEST_EFFORT,
            durability: Durability::TRANSIENT_LOCAL,
            history: history("KEEP_LAST (5)"),
            deadline: Duration::Finite(100_000_000),
            ..Qos::defaults(Role::Writer, VendorId([0, 0]))
        };
        let facts = QosFacts::from(&qos);
        assert_eq!(
            (facts.history.as_str(), facts.lifespan_seconds),
            ("KEEP_LAST (5)", None)
        );
        assert_eq!(facts.qos(), qos);
        assert_eq!(history("KEEP_LAST (x)"), None);
        assert_eq!(history("KEEP_ALL").unwrap().kind, HistoryKind::KEEP_ALL);
        assert_eq!(duration(Some(-1.0)), Duration::Infinite);
        assert_eq!(durability("?").name(), None);
    }
}
