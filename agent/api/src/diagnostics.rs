//! `/diagnostics`: the states of the robot's parts.

use std::borrow::Cow;

use serde::{Deserialize, Serialize};

/// The diagnostics of all robots.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(default)]
pub struct Diagnostics<'a> {
    /// Unix time of the state that this answer describes.
    pub timestamp_seconds: f64,
    /// Whether the agent reads diagnostics.
    pub is_on: bool,
    /// The parts, sorted by domain, topic, name and hardware id.
    pub statuses: Vec<DiagnosticStatus<'a>>,
}

/// The last status of a part.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(default)]
pub struct DiagnosticStatus<'a> {
    /// Domain id.
    pub domain_id: u32,
    /// Topic.
    #[cfg_attr(feature = "openapi", schema(example = "/diagnostics"))]
    pub topic: Cow<'a, str>,
    /// Name of the part.
    #[cfg_attr(feature = "openapi", schema(example = "lidar: connection"))]
    pub name: Cow<'a, str>,
    /// Id of its hardware; often empty.
    pub hardware_id: Cow<'a, str>,
    /// Node that publishes it.
    pub ros_node: Option<Cow<'a, str>>,
    /// `ok`, `warn`, `error` or `stale`; also `stale` if its messages ceased.
    #[cfg_attr(feature = "openapi", schema(example = "error"))]
    pub level: Cow<'static, str>,
    /// Message, truncated to 256 bytes.
    pub message: Cow<'a, str>,
    /// Unix time of the last message.
    pub timestamp_seconds: f64,
    /// Unix time since which it has this level.
    pub since_seconds: f64,
    /// Values with their keys, at most 64.
    pub values: Vec<DiagnosticValue<'a>>,
}

/// A value of a status.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(default)]
pub struct DiagnosticValue<'a> {
    /// Key, truncated to 128 bytes.
    pub key: Cow<'a, str>,
    /// Value, truncated to 256 bytes.
    pub value: Cow<'a, str>,
}
