//! Connections of RTPS.

use proptest::prelude::*;
use ros2probe_model::facts::route::Destination;
use ros2probe_model::graph::zenoh::Flow;

use super::super::stream::MAX_FRAME;
use super::super::*;

const ONE: GuidPrefix = GuidPrefix([1; 12]);
const OTHER: GuidPrefix = GuidPrefix([2; 12]);
/// The domain's port of user data for participant 0.
const PORT: u16 = 7411;

/// A message of a direction: its bytes, its whole length, and its receiver.
#[derive(Clone, PartialEq, Eq, Debug)]
struct Read {
    bytes: Vec<u8>,
    length: u32,
    receiver: GuidPrefix,
}

/// A message of a participant with `body` after its header.
fn message(sender: GuidPrefix, body: &[u8]) -> Vec<u8> {
    let mut message = b"RTPS\x02\x03\x01\x0f".to_vec();
    message.extend(sender.0);
    message.extend(body);
    message
}

fn frame(message: &[u8], port: u16) -> Vec<u8> {
    let mut frame = b"RTCP".to_vec();
    frame.extend((message.len() as u32 + 14).to_le_bytes());
    frame.extend([0; 4]);
    frame.extend(port.to_le_bytes());
    frame.extend(message);
    frame
}

/// OPEN_LOGICAL_PORT without a payload.
fn control() -> Vec<u8> {
    let mut body = vec![0xd2, 2, 16, 0];
    body.extend([7; 12]);
    frame(&body, 0)
}

const fn flow() -> Flow {
    Flow {
        source: place_of(40_000),
        destination: place_of(5100),
    }
}

const fn place_of(port: u16) -> Destination {
    Destination {
        address: [9; 16],
        port,
    }
}

/// Returns bytes of a connection in one direction.
fn chunk(flow: Flow, sequence_number: u32, bytes: &[u8]) -> Chunk<'_> {
    Chunk {
        time: Timestamp(1),
        stream: StreamId {
            flow,
            ..StreamId::default()
        },
        sequence_number,
        syn: false,
        end: false,
        boundary: None,
        before: MissingBefore::Unknown,
        bytes,
        length: bytes.len() as u32,
    }
}

/// A connection, of which `passed` bytes were sent in each direction.
#[derive(Default)]
struct Connection {
    streams: Streams,
    passed: [u32; 2],
    read: Vec<Read>,
}

impl Connection {
    fn send(&mut self, there: bool, bytes: &[u8], length: usize) {
        let flow = if there { flow() } else { flow().reversed() };
        let passed = &mut self.passed[usize::from(there)];
        let length = length as u32;
        let chunk = Chunk {
            length,
            ..chunk(flow, *passed, bytes)
        };
        *passed = passed.wrapping_add(length);
        let read = &mut self.read;
        self.streams.chunk(&chunk, |streamed| {
            let Streamed::Message {
                envelope,
                bytes,
                length,
            } = streamed
            else {
                panic!("{streamed:?}");
            };
            assert_eq!(envelope.destination_port, flow.destination.port);
            assert_eq!(envelope.logical_port, PORT);
            read.push(Read {
                bytes: bytes.to_vec(),
                length: *length,
                receiver: envelope.receiver,
            });
        });
    }

    fn whole(&mut self, there: bool, bytes: &[u8]) {
        self.send(there, bytes, bytes.len());
    }
}

fn read(message: &[u8], receiver: GuidPrefix) -> Read {
    Read {
        bytes: message.to_vec(),
        length: message.len() as u32,
        receiver,
    }
}

proptest! {
    #[test]
    fn messages_are_read_wherever_segments_divide_them(
        bodies in prop::collection::vec(prop::collection::vec(any::<u8>(), 0..200), 1..20),
        cuts in prop::collection::vec(any::<prop::sample::Index>(), 0..40),
    ) {
        let messages: Vec<_> = bodies.iter().map(|body| message(ONE, body)).collect();
        let mut bytes = control();
        // The first segment has the beginning of a frame whole.
        let whole = bytes.len();
        bytes.extend(messages.iter().flat_map(|message| frame(message, PORT)));
        let mut cuts: Vec<_> = cuts.iter().map(|cut| whole + cut.index(bytes.len() - whole)).collect();
        cuts.extend([0, bytes.len()]);
        cuts.sort_unstable();
        let mut connection = Connection::default();
        for pair in cuts.windows(2) {
            connection.whole(true, &bytes[pair[0]..pair[1]]);
        }
        let expected: Vec<_> = messages.iter().map(|each| read(each, GuidPrefix::UNKNOWN)).collect();
        prop_assert_eq!(connection.read, expected);
    }
}

#[test]
fn the_sender_of_one_direction_receives_in_the_other_one() {
    let mut connection = Connection::default();
    let (one, other) = (message(ONE, b"a"), message(OTHER, b"b"));
    connection.whole(true, &frame(&one, PORT));
    connection.whole(false, &frame(&other, PORT));
    connection.whole(true, &frame(&one, PORT));
    let expected = [
        read(&one, GuidPrefix::UNKNOWN),
        read(&other, ONE),
        read(&one, OTHER),
    ];
    assert_eq!(connection.read, expected);
}

#[test]
fn a_connection_that_is_older_than_the_capture_is_read_from_its_next_frame_on() {
    let mut connection = Connection::default();
    let (cut, next) = (message(ONE, &[5; 300]), message(ONE, b"next"));
    let mut bytes = frame(&cut, PORT)[100..].to_vec();
    bytes.extend(frame(&next, PORT));
    connection.whole(true, &bytes);
    assert_eq!(connection.read, [read(&next, GuidPrefix::UNKNOWN)]);
}

/// The beginning of a ClientHello of TLS 1.3, as OpenSSL sends it.
const CLIENT_HELLO: [u8; 12] = [0x16, 3, 1, 0, 0xfa, 1, 0, 0, 0xf6, 3, 3, 0x9c];

#[test]
fn a_connection_that_begins_with_a_clients_hello_of_tls_is_reported_once() {
    let mut streams = Streams::default();
    let mut hellos = Vec::new();
    let mut pass = |bytes: &[u8], to, number| {
        let flow = Flow {
            source: place_of(40_000),
            destination: place_of(to),
        };
        let chunk = Chunk {
            syn: number == 0,
            ..chunk(flow, number, bytes)
        };
        streams.chunk(&chunk, |streamed| {
            if let Streamed::ClientHello(flow) = streamed {
                hellos.push(flow.destination.port);
            }
        });
    };
    let frame = frame(&message(ONE, b"plain"), PORT);
    for (to, bytes) in [
        (5100, &CLIENT_HELLO[..]),
        (5101, &frame),
        (7447, &CLIENT_HELLO),
    ] {
        pass(&[], to, 0);
        pass(bytes, to, 1);
        // Later bytes that look like it are in the middle of the connection.
        pass(&CLIENT_HELLO, to, 1 + bytes.len() as u32);
    }
    assert_eq!(hellos, [5100]);
}

#[test]
fn missing_bytes_lose_the_messages_that_contain_them() {
    let mut connection = Connection::default();
    let messages = [b"1", b"2", b"3", b"4"].map(|body| message(ONE, body));
    connection.whole(true, &frame(&messages[0], PORT));
    // Ten bytes of the second frame never arrive.
    connection.passed[1] += 10;
    connection.whole(true, &frame(&messages[1], PORT)[10..]);
    connection.whole(true, &frame(&messages[2], PORT));
    let late = Timestamp(20_000_000_000);
    let (mut found, mut gaps) = (Vec::new(), Vec::new());
    connection.streams.advance(late, |streamed| match streamed {
        Streamed::Message { bytes, .. } => found.push(bytes.to_vec()),
        Streamed::Gap(destination, time) => gaps.push((*destination, *time)),
        _ => panic!("{streamed:?}"),
    });
    assert_eq!(found, [messages[2].clone()]);
    assert_eq!(gaps, [(place_of(5100), late)]);
    assert_eq!(connection.streams.counters().frame_gaps, 1);
    connection.whole(true, &frame(&messages[3], PORT));
    assert_eq!(connection.read.len(), 2);
}

#[test]
fn a_message_of_which_only_the_beginning_was_captured_keeps_its_length() {
    let mut connection = Connection::default();
    let message = message(ONE, &[7; 60_000]);
    let frame = frame(&message, PORT);
    connection.send(true, &frame[..200], 1448);
    connection.send(true, &[], frame.len() - 1448);
    connection.whole(true, &frame[..200]);
    let [read] = &connection.read[..] else {
        panic!("{:?}", connection.read.len())
    };
    assert_eq!(read.bytes, message[..186]);
    assert_eq!(read.length as usize, message.len());
}

#[test]
fn a_frame_longer_than_the_limit_is_passed_with_its_first_bytes() {
    let mut connection = Connection::default();
    let length = MAX_FRAME + 100_000;
    let mut frame = frame(&message(ONE, &[]), PORT);
    frame[4..8].copy_from_slice(&(length as u32).to_le_bytes());
    frame.resize(length, 3);
    for segment in frame.chunks(65_160) {
        connection.whole(true, segment);
        assert!(connection.streams.bytes() <= 2 * MAX_FRAME);
    }
    let [read] = &connection.read[..] else {
        panic!("{:?}", connection.read.len())
    };
    assert_eq!(read.bytes.len() + 14, MAX_FRAME);
    assert_eq!(read.length as usize + 14, length);
}

#[test]
fn a_header_within_a_payload_of_a_known_direction_is_ignored() {
    let mut connection = Connection::default();
    let inner = frame(&message(OTHER, b"inner"), PORT);
    let outer = message(ONE, &inner);
    connection.whole(true, &frame(&outer, PORT));
    connection.whole(true, &frame(&outer, PORT));
    let outer = read(&outer, GuidPrefix::UNKNOWN);
    assert_eq!(connection.read, [outer.clone(), outer]);
}

/// Many directions begin a large frame at the same time.
#[test]
fn frames_beyond_the_byte_cap_lose_their_payload_and_each_direction_stays_synchronized() {
    const HALF: usize = 3 << 20;
    let mut streams = Streams::default();
    let mut large = frame(&message(ONE, &[]), PORT);
    large[4..8].copy_from_slice(&(2 * HALF as u32).to_le_bytes());
    large.resize(2 * HALF, 3);
    let next = message(ONE, b"next");
    let (mut lengths, mut last) = (Vec::new(), 0);
    for step in 0..3 {
        for port in 0..20_u16 {
            let flow = Flow {
                source: place_of(40_000 + port),
                destination: place_of(5100),
            };
            let (from, bytes) = match step {
                0 => (0, &large[..HALF]),
                1 => (HALF, &large[HALF..]),
                _ => (2 * HALF, &frame(&next, PORT)[..]),
            };
            streams.chunk(&chunk(flow, from as u32, bytes), |streamed| {
                if let Streamed::Message { bytes, length, .. } = streamed {
                    match **bytes == *next {
                        true => last += 1,
                        false => lengths.push(*length),
                    }
                }
            });
            let [_, held] = streams.tables();
            assert!(held.size <= held.limit, "{held:?}");
        }
    }
    assert_eq!(lengths, vec![2 * HALF as u32 - 14; 20]);
    assert_eq!((last, streams.counters().frame_gaps), (20, 0));
}
