//! `offered_qos_profiles`: the QoS of a topic's publishers as rosbag2 writes it.
//!
//! Two spellings exist. Humble writes and reads the numbers of `rmw_qos_profile_t`; Jazzy and later
//! write names and read both, depending on whether `history` is a number. For a topic without
//! publishers, Jazzy writes `[]`. With numbers the text is empty, which every distribution accepts
//! (Jazzy's reader fails on Humble's own `~`). This module does not interpret profiles as a player
//! would.

use std::fmt::Write as _;

use ros2probe_wire::RtpsDuration;
use ros2probe_wire::qos::{Durability, HistoryKind, Liveliness, Qos, Reliability};

/// Spelling of policies.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum Spelling {
    /// Numbers, which every distribution reads; Humble reads nothing else.
    Numbers,
    /// Names, which Jazzy and later write; Humble cannot read them.
    Names,
}

/// Returns the text for these publishers.
#[must_use]
pub fn profiles(publishers: &[Qos], spelling: Spelling) -> String {
    if publishers.is_empty() {
        return match spelling {
            Spelling::Numbers => String::new(),
            Spelling::Names => "[]".to_owned(),
        };
    }
    let mut text = String::new();
    for (index, publisher) in publishers.iter().enumerate() {
        if index > 0 {
            text.push('\n');
        }
        profile(&mut text, publisher, spelling);
    }
    text
}

fn profile(text: &mut String, qos: &Qos, spelling: Spelling) {
    let (history, depth) = match qos.history {
        Some(history) => (history_kind(history.kind), history.depth.max(0)),
        None => (UNKNOWN_HISTORY, 0),
    };
    let one = |(number, name): (u8, &'static str)| match spelling {
        Spelling::Numbers => number.to_string(),
        Spelling::Names => name.to_owned(),
    };
    let duration = |text: &mut String, name: &str, duration: RtpsDuration| {
        let (seconds, nanoseconds) = match duration {
            // 2^63 - 1 ns, which is RMW_DURATION_INFINITE.
            RtpsDuration::Infinite => (9_223_372_036, 854_775_807),
            RtpsDuration::Finite(duration) => (duration.as_secs(), duration.subsec_nanos()),
        };
        let _ = write!(
            text,
            "  {name}:\n    sec: {seconds}\n    nsec: {nanoseconds}\n"
        );
    };
    let _ = writeln!(text, "- history: {}", one(history));
    let _ = writeln!(text, "  depth: {depth}");
    let _ = writeln!(text, "  reliability: {}", one(reliability(qos.reliability)));
    let _ = writeln!(text, "  durability: {}", one(durability(qos.durability)));
    duration(text, "deadline", qos.deadline);
    duration(text, "lifespan", qos.lifespan);
    let _ = writeln!(text, "  liveliness: {}", one(liveliness(qos.liveliness)));
    duration(text, "liveliness_lease_duration", qos.liveliness_lease);
    // Observed endpoints belong to ROS topics, whose names follow the conventions.
    text.push_str("  avoid_ros_namespace_conventions: false");
}

const UNKNOWN_HISTORY: (u8, &str) = (3, "unknown");

fn history_kind(kind: HistoryKind) -> (u8, &'static str) {
    match kind {
        HistoryKind::KEEP_LAST => (1, "keep_last"),
        HistoryKind::KEEP_ALL => (2, "keep_all"),
        _ => UNKNOWN_HISTORY,
    }
}

fn reliability(kind: Reliability) -> (u8, &'static str) {
    match kind {
        Reliability::RELIABLE => (1, "reliable"),
        Reliability::BEST_EFFORT => (2, "best_effort"),
        _ => (3, "unknown"),
    }
}

fn durability(kind: Durability) -> (u8, &'static str) {
    match kind {
        Durability::TRANSIENT_LOCAL => (1, "transient_local"),
        Durability::VOLATILE => (2, "volatile"),
        _ => (3, "unknown"),
    }
}

fn liveliness(kind: Liveliness) -> (u8, &'static str) {
    match kind {
        Liveliness::AUTOMATIC => (1, "automatic"),
        Liveliness::MANUAL_BY_TOPIC => (3, "manual_by_topic"),
        _ => (4, "unknown"),
    }
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use ros2probe_wire::qos::{History, Role};
    use ros2probe_wire::rtps::VendorId;

    use super::*;

    fn publisher() -> Qos {
        Qos {
            history: Some(History {
                kind: HistoryKind::KEEP_LAST,
                depth: 5,
            }),
            reliability: Reliability::BEST_EFFORT,
            lifespan: RtpsDuration::Finite(Duration::from_nanos(10_000_000_001)),
            ..Qos::defaults(Role::Writer, VendorId::CYCLONE)
        }
    }

    #[test]
    fn numeric_profiles_match_those_of_a_real_humble_bag() {
        // cyclonedds/bag-record-2ns, /robot1/imu/data, with a lifespan.
        let text = "- history: 1\n  depth: 5\n  reliability: 2\n  durability: 2\n  deadline:\n    sec: \
            9223372036\n    nsec: 854775807\n  lifespan:\n    sec: 10\n    nsec: 1\n  liveliness: 1\n  \
            liveliness_lease_duration:\n    sec: 9223372036\n    nsec: 854775807\n  \
            avoid_ros_namespace_conventions: false";
        assert_eq!(profiles(&[publisher()], Spelling::Numbers), text);
        let twice = profiles(&[publisher(), publisher()], Spelling::Numbers);
        assert_eq!(twice, format!("{text}\n{text}"));
    }

    #[test]
    fn a_history_that_was_not_announced_is_unknown() {
        let publisher = Qos {
            history: None,
            ..publisher()
        };
        let text = profiles(&[publisher], Spelling::Names);
        let begin =
            "- history: unknown\n  depth: 0\n  reliability: best_effort\n  durability: volatile\n";
        assert!(text.starts_with(begin), "{text}");
        assert!(text.contains("\n  liveliness: automatic\n"), "{text}");
    }

    #[test]
    fn without_publishers_the_profiles_are_an_empty_text_or_list() {
        assert_eq!(profiles(&[], Spelling::Numbers), "");
        assert_eq!(profiles(&[], Spelling::Names), "[]");
    }
}
