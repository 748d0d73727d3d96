//! Parses a captured frame into a UDP datagram, the part of one in an IP fragment, or a TCP
//! segment.
//!
//! The results are views: the parser copies nothing and keeps no state between frames. It does not
//! verify checksums, because transmit offload leaves them unset in captures. Reassembly happens
//! elsewhere. Packets of other protocols are identified and not read.
//!
//! A capture may hold less of a frame than was on the wire. Every length here is the length on the
//! wire; fewer bytes may have been captured.

mod ip;

use crate::cursor::{Cursor, Endianness, Reason, WireError};

/// Link layer of a capture, by its pcap `LINKTYPE_` number.
#[derive(Clone, Copy, PartialEq, Eq, Hash, Debug)]
pub struct Link(pub u16);

impl Link {
    /// BSD loopback: address family in the byte order of the capturing host.
    pub const NULL: Self = Self(0);
    /// Ethernet; Linux also reports it for `lo` and for Wi-Fi in managed mode.
    pub const ETHERNET: Self = Self(1);
    /// Raw IP, with the number of some BSDs.
    pub const RAW_BSD: Self = Self(12);
    /// Raw IP, with the number of OpenBSD.
    pub const RAW_OPENBSD: Self = Self(14);
    /// Raw IP, version by the first nibble.
    pub const RAW: Self = Self(101);
    /// OpenBSD loopback: address family in network byte order.
    pub const LOOP: Self = Self(108);
    /// Linux cooked capture.
    pub const LINUX_SLL: Self = Self(113);
    /// Raw IPv4.
    pub const IPV4: Self = Self(228);
    /// Raw IPv6.
    pub const IPV6: Self = Self(229);
    /// Linux cooked capture, version 2: with the interface's index.
    pub const LINUX_SLL2: Self = Self(276);

    /// Returns whether [`parse`] supports this link layer.
    #[must_use]
    pub const fn is_supported(self) -> bool {
        matches!(
            self,
            Self::NULL
                | Self::ETHERNET
                | Self::RAW_BSD
                | Self::RAW_OPENBSD
                | Self::RAW
                | Self::LOOP
                | Self::LINUX_SLL
                | Self::IPV4
                | Self::IPV6
                | Self::LINUX_SLL2
        )
    }
}

/// The recipient or direction of a frame, as Linux numbers it (`PACKET_*` in `linux/if_packet.h`).
#[derive(Clone, Copy, PartialEq, Eq, Hash, Debug)]
pub struct PacketType(pub u8);

impl PacketType {
    /// Addressed to this host. The default if the link layer does not carry a type.
    pub const HOST: Self = Self(0);
    /// Link-layer broadcast.
    pub const BROADCAST: Self = Self(1);
    /// Link-layer multicast.
    pub const MULTICAST: Self = Self(2);
    /// Addressed to another host.
    pub const OTHER_HOST: Self = Self(3);
    /// Sent by this host.
    pub const OUTGOING: Self = Self(4);
}

/// One captured frame.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub struct Frame<'a> {
    /// Index of the interface, if the link header carries it (cooked v2).
    pub interface: Option<u32>,
    /// Packet type, if the link header carries it (cooked v1 and v2), otherwise
    /// [`PacketType::HOST`].
    pub packet_type: PacketType,
    /// The IP packet; `None` if the frame carries something else (ARP, LLDP, a third VLAN tag).
    pub packet: Option<Packet<'a>>,
}

/// One IP packet.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub struct Packet<'a> {
    /// Source address; IPv4 as `::ffff:a.b.c.d`.
    pub source: [u8; 16],
    /// Destination address; IPv4 as `::ffff:a.b.c.d`.
    pub destination: [u8; 16],
    /// Content of the packet.
    pub payload: Payload<'a>,
}

/// Content of an IP packet.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum Payload<'a> {
    /// A whole UDP datagram.
    Datagram(Datagram<'a>),
    /// A part of a UDP datagram.
    Fragment(Fragment<'a>),
    /// A TCP segment, or several that segmentation offload has merged.
    Segment(Segment<'a>),
    /// Another protocol, by its IP protocol number; also an IP fragment of a TCP segment.
    Other(u8),
}

/// A TCP segment (RFC 9293, 3.1).
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub struct Segment<'a> {
    /// Source port.
    pub source_port: u16,
    /// Destination port.
    pub destination_port: u16,
    /// Sequence number of the first byte, or of the SYN.
    pub sequence_number: u32,
    /// Whether the segment opens the connection.
    pub syn: bool,
    /// Whether the sender sends no bytes after this segment.
    pub fin: bool,
    /// Whether the segment aborts the connection.
    pub rst: bool,
    /// Captured bytes of the payload.
    pub payload: &'a [u8],
    /// Length of the payload on the wire.
    pub length: u32,
}

/// A whole UDP datagram.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub struct Datagram<'a> {
    /// Source port.
    pub source_port: u16,
    /// Destination port.
    pub destination_port: u16,
    /// Captured bytes of the payload after the UDP header.
    pub payload: &'a [u8],
    /// Length of the payload on the wire.
    pub length: u32,
}

/// A part of a UDP datagram. A part at offset zero includes the UDP header.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub struct Fragment<'a> {
    /// IP identification, shared by the parts of one datagram (16 bits in IPv4).
    pub id: u32,
    /// Offset of the part in bytes from the UDP header's start.
    pub offset: u32,
    /// Whether further parts follow. The end of the last part is the datagram's length, with the
    /// UDP header.
    pub more: bool,
    /// Captured bytes of the part.
    pub bytes: &'a [u8],
    /// Length of the part on the wire.
    pub length: u32,
}

impl Fragment<'_> {
    /// Returns the offset of the next part, at most 65535.
    #[must_use]
    pub const fn end(&self) -> u32 {
        self.offset.saturating_add(self.length)
    }
}

const ETHER_TYPE_IPV4: u16 = 0x0800;
const ETHER_TYPE_IPV6: u16 = 0x86dd;
/// EtherTypes of VLAN tags: 802.1Q, 802.1ad, and the older one of stacked VLANs.
const ETHER_TYPES_VLAN: [u16; 3] = [0x8100, 0x88a8, 0x9100];
const MOST_VLAN_TAGS: usize = 2;

/// Parses one frame of a capture. `length` is the frame's length on the wire.
///
/// # Errors
/// Fails if a header is cut off or contradicts itself, or if the link layer is not supported.
pub fn parse(link: Link, bytes: &[u8], length: u32) -> Result<Frame<'_>, WireError> {
    let mut cursor = Cursor::new(bytes, Endianness::Big);
    let length = true_length(bytes, length);
    let mut interface = None;
    let mut packet_type = PacketType::HOST;
    let packet = match link {
        Link::ETHERNET => {
            cursor.take("ethernet addresses", 12)?;
            let ether_type = cursor.u16("ether type")?;
            network(ether_type, cursor, length)?
        }
        Link::LINUX_SLL => {
            let [_, kind] = cursor.array("cooked packet type")?;
            packet_type = PacketType(kind);
            cursor.take("cooked link address", 12)?;
            let protocol = cursor.u16("cooked protocol")?;
            network(protocol, cursor, length)?
        }
        Link::LINUX_SLL2 => {
            let protocol = cursor.u16("cooked protocol")?;
            cursor.take("cooked reserved", 2)?;
            interface = Some(cursor.u32("cooked interface index")?);
            cursor.take("cooked hardware type", 2)?;
            packet_type = PacketType(cursor.u8("cooked packet type")?);
            cursor.take("cooked link address", 9)?;
            network(protocol, cursor, length)?
        }
        Link::NULL | Link::LOOP => {
            // AF_INET is 2 everywhere; AF_INET6 is 10 on Linux, 24, 28 or 30 on the BSDs. The
            // numbers are small, so the byte order is unambiguous.
            let family = u32::from_be_bytes(cursor.array("loopback address family")?);
            match family.min(family.swap_bytes()) {
                2 => Some(ip::v4(cursor, length)?),
                10 | 24 | 28 | 30 => Some(ip::v6(cursor, length)?),
                _ => None,
            }
        }
        Link::RAW | Link::RAW_BSD | Link::RAW_OPENBSD => raw(cursor, length)?,
        Link::IPV4 => Some(ip::v4(cursor, length)?),
        Link::IPV6 => Some(ip::v6(cursor, length)?),
        Link(_) => return Err(cursor.error("link type", Reason::BadValue)),
    };
    Ok(Frame {
        interface,
        packet_type,
        packet,
    })
}

/// Parses a packet from an `AF_PACKET` socket of type `SOCK_DGRAM`. It has no link header; the
/// kernel reports the protocol and the packet type separately.
///
/// The kernel strips only the outer tag of a frame with two VLAN tags. A received packet then
/// begins with the inner tag; a sent one begins with the IP header although its protocol names a
/// tag. Since Linux 6.11 the protocol is the one after all tags, even if the packet still begins
/// with a tag.
///
/// # Errors
/// Fails as [`parse`] does.
pub fn parse_cooked(
    protocol: u16,
    packet_type: PacketType,
    bytes: &[u8],
    length: u32,
) -> Result<Option<Packet<'_>>, WireError> {
    let cursor = Cursor::new(bytes, Endianness::Big);
    let length = true_length(bytes, length);
    if packet_type == PacketType::OUTGOING && ETHER_TYPES_VLAN.contains(&protocol) {
        return raw(cursor, length);
    }
    if begins_with_unnamed_tag(protocol, bytes, length) {
        let mut cursor = cursor;
        cursor.take("VLAN tag", 4)?;
        return network(protocol, cursor, length);
    }
    network(protocol, cursor, length)
}

/// Returns whether a VLAN tag precedes the packet although `protocol` does not announce one. A tag
/// has two octets of control information, then the packet's own EtherType. Without a tag, only an
/// IPv4 packet of 2048 octets or an IPv6 packet of more than 24,000 octets looks the same.
fn begins_with_unnamed_tag(protocol: u16, bytes: &[u8], length: usize) -> bool {
    const LEAST_AMBIGUOUS: usize = 2048;
    let version = match protocol {
        ETHER_TYPE_IPV4 => 4,
        ETHER_TYPE_IPV6 => 6,
        _ => return false,
    };
    let [first, _, high, low, behind, ..] = *bytes else {
        return false;
    };
    u16::from_be_bytes([high, low]) == protocol
        && behind >> 4 == version
        && (first >> 4 != version || length < LEAST_AMBIGUOUS)
}

fn network(
    mut ether_type: u16,
    mut cursor: Cursor<'_>,
    length: usize,
) -> Result<Option<Packet<'_>>, WireError> {
    for _ in 0..MOST_VLAN_TAGS {
        if !ETHER_TYPES_VLAN.contains(&ether_type) {
            break;
        }
        cursor.take("VLAN tag", 2)?;
        ether_type = cursor.u16("ether type")?;
    }
    match ether_type {
        ETHER_TYPE_IPV4 => ip::v4(cursor, length).map(Some),
        ETHER_TYPE_IPV6 => ip::v6(cursor, length).map(Some),
        _ => Ok(None),
    }
}

fn raw(cursor: Cursor<'_>, length: usize) -> Result<Option<Packet<'_>>, WireError> {
    match cursor.rest().first().map(|first| first >> 4) {
        Some(4) => ip::v4(cursor, length).map(Some),
        Some(6) => ip::v6(cursor, length).map(Some),
        Some(_) => Ok(None),
        None => Err(cursor.error("IP version", Reason::Truncated)),
    }
}

/// Returns the claimed length on the wire, or the captured length if it is larger, because the
/// claim is then wrong.
fn true_length(bytes: &[u8], length: u32) -> usize {
    usize::try_from(length)
        .unwrap_or(usize::MAX)
        .max(bytes.len())
}

#[cfg(test)]
mod tests;
