//! What discovery says of a topic, as far as a bag says it: from a snapshot within the agent, from
//! the API's JSON where a client records.

use std::collections::HashMap;

use serde::Deserialize;

use crate::model::snapshot::{EndpointFacts, TopicFacts};
use crate::subscriptions::line::{QosFacts, seconds};

/// The API's `/topics`: what is announced of all topics.
#[derive(Clone, Debug, Default, Deserialize)]
pub struct Graph {
    topics: Vec<GraphTopic>,
}

#[derive(Clone, Debug, Deserialize)]
struct GraphTopic {
    name: String,
    dds_name: String,
    kind: String,
    #[serde(flatten)]
    announced: Announced,
}

impl Graph {
    /// By the names that messages bear: ROS names of topics, else DDS names.
    #[must_use]
    pub fn by_name(self) -> HashMap<String, Announced> {
        let topics = self.topics.into_iter().map(|topic| {
            let name = match topic.kind.as_str() {
                "service_request" | "service_reply" | "discovery" | "dds" => topic.dds_name,
                _ => topic.name,
            };
            (name, topic.announced)
        });
        topics.collect()
    }
}

/// A topic at the moment in which it is taken into a bag.
#[derive(Clone, Debug, Default, Deserialize)]
pub struct Announced {
    /// ROS types announced on it.
    pub message_types: Vec<String>,
    /// RIHS01 hashes announced on it.
    pub type_hashes: Vec<String>,
    /// Its writers.
    pub publishers: Vec<Publisher>,
    /// Its readers.
    pub subscriptions: Vec<Subscriber>,
}

/// One writer.
#[derive(Clone, Debug, Deserialize)]
pub struct Publisher {
    /// GUID as the metrics show it.
    pub guid: String,
    /// What it offers.
    pub qos: QosFacts,
}

/// One reader; that there is one is all that matters.
#[derive(Clone, Debug, Deserialize)]
pub struct Subscriber {}

impl Publisher {
    /// Late joiners are given its last samples, which were sent before and are sent to them alone.
    #[must_use]
    pub fn keeps_samples(&self) -> bool {
        self.qos.durability != "VOLATILE"
    }
}

impl From<&TopicFacts> for Announced {
    fn from(facts: &TopicFacts) -> Self {
        Self {
            message_types: facts.message_types.clone(),
            type_hashes: facts.type_hashes.clone(),
            publishers: facts.publishers.iter().map(Publisher::from).collect(),
            subscriptions: facts.subscriptions.iter().map(|_| Subscriber {}).collect(),
        }
    }
}

impl From<&EndpointFacts> for Publisher {
    fn from(facts: &EndpointFacts) -> Self {
        Self {
            guid: facts.guid.to_string(),
            qos: QosFacts {
                reliability: facts.reliability.clone(),
                durability: facts.durability.clone(),
                history: facts.history.clone(),
                deadline_seconds: facts.deadline_nanoseconds.map(seconds),
                lifespan_seconds: facts.lifespan_nanoseconds.map(seconds),
                liveliness: facts.liveliness.clone(),
                liveliness_lease_seconds: facts.liveliness_lease_nanoseconds.map(seconds),
            },
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_api_tells_what_a_bag_says_of_publishers() {
        let json = r#"{"message_types": ["std_msgs/msg/String"], "type_hashes": [], "name": "/x",
            "subscriptions": [{"guid": "a"}],
            "publishers": [{"guid": "0110.1", "node": "/n", "qos": {"reliability": "BEST_EFFORT",
                "durability": "TRANSIENT_LOCAL", "history": "KEEP_LAST (5)",
                "deadline_seconds": 0.1, "lifespan_seconds": null, "liveliness": "AUTOMATIC",
                "liveliness_lease_seconds": null, "ownership": "SHARED", "partitions": []}}]}"#;
        let announced: Announced = serde_json::from_str(json).unwrap();
        let publisher = &announced.publishers[0];
        assert!(publisher.keeps_samples() && announced.subscriptions.len() == 1);
        assert_eq!(publisher.qos.history, "KEEP_LAST (5)");
    }
}
