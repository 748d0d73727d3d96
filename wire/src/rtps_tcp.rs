//! Frames of RTPS over TCP, as Fast DDS sends them (version 1.0 of its framing).
//!
//! Each direction of a connection is a sequence of frames. A frame has a header of 14 bytes and one
//! RTPS message, or a control message for the connection. Integers are little-endian, as the sender
//! writes them in its own byte order and big-endian machines do not run ROS 2.
//!
//! The kernel programs and the replay compile this module. It decides on values that the caller has
//! read, and allocates no memory. The layout is that of Fast DDS, `transport/TCPChannelResource`
//! and `transport/tcp/RTCPHeader`; the OMG specifies only the kinds of the locators.

/// Size of a frame's header, in bytes.
pub const HEADER_LEN: usize = 14;
/// Number of bytes from which the beginning of a frame is recognized.
pub const RECOGNIZED: usize = 18;
/// The first bytes of a frame.
pub const MAGIC: [u8; 4] = *b"RTCP";
/// Length of the shortest frame: a header and a control message without a payload.
const SHORTEST: u32 = 30;
/// Length of the longest frame: a header and a message of
/// [`MAX_MESSAGE`](crate::walk::MAX_MESSAGE).
const MAX_LENGTH: u32 = (32 << 20) + 14;
const _: () = assert!(MAX_LENGTH == crate::walk::MAX_MESSAGE + HEADER_LEN as u32);
/// The flag of a control message whose integers are little-endian.
const LITTLE_ENDIAN: u8 = 2;

/// Header of a frame. Its checksum is not verified, as Fast DDS itself accepts a wrong one.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub struct FrameHeader {
    /// Length of the frame in bytes, header included.
    pub length: u32,
    /// Port of the receiver that a UDP datagram would have; 0 = a control message.
    pub logical_port: u16,
}

impl FrameHeader {
    /// Reads a header; `None` if the bytes cannot be one.
    #[inline(always)]
    #[must_use]
    pub const fn read(head: [u8; HEADER_LEN]) -> Option<Self> {
        let [m0, m1, m2, m3, l0, l1, l2, l3, _, _, _, _, p0, p1] = head;
        let header = Self {
            length: u32::from_le_bytes([l0, l1, l2, l3]),
            logical_port: u16::from_le_bytes([p0, p1]),
        };
        let is_magic = u32::from_ne_bytes([m0, m1, m2, m3]) == u32::from_ne_bytes(MAGIC);
        if is_magic && Self::is_length(header.length) {
            Some(header)
        } else {
            None
        }
    }

    /// Reads the header of a frame as [`Self::recognize`] does, from words in memory order: those at
    /// offsets 0, 4, 12 and 14.
    #[inline(always)]
    #[must_use]
    pub const fn of_words([magic, length, port, next]: [u32; 4]) -> Option<Self> {
        let header = Self {
            length: u32::from_le(length),
            logical_port: u16::from_le(port as u16),
        };
        if magic != u32::from_ne_bytes(MAGIC) || !Self::is_length(header.length) {
            return None;
        }
        let is_frame = if header.is_control() {
            header.has_control(next.to_ne_bytes())
        } else {
            next == crate::walk::MAGIC
        };
        if is_frame { Some(header) } else { None }
    }

    /// Reads the header of a frame that begins with these bytes; `None` if they cannot be the
    /// beginning of one. Bytes of a payload that look like a header rarely pass this test: it reads
    /// the beginning of the message, too.
    #[inline(always)]
    #[must_use]
    pub const fn recognize(bytes: [u8; RECOGNIZED]) -> Option<Self> {
        let [head @ .., a, b, c, d] = bytes;
        let Some(header) = Self::read(head) else {
            return None;
        };
        let next = [a, b, c, d];
        let is_frame = if header.is_control() {
            header.has_control(next)
        } else {
            u32::from_ne_bytes(next) == crate::walk::MAGIC
        };
        if is_frame { Some(header) } else { None }
    }

    /// Returns whether a frame may have this length in bytes.
    #[inline(always)]
    #[must_use]
    pub const fn is_length(length: u32) -> bool {
        length >= SHORTEST && length <= MAX_LENGTH
    }

    /// Returns whether these bytes begin a control message of the frame: kind, flags and length.
    #[inline(always)]
    const fn has_control(&self, [kind, flags, low, high]: [u8; 4]) -> bool {
        let is_kind = matches!(kind, 0xd1..=0xd6 | 0xe1..=0xe4);
        let length = u16::from_le_bytes([low, high]) as u32;
        is_kind && flags & LITTLE_ENDIAN != 0 && length + HEADER_LEN as u32 == self.length
    }

    /// Returns whether the frame has a control message instead of an RTPS message.
    #[inline(always)]
    #[must_use]
    pub const fn is_control(&self) -> bool {
        self.logical_port == 0
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// BIND_CONNECTION of a capture of Fast DDS 2.6.12, cut after its length.
    const BIND: [u8; RECOGNIZED] = [
        0x52, 0x54, 0x43, 0x50, 0x44, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0xd1, 0x0e, 0x36, 0,
    ];

    fn message(length: u32, port: u16) -> [u8; RECOGNIZED] {
        let mut bytes = BIND;
        bytes[4..8].copy_from_slice(&length.to_le_bytes());
        bytes[12..14].copy_from_slice(&port.to_le_bytes());
        bytes[14..18].copy_from_slice(b"RTPS");
        bytes
    }

    #[test]
    fn a_control_message_is_a_frame_of_port_0() {
        let header = FrameHeader::recognize(BIND).unwrap();
        assert_eq!(header.length, 68);
        assert!(header.is_control());
    }

    #[test]
    fn a_control_message_of_another_length_or_kind_is_not_a_frame() {
        for (at, value) in [(4, 0x45), (14, 0xd7), (14, 0xe5), (15, 0x0c)] {
            let mut bytes = BIND;
            bytes[at] = value;
            assert_eq!(FrameHeader::recognize(bytes), None, "byte {at}");
        }
    }

    #[test]
    fn an_rtps_message_is_a_frame_of_another_port() {
        let header = FrameHeader::recognize(message(65_514, 7411)).unwrap();
        assert_eq!((header.length, header.logical_port), (65_514, 7411));
        assert!(!header.is_control());
        assert_eq!(FrameHeader::recognize(message(65_514, 0)), None);
        let mut other = message(65_514, 7411);
        other[14] = b'X';
        assert_eq!(FrameHeader::recognize(other), None);
    }

    #[test]
    fn a_length_that_no_frame_has_is_refused() {
        for length in [0, 14, 29, MAX_LENGTH + 1, u32::MAX] {
            assert_eq!(
                FrameHeader::recognize(message(length, 7411)),
                None,
                "{length}"
            );
        }
        for length in [30, MAX_LENGTH] {
            assert!(
                FrameHeader::recognize(message(length, 7411)).is_some(),
                "{length}"
            );
        }
    }
}
