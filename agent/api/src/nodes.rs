//! `/nodes` and `/nodes/{node}`.

use std::borrow::Cow;

use serde::{Deserialize, Serialize};

use crate::diagnosis::{Diagnosis, Finding};
use crate::endpoints::Process;
use crate::inside::NodeInside;

/// All nodes.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(default)]
pub struct NodeList<'a> {
    /// Unix time of the state that this answer describes.
    pub timestamp_seconds: f64,
    /// Nodes, sorted by domain and name.
    pub nodes: Vec<Node<'a>>,
}

/// All nodes of a domain with the same name. More than one is a fault.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(default)]
pub struct Node<'a> {
    /// Domain id.
    pub domain_id: u32,
    /// Fully qualified name.
    #[cfg_attr(feature = "openapi", schema(example = "/robot1/lidar"))]
    pub name: Cow<'a, str>,
    /// Hidden by ROS convention, such as the nodes of command-line tools.
    pub hidden: bool,
    /// Each node with this name; more than one is a fault.
    pub instances: Vec<NodeInstance<'a>>,
    /// Topics that the node publishes.
    pub publishers: Vec<Named<'a>>,
    /// Topics that the node subscribes to.
    pub subscriptions: Vec<Named<'a>>,
    /// Services that the node offers.
    pub services: Vec<Named<'a>>,
    /// Services that the node calls.
    pub clients: Vec<Named<'a>>,
    /// Actions that the node offers.
    pub action_servers: Vec<Named<'a>>,
    /// Actions that the node calls.
    pub action_clients: Vec<Named<'a>>,
    /// Last known state of a managed node: `unconfigured`, `inactive`, `active`, `finalized`, or a
    /// state of transition; null when unknown.
    pub lifecycle_state: Option<Cow<'a, str>>,
    /// Problems of the node. Problems of its topics are in `/topics`.
    #[cfg_attr(feature = "openapi", schema(value_type = Vec<Diagnosis<'static>>))]
    pub diagnoses: Vec<Finding<'a>>,
    /// Data about the node from inside its processes; null without `capture.inside`.
    pub inside: Option<NodeInside<'a>>,
}

/// One of the nodes that share a name.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(default)]
pub struct NodeInstance<'a> {
    /// GUID of the node's participant.
    pub participant: String,
    /// Middleware: the DDS implementation, or `Eclipse Zenoh`; null when unknown.
    pub vendor: Option<Cow<'a, str>>,
    /// Host and process of the node; null when unknown.
    #[serde(flatten)]
    pub process: Option<Process<'a>>,
}

/// A name with its types.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(default)]
pub struct Named<'a> {
    /// ROS name.
    pub name: String,
    /// ROS types.
    pub types: Vec<Cow<'a, str>>,
}
