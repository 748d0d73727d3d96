//! The kernel filter: reads copies, returns how much of a frame user space gets, changes nothing.
//!
//! Thin on purpose. What a submessage is and what becomes of it is decided by
//! `ros2probe_wire::walk`, the same code that user space runs; here are the socket buffer, the maps
//! and the fragments. Hooks: [`wire`] sees frames on interfaces, [`host_ingress`] and
//! [`host_egress`] see datagrams at sockets. On request, [`shm_handed`] sees messages in the process
//! that sends them.
//!
//! Stays inside what Linux 5.10 verifies: bounded loops, global functions that are verified once,
//! reads of fixed size, no spin lock, no atomics that return a value.

#![no_std]
#![no_main]
#![feature(asm_experimental_arch)]

mod fragment;
mod handed;
mod host;
mod inside;
mod maps;
mod no_room;
mod owners;
mod packet;
mod pieces;
mod reassembly;
mod runs;
mod verdict;

use aya_ebpf::{
    EbpfContext as _,
    bindings::__sk_buff,
    macros::{cgroup_skb, raw_tracepoint, socket_filter, uprobe},
    programs::{ProbeContext, RawTracePointContext, SkBuffContext},
};
use ros2probe_wire::filter::Counter;

use crate::{
    maps::{INTERFACES, WIRE, claim_incoming, count, count_outside, release, setting},
    packet::hook,
};

/// `skb->pkt_type` of a frame that this host sends.
const PACKET_OUTGOING: u32 = 4;
/// The loopback device has this index in every network namespace.
const LOOPBACK: u32 = 1;

/// What an AF_PACKET SOCK_DGRAM socket has attached: goes on with [`wire`]. A socket pays for the
/// length of its program, and up to Linux 6.7 it may not hold 20 KB (`net.core.optmem_max`).
#[socket_filter]
pub fn wire_entry(context: SkBuffContext) -> i64 {
    // SAFETY: index 0 is in the array, and the loader puts a program of the same type there.
    unsafe { WIRE.tail_call(&context, 0) };
    // Only if nothing is there.
    0
}

/// For such a socket: the frame begins at the IP header. Returns the bytes that go into the socket's
/// packet ring: all of the frame, or none.
#[socket_filter]
pub fn wire(context: SkBuffContext) -> i64 {
    frame(context.skb.skb).unwrap_or(0)
}

/// For a cgroup: a datagram on its way into a socket begins at the IP header, reassembled. Returns 1:
/// the kernel goes on with it.
#[cgroup_skb(ingress)]
pub fn host_ingress(context: SkBuffContext) -> i32 {
    host::look(context.skb.skb, hook::INGRESS);
    1
}

/// As [`host_ingress`], for a datagram on its way out of a socket, not fragmented yet.
#[cgroup_skb(egress)]
pub fn host_egress(context: SkBuffContext) -> i32 {
    host::look(context.skb.skb, hook::EGRESS);
    1
}

/// For every datagram that a socket has no room for, directly after [`host_ingress`].
#[raw_tracepoint]
pub fn no_room(context: RawTracePointContext) -> u32 {
    no_room::refused(&context);
    0
}

/// For every packet that the kernel throws away, with the reason; attached where [`no_room`] is not
/// told of IPv6.
#[raw_tracepoint]
pub fn no_room_freed(context: RawTracePointContext) -> u32 {
    no_room::freed(&context);
    0
}

/// As [`no_room_freed`], where the kernel tells no reason.
#[raw_tracepoint]
pub fn no_room_unexplained(context: RawTracePointContext) -> u32 {
    no_room::unexplained(&context);
    0
}

/// For every packet that the kernel throws away, with the reason; attached where it tells one.
#[raw_tracepoint]
pub fn not_reassembled(context: RawTracePointContext) -> u32 {
    reassembly::dropped(&context);
    0
}

/// As [`not_reassembled`], where the kernel tells no reason.
#[raw_tracepoint]
pub fn not_reassembled_unexplained(context: RawTracePointContext) -> u32 {
    reassembly::unexplained(&context);
    0
}

/// Where a process is about to copy a message into shared memory, in one piece (Fast DDS 2.x).
#[uprobe]
pub fn shm_handed(context: ProbeContext) -> u32 {
    handed::look(context.as_ptr() as *const u64, false);
    0
}

/// As [`shm_handed`], for a message in a list of buffers (Fast DDS 3.x).
#[uprobe]
pub fn shm_handed_list(context: ProbeContext) -> u32 {
    handed::look(context.as_ptr() as *const u64, true);
    0
}

#[inline(always)]
fn frame(skb: *mut __sk_buff) -> Option<i64> {
    // SAFETY: the verifier rewrites reads of these fields; `skb` is the program's context.
    let (pkt_type, interface, segments) =
        unsafe { ((*skb).pkt_type, (*skb).ifindex, (*skb).gso_segs) };
    if interface == LOOPBACK && pkt_type == PACKET_OUTGOING {
        // Loopback frames pass twice; the copy on its way in is the one that counts.
        count_outside(Counter::LoopbackCopies, 1);
        return Some(0);
    }
    let accepted = match INTERFACES.get_ptr(interface) {
        // SAFETY: a map value pointer that was checked against null.
        Some(accepted) => unsafe { *accepted },
        None => setting!(NEW_INTERFACES),
    };
    if accepted == 0 {
        count_outside(Counter::InterfaceExcluded, 1);
        return Some(0);
    }
    let slot = claim_incoming()?;
    let kept = claimed(skb, segments, slot);
    release(slot);
    kept
}

#[inline(always)]
fn claimed(skb: *mut __sk_buff, segments: u32, slot: u32) -> Option<i64> {
    if packet::parse(skb, slot, hook::WIRE) == 0 {
        return Some(0);
    }
    if segments > 1 {
        count(slot, Counter::Segmented, 1);
        return Some(0);
    }
    let keep = if packet::is_fragment(slot)? {
        fragment::pass(skb, slot)
    } else {
        verdict::whole(skb, slot)
    };
    if keep == 0 {
        return Some(0);
    }
    // SAFETY: as above.
    let len = unsafe { (*skb).len };
    count(slot, Counter::CapturedBytes, u64::from(len));
    Some(i64::from(len))
}

#[panic_handler]
fn panic(_: &core::panic::PanicInfo<'_>) -> ! {
    loop {}
}

#[unsafe(link_section = "license")]
#[unsafe(no_mangle)]
static LICENSE: [u8; 4] = *b"GPL\0";
