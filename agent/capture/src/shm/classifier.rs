//! The verdict on a message in shared memory: the kernel filter's rules, on the same walk.
//!
//! Messages are ignored, metered as records, or captured whole. Messages of unknown writers are
//! captured, then metered, each within a budget. Only the parts that the walk needs are read: the
//! first 256 bytes for a point cloud's fragment.

use std::collections::HashMap;

use ros2probe_model::facts::bounded::Bounded;
use ros2probe_wire::filter::UNKNOWN_CAPTURE_BYTES;
use ros2probe_wire::record::{Record, Verdict, guid_words};
use ros2probe_wire::time::SECOND;
use ros2probe_wire::walk::{self, Bytes, Fate, MAGIC, Step, Walk};
use ros2probe_wire::{EntityId, Guid};

use crate::tables::UnknownShmWriters;

/// Maximum number of submessages read per message; a message with more is captured.
const SUBMESSAGES: usize = 64;
/// Budget of all unknown writers per second: bytes captured, and records.
const CAPTURE_PER_SECOND: i64 = 4 << 20;
const RECORDS_PER_SECOND: i64 = 4096;

/// What happens to a message.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum MessageVerdict {
    /// The message is discarded: none of its submessages is of interest.
    Ignored,
    /// The message is metered: the appended records are valid.
    Metered,
    /// The message is captured: user space must read it whole.
    Captured,
    /// The message is not an RTPS message.
    Foreign,
}

/// The rules and the interest map.
#[derive(Debug)]
pub struct MessageClassifier {
    interest: HashMap<[u32; 4], Verdict>,
    /// Number of captured bytes of each unknown writer.
    unknown: Bounded<UnknownShmWriters, HashMap<[u32; 4], u32>>,
    capture_left: i64,
    records_left: i64,
    refilled: u64,
    /// Whether the last captured message announces endpoints or perhaps nodes, and more
    /// announcements may follow.
    pub announces: bool,
    /// Whether the last captured message belongs to a writer of discovery.
    pub is_builtin: bool,
    /// Whether the last captured message belongs to a writer whose messages are captured whole: a
    /// participant's nodes, or samples that are read.
    pub is_wanted: bool,
}

/// Creates a classifier without known endpoints.
impl Default for MessageClassifier {
    fn default() -> Self {
        Self {
            interest: HashMap::new(),
            unknown: Bounded::default(),
            capture_left: CAPTURE_PER_SECOND,
            records_left: RECORDS_PER_SECOND,
            refilled: 0,
            announces: false,
            is_builtin: false,
            is_wanted: false,
        }
    }
}

impl MessageClassifier {
    /// Sets the verdict of a writer or reader; `None` = unknown.
    pub fn set(&mut self, guid: Guid, verdict: Option<Verdict>) {
        let key = guid_words(guid);
        match verdict {
            Some(verdict) => self.interest.insert(key, verdict),
            None => self.interest.remove(&key),
        };
        self.unknown.remove(&key);
    }

    /// Refills the budget of unknown writers for the next second.
    pub fn refill(&mut self, now: u64) {
        if now.saturating_sub(self.refilled) >= SECOND {
            self.refilled = now;
            (self.capture_left, self.records_left) = (CAPTURE_PER_SECOND, RECORDS_PER_SECOND);
        }
    }

    /// Returns the verdict on a message of `length` bytes. Appends records based on `template`,
    /// which holds the fields of the whole message. The records are valid if the message is
    /// metered.
    pub fn classify<B: Bytes>(
        &mut self,
        message: &B,
        length: u32,
        template: Record,
        records: &mut Vec<Record>,
    ) -> MessageVerdict {
        let Some([magic, _version, source @ ..]) = message.words::<5>(0) else {
            return MessageVerdict::Foreign;
        };
        if magic != MAGIC {
            return MessageVerdict::Foreign;
        }
        let mut walk = Walk {
            record: template,
            ..Walk::default()
        };
        walk.begin(source, length);
        walk.record.datagram_len = u16::try_from(length).unwrap_or(u16::MAX);
        let first = records.len();
        for _ in 0..SUBMESSAGES {
            let step = walk::step(&mut walk, message, length);
            let wanted = match step {
                Step::Passed => continue,
                Step::Endpoint | Step::LongGap => self.wanted(&walk.record, length),
                Step::End | Step::Later | Step::Split | Step::Malformed => {
                    return if records.len() > first {
                        MessageVerdict::Metered
                    } else {
                        MessageVerdict::Ignored
                    };
                }
            };
            match wanted {
                Verdict::Ignore => {}
                Verdict::Meter if step != Step::LongGap => records.push(Record {
                    flags: walk.record.flags | template.flags,
                    ..walk.record
                }),
                Verdict::Meter | Verdict::Capture => {
                    let is_sample = walk.record.is_sample();
                    let writer = walk.record.writer().entity;
                    self.announces = is_sample && writer != EntityId::SPDP_WRITER;
                    self.is_builtin = writer.is_builtin();
                    self.is_wanted = self.interest.contains_key(&walk.record.writer);
                    records.truncate(first);
                    return MessageVerdict::Captured;
                }
            }
        }
        records.truncate(first);
        MessageVerdict::Captured
    }

    fn wanted(&mut self, record: &Record, length: u32) -> Verdict {
        match walk::fate(record) {
            Fate::Ignore => Verdict::Ignore,
            Fate::Capture => Verdict::Capture,
            Fate::Reader => {
                let wanted = self.interest.get(&record.reader);
                wanted.copied().unwrap_or(Verdict::Ignore)
            }
            Fate::Writer => match self.interest.get(&record.writer) {
                Some(verdict) => *verdict,
                None => self.unknown(record.writer, length),
            },
        }
    }

    /// Captures within the writer's budget, then meters within the common budget.
    fn unknown(&mut self, writer: [u32; 4], length: u32) -> Verdict {
        let is_datagram = length <= u16::MAX.into();
        if is_datagram
            && self.capture_left > 0
            && let Some(used) = self.unknown.get_or_insert_with(writer, || 0)
            && *used < UNKNOWN_CAPTURE_BYTES
        {
            *used = used.saturating_add(length);
            self.capture_left -= i64::from(length);
            return Verdict::Capture;
        }
        if self.records_left > 0 {
            self.records_left -= 1;
            return Verdict::Meter;
        }
        Verdict::Ignore
    }
}

#[cfg(test)]
mod tests {
    use ros2probe_wire::record::{flag, kind};

    use super::*;
    use crate::tables::tests::assert_driven;

    const WRITER: [u8; 4] = [0, 0, 1, 3];

    fn guid(entity: [u8; 4]) -> Guid {
        let mut bytes = [9; 16];
        bytes[12..].copy_from_slice(&entity);
        Guid::from_bytes(bytes)
    }

    /// Returns a message with samples of writers.
    pub(super) fn message(samples: &[([u8; 4], u32)]) -> Vec<u8> {
        let mut bytes = b"RTPS\x02\x03\x01\x0f".to_vec();
        bytes.extend([9; 12]);
        for (writer, number) in samples {
            bytes.extend([0x15, 0x05, 32, 0, 0, 0, 16, 0, 0, 0, 0, 0]);
            bytes.extend(writer);
            bytes.extend([0; 4]);
            bytes.extend(number.to_le_bytes());
            bytes.extend([0, 1, 0, 0, 1, 0, 0, 0, 2, 0, 0, 0]);
        }
        bytes
    }

    fn classify(judge: &mut MessageClassifier, message: &[u8]) -> (MessageVerdict, Vec<Record>) {
        let mut records = Vec::new();
        let template = Record {
            flags: flag::SHM,
            ..Record::default()
        };
        let length = u32::try_from(message.len()).unwrap();
        let judgement = judge.classify(&message, length, template, &mut records);
        (judgement, records)
    }

    #[test]
    fn every_sample_of_a_measured_writer_becomes_a_record() {
        let mut rules = MessageClassifier::default();
        rules.set(guid(WRITER), Some(Verdict::Meter));
        rules.set(guid([0, 0, 2, 3]), Some(Verdict::Ignore));
        let message = message(&[(WRITER, 7), ([0, 0, 2, 3], 1), (WRITER, 8)]);
        let (judgement, records) = classify(&mut rules, &message);
        assert_eq!(judgement, MessageVerdict::Metered);
        let numbers: Vec<_> = records.iter().map(|one| one.sequence_number).collect();
        assert_eq!(numbers, [7, 8]);
        assert!(records.iter().all(|record| {
            record.kind == kind::DATA
                && record.writer() == guid(WRITER)
                && record.flags & flag::SHM != 0
                && record.payload_len == 12
        }));
    }

    #[test]
    fn a_message_with_discovery_is_always_captured() {
        let mut rules = MessageClassifier::default();
        rules.set(guid(WRITER), Some(Verdict::Meter));
        let participant = message(&[(WRITER, 1), ([0, 1, 0, 0xc2], 1)]);
        assert_eq!(
            classify(&mut rules, &participant),
            (MessageVerdict::Captured, vec![])
        );
        assert!(!rules.announces);
        let endpoint = message(&[(WRITER, 1), ([0, 0, 3, 0xc2], 1)]);
        assert_eq!(classify(&mut rules, &endpoint).0, MessageVerdict::Captured);
        assert!(rules.announces && !rules.is_wanted);
        rules.set(guid(WRITER), Some(Verdict::Capture));
        let read = message(&[(WRITER, 2)]);
        assert_eq!(classify(&mut rules, &read).0, MessageVerdict::Captured);
        assert!(rules.announces && rules.is_wanted);
    }

    #[test]
    fn messages_of_no_interest_and_messages_that_are_not_rtps_are_ignored() {
        let mut rules = MessageClassifier::default();
        rules.set(guid(WRITER), Some(Verdict::Ignore));
        assert_eq!(
            classify(&mut rules, &message(&[(WRITER, 1)])).0,
            MessageVerdict::Ignored
        );
        assert_eq!(classify(&mut rules, b"RTPX").0, MessageVerdict::Foreign);
        assert_eq!(classify(&mut rules, &[0; 100]).0, MessageVerdict::Foreign);
        assert_eq!(
            classify(&mut rules, &message(&[])).0,
            MessageVerdict::Ignored
        );
    }

    #[test]
    fn an_unknown_writer_is_captured_then_metered_then_ignored() {
        let mut rules = MessageClassifier::default();
        let message = message(&[(WRITER, 1)]);
        let mut counts = [0; 3];
        for _ in 0..UNKNOWN_CAPTURE_BYTES {
            counts[match classify(&mut rules, &message).0 {
                MessageVerdict::Captured => 0,
                MessageVerdict::Metered => 1,
                _ => 2,
            }] += 1;
        }
        let [captured, metered, ignored] = counts;
        assert_eq!(
            captured,
            UNKNOWN_CAPTURE_BYTES.div_ceil(message.len() as u32)
        );
        assert_eq!(i64::from(metered), RECORDS_PER_SECOND);
        assert!(ignored > 0);
        rules.refill(SECOND);
        assert_eq!(classify(&mut rules, &message).0, MessageVerdict::Metered);
        rules.set(guid(WRITER), Some(Verdict::Ignore));
        assert_eq!(classify(&mut rules, &message).0, MessageVerdict::Ignored);
    }

    #[test]
    fn a_flood_of_invented_writers_stays_within_the_budget() {
        let mut rules = MessageClassifier::default();
        let mut captured = 0;
        for writer in 0..200_000_u32 {
            let [_, a, b, c] = writer.to_be_bytes();
            let message = message(&[([a, b, c, 3], 1)]);
            if classify(&mut rules, &message).0 == MessageVerdict::Captured {
                captured += message.len();
            }
        }
        assert!(
            captured <= CAPTURE_PER_SECOND as usize + 65_536,
            "{captured}"
        );
        assert_driven::<UnknownShmWriters>();
    }
}
