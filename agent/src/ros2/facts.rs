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

/// `/topics/NAME`.
#[derive(Clone, Debug, Default, Deserialize)]
pub struct Topic {
    /// ROS name.
    pub name: String,
    /// ROS types, sorted.
    pub message_types: Vec<String>,
    /// Writers.
    pub publishers: Vec<Endpoint>,
    /// Readers.
    pub subscriptions: Vec<Endpoint>,
}

/// A writer or reader.
#[derive(Clone, Debug, Default, Deserialize)]
pub struct Endpoint {
    /// 24 and 8 hexadecimal digits with a point between.
    pub guid: String,
    /// Its node, when that is known.
    pub node: Option<String>,
    /// Its participant's enclave; `None` where it is no ROS participant.
    pub enclave: Option<String>,
    /// ROS type.
    pub message_type: String,
    /// RIHS01 hash, when announced.
    pub type_hash: Option<String>,
    /// Quality of service.
    pub qos: Qos,
}

/// Quality of service in the words of `ros2`.
#[derive(Clone, Debug, Default, Deserialize)]
pub struct Qos {
    /// `RELIABLE`, ...
    pub reliability: String,
    /// `VOLATILE`, ...
    pub durability: String,
    /// `KEEP_LAST (10)`, ...
    pub history: String,
    /// `None` is infinite, as below.
    pub deadline_seconds: Option<f64>,
    /// Lifespan.
    pub lifespan_seconds: Option<f64>,
    /// `AUTOMATIC`, ...
    pub liveliness: String,
    /// Lease.
    pub liveliness_lease_seconds: Option<f64>,
}

/// `/nodes/NAME`.
#[derive(Clone, Debug, Default, Deserialize)]
pub struct Node {
    /// Fully qualified.
    pub name: String,
    /// Each node of the name.
    pub instances: Vec<Instance>,
    /// Topics it publishes.
    pub publishers: Vec<Named>,
    /// Topics it subscribes to.
    pub subscriptions: Vec<Named>,
    /// Services it serves.
    pub services: Vec<Named>,
    /// Services it calls.
    pub clients: Vec<Named>,
}

/// One node of a name.
#[derive(Clone, Copy, Debug, Default, Deserialize)]
pub struct Instance {}

/// A name with its types.
#[derive(Clone, Debug, Default, PartialEq, Eq, Deserialize)]
pub struct Named {
    /// ROS name.
    pub name: String,
    /// ROS types, sorted.
    pub types: Vec<String>,
}

/// Any token begins with an underscore: shown only when asked for.
#[must_use]
pub fn is_hidden(name: &str) -> bool {
    name.split('/').any(|token| token.starts_with('_'))
}

/// A node is hidden by its own name, whatever its namespace is called.
#[must_use]
pub fn is_hidden_node(name: &str) -> bool {
    name.rsplit('/')
        .next()
        .is_some_and(|name| name.starts_with('_'))
}
