//! Text about the messages that a bag lacks.

use std::collections::BTreeMap;

use ros2probe_api::latched::Latched;
use ros2probe_api::recording_report::{NO_SUBSCRIBER, OtherDomain, Report, UnknownWriters};
use ros2probe_api::topics::UNSUBSCRIBED;
use ros2probe_daemon::tables::RecordedTopics;

/// Maximum number of topics named in one line.
const MAX_NAMED_TOPICS: usize = 8;
/// Reasons for a published topic without visible messages, with their texts.
const UNOBSERVED_REASONS: [(&str, &str); 5] = [
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

/// Returns text about missing messages, one line per topic; empty if nothing is missing.
pub(super) fn shortfalls(report: &Report) -> Vec<String> {
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

/// Returns text about invisible topics, one line per reason.
pub(super) fn unobserved_lines(unobserved: &BTreeMap<String, String>) -> Vec<String> {
    let lines = UNOBSERVED_REASONS.iter().filter_map(|(why, what)| {
        let topics = unobserved.iter().filter(|(_, reason)| reason == why);
        let names: Vec<&str> = topics.map(|(name, _)| name.as_str()).collect();
        let line = format!("{}: no message recorded; {what}", shortened_list(&names));
        (!names.is_empty()).then_some(line)
    });
    lines.collect()
}

/// Returns a count with its noun.
fn counted(count: u64, thing: &str) -> String {
    let plural = if count == 1 { "" } else { "s" };
    format!("{count} {thing}{plural}")
}

/// Returns the first names of a list, and the number of others.
fn shortened_list(names: &[&str]) -> String {
    let shown = names
        .iter()
        .take(MAX_NAMED_TOPICS)
        .copied()
        .collect::<Vec<_>>()
        .join(", ");
    match names.len().saturating_sub(MAX_NAMED_TOPICS) {
        0 => shown,
        more => format!("{shown} and {more} more"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn missing_messages_of_a_topic_are_reported_in_one_line_with_their_reasons() {
        let mut report = Report::default();
        let topic = report.topic("/points");
        (topic.messages, topic.incomplete, topic.dropped) = (1, 3, 1);
        assert_eq!(
            shortfalls(&report),
            [
                "/points: 1 of 5 messages recorded; 3 incomplete on the wire, 1 dropped, \
                 the storage was too slow"
            ]
        );
        let topic = report.topic("/points");
        (topic.incomplete, topic.dropped, topic.unwritten) = (0, 0, 1);
        assert!(shortfalls(&report)[0].ends_with("1 not written, the storage failed or was full"));
    }

    #[test]
    fn a_reached_limit_a_second_type_and_topics_beyond_the_cap_are_reported() {
        let report = Report {
            no_room: 501,
            left_out: vec!["/a".to_owned()],
            limit_reached: Some("recordings.max_bytes".to_owned()),
            ..Report::default()
        };
        assert_eq!(
            shortfalls(&report),
            [
                "not recorded: 501 messages of further topics than the 2048 that a recording has \
                 room for",
                "/a: other types than the first are not recorded",
                "ended by a limit: recordings.max_bytes",
            ]
        );
    }

    #[test]
    fn topics_missing_in_a_bag_are_named_and_make_it_incomplete() {
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
