//! The unit that the model counts: one submessage that a source saw, with time, endpoints and path.
//!
//! A Zenoh message becomes an observation of a DATA. Words and flags of the kernel's record have
//! several meanings. Only the module `record` reads them; the rest of the model uses these types.

mod record;

use std::time::Duration;

use ros2probe_wire::record::SequenceNumberSet;
use ros2probe_wire::rtps::StatusInfo;
use ros2probe_wire::{Guid, GuidPrefix, RtpsTime, SequenceNumber};

use crate::facts::model_time::ModelTime;
use crate::facts::route::{Destination, Direction, Route};

/// Index of the loopback interface. It is the first in every network namespace.
pub const LOOPBACK: u32 = 1;

/// One submessage that a source saw.
#[derive(Clone, Copy, Debug)]
pub enum Observation {
    /// DATA or DATA_FRAG.
    Sample(Sample),
    /// HEARTBEAT.
    Heartbeat(Heartbeat),
    /// GAP.
    Gap(Gap),
    /// ACKNACK.
    AckNack(AckNack),
    /// A packet that shows only that its sender is alive.
    Presence(Head),
}

/// Fields that all observations have: the time, the endpoints and the path.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub struct Head {
    /// Time of the last datagram.
    pub at: ModelTime,
    /// Nanoseconds from the first datagram to the last; `u32::MAX` means at least that many.
    pub elapsed: u32,
    /// The writer.
    pub writer: Guid,
    /// The reader; unknown for a submessage to all matched readers.
    pub reader: Guid,
    /// Where it was seen.
    pub path: Path,
    /// Direction of the datagram: sent or received.
    pub direction: Direction,
    /// Cookie of the socket that sends or receives it; 0 = unknown.
    pub socket: u64,
    /// Destination of the datagram.
    pub destination: Destination,
    /// Source port of the TCP connection that carried it as RTPS; 0 for a datagram.
    pub tcp_source_port: u16,
    /// Index of the interface; 0 = unknown.
    pub interface: u32,
    /// Bytes of the datagram's UDP payload, at most 65,535; 0 = unknown.
    pub datagram_len: u16,
}

/// Where a submessage was seen.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum Path {
    /// On an interface.
    Wire,
    /// At a socket of this host: after its sender, or before its receiver's buffer.
    Socket,
    /// In shared memory of this host.
    SharedMemory {
        /// Whether a probe in the sender saw it. A probe sees every message; polling misses some.
        exact: bool,
    },
    /// On a TCP connection of Zenoh: a copy is for another receiver, never a repetition.
    Stream {
        /// Whether the connection leads to a router, which forwards messages and is not a
        /// subscriber.
        relayed: bool,
        /// Whether it was seen at a socket of this host, not on an interface.
        at_socket: bool,
    },
}

/// A DATA, or consecutive DATA_FRAGs of one sample.
#[derive(Clone, Copy, Debug)]
pub struct Sample {
    /// When and where it was seen.
    pub head: Head,
    /// writerSN.
    pub sequence_number: SequenceNumber,
    /// The INFO_TS in force.
    pub source_timestamp: RtpsTime,
    /// PID_STATUS_INFO of the inline QoS, [`StatusInfo::ALIVE`] if absent (RTPS 2.5, 9.6.4.9).
    pub status_info: StatusInfo,
    /// Whether the payload is a value, not a key and not empty.
    pub has_value: bool,
    /// Whether the beginning of the payload is known; a long inline QoS hides it.
    pub has_known_begin: bool,
    /// `std_msgs/Header.stamp` as seconds and nanoseconds, if the payload begins with one. `None`
    /// if the payload's first bytes were not seen or cannot be a stamp.
    pub header_stamp: Option<(i32, u32)>,
    /// What the kernel did with the datagram.
    pub fate: DatagramFate,
    /// The submessage and its sizes.
    pub content: Content,
}

/// The submessages that carry samples.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum Content {
    /// The whole sample.
    Data {
        /// Bytes of serialized payload, encapsulation included.
        size: u32,
    },
    /// Consecutive fragments of the sample.
    DataFrag(DataFrag),
}

/// DATA_FRAG (RTPS 2.5, 9.4.5.5), or several consecutive ones. All fields are unverified.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub struct DataFrag {
    /// fragmentStartingNum: the number of the first fragment, counted from 1.
    pub starting: u32,
    /// fragmentsInSubmessage, summed over all submessages.
    pub count: u32,
    /// fragmentSize: bytes of every fragment but the sample's last.
    pub fragment_size: u32,
    /// sampleSize: bytes of the whole payload.
    pub sample_size: u32,
}

/// What the kernel did with the datagram of a sample.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum DatagramFate {
    /// It was passed on.
    Passed,
    /// The receiving socket's buffer was full. A second observation of the same arrival follows,
    /// which reports it as passed on.
    SocketFull,
    /// Some of its IP fragments never arrived.
    NotReassembled,
}

/// HEARTBEAT (RTPS 2.5, 9.4.5.7).
#[derive(Clone, Copy, Debug)]
pub struct Heartbeat {
    /// When and where it was seen.
    pub head: Head,
    /// firstSN: the oldest sample that the writer has; one more than `last` if it has none.
    pub first: SequenceNumber,
    /// lastSN: the newest sample.
    pub last: SequenceNumber,
}

/// GAP (RTPS 2.5, 9.4.5.6): the writer will not send the samples from `start` up to the base of
/// `list`, exclusive, nor the members of `list`. The span may have any length.
#[derive(Clone, Copy, Debug)]
pub struct Gap {
    /// When and where it was seen.
    pub head: Head,
    /// gapStart.
    pub start: SequenceNumber,
    /// gapList.
    pub list: SequenceNumberSet,
}

/// ACKNACK (RTPS 2.5, 9.4.5.3).
#[derive(Clone, Copy, Debug)]
pub struct AckNack {
    /// When and where it was seen.
    pub head: Head,
    /// readerSNState: all samples below its base are acknowledged, its members are missing.
    pub missing: SequenceNumberSet,
}

impl Observation {
    /// Returns the time, the endpoints and the path.
    #[must_use]
    pub const fn head(&self) -> &Head {
        match self {
            Self::Sample(sample) => &sample.head,
            Self::Heartbeat(heartbeat) => &heartbeat.head,
            Self::Gap(gap) => &gap.head,
            Self::AckNack(acknack) => &acknack.head,
            Self::Presence(head) => head,
        }
    }

    /// Returns the DATA or DATA_FRAG, if it is one.
    #[must_use]
    pub const fn sample(&self) -> Option<&Sample> {
        match self {
            Self::Sample(sample) => Some(sample),
            _ => None,
        }
    }

    /// Returns the participant that sent it: the reader's for an ACKNACK, otherwise the writer's.
    #[must_use]
    pub const fn sender(&self) -> GuidPrefix {
        match self {
            Self::AckNack(acknack) => acknack.head.reader.prefix,
            _ => self.head().writer.prefix,
        }
    }

    /// Returns the addressed participant; unknown for a submessage to all matched readers.
    #[must_use]
    pub const fn addressee(&self) -> GuidPrefix {
        match self {
            Self::AckNack(acknack) => acknack.head.writer.prefix,
            _ => self.head().reader.prefix,
        }
    }
}

impl Head {
    /// Returns the time of the first datagram.
    #[must_use]
    pub fn began(&self) -> ModelTime {
        self.at - Duration::from_nanos(self.elapsed.into())
    }

    /// Returns whether it was sent, not received.
    #[must_use]
    pub fn is_sent(&self) -> bool {
        self.direction == Direction::Sent
    }

    /// Returns whether it was seen at a socket of this host.
    #[must_use]
    pub const fn is_at_socket(&self) -> bool {
        match self.path {
            Path::Socket => true,
            Path::Stream { at_socket, .. } => at_socket,
            Path::Wire | Path::SharedMemory { .. } => false,
        }
    }

    /// Returns whether it was seen in shared memory.
    #[must_use]
    pub const fn is_in_shared_memory(&self) -> bool {
        matches!(self.path, Path::SharedMemory { .. })
    }

    /// Returns whether it was seen by polling shared memory, which may miss other messages.
    #[must_use]
    pub fn is_polled(&self) -> bool {
        self.path == Path::SharedMemory { exact: false }
    }

    /// Returns whether a uprobe in the sending process saw it. Uprobes do not sample.
    #[must_use]
    pub fn is_exact(&self) -> bool {
        self.path == Path::SharedMemory { exact: true }
    }

    /// Returns whether its sender is on this host, as far as the path shows that.
    #[must_use]
    pub fn is_outgoing(&self) -> bool {
        self.is_sent()
            || self.is_in_shared_memory()
            || !self.is_at_socket() && self.interface == LOOPBACK
    }

    /// Returns the participant that it is directed at (INFO_DST); `None` for all matched readers.
    #[must_use]
    pub fn directed_at(&self) -> Option<GuidPrefix> {
        Some(self.reader.prefix).filter(|prefix| *prefix != GuidPrefix::UNKNOWN)
    }

    /// Returns the route of the datagram.
    #[must_use]
    pub fn route(&self) -> Route {
        let is_receiver = self.is_at_socket() && !self.is_sent();
        Route {
            direction: self.direction,
            socket: if is_receiver { self.socket } else { 0 },
            destination: self.destination,
        }
    }
}

impl Sample {
    /// Returns the size of the whole sample's serialized payload in bytes, including encapsulation.
    /// For DATA_FRAG it is unverified, so no memory may be allocated in proportion to it.
    #[must_use]
    pub const fn size(&self) -> u32 {
        match self.content {
            Content::Data { size } => size,
            Content::DataFrag(fragments) => fragments.sample_size,
        }
    }

    /// Returns whether the sample is a value of a living instance, not a disposal.
    #[must_use]
    pub fn is_message(&self) -> bool {
        self.has_value && self.status_info == StatusInfo::ALIVE
    }

    /// Returns whether it holds the sample's first byte.
    #[must_use]
    pub const fn is_start(&self) -> bool {
        match self.content {
            Content::Data { .. } => true,
            Content::DataFrag(fragments) => fragments.starting == 1,
        }
    }

    /// Returns whether it holds the sample's last byte.
    #[must_use]
    pub const fn is_end(&self) -> bool {
        match self.content {
            Content::Data { .. } => true,
            Content::DataFrag(fragments) => fragments.is_end(),
        }
    }

    /// Returns whether its datagram was passed on. Otherwise it does not count as a transmission.
    #[must_use]
    pub fn is_delivered(&self) -> bool {
        self.fate == DatagramFate::Passed
    }
}

impl DataFrag {
    /// Returns the number of fragments of the whole sample; 0 for an invalid fragment size.
    #[must_use]
    pub const fn total(&self) -> u32 {
        match self.fragment_size {
            0 => 0,
            size => self.sample_size.div_ceil(size),
        }
    }

    /// Returns whether it holds the sample's last fragment.
    const fn is_end(&self) -> bool {
        self.fragment_size == 0 || self.starting.wrapping_add(self.count) > self.total()
    }
}

impl AckNack {
    /// Returns the number below which the reader acknowledges all samples.
    #[must_use]
    pub const fn base(&self) -> SequenceNumber {
        self.missing.base
    }
}

#[cfg(test)]
pub(crate) mod tests;
