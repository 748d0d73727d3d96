//! `/graph`.

use serde::{Deserialize, Serialize};

use crate::Open;

/// The graph.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(default)]
pub struct Graph {
    /// Unix time of the facts.
    pub timestamp_seconds: f64,
    /// By id.
    pub nodes: Vec<Vertex>,
    /// By source, target and kind.
    pub edges: Vec<Edge>,
}

/// Something that others are joined to.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(default)]
pub struct Vertex {
    /// What edges call it.
    #[cfg_attr(feature = "openapi", schema(example = "node:0:/robot1/lidar"))]
    pub id: String,
    /// What it is.
    #[cfg_attr(feature = "openapi", schema(value_type = VertexKind))]
    pub kind: Open<VertexKind>,
    /// Domain.
    pub domain_id: u32,
    /// ROS name; a participant's GUID where a participant has no node.
    pub name: String,
}

/// What a vertex is.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(rename_all = "snake_case")]
pub enum VertexKind {
    /// A ROS node.
    Node,
    /// A participant that has endpoints of no node.
    Participant,
    /// A topic.
    Topic,
    /// A service.
    Service,
    /// An action.
    Action,
}

/// Who gives something to whom.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(default)]
pub struct Edge {
    /// Id of the vertex it begins at.
    pub source: String,
    /// Id of the vertex it ends at.
    pub target: String,
    /// What it means.
    #[cfg_attr(feature = "openapi", schema(value_type = EdgeKind))]
    pub kind: Open<EdgeKind>,
    /// Messages a second of a publisher, where they are counted.
    pub rate_hertz: Option<f64>,
}

/// What an edge means. Edges go the way messages and requests go.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(rename_all = "snake_case")]
pub enum EdgeKind {
    /// From a node to a topic.
    Publishes,
    /// From a topic to a node.
    Feeds,
    /// From a client to a service or action.
    Calls,
    /// From a service or action to its server.
    ServedBy,
}
