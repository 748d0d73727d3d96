//! `/transforms`: the trees of frames.

use std::borrow::Cow;

use serde::{Deserialize, Serialize};

/// The transforms of all robots.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(default)]
pub struct Transforms<'a> {
    /// Unix time of the state that this answer describes.
    pub timestamp_seconds: f64,
    /// Whether the agent reads transforms.
    pub is_on: bool,
    /// Trees, sorted by domain and namespace.
    pub trees: Vec<TransformTree<'a>>,
}

/// The frames of one domain and namespace.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(default)]
pub struct TransformTree<'a> {
    /// Domain id.
    pub domain_id: u32,
    /// Namespace of the topics; empty for `/tf`.
    #[cfg_attr(feature = "openapi", schema(example = "/robot1"))]
    pub namespace: Cow<'a, str>,
    /// Publishers of static transforms of which no message was read: the agent came later.
    pub unread_static_publishers: u64,
    /// Edges, sorted by child frame.
    pub edges: Vec<TransformEdge<'a>>,
}

/// The transform between a frame and its parent.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(default)]
pub struct TransformEdge<'a> {
    /// Parent frame.
    #[cfg_attr(feature = "openapi", schema(example = "odom"))]
    pub parent: Cow<'a, str>,
    /// Child frame.
    #[cfg_attr(feature = "openapi", schema(example = "base_link"))]
    pub child: Cow<'a, str>,
    /// Whether it is static: broadcast once.
    pub is_static: bool,
    /// Its broadcasters, the last one first.
    pub broadcasters: Vec<Broadcaster<'a>>,
    /// Transforms that were seen.
    pub messages: u64,
    /// Transforms per second over the last ten; absent in the first second, and for a static edge.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub rate_hz: Option<f64>,
    /// Longest of the latest times between two transforms; each transform shortens it by an eighth,
    /// until a longer one follows. Absent before the second transform, and for a static edge.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[cfg_attr(feature = "openapi", schema(nullable = false))]
    pub longest_interval_seconds: Option<f64>,
    /// Sudden changes of the edge that were seen since its broadcasters appeared.
    pub jumps: TransformJumps,
    /// Unix time at which the last transform was seen.
    pub timestamp_seconds: f64,
    /// Seconds of its stamp.
    pub stamp_sec: i32,
    /// Nanoseconds of that second.
    pub stamp_nanosec: u32,
    /// x, y and z in metres.
    pub translation: [f64; 3],
    /// Quaternion: x, y, z and w.
    pub rotation: [f64; 4],
}

/// Numbers of sudden changes of an edge, by kind.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(default)]
pub struct TransformJumps {
    /// Jumps of the position.
    pub translation: u64,
    /// Jumps of the orientation.
    pub rotation: u64,
    /// Stamps before the last one of the same broadcaster.
    pub time: u64,
}

/// A node that broadcasts an edge.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(default)]
pub struct Broadcaster<'a> {
    /// Fully qualified name of the node, if known.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub ros_node: Option<Cow<'a, str>>,
    /// GUID of its writer.
    pub writer: String,
}
