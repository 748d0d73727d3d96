//! Reads packets at the tcx hooks of an interface: directly after it has received them, and before
//! it queues them for sending. Unlike a packet socket, the hooks need no copy of a packet's
//! descriptor, and no timestamp.
//!
//! Packets that user space needs are written to the ring of pieces, from the IP header on. The IP
//! fragments of a large message only continue its record, without any other working memory.

use aya_ebpf::bindings::__sk_buff;

use crate::{
    fragment::{self, Trailing},
    keeps_frame,
    maps::{FlowKey, claim_egress_slot, claim_ingress_slot, is_preempted, release_slot},
    packet::{self, IPV4_MAPPED, hook},
    pieces,
};

/// Bits of the second word of an IPv4 header.
const MORE_FRAGMENTS: u32 = 0x2000;
const OFFSET: u32 = 0x1fff;
const UDP: u32 = 17;
const TCP: u32 = 6;

/// Handles one packet; `at` is one of [`hook`].
// Inlined, because the verifier allows at most eight nested calls. The functions that it calls are
// separate, because the stacks of nested functions add up.
#[inline(always)]
pub fn process_packet(skb: *mut __sk_buff, at: u32) -> Option<()> {
    let [first, second, third, ..] = packet::load_ip_header(skb, at)?;
    let version = u32::from_be(first) >> 28;
    let protocol = u32::from_be(third) >> 16 & 0xff;
    if version == 4 && protocol != UDP && protocol != TCP || version != 4 && version != 6 {
        return None;
    }
    // Bottom halves are disabled at both hooks, so runs on a CPU do not interrupt each other, except
    // on kernels that preempt such code.
    let slot = if at == hook::TCX_EGRESS && is_preempted() {
        claim_egress_slot()?
    } else {
        claim_ingress_slot()?
    };
    let second = u32::from_be(second);
    let is_middle = second & OFFSET != 0 && second & MORE_FRAGMENTS != 0;
    let is_followed =
        version == 4 && protocol == UDP && is_middle && follow_fragment(skb, slot, at) != 0;
    if !is_followed {
        decide(skb, slot, at);
    }
    release_slot(slot);
    Some(())
}

/// Decides what happens to a packet, and passes it to user space if it is needed.
#[inline(always)]
fn decide(skb: *mut __sk_buff, slot: u32, at: u32) {
    let start = link_header_len(skb, at);
    if start == packet::NO_LINK_HEADER {
        return;
    }
    // SAFETY: the verifier rewrites reads of these fields.
    let (segments, len) = unsafe { ((*skb).gso_segs, (*skb).len) };
    if keeps_frame(skb, segments, slot, at, start) == Some(true) {
        pieces::write_frame(
            skb,
            slot,
            u64::from(len.wrapping_sub(start)) << 32 | u64::from(start),
        );
    }
}

/// Returns the offset of the IP header, as [`packet::link_header_len`] does.
#[unsafe(export_name = "tcx_link_header_len")]
#[inline(never)]
pub extern "C" fn link_header_len(skb: *mut __sk_buff, at: u32) -> u32 {
    match packet::load_ip_header(skb, at) {
        Some(header) => packet::link_header_len(skb, &header),
        None => packet::NO_LINK_HEADER,
    }
}

/// Handles an IPv4 fragment in the middle of a UDP datagram; returns 0 if [`decide`] must handle it.
#[unsafe(export_name = "follow_tcx_fragment")]
#[inline(never)]
pub extern "C" fn follow_fragment(skb: *mut __sk_buff, slot: u32, at: u32) -> u32 {
    let Some(header) = packet::load_ip_header(skb, at) else {
        return 0;
    };
    let start = packet::link_header_len(skb, &header);
    if start == packet::NO_LINK_HEADER {
        return 0;
    }
    let [first, second, _, source, destination] = header;
    let (first, second) = (u32::from_be(first), u32::from_be(second));
    let header_len = (first >> 24 & 0xf) * 4;
    let total = first & 0xffff;
    if header_len < 20 || total < header_len {
        return 0;
    }
    // SAFETY: the verifier rewrites reads of this field.
    let interface = unsafe { (*skb).ifindex };
    let key = FlowKey {
        source: [0, 0, IPV4_MAPPED, source],
        destination: [0, 0, IPV4_MAPPED, destination],
        identification: second >> 16,
        interface: interface | u32::from(at == hook::TCX_EGRESS) << 31,
    };
    let trailing = Trailing {
        offset: (second & OFFSET) * 8,
        len: total - header_len,
        payload_offset: start + header_len,
    };
    u32::from(fragment::follow(skb, slot, &key, &trailing))
}
