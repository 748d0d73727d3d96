//! Reads the first bytes of a frame of RTPS: its length, and which of its bytes are needed.
//!
//! The writer of the first sample decides. Frames without a sample are small and needed whole:
//! control messages, acknowledgements, and the announcements of discovery. The budget of unclassified
//! traffic pays for frames that no known endpoint sends.

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
    packet::load,
    verdict::{charge, charge_unknown},
};

use super::{
    LOOPBACK,
    message::WHOLE,
    state::{WINDOW, Window, segment},
};

/// Maximum number of submessages that are examined: INFO_DST, INFO_TS and a sample.
const BEFORE: u32 = 3;
/// Offset of the first submessage in a frame.
const SUBMESSAGES: u32 = HEADER_LEN as u32 + walk::HEADER_LEN;
/// Maximum number of bytes after the first sample that are left out: INFO_DST, a HEARTBEAT and Fast
/// DDS's own submessage for statistics.
const REST: u32 = 128;
/// Frames of known writers up to this length are passed on as a whole, because they may have
/// several samples. A frame whose only sample is ignored is skipped.
const SMALL: u32 = 1024;
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
pub fn begins(skb: *mut __sk_buff, at: u32, len: u32) -> bool {
    if len < RECOGNIZED as u32 {
        return false;
    }
    let Some([magic, length, _checksum, port]): Option<[u32; 4]> = load(skb, at) else {
        return false;
    };
    let Some(next): Option<u32> = load(skb, at + HEADER_LEN as u32) else {
        return false;
    };
    FrameHeader::of_words([magic, length, port, next]).is_some()
}

/// Returns the length of the frame in the window, header included; 0 if none begins there.
#[inline(always)]
pub fn length(window: Window, read: u32) -> u32 {
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
pub extern "C" fn read(slot: u32) -> u32 {
    let (Some(mut this), Some(window)) = (segment(slot), Window::of(slot)) else {
        return 0;
    };
    this.wanted = WHOLE;
    this.wakes = 0;
    let [.., port] = window.words(0);
    let [one, two, three, _] = window.words(HEADER_LEN as u32 + 8);
    let (mut at, mut number) = (SUBMESSAGES, 0);
    while port as u16 != 0 && number < BEFORE {
        if at + 24 > this.end || at + 24 > WINDOW {
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
                this.wakes = 1;
                return 1;
            }
            let is_alone = octets == 0 || at + 4 + octets + REST >= this.total;
            return sample(slot, [one, two, three, third], u32::from(is_alone));
        }
        if id == HEARTBEAT || id == GAP || id == ACKNACK {
            let sender = if id == ACKNACK { first } else { second };
            if INTEREST.get_ptr([one, two, three, sender]).is_some() {
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
    let total = this.total;
    pay(slot, total)
}

/// Sets the number of bytes of a frame that begins with a sample of `writer`. Unless the sample
/// `is_alone`, others follow it, which may be of other writers.
#[inline(always)]
fn sample(slot: u32, writer: [u32; 4], is_alone: u32) -> u32 {
    let Some(mut this) = segment(slot) else {
        return 0;
    };
    // SAFETY: a map value pointer checked against null.
    let verdict = INTEREST.get_ptr(&writer).map(|verdict| unsafe { *verdict });
    // On the loopback interface, the payload was passed on where it was sent.
    let is_repeated = this.interface == LOOPBACK && this.key.outgoing == 0;
    let is_needed = is_alone == 0 || this.total <= SMALL;
    match verdict {
        Some(IGNORE) if is_alone != 0 => this.wanted = 0,
        Some(_) if is_needed => {}
        Some(CAPTURE) if !is_repeated => this.wakes = 1,
        Some(_) => this.wanted = WINDOW,
        // The writer's announcement may still be in transit.
        None if !is_repeated && charge_unknown(&writer, this.total) => this.wakes = 1,
        None => {
            this.wanted = if this.total < WINDOW {
                this.total
            } else {
                WINDOW
            };
            let wanted = this.wanted;
            return pay(slot, wanted);
        }
    }
    1
}

/// Charges bytes of a frame that no known endpoint sent. Without a budget no byte is passed on, so
/// that a peer with many such frames cannot fill the ring.
#[inline(always)]
fn pay(slot: u32, bytes: u32) -> u32 {
    if !charge(bytes) {
        count(slot, Counter::UnknownOverBudget, 1);
        if let Some(mut this) = segment(slot) {
            this.wanted = 0;
            this.is_over_budget = 1;
        }
    }
    1
}
