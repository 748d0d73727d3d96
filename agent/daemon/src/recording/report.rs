//! What a recording has and what it has not: counted for each topic, with the numbers of what is
//! missing. It stands in the bag's metadata and in the answer of whoever ends the recording.
//!
//! `missing` counts messages of topics of the bag. What belongs to no topic, or never passes where it
//! can be observed, is listed beside it.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

use crate::subscriptions::{Missed, MissedReason};

/// Runs of missing samples that are named; further ones are counted.
const RUNS: usize = 256;
/// Topics that are named in one line.
const NAMES: usize = 8;
/// Nobody subscribes: the one reason in [`Report::unobserved`] by which nothing is missing.
pub(super) const NO_SUBSCRIBER: &str = "no_subscriber";
/// Reasons why no message of a published topic was seen, and what people read.
const UNOBSERVED: [(&str, &str); 5] = [
    (
        NO_SUBSCRIBER,
        "without a subscriber the publisher sends nothing",
    ),
    (
        "shared_memory",
        "publisher and subscriber use shared memory, which was not observed",
    ),
    (
        "data_sharing",
        "subscribers read the publisher's memory (data sharing), which cannot be observed",
    ),
    (
        "same_process",
        "publisher and subscriber share one process; nothing crosses the network",
    ),
    (
        "iceoryx",
        "messages pass through iceoryx, which cannot be observed",
    ),
];
/// Under this name in the bag's custom data.
pub const CUSTOM_DATA: &str = "ros2probe";

/// What became of what was to be recorded.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
#[schema(as = RecordingReport)]
pub struct Report {
    /// Messages in the bag.
    pub messages: u64,
    /// Bytes of those messages.
    pub bytes: u64,
    /// Messages that were sent and are not in the bag.
    pub missing: u64,
    /// By topic.
    pub topics: BTreeMap<String, TopicReport>,
    /// Which messages are missing, by writer and sequence number: the first ones.
    pub missing_runs: Vec<MissingRun>,
    /// Further runs that are counted but not named.
    pub missing_runs_unnamed: u64,
    /// Topics that late joiners are given samples of, which were sent before the recording began and
    /// are not in the bag.
    pub sent_before: Vec<String>,
    /// Topics that are left out because they have several types; a bag holds one.
    pub left_out: Vec<String>,
    /// Published topics without a message in the bag, where the reason is known: `no_subscriber`, or
    /// how all messages pass: `shared_memory`, `data_sharing`, `same_process`, `iceoryx`.
    #[serde(default)]
    pub unobserved: BTreeMap<String, String>,
    /// Writers that sent and were never announced.
    #[serde(default)]
    pub unknown_writers: UnknownWriters,
    /// Topics that the choice would take, in other domains.
    #[serde(default)]
    pub other_domains: Vec<OtherDomain>,
    /// Which limit ended it, if one did.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub limit_reached: Option<String>,
}

/// Writers whose topics are unknown.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
#[schema(as = RecordingUnknownWriters)]
pub struct UnknownWriters {
    /// How many sent.
    pub writers: u64,
    /// Messages they sent while it was recorded.
    pub messages: u64,
}

/// What passed in a domain that is not recorded.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
#[schema(as = RecordingOtherDomain)]
pub struct OtherDomain {
    /// Which one.
    pub domain_id: u32,
    /// Published topics.
    pub topics: u64,
    /// Their messages while it was recorded; null where none of them is measured.
    pub messages: Option<u64>,
}

/// What became of one topic's messages.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
#[schema(as = TopicReport)]
pub struct TopicReport {
    /// In the bag.
    pub messages: u64,
    /// Bytes of those.
    pub bytes: u64,
    /// Never complete on the wire: fragments were lost.
    pub incomplete: u64,
    /// Lost on the way: nothing of them was seen.
    #[serde(default)]
    pub lost: u64,
    /// Came before their writer was announced, and not again.
    #[serde(default)]
    pub unannounced: u64,
    /// On the wire, but lost on the way to the agent.
    pub not_captured: u64,
    /// Dropped because the storage was too slow.
    pub dropped: u64,
    /// Taken, and lost because the storage took no more.
    pub unwritten: u64,
    /// Came while the recording was paused.
    pub paused: u64,
}

/// Consecutive samples of one writer that are missing for one reason.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
#[schema(as = MissingRun)]
pub struct MissingRun {
    /// Topic.
    pub topic: String,
    /// GUID of the writer.
    pub writer: String,
    /// Number of the first.
    pub first_sequence_number: u64,
    /// Number of the last.
    pub last_sequence_number: u64,
    /// How many of those in between.
    pub samples: u64,
    /// `incomplete`, `lost`, `unannounced`, `not_captured` or `dropped`.
    pub reason: String,
}

impl Report {
    /// A message is in the bag.
    pub(super) fn written(&mut self, topic: &str, bytes: usize) {
        let bytes = bytes as u64;
        self.messages += 1;
        self.bytes += bytes;
        let topic = self.topic(topic);
        topic.messages += 1;
        topic.bytes += bytes;
    }

    /// A message came while the recording was paused.
    pub(super) fn paused(&mut self, topic: &str) {
        self.topic(topic).paused += 1;
    }

    /// Messages will never be in the bag.
    pub(super) fn missed(&mut self, missed: &Missed) {
        self.missing += missed.samples;
        let topic = self.topic(&missed.topic.name);
        let (count, reason) = match missed.reason {
            MissedReason::Incomplete => (&mut topic.incomplete, "incomplete"),
            MissedReason::Lost => (&mut topic.lost, "lost"),
            MissedReason::Unannounced => (&mut topic.unannounced, "unannounced"),
            MissedReason::NotCaptured => (&mut topic.not_captured, "not_captured"),
            MissedReason::QueueFull => (&mut topic.dropped, "dropped"),
        };
        *count += missed.samples;
        if self.missing_runs.len() >= RUNS {
            self.missing_runs_unnamed += 1;
            return;
        }
        self.missing_runs.push(MissingRun {
            topic: missed.topic.name.to_string(),
            writer: missed.writer.to_string(),
            first_sequence_number: missed.first,
            last_sequence_number: missed.last,
            samples: missed.samples,
            reason: reason.to_owned(),
        });
    }

    /// Messages that were taken for written are not in the bag after all.
    pub(super) fn unwritten(&mut self, topic: &str, messages: u64, bytes: u64) {
        self.messages = self.messages.saturating_sub(messages);
        self.bytes = self.bytes.saturating_sub(bytes);
        self.missing += messages;
        let topic = self.topic(topic);
        topic.messages = topic.messages.saturating_sub(messages);
        topic.bytes = topic.bytes.saturating_sub(bytes);
        topic.unwritten += messages;
    }

    /// The topic is in the bag, if only by its name.
    pub(super) fn topic(&mut self, name: &str) -> &mut TopicReport {
        if !self.topics.contains_key(name) {
            self.topics.insert(name.to_owned(), TopicReport::default());
        }
        self.topics.entry(name.to_owned()).or_default()
    }

    /// For a bag's metadata: one line of JSON.
    #[must_use]
    pub fn custom_data(&self) -> BTreeMap<String, String> {
        // Numbers and strings: nothing that could fail.
        let text = serde_json::to_string(self).unwrap_or_default();
        BTreeMap::from([(CUSTOM_DATA.to_owned(), text)])
    }

    /// Whether everything that was sent is in the bag, as far as that is known. Topics without a
    /// subscriber are: their publishers send nothing.
    #[must_use]
    pub fn is_complete(&self) -> bool {
        self.missing == 0
            && self.left_out.is_empty()
            && self.unknown_writers.writers == 0
            && self.other_domains.is_empty()
            && self.unobserved.values().all(|why| why == NO_SUBSCRIBER)
    }

    /// For people: what is missing, a line for each topic; nothing where nothing is.
    #[must_use]
    pub fn shortfalls(&self) -> Vec<String> {
        let mut lines = Vec::new();
        for (name, topic) in &self.topics {
            let counts = [
                (topic.incomplete, "incomplete on the wire"),
                (topic.lost, "lost on the way"),
                (topic.not_captured, "could not be captured"),
                (topic.dropped, "dropped, the storage was too slow"),
                (topic.unwritten, "not written, the storage was full"),
                (topic.unannounced, "sent before their writer was announced"),
            ];
            let counts = counts.into_iter().filter(|(count, _)| *count > 0);
            let missing: u64 = counts.clone().map(|(count, _)| count).sum();
            if missing > 0 {
                let recorded = topic.messages;
                let all = recorded + missing;
                let counts: Vec<String> = counts
                    .map(|(count, what)| format!("{count} {what}"))
                    .collect();
                let counts = counts.join(", ");
                lines.push(format!(
                    "{name}: {recorded} of {all} messages recorded; {counts}"
                ));
            }
        }
        for name in &self.sent_before {
            lines.push(format!(
                "{name} is transient local: messages sent before recording started are missing \
                 (see `retain: last`)"
            ));
        }
        for name in &self.left_out {
            lines.push(format!(
                "{name}: other types than the first are not recorded"
            ));
        }
        lines.extend(unobserved_lines(&self.unobserved));
        let UnknownWriters { writers, messages } = self.unknown_writers;
        if writers > 0 {
            lines.push(format!(
                "not recorded: {} of {} whose announcement was missed",
                counted(messages, "message"),
                counted(writers, "unknown writer")
            ));
        }
        for domain in &self.other_domains {
            let OtherDomain {
                domain_id,
                topics,
                messages,
            } = domain;
            let messages = messages.map_or_else(String::new, |count| {
                format!(" with {}", counted(count, "message"))
            });
            let topics = counted(*topics, "topic");
            lines.push(format!(
                "not recorded: {topics} of domain {domain_id}{messages} (`--domain {domain_id}`)"
            ));
        }
        if let Some(limit) = &self.limit_reached {
            lines.push(format!("ended by a limit: {limit}"));
        }
        lines
    }
}

/// For people: why nothing of these topics is seen, a line for each reason.
#[must_use]
pub fn unobserved_lines(unobserved: &BTreeMap<String, String>) -> Vec<String> {
    let lines = UNOBSERVED.iter().filter_map(|(why, what)| {
        let topics = unobserved.iter().filter(|(_, reason)| reason == why);
        let names: Vec<&str> = topics.map(|(name, _)| name.as_str()).collect();
        let line = format!("{}: no message recorded; {what}", few(&names));
        (!names.is_empty()).then_some(line)
    });
    lines.collect()
}

/// A number of things.
fn counted(count: u64, thing: &str) -> String {
    let plural = if count == 1 { "" } else { "s" };
    format!("{count} {thing}{plural}")
}

/// Of a list of names the first ones.
fn few(names: &[&str]) -> String {
    let shown = names
        .iter()
        .take(NAMES)
        .copied()
        .collect::<Vec<_>>()
        .join(", ");
    match names.len().saturating_sub(NAMES) {
        0 => shown,
        more => format!("{shown} and {more} more"),
    }
}

#[cfg(test)]
mod tests {
    use ros2probe_wire::DomainId;
    use std::sync::Arc;

    use ros2probe_wire::Guid;

    use super::*;
    use crate::subscriptions::Topic;

    fn missed(first: u64, samples: u64, reason: MissedReason) -> Missed {
        Missed {
            topic: Arc::new(Topic {
                domain_id: DomainId(0),
                name: "/points".into(),
                dds_name: "rt/points".into(),
                message_type: "sensor_msgs/msg/PointCloud2".into(),
                offered: None,
            }),
            writer: Guid::default(),
            first,
            last: first + samples - 1,
            samples,
            reason,
        }
    }

    #[test]
    fn what_is_missing_is_counted_by_reason_and_named_with_its_numbers() {
        let mut report = Report::default();
        report.written("/points", 100);
        report.missed(&missed(2, 3, MissedReason::Incomplete));
        report.missed(&missed(9, 1, MissedReason::QueueFull));
        assert_eq!((report.messages, report.missing), (1, 4));
        let topic = &report.topics["/points"];
        assert_eq!((topic.incomplete, topic.dropped), (3, 1));
        let run = &report.missing_runs[0];
        assert_eq!(
            (run.first_sequence_number, run.last_sequence_number),
            (2, 4)
        );
        assert_eq!(
            report.shortfalls(),
            [
                "/points: 1 of 5 messages recorded; 3 incomplete on the wire, 1 dropped, \
              the storage was too slow"
            ]
        );
    }

    #[test]
    fn a_long_list_of_runs_is_cut_and_counted() {
        let mut report = Report::default();
        for first in 0..RUNS as u64 + 5 {
            report.missed(&missed(first * 2 + 1, 1, MissedReason::Incomplete));
        }
        assert_eq!(report.missing_runs.len(), RUNS);
        assert_eq!(
            (report.missing_runs_unnamed, report.missing),
            (5, RUNS as u64 + 5)
        );
    }

    #[test]
    fn what_the_storage_refused_counts_as_missing() {
        let mut report = Report::default();
        report.written("/points", 100);
        report.written("/points", 100);
        report.unwritten("/points", 1, 100);
        assert_eq!((report.messages, report.bytes, report.missing), (1, 100, 1));
        assert!(report.shortfalls()[0].ends_with("1 not written, the storage was full"));
        let json = &report.custom_data()[CUSTOM_DATA];
        assert_eq!(serde_json::from_str::<Report>(json).unwrap(), report);
    }

    #[test]
    fn what_belongs_to_no_topic_of_the_bag_is_named_and_makes_it_incomplete() {
        let mut report = Report::default();
        let unobserved = |why: &str| ("/imu".to_owned(), why.to_owned());
        report.unobserved.extend([unobserved(NO_SUBSCRIBER)]);
        assert!(report.is_complete());
        report.unobserved.extend([unobserved("same_process")]);
        assert!(!report.is_complete());
        report.unknown_writers = UnknownWriters {
            writers: 2,
            messages: 90,
        };
        report.other_domains = vec![OtherDomain {
            domain_id: 7,
            topics: 3,
            messages: Some(12),
        }];
        assert_eq!(
            report.shortfalls(),
            [
                "/imu: no message recorded; publisher and subscriber share one process; nothing \
                 crosses the network",
                "not recorded: 90 messages of 2 unknown writers whose announcement was missed",
                "not recorded: 3 topics of domain 7 with 12 messages (`--domain 7`)",
            ]
        );
    }
}
