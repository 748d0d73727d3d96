//! `/parameters`: parameters of nodes and their changes.

use std::borrow::Cow;

use serde::{Deserialize, Serialize};

/// Parameters that the agent saw, and their changes.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(default)]
pub struct Parameters<'a> {
    /// Unix time of the state that this answer describes.
    pub timestamp_seconds: f64,
    /// Whether the agent reads parameters.
    pub is_on: bool,
    /// Last known values, sorted by domain, node and name.
    pub parameters: Vec<Parameter<'a>>,
    /// The latest changes, oldest first.
    pub changes: Vec<ParameterChange<'a>>,
}

/// The last known value of a parameter.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(default)]
pub struct Parameter<'a> {
    /// Domain id.
    pub domain_id: u32,
    /// Fully qualified name of the node.
    #[cfg_attr(feature = "openapi", schema(example = "/robot1/planner"))]
    pub ros_node: Cow<'a, str>,
    /// Name.
    #[cfg_attr(feature = "openapi", schema(example = "max_speed"))]
    pub name: Cow<'a, str>,
    /// Value in the form of YAML, truncated to 256 bytes.
    #[cfg_attr(feature = "openapi", schema(example = "0.5"))]
    pub value: Cow<'a, str>,
    /// Unix time of this value.
    pub timestamp_seconds: f64,
}

/// A change of a parameter.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(default)]
pub struct ParameterChange<'a> {
    /// Unix time of the event. It changes if the wall clock is set.
    pub timestamp_seconds: f64,
    /// Time of the event in nanoseconds of the agent's monotonic clock, which identifies the
    /// change. Its beginning is arbitrary.
    pub monotonic_ns: u64,
    /// Domain id.
    pub domain_id: u32,
    /// Fully qualified name of the node.
    pub ros_node: Cow<'a, str>,
    /// Name.
    pub name: Cow<'a, str>,
    /// Last known value before; absent if it was unknown.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub before: Option<Cow<'a, str>>,
    /// New value; absent if the parameter was removed.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub value: Option<Cow<'a, str>>,
    /// Node of the client that requested it; absent if it is unknown.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub requested_by: Option<Cow<'a, str>>,
    /// GUID of the client's writer; absent if no request was seen.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub requested_by_writer: Option<String>,
}
