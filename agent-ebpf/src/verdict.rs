//! The three verdicts on a datagram: ignore, meter, capture.

use aya_ebpf::{bindings::__sk_buff, helpers::bpf_ktime_get_ns};
use ros2probe_wire::{
    filter::{Budget, Counter, UNKNOWN_CAPTURE_BYTES},
    record::{Record, Verdict, flag, kind},
    walk::{self, Fate, MAGIC, Step},
};

use crate::{
    host,
    instructions::opaque,
    maps::{
        BUDGET, INTEREST, PARTICIPANTS, RECORDS, RECORDS_PER_DATAGRAM, Scratch, Shared, UNKNOWN,
        WAKE_BYTES, copy, count, count_outside, scratch,
    },
    packet::{Payload, load},
    runs,
    settings::setting,
    zenoh,
};

/// Maximum number of submessages that one run of the program reads; a datagram with more is
/// captured.
const SUBMESSAGES: u32 = 64;
/// Minimum interval between two notes of a participant's time. Leases last seconds.
const HEARD_NANOSECONDS: u64 = 10_000_000;
/// `BPF_RB_NO_WAKEUP`, `BPF_RB_FORCE_WAKEUP`, `BPF_RB_AVAIL_DATA`.
pub const NO_WAKEUP: u64 = 1;
pub const FORCE_WAKEUP: u64 = 2;
pub const AVAILABLE_DATA: u64 = 0;

/// Results of [`advance`]. The values are `u32`, because functions of BPF take and return integers.
pub mod progress {
    /// More submessages may follow in this frame.
    pub const ON: u32 = 0;
    /// No more submessages can be read in this frame.
    pub const STOP: u32 = 1;
    /// User space must read the datagram.
    pub const CAPTURE: u32 = 2;
    /// The submessage continues in a later fragment: user space must read it.
    pub const SPLIT: u32 = 3;
}

/// Handles a datagram in one frame; returns 1 to keep the frame.
#[unsafe(no_mangle)]
#[inline(never)]
pub extern "C" fn whole(skb: *mut __sk_buff, slot: u32) -> u32 {
    let Some(mut scratch) = scratch(slot) else {
        return 0;
    };
    if begin(skb, slot, scratch.get()).is_none() {
        return zenoh::quic(skb, slot);
    }
    let begun = scratch.get();
    let (base, present) = (begun.packet.body + 8, begun.walk.datagram_len);
    if present + 8 > begun.packet.len {
        count(slot, Counter::Malformed, 1);
        return 0;
    }
    if run(skb, base, present, slot) >= progress::CAPTURE {
        captured(slot, scratch.get());
        return 1;
    }
    let records = scratch.get().count;
    count(
        slot,
        if records == 0 {
            Counter::Ignored
        } else {
            Counter::Metered
        },
        1,
    );
    flush(records, 0, slot);
    0
}

/// Walks the datagram again after the ring had no room for it, as if it were captured. Its
/// submessages of interest become records.
#[unsafe(no_mangle)]
#[inline(never)]
pub extern "C" fn meter(skb: *mut __sk_buff, slot: u32) -> u32 {
    let Some(mut scratch) = scratch(slot) else {
        return 0;
    };
    let begun = scratch.get();
    let base = begun.packet.body + 8;
    let Some([_magic, _version, source @ ..]): Option<[u32; 5]> = load(skb, base) else {
        return 0;
    };
    begun.count = 0;
    begun.unknown = 0;
    begun.repeated = 1;
    let len = begun.walk.datagram_len;
    begun.walk.begin(source, len);
    run(skb, base, len, slot);
    let records = scratch.get().count;
    flush(records, 0, slot);
    0
}

/// Reads the UDP and RTPS headers of the current packet and starts the walk; `None` if the packet
/// is not RTPS.
#[inline(always)]
pub fn begin(skb: *mut __sk_buff, slot: u32, scratch: &mut Scratch) -> Option<()> {
    let packet = &scratch.packet;
    if packet.len < 8 + walk::HEADER_LEN {
        return None;
    }
    let [ports, lengths, magic, _version, source @ ..]: [u32; 7] = load(skb, packet.body)?;
    if magic != MAGIC {
        return None;
    }
    count(slot, Counter::Messages, 1);
    let udp_len = u32::from_be(lengths) >> 16;
    if udp_len < 8 + walk::HEADER_LEN {
        count(slot, Counter::Malformed, 1);
        return None;
    }
    if packet.fragmented == 0 {
        // SAFETY: no preconditions.
        scratch.packet.now = unsafe { bpf_ktime_get_ns() };
    }
    let packet = &scratch.packet;
    let (now, destination, interface) = (packet.now, packet.destination, packet.interface);
    let flags = (if packet.fragmented != 0 {
        flag::FRAGMENTED
    } else {
        0
    }) | (if packet.outgoing != 0 {
        flag::OUTGOING
    } else {
        0
    }) | (if packet.ipv6 != 0 { flag::IPV6 } else { 0 })
        | (if packet.host != 0 { flag::HOST } else { 0 });
    scratch.count = 0;
    scratch.unknown = 0;
    scratch.repeated = 0;
    let (token, socket) = if packet.host != 0 {
        host::identify(skb, slot, &mut scratch.named)
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
    heard(scratch, source, now);
    Some(())
}

/// Notes the time of a participant's message if user space tracks the participant, at most every 10
/// ms.
#[inline(always)]
pub fn heard(scratch: &mut Scratch, source: [u32; 3], now: u64) {
    let same = scratch.heard[2] == source[2]
        && scratch.heard[1] == source[1]
        && scratch.heard[0] == source[0];
    if same && now.wrapping_sub(scratch.heard_at) < HEARD_NANOSECONDS {
        return;
    }
    if let Some(last) = PARTICIPANTS.get_ptr_mut(source) {
        // SAFETY: a map value pointer checked against null; racing writers store the same moment.
        unsafe { *last = now }
    }
    scratch.heard = source;
    scratch.heard_at = now;
}

/// Walks the submessages that begin before `present`; returns the [`progress`] of the last one that
/// was walked, or `CAPTURE` if there are too many.
#[inline(always)]
pub fn run(skb: *mut __sk_buff, base: u32, present: u32, slot: u32) -> u32 {
    let mut submessages = 0;
    while submessages < SUBMESSAGES {
        let result = advance(skb, base, present, slot);
        if result != progress::ON {
            return result;
        }
        submessages += 1;
    }
    progress::CAPTURE
}

/// Walks one submessage.
#[unsafe(no_mangle)]
#[inline(never)]
pub extern "C" fn advance(skb: *mut __sk_buff, base: u32, present: u32, slot: u32) -> u32 {
    let Some(mut scratch) = scratch(slot) else {
        return progress::STOP;
    };
    let scratch = scratch.get();
    let before = scratch.walk.offset;
    let result = match walk::step(&mut scratch.walk, &Payload { skb, base }, present) {
        Step::End | Step::Later => progress::STOP,
        Step::Passed => progress::ON,
        Step::Split => progress::SPLIT,
        Step::Malformed => {
            count(slot, Counter::Malformed, 1);
            progress::STOP
        }
        Step::Endpoint => endpoint(slot, scratch, false),
        Step::LongGap => endpoint(slot, scratch, true),
    };
    if result == progress::CAPTURE {
        // User space reads this submessage again.
        scratch.walk.offset = before;
    }
    result
}

/// Looks up the current submessage in the interest map.
#[inline(always)]
pub fn endpoint(slot: u32, scratch: &mut Scratch, long_gap: bool) -> u32 {
    if joins_last(scratch) {
        return progress::ON;
    }
    let (key, unknown_counts) = match walk::fate(&scratch.walk.record) {
        Fate::Ignore => return progress::ON,
        Fate::Capture if host::captured_before(slot, scratch) => return progress::ON,
        Fate::Capture => return progress::CAPTURE,
        Fate::Writer => (scratch.walk.record.writer, true),
        Fate::Reader => (scratch.walk.record.reader, false),
    };
    scratch.classified = 1;
    let meter = match INTEREST.get_ptr(key) {
        // SAFETY: a map value pointer checked against null.
        Some(verdict) => match unsafe { *verdict } {
            verdict if verdict == Verdict::Capture as u32 => {
                if !host::captured_before(slot, scratch) {
                    return progress::CAPTURE;
                }
                true
            }
            verdict => verdict == Verdict::Meter as u32,
        },
        None if unknown_counts => {
            scratch.classified = 0;
            match unknown(slot, scratch, key) {
                progress::CAPTURE => return progress::CAPTURE,
                admitted => admitted == progress::STOP,
            }
        }
        None => false,
    };
    if !meter {
        return progress::ON;
    }
    let index = scratch.count;
    if long_gap || index >= RECORDS_PER_DATAGRAM {
        return progress::CAPTURE;
    }
    if let Some(slot) = scratch.records.get_mut(index as usize) {
        copy(&scratch.walk.record, slot);
    }
    scratch.count = index + 1;
    progress::ON
}

/// Adds the current submessage to the last record if it holds the next fragments of the same
/// sample. Returns whether it holds them. Cyclone DDS sends ten DATA_FRAGs in a datagram.
#[inline(always)]
fn joins_last(scratch: &mut Scratch) -> bool {
    let record = &scratch.walk.record;
    if record.kind != kind::DATA_FRAG || scratch.count == 0 || scratch.classified == 0 {
        return false;
    }
    let index = opaque(scratch.count - 1) as usize & (RECORDS_PER_DATAGRAM as usize - 1);
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
/// budget, then `STOP` for one record, then `ON` for no record.
#[inline(always)]
fn unknown(slot: u32, scratch: &mut Scratch, key: [u32; 4]) -> u32 {
    let len = scratch.walk.datagram_len;
    // SAFETY: the memory of an LRU entry stays valid when the entry is reused for another key; two
    // writers then share one charge.
    let used = match unsafe { UNKNOWN.get(key) } {
        Some(used) => used,
        None => {
            let _ = UNKNOWN.insert(key, Shared::new(0), 0);
            // SAFETY: as above.
            match unsafe { UNKNOWN.get(key) } {
                Some(used) => used,
                None => return progress::ON,
            }
        }
    };
    let so_far = used.get();
    if so_far < UNKNOWN_CAPTURE_BYTES && !host::captured_before(slot, scratch) && charge(len) {
        used.set(so_far + len);
        scratch.unknown = 1;
        return progress::CAPTURE;
    }
    if spend(Budget::Records, 1) {
        count(slot, Counter::MeteredUnknown, 1);
        return progress::STOP;
    }
    count(slot, Counter::UnknownOverBudget, 1);
    progress::ON
}

/// Charges bytes of an unclassified writer to its own budget and to the common one; returns whether
/// any was left of both.
#[inline(always)]
pub fn charge_unknown(writer: &[u32; 4], len: u32) -> bool {
    // SAFETY: as in `unknown`.
    let used = match unsafe { UNKNOWN.get(writer) } {
        Some(used) => used,
        None => {
            let _ = UNKNOWN.insert(writer, Shared::new(0), 0);
            // SAFETY: as above.
            match unsafe { UNKNOWN.get(writer) } {
                Some(used) => used,
                None => return false,
            }
        }
    };
    let so_far = used.get();
    if so_far >= UNKNOWN_CAPTURE_BYTES || !charge(len) {
        return false;
    }
    used.set(so_far + len);
    true
}

/// Charges bytes of unclassified traffic to the capture budget; returns whether any budget was
/// left.
#[inline(always)]
pub fn charge(len: u32) -> bool {
    spend(Budget::CaptureBytes, len)
}

/// Charges a budget if any of it is left; returns whether any was left. The last charge may overdraw
/// the budget, and racing CPUs may lose a charge.
#[inline(always)]
pub fn spend(budget: Budget, amount: u32) -> bool {
    let Some(budget) = BUDGET.get(budget as u32) else {
        return false;
    };
    let left = budget.get();
    if left > 0 {
        budget.set(left - i64::from(amount));
    }
    left > 0
}

/// Counts a captured datagram.
#[inline(always)]
pub fn captured(slot: u32, scratch: &Scratch) {
    count(slot, Counter::Captured, 1);
    if scratch.unknown != 0 {
        count(slot, Counter::CapturedUnknown, 1);
    }
}

/// Writes the first `records` scratch records, adding `flags` to each.
#[unsafe(no_mangle)]
#[inline(never)]
pub extern "C" fn flush(records: u32, flags: u32, slot: u32) -> u32 {
    let mut index = 0;
    while index < RECORDS_PER_DATAGRAM {
        if index >= records {
            break;
        }
        flush_one(index, flags, slot);
        index += 1;
    }
    0
}

/// Writes one scratch record. The function is separate, so that the verifier checks it once and not
/// in a loop.
#[unsafe(no_mangle)]
#[inline(never)]
pub extern "C" fn flush_one(index: u32, flags: u32, slot: u32) -> u32 {
    let index = opaque(index) as usize & (RECORDS_PER_DATAGRAM as usize - 1);
    if let Some(mut scratch) = scratch(slot)
        && let Some(record) = scratch.get().records.get_mut(index)
    {
        record.flags |= flags as u16;
        runs::give(slot, record, flags & u32::from(flag::AHEAD) == 0);
    }
    0
}

/// Writes one record; wakes user space only when the ring fills up.
#[inline(always)]
pub fn write(slot: u32, record: &Record) {
    count(slot, output(record), 1);
}

/// Writes a record as [`write`] does, outside of slots.
#[inline(always)]
pub fn write_outside(record: &Record) {
    count_outside(output(record), 1);
}

#[inline(always)]
fn output(record: &Record) -> Counter {
    let wake = if RECORDS.query(AVAILABLE_DATA) > setting(&WAKE_BYTES) {
        FORCE_WAKEUP
    } else {
        NO_WAKEUP
    };
    if RECORDS.output::<Record>(record, wake).is_ok() {
        Counter::Records
    } else {
        Counter::RecordsLost
    }
}
