//! Parses one block of a TPACKET_V3 ring (`linux/if_packet.h`) as plain bytes.
//!
//! Offsets in a block come from the kernel, but every offset is checked against the block. A wrong
//! offset ends the block and is reported.

use std::mem::{offset_of, size_of};

use libc::{sockaddr_ll, tpacket_block_desc, tpacket_hdr_v1, tpacket_hdr_variant1, tpacket3_hdr};
use ros2probe_wire::Timestamp;
use ros2probe_wire::frame::PacketType;

/// Offset of the word that holds a block's owner.
pub(super) const STATUS_OFFSET: usize =
    offset_of!(tpacket_block_desc, hdr) + offset_of!(tpacket_hdr_v1, block_status);
const COUNT_OFFSET: usize =
    offset_of!(tpacket_block_desc, hdr) + offset_of!(tpacket_hdr_v1, num_pkts);
const FIRST_OFFSET: usize =
    offset_of!(tpacket_block_desc, hdr) + offset_of!(tpacket_hdr_v1, offset_to_first_pkt);
const LENGTH_OFFSET: usize =
    offset_of!(tpacket_block_desc, hdr) + offset_of!(tpacket_hdr_v1, blk_len);

const VLAN_TAG: usize =
    offset_of!(tpacket3_hdr, hv1) + offset_of!(tpacket_hdr_variant1, tp_vlan_tci);
/// The address follows its header at the next multiple of `TPACKET_ALIGNMENT`.
const ADDRESS_OFFSET: usize = size_of::<tpacket3_hdr>().next_multiple_of(libc::TPACKET_ALIGNMENT);

// The kernel's ABI does not change; this pins the version of the offsets above.
const _: () =
    assert!(STATUS_OFFSET == 8 && COUNT_OFFSET == 12 && FIRST_OFFSET == 16 && LENGTH_OFFSET == 20);
const _: () = assert!(size_of::<tpacket_block_desc>() == 48 && size_of::<tpacket3_hdr>() == 48);
const _: () = assert!(VLAN_TAG == 32 && ADDRESS_OFFSET == 48 && size_of::<sockaddr_ll>() == 20);
const _: () = assert!(offset_of!(tpacket3_hdr, tp_mac) == 24);

/// One frame in the ring.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub struct RingFrame<'a> {
    /// Time at which the kernel saw the frame.
    pub time: Timestamp,
    /// The captured bytes, beginning at the network header.
    pub bytes: &'a [u8],
    /// Length of the frame from the network header.
    pub length: u32,
    /// Index of the interface on which the frame was seen.
    pub interface: u32,
    /// Recipient of the frame; outgoing if this host sends it.
    pub packet_type: PacketType,
    /// Ether type of the bytes.
    pub protocol: u16,
    /// VLAN tag removed by the kernel.
    pub vlan: Option<u16>,
}

/// The frames of a block, in order.
#[derive(Clone, Debug)]
pub struct Frames<'a> {
    block: &'a [u8],
    at: usize,
    left: u32,
    damaged: bool,
}

impl<'a> Frames<'a> {
    /// Reads the frames of a block that the kernel has handed to user space.
    #[must_use]
    pub fn new(block: &'a [u8]) -> Self {
        let header = (|| {
            let length = size(word(block, LENGTH_OFFSET)?);
            let frames = (word(block, COUNT_OFFSET)?, size(word(block, FIRST_OFFSET)?));
            block.get(..length).map(|block| (block, frames))
        })();
        match header {
            Some((block, (left, at))) => Self {
                block,
                at,
                left,
                damaged: false,
            },
            None => Self {
                block,
                at: 0,
                left: 0,
                damaged: true,
            },
        }
    }

    /// Returns whether the iteration ended early because the block contradicts itself.
    #[must_use]
    pub const fn damaged(&self) -> bool {
        self.damaged
    }
}

impl<'a> Iterator for Frames<'a> {
    type Item = RingFrame<'a>;

    fn next(&mut self) -> Option<RingFrame<'a>> {
        self.left = self.left.checked_sub(1)?;
        let next = frame(self.block, self.at).and_then(|(frame, step)| {
            // The last frame's step is 0.
            let forward = step >= ADDRESS_OFFSET || self.left == 0;
            forward.then_some((frame, self.at.checked_add(step)?))
        });
        let Some((frame, at)) = next else {
            self.damaged = true;
            self.left = 0;
            return None;
        };
        self.at = at;
        Some(frame)
    }
}

/// Returns the frame at `at`, and the distance to the next one; `None` if it exceeds the block.
fn frame(block: &[u8], at: usize) -> Option<(RingFrame<'_>, usize)> {
    let block = block.get(at..)?;
    let step = size(word(block, offset_of!(tpacket3_hdr, tp_next_offset))?);
    let seconds = word(block, offset_of!(tpacket3_hdr, tp_sec))?;
    let nanoseconds = word(block, offset_of!(tpacket3_hdr, tp_nsec))?;
    let kept = size(word(block, offset_of!(tpacket3_hdr, tp_snaplen))?);
    let length = word(block, offset_of!(tpacket3_hdr, tp_len))?;
    let status = word(block, offset_of!(tpacket3_hdr, tp_status))?;
    let start = usize::from(half(block, offset_of!(tpacket3_hdr, tp_mac))?);
    let vlan = word(block, VLAN_TAG)?;
    let [_, _, vlan_high, vlan_low] = vlan.to_be_bytes();
    let address = block.get(ADDRESS_OFFSET..)?;
    let protocol = half(address, offset_of!(sockaddr_ll, sll_protocol))?;
    let interface = word(address, offset_of!(sockaddr_ll, sll_ifindex))?;
    let packet_type = *address.get(offset_of!(sockaddr_ll, sll_pkttype))?;
    let bytes = block.get(start..)?.get(..kept)?;
    let frame = RingFrame {
        time: Timestamp(u64::from(seconds) * 1_000_000_000 + u64::from(nanoseconds)),
        bytes,
        length,
        interface,
        packet_type: PacketType(packet_type),
        protocol: u16::from_be(protocol),
        vlan: (status & libc::TP_STATUS_VLAN_VALID != 0)
            .then_some(u16::from_be_bytes([vlan_high, vlan_low])),
    };
    Some((frame, step))
}

fn word(bytes: &[u8], at: usize) -> Option<u32> {
    bytes
        .get(at..)?
        .first_chunk()
        .map(|bytes| u32::from_ne_bytes(*bytes))
}

fn half(bytes: &[u8], at: usize) -> Option<u16> {
    bytes
        .get(at..)?
        .first_chunk()
        .map(|bytes| u16::from_ne_bytes(*bytes))
}

fn size(value: u32) -> usize {
    usize::try_from(value).unwrap_or(usize::MAX)
}

#[cfg(test)]
pub(super) mod tests {
    use proptest::prelude::*;

    use super::*;

    fn put(block: &mut [u8], at: usize, value: u32) {
        block[at..at + 4].copy_from_slice(&value.to_ne_bytes());
    }

    /// Returns a block with two frames of 5 and 7 bytes.
    fn block() -> Vec<u8> {
        block_of(&[b"first", b"another"])
    }

    /// Returns a block as the kernel lays it out; the last frame has a VLAN tag.
    pub(in crate::ring) fn block_of(frames: &[&[u8]]) -> Vec<u8> {
        let mut block = vec![0; 48];
        put(&mut block, STATUS_OFFSET, libc::TP_STATUS_USER);
        put(
            &mut block,
            COUNT_OFFSET,
            u32::try_from(frames.len()).unwrap(),
        );
        put(&mut block, FIRST_OFFSET, 48);
        for (number, bytes) in (1_u32..).zip(frames) {
            let last = number == u32::try_from(frames.len()).unwrap();
            let at = block.len();
            let start = 48 + 32;
            let step = (start + bytes.len()).next_multiple_of(16);
            block.resize(at + step, 0);
            let header = &mut block[at..];
            let next = if last {
                0
            } else {
                u32::try_from(step).unwrap()
            };
            put(header, offset_of!(tpacket3_hdr, tp_next_offset), next);
            put(header, offset_of!(tpacket3_hdr, tp_sec), 1_700_000_000);
            put(header, offset_of!(tpacket3_hdr, tp_nsec), number);
            put(
                header,
                offset_of!(tpacket3_hdr, tp_snaplen),
                u32::try_from(bytes.len()).unwrap(),
            );
            put(header, offset_of!(tpacket3_hdr, tp_len), 1500);
            if last {
                put(
                    header,
                    offset_of!(tpacket3_hdr, tp_status),
                    libc::TP_STATUS_VLAN_VALID,
                );
                put(header, VLAN_TAG, 0x2005);
            }
            header[24..26].copy_from_slice(&u16::try_from(start).unwrap().to_ne_bytes());
            header[ADDRESS_OFFSET + 2..ADDRESS_OFFSET + 4].copy_from_slice(&[0x08, 0x00]);
            put(header, ADDRESS_OFFSET + 4, number + 10);
            header[ADDRESS_OFFSET + 10] = 4;
            header[start..start + bytes.len()].copy_from_slice(bytes);
        }
        let length = u32::try_from(block.len()).unwrap();
        put(&mut block, LENGTH_OFFSET, length);
        block
    }

    #[test]
    fn frames_are_read_as_the_kernel_writes_them() {
        let mut bytes = block();
        bytes.resize(4096, 0xee);
        let mut frames = Frames::new(&bytes);
        let expected = RingFrame {
            time: Timestamp(1_700_000_000_000_000_001),
            bytes: b"first",
            length: 1500,
            interface: 11,
            packet_type: PacketType::OUTGOING,
            protocol: 0x0800,
            vlan: None,
        };
        assert_eq!(frames.next(), Some(expected));
        let second = frames.next().unwrap();
        assert_eq!((second.bytes, second.interface), (&b"another"[..], 12));
        assert_eq!(second.vlan, Some(0x2005));
        assert_eq!((frames.next(), frames.damaged()), (None, false));
    }

    #[test]
    fn a_truncated_block_ends_early_and_reports_damage() {
        let bytes = block();
        for end in 0..bytes.len() {
            let mut frames = Frames::new(&bytes[..end]);
            assert_eq!((frames.by_ref().count(), frames.damaged()), (0, true));
            if end > LENGTH_OFFSET + 4 {
                let mut bytes = bytes[..end].to_vec();
                put(&mut bytes, LENGTH_OFFSET, u32::try_from(end).unwrap());
                let mut frames = Frames::new(&bytes);
                // Without the padding after the last frame the block is still complete.
                let complete = frames.by_ref().count() == 2;
                assert_eq!(frames.damaged(), !complete);
                assert_eq!(complete, end >= bytes.len().max(48 + 96 + 87));
            }
        }
    }

    #[test]
    fn a_frame_offset_that_does_not_advance_ends_the_block() {
        for step in [0, 16, u32::MAX] {
            let mut bytes = block();
            put(&mut bytes, 48, step);
            put(&mut bytes, COUNT_OFFSET, u32::MAX);
            let mut frames = Frames::new(&bytes);
            assert!(frames.by_ref().count() <= 1);
            assert!(frames.damaged());
        }
    }

    proptest! {
        #[test]
        fn corrupted_bytes_never_lead_out_of_the_block(
            damage in prop::collection::vec((0..231_usize, any::<u8>()), 1..8),
        ) {
            let mut bytes = block();
            for (at, value) in damage {
                bytes[at] = value;
            }
            let count = Frames::new(&bytes).count();
            prop_assert!(count <= bytes.len() / ADDRESS_OFFSET);
        }
    }
}
