//! Datagrams that reached a socket and died there: its receive buffer was full.
//!
//! Directly before, on the same CPU and for the same socket, the host hook has looked at the
//! datagram and left what it found. So nothing is parsed here, and it works alike on every kernel.
//! Where the kernel's types are known, the socket is compared: a datagram that the hook has not seen
//! (another kind of traffic, a socket outside the hook's cgroup) is never taken for another.

use aya_ebpf::programs::RawTracePointContext;
use ros2probe_wire::{
    filter::Counter,
    host::Layout,
    record::{flag, kind},
};

use crate::{
    inside::{member, place},
    maps::{RECORDS_PER_DATAGRAM, SOCKETS, add, count, last, scratch},
    verdict::write,
};

/// `udp_fail_queue_rcv_skb(rc, sk)`.
#[inline(always)]
pub fn refused(context: &RawTracePointContext) {
    let Some(last) = last() else { return };
    let seen = last.socket;
    let mut socket = seen;
    if place(Layout::SocketCookie) != Layout::ABSENT {
        let sk: u64 = context.arg(1);
        socket = member(sk, Layout::SocketCookie).unwrap_or(0);
    }
    if let Some(known) = SOCKETS.get_ptr_mut(&socket) {
        // SAFETY: a map value pointer checked against null.
        add(unsafe { &raw mut (*known).no_room }, 1);
    }
    if seen == 0 {
        // Not RTPS.
        return;
    }
    if seen != socket {
        count(Counter::NoRoomUnseen, 1);
        return;
    }
    last.socket = 0;
    count(Counter::NoRoom, 1);
    undelivered(last.slot, last.token, last.captured);
}

/// Writes what the hook left in `slot` again.
#[unsafe(no_mangle)]
#[inline(never)]
pub extern "C" fn undelivered(slot: u32, token: u32, captured: u32) -> u32 {
    let Some(scratch) = scratch(slot) else {
        return 0;
    };
    if captured != 0 {
        let record = &mut scratch.walk.record;
        record.kind = kind::UNDELIVERED;
        record.datagram = token;
        write(record);
        return 0;
    }
    let mut index = 0;
    while index < RECORDS_PER_DATAGRAM {
        if index >= scratch.count {
            break;
        }
        if let Some(record) = scratch.records.get_mut(index as usize)
            && (record.kind == kind::DATA || record.kind == kind::DATA_FRAG)
        {
            record.flags |= flag::NO_ROOM;
            write(record);
        }
        index += 1;
    }
    0
}
