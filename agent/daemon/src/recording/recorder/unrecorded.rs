//! Parts of the final report about messages that were sent before the recording, were not observed,
//! or belong to another domain.

use std::collections::{BTreeMap, HashMap};

use super::{Recorder, TopicDecision};
use crate::recording::graph::{DurablePublisher, GraphSnapshot};
use ros2probe_api::latched::Latched;
use ros2probe_api::recording_report::OtherDomain;

impl Recorder<'_> {
    /// Reports topics with a durable publisher whose stored samples may be missing in the bag. They
    /// are not missing if the bag has its first sample, or any sample while the agent retains the
    /// last one.
    pub(super) fn note_what_was_sent_before(&mut self, graph: &GraphSnapshot) {
        let topics = graph.topics.iter();
        let mut names: Vec<String> = Vec::new();
        for topic in topics.filter(|topic| topic.domain_id == self.domain_id) {
            let Some(TopicDecision::Recorded(taken)) = self.topics.get(&topic.name) else {
                continue;
            };
            let first: HashMap<String, u64> = taken
                .first
                .iter()
                .map(|(writer, first)| (writer.to_string(), first.0))
                .collect();
            let is_missing = |publisher: &&DurablePublisher| {
                let is_kept = publisher.latched.as_ref().is_some_and(Latched::is_kept);
                let first = first.get(&publisher.guid);
                first.is_none_or(|number| *number > 1 && !is_kept)
            };
            if let Some(missing) = topic.durable_publishers.iter().find(is_missing) {
                names.push(topic.name.clone());
                if let Some(latched) = &missing.latched {
                    let report = &mut self.report.latched;
                    report.insert(topic.name.clone(), latched.clone());
                }
            }
        }
        names.sort();
        self.report.sent_before = names;
    }

    /// Reports topics that would have been recorded if they had been visible, announced, or in this
    /// domain.
    pub(super) fn note_what_was_not_observed(&mut self, graph: GraphSnapshot) {
        let mut domains: BTreeMap<u32, OtherDomain> = BTreeMap::new();
        self.report.unobserved = self.unobserved_topics(&graph);
        for topic in graph.topics {
            if topic.domain_id == self.domain_id || !self.is_selected(&topic) {
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
