//! Writers and readers as answers show them, with what they offer or ask for.

use std::fmt::Display;

use ros2probe_wire::Guid;
use serde::{Serialize, Serializer};
use utoipa::ToSchema;

use super::index::Index;
use super::measured::MeasurementView;
use ros2probe_model::snapshot::{EndpointFacts, ProcessFacts};

/// One writer or reader.
#[derive(Debug, Serialize, ToSchema)]
#[schema(as = Endpoint)]
pub(super) struct EndpointView<'a> {
    /// GUID, as the metrics show it.
    #[serde(serialize_with = "text")]
    #[schema(value_type = String, example = "010f2b7d6a474f3300000000.00001103")]
    guid: Guid,
    /// Its node, when `ros_discovery_info` told.
    node: Option<&'a str>,
    /// ROS enclave of its participant; null means it is no ROS participant.
    enclave: Option<&'a str>,
    /// ROS type.
    message_type: &'a str,
    /// RIHS01 hash; null where it is not announced (Humble).
    type_hash: Option<&'a str>,
    /// Its participant's implementation.
    vendor: Option<&'a str>,
    /// Quality of service.
    qos: QosView<'a>,
    /// Unix time of its first announcement.
    first_seen_timestamp_seconds: f64,
    /// What was counted of this writer; null for readers and while the topic is not watched.
    measurement: Option<MeasurementView>,
}

/// Quality of service as announced; durations are null when they are infinite.
#[derive(Debug, Serialize, ToSchema)]
#[schema(as = Qos)]
struct QosView<'a> {
    #[schema(example = "RELIABLE")]
    reliability: &'a str,
    #[schema(example = "VOLATILE")]
    durability: &'a str,
    /// `UNKNOWN` where the implementation does not say.
    #[schema(example = "KEEP_LAST (10)")]
    history: &'a str,
    deadline_seconds: Option<f64>,
    lifespan_seconds: Option<f64>,
    #[schema(example = "AUTOMATIC")]
    liveliness: &'a str,
    liveliness_lease_seconds: Option<f64>,
    #[schema(example = "SHARED")]
    ownership: &'static str,
    /// Empty is the default one.
    partitions: &'a [String],
}

/// Where something lives, as far as it is known.
#[derive(Debug, Serialize, ToSchema)]
#[schema(as = Process)]
pub(super) struct ProcessView<'a> {
    /// Host name when announced.
    host: Option<&'a str>,
    /// Process id.
    process_id: Option<u32>,
    /// Process name.
    process: Option<&'a str>,
    /// Control group, as a path below the root: which container.
    cgroup: Option<&'a str>,
}

impl<'a> EndpointView<'a> {
    pub(super) fn new(facts: &'a EndpointFacts, index: &Index<'a>) -> Self {
        let participant = index.participant(facts.guid);
        Self {
            guid: facts.guid,
            node: facts.node.as_deref(),
            enclave: participant.and_then(|participant| participant.enclave.as_deref()),
            message_type: &facts.message_type,
            type_hash: facts.type_hash.as_deref(),
            vendor: participant.map(|participant| participant.vendor.as_str()),
            qos: QosView {
                reliability: &facts.reliability,
                durability: &facts.durability,
                history: &facts.history,
                deadline_seconds: seconds(facts.deadline_nanoseconds),
                lifespan_seconds: seconds(facts.lifespan_nanoseconds),
                liveliness: &facts.liveliness,
                liveliness_lease_seconds: seconds(facts.liveliness_lease_nanoseconds),
                ownership: facts.ownership,
                partitions: &facts.partitions,
            },
            first_seen_timestamp_seconds: facts.first_seen.seconds(),
            measurement: facts.measurement.as_deref().map(Into::into),
        }
    }
}

impl<'a> From<&'a ProcessFacts> for ProcessView<'a> {
    fn from(facts: &'a ProcessFacts) -> Self {
        Self {
            host: facts.host.as_deref(),
            process_id: facts.id,
            process: facts.name.as_deref(),
            cgroup: facts.cgroup.as_deref(),
        }
    }
}

/// Nanoseconds as seconds.
#[expect(clippy::cast_precision_loss, reason = "microseconds survive")]
pub(super) fn seconds(nanoseconds: Option<u64>) -> Option<f64> {
    nanoseconds.map(|nanoseconds| nanoseconds as f64 / 1e9)
}

/// As it is printed.
pub(super) fn text<T: Display, S: Serializer>(value: &T, out: S) -> Result<S::Ok, S::Error> {
    out.collect_str(value)
}

/// Each as it is printed.
pub(super) fn texts<T: Display, S: Serializer>(values: &[T], out: S) -> Result<S::Ok, S::Error> {
    out.collect_seq(values.iter().map(Printed))
}

struct Printed<'a, T>(&'a T);

impl<T: Display> Serialize for Printed<'_, T> {
    fn serialize<S: Serializer>(&self, out: S) -> Result<S::Ok, S::Error> {
        out.collect_str(self.0)
    }
}
