//! The kernel filter reads packets and changes none of them. For a frame on an interface it returns
//! how many bytes user space receives.
//!
//! The crate is thin on purpose: `ros2probe_wire::walk`, which user space runs too, reads
//! submessages and decides what happens to them. This crate adds the socket buffer, the maps and
//! the fragments. [`wire`], or [`tcx_ingress`] and [`tcx_egress`], read frames on interfaces.
//! [`host_ingress`] and [`host_egress`] read datagrams at sockets, [`zenoh_ingress`] and
//! [`zenoh_egress`] TCP segments. If enabled, [`shm_handed`] reads messages in the process that sends
//! them, and [`received_ipv4`] notes when threads receive datagrams.
//!
//! The programs for tcx need Linux 6.6. The others use only what the verifier of Linux 5.10 accepts:
//! bounded loops, global functions that are verified once, reads of fixed size, no spin lock, no atomics that return a value.

#![no_std]
#![no_main]
#![feature(asm_experimental_arch)]

#[path = "inside/accounting.rs"]
mod accounting;
mod delivery;
mod fragment;
mod handed;
mod host;
mod instructions;
mod kernel_memory;
mod maps;
mod owners;
mod packet;
mod pieces;
mod reassembly;
mod registers;
mod runs;
mod settings;
mod socket_full;
mod tcx;
mod verdict;
mod zenoh;

use aya_ebpf::{
    EbpfContext as _,
    bindings::__sk_buff,
    macros::{cgroup_skb, cgroup_sock_addr, classifier, raw_tracepoint, socket_filter, uprobe},
    programs::{ProbeContext, RawTracePointContext, SkBuffContext, SockAddrContext, TcContext},
};
use ros2probe_wire::filter::Counter;

use crate::{
    maps::{
        INTERFACES, NEW_INTERFACES, WIRE, claim_ingress_slot, count, count_without_slot,
        release_slot,
    },
    packet::hook,
    settings::{keep_frames_of_task, read_global},
};

/// `skb->pkt_type` of a frame that this host sends.
const PACKET_OUTGOING: u32 = 4;
/// As [`PACKET_OUTGOING`], for a copy of a sent multicast packet.
const PACKET_LOOPBACK: u32 = 5;
/// Index of the loopback device in every network namespace.
const LOOPBACK: u32 = 1;
/// Return value at tcx: the next program decides, or the kernel after the last one.
const TCX_NEXT: i32 = -1;

/// Runs for an AF_PACKET SOCK_DGRAM socket and tail-calls [`wire`]. The kernel charges a socket for
/// the length of its program, which must stay below 20 KB up to Linux 6.7 (`net.core.optmem_max`).
#[socket_filter]
pub fn wire_entry(context: SkBuffContext) -> i64 {
    // SAFETY: index 0 is in the array, and the loader puts a program of the same type there.
    unsafe { WIRE.tail_call(&context, 0) };
    // This line is reached only if the array is empty.
    0
}

/// Runs for the socket of [`wire_entry`]; the frame begins at the IP header. Returns the number of
/// bytes that go into the socket's packet ring: the whole frame or 0.
#[socket_filter]
pub fn wire(context: SkBuffContext) -> i64 {
    frame(context.skb.skb).unwrap_or(0)
}

/// Runs at tcx for a packet that an interface has received. Returns TCX_NEXT, so that the packet
/// continues as without the program.
#[classifier]
pub fn tcx_ingress(context: TcContext) -> i32 {
    let skb = context.skb.skb;
    // A sent multicast packet comes back for the members on this host, and was counted when sent.
    // SAFETY: the verifier rewrites reads of this field.
    if unsafe { (*skb).pkt_type } != PACKET_LOOPBACK {
        tcx::process_packet(skb, hook::TCX_INGRESS);
    }
    TCX_NEXT
}

/// Runs as [`tcx_ingress`] does, for a packet that an interface is about to send, after the IP layer
/// has fragmented it.
#[classifier]
pub fn tcx_egress(context: TcContext) -> i32 {
    tcx::process_packet(context.skb.skb, hook::TCX_EGRESS);
    TCX_NEXT
}

/// Runs at a cgroup for a received datagram, which is reassembled and begins at the IP header.
/// Returns 1, so that the kernel delivers the datagram.
#[cgroup_skb(ingress)]
pub fn host_ingress(context: SkBuffContext) -> i32 {
    host::process_packet(context.skb.skb, hook::INGRESS);
    1
}

/// Runs as [`host_ingress`] does, for a datagram that a socket sends, before fragmentation.
#[cgroup_skb(egress)]
pub fn host_egress(context: SkBuffContext) -> i32 {
    host::process_packet(context.skb.skb, hook::EGRESS);
    1
}

/// Runs in addition to [`host_ingress`], for TCP segments, which may carry Zenoh or RTPS. Linux may
/// merge several segments of a connection into one packet.
#[cgroup_skb(ingress)]
pub fn zenoh_ingress(context: SkBuffContext) -> i32 {
    zenoh::process_socket_segment(context.skb.skb, hook::INGRESS);
    1
}

/// Runs as [`zenoh_ingress`] does, for segments that a socket sends.
#[cgroup_skb(egress)]
pub fn zenoh_egress(context: SkBuffContext) -> i32 {
    zenoh::process_socket_segment(context.skb.skb, hook::EGRESS);
    1
}

/// Runs at a cgroup after a thread has received an IPv4 datagram with the address of its sender.
/// Returns 1, which changes nothing.
#[cgroup_sock_addr(recvmsg4)]
pub fn received_ipv4(context: SockAddrContext) -> i32 {
    delivery::on_recvmsg(context.sock_addr);
    1
}

/// Runs as [`received_ipv4`] does, for IPv6.
#[cgroup_sock_addr(recvmsg6)]
pub fn received_ipv6(context: SockAddrContext) -> i32 {
    delivery::on_recvmsg(context.sock_addr);
    1
}

/// Runs for every datagram that does not fit a socket's buffer, directly after [`host_ingress`].
#[raw_tracepoint]
pub fn socket_full(context: RawTracePointContext) -> u32 {
    socket_full::on_udp_fail_queue_rcv_skb(&context);
    0
}

/// Runs for every packet that the kernel drops, with the reason. It is attached on kernels where
/// [`socket_full`] does not cover IPv6.
#[raw_tracepoint]
pub fn no_room_freed(context: RawTracePointContext) -> u32 {
    socket_full::on_kfree_skb(&context);
    0
}

/// Runs as [`no_room_freed`] does, on kernels that report no drop reason.
#[raw_tracepoint]
pub fn no_room_unexplained(context: RawTracePointContext) -> u32 {
    socket_full::on_kfree_skb_no_reason(&context);
    0
}

/// Runs for every packet that the kernel drops. It is attached on kernels that report a drop
/// reason.
#[raw_tracepoint]
pub fn not_reassembled(context: RawTracePointContext) -> u32 {
    reassembly::on_kfree_skb(&context);
    0
}

/// Runs as [`not_reassembled`] does, on kernels that report no drop reason.
#[raw_tracepoint]
pub fn not_reassembled_unexplained(context: RawTracePointContext) -> u32 {
    reassembly::on_kfree_skb_no_reason(&context);
    0
}

/// Runs where a process is about to copy a message in one piece into shared memory (Fast DDS 2.x).
#[uprobe]
pub fn shm_handed(context: ProbeContext) -> u32 {
    handed::process_send(context.as_ptr() as *const u64, false);
    keep_frames_of_task(&context);
    0
}

/// Runs as [`shm_handed`] does, for a message in a list of buffers (Fast DDS 3.x).
#[uprobe]
pub fn shm_handed_list(context: ProbeContext) -> u32 {
    handed::process_send(context.as_ptr() as *const u64, true);
    keep_frames_of_task(&context);
    0
}

#[inline(always)]
fn frame(skb: *mut __sk_buff) -> Option<i64> {
    // SAFETY: the verifier rewrites reads of these fields; `skb` is the program's context.
    let (pkt_type, interface, segments) =
        unsafe { ((*skb).pkt_type, (*skb).ifindex, (*skb).gso_segs) };
    if interface == LOOPBACK && pkt_type == PACKET_OUTGOING {
        // Loopback frames pass twice; only the received copy is read.
        count_without_slot(Counter::LoopbackCopies, 1);
        return Some(0);
    }
    let accepted = match INTERFACES.get_ptr(interface) {
        // SAFETY: a map value pointer that was checked against null.
        Some(accepted) => unsafe { *accepted },
        None => read_global(&NEW_INTERFACES),
    };
    if accepted == 0 {
        count_without_slot(Counter::InterfaceExcluded, 1);
        return Some(0);
    }
    let slot = claim_ingress_slot()?;
    let kept = claimed(skb, segments, slot);
    release_slot(slot);
    kept
}

#[inline(always)]
fn claimed(skb: *mut __sk_buff, segments: u32, slot: u32) -> Option<i64> {
    let start = packet::ip_header_offset(skb);
    if !keeps_frame(skb, segments, slot, hook::INTERFACE, start)? {
        return Some(0);
    }
    // SAFETY: the verifier rewrites reads of this field.
    let len = unsafe { (*skb).len };
    count(slot, Counter::CapturedBytes, u64::from(len));
    Some(i64::from(len))
}

/// Returns whether user space needs the frame whose IP header is at `start`; `None` without working
/// memory. `at` is one of [`hook`].
#[inline(always)]
fn keeps_frame(skb: *mut __sk_buff, segments: u32, slot: u32, at: u32, start: u32) -> Option<bool> {
    if packet::parse_ip_packet(skb, slot, at, start) == 0 {
        let keep = zenoh::filter_tcp_frame(skb, slot, start) != 0;
        count(slot, Counter::ZenohFrames, u64::from(keep));
        return Some(keep);
    }
    if segments > 1 {
        count(slot, Counter::Segmented, 1);
        return Some(false);
    }
    let keep = if packet::is_fragment(slot)? {
        fragment::process_fragment(skb, slot)
    } else {
        verdict::decide_datagram(skb, slot)
    };
    Some(keep != 0)
}

#[panic_handler]
fn panic(_: &core::panic::PanicInfo<'_>) -> ! {
    loop {}
}

#[unsafe(link_section = "license")]
#[unsafe(no_mangle)]
static LICENSE: [u8; 4] = *b"GPL\0";
