//! Notes in the final report about messages that were sent before, were not observed, or belong to
//! another domain.

use std::collections::{BTreeMap, HashSet};

use super::{Recorder, TopicDecision};
use crate::recording::graph::GraphSnapshot;
use ros2probe_api::recording_report::OtherDomain;

impl Recorder<'_> {
    /// Notes publishers with stored samples for late joiners whose first samples are not in the
    /// bag.
    pub(super) fn note_what_was_sent_before(&mut self, graph: &GraphSnapshot) {
        let mut names: Vec<String> = Vec::new();
        for topic in graph
            .topics
            .iter()
            .filter(|topic| topic.domain_id == self.domain_id)
        {
            let Some(TopicDecision::Recorded(taken)) = self.topics.get(&topic.name) else {
                continue;
            };
            let begun: HashSet<String> = taken
                .first
                .iter()
                .filter(|(_, first)| first.0 <= 1)
                .map(|(writer, _)| writer.to_string())
                .collect();
            if topic
                .durable_publishers
                .iter()
                .any(|keeper| !begun.contains(keeper))
            {
                names.push(topic.name.clone());
            }
        }
        names.sort();
        self.report.sent_before = names;
    }

    /// Notes topics that would have been recorded if they had been visible, announced, or in this
    /// domain.
    pub(super) fn note_what_was_not_observed(&mut self, graph: GraphSnapshot) {
        let mut domains: BTreeMap<u32, OtherDomain> = BTreeMap::new();
        self.report.unobserved = self.unobserved(&graph);
        for topic in graph.topics {
            if topic.domain_id == self.domain_id || !self.takes(&topic) {
                continue;
            }
            let domain = domains.entry(topic.domain_id).or_default();
            domain.domain_id = topic.domain_id;
            domain.topics += 1;
            if let Some(messages) = topic.messages {
                let before = self.before.topics.get(&(topic.domain_id, topic.name));
                let new = messages.saturating_sub(before.copied().unwrap_or(0));
                *domain.messages.get_or_insert(0) += new;
            }
        }
        self.report.other_domains = domains.into_values().collect();
        for (writer, messages) in graph.unknown_writers {
            let before = self.before.unknown_writers.get(&writer);
            let new = messages.saturating_sub(before.copied().unwrap_or(0));
            if new > 0 {
                self.report.unknown_writers.writers += 1;
                self.report.unknown_writers.messages += new;
            }
        }
    }
}
