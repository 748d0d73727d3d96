//! Writers and readers, with their quality of service.

use std::borrow::Cow;

use serde::{Deserialize, Serialize};

use crate::measurement::Measurement;

/// One writer or reader.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(default)]
pub struct Endpoint<'a> {
    /// GUID, as the metrics show it.
    #[cfg_attr(
        feature = "openapi",
        schema(example = "010f2b7d6a474f3300000000.00001103")
    )]
    pub guid: String,
    /// Its node, as `ros_discovery_info` announces it; null when unknown.
    pub node: Option<Cow<'a, str>>,
    /// ROS enclave of its participant; null means it is no ROS participant.
    pub enclave: Option<Cow<'a, str>>,
    /// ROS type.
    pub message_type: Cow<'a, str>,
    /// RIHS01 hash; null where it is not announced (Humble).
    pub type_hash: Option<Cow<'a, str>>,
    /// Its participant's implementation.
    pub vendor: Option<Cow<'a, str>>,
    /// Quality of service.
    pub qos: Qos<'a>,
    /// Unix time of its first announcement.
    pub first_seen_timestamp_seconds: f64,
    /// What was counted of this writer; null for readers and while the topic is not watched.
    pub measurement: Option<Measurement>,
}

/// Quality of service as announced; durations are null when they are infinite.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(default)]
#[expect(missing_docs, reason = "policies of DDS, by their names")]
pub struct Qos<'a> {
    #[cfg_attr(feature = "openapi", schema(example = "RELIABLE"))]
    pub reliability: Cow<'a, str>,
    #[cfg_attr(feature = "openapi", schema(example = "VOLATILE"))]
    pub durability: Cow<'a, str>,
    /// `UNKNOWN` where the implementation does not say.
    #[cfg_attr(feature = "openapi", schema(example = "KEEP_LAST (10)"))]
    pub history: Cow<'a, str>,
    pub deadline_seconds: Option<f64>,
    pub lifespan_seconds: Option<f64>,
    #[cfg_attr(feature = "openapi", schema(example = "AUTOMATIC"))]
    pub liveliness: Cow<'a, str>,
    pub liveliness_lease_seconds: Option<f64>,
    #[cfg_attr(feature = "openapi", schema(example = "SHARED"))]
    pub ownership: Cow<'static, str>,
    /// Empty is the default one.
    pub partitions: Vec<Cow<'a, str>>,
}

/// Where something lives, as far as it is known.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(default)]
pub struct Process<'a> {
    /// Host name when announced.
    pub host: Option<Cow<'a, str>>,
    /// Process id.
    pub process_id: Option<u32>,
    /// Process name.
    pub process: Option<Cow<'a, str>>,
    /// Control group, as a path below the root: which container.
    pub cgroup: Option<Cow<'a, str>>,
}
