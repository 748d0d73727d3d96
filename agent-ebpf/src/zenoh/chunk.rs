//! Writes chunks for user space. A chunk covers consecutive bytes of a direction, of which possibly
//! only the beginning is copied.

use aya_ebpf::{
    bindings::__sk_buff,
    helpers::generated::{bpf_sk_fullsock, bpf_skb_load_bytes, bpf_tcp_sock},
};
use core::{
    mem::size_of,
    ptr::{read_volatile, write_volatile},
};
use ros2probe_wire::{
    filter::Counter,
    host::{Layout, Link, PIECE_BYTES, Piece, chunk as chunk_flag},
    record::flag,
};

use crate::{
    kernel_memory::{layout_entry, read_member},
    maps::{PIECES, PieceBuffer, WAKE_PIECE_BYTES, count, piece_buffer},
    packet::IPV4_MAPPED,
    pieces::bounded_piece_len,
    settings::read_global,
    verdict::{FORCE_WAKEUP, NO_WAKEUP, RING_AVAIL_DATA},
};

use super::{
    LOOPBACK,
    state::{Segment, WINDOW, protocol, segment},
};

/// Maximum number of chunks of one packet, which cover 128 KB.
const MAX_CHUNKS_PER_PACKET: u32 = 8;
/// Flag that wakes user space. It is not a bit of [`chunk_flag`].
pub const WAKEUP: u32 = 1 << 16;

/// Loads the first bytes of the batch at `offset` of the payload into the window; returns their
/// number.
#[unsafe(export_name = "zenoh_load_window")]
#[inline(never)]
pub extern "C" fn load_window(skb: *mut __sk_buff, slot: u32, offset: u32) -> u32 {
    let (Some(mut this), Some(mut buffer)) = (segment(slot), piece_buffer(slot)) else {
        return 0;
    };
    this.window_len = 0;
    let left = this.len.wrapping_sub(offset);
    let wanted = if left > WINDOW { WINDOW } else { left };
    if wanted == 0 || !load_into_buffer(skb, &mut buffer, this.body.wrapping_add(offset), wanted) {
        return 0;
    }
    this.window = offset;
    this.window_len = wanted;
    wanted
}

#[inline(always)]
fn load_into_buffer(skb: *mut __sk_buff, buffer: &mut PieceBuffer, from: u32, len: u32) -> bool {
    // SAFETY: the buffer can hold the longest piece.
    let status = unsafe {
        bpf_skb_load_bytes(
            skb.cast(),
            from,
            buffer.bytes.as_mut_ptr().cast(),
            bounded_piece_len(len) as u32,
        )
    };
    status == 0
}

/// Passes on `len` bytes at `offset` of the payload, and copies all of them. `flags` are those of
/// the first chunk.
#[unsafe(export_name = "zenoh_whole")]
#[inline(never)]
pub extern "C" fn write_full_chunks(
    skb: *mut __sk_buff,
    slot: u32,
    offset: u32,
    len: u32,
    flags: u32,
) -> u32 {
    let (mut written_len, mut chunk_count, mut flags) = (0, 0, flags);
    while chunk_count < MAX_CHUNKS_PER_PACKET {
        if written_len >= len {
            return 1;
        }
        let left = len - written_len;
        let chunk_len = if left > PIECE_BYTES {
            PIECE_BYTES
        } else {
            left
        };
        write_chunk(
            skb,
            slot,
            offset.wrapping_add(written_len),
            u64::from(chunk_len) << 32 | u64::from(chunk_len),
            flags,
        );
        flags &= WAKEUP;
        written_len += PIECE_BYTES;
        chunk_count += 1;
    }
    if written_len < len
        && let Some(mut this) = segment(slot)
    {
        this.state.pending_flags |= u32::from(chunk_flag::LOST);
    }
    1
}

/// Passes on bytes at `offset` of the payload. The lower half of `lengths` is their number, the
/// upper half the number of bytes that are copied.
#[unsafe(export_name = "zenoh_head")]
#[inline(never)]
pub extern "C" fn write_chunk(
    skb: *mut __sk_buff,
    slot: u32,
    offset: u32,
    lengths: u64,
    flags: u32,
) -> u32 {
    let (Some(mut this), Some(mut buffer)) = (segment(slot), piece_buffer(slot)) else {
        return 0;
    };
    let (len, copied) = (lengths as u32, (lengths >> 32) as u32);
    if PIECES.query(RING_AVAIL_DATA) > read_global(&WAKE_PIECE_BYTES) / 2 * 3 {
        // The rest of the ring is reserved for datagrams.
        return count_lost_chunk(slot);
    }
    if copied != 0 && (offset != this.window || copied > this.window_len) {
        this.window_len = 0;
        if !load_into_buffer(skb, &mut buffer, this.body.wrapping_add(offset), copied) {
            return count_lost_chunk(slot);
        }
    }
    fill_chunk_header(&mut buffer.piece, &this, offset);
    let piece = &mut buffer.piece;
    piece.datagram_len = len;
    piece.len = copied;
    piece.chunk |= (flags | this.state.pending_flags) as u16;
    let wake =
        if flags & WAKEUP != 0 || PIECES.query(RING_AVAIL_DATA) > read_global(&WAKE_PIECE_BYTES) {
            FORCE_WAKEUP
        } else {
            NO_WAKEUP
        };
    let size = size_of::<Piece>()
        + if copied == 0 {
            0
        } else {
            bounded_piece_len(copied)
        };
    // SAFETY: the buffer is that long.
    let bytes = unsafe { core::slice::from_raw_parts((&raw const *buffer).cast::<u8>(), size) };
    let written = PIECES.output::<[u8]>(bytes, wake).is_ok();
    buffer.piece.chunk = 0;
    if !written {
        return count_lost_chunk(slot);
    }
    if this.state.protocol == protocol::ZENOH {
        count(slot, Counter::ZenohChunks, 1);
    }
    this.state.pending_flags = 0;
    this.state.last_chunk_ns = this.now;
    1
}

/// Writes the fields of a piece that all chunks have.
#[inline(always)]
fn fill_chunk_header(piece: &mut Piece, this: &Segment, offset: u32) {
    piece.time = this.now;
    piece.socket = this.key.socket;
    piece.source = this.source;
    piece.destination = this.destination;
    piece.source_port = this.source_port as u16;
    piece.destination_port = this.destination_port as u16;
    piece.interface = this.interface;
    piece.datagram = this.sequence_number.wrapping_add(offset);
    piece.offset = 0;
    let ipv6 = if this.source[2] == IPV4_MAPPED && this.source[0] | this.source[1] == 0 {
        0
    } else {
        flag::IPV6
    };
    let outgoing = if this.key.outgoing == 0 {
        0
    } else {
        flag::OUTGOING
    };
    piece.flags = flag::HOST | flag::STREAM | ipv6 | outgoing;
    piece.chunk = if this.state.protocol == protocol::RTPS {
        chunk_flag::RTPS
    } else {
        0
    };
}

/// Returns the period of a time, in which the state of a connection is passed on once.
#[inline(always)]
pub fn link_report_period(now: u64) -> u32 {
    (now >> 30) as u32
}

/// Returns the sequence number after the last byte that was written to the socket at `address`.
#[inline(always)]
fn written_seq(address: u64) -> Option<u32> {
    if layout_entry(Layout::TcpWritten) == Layout::ABSENT {
        return None;
    }
    read_member(address, Layout::TcpWritten)
}

/// Passes on the sender's state of the connection, at most once in 2^30 nanoseconds. Within a host
/// there is no link.
#[unsafe(export_name = "zenoh_link")]
#[inline(never)]
pub extern "C" fn write_link_state(skb: *mut __sk_buff, slot: u32) -> u32 {
    let (Some(mut this), Some(mut buffer)) = (segment(slot), piece_buffer(slot)) else {
        return 0;
    };
    let period = link_report_period(this.now);
    if this.key.outgoing != 1 || this.interface == LOOPBACK || this.state.last_link_report == period
    {
        return 0;
    }
    this.state.last_link_report = period;
    // SAFETY: the verifier rewrites reads of this field, and checks it against null.
    let socket = unsafe { (*skb).__bindgen_anon_2.sk };
    if socket.is_null() {
        return 0;
    }
    // SAFETY: a socket of the context, checked against null.
    let socket = unsafe { bpf_sk_fullsock(socket) };
    if socket.is_null() {
        return 0;
    }
    // SAFETY: as above.
    let tcp = unsafe { bpf_tcp_sock(socket) };
    if tcp.is_null() {
        return 0;
    }
    // The kernel counts the segment only after this program.
    let end = this.sequence_number.wrapping_add(this.len);
    // SAFETY: a socket of TCP, checked against null; the verifier rewrites each read.
    let (mut state, next) = unsafe {
        let next = read_volatile(&raw const (*tcp).snd_nxt);
        let next = if end.wrapping_sub(next) as i32 > 0 {
            end
        } else {
            next
        };
        let acknowledged = read_volatile(&raw const (*tcp).snd_una);
        let state = Link {
            smoothed_rtt: read_volatile(&raw const (*tcp).srtt_us) >> 3,
            retransmitted: read_volatile(&raw const (*tcp).total_retrans),
            sent: read_volatile(&raw const (*tcp).data_segs_out),
            unacknowledged: next.wrapping_sub(acknowledged),
            unsent: 0,
            unsent_known: 0,
        };
        (state, next)
    };
    // The verifier permits no arithmetic on the pointer, and forgets that a value of a map is one.
    // SAFETY: a field of the slot's memory.
    let address = unsafe {
        write_volatile(&raw mut this.socket_address, socket as u64);
        read_volatile(&raw const this.socket_address)
    };
    if let Some(written) = written_seq(address) {
        state.unsent = written.wrapping_sub(next);
        state.unsent_known = 1;
    }
    // The window holds no bytes of the segment any more.
    this.window_len = 0;
    fill_chunk_header(&mut buffer.piece, &this, 0);
    buffer.piece.datagram_len = 0;
    buffer.piece.len = size_of::<Link>() as u32;
    buffer.piece.chunk |= chunk_flag::LINK;
    // SAFETY: the buffer is longer than the state, and aligned.
    unsafe { buffer.bytes.as_mut_ptr().cast::<Link>().write(state) };
    let size = size_of::<Piece>() + size_of::<Link>();
    // SAFETY: the buffer is that long.
    let bytes = unsafe { core::slice::from_raw_parts((&raw const *buffer).cast::<u8>(), size) };
    let _ = PIECES.output::<[u8]>(bytes, NO_WAKEUP);
    buffer.piece.chunk = 0;
    0
}

#[inline(always)]
fn count_lost_chunk(slot: u32) -> u32 {
    if let Some(mut this) = segment(slot) {
        let counter = if this.state.protocol == protocol::RTPS {
            Counter::TcpChunksLost
        } else {
            Counter::ZenohChunksLost
        };
        count(slot, counter, 1);
        this.state.pending_flags |= u32::from(chunk_flag::LOST);
    }
    0
}
