//! Reads a PUSH, the message of a sample, up to its payload, and decides which bytes of the sample
//! are passed on.

use ros2probe_wire::{
    filter::{Budget, Counter},
    record::Verdict,
};

use crate::{
    maps::{INTEREST, count},
    verdict::try_spend,
};

use super::{
    message::{read_extensions, read_varint},
    state::{WINDOW, Window, fragment_state, segment},
};

const PUSH_ID: u32 = 0x1d;
const PUT_ID: u32 = 0x01;
/// Number of payload bytes that are passed on with the head; they include `Header.stamp`.
const PAYLOAD_PREFIX_LEN: u32 = 32;
/// Attachments of rmw_zenoh: their length, and the offset of the gid in them.
const ATTACHMENT_LAYOUT: [u32; 2] = [33, 17];
const LABELLED_ATTACHMENT_LAYOUT: [u32; 2] = [77, 61];
const GID_LEN: u32 = 16;

/// Reads the PUSH at the reader's position and sets `forward_len`. In a FRAME, `forward_len` is set
/// only if nothing follows the PUSH, or if its header exceeds the window.
#[inline(always)]
pub fn plan_push(slot: u32, in_frame: bool) -> Option<()> {
    let Some(mut this) = segment(slot) else {
        return None;
    };
    if read_put(slot).is_none() {
        // Other messages in a FRAME are needed as a whole. Of the first part of a long message, and
        // of a sample whose header exceeds the window, one window is passed on.
        if !in_frame {
            this.forward_len = WINDOW;
        } else if this.window_len == WINDOW && this.is_sample != 0 {
            this.forward_len = WINDOW;
        }
        return None;
    }
    let payload_end = this.payload.wrapping_add(this.payload_len);
    if in_frame && (payload_end != this.batch_len || this.payload_len > this.batch_len) {
        return None;
    }
    let head_len = this.payload + PAYLOAD_PREFIX_LEN;
    let head_len = if head_len > WINDOW { WINDOW } else { head_len };
    match look_up_verdict(slot) {
        CAPTURE => {
            this.wakes_reader = 1;
            if !in_frame {
                this.state.fragment_state = fragment_state::WHOLE;
            }
            return Some(());
        }
        IGNORE => {
            if !in_frame {
                this.state.fragment_state = fragment_state::SKIPPED;
            }
            this.forward_len = 0;
        }
        METER => this.forward_len = head_len,
        _ => {
            this.forward_len = head_len;
            if !try_spend(Budget::CaptureBytes, head_len) {
                count(slot, Counter::UnknownOverBudget, 1);
                if !in_frame {
                    this.state.fragment_state =
                        fragment_state::SKIPPED | fragment_state::OVER_BUDGET;
                }
                this.forward_len = 0;
                this.is_over_budget = 1;
            }
        }
    }
    Some(())
}

const IGNORE: u32 = Verdict::Ignore as u32;
const METER: u32 = Verdict::Meter as u32;
const CAPTURE: u32 = Verdict::Capture as u32;
/// The publisher has no verdict yet, or the attachment does not identify it.
const NO_VERDICT: u32 = 3;

/// Returns the verdict on the publisher that the attachment identifies.
#[unsafe(export_name = "zenoh_verdict")]
#[inline(never)]
pub extern "C" fn look_up_verdict(slot: u32) -> u32 {
    let (Some(this), Some(window)) = (segment(slot), Window::of(slot)) else {
        return NO_VERDICT;
    };
    let gid = match this.attachment_len {
        length if length == ATTACHMENT_LAYOUT[0] => ATTACHMENT_LAYOUT[1],
        length if length == LABELLED_ATTACHMENT_LAYOUT[0] => LABELLED_ATTACHMENT_LAYOUT[1],
        _ => return NO_VERDICT,
    };
    if this.attachment == 0 {
        return NO_VERDICT;
    }
    let at = this.attachment + gid;
    if window.byte(at - 1, this.window_len) != Some(GID_LEN) || at + GID_LEN > this.window_len {
        return NO_VERDICT;
    }
    match INTEREST.get_ptr(window.words(at)) {
        // SAFETY: a map value pointer checked against null.
        Some(verdict) => unsafe { *verdict },
        None => NO_VERDICT,
    }
}

/// Reads a PUSH with a PUT up to the payload; returns `None` if the message is another one, or its
/// header is not in the window.
#[inline(always)]
fn read_put(slot: u32) -> Option<()> {
    let (Some(mut this), Some(window)) = (segment(slot), Window::of(slot)) else {
        return None;
    };
    this.is_sample = 0;
    let header = window.byte(this.position, this.window_len)?;
    if header & 0x1f != PUSH_ID {
        return None;
    }
    this.is_sample = 1;
    this.position += 1;
    if read_varint(slot) == 0 || header & 0x20 != 0 && skip_bytes(slot) == 0 {
        return None;
    }
    if header & 0x80 != 0 && read_extensions(slot) == 0 {
        return None;
    }
    let header = window.byte(this.position, this.window_len)?;
    if header & 0x1f != PUT_ID {
        this.is_sample = 0;
        return None;
    }
    this.position += 1;
    if header & 0x20 != 0 && (read_varint(slot) == 0 || skip_bytes(slot) == 0) {
        return None;
    }
    if header & 0x40 != 0
        && (read_varint(slot) == 0 || this.varint & 1 != 0 && skip_bytes(slot) == 0)
    {
        return None;
    }
    if header & 0x80 != 0 && read_extensions(slot) == 0 {
        return None;
    }
    if this.is_shared != 0 || read_varint(slot) == 0 {
        return None;
    }
    this.payload = this.position;
    this.payload_len = this.varint;
    Some(())
}

/// Skips a length and that many bytes; returns 0 if they are longer than the window.
#[unsafe(export_name = "zenoh_skip")]
#[inline(never)]
pub extern "C" fn skip_bytes(slot: u32) -> u32 {
    if read_varint(slot) == 0 {
        return 0;
    }
    let Some(mut this) = segment(slot) else {
        return 0;
    };
    if this.varint > WINDOW {
        return 0;
    }
    this.position += this.varint;
    1
}
