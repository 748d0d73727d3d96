//! Counts recorded and missing messages, and formats them as text. The report is an answer of the
//! API and part of the bag's metadata.

use std::collections::BTreeMap;

use ros2probe_api::latched::Latched;
use ros2probe_api::recording_report::{
    MissingRun, NO_SUBSCRIBER, OtherDomain, Report, UnknownWriters,
};

use ros2probe_api::topics::UNSUBSCRIBED;

use crate::subscriptions::{Missed, MissedReason};
use crate::tables::RecordedTopics;

/// Most runs of missing samples listed; further ones are counted.
const RUNS: usize = 256;
/// Most topics named in one line.
const NAMES: usize = 8;
/// Reasons for a published topic without visible messages, with their texts.
const UNOBSERVED: [(&str, &str); 5] = [
    (NO_SUBSCRIBER, UNSUBSCRIBED),
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
/// Key of the report in the bag's custom data.
pub(super) const CUSTOM_DATA: &str = "ros2probe";

/// Counts a recorded message.
pub(super) fn add_written(report: &mut Report, topic: &str, bytes: usize) {
    let bytes = bytes as u64;
    report.messages += 1;
    report.bytes += bytes;
    let topic = report.topic(topic);
    topic.messages += 1;
    topic.bytes += bytes;
}

/// Counts a message that arrived during a pause.
pub(super) fn add_paused(report: &mut Report, topic: &str) {
    report.topic(topic).paused += 1;
}

/// Counts messages that will never be in the bag.
pub(super) fn add_missed(report: &mut Report, missed: &Missed) {
    report.missing += missed.samples;
    let topic = report.topic(&missed.topic.name);
    let (count, reason) = match missed.reason {
        MissedReason::Incomplete => (&mut topic.incomplete, "incomplete"),
        MissedReason::Lost => (&mut topic.lost, "lost"),
        MissedReason::Unannounced => (&mut topic.unannounced, "unannounced"),
        MissedReason::NotCaptured => (&mut topic.not_captured, "not_captured"),
        MissedReason::QueueFull => (&mut topic.dropped, "dropped"),
    };
    *count += missed.samples;
    if report.missing_runs.len() >= RUNS {
        report.missing_runs_unnamed += 1;
        return;
    }
    report.missing_runs.push(MissingRun {
        topic: missed.topic.name.to_string(),
        writer: missed.writer.to_string(),
        first_sequence_number: missed.first.0,
        last_sequence_number: missed.last.0,
        samples: missed.samples,
        reason: reason.to_owned(),
    });
}

/// Corrects the counts of messages that were not written after all.
pub(super) fn take_back(report: &mut Report, topic: &str, messages: u64, bytes: u64) {
    report.messages = report.messages.saturating_sub(messages);
    report.bytes = report.bytes.saturating_sub(bytes);
    report.missing += messages;
    let topic = report.topic(topic);
    topic.messages = topic.messages.saturating_sub(messages);
    topic.bytes = topic.bytes.saturating_sub(bytes);
    topic.unwritten += messages;
}

/// Report for a bag's metadata: one line of JSON.
pub(super) fn custom_data(report: &Report) -> BTreeMap<String, String> {
    // Numbers and strings cannot fail to serialize.
    let text = serde_json::to_string(report).unwrap_or_default();
    BTreeMap::from([(CUSTOM_DATA.to_owned(), text)])
}

/// Text about missing messages, one line per topic. Empty if nothing is missing.
#[must_use]
pub fn shortfalls(report: &Report) -> Vec<String> {
    let mut lines = Vec::new();
    for (name, topic) in &report.topics {
        let counts = [
            (topic.incomplete, "incomplete on the wire"),
            (topic.lost, "lost on the way"),
            (topic.not_captured, "could not be captured"),
            (topic.dropped, "dropped, the storage was too slow"),
            (
                topic.unwritten,
                "not written, the storage failed or was full",
            ),
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
    if report.no_room > 0 {
        let topics = RecordedTopics::CAP;
        lines.push(format!(
            "not recorded: {} of further topics than the {topics} that a recording has room for",
            counted(report.no_room, "message")
        ));
    }
    for name in &report.sent_before {
        let latched = report.latched.get(name);
        lines.push(Latched::missing(latched, name).unwrap_or_else(|| {
            format!("{name} is transient local: messages sent before recording started are missing")
        }));
    }
    for name in &report.left_out {
        lines.push(format!(
            "{name}: other types than the first are not recorded"
        ));
    }
    lines.extend(unobserved_lines(&report.unobserved));
    let UnknownWriters { writers, messages } = report.unknown_writers;
    if writers > 0 {
        lines.push(format!(
            "not recorded: {} of {} whose announcement was missed",
            counted(messages, "message"),
            counted(writers, "unknown writer")
        ));
    }
    for domain in &report.other_domains {
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
    if let Some(limit) = &report.limit_reached {
        lines.push(format!("ended by a limit: {limit}"));
    }
    lines
}
/// Text about invisible topics, one line per reason.
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

/// Returns a count with its noun.
#[must_use]
pub fn counted(count: u64, thing: &str) -> String {
    let plural = if count == 1 { "" } else { "s" };
    format!("{count} {thing}{plural}")
}

/// The first names of a list.
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

    use ros2probe_wire::SequenceNumber;

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
            first: SequenceNumber(first),
            last: SequenceNumber(first + samples - 1),
            samples,
            reason,
        }
    }

    #[test]
    fn missing_messages_are_counted_by_reason_and_named_with_their_numbers() {
        let mut report = Report::default();
        add_written(&mut report, "/points", 100);
        add_missed(&mut report, &missed(2, 3, MissedReason::Incomplete));
        add_missed(&mut report, &missed(9, 1, MissedReason::QueueFull));
        assert_eq!((report.messages, report.missing), (1, 4));
        let topic = &report.topics["/points"];
        assert_eq!((topic.incomplete, topic.dropped), (3, 1));
        let run = &report.missing_runs[0];
        assert_eq!(
            (run.first_sequence_number, run.last_sequence_number),
            (2, 4)
        );
        assert_eq!(
            shortfalls(&report),
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
            add_missed(
                &mut report,
                &missed(first * 2 + 1, 1, MissedReason::Incomplete),
            );
        }
        assert_eq!(report.missing_runs.len(), RUNS);
        assert_eq!(
            (report.missing_runs_unnamed, report.missing),
            (5, RUNS as u64 + 5)
        );
    }

    #[test]
    fn messages_that_the_storage_refused_count_as_missing() {
        let mut report = Report::default();
        add_written(&mut report, "/points", 100);
        add_written(&mut report, "/points", 100);
        take_back(&mut report, "/points", 1, 100);
        assert_eq!((report.messages, report.bytes, report.missing), (1, 100, 1));
        assert!(shortfalls(&report)[0].ends_with("1 not written, the storage failed or was full"));
        let json = &custom_data(&report)[CUSTOM_DATA];
        assert_eq!(serde_json::from_str::<Report>(json).unwrap(), report);
    }

    #[test]
    fn unobserved_topics_and_unknown_writers_make_a_report_incomplete() {
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
            shortfalls(&report),
            [
                "/imu: no message recorded; publisher and subscriber share one process; nothing \
                 crosses the network",
                "not recorded: 90 messages of 2 unknown writers whose announcement was missed",
                "not recorded: 3 topics of domain 7 with 12 messages (`--domain 7`)",
            ]
        );
    }
}
