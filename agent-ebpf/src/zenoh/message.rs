//! Reads the header of a batch: determines which of its bytes are needed, and whether it may be a
//! batch at all.

use ros2probe_wire::zenoh_stream::{Lanes, PREFIX, message};

use super::{
    push,
    state::{WINDOW, Window, chain, segment},
};

/// All bytes of a batch are needed.
pub const WHOLE: u32 = u32::MAX;
/// Number of bytes passed on of a FRAGMENT that continues a message.
const CONTINUATION: u32 = 16;
/// Default priority of data, and priority of declarations.
const DATA: u32 = 5;
const CONTROL: u32 = 0;
/// Ids of transport messages.
const ID: u32 = message::ID as u32;
const KEEP_ALIVE: u32 = message::KEEP_ALIVE as u32;
const FRAME: u32 = message::FRAME as u32;
const FRAGMENT: u32 = message::FRAGMENT as u32;
const JOIN: u32 = message::JOIN as u32;
const LEAST_NETWORK: u32 = message::LEAST_NETWORK as u32;
/// Maximum size of a number, in bytes.
const NUMBER: u32 = 9;
/// Maximum number of extensions of a message.
const EXTENSIONS: u32 = 8;

/// Reads the batch in the window: sets `wanted`, `lane` and `number`. Returns 1 if it may be a
/// batch.
#[unsafe(export_name = "zenoh_read")]
#[inline(never)]
pub extern "C" fn read(slot: u32) -> u32 {
    u32::from(batch(slot).is_some())
}

#[inline(always)]
fn batch(slot: u32) -> Option<()> {
    let (Some(mut this), Some(window)) = (segment(slot), Window::of(slot)) else {
        return None;
    };
    this.wanted = WHOLE;
    this.lane = 0;
    this.payload = 0;
    this.attachment = 0;
    this.priority = DATA;
    this.is_first = 0;
    this.is_shared = 0;
    this.wakes = 0;
    let Some(header) = window.byte(PREFIX, this.end) else {
        // The segment ends before the header.
        return Some(());
    };
    let kind = header & ID;
    if kind > JOIN {
        return None;
    }
    this.wakes = u32::from(kind != KEEP_ALIVE && kind < FRAME);
    if kind != FRAME && kind != FRAGMENT {
        return Some(());
    }
    this.at = PREFIX + 1;
    if number(slot) == 0 {
        return is_cut(slot, kind);
    }
    this.number = this.value;
    if header & 0x80 != 0 && extensions(slot) == 0 {
        return is_cut(slot, kind);
    }
    this.message = this.at;
    this.lane = Lanes::key(this.priority, header & 0x20);
    let is_control = this.priority == CONTROL;
    this.wakes = u32::from(is_control);
    if this.is_judged != 0 {
        return Some(());
    }
    let in_frame = kind == FRAME;
    let is_first = in_frame || this.is_first != 0 || this.state.chain & chain::OPEN == 0;
    if is_first && !in_frame {
        this.state.chain = 0;
    }
    if is_first && !is_control {
        let _ = push::read(slot, in_frame);
    }
    if in_frame {
        return Some(());
    }
    if !is_first && this.state.chain & chain::WHOLE == 0 && !is_control {
        this.wanted = match this.state.chain & chain::SKIPPED {
            0 => CONTINUATION,
            _ => 0,
        };
        this.is_over_budget = u32::from(this.state.chain & chain::OVER_BUDGET != 0);
    }
    this.state.chain = match header & 0x40 {
        0 => 0,
        _ => this.state.chain | chain::OPEN,
    };
    Some(())
}

/// Handles a header that cannot be read: it is cut by the end of the segment, or it is not a
/// header.
#[inline(always)]
fn is_cut(slot: u32, kind: u32) -> Option<()> {
    let mut this = segment(slot)?;
    if this.end == WINDOW || this.end == this.total {
        return None;
    }
    if kind == FRAGMENT && this.state.chain & chain::OPEN == 0 {
        // The publisher of the sample is unknown, so the whole sample is passed on.
        this.state.chain = chain::OPEN | chain::WHOLE;
    }
    Some(())
}

/// Returns whether the window may hold a batch of an unknown connection. This test is stricter than
/// [`read`], which precedes it.
#[inline(always)]
pub fn is_plausible(slot: u32) -> bool {
    let (Some(this), Some(window)) = (segment(slot), Window::of(slot)) else {
        return false;
    };
    let Some(header) = window.byte(PREFIX, this.end) else {
        return false;
    };
    if header & ID == KEEP_ALIVE {
        return header == KEEP_ALIVE && this.total == PREFIX + 1;
    }
    if this.lane == 0 {
        return false;
    }
    if header & ID == FRAGMENT {
        return true;
    }
    let Some(next) = window.byte(this.message, this.end) else {
        return false;
    };
    header & 0x40 == 0 && next & ID >= LEAST_NETWORK
}

/// Reads a number of variable length at the reader's position into `value`, without the bits above
/// the lowest 32; returns 0 if the number ends after the window.
#[unsafe(export_name = "zenoh_number")]
#[inline(never)]
pub extern "C" fn number(slot: u32) -> u32 {
    let (Some(mut this), Some(window)) = (segment(slot), Window::of(slot)) else {
        return 0;
    };
    let (mut value, mut shift, mut count) = (0_u32, 0_u32, 0);
    while count < NUMBER {
        let Some(next) = window.byte(this.at, this.end) else {
            return 0;
        };
        this.at += 1;
        count += 1;
        if shift < 32 {
            value |= (next & 0x7f) << shift;
        }
        shift += 7;
        // The ninth byte has no continuation bit.
        if next & 0x80 == 0 || count == NUMBER {
            this.value = value;
            return 1;
        }
    }
    0
}

/// Reads the extensions at the reader's position; returns 0 if they end after the window or are
/// malformed.
#[unsafe(export_name = "zenoh_extensions")]
#[inline(never)]
pub extern "C" fn extensions(slot: u32) -> u32 {
    let (Some(mut this), Some(window)) = (segment(slot), Window::of(slot)) else {
        return 0;
    };
    let mut count = 0;
    while count < EXTENSIONS {
        let Some(header) = window.byte(this.at, this.end) else {
            return 0;
        };
        this.at += 1;
        count += 1;
        let encoding = header & 0x60;
        if encoding == 0x60 {
            return 0;
        }
        this.value = 0;
        if encoding != 0 && number(slot) == 0 {
            return 0;
        }
        match header & 0x7f {
            0x31 => this.priority = this.value & 7,
            0x02 => this.is_first = 1,
            0x12 => this.is_shared = 1,
            0x43 => {
                this.attachment = this.at;
                this.attachment_len = this.value;
            }
            _ => {}
        }
        if encoding == 0x40 {
            if this.value > WINDOW {
                return 0;
            }
            this.at += this.value;
        }
        if header & 0x80 == 0 {
            return 1;
        }
    }
    0
}
