//! Conversion of subscription items to lines of the API's stream, and of QoS in lines back.

use std::time::Duration;

use ros2probe_api::samples::{self, Clock, End, Line, OfferedQos};
use ros2probe_wire::qos::{Durability, History, HistoryKind, Liveliness, Qos, Reliability, Role};
use ros2probe_wire::rtps::VendorId;
use ros2probe_wire::{RtpsDuration, Timestamp};

use super::Item;
use ros2probe_model::facts::dispatch::{Missed, MissedReason, Offered, Sample, Topic};

/// Returns the line of an item.
#[must_use]
pub fn line(item: &Item) -> Line {
    match item {
        Item::Sample(sample) => Line::Sample(self::sample(sample)),
        Item::Clock(now) => Line::Clock(Clock {
            time_ns: nanoseconds(*now),
        }),
        Item::Missed(missed) => Line::Missed(self::missed(missed)),
        Item::End(reason) => Line::End(End {
            reason: (*reason).to_owned(),
        }),
    }
}

fn sample(sample: &Sample) -> samples::Sample {
    let Topic {
        domain_id,
        name,
        message_type,
        ..
    } = sample.topic.as_ref();
    let stamp =
        |(seconds, nanoseconds)| i64::from(seconds) * 1_000_000_000 + i64::from(nanoseconds);
    let len = |payload: &bytes::Bytes| u32::try_from(payload.len()).unwrap_or(u32::MAX);
    samples::Sample {
        topic: name.to_string(),
        domain_id: domain_id.0,
        message_type: message_type.to_string(),
        time_ns: nanoseconds(sample.time),
        writer: sample.writer.to_string(),
        sequence_number: sample.sequence_number.0,
        source_timestamp_ns: sample.source_timestamp.map(nanoseconds),
        header_stamp_ns: sample.header_stamp.map(stamp),
        size: sample.size,
        sampled: sample.sampled,
        payload_bytes: sample.payload.as_ref().map(len),
        offered: None,
    }
}

fn missed(missed: &Missed) -> samples::Missed {
    samples::Missed {
        topic: missed.topic.name.to_string(),
        domain_id: missed.topic.domain_id.0,
        writer: missed.writer.to_string(),
        samples: missed.samples,
        first_sequence_number: missed.first.0,
        last_sequence_number: missed.last.0,
        reason: match missed.reason {
            MissedReason::Incomplete => samples::MissedReason::Incomplete,
            MissedReason::Lost => samples::MissedReason::Lost,
            MissedReason::Unannounced => samples::MissedReason::Unannounced,
            MissedReason::NotCaptured => samples::MissedReason::NotCaptured,
            MissedReason::QueueFull => samples::MissedReason::QueueFull,
        }
        .into(),
    }
}

/// Returns the offered QoS of a writer in the form of a line.
#[must_use]
pub fn offered(offered: &Offered) -> samples::Offered {
    samples::Offered {
        type_hash: offered.type_hash.as_ref().map(ToString::to_string),
        equivalence_hash: offered.equivalence_hash.map(|hash| hash.to_string()),
        qos: offered_qos(&offered.qos),
    }
}

fn offered_qos(qos: &Qos) -> OfferedQos {
    OfferedQos {
        reliability: qos.reliability.to_string(),
        durability: qos.durability.to_string(),
        history: match qos.history {
            None => "UNKNOWN".to_owned(),
            Some(history) => history.to_string(),
        },
        deadline_seconds: qos.deadline.seconds(),
        lifespan_seconds: qos.lifespan.seconds(),
        liveliness: qos.liveliness.to_string(),
        liveliness_lease_seconds: qos.liveliness_lease.seconds(),
    }
}

/// Parses QoS policies; an unknown word becomes an unknown value.
#[must_use]
pub fn qos(words: &OfferedQos) -> Qos {
    let unknown = u32::MAX;
    Qos {
        reliability: match words.reliability.as_str() {
            "RELIABLE" => Reliability::RELIABLE,
            "BEST_EFFORT" => Reliability::BEST_EFFORT,
            _ => Reliability(unknown),
        },
        durability: durability(&words.durability),
        history: history(&words.history),
        deadline: duration(words.deadline_seconds),
        lifespan: duration(words.lifespan_seconds),
        liveliness: match words.liveliness.as_str() {
            "AUTOMATIC" => Liveliness::AUTOMATIC,
            "MANUAL_BY_PARTICIPANT" => Liveliness::MANUAL_BY_PARTICIPANT,
            "MANUAL_BY_TOPIC" => Liveliness::MANUAL_BY_TOPIC,
            _ => Liveliness(unknown),
        },
        liveliness_lease: duration(words.liveliness_lease_seconds),
        ..Qos::defaults(Role::Writer, VendorId([0, 0]))
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

fn duration(seconds: Option<f64>) -> RtpsDuration {
    let duration = seconds.and_then(|seconds| Duration::try_from_secs_f64(seconds).ok());
    duration.map_or(RtpsDuration::Infinite, RtpsDuration::Finite)
}

fn nanoseconds(time: Timestamp) -> i64 {
    i64::try_from(time.0).unwrap_or(i64::MAX)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_line_is_read_back_unchanged() {
        let lines = [
            (
                Line::Clock(Clock { time_ns: 17 }),
                r#"{"clock":{"time_ns":17}}"#,
            ),
            (
                Line::End(End {
                    reason: "agent ends".to_owned(),
                }),
                r#"{"end":{"reason":"agent ends"}}"#,
            ),
            (
                Line::Missed(samples::Missed {
                    topic: "/a".to_owned(),
                    domain_id: 0,
                    writer: "01".to_owned(),
                    samples: 2,
                    first_sequence_number: 4,
                    last_sequence_number: 5,
                    reason: samples::MissedReason::QueueFull.into(),
                }),
                r#"{"missed":{"topic":"/a","domain_id":0,"writer":"01","samples":2,"first_sequence_number":4,"last_sequence_number":5,"reason":"queue_full"}}"#,
            ),
        ];
        for (line, text) in lines {
            assert_eq!(serde_json::to_string(&line).unwrap(), text);
            assert_eq!(serde_json::from_str::<Line>(text).unwrap(), line);
        }
    }

    #[test]
    fn quality_of_service_survives_the_conversion() {
        let qos = Qos {
            reliability: Reliability::BEST_EFFORT,
            durability: Durability::TRANSIENT_LOCAL,
            history: history("KEEP_LAST (5)"),
            deadline: RtpsDuration::Finite(Duration::from_millis(100)),
            ..Qos::defaults(Role::Writer, VendorId([0, 0]))
        };
        let facts = offered_qos(&qos);
        assert_eq!(
            (facts.history.as_str(), facts.lifespan_seconds),
            ("KEEP_LAST (5)", None)
        );
        assert_eq!(super::qos(&facts), qos);
        assert_eq!(history("KEEP_LAST (x)"), None);
        assert_eq!(history("KEEP_ALL").unwrap().kind, HistoryKind::KEEP_ALL);
        assert_eq!(duration(Some(-1.0)), RtpsDuration::Infinite);
        assert_eq!(durability("?").name(), None);
    }
}
