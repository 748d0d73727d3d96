//! Bodies of the fuzz targets: plain functions, so that the tests run them too, over the committed
//! seeds and all their truncations (`agent/cli/tests/surface/fuzz_seeds.rs`).
//!
//! Each function reads its bytes as the agent does, and asserts what must hold for any bytes. A
//! reader never panics, returns nothing that is not in its input, ends, and stays at its end.

use std::fs;
use std::io::{Cursor, Write as _};
use std::path::Path;
use std::sync::{Arc, LazyLock};
use std::time::Duration;

use md5::{Digest as _, Md5};
use ros2probe::ros2::Dialect;
use ros2probe::ros2::bag::{self, Sort};
use ros2probe_attach::library;
use ros2probe_bag::info::Bag;
use ros2probe_bag::reindex::{Found, reindex};
use ros2probe_capture::border::observe;
use ros2probe_capture::pcap::PcapReader;
use ros2probe_capture::reassembly::{FlowKey, Limits, Reassembly};
use ros2probe_capture::ring::block::Frames;
use ros2probe_capture::shm::cell::Cell;
use ros2probe_capture::shm::classifier::MessageClassifier;
use ros2probe_capture::shm::port::Port;
use ros2probe_capture::shm::segment::{Buffer, Message};
use ros2probe_capture::streams::{Chunk, MissingBefore, Protocol, Streamed, Streams};
use ros2probe_daemon::config::{Config, Watch, Watchlist};
use ros2probe_daemon::surface::foxglove::protocol;
use ros2probe_daemon::surface::ros2_daemon::call::{self, Argument, Call};
use ros2probe_message::filter::{Filter, Subject};
use ros2probe_message::library::{DescribedFigures, Library, Sources};
use ros2probe_message::{Decoded, Definition, MessageType, Truncation, csv, decode, yaml};
use ros2probe_model::derive::robot::Parts;
use ros2probe_model::facts::route::Destination;
use ros2probe_model::facts::selection::{Depth, SampleRequest, Selection};
use ros2probe_model::graph::zenoh::{Flow, StreamId};
use ros2probe_model::observe::input::{Captured, Input};
use ros2probe_model::observe::observer::{Observer, Settings};
use ros2probe_wire::discovery::EquivalenceHash;
use ros2probe_wire::frame::{self, Packet, Payload};
use ros2probe_wire::record::Record;
use ros2probe_wire::walk::{self, Envelope};
use ros2probe_wire::{Expansion, Timestamp};
use zerocopy::FromBytes as _;

/// Lengths of a block's header, and of a frame's header with its address.
const BLOCK_HEADER: usize = 48;
const FRAME_HEADER: usize = 48;
/// Maximum number of packets read: a compressed capture may have any length.
const PACKETS: u64 = 10_000;

/// Reads a capture file, through reassembly and walk.
pub fn capture(bytes: &[u8]) {
    let Ok(mut reader) = PcapReader::new(Cursor::new(bytes.to_vec()), Expansion::Limited) else {
        return;
    };
    let mut inside = Inside::default();
    while let Ok(Some(packet)) = reader.next_packet() {
        assert!(packet.bytes.len() <= 262_144);
        if let Ok(frame) = frame::parse(packet.link, packet.bytes, packet.length)
            && let Some(found) = &frame.packet
        {
            inside.packet(packet.time, packet.interface, found);
        }
        if reader.packets() == PACKETS {
            return;
        }
    }
    assert!(matches!(reader.next_packet(), Ok(None)));
}

/// Reads segments of two TCP connections, and passes what they contain to the model. Five bytes
/// precede each segment: flags, the distance from the next expected byte, how much was not captured
/// and whether the kernel found a boundary, and the length.
pub fn stream(bytes: &[u8]) {
    const START: u64 = 1_795_143_000_000_000_000;
    let mut observer = small_observer();
    let mut streams = Streams::default();
    let mut next = [0x1000_u32; 4];
    let mut now = START;
    let mut rest = bytes;
    while let Some(([flags, distance, cut, low, high], behind)) = rest.split_first_chunk::<5>() {
        let length = usize::from(u16::from_le_bytes([*low, *high])).min(behind.len());
        let (content, behind) = behind.split_at(length);
        rest = behind;
        now += 1_000_000 << (flags >> 6);
        let direction = usize::from(flags & 3);
        let length = content.len() as u32 + u32::from(*cut & 0x3f) * 256;
        let syn = flags & 4 != 0;
        let expected = next.get(direction).copied().unwrap_or_default();
        let number = expected.wrapping_add_signed(i32::from(distance.cast_signed()) * 7);
        if let Some(next) = next.get_mut(direction) {
            *next = number.wrapping_add(length).wrapping_add(u32::from(syn));
        }
        let chunk = Chunk {
            time: Timestamp(now),
            stream: direction_of(flags & 3),
            sequence_number: number,
            syn,
            end: flags & 8 != 0,
            boundary: match cut >> 6 {
                1 => Some(Protocol::Zenoh),
                2 => Some(Protocol::Rtps),
                _ => None,
            },
            before: match flags >> 4 & 3 {
                1 => MissingBefore::Skipped,
                2 => MissingBefore::Lost,
                3 => MissingBefore::OverBudget,
                _ => MissingBefore::Unknown,
            },
            bytes: content,
            length,
        };
        streams.chunk(&chunk, |streamed| {
            check(streamed, now);
            streamed.pass_to(&mut observer);
        });
        observer.drain();
    }
    // Segments that wait for missing ones are given up.
    now += 60_000_000_000;
    streams.advance(Timestamp(now), |streamed| {
        check(streamed, now);
        streamed.pass_to(&mut observer);
    });
    for table in streams.tables() {
        assert!(table.size <= table.limit, "{table:?}");
    }
    observer.input(Input::End);
    for table in &observer.snapshot(Timestamp(now)).tables {
        assert!(table.size <= table.limit, "{table:?}");
    }
}

fn check(streamed: &Streamed<'_>, now: u64) {
    match streamed {
        Streamed::Message {
            envelope,
            bytes,
            length,
        } => {
            assert!(bytes.len() as u64 <= u64::from(*length));
            assert!(envelope.time <= now);
        }
        Streamed::Zenoh(_) | Streamed::Gap(..) | Streamed::ClientHello(_) => {}
    }
}

/// Returns one of the directions of two connections.
fn direction_of(number: u8) -> StreamId {
    let place = |port| Destination {
        address: [9; 16],
        port,
    };
    let flow = Flow {
        source: place(40_000 + u16::from(number / 2)),
        destination: place(7447),
    };
    StreamId {
        flow: if number.is_multiple_of(2) {
            flow
        } else {
            flow.reversed()
        },
        ..StreamId::default()
    }
}

/// Reads a message of a viewer. An accepted message has no more ids than fit into its text.
pub fn viewer(bytes: &[u8]) {
    let Ok(text) = std::str::from_utf8(bytes) else {
        return;
    };
    match protocol::parse(text) {
        Ok(protocol::Request::Subscribe(wanted)) => assert!(wanted.len() <= text.len() / 8),
        Ok(protocol::Request::Unsubscribe(ids)) => assert!(ids.len() <= text.len()),
        Ok(protocol::Request::Unsupported(op)) => assert!(op.len() <= text.len()),
        Ok(_) | Err(protocol::Malformed) => {}
    }
}

/// Reads a request of the `ros2` command line. An accepted call has no more text than the request.
pub fn ros2_daemon(bytes: &[u8]) {
    let Ok(Call { method, arguments }) = call::parse(bytes) else {
        return;
    };
    let length = |argument: &Argument| match argument {
        Argument::Text(text) => text.len(),
        _ => 0,
    };
    assert!(arguments.len() <= 8);
    assert!(method.len() + arguments.iter().map(length).sum::<usize>() <= bytes.len());
}

/// Reads a block of the packet ring, through reassembly and walk.
pub fn ring_block(bytes: &[u8]) {
    let mut frames = Frames::new(bytes);
    let mut inside = Inside::default();
    let mut count = 0;
    for captured in frames.by_ref() {
        count += 1;
        assert!(count * FRAME_HEADER + BLOCK_HEADER <= bytes.len() + FRAME_HEADER);
        let range = captured.bytes.as_ptr_range();
        assert!(bytes.as_ptr_range().start <= range.start && range.end <= bytes.as_ptr_range().end);
        let packet = frame::parse_cooked(
            captured.protocol,
            captured.packet_type,
            captured.bytes,
            captured.length,
        );
        if let Ok(Some(packet)) = packet {
            inside.packet(captured.time, captured.interface, &packet);
        }
    }
    assert_eq!(frames.next(), None);
}

/// Reads a port of Fast DDS's shared memory, the same port a moment later, and a segment. The
/// lengths of the first two precede them, little-endian.
pub fn shared_memory(bytes: &[u8]) {
    const PORT: u32 = 7411;
    const MOMENT: u64 = 1_000_000;
    let Some((lengths, rest)) = bytes.split_first_chunk::<4>() else {
        return;
    };
    let [before, after] = [[lengths[0], lengths[1]], [lengths[2], lengths[3]]];
    let [before, after] = [before, after].map(|length| usize::from(u16::from_le_bytes(length)));
    let Some((before, rest)) = rest.split_at_checked(before) else {
        return;
    };
    let Some((after, segment)) = rest.split_at_checked(after) else {
        return;
    };
    let Some((mut port, mut announced)) = Port::attach(before, PORT, 0) else {
        return;
    };
    assert!(announced.len() * Cell::LEN <= before.len());
    for (round, file) in [after, before, after].into_iter().enumerate() {
        let known = announced.len();
        let now = MOMENT * (round as u64 + 1);
        let Some(look) = port.poll(file, now, &mut announced) else {
            break;
        };
        assert!((announced.len() - known) as u64 <= look.pushed);
        assert!((announced.len() - known) * Cell::LEN <= file.len());
    }
    let mut judge = MessageClassifier::default();
    for descriptor in &announced {
        let Ok(buffer) = Buffer::find(segment, descriptor) else {
            continue;
        };
        assert!(buffer.is_valid(segment));
        let mut records = Vec::new();
        let message = Message::new(segment, buffer);
        judge.classify(&message, buffer.length, Record::default(), &mut records);
        assert!(records.len() <= buffer.length as usize);
        let mut whole = Vec::new();
        if buffer.read(segment, &mut whole) {
            assert!(whole.len() <= segment.len());
        }
    }
}

/// Reads a configuration file.
pub fn configuration(bytes: &[u8]) {
    match Config::parse(bytes) {
        Ok(config) => assert_eq!(config.needs_restart(&config), [""; 0]),
        Err(mistakes) => {
            assert!(!mistakes.is_empty());
            let lines = bytes.split(|byte| b"\r\n".contains(byte)).count();
            for mistake in mistakes.iter() {
                assert!(mistake.position.line <= lines + 1, "{mistake} of {lines}");
            }
            assert!(mistakes.report("file").lines().count() >= 1);
        }
    }
}

/// Reads a message definition: as each kind of file, and as a bag's schema.
pub fn definition(bytes: &[u8]) {
    let Ok(text) = std::str::from_utf8(bytes) else {
        return;
    };
    let lines = text.split(['\r', '\n']).count();
    for name in ["a/msg/B", "a/srv/B", "a/action/B"] {
        let name = || name.parse().expect("a type's name");
        if let Err(mistake) = Definition::parse(name(), text) {
            assert!((1..=lines).contains(&mistake.line), "{mistake} of {lines}");
        }
        match Definition::parse_idl(name(), text) {
            // The text of the definition is equivalent.
            Ok(read) => assert_eq!(Definition::parse(name(), &read.text), Ok(read)),
            Err(mistake) => assert!((1..=lines).contains(&mistake.line), "{mistake} of {lines}"),
        }
    }
    let root = "a/msg/B".parse().expect("a type's name");
    if let Ok(read) = MessageType::parse(&root, text) {
        for structure in read.structures() {
            assert!(read.structure(&structure.name).is_some());
            assert!(structure.fields.len() <= text.len());
        }
        let (encoding, written) = read.schema_text();
        assert_eq!(encoding, "ros2msg");
        let again = MessageType::parse(&root, &written).expect("what was read");
        assert_eq!(again.type_hash(), read.type_hash());
    }
}

/// Reads a reply of the TypeLookup service, then one with the bytes as a TypeObject whose hash
/// fits.
pub fn type_objects(bytes: &[u8]) {
    const NAME: &str = "my_robot_msgs/msg/Part";
    let mut object = (bytes.len() as u32).to_le_bytes().to_vec();
    object.extend(bytes);
    let digest = Md5::digest(&object);
    let hash = EquivalenceHash(*digest.first_chunk().expect("14 of 16 bytes"));
    let library = Library::new(Sources::default());
    library.offer_objects(bytes.into());
    library.offer_objects(reply(hash, &object).into());
    for announced in [Some(hash.to_string()), None] {
        if let Ok(found) = library.find(NAME, announced.as_deref()) {
            for structure in found.structures() {
                assert!(structure.fields.len() <= bytes.len());
            }
            let root = NAME.parse().expect("a type's name");
            let again = MessageType::parse(&root, &found.schema_text().1);
            assert_eq!(again.expect("what was read").type_hash(), found.type_hash());
        }
    }
    let figures = library.described_figures();
    assert!(figures.objects <= DescribedFigures::MAX_OBJECTS);
    assert!(figures.object_bytes <= DescribedFigures::MAX_OBJECT_BYTES);
}

/// Returns a reply with one TypeObject.
fn reply(hash: EquivalenceHash, object: &[u8]) -> Vec<u8> {
    let sized = |bytes: Vec<u8>| [&(bytes.len() as u32).to_le_bytes()[..], &bytes].concat();
    let pair = [&[1, 0, 0, 0, 0xf2][..], &hash.0, &[0], object].concat();
    // The member `types`, whose size is also that of the sequence.
    let types = [&[0xd1, 0x4a, 0x80, 0x52][..], &sized(pair)].concat();
    let result = [&[0; 4][..], &sized(types)].concat();
    let returned = [&[0xd3, 0x52, 0x82, 0x01][..], &sized(result)].concat();
    [&[0, 7, 0, 0][..], &[0; 28], &sized(returned)].concat()
}

/// Types with which payloads are decoded; the first byte selects one.
static TYPES: LazyLock<Vec<MessageType>> = LazyLock::new(|| {
    macro_rules! text {
        ($name:literal) => {
            include_str!(concat!(
                "../../testing/data/definitions/test_msgs/msg/",
                $name,
                ".msg"
            ))
        };
    }
    let parts = [
        ("BasicTypes", text!("BasicTypes")),
        ("Constants", text!("Constants")),
        ("Defaults", text!("Defaults")),
        ("Arrays", text!("Arrays")),
        ("BoundedSequences", text!("BoundedSequences")),
        ("UnboundedSequences", text!("UnboundedSequences")),
    ];
    let line = "=".repeat(80);
    let parts: String = parts
        .iter()
        .map(|(name, text)| format!("\n{line}\nMSG: test_msgs/{name}\n{text}"))
        .collect();
    let roots = [
        text!("MultiNested"),
        text!("UnboundedSequences"),
        text!("BoundedSequences"),
        text!("Arrays"),
        text!("Strings"),
        text!("WStrings"),
        text!("Nested"),
        text!("Empty"),
    ];
    let root = "fuzz/msg/Root".parse().expect("a name");
    let types = roots
        .iter()
        .map(|text| MessageType::parse(&root, &format!("{text}{parts}")));
    types.collect::<Result<_, _>>().expect("definitions")
});

/// Reads a payload, whole and in part, and prints it.
pub fn message(bytes: &[u8]) {
    // Maximum length of the text per octet of payload: each octet may have a line of its own.
    const LONGEST: usize = 64;
    let Some((choice, payload)) = bytes.split_first() else {
        return;
    };
    let Some(message_type) = TYPES.get(usize::from(*choice) % TYPES.len()) else {
        return;
    };
    let whole = decode(message_type, payload, &decode::Limits::default());
    let part = decode::Limits {
        kept: 2,
        ..Default::default()
    };
    let part = decode(message_type, payload, &part);
    let trailing = |decoded: &Decoded<'_>| decoded.oddities.trailing;
    assert_eq!(whole.as_ref().map(trailing), part.as_ref().map(trailing));
    let Ok(Decoded { message, .. }) = &whole else {
        return;
    };
    let all = Truncation::default();
    let line = csv::line(message, &all);
    assert!(line.len() <= (payload.len() + 64) * LONGEST);
    for style in [yaml::Style::Block, yaml::Style::Flow] {
        let document = yaml::document(message, &all, style);
        assert!(document.ends_with('\n') && document.len() <= (payload.len() + 64) * LONGEST);
    }
    let few = Truncation {
        truncate: Some(2),
        ..all
    };
    if let Ok(part) = &part {
        assert_eq!(csv::line(&part.message, &few), csv::line(message, &few));
    }
}

/// Reads a condition, a line break, and the message on which the condition is evaluated, in the
/// form that [`message`] reads.
pub fn filter(bytes: &[u8]) {
    let mut parts = bytes.splitn(2, |byte| *byte == b'\n');
    let (Some(condition), Some(rest)) = (parts.next(), parts.next()) else {
        return;
    };
    let Ok(condition) = std::str::from_utf8(condition) else {
        return;
    };
    let columns = condition.chars().count() + 1;
    let filter = match Filter::parse(condition) {
        Ok(filter) => filter,
        Err(error) => return assert!((1..=columns).contains(&error.column), "{error}"),
    };
    let asked = |subject| {
        if let Err(error) = filter.passes(subject) {
            assert!((1..=columns).contains(&error.column), "{error}");
        }
    };
    asked(Subject::Bytes(rest));
    let Some((choice, payload)) = rest.split_first() else {
        return;
    };
    let message_type = TYPES.get(usize::from(*choice) % TYPES.len());
    let message = message_type.map(|found| decode(found, payload, &decode::Limits::default()));
    if let Some(Ok(Decoded { message, .. })) = &message {
        asked(Subject::Message(message));
    }
}

/// Reads a bag of one file. The first byte chooses the file's name, the next two are the length of
/// its metadata.yaml, little-endian; 0 means that the bag has none.
pub fn bag_file(bytes: &[u8]) {
    let Some(([choice, low, high], rest)) = bytes.split_first_chunk::<3>() else {
        return;
    };
    let length = usize::from(u16::from_le_bytes([*low, *high]));
    let Some((metadata, file)) = rest.split_at_checked(length) else {
        return;
    };
    let directory = scratch(|place| tempfile::tempdir_in(place)).expect("a directory");
    let directory = directory.path();
    let name = ["a_0.mcap", "a_0.mcap.zstd", "a_0.mcap.lz4"][usize::from(choice % 3)];
    let path = directory.join(name);
    fs::write(&path, file).expect("a file");
    reported(&path);
    if !metadata.is_empty() {
        fs::write(directory.join("metadata.yaml"), metadata).expect("a file");
        reported(directory);
    }
    let Ok(report) = reindex(directory, Expansion::Limited) else {
        return;
    };
    assert_eq!(report.files.len(), 1);
    let of_file = &report.files[0];
    assert!(!path.with_extension("mcap.part").exists());
    // A second run on the completed bag reports the same.
    reported(directory);
    let again = reindex(directory, Expansion::Limited).expect("what was written");
    assert_eq!(again.metadata.message_count, report.metadata.message_count);
    assert_eq!(again.metadata.topics, report.metadata.topics);
    for file in &again.files {
        let is_same = file.messages == of_file.messages;
        assert!(
            is_same && !matches!(file.found, Found::Unfinished { .. }),
            "{file:?}"
        );
    }
}

/// Reads everything that can be reported about a bag or a file.
fn reported(path: &Path) {
    let Ok(opened) = Bag::open(path, Expansion::Limited) else {
        return;
    };
    let details = opened.details().ok();
    for (dialect, sort) in [
        (Dialect::Humble, Sort::Type),
        (Dialect::Jazzy, Sort::Name),
        (Dialect::Kilted, Sort::Count),
    ] {
        assert!(bag::info(&opened, dialect, sort, details.as_ref()).ends_with('\n'));
        let names = bag::names(&opened, dialect, sort);
        assert!(names.is_empty() || names.ends_with('\n'));
    }
}

/// Runs `make` on a temporary directory, in memory if possible.
fn scratch<T>(make: impl Fn(&Path) -> std::io::Result<T>) -> std::io::Result<T> {
    make(Path::new("/dev/shm")).or_else(|_| make(&std::env::temp_dir()))
}

/// Reads a library that a process has loaded.
pub fn library(bytes: &[u8]) {
    let mut file = scratch(|place| tempfile::tempfile_in(place)).expect("a file");
    file.write_all(bytes).expect("room");
    if let Ok(entry) = library::find(&file) {
        assert!(entry.offset <= bytes.len() as u64);
    }
}

/// Passes inputs to the model as a source does. Each input has a kind, the time since the previous
/// one in units of 10 ms, a length (little-endian), and that many bytes.
pub fn model(bytes: &[u8]) {
    const START: u64 = 1_795_143_000_000_000_000;
    const STEP: u64 = 10_000_000;
    let mut observer = small_observer();
    let mut now = START;
    let mut rest = bytes;
    observer.input(Input::Time(Timestamp(now)));
    while let Some(([kind, wait, low, high], behind)) = rest.split_first_chunk::<4>() {
        let length = usize::from(u16::from_le_bytes([*low, *high])).min(behind.len());
        let (content, behind) = behind.split_at(length);
        rest = behind;
        // A clock may also be set back.
        now = match wait {
            0xff => now.saturating_sub(5 * STEP),
            wait => now + u64::from(*wait) * STEP,
        };
        observer.input(Input::Time(Timestamp(now)));
        brought(&mut observer, *kind, now, content);
        observer.drain();
    }
    let memory = observer.memory();
    observer.input(Input::End);
    let snapshot = observer.snapshot(Timestamp(now));
    assert!(snapshot.participants.len() <= SMALL.participants);
    assert!(snapshot.nodes.len() <= SMALL.nodes);
    assert!(snapshot.unknown_writers.len() <= SMALL.unknown_writers);
    for table in &snapshot.tables {
        assert!(table.size <= table.limit, "{table:?}");
    }
    let endpoints = snapshot.topics.iter();
    let endpoints = endpoints.map(|topic| topic.publishers.len() + topic.subscriptions.len());
    assert!(endpoints.sum::<usize>() <= SMALL.endpoints);
    observer.drain();
    // The saved state can be restored, as far as it is trusted.
    let mut after = small_observer();
    after.input(Input::Restored {
        memory: &memory,
        now: Timestamp(now),
    });
    assert!(after.memory().participants.len() <= memory.participants.len());
}

/// Small limits, so that the caps are reached soon.
const SMALL: Settings = Settings {
    participants: 3,
    endpoints: 8,
    nodes: 4,
    topics: 2,
    unknown_writers: 2,
    deliveries: 4,
    interest: 12,
    sample_bytes: 1 << 12,
    payload_bytes: 1 << 14,
    topic_grace: Duration::from_secs(1),
    service_timeout: Duration::from_secs(1),
    payload_delay: Duration::from_millis(400),
    keeps_latched: true,
    robot: Parts::ALL,
    directed: true,
};

fn small_observer() -> Observer {
    let mut observer = Observer::new(SMALL);
    let watches = ["/**", "/a"].map(|pattern| Watch::named(pattern).expect("a pattern"));
    let watchlist = Watchlist::new(watches.to_vec());
    observer.input(Input::Watchlist(Arc::new(watchlist.expect("patterns"))));
    observer.input(Input::SampleRequests(Arc::new(vec![SampleRequest {
        id: 1,
        selection: Arc::new(Selection::all()),
        domain_id: None,
        depth: Depth::Payloads,
    }])));
    observer
}

fn brought(observer: &mut Observer, kind: u8, now: u64, content: &[u8]) {
    let envelope = Envelope {
        time: now,
        destination: [0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0xff, 0xff, 239, 255, 0, 1],
        destination_port: 7400 + u16::from(kind >> 4),
        source_port: 40_000,
        host: kind & 8 != 0,
        socket: u64::from(kind >> 6),
        ..Envelope::default()
    };
    match kind & 7 {
        0 | 1 => observer.input(Input::Datagram {
            envelope: &envelope,
            payload: content,
            handover: None,
        }),
        2 => observer.input(Input::SharedMemory {
            envelope: &envelope,
            payload: content,
        }),
        3 => observer.input(Input::CutDatagram {
            envelope: &envelope,
            payload: content,
            length: u32::from(kind) * 8,
        }),
        4 => {
            let captured = Captured::new(&envelope, content, kind & 16 != 0);
            let outcome = walk::datagram(content, &envelope, None, |found| {
                let found = &found;
                observer.input(Input::Submessage { captured, found });
                if !found.record.writer().entity.is_builtin() {
                    observe(observer, &found.record);
                }
            });
            observer.input(Input::DatagramEnd(outcome));
        }
        // Records as the kernel programs write them, for any traffic.
        _ => {
            if let Ok((record, _)) = Record::read_from_prefix(content) {
                observe(
                    observer,
                    &Record {
                        time: now,
                        ..record
                    },
                );
            }
        }
    }
}

/// Reassembles the datagrams in frames.
struct Inside(Reassembly);

impl Default for Inside {
    fn default() -> Self {
        Self(Reassembly::new(Limits::default()))
    }
}

impl Inside {
    fn packet(&mut self, time: Timestamp, interface: u32, packet: &Packet<'_>) {
        match &packet.payload {
            Payload::Datagram(datagram) => read(datagram.payload),
            Payload::Fragment(fragment) => {
                let key = FlowKey::new(0, interface, false, packet, fragment);
                if let Some(whole) = self.0.fragment(time, key, fragment) {
                    read(whole.payload());
                }
                assert!(self.0.bytes() <= Limits::default().bytes);
            }
            Payload::Segment(_) | Payload::Other(_) => {}
        }
    }
}

fn read(datagram: &[u8]) {
    walk::datagram(datagram, &Envelope::default(), None, |found| {
        assert!(found.payload.len() <= datagram.len());
    });
}
