//! Conversion from the kernel's record. No other file of the model uses that type.

use ros2probe_wire::Timestamp;
use ros2probe_wire::record::{self, Body, Record, flag};
use ros2probe_wire::rtps::SubmessageFlags;

use super::{
    AckNack, Content, DataFrag, DatagramFate, Gap, Head, Heartbeat, Observation, Path, Sample,
};
use crate::facts::route::{Destination, Direction};
use crate::facts::wall_clock::WallClock;

impl Observation {
    /// Converts a record of a complete datagram, whose time is wall time.
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
            Body::Complete | Body::Handover | Body::Undelivered | Body::Unknown => {
                Self::Presence(head)
            }
        }
    }

    /// Converts a record of a message that was polled in shared memory.
    #[must_use]
    pub fn of_polled(record: &Record, clock: WallClock) -> Self {
        let flags = record.flags | flag::SHM;
        Self::of(&Record { flags, ..*record }, clock)
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
            fate: if record.flags & flag::NOT_REASSEMBLED != 0 {
                DatagramFate::NotReassembled
            } else if record.flags & flag::SOCKET_FULL != 0 {
                DatagramFate::SocketFull
            } else {
                DatagramFate::Passed
            },
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
