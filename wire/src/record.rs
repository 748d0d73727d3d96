//! What the kernel filter tells user space about one submessage: the shared binary layout.
//!
//! The same [`Record`]s come out of the kernel's ring buffer and out of the user-space walk over
//! captured, replayed or shared-memory datagrams; the model cannot tell the difference. Words are
//! in the host's byte order except where they hold wire bytes (GUIDs, addresses).
//!
//! The kinds share the words of a record. [`Record::body`] reads them as the kind has it; only the
//! walk and the kernel program, which write them, use the fields themselves.

mod body;

use zerocopy::{FromBytes, Immutable, IntoBytes, KnownLayout};

use crate::guid::{Guid, GuidPrefix};
use crate::time::{RtpsTime, Timestamp};

pub use body::{AckNack, Body, Data, DataFrag, Gap, Heartbeat, Sample, SequenceNumberSet};

/// Submessage kinds (RTPS 2.5, 9.4.5.1.1) and the two that only this ABI knows.
pub mod kind {
    use crate::rtps::SubmessageId;

    /// ACKNACK: reader acknowledges and asks again.
    pub const ACKNACK: u8 = SubmessageId::ACKNACK.0;
    /// HEARTBEAT: writer says what it has.
    pub const HEARTBEAT: u8 = SubmessageId::HEARTBEAT.0;
    /// GAP: writer says what will never come.
    pub const GAP: u8 = SubmessageId::GAP.0;
    /// DATA: one sample.
    pub const DATA: u8 = SubmessageId::DATA.0;
    /// DATA_FRAG: some fragments of one sample.
    pub const DATA_FRAG: u8 = SubmessageId::DATA_FRAG.0;
    /// Not a submessage: the fragmented datagram [`super::Record::datagram`] is complete, all
    /// records that were sent ahead for it now count.
    pub const COMPLETE: u8 = 0xf0;
    /// Not a submessage: from `offset` on, user space has to walk this fragmented datagram itself;
    /// its remaining IP fragments are captured. See [`super::Record::handover`].
    pub const HANDOVER: u8 = 0xf1;
    /// Not a submessage: the captured datagram [`super::Record::datagram`] was not delivered to
    /// [`super::Record::socket`], which had no room for it.
    pub const UNDELIVERED: u8 = 0xf2;
}

/// Bits of [`Record::flags`].
pub mod flag {
    /// The datagram came in several IP fragments.
    pub const FRAGMENTED: u16 = 1 << 0;
    /// The datagram was not complete yet when this was written: it counts once the
    /// [`super::kind::COMPLETE`] record or a later record of the same datagram without this bit
    /// has come.
    pub const AHEAD: u16 = 1 << 1;
    /// Sent by this host.
    pub const OUTGOING: u16 = 1 << 2;
    /// `destination` is IPv6 (otherwise IPv4-mapped).
    pub const IPV6: u16 = 1 << 3;
    /// `payload_len` is an upper bound: the inline QoS was longer than the walk follows.
    pub const INLINE_QOS_UNREAD: u16 = 1 << 4;
    /// `stamp_seconds` and `stamp_nanoseconds` hold the payload's bytes 4..12.
    pub const STAMP: u16 = 1 << 5;
    /// Seen at a socket of this host, as a whole datagram, not on an interface: on its way out
    /// with [`OUTGOING`], otherwise on its way into the receive buffer of
    /// [`super::Record::socket`].
    pub const HOST: u16 = 1 << 6;
    /// A copy of a record of the same time: the socket had no room, the datagram was not delivered
    /// to it. DATA and DATA_FRAG only.
    pub const NO_ROOM: u16 = 1 << 7;
    /// The datagram never became complete: the kernel gave up waiting for IP fragments. Written
    /// when it does (`net.ipv4.ipfrag_time`, 30 s), for what its first fragment shows. DATA and
    /// DATA_FRAG only; `socket` is 0.
    pub const NOT_REASSEMBLED: u16 = 1 << 8;
    /// Read from shared memory between processes of this host: a sampled view, in which what is
    /// missing may have been sent all the same, unless [`EXACT`] is set.
    pub const SHM: u16 = 1 << 9;
    /// With [`SHM`]: not read there, but seen in the process that put it there, as every message of
    /// that process is: what is missing was not sent. Written by the kernel program.
    pub const EXACT: u16 = 1 << 10;
}

/// One submessage of one writer or reader. 136 bytes.
///
/// The fields from `payload_len` to `status_info`, and `sequence_number`, are named for DATA and
/// DATA_FRAG. Other kinds keep other numbers there: [`Record::body`] names them.
#[derive(
    Clone, Copy, Default, PartialEq, Eq, Debug, FromBytes, IntoBytes, Immutable, KnownLayout,
)]
#[repr(C)]
pub struct Record {
    /// Nanoseconds: from the kernel filter CLOCK_MONOTONIC at the frame that completed the datagram
    /// (converted to the Unix epoch before the model sees it), elsewhere the Unix epoch.
    pub time: u64,
    /// Writer GUID, 16 wire bytes.
    pub writer: [u32; 4],
    /// Reader GUID: INFO_DST's prefix and the submessage's reader id, both zero when unspecified.
    pub reader: [u32; 4],
    /// DATA, DATA_FRAG: writer SN. HEARTBEAT: firstSN. GAP: gapStart. ACKNACK: base.
    pub sequence_number: u64,
    /// INFO_TS in force, `seconds << 32 | fraction`; 0 = none. See [`RtpsTime`].
    pub source_timestamp: u64,
    /// Destination address, 16 wire bytes, IPv4-mapped for IPv4.
    pub destination: [u32; 4],
    /// Destination UDP port.
    pub destination_port: u16,
    /// Length of the whole UDP payload.
    pub datagram_len: u16,
    /// Interface index the frame was seen on; 0 = unknown.
    pub interface: u32,
    /// Names one fragmented datagram among those of the last seconds; 0 when not fragmented.
    pub datagram: u32,
    /// One of [`kind`].
    pub kind: u8,
    /// The submessage header's flags octet.
    pub submessage_flags: u8,
    /// Bits of [`flag`].
    pub flags: u16,
    /// DATA, DATA_FRAG: bytes of serialized payload in this submessage, encapsulation included.
    /// HEARTBEAT: lastSN high word. GAP: gapList base high word. HANDOVER: walk offset.
    pub payload_len: u32,
    /// DATA, DATA_FRAG: encapsulation identifier and options, as a big-endian number; 0 where the
    /// payload's first bytes are not in this submessage. HEARTBEAT: lastSN low. GAP: base low.
    /// HANDOVER: IP identification.
    pub encapsulation: u32,
    /// Payload bytes 4..8 as a number in the encapsulation's byte order: `Header.stamp.sec` where
    /// the type begins with a header. HEARTBEAT: count. GAP, ACKNACK: numBits.
    pub stamp_seconds: u32,
    /// Payload bytes 8..12 likewise: `Header.stamp.nanosec`. GAP, ACKNACK: bitmap word 0.
    pub stamp_nanoseconds: u32,
    /// DATA_FRAG: fragmentStartingNum, 1-based. GAP, ACKNACK: bitmap word 1.
    pub fragment_start: u32,
    /// DATA_FRAG: fragmentsInSubmessage << 16 | fragmentSize. GAP, ACKNACK: bitmap word 2.
    pub fragments: u32,
    /// DATA_FRAG: sampleSize. GAP, ACKNACK: bitmap word 3.
    pub sample_size: u32,
    /// DATA, DATA_FRAG: PID_STATUS_INFO of the inline QoS, 0 = alive. GAP, ACKNACK: bitmap word 4.
    pub status_info: u32,
    /// Cookie of the socket that receives or sends the datagram (`SO_COOKIE`); 0 = unknown.
    pub socket: u64,
    /// DATA_FRAG: nanoseconds from the first datagram that this record speaks for to the last, which
    /// is at `time`; `u32::MAX` = that or more.
    pub elapsed: u32,
    /// Source UDP port; 0 = unknown.
    pub source_port: u16,
    /// Zero.
    pub unused: u16,
}

const _: () = assert!(size_of::<Record>() == 136 && align_of::<Record>() == 8);

impl Record {
    /// Sequence numbers a GAP's or ACKNACK's bitmap can hold in a record; longer sets (up to 256)
    /// make the walk ask for the whole datagram instead.
    pub const BITMAP_BITS: u32 = 160;

    /// The participant that sent it: the writer's, of an ACKNACK the reader's.
    #[must_use]
    pub fn sender(&self) -> GuidPrefix {
        if self.is_acknack() {
            self.reader().prefix
        } else {
            self.writer().prefix
        }
    }

    /// The participant that it is for; unknown for all matched readers.
    #[must_use]
    pub fn addressee(&self) -> GuidPrefix {
        if self.is_acknack() {
            self.writer().prefix
        } else {
            self.reader().prefix
        }
    }

    /// The writer.
    #[must_use]
    pub fn writer(&self) -> Guid {
        zerocopy::transmute!(self.writer)
    }

    /// The reader, or unknown for all matched readers.
    #[must_use]
    pub fn reader(&self) -> Guid {
        zerocopy::transmute!(self.reader)
    }

    /// When the first datagram that it reports came, where it reports fragments of several.
    #[must_use]
    pub const fn began(&self) -> Timestamp {
        Timestamp(self.time.saturating_sub(self.elapsed as u64))
    }

    /// INFO_TS in force.
    #[must_use]
    pub const fn source_timestamp(&self) -> RtpsTime {
        RtpsTime(self.source_timestamp)
    }

    /// DATA_FRAG: how many consecutive fragments this submessage holds.
    #[must_use]
    pub const fn fragments_in_submessage(&self) -> u32 {
        self.fragments >> 16
    }

    /// DATA_FRAG: size of every fragment but the sample's last.
    #[must_use]
    pub const fn fragment_size(&self) -> u32 {
        self.fragments & 0xffff
    }

    /// DATA_FRAG: whether it holds the sample's last fragment.
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
        // The last fragment begins within the sample, and its end reaches the sample's.
        end as u64 > (self.sample_size as u64).div_ceil(size as u64)
    }

    /// DATA_FRAG: whether `next` goes on where this one ends, for the same sample and reader.
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

    /// Takes `next` into this DATA_FRAG when it follows: one record then speaks for fragments of
    /// several datagrams, with the time of the last. `false` when it does not.
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
            // Cyclone DDS says INFO_TS with the first fragment only, others with each.
            self.source_timestamp = next.source_timestamp;
        }
        true
    }

    /// HEARTBEAT's lastSN, GAP's gapList base.
    const fn long(&self) -> u64 {
        (self.payload_len as u64) << 32 | self.encapsulation as u64
    }

    /// [`kind::HANDOVER`]'s context.
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

/// Where and with which receiver state (RTPS 2.5, 8.3.4) a handed-over walk goes on.
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
    /// Offset in the UDP payload of the next submessage header.
    pub offset: u32,
    /// INFO_TS in force: seconds and fraction; zero = none.
    pub timestamp: [u32; 2],
}

/// How the kernel filter treats a writer or reader: the value of its interest map. No entry means
/// unknown: its first datagrams are captured, within a budget.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Debug)]
#[repr(u32)]
pub enum Verdict {
    /// Classified and of no interest.
    Ignore = 0,
    /// One record per submessage, nothing copied.
    Meter = 1,
    /// Whole datagrams to user space.
    Capture = 2,
}

/// GUID in the words of [`Record`] and of the interest map's key.
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
    fn a_hole_a_repetition_another_sample_and_another_reader_do_not_follow() {
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
    fn a_sample_of_impossible_size_ends_at_once() {
        assert!(
            Record {
                fragments: 1 << 16,
                ..fragments(1, 1, 1)
            }
            .ends_sample()
        );
    }
}
