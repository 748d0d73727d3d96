//! What discovery says of topics, as far as a bag or its report says it: from a snapshot within the
//! agent, from the API's JSON where a client records.

use std::collections::HashMap;

use serde::Deserialize;

use crate::subscriptions::line::{QosFacts, seconds};
use ros2probe_model::snapshot::{EndpointFacts, Snapshot, TopicFacts, Transport};
use ros2probe_model::topic_kind::TopicKind;

const VOLATILE: &str = "VOLATILE";

/// The API's `/topics`: what is announced of all topics.
#[derive(Clone, Debug, Default, Deserialize)]
pub struct Graph {
    topics: Vec<GraphTopic>,
}

/// One of them, as the API's `/topics/{topic}` says it, too.
#[derive(Clone, Debug, Deserialize)]
pub struct GraphTopic {
    domain_id: u32,
    name: String,
    dds_name: String,
    kind: String,
    #[serde(default)]
    passages: Vec<PassagePairs>,
    #[serde(default)]
    measurement: Option<Counted>,
    #[serde(flatten)]
    announced: DiscoveredTopic,
}

#[derive(Clone, Debug, Deserialize)]
struct PassagePairs {
    passage: String,
    pairs: usize,
}

#[derive(Clone, Copy, Debug, Deserialize)]
struct Counted {
    messages: u64,
}

impl GraphTopic {
    fn is_ros_topic(&self) -> bool {
        TopicKind::parse(&self.kind).is_none_or(TopicKind::is_ros_topic)
    }
}

/// The API's `/participants`: who sends without having been announced.
#[derive(Clone, Debug, Default, Deserialize)]
pub struct UnknownWriterList {
    unknown_writers: Vec<UnknownWriter>,
}

#[derive(Clone, Debug, Deserialize)]
struct UnknownWriter {
    guid: String,
    measurement: Counted,
}

/// The graph at one moment, as far as a report compares two of them.
#[derive(Clone, Debug, Default)]
pub struct GraphSnapshot {
    /// ROS topics that somebody publishes.
    pub topics: Vec<PublishedTopic>,
    /// Messages of each writer that was never announced, by its GUID.
    pub unknown_writers: HashMap<String, u64>,
}

/// A published topic.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct PublishedTopic {
    /// Its domain.
    pub domain_id: u32,
    /// ROS name.
    pub name: String,
    /// ROS types.
    pub message_types: Vec<String>,
    /// Somebody subscribes to it.
    pub subscribed: bool,
    /// How messages pass between most pairs, where none of them uses the network.
    pub other_transport: Option<String>,
    /// Publishers that late joiners are given samples of.
    pub durable_publishers: Vec<String>,
    /// Messages counted so far; `None` where it is not measured.
    pub messages: Option<u64>,
}

impl From<GraphTopic> for Graph {
    fn from(topic: GraphTopic) -> Self {
        let topics = vec![topic];
        Self { topics }
    }
}

impl Graph {
    /// Of one domain, by the names that messages bear: ROS names of topics, else DDS names.
    #[must_use]
    pub fn by_name(self, domain_id: u32) -> HashMap<String, DiscoveredTopic> {
        let topics = self.topics.into_iter();
        let topics = topics.filter(|topic| topic.domain_id == domain_id);
        let topics = topics.map(|topic| {
            let name = if topic.is_ros_topic() {
                topic.name
            } else {
                topic.dds_name
            };
            (name, topic.announced)
        });
        topics.collect()
    }

    /// With those who send unannounced.
    #[must_use]
    pub fn into_snapshot(self, unknown_writers: UnknownWriterList) -> GraphSnapshot {
        let topics = self.topics.into_iter();
        let topics = topics
            .filter(|topic| topic.is_ros_topic() && !topic.announced.publishers.is_empty())
            .map(|topic| {
                let passages = topic.passages.iter();
                let passages = passages.map(|each| (each.passage.as_str(), each.pairs));
                let publishers = topic.announced.publishers.iter();
                let durable_publishers = publishers.filter(|publisher| publisher.is_durable());
                PublishedTopic {
                    domain_id: topic.domain_id,
                    other_transport: other_transport(passages).map(str::to_owned),
                    durable_publishers: durable_publishers
                        .map(|publisher| publisher.guid.clone())
                        .collect(),
                    name: topic.name,
                    message_types: topic.announced.message_types,
                    subscribed: !topic.announced.subscriptions.is_empty(),
                    messages: topic.measurement.map(|counted| counted.messages),
                }
            });
        let unknown_writers = unknown_writers.unknown_writers.into_iter();
        GraphSnapshot {
            topics: topics.collect(),
            unknown_writers: unknown_writers
                .map(|stranger| (stranger.guid, stranger.measurement.messages))
                .collect(),
        }
    }
}

impl From<&Snapshot> for GraphSnapshot {
    fn from(snapshot: &Snapshot) -> Self {
        let topics = snapshot.topics.iter();
        let topics =
            topics.filter(|topic| topic.kind.is_ros_topic() && !topic.publishers.is_empty());
        let unknown_writers = snapshot.unknown_writers.iter();
        Self {
            topics: topics.map(PublishedTopic::from).collect(),
            unknown_writers: unknown_writers
                .map(|stranger| (stranger.guid.to_string(), stranger.measurement.messages))
                .collect(),
        }
    }
}

impl From<&TopicFacts> for PublishedTopic {
    fn from(facts: &TopicFacts) -> Self {
        let passages = facts.transports.iter();
        let passages = passages.map(|count| (count.transport.label(), count.pairs));
        let publishers = facts.publishers.iter();
        let durable_publishers = publishers.filter(|publisher| publisher.durability != VOLATILE);
        Self {
            domain_id: facts.domain_id.0,
            name: facts.name.clone(),
            message_types: facts.message_types.clone(),
            subscribed: !facts.subscriptions.is_empty(),
            other_transport: other_transport(passages).map(str::to_owned),
            durable_publishers: durable_publishers
                .map(|publisher| publisher.guid.to_string())
                .collect(),
            messages: facts.measurement.as_ref().map(|measured| measured.messages),
        }
    }
}

fn other_transport<'a>(
    passages: impl Iterator<Item = (&'a str, usize)> + Clone,
) -> Option<&'a str> {
    let network = Transport::Network.label();
    if passages.clone().any(|(passage, _)| passage == network) {
        return None;
    }
    let most = passages.max_by_key(|(_, pairs)| *pairs);
    most.map(|(passage, _)| passage)
}

/// A topic at the moment in which it is taken into a bag.
#[derive(Clone, Debug, Default, Deserialize)]
pub struct DiscoveredTopic {
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
    pub fn is_durable(&self) -> bool {
        self.qos.durability != VOLATILE
    }
}

impl From<&TopicFacts> for DiscoveredTopic {
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
        let announced: DiscoveredTopic = serde_json::from_str(json).unwrap();
        let publisher = &announced.publishers[0];
        assert!(publisher.is_durable() && announced.subscriptions.len() == 1);
        assert_eq!(publisher.qos.history, "KEEP_LAST (5)");
    }
}
