//! The three verdicts on a datagram: ignore, meter, capture.

use aya_ebpf::{bindings::__sk_buff, helpers::bpf_ktime_get_ns};
use ros2probe_wire::{
    filter::{Budget, Counter, UNKNOWN_CAPTURE_BYTES},
    record::{Record, Verdict, flag, kind},
    walk::{self, Fate, MAGIC, Step},
};

use crate::{
    host,
    instructions::hide_bounds,
    maps::{
        BUDGET, INTEREST, PARTICIPANTS, RECORDS, RECORDS_PER_DATAGRAM, Scratch, Shared, UNKNOWN,
        WAKE_BYTES, copy, count, count_without_slot, scratch,
    },
    packet::{Payload, load_bytes},
    runs,
    settings::read_global,
    zenoh,
};

/// Maximum number of submessages that one run of the program reads; a datagram with more is
/// captured.
const MAX_SUBMESSAGES: u32 = 64;
/// Minimum interval between two notes of a participant's time. Leases last seconds.
const LAST_SEEN_INTERVAL_NS: u64 = 10_000_000;
/// `BPF_RB_NO_WAKEUP`, `BPF_RB_FORCE_WAKEUP`, `BPF_RB_AVAIL_DATA`.
pub const NO_WAKEUP: u64 = 1;
pub const FORCE_WAKEUP: u64 = 2;
pub const RING_AVAIL_DATA: u64 = 0;

/// Results of [`walk_submessage`]. The values are `u32`, because functions of BPF take and return
/// integers.
pub mod progress {
    /// More submessages may follow in this frame.
    pub const CONTINUE: u32 = 0;
    /// No more submessages can be read in this frame.
    pub const FRAME_DONE: u32 = 1;
    /// User space must read the datagram.
    pub const CAPTURE: u32 = 2;
    /// The submessage continues in a later fragment: user space must read it.
    pub const SPLIT: u32 = 3;
}

/// Handles a datagram in one frame; returns 1 to keep the frame.
#[unsafe(no_mangle)]
#[inline(never)]
pub extern "C" fn decide_datagram(skb: *mut __sk_buff, slot: u32) -> u32 {
    let Some(mut scratch) = scratch(slot) else {
        return 0;
    };
    if start_walk(skb, slot, scratch.get()).is_none() {
        return zenoh::quic(skb, slot);
    }
    let current = scratch.get();
    let (base, available_len) = (current.packet.payload_offset + 8, current.walk.datagram_len);
    if available_len + 8 > current.packet.len {
        count(slot, Counter::Malformed, 1);
        return 0;
    }
    if walk_frame(skb, base, available_len, slot) >= progress::CAPTURE {
        count_capture(slot, scratch.get());
        return 1;
    }
    let records = scratch.get().record_count;
    count(
        slot,
        if records == 0 {
            Counter::Ignored
        } else {
            Counter::Metered
        },
        1,
    );
    write_records(records, 0, slot);
    0
}

/// Walks the datagram again after the ring had no room for it, as if it were captured. Its
/// submessages of interest become records.
#[unsafe(no_mangle)]
#[inline(never)]
pub extern "C" fn meter_datagram(skb: *mut __sk_buff, slot: u32) -> u32 {
    let Some(mut scratch) = scratch(slot) else {
        return 0;
    };
    let current = scratch.get();
    let base = current.packet.payload_offset + 8;
    let Some([_magic, _version, source @ ..]): Option<[u32; 5]> = load_bytes(skb, base) else {
        return 0;
    };
    current.record_count = 0;
    current.is_unknown_writer = 0;
    current.is_duplicate = 1;
    let len = current.walk.datagram_len;
    current.walk.begin(source, len);
    walk_frame(skb, base, len, slot);
    let records = scratch.get().record_count;
    write_records(records, 0, slot);
    0
}

/// Reads the UDP and RTPS headers of the current packet and starts the walk; `None` if the packet
/// is not RTPS.
#[inline(always)]
pub fn start_walk(skb: *mut __sk_buff, slot: u32, scratch: &mut Scratch) -> Option<()> {
    let packet = &scratch.packet;
    if packet.len < 8 + walk::HEADER_LEN {
        return None;
    }
    let [ports, lengths, magic, _version, source @ ..]: [u32; 7] =
        load_bytes(skb, packet.payload_offset)?;
    if magic != MAGIC {
        return None;
    }
    count(slot, Counter::Messages, 1);
    let udp_len = u32::from_be(lengths) >> 16;
    if udp_len < 8 + walk::HEADER_LEN {
        count(slot, Counter::Malformed, 1);
        return None;
    }
    if packet.is_fragment == 0 {
        // SAFETY: no preconditions.
        scratch.packet.time_ns = unsafe { bpf_ktime_get_ns() };
    }
    let packet = &scratch.packet;
    let (now, destination, interface) = (packet.time_ns, packet.destination, packet.interface);
    let flags = (if packet.is_fragment != 0 {
        flag::FRAGMENTED
    } else {
        0
    }) | (if packet.is_outgoing != 0 {
        flag::OUTGOING
    } else {
        0
    }) | (if packet.is_ipv6 != 0 { flag::IPV6 } else { 0 })
        | (if packet.is_at_socket != 0 {
            flag::HOST
        } else {
            0
        });
    scratch.record_count = 0;
    scratch.is_unknown_writer = 0;
    scratch.is_duplicate = 0;
    let (token, socket) = if packet.is_at_socket != 0 {
        host::assign_token(skb, slot, &mut scratch.token_count)
    } else {
        (0, 0)
    };
    let record = &mut scratch.walk.record;
    record.time = now;
    record.destination = destination;
    record.destination_port = (u32::from_be(ports) & 0xffff) as u16;
    record.source_port = (u32::from_be(ports) >> 16) as u16;
    record.interface = interface;
    record.datagram = token;
    record.socket = socket;
    record.elapsed = 0;
    record.unused = 0;
    record.flags = flags;
    scratch.walk.begin(source, udp_len - 8);
    note_participant_seen(scratch, source, now);
    Some(())
}

/// Notes the time of a participant's message if user space tracks the participant, at most every 10
/// ms.
#[inline(always)]
pub fn note_participant_seen(scratch: &mut Scratch, source: [u32; 3], now: u64) {
    let same = scratch.last_participant[2] == source[2]
        && scratch.last_participant[1] == source[1]
        && scratch.last_participant[0] == source[0];
    if same && now.wrapping_sub(scratch.last_participant_ns) < LAST_SEEN_INTERVAL_NS {
        return;
    }
    if let Some(last) = PARTICIPANTS.get_ptr_mut(source) {
        // SAFETY: a map value pointer checked against null; racing writers store the same moment.
        unsafe { *last = now }
    }
    scratch.last_participant = source;
    scratch.last_participant_ns = now;
}

/// Walks the submessages that begin before `available_len`; returns the [`progress`] of the last
/// one that was walked, or `CAPTURE` if there are too many.
#[inline(always)]
pub fn walk_frame(skb: *mut __sk_buff, base: u32, available_len: u32, slot: u32) -> u32 {
    let mut submessages = 0;
    while submessages < MAX_SUBMESSAGES {
        let result = walk_submessage(skb, base, available_len, slot);
        if result != progress::CONTINUE {
            return result;
        }
        submessages += 1;
    }
    progress::CAPTURE
}

/// Walks one submessage.
#[unsafe(no_mangle)]
#[inline(never)]
pub extern "C" fn walk_submessage(
    skb: *mut __sk_buff,
    base: u32,
    available_len: u32,
    slot: u32,
) -> u32 {
    let Some(mut scratch) = scratch(slot) else {
        return progress::FRAME_DONE;
    };
    let scratch = scratch.get();
    let submessage_offset = scratch.walk.offset;
    let result = match walk::step(&mut scratch.walk, &Payload { skb, base }, available_len) {
        Step::End | Step::Later => progress::FRAME_DONE,
        Step::Passed => progress::CONTINUE,
        Step::Split => progress::SPLIT,
        Step::Malformed => {
            count(slot, Counter::Malformed, 1);
            progress::FRAME_DONE
        }
        Step::Endpoint => apply_verdict(slot, scratch, false),
        Step::LongGap => apply_verdict(slot, scratch, true),
    };
    if result == progress::CAPTURE {
        // User space reads this submessage again.
        scratch.walk.offset = submessage_offset;
    }
    result
}

/// Looks up the current submessage in the interest map.
#[inline(always)]
pub fn apply_verdict(slot: u32, scratch: &mut Scratch, long_gap: bool) -> u32 {
    if merge_into_last_record(scratch) {
        return progress::CONTINUE;
    }
    let (key, is_writer) = match walk::fate(&scratch.walk.record) {
        Fate::Ignore => return progress::CONTINUE,
        Fate::Capture if host::is_duplicate_capture(slot, scratch) => return progress::CONTINUE,
        Fate::Capture => return progress::CAPTURE,
        Fate::Writer => (scratch.walk.record.writer, true),
        Fate::Reader => (scratch.walk.record.reader, false),
    };
    scratch.last_endpoint_is_classified = 1;
    let meter = match INTEREST.get_ptr(key) {
        // SAFETY: a map value pointer checked against null.
        Some(verdict) => match unsafe { *verdict } {
            verdict if verdict == Verdict::Capture as u32 => {
                if !host::is_duplicate_capture(slot, scratch) {
                    return progress::CAPTURE;
                }
                true
            }
            verdict => verdict == Verdict::Meter as u32,
        },
        None if is_writer => {
            scratch.last_endpoint_is_classified = 0;
            match charge_unknown_submessage(slot, scratch, key) {
                progress::CAPTURE => return progress::CAPTURE,
                admitted => admitted == progress::FRAME_DONE,
            }
        }
        None => false,
    };
    if !meter {
        return progress::CONTINUE;
    }
    let index = scratch.record_count;
    if long_gap || index >= RECORDS_PER_DATAGRAM {
        return progress::CAPTURE;
    }
    if let Some(slot) = scratch.records.get_mut(index as usize) {
        copy(&scratch.walk.record, slot);
    }
    scratch.record_count = index + 1;
    progress::CONTINUE
}

/// Adds the current submessage to the last record if it holds the next fragments of the same
/// sample. Returns whether it holds them. Cyclone DDS sends ten DATA_FRAGs in a datagram.
#[inline(always)]
fn merge_into_last_record(scratch: &mut Scratch) -> bool {
    let record = &scratch.walk.record;
    if record.kind != kind::DATA_FRAG
        || scratch.record_count == 0
        || scratch.last_endpoint_is_classified == 0
    {
        return false;
    }
    let index =
        hide_bounds(scratch.record_count - 1) as usize & (RECORDS_PER_DATAGRAM as usize - 1);
    let Some(last) = scratch.records.get_mut(index) else {
        return false;
    };
    last.kind == kind::DATA_FRAG
        && last.writer[3] == record.writer[3]
        && last.writer[2] == record.writer[2]
        && last.writer[1] == record.writer[1]
        && last.writer[0] == record.writer[0]
        && last.extend(record)
}

/// Handles a writer that user space has not classified. Returns `CAPTURE` within the writer's
/// budget, then `FRAME_DONE` for one record, then `CONTINUE` for no record.
#[inline(always)]
fn charge_unknown_submessage(slot: u32, scratch: &mut Scratch, key: [u32; 4]) -> u32 {
    let len = scratch.walk.datagram_len;
    // SAFETY: the memory of an LRU entry stays valid when the entry is reused for another key; two
    // writers then share one charge.
    let charged = match unsafe { UNKNOWN.get(key) } {
        Some(charged) => charged,
        None => {
            let _ = UNKNOWN.insert(key, Shared::new(0), 0);
            // SAFETY: as above.
            match unsafe { UNKNOWN.get(key) } {
                Some(charged) => charged,
                None => return progress::CONTINUE,
            }
        }
    };
    let charged_bytes = charged.get();
    if charged_bytes < UNKNOWN_CAPTURE_BYTES
        && !host::is_duplicate_capture(slot, scratch)
        && charge_capture_budget(len)
    {
        charged.set(charged_bytes + len);
        scratch.is_unknown_writer = 1;
        return progress::CAPTURE;
    }
    if try_spend(Budget::Records, 1) {
        count(slot, Counter::MeteredUnknown, 1);
        return progress::FRAME_DONE;
    }
    count(slot, Counter::UnknownOverBudget, 1);
    progress::CONTINUE
}

/// Charges bytes of an unclassified writer to its own budget and to the common one; returns whether
/// any was left of both.
#[inline(always)]
pub fn charge_unknown_writer(writer: &[u32; 4], len: u32) -> bool {
    // SAFETY: as in `charge_unknown_submessage`.
    let charged = match unsafe { UNKNOWN.get(writer) } {
        Some(charged) => charged,
        None => {
            let _ = UNKNOWN.insert(writer, Shared::new(0), 0);
            // SAFETY: as above.
            match unsafe { UNKNOWN.get(writer) } {
                Some(charged) => charged,
                None => return false,
            }
        }
    };
    let charged_bytes = charged.get();
    if charged_bytes >= UNKNOWN_CAPTURE_BYTES || !charge_capture_budget(len) {
        return false;
    }
    charged.set(charged_bytes + len);
    true
}

/// Charges bytes of unclassified traffic to the capture budget; returns whether any budget was
/// left.
#[inline(always)]
pub fn charge_capture_budget(len: u32) -> bool {
    try_spend(Budget::CaptureBytes, len)
}

/// Charges a budget if any of it is left; returns whether any was left. The last charge may
/// overdraw the budget, and racing CPUs may lose a charge.
#[inline(always)]
pub fn try_spend(budget: Budget, amount: u32) -> bool {
    let Some(budget) = BUDGET.get(budget as u32) else {
        return false;
    };
    let remaining = budget.get();
    if remaining > 0 {
        budget.set(remaining - i64::from(amount));
    }
    remaining > 0
}

/// Counts a captured datagram.
#[inline(always)]
pub fn count_capture(slot: u32, scratch: &Scratch) {
    count(slot, Counter::Captured, 1);
    if scratch.is_unknown_writer != 0 {
        count(slot, Counter::CapturedUnknown, 1);
    }
}

/// Writes the first `records` scratch records, adding `flags` to each.
#[unsafe(no_mangle)]
#[inline(never)]
pub extern "C" fn write_records(records: u32, flags: u32, slot: u32) -> u32 {
    let mut index = 0;
    while index < RECORDS_PER_DATAGRAM {
        if index >= records {
            break;
        }
        write_record_at(index, flags, slot);
        index += 1;
    }
    0
}

/// Writes one scratch record. The function is separate, so that the verifier checks it once and not
/// in a loop.
#[unsafe(no_mangle)]
#[inline(never)]
pub extern "C" fn write_record_at(index: u32, flags: u32, slot: u32) -> u32 {
    let index = hide_bounds(index) as usize & (RECORDS_PER_DATAGRAM as usize - 1);
    if let Some(mut scratch) = scratch(slot)
        && let Some(record) = scratch.get().records.get_mut(index)
    {
        record.flags |= flags as u16;
        runs::write_or_merge(slot, record, flags & u32::from(flag::AHEAD) == 0);
    }
    0
}

/// Writes one record; wakes user space only when the ring fills up.
#[inline(always)]
pub fn write_record(slot: u32, record: &Record) {
    count(slot, push_record(record), 1);
}

/// Writes a record as [`write_record`] does, outside of slots.
#[inline(always)]
pub fn write_record_without_slot(record: &Record) {
    count_without_slot(push_record(record), 1);
}

#[inline(always)]
fn push_record(record: &Record) -> Counter {
    let wakeup_flag = if RECORDS.query(RING_AVAIL_DATA) > read_global(&WAKE_BYTES) {
        FORCE_WAKEUP
    } else {
        NO_WAKEUP
    };
    if RECORDS.output::<Record>(record, wakeup_flag).is_ok() {
        Counter::Records
    } else {
        Counter::RecordsLost
    }
}
