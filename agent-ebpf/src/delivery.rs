//! Deliveries of messages through the sockets of this host, while a client requests causes of late
//! calls.
//!
//! [`passed`] numbers the datagrams of each socket just before they enter its receive buffer.
//! [`received`] runs when a thread has received one. The buffer is a queue: the number of that
//! datagram is the newest number, less the datagrams that are still in the buffer.
//! A missed drop cannot shift later numbers. A datagram that enters the buffer at the same moment
//! can hide one delivery, which is then unknown.

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
    instructions::add,
    kernel_memory::{member, place},
    maps::{count_outside, scratch},
    packet::hook,
};

/// 1 = deliveries are followed. Set by user space.
#[map]
static FOLLOW_DELIVERIES: Array<u32> = Array::with_max_entries(1, 0);
/// Sockets that receive datagrams, by cookie.
#[map]
static QUEUES: LruHashMap<u64, Queue> = LruHashMap::with_max_entries(QUEUE_CAPACITY, 0);
/// Datagrams in the receive buffers.
#[map]
static QUEUED: LruHashMap<QueuedKey, Queued> = LruHashMap::with_max_entries(DELIVERY_CAPACITY, 0);
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
struct Queue {
    /// Number of datagrams so far.
    count: u64,
    /// Address of the socket, passed through memory to be a plain number.
    socket: u64,
    /// Time of the last receive call, and the accounting of its thread then.
    received: u64,
    accounting: Accounting,
    /// The accounting at the present receive call.
    after: Accounting,
    /// That thread.
    thread: u64,
    /// The last time in which the receiving thread waited for a CPU for longer than [`STALL`]: its
    /// end, and its parts.
    stall_ended: u64,
    stall_runnable: u64,
    stall_throttled: u64,
}

#[repr(C)]
#[derive(Clone, Copy)]
struct QueuedKey {
    socket: u64,
    number: u64,
}

/// A datagram in a receive buffer.
#[repr(C)]
#[derive(Clone, Copy)]
struct Queued {
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
const NEW_QUEUE: Queue = Queue {
    count: 0,
    socket: 0,
    received: 0,
    accounting: NO_ACCOUNTING,
    after: NO_ACCOUNTING,
    thread: 0,
    stall_ended: 0,
    stall_runnable: 0,
    stall_throttled: 0,
};

/// Minimum wait for a CPU, in nanoseconds, to which the waits of several datagrams are attributed.
const STALL: u64 = 500_000;

/// Returns whether deliveries are followed.
#[inline(always)]
pub fn are_followed() -> bool {
    match FOLLOW_DELIVERIES.get_ptr(0) {
        // SAFETY: a map value pointer checked against null.
        Some(followed) => unsafe { core::ptr::read_volatile(followed) != 0 },
        None => false,
    }
}

/// Handles a datagram that passes the host hook; `at` is one of [`hook`].
#[unsafe(no_mangle)]
#[inline(never)]
pub extern "C" fn passed(skb: *mut __sk_buff, slot: u32, at: u32) -> u32 {
    let Some(mut scratch) = scratch(slot) else {
        return 0;
    };
    let walk = &scratch.get().walk;
    // Other protocols have no token. Their datagrams are numbered too.
    let (port, source_timestamp) = match walk.record.datagram {
        0 => (0, 0),
        _ => (
            u64::from(walk.record.source_port),
            nanoseconds(walk.timestamp),
        ),
    };
    // SAFETY: no preconditions.
    let now = unsafe { bpf_ktime_get_ns() };
    if at != hook::INGRESS {
        if source_timestamp != 0 {
            sent(source_timestamp, now);
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
            let _ = QUEUES.insert(&socket, &NEW_QUEUE, 0);
            match QUEUES.get_ptr_mut(&socket) {
                Some(queue) => queue,
                None => return 0,
            }
        }
    };
    // SAFETY: a map value pointer checked against null.
    let number = unsafe { core::ptr::read_volatile(&raw const (*queue).count) };
    let queued = Queued {
        arrived: now,
        source_timestamp,
        port,
    };
    let _ = QUEUED.insert(&QueuedKey { socket, number }, &queued, 0);
    // SAFETY: as above.
    add(unsafe { &raw mut (*queue).count }, 1);
    0
}

/// Takes back the number of a datagram that the receive buffer refused.
#[inline(always)]
pub fn refused(socket: u64) {
    if are_followed()
        && let Some(queue) = QUEUES.get_ptr_mut(&socket)
    {
        // SAFETY: a map value pointer checked against null.
        add(unsafe { &raw mut (*queue).count }, u64::MAX);
    }
}

/// Notes when a message was first sent.
#[inline(always)]
fn sent(source_timestamp: u64, now: u64) {
    const NO_EXIST: u64 = 1;
    let _ = SENT.insert(&source_timestamp, &now, NO_EXIST);
}

/// Handles the end of a receive call.
#[inline(always)]
pub fn received(context: *mut bpf_sock_addr) {
    if !are_followed() {
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
        let address = &raw mut (*queue).socket;
        core::ptr::write_volatile(address, (*context).__bindgen_anon_1.sk as u64);
        (core::ptr::read_volatile(address), (*context).user_port)
    };
    // SAFETY: a map value, as above.
    unsafe {
        let is_known = accounting::read_into(&raw mut (*queue).after) != 0;
        let port = u16::from_be(port as u16);
        if note(queue, socket, address, port, now, is_known).is_none() {
            count_outside(Counter::ReceivedUnmatched, 1);
        }
        (*queue).received = 0;
        if is_known {
            (*queue).accounting = (*queue).after;
            (*queue).thread = bpf_get_current_pid_tgid();
            (*queue).received = now;
        }
    }
}

/// Notes the delivery of the received datagram; `None` if it is not known which one that is.
/// `is_known`: whether the accounting of the running thread is.
#[inline(always)]
unsafe fn note(
    queue: *mut Queue,
    socket: u64,
    address: u64,
    port: u16,
    now: u64,
    is_known: bool,
) -> Option<()> {
    // SAFETY: a map value, by the caller.
    let count = unsafe { core::ptr::read_volatile(&raw const (*queue).count) };
    let number = count.checked_sub(1 + waiting(address)?)?;
    let key = QueuedKey { socket, number };
    // SAFETY: the memory of an LRU entry stays valid. An entry is written once, unless two CPUs
    // numbered datagrams at the same moment.
    let Queued {
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
        let since = (*queue).received;
        if is_known && since != 0 && now > since && (*queue).thread == thread {
            let before = &raw const (*queue).accounting;
            let states = accounting::states(before, &(*queue).after, now - since);
            let mut throttled = states[thread_state::THROTTLED];
            let mut runnable = states[thread_state::RUNNABLE];
            if throttled + runnable > STALL {
                (*queue).stall_ended = now;
                (*queue).stall_runnable = runnable;
                (*queue).stall_throttled = throttled;
            } else if (*queue).stall_ended > arrived {
                // The datagram arrived during that wait, behind the one that was received then.
                let during = (*queue).stall_ended - arrived;
                throttled += accounting::least((*queue).stall_throttled, during);
                runnable += accounting::least((*queue).stall_runnable, during);
            }
            // Both began with an earlier receive call. No part of the delivery is longer than it.
            let most = now - arrived;
            delivery.throttled = accounting::least(throttled, most);
            delivery.runnable = accounting::least(runnable, most - delivery.throttled);
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
fn waiting(address: u64) -> Option<u64> {
    if place(Layout::SocketQueue) == Layout::ABSENT || place(Layout::ReaderQueue) == Layout::ABSENT
    {
        return None;
    }
    // Readers move all datagrams of the first queue to the second one.
    let new: u32 = member(address, Layout::SocketQueue)?;
    let moved: u32 = member(address, Layout::ReaderQueue)?;
    Some(u64::from(new) + u64::from(moved))
}

/// Returns a time of RTPS, seconds and fraction, in nanoseconds. Rounds as user space does.
#[inline(always)]
fn nanoseconds([seconds, fraction]: [u32; 2]) -> u64 {
    const SECOND: u64 = 1_000_000_000;
    u64::from(seconds) * SECOND + (u64::from(fraction) * SECOND + (1 << 31) >> 32)
}
