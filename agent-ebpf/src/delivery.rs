//! Deliveries of messages through the sockets of this host, while a client requests causes of late
//! calls.
//!
//! [`track_datagram`] numbers the datagrams of each socket just before they enter its receive
//! buffer. [`on_recvmsg`] runs when a thread has received one. The buffer is a queue: the number of
//! that datagram is the newest number, less the datagrams that are still in the buffer. A missed
//! drop cannot shift later numbers. A datagram that enters the buffer at the same moment can hide
//! one delivery, which is then unknown.

use aya_ebpf::{
    bindings::{__sk_buff, bpf_sock_addr},
    helpers::{bpf_get_current_pid_tgid, bpf_ktime_get_ns, generated::bpf_get_socket_cookie},
    macros::map,
    maps::{Array, LruHashMap},
};
use ros2probe_wire::{
    delivery::{DELIVERY_CAPACITY, Delivery, DeliveryKey, QUEUE_CAPACITY},
    filter::Counter,
    host::Layout,
    inside::thread_state,
};

use crate::{
    accounting::{self, Accounting},
    instructions::atomic_add,
    kernel_memory::{layout_entry, read_member},
    maps::{count_without_slot, scratch},
    packet::hook,
};

/// 1 = deliveries are followed. Set by user space.
#[map]
static FOLLOW_DELIVERIES: Array<u32> = Array::with_max_entries(1, 0);
/// Sockets that receive datagrams, by cookie.
#[map]
static QUEUES: LruHashMap<u64, ReceiveQueue> = LruHashMap::with_max_entries(QUEUE_CAPACITY, 0);
/// Datagrams in the receive buffers.
#[map]
static QUEUED: LruHashMap<QueuedDatagramKey, QueuedDatagram> =
    LruHashMap::with_max_entries(DELIVERY_CAPACITY, 0);
/// Messages that were received.
#[map]
static DELIVERIES: LruHashMap<DeliveryKey, Delivery> =
    LruHashMap::with_max_entries(DELIVERY_CAPACITY, 0);
/// Messages that sockets of this host sent: source timestamp to the time of the first datagram.
#[map]
static SENT: LruHashMap<u64, u64> = LruHashMap::with_max_entries(DELIVERY_CAPACITY, 0);

/// A socket's receive buffer.
#[repr(C)]
#[derive(Clone, Copy)]
struct ReceiveQueue {
    /// Number of datagrams so far.
    datagram_count: u64,
    /// Address of the socket. It is stored and read back, so that it is a number to the verifier.
    socket_address: u64,
    /// Time of the last receive call, and the accounting of its thread then.
    last_recvmsg_ns: u64,
    accounting: Accounting,
    /// The accounting at the present receive call.
    current_accounting: Accounting,
    /// That thread.
    last_thread: u64,
    /// The last time in which the receiving thread waited for a CPU for longer than
    /// [`MIN_STALL_NS`]: its end, and its parts.
    last_stall_end_ns: u64,
    stall_runnable: u64,
    stall_throttled: u64,
}

#[repr(C)]
#[derive(Clone, Copy)]
struct QueuedDatagramKey {
    socket: u64,
    number: u64,
}

/// A datagram in a receive buffer.
#[repr(C)]
#[derive(Clone, Copy)]
struct QueuedDatagram {
    arrived: u64,
    /// Source timestamp of its last sample in nanoseconds; 0 = it has none.
    source_timestamp: u64,
    /// Port of the sender.
    port: u64,
}

const NO_ACCOUNTING: Accounting = Accounting {
    cpu: 0,
    runnable: 0,
    throttled: 0,
    voluntary_switches: 0,
};
const EMPTY_RECEIVE_QUEUE: ReceiveQueue = ReceiveQueue {
    datagram_count: 0,
    socket_address: 0,
    last_recvmsg_ns: 0,
    accounting: NO_ACCOUNTING,
    current_accounting: NO_ACCOUNTING,
    last_thread: 0,
    last_stall_end_ns: 0,
    stall_runnable: 0,
    stall_throttled: 0,
};

/// Minimum wait for a CPU, in nanoseconds, to which the waits of several datagrams are attributed.
const MIN_STALL_NS: u64 = 500_000;

/// Returns whether deliveries are followed.
#[inline(always)]
pub fn is_tracking_enabled() -> bool {
    match FOLLOW_DELIVERIES.get_ptr(0) {
        // SAFETY: a map value pointer checked against null.
        Some(followed) => unsafe { core::ptr::read_volatile(followed) != 0 },
        None => false,
    }
}

/// Handles a datagram that passes the host hook; `at` is one of [`hook`].
#[unsafe(no_mangle)]
#[inline(never)]
pub extern "C" fn track_datagram(skb: *mut __sk_buff, slot: u32, at: u32) -> u32 {
    let Some(mut scratch) = scratch(slot) else {
        return 0;
    };
    let walk = &scratch.get().walk;
    // Other protocols have no token. Their datagrams are numbered too.
    let (port, source_timestamp) = match walk.record.datagram {
        0 => (0, 0),
        _ => (
            u64::from(walk.record.source_port),
            rtps_time_to_ns(walk.timestamp),
        ),
    };
    // SAFETY: no preconditions.
    let now = unsafe { bpf_ktime_get_ns() };
    if at != hook::INGRESS {
        if source_timestamp != 0 {
            note_send_time(source_timestamp, now);
        }
        return 0;
    }
    // SAFETY: `skb` is the program's context.
    let socket = unsafe { bpf_get_socket_cookie(skb.cast()) };
    let queue = match QUEUES.get_ptr_mut(&socket) {
        Some(queue) => queue,
        // Only sockets that receive RTPS are of interest.
        None if port == 0 => return 0,
        None => {
            let _ = QUEUES.insert(&socket, &EMPTY_RECEIVE_QUEUE, 0);
            match QUEUES.get_ptr_mut(&socket) {
                Some(queue) => queue,
                None => return 0,
            }
        }
    };
    // SAFETY: a map value pointer checked against null.
    let number = unsafe { core::ptr::read_volatile(&raw const (*queue).datagram_count) };
    let queued = QueuedDatagram {
        arrived: now,
        source_timestamp,
        port,
    };
    let _ = QUEUED.insert(&QueuedDatagramKey { socket, number }, &queued, 0);
    // SAFETY: as above.
    atomic_add(unsafe { &raw mut (*queue).datagram_count }, 1);
    0
}

/// Takes back the number of a datagram that the receive buffer refused.
#[inline(always)]
pub fn uncount_dropped_datagram(socket: u64) {
    if is_tracking_enabled()
        && let Some(queue) = QUEUES.get_ptr_mut(&socket)
    {
        // SAFETY: a map value pointer checked against null.
        atomic_add(unsafe { &raw mut (*queue).datagram_count }, u64::MAX);
    }
}

/// Notes when a message was first sent.
#[inline(always)]
fn note_send_time(source_timestamp: u64, now: u64) {
    const BPF_NOEXIST: u64 = 1;
    let _ = SENT.insert(&source_timestamp, &now, BPF_NOEXIST);
}

/// Handles the end of a receive call.
#[inline(always)]
pub fn on_recvmsg(context: *mut bpf_sock_addr) {
    if !is_tracking_enabled() {
        return;
    }
    // SAFETY: the program's context.
    let socket = unsafe { bpf_get_socket_cookie(context.cast()) };
    let Some(queue) = QUEUES.get_ptr_mut(&socket) else {
        return;
    };
    // SAFETY: no preconditions.
    let now = unsafe { bpf_ktime_get_ns() };
    // SAFETY: as above. The verifier rewrites reads of the context.
    let (address, port) = unsafe {
        let address = &raw mut (*queue).socket_address;
        core::ptr::write_volatile(address, (*context).__bindgen_anon_1.sk as u64);
        (core::ptr::read_volatile(address), (*context).user_port)
    };
    // SAFETY: a map value, as above.
    unsafe {
        let has_accounting = accounting::read_accounting(&raw mut (*queue).current_accounting) != 0;
        let port = u16::from_be(port as u16);
        if note_delivery(queue, socket, address, port, now, has_accounting).is_none() {
            count_without_slot(Counter::ReceivedUnmatched, 1);
        }
        (*queue).last_recvmsg_ns = 0;
        if has_accounting {
            (*queue).accounting = (*queue).current_accounting;
            (*queue).last_thread = bpf_get_current_pid_tgid();
            (*queue).last_recvmsg_ns = now;
        }
    }
}

/// Notes the delivery of the received datagram; `None` if it is not known which one that is.
/// `has_accounting`: whether the accounting of the running thread is known.
#[inline(always)]
unsafe fn note_delivery(
    queue: *mut ReceiveQueue,
    socket: u64,
    address: u64,
    port: u16,
    now: u64,
    has_accounting: bool,
) -> Option<()> {
    // SAFETY: a map value, by the caller.
    let count = unsafe { core::ptr::read_volatile(&raw const (*queue).datagram_count) };
    let number = count.checked_sub(1 + queue_len(address)?)?;
    let key = QueuedDatagramKey { socket, number };
    // SAFETY: the memory of an LRU entry stays valid. An entry is written once, unless two CPUs
    // numbered datagrams at the same moment.
    let QueuedDatagram {
        arrived,
        source_timestamp,
        port: expected,
    } = *unsafe { QUEUED.get(&key) }?;
    if source_timestamp == 0 {
        return Some(());
    }
    if expected != u64::from(port) || now < arrived {
        return None;
    }
    let thread = bpf_get_current_pid_tgid();
    let mut delivery = Delivery {
        arrived,
        received: now,
        runnable: 0,
        throttled: 0,
        thread: thread as u32,
        accounted: 0,
    };
    // SAFETY: a map value, by the caller.
    unsafe {
        let previous_recvmsg_ns = (*queue).last_recvmsg_ns;
        if has_accounting
            && previous_recvmsg_ns != 0
            && now > previous_recvmsg_ns
            && (*queue).last_thread == thread
        {
            let previous_accounting = &raw const (*queue).accounting;
            let states = accounting::states(
                previous_accounting,
                &(*queue).current_accounting,
                now - previous_recvmsg_ns,
            );
            let mut throttled = states[thread_state::THROTTLED];
            let mut runnable = states[thread_state::RUNNABLE];
            if throttled + runnable > MIN_STALL_NS {
                (*queue).last_stall_end_ns = now;
                (*queue).stall_runnable = runnable;
                (*queue).stall_throttled = throttled;
            } else if (*queue).last_stall_end_ns > arrived {
                // The datagram arrived during the last stall, behind the one received after it.
                let overlap_ns = (*queue).last_stall_end_ns - arrived;
                throttled += accounting::min((*queue).stall_throttled, overlap_ns);
                runnable += accounting::min((*queue).stall_runnable, overlap_ns);
            }
            // Both began with an earlier receive call. No part of the delivery is longer than it.
            let total_wait_ns = now - arrived;
            delivery.throttled = accounting::min(throttled, total_wait_ns);
            delivery.runnable = accounting::min(runnable, total_wait_ns - delivery.throttled);
            delivery.accounted = 1;
        }
    }
    let process = thread >> 32;
    let key = DeliveryKey {
        source_timestamp,
        process,
    };
    let _ = DELIVERIES.insert(&key, &delivery, 0);
    Some(())
}

/// Returns the number of datagrams in the receive buffer of the socket at `address`.
#[inline(always)]
fn queue_len(address: u64) -> Option<u64> {
    if layout_entry(Layout::SocketQueue) == Layout::ABSENT
        || layout_entry(Layout::ReaderQueue) == Layout::ABSENT
    {
        return None;
    }
    // Readers move all datagrams of the first queue to the second one.
    let queued: u32 = read_member(address, Layout::SocketQueue)?;
    let queued_by_reader: u32 = read_member(address, Layout::ReaderQueue)?;
    Some(u64::from(queued) + u64::from(queued_by_reader))
}

/// Returns a time of RTPS, seconds and fraction, in nanoseconds. Rounds as user space does.
#[inline(always)]
fn rtps_time_to_ns([seconds, fraction]: [u32; 2]) -> u64 {
    const SECOND: u64 = 1_000_000_000;
    u64::from(seconds) * SECOND + (u64::from(fraction) * SECOND + (1 << 31) >> 32)
}
