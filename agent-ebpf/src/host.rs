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
        Recent, SOCKETS, Scratch, claim_incoming, claim_outgoing, count, last, recent, release,
        scratch,
    },
    packet::{self, hook},
    pieces, verdict,
};

/// Time after a capture within which the same datagram at another socket is a copy. The kernel
/// delivers the copies of one datagram within microseconds. A writer waits for an answer before it
/// repeats a datagram.
const COPY_NANOSECONDS: u64 = 1_000_000;
/// Time after which a socket that was seen is looked up again. The LRU table may have evicted the
/// socket.
const MET_NANOSECONDS: u64 = 500_000_000;
const TCP: u8 = 6;
const ICMPV6: u8 = 58;
const UDP: u8 = 17;

/// Handles one datagram; `at` is one of [`hook`].
#[unsafe(no_mangle)]
#[inline(never)]
pub extern "C" fn look(skb: *mut __sk_buff, at: u32) -> u32 {
    if !may_be_udp(skb) {
        return 0;
    }
    let incoming = at == hook::INGRESS;
    if incoming && let Some(last) = last() {
        last.socket.set(0);
        last.token.set(0);
        last.told.set(0);
    }
    let claimed = if incoming {
        claim_incoming()
    } else {
        claim_outgoing()
    };
    if let Some(slot) = claimed {
        let _ = datagram(skb, slot, at);
        release(slot);
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
    let words = start as *const u8;
    // SAFETY: these bytes lie before `end`.
    let (version, next_ipv6, next_ipv4) = unsafe { (*words >> 4, *words.add(6), *words.add(9)) };
    match version {
        4 => next_ipv4 == UDP,
        // Other values may be extension headers.
        6 => !matches!(next_ipv6, TCP | ICMPV6),
        _ => false,
    }
}

#[inline(always)]
fn datagram(skb: *mut __sk_buff, slot: u32, at: u32) -> Option<()> {
    if packet::parse(skb, slot, at) == 0 {
        return None;
    }
    // SAFETY: the verifier rewrites reads of this field; `skb` is the program's context.
    if unsafe { (*skb).gso_segs } > 1 {
        count(slot, Counter::Segmented, 1);
        return None;
    }
    let mut scratch = scratch(slot)?;
    if scratch.get().packet.fragmented != 0 {
        // A raw socket has sent this fragment; received datagrams are reassembled.
        count(slot, Counter::Fragments, 1);
        return None;
    }
    scratch.get().walk.record.datagram = 0;
    let mut capture = verdict::whole(skb, slot) != 0;
    if delivery::are_followed() {
        delivery::passed(skb, slot, at);
    }
    let record = &scratch.get().walk.record;
    let (socket, token) = (record.socket, record.datagram);
    if token == 0 {
        return None;
    }
    if capture {
        scratch.get().count = 0;
        if pieces::capture(skb, slot) != 0 {
            note(scratch.get());
        } else {
            // The ring is full, so the datagram is metered instead.
            capture = false;
            verdict::meter(skb, slot);
        }
    }
    if at == hook::INGRESS
        && let Some(last) = last()
    {
        last.socket.set(socket);
        last.token.set(token);
        last.slot.set(slot);
        last.captured.set(u32::from(capture));
        // The address of the program's context is that of the kernel's packet.
        last.buffer.set(skb as u64);
    }
    let scratch = scratch.get();
    if !capture && scratch.count == 0 {
        return None;
    }
    let now = scratch.packet.now;
    if scratch.met == socket && now.wrapping_sub(scratch.met_at) < MET_NANOSECONDS {
        return None;
    }
    (scratch.met, scratch.met_at) = (socket, now);
    if SOCKETS.get_ptr(socket).is_none() {
        meet(skb, socket, 0);
    }
    Some(())
}

/// Adds a socket to [`SOCKETS`], where user space finds it and looks up its process.
#[inline(always)]
pub fn meet(skb: *mut __sk_buff, socket: u64, is_stream: u64) {
    let met = Socket {
        // SAFETY: `skb` is the program's context.
        cgroup: unsafe { bpf_skb_cgroup_id(skb) },
        rcvbuf_errors: 0,
        is_stream,
    };
    let _ = SOCKETS.insert(socket, met, 0);
}

/// Returns a token for the current datagram, and its socket's cookie. `named` counts per slot, and
/// only this run holds the slot.
#[inline(always)]
pub fn identify(skb: *mut __sk_buff, slot: u32, named: &mut u32) -> (u32, u64) {
    *named = named.wrapping_add(1);
    // SAFETY: no preconditions.
    let cpu = unsafe { bpf_get_smp_processor_id() } as u32;
    // The token is unique among 2^20 datagrams of a CPU if at most 256 CPUs exist. It contains the
    // slot's number plus one, so it is never 0.
    let token = *named << 12 | (slot + 1) << 8 | (cpu & 0xff);
    // SAFETY: `skb` is the program's context.
    (token, unsafe { bpf_get_socket_cookie(skb.cast()) })
}

/// Returns whether a copy of the current datagram was captured just before. Copies are recognized
/// by the submessage that requires the capture. The result is always false on the wire hook.
#[inline(always)]
pub fn captured_before(slot: u32, scratch: &mut Scratch) -> bool {
    if scratch.repeated != 0 {
        return true;
    }
    if scratch.packet.host == 0 {
        return false;
    }
    let record = &scratch.walk.record;
    let Some(recent) = noted(scratch) else {
        return false;
    };
    let same = scratch.packet.now.wrapping_sub(recent.time.get()) < COPY_NANOSECONDS
        && recent.sequence_number.get() == record.sequence_number
        && recent.fragment_start.get() == record.fragment_start
        && recent.datagram_len.get() == scratch.walk.datagram_len
        && recent.writer[3].get() == record.writer[3]
        && recent.writer[2].get() == record.writer[2]
        && recent.writer[1].get() == record.writer[1]
        && recent.writer[0].get() == record.writer[0];
    if same {
        scratch.repeated = 1;
        count(slot, Counter::CopiesNotCaptured, 1);
    }
    same
}

/// Notes that the current datagram is captured.
#[inline(always)]
fn note(scratch: &Scratch) {
    let Some(recent) = noted(scratch) else {
        return;
    };
    let record = &scratch.walk.record;
    recent.time.set(scratch.packet.now);
    recent.sequence_number.set(record.sequence_number);
    recent.writer[0].set(record.writer[0]);
    recent.writer[1].set(record.writer[1]);
    recent.writer[2].set(record.writer[2]);
    recent.writer[3].set(record.writer[3]);
    recent.fragment_start.set(record.fragment_start);
    recent.datagram_len.set(scratch.walk.datagram_len);
}

#[inline(always)]
fn noted(scratch: &Scratch) -> Option<&'static Recent> {
    let record = &scratch.walk.record;
    recent(
        record.writer[2]
            ^ record.writer[3] >> 24
            ^ record.sequence_number as u32
            ^ record.fragment_start,
    )
}
