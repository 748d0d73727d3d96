use std::vec::Vec;

use etherparse::{PacketBuilder, SlicedPacket, TransportSlice};
use proptest::prelude::*;

use super::*;

/// Ethernet, IPv4, UDP 7401 -> 7400, payload "RTPS" padded to Ethernet's 60 octets.
const PADDED: [u8; 60] = {
    let mut frame = [0xee; 60];
    let header = [
        0x01, 0x00, 0x5e, 0x7f, 0x00, 0x01, 0x02, 0x00, 0x00, 0x00, 0x00, 0x01, 0x08,
        0x00, // link
        0x45, 0x00, 0x00, 0x20, 0x12, 0x34, 0x40, 0x00, 0x01, 0x11, 0x00, 0x00, // IPv4
        10, 0, 0, 1, 239, 255, 0, 1, // addresses
        0x1c, 0xe9, 0x1c, 0xe8, 0x00, 0x0c, 0x00, 0x00, b'R', b'T', b'P', b'S',
    ];
    let mut at = 0;
    while at < header.len() {
        frame[at] = header[at];
        at += 1;
    }
    frame
};

fn whole(link: Link, bytes: &[u8]) -> Result<Frame<'_>, WireError> {
    parse(link, bytes, u32::try_from(bytes.len()).unwrap())
}

fn datagram<'a>(frame: &Frame<'a>) -> Datagram<'a> {
    match frame.packet.expect("an IP packet").payload {
        Payload::Datagram(datagram) => datagram,
        other => panic!("not a datagram: {other:?}"),
    }
}

fn fragment<'a>(frame: &Frame<'a>) -> Fragment<'a> {
    match frame.packet.expect("an IP packet").payload {
        Payload::Fragment(fragment) => fragment,
        other => panic!("not a fragment: {other:?}"),
    }
}

#[test]
fn ethernet_padding_is_not_payload() {
    let frame = whole(Link::ETHERNET, &PADDED).unwrap();
    let packet = frame.packet.unwrap();
    assert_eq!(packet.source, *b"\0\0\0\0\0\0\0\0\0\0\xff\xff\x0a\0\0\x01");
    assert_eq!(
        packet.destination,
        *b"\0\0\0\0\0\0\0\0\0\0\xff\xff\xef\xff\0\x01"
    );
    let expected = Datagram {
        source_port: 7401,
        destination_port: 7400,
        payload: b"RTPS",
        length: 4,
    };
    assert_eq!(datagram(&frame), expected);
}

#[test]
fn every_link_layer_yields_the_same_packet() {
    let ip = &PADDED[14..];
    let expected = whole(Link::RAW, ip).unwrap().packet;
    let join = |head: &[u8]| [head, ip].concat();
    let sll = [0, 4, 0, 1, 0, 6, 1, 2, 3, 4, 5, 6, 0, 0, 0x08, 0x00];
    let sll2 = [
        0x08, 0x00, 0, 0, 0, 0, 0, 7, 0, 1, 4, 6, 1, 2, 3, 4, 5, 6, 0, 0,
    ];
    let tagged = [&PADDED[..12], &[0x81, 0x00, 0x20, 0x05, 0x08, 0x00]].concat();
    let stacked = [
        &PADDED[..12],
        &[0x88, 0xa8, 0x00, 0x01, 0x81, 0x00, 0x20, 0x05, 0x08, 0x00],
    ]
    .concat();
    let old_stacked = [
        &PADDED[..12],
        &[0x91, 0x00, 0x00, 0x01, 0x81, 0x00, 0x20, 0x05, 0x08, 0x00],
    ]
    .concat();
    let cases: [(Link, Vec<u8>); 12] = [
        (Link::RAW_BSD, ip.to_vec()),
        (Link::RAW_OPENBSD, ip.to_vec()),
        (Link::IPV4, ip.to_vec()),
        (Link::NULL, join(&[2, 0, 0, 0])),
        (Link::NULL, join(&[0, 0, 0, 2])),
        (Link::LOOP, join(&[0, 0, 0, 2])),
        (Link::ETHERNET, PADDED.to_vec()),
        (Link::ETHERNET, join(&tagged)),
        (Link::ETHERNET, join(&stacked)),
        (Link::ETHERNET, join(&old_stacked)),
        (Link::LINUX_SLL, join(&sll)),
        (Link::LINUX_SLL2, join(&sll2)),
    ];
    for (link, bytes) in cases {
        assert!(link.is_supported());
        assert_eq!(whole(link, &bytes).unwrap().packet, expected, "{link:?}");
    }
    let cooked = join(&sll2);
    let frame = whole(Link::LINUX_SLL2, &cooked).unwrap();
    assert_eq!(
        (frame.interface, frame.packet_type),
        (Some(7), PacketType::OUTGOING)
    );
    let cooked = join(&sll);
    assert_eq!(
        whole(Link::LINUX_SLL, &cooked).unwrap().packet_type,
        PacketType::OUTGOING
    );
}

#[test]
fn a_frame_with_a_third_vlan_tag_or_another_protocol_has_no_packet() {
    let mut tags = PADDED[..12].to_vec();
    for tag in [0x8100_u16, 0x8100, 0x8100] {
        tags.extend_from_slice(&tag.to_be_bytes());
        tags.extend_from_slice(&[0, 1]);
    }
    tags.extend_from_slice(&PADDED[12..]);
    assert_eq!(whole(Link::ETHERNET, &tags).unwrap().packet, None);
    let mut arp = PADDED;
    arp[13] = 0x06;
    assert_eq!(whole(Link::ETHERNET, &arp).unwrap().packet, None);
    assert_eq!(
        whole(Link(147), &PADDED).unwrap_err(),
        WireError {
            what: "link type",
            offset: 0,
            reason: Reason::BadValue
        }
    );
}

#[test]
fn a_socket_that_strips_the_link_header_yields_the_same_packet() {
    let ip = &PADDED[14..];
    let expected = whole(Link::RAW, ip).unwrap().packet;
    let length = u32::try_from(ip.len()).unwrap();
    assert_eq!(
        parse_cooked(0x0800, PacketType::HOST, ip, length),
        Ok(expected)
    );
    // Two VLAN tags: received frames keep the inner tag, sent frames do not.
    let inner = [&[0x45, 0x05, 0x08, 0x00], ip].concat();
    assert_eq!(
        parse_cooked(0x8100, PacketType::MULTICAST, &inner, length + 4),
        Ok(expected)
    );
    assert_eq!(
        parse_cooked(0x88a8, PacketType::OUTGOING, ip, length),
        Ok(expected)
    );
    // Linux 6.11 and later: the tag is present, but the protocol does not name it.
    assert_eq!(
        parse_cooked(0x0800, PacketType::MULTICAST, &inner, length + 4),
        Ok(expected)
    );
    assert_eq!(
        parse_cooked(0x0806, PacketType::BROADCAST, ip, length),
        Ok(None)
    );
}

#[test]
fn a_packet_that_resembles_a_vlan_tag_is_read_as_a_packet() {
    let mut packet = [
        0x45, 0, 0x08, 0x00, 0x45, 0x45, 0, 0, 64, 17, 0, 0, 10, 0, 0, 1, 10, 0, 0, 2,
    ]
    .to_vec();
    packet.extend_from_slice(&[0x1c, 0xe8, 0x1c, 0xe8, 0x07, 0xec, 0, 0]);
    packet.resize(2048, 0);
    let parsed = parse_cooked(0x0800, PacketType::HOST, &packet, 2048).unwrap();
    assert_eq!(parsed.unwrap().source[12..], [10, 0, 0, 1]);
}

#[test]
fn ipv4_options_are_skipped() {
    let mut frame = PADDED[..34].to_vec();
    frame[14] = 0x47;
    frame[17] = 0x28;
    frame.extend_from_slice(&[0x94, 0x04, 0, 0, 1, 1, 1, 0]);
    frame.extend_from_slice(&PADDED[34..46]);
    assert_eq!(
        datagram(&whole(Link::ETHERNET, &frame).unwrap()).payload,
        b"RTPS"
    );
}

#[test]
fn ipv4_fragments_report_their_offset_and_length() {
    let mut frame = PADDED;
    // First part: more fragments, 16 octets.
    frame[17] = 0x24;
    frame[20] = 0x20;
    let first = frame;
    let first = whole(Link::ETHERNET, &first).unwrap();
    let first = fragment(&first);
    assert_eq!(
        (first.id, first.offset, first.more, first.length),
        (0x1234, 0, true, 16)
    );
    // Last part, at 185 * 8.
    frame[20..22].copy_from_slice(&[0x00, 185]);
    frame[17] = 0x20;
    let last = whole(Link::ETHERNET, &frame).unwrap();
    let last = fragment(&last);
    assert_eq!((last.offset, last.more, last.end()), (1480, false, 1492));
    assert_eq!(last.bytes, &PADDED[34..46]);
    // A part that would end beyond the largest datagram.
    frame[20..22].copy_from_slice(&[0x1f, 0xff]);
    let error = whole(Link::ETHERNET, &frame).unwrap_err();
    assert_eq!(
        (error.what, error.reason),
        ("IP fragment", Reason::BadLength)
    );
}

fn ipv6(next_header: u8, body: &[u8]) -> Vec<u8> {
    let mut packet = [0x60, 0, 0, 0, 0, 0, next_header, 1].to_vec();
    packet[4..6].copy_from_slice(&u16::try_from(body.len()).unwrap().to_be_bytes());
    packet.extend_from_slice(&[0xfe; 16]);
    packet.extend_from_slice(&[0xff; 16]);
    packet.extend_from_slice(body);
    packet
}

const UDP_V6: [u8; 12] = [
    0x1c, 0xe9, 0x1c, 0xe8, 0x00, 0x0c, 0x00, 0x00, b'R', b'T', b'P', b'S',
];

#[test]
fn ipv6_extension_headers_are_skipped() {
    let mut body = Vec::new();
    body.extend_from_slice(&[60, 0, 1, 4, 0, 0, 0, 0]); // hop-by-hop
    body.extend_from_slice(&[43, 1, 1, 12, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0]); // destination
    body.extend_from_slice(&[51, 0, 4, 0, 0, 0, 0, 0]); // routing
    body.extend_from_slice(&[
        44, 4, 0, 0, 0, 0, 0, 1, 0, 0, 0, 1, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0,
    ]);
    body.extend_from_slice(&[17, 0, 0, 0, 0, 0, 0, 9]); // an atomic fragment
    body.extend_from_slice(&UDP_V6);
    let packet = ipv6(0, &body);
    for link in [Link::RAW, Link::IPV6] {
        assert_eq!(datagram(&whole(link, &packet).unwrap()).payload, b"RTPS");
    }
    let null = [&[0, 0, 0, 30][..], &packet].concat();
    assert_eq!(
        datagram(&whole(Link::NULL, &null).unwrap()).payload,
        b"RTPS"
    );
    assert_eq!(
        whole(Link::RAW, &ipv6(59, &[]))
            .unwrap()
            .packet
            .unwrap()
            .payload,
        Payload::Other(59)
    );
}

#[test]
fn too_many_ipv6_extension_headers_are_refused() {
    let mut body = [60, 0, 1, 4, 0, 0, 0, 0].repeat(60);
    body.extend_from_slice(&UDP_V6);
    let error = whole(Link::RAW, &ipv6(60, &body)).unwrap_err();
    assert_eq!(
        (error.what, error.reason),
        ("IPv6 extension headers", Reason::OverLimit)
    );
}

#[test]
fn the_masked_ipv6_fragment_offset_is_in_bytes() {
    // Part of a 60 KB datagram at byte 57,920 = 0xe240, more to follow.
    let mut body = [17, 0, 0xe2, 0x41, 0xde, 0xad, 0xbe, 0xef].to_vec();
    body.extend_from_slice(&[0x55; 1448]);
    let packet = ipv6(44, &body);
    let part = whole(Link::RAW, &packet).unwrap();
    let part = fragment(&part);
    assert_eq!(
        (part.id, part.offset, part.more),
        (0xdead_beef, 57_920, true)
    );
    assert_eq!((part.length, part.end()), (1448, 59_368));
}

#[test]
fn a_capture_cut_short_keeps_the_length_on_the_wire() {
    let mut frame = PADDED.to_vec();
    frame[16..18].copy_from_slice(&1020_u16.to_be_bytes());
    frame[38..40].copy_from_slice(&1000_u16.to_be_bytes());
    let short = parse(Link::ETHERNET, &frame, 1034).unwrap();
    assert_eq!(
        (datagram(&short).length, datagram(&short).payload.len()),
        (992, 18)
    );
    // The wire length equals the captured length: the IP header is wrong.
    let error = whole(Link::ETHERNET, &frame).unwrap_err();
    assert_eq!(
        (error.what, error.reason),
        ("IPv4 total length", Reason::BadLength)
    );
}

#[test]
fn lengths_that_contradict_each_other_are_refused() {
    for (at, value, what) in [
        (14, 0x44, "IPv4 header length"),
        (17, 0x13, "IPv4 total length"),
        (14, 0x65, "IPv4 version"),
        (39, 0x07, "UDP length"),
        (39, 0x0d, "UDP length"),
    ] {
        let mut frame = PADDED;
        frame[at] = value;
        assert_eq!(whole(Link::ETHERNET, &frame).unwrap_err().what, what);
    }
}

#[test]
fn a_truncated_frame_is_an_error_or_has_a_shorter_payload() {
    let headers = 14 + 20 + 8;
    for end in 0..PADDED.len() {
        match parse(Link::ETHERNET, &PADDED[..end], 60) {
            Err(error) => {
                assert!(end < headers, "{error}");
                assert_eq!(error.reason, Reason::Truncated, "{error}");
                assert!(error.offset <= end);
            }
            Ok(frame) => {
                assert!(end >= headers);
                let datagram = datagram(&frame);
                assert_eq!(
                    (datagram.length, datagram.payload.len()),
                    (4, 4.min(end - headers))
                );
            }
        }
    }
}

#[test]
fn one_wrong_byte_never_causes_a_read_beyond_the_frame() {
    let v6 = ipv6(44, &[&[17, 0, 0, 1, 0, 0, 0, 1][..], &[7; 16]].concat());
    for (link, original) in [(Link::ETHERNET, PADDED.to_vec()), (Link::RAW, v6)] {
        for at in 0..original.len() {
            for value in 0..=255 {
                let mut bytes = original.clone();
                bytes[at] = value;
                if let Ok(Frame {
                    packet: Some(packet),
                    ..
                }) = whole(link, &bytes)
                {
                    let (held, length) = match packet.payload {
                        Payload::Datagram(datagram) => (datagram.payload.len(), datagram.length),
                        Payload::Fragment(part) => (part.bytes.len(), part.length),
                        Payload::Segment(part) => (part.payload.len(), part.length),
                        Payload::Other(_) => (0, 0),
                    };
                    assert_eq!(held, usize::try_from(length).unwrap());
                    assert!(held <= bytes.len());
                }
            }
        }
    }
}

proptest! {
    #[test]
    fn any_bytes_on_any_link_layer_never_make_the_parser_panic(
        link in prop::sample::select(std::vec![0_u16, 1, 12, 101, 108, 113, 228, 229, 276, 9]),
        bytes in prop::collection::vec(any::<u8>(), 0..200),
        length in any::<u32>(),
    ) {
        let _ = parse(Link(link), &bytes, length);
        let _ = parse_cooked(link.rotate_left(8), PacketType(4), &bytes, length);
    }

    #[test]
    fn packets_built_by_etherparse_are_parsed(
        vlan in 0..3_u8,
        v6 in any::<bool>(),
        ports in any::<(u16, u16)>(),
        payload in prop::collection::vec(any::<u8>(), 0..1400),
        padding in 0..20_usize,
    ) {
        let builder = PacketBuilder::ethernet2([1; 6], [2; 6]);
        let (source, destination) = ([10, 1, 2, 3], [239, 255, 0, 1]);
        let mut bytes = Vec::new();
        let vlan_id = |id: u16| etherparse::VlanId::try_new(id).unwrap();
        macro_rules! write {
            ($builder:expr) => {
                if v6 {
                    $builder.ipv6([3; 16], [4; 16], 9).udp(ports.0, ports.1).write(&mut bytes, &payload)
                } else {
                    $builder
                        .ipv4(source, destination, 9)
                        .udp(ports.0, ports.1)
                        .write(&mut bytes, &payload)
                }
            };
        }
        match vlan {
            0 => write!(builder),
            1 => write!(builder.single_vlan(vlan_id(5))),
            _ => write!(builder.double_vlan(vlan_id(6), vlan_id(7))),
        }
        .unwrap();
        bytes.resize(bytes.len() + padding, 0xaa);
        let frame = whole(Link::ETHERNET, &bytes).unwrap();
        let packet = frame.packet.unwrap();
        if v6 {
            prop_assert_eq!((packet.source, packet.destination), ([3; 16], [4; 16]));
        } else {
            prop_assert_eq!(&packet.source[12..], &source);
            prop_assert_eq!(&packet.destination[12..], &destination);
        }
        let read = datagram(&frame);
        prop_assert_eq!((read.source_port, read.destination_port), ports);
        prop_assert_eq!(read.payload, &payload[..]);
    }

    /// If both readers accept a damaged frame as a whole UDP datagram, they agree on it.
    #[test]
    fn the_parser_agrees_with_etherparse_on_damaged_frames(
        damage in prop::collection::vec((12..PADDED.len(), any::<u8>()), 1..3),
    ) {
        let mut bytes = PADDED;
        for (at, value) in damage {
            bytes[at] = value;
        }
        let (Ok(ours), Ok(theirs)) =
            (whole(Link::ETHERNET, &bytes), SlicedPacket::from_ethernet(&bytes))
        else {
            return Ok(());
        };
        match (ours.packet.map(|packet| packet.payload), theirs.transport) {
            (Some(Payload::Datagram(ours)), Some(TransportSlice::Udp(theirs))) => {
                prop_assert_eq!(ours.source_port, theirs.source_port());
                prop_assert_eq!(ours.destination_port, theirs.destination_port());
                prop_assert_eq!(ours.payload, theirs.payload());
            }
            (Some(Payload::Datagram(ours)), other) => {
                prop_assert!(false, "{ours:?} is not UDP for etherparse: {other:?}");
            }
            (_, Some(TransportSlice::Udp(theirs))) => {
                prop_assert!(false, "etherparse sees UDP where we do not: {theirs:?}");
            }
            _ => {}
        }
    }
}
