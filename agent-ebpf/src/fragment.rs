//! Datagrams in several IP fragments. One walk covers all frames, and its result is reported once
//! all fragments have arrived.
//!
//! Only the first fragment has a UDP header, and submessage headers may lie in any fragment. A
//! table holds the walk's state between frames. The filter cannot continue alone if discovery data
//! follows user data, if a header is cut in two, or if fragments are out of order. It then hands
//! the rest of the datagram and the walk's state to user space. So a verdict is reached exactly
//! once for each submessage.

use aya_ebpf::{bindings::__sk_buff, helpers::bpf_ktime_get_ns};
use ros2probe_wire::{
    filter::Counter,
    record::{flag, kind},
};

use crate::{
    instructions::opaque,
    maps::{FLOWS, Flow, FlowKey, NEW_FLOW, Packet, Scratch, Working, copy, count, scratch},
    runs,
    verdict::{self, progress},
};

/// Lifetime of a flow. Afterwards another datagram may have the same identification.
const FLOW_LIFETIME_NANOSECONDS: u64 = 5_000_000_000;

mod state {
    /// A new flow. Trailing fragments in this state arrived before the first one: the kind of
    /// datagram is unknown, and they are captured within the budget of unclassified writers.
    pub const HEADLESS: u32 = 0;
    /// The datagram is RTPS, and the kernel walks it.
    pub const WALKING: u32 = 1;
    /// All fragments go to user space.
    pub const CAPTURED: u32 = 2;
    /// The remaining fragments go to user space.
    pub const HANDED_OVER: u32 = 3;
    /// Not RTPS.
    pub const FOREIGN: u32 = 4;
    /// Complete; duplicate fragments change nothing.
    pub const DONE: u32 = 5;
}

/// Handles one IP fragment; returns 1 to keep the frame.
#[unsafe(no_mangle)]
#[inline(never)]
pub extern "C" fn pass(skb: *mut __sk_buff, slot: u32) -> u32 {
    let Some(mut scratch) = scratch(slot) else {
        return 0;
    };
    count(slot, Counter::Fragments, 1);
    let packet = &mut scratch.get().packet;
    // SAFETY: no preconditions.
    packet.now = unsafe { bpf_ktime_get_ns() };
    let Some(flow) = flow(slot, packet) else {
        count(slot, Counter::FlowTableFull, 1);
        return 0;
    };
    let (offset, len, more) = (packet.offset, packet.len, packet.more);
    let state = flow.state.get();
    if state == state::DONE || state == state::FOREIGN && offset != 0 {
        return 0;
    }
    let (word, mask) = (opaque(offset >> 9) & 127, 1_u64 << (offset >> 3 & 63));
    if let Some(starts) = flow.starts.get(word as usize) {
        let before = starts.get();
        if before & mask != 0 {
            count(slot, Counter::FragmentsRepeated, 1);
            return u32::from(state == state::CAPTURED || state == state::HANDED_OVER);
        }
        starts.set(before | mask);
    }
    let seen = flow.seen.get() + len;
    flow.seen.set(seen);
    if more == 0 {
        flow.expected.set(offset + len);
    }
    let expected = flow.expected.get();
    let complete = expected != 0 && expected == seen;
    let keep = if offset == 0 {
        first(skb, slot, scratch, flow)
    } else {
        trailing(skb, slot, scratch, flow)
    };
    if complete {
        finish(slot, scratch.get(), flow);
    }
    keep
}

/// Returns the flow of the current fragment; creates it if it does not exist or its identification
/// is reused. The kernel may reuse an LRU entry for another key while this run holds it, and
/// fragments of one datagram may arrive on two CPUs. In both cases a flow is miscounted.
#[inline(always)]
fn flow(slot: u32, packet: &Packet) -> Option<&'static Flow> {
    let key = FlowKey {
        source: packet.source,
        destination: packet.destination,
        identification: packet.identification,
        interface: packet.interface | packet.outgoing << 31,
    };
    // SAFETY: the memory of an LRU entry stays valid when the entry is reused for another key.
    if let Some(flow) = unsafe { FLOWS.get(key) } {
        let reused = flow.state.get() == state::DONE && packet.offset == 0;
        if !reused && packet.now.wrapping_sub(flow.born.get()) < FLOW_LIFETIME_NANOSECONDS {
            return Some(flow);
        }
    }
    if packet.offset != 0 {
        count(slot, Counter::FragmentsWithoutFlow, 1);
    }
    FLOWS.insert(key, NEW_FLOW.get(0)?, 0).ok()?;
    // SAFETY: as above.
    let flow = unsafe { FLOWS.get(key) }?;
    flow.born.set(packet.now);
    flow.token.set(packet.now as u32 | 1);
    Some(flow)
}

/// Handles the fragment with the UDP header.
#[inline(always)]
fn first(skb: *mut __sk_buff, slot: u32, mut scratch: Working<Scratch>, flow: &Flow) -> u32 {
    if verdict::begin(skb, slot, scratch.get()).is_none() {
        flow.state.set(state::FOREIGN);
        return 0;
    }
    let begun = scratch.get();
    begun.walk.record.datagram = flow.token.get();
    // Fragments that arrived before the first one were captured within the budget, so the others
    // are captured, too.
    let alone = flow.seen.get() == begun.packet.len;
    let (base, present) = (begun.packet.body + 8, begun.packet.len - 8);
    let result = if alone {
        verdict::run(skb, base, present, slot)
    } else {
        progress::CAPTURE
    };
    if result >= progress::CAPTURE {
        // This includes a split header: user space reads the datagram from its start.
        flow.state.set(state::CAPTURED);
        verdict::captured(slot, scratch.get());
        return 1;
    }
    flow.state.set(state::WALKING);
    keep_walk(slot, scratch, flow);
    0
}

/// Handles any fragment but the first.
#[inline(always)]
fn trailing(skb: *mut __sk_buff, slot: u32, mut scratch: Working<Scratch>, flow: &Flow) -> u32 {
    let going_on = scratch.get();
    let state = flow.state.get();
    if state == state::HEADLESS {
        // Trailing fragments of unknown datagrams must not fill the packet ring.
        return u32::from(verdict::charge(going_on.packet.len));
    }
    if state != state::WALKING {
        return 1;
    }
    // Offset in the UDP payload, which begins 8 bytes into the IP payload.
    let start = going_on.packet.offset - 8;
    let end = start + going_on.packet.len;
    let next = flow.next.get();
    if next >= end {
        return 0;
    }
    flow.walk.load(&mut going_on.walk);
    going_on.count = 0;
    going_on.unknown = 0;
    let base = going_on.packet.body.wrapping_sub(start);
    // The walk continues in a fragment that has not arrived yet: this one is out of order.
    let result = if next < start {
        progress::SPLIT
    } else {
        verdict::run(skb, base, end, slot)
    };
    keep_walk(slot, scratch, flow);
    if result < progress::CAPTURE {
        return 0;
    }
    hand_over(slot, scratch.get(), flow);
    verdict::captured(slot, scratch.get());
    1
}

/// Writes the records found so far, except the last one, and stores the walk's state.
#[inline(always)]
fn keep_walk(slot: u32, mut scratch: Working<Scratch>, flow: &Flow) {
    let walked = scratch.get();
    let found = walked.count;
    flow.walk.store(&walked.walk);
    let next = walked.walk.offset;
    let is_over = next + 4 > walked.walk.datagram_len;
    flow.next.set(if is_over { u32::MAX } else { next });
    if found == 0 {
        return;
    }
    send_pending(slot, walked, flow);
    if found > 1 {
        verdict::flush(found - 1, u32::from(flag::AHEAD), slot);
        flow.ahead.set(1);
    }
    if let Some(last) = scratch.get().records.get(found as usize - 1) {
        flow.pending.store(last);
        flow.has_pending.set(1);
    }
}

#[inline(always)]
fn send_pending(slot: u32, scratch: &mut Scratch, flow: &Flow) {
    if flow.has_pending.get() != 0 {
        flow.has_pending.set(0);
        flow.ahead.set(1);
        flow.pending.load(&mut scratch.pending);
        scratch.pending.flags |= flag::AHEAD;
        runs::give(slot, &scratch.pending, false);
    }
}

/// Writes a HANDOVER record with the walk's state for user space.
#[inline(always)]
fn hand_over(slot: u32, scratch: &mut Scratch, flow: &Flow) {
    send_pending(slot, scratch, flow);
    flow.state.set(state::HANDED_OVER);
    flow.ahead.set(1);
    let (walk, packet, record) = (&scratch.walk, &scratch.packet, &mut scratch.pending);
    copy(&walk.record, record);
    record.time = packet.now;
    record.kind = kind::HANDOVER;
    record.submessage_flags = 0;
    record.flags |= flag::AHEAD;
    record.writer = [walk.source[0], walk.source[1], walk.source[2], 0];
    record.reader = [
        walk.destination[0],
        walk.destination[1],
        walk.destination[2],
        0,
    ];
    record.sequence_number = 0;
    record.source_timestamp = u64::from(walk.timestamp[0]) << 32 | u64::from(walk.timestamp[1]);
    record.payload_len = walk.offset;
    record.encapsulation = packet.identification;
    record.stamp_seconds = packet.source[0];
    record.stamp_nanoseconds = packet.source[1];
    record.fragment_start = packet.source[2];
    record.fragments = packet.source[3];
    record.sample_size = 0;
    record.status_info = 0;
    count(slot, Counter::HandedOver, 1);
    verdict::write(slot, record);
    flow.pending.store(record);
}

/// Writes the last record after all fragments have arrived.
#[inline(always)]
fn finish(slot: u32, scratch: &mut Scratch, flow: &Flow) {
    let state = flow.state.get();
    let (walked, handed_over) = (state == state::WALKING, state == state::HANDED_OVER);
    flow.state.set(state::DONE);
    if !walked && !handed_over {
        return;
    }
    let (pending, ahead) = (flow.has_pending.get() != 0, flow.ahead.get() != 0);
    let metered = pending || ahead;
    if walked {
        count(
            slot,
            if metered {
                Counter::Metered
            } else {
                Counter::Ignored
            },
            1,
        );
    }
    if !metered {
        return;
    }
    count(slot, Counter::FragmentedComplete, 1);
    let record = &mut scratch.pending;
    flow.pending.load(record);
    if !pending {
        // All records were written ahead. This record marks them as valid.
        record.kind = kind::COMPLETE;
        record.datagram = flow.token.get();
        record.flags &= !flag::AHEAD;
    }
    flow.has_pending.set(0);
    record.time = scratch.packet.now;
    // After records written ahead, this record completes the datagram.
    runs::give(slot, record, !ahead);
}
