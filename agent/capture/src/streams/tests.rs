mod rtps;

use std::path::Path;

use proptest::prelude::*;
use ros2probe_model::graph::zenoh::Flow;
use ros2probe_wire::Expansion;

use super::*;
use crate::pcap::PcapReader;
use crate::tables::tests::assert_driven;
use crate::tables::{SearchedBytes, SegmentsAhead, SegmentsAheadBytes};

/// Events that a replay of a capture reports.
#[derive(Default, PartialEq, Eq, Debug)]
struct Reported {
    batches: Vec<(Flow, Vec<u8>)>,
    gaps: u64,
    begun: u64,
    ended: u64,
    tls: u64,
    hellos: u64,
}

impl Reported {
    fn note(&mut self, streamed: &Streamed<'_>) {
        let report = match streamed {
            Streamed::Zenoh(report) => report,
            Streamed::ClientHello(_) => return self.hellos += 1,
            _ => panic!("{streamed:?}"),
        };
        match report.event {
            StreamEvent::Batch { bytes, length } => {
                assert_eq!(bytes.len(), usize::from(length));
                self.batches.push((report.stream.flow, bytes.to_vec()));
            }
            StreamEvent::Gap => self.gaps += 1,
            StreamEvent::Begin => self.begun += 1,
            StreamEvent::End => self.ended += 1,
            StreamEvent::Unseen(Unseen::Tls) => self.tls += 1,
            StreamEvent::Unseen(_) => {}
        }
    }
}

/// A captured segment.
#[derive(Clone, Debug)]
struct Segment {
    time: Timestamp,
    flow: Flow,
    sequence_number: u32,
    syn: bool,
    end: bool,
    bytes: Vec<u8>,
}

fn segments() -> Vec<Segment> {
    use ros2probe_model::facts::route::Destination;
    use ros2probe_wire::frame::{self, Payload};

    let path = Path::new(env!("CARGO_MANIFEST_DIR"))
        .join("../testing/data/zenoh/lifecycle-1host/capture.pcap.gz");
    let mut reader = PcapReader::open(&path, Expansion::Limited).unwrap();
    let mut segments = Vec::new();
    while let Some(captured) = reader.next_packet().unwrap() {
        let frame = frame::parse(captured.link, captured.bytes, captured.length).unwrap();
        let packet = frame.packet.unwrap();
        let Payload::Segment(segment) = packet.payload else {
            continue;
        };
        let place = |address, port| Destination { address, port };
        segments.push(Segment {
            time: captured.time,
            flow: Flow {
                source: place(packet.source, segment.source_port),
                destination: place(packet.destination, segment.destination_port),
            },
            sequence_number: segment.sequence_number,
            syn: segment.syn,
            end: segment.fin || segment.rst,
            bytes: segment.payload.to_vec(),
        });
    }
    segments
}

fn follow(segments: &[Segment]) -> (Reported, Counters) {
    let (mut streams, mut reported) = (Streams::default(), Reported::default());
    for segment in segments {
        let chunk = Chunk {
            time: segment.time,
            stream: StreamId {
                flow: segment.flow,
                ..StreamId::default()
            },
            sequence_number: segment.sequence_number,
            syn: segment.syn,
            end: segment.end,
            boundary: None,
            before: MissingBefore::Unknown,
            bytes: &segment.bytes,
            length: u32::try_from(segment.bytes.len()).unwrap(),
        };
        streams.advance(segment.time, |report| reported.note(report));
        streams.chunk(&chunk, |report| reported.note(report));
        for table in streams.tables() {
            assert!(table.size <= table.limit, "{table:?}");
        }
    }
    let [table, _] = streams.tables();
    assert_eq!(table.evictions, 0);
    (reported, streams.counters())
}

#[test]
fn a_capture_has_as_many_batches_as_an_independent_decoder_found() {
    let (reported, counters) = follow(&segments());
    assert_eq!(reported.batches.len(), 3517);
    assert_eq!(counters.batches, 3517);
    assert_eq!((reported.gaps, counters.gaps), (0, 0));
    assert_eq!(counters.retransmitted_bytes, 797);
}

#[test]
fn reordered_and_repeated_segments_yield_the_same_batches() {
    let segments = segments();
    let (expected, _) = follow(&segments);
    let data = |segment: &Segment| !segment.bytes.is_empty() && !segment.end && !segment.syn;
    let mut shuffled = Vec::new();
    for (index, pair) in segments.chunks(2).enumerate() {
        match pair {
            [one, two] if data(one) && data(two) && index % 3 != 0 => {
                shuffled.extend([two.clone(), one.clone(), two.clone()]);
            }
            _ => shuffled.extend(pair.iter().cloned()),
        }
    }
    let (reported, counters) = follow(&shuffled);
    assert!(counters.retransmitted_bytes > 10_000, "{counters:?}");
    let sorted = |reported: &Reported| {
        let mut batches = reported.batches.clone();
        batches.sort_by_key(|(flow, _)| *flow);
        batches
    };
    assert_eq!(sorted(&reported), sorted(&expected));
}

#[test]
fn the_next_batch_boundary_is_found_soon_after_a_gap() {
    let mut segments = segments();
    let (expected, _) = follow(&segments);
    let busiest = |segment: &Segment| segment.bytes.len() > 300;
    let lost: Vec<_> = (2000..2003)
        .filter(|index| busiest(&segments[*index]))
        .collect();
    assert!(!lost.is_empty());
    for index in lost.into_iter().rev() {
        segments.remove(index);
    }
    let (reported, counters) = follow(&segments);
    assert!(counters.gaps > 0 && reported.gaps > 0);
    let missing = expected.batches.len() - reported.batches.len();
    assert!((1..=4).contains(&missing), "{missing}");
    let found = |batch| expected.batches.contains(batch);
    assert!(reported.batches.iter().all(found));
}

#[test]
fn a_connection_that_is_older_than_the_capture_is_found() {
    let segments = segments();
    let (expected, _) = follow(&segments);
    let (reported, counters) = follow(&segments[2500..]);
    assert!(reported.batches.len() > 1000, "{}", reported.batches.len());
    assert!(counters.unsynchronized_bytes < 1000, "{counters:?}");
    assert!(
        reported
            .batches
            .iter()
            .all(|batch| expected.batches.contains(batch))
    );
}

#[test]
fn connections_of_other_protocols_are_ignored_and_tls_is_reported() {
    let place = |port| ros2probe_model::facts::route::Destination {
        address: [1; 16],
        port,
    };
    let segment = |port, sequence_number, bytes: &[u8]| Segment {
        time: Timestamp(1),
        flow: Flow {
            source: place(1),
            destination: place(port),
        },
        sequence_number,
        syn: sequence_number == 9,
        end: sequence_number == 90_000,
        bytes: bytes.to_vec(),
    };
    let hello = b"\x16\x03\x01\x02\x00\x01\x00\x01\xfc\x03\x03";
    let request = b"GET / HTTP/1.1\r\nHost: robot\r\n\r\n";
    let (reported, _) = follow(&[
        segment(7447, 9, &[]),
        segment(7447, 10, hello),
        segment(443, 9, &[]),
        segment(443, 10, hello),
        segment(80, 9, &[]),
        segment(80, 10, request),
        segment(81, 10, request),
        // The source does not pass on the bytes between.
        segment(7447, 90_000, &[]),
        segment(443, 90_000, &[]),
        segment(80, 90_000, &[]),
    ]);
    assert_eq!((reported.tls, reported.ended), (1, 1));
    assert_eq!(reported.hellos, 1, "on another port");
    assert!(reported.batches.is_empty());
}

proptest! {
    #[test]
    fn arbitrary_segments_keep_the_count_of_held_bytes_correct(
        segments in prop::collection::vec(
            (0..4_u16, any::<u32>(), any::<(bool, bool, bool)>(), prop::collection::vec(any::<u8>(), 0..80), 0..100_000_u32),
            0..200,
        )
    ) {
        let mut streams = Streams::default();
        for (port, number, (syn, end, is_boundary), bytes, more) in &segments {
            let chunk = Chunk {
                time: Timestamp(u64::from(*number)),
                stream: StreamId {
                    flow: Flow {
                        source: ros2probe_model::facts::route::Destination { address: [0; 16], port: *port },
                        ..Flow::default()
                    },
                    ..StreamId::default()
                },
                sequence_number: *number % 1000,
                syn: *syn && *end,
                end: *end && !*syn,
                boundary: is_boundary.then_some(Protocol::Zenoh),
                before: [
                    MissingBefore::Unknown,
                    MissingBefore::Skipped,
                    MissingBefore::OverBudget,
                    MissingBefore::Lost,
                ][bytes.len() % 4],
                bytes,
                length: u32::try_from(bytes.len()).unwrap() + more,
            };
            streams.chunk(&chunk, |_| {});
            let held: usize = streams.streams.values().map(|stream| stream.held()).sum();
            prop_assert_eq!(held, streams.bytes());
        }
    }
}

/// Returns a chunk of the connection from this port.
fn chunk(port: u16, sequence_number: u32, bytes: &[u8]) -> Chunk<'_> {
    use ros2probe_model::facts::route::Destination;
    let source = Destination {
        address: [1; 16],
        port,
    };
    Chunk {
        time: Timestamp(1),
        stream: StreamId {
            flow: Flow {
                source,
                ..Flow::default()
            },
            ..StreamId::default()
        },
        sequence_number,
        syn: false,
        end: false,
        boundary: None,
        before: MissingBefore::Unknown,
        bytes,
        length: u32::try_from(bytes.len()).unwrap(),
    }
}

#[test]
fn directions_beyond_the_cap_evict_the_oldest_one_of_another_protocol() {
    let mut streams = Streams::default();
    let zenoh = Chunk {
        boundary: Some(Protocol::Zenoh),
        ..chunk(1, 1, &[1, 0, 4])
    };
    streams.chunk(&zenoh, |_| {});
    for port in 2..5002 {
        streams.chunk(&chunk(port, 1, &[0; 10]), |_| {});
    }
    assert_driven::<ZenohStreams>();
    let [table, bytes] = streams.tables();
    assert_eq!(table.evictions, 5001 - ZenohStreams::CAP as u64);
    assert_eq!(bytes.evictions, table.evictions);
    assert!(streams.follows_flow(&zenoh.stream.flow));
    assert!(!streams.follows_flow(&chunk(2, 1, &[]).stream.flow));
}

#[test]
fn unfinished_batches_stay_within_the_byte_cap() {
    let mut streams = Streams::default();
    let begun = [&[0xff, 0xff][..], &[5; 65_000]].concat();
    for port in 1..400 {
        let begun = Chunk {
            boundary: Some(Protocol::Zenoh),
            ..chunk(port, 1, &begun)
        };
        streams.chunk(&begun, |_| {});
        assert!(streams.bytes() <= ZenohStreamBytes::CAP);
    }
    assert_driven::<ZenohStreamBytes>();
    assert!(streams.bytes() > ZenohStreamBytes::CAP - 70_000);
    assert!(streams.tables()[1].evictions > 100);
}

#[test]
fn missing_bytes_are_given_up_when_the_cap_of_waiting_segments_is_reached() {
    let mut streams = Streams::default();
    let first = Chunk {
        boundary: Some(Protocol::Zenoh),
        ..chunk(1, 1, &[1, 0, 4])
    };
    streams.chunk(&first, |_| {});
    for number in 0..4096 {
        streams.chunk(&chunk(1, 100 + 3 * number, &[1, 0, 4]), |_| {});
    }
    assert_eq!(streams.counters().gaps, 0);
    streams.chunk(&chunk(1, 100_000, &[1, 0, 4]), |_| {});
    assert_eq!(streams.counters().gaps, 1);
    assert_driven::<SegmentsAhead>();
}

#[test]
fn missing_bytes_are_given_up_when_the_cap_of_waiting_bytes_is_reached() {
    let mut streams = Streams::default();
    let first = Chunk {
        boundary: Some(Protocol::Zenoh),
        ..chunk(1, 1, &[1, 0, 4])
    };
    streams.chunk(&first, |_| {});
    let segment = vec![0; 1 << 16];
    // Each segment takes memory in addition to its bytes.
    for number in 0..63 {
        streams.chunk(&chunk(1, 100 + (number << 16), &segment), |_| {});
    }
    assert_eq!(streams.counters().gaps, 0);
    assert!((63 << 16..4 << 20).contains(&streams.bytes()));
    streams.chunk(&chunk(1, 100 + (63 << 16), &segment), |_| {});
    assert_eq!(streams.counters().gaps, 1);
    assert_driven::<SegmentsAheadBytes>();
}

#[test]
fn possible_batches_are_collected_up_to_three_times_the_maximum_size() {
    let mut streams = Streams::default();
    let mut next = 1;
    let mut most = 0;
    for lane in 0..6 {
        // Each fragment is on a lane without another one.
        let header = [0xff, 0xff, 0xe6, 1, 0x31, lane];
        for part in [&header[..], &[0; 65_535 - 4]] {
            streams.chunk(&chunk(1, next, part), |_| {});
            next += u32::try_from(part.len()).unwrap();
            most = most.max(streams.bytes());
        }
    }
    // The buffer reserves memory in advance.
    assert!((3 * 65_537..=6 * 65_537).contains(&most), "{most} bytes");
    assert_eq!(streams.counters().batches, 0);
    assert_driven::<SearchedBytes>();
}

#[test]
fn ended_connections_leave_the_eviction_order_when_it_is_full() {
    let mut streams = Streams::default();
    for turn in 0..20_000 {
        let stays = turn % 8 == 0;
        let port = 1 + turn;
        streams.chunk(&chunk(port, 1, &[0; 10]), |_| {});
        let end = Chunk {
            end: true,
            ..chunk(port, 11, &[])
        };
        if !stays {
            streams.chunk(&end, |_| {});
        }
    }
    assert_eq!(streams.streams.len(), 2_500);
    assert_driven::<ZenohOrder>();
}

#[test]
fn connections_that_begin_anew_are_rarely_removed_from_the_eviction_order() {
    let (mut streams, mut cleanings) = (Streams::default(), 0);
    let connections = 4000;
    for turn in 1..=4 {
        for port in 1..=connections {
            let before = streams.order.len();
            let syn = Chunk {
                syn: true,
                ..chunk(port, turn, &[])
            };
            streams.chunk(&syn, |_| {});
            if streams.order.len() <= before {
                cleanings += 1;
                assert_eq!(streams.order.len(), usize::from(connections));
                assert_eq!(streams.order.back(), Some(&syn.stream));
            }
        }
    }
    assert_eq!(streams.streams.len(), usize::from(connections));
    assert_eq!(cleanings, 2);
}

#[test]
fn missing_bytes_are_given_up_after_the_clock_was_set_back() {
    let hour = 3_600_000_000_000;
    let mut streams = Streams::default();
    let first = Chunk {
        time: Timestamp(2 * hour),
        boundary: Some(Protocol::Zenoh),
        ..chunk(1, 1, &[1, 0, 4])
    };
    streams.chunk(&first, |_| {});
    let later = Chunk {
        time: Timestamp(2 * hour),
        ..chunk(1, 100, &[1, 0, 4])
    };
    streams.chunk(&later, |_| {});
    assert_eq!(streams.counters().gaps, 0);
    streams.advance(Timestamp(hour), |_| {});
    assert_eq!(streams.counters().gaps, 1);
}

/// Zenoh sends such a batch in place of the rest of a message that it drops.
#[test]
fn an_empty_batch_is_not_a_gap_but_a_run_of_zeros_is() {
    let first = [4, 0, 0x25, 1, 0x1d, 3, 0, 0, 4, 0, 0x25, 2, 0x1d, 3];
    for parts in 1..first.len() {
        let (mut streams, mut reported) = (Streams::default(), Reported::default());
        let mut next = 1;
        for part in first.chunks(parts) {
            let chunk = Chunk {
                boundary: (next == 1).then_some(Protocol::Zenoh),
                ..chunk(1, next, part)
            };
            streams.chunk(&chunk, |report| reported.note(report));
            next += u32::try_from(part.len()).unwrap();
        }
        assert_eq!((reported.batches.len(), reported.gaps), (2, 0), "{parts}");
        streams.chunk(&chunk(1, next, &[0; 128]), |report| reported.note(report));
        assert_eq!(reported.gaps, 0);
        streams.chunk(&chunk(1, next + 128, &[0; 2]), |report| {
            reported.note(report);
        });
        assert_eq!((reported.batches.len(), reported.gaps), (2, 1), "{parts}");
    }
}

/// Reads batches, each in a chunk with this TCP sequence number. Returns the numbers of batches and
/// gaps after each chunk.
fn progress(streams: &mut Streams, chunks: &[(u32, MissingBefore)]) -> Vec<(usize, u64)> {
    let mut reported = Reported::default();
    let chunks = chunks.iter().map(|(number, before)| {
        let chunk = Chunk {
            boundary: Some(Protocol::Zenoh),
            before: *before,
            ..chunk(1, *number, &[4, 0, 0x25, 1, 0x1d, 3])
        };
        streams.chunk(&chunk, |report| reported.note(report));
        (reported.batches.len(), reported.gaps)
    });
    chunks.collect()
}

#[test]
fn skipped_bytes_are_not_a_gap_but_lost_bytes_are() {
    let mut streams = Streams::default();
    let chunks = [
        (1, MissingBefore::Unknown),
        (1001, MissingBefore::Skipped),
        (1007, MissingBefore::Unknown),
        (2013, MissingBefore::Lost),
        (2019, MissingBefore::Unknown),
    ];
    assert_eq!(
        progress(&mut streams, &chunks),
        [(1, 0), (2, 0), (3, 0), (4, 1), (5, 1)]
    );
    assert_eq!(
        (streams.counters().gaps, streams.counters().batches),
        (1, 5)
    );
}

#[test]
fn batches_over_the_budget_are_a_gap_between_batches() {
    let chunks = [
        (1, MissingBefore::Unknown),
        (1001, MissingBefore::OverBudget),
        // The chunk before this one is late, and so is what is known about the bytes before it.
        (1019, MissingBefore::Unknown),
        (1007, MissingBefore::Unknown),
        (2013, MissingBefore::Unknown),
        (2007, MissingBefore::OverBudget),
        (1013, MissingBefore::Unknown),
        (2019, MissingBefore::Skipped),
    ];
    assert_eq!(
        progress(&mut Streams::default(), &chunks),
        [
            (1, 0),
            (2, 1),
            (2, 1),
            (3, 1),
            (3, 1),
            (3, 1),
            (7, 2),
            (8, 2)
        ]
    );
}

/// Returns a UDP datagram over IPv4 between these ports, as a raw packet.
fn datagram(source_port: u16, destination_port: u16, payload: &[u8]) -> Vec<u8> {
    let length = |header: usize| u16::try_from(payload.len() + header).unwrap().to_be_bytes();
    let mut bytes = vec![0x45, 0];
    bytes.extend(length(28));
    bytes.extend([0, 0, 0x40, 0, 64, 17, 0, 0]);
    let (client, server) = ([10, 0, 0, 1], [10, 0, 0, 2]);
    let is_answer = source_port == 7447;
    bytes.extend(match is_answer {
        true => [server, client].concat(),
        false => [client, server].concat(),
    });
    bytes.extend(source_port.to_be_bytes());
    bytes.extend(destination_port.to_be_bytes());
    bytes.extend(length(8));
    bytes.extend([0, 0]);
    bytes.extend(payload);
    bytes
}

/// Replays datagrams between these ports; returns the number of QUIC connections.
fn quic_in(datagrams: &[(u16, u16, Vec<u8>)]) -> u64 {
    use crate::frame_decoder::FrameDecoder;
    use crate::pcap::Captured;
    use crate::reassembly::Limits;
    use ros2probe_model::observe::observer::{Observer, Settings};
    use ros2probe_wire::frame::Link;

    let mut observer = Observer::new(Settings::default());
    let mut decoder = FrameDecoder::new(Limits::default());
    for (source_port, destination_port, payload) in datagrams {
        let packet = datagram(*source_port, *destination_port, payload);
        let captured = Captured {
            time: Timestamp(1),
            link: Link::RAW,
            interface: 0,
            bytes: &packet,
            length: u32::try_from(packet.len()).unwrap(),
        };
        decoder.packet(&captured, &mut observer);
    }
    let facts = observer.snapshot(Timestamp(2)).zenoh;
    let unseen = facts.iter().flat_map(|facts| facts.unseen());
    let quic = unseen.inspect(|(reason, _)| assert_eq!(*reason, Unseen::Quic));
    quic.map(|(_, connections)| connections).sum()
}

/// Returns an Initial packet as RFC 9001, A.2 pads it, in this version.
fn initial(version: [u8; 4]) -> Vec<u8> {
    let first = if version == [0, 0, 0, 1] { 0xc3 } else { 0xd3 };
    let mut bytes = [&[first][..], &version, &[8]].concat();
    bytes.resize(1200, 0x5a);
    bytes
}

#[test]
fn quic_on_a_port_of_zenoh_in_a_capture_is_reported() {
    for version in [[0, 0, 0, 1], [0x6b, 0x33, 0x43, 0xcf]] {
        let packet = initial(version);
        assert_eq!(quic_in(&[(50_000, 7447, packet.clone())]), 1);
        assert_eq!(quic_in(&[(7447, 50_000, packet.clone())]), 1);
        let both = [50_000, 50_001]
            .map(|port| [(port, 7447, packet.clone()), (7447, port, packet.clone())]);
        assert_eq!(quic_in(&both.concat()), 1, "between two addresses");
    }
}

#[test]
fn other_datagrams_on_a_port_of_zenoh_do_not_count_as_quic() {
    let short_header = [&[0x43][..], &[0x5a; 1251]].concat();
    let draft = initial([0xff, 0, 0, 0x1d]);
    let cut = initial([0, 0, 0, 1])[..1199].to_vec();
    let rtps = [&b"RTPS\x02\x03"[..], &[0; 1300]].concat();
    for payload in [short_header, draft, cut, rtps, vec![], vec![0xc0]] {
        assert_eq!(quic_in(&[(50_000, 7447, payload)]), 0);
    }
    // The ports are those of scouting and of HTTP/3.
    for port in [7446, 443] {
        assert_eq!(quic_in(&[(50_000, port, initial([0, 0, 0, 1]))]), 0);
    }
}

proptest! {
    #[test]
    fn random_datagrams_are_not_quic(bytes in proptest::collection::vec(any::<u8>(), 0..1500)) {
        prop_assert_eq!(quic_in(&[(50_000, 7447, bytes)]), 0);
    }
}
