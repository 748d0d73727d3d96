//! Parses a socket buffer down to the IP payload of a UDP packet.

use aya_ebpf::{
    bindings::__sk_buff,
    helpers::generated::{bpf_skb_load_bytes, bpf_skb_load_bytes_relative},
};
use core::mem::MaybeUninit;
use ros2probe_wire::{filter::Counter, walk};

use crate::{
    PACKET_OUTGOING,
    instructions::hide_bounds,
    maps::{IN_PLACE, Packet, count, scratch},
    settings::read_global,
};

/// Maximum offset at which [`load_direct`] reads, because the verifier requires a bound.
const MAX_DIRECT_OFFSET: usize = 0x7fff;

/// The hook at which a program sees a packet. The values are `u32`, because functions of BPF take
/// and return integers.
pub mod hook {
    /// A frame on an interface, at a packet socket.
    pub const INTERFACE: u32 = 0;
    /// A received datagram at its socket.
    pub const INGRESS: u32 = 1;
    /// A sent datagram at its socket.
    pub const EGRESS: u32 = 2;
    /// A packet that an interface has received, at tcx.
    pub const TCX_INGRESS: u32 = 3;
    /// A packet that an interface is about to send, at tcx.
    pub const TCX_EGRESS: u32 = 4;
}

/// `BPF_HDR_START_NET`: offsets count from the IP header.
const FROM_IP_HEADER: u32 = 1;
/// Result of [`link_header_len`] if the length is unknown.
pub const NO_LINK_HEADER: u32 = u32::MAX;
/// Lengths of an Ethernet header, and of a VLAN tag.
const ETHERNET_LEN: u32 = 14;
const TAG_LEN: u32 = 4;

const UDP: u32 = 17;
/// Third word of an IPv4-mapped address, in memory order.
pub const IPV4_MAPPED: u32 = u32::from_ne_bytes([0, 0, 0xff, 0xff]);
/// EtherTypes 802.1Q and 802.1ad, as `skb->protocol` holds them.
const ETH_P_8021Q: u32 = 0x8100_u16.to_be() as u32;
const ETH_P_8021AD: u32 = 0x88a8_u16.to_be() as u32;

/// The UDP payload as the walk reads it. Payload offset 0 is at `base` of the socket buffer. `base`
/// wraps for a trailing IP fragment, because the datagram's payload starts before the frame.
pub struct Payload {
    pub skb: *mut __sk_buff,
    pub base: u32,
}

impl walk::Bytes for Payload {
    #[inline(always)]
    fn words<const N: usize>(&self, offset: u32) -> Option<[u32; N]> {
        load_bytes(self.skb, self.base.wrapping_add(offset))
    }
}

/// Copies a plain value out of the socket buffer.
#[inline(always)]
pub fn load_bytes<T: Copy>(skb: *mut __sk_buff, offset: u32) -> Option<T> {
    match load_direct(skb, offset) {
        Some(value) => Some(value),
        None => load_with_helper(skb, offset),
    }
}

/// Reads a value from the contiguous part of a datagram, without a helper call.
#[inline(always)]
fn load_direct<T: Copy>(skb: *mut __sk_buff, offset: u32) -> Option<T> {
    if read_global(&IN_PLACE) == 0 {
        // Programs of packet sockets may not read in place; for them the verifier skips the code below.
        return None;
    }
    let offset = hide_bounds(offset) as usize;
    if offset > MAX_DIRECT_OFFSET {
        return None;
    }
    // SAFETY: the verifier rewrites reads of these fields into the addresses.
    let (start, end) = unsafe { ((*skb).data as usize, (*skb).data_end as usize) };
    let at = start + offset;
    if at + size_of::<T>() > end {
        return None;
    }
    // SAFETY: the value lies before the end; only integer arrays are read, and this machine reads
    // them at any address.
    Some(unsafe { *(at as *const T) })
}

#[inline(always)]
fn load_with_helper<T: Copy>(skb: *mut __sk_buff, offset: u32) -> Option<T> {
    let mut value = MaybeUninit::<T>::uninit();
    // SAFETY: the destination has the size given; the kernel checks the offset.
    let result = unsafe {
        bpf_skb_load_bytes(
            skb.cast(),
            offset,
            value.as_mut_ptr().cast(),
            size_of::<T>() as u32,
        )
    };
    if result != 0 {
        return None;
    }
    // SAFETY: the helper has filled all of it; only integer arrays are loaded.
    Some(unsafe { value.assume_init() })
}

/// Returns whether the current packet is an IP fragment; `None` without working memory.
#[inline(always)]
pub fn is_fragment(slot: u32) -> Option<bool> {
    Some(scratch(slot)?.get().packet.is_fragment != 0)
}

/// Reads the first 20 bytes of the IP header of a packet at tcx; `at` is one of [`hook`].
#[inline(always)]
pub fn load_ip_header(skb: *mut __sk_buff, at: u32) -> Option<[u32; 5]> {
    let tag = if at == hook::TCX_INGRESS {
        ip_header_offset(skb)
    } else {
        0
    };
    match load_contiguous_ip_header(skb, tag) {
        Some(header) => Some(header),
        // Some drivers leave all that follows the header of Ethernet in pages.
        None => load_with_helper(skb, ETHERNET_LEN),
    }
}

/// Reads the header from the contiguous part of a packet.
#[inline(always)]
fn load_contiguous_ip_header(skb: *mut __sk_buff, tag: u32) -> Option<[u32; 5]> {
    let mut header = MaybeUninit::<[u32; 5]>::uninit();
    // SAFETY: the destination has the size given; the kernel checks the offset.
    let result = unsafe {
        bpf_skb_load_bytes_relative(
            skb.cast(),
            tag,
            header.as_mut_ptr().cast(),
            size_of::<[u32; 5]>() as u32,
            FROM_IP_HEADER,
        )
    };
    if result != 0 {
        return None;
    }
    // SAFETY: the helper has filled all of it.
    Some(unsafe { header.assume_init() })
}

/// Returns the offset of the IP header `header` in a packet at tcx. The packet begins with the header
/// of the link, if the interface has one. The kernel does not pass the offset on. It follows from the
/// length of the packet, unless padding follows the packet: short frames of Ethernet have padding.
/// Returns [`NO_LINK_HEADER`] if the offset is unknown.
#[inline(always)]
pub fn link_header_len(skb: *mut __sk_buff, header: &[u32; 5]) -> u32 {
    let first = u32::from_be(header[0]);
    let len = match first >> 28 {
        4 => first & 0xffff,
        6 => 40 + (u32::from_be(header[1]) >> 16),
        _ => return NO_LINK_HEADER,
    };
    // SAFETY: the verifier rewrites reads of this field.
    let offset = unsafe { (*skb).len }.wrapping_sub(len);
    if is_at(skb, header, offset) {
        offset
    } else if is_at(skb, header, ETHERNET_LEN) {
        ETHERNET_LEN
    } else if is_at(skb, header, ETHERNET_LEN + TAG_LEN) {
        ETHERNET_LEN + TAG_LEN
    } else {
        NO_LINK_HEADER
    }
}

#[inline(always)]
fn is_at(skb: *mut __sk_buff, header: &[u32; 5], offset: u32) -> bool {
    load_bytes::<[u32; 5]>(skb, offset).is_some_and(|there| {
        there[0] == header[0]
            && there[1] == header[1]
            && there[2] == header[2]
            && there[3] == header[3]
            && there[4] == header[4]
    })
}

/// Fills in the scratch packet, whose IP header is at `start`; returns 1 if the packet is a UDP
/// datagram or a fragment of one. `at` is one of [`hook`].
// Global (not inlined) functions are verified once each, whatever calls them.
#[unsafe(no_mangle)]
#[inline(never)]
pub extern "C" fn parse_ip_packet(skb: *mut __sk_buff, slot: u32, at: u32, start: u32) -> u32 {
    let Some(mut scratch) = scratch(slot) else {
        return 0;
    };
    let packet = &mut scratch.get().packet;
    // SAFETY: the verifier rewrites reads of these fields.
    let (pkt_type, interface) = unsafe { ((*skb).pkt_type, (*skb).ifindex) };
    let host = at == hook::INGRESS || at == hook::EGRESS;
    // Elsewhere the packet type is unusable: a sent datagram does not have it yet.
    let outgoing = if at == hook::INTERFACE {
        pkt_type == PACKET_OUTGOING
    } else {
        at == hook::EGRESS || at == hook::TCX_EGRESS
    };
    packet.is_at_socket = u32::from(host);
    packet.is_outgoing = u32::from(outgoing);
    packet.interface = interface;
    let Some(header) = load_bytes::<[u32; 5]>(skb, start) else {
        return 0;
    };
    let is_udp = match u32::from_be(header[0]) >> 28 {
        4 => ipv4(header, start, packet),
        6 => ipv6(skb, start, packet),
        _ => None,
    };
    if is_udp.is_none() {
        return 0;
    }
    count(slot, Counter::Frames, 1);
    1
}

/// Returns how far the IP header of a frame is behind the place where the kernel expects it. The kernel
/// strips the outer VLAN tag of received frames, but not a second one.
#[inline(always)]
pub fn ip_header_offset(skb: *mut __sk_buff) -> u32 {
    // SAFETY: the verifier rewrites reads of these fields.
    let (pkt_type, protocol) = unsafe { ((*skb).pkt_type, (*skb).protocol) };
    if pkt_type != PACKET_OUTGOING && (protocol == ETH_P_8021Q || protocol == ETH_P_8021AD) {
        TAG_LEN
    } else {
        0
    }
}

/// Reads an IPv4 header (RFC 791).
#[inline(always)]
fn ipv4(header: [u32; 5], start: u32, packet: &mut Packet) -> Option<()> {
    let [first, second, third, source, destination] = header;
    let (first, second, third) = (
        u32::from_be(first),
        u32::from_be(second),
        u32::from_be(third),
    );
    if third >> 16 & 0xff != UDP {
        return None;
    }
    let header = (first >> 24 & 0xf) * 4;
    let total = first & 0xffff;
    if header < 20 || total < header {
        return None;
    }
    packet.payload_offset = start + header;
    packet.len = total - header;
    packet.fragment_offset = (second & 0x1fff) * 8;
    packet.more_fragments = second >> 13 & 1;
    packet.identification = second >> 16;
    packet.is_fragment = u32::from(second & 0x3fff != 0);
    packet.is_ipv6 = 0;
    packet.source = [0, 0, IPV4_MAPPED, source];
    packet.destination = [0, 0, IPV4_MAPPED, destination];
    Some(())
}

/// Reads an IPv6 header (RFC 8200) with up to seven extension headers.
#[inline(always)]
fn ipv6(skb: *mut __sk_buff, start: u32, packet: &mut Packet) -> Option<()> {
    let header: [u32; 10] = load_bytes(skb, start)?;
    let lengths = u32::from_be(header[1]);
    packet.source = [header[2], header[3], header[4], header[5]];
    packet.destination = [header[6], header[7], header[8], header[9]];
    packet.is_ipv6 = 1;
    // This zero is hidden from the compiler, which would turn four consecutive zeros into a call of
    // `memset`.
    let zero = core::hint::black_box(0);
    packet.fragment_offset = zero;
    packet.more_fragments = zero;
    packet.identification = zero;
    packet.is_fragment = zero;
    let end = start + 40 + (lengths >> 16);
    let mut next_header = lengths >> 8 & 0xff;
    let mut at = start + 40;
    let mut extensions = 0;
    while extensions < 8 {
        if next_header == UDP {
            if at > end {
                return None;
            }
            packet.payload_offset = at;
            packet.len = end - at;
            return Some(());
        }
        if packet.fragment_offset != 0 {
            // Only the first fragment has further headers.
            return None;
        }
        let [word, second]: [u32; 2] = load_bytes(skb, at)?;
        let word = u32::from_be(word);
        match next_header {
            // Hop-by-hop, routing, destination options: the length counts 8-byte units beyond the
            // first 8 bytes.
            0 | 43 | 60 => at += ((word >> 16 & 0xff) + 1) * 8,
            44 => {
                packet.is_fragment = u32::from(word & 0xfff9 != 0);
                // The offset counts 8-byte units and is shifted left by three bits: the masked
                // value is in bytes.
                packet.fragment_offset = word & 0xfff8;
                packet.more_fragments = word & 1;
                packet.identification = u32::from_be(second);
                at += 8;
            }
            // Authentication header: the length counts 4-byte units beyond the first 8 bytes.
            51 => at += ((word >> 16 & 0xff) + 2) * 4,
            _ => return None,
        }
        next_header = word >> 24;
        extensions += 1;
    }
    None
}
