//! Chains in a bag: reads its messages, and passes the stamps of their headers to the model.
//!
//! A bag names no nodes, so hops lead from topic to topic
//! ([`ros2probe_model::derive::chain::recorded`]).

use std::collections::HashMap;
use std::path::Path;

use ros2probe_api::chains::Chain;
use ros2probe_bag::messages::{self, Message, MessagesError};
use ros2probe_daemon::run::CaptureTime;
use ros2probe_daemon::surface::api::chains::parts;
use ros2probe_model::derive::chain::recorded::{RecordedChains, RecordedFacts};
use ros2probe_model::facts::header::begins_with_header;
use ros2probe_model::facts::names::TopicName;
use ros2probe_wire::{Expansion, Timestamp};

/// Interval of progress reports, in messages.
const PROGRESS_INTERVAL: u64 = 65_536;
/// Type of messages that describe the images of another topic and have the same stamps.
const COMPANION_TYPE: &str = "sensor_msgs/msg/CameraInfo";

/// Chains in a bag.
#[derive(Debug)]
pub struct BagChains {
    facts: RecordedFacts,
    /// Number of messages that were read.
    pub messages: u64,
    /// Parts of the bag that were not read, as lines for people.
    pub faults: Vec<String>,
}

/// A topic, and others with the same stamps.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct SharedStamps {
    /// Name of the topic.
    pub topic: String,
    /// Names of the other topics.
    pub others: Vec<String>,
}

impl BagChains {
    /// Reads a bag between these times of reception. Its chains are cut at the topics `ends`.
    /// `progress` receives the number of messages read, and the number in the bag if known.
    ///
    /// # Errors
    /// Fails if nothing in the bag can be read.
    pub fn read(
        path: &Path,
        expansion: Expansion,
        (from, until): (Option<CaptureTime>, Option<CaptureTime>),
        ends: &[&str],
        progress: &mut dyn FnMut(u64, Option<u64>),
    ) -> Result<Self, MessagesError> {
        let mut chains = RecordedChains::default();
        // By name of a topic; `None` if its messages do not begin with a header.
        let mut stamped: HashMap<String, Option<TopicName>> = HashMap::new();
        let mut first = None;
        let mut seen = 0_u64;
        let read = messages::read(path, expansion, &mut |message, total| {
            seen += 1;
            if seen.is_multiple_of(PROGRESS_INTERVAL) {
                progress(seen, total);
            }
            let logged = Timestamp(message.log_time);
            let begin = *first.get_or_insert(logged);
            let is_before = from.is_some_and(|from| logged < from.in_capture(begin));
            let is_after = until.is_some_and(|until| logged > until.in_capture(begin));
            if is_before || is_after {
                return;
            }
            if !stamped.contains_key(message.topic) {
                let name = is_stamped(message).then(|| TopicName::from(message.topic));
                stamped.insert(message.topic.to_owned(), name);
            }
            if let Some(Some(name)) = stamped.get(message.topic)
                && let Some(stamp) = stamp(message.begin)
            {
                let published = message.publish_time.map(Timestamp);
                chains.add(name, stamp, logged, published);
            }
        })?;
        Ok(Self {
            facts: chains.finish(ends),
            messages: read.messages,
            faults: read.faults.iter().map(ToString::to_string).collect(),
        })
    }

    /// Returns the chains, or the parts of them between two topics. Their domain and nodes are not
    /// known.
    #[must_use]
    pub fn chains(&self, from: Option<&str>, to: Option<&str>) -> Vec<Chain<'_>> {
        let lead = |end| self.representative(end);
        parts(self.facts.chains.iter(), from.map(lead), to.map(lead))
    }

    /// Returns the kind of time from which durations are computed: `publish` or `log`.
    #[must_use]
    pub const fn times(&self) -> &'static str {
        self.facts.times.label()
    }

    /// Returns topics that stand for others in the chains, because they are published together.
    #[must_use]
    pub fn simultaneous_topics(&self) -> Vec<SharedStamps> {
        let mut all: Vec<SharedStamps> = Vec::new();
        for (topic, lead) in &self.facts.together {
            let known = all.iter_mut().find(|known| *known.topic == **lead);
            match known {
                Some(known) => known.others.push(topic.to_string()),
                None => all.push(SharedStamps {
                    topic: lead.to_string(),
                    others: vec![topic.to_string()],
                }),
            }
        }
        all
    }

    /// Returns topics that share stamps with several others, none of which is known to be the
    /// cause.
    #[must_use]
    pub fn unclear(&self) -> Vec<SharedStamps> {
        let unclear = self
            .facts
            .unclear
            .iter()
            .map(|(topic, others)| SharedStamps {
                topic: topic.to_string(),
                others: others.iter().map(ToString::to_string).collect(),
            });
        unclear.collect()
    }

    /// Returns the number of messages that were not used: their stamps are multiples of 100 µs.
    #[must_use]
    pub const fn rounded_messages(&self) -> u64 {
        self.facts.rounded
    }

    /// Returns the number of messages above the caps.
    #[must_use]
    pub const fn refused(&self) -> u64 {
        self.facts.refused
    }

    /// Returns the topic that stands for this one in the chains.
    fn representative<'a>(&'a self, name: &'a str) -> &'a str {
        let mut together = self.facts.together.iter();
        let known = together.find(|(topic, _)| **topic == *name);
        known.map_or(name, |(_, lead)| lead)
    }
}

/// Returns whether messages of this topic begin with a header and may belong to a chain.
fn is_stamped(message: &Message<'_>) -> bool {
    if message.type_name == COMPANION_TYPE {
        return false;
    }
    // The text of the type itself comes first. The types of its fields follow a line of `=`.
    let fields = message.definition.lines().map(|line| {
        let line = line.split_once('#').map_or(line, |(line, _)| line);
        line.trim()
    });
    let mut fields = fields.filter(|line| !line.is_empty() && !line.contains('='));
    match fields.next() {
        Some(field) => matches!(
            field.split_whitespace().next(),
            Some("std_msgs/Header" | "std_msgs/msg/Header" | "Header")
        ),
        None => begins_with_header(message.type_name),
    }
}

/// Reads the stamp at the beginning of a payload (XTYPES 1.3, 7.6.3.1.2).
fn stamp(begin: &[u8]) -> Option<(i32, u32)> {
    let (encapsulation, body) = begin.split_first_chunk::<4>()?;
    let [0, kind, ..] = *encapsulation else {
        return None;
    };
    let body = match kind {
        // CDR, and PLAIN_CDR2.
        0 | 1 | 6 | 7 => body,
        // DELIMITED_CDR2 begins with a length.
        8 | 9 => body.get(4..)?,
        _ => return None,
    };
    let (seconds, rest) = body.split_first_chunk::<4>()?;
    let nanoseconds = rest.first_chunk::<4>()?;
    Some(match kind & 1 {
        1 => (
            i32::from_le_bytes(*seconds),
            u32::from_le_bytes(*nanoseconds),
        ),
        _ => (
            i32::from_be_bytes(*seconds),
            u32::from_be_bytes(*nanoseconds),
        ),
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn stamps_are_read_in_both_byte_orders_and_all_plain_encapsulations() {
        let little = [0, 1, 0, 0, 7, 0, 0, 0, 9, 0, 0, 0];
        let big = [0, 0, 0, 0, 0, 0, 0, 7, 0, 0, 0, 9];
        let delimited = [0, 9, 0, 0, 64, 0, 0, 0, 7, 0, 0, 0, 9, 0, 0, 0];
        for payload in [&little[..], &big, &delimited] {
            assert_eq!(stamp(payload), Some((7, 9)), "{payload:?}");
            assert_eq!(stamp(&payload[..payload.len() - 1]), None);
        }
        assert_eq!(stamp(&[0, 3, 0, 0, 7, 0, 0, 0, 9, 0, 0, 0]), None);
    }

    #[test]
    fn messages_of_any_type_that_begin_with_a_header_are_stamped() {
        let message = |type_name, definition| Message {
            topic: "/a",
            type_name,
            definition,
            log_time: 0,
            publish_time: None,
            begin: &[],
        };
        let with = "# A reading.\nuint8 MOST=3\n\nstd_msgs/Header header # when\nfloat32 value\n";
        assert!(is_stamped(&message("mine/msg/Reading", with)));
        let without = "float32 value\nstd_msgs/Header header\n";
        assert!(!is_stamped(&message("sensor_msgs/msg/Imu", without)));
        assert!(is_stamped(&message("sensor_msgs/msg/Imu", "")));
        assert!(!is_stamped(&message("mine/msg/Reading", "")));
        assert!(!is_stamped(&message("sensor_msgs/msg/CameraInfo", with)));
    }
}
