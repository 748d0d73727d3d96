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
    instructions::add,
    kernel_memory::{member, place, read},
    maps::{Last, RECORDS_PER_DATAGRAM, SOCKETS, count_outside, last, scratch},
    verdict::write,
};

/// Maximum time between the hook and an immediate drop. A packet that is freed later was in the
/// socket's buffer, or is another packet at the same address.
const AT_ONCE_NANOSECONDS: u64 = 200_000;
const COMPARED_NANOSECONDS: u64 = 10_000_000;

/// `udp_fail_queue_rcv_skb(rc, sk)`.
#[inline(always)]
pub fn refused(context: &RawTracePointContext) {
    let Some(last) = last() else { return };
    let seen = last.socket.get();
    let mut socket = seen;
    if place(Layout::SocketCookie) != Layout::ABSENT {
        let sk: u64 = context.arg(1);
        socket = member(sk, Layout::SocketCookie).unwrap_or(0);
    }
    if seen == 0 {
        // The datagram is not RTPS, or its drop is counted already.
        if last.told.get() != socket {
            refusal(socket);
        }
        return;
    }
    refusal(socket);
    if seen == socket {
        tell(last);
    } else {
        count_outside(Counter::SocketFullUnseen, 1);
    }
}

/// `kfree_skb(skb, location, reason)`.
#[inline(always)]
pub fn freed(context: &RawTracePointContext) {
    let reason: u64 = context.arg(2);
    let reason = reason as u32;
    if reason != place(Layout::ReasonBufferFull) && reason != place(Layout::ReasonMemory) {
        return;
    }
    let buffer: u64 = context.arg(0);
    if let Some(last) = seen(buffer) {
        end(last);
    }
}

/// `kfree_skb(skb, location)`, for IPv6. Without the kernel's types, the packet is identified by
/// its address and by the immediate drop.
#[inline(always)]
pub fn unexplained(context: &RawTracePointContext) {
    let buffer: u64 = context.arg(0);
    let Some(last) = seen(buffer) else { return };
    let Some(mut scratch) = scratch(last.slot.get()) else {
        return;
    };
    let record = &scratch.get().walk.record;
    // `refused` handles full buffers of IPv4, so this is a later packet at the same address.
    if record.flags & flag::IPV6 == 0 {
        return;
    }
    let mut limit = AT_ONCE_NANOSECONDS;
    if place(Layout::BufferTransportHeader) != Layout::ABSENT {
        if is_of(buffer, record).is_none() {
            return;
        }
        limit = COMPARED_NANOSECONDS;
    }
    // SAFETY: no preconditions.
    let age = unsafe { bpf_ktime_get_ns() }.wrapping_sub(record.time);
    if age < limit {
        end(last);
    }
}

/// Returns `Some` if the packet's UDP header is that of the record's datagram.
#[inline(always)]
fn is_of(buffer: u64, record: &Record) -> Option<()> {
    let head: u64 = member(buffer, Layout::BufferHead)?;
    let transport: u16 = member(buffer, Layout::BufferTransportHeader)?;
    let [source, destination, len, _]: [u16; 4] = read(head + u64::from(transport))?;
    let same = u16::from_be(source) == record.source_port
        && u16::from_be(destination) == record.destination_port
        && u16::from_be(len) == record.datagram_len.wrapping_add(8);
    same.then_some(())
}

/// Returns the hook's last datagram if `buffer` is its packet and its drop is not counted yet.
#[inline(always)]
fn seen(buffer: u64) -> Option<&'static Last> {
    last().filter(|last| last.socket.get() != 0 && last.buffer.get() == buffer)
}

#[inline(always)]
fn end(last: &Last) {
    let socket = last.socket.get();
    refusal(socket);
    last.told.set(socket);
    tell(last);
}

/// Counts the drop for a known socket.
#[inline(always)]
fn refusal(socket: u64) {
    delivery::refused(socket);
    if let Some(known) = SOCKETS.get_ptr_mut(&socket) {
        // SAFETY: a map value pointer checked against null.
        add(unsafe { &raw mut (*known).rcvbuf_errors }, 1);
    }
}

#[inline(always)]
fn tell(last: &Last) {
    last.socket.set(0);
    count_outside(Counter::SocketFull, 1);
    undelivered(last.slot.get(), last.token.get(), last.captured.get());
}

/// Writes the hook's records of the datagram again, marked as not delivered. If the datagram was
/// captured, writes one record of kind UNDELIVERED instead.
#[unsafe(no_mangle)]
#[inline(never)]
pub extern "C" fn undelivered(slot: u32, token: u32, captured: u32) -> u32 {
    let Some(mut scratch) = scratch(slot) else {
        return 0;
    };
    let scratch = scratch.get();
    if scratch.walk.record.datagram != token {
        // Another run took the slot after a preemption, so the slot holds another datagram.
        count_outside(Counter::SocketFullUnseen, 1);
        return 0;
    }
    if captured != 0 {
        let record = &mut scratch.walk.record;
        record.kind = kind::UNDELIVERED;
        write(slot, record);
        return 0;
    }
    let mut index = 0;
    while index < RECORDS_PER_DATAGRAM {
        if index >= scratch.count {
            break;
        }
        if let Some(record) = scratch.records.get_mut(index as usize)
            && record.has_samples()
        {
            record.flags |= flag::SOCKET_FULL;
            write(slot, record);
        }
        index += 1;
    }
    0
}
