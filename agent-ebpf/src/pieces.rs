//! Writes captured datagrams to the ring in pieces. A program can copy only a bounded length at a
//! time, and a short discovery datagram should not reserve memory for the longest one.

use aya_ebpf::{
    bindings::__sk_buff,
    helpers::{bpf_ktime_get_ns, generated::bpf_skb_load_bytes},
};
use ros2probe_wire::{
    EntityId,
    filter::Counter,
    host::{PIECE_BYTES, Piece},
    record::flag,
};

use crate::{
    host,
    instructions::hide_bounds,
    maps::{PIECES, PieceBuffer, WAKE_PIECE_BYTES, count, piece_buffer, scratch},
    settings::read_global,
    verdict::{FORCE_WAKEUP, NO_WAKEUP, RING_AVAIL_DATA},
};

/// Maximum number of pieces of a UDP datagram.
const PIECES_PER_DATAGRAM: u32 = 65_536 / PIECE_BYTES;
/// Maximum length of a frame, from its IP header on. Only packets of TCP can be longer
/// (`gso_max_size`).
const MAX_FRAME_BYTES: u32 = 65_535;
const DATAGRAM_FLAGS: u16 = flag::FRAGMENTED | flag::OUTGOING | flag::IPV6 | flag::HOST;

/// Writer of participant announcements. Participants repeat their announcements, so these do not
/// wake user space. Every other captured datagram is sent once, and user space should read it
/// before data that depends on it.
const SPDP_WRITER: u32 = u32::from_ne_bytes(EntityId::SPDP_WRITER.0);

/// Flags of the kernel: a piece wakes user space if the ring was empty. So one fragment of a captured
/// message does, and the others do not.
const WAKEUP_IF_EMPTY: u64 = 0;

const _: () = assert!(PIECE_BYTES.is_power_of_two());

/// Writes the current datagram to the ring; returns 1 if every piece fit.
#[unsafe(no_mangle)]
#[inline(never)]
pub extern "C" fn write_capture(skb: *mut __sk_buff, slot: u32) -> u32 {
    let (Some(mut scratch), Some(mut buffer)) = (scratch(slot), piece_buffer(slot)) else {
        return 0;
    };
    let scratch = scratch.get();
    let (record, packet, piece) = (&scratch.walk.record, &scratch.packet, &mut buffer.piece);
    piece.time = packet.time_ns;
    piece.socket = record.socket;
    piece.source = packet.source;
    piece.destination = packet.destination;
    piece.source_port = record.source_port;
    piece.destination_port = record.destination_port;
    piece.interface = packet.interface;
    piece.datagram = record.datagram;
    piece.datagram_len = scratch.walk.datagram_len;
    piece.flags = record.flags & DATAGRAM_FLAGS;
    let len = scratch.walk.datagram_len;
    let base = packet.payload_offset + 8;
    write_pieces(skb, slot, base, len)
}

/// Writes a frame to the ring, from its IP header on; returns 1 if every piece fit. The lower half of
/// `place` is the offset of the IP header, the upper half the number of bytes from there.
#[unsafe(no_mangle)]
#[inline(never)]
pub extern "C" fn write_frame(skb: *mut __sk_buff, slot: u32, place: u64) -> u32 {
    let (Some(mut scratch), Some(mut buffer)) = (scratch(slot), piece_buffer(slot)) else {
        return 0;
    };
    let (base, len) = (place as u32, (place >> 32) as u32);
    if len > MAX_FRAME_BYTES {
        count(slot, Counter::PiecesLost, 1);
        return 0;
    }
    let scratch = scratch.get();
    let piece = &mut buffer.piece;
    // SAFETY: no preconditions.
    piece.time = unsafe { bpf_ktime_get_ns() };
    piece.interface = scratch.packet.interface;
    piece.datagram = host::next_token(slot, &mut scratch.token_count);
    piece.datagram_len = len;
    piece.flags = flag::FRAME
        | if scratch.packet.is_outgoing != 0 {
            flag::OUTGOING
        } else {
            0
        };
    write_pieces(skb, slot, base, len)
}

/// Writes `len` bytes from `base` in pieces; returns 1 if every piece fit.
#[inline(always)]
fn write_pieces(skb: *mut __sk_buff, slot: u32, base: u32, len: u32) -> u32 {
    let (mut offset, mut piece_count) = (0, 0);
    while piece_count < PIECES_PER_DATAGRAM {
        if offset >= len {
            break;
        }
        if write_piece(skb, slot, base, offset) == 0 {
            count(slot, Counter::PiecesLost, 1);
            return 0;
        }
        offset += PIECE_BYTES;
        piece_count += 1;
    }
    count(slot, Counter::CapturedBytes, u64::from(len));
    1
}

/// Writes one piece, from `offset` of the payload at `base`; returns 1 if it fit.
#[unsafe(no_mangle)]
#[inline(never)]
pub extern "C" fn write_piece(skb: *mut __sk_buff, slot: u32, base: u32, offset: u32) -> u32 {
    let Some(mut buffer) = piece_buffer(slot) else {
        return 0;
    };
    let remaining = buffer.piece.datagram_len.wrapping_sub(offset);
    let len = if remaining > PIECE_BYTES {
        PIECE_BYTES
    } else {
        remaining
    };
    buffer.piece.offset = offset;
    buffer.piece.len = len;
    // SAFETY: the buffer can hold the longest piece.
    let status = unsafe {
        bpf_skb_load_bytes(
            skb.cast(),
            base.wrapping_add(offset),
            buffer.bytes.as_mut_ptr().cast(),
            bounded_piece_len(len) as u32,
        )
    };
    if status != 0 {
        return 0;
    }
    push_piece(slot, &mut buffer)
}

/// Writes the piece that the buffer holds to the ring; returns 1 if it fit.
#[inline(always)]
pub fn push_piece(slot: u32, buffer: &mut PieceBuffer) -> u32 {
    let wake = if PIECES.query(RING_AVAIL_DATA) > read_global(&WAKE_PIECE_BYTES) {
        FORCE_WAKEUP
    } else if buffer.piece.flags & flag::FRAME != 0 {
        WAKEUP_IF_EMPTY
    } else if scratch(slot)
        .is_some_and(|mut scratch| scratch.get().walk.record.writer[3] != SPDP_WRITER)
    {
        FORCE_WAKEUP
    } else {
        NO_WAKEUP
    };
    let size = size_of::<Piece>() + bounded_piece_len(buffer.piece.len);
    // SAFETY: the buffer is that long.
    let bytes = unsafe { core::slice::from_raw_parts((&raw const *buffer).cast::<u8>(), size) };
    u32::from(PIECES.output::<[u8]>(bytes, wake).is_ok())
}

/// Returns `len`, which must be 1 to [`PIECE_BYTES`], with bounds that every verifier recognizes.
/// The mask stands directly before the use, and the optimizer must not remove it as redundant.
#[inline(always)]
pub fn bounded_piece_len(len: u32) -> usize {
    let len = hide_bounds(len);
    ((len.wrapping_sub(1) & (PIECE_BYTES as u64 - 1)) + 1) as usize
}
