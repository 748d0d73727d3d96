//! The last message of topics whose fields have metrics. The surfaces decode them when they need a
//! value.

use std::sync::Arc;

use foldhash::HashMap;
use ros2probe_wire::{DomainId, Guid};

use super::Origin;
use crate::facts::bounded::{Bounded, Counted, Sum, TableFacts};
use crate::facts::dispatch::definition_hash;
use crate::facts::model_time::ModelTime;
use crate::facts::names::{TopicName, TypeName};
use crate::facts::tables::{FieldBytes, FieldMessages};
use crate::graph::discovery::Discovery;

/// `sensor_msgs/msg/BatteryState`, whose fields have metrics on every robot.
pub const BATTERY_TYPE: &str = "sensor_msgs/msg/BatteryState";

/// The last message of each writer.
#[derive(Debug, Default)]
pub(super) struct Fields {
    /// Topics of the configuration.
    topics: Arc<Vec<TopicName>>,
    last: Bounded<Counted<FieldMessages>, HashMap<Guid, LastMessage>>,
    bytes: Sum<Counted<FieldBytes>>,
}

#[derive(Debug)]
struct LastMessage {
    domain_id: DomainId,
    topic: TopicName,
    at: ModelTime,
    payload: Arc<[u8]>,
}

/// The last message of a writer.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct FieldMessage {
    /// Domain.
    pub domain_id: DomainId,
    /// Topic.
    pub topic: TopicName,
    /// ROS type.
    pub message_type: TypeName,
    /// Hash of the type, as announced.
    pub hash: Option<String>,
    /// Time of its arrival.
    pub at: ModelTime,
    /// Payload with its encapsulation header.
    pub payload: Arc<[u8]>,
}

impl Fields {
    /// Sets the topics of the configuration.
    pub(super) fn expect(&mut self, topics: Arc<Vec<TopicName>>) {
        self.topics = topics;
    }

    /// Returns whether messages of this topic are kept.
    pub(super) fn cover(&self, topic: &TopicName, message_type: &TypeName) -> bool {
        message_type.as_str() == BATTERY_TYPE || self.topics.contains(topic)
    }

    /// Keeps a message instead of the last one of its writer, if there is room.
    pub(super) fn add(&mut self, origin: &Origin<'_>, payload: &[u8]) {
        self.forget(origin.writer);
        if payload.len() > self.bytes.remaining() {
            self.bytes.refuse();
            return;
        }
        let new = || LastMessage {
            domain_id: origin.domain_id,
            topic: origin.topic.clone(),
            at: origin.at,
            payload: payload.into(),
        };
        if self.last.get_or_insert_with(origin.writer, new).is_some() {
            self.bytes.add(payload.len());
        }
    }

    /// Removes the message of a departed writer.
    pub(super) fn forget(&mut self, writer: Guid) {
        if let Some(last) = self.last.remove(&writer) {
            self.bytes.sub(last.payload.len());
        }
    }

    /// Returns the messages, sorted by domain and topic, the latest first.
    pub(super) fn facts(&self, discovery: &Discovery) -> Vec<FieldMessage> {
        let last = self.last.iter().filter_map(|(writer, last)| {
            let endpoint = discovery.endpoints().get(writer)?;
            Some(FieldMessage {
                domain_id: last.domain_id,
                topic: last.topic.clone(),
                message_type: endpoint.message_type.clone(),
                hash: definition_hash(endpoint.type_hash, endpoint.equivalence_hash),
                at: last.at,
                payload: Arc::clone(&last.payload),
            })
        });
        let mut last: Vec<_> = last.collect();
        last.sort_unstable_by(|one, other| {
            let key = |each: &FieldMessage| (each.domain_id, each.topic.clone());
            key(one).cmp(&key(other)).then(other.at.cmp(&one.at))
        });
        last
    }

    pub(super) fn tables(&self) -> [TableFacts; 2] {
        [self.last.facts(), self.bytes.facts()]
    }
}
