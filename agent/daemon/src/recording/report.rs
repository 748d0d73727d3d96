//! Counts recorded and missing messages. The report is part of the API's responses and of the bag's
//! metadata.

use std::collections::BTreeMap;

use ros2probe_api::recording_report::{MissingRun, Report};

use crate::subscriptions::{Missed, MissedReason};

/// Maximum number of listed runs of missing samples; further runs are only counted.
const MAX_LISTED_RUNS: usize = 256;
/// Key of the report in the bag's custom data.
pub(in crate::recording) const CUSTOM_DATA: &str = "ros2probe";

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
    if report.missing_runs.len() >= MAX_LISTED_RUNS {
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

/// Returns the report for a bag's metadata: one line of JSON.
pub(super) fn custom_data(report: &Report) -> BTreeMap<String, String> {
    // Numbers and strings cannot fail to serialize.
    let text = serde_json::to_string(report).unwrap_or_default();
    BTreeMap::from([(CUSTOM_DATA.to_owned(), text)])
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
    fn missing_messages_are_counted_by_reason_and_listed_by_sequence_number() {
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
    }

    #[test]
    fn runs_beyond_the_maximum_are_counted_but_not_listed() {
        let mut report = Report::default();
        for first in 0..MAX_LISTED_RUNS as u64 + 5 {
            add_missed(
                &mut report,
                &missed(first * 2 + 1, 1, MissedReason::Incomplete),
            );
        }
        assert_eq!(report.missing_runs.len(), MAX_LISTED_RUNS);
        assert_eq!(
            (report.missing_runs_unnamed, report.missing),
            (5, MAX_LISTED_RUNS as u64 + 5)
        );
    }

    #[test]
    fn messages_that_the_storage_refused_count_as_missing() {
        let mut report = Report::default();
        add_written(&mut report, "/points", 100);
        add_written(&mut report, "/points", 100);
        take_back(&mut report, "/points", 1, 100);
        assert_eq!((report.messages, report.bytes, report.missing), (1, 100, 1));
        assert_eq!(report.topics["/points"].unwritten, 1);
        let json = &custom_data(&report)[CUSTOM_DATA];
        assert_eq!(serde_json::from_str::<Report>(json).unwrap(), report);
    }
}
