//! Conversion from the kernel's record. No other file of the model uses that type.

use ros2probe_wire::record::{self, Body, Record, SequenceNumberSet, flag};
use ros2probe_wire::rtps::{StatusInfo, SubmessageFlags};
use ros2probe_wire::{RtpsTime, Timestamp};

use super::{
    AckNack, Content, DataFrag, DatagramFate, Gap, Head, Heartbeat, Observation, Path, Sample,
};
use crate::facts::route::{Destination, Direction};
use crate::facts::wall_clock::WallClock;

impl Observation {
    /// Calls `observe` with each observation of a record of a complete datagram, whose time is wall
    /// time. Only a DATA_BATCH has several, or none.
    pub fn each(record: &Record, clock: WallClock, mut observe: impl FnMut(&Self)) {
        match record.body() {
            Body::Batch(batch) => for_each_of_batch(batch, Head::of(record, clock), observe),
            _ => observe(&Self::of(record, clock)),
        }
    }

    /// Calls `observe` as [`Self::each`] does, with the record of a message that was polled in
    /// shared memory.
    pub fn for_each_polled(record: &Record, clock: WallClock, observe: impl FnMut(&Self)) {
        let flags = record.flags | flag::SHM;
        Self::each(&Record { flags, ..*record }, clock, observe);
    }

    /// Converts a record of a complete datagram, whose time is wall time. Of a DATA_BATCH, it only
    /// shows that the sender is alive.
    #[must_use]
    pub fn of(record: &Record, clock: WallClock) -> Self {
        let head = Head::of(record, clock);
        match record.body() {
            Body::Sample(sample) => Self::Sample(Sample::of(sample, head)),
            Body::Heartbeat(heartbeat) => Self::Heartbeat(Heartbeat {
                head,
                first: heartbeat.first(),
                last: heartbeat.last(),
            }),
            Body::Gap(gap) => Self::Gap(Gap {
                head,
                start: gap.start(),
                list: gap.list(),
            }),
            Body::AckNack(acknack) => Self::AckNack(AckNack {
                head,
                missing: acknack.missing(),
            }),
            Body::Batch(_)
            | Body::Complete
            | Body::Handover
            | Body::Undelivered
            | Body::Unknown => Self::Presence(head),
        }
    }
}

/// Calls `observe` with the samples of a batch. Numbers that no sample of the batch has will not be
/// sent, as a GAP says. The size of each sample is their mean. The last sample has the last number,
/// and all others follow each other.
fn for_each_of_batch(batch: record::Batch<'_>, head: Head, mut observe: impl FnMut(&Observation)) {
    let Some(others) = batch.count().checked_sub(1) else {
        return;
    };
    let (size, rest) = (batch.size() / batch.count(), batch.size() % batch.count());
    let fate = DatagramFate::of(batch.record());
    let mut sample = |sequence_number, size| {
        observe(&Observation::Sample(Sample {
            head,
            sequence_number,
            // A batch has a time for each sample, which is not read.
            source_timestamp: RtpsTime::default(),
            status_info: StatusInfo::ALIVE,
            has_value: true,
            has_known_begin: false,
            header_stamp: None,
            fate,
            content: Content::Data { size },
        }));
    };
    let end = batch.first().saturating_add(others.into());
    for number in batch.first().until(end) {
        sample(number, size);
    }
    sample(batch.last(), size + rest);
    if end < batch.last() {
        observe(&Observation::Gap(Gap {
            head,
            start: end,
            list: SequenceNumberSet::empty(batch.last()),
        }));
    }
}

impl DatagramFate {
    const fn of(record: &Record) -> Self {
        if record.flags & flag::NOT_REASSEMBLED != 0 {
            Self::NotReassembled
        } else if record.flags & flag::SOCKET_FULL != 0 {
            Self::SocketFull
        } else {
            Self::Passed
        }
    }
}

impl Head {
    fn of(record: &Record, clock: WallClock) -> Self {
        let has = |bit| record.flags & bit != 0;
        let path = if has(flag::SHM) {
            Path::SharedMemory {
                exact: has(flag::EXACT),
            }
        } else if has(flag::STREAM) {
            Path::Stream {
                relayed: has(flag::RELAYED),
                at_socket: has(flag::HOST),
            }
        } else if has(flag::HOST) {
            Path::Socket
        } else {
            Path::Wire
        };
        Self {
            at: clock.model_time(Timestamp(record.time)),
            elapsed: record.elapsed,
            writer: record.writer(),
            reader: record.reader(),
            path,
            direction: match has(flag::OUTGOING) {
                true => Direction::Sent,
                false => Direction::Received,
            },
            socket: record.socket,
            destination: Destination {
                address: bytes(record.destination),
                port: record.destination_port,
            },
            tcp_source_port: match has(flag::TCP) {
                true => record.source_port,
                false => 0,
            },
            interface: record.interface,
            datagram_len: record.datagram_len,
        }
    }
}

impl Sample {
    fn of(sample: record::Sample<'_>, head: Head) -> Self {
        let record = sample.record();
        let (has_value, content) = match sample {
            record::Sample::Data(data) => {
                let size = data.payload_len();
                let has_value = data.flags().contains(SubmessageFlags::DATA);
                (has_value, Content::Data { size })
            }
            record::Sample::DataFrag(fragments) => {
                let content = DataFrag {
                    starting: fragments.starting(),
                    count: fragments.count(),
                    fragment_size: fragments.fragment_size(),
                    sample_size: fragments.sample_size(),
                };
                (!fragments.is_key(), Content::DataFrag(content))
            }
        };
        Self {
            head,
            sequence_number: sample.sequence_number(),
            source_timestamp: sample.source_timestamp(),
            status_info: sample.status_info(),
            has_value,
            has_known_begin: record.flags & flag::INLINE_QOS_UNREAD == 0,
            header_stamp: sample.header_stamp(),
            fate: DatagramFate::of(record),
            content,
        }
    }
}

/// Returns four words as the wire bytes that they hold.
fn bytes(words: [u32; 4]) -> [u8; 16] {
    let words = words.map(u32::to_ne_bytes);
    let mut bytes = [0; 16];
    for (into, from) in bytes.iter_mut().zip(words.as_flattened()) {
        *into = *from;
    }
    bytes
}
