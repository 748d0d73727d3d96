//! Reads the first bytes of a frame of RTPS: its length, and which of its bytes are needed.
//!
//! The writer of the first sample decides. Frames without a sample are small and needed whole:
//! control messages, acknowledgements, and the announcements of discovery. The budget of
//! unclassified traffic pays for frames that no known endpoint sends.

use aya_ebpf::bindings::__sk_buff;
use ros2probe_wire::{
    filter::Counter,
    record::{Verdict, kind},
    rtps::SubmessageId,
    rtps_tcp::{FrameHeader, HEADER_LEN, RECOGNIZED},
    walk,
};

use crate::{
    maps::{INTEREST, count},
    packet::load_bytes,
    verdict::{charge_capture_budget, charge_unknown_writer},
};

use super::{
    LOOPBACK,
    message::ALL_BYTES,
    state::{WINDOW, Window, segment},
};

/// Maximum number of submessages that are examined: INFO_DST, INFO_TS and a sample.
const MAX_EXAMINED_SUBMESSAGES: u32 = 3;
/// Offset of the first submessage in a frame.
const FIRST_SUBMESSAGE_OFFSET: u32 = HEADER_LEN as u32 + walk::HEADER_LEN;
/// Maximum number of bytes after the first sample that are left out: INFO_DST, a HEARTBEAT and Fast
/// DDS's own submessage for statistics.
const MAX_TRAILING_LEN: u32 = 128;
/// Frames of known writers up to this length are passed on as a whole, because they may have
/// several samples. A frame whose only sample is ignored is skipped.
const SMALL_FRAME_LEN: u32 = 1024;
/// The bits of an entity kind that mark a built-in entity (RTPS 2.5, 9.3.1.2).
const BUILT_IN: u32 = 0xc0;
const INFO_TS: u32 = SubmessageId::INFO_TS.0 as u32;
const INFO_DST: u32 = SubmessageId::INFO_DST.0 as u32;
const HEARTBEAT: u32 = kind::HEARTBEAT as u32;
const GAP: u32 = kind::GAP as u32;
const ACKNACK: u32 = kind::ACKNACK as u32;
const DATA: u32 = kind::DATA as u32;
const DATA_FRAG: u32 = kind::DATA_FRAG as u32;
const IGNORE: u32 = Verdict::Ignore as u32;
const CAPTURE: u32 = Verdict::Capture as u32;

/// Returns whether a frame begins at `at` of a packet.
#[inline(always)]
pub fn starts_frame(skb: *mut __sk_buff, at: u32, len: u32) -> bool {
    if len < RECOGNIZED as u32 {
        return false;
    }
    let Some([magic, length, _checksum, port]): Option<[u32; 4]> = load_bytes(skb, at) else {
        return false;
    };
    let Some(next): Option<u32> = load_bytes(skb, at + HEADER_LEN as u32) else {
        return false;
    };
    FrameHeader::of_words([magic, length, port, next]).is_some()
}

/// Returns the length of the frame in the window, header included; 0 if none begins there.
#[inline(always)]
pub fn frame_len(window: Window, read: u32) -> u32 {
    if read < RECOGNIZED as u32 {
        return 0;
    }
    let [magic, length, _checksum, port] = window.words(0);
    let [next, ..] = window.words(HEADER_LEN as u32);
    match FrameHeader::of_words([magic, length, port, next]) {
        Some(header) => header.length,
        None => 0,
    }
}

/// Sets the number of bytes of the frame in the window to pass on.
#[unsafe(export_name = "rtps_read")]
#[inline(never)]
pub extern "C" fn plan_frame(slot: u32) -> u32 {
    let (Some(mut this), Some(window)) = (segment(slot), Window::of(slot)) else {
        return 0;
    };
    this.forward_len = ALL_BYTES;
    this.wakes_reader = 0;
    let [.., port] = window.words(0);
    let [prefix_0, prefix_1, prefix_2, _] = window.words(HEADER_LEN as u32 + 8);
    let (mut at, mut number) = (FIRST_SUBMESSAGE_OFFSET, 0);
    while port as u16 != 0 && number < MAX_EXAMINED_SUBMESSAGES {
        if at + 24 > this.window_len || at + 24 > WINDOW {
            break;
        }
        let [header, first, second, third] = window.words(at);
        let id = header & 0xff;
        let octets = if header >> 8 & 1 != 0 {
            header >> 16
        } else {
            (header >> 16 & 0xff) << 8 | header >> 24
        };
        if id == DATA || id == DATA_FRAG {
            if third >> 24 & BUILT_IN == BUILT_IN {
                this.wakes_reader = 1;
                return 1;
            }
            let is_only_sample =
                octets == 0 || at + 4 + octets + MAX_TRAILING_LEN >= this.batch_len;
            return plan_sample(
                slot,
                [prefix_0, prefix_1, prefix_2, third],
                u32::from(is_only_sample),
            );
        }
        if id == HEARTBEAT || id == GAP || id == ACKNACK {
            let sender = if id == ACKNACK { first } else { second };
            if INTEREST
                .get_ptr([prefix_0, prefix_1, prefix_2, sender])
                .is_some()
            {
                return 1;
            }
            break;
        }
        if id != INFO_TS && id != INFO_DST || octets > 16 {
            break;
        }
        at += 4 + octets;
        number += 1;
    }
    let total = this.batch_len;
    charge_or_skip(slot, total)
}

/// Sets the number of bytes of a frame that begins with a sample of `writer`. Unless the sample
/// `is_only_sample`, others follow it, which may be of other writers.
#[inline(always)]
fn plan_sample(slot: u32, writer: [u32; 4], is_only_sample: u32) -> u32 {
    let Some(mut this) = segment(slot) else {
        return 0;
    };
    // SAFETY: a map value pointer checked against null.
    let verdict = INTEREST.get_ptr(&writer).map(|verdict| unsafe { *verdict });
    // On the loopback interface, the payload was passed on where it was sent.
    let is_loopback_copy = this.interface == LOOPBACK && this.key.outgoing == 0;
    let is_needed = is_only_sample == 0 || this.batch_len <= SMALL_FRAME_LEN;
    match verdict {
        Some(IGNORE) if is_only_sample != 0 => this.forward_len = 0,
        Some(_) if is_needed => {}
        Some(CAPTURE) if !is_loopback_copy => this.wakes_reader = 1,
        Some(_) => this.forward_len = WINDOW,
        // The writer's announcement may still be in transit.
        None if !is_loopback_copy && charge_unknown_writer(&writer, this.batch_len) => {
            this.wakes_reader = 1
        }
        None => {
            this.forward_len = if this.batch_len < WINDOW {
                this.batch_len
            } else {
                WINDOW
            };
            let wanted = this.forward_len;
            return charge_or_skip(slot, wanted);
        }
    }
    1
}

/// Charges bytes of a frame that no known endpoint sent. Without a budget no byte is passed on, so
/// that a peer with many such frames cannot fill the ring.
#[inline(always)]
fn charge_or_skip(slot: u32, bytes: u32) -> u32 {
    if !charge_capture_budget(bytes) {
        count(slot, Counter::UnknownOverBudget, 1);
        if let Some(mut this) = segment(slot) {
            this.forward_len = 0;
            this.is_over_budget = 1;
        }
    }
    1
}
