//! Finds connections of Zenoh: by their first batch, or by batches with consecutive sequence
//! numbers.
//!
//! The search in a connection that is older than the agent starts at a packet that may begin with a
//! batch. It reads batches in this packet and in the next ones, until two of them continue the
//! sequence numbers of their lane. No data leaves the kernel during the search.

use aya_ebpf::bindings::__sk_buff;
use ros2probe_wire::{
    filter::Counter,
    host::chunk as part,
    zenoh_stream::{Beginning, HEAD, Lanes, PREFIX},
};

use crate::{
    maps::{Working, copy, count},
    packet::load,
};

use super::{
    chunk::{self, WAKE},
    is_zenoh_port, message, rtps,
    state::{
        CANDIDATES, CONNECTIONS, Direction, Key, Segment, Window, body, found_rtps, mode, note,
        protocol, segment,
    },
};

/// Maximum number of batches of one packet that the search reads.
const BATCHES: u32 = 32;
/// Number of bytes of TLS that are passed on, once per direction.
const TLS_BYTES: u32 = 16;

/// Returns whether the payload may belong to a connection of Zenoh that is not known yet.
#[inline(always)]
pub fn may_be(skb: *mut __sk_buff, body: u32, len: u32, key: &Key, is_noted: bool) -> bool {
    len != 0
        && (begins_with(skb, body, len, key.ports) != Beginning::Other
            || is_noted && CANDIDATES.get_ptr_mut(key).is_some())
}

/// Classifies the start of a payload.
#[inline(always)]
fn begins_with(skb: *mut __sk_buff, at: u32, len: u32, ports: u32) -> Beginning {
    if len >= HEAD as u32 {
        if let Some(head) = load(skb, at) {
            return Beginning::of(head, len, is_zenoh_port(ports));
        }
    } else if len == 3
        && let Some(bytes) = load(skb, at)
    {
        return Beginning::of_three(bytes);
    }
    Beginning::Other
}

/// Searches for a boundary in an unknown direction. Returns 1 if the direction is known now and the
/// segment must be followed.
#[unsafe(export_name = "zenoh_at_socket")]
#[inline(never)]
pub extern "C" fn at_socket(skb: *mut __sk_buff, slot: u32) -> u32 {
    let Some(mut this) = segment(slot) else {
        return 0;
    };
    let begins = begins_with(skb, this.body, this.len, this.key.ports);
    match begins {
        Beginning::Init => {
            begin(slot, u32::from(part::SYN));
            know(slot, this, mode::FOLLOWED)
        }
        Beginning::KeepAlive => {
            begin(slot, u32::from(part::LOST));
            know(slot, this, mode::FOLLOWED)
        }
        Beginning::Frame => {
            if !rtps::begins(skb, this.body, this.len) {
                return 0;
            }
            begin(slot, u32::from(part::LOST));
            this.state.protocol = protocol::RTPS;
            found_rtps();
            know(slot, this, mode::FOLLOWED)
        }
        Beginning::OtherVersion | Beginning::Tls => {
            begin(slot, u32::from(part::SYN));
            let all = if begins == Beginning::Tls {
                TLS_BYTES
            } else {
                this.len
            };
            let copied = if all > this.len { this.len } else { all };
            let copied = if copied > super::state::WINDOW {
                super::state::WINDOW
            } else {
                copied
            };
            let lengths = u64::from(copied) << 32 | u64::from(this.len);
            chunk::head(skb, slot, 0, lengths, WAKE);
            know(slot, this, mode::UNREADABLE);
            0
        }
        _ => {
            if guess(skb, slot) == 0 {
                return 0;
            }
            this.state.boundary = this.state.guess.boundary;
            this.state.covered = this.state.boundary;
            know(slot, this, mode::FOLLOWED)
        }
    }
}

/// Searches as [`at_socket`] does, on an interface. Returns 1 if the connection carries Zenoh or
/// RTPS.
#[unsafe(export_name = "zenoh_on_interface")]
#[inline(never)]
pub extern "C" fn on_interface(skb: *mut __sk_buff, slot: u32) -> u32 {
    let Some(mut this) = segment(slot) else {
        return 0;
    };
    let begins = begins_with(skb, this.body, this.len, this.key.ports);
    let is_certain = match begins {
        Beginning::Init | Beginning::KeepAlive => true,
        Beginning::Frame => rtps::begins(skb, this.body, this.len),
        _ => guess(skb, slot) != 0,
    };
    if !is_certain {
        return 0;
    }
    begin(slot, 0);
    if begins == Beginning::Frame {
        this.state.protocol = protocol::RTPS;
    }
    know(slot, this, mode::UNREADABLE);
    this.key.ports = this.key.ports << 16 | this.key.ports >> 16;
    know(slot, this, mode::UNREADABLE);
    1
}

/// Starts a direction with the current segment.
#[unsafe(export_name = "zenoh_begin")]
#[inline(never)]
extern "C" fn begin(slot: u32, pending: u32) -> u32 {
    let Some(mut this) = segment(slot) else {
        return 0;
    };
    this.state.reported = 0;
    this.state.next = this.sequence_number;
    this.state.boundary = this.sequence_number;
    this.state.covered = this.sequence_number;
    this.state.body = body::SKIPPED;
    this.state.chain = 0;
    this.state.prefix = 0;
    this.state.pending = pending;
    this.state.gap_bytes = 0;
    this.state.hole_len = 0;
    this.state.protocol = protocol::ZENOH;
    this.state.length = 0;
    this.state.linked = 0;
    close(slot)
}

/// Discards the guess about the direction.
#[unsafe(export_name = "zenoh_forget")]
#[inline(never)]
extern "C" fn close(slot: u32) -> u32 {
    let Some(mut this) = segment(slot) else {
        return 0;
    };
    let number = this.sequence_number;
    let guess = &mut this.state.guess;
    guess.boundary = number;
    guess.next = number;
    guess.is_open = 0;
    guess.lanes = Lanes::new();
    0
}

#[inline(always)]
fn know(slot: u32, mut this: Working<Segment>, mode: u32) -> u32 {
    this.state.mode = mode;
    let counter = if this.state.protocol == protocol::RTPS {
        Counter::TcpConnections
    } else {
        Counter::ZenohConnections
    };
    count(slot, counter, 1);
    note(this.key.socket);
    u32::from(CONNECTIONS.insert(&this.key, &this.state, 0).is_ok())
}

/// Continues the guess about the direction, or begins one. Returns 1 once the boundary is certain.
#[inline(always)]
fn guess(skb: *mut __sk_buff, slot: u32) -> u32 {
    let Some(mut this) = segment(slot) else {
        return 0;
    };
    let known = CANDIDATES.get_ptr_mut(&this.key);
    begin(slot, u32::from(part::LOST));
    if let Some(known) = known {
        // SAFETY: a map value pointer checked against null.
        let known: &Direction = unsafe { &*known };
        copy(&known.guess, &mut this.state.guess);
    }
    let is_certain = judge(skb, slot, 0);
    if is_certain != 0 || this.state.guess.is_open == 0 {
        if known.is_some() {
            let _ = CANDIDATES.remove(&this.key);
        }
        return is_certain;
    }
    if known.is_none() {
        count(slot, Counter::ZenohCandidates, 1);
    }
    note(this.key.socket);
    let _ = CANDIDATES.insert(&this.key, &this.state, 0);
    0
}

/// Reads the batches of the segment as long as each continues the earlier ones. Returns 1 as soon
/// as the boundary is certain; with `to_end`, all batches up to the end of the segment must also
/// fit.
#[unsafe(export_name = "zenoh_judge")]
#[inline(never)]
pub extern "C" fn judge(skb: *mut __sk_buff, slot: u32, to_end: u32) -> u32 {
    let Some(mut this) = segment(slot) else {
        return 0;
    };
    if this.state.guess.is_open == 0 || this.state.guess.next != this.sequence_number {
        close(slot);
        this.state.guess.is_open = 1;
    }
    let mut batches = 0;
    while batches < BATCHES {
        let offset = this.state.guess.boundary.wrapping_sub(this.sequence_number);
        if offset >= this.len {
            this.state.guess.next = this.sequence_number.wrapping_add(this.len);
            return u32::from(this.state.guess.lanes.are_certain());
        }
        if fits(skb, slot, offset) == 0 {
            break;
        }
        if to_end == 0 && this.state.guess.lanes.are_certain() {
            return 1;
        }
        this.state.guess.boundary = this.state.guess.boundary.wrapping_add(this.total);
        batches += 1;
    }
    this.state.guess.is_open = 0;
    0
}

/// Returns 1 if the batch at this offset continues the earlier ones.
#[unsafe(export_name = "zenoh_fits")]
#[inline(never)]
extern "C" fn fits(skb: *mut __sk_buff, slot: u32, offset: u32) -> u32 {
    let (Some(mut this), Some(window)) = (segment(slot), Window::of(slot)) else {
        return 0;
    };
    let read = chunk::load_window(skb, slot, offset);
    let (Some(low), Some(high)) = (window.byte(0, read), window.byte(1, read)) else {
        return 0;
    };
    this.total = (low | high << 8) + PREFIX;
    if this.end > this.total {
        this.end = this.total;
    }
    this.is_judged = 1;
    if this.total == PREFIX || message::read(slot) == 0 || !message::is_plausible(slot) {
        return 0;
    }
    let (lane, number) = (this.lane, this.number);
    let lanes = &mut this.state.guess.lanes;
    if lane == 0 {
        lanes.keep_alive();
        return 1;
    }
    u32::from(lanes.continues(lane, number))
}
