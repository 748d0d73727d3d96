//! Datagrams that never became complete: the kernel timed out waiting for IP fragments, or had no
//! memory for them.
//!
//! The programs run for every packet that the kernel drops. They read the reason, and the packet
//! only if the reason does not rule out a fragment. The first fragment of an incomplete datagram
//! identifies the lost samples. Without it, or if its first bytes are not in the linear part of the
//! buffer (some network drivers), the datagram is only counted.
//!
//! Lack of memory has no drop reason of its own. A first fragment dropped without a reason counts
//! as refused if its network namespace has used up its memory for fragments. Before Linux 6.2 the
//! timeout has no reason either, so any dropped first fragment counts.

use aya_ebpf::{
    helpers::bpf_ktime_get_ns, macros::map, maps::PerCpuArray, programs::RawTracePointContext,
};
use ros2probe_wire::{
    filter::{Budget, Counter},
    host::Layout,
    record::{Record, Verdict, flag},
    walk::{self, Fate, MAGIC, Step, Walk},
};

use crate::{
    instructions::atomic_add,
    kernel_memory::{layout_entry, read_kernel, read_member},
    maps::{INTEREST, ScratchRef, copy, count_without_slot},
    packet::IPV4_MAPPED,
    verdict::{try_spend, write_record_without_slot},
};

const UDP: u32 = 17;
/// Extension header numbers of IPv6 (RFC 8200).
const HOP_BY_HOP: u32 = 0;
const ROUTING: u32 = 43;
const FRAGMENT: u32 = 44;
const DESTINATION_OPTIONS: u32 = 60;
/// Maximum number of submessages that are read from a first fragment.
const MAX_SUBMESSAGES: u32 = 64;

/// Working memory. The kernel drops fragments with bottom halves disabled, one after the other.
/// Such a drop may interrupt the drop of another packet.
#[map]
static INCOMPLETE: PerCpuArray<DroppedFragment> = PerCpuArray::with_max_entries(1, 0);

#[repr(C)]
struct DroppedFragment {
    walk: Walk,
    /// The record to write.
    record: Record,
    /// Source, destination and identification of the current datagram.
    datagram_key: [u32; 9],
    /// `datagram_key` of the previous datagram, because the fragments of a datagram are dropped one
    /// after the other.
    previous_key: [u32; 9],
    ipv6: u32,
    /// Offset of the fragment; 0 for a datagram's first one.
    offset: u32,
    /// The fragment header's next header, or the IPv4 protocol.
    protocol: u32,
    /// 1 = more fragments follow.
    more_fragments: u32,
    /// Address of the IP payload.
    payload_address: u64,
    /// Number of runs that use this entry, or have failed to claim it and not withdrawn yet.
    claim_count: u64,
}

#[inline(always)]
fn current_drop() -> Option<ScratchRef<DroppedFragment>> {
    ScratchRef::lookup(&INCOMPLETE, 0)
}

/// The linear part of a buffer, beginning at the UDP payload.
struct LinearData {
    address: u64,
    len: u32,
}

impl walk::Bytes for LinearData {
    #[inline(always)]
    fn words<const N: usize>(&self, offset: u32) -> Option<[u32; N]> {
        if offset + 4 * N as u32 > self.len {
            return None;
        }
        read_kernel(self.address + u64::from(offset))
    }
}

/// Why a packet was dropped.
#[derive(Clone, Copy, PartialEq, Eq)]
enum DropReason {
    /// The reassembly failed: fragments were missing at the timeout, or too many other datagrams
    /// arrived in between (`FRAG_TOO_FAR`).
    ReassemblyFailed,
    /// Another reason, or an unspecified one.
    Other,
    /// The kernel reports no reason.
    NotReported,
}

/// `kfree_skb(skb, location, reason)`.
#[inline(always)]
pub fn on_kfree_skb(context: &RawTracePointContext) {
    let reason: u64 = context.arg(2);
    let reason = reason as u32;
    let reason = if reason == layout_entry(Layout::ReasonTimeout)
        || reason == layout_entry(Layout::ReasonTooFar)
    {
        DropReason::ReassemblyFailed
    } else if reason != layout_entry(Layout::ReasonNone) {
        return;
    } else if layout_entry(Layout::ReasonTimeout) == Layout::ABSENT {
        DropReason::NotReported
    } else {
        DropReason::Other
    };
    process_drop(context.arg(0), reason);
}

/// `kfree_skb(skb, location)`.
#[inline(always)]
pub fn on_kfree_skb_no_reason(context: &RawTracePointContext) {
    process_drop(context.arg(0), DropReason::NotReported);
}

#[inline(always)]
fn process_drop(skb: u64, reason: DropReason) {
    let Some(this) = INCOMPLETE.get_ptr_mut(0) else {
        return;
    };
    // SAFETY: a map value pointer checked against null.
    let claim_count = unsafe { &raw mut (*this).claim_count };
    atomic_add(claim_count, 1);
    // SAFETY: a field of a map value; see `maps::claim_slot`.
    if unsafe { core::ptr::read_volatile(claim_count) } == 1 {
        let _ = process_dropped_fragment(skb, reason);
    } else {
        count_without_slot(Counter::Contended, 1);
    }
    atomic_add(claim_count, u64::MAX);
}

#[inline(always)]
fn process_dropped_fragment(skb: u64, reason: DropReason) -> Option<()> {
    let mut working = current_drop()?;
    let this = working.get();
    let head: u64 = read_member(skb, Layout::BufferHead)?;
    let tail: u32 = read_member(skb, Layout::BufferTail)?;
    let network: u16 = read_member(skb, Layout::BufferNetworkHeader)?;
    let ip = head + u64::from(network);
    let [first]: [u8; 1] = read_kernel(ip)?;
    let parsed = match first >> 4 {
        4 => ipv4(ip, this),
        6 => ipv6(ip, this),
        _ => None,
    };
    if parsed.is_none() || this.protocol != UDP {
        return None;
    }
    // Reassembly clears the flag for more fragments, so a datagram that was complete is not counted
    // here.
    if reason != DropReason::ReassemblyFailed && (this.offset != 0 || this.more_fragments == 0) {
        return None;
    }
    if reason == DropReason::Other && !is_fragment_memory_exhausted(skb, this.ipv6 != 0)? {
        return None;
    }
    let is_same_datagram = is_same_datagram(this);
    if this.offset != 0 {
        // If `is_same_datagram` is set, an earlier fragment of the same datagram was dropped and
        // counted.
        if !is_same_datagram {
            count_without_slot(Counter::NotReassembledUnnamed, 1);
        }
        return None;
    }
    let linear_len = (head + u64::from(tail)).wrapping_sub(this.payload_address + 8) as u32;
    if linear_len > 0xffff || linear_len < walk::HEADER_LEN {
        count_without_slot(Counter::NotReassembledUnnamed, 1);
        return None;
    }
    let [ports, lengths, magic, _version, source @ ..]: [u32; 7] =
        read_kernel(this.payload_address)?;
    if magic != MAGIC {
        return None;
    }
    let udp_len = u32::from_be(lengths) >> 16;
    if udp_len < 8 + walk::HEADER_LEN {
        return None;
    }
    count_without_slot(Counter::NotReassembled, 1);
    let zero = core::hint::black_box(0);
    let interface = read_member(skb, Layout::BufferInterface)?;
    let destination = [
        this.datagram_key[4],
        this.datagram_key[5],
        this.datagram_key[6],
        this.datagram_key[7],
    ];
    let record = &mut this.walk.record;
    // SAFETY: no preconditions.
    record.time = unsafe { bpf_ktime_get_ns() };
    record.destination = destination;
    record.destination_port = (u32::from_be(ports) & 0xffff) as u16;
    record.source_port = (u32::from_be(ports) >> 16) as u16;
    record.interface = interface;
    record.datagram = zero;
    record.socket = u64::from(zero);
    record.elapsed = zero;
    record.unused = zero as u16;
    record.flags = flag::FRAGMENTED | if this.ipv6 != 0 { flag::IPV6 } else { 0 };
    this.walk.begin(source, udp_len - 8);
    let payload = this.payload_address + 8;
    let mut submessages = 0;
    while submessages < MAX_SUBMESSAGES {
        if report_lost_submessage(payload, linear_len) == 0 {
            break;
        }
        submessages += 1;
    }
    Some(())
}

/// Returns whether the namespace has no memory for further fragments. This is the kernel's own
/// condition, with a margin for changes since the kernel tested it. `None` if a kernel structure
/// cannot be read.
#[inline(always)]
fn is_fragment_memory_exhausted(skb: u64, ipv6: bool) -> Option<bool> {
    let device: u64 = read_member(skb, Layout::BufferDevice)?;
    let namespace: u64 = read_member(device, Layout::DeviceNamespace)?;
    let fragments: u64 = if ipv6 {
        read_member(namespace, Layout::NamespaceFragments6)?
    } else {
        read_member(namespace, Layout::NamespaceFragments4)?
    };
    let memory: u64 = read_member(fragments, Layout::FragmentsMemory)?;
    let limit: u64 = read_member(fragments, Layout::FragmentsLimit)?;
    Some(memory >= limit - (limit >> 4))
}

/// Returns whether the current fragment belongs to the previous fragment's datagram, and makes the
/// current datagram the previous one.
#[inline(always)]
fn is_same_datagram(this: &mut DroppedFragment) -> bool {
    // The words are compared one by one, because a comparison of arrays would become a call of
    // `memcmp`.
    let mut difference = 0;
    let mut index = 0;
    while index < this.datagram_key.len() {
        difference |= this.datagram_key[index] ^ this.previous_key[index];
        index += 1;
    }
    copy(&this.datagram_key, &mut this.previous_key);
    difference == 0
}

/// Handles one submessage of a first fragment; returns 0 at the end.
#[unsafe(no_mangle)]
#[inline(never)]
pub extern "C" fn report_lost_submessage(payload: u64, linear_len: u32) -> u32 {
    let Some(mut working) = current_drop() else {
        return 0;
    };
    let this = working.get();
    let bytes = LinearData {
        address: payload,
        len: linear_len,
    };
    match walk::step(&mut this.walk, &bytes, linear_len) {
        Step::End | Step::Later | Step::Split | Step::Malformed => return 0,
        Step::Passed | Step::LongGap => return 1,
        Step::Endpoint => {}
    }
    let record = &this.walk.record;
    if !record.has_samples() {
        return 1;
    }
    match walk::fate(record) {
        Fate::Writer => {}
        _ => return 1,
    }
    match INTEREST.get_ptr(record.writer) {
        // SAFETY: a map value pointer checked against null.
        Some(verdict) if unsafe { *verdict } == Verdict::Ignore as u32 => return 1,
        Some(_) => {}
        None if try_spend(Budget::Records, 1) => count_without_slot(Counter::MeteredUnknown, 1),
        None => {
            count_without_slot(Counter::UnknownOverBudget, 1);
            return 1;
        }
    }
    copy(&this.walk.record, &mut this.record);
    this.record.flags |= flag::NOT_REASSEMBLED;
    write_record_without_slot(&this.record);
    1
}

/// Reads an IPv4 header (RFC 791).
#[inline(always)]
fn ipv4(ip: u64, this: &mut DroppedFragment) -> Option<()> {
    let [first, second, third, source, destination]: [u32; 5] = read_kernel(ip)?;
    let (first, second) = (u32::from_be(first), u32::from_be(second));
    this.protocol = u32::from_be(third) >> 16 & 0xff;
    this.offset = second & 0x1fff;
    this.more_fragments = second >> 13 & 1;
    this.ipv6 = core::hint::black_box(0);
    let zero = this.ipv6;
    this.datagram_key = [
        zero,
        zero,
        IPV4_MAPPED,
        source,
        zero,
        zero,
        IPV4_MAPPED,
        destination,
        second >> 16,
    ];
    this.payload_address = ip + u64::from((first >> 24 & 0xf) * 4);
    Some(())
}

/// Reads an IPv6 header (RFC 8200). Up to three extension headers may precede the fragment header.
#[inline(always)]
fn ipv6(ip: u64, this: &mut DroppedFragment) -> Option<()> {
    let header: [u32; 10] = read_kernel(ip)?;
    let mut next = u32::from_be(header[1]) >> 8 & 0xff;
    let mut at = ip + 40;
    let mut extensions = 0;
    while extensions < 4 {
        let [word, second]: [u32; 2] = read_kernel(at)?;
        let word = u32::from_be(word);
        if next == FRAGMENT {
            this.protocol = word >> 24;
            this.offset = word & 0xfff8;
            this.more_fragments = word & 1;
            this.ipv6 = 1;
            this.datagram_key = [
                header[2], header[3], header[4], header[5], header[6], header[7], header[8],
                header[9], second,
            ];
            this.payload_address = at + 8;
            return Some(());
        }
        if next != HOP_BY_HOP && next != ROUTING && next != DESTINATION_OPTIONS {
            return None;
        }
        at += u64::from(((word >> 16 & 0xff) + 1) * 8);
        next = word >> 24;
        extensions += 1;
    }
    None
}
