//! `/graph`: nodes, topics, services and actions as a directed graph.

use serde::{Deserialize, Serialize};

use crate::Open;

/// The graph of nodes, topics, services and actions.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(default)]
pub struct Graph {
    /// Unix time of the state that this answer describes.
    pub timestamp_seconds: f64,
    /// Vertices, sorted by id.
    pub nodes: Vec<Vertex>,
    /// Edges, sorted by source, target and kind.
    pub edges: Vec<Edge>,
}

/// A vertex: a node, participant, topic, service or action.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(default)]
pub struct Vertex {
    /// Id by which edges refer to the vertex.
    #[cfg_attr(feature = "openapi", schema(example = "node:0:/robot1/lidar"))]
    pub id: String,
    /// Kind of the vertex.
    #[cfg_attr(feature = "openapi", schema(value_type = VertexKind))]
    pub kind: Open<VertexKind>,
    /// Domain id.
    pub domain_id: u32,
    /// ROS name, or the GUID of a participant without a node.
    pub name: String,
}

/// The kind of a vertex.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(rename_all = "snake_case")]
pub enum VertexKind {
    /// A ROS node.
    Node,
    /// A participant whose endpoints belong to no known node.
    Participant,
    /// A topic.
    Topic,
    /// A service.
    Service,
    /// An action.
    Action,
}

/// An edge, in the direction of messages and requests.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(default)]
pub struct Edge {
    /// Id of the vertex at which the edge begins.
    pub source: String,
    /// Id of the vertex at which the edge ends.
    pub target: String,
    /// Kind of the edge.
    #[cfg_attr(feature = "openapi", schema(value_type = EdgeKind))]
    pub kind: Open<EdgeKind>,
    /// Messages per second; null unless the edge is `publishes` and the topic is measured.
    pub rate_hertz: Option<f64>,
}

/// The kind of an edge. Edges point in the direction of messages and requests.
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
