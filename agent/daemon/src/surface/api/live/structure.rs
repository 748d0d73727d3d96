//! The graph of the stream. It changes rarely, and the rows of values refer to its numbers.

use std::borrow::Cow;
use std::collections::{BTreeMap, HashMap, HashSet};
use std::hash::Hash;

use ros2probe_wire::{DomainId, EntityId, Guid};

use super::super::endpoint::{texts, vendor};
use super::super::index::Index;
use crate::watches::{ActiveWatches, Origin};
use ros2probe_api::live::{Endpoint, Graph, Node, Participant, Topic};
use ros2probe_capture::cgroup_paths::container_or_service;
use ros2probe_model::facts::topic_kind::TopicKind;
use ros2probe_model::report::snapshot::{EndpointFacts, Snapshot, TopicFacts};

/// Numbers that identify entities within the streams.
#[derive(Debug, Default)]
pub(super) struct Ids {
    participants: Numbers<Guid>,
    nodes: Numbers<(DomainId, String)>,
    topics: Numbers<(DomainId, String)>,
}

/// The number of each key; numbers increase and are never reused.
#[derive(Debug)]
struct Numbers<K> {
    last: u32,
    known: HashMap<K, (u32, u64)>,
}

impl<K> Default for Numbers<K> {
    fn default() -> Self {
        Self {
            last: 0,
            known: HashMap::new(),
        }
    }
}

impl<K: Eq + Hash> Numbers<K> {
    /// Returns the number of `key` and marks it as present in this round.
    fn number(&mut self, key: K, round: u64) -> u32 {
        let last = &mut self.last;
        let (number, seen) = self.known.entry(key).or_insert_with(|| {
            *last += 1;
            (*last, round)
        });
        *seen = round;
        *number
    }

    /// Removes keys that are not present in this round.
    fn forget(&mut self, round: u64) {
        self.known.retain(|_, (_, seen)| *seen == round);
    }
}

impl Ids {
    pub(super) fn topic(&self, domain_id: DomainId, dds_name: &str) -> Option<u32> {
        let key = (domain_id, dds_name.to_owned());
        self.topics.known.get(&key).map(|(number, _)| *number)
    }

    /// Returns the numbers of all topics.
    pub(super) fn topics(&self) -> HashSet<u32> {
        self.topics
            .known
            .values()
            .map(|(number, _)| *number)
            .collect()
    }

    pub(super) fn node(&self, domain_id: DomainId, name: &str) -> Option<u32> {
        let key = (domain_id, name.to_owned());
        self.nodes.known.get(&key).map(|(number, _)| *number)
    }

    /// Returns the current graph; vanished participants, nodes and topics lose their numbers.
    pub(super) fn structure<'a>(
        &mut self,
        snapshot: &'a Snapshot,
        index: &Index<'a>,
        in_force: &ActiveWatches,
        round: u64,
    ) -> Graph<'a> {
        let mut graph = Graph::default();
        for facts in &snapshot.participants {
            let process = &facts.process;
            graph.participants.push(Participant(
                self.participants.number(facts.guid, round),
                facts.guid.to_string(),
                facts.domain_id.0,
                vendor(facts.vendor),
                process.host.as_deref().map(Cow::Borrowed),
                process.id,
                process.name.as_deref().map(Cow::Borrowed),
                process.cgroup.as_deref().map(Cow::Borrowed),
                process.cgroup.as_deref().and_then(container_or_service),
            ));
        }
        let mut nodes: BTreeMap<(DomainId, &str), Vec<u32>> = BTreeMap::new();
        for facts in &snapshot.nodes {
            let participant = self.participants.number(facts.participant, round);
            let participants = nodes.entry((facts.domain_id, &facts.name)).or_default();
            participants.push(participant);
        }
        for ((domain_id, name), participants) in nodes {
            let id = self.nodes.number((domain_id, name.to_owned()), round);
            let hidden = name.split('/').any(|token| token.starts_with('_'));
            graph.nodes.push(Node(
                id,
                domain_id.0,
                name.into(),
                participants,
                hidden.into(),
            ));
        }
        for facts in snapshot.topics.iter().filter(|topic| is_shown(topic)) {
            let key = (facts.domain_id, facts.dds_name.to_string());
            let id = self.topics.number(key, round);
            let watched = watched(facts, index, in_force);
            graph.topics.push(Topic(
                id,
                facts.domain_id.0,
                Cow::Borrowed(&*facts.name),
                Cow::Borrowed(&*facts.dds_name),
                facts.kind.label().into(),
                texts(&facts.message_types),
                facts.hidden.into(),
                facts.vanished.into(),
                is_measured(facts, index).into(),
                watched,
            ));
            for endpoint in &facts.publishers {
                let row = self.endpoint(id, facts.domain_id.0, endpoint, round);
                graph.publishers.push(row);
            }
            for endpoint in &facts.subscriptions {
                let row = self.endpoint(id, facts.domain_id.0, endpoint, round);
                graph.subscriptions.push(row);
            }
        }
        self.participants.forget(round);
        self.nodes.forget(round);
        self.topics.forget(round);
        graph
    }

    fn endpoint<'a>(
        &mut self,
        topic: u32,
        domain_id: u32,
        facts: &'a EndpointFacts,
        round: u64,
    ) -> Endpoint<'a> {
        let node = facts.node.as_deref();
        let node = node.map_or(0, |name| {
            self.nodes
                .number((DomainId(domain_id), name.to_owned()), round)
        });
        let participant = Guid::new(facts.guid.prefix, EntityId::PARTICIPANT);
        Endpoint(
            topic,
            node,
            self.participants.number(participant, round),
            facts.guid.to_string(),
            facts.transports,
            Cow::Borrowed(facts.qos.reliability.label()),
            Cow::Borrowed(facts.qos.durability.label()),
        )
    }
}

/// Returns whether the page shows the topic.
pub(in super::super) fn is_shown(topic: &TopicFacts) -> bool {
    !matches!(
        topic.kind,
        TopicKind::ServiceRequest | TopicKind::ServiceReply | TopicKind::Discovery
    )
}

/// Returns whether the topic is measured at present for a watch or subscription.
pub(super) fn is_measured<'a>(topic: &'a TopicFacts, index: &Index<'a>) -> bool {
    topic.is_read || !index.watches(topic).is_empty()
}

/// Returns the origins of the topic's watches, encoded as in [`Topic`].
fn watched<'a>(topic: &'a TopicFacts, index: &Index<'a>, in_force: &ActiveWatches) -> u8 {
    let (mut own, mut glob) = (0, 0);
    for (watch, _) in index.watches(topic) {
        if *watch.watch.pattern != *topic.name {
            glob = 4;
            continue;
        }
        let entry = in_force.find(&watch.watch.pattern, watch.watch.domain_id.map(|id| id.0));
        own = entry.map_or(own, |entry| match entry.origin {
            Origin::Config => 1,
            Origin::CommandLine => 2,
            Origin::Api => 3,
        });
    }
    own | glob
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_forgotten_number_is_never_used_again() {
        let mut numbers = Numbers::default();
        assert_eq!((numbers.number("a", 1), numbers.number("b", 1)), (1, 2));
        assert_eq!(numbers.number("a", 2), 1);
        numbers.forget(2);
        assert_eq!((numbers.number("c", 3), numbers.number("b", 3)), (3, 4));
    }
}
