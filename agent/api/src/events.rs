//! `/events`: the data of server-sent events.

use std::borrow::Cow;

use serde::{Deserialize, Serialize};

use crate::attributes::Attributes;

/// An event: the `data` of a server-sent event, whose `event` field is `name` and `id` field is
/// `id`.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(default)]
pub struct Event<'a> {
    /// Position in the stream, for `Last-Event-ID`. An id is valid for one run of the agent.
    #[cfg_attr(feature = "openapi", schema(example = "641a2b3c4d5e6-17"))]
    pub id: String,
    /// Time of the event, in UTC (RFC 3339).
    #[cfg_attr(feature = "openapi", schema(format = DateTime))]
    pub time: String,
    /// Name of the event, from `docs/events.md`.
    #[cfg_attr(feature = "openapi", schema(example = "ros2.message.lost"))]
    pub name: Cow<'static, str>,
    /// `INFO`, `WARN` or `ERROR`.
    pub severity: Cow<'static, str>,
    /// Attributes of the event; they have the same names as the labels of metrics.
    #[cfg_attr(feature = "openapi", schema(value_type = Object))]
    pub attributes: Attributes<'a>,
}

/// The `data` of a server-sent event named `lagged`: events are missing at this point.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct Lagged {
    /// Number of missing events; null if they belong to an earlier run of the agent.
    pub missed: Option<u64>,
    /// `overwritten`: the buffer dropped them before they were sent. `restarted`: the id belongs to
    /// an earlier run of the agent.
    pub reason: Cow<'static, str>,
}
