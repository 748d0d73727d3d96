//! Facts about topics for a bag and its report: from a snapshot within the agent, or from an
//! agent's responses in a client.

use std::collections::HashMap;

use ros2probe_api::endpoints::Endpoint;
use ros2probe_api::latched::Latched;
use ros2probe_api::participants::UnknownWriter;
use ros2probe_api::samples::OfferedQos;
use ros2probe_api::topics::Topic;
use ros2probe_model::facts::topic_kind::TopicKind;
use ros2probe_model::report::snapshot::{EndpointFacts, Snapshot, TopicFacts, Transport};
use ros2probe_wire::qos::Durability;

use crate::agent_facts::Ability;
use crate::latched::latched;
use crate::snapshot_cell::State;

const VOLATILE_DURABILITY: &str = "VOLATILE";

/// The graph at one moment; a report compares two of them.
#[derive(Clone, Debug, Default)]
pub struct GraphSnapshot {
    /// ROS topics with a publisher.
    pub topics: Vec<PublishedTopic>,
    /// Messages of each writer that was never announced, by its GUID.
    pub unknown_writers: HashMap<String, u64>,
}

/// A published topic.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct PublishedTopic {
    /// Domain of the topic.
    pub domain_id: u32,
    /// ROS name.
    pub name: String,
    /// ROS types.
    pub message_types: Vec<String>,
    /// Whether it has a subscriber.
    pub subscribed: bool,
    /// Transport of most pairs of writer and reader, if no pair uses the network.
    pub other_transport: Option<String>,
    /// Whether every message in shared memory is captured now.
    pub is_exact: bool,
    /// Publishers that send stored samples to late joiners.
    pub durable_publishers: Vec<DurablePublisher>,
    /// Messages counted so far; `None` if the topic is not measured.
    pub messages: Option<u64>,
}

/// A publisher that sends stored samples to late joiners.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct DurablePublisher {
    /// GUID.
    pub guid: String,
    /// State of its last message, if the agent retains such messages.
    pub latched: Option<Latched>,
}

/// Returns the topics of one domain by name: the ROS name of a ROS topic, otherwise the DDS name.
#[must_use]
pub fn by_name(topics: &[Topic<'_>], domain_id: u32) -> HashMap<String, DiscoveredTopic> {
    let topics = topics.iter();
    let topics = topics.filter(|topic| topic.domain_id == domain_id);
    let topics = topics.map(|topic| {
        let name = if is_ros_topic(&topic.kind) {
            &topic.name
        } else {
            &topic.dds_name
        };
        (name.to_string(), topic.into())
    });
    topics.collect()
}

impl GraphSnapshot {
    /// Returns the graph from an agent's responses.
    #[must_use]
    pub fn answered(topics: &[Topic<'_>], unknown_writers: Vec<UnknownWriter<'_>>) -> Self {
        let topics = topics.iter();
        let topics =
            topics.filter(|topic| is_ros_topic(&topic.kind) && !topic.publishers.is_empty());
        let unknown_writers = unknown_writers.into_iter();
        Self {
            topics: topics.map(PublishedTopic::from).collect(),
            unknown_writers: unknown_writers
                .map(|writer| (writer.guid, writer.measurement.messages))
                .collect(),
        }
    }
}

impl From<&State> for GraphSnapshot {
    fn from(state: &State) -> Self {
        let mut graph = Self::from(state.known());
        let is_exact = state.agent.abilities.contains(&Ability::SharedMemoryExact);
        for topic in &mut graph.topics {
            topic.is_exact = is_exact;
        }
        graph
    }
}

impl From<&Topic<'_>> for PublishedTopic {
    fn from(topic: &Topic<'_>) -> Self {
        let passages = topic.passages.iter();
        let passages = passages.map(|each| (each.passage.as_ref(), each.pairs));
        let publishers = topic.publishers.iter();
        let durable_publishers =
            publishers.filter(|publisher| publisher.qos.durability != VOLATILE_DURABILITY);
        Self {
            domain_id: topic.domain_id,
            name: topic.name.to_string(),
            message_types: to_texts(&topic.message_types),
            subscribed: !topic.subscriptions.is_empty(),
            other_transport: other_transport(passages).map(str::to_owned),
            is_exact: topic
                .passages
                .iter()
                .any(|each| each.view.as_deref() == Some("exact")),
            durable_publishers: durable_publishers
                .map(|publisher| DurablePublisher {
                    guid: publisher.guid.clone(),
                    latched: publisher.latched.clone(),
                })
                .collect(),
            messages: topic.measurement.as_ref().map(|measured| measured.messages),
        }
    }
}

/// Returns whether the topic has a ROS name. Kinds unknown to this version count as ROS topics.
fn is_ros_topic(kind: &str) -> bool {
    TopicKind::parse(kind).is_none_or(TopicKind::is_ros_topic)
}

/// Returns each value as displayed text.
fn to_texts<T: ToString>(texts: &[T]) -> Vec<String> {
    texts.iter().map(ToString::to_string).collect()
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
        let durable_publishers =
            publishers.filter(|publisher| publisher.qos.durability != Durability::VOLATILE);
        Self {
            domain_id: facts.domain_id.0,
            name: facts.name.to_string(),
            message_types: to_texts(&facts.message_types),
            subscribed: !facts.subscriptions.is_empty(),
            other_transport: other_transport(passages).map(str::to_owned),
            is_exact: false,
            durable_publishers: durable_publishers
                .map(|publisher| DurablePublisher {
                    guid: publisher.guid.to_string(),
                    latched: publisher.latched.map(latched),
                })
                .collect(),
            messages: facts.measurement.as_ref().map(|measured| measured.messages),
        }
    }
}

fn other_transport<'a>(
    passages: impl Iterator<Item = (&'a str, usize)> + Clone,
) -> Option<&'a str> {
    let networks = Transport::ALL.into_iter().filter(|each| each.is_network());
    let networks: Vec<_> = networks.map(Transport::label).collect();
    if passages
        .clone()
        .any(|(passage, _)| networks.contains(&passage))
    {
        return None;
    }
    let most = passages.max_by_key(|(_, pairs)| *pairs);
    most.map(|(passage, _)| passage)
}

/// Facts about a topic at the moment it is added to a bag.
#[derive(Clone, Debug, Default)]
pub struct DiscoveredTopic {
    /// ROS types announced on the topic.
    pub message_types: Vec<String>,
    /// RIHS01 hashes announced on the topic.
    pub type_hashes: Vec<String>,
    /// Writers of the topic.
    pub publishers: Vec<Publisher>,
    /// Whether it has a reader.
    pub subscribed: bool,
}

/// One writer.
#[derive(Clone, Debug)]
pub struct Publisher {
    /// GUID as in the metrics.
    pub guid: String,
    /// Hash of its complete type in XTypes, if announced.
    pub equivalence_hash: Option<String>,
    /// Offered QoS.
    pub qos: OfferedQos,
}

impl Publisher {
    /// Returns whether late joiners receive its last samples, which were sent earlier and are
    /// repeated only to late joiners.
    #[must_use]
    pub fn is_durable(&self) -> bool {
        self.qos.durability != VOLATILE_DURABILITY
    }
}

impl From<&TopicFacts> for DiscoveredTopic {
    fn from(facts: &TopicFacts) -> Self {
        Self {
            message_types: to_texts(&facts.message_types),
            type_hashes: to_texts(&facts.type_hashes),
            publishers: facts.publishers.iter().map(Publisher::from).collect(),
            subscribed: !facts.subscriptions.is_empty(),
        }
    }
}

impl From<&Topic<'_>> for DiscoveredTopic {
    fn from(topic: &Topic<'_>) -> Self {
        Self {
            message_types: to_texts(&topic.message_types),
            type_hashes: to_texts(&topic.type_hashes),
            publishers: topic.publishers.iter().map(Publisher::from).collect(),
            subscribed: !topic.subscriptions.is_empty(),
        }
    }
}

impl From<&Endpoint<'_>> for Publisher {
    fn from(endpoint: &Endpoint<'_>) -> Self {
        let qos = &endpoint.qos;
        Self {
            guid: endpoint.guid.clone(),
            equivalence_hash: endpoint.equivalence_hash.as_deref().map(str::to_owned),
            qos: OfferedQos {
                reliability: qos.reliability.to_string(),
                durability: qos.durability.to_string(),
                history: qos.history.to_string(),
                deadline_seconds: qos.deadline_seconds,
                lifespan_seconds: qos.lifespan_seconds,
                liveliness: qos.liveliness.to_string(),
                liveliness_lease_seconds: qos.liveliness_lease_seconds,
            },
        }
    }
}

impl From<&EndpointFacts> for Publisher {
    fn from(facts: &EndpointFacts) -> Self {
        let qos = &facts.qos;
        Self {
            guid: facts.guid.to_string(),
            equivalence_hash: facts.equivalence_hash.map(|hash| hash.to_string()),
            qos: OfferedQos {
                reliability: qos.reliability.to_string(),
                durability: qos.durability.to_string(),
                history: facts.history(),
                deadline_seconds: qos.deadline.seconds(),
                lifespan_seconds: qos.lifespan.seconds(),
                liveliness: qos.liveliness.to_string(),
                liveliness_lease_seconds: qos.liveliness_lease.seconds(),
            },
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn publishers_in_a_response_of_the_api_have_the_qos_for_a_bag() {
        let json = r#"{"message_types": ["std_msgs/msg/String"], "type_hashes": [], "name": "/x",
            "subscriptions": [{"guid": "a"}],
            "publishers": [{"guid": "0110.1", "node": "/n", "qos": {"reliability": "BEST_EFFORT",
                "durability": "TRANSIENT_LOCAL", "history": "KEEP_LAST (5)",
                "deadline_seconds": 0.1, "lifespan_seconds": null, "liveliness": "AUTOMATIC",
                "liveliness_lease_seconds": null, "ownership": "SHARED", "partitions": []}}]}"#;
        let topic: Topic<'_> = serde_json::from_str(json).unwrap();
        let announced = DiscoveredTopic::from(&topic);
        let publisher = &announced.publishers[0];
        assert!(publisher.is_durable() && announced.subscribed);
        assert_eq!(publisher.qos.history, "KEEP_LAST (5)");
    }
}
