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
    host::chunk as part,
    rtps_tcp::{FrameHeader, RECOGNIZED},
    zenoh_stream::PREFIX,
};

use crate::maps::{Working, copy, count};

use super::{
    chunk::{self, WAKE},
    message::{self, WHOLE},
    rtps, search,
    state::{CONNECTIONS, Segment, Window, body, mode, protocol, segment as current},
};

/// Maximum number of batches of one packet that are read. The bytes after them are passed on as a
/// whole.
const BATCHES: u32 = 64;
/// Maximum number of bytes passed on after a boundary was lost. Then the direction is no longer
/// followed.
const GAP_BYTES: u32 = 16 << 20;
/// Maximum time without a chunk of a direction, so that chunks show that its sender is alive.
const ALIVE_NANOSECONDS: u64 = 1_000_000_000;
/// Number of bytes passed on of a batch that only shows that its sender is alive.
const ALIVE_BYTES: u32 = 256;
/// Bit of `Direction::prefix` that marks a known first byte of a length.
const SPLIT: u32 = 0x100;

/// Handles a segment of a known direction.
#[inline(always)]
pub fn segment(skb: *mut __sk_buff, slot: u32) -> u32 {
    let Some(mut this) = current(slot) else {
        return 0;
    };
    let Some(state) = CONNECTIONS.get_ptr_mut(&this.key) else {
        return 0;
    };
    // SAFETY: a map value pointer checked against null. Segments of one direction follow each
    // other; at worst, runs that race on two CPUs lose a boundary.
    copy(unsafe { &*state }, &mut this.state);
    chunk::link(skb, slot);
    if this.len != 0 {
        take(skb, slot);
    }
    if this.state.mode == mode::GAP && this.state.gap_bytes > GAP_BYTES {
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
extern "C" fn take(skb: *mut __sk_buff, slot: u32) -> u32 {
    let Some(mut this) = current(slot) else {
        return 0;
    };
    let behind = this.state.next.wrapping_sub(this.sequence_number);
    if this.state.mode == mode::UNREADABLE {
        return 0;
    }
    if this.state.mode == mode::FOLLOWED && behind as i32 > 0 {
        // A retransmitted segment may begin before the hole, and end after it.
        let end = this.sequence_number.wrapping_add(this.len);
        let hole_end = this.state.hole.wrapping_add(this.state.hole_len);
        let is_for_hole = this.state.hole_len != 0
            && end.wrapping_sub(this.state.hole) as i32 > 0
            && this.sequence_number.wrapping_sub(hole_end) as i32 <= -1;
        let repeated = if behind >= this.len { this.len } else { behind };
        if is_for_hole {
            fill(skb, slot, repeated);
        }
        if behind >= this.len {
            return 0;
        }
        this.sequence_number = this.state.next;
        this.body += behind;
        this.len -= behind;
    } else if this.state.mode == mode::FOLLOWED && behind != 0 {
        let ahead = this.state.boundary.wrapping_sub(this.sequence_number);
        let needs_next = this.state.body == body::WHOLE
            || this.state.prefix != 0
            || this.state.body == body::HEAD && this.state.length != 0;
        if needs_next || (ahead as i32) < 0 {
            if this.state.body == body::HEAD {
                cover(skb, slot);
            }
            let since = this.state.next.wrapping_sub(this.state.hole);
            if this.state.hole_len == 0 || since > GAP_BYTES {
                this.state.hole = this.state.next;
            }
            // An earlier hole may still be open: what fills it is needed, too.
            this.state.hole_len = this.sequence_number.wrapping_sub(this.state.hole);
            lose(slot, this);
        }
    } else if this.state.mode == mode::GAP && (behind as i32) < 0 {
        this.state.hole_len = this.sequence_number.wrapping_sub(this.state.hole);
    }
    let end = this.sequence_number.wrapping_add(this.len);
    let is_rtps = this.state.protocol == protocol::RTPS;
    if this.state.mode == mode::GAP
        && is_rtps
        && this.state.body != body::SKIPPED
        && behind as i32 <= 0
        && rtps::begins(skb, this.body, this.len)
    {
        this.state.mode = mode::FOLLOWED;
        this.state.boundary = this.sequence_number;
        this.state.covered = this.sequence_number;
        this.state.prefix = 0;
        this.state.length = 0;
    }
    if this.state.mode == mode::GAP {
        if is_rtps && this.state.body == body::SKIPPED {
            after_skipped(skb, slot);
        } else if behind as i32 > 0 {
            let len = this.len;
            fill(skb, slot, len);
        } else {
            chunk::whole(skb, slot, 0, this.len, 0);
        }
        this.state.gap_bytes = this.state.gap_bytes.wrapping_add(this.len);
        if end.wrapping_sub(this.state.next) as i32 > 0 {
            this.state.next = end;
        }
        if this.state.protocol == protocol::ZENOH && search::judge(skb, slot, 1) != 0 {
            this.state.mode = mode::FOLLOWED;
            this.state.boundary = this.state.guess.boundary;
            this.state.covered = end;
            this.state.next = end;
            this.state.body = body::WHOLE;
            this.state.chain = 0;
            this.state.prefix = 0;
        }
        return 0;
    }
    let left = this.state.boundary.wrapping_sub(this.sequence_number);
    // The end of a batch of which only the head is needed may be missing before the segment.
    let is_open = this.state.body == body::HEAD && this.state.covered != this.state.boundary;
    if this.state.prefix == 0 && (left != 0 || is_open) {
        finish(skb, slot, left);
    }
    this.state.next = end;
    let mut batches = 0;
    while batches < BATCHES {
        if batch(skb, slot) == 0 {
            return 0;
        }
        batches += 1;
    }
    let offset = this.state.boundary.wrapping_sub(this.sequence_number);
    if offset < this.len {
        lose(slot, this);
        this.state.body = body::WHOLE;
        let rest = this.len - offset;
        chunk::whole(skb, slot, offset, rest, u32::from(part::BOUNDARY));
    }
    0
}

/// Passes on the bytes that were seen of a batch of which only the head is needed, without a copy.
#[inline(always)]
fn cover(skb: *mut __sk_buff, slot: u32) {
    let Some(mut this) = current(slot) else {
        return;
    };
    let covered = this.state.covered;
    let seen = this.state.next.wrapping_sub(covered);
    if seen as i32 > 0 {
        let offset = covered.wrapping_sub(this.sequence_number);
        chunk::head(skb, slot, offset, u64::from(seen), 0);
        this.state.covered = this.state.next;
    }
}

/// Passes on the first bytes of a segment that fill a hole. The flags are for later bytes.
#[inline(always)]
fn fill(skb: *mut __sk_buff, slot: u32, len: u32) {
    let Some(mut this) = current(slot) else {
        return;
    };
    let pending = this.state.pending;
    this.state.pending = 0;
    chunk::whole(skb, slot, 0, len, 0);
    this.state.pending |= pending;
}

/// Passes on a segment after a hole that began in a frame of which nothing is needed. The end of
/// that frame is known.
#[inline(always)]
fn after_skipped(skb: *mut __sk_buff, slot: u32) {
    let Some(mut this) = current(slot) else {
        return;
    };
    let left = this.state.boundary.wrapping_sub(this.sequence_number);
    if (left as i32) < 0 {
        // The end of the frame is in the hole, and the bytes up to it are still left out.
        let pending = this.state.pending;
        this.state.pending = 0;
        chunk::whole(skb, slot, 0, this.len, 0);
        this.state.pending |= pending;
    } else if left < this.len {
        let rest = this.len - left;
        chunk::whole(skb, slot, left, rest, u32::from(part::BOUNDARY));
        this.state.body = body::WHOLE;
    }
}

/// Passes on the rest of a batch that an earlier segment began; `left` bytes of the batch remain.
#[inline(always)]
fn finish(skb: *mut __sk_buff, slot: u32, left: u32) {
    let Some(mut this) = current(slot) else {
        return;
    };
    let now = if left > this.len { this.len } else { left };
    if this.state.body == body::WHOLE {
        chunk::whole(skb, slot, 0, now, 0);
    } else if this.state.body == body::HEAD && this.state.length != 0 {
        // The previous segment had only a part of the head.
        let wanted = this.state.length;
        let copied = if wanted > now { now } else { wanted };
        this.state.length = wanted - copied;
        chunk::head(skb, slot, 0, u64::from(copied) << 32 | u64::from(now), 0);
    } else if this.state.body == body::HEAD && left <= this.len {
        let covered = this.state.covered;
        let rest = this.state.boundary.wrapping_sub(covered);
        let offset = covered.wrapping_sub(this.sequence_number);
        chunk::head(skb, slot, offset, u64::from(rest), 0);
    } else {
        return;
    }
    this.state.covered = this.sequence_number.wrapping_add(now);
}

#[inline(always)]
fn lose(slot: u32, mut this: Working<Segment>) {
    let counter = if this.state.protocol == protocol::RTPS {
        Counter::TcpGaps
    } else {
        Counter::ZenohGaps
    };
    count(slot, counter, 1);
    this.state.mode = mode::GAP;
    this.state.gap_bytes = 0;
    this.state.guess.is_open = 0;
}

/// Handles the next batch that begins in the segment; returns 0 if no batch begins there, or if the
/// batch is unreadable.
#[unsafe(export_name = "zenoh_batch")]
#[inline(never)]
extern "C" fn batch(skb: *mut __sk_buff, slot: u32) -> u32 {
    let (Some(mut this), Some(window)) = (current(slot), Window::of(slot)) else {
        return 0;
    };
    let offset = this.state.boundary.wrapping_sub(this.sequence_number);
    let is_rtps = this.state.protocol == protocol::RTPS;
    if this.state.prefix != 0 {
        return if is_rtps {
            split_header(skb, slot)
        } else {
            split(skb, slot)
        };
    }
    if offset >= this.len {
        return 0;
    }
    let read = chunk::load_window(skb, slot, offset);
    if is_rtps {
        return frame(skb, slot, offset, read);
    }
    let Some(low) = window.byte(0, read) else {
        return unreadable(skb, slot, offset);
    };
    let Some(high) = window.byte(1, read) else {
        let one = 1 << 32 | 1;
        chunk::head(skb, slot, offset, one, u32::from(part::BOUNDARY));
        this.state.prefix = SPLIT | low;
        return 0;
    };
    let total = (low | high << 8) + PREFIX;
    this.total = total;
    if this.end > total {
        this.end = total;
    }
    this.is_judged = 0;
    this.is_over_budget = 0;
    if total == PREFIX {
        // Zenoh sends an empty batch in place of the rest of a message that was dropped.
        this.wanted = 0;
    } else {
        if message::read(slot) == 0 {
            return unreadable(skb, slot, offset);
        }
        count(slot, Counter::ZenohBatches, 1);
    }
    pass(skb, slot, offset)
}

/// Handles the frame of RTPS that begins at `offset` of the segment, of which the first `read`
/// bytes are in the window.
#[inline(always)]
fn frame(skb: *mut __sk_buff, slot: u32, offset: u32, read: u32) -> u32 {
    let (Some(mut this), Some(window)) = (current(slot), Window::of(slot)) else {
        return 0;
    };
    let left = this.len.wrapping_sub(offset);
    if left < RECOGNIZED as u32 {
        return cut_header(skb, slot, offset, left);
    }
    let total = rtps::length(window, read);
    if total == 0 {
        return unreadable(skb, slot, offset);
    }
    count(slot, Counter::TcpFrames, 1);
    this.total = total;
    if this.end > total {
        this.end = total;
    }
    this.is_over_budget = 0;
    if rtps::read(slot) == 0 {
        return 0;
    }
    pass(skb, slot, offset)
}

/// Keeps what the segment has of the header of a frame: its last `left` bytes.
#[inline(always)]
fn cut_header(skb: *mut __sk_buff, slot: u32, offset: u32, left: u32) -> u32 {
    let (Some(mut this), Some(window)) = (current(slot), Window::of(slot)) else {
        return 0;
    };
    this.state.length = length_bytes(window, 0, left);
    this.state.prefix = left;
    this.state.body = body::WHOLE;
    this.state.covered = this.sequence_number.wrapping_add(this.len);
    let lengths = u64::from(left) << 32 | u64::from(left);
    chunk::head(skb, slot, offset, lengths, u32::from(part::BOUNDARY));
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
fn split_header(skb: *mut __sk_buff, slot: u32) -> u32 {
    let (Some(mut this), Some(window)) = (current(slot), Window::of(slot)) else {
        return 0;
    };
    let before = this.state.prefix;
    let read = chunk::load_window(skb, slot, 0);
    if before + this.len < RECOGNIZED as u32 {
        // The whole header has not arrived: the frame is found again at a later segment.
        return unreadable(skb, slot, 0);
    }
    let total = this.state.length | length_bytes(window, before, read);
    if !FrameHeader::is_length(total) {
        return unreadable(skb, slot, 0);
    }
    count(slot, Counter::TcpFrames, 1);
    this.state.prefix = 0;
    this.state.length = 0;
    let rest = total.wrapping_sub(before);
    let now = if rest > this.len { this.len } else { rest };
    this.state.boundary = this.state.boundary.wrapping_add(total);
    this.state.body = body::WHOLE;
    chunk::whole(skb, slot, 0, now, 0);
    this.state.covered = this.sequence_number.wrapping_add(now);
    1
}

/// Passes on what is wanted of the batch at `offset`.
#[inline(always)]
fn pass(skb: *mut __sk_buff, slot: u32, offset: u32) -> u32 {
    let Some(mut this) = current(slot) else {
        return 0;
    };
    let total = this.total;
    let left = this.len.wrapping_sub(offset);
    let now = if total > left { left } else { total };
    this.state.boundary = this.state.boundary.wrapping_add(total);
    // While a hole may be open, each frame is named, so that user space waits for the hole.
    let is_after_hole = this.state.protocol == protocol::RTPS
        && this.state.hole_len != 0
        && this.state.next.wrapping_sub(this.state.hole) < GAP_BYTES;
    let is_silent = this.now.wrapping_sub(this.state.reported) > ALIVE_NANOSECONDS;
    if this.wanted == 0 && (is_silent || is_after_hole) {
        this.wanted = ALIVE_BYTES;
    }
    let boundary = u32::from(part::BOUNDARY);
    if this.wanted == WHOLE {
        let wake = if this.wakes != 0 { WAKE } else { 0 };
        this.state.body = body::WHOLE;
        chunk::whole(skb, slot, offset, now, boundary | wake);
    } else if this.wanted == 0 {
        if this.state.protocol == protocol::ZENOH {
            count(slot, Counter::ZenohSkipped, 1);
        }
        this.state.body = body::SKIPPED;
        this.state.pending |= u32::from(part::SKIPPED);
        if this.is_over_budget != 0 {
            this.state.pending |= u32::from(part::OVER_BUDGET);
        }
    } else {
        let copied = if this.wanted > now { now } else { this.wanted };
        this.state.body = body::HEAD;
        this.state.length = if this.state.protocol == protocol::RTPS && now < total {
            this.wanted - copied
        } else {
            0
        };
        let lengths = u64::from(copied) << 32 | u64::from(now);
        chunk::head(skb, slot, offset, lengths, boundary);
    }
    this.state.covered = this.sequence_number.wrapping_add(offset + now);
    1
}

/// Handles a batch whose length is split: the previous segment had its first byte.
#[inline(always)]
fn split(skb: *mut __sk_buff, slot: u32) -> u32 {
    let (Some(mut this), Some(window)) = (current(slot), Window::of(slot)) else {
        return 0;
    };
    let read = chunk::load_window(skb, slot, 0);
    let Some(high) = window.byte(0, read) else {
        return unreadable(skb, slot, 0);
    };
    let length = this.state.prefix & 0xff | high << 8;
    this.state.prefix = 0;
    if length != 0 {
        count(slot, Counter::ZenohBatches, 1);
    }
    let now = if length + 1 > this.len {
        this.len
    } else {
        length + 1
    };
    this.state.boundary = this.state.boundary.wrapping_add(length + PREFIX);
    this.state.body = body::WHOLE;
    chunk::whole(skb, slot, 0, now, 0);
    this.state.covered = this.sequence_number.wrapping_add(now);
    1
}

/// Passes on the rest of a segment that has no readable batch at `offset`.
#[inline(always)]
fn unreadable(skb: *mut __sk_buff, slot: u32, offset: u32) -> u32 {
    if let Some(mut this) = current(slot) {
        lose(slot, this);
        this.state.body = body::WHOLE;
        let rest = this.len.wrapping_sub(offset);
        chunk::whole(skb, slot, offset, rest, 0);
    }
    0
}

/// Handles the end of a direction, and with `is_reset` that of the other one, too.
#[unsafe(export_name = "zenoh_end")]
#[inline(never)]
pub extern "C" fn end(skb: *mut __sk_buff, slot: u32, is_reset: u32) -> u32 {
    let Some(mut this) = current(slot) else {
        return 0;
    };
    let offset = this.len;
    close(skb, slot, offset);
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
        this.sequence_number = unsafe { (*state).next };
        close(skb, slot, 0);
    }
    0
}

#[unsafe(export_name = "zenoh_close")]
#[inline(never)]
extern "C" fn close(skb: *mut __sk_buff, slot: u32, offset: u32) -> u32 {
    let Some(mut this) = current(slot) else {
        return 0;
    };
    let Some(state) = CONNECTIONS.get_ptr_mut(&this.key) else {
        return 0;
    };
    // SAFETY: a map value pointer checked against null.
    this.state.pending = unsafe { (*state).pending };
    chunk::head(skb, slot, offset, 0, u32::from(part::END) | WAKE);
    let _ = CONNECTIONS.remove(&this.key);
    1
}
