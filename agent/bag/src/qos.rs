//! `offered_qos_profiles`: the QoS of a topic's publishers as rosbag2 writes it.
//!
//! Two spellings exist. Humble writes and reads the numbers of `rmw_qos_profile_t`; Jazzy and later
//! write names and read both, depending on whether `history` is a number. For a topic without
//! publishers, Jazzy writes `[]`. With numbers the text is empty, which every distribution accepts
//! (Jazzy's reader fails on Humble's own `~`). A text is read only to show the QoS of a topic: this
//! module does not adapt them to subscriptions, as a player would.

use std::fmt::Write as _;
use std::time::Duration;

use ros2probe_wire::RtpsDuration;
use ros2probe_wire::discovery::Role;
use ros2probe_wire::qos::{Durability, History, HistoryKind, Liveliness, Qos, Reliability};
use ros2probe_wire::rtps::VendorId;
use serde::Deserialize;

/// Maximum length of a text that is read, in bytes: about a hundred publishers.
const MAX_TEXT: usize = 32 << 10;
/// Seconds from which on a duration is infinite. Humble's is 2^63 ns, or 2^31 s.
const INFINITE_SECONDS: u64 = (1 << 31) - 1;

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

/// Returns the QoS of the first publisher in a text, in either spelling. Policies that it lacks, or
/// whose value is unknown, have their defaults. `None` for a text without publishers.
#[must_use]
pub fn first(text: &str) -> Option<Qos> {
    if text.len() > MAX_TEXT {
        return None;
    }
    let profiles: Vec<Profile> = serde_yaml::from_str(text).ok()?;
    let profile = profiles.into_iter().next()?;
    let defaults = Qos::defaults(Role::Writer, VendorId([0; 2]));
    let kinds = [HistoryKind::KEEP_LAST, HistoryKind::KEEP_ALL];
    let history = profile.history.one_of(kinds, history_kind);
    let kinds = [Reliability::RELIABLE, Reliability::BEST_EFFORT];
    let reliability = profile.reliability.one_of(kinds, reliability);
    let kinds = [Durability::TRANSIENT_LOCAL, Durability::VOLATILE];
    let durability = profile.durability.one_of(kinds, durability);
    let kinds = [Liveliness::AUTOMATIC, Liveliness::MANUAL_BY_TOPIC];
    let liveliness = profile.liveliness.one_of(kinds, liveliness);
    Some(Qos {
        reliability: reliability.unwrap_or(defaults.reliability),
        durability: durability.unwrap_or(defaults.durability),
        history: history.map(|kind| History {
            kind,
            depth: i32::try_from(profile.depth).unwrap_or(i32::MAX),
        }),
        deadline: profile.deadline.duration(),
        lifespan: profile.lifespan.duration(),
        liveliness: liveliness.unwrap_or(defaults.liveliness),
        liveliness_lease: profile.liveliness_lease_duration.duration(),
        ..defaults
    })
}

/// A publisher in a text.
#[derive(Deserialize)]
struct Profile {
    #[serde(default)]
    history: Policy,
    #[serde(default)]
    depth: u64,
    #[serde(default)]
    reliability: Policy,
    #[serde(default)]
    durability: Policy,
    #[serde(default)]
    deadline: Span,
    #[serde(default)]
    lifespan: Span,
    #[serde(default)]
    liveliness: Policy,
    #[serde(default)]
    liveliness_lease_duration: Span,
}

/// A policy, in either spelling.
#[derive(Default, Deserialize)]
#[serde(untagged)]
enum Policy {
    Number(u8),
    Name(String),
    #[default]
    Unknown,
}

/// A duration; zero means the default, which is infinite for all policies here.
#[derive(Default, Deserialize)]
struct Span {
    #[serde(default)]
    sec: u64,
    #[serde(default)]
    nsec: u64,
}

impl Policy {
    /// Returns the one of these values that has this spelling.
    fn one_of<T: Copy>(&self, values: [T; 2], spelled: fn(T) -> (u8, &'static str)) -> Option<T> {
        values.into_iter().find(|value| {
            let (number, name) = spelled(*value);
            match self {
                Self::Number(found) => *found == number,
                Self::Name(found) => found == name,
                Self::Unknown => false,
            }
        })
    }
}

impl Span {
    fn duration(&self) -> RtpsDuration {
        if self.sec >= INFINITE_SECONDS || (self.sec, self.nsec) == (0, 0) {
            return RtpsDuration::Infinite;
        }
        let rest = Duration::from_nanos(self.nsec);
        RtpsDuration::Finite(Duration::from_secs(self.sec).saturating_add(rest))
    }
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
    fn written_profiles_are_read_again_in_both_spellings() {
        for spelling in [Spelling::Numbers, Spelling::Names] {
            let text = profiles(&[publisher()], spelling);
            let read = first(&text).unwrap();
            assert_eq!(
                read,
                Qos {
                    history: publisher().history,
                    reliability: Reliability::BEST_EFFORT,
                    lifespan: publisher().lifespan,
                    ..Qos::defaults(Role::Writer, VendorId([0; 2]))
                }
            );
        }
    }

    #[test]
    fn a_text_without_publishers_has_no_qos() {
        for text in ["", "[]", "~", "- 1", "{", &" ".repeat(MAX_TEXT + 1)] {
            assert_eq!(first(text), None, "{text}");
        }
        // A bag of Foxy has fewer policies.
        let read =
            first("- history: 3\n  reliability: 9\n  deadline: {sec: 0, nsec: 0}\n").unwrap();
        assert_eq!(read, Qos::defaults(Role::Writer, VendorId([0; 2])));
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
