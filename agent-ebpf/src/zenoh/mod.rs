//! Selects the bytes of TCP connections of Zenoh and RTPS that user space needs.
//!
//! At both hooks a connection is recognized by its first batch or frame, or by batches with
//! consecutive sequence numbers ([`search`]). At the sockets ([`process_socket_segment`]) each
//! direction of such a connection is followed from batch to batch. Only the head of a sample is
//! passed on, but declarations as a whole. On interfaces ([`filter_tcp_frame`]) whole frames are
//! kept.
//!
//! The bytes of a connection that is not recognized stay in the kernel, except on configured ports
//! of Zenoh:
//!
//! - Of a client's hello of TLS on any port, the addresses are passed on, and no byte.
//! - At a socket, these bytes are passed on: the first 16 of a hello of TLS, and the first 512 of
//!   an INIT of another version of Zenoh. Of each Initial packet of QUIC ([`quic`]), 6 bytes are.
//! - On an interface, every TCP frame with payload, SYN, FIN or RST is kept as a whole, of any
//!   protocol. So is every datagram with an Initial packet of QUIC.

mod chunk;
mod follow;
mod message;
mod push;
mod rtps;
mod search;
mod state;

use aya_ebpf::{
    bindings::__sk_buff,
    helpers::{bpf_ktime_get_ns, generated::bpf_get_socket_cookie},
};
use ros2probe_wire::{host::chunk as chunk_flag, quic as initial};

use crate::{
    host::add_socket,
    maps::{claim_egress_slot, claim_ingress_slot, release_slot, scratch},
    packet::{IPV4_MAPPED, hook, load_bytes},
    settings::read_global,
};
use state::{CONNECTIONS, Direction, Key, Segment, ZENOH_PORTS};

/// Index of the loopback interface, in every network namespace (`LOOPBACK_IFINDEX` of Linux).
const LOOPBACK: u32 = 1;
const TCP: u32 = 6;
/// Bytes of a UDP header.
const UDP_HEADER: u32 = 8;
const FIN: u32 = 1;
const SYN: u32 = 2;
const RST: u32 = 4;

/// Header fields that are needed before a slot is claimed.
struct Header {
    source: [u32; 4],
    destination: [u32; 4],
    source_port: u32,
    destination_port: u32,
    sequence_number: u32,
    flags: u32,
    /// Offset of the payload in the socket buffer.
    payload_offset: u32,
    /// Length of the payload.
    payload_len: u32,
}

/// Handles one packet at a socket; `at` is one of [`hook`].
// Inlined, as other functions here, because the verifier allows at most eight nested calls.
#[inline(always)]
pub fn process_socket_segment(skb: *mut __sk_buff, at: u32) -> Option<()> {
    // SAFETY: the verifier rewrites reads of this field.
    let interface = unsafe { (*skb).ifindex };
    // Of Zenoh, these bytes were captured at the socket of their sender.
    let is_loopback_copy = at != hook::EGRESS && interface == LOOPBACK;
    if is_loopback_copy && !state::is_any_rtps() {
        return None;
    }
    let header = parse_tcp_header(skb, 0)?;
    let is_bare = header.payload_len == 0 && header.flags & (FIN | RST) == 0;
    // A sender whose peer has closed the window sends segments without bytes.
    if header.flags & SYN != 0 || is_bare && (at != hook::EGRESS || interface == LOOPBACK) {
        return None;
    }
    let outgoing = u32::from(at == hook::EGRESS);
    let key = Key {
        // SAFETY: `skb` is the program's context.
        socket: unsafe { bpf_get_socket_cookie(skb.cast()) },
        ports: header.source_port << 16 | header.destination_port,
        outgoing,
    };
    let is_tracked_socket = state::is_tracked_socket(key.socket);
    let direction = match is_tracked_socket {
        true => CONNECTIONS.get_ptr_mut(&key),
        false => None,
    };
    let is_known = direction.is_some();
    if is_loopback_copy {
        let is_rtps = match direction {
            // SAFETY: a map value pointer checked against null.
            Some(direction) => unsafe { (*direction).protocol == state::protocol::RTPS },
            None => rtps::starts_frame(skb, header.payload_offset, header.payload_len),
        };
        if !is_rtps {
            return None;
        }
    }
    if is_bare && !is_link_report_due(direction) {
        return None;
    }
    if is_known {
        state::track_socket(key.socket);
    } else if !search::may_be_tracked_protocol(
        skb,
        header.payload_offset,
        header.payload_len,
        &key,
        is_tracked_socket,
    ) {
        return None;
    }
    let slot = if outgoing == 0 {
        claim_ingress_slot()?
    } else {
        claim_egress_slot()?
    };
    if let Some(mut segment) = state::segment(slot) {
        init_segment(skb, &mut segment, &header, &key);
        if is_known {
            follow::forward_segment(skb, slot);
        } else if search::probe_at_socket(skb, slot) != 0 {
            // This call happens once per direction, not per segment.
            add_socket(skb, key.socket, 1);
            follow::forward_segment(skb, slot);
        }
        if header.flags & (FIN | RST) != 0 {
            follow::end_direction(skb, slot, header.flags & RST);
        }
    }
    release_slot(slot);
    Some(())
}

/// Returns whether the state of this connection is to be passed on.
#[inline(always)]
fn is_link_report_due(direction: Option<*mut Direction>) -> bool {
    let Some(direction) = direction else {
        return false;
    };
    // SAFETY: no preconditions.
    let period = chunk::link_report_period(unsafe { bpf_ktime_get_ns() });
    // SAFETY: a map value pointer checked against null.
    unsafe { (*direction).last_link_report != period }
}

/// Handles one frame on an interface; returns 1 to keep it. `slot` is claimed.
#[unsafe(export_name = "zenoh_frame")]
#[inline(never)]
pub extern "C" fn filter_tcp_frame(skb: *mut __sk_buff, slot: u32, start: u32) -> u32 {
    u32::from(filter_interface_frame(skb, slot, start).is_some())
}

#[inline(always)]
fn filter_interface_frame(skb: *mut __sk_buff, slot: u32, start: u32) -> Option<()> {
    let header = parse_tcp_header(skb, start)?;
    if header.payload_len == 0 && header.flags & (SYN | FIN | RST) == 0 {
        return None;
    }
    if is_configured_port(header.source_port) || is_configured_port(header.destination_port) {
        return Some(());
    }
    // SAFETY: the verifier rewrites reads of this field.
    let interface = unsafe { (*skb).ifindex };
    let (source, destination) = (&header.source, &header.destination);
    let low_hash = u64::from(source[3])
        + u64::from(destination[3])
        + u64::from(source[1])
        + u64::from(destination[1]);
    let high_hash = u64::from(source[2])
        + u64::from(destination[2])
        + u64::from(source[0])
        + u64::from(destination[0]);
    let key = Key {
        // The hash is the same for both directions. If another connection has the same hash and
        // ports, its frames are kept, too.
        socket: low_hash.wrapping_mul(0x9e37_79b9_7f4a_7c15)
            ^ high_hash << 20
            ^ u64::from(interface),
        ports: header.source_port << 16 | header.destination_port,
        outgoing: 2,
    };
    let is_tracked_socket = state::is_tracked_socket(key.socket);
    if is_tracked_socket && CONNECTIONS.get_ptr_mut(&key).is_some() {
        state::track_socket(key.socket);
        return Some(());
    }
    if !search::may_be_tracked_protocol(
        skb,
        header.payload_offset,
        header.payload_len,
        &key,
        is_tracked_socket,
    ) {
        return None;
    }
    let mut segment = state::segment(slot)?;
    init_segment(skb, &mut segment, &header, &key);
    if search::probe_on_interface(skb, slot) == 0 {
        return None;
    }
    Some(())
}

/// Handles a UDP datagram that is not RTPS. On a port of Zenoh, the datagram may begin a QUIC
/// connection. At a socket, its head is then passed on. On an interface, the function returns 1 to
/// keep the frame.
#[unsafe(export_name = "zenoh_quic")]
#[inline(never)]
pub extern "C" fn quic(skb: *mut __sk_buff, slot: u32) -> u32 {
    let Some(mut scratch) = scratch(slot) else {
        return 0;
    };
    let packet = &scratch.get().packet;
    let body = packet.payload_offset;
    let Some(ports): Option<u32> = load_bytes(skb, body) else {
        return 0;
    };
    let ports = u32::from_be(ports);
    if !is_zenoh_port(ports) || packet.is_fragment != 0 || packet.len < UDP_HEADER {
        return 0;
    }
    let len = packet.len - UDP_HEADER;
    let Some(head): Option<[u8; initial::HEAD]> = load_bytes(skb, body + UDP_HEADER) else {
        return 0;
    };
    if !initial::is_initial(head, len) {
        return 0;
    }
    if packet.is_at_socket == 0 {
        return 1;
    }
    if let Some(mut segment) = state::segment(slot) {
        segment.key = Key {
            // SAFETY: `skb` is the program's context.
            socket: unsafe { bpf_get_socket_cookie(skb.cast()) },
            ports,
            outgoing: packet.is_outgoing,
        };
        segment.source = packet.source;
        segment.destination = packet.destination;
        segment.source_port = ports >> 16;
        segment.destination_port = ports & 0xffff;
        segment.interface = packet.interface;
        segment.sequence_number = 0;
        segment.body = body + UDP_HEADER;
        segment.len = len;
        segment.window_len = 0;
        segment.state.pending_flags = 0;
        segment.state.protocol = state::protocol::ZENOH;
        // SAFETY: no preconditions.
        segment.now = unsafe { bpf_ktime_get_ns() };
        let lengths = (initial::HEAD as u64) << 32 | u64::from(len);
        chunk::write_chunk(
            skb,
            slot,
            0,
            lengths,
            u32::from(chunk_flag::QUIC) | chunk::WAKEUP,
        );
    }
    0
}

/// Returns whether one of two ports is configured as a port of Zenoh.
#[inline(always)]
pub fn is_zenoh_port(ports: u32) -> bool {
    is_configured_port(ports >> 16) || is_configured_port(ports & 0xffff)
}

/// Returns whether the port is configured as a port of Zenoh.
#[inline(always)]
fn is_configured_port(port: u32) -> bool {
    let ports = read_global(&ZENOH_PORTS);
    let port = port as u16;
    ports[0] == port
        || ports[1] == port
        || ports[2] == port
        || ports[3] == port
        || ports[4] == port
        || ports[5] == port
        || ports[6] == port
        || ports[7] == port
}

#[inline(always)]
fn init_segment(skb: *mut __sk_buff, segment: &mut Segment, header: &Header, key: &Key) {
    segment.key = *key;
    segment.source = header.source;
    segment.destination = header.destination;
    segment.source_port = header.source_port;
    segment.destination_port = header.destination_port;
    segment.sequence_number = header.sequence_number;
    segment.body = header.payload_offset;
    segment.len = header.payload_len;
    // The window holds another packet's bytes.
    segment.window_len = 0;
    // SAFETY: the verifier rewrites reads of this field.
    segment.interface = unsafe { (*skb).ifindex };
    // SAFETY: no preconditions.
    segment.now = unsafe { bpf_ktime_get_ns() };
}

/// Reads the headers; `None` if the packet is not a TCP segment in one piece. IPv6 extension
/// headers are not read, because no TCP stack sends them by default.
#[inline(always)]
fn parse_tcp_header(skb: *mut __sk_buff, start: u32) -> Option<Header> {
    let first: [u32; 5] = load_bytes(skb, start)?;
    let (body, total, source, destination) = match u32::from_be(first[0]) >> 28 {
        4 => {
            let lengths = u32::from_be(first[0]);
            if u32::from_be(first[2]) >> 16 & 0xff != TCP || u32::from_be(first[1]) & 0x3fff != 0 {
                return None;
            }
            let header = (lengths >> 24 & 0xf) * 4;
            if header < 20 {
                return None;
            }
            (
                start + header,
                lengths & 0xffff,
                [0, 0, IPV4_MAPPED, first[3]],
                [0, 0, IPV4_MAPPED, first[4]],
            )
        }
        6 => {
            if u32::from_be(first[1]) >> 8 & 0xff != TCP {
                return None;
            }
            let rest: [u32; 5] = load_bytes(skb, start + 20)?;
            let payload = u32::from_be(first[1]) >> 16;
            (
                start + 40,
                if payload == 0 { 0 } else { payload + 40 },
                [first[2], first[3], first[4], rest[0]],
                [rest[1], rest[2], rest[3], rest[4]],
            )
        }
        _ => return None,
    };
    let tcp: [u32; 4] = load_bytes(skb, body)?;
    // A packet of more than 64 KB has no length in its header.
    // SAFETY: the verifier rewrites reads of this field.
    let end = start
        + if total == 0 {
            unsafe { (*skb).len }
        } else {
            total
        };
    let flags = u32::from_be(tcp[3]);
    let body = body + (flags >> 28) * 4;
    if flags >> 28 < 5 || end < body {
        return None;
    }
    Some(Header {
        source,
        destination,
        source_port: u32::from_be(tcp[0]) >> 16,
        destination_port: u32::from_be(tcp[0]) & 0xffff,
        sequence_number: u32::from_be(tcp[1]),
        flags: flags >> 16 & 0x3f,
        payload_offset: body,
        payload_len: end - body,
    })
}
