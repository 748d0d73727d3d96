//! The kernel filter's report of one submessage: the binary layout shared with user space.
//!
//! The kernel's ring buffer and the user-space walk over captured, replayed or shared-memory
//! datagrams yield the same [`Record`]s; the model does not distinguish them. Words are in the
//! host's byte order unless they hold wire bytes (GUIDs, addresses).
//!
//! All kinds share the words of a record. [`Record::body`] reads them according to the kind; only
//! the walk and the kernel program, which write them, use the fields directly.

mod body;

use zerocopy::{FromBytes, Immutable, IntoBytes, KnownLayout};

use crate::guid::{Guid, GuidPrefix};
use crate::time::{RtpsTime, Timestamp};

pub use body::{AckNack, Batch, Body, Data, DataFrag, Gap, Heartbeat, Sample, SequenceNumberSet};

/// Submessage kinds (RTPS 2.5, 9.4.5.1.1) and those specific to this ABI.
pub mod kind {
    use crate::rtps::SubmessageId;

    /// ACKNACK: a reader acknowledges samples and requests missing ones.
    pub const ACKNACK: u8 = SubmessageId::ACKNACK.0;
    /// HEARTBEAT: a writer announces the samples that it has.
    pub const HEARTBEAT: u8 = SubmessageId::HEARTBEAT.0;
    /// GAP: a writer announces samples that it will not send.
    pub const GAP: u8 = SubmessageId::GAP.0;
    /// DATA: one sample.
    pub const DATA: u8 = SubmessageId::DATA.0;
    /// DATA_FRAG: some fragments of one sample.
    pub const DATA_FRAG: u8 = SubmessageId::DATA_FRAG.0;
    /// DATA_BATCH of RTI Connext: several samples.
    pub const DATA_BATCH: u8 = SubmessageId::DATA_BATCH.0;
    /// Not a submessage: the fragmented datagram [`super::Record::datagram`] is complete, and all
    /// records written ahead for it are valid.
    pub const COMPLETE: u8 = 0xf0;
    /// Not a submessage: user space must walk this fragmented datagram itself from `offset`; its
    /// remaining IP fragments are captured. See [`super::Record::handover`].
    pub const HANDOVER: u8 = 0xf1;
    /// Not a submessage: the captured datagram [`super::Record::datagram`] was dropped at the full
    /// buffer of [`super::Record::socket`].
    pub const UNDELIVERED: u8 = 0xf2;
}

/// Bits of [`Record::flags`].
pub mod flag {
    /// The datagram arrived in several IP fragments.
    pub const FRAGMENTED: u16 = 1 << 0;
    /// The record was written before the datagram was complete. It becomes valid with the
    /// [`super::kind::COMPLETE`] record, or with a later record of the same datagram without this
    /// bit.
    pub const AHEAD: u16 = 1 << 1;
    /// This host sent the datagram.
    pub const OUTGOING: u16 = 1 << 2;
    /// `destination` is IPv6 (otherwise IPv4-mapped).
    pub const IPV6: u16 = 1 << 3;
    /// `payload_len` is an upper bound: the inline QoS exceeded the walk's limit.
    pub const INLINE_QOS_UNREAD: u16 = 1 << 4;
    /// `stamp_seconds` and `stamp_nanoseconds` hold the payload's bytes 4..12.
    pub const STAMP: u16 = 1 << 5;
    /// The datagram was seen as a whole at a socket of this host, not on an interface. With
    /// [`OUTGOING`] the socket sent it, otherwise it was about to enter the receive buffer of
    /// [`super::Record::socket`].
    pub const HOST: u16 = 1 << 6;
    /// A copy of a record with the same time, because the datagram was dropped at the socket's full
    /// buffer. DATA, DATA_FRAG and DATA_BATCH only.
    pub const SOCKET_FULL: u16 = 1 << 7;
    /// The datagram never became complete: the kernel timed out waiting for IP fragments, or had no
    /// memory for them. By default it waits 30 s with IPv4 (`net.ipv4.ipfrag_time`) and 60 s with
    /// IPv6 (`net.ipv6.ip6frag_time`). The record is written then, for the submessages in the first
    /// fragment. DATA, DATA_FRAG and DATA_BATCH only; `socket` is 0.
    pub const NOT_REASSEMBLED: u16 = 1 << 8;
    /// The message was read from shared memory between processes of this host, which is sampled.
    /// Missing samples may have been sent, unless [`EXACT`] is set.
    pub const SHM: u16 = 1 << 9;
    /// With [`SHM`]: the kernel program read every message in the sending process, so missing
    /// samples were not sent.
    pub const EXACT: u16 = 1 << 10;
    /// A TCP connection of Zenoh carried the sample: a copy is for another receiver, never a
    /// repetition. In a [`crate::host::Piece`]: the piece is a chunk of a TCP connection, or the
    /// head of a QUIC datagram.
    pub const STREAM: u16 = 1 << 11;
    /// With [`STREAM`]: the sample was sent to a router, which forwards it and is not a subscriber.
    pub const RELAYED: u16 = 1 << 12;
    /// The message came by a TCP connection that carries RTPS, from [`super::Record::source_port`].
    pub const TCP: u16 = 1 << 13;
    /// Of a piece: the bytes are those of a frame on an interface, from its IP header on.
    pub const FRAME: u16 = 1 << 14;
}

/// One submessage of one writer or reader. 136 bytes.
///
/// The fields from `payload_len` to `status_info`, and `sequence_number`, are named for DATA and
/// DATA_FRAG. Other kinds store other numbers there: [`Record::body`] names them.
#[derive(
    Clone, Copy, Default, PartialEq, Eq, Debug, FromBytes, IntoBytes, Immutable, KnownLayout,
)]
#[repr(C)]
pub struct Record {
    /// Time of the frame that completed the datagram, in nanoseconds. The kernel filter writes
    /// CLOCK_MONOTONIC, which is converted to the Unix epoch before the model reads it. Other
    /// sources write nanoseconds since the Unix epoch.
    pub time: u64,
    /// Writer GUID, 16 wire bytes.
    pub writer: [u32; 4],
    /// Reader GUID: INFO_DST's prefix and the submessage's reader id, both zero when unspecified.
    pub reader: [u32; 4],
    /// DATA, DATA_FRAG: writer SN. HEARTBEAT: firstSN. GAP: gapStart. ACKNACK: base. DATA_BATCH:
    /// number of the first sample.
    pub sequence_number: u64,
    /// INFO_TS in force, `seconds << 32 | fraction`; 0 = none. See [`RtpsTime`].
    pub source_timestamp: u64,
    /// Destination address, 16 wire bytes, IPv4-mapped for IPv4.
    pub destination: [u32; 4],
    /// Destination UDP port.
    pub destination_port: u16,
    /// Length of the whole UDP payload.
    pub datagram_len: u16,
    /// Index of the interface on which the frame was seen; 0 = unknown.
    pub interface: u32,
    /// Token of the datagram, unique for some seconds. On an interface, only a fragmented datagram has
    /// one; 0 = none.
    pub datagram: u32,
    /// One of [`kind`].
    pub kind: u8,
    /// The submessage header's flags octet.
    pub submessage_flags: u8,
    /// Bits of [`flag`].
    pub flags: u16,
    /// DATA, DATA_FRAG: bytes of serialized payload in this submessage, encapsulation included.
    /// HEARTBEAT: lastSN high word. GAP: gapList base high word. HANDOVER: walk offset. DATA_BATCH:
    /// bytes of all samples.
    pub payload_len: u32,
    /// DATA, DATA_FRAG: encapsulation identifier and options, as a big-endian number; 0 if the
    /// payload's first bytes are not in this submessage. HEARTBEAT: lastSN low. GAP: base low.
    /// HANDOVER: IP identification.
    pub encapsulation: u32,
    /// Payload bytes 4..8 as a number in the encapsulation's byte order: `Header.stamp.sec` if the
    /// type begins with a header. HEARTBEAT: count. GAP, ACKNACK: numBits.
    pub stamp_seconds: u32,
    /// Payload bytes 8..12 in the same byte order: `Header.stamp.nanosec`. GAP, ACKNACK: bitmap
    /// word 0.
    pub stamp_nanoseconds: u32,
    /// DATA_FRAG: fragmentStartingNum, 1-based. GAP, ACKNACK: bitmap word 1. DATA_BATCH: number of
    /// samples.
    pub fragment_start: u32,
    /// DATA_FRAG: fragmentsInSubmessage << 16 | fragmentSize. GAP, ACKNACK: bitmap word 2.
    pub fragments: u32,
    /// DATA_FRAG: sampleSize. GAP, ACKNACK: bitmap word 3. DATA_BATCH: distance of the last sample's
    /// number from the first's.
    pub sample_size: u32,
    /// DATA, DATA_FRAG: PID_STATUS_INFO of the inline QoS, 0 = alive. GAP, ACKNACK: bitmap word 4.
    pub status_info: u32,
    /// Cookie of the socket that receives or sends the datagram (`SO_COOKIE`); 0 = unknown.
    pub socket: u64,
    /// DATA_FRAG: nanoseconds from the first datagram of this record to the last, which is at
    /// `time`; saturates at `u32::MAX`.
    pub elapsed: u32,
    /// Source UDP port; 0 = unknown.
    pub source_port: u16,
    /// Zero.
    pub unused: u16,
}

const _: () = assert!(size_of::<Record>() == 136 && align_of::<Record>() == 8);

impl Record {
    /// Maximum number of bitmap bits of a GAP or ACKNACK in a record; a set has up to 256. For a
    /// longer GAP the walk returns [`crate::walk::Step::LongGap`]. A longer ACKNACK is cut.
    pub const BITMAP_BITS: u32 = 160;

    /// Returns the participant that sent the submessage: the reader's for an ACKNACK, otherwise the
    /// writer's.
    #[must_use]
    pub fn sender(&self) -> GuidPrefix {
        if self.is_acknack() {
            self.reader().prefix
        } else {
            self.writer().prefix
        }
    }

    /// Returns the participant to which the submessage is sent; unknown if it is sent to all
    /// matched readers.
    #[must_use]
    pub fn addressee(&self) -> GuidPrefix {
        if self.is_acknack() {
            self.writer().prefix
        } else {
            self.reader().prefix
        }
    }

    /// Returns the writer.
    #[must_use]
    pub fn writer(&self) -> Guid {
        zerocopy::transmute!(self.writer)
    }

    /// Returns the reader; unknown if the submessage is sent to all matched readers.
    #[must_use]
    pub fn reader(&self) -> Guid {
        zerocopy::transmute!(self.reader)
    }

    /// Returns the time of the first datagram, if the record covers fragments of several datagrams.
    #[must_use]
    pub const fn began(&self) -> Timestamp {
        Timestamp(self.time.saturating_sub(self.elapsed as u64))
    }

    /// Returns the INFO_TS in force.
    #[must_use]
    pub const fn source_timestamp(&self) -> RtpsTime {
        RtpsTime(self.source_timestamp)
    }

    /// DATA_FRAG: returns the number of consecutive fragments in this submessage.
    #[must_use]
    pub const fn fragments_in_submessage(&self) -> u32 {
        self.fragments >> 16
    }

    /// DATA_FRAG: returns the size in bytes of every fragment but the sample's last.
    #[must_use]
    pub const fn fragment_size(&self) -> u32 {
        self.fragments & 0xffff
    }

    /// DATA_FRAG: returns whether the record holds the sample's last fragment.
    #[inline(always)]
    #[must_use]
    pub const fn ends_sample(&self) -> bool {
        let size = self.fragment_size();
        if size == 0 {
            return true;
        }
        let end = self
            .fragment_start
            .wrapping_add(self.fragments_in_submessage());
        // The last fragment begins within the sample and reaches its end.
        end as u64 > (self.sample_size as u64).div_ceil(size as u64)
    }

    /// DATA_FRAG: returns whether `next` continues this record, for the same sample and reader.
    #[inline(always)]
    #[must_use]
    pub const fn is_followed_by(&self, next: &Self) -> bool {
        const OF_THE_DATAGRAM: u16 = flag::FRAGMENTED | flag::STAMP;
        let count = self.fragments_in_submessage();
        self.sequence_number == next.sequence_number
            && self.fragment_start.wrapping_add(count) == next.fragment_start
            && self.fragment_size() == next.fragment_size()
            && self.sample_size == next.sample_size
            && self.reader[3] == next.reader[3]
            && self.reader[2] == next.reader[2]
            && self.reader[1] == next.reader[1]
            && self.reader[0] == next.reader[0]
            && self.status_info == next.status_info
            && self.socket == next.socket
            && (self.flags ^ next.flags) & !OF_THE_DATAGRAM == 0
    }

    /// Merges `next` into this DATA_FRAG if its fragments follow. The record then covers fragments
    /// of several datagrams, with the time of the last. Returns `false` if they do not follow, or
    /// if the record would cover more than 65,535 fragments.
    #[inline(always)]
    pub const fn extend(&mut self, next: &Self) -> bool {
        let count = self.fragments_in_submessage() + next.fragments_in_submessage();
        if !self.is_followed_by(next) || count > 0xffff {
            return false;
        }
        let elapsed = next.time.saturating_sub(self.time) + self.elapsed as u64;
        self.elapsed = if elapsed > u32::MAX as u64 {
            u32::MAX
        } else {
            elapsed as u32
        };
        self.time = next.time;
        self.fragments = count << 16 | self.fragment_size();
        self.payload_len = self.payload_len.wrapping_add(next.payload_len);
        if self.source_timestamp == 0 {
            // Cyclone DDS sends INFO_TS with the first fragment only, other vendors with each.
            self.source_timestamp = next.source_timestamp;
        }
        true
    }

    /// Returns HEARTBEAT's lastSN or GAP's gapList base.
    const fn long(&self) -> u64 {
        (self.payload_len as u64) << 32 | self.encapsulation as u64
    }

    /// Returns the state from which user space continues the walk, for a [`kind::HANDOVER`].
    #[must_use]
    pub fn handover(&self) -> Handover {
        Handover {
            source: self.writer().prefix,
            destination: self.reader().prefix,
            source_address: zerocopy::transmute!([
                self.stamp_seconds,
                self.stamp_nanoseconds,
                self.fragment_start,
                self.fragments
            ]),
            identification: self.encapsulation,
            offset: self.payload_len,
            timestamp: [
                (self.source_timestamp >> 32) as u32,
                self.source_timestamp as u32,
            ],
        }
    }
}

/// Position and receiver state (RTPS 2.5, 8.3.4) from which user space continues a walk.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub struct Handover {
    /// Source GUID prefix in force.
    pub source: GuidPrefix,
    /// INFO_DST's prefix in force.
    pub destination: GuidPrefix,
    /// Source IP address, IPv4-mapped for IPv4.
    pub source_address: [u8; 16],
    /// IPv4 identification or IPv6 fragment identification.
    pub identification: u32,
    /// Offset of the next submessage header in the UDP payload.
    pub offset: u32,
    /// INFO_TS in force: seconds and fraction; zero = none.
    pub timestamp: [u32; 2],
}

/// Treatment of a writer or reader by the kernel filter: the value in the interest map. A writer
/// without an entry is unknown, and its first datagrams are captured within a budget.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Debug)]
#[repr(u32)]
pub enum Verdict {
    /// The endpoint is classified and of no interest.
    Ignore = 0,
    /// One record is written per submessage, and no payload is copied.
    Meter = 1,
    /// Whole datagrams are copied to user space.
    Capture = 2,
}

/// Returns the GUID as words, as in [`Record`] and in the keys of the interest map.
#[must_use]
pub fn guid_words(guid: Guid) -> [u32; 4] {
    zerocopy::transmute!(guid)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn fragments(start: u32, count: u32, time: u64) -> Record {
        Record {
            kind: kind::DATA_FRAG,
            sequence_number: 7,
            fragment_start: start,
            fragments: count << 16 | 1344,
            sample_size: 1344 * 10 + 1,
            payload_len: count * 1344,
            time,
            ..Record::default()
        }
    }

    #[test]
    fn fragments_that_follow_each_other_become_one_record() {
        let mut run = fragments(1, 5, 100);
        assert!(!run.ends_sample());
        assert!(run.extend(&fragments(6, 5, 200)));
        assert!(!run.ends_sample());
        assert!(run.extend(&fragments(11, 1, 300)));
        assert!(run.ends_sample());
        assert_eq!((run.fragment_start, run.fragments_in_submessage()), (1, 11));
        assert_eq!((run.time, run.payload_len), (300, 11 * 1344));
        assert_eq!(run.elapsed, 200);
    }

    #[test]
    fn fragments_after_a_gap_or_of_another_sample_or_reader_are_not_merged() {
        let run = fragments(1, 5, 100);
        let strangers = [
            fragments(7, 1, 1),
            fragments(5, 5, 1),
            Record {
                sequence_number: 8,
                ..fragments(6, 5, 1)
            },
            Record {
                reader: [0, 0, 0, 1],
                ..fragments(6, 5, 1)
            },
            Record {
                sample_size: 9,
                ..fragments(6, 5, 1)
            },
            Record {
                flags: flag::OUTGOING,
                ..fragments(6, 5, 1)
            },
            Record {
                socket: 1,
                ..fragments(6, 5, 1)
            },
            Record {
                fragments: 0xffff << 16 | 1344,
                ..fragments(6, 5, 1)
            },
        ];
        for stranger in strangers {
            let mut same = run;
            assert!(!same.extend(&stranger), "{stranger:?}");
            assert_eq!(same, run);
        }
    }

    #[test]
    fn a_fragment_size_of_zero_ends_the_sample() {
        assert!(
            Record {
                fragments: 1 << 16,
                ..fragments(1, 1, 1)
            }
            .ends_sample()
        );
    }
}
