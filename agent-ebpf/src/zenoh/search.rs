//! Finds connections of Zenoh: by their first batch, or by batches with consecutive sequence
//! numbers.
//!
//! The search in a connection that is older than the agent starts at a packet that may begin with a
//! batch. It reads batches in this packet and in the next ones, until two of them continue the
//! sequence numbers of their lane. No data leaves the kernel during the search.

use aya_ebpf::bindings::__sk_buff;
use ros2probe_wire::{
    filter::Counter,
    host::chunk as chunk_flag,
    zenoh_stream::{Beginning, HEAD, Lanes, PREFIX},
};

use crate::{
    maps::{ScratchRef, copy, count},
    packet::load_bytes,
};

use super::{
    chunk::{self, WAKEUP},
    is_zenoh_port, message, rtps,
    state::{
        CANDIDATES, CONNECTIONS, Direction, Key, Segment, Window, body, found_rtps, mode, protocol,
        segment, track_socket,
    },
};

/// Maximum number of batches of one packet that the search reads.
const MAX_BATCHES: u32 = 32;
/// Number of bytes of TLS that are passed on, once per direction.
const TLS_BYTES: u32 = 16;

/// Returns whether the payload may belong to a connection of Zenoh that is not known yet.
#[inline(always)]
pub fn may_be_tracked_protocol(
    skb: *mut __sk_buff,
    body: u32,
    len: u32,
    key: &Key,
    is_tracked_socket: bool,
) -> bool {
    len != 0
        && (classify_payload(skb, body, len, key.ports) != Beginning::Other
            || is_tracked_socket && CANDIDATES.get_ptr_mut(key).is_some())
}

/// Classifies the start of a payload.
#[inline(always)]
fn classify_payload(skb: *mut __sk_buff, at: u32, len: u32, ports: u32) -> Beginning {
    if len >= HEAD as u32 {
        if let Some(head) = load_bytes(skb, at) {
            return Beginning::of(head, len, is_zenoh_port(ports));
        }
    } else if len == 3
        && let Some(bytes) = load_bytes(skb, at)
    {
        return Beginning::of_three(bytes);
    }
    Beginning::Other
}

/// Searches for a boundary in an unknown direction. Returns 1 if the direction is known now and the
/// segment must be followed.
#[unsafe(export_name = "zenoh_at_socket")]
#[inline(never)]
pub extern "C" fn probe_at_socket(skb: *mut __sk_buff, slot: u32) -> u32 {
    let Some(mut this) = segment(slot) else {
        return 0;
    };
    let payload_start = classify_payload(skb, this.body, this.len, this.key.ports);
    match payload_start {
        Beginning::Init => {
            init_direction(slot, u32::from(chunk_flag::SYN));
            insert_direction(slot, this, mode::SYNCHRONIZED)
        }
        Beginning::KeepAlive => {
            init_direction(slot, u32::from(chunk_flag::LOST));
            insert_direction(slot, this, mode::SYNCHRONIZED)
        }
        Beginning::Frame => {
            if !rtps::starts_frame(skb, this.body, this.len) {
                return 0;
            }
            init_direction(slot, u32::from(chunk_flag::LOST));
            this.state.protocol = protocol::RTPS;
            found_rtps();
            insert_direction(slot, this, mode::SYNCHRONIZED)
        }
        Beginning::ClientHello => {
            // User space knows the announced ports of RTPS. It needs no byte of the connection.
            init_direction(slot, 0);
            this.state.protocol = protocol::RTPS;
            let lengths = u64::from(this.len);
            chunk::write_chunk(skb, slot, 0, lengths, u32::from(chunk_flag::CLIENT_HELLO));
            0
        }
        Beginning::OtherVersion | Beginning::Tls => {
            init_direction(slot, u32::from(chunk_flag::SYN));
            let full_len = if payload_start == Beginning::Tls {
                TLS_BYTES
            } else {
                this.len
            };
            let copied = if full_len > this.len {
                this.len
            } else {
                full_len
            };
            let copied = if copied > super::state::WINDOW {
                super::state::WINDOW
            } else {
                copied
            };
            let lengths = u64::from(copied) << 32 | u64::from(this.len);
            chunk::write_chunk(skb, slot, 0, lengths, WAKEUP);
            insert_direction(slot, this, mode::UNREADABLE);
            0
        }
        _ => {
            if extend_candidate(skb, slot) == 0 {
                return 0;
            }
            this.state.next_batch_seq = this.state.candidate.next_batch_seq;
            this.state.forwarded_seq = this.state.next_batch_seq;
            insert_direction(slot, this, mode::SYNCHRONIZED)
        }
    }
}

/// Searches as [`probe_at_socket`] does, on an interface. Returns 1 if the connection carries Zenoh
/// or RTPS.
#[unsafe(export_name = "zenoh_on_interface")]
#[inline(never)]
pub extern "C" fn probe_on_interface(skb: *mut __sk_buff, slot: u32) -> u32 {
    let Some(mut this) = segment(slot) else {
        return 0;
    };
    let payload_start = classify_payload(skb, this.body, this.len, this.key.ports);
    let is_certain = match payload_start {
        Beginning::Init | Beginning::KeepAlive => true,
        Beginning::Frame => rtps::starts_frame(skb, this.body, this.len),
        Beginning::ClientHello => false,
        _ => extend_candidate(skb, slot) != 0,
    };
    if !is_certain {
        return 0;
    }
    init_direction(slot, 0);
    if payload_start == Beginning::Frame {
        this.state.protocol = protocol::RTPS;
    }
    insert_direction(slot, this, mode::UNREADABLE);
    this.key.ports = this.key.ports << 16 | this.key.ports >> 16;
    insert_direction(slot, this, mode::UNREADABLE);
    1
}

/// Starts a direction with the current segment.
#[unsafe(export_name = "zenoh_begin")]
#[inline(never)]
extern "C" fn init_direction(slot: u32, pending: u32) -> u32 {
    let Some(mut this) = segment(slot) else {
        return 0;
    };
    this.state.last_chunk_ns = 0;
    this.state.next_seq = this.sequence_number;
    this.state.next_batch_seq = this.sequence_number;
    this.state.forwarded_seq = this.sequence_number;
    this.state.body = body::SKIPPED;
    this.state.fragment_state = 0;
    this.state.split_prefix = 0;
    this.state.pending_flags = pending;
    this.state.gap_bytes = 0;
    this.state.gap_len = 0;
    this.state.protocol = protocol::ZENOH;
    this.state.partial_length = 0;
    this.state.last_link_report = 0;
    reset_candidate(slot)
}

/// Discards the candidate of the direction.
#[unsafe(export_name = "zenoh_forget")]
#[inline(never)]
extern "C" fn reset_candidate(slot: u32) -> u32 {
    let Some(mut this) = segment(slot) else {
        return 0;
    };
    let number = this.sequence_number;
    let candidate = &mut this.state.candidate;
    candidate.next_batch_seq = number;
    candidate.next_seq = number;
    candidate.is_valid = 0;
    candidate.lanes = Lanes::new();
    0
}

#[inline(always)]
fn insert_direction(slot: u32, mut this: ScratchRef<Segment>, mode: u32) -> u32 {
    this.state.mode = mode;
    let counter = if this.state.protocol == protocol::RTPS {
        Counter::TcpConnections
    } else {
        Counter::ZenohConnections
    };
    count(slot, counter, 1);
    track_socket(this.key.socket);
    u32::from(CONNECTIONS.insert(&this.key, &this.state, 0).is_ok())
}

/// Extends the candidate of the direction, or begins one. Returns 1 once the boundary is certain.
#[inline(always)]
fn extend_candidate(skb: *mut __sk_buff, slot: u32) -> u32 {
    let Some(mut this) = segment(slot) else {
        return 0;
    };
    let known = CANDIDATES.get_ptr_mut(&this.key);
    init_direction(slot, u32::from(chunk_flag::LOST));
    if let Some(known) = known {
        // SAFETY: a map value pointer checked against null.
        let known: &Direction = unsafe { &*known };
        copy(&known.candidate, &mut this.state.candidate);
    }
    let is_certain = validate_batches(skb, slot, 0);
    if is_certain != 0 || this.state.candidate.is_valid == 0 {
        if known.is_some() {
            let _ = CANDIDATES.remove(&this.key);
        }
        return is_certain;
    }
    if known.is_none() {
        count(slot, Counter::ZenohCandidates, 1);
    }
    track_socket(this.key.socket);
    let _ = CANDIDATES.insert(&this.key, &this.state, 0);
    0
}

/// Reads the batches of the segment as long as each continues the earlier ones. Returns 1 as soon
/// as the boundary is certain; with `must_reach_end`, all batches up to the end of the segment must
/// also fit.
#[unsafe(export_name = "zenoh_judge")]
#[inline(never)]
pub extern "C" fn validate_batches(skb: *mut __sk_buff, slot: u32, must_reach_end: u32) -> u32 {
    let Some(mut this) = segment(slot) else {
        return 0;
    };
    if this.state.candidate.is_valid == 0 || this.state.candidate.next_seq != this.sequence_number {
        reset_candidate(slot);
        this.state.candidate.is_valid = 1;
    }
    let mut batches = 0;
    while batches < MAX_BATCHES {
        let offset = this
            .state
            .candidate
            .next_batch_seq
            .wrapping_sub(this.sequence_number);
        if offset >= this.len {
            this.state.candidate.next_seq = this.sequence_number.wrapping_add(this.len);
            return u32::from(this.state.candidate.lanes.are_certain());
        }
        if validate_batch(skb, slot, offset) == 0 {
            break;
        }
        if must_reach_end == 0 && this.state.candidate.lanes.are_certain() {
            return 1;
        }
        this.state.candidate.next_batch_seq = this
            .state
            .candidate
            .next_batch_seq
            .wrapping_add(this.batch_len);
        batches += 1;
    }
    this.state.candidate.is_valid = 0;
    0
}

/// Returns 1 if the batch at this offset continues the earlier ones.
#[unsafe(export_name = "zenoh_fits")]
#[inline(never)]
extern "C" fn validate_batch(skb: *mut __sk_buff, slot: u32, offset: u32) -> u32 {
    let (Some(mut this), Some(window)) = (segment(slot), Window::of(slot)) else {
        return 0;
    };
    let read = chunk::load_window(skb, slot, offset);
    let (Some(low), Some(high)) = (window.byte(0, read), window.byte(1, read)) else {
        return 0;
    };
    this.batch_len = (low | high << 8) + PREFIX;
    if this.window_len > this.batch_len {
        this.window_len = this.batch_len;
    }
    this.is_probe = 1;
    if this.batch_len == PREFIX || message::plan_batch(slot) == 0 || !message::is_plausible(slot) {
        return 0;
    }
    let (lane, number) = (this.lane, this.lane_sequence_number);
    let lanes = &mut this.state.candidate.lanes;
    if lane == 0 {
        lanes.keep_alive();
        return 1;
    }
    u32::from(lanes.continues(lane, number))
}
