use std::io::Write;

use flate2::Compression;
use flate2::write::GzEncoder;
use ros2probe_wire::Expansion;
use ros2probe_wire::frame::{self, PacketType, Payload};

use super::*;
use crate::reassembly::{self, FlowKey, Limits, Reassembly};

const PACKETS: [(u32, u32, &[u8]); 3] = [
    (1_700_000_000, 123_456, b"first"),
    (1_700_000_001, 0, b""),
    (1_700_000_002, 999_999, b"the third packet"),
];

fn data(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR"))
        .join("../../wire/tests/data")
        .join(name)
}

/// Writes numbers in one byte order.
struct Writer {
    bytes: Vec<u8>,
    endianness: Endianness,
}

impl Writer {
    fn new(endianness: Endianness) -> Self {
        Self {
            bytes: Vec::new(),
            endianness,
        }
    }

    fn u32(&mut self, value: u32) -> &mut Self {
        self.bytes.extend_from_slice(&match self.endianness {
            Endianness::Big => value.to_be_bytes(),
            Endianness::Little => value.to_le_bytes(),
        });
        self
    }

    fn u16(&mut self, value: u16) -> &mut Self {
        self.bytes.extend_from_slice(&match self.endianness {
            Endianness::Big => value.to_be_bytes(),
            Endianness::Little => value.to_le_bytes(),
        });
        self
    }

    fn raw(&mut self, bytes: &[u8]) -> &mut Self {
        self.bytes.extend_from_slice(bytes);
        while !self.bytes.len().is_multiple_of(4) {
            self.bytes.push(0);
        }
        self
    }

    fn block(&mut self, kind: u32, body: impl FnOnce(&mut Self)) -> &mut Self {
        let mut inner = Self::new(self.endianness);
        body(&mut inner);
        let total = u32::try_from(inner.bytes.len()).unwrap() + 12;
        self.u32(kind).u32(total);
        self.bytes.extend_from_slice(&inner.bytes);
        self.u32(total)
    }

    fn section(&mut self) -> &mut Self {
        self.block(0x0a0d_0d0a, |body| {
            body.u32(0x1a2b_3c4d)
                .u16(1)
                .u16(0)
                .u32(u32::MAX)
                .u32(u32::MAX);
            body.u16(4).u16(4).raw(b"test").u32(0);
        })
    }
}

fn classic(endianness: Endianness, nanoseconds: bool) -> Vec<u8> {
    let mut file = Writer::new(endianness);
    file.u32(if nanoseconds {
        0xa1b2_3c4d
    } else {
        0xa1b2_c3d4
    });
    file.u16(2)
        .u16(4)
        .u32(0)
        .u32(0)
        .u32(65535)
        .u32(0x1000_0000 | 101);
    for (seconds, fraction, bytes) in PACKETS {
        let length = u32::try_from(bytes.len()).unwrap();
        file.u32(seconds).u32(fraction).u32(length).u32(length + 10);
        file.bytes.extend_from_slice(bytes);
    }
    file.bytes
}

fn next_generation(endianness: Endianness) -> Vec<u8> {
    let mut file = Writer::new(endianness);
    file.section();
    file.block(1, |body| {
        body.u16(1)
            .u16(0)
            .u32(0)
            .u16(2)
            .u16(5)
            .raw(b"veth0")
            .u16(9)
            .u16(1)
            .raw(&[9])
            .u32(0);
    });
    file.block(1, |body| {
        body.u16(276).u16(0).u32(4).u16(9).u16(1).raw(&[0x8a]);
    });
    file.block(5, |body| {
        body.u32(0).raw(b"statistics nobody reads ");
    });
    let time = 1_700_000_000_123_456_789_u64;
    let [high, low] = [time >> 32, time & 0xffff_ffff].map(|half| u32::try_from(half).unwrap());
    file.block(6, |body| {
        body.u32(0)
            .u32(high)
            .u32(low)
            .u32(5)
            .u32(15)
            .raw(b"first")
            .u16(1)
            .u16(2)
            .raw(b"hi")
            .u32(0);
    });
    // The resolution is 1024 units per second.
    file.block(6, |body| {
        body.u32(1).u32(0).u32(1536).u32(3).u32(3).raw(b"two");
    });
    file.block(2, |body| {
        body.u16(1)
            .u16(7)
            .u32(0)
            .u32(2048)
            .u32(3)
            .u32(3)
            .raw(b"old");
    });
    file.block(3, |body| {
        body.u32(6).raw(b"simple");
    });
    file.bytes
}

type Owned = (u64, Link, u32, Vec<u8>, u32);

fn read(bytes: &[u8]) -> (Vec<Owned>, Option<PcapError>) {
    let mut packets = Vec::new();
    let mut reader = match PcapReader::new(io::Cursor::new(bytes.to_vec()), Expansion::Limited) {
        Ok(reader) => reader,
        Err(error) => return (packets, Some(error)),
    };
    let error = loop {
        match reader.next_packet() {
            Ok(Some(packet)) => packets.push((
                packet.time.0,
                packet.link,
                packet.interface,
                packet.bytes.to_vec(),
                packet.length,
            )),
            Ok(None) => break None,
            Err(error) => break Some(error),
        }
    };
    assert_eq!(reader.packets(), packets.len() as u64);
    assert!(
        matches!(reader.next_packet(), Ok(None)),
        "an ended capture stays ended"
    );
    (packets, error)
}

fn gzip(bytes: &[u8]) -> Vec<u8> {
    let mut encoder = GzEncoder::new(Vec::new(), Compression::fast());
    encoder.write_all(bytes).unwrap();
    encoder.finish().unwrap()
}

#[test]
fn pcap_files_read_the_same_in_every_byte_order_resolution_and_compression() {
    for endianness in [Endianness::Big, Endianness::Little] {
        for nanoseconds in [false, true] {
            let file = classic(endianness, nanoseconds);
            for bytes in [file.clone(), gzip(&file)] {
                let (packets, error) = read(&bytes);
                assert!(error.is_none(), "{error:?}");
                let unit = if nanoseconds { 1 } else { 1000 };
                let expected = PACKETS.map(|(seconds, fraction, bytes)| {
                    let time = u64::from(seconds) * 1_000_000_000 + u64::from(fraction) * unit;
                    let length = u32::try_from(bytes.len()).unwrap() + 10;
                    (time, Link::RAW, 0, bytes.to_vec(), length)
                });
                assert_eq!(packets, expected);
            }
        }
    }
}

#[test]
fn pcapng_packets_have_the_link_layer_and_time_resolution_of_their_interface() {
    for endianness in [Endianness::Big, Endianness::Little] {
        let (packets, error) = read(&next_generation(endianness));
        assert!(error.is_none(), "{error:?}");
        assert_eq!(
            packets,
            [
                (
                    1_700_000_000_123_456_789,
                    Link::ETHERNET,
                    0,
                    b"first".to_vec(),
                    15
                ),
                (1_500_000_000, Link::LINUX_SLL2, 1, b"two".to_vec(), 3),
                (2_000_000_000, Link::LINUX_SLL2, 1, b"old".to_vec(), 3),
                (2_000_000_000, Link::ETHERNET, 0, b"simple".to_vec(), 6),
            ]
        );
    }
}

#[test]
fn a_second_section_has_its_own_byte_order_and_interfaces() {
    let mut file = next_generation(Endianness::Little);
    file.extend(next_generation(Endianness::Big));
    let mut reader = PcapReader::new(io::Cursor::new(file), Expansion::Limited).unwrap();
    let mut count = 0;
    while reader.next_packet().unwrap().is_some() {
        count += 1;
        assert_eq!(reader.interface_name(0), Some("veth0"));
        assert_eq!(
            (reader.interface_name(1), reader.interface_name(2)),
            (None, None)
        );
    }
    assert_eq!(count, 8);
}

#[test]
fn a_truncated_file_delivers_the_packets_before_the_cut() {
    for file in [
        classic(Endianness::Little, false),
        next_generation(Endianness::Big),
    ] {
        let (all, _) = read(&file);
        for end in 0..file.len() {
            let (packets, error) = read(&file[..end]);
            assert!(all.starts_with(&packets));
            match error {
                Some(PcapError::Truncated { packets: count, .. }) => {
                    assert_eq!(count, packets.len() as u64);
                }
                // Between two blocks or packets, a truncation cannot be detected.
                None => {}
                Some(error) => panic!("cut at {end}: {error}"),
            }
            let zipped = gzip(&file);
            let (packets, error) = read(&zipped[..end.min(zipped.len() - 1)]);
            assert!(all.starts_with(&packets));
            assert!(
                matches!(error, Some(PcapError::Truncated { .. })),
                "{error:?}"
            );
        }
    }
}

#[test]
fn a_corrupted_byte_never_causes_a_panic_or_extra_packets() {
    for file in [
        classic(Endianness::Big, true),
        next_generation(Endianness::Little),
    ] {
        for at in 0..file.len() {
            for flip in [0x01, 0x80, 0xff] {
                let mut bytes = file.clone();
                bytes[at] ^= flip;
                let (packets, _) = read(&bytes);
                assert!(packets.len() <= 4);
            }
        }
    }
}

#[test]
fn an_excessive_length_in_the_file_is_rejected() {
    let mut file = classic(Endianness::Little, false);
    file[32..36].copy_from_slice(&0x7fff_ffff_u32.to_le_bytes());
    let (_, error) = read(&file);
    assert!(
        matches!(
            error,
            Some(PcapError::TooLong {
                length: 0x7fff_ffff,
                ..
            })
        ),
        "{error:?}"
    );
    let mut file = Writer::new(Endianness::Little);
    file.section().u32(6).u32(0x7fff_fffc);
    let (_, error) = read(&file.bytes);
    assert!(
        matches!(error, Some(PcapError::TooLong { what: "block", .. })),
        "{error:?}"
    );
    let mut file = Writer::new(Endianness::Little);
    file.section()
        .u32(0xbad)
        .u32(0xffff_fffc)
        .raw(b"skipped until it ends");
    let (_, error) = read(&file.bytes);
    assert!(
        matches!(error, Some(PcapError::Truncated { .. })),
        "{error:?}"
    );
}

#[test]
fn a_file_that_is_not_a_capture_is_reported() {
    for (bytes, begin) in [
        (&b"%PDF-1.7 and so on"[..], "[25, 50, 44, 46]"),
        (b"no\n", "[6e, 6f, 0a]"),
    ] {
        let (_, error) = read(bytes);
        let text = error.unwrap().to_string();
        let expected = format!("not a capture: it begins with {begin}, as neither pcap nor pcapng");
        assert!(text.starts_with(&expected), "{text}");
    }
    let missing = PcapReader::open(Path::new("/nonexistent/x.pcap"), Expansion::Limited)
        .err()
        .unwrap()
        .to_string();
    assert_eq!(missing, "cannot open capture /nonexistent/x.pcap");
}

#[test]
fn fragments_of_a_real_capture_become_a_datagram() {
    let (_, datagrams, counters) = datagrams(&data("cyclonedds-qos-mismatch.pcap.gz"));
    assert_eq!(
        (datagrams, counters.completed, counters.contradictory),
        (146, 1, 0)
    );
}

/// Returns the number of frames and of datagrams (whole or reassembled), and the reassembly's
/// counters.
fn datagrams(path: &Path) -> (u64, u64, reassembly::Counters) {
    let mut reader = PcapReader::open(path, Expansion::Limited).unwrap();
    let mut reassembly = Reassembly::new(Limits::default());
    let mut whole = 0;
    while let Some(captured) = reader.next_packet().unwrap() {
        let frame = frame::parse(captured.link, captured.bytes, captured.length).unwrap();
        let Some(packet) = frame.packet else { continue };
        match packet.payload {
            Payload::Datagram(_) => whole += 1,
            Payload::Fragment(part) => {
                let outgoing = frame.packet_type == PacketType::OUTGOING;
                let interface = frame.interface.unwrap_or_default();
                let key = FlowKey::new(0, interface, outgoing, &packet, &part);
                whole += u64::from(reassembly.fragment(captured.time, key, &part).is_some());
            }
            Payload::Segment(_) | Payload::Other(_) => {}
        }
    }
    (reader.packets(), whole, reassembly.counters())
}

/// Returns the numbers of frames, whole UDP datagrams, fragments, and frames that a cooked header
/// marks as outgoing.
fn census(path: &Path) -> (u64, u64, u64, u64) {
    let mut reader = PcapReader::open(path, Expansion::Limited).unwrap();
    let (mut datagrams, mut fragments, mut outgoing) = (0, 0, 0);
    while let Some(captured) = reader.next_packet().unwrap() {
        let frame = frame::parse(captured.link, captured.bytes, captured.length).unwrap();
        outgoing += u64::from(frame.packet_type == PacketType::OUTGOING);
        match frame.packet.map(|packet| packet.payload) {
            Some(Payload::Datagram(_)) => datagrams += 1,
            Some(Payload::Fragment(_)) => fragments += 1,
            _ => {}
        }
    }
    (reader.packets(), datagrams, fragments, outgoing)
}

#[test]
fn real_captures_contain_the_packets_that_another_decoder_counted() {
    // Ethernet and cooked v2; the numbers are in wire/tests/data/README.md.
    assert_eq!(
        census(&data("cyclonedds-qos-mismatch.pcap.gz")),
        (152, 145, 2, 0)
    );
    assert_eq!(
        census(&data("fastdds-samehost-any.pcap.gz")),
        (560, 548, 0, 51)
    );
    assert_eq!(
        census(&data("cyclonedds-samehost-any.pcap.gz")),
        (620, 615, 0, 133)
    );
}

#[test]
fn a_small_capture_that_expands_too_far_ends_with_an_error() {
    // The file has the header of a capture, and empty packets.
    const PACKETS: usize = 8 << 20;
    let mut file = GzEncoder::new(Vec::new(), Compression::fast());
    let header = [0xa1b2_c3d4_u32, 0x0002_0004, 0, 0, 65_535, 1];
    file.write_all(&header.map(u32::to_le_bytes).concat())
        .unwrap();
    for _ in 0..PACKETS / 4096 {
        file.write_all(&[0; 16 * 4096]).unwrap();
    }
    let file = file.finish().unwrap();
    let read = |expansion| {
        let mut reader = PcapReader::new(io::Cursor::new(file.clone()), expansion).unwrap();
        let end = loop {
            match reader.next_packet() {
                Ok(Some(_)) => {}
                Ok(None) => break None,
                Err(PcapError::Read { source, .. }) => break Some(source.to_string()),
                Err(error) => panic!("{error}"),
            }
        };
        (usize::try_from(reader.packets()).unwrap(), end)
    };
    assert!(file.len() < 1 << 20, "{}", file.len());
    let (packets, end) = read(Expansion::Limited);
    // The limit does not apply to the first 64 MiB.
    assert!(packets > 4 << 20 && packets < PACKETS, "{packets}");
    let end = end.unwrap();
    assert!(end.contains("more than 100 times its size"), "{end}");
    assert!(end.contains("--no-expansion-limit"), "{end}");
    assert_eq!(read(Expansion::Unlimited), (PACKETS, None));
}
