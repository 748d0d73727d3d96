//! What the text is made of, as the agent's API says it. Fields that no text needs are left out, and
//! control characters are escaped: names come from whoever is on the network, and go to a terminal.

use std::borrow::Cow;

use serde::{Deserialize, Deserializer};

use ros2probe_daemon::escape::visible;

/// `/names`.
#[derive(Clone, Debug, Default, Deserialize)]
pub struct Names {
    /// Domains in which somebody is.
    pub domains: Vec<u32>,
    /// Participants in the domain.
    #[serde(default)]
    pub participants: usize,
    /// Writers that send although their announcement was missed.
    #[serde(default)]
    pub unknown_writers: usize,
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
    #[serde(deserialize_with = "plain")]
    pub name: String,
    /// Nodes that bear it.
    pub instances: usize,
}

/// A topic with its types and the number of its ends.
#[derive(Clone, Debug, Default, Deserialize)]
pub struct TopicName {
    /// ROS name.
    #[serde(deserialize_with = "plain")]
    pub name: String,
    /// Hidden by ROS convention.
    pub hidden: bool,
    /// ROS types, sorted.
    #[serde(deserialize_with = "plain_list")]
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
    #[serde(deserialize_with = "plain")]
    pub name: String,
    /// Hidden by ROS convention.
    pub hidden: bool,
    /// ROS types, sorted.
    #[serde(deserialize_with = "plain_list")]
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
    #[serde(deserialize_with = "plain")]
    pub name: String,
    /// ROS types, sorted.
    #[serde(deserialize_with = "plain_list")]
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
    #[serde(deserialize_with = "plain")]
    pub guid: String,
    /// Its node, when that is known.
    #[serde(default, deserialize_with = "plain_option")]
    pub node: Option<String>,
    /// Its participant's enclave; `None` where it is no ROS participant.
    pub enclave: Option<String>,
    /// ROS type.
    #[serde(deserialize_with = "plain")]
    pub message_type: String,
    /// RIHS01 hash, when announced.
    #[serde(default, deserialize_with = "plain_option")]
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
    #[serde(deserialize_with = "plain")]
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
    #[serde(deserialize_with = "plain")]
    pub name: String,
    /// ROS types, sorted.
    #[serde(deserialize_with = "plain_list")]
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

fn plain<'de, D: Deserializer<'de>>(from: D) -> Result<String, D::Error> {
    let text: Cow<'_, str> = Cow::deserialize(from)?;
    Ok(visible(&text).into_owned())
}

fn plain_list<'de, D: Deserializer<'de>>(from: D) -> Result<Vec<String>, D::Error> {
    let list: Vec<Cow<'_, str>> = Vec::deserialize(from)?;
    Ok(list.iter().map(|text| visible(text).into_owned()).collect())
}

fn plain_option<'de, D: Deserializer<'de>>(from: D) -> Result<Option<String>, D::Error> {
    let text: Option<Cow<'_, str>> = Option::deserialize(from)?;
    Ok(text.map(|text| visible(&text).into_owned()))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn no_name_reaches_a_terminal_with_control_characters() {
        let node = r#"{"name": "/\u001b[2J\n/é", "instances": 1}"#;
        let node: NodeName = serde_json::from_str(node).unwrap();
        assert_eq!(node.name, "/\\u{1b}[2J\\n/é");
        let topic = r#"{"name": "/a", "hidden": false, "types": ["a/msg/\u009b1mB"],
            "publishers": 1, "subscriptions": 0}"#;
        let topic: TopicName = serde_json::from_str(topic).unwrap();
        assert_eq!(topic.types, ["a/msg/\\u{9b}1mB"]);
    }

    #[test]
    fn a_node_is_hidden_by_its_own_name_alone() {
        assert!(is_hidden("/fib/_action/status") && is_hidden("/_a/b") && !is_hidden("/a_/b"));
        assert!(is_hidden_node("/a/_ros2cli_1") && !is_hidden_node("/_a/b"));
    }
}
