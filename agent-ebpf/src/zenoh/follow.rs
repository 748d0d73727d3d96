//! Follows one direction of a connection from batch to batch, and passes on the bytes that are
//! needed.
//!
//! A segment that repeats earlier bytes is left out. Missing bytes do not matter within a batch of
//! which only the head is needed, because the next boundary is still known. Otherwise all bytes are
//! passed on until a boundary is found again, and so are the missing bytes when TCP retransmits
//! them. User space restores the order of the segments and reads the batches.

use aya_ebpf::bindings::__sk_buff;
use core::mem::swap;
use ros2probe_wire::{
    filter::Counter,
    host::chunk as chunk_flag,
    rtps_tcp::{FrameHeader, RECOGNIZED},
    zenoh_stream::PREFIX,
};

use crate::maps::{ScratchRef, copy, count};

use super::{
    chunk::{self, WAKEUP},
    message::{self, ALL_BYTES},
    rtps, search,
    state::{CONNECTIONS, Segment, Window, body, mode, protocol, segment},
};

/// Maximum number of batches of one packet that are read. The bytes after them are passed on as a
/// whole.
const MAX_BATCHES: u32 = 64;
/// Maximum number of bytes passed on after a boundary was lost. Then the direction is no longer
/// followed.
const GAP_BYTES: u32 = 16 << 20;
/// Maximum time without a chunk of a direction, so that chunks show that its sender is alive.
const ALIVE_NANOSECONDS: u64 = 1_000_000_000;
/// Number of bytes passed on of a batch that only shows that its sender is alive.
const ALIVE_BYTES: u32 = 256;
/// Bit of `Direction::split_prefix` that marks a known first byte of a length.
const HAS_FIRST_BYTE: u32 = 0x100;

/// Handles a segment of a known direction.
#[inline(always)]
pub fn forward_segment(skb: *mut __sk_buff, slot: u32) -> u32 {
    let Some(mut this) = segment(slot) else {
        return 0;
    };
    let Some(state) = CONNECTIONS.get_ptr_mut(&this.key) else {
        return 0;
    };
    // SAFETY: a map value pointer checked against null. Segments of one direction follow each
    // other; at worst, runs that race on two CPUs lose a boundary.
    copy(unsafe { &*state }, &mut this.state);
    chunk::write_link_state(skb, slot);
    if this.len != 0 {
        process_payload(skb, slot);
    }
    if this.state.mode == mode::RESYNCHRONIZING && this.state.gap_bytes > GAP_BYTES {
        let _ = CONNECTIONS.remove(&this.key);
        return 0;
    }
    if let Some(state) = CONNECTIONS.get_ptr_mut(&this.key) {
        // SAFETY: as above.
        copy(&this.state, unsafe { &mut *state });
    }
    0
}

#[unsafe(export_name = "zenoh_take")]
#[inline(never)]
extern "C" fn process_payload(skb: *mut __sk_buff, slot: u32) -> u32 {
    let Some(mut this) = segment(slot) else {
        return 0;
    };
    let overlap_len = this.state.next_seq.wrapping_sub(this.sequence_number);
    if this.state.mode == mode::UNREADABLE {
        return 0;
    }
    if this.state.mode == mode::SYNCHRONIZED && overlap_len as i32 > 0 {
        // A retransmitted segment may begin before the hole, and end after it.
        let end = this.sequence_number.wrapping_add(this.len);
        let gap_end_seq = this.state.gap_start_seq.wrapping_add(this.state.gap_len);
        let fills_gap = this.state.gap_len != 0
            && end.wrapping_sub(this.state.gap_start_seq) as i32 > 0
            && this.sequence_number.wrapping_sub(gap_end_seq) as i32 <= -1;
        let retransmitted_len = if overlap_len >= this.len {
            this.len
        } else {
            overlap_len
        };
        if fills_gap {
            forward_gap_bytes(skb, slot, retransmitted_len);
        }
        if overlap_len >= this.len {
            return 0;
        }
        this.sequence_number = this.state.next_seq;
        this.body += overlap_len;
        this.len -= overlap_len;
    } else if this.state.mode == mode::SYNCHRONIZED && overlap_len != 0 {
        let ahead = this.state.next_batch_seq.wrapping_sub(this.sequence_number);
        let needs_missing_bytes = this.state.body == body::WHOLE
            || this.state.split_prefix != 0
            || this.state.body == body::HEAD && this.state.partial_length != 0;
        if needs_missing_bytes || (ahead as i32) < 0 {
            if this.state.body == body::HEAD {
                forward_seen_bytes(skb, slot);
            }
            let since = this.state.next_seq.wrapping_sub(this.state.gap_start_seq);
            if this.state.gap_len == 0 || since > GAP_BYTES {
                this.state.gap_start_seq = this.state.next_seq;
            }
            // An earlier hole may still be open: what fills it is needed, too.
            this.state.gap_len = this.sequence_number.wrapping_sub(this.state.gap_start_seq);
            enter_gap(slot, this);
        }
    } else if this.state.mode == mode::RESYNCHRONIZING && (overlap_len as i32) < 0 {
        this.state.gap_len = this.sequence_number.wrapping_sub(this.state.gap_start_seq);
    }
    let end = this.sequence_number.wrapping_add(this.len);
    let is_rtps = this.state.protocol == protocol::RTPS;
    if this.state.mode == mode::RESYNCHRONIZING
        && is_rtps
        && this.state.body != body::SKIPPED
        && overlap_len as i32 <= 0
        && rtps::starts_frame(skb, this.body, this.len)
    {
        this.state.mode = mode::SYNCHRONIZED;
        this.state.next_batch_seq = this.sequence_number;
        this.state.forwarded_seq = this.sequence_number;
        this.state.split_prefix = 0;
        this.state.partial_length = 0;
    }
    if this.state.mode == mode::RESYNCHRONIZING {
        if is_rtps && this.state.body == body::SKIPPED {
            forward_after_skipped_frame(skb, slot);
        } else if overlap_len as i32 > 0 {
            let len = this.len;
            forward_gap_bytes(skb, slot, len);
        } else {
            chunk::write_full_chunks(skb, slot, 0, this.len, 0);
        }
        this.state.gap_bytes = this.state.gap_bytes.wrapping_add(this.len);
        if end.wrapping_sub(this.state.next_seq) as i32 > 0 {
            this.state.next_seq = end;
        }
        if this.state.protocol == protocol::ZENOH && search::validate_batches(skb, slot, 1) != 0 {
            this.state.mode = mode::SYNCHRONIZED;
            this.state.next_batch_seq = this.state.candidate.next_batch_seq;
            this.state.forwarded_seq = end;
            this.state.next_seq = end;
            this.state.body = body::WHOLE;
            this.state.fragment_state = 0;
            this.state.split_prefix = 0;
        }
        return 0;
    }
    let left = this.state.next_batch_seq.wrapping_sub(this.sequence_number);
    // The end of a batch of which only the head is needed may be missing before the segment.
    let is_open =
        this.state.body == body::HEAD && this.state.forwarded_seq != this.state.next_batch_seq;
    if this.state.split_prefix == 0 && (left != 0 || is_open) {
        forward_batch_rest(skb, slot, left);
    }
    this.state.next_seq = end;
    let mut batches = 0;
    while batches < MAX_BATCHES {
        if process_batch(skb, slot) == 0 {
            return 0;
        }
        batches += 1;
    }
    let offset = this.state.next_batch_seq.wrapping_sub(this.sequence_number);
    if offset < this.len {
        enter_gap(slot, this);
        this.state.body = body::WHOLE;
        let rest = this.len - offset;
        chunk::write_full_chunks(skb, slot, offset, rest, u32::from(chunk_flag::BOUNDARY));
    }
    0
}

/// Passes on the bytes that were seen of a batch of which only the head is needed, without a copy.
#[inline(always)]
fn forward_seen_bytes(skb: *mut __sk_buff, slot: u32) {
    let Some(mut this) = segment(slot) else {
        return;
    };
    let covered = this.state.forwarded_seq;
    let seen = this.state.next_seq.wrapping_sub(covered);
    if seen as i32 > 0 {
        let offset = covered.wrapping_sub(this.sequence_number);
        chunk::write_chunk(skb, slot, offset, u64::from(seen), 0);
        this.state.forwarded_seq = this.state.next_seq;
    }
}

/// Passes on the first bytes of a segment that fill a hole. The flags are for later bytes.
#[inline(always)]
fn forward_gap_bytes(skb: *mut __sk_buff, slot: u32, len: u32) {
    let Some(mut this) = segment(slot) else {
        return;
    };
    let pending = this.state.pending_flags;
    this.state.pending_flags = 0;
    chunk::write_full_chunks(skb, slot, 0, len, 0);
    this.state.pending_flags |= pending;
}

/// Passes on a segment after a hole that began in a frame of which nothing is needed. The end of
/// that frame is known.
#[inline(always)]
fn forward_after_skipped_frame(skb: *mut __sk_buff, slot: u32) {
    let Some(mut this) = segment(slot) else {
        return;
    };
    let left = this.state.next_batch_seq.wrapping_sub(this.sequence_number);
    if (left as i32) < 0 {
        // The end of the frame is in the hole, and the bytes up to it are still left out.
        let pending = this.state.pending_flags;
        this.state.pending_flags = 0;
        chunk::write_full_chunks(skb, slot, 0, this.len, 0);
        this.state.pending_flags |= pending;
    } else if left < this.len {
        let rest = this.len - left;
        chunk::write_full_chunks(skb, slot, left, rest, u32::from(chunk_flag::BOUNDARY));
        this.state.body = body::WHOLE;
    }
}

/// Passes on the rest of a batch that an earlier segment began; `left` bytes of the batch remain.
#[inline(always)]
fn forward_batch_rest(skb: *mut __sk_buff, slot: u32, left: u32) {
    let Some(mut this) = segment(slot) else {
        return;
    };
    let available_len = if left > this.len { this.len } else { left };
    if this.state.body == body::WHOLE {
        chunk::write_full_chunks(skb, slot, 0, available_len, 0);
    } else if this.state.body == body::HEAD && this.state.partial_length != 0 {
        // The previous segment had only a part of the head.
        let wanted = this.state.partial_length;
        let copied = if wanted > available_len {
            available_len
        } else {
            wanted
        };
        this.state.partial_length = wanted - copied;
        chunk::write_chunk(
            skb,
            slot,
            0,
            u64::from(copied) << 32 | u64::from(available_len),
            0,
        );
    } else if this.state.body == body::HEAD && left <= this.len {
        let covered = this.state.forwarded_seq;
        let rest = this.state.next_batch_seq.wrapping_sub(covered);
        let offset = covered.wrapping_sub(this.sequence_number);
        chunk::write_chunk(skb, slot, offset, u64::from(rest), 0);
    } else {
        return;
    }
    this.state.forwarded_seq = this.sequence_number.wrapping_add(available_len);
}

#[inline(always)]
fn enter_gap(slot: u32, mut this: ScratchRef<Segment>) {
    let counter = if this.state.protocol == protocol::RTPS {
        Counter::TcpGaps
    } else {
        Counter::ZenohGaps
    };
    count(slot, counter, 1);
    this.state.mode = mode::RESYNCHRONIZING;
    this.state.gap_bytes = 0;
    this.state.candidate.is_valid = 0;
}

/// Handles the next batch that begins in the segment; returns 0 if no batch begins there, or if the
/// batch is unreadable.
#[unsafe(export_name = "zenoh_batch")]
#[inline(never)]
extern "C" fn process_batch(skb: *mut __sk_buff, slot: u32) -> u32 {
    let (Some(mut this), Some(window)) = (segment(slot), Window::of(slot)) else {
        return 0;
    };
    let offset = this.state.next_batch_seq.wrapping_sub(this.sequence_number);
    let is_rtps = this.state.protocol == protocol::RTPS;
    if this.state.split_prefix != 0 {
        return if is_rtps {
            process_split_header(skb, slot)
        } else {
            process_split_prefix(skb, slot)
        };
    }
    if offset >= this.len {
        return 0;
    }
    let read = chunk::load_window(skb, slot, offset);
    if is_rtps {
        return process_frame(skb, slot, offset, read);
    }
    let Some(low) = window.byte(0, read) else {
        return forward_unreadable(skb, slot, offset);
    };
    let Some(high) = window.byte(1, read) else {
        let one_byte = 1 << 32 | 1;
        chunk::write_chunk(skb, slot, offset, one_byte, u32::from(chunk_flag::BOUNDARY));
        this.state.split_prefix = HAS_FIRST_BYTE | low;
        return 0;
    };
    let total = (low | high << 8) + PREFIX;
    this.batch_len = total;
    if this.window_len > total {
        this.window_len = total;
    }
    this.is_probe = 0;
    this.is_over_budget = 0;
    if total == PREFIX {
        // Zenoh sends an empty batch in place of the rest of a message that was dropped.
        this.forward_len = 0;
    } else {
        if message::plan_batch(slot) == 0 {
            return forward_unreadable(skb, slot, offset);
        }
        count(slot, Counter::ZenohBatches, 1);
    }
    forward_batch(skb, slot, offset)
}

/// Handles the frame of RTPS that begins at `offset` of the segment, of which the first `read`
/// bytes are in the window.
#[inline(always)]
fn process_frame(skb: *mut __sk_buff, slot: u32, offset: u32, read: u32) -> u32 {
    let (Some(mut this), Some(window)) = (segment(slot), Window::of(slot)) else {
        return 0;
    };
    let left = this.len.wrapping_sub(offset);
    if left < RECOGNIZED as u32 {
        return save_partial_header(skb, slot, offset, left);
    }
    let total = rtps::frame_len(window, read);
    if total == 0 {
        return forward_unreadable(skb, slot, offset);
    }
    count(slot, Counter::TcpFrames, 1);
    this.batch_len = total;
    if this.window_len > total {
        this.window_len = total;
    }
    this.is_over_budget = 0;
    if rtps::plan_frame(slot) == 0 {
        return 0;
    }
    forward_batch(skb, slot, offset)
}

/// Keeps what the segment has of the header of a frame: its last `left` bytes.
#[inline(always)]
fn save_partial_header(skb: *mut __sk_buff, slot: u32, offset: u32, left: u32) -> u32 {
    let (Some(mut this), Some(window)) = (segment(slot), Window::of(slot)) else {
        return 0;
    };
    this.state.partial_length = length_bytes(window, 0, left);
    this.state.split_prefix = left;
    this.state.body = body::WHOLE;
    this.state.forwarded_seq = this.sequence_number.wrapping_add(this.len);
    let lengths = u64::from(left) << 32 | u64::from(left);
    chunk::write_chunk(skb, slot, offset, lengths, u32::from(chunk_flag::BOUNDARY));
    0
}

/// Returns those bytes of a frame's length that are in the window, whose first byte is byte `from`
/// of the header.
#[inline(always)]
fn length_bytes(window: Window, from: u32, read: u32) -> u32 {
    let (mut number, mut length) = (0, 0);
    while number < 4 {
        let at = number + 4;
        if at >= from
            && let Some(byte) = window.byte(at - from, read)
        {
            length |= byte << (8 * number);
        }
        number += 1;
    }
    length
}

/// Handles a frame whose header is split: the previous segment had its first bytes. The whole frame
/// is passed on.
#[inline(always)]
fn process_split_header(skb: *mut __sk_buff, slot: u32) -> u32 {
    let (Some(mut this), Some(window)) = (segment(slot), Window::of(slot)) else {
        return 0;
    };
    let before = this.state.split_prefix;
    let read = chunk::load_window(skb, slot, 0);
    if before + this.len < RECOGNIZED as u32 {
        // The whole header has not arrived: the frame is found again at a later segment.
        return forward_unreadable(skb, slot, 0);
    }
    let total = this.state.partial_length | length_bytes(window, before, read);
    if !FrameHeader::is_length(total) {
        return forward_unreadable(skb, slot, 0);
    }
    count(slot, Counter::TcpFrames, 1);
    this.state.split_prefix = 0;
    this.state.partial_length = 0;
    let rest = total.wrapping_sub(before);
    let available_len = if rest > this.len { this.len } else { rest };
    this.state.next_batch_seq = this.state.next_batch_seq.wrapping_add(total);
    this.state.body = body::WHOLE;
    chunk::write_full_chunks(skb, slot, 0, available_len, 0);
    this.state.forwarded_seq = this.sequence_number.wrapping_add(available_len);
    1
}

/// Passes on what is wanted of the batch at `offset`.
#[inline(always)]
fn forward_batch(skb: *mut __sk_buff, slot: u32, offset: u32) -> u32 {
    let Some(mut this) = segment(slot) else {
        return 0;
    };
    let total = this.batch_len;
    let left = this.len.wrapping_sub(offset);
    let available_len = if total > left { left } else { total };
    this.state.next_batch_seq = this.state.next_batch_seq.wrapping_add(total);
    // While a hole may be open, each frame is named, so that user space waits for the hole.
    let is_after_gap = this.state.protocol == protocol::RTPS
        && this.state.gap_len != 0
        && this.state.next_seq.wrapping_sub(this.state.gap_start_seq) < GAP_BYTES;
    let is_chunk_due = this.now.wrapping_sub(this.state.last_chunk_ns) > ALIVE_NANOSECONDS;
    if this.forward_len == 0 && (is_chunk_due || is_after_gap) {
        this.forward_len = ALIVE_BYTES;
    }
    let boundary = u32::from(chunk_flag::BOUNDARY);
    if this.forward_len == ALL_BYTES {
        let wake = if this.wakes_reader != 0 { WAKEUP } else { 0 };
        this.state.body = body::WHOLE;
        chunk::write_full_chunks(skb, slot, offset, available_len, boundary | wake);
    } else if this.forward_len == 0 {
        if this.state.protocol == protocol::ZENOH {
            count(slot, Counter::ZenohSkipped, 1);
        }
        this.state.body = body::SKIPPED;
        this.state.pending_flags |= u32::from(chunk_flag::SKIPPED);
        if this.is_over_budget != 0 {
            this.state.pending_flags |= u32::from(chunk_flag::OVER_BUDGET);
        }
    } else {
        let copied = if this.forward_len > available_len {
            available_len
        } else {
            this.forward_len
        };
        this.state.body = body::HEAD;
        this.state.partial_length =
            if this.state.protocol == protocol::RTPS && available_len < total {
                this.forward_len - copied
            } else {
                0
            };
        let lengths = u64::from(copied) << 32 | u64::from(available_len);
        chunk::write_chunk(skb, slot, offset, lengths, boundary);
    }
    this.state.forwarded_seq = this.sequence_number.wrapping_add(offset + available_len);
    1
}

/// Handles a batch whose length is split: the previous segment had its first byte.
#[inline(always)]
fn process_split_prefix(skb: *mut __sk_buff, slot: u32) -> u32 {
    let (Some(mut this), Some(window)) = (segment(slot), Window::of(slot)) else {
        return 0;
    };
    let read = chunk::load_window(skb, slot, 0);
    let Some(high) = window.byte(0, read) else {
        return forward_unreadable(skb, slot, 0);
    };
    let length = this.state.split_prefix & 0xff | high << 8;
    this.state.split_prefix = 0;
    if length != 0 {
        count(slot, Counter::ZenohBatches, 1);
    }
    let available_len = if length + 1 > this.len {
        this.len
    } else {
        length + 1
    };
    this.state.next_batch_seq = this.state.next_batch_seq.wrapping_add(length + PREFIX);
    this.state.body = body::WHOLE;
    chunk::write_full_chunks(skb, slot, 0, available_len, 0);
    this.state.forwarded_seq = this.sequence_number.wrapping_add(available_len);
    1
}

/// Passes on the rest of a segment that has no readable batch at `offset`.
#[inline(always)]
fn forward_unreadable(skb: *mut __sk_buff, slot: u32, offset: u32) -> u32 {
    if let Some(mut this) = segment(slot) {
        enter_gap(slot, this);
        this.state.body = body::WHOLE;
        let rest = this.len.wrapping_sub(offset);
        chunk::write_full_chunks(skb, slot, offset, rest, 0);
    }
    0
}

/// Handles the end of a direction, and with `is_reset` that of the other one, too.
#[unsafe(export_name = "zenoh_end")]
#[inline(never)]
pub extern "C" fn end_direction(skb: *mut __sk_buff, slot: u32, is_reset: u32) -> u32 {
    let Some(mut this) = segment(slot) else {
        return 0;
    };
    let offset = this.len;
    close_direction(skb, slot, offset);
    if is_reset == 0 {
        return 0;
    }
    let this = &mut *this;
    this.key.outgoing = u32::from(this.key.outgoing == 0);
    this.key.ports = this.key.ports << 16 | this.key.ports >> 16;
    swap(&mut this.source_port, &mut this.destination_port);
    let mut word = 0;
    while word < 4 {
        let (one, other) = (this.source[word], this.destination[word]);
        this.source[word] = other;
        this.destination[word] = one;
        word += 1;
    }
    if let Some(state) = CONNECTIONS.get_ptr_mut(&this.key) {
        // SAFETY: a map value pointer checked against null.
        this.sequence_number = unsafe { (*state).next_seq };
        close_direction(skb, slot, 0);
    }
    0
}

#[unsafe(export_name = "zenoh_close")]
#[inline(never)]
extern "C" fn close_direction(skb: *mut __sk_buff, slot: u32, offset: u32) -> u32 {
    let Some(mut this) = segment(slot) else {
        return 0;
    };
    let Some(state) = CONNECTIONS.get_ptr_mut(&this.key) else {
        return 0;
    };
    // SAFETY: a map value pointer checked against null.
    this.state.pending_flags = unsafe { (*state).pending_flags };
    chunk::write_chunk(skb, slot, offset, 0, u32::from(chunk_flag::END) | WAKEUP);
    let _ = CONNECTIONS.remove(&this.key);
    1
}
