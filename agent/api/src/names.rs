//! `/names`.

use std::borrow::Cow;
use std::collections::BTreeSet;

use serde::{Deserialize, Serialize};

/// Names.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(default)]
pub struct Names<'a> {
    /// Unix time of the facts.
    pub timestamp_seconds: f64,
    /// Every domain with a participant, also when the request selects one.
    pub domains: BTreeSet<u32>,
    /// How many participants there are.
    pub participants: usize,
    /// Writers that send although their announcement was missed; of no known domain.
    pub unknown_writers: usize,
    /// Nodes by domain and name.
    pub nodes: Vec<NodeName<'a>>,
    /// ROS topics by domain and name; with `hidden=true` also those that actions and introspection
    /// of services consist of.
    pub topics: Vec<TopicName<'a>>,
    /// Services by domain and name.
    pub services: Vec<ServiceName<'a>>,
}

/// A node's name.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(default)]
pub struct NodeName<'a> {
    /// Domain.
    pub domain_id: u32,
    /// Fully qualified name.
    #[cfg_attr(feature = "openapi", schema(example = "/robot1/lidar"))]
    pub name: Cow<'a, str>,
    /// Hidden by ROS convention.
    pub hidden: bool,
    /// Nodes that bear it; more than one is a fault.
    pub instances: usize,
}

/// A topic's name.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(default)]
pub struct TopicName<'a> {
    /// Domain.
    pub domain_id: u32,
    /// ROS name.
    #[cfg_attr(feature = "openapi", schema(example = "/points"))]
    pub name: Cow<'a, str>,
    /// Hidden by ROS convention.
    pub hidden: bool,
    /// ROS types.
    pub types: Vec<Cow<'a, str>>,
    /// How many writers.
    pub publishers: usize,
    /// How many readers.
    pub subscriptions: usize,
}

/// A service's name.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(default)]
pub struct ServiceName<'a> {
    /// Domain.
    pub domain_id: u32,
    /// ROS name.
    #[cfg_attr(feature = "openapi", schema(example = "/add_two_ints"))]
    pub name: Cow<'a, str>,
    /// Hidden by ROS convention.
    pub hidden: bool,
    /// ROS types.
    #[cfg_attr(feature = "openapi", schema(example = json!(["example_interfaces/srv/AddTwoInts"])))]
    pub types: Vec<Cow<'a, str>>,
    /// Readers of requests: of servers.
    pub request_readers: usize,
    /// Writers of replies: of servers.
    pub reply_writers: usize,
    /// Writers of requests: of clients.
    pub request_writers: usize,
    /// Readers of replies: of clients.
    pub reply_readers: usize,
}

impl Names<'_> {
    /// Nothing in the domain that was asked for.
    #[must_use]
    pub const fn is_empty(&self) -> bool {
        self.nodes.is_empty() && self.topics.is_empty() && self.services.is_empty()
    }
}
