//! Datagrams dropped at a socket because its receive buffer was full.
//!
//! Directly before the drop, on the same CPU and for the same socket, the host hook has read the
//! datagram and stored its findings. So this module parses no RTPS. Where the kernel's types are
//! known, it compares the socket. Then it never takes an unseen datagram (other traffic, a socket
//! outside the hook's cgroup) for one that the hook has seen.
//!
//! Before Linux 6.6 the kernel reports a full buffer for IPv4 only. On such kernels this module
//! observes all freed packets, and recognizes the one that the hook has just seen.

use aya_ebpf::{helpers::bpf_ktime_get_ns, programs::RawTracePointContext};
use ros2probe_wire::{
    filter::Counter,
    host::Layout,
    record::{Record, flag, kind},
};

use crate::{
    delivery,
    instructions::atomic_add,
    kernel_memory::{layout_entry, read_kernel, read_member},
    maps::{
        LastReceived, RECORDS_PER_DATAGRAM, SOCKETS, count_without_slot, last_received, scratch,
    },
    verdict::write_record,
};

/// Maximum time between the hook and an immediate drop. A packet that is freed later was in the
/// socket's buffer, or is another packet at the same address.
const MAX_IMMEDIATE_DROP_NS: u64 = 200_000;
/// As [`MAX_IMMEDIATE_DROP_NS`], for a packet whose UDP header is that of the datagram.
const MAX_MATCHED_DROP_NS: u64 = 10_000_000;

/// `udp_fail_queue_rcv_skb(rc, sk)`.
#[inline(always)]
pub fn on_udp_fail_queue_rcv_skb(context: &RawTracePointContext) {
    let Some(last) = last_received() else { return };
    let last_socket = last.socket.get();
    let mut socket = last_socket;
    if layout_entry(Layout::SocketCookie) != Layout::ABSENT {
        let sk: u64 = context.arg(1);
        socket = read_member(sk, Layout::SocketCookie).unwrap_or(0);
    }
    if last_socket == 0 {
        // The datagram is not RTPS, or its drop is counted already.
        if last.counted_socket.get() != socket {
            count_socket_drop(socket);
        }
        return;
    }
    count_socket_drop(socket);
    if last_socket == socket {
        write_drop(last);
    } else {
        count_without_slot(Counter::SocketFullUnseen, 1);
    }
}

/// `kfree_skb(skb, location, reason)`.
#[inline(always)]
pub fn on_kfree_skb(context: &RawTracePointContext) {
    let reason: u64 = context.arg(2);
    let reason = reason as u32;
    if reason != layout_entry(Layout::ReasonBufferFull)
        && reason != layout_entry(Layout::ReasonMemory)
    {
        return;
    }
    let buffer: u64 = context.arg(0);
    if let Some(last) = last_received_with(buffer) {
        report_drop(last);
    }
}

/// `kfree_skb(skb, location)`, for IPv6. Without the kernel's types, the packet is identified by
/// its address and by the immediate drop.
#[inline(always)]
pub fn on_kfree_skb_no_reason(context: &RawTracePointContext) {
    let buffer: u64 = context.arg(0);
    let Some(last) = last_received_with(buffer) else {
        return;
    };
    let Some(mut scratch) = scratch(last.slot.get()) else {
        return;
    };
    let record = &scratch.get().walk.record;
    // `on_udp_fail_queue_rcv_skb` handles full buffers of IPv4, so this is a later packet at the
    // same address.
    if record.flags & flag::IPV6 == 0 {
        return;
    }
    let mut limit = MAX_IMMEDIATE_DROP_NS;
    if layout_entry(Layout::BufferTransportHeader) != Layout::ABSENT {
        if has_same_udp_header(buffer, record).is_none() {
            return;
        }
        limit = MAX_MATCHED_DROP_NS;
    }
    // SAFETY: no preconditions.
    let age = unsafe { bpf_ktime_get_ns() }.wrapping_sub(record.time);
    if age < limit {
        report_drop(last);
    }
}

/// Returns `Some` if the packet's UDP header is that of the record's datagram.
#[inline(always)]
fn has_same_udp_header(buffer: u64, record: &Record) -> Option<()> {
    let head: u64 = read_member(buffer, Layout::BufferHead)?;
    let transport: u16 = read_member(buffer, Layout::BufferTransportHeader)?;
    let [source, destination, len, _]: [u16; 4] = read_kernel(head + u64::from(transport))?;
    let same = u16::from_be(source) == record.source_port
        && u16::from_be(destination) == record.destination_port
        && u16::from_be(len) == record.datagram_len.wrapping_add(8);
    same.then_some(())
}

/// Returns the hook's last datagram if `buffer` is its packet and its drop is not counted yet.
#[inline(always)]
fn last_received_with(buffer: u64) -> Option<&'static LastReceived> {
    last_received().filter(|last| last.socket.get() != 0 && last.skb_address.get() == buffer)
}

#[inline(always)]
fn report_drop(last: &LastReceived) {
    let socket = last.socket.get();
    count_socket_drop(socket);
    last.counted_socket.set(socket);
    write_drop(last);
}

/// Counts the drop for a known socket.
#[inline(always)]
fn count_socket_drop(socket: u64) {
    delivery::uncount_dropped_datagram(socket);
    if let Some(known) = SOCKETS.get_ptr_mut(&socket) {
        // SAFETY: a map value pointer checked against null.
        atomic_add(unsafe { &raw mut (*known).rcvbuf_errors }, 1);
    }
}

#[inline(always)]
fn write_drop(last: &LastReceived) {
    last.socket.set(0);
    count_without_slot(Counter::SocketFull, 1);
    write_undelivered_records(last.slot.get(), last.token.get(), last.was_captured.get());
}

/// Writes the hook's records of the datagram again, marked as not delivered. If the datagram was
/// captured, writes one record of kind UNDELIVERED instead.
#[unsafe(no_mangle)]
#[inline(never)]
pub extern "C" fn write_undelivered_records(slot: u32, token: u32, captured: u32) -> u32 {
    let Some(mut scratch) = scratch(slot) else {
        return 0;
    };
    let scratch = scratch.get();
    if scratch.walk.record.datagram != token {
        // Another run took the slot after a preemption, so the slot holds another datagram.
        count_without_slot(Counter::SocketFullUnseen, 1);
        return 0;
    }
    if captured != 0 {
        let record = &mut scratch.walk.record;
        record.kind = kind::UNDELIVERED;
        write_record(slot, record);
        return 0;
    }
    let mut index = 0;
    while index < RECORDS_PER_DATAGRAM {
        if index >= scratch.record_count {
            break;
        }
        if let Some(record) = scratch.records.get_mut(index as usize)
            && record.has_samples()
        {
            record.flags |= flag::SOCKET_FULL;
            write_record(slot, record);
        }
        index += 1;
    }
    0
}
