//! Parses IPv4 (RFC 791) and IPv6 (RFC 8200) packets down to UDP (RFC 768) and TCP (RFC 9293).
//!
//! A packet whose lengths make the receiving kernel discard it is an error here, because no socket
//! can have received it.

use super::{Datagram, Fragment, Packet, Payload, Segment};
use crate::cursor::{Cursor, Reason, WireError};

const TCP: u8 = 6;
const UDP: u8 = 17;
const UDP_HEADER: usize = 8;
/// Maximum end of a fragment in its datagram, in bytes: lengths in IP have 16 bits.
const LARGEST_DATAGRAM: u32 = 65_535;
/// Maximum number of headers after the IPv6 header, that of the transport included. RFC 8200 has
/// each extension header once and destination options twice; a few more are accepted.
const MOST_EXTENSION_HEADERS: usize = 8;

/// Parses an IPv4 packet. `length` is the length on the wire of the cursor's outermost slice.
pub(super) fn v4(mut cursor: Cursor<'_>, length: usize) -> Result<Packet<'_>, WireError> {
    let start = cursor;
    let available = length.saturating_sub(cursor.offset());
    let version = cursor.u8("IPv4 version")?;
    if version >> 4 != 4 {
        return Err(start.error("IPv4 version", Reason::BadMarker));
    }
    let header_length = usize::from(version & 0x0f) * 4;
    cursor.u8("IPv4 traffic class")?;
    let total_length = usize::from(cursor.u16("IPv4 total length")?);
    let id = u32::from(cursor.u16("IPv4 identification")?);
    let fragmentation = cursor.u16("IPv4 fragment offset")?;
    cursor.u8("IPv4 time to live")?;
    let protocol = cursor.u8("IPv4 protocol")?;
    cursor.u16("IPv4 checksum")?;
    let source = mapped(cursor.array("IPv4 source")?);
    let destination = mapped(cursor.array("IPv4 destination")?);
    let more = fragmentation & 0x2000 != 0;
    let offset = u32::from(fragmentation & 0x1fff) * 8;
    let is_fragment = more || offset != 0;
    if protocol != UDP && (protocol != TCP || is_fragment) {
        return Ok(Packet {
            source,
            destination,
            payload: Payload::Other(protocol),
        });
    }
    let options = header_length
        .checked_sub(20)
        .ok_or(start.error("IPv4 header length", Reason::BadLength))?;
    // With segmentation offload, long TCP segments have a total length of 0.
    let total_length = match total_length {
        0 if protocol == TCP => available,
        length => length,
    };
    let body_length = total_length
        .checked_sub(header_length)
        .filter(|_| total_length <= available)
        .ok_or(start.error("IPv4 total length", Reason::BadLength))?;
    cursor.take("IPv4 options", options)?;
    let body = Body::new(cursor, body_length)?;
    let payload = if protocol == TCP {
        Payload::Segment(body.segment()?)
    } else if is_fragment {
        Payload::Fragment(body.fragment(id, offset, more)?)
    } else {
        Payload::Datagram(body.datagram(false)?)
    };
    Ok(Packet {
        source,
        destination,
        payload,
    })
}

/// Parses an IPv6 packet. `length` is the length on the wire of the cursor's outermost slice.
pub(super) fn v6(mut cursor: Cursor<'_>, length: usize) -> Result<Packet<'_>, WireError> {
    let start = cursor;
    let available = length.saturating_sub(cursor.offset());
    if cursor.u8("IPv6 version")? >> 4 != 6 {
        return Err(start.error("IPv6 version", Reason::BadMarker));
    }
    cursor.take("IPv6 flow label", 3)?;
    let payload_length = usize::from(cursor.u16("IPv6 payload length")?);
    let mut next_header = cursor.u8("IPv6 next header")?;
    cursor.u8("IPv6 hop limit")?;
    let source = cursor.array("IPv6 source")?;
    let destination = cursor.array("IPv6 destination")?;
    let packet = |payload| Packet {
        source,
        destination,
        payload,
    };
    if !matches!(next_header, TCP | UDP | 0 | 43 | 44 | 51 | 60) {
        return Ok(packet(Payload::Other(next_header)));
    }
    // As with IPv4, long TCP segments have a length of 0. A jumbogram's option may precede them.
    let payload_length = match payload_length {
        0 if matches!(next_header, TCP | 0) => available.saturating_sub(40),
        length => length,
    };
    if payload_length.saturating_add(40) > available {
        return Err(start.error("IPv6 payload length", Reason::BadLength));
    }
    let mut body = Body::new(cursor, payload_length)?;
    for _ in 0..MOST_EXTENSION_HEADERS {
        match next_header {
            UDP => return Ok(packet(Payload::Datagram(body.datagram(true)?))),
            TCP => return Ok(packet(Payload::Segment(body.segment()?))),
            // Hop-by-hop options, routing, destination options: the length counts units of 8 octets
            // after the first 8.
            0 | 43 | 60 => {
                let [following, units] = body.peek("IPv6 extension header")?;
                body.skip("IPv6 extension header", 8 + usize::from(units) * 8)?;
                next_header = following;
            }
            // Authentication header (RFC 4302): the length counts units of 4 octets, minus 2.
            51 => {
                let [following, units] = body.peek("IPv6 authentication header")?;
                body.skip("IPv6 authentication header", 8 + usize::from(units) * 4)?;
                next_header = following;
            }
            44 => {
                let [following, _, high, low, id @ ..] = body.peek::<8>("IPv6 fragment header")?;
                body.skip("IPv6 fragment header", 8)?;
                // The upper 13 bits count units of 8 octets, so the masked field is in bytes.
                let field = u16::from_be_bytes([high, low]);
                let (offset, more) = (u32::from(field & 0xfff8), field & 1 != 0);
                if offset == 0 && !more {
                    // An atomic fragment (RFC 6946) is a whole packet.
                    next_header = following;
                } else if following == UDP {
                    let fragment = body.fragment(u32::from_be_bytes(id), offset, more)?;
                    return Ok(packet(Payload::Fragment(fragment)));
                } else {
                    return Ok(packet(Payload::Other(following)));
                }
            }
            other => return Ok(packet(Payload::Other(other))),
        }
    }
    Err(start.error("IPv6 extension headers", Reason::OverLimit))
}

/// The bytes after a header, of which the capture may lack the end. `length` is their number on the
/// wire.
struct Body<'a> {
    cursor: Cursor<'a>,
    length: usize,
}

impl<'a> Body<'a> {
    /// Cuts off link-layer padding (Ethernet pads to 60 octets).
    fn new(mut cursor: Cursor<'a>, length: usize) -> Result<Self, WireError> {
        let captured = length.min(cursor.remaining());
        Ok(Self {
            cursor: cursor.sub("IP payload", captured)?,
            length,
        })
    }

    fn peek<const N: usize>(&self, what: &'static str) -> Result<[u8; N], WireError> {
        let mut ahead = self.cursor;
        ahead.array(what)
    }

    fn skip(&mut self, what: &'static str, count: usize) -> Result<(), WireError> {
        self.length = self
            .length
            .checked_sub(count)
            .ok_or(self.cursor.error(what, Reason::BadLength))?;
        self.cursor.take(what, count)?;
        Ok(())
    }

    fn fragment(self, id: u32, offset: u32, more: bool) -> Result<Fragment<'a>, WireError> {
        let wrong = self.cursor.error("IP fragment", Reason::BadLength);
        let length = u32::try_from(self.length).map_err(|_| wrong)?;
        let ragged = more && !length.is_multiple_of(8);
        if length == 0 || ragged || offset.saturating_add(length) > LARGEST_DATAGRAM {
            return Err(wrong);
        }
        Ok(Fragment {
            id,
            offset,
            more,
            bytes: self.cursor.rest(),
            length,
        })
    }

    /// Parses a TCP segment.
    fn segment(mut self) -> Result<Segment<'a>, WireError> {
        let start = self.cursor;
        let source_port = self.cursor.u16("TCP source port")?;
        let destination_port = self.cursor.u16("TCP destination port")?;
        let sequence_number = self.cursor.u32("TCP sequence number")?;
        self.cursor.take("TCP acknowledgement", 4)?;
        let [offset, flags] = self.cursor.array("TCP flags")?;
        self.cursor.take("TCP window, checksum and pointer", 6)?;
        let header = usize::from(offset >> 4) * 4;
        let wrong = start.error("TCP data offset", Reason::BadLength);
        let length = self.length.checked_sub(header).ok_or(wrong)?;
        let options = header.checked_sub(20).ok_or(wrong)?;
        self.cursor.take("TCP options", options)?;
        Ok(Segment {
            source_port,
            destination_port,
            sequence_number,
            syn: flags & 0x02 != 0,
            fin: flags & 0x01 != 0,
            rst: flags & 0x04 != 0,
            payload: self.cursor.rest(),
            length: u32::try_from(length).map_err(|_| wrong)?,
        })
    }

    /// Parses a UDP datagram. With `zero_is_all`, a UDP length of zero means the rest of the
    /// packet, as in Linux: IPv6 allows it for jumbograms (RFC 2675).
    fn datagram(mut self, zero_is_all: bool) -> Result<Datagram<'a>, WireError> {
        let start = self.cursor;
        let source_port = self.cursor.u16("UDP source port")?;
        let destination_port = self.cursor.u16("UDP destination port")?;
        let mut udp_length = usize::from(self.cursor.u16("UDP length")?);
        self.cursor.u16("UDP checksum")?;
        if udp_length == 0 && zero_is_all {
            udp_length = self.length;
        }
        let length = udp_length
            .checked_sub(UDP_HEADER)
            .filter(|_| udp_length <= self.length)
            .ok_or(start.error("UDP length", Reason::BadLength))?;
        let payload = self
            .cursor
            .take("UDP payload", length.min(self.cursor.remaining()))?;
        let length =
            u32::try_from(length).map_err(|_| start.error("UDP length", Reason::BadLength))?;
        Ok(Datagram {
            source_port,
            destination_port,
            payload,
            length,
        })
    }
}

fn mapped([a, b, c, d]: [u8; 4]) -> [u8; 16] {
    [0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0xff, 0xff, a, b, c, d]
}
