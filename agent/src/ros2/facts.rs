//! What the text is made of, as the agent's API says it. Fields that no text needs are left out.

use serde::Deserialize;

/// `/names`.
#[derive(Clone, Debug, Default, Deserialize)]
pub struct Names {
    /// Domains in which somebody is.
    pub domains: Vec<u32>,
    /// Nodes by name.
    pub nodes: Vec<NodeName>,
    /// ROS topics by name.
    pub topics: Vec<TopicName>,
    /// Services by name.
    pub services: Vec<ServiceName>,
}

/// A node's name.
#[derive(Clone, Debug, Default, Deserialize)]
pub struct NodeName {
    /// Fully qualified.
    pub name: String,
    /// Hidden by ROS convention.
    pub hidden: bool,
    /// Nodes that bear it.
    pub instances: usize,
}

/// A topic with its types and the number of its ends.
#[derive(Clone, Debug, Default, Deserialize)]
pub struct TopicName {
    /// ROS name.
    pub name: String,
    /// Hidden by ROS convention.
    pub hidden: bool,
    /// ROS types, sorted.
    pub types: Vec<String>,
    /// Writers.
    pub publishers: usize,
    /// Readers.
    pub subscriptions: usize,
}

/// A service with its types and the number of its ends.
#[derive(Clone, Debug, Default, Deserialize)]
pub struct ServiceName {
    /// ROS name.
    pub name: String,
    /// Hidden by ROS convention.
    pub hidden: bool,
    /// ROS types, sorted.
    pub types: Vec<String>,
    /// Readers of requests.
    pub request_readers: usize,
    /// Writers of replies.
    pub reply_writers: usize,
    /// Readers of replies.
    pub reply_readers: usize,
}

impl Names {
    /// Nothing in the domain that was asked for.
    #[must_use]
    pub const fn is_empty(&self) -> bool {
        self.nodes.is_empty() && self.topics.is_empty() && self.services.is_empty()
    }
}
