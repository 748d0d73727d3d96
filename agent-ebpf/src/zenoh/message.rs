//! Reads the header of a batch: determines which of its bytes are needed, and whether it may be a
//! batch at all.

use ros2probe_wire::zenoh_stream::{Lanes, PREFIX, message};

use super::{
    push,
    state::{WINDOW, Window, fragment_state, segment},
};

/// All bytes of a batch are needed.
pub const ALL_BYTES: u32 = u32::MAX;
/// Number of bytes passed on of a FRAGMENT that continues a message.
const CONTINUATION_LEN: u32 = 16;
/// Default priority of data, and priority of declarations.
const PRIORITY_DATA: u32 = 5;
const PRIORITY_CONTROL: u32 = 0;
/// Ids of transport messages.
const ID_MASK: u32 = message::ID as u32;
const KEEP_ALIVE: u32 = message::KEEP_ALIVE as u32;
const FRAME: u32 = message::FRAME as u32;
const FRAGMENT: u32 = message::FRAGMENT as u32;
const JOIN: u32 = message::JOIN as u32;
const LEAST_NETWORK: u32 = message::LEAST_NETWORK as u32;
/// Maximum size of a number, in bytes.
const MAX_VARINT_LEN: u32 = 9;
/// Maximum number of extensions of a message.
const MAX_EXTENSIONS: u32 = 8;

/// Reads the batch in the window: sets `forward_len`, `lane` and `lane_sequence_number`. Returns 1
/// if it may be a batch.
#[unsafe(export_name = "zenoh_read")]
#[inline(never)]
pub extern "C" fn plan_batch(slot: u32) -> u32 {
    u32::from(parse_batch(slot).is_some())
}

#[inline(always)]
fn parse_batch(slot: u32) -> Option<()> {
    let (Some(mut this), Some(window)) = (segment(slot), Window::of(slot)) else {
        return None;
    };
    this.forward_len = ALL_BYTES;
    this.lane = 0;
    this.payload = 0;
    this.attachment = 0;
    this.priority = PRIORITY_DATA;
    this.is_first = 0;
    this.is_shared = 0;
    this.wakes_reader = 0;
    let Some(header) = window.byte(PREFIX, this.window_len) else {
        // The segment ends before the header.
        return Some(());
    };
    let kind = header & ID_MASK;
    if kind > JOIN {
        return None;
    }
    this.wakes_reader = u32::from(kind != KEEP_ALIVE && kind < FRAME);
    if kind != FRAME && kind != FRAGMENT {
        return Some(());
    }
    this.position = PREFIX + 1;
    if read_varint(slot) == 0 {
        return accept_truncated_header(slot, kind);
    }
    this.lane_sequence_number = this.varint;
    if header & 0x80 != 0 && read_extensions(slot) == 0 {
        return accept_truncated_header(slot, kind);
    }
    this.message = this.position;
    this.lane = Lanes::key(this.priority, header & 0x20);
    let is_control = this.priority == PRIORITY_CONTROL;
    this.wakes_reader = u32::from(is_control);
    if this.is_probe != 0 {
        return Some(());
    }
    let in_frame = kind == FRAME;
    let is_first =
        in_frame || this.is_first != 0 || this.state.fragment_state & fragment_state::OPEN == 0;
    if is_first && !in_frame {
        this.state.fragment_state = 0;
    }
    if is_first && !is_control {
        let _ = push::plan_push(slot, in_frame);
    }
    if in_frame {
        return Some(());
    }
    if !is_first && this.state.fragment_state & fragment_state::WHOLE == 0 && !is_control {
        this.forward_len = match this.state.fragment_state & fragment_state::SKIPPED {
            0 => CONTINUATION_LEN,
            _ => 0,
        };
        this.is_over_budget =
            u32::from(this.state.fragment_state & fragment_state::OVER_BUDGET != 0);
    }
    this.state.fragment_state = match header & 0x40 {
        0 => 0,
        _ => this.state.fragment_state | fragment_state::OPEN,
    };
    Some(())
}

/// Handles a header that cannot be read: it is cut by the end of the segment, or it is not a
/// header.
#[inline(always)]
fn accept_truncated_header(slot: u32, kind: u32) -> Option<()> {
    let mut this = segment(slot)?;
    if this.window_len == WINDOW || this.window_len == this.batch_len {
        return None;
    }
    if kind == FRAGMENT && this.state.fragment_state & fragment_state::OPEN == 0 {
        // The publisher of the sample is unknown, so the whole sample is passed on.
        this.state.fragment_state = fragment_state::OPEN | fragment_state::WHOLE;
    }
    Some(())
}

/// Returns whether the window may hold a batch of an unknown connection. This test is stricter than
/// [`plan_batch`], which precedes it.
#[inline(always)]
pub fn is_plausible(slot: u32) -> bool {
    let (Some(this), Some(window)) = (segment(slot), Window::of(slot)) else {
        return false;
    };
    let Some(header) = window.byte(PREFIX, this.window_len) else {
        return false;
    };
    if header & ID_MASK == KEEP_ALIVE {
        return header == KEEP_ALIVE && this.batch_len == PREFIX + 1;
    }
    if this.lane == 0 {
        return false;
    }
    if header & ID_MASK == FRAGMENT {
        return true;
    }
    let Some(next) = window.byte(this.message, this.window_len) else {
        return false;
    };
    header & 0x40 == 0 && next & ID_MASK >= LEAST_NETWORK
}

/// Reads a number of variable length at the reader's position into `value`, without the bits above
/// the lowest 32; returns 0 if the number ends after the window.
#[unsafe(export_name = "zenoh_number")]
#[inline(never)]
pub extern "C" fn read_varint(slot: u32) -> u32 {
    let (Some(mut this), Some(window)) = (segment(slot), Window::of(slot)) else {
        return 0;
    };
    let (mut value, mut shift, mut count) = (0_u32, 0_u32, 0);
    while count < MAX_VARINT_LEN {
        let Some(next) = window.byte(this.position, this.window_len) else {
            return 0;
        };
        this.position += 1;
        count += 1;
        if shift < 32 {
            value |= (next & 0x7f) << shift;
        }
        shift += 7;
        // The ninth byte has no continuation bit.
        if next & 0x80 == 0 || count == MAX_VARINT_LEN {
            this.varint = value;
            return 1;
        }
    }
    0
}

/// Reads the extensions at the reader's position; returns 0 if they end after the window or are
/// malformed.
#[unsafe(export_name = "zenoh_extensions")]
#[inline(never)]
pub extern "C" fn read_extensions(slot: u32) -> u32 {
    let (Some(mut this), Some(window)) = (segment(slot), Window::of(slot)) else {
        return 0;
    };
    let mut count = 0;
    while count < MAX_EXTENSIONS {
        let Some(header) = window.byte(this.position, this.window_len) else {
            return 0;
        };
        this.position += 1;
        count += 1;
        let encoding = header & 0x60;
        if encoding == 0x60 {
            return 0;
        }
        this.varint = 0;
        if encoding != 0 && read_varint(slot) == 0 {
            return 0;
        }
        match header & 0x7f {
            0x31 => this.priority = this.varint & 7,
            0x02 => this.is_first = 1,
            0x12 => this.is_shared = 1,
            0x43 => {
                this.attachment = this.position;
                this.attachment_len = this.varint;
            }
            _ => {}
        }
        if encoding == 0x40 {
            if this.varint > WINDOW {
                return 0;
            }
            this.position += this.varint;
        }
        if header & 0x80 == 0 {
            return 1;
        }
    }
    0
}
