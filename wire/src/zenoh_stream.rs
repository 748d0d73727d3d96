//! Recognizes a direction of a TCP connection of Zenoh: by its first bytes, or by batches that
//! continue the sequence numbers of their lanes.
//!
//! The kernel programs and the replay compile this module. It decides on values that the caller has
//! read, and allocates no memory. The formats are those of `zenoh-protocol`, `transport/`.

use crate::rtps_tcp::MAGIC;

/// Number of bytes that [`Beginning::of`] reads.
pub const HEAD: usize = 8;
/// Version of the wire format since Zenoh 1.0.
pub const VERSION: u8 = 0x09;
/// Size of the length before a batch, in bytes.
pub const PREFIX: u32 = 2;
/// Number of proofs that make a boundary certain.
const CERTAIN: u32 = 2;

/// Largest version number that is taken for another version of Zenoh rather than another protocol.
const PLAUSIBLE_VERSION: u8 = 0x3f;
/// A `KEEP_ALIVE` alone in its batch, with the length before it.
const KEEP_ALIVE: [u8; 3] = [1, 0, message::KEEP_ALIVE];

/// Ids of transport messages, in the lower five bits of their header.
pub mod message {
    /// Bits of a header that hold the id.
    pub const ID: u8 = 0x1f;
    /// Operation, administration and maintenance.
    pub const OAM: u8 = 0;
    /// The first message of each side.
    pub const INIT: u8 = 1;
    /// The second message of each side.
    pub const OPEN: u8 = 2;
    /// The sender closes the session or the link.
    pub const CLOSE: u8 = 3;
    /// The sender is alive.
    pub const KEEP_ALIVE: u8 = 4;
    /// Network messages follow.
    pub const FRAME: u8 = 5;
    /// A part of a network message.
    pub const FRAGMENT: u8 = 6;
    /// A member of a multicast group introduces itself. This is the largest id.
    pub const JOIN: u8 = 7;
    /// The smallest id of a network message. Network messages follow a FRAME.
    pub const LEAST_NETWORK: u8 = 0x19;
}

/// The start of a TCP segment's payload.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum Beginning {
    /// Possibly a frame of RTPS.
    Frame,
    /// INIT: a connection of the known version begins.
    Init,
    /// INIT of another version, on a port of Zenoh.
    OtherVersion,
    /// A `KEEP_ALIVE`, alone in its batch and in its segment.
    KeepAlive,
    /// The first handshake message of either side of TLS, on a port of Zenoh.
    Tls,
    /// The first handshake message of a client of TLS, on another port. RTPS may be inside.
    ClientHello,
    /// A byte sequence that may be a batch with a FRAME or FRAGMENT.
    Batch,
    /// Another protocol, or the middle of a batch.
    Other,
}

impl Beginning {
    /// Classifies the start of a segment of at least [`HEAD`] bytes. `length` is the segment's
    /// whole length.
    #[inline(always)]
    #[must_use]
    pub const fn of(head: [u8; HEAD], length: u32, is_zenoh_port: bool) -> Self {
        let [low, high, header, next, flags, kind, ..] = head;
        let [r, t, c, p] = MAGIC;
        if low == r && high == t && header == c && next == p {
            return Self::Frame;
        }
        if low == 0x16 && high == 3 && header <= 4 {
            // A handshake record: ClientHello or ServerHello.
            return match kind {
                1 | 2 if is_zenoh_port => Self::Tls,
                1 => Self::ClientHello,
                _ => Self::Other,
            };
        }
        let batch = u16::from_le_bytes([low, high]) as u32;
        if batch == 0 {
            return Self::Other;
        }
        match header & message::ID {
            message::INIT if batch + PREFIX > length => Self::Other,
            message::INIT if next == VERSION && flags & 0x0c == 0 && flags & 3 != 3 => Self::Init,
            message::INIT if next <= PLAUSIBLE_VERSION && is_zenoh_port => Self::OtherVersion,
            message::FRAME if header & 0x40 == 0 => Self::Batch,
            message::FRAGMENT => Self::Batch,
            _ => Self::Other,
        }
    }

    /// Classifies the start of a segment of exactly three bytes.
    #[inline(always)]
    #[must_use]
    pub const fn of_three(bytes: [u8; 3]) -> Self {
        let [low, high, header] = bytes;
        if low == KEEP_ALIVE[0] && high == KEEP_ALIVE[1] && header == KEEP_ALIVE[2] {
            Self::KeepAlive
        } else {
            Self::Other
        }
    }
}

/// Sequence numbers of up to two lanes of a direction. Numbers that continue a lane prove a
/// boundary.
///
/// A batch of a third lane is accepted and proves nothing: publishers of ROS use one or two.
#[repr(C)]
#[derive(Clone, Copy, Default, Debug)]
pub struct Lanes {
    proofs: u32,
    lanes: [Lane; 2],
}

/// A lane and its next sequence number. The key 0 means no lane.
#[repr(C)]
#[derive(Clone, Copy, Default, Debug)]
struct Lane {
    key: u32,
    expected: u32,
}

impl Lanes {
    /// Bits of a sequence number in the default resolution.
    const NUMBER: u32 = u32::MAX >> 4;

    /// Returns lanes without a number.
    #[must_use]
    pub const fn new() -> Self {
        let none = Lane {
            key: 0,
            expected: 0,
        };
        Self {
            proofs: 0,
            lanes: [none; 2],
        }
    }

    /// Returns the key of a lane, which is never 0. `reliability` is any number below 256.
    #[inline(always)]
    #[must_use]
    pub const fn key(priority: u32, reliability: u32) -> u32 {
        1 << 16 | priority << 8 | reliability
    }

    /// Returns whether the boundary is certain.
    #[inline(always)]
    #[must_use]
    pub const fn are_certain(&self) -> bool {
        self.proofs >= CERTAIN
    }

    /// Counts a `KEEP_ALIVE` alone in its batch as a proof, because few other bytes look like one.
    #[inline(always)]
    pub const fn keep_alive(&mut self) {
        self.proofs += 1;
    }

    /// Returns whether a FRAME or FRAGMENT with this number may follow the earlier ones of its
    /// lane.
    #[inline(always)]
    pub const fn continues(&mut self, key: u32, number: u32) -> bool {
        let [one, two] = &mut self.lanes;
        let lane = if one.key == 0 || one.key == key {
            one
        } else {
            two
        };
        if lane.key == 0 {
            lane.key = key;
        } else if lane.key != key {
            return true;
        } else {
            // A sender skips the number after the FRAGMENTs of a message.
            if number.wrapping_sub(lane.expected) & Self::NUMBER > 1 {
                return false;
            }
            self.proofs += 1;
        }
        lane.expected = number.wrapping_add(1);
        true
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// INIT of a peer, as in the captures of Zenoh 1.8, cut after its flags.
    const INIT: [u8; HEAD] = [0x20, 0, 0x81, 9, 0xf1, 0x0a, 0, 0];

    #[test]
    fn a_segment_with_init_begins_a_connection_on_any_port() {
        assert_eq!(Beginning::of(INIT, 34, false), Beginning::Init);
        assert_eq!(Beginning::of(INIT, 33, false), Beginning::Other, "cut");
    }

    #[test]
    fn another_version_is_recognized_on_ports_of_zenoh_only() {
        let mut head = INIT;
        head[3] = 8;
        assert_eq!(Beginning::of(head, 34, true), Beginning::OtherVersion);
        assert_eq!(Beginning::of(head, 34, false), Beginning::Other);
        head[3] = 0x40;
        assert_eq!(Beginning::of(head, 34, true), Beginning::Other);
    }

    #[test]
    fn a_tls_hello_of_either_side_is_recognized_on_ports_of_zenoh_and_of_a_client_on_any() {
        let mut head = [0x16, 3, 1, 2, 0, 1, 0, 1];
        assert_eq!(Beginning::of(head, 200, true), Beginning::Tls);
        assert_eq!(Beginning::of(head, 200, false), Beginning::ClientHello);
        head[5] = 2;
        assert_eq!(Beginning::of(head, 200, true), Beginning::Tls);
        assert_eq!(Beginning::of(head, 200, false), Beginning::Other);
        for (at, value) in [(0, 0x17), (1, 2), (2, 5), (5, 11)] {
            let mut other = head;
            other[at] = value;
            assert_ne!(
                Beginning::of(other, 200, false),
                Beginning::ClientHello,
                "{at}"
            );
        }
    }

    #[test]
    fn a_keep_alive_is_recognized_by_its_three_bytes() {
        assert_eq!(Beginning::of_three([1, 0, 4]), Beginning::KeepAlive);
        for other in [[2, 0, 4], [1, 1, 4], [1, 0, 5]] {
            assert_eq!(Beginning::of_three(other), Beginning::Other);
        }
    }

    #[test]
    fn frames_and_fragments_may_begin_a_batch_of_any_connection() {
        for (header, beginning) in [
            (0x25, Beginning::Batch),
            (0x65, Beginning::Other),
            (0x66, Beginning::Batch),
            (0x02, Beginning::Other),
            (0x1f, Beginning::Other),
        ] {
            let head = [9, 0, header, 0, 0, 0, 0, 0];
            assert_eq!(Beginning::of(head, 11, true), beginning, "{header:#x}");
        }
        assert_eq!(Beginning::of([0; HEAD], 11, true), Beginning::Other);
    }

    #[test]
    fn two_numbers_that_continue_a_lane_prove_a_boundary() {
        let mut lanes = Lanes::new();
        let key = Lanes::key(5, 0x20);
        for (number, is_certain) in [(7, false), (8, false), (9, true)] {
            assert!(lanes.continues(key, number));
            assert_eq!(lanes.are_certain(), is_certain, "{number}");
        }
        assert!(!lanes.continues(key, 12), "two numbers are missing");
    }

    #[test]
    fn one_number_may_be_skipped_and_the_highest_number_wraps() {
        let mut lanes = Lanes::new();
        let key = Lanes::key(0, 0);
        for number in [0x0fff_fffd, 0x0fff_ffff, 0, 1] {
            assert!(lanes.continues(key, number), "{number:#x}");
        }
    }

    #[test]
    fn two_lanes_count_separately_and_a_third_lane_proves_nothing() {
        let mut lanes = Lanes::new();
        for (key, number) in [(1, 5), (2, 90), (3, 1), (3, 500), (1, 6)] {
            assert!(lanes.continues(Lanes::key(key, 0), number), "{key}");
        }
        assert!(!lanes.are_certain());
        lanes.keep_alive();
        assert!(lanes.are_certain());
    }
}
