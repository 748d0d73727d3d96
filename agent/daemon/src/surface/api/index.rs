//! Lookup tables of one snapshot, built once per answer.

use std::collections::HashMap;

use ros2probe_wire::{DomainId, Guid, GuidPrefix};

use ros2probe_model::facts::diagnosis::Diagnosis;
use ros2probe_model::report::snapshot::{
    EndpointFacts, ParticipantFacts, PeerClock, Snapshot, TopicFacts, WatchFacts, WatchedTopicFacts,
};

/// A watchlist entry and the state of a topic under it.
pub(super) type WatchedTopic<'a> = (&'a WatchFacts, &'a WatchedTopicFacts);

/// The lookup tables of an answer.
#[derive(Debug)]
pub(super) struct Index<'a> {
    participants: HashMap<GuidPrefix, &'a ParticipantFacts>,
    clocks: HashMap<GuidPrefix, &'a PeerClock>,
    findings: HashMap<(DomainId, &'a str), Vec<&'a Diagnosis>>,
    watches: HashMap<(DomainId, &'a str), Vec<WatchedTopic<'a>>>,
}

/// Endpoints with their topics, by GUID.
#[derive(Debug)]
pub(super) struct Ends<'a>(HashMap<Guid, (&'a TopicFacts, &'a EndpointFacts)>);

impl<'a> Index<'a> {
    pub(super) fn new(snapshot: &'a Snapshot) -> Self {
        let participants = snapshot.participants.iter();
        let mut findings: HashMap<_, Vec<_>> = HashMap::new();
        for finding in &snapshot.diagnoses.list {
            if let Some(topic) = finding.topic() {
                let key = (topic.domain_id, &*topic.dds_name);
                findings.entry(key).or_default().push(finding);
            }
        }
        let mut watches: HashMap<_, Vec<_>> = HashMap::new();
        for watch in &snapshot.watches {
            for topic in &watch.topics {
                let key = (topic.domain_id, topic.topic.as_str());
                watches.entry(key).or_default().push((watch, topic));
            }
        }
        Self {
            participants: participants.map(|each| (each.guid.prefix, each)).collect(),
            clocks: snapshot.peer_clocks(),
            findings,
            watches,
        }
    }

    pub(super) fn participant(&self, guid: Guid) -> Option<&'a ParticipantFacts> {
        self.participants.get(&guid.prefix).copied()
    }

    /// Returns what is known of the clock of the host of an endpoint; `None` for this host, and if
    /// clocks are not compared.
    pub(super) fn clock(&self, guid: Guid) -> Option<&'a PeerClock> {
        self.clocks.get(&guid.prefix).copied()
    }

    /// Returns the problems of a topic.
    pub(super) fn findings(&self, topic: &'a TopicFacts) -> &[&'a Diagnosis] {
        let found = self
            .findings
            .get(&(topic.domain_id, topic.dds_name.as_str()));
        found.map_or(&[], Vec::as_slice)
    }

    /// Returns the watchlist entries that cover a topic. Request and reply topics share the name of
    /// their service, so entries apply only to measured topics.
    pub(super) fn watches(&self, topic: &'a TopicFacts) -> &[WatchedTopic<'a>] {
        if topic.measurement.is_none() {
            return &[];
        }
        let found = self.watches.get(&(topic.domain_id, topic.name.as_str()));
        found.map_or(&[], Vec::as_slice)
    }
}

impl<'a> Ends<'a> {
    pub(super) fn new(snapshot: &'a Snapshot) -> Self {
        let mut ends = HashMap::new();
        for topic in &snapshot.topics {
            for endpoint in topic.publishers.iter().chain(&topic.subscriptions) {
                ends.insert(endpoint.guid, (topic, endpoint));
            }
        }
        Self(ends)
    }

    pub(super) fn endpoint(&self, guid: Guid) -> Option<(&'a TopicFacts, &'a EndpointFacts)> {
        self.0.get(&guid).copied()
    }
}
