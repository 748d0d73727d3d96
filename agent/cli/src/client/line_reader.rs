//! Reads subscription items from the lines of an agent's stream.

use std::collections::HashMap;
use std::sync::Arc;

use bytes::Bytes;
use ros2probe_api::samples::{self, Line, Open};
use ros2probe_daemon::subscriptions::Item;
use ros2probe_daemon::subscriptions::line::qos;
use ros2probe_model::facts::bounded::Bounded;
use ros2probe_model::facts::dispatch::{Missed, MissedReason, Offered, Sample, Topic};
use ros2probe_model::graph::discovery::hexadecimal;
use ros2probe_wire::discovery::{EquivalenceHash, TypeHash};
use ros2probe_wire::time::SECOND;
use ros2probe_wire::{DomainId, EntityId, Guid, GuidPrefix, SequenceNumber, Timestamp};

use crate::tables::{StreamTopics, StreamWriters};

/// Converts lines to items, with the topics that earlier lines described.
#[derive(Debug)]
pub(super) struct LineReader {
    topics: Bounded<StreamTopics, HashMap<(u32, String), Arc<Topic>>>,
    /// Topics by writer, with the writer's announcement.
    writers: Bounded<StreamWriters, HashMap<String, Arc<Topic>>>,
    open: Open,
}

impl LineReader {
    /// Creates the reader of the stream that began with `open`.
    pub(super) fn new(open: Open) -> Self {
        Self {
            topics: Bounded::default(),
            writers: Bounded::default(),
            open,
        }
    }

    /// Returns the first line of the stream.
    pub(super) const fn opened(&self) -> &Open {
        &self.open
    }

    /// Returns the item of a line; `None` for [`Line::Open`]. `payload` holds the bytes after the
    /// line of a sample.
    pub(super) fn item(&mut self, line: &Line, payload: Bytes) -> Option<Item> {
        Some(match line {
            Line::Open(_) => return None,
            Line::Clock(clock) => Item::Clock(time(clock.time_ns)),
            Line::End(_) => Item::End("the agent's stream ended"),
            Line::Sample(facts) => {
                let topic = self.writers_topic(facts);
                Item::Sample(Arc::new(sample(topic, facts, payload)))
            }
            Line::Missed(facts) => Item::Missed(Missed {
                topic: self.topic(facts.domain_id, &facts.topic, None, None),
                writer: guid(&facts.writer),
                first: SequenceNumber(facts.first_sequence_number),
                last: SequenceNumber(facts.last_sequence_number),
                samples: facts.samples,
                reason: match facts.known_reason() {
                    samples::MissedReason::Incomplete => MissedReason::Incomplete,
                    samples::MissedReason::Lost => MissedReason::Lost,
                    samples::MissedReason::Unannounced => MissedReason::Unannounced,
                    samples::MissedReason::NotCaptured => MissedReason::NotCaptured,
                    samples::MissedReason::QueueFull => MissedReason::QueueFull,
                },
            }),
        })
    }

    fn writers_topic(&mut self, facts: &samples::Sample) -> Arc<Topic> {
        let known = self.writers.get(&facts.writer);
        if let Some(known) = known.filter(|_| facts.offered.is_none()) {
            return Arc::clone(known);
        }
        let message_type = Some(facts.message_type.as_str());
        let offered = facts.offered.as_deref();
        let topic = self.topic(facts.domain_id, &facts.topic, message_type, offered);
        self.writers
            .insert(facts.writer.clone(), Arc::clone(&topic));
        topic
    }

    /// Returns the topic of a line. If the line has no type, the type of an earlier line applies.
    /// Types that were known at the begin may be those of subscribers alone.
    fn topic(
        &mut self,
        domain_id: u32,
        name: &str,
        message_type: Option<&str>,
        offered: Option<&samples::Offered>,
    ) -> Arc<Topic> {
        let key = (domain_id, name.to_owned());
        let known = self.topics.get(&key);
        let same = |known: &&Arc<Topic>| {
            offered.is_none() && message_type.is_none_or(|it| it == &*known.message_type)
        };
        if let Some(known) = known.filter(same) {
            return Arc::clone(known);
        }
        let topic = Arc::new(Topic {
            domain_id: DomainId(domain_id),
            name: name.into(),
            dds_name: format!("rt{name}").into(),
            message_type: message_type.unwrap_or_default().into(),
            offered: offered.map(|offered| Arc::new(announced(offered))),
        });
        self.topics.insert(key, Arc::clone(&topic));
        topic
    }
}

fn sample(topic: Arc<Topic>, facts: &samples::Sample, payload: Bytes) -> Sample {
    Sample {
        topic,
        time: time(facts.time_ns),
        writer: guid(&facts.writer),
        sequence_number: SequenceNumber(facts.sequence_number),
        source_timestamp: facts.source_timestamp_ns.map(time),
        header_stamp: facts.header_stamp_ns.and_then(stamp),
        size: facts.size,
        sampled: facts.sampled,
        payload: Some(payload),
    }
}

/// Converts the offered QoS of a writer to the form of discovery.
fn announced(offered: &samples::Offered) -> Offered {
    Offered {
        type_hash: offered.type_hash.as_deref().and_then(TypeHash::parse),
        equivalence_hash: offered
            .equivalence_hash
            .as_deref()
            .and_then(EquivalenceHash::parse),
        qos: Arc::new(qos(&offered.qos)),
    }
}

fn time(nanoseconds: i64) -> Timestamp {
    Timestamp(u64::try_from(nanoseconds).unwrap_or(0))
}

fn stamp(nanoseconds: i64) -> Option<(i32, u32)> {
    let seconds = i32::try_from(nanoseconds.div_euclid(SECOND.cast_signed())).ok()?;
    let rest = u32::try_from(nanoseconds.rem_euclid(SECOND.cast_signed())).ok()?;
    Some((seconds, rest))
}

/// Parses a GUID. Returns the unknown GUID for text in any other format.
fn guid(text: &str) -> Guid {
    let parts = text.split_once('.').and_then(|(prefix, entity)| {
        Some(Guid {
            prefix: GuidPrefix(hexadecimal(prefix)?),
            entity: EntityId(hexadecimal(entity)?),
        })
    });
    parts.unwrap_or_default()
}

#[cfg(test)]
mod tests {
    use ros2probe_model::facts::bounded::{Declared as _, ledger};

    use super::*;

    #[test]
    fn topics_and_writers_beyond_the_caps_are_read_but_not_kept() {
        let mut reader = LineReader::new(Open { topics: Vec::new() });
        let cap = StreamTopics::CAP as u64;
        for number in (0..cap + 100).chain([3]) {
            let line = Line::Sample(samples::Sample {
                topic: format!("/t{number}"),
                domain_id: 0,
                message_type: "a/msg/B".to_owned(),
                time_ns: 1,
                writer: format!("010f00000000000000000000.{number:08x}"),
                sequence_number: number,
                source_timestamp_ns: None,
                header_stamp_ns: None,
                size: 4,
                sampled: false,
                payload_bytes: None,
                offered: None,
            });
            let Some(Item::Sample(sample)) = reader.item(&line, Bytes::new()) else {
                panic!("{line:?}");
            };
            assert_eq!(*sample.topic.name, format!("/t{number}"));
            assert_eq!(
                sample.writer.entity.0,
                u32::try_from(number).unwrap().to_be_bytes()
            );
        }
        let ledger = ledger();
        for table in [StreamTopics::TABLE, StreamWriters::TABLE] {
            let used = ledger[table.name];
            assert!(used.is_driven(), "{}: {used:?}", table.name);
        }
    }

    /// Earlier, a loss had the type of a subscriber, and a recording then left out all messages.
    #[test]
    fn a_loss_before_the_first_message_has_no_type() {
        let opened = samples::OpenTopic {
            topic: "/a".to_owned(),
            domain_id: 0,
            types: vec!["std_msgs/msg/Int32".to_owned()],
        };
        let mut reader = LineReader::new(Open {
            topics: vec![opened],
        });
        let missed = Line::Missed(samples::Missed {
            topic: "/a".to_owned(),
            domain_id: 0,
            writer: "01".to_owned(),
            samples: 1,
            first_sequence_number: 1,
            last_sequence_number: 1,
            reason: samples::MissedReason::Lost.into(),
        });
        let Some(Item::Missed(missed)) = reader.item(&missed, Bytes::new()) else {
            panic!("{missed:?}");
        };
        assert_eq!(&*missed.topic.message_type, "");
    }

    #[test]
    fn guids_and_stamps_are_read_in_the_form_in_which_they_are_written() {
        let writer = Guid {
            prefix: GuidPrefix([1, 0x0f, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12]),
            entity: EntityId([0, 0, 0x12, 3]),
        };
        assert_eq!(guid(&writer.to_string()), writer);
        assert_eq!(guid("hello"), Guid::default());
        assert_eq!(stamp(1_500_000_000), Some((1, 500_000_000)));
        assert_eq!(stamp(-1), Some((-1, 999_999_999)));
        assert_eq!(stamp(i64::MAX), None);
    }
}
