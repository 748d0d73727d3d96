//! What discovery says of a topic, as far as a bag says it: from a snapshot within the agent, from
//! the API's JSON where a client records.

use ros2probe_wire::Duration;
use ros2probe_wire::qos::{Durability, History, HistoryKind, Liveliness, Qos, Reliability, Role};
use ros2probe_wire::rtps::VendorId;
use serde::Deserialize;

use crate::model::snapshot::{EndpointFacts, TopicFacts};

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
    pub qos: Offered,
}

/// One reader; that there is one is all that matters.
#[derive(Clone, Debug, Deserialize)]
pub struct Subscriber {}

/// Quality of service in ROS's words; durations in seconds, `None` = infinite.
#[derive(Clone, Debug, Deserialize)]
pub struct Offered {
    reliability: String,
    durability: String,
    history: String,
    deadline_seconds: Option<f64>,
    lifespan_seconds: Option<f64>,
    liveliness: String,
    liveliness_lease_seconds: Option<f64>,
}

impl Publisher {
    /// Late joiners are given its last samples, which were sent before and are sent to them alone.
    #[must_use]
    pub fn keeps_samples(&self) -> bool {
        durability(&self.qos.durability) != Durability::VOLATILE
    }
}

impl Offered {
    /// As policies; what has no word stays unknown.
    #[must_use]
    pub fn qos(&self) -> Qos {
        let unknown = u32::MAX;
        Qos {
            reliability: match self.reliability.as_str() {
                "RELIABLE" => Reliability::RELIABLE,
                "BEST_EFFORT" => Reliability::BEST_EFFORT,
                _ => Reliability(unknown),
            },
            durability: durability(&self.durability),
            history: history(&self.history),
            deadline: duration(self.deadline_seconds),
            lifespan: duration(self.lifespan_seconds),
            liveliness: match self.liveliness.as_str() {
                "AUTOMATIC" => Liveliness::AUTOMATIC,
                "MANUAL_BY_PARTICIPANT" => Liveliness::MANUAL_BY_PARTICIPANT,
                "MANUAL_BY_TOPIC" => Liveliness::MANUAL_BY_TOPIC,
                _ => Liveliness(unknown),
            },
            liveliness_lease: duration(self.liveliness_lease_seconds),
            ..Qos::defaults(Role::Writer, VendorId([0, 0]))
        }
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
            qos: Offered {
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

fn durability(word: &str) -> Durability {
    match word {
        "VOLATILE" => Durability::VOLATILE,
        "TRANSIENT_LOCAL" => Durability::TRANSIENT_LOCAL,
        "TRANSIENT" => Durability::TRANSIENT,
        "PERSISTENT" => Durability::PERSISTENT,
        _ => Durability(u32::MAX),
    }
}

fn history(words: &str) -> Option<History> {
    if words == "KEEP_ALL" {
        let kind = HistoryKind::KEEP_ALL;
        return Some(History { kind, depth: 0 });
    }
    let depth = words.strip_prefix("KEEP_LAST (")?.strip_suffix(')')?;
    Some(History {
        kind: HistoryKind::KEEP_LAST,
        depth: depth.parse().ok()?,
    })
}

fn duration(seconds: Option<f64>) -> Duration {
    let Some(seconds) = seconds else {
        return Duration::Infinite;
    };
    let duration = std::time::Duration::try_from_secs_f64(seconds).ok();
    let nanoseconds = duration.and_then(|duration| u64::try_from(duration.as_nanos()).ok());
    nanoseconds.map_or(Duration::Infinite, Duration::Finite)
}

#[expect(
    clippy::cast_precision_loss,
    reason = "durations of QoS are given in milliseconds"
)]
fn seconds(nanoseconds: u64) -> f64 {
    nanoseconds as f64 / 1e9
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
        assert!(publisher.keeps_samples());
        let qos = publisher.qos.qos();
        assert_eq!(qos.reliability, Reliability::BEST_EFFORT);
        assert_eq!(qos.durability, Durability::TRANSIENT_LOCAL);
        let history = qos.history.unwrap();
        assert_eq!((history.kind, history.depth), (HistoryKind::KEEP_LAST, 5));
        assert_eq!(qos.deadline, Duration::Finite(100_000_000));
        assert_eq!(qos.lifespan, Duration::Infinite);
    }

    #[test]
    fn what_was_not_announced_stays_unknown() {
        assert_eq!(history("UNKNOWN"), None);
        assert_eq!(history("KEEP_LAST (x)"), None);
        assert_eq!(history("KEEP_ALL").unwrap().kind, HistoryKind::KEEP_ALL);
        assert_eq!(duration(Some(-1.0)), Duration::Infinite);
        assert_eq!(durability("?").name(), None);
    }
}
