//! Datagrams in several IP fragments. One walk covers all frames, and its result is reported once
//! all fragments have arrived.
//!
//! Only the first fragment has a UDP header, and submessage headers may lie in any fragment. A
//! table holds the walk's state between frames. The filter cannot continue alone if discovery data
//! follows user data, if a header is cut in two, or if fragments are out of order. It then hands
//! the rest of the datagram and the walk's state to user space. So a verdict is reached exactly
//! once for each submessage.

use aya_ebpf::{
    bindings::__sk_buff,
    helpers::{bpf_ktime_get_ns, generated::bpf_ktime_get_coarse_ns},
};
use ros2probe_wire::{
    filter::Counter,
    record::{flag, kind},
    walk,
};

use crate::{
    instructions::hide_bounds,
    maps::{FLOWS, Flow, FlowKey, NEW_FLOW, Packet, Scratch, ScratchRef, copy, count, scratch},
    packet::Payload,
    runs,
    verdict::{self, progress},
};

/// Lifetime of a flow. Afterwards another datagram may have the same identification.
const FLOW_LIFETIME_NANOSECONDS: u64 = 5_000_000_000;

/// Maximum number of submessages in one fragment that only continue a record: seven of Cyclone DDS
/// at an MTU of 9000.
const MAX_CONTINUED: u32 = 8;

/// An IP fragment in the middle of a datagram, before it has working memory.
pub struct Trailing {
    /// Offset of these bytes in the whole IP payload.
    pub offset: u32,
    pub len: u32,
    /// Offset of the IP payload in the socket buffer.
    pub payload_offset: u32,
}

mod state {
    /// A new flow. Trailing fragments in this state arrived before the first one: the kind of
    /// datagram is unknown, and they are captured within the budget of unclassified writers.
    pub const NO_FIRST_FRAGMENT: u32 = 0;
    /// The datagram is RTPS, and the kernel walks it.
    pub const WALKING: u32 = 1;
    /// All fragments go to user space.
    pub const CAPTURED: u32 = 2;
    /// The remaining fragments go to user space.
    pub const HANDED_OVER: u32 = 3;
    /// Not RTPS.
    pub const NOT_RTPS: u32 = 4;
    /// Complete; duplicate fragments change nothing.
    pub const COMPLETE: u32 = 5;
}

/// Handles one IP fragment; returns 1 to keep the frame.
#[unsafe(no_mangle)]
#[inline(never)]
pub extern "C" fn process_fragment(skb: *mut __sk_buff, slot: u32) -> u32 {
    let Some(mut scratch) = scratch(slot) else {
        return 0;
    };
    count(slot, Counter::Fragments, 1);
    let packet = &mut scratch.get().packet;
    // SAFETY: no preconditions.
    packet.time_ns = unsafe { bpf_ktime_get_ns() };
    let Some(flow) = flow(slot, packet) else {
        count(slot, Counter::FlowTableFull, 1);
        return 0;
    };
    let (offset, len, more) = (packet.fragment_offset, packet.len, packet.more_fragments);
    let state = flow.state.get();
    if state == state::COMPLETE || state == state::NOT_RTPS && offset != 0 {
        return 0;
    }
    let (word, mask) = (hide_bounds(offset >> 9) & 127, 1_u64 << (offset >> 3 & 63));
    if let Some(starts) = flow.seen_offsets.get(word as usize) {
        let before = starts.get();
        if before & mask != 0 {
            count(slot, Counter::FragmentsRepeated, 1);
            return u32::from(state == state::CAPTURED || state == state::HANDED_OVER);
        }
        starts.set(before | mask);
    }
    let seen = flow.received_bytes.get() + len;
    flow.received_bytes.set(seen);
    if more == 0 {
        flow.total_bytes.set(offset + len);
    }
    let expected = flow.total_bytes.get();
    let complete = expected != 0 && expected == seen;
    let keep = if offset == 0 {
        process_first_fragment(skb, slot, scratch, flow)
    } else {
        process_later_fragment(skb, slot, scratch, flow)
    };
    if complete {
        complete_datagram(slot, scratch.get(), flow);
    }
    keep
}

/// Handles a fragment of a datagram whose first fragment was seen, if its bytes are not needed or only
/// continue a record. Returns `false` if [`process_fragment`] must handle it: after the submessages by
/// which the record was continued.
#[inline(always)]
pub fn follow(skb: *mut __sk_buff, slot: u32, key: &FlowKey, trailing: &Trailing) -> bool {
    // SAFETY: as in `flow`.
    let Some(flow) = (unsafe { FLOWS.get(key) }) else {
        return false;
    };
    let state = flow.state.get();
    if state != state::WALKING && state != state::NOT_RTPS {
        return false;
    }
    // SAFETY: no preconditions. This clock is a few milliseconds slow, but cheap.
    let now = unsafe { bpf_ktime_get_coarse_ns() };
    if now.saturating_sub(flow.created_ns.get()) >= FLOW_LIFETIME_NANOSECONDS {
        return false;
    }
    if state == state::WALKING {
        let offset = trailing.offset;
        let (word, mask) = (hide_bounds(offset >> 9) & 127, 1_u64 << (offset >> 3 & 63));
        let Some(starts) = flow.seen_offsets.get(word as usize) else {
            return false;
        };
        let before = starts.get();
        // The last fragment has not arrived, so that the datagram is not complete now.
        if before & mask != 0 || flow.total_bytes.get() != 0 {
            return false;
        }
        let start = offset - 8;
        let base = trailing.payload_offset.wrapping_sub(start);
        if !continue_record(skb, flow, base, start, start + trailing.len) {
            return false;
        }
        starts.set(before | mask);
        flow.received_bytes
            .set(flow.received_bytes.get() + trailing.len);
    }
    count(slot, Counter::Frames, 1);
    count(slot, Counter::Fragments, 1);
    true
}

/// Extends the flow's record by the submessages of a fragment, the bytes from `start` to `end` of the
/// UDP payload. Returns `false` if the fragment has others too; the walk then continues at the first
/// of them.
#[inline(always)]
fn continue_record(skb: *mut __sk_buff, flow: &Flow, base: u32, start: u32, end: u32) -> bool {
    let mut next = flow.walk_offset.get();
    if next >= end {
        return true;
    }
    if next < start || flow.may_continue.get() == 0 || flow.has_pending_record.get() == 0 {
        return false;
    }
    let (record, walk) = (flow.pending_record.as_ptr(), flow.walk.as_ptr());
    // SAFETY: the entry of a map, whose memory stays valid. Fragments of one datagram that arrive on
    // two CPUs may miscount it.
    let (record, len) = unsafe { (&mut *record, (*walk).datagram_len) };
    let mut submessages = 0;
    while submessages < MAX_CONTINUED && next < end {
        let payload = Payload { skb, base };
        let after = walk::continue_fragments(record, &payload, next, (end, len));
        if after == 0 {
            break;
        }
        next = after;
        submessages += 1;
    }
    let is_walk_complete = next + 4 > len;
    flow.walk_offset
        .set(if is_walk_complete { u32::MAX } else { next });
    // SAFETY: as above.
    unsafe { (*walk).offset = next };
    is_walk_complete || next >= end
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
        interface: packet.interface | packet.is_outgoing << 31,
    };
    // SAFETY: the memory of an LRU entry stays valid when the entry is reused for another key.
    if let Some(flow) = unsafe { FLOWS.get(key) } {
        let reused = flow.state.get() == state::COMPLETE && packet.fragment_offset == 0;
        if !reused && packet.time_ns.wrapping_sub(flow.created_ns.get()) < FLOW_LIFETIME_NANOSECONDS
        {
            return Some(flow);
        }
    }
    if packet.fragment_offset != 0 {
        count(slot, Counter::FragmentsWithoutFlow, 1);
    }
    FLOWS.insert(key, NEW_FLOW.get(0)?, 0).ok()?;
    // SAFETY: as above.
    let flow = unsafe { FLOWS.get(key) }?;
    flow.created_ns.set(packet.time_ns);
    flow.token.set(packet.time_ns as u32 | 1);
    Some(flow)
}

/// Handles the fragment with the UDP header.
#[inline(always)]
fn process_first_fragment(
    skb: *mut __sk_buff,
    slot: u32,
    mut scratch: ScratchRef<Scratch>,
    flow: &Flow,
) -> u32 {
    if verdict::start_walk(skb, slot, scratch.get()).is_none() {
        flow.state.set(state::NOT_RTPS);
        return 0;
    }
    let current = scratch.get();
    current.walk.record.datagram = flow.token.get();
    // Fragments that arrived before the first one were captured within the budget, so the others
    // are captured, too.
    let is_first_to_arrive = flow.received_bytes.get() == current.packet.len;
    let (base, available_len) = (current.packet.payload_offset + 8, current.packet.len - 8);
    let result = if is_first_to_arrive {
        verdict::walk_frame(skb, base, available_len, slot)
    } else {
        progress::CAPTURE
    };
    if result >= progress::CAPTURE {
        // This includes a split header: user space reads the datagram from its start.
        flow.state.set(state::CAPTURED);
        verdict::count_capture(slot, scratch.get());
        return 1;
    }
    flow.state.set(state::WALKING);
    save_walk(slot, scratch, flow);
    0
}

/// Handles any fragment but the first.
#[inline(always)]
fn process_later_fragment(
    skb: *mut __sk_buff,
    slot: u32,
    mut scratch: ScratchRef<Scratch>,
    flow: &Flow,
) -> u32 {
    let current = scratch.get();
    let state = flow.state.get();
    if state == state::NO_FIRST_FRAGMENT {
        // Trailing fragments of unknown datagrams must not fill the packet ring.
        return u32::from(verdict::charge_capture_budget(current.packet.len));
    }
    if state != state::WALKING {
        return 1;
    }
    // Offset in the UDP payload, which begins 8 bytes into the IP payload.
    let start = current.packet.fragment_offset - 8;
    let end = start + current.packet.len;
    let next = flow.walk_offset.get();
    if next >= end {
        return 0;
    }
    current.record_count = 0;
    current.is_unknown_writer = 0;
    let base = current.packet.payload_offset.wrapping_sub(start);
    if continue_record(skb, flow, base, start, end) {
        return 0;
    }
    flow.walk.load(&mut current.walk);
    let next = flow.walk_offset.get();
    // The walk continues in a fragment that has not arrived yet: this one is out of order.
    let result = if next < start {
        progress::SPLIT
    } else {
        verdict::walk_frame(skb, base, end, slot)
    };
    save_walk(slot, scratch, flow);
    if result < progress::CAPTURE {
        return 0;
    }
    write_handover(slot, scratch.get(), flow);
    verdict::count_capture(slot, scratch.get());
    1
}

/// Writes the records found so far, except the last one, and stores the walk's state.
#[inline(always)]
fn save_walk(slot: u32, mut scratch: ScratchRef<Scratch>, flow: &Flow) {
    let current = scratch.get();
    let record_count = current.record_count;
    flow.walk.store(&current.walk);
    let next = current.walk.offset;
    let is_walk_complete = next + 4 > current.walk.datagram_len;
    flow.walk_offset
        .set(if is_walk_complete { u32::MAX } else { next });
    // The receiver state may have changed after the pending record.
    flow.may_continue.set(0);
    if record_count == 0 {
        return;
    }
    write_pending_record(slot, current, flow);
    if record_count > 1 {
        verdict::write_records(record_count - 1, u32::from(flag::AHEAD), slot);
        flow.ahead.set(1);
    }
    let current = scratch.get();
    if let Some(last) = current.records.get(record_count as usize - 1) {
        // Each submessage of a writer that is not classified is charged to its budget.
        let may_continue =
            current.last_endpoint_is_classified != 0 && walk::may_continue(&current.walk, last);
        flow.may_continue.set(u32::from(may_continue));
        flow.pending_record.store(last);
        flow.has_pending_record.set(1);
    }
}

#[inline(always)]
fn write_pending_record(slot: u32, scratch: &mut Scratch, flow: &Flow) {
    if flow.has_pending_record.get() != 0 {
        flow.has_pending_record.set(0);
        flow.ahead.set(1);
        flow.pending_record.load(&mut scratch.pending_record);
        scratch.pending_record.flags |= flag::AHEAD;
        runs::write_or_merge(slot, &scratch.pending_record, false);
    }
}

/// Writes a HANDOVER record with the walk's state for user space.
#[inline(always)]
fn write_handover(slot: u32, scratch: &mut Scratch, flow: &Flow) {
    write_pending_record(slot, scratch, flow);
    flow.state.set(state::HANDED_OVER);
    flow.ahead.set(1);
    let (walk, packet, record) = (&scratch.walk, &scratch.packet, &mut scratch.pending_record);
    copy(&walk.record, record);
    record.time = packet.time_ns;
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
    verdict::write_record(slot, record);
    flow.pending_record.store(record);
}

/// Writes the last record after all fragments have arrived.
#[inline(always)]
fn complete_datagram(slot: u32, scratch: &mut Scratch, flow: &Flow) {
    let state = flow.state.get();
    let (was_walked, handed_over) = (state == state::WALKING, state == state::HANDED_OVER);
    flow.state.set(state::COMPLETE);
    if !was_walked && !handed_over {
        return;
    }
    let (pending, ahead) = (flow.has_pending_record.get() != 0, flow.ahead.get() != 0);
    let metered = pending || ahead;
    if was_walked {
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
    let record = &mut scratch.pending_record;
    flow.pending_record.load(record);
    if !pending {
        // All records were written ahead. This record marks them as valid.
        record.kind = kind::COMPLETE;
        record.datagram = flow.token.get();
        record.flags &= !flag::AHEAD;
    }
    flow.has_pending_record.set(0);
    record.time = scratch.packet.time_ns;
    // After records written ahead, this record completes the datagram.
    runs::write_or_merge(slot, record, !ahead);
}
