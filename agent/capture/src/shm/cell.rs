//! One entry of a port's ring: the buffer and segment that hold a message.
//!
//! The layout is a cell of MultiProducerConsumerRingBuffer with a BufferDescriptor, 20 bytes, in
//! Fast DDS 2.3 to 3.6 (constant 5 of its shared-memory ABI). The fields are reference counter,
//! segment id, offset of the buffer's node in the segment, and validity id.

use std::fmt;

/// Id of a segment; the file's name ends in its hexadecimal form.
#[derive(Clone, Copy, PartialEq, Eq, Hash, Default)]
pub struct SegmentId(pub [u8; 8]);

/// Identifies the message of a cell.
#[derive(Clone, Copy, PartialEq, Eq, Hash, Default, Debug)]
pub struct Descriptor {
    /// Segment with the buffer.
    pub segment: SegmentId,
    /// Offset of the buffer's node in the segment.
    pub node: u32,
    /// Validity id: distinguishes successive uses of the buffer.
    pub validity: u32,
}

/// A cell as it was read.
#[derive(Clone, Copy, PartialEq, Eq, Default, Debug)]
pub struct Cell {
    /// Number of listeners that have not read the message yet; also 0 while the cell is being
    /// filled.
    pub references: u32,
    /// The message.
    pub descriptor: Descriptor,
}

impl Cell {
    /// Size of a cell, in bytes.
    pub const LEN: usize = 20;

    /// Parses the bytes of a cell.
    #[must_use]
    pub const fn parse(bytes: [u8; Self::LEN]) -> Self {
        let [
            a0,
            a1,
            a2,
            a3,
            s0,
            s1,
            s2,
            s3,
            s4,
            s5,
            s6,
            s7,
            n0,
            n1,
            n2,
            n3,
            v0,
            v1,
            v2,
            v3,
        ] = bytes;
        Self {
            references: u32::from_le_bytes([a0, a1, a2, a3]),
            descriptor: Descriptor {
                segment: SegmentId([s0, s1, s2, s3, s4, s5, s6, s7]),
                node: u32::from_le_bytes([n0, n1, n2, n3]),
                validity: u32::from_le_bytes([v0, v1, v2, v3]),
            },
        }
    }
}

impl fmt::Display for SegmentId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.0.iter().try_for_each(|byte| write!(f, "{byte:02x}"))
    }
}

impl fmt::Debug for SegmentId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        fmt::Display::fmt(self, f)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_cell_is_parsed_as_four_consecutive_fields() {
        let bytes: [u8; 20] = std::array::from_fn(|index| index as u8);
        let cell = Cell::parse(bytes);
        assert_eq!(cell.references, 0x0302_0100);
        assert_eq!(cell.descriptor.segment.to_string(), "0405060708090a0b");
        assert_eq!(cell.descriptor.node, 0x0f0e_0d0c);
        assert_eq!(cell.descriptor.validity, 0x1312_1110);
    }
}
