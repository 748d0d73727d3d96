//! `/names`: names of nodes, topics and services.

use std::borrow::Cow;
use std::collections::BTreeSet;

use serde::{Deserialize, Serialize};

/// Names of nodes, topics and services.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(default)]
pub struct Names<'a> {
    /// Unix time of the state that this answer describes.
    pub timestamp_seconds: f64,
    /// Domains with a participant, including domains that the request does not select.
    pub domains: BTreeSet<u32>,
    /// Number of participants.
    pub participants: usize,
    /// Number of active writers whose announcement was missed. Their domain is unknown.
    pub unknown_writers: usize,
    /// Command that requests the announcements of unknown writers, or of participants without a
    /// known topic. Null without such writers and participants, and if none can answer.
    pub remedy: Option<Cow<'a, str>>,
    /// Nodes, sorted by domain and name.
    pub nodes: Vec<NodeName<'a>>,
    /// ROS topics, sorted by domain and name. With `hidden=true` they include the topics of actions
    /// and of service introspection.
    pub topics: Vec<TopicName<'a>>,
    /// Services, sorted by domain and name.
    pub services: Vec<ServiceName<'a>>,
}

/// The name of a node.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(default)]
pub struct NodeName<'a> {
    /// Domain id.
    pub domain_id: u32,
    /// Fully qualified name.
    #[cfg_attr(feature = "openapi", schema(example = "/robot1/lidar"))]
    pub name: Cow<'a, str>,
    /// Hidden by ROS convention.
    pub hidden: bool,
    /// Number of nodes with this name; more than one is a fault.
    pub instances: usize,
}

/// The name of a topic.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(default)]
pub struct TopicName<'a> {
    /// Domain id.
    pub domain_id: u32,
    /// ROS name.
    #[cfg_attr(feature = "openapi", schema(example = "/points"))]
    pub name: Cow<'a, str>,
    /// Hidden by ROS convention.
    pub hidden: bool,
    /// ROS types.
    pub types: Vec<Cow<'a, str>>,
    /// Number of writers.
    pub publishers: usize,
    /// Number of readers.
    pub subscriptions: usize,
}

/// The name of a service.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(default)]
pub struct ServiceName<'a> {
    /// Domain id.
    pub domain_id: u32,
    /// ROS name.
    #[cfg_attr(feature = "openapi", schema(example = "/add_two_ints"))]
    pub name: Cow<'a, str>,
    /// Hidden by ROS convention.
    pub hidden: bool,
    /// ROS types.
    #[cfg_attr(feature = "openapi", schema(example = json!(["example_interfaces/srv/AddTwoInts"])))]
    pub types: Vec<Cow<'a, str>>,
    /// Number of request readers, which belong to servers.
    pub request_readers: usize,
    /// Number of reply writers, which belong to servers.
    pub reply_writers: usize,
    /// Number of request writers, which belong to clients.
    pub request_writers: usize,
    /// Number of reply readers, which belong to clients.
    pub reply_readers: usize,
}

impl Names<'_> {
    /// Returns whether the requested domain has no nodes, topics or services.
    #[must_use]
    pub const fn is_empty(&self) -> bool {
        self.nodes.is_empty() && self.topics.is_empty() && self.services.is_empty()
    }
}
