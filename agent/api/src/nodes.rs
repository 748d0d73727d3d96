//! `/nodes` and `/nodes/{node}`.

use std::borrow::Cow;

use serde::{Deserialize, Serialize};

use crate::diagnosis::{Diagnosis, Finding};
use crate::endpoints::Process;

/// Nodes.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(default)]
pub struct NodeList<'a> {
    /// Unix time of the facts.
    pub timestamp_seconds: f64,
    /// By domain and name.
    pub nodes: Vec<Node<'a>>,
}

/// One node name. Several nodes of one name in one domain are a fault, and shown as one.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(default)]
pub struct Node<'a> {
    /// Domain.
    pub domain_id: u32,
    /// Fully qualified name.
    #[cfg_attr(feature = "openapi", schema(example = "/robot1/lidar"))]
    pub name: Cow<'a, str>,
    /// Hidden by ROS convention: those of the command line are.
    pub hidden: bool,
    /// Each node of the name; more than one is a fault.
    pub instances: Vec<NodeInstance<'a>>,
    /// Topics it publishes.
    pub publishers: Vec<Named<'a>>,
    /// Topics it subscribes to.
    pub subscriptions: Vec<Named<'a>>,
    /// Services it serves.
    pub services: Vec<Named<'a>>,
    /// Services it calls.
    pub clients: Vec<Named<'a>>,
    /// Actions it serves.
    pub action_servers: Vec<Named<'a>>,
    /// Actions it calls.
    pub action_clients: Vec<Named<'a>>,
    /// What is wrong with it; `/topics` says what is wrong with its topics.
    #[cfg_attr(feature = "openapi", schema(value_type = Vec<Diagnosis<'static>>))]
    pub diagnoses: Vec<Finding<'a>>,
}

/// One node of a name.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(default)]
pub struct NodeInstance<'a> {
    /// Its participant.
    pub participant: String,
    /// Implementation.
    pub vendor: Option<Cow<'a, str>>,
    /// Where it lives.
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
