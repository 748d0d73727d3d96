//! `/logs`: what nodes log.

use std::borrow::Cow;

use serde::{Deserialize, Serialize};

/// The logs of all nodes.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(default)]
pub struct Logs<'a> {
    /// Unix time of the state that this answer describes.
    pub timestamp_seconds: f64,
    /// Whether the agent reads logs.
    pub is_on: bool,
    /// Nodes with a message, sorted by domain and name.
    pub nodes: Vec<NodeLog<'a>>,
    /// The latest messages that the query selects, oldest first.
    pub messages: Vec<LogMessage<'a>>,
}

/// The log of a node.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(default)]
pub struct NodeLog<'a> {
    /// Domain id.
    pub domain_id: u32,
    /// Fully qualified name.
    #[cfg_attr(feature = "openapi", schema(example = "/robot1/lidar"))]
    pub ros_node: Cow<'a, str>,
    /// Levels with a message, the least severe first.
    pub levels: Vec<LevelLog<'a>>,
}

/// Messages of one level.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(default)]
pub struct LevelLog<'a> {
    /// `debug`, `info`, `warn`, `error` or `fatal`.
    pub level: Cow<'static, str>,
    /// Messages since the agent started.
    pub messages: u64,
    /// The last one.
    pub last: LogMessage<'a>,
}

/// A message of a log.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(default)]
pub struct LogMessage<'a> {
    /// Unix time of its arrival.
    pub timestamp_seconds: f64,
    /// Seconds of the node's clock when it was logged.
    pub stamp_sec: i32,
    /// Nanoseconds of that second.
    pub stamp_nanosec: u32,
    /// Domain id.
    pub domain_id: u32,
    /// Fully qualified name of the node.
    #[cfg_attr(feature = "openapi", schema(example = "/robot1/lidar"))]
    pub ros_node: Cow<'a, str>,
    /// `debug`, `info`, `warn`, `error` or `fatal`.
    #[cfg_attr(feature = "openapi", schema(example = "warn"))]
    pub level: Cow<'static, str>,
    /// Name of the logger.
    #[cfg_attr(feature = "openapi", schema(example = "robot1.lidar"))]
    pub logger: Cow<'a, str>,
    /// The text, truncated to 512 bytes.
    pub text: Cow<'a, str>,
    /// Source file, truncated to 128 bytes.
    pub file: Cow<'a, str>,
    /// Function, truncated to 128 bytes.
    pub function: Cow<'a, str>,
    /// Line in the file.
    pub line: u32,
    /// GUID of the writer.
    pub writer: String,
    /// Sequence number.
    pub sequence_number: u64,
}
