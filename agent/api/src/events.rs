//! `/events`: the data of server-sent events.

use std::borrow::Cow;

use serde::{Deserialize, Serialize};

use crate::attributes::Attributes;

/// One event: the `data` of a message, whose `event` is its name and whose `id` is its id.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(default)]
pub struct Event<'a> {
    /// Where to go on after a break. Belongs to one run of the agent.
    #[cfg_attr(feature = "openapi", schema(example = "641a2b3c4d5e6-17"))]
    pub id: String,
    /// When it happened, in UTC.
    #[cfg_attr(feature = "openapi", schema(format = DateTime))]
    pub time: String,
    /// What it is, as `docs/events.md` lists.
    #[cfg_attr(feature = "openapi", schema(example = "ros2.message.lost"))]
    pub name: Cow<'static, str>,
    /// `INFO`, `WARN` or `ERROR`.
    pub severity: Cow<'static, str>,
    /// What is known of it, by the names of the metrics' labels.
    #[cfg_attr(feature = "openapi", schema(value_type = Object))]
    pub attributes: Attributes<'a>,
}

/// Events are missing here: the `data` of a message whose `event` is `lagged`.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct Lagged {
    /// Number of events; null when they belong to an earlier run of the agent.
    pub missed: Option<u64>,
    /// `overwritten` before they could be sent, or `restarted`: the id was of another run.
    pub reason: Cow<'static, str>,
}
