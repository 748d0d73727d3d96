//! The host hook reads whole datagrams at the sockets of this host, however links fragment them.
//!
//! A datagram passes once per receiving socket and once per transmission. Its records name the
//! socket. A captured datagram is written in pieces and only once, however many sockets receive it.
//! Its other copies are metered. The return value for the kernel is not decided here: the entry
//! programs always return 1.

use aya_ebpf::{
    bindings::__sk_buff,
    helpers::{
        bpf_get_smp_processor_id,
        generated::{bpf_get_socket_cookie, bpf_skb_cgroup_id},
    },
};
use ros2probe_wire::{filter::Counter, host::Socket};

use crate::{
    delivery,
    maps::{
        RecentCapture, SOCKETS, Scratch, claim_egress_slot, claim_ingress_slot, count,
        last_received, recent_capture, release_slot, scratch,
    },
    packet::{self, hook},
    pieces, verdict,
};

/// Time after a capture within which the same datagram at another socket is a copy. The kernel
/// delivers the copies of one datagram within microseconds. A writer waits for an answer before it
/// repeats a datagram.
const DUPLICATE_WINDOW_NS: u64 = 1_000_000;
/// Time after which a socket that was seen is looked up again. The LRU table may have evicted the
/// socket.
const SOCKET_RECHECK_NS: u64 = 500_000_000;
const TCP: u8 = 6;
const ICMPV6: u8 = 58;
const UDP: u8 = 17;

/// Handles one datagram; `at` is one of [`hook`].
#[unsafe(no_mangle)]
#[inline(never)]
pub extern "C" fn process_packet(skb: *mut __sk_buff, at: u32) -> u32 {
    if !may_be_udp(skb) {
        return 0;
    }
    let is_ingress = at == hook::INGRESS;
    if is_ingress && let Some(last) = last_received() {
        last.socket.set(0);
        last.token.set(0);
        last.counted_socket.set(0);
    }
    let claimed_slot = if is_ingress {
        claim_ingress_slot()
    } else {
        claim_egress_slot()
    };
    if let Some(slot) = claimed_slot {
        let _ = process_datagram(skb, slot, at);
        release_slot(slot);
    }
    0
}

/// Returns whether the packet may be UDP. Most packets here are TCP, so only the first words are
/// read, in place.
#[inline(always)]
fn may_be_udp(skb: *mut __sk_buff) -> bool {
    // SAFETY: the verifier rewrites reads of these fields into the addresses.
    let (start, end) = unsafe { ((*skb).data as usize, (*skb).data_end as usize) };
    if start + 20 > end {
        // The IP header is not contiguous: it may be UDP.
        return true;
    }
    let ip_header = start as *const u8;
    // SAFETY: these bytes lie before `end`.
    let (version, next_ipv6, next_ipv4) =
        unsafe { (*ip_header >> 4, *ip_header.add(6), *ip_header.add(9)) };
    match version {
        4 => next_ipv4 == UDP,
        // Other values may be extension headers.
        6 => !matches!(next_ipv6, TCP | ICMPV6),
        _ => false,
    }
}

#[inline(always)]
fn process_datagram(skb: *mut __sk_buff, slot: u32, at: u32) -> Option<()> {
    if packet::parse_ip_packet(skb, slot, at, 0) == 0 {
        return None;
    }
    // SAFETY: the verifier rewrites reads of this field; `skb` is the program's context.
    if unsafe { (*skb).gso_segs } > 1 {
        count(slot, Counter::Segmented, 1);
        return None;
    }
    let mut scratch = scratch(slot)?;
    if scratch.get().packet.is_fragment != 0 {
        // A raw socket has sent this fragment; received datagrams are reassembled.
        count(slot, Counter::Fragments, 1);
        return None;
    }
    scratch.get().walk.record.datagram = 0;
    let mut capture = verdict::decide_datagram(skb, slot) != 0;
    if delivery::is_tracking_enabled() {
        delivery::track_datagram(skb, slot, at);
    }
    let record = &scratch.get().walk.record;
    let (socket, token) = (record.socket, record.datagram);
    if token == 0 {
        return None;
    }
    if capture {
        scratch.get().record_count = 0;
        if pieces::write_capture(skb, slot) != 0 {
            remember_capture(scratch.get());
        } else {
            // The ring is full, so the datagram is metered instead.
            capture = false;
            verdict::meter_datagram(skb, slot);
        }
    }
    if at == hook::INGRESS
        && let Some(last) = last_received()
    {
        last.socket.set(socket);
        last.token.set(token);
        last.slot.set(slot);
        last.was_captured.set(u32::from(capture));
        // The address of the program's context is that of the kernel's packet.
        last.skb_address.set(skb as u64);
    }
    let scratch = scratch.get();
    if !capture && scratch.record_count == 0 {
        return None;
    }
    let now = scratch.packet.time_ns;
    if scratch.last_socket == socket
        && now.wrapping_sub(scratch.last_socket_lookup_ns) < SOCKET_RECHECK_NS
    {
        return None;
    }
    (scratch.last_socket, scratch.last_socket_lookup_ns) = (socket, now);
    if SOCKETS.get_ptr(socket).is_none() {
        add_socket(skb, socket, 0);
    }
    Some(())
}

/// Adds a socket to [`SOCKETS`], where user space finds it and looks up its process.
#[inline(always)]
pub fn add_socket(skb: *mut __sk_buff, socket: u64, is_stream: u64) {
    let socket_entry = Socket {
        // SAFETY: `skb` is the program's context.
        cgroup: unsafe { bpf_skb_cgroup_id(skb) },
        rcvbuf_errors: 0,
        is_stream,
    };
    let _ = SOCKETS.insert(socket, socket_entry, 0);
}

/// Returns a token for the current datagram, and its socket's cookie.
#[inline(always)]
pub fn assign_token(skb: *mut __sk_buff, slot: u32, token_count: &mut u32) -> (u32, u64) {
    let token = next_token(slot, token_count);
    // SAFETY: `skb` is the program's context.
    (token, unsafe { bpf_get_socket_cookie(skb.cast()) })
}

/// Returns a token for the current datagram or frame. `token_count` is per slot, and only this run
/// holds the slot.
#[inline(always)]
pub fn next_token(slot: u32, token_count: &mut u32) -> u32 {
    *token_count = token_count.wrapping_add(1);
    // SAFETY: no preconditions.
    let cpu = unsafe { bpf_get_smp_processor_id() } as u32;
    // The token is unique among 2^20 datagrams of a CPU if at most 256 CPUs exist. It contains the
    // slot's number plus one, so it is never 0.
    *token_count << 12 | (slot + 1) << 8 | (cpu & 0xff)
}

/// Returns whether a copy of the current datagram was captured just before. Copies are recognized
/// by the submessage that requires the capture. The result is always false on the wire hook.
#[inline(always)]
pub fn is_duplicate_capture(slot: u32, scratch: &mut Scratch) -> bool {
    if scratch.is_duplicate != 0 {
        return true;
    }
    if scratch.packet.is_at_socket == 0 {
        return false;
    }
    let record = &scratch.walk.record;
    let Some(recent) = recent_capture_of(scratch) else {
        return false;
    };
    let is_duplicate = scratch.packet.time_ns.wrapping_sub(recent.time.get()) < DUPLICATE_WINDOW_NS
        && recent.sequence_number.get() == record.sequence_number
        && recent.fragment_start.get() == record.fragment_start
        && recent.datagram_len.get() == scratch.walk.datagram_len
        && recent.writer[3].get() == record.writer[3]
        && recent.writer[2].get() == record.writer[2]
        && recent.writer[1].get() == record.writer[1]
        && recent.writer[0].get() == record.writer[0];
    if is_duplicate {
        scratch.is_duplicate = 1;
        count(slot, Counter::CopiesNotCaptured, 1);
    }
    is_duplicate
}

/// Notes that the current datagram is captured.
#[inline(always)]
fn remember_capture(scratch: &Scratch) {
    let Some(recent) = recent_capture_of(scratch) else {
        return;
    };
    let record = &scratch.walk.record;
    recent.time.set(scratch.packet.time_ns);
    recent.sequence_number.set(record.sequence_number);
    recent.writer[0].set(record.writer[0]);
    recent.writer[1].set(record.writer[1]);
    recent.writer[2].set(record.writer[2]);
    recent.writer[3].set(record.writer[3]);
    recent.fragment_start.set(record.fragment_start);
    recent.datagram_len.set(scratch.walk.datagram_len);
}

#[inline(always)]
fn recent_capture_of(scratch: &Scratch) -> Option<&'static RecentCapture> {
    let record = &scratch.walk.record;
    recent_capture(
        record.writer[2]
            ^ record.writer[3] >> 24
            ^ record.sequence_number as u32
            ^ record.fragment_start,
    )
}
