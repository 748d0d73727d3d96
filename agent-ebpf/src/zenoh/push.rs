//! Reads a PUSH, the message of a sample, up to its payload, and decides which bytes of the sample
//! are passed on.

use ros2probe_wire::{
    filter::{Budget, Counter},
    record::Verdict,
};

use crate::{
    maps::{INTEREST, count},
    verdict::spend,
};

use super::{
    message::{extensions, number},
    state::{WINDOW, Window, chain, segment},
};

const PUSH: u32 = 0x1d;
const PUT: u32 = 0x01;
/// Number of payload bytes that are passed on with the head; they include `Header.stamp`.
const PAYLOAD: u32 = 32;
/// Attachments of rmw_zenoh: their length, and the offset of the gid in them.
const PLAIN: [u32; 2] = [33, 17];
const LABELLED: [u32; 2] = [77, 61];
const GID: u32 = 16;

/// Reads the PUSH at the reader's position and sets `wanted`. In a FRAME, `wanted` is set only if
/// nothing follows the PUSH, or if its header exceeds the window.
#[inline(always)]
pub fn read(slot: u32, in_frame: bool) -> Option<()> {
    let Some(mut this) = segment(slot) else {
        return None;
    };
    if put(slot).is_none() {
        // Other messages in a FRAME are needed as a whole. Of the first part of a long message, and
        // of a sample whose header exceeds the window, one window is passed on.
        if !in_frame {
            this.wanted = WINDOW;
        } else if this.end == WINDOW && this.is_sample != 0 {
            this.wanted = WINDOW;
        }
        return None;
    }
    let payload_end = this.payload.wrapping_add(this.payload_len);
    if in_frame && (payload_end != this.total || this.payload_len > this.total) {
        return None;
    }
    let head = this.payload + PAYLOAD;
    let head = if head > WINDOW { WINDOW } else { head };
    match verdict(slot) {
        CAPTURE => {
            this.wakes = 1;
            if !in_frame {
                this.state.chain = chain::WHOLE;
            }
            return Some(());
        }
        IGNORE => {
            if !in_frame {
                this.state.chain = chain::SKIPPED;
            }
            this.wanted = 0;
        }
        METER => this.wanted = head,
        _ => {
            this.wanted = head;
            if !spend(Budget::CaptureBytes, head) {
                count(slot, Counter::UnknownOverBudget, 1);
                if !in_frame {
                    this.state.chain = chain::SKIPPED | chain::OVER_BUDGET;
                }
                this.wanted = 0;
                this.is_over_budget = 1;
            }
        }
    }
    Some(())
}

const IGNORE: u32 = Verdict::Ignore as u32;
const METER: u32 = Verdict::Meter as u32;
const CAPTURE: u32 = Verdict::Capture as u32;
const UNKNOWN: u32 = 3;

/// Returns the verdict on the publisher that the attachment identifies.
#[unsafe(export_name = "zenoh_verdict")]
#[inline(never)]
pub extern "C" fn verdict(slot: u32) -> u32 {
    let (Some(this), Some(window)) = (segment(slot), Window::of(slot)) else {
        return UNKNOWN;
    };
    let gid = match this.attachment_len {
        length if length == PLAIN[0] => PLAIN[1],
        length if length == LABELLED[0] => LABELLED[1],
        _ => return UNKNOWN,
    };
    if this.attachment == 0 {
        return UNKNOWN;
    }
    let at = this.attachment + gid;
    if window.byte(at - 1, this.end) != Some(GID) || at + GID > this.end {
        return UNKNOWN;
    }
    match INTEREST.get_ptr(window.words(at)) {
        // SAFETY: a map value pointer checked against null.
        Some(verdict) => unsafe { *verdict },
        None => UNKNOWN,
    }
}

/// Reads a PUSH with a PUT up to the payload; returns `None` if the message is another one, or its
/// header is not in the window.
#[inline(always)]
fn put(slot: u32) -> Option<()> {
    let (Some(mut this), Some(window)) = (segment(slot), Window::of(slot)) else {
        return None;
    };
    this.is_sample = 0;
    let header = window.byte(this.at, this.end)?;
    if header & 0x1f != PUSH {
        return None;
    }
    this.is_sample = 1;
    this.at += 1;
    if number(slot) == 0 || header & 0x20 != 0 && skip(slot) == 0 {
        return None;
    }
    if header & 0x80 != 0 && extensions(slot) == 0 {
        return None;
    }
    let header = window.byte(this.at, this.end)?;
    if header & 0x1f != PUT {
        this.is_sample = 0;
        return None;
    }
    this.at += 1;
    if header & 0x20 != 0 && (number(slot) == 0 || skip(slot) == 0) {
        return None;
    }
    if header & 0x40 != 0 && (number(slot) == 0 || this.value & 1 != 0 && skip(slot) == 0) {
        return None;
    }
    if header & 0x80 != 0 && extensions(slot) == 0 {
        return None;
    }
    if this.is_shared != 0 || number(slot) == 0 {
        return None;
    }
    this.payload = this.at;
    this.payload_len = this.value;
    Some(())
}

/// Skips a length and that many bytes; returns 0 if they are longer than the window.
#[unsafe(export_name = "zenoh_skip")]
#[inline(never)]
pub extern "C" fn skip(slot: u32) -> u32 {
    if number(slot) == 0 {
        return 0;
    }
    let Some(mut this) = segment(slot) else {
        return 0;
    };
    if this.value > WINDOW {
        return 0;
    }
    this.at += this.value;
    1
}
