//! Compares the oracle with two decoders that others wrote, on every capture of RTPS over UDP in
//! the project: tshark and scapy.
//!
//! `captures.rs` compares the oracle with the walk and with recorded facts. Here tshark decodes
//! each message anew. scapy needs a millisecond for each, so it decodes two messages of each layout
//! in a capture. A layout is ids, flags, lengths and entities of all submessages. Both decoders
//! reassemble IP fragments themselves. They do not decode everything:
//!
//! - scapy leaves DATA_FRAG, HEARTBEAT_FRAG, NACK_FRAG and GAP undecoded, and with them the rest of
//!   the message;
//! - scapy ends a payload too early if inline QoS precede it;
//! - scapy takes the submessages after an announcement of a participant as a part of it;
//! - tshark prints no payload of builtin writers, whose parameters it decodes;
//! - neither reads Zenoh, or RTPS over TCP as Fast DDS frames it.

#![expect(
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::indexing_slicing,
    reason = "a failed expectation may panic here"
)]

#[expect(dead_code, reason = "only the oracle is needed here")]
#[path = "../fuzz/src/lib.rs"]
mod entry;
mod pcap;

use std::collections::{BTreeMap, BTreeSet, HashSet};
use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;

use flate2::Crc;
use ros2probe_wire::walk::{self, Envelope};
use ros2probe_wire::{Endianness, EntityId, Guid, SequenceNumber, record};

use entry::oracle::submessage::{Data, DataFrag};
use entry::oracle::{Body, Message, Submessage};
use pcap::{datagrams, read};

/// A capture file.
struct Capture {
    path: PathBuf,
    bytes: Vec<u8>,
}

/// Captures of the project; directories whose traffic neither decoder reads are left out.
fn captures() -> Vec<Capture> {
    fn add(directory: &Path, found: &mut Vec<PathBuf>) {
        for entry in fs::read_dir(directory).unwrap() {
            let path = entry.unwrap().path();
            if path.ends_with("zenoh") || path.ends_with("fastrtps-tcp") {
                continue;
            }
            if path.is_dir() {
                add(&path, found);
            } else if path.to_str().unwrap().ends_with(".pcap.gz") {
                found.push(path);
            }
        }
    }
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let mut all = Vec::new();
    for directory in [
        "tests/data",
        "../agent/testing/data",
        "../agent/cli/tests/fixtures",
    ] {
        add(&root.join(directory), &mut all);
    }
    // A clone of a capture elsewhere has nothing to add.
    let mut seen = HashSet::new();
    all.retain(|path| seen.insert(fs::read(path).unwrap()));
    assert!(all.len() >= 15, "{all:?}");
    let load = |path: PathBuf| Capture {
        bytes: read(&path),
        path,
    };
    all.into_iter().map(load).collect()
}

/// Writes a capture without compression beside the build's other temporary files.
fn unpacked(capture: &Capture) -> tempfile::NamedTempFile {
    let file = tempfile::NamedTempFile::new().unwrap();
    fs::write(file.path(), &capture.bytes).unwrap();
    file
}

fn output(command: &mut Command) -> String {
    let output = command
        .output()
        .expect("`.ci/prerequisites.sh test` installs it");
    let errors = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{command:?}: {errors}");
    String::from_utf8(output.stdout).unwrap()
}

fn entity(guid: Guid) -> String {
    hex(&guid.entity.0)
}

fn hex(bytes: &[u8]) -> String {
    const DIGITS: [u8; 16] = *b"0123456789abcdef";
    let mut text = Vec::with_capacity(2 * bytes.len());
    for byte in bytes {
        text.push(DIGITS[usize::from(byte >> 4)]);
        text.push(DIGITS[usize::from(byte & 15)]);
    }
    String::from_utf8(text).unwrap()
}

fn digest(bytes: &[u8]) -> String {
    let mut crc = Crc::new();
    crc.update(bytes);
    format!("{:08x}", crc.sum())
}

/// Returns a submessage's octetsToNextHeader.
fn octets(message: &[u8], submessage: &Submessage<'_>) -> u16 {
    let octets = message[submessage.offset + 2..][..2].try_into().unwrap();
    match submessage.flags.endianness() {
        Endianness::Big => u16::from_be_bytes(octets),
        Endianness::Little => u16::from_le_bytes(octets),
    }
}

/// Returns a value for each message in a capture.
fn for_messages<T>(capture: &Capture, make: impl Fn(&[u8], &[Submessage<'_>]) -> T) -> Vec<T> {
    let mut values = Vec::new();
    datagrams(&capture.bytes, |bytes| {
        if let Ok(message) = Message::parse(bytes) {
            let submessages: Vec<_> = message.map(Result::unwrap).collect();
            values.push(make(bytes, &submessages));
        }
    });
    values
}

/// Asserts that both decoders saw the same messages equally often. Their order may differ where
/// fragments of two datagrams alternate.
fn assert_equal(capture: &Capture, ours: &[String], theirs: &[String]) {
    let mut balance: BTreeMap<&str, i64> = BTreeMap::new();
    for line in ours {
        *balance.entry(line).or_default() += 1;
    }
    for line in theirs {
        *balance.entry(line).or_default() -= 1;
    }
    balance.retain(|_, count| *count != 0);
    let first: Vec<_> = balance.iter().take(6).collect();
    assert!(
        balance.is_empty(),
        "{}: {} of ours, {} of theirs, {} differ: {first:#?}",
        capture.path.display(),
        ours.len(),
        theirs.len(),
        balance.len()
    );
}

/// Returns length and digest of a payload that scapy decodes.
fn scapy_payload(data: &Data<'_>) -> String {
    let bytes = data.payload.bytes();
    match data.inline_qos {
        None => format!(" {} {}", bytes.len(), digest(bytes)),
        Some(_) => String::new(),
    }
}

/// Returns a message as `second_decoders/scapy_lines.py` prints it.
fn as_scapy(bytes: &[u8], submessages: &[Submessage<'_>]) -> String {
    let mut parts = vec![hex(&bytes[8..20])];
    let mut rest = submessages.iter();
    while let Some(submessage) = rest.next() {
        let content = match submessage.body {
            Body::DataFrag(_) | Body::HeartbeatFrag(_) | Body::NackFrag(_) | Body::Gap(_) => break,
            Body::InfoTimestamp => format!(" {}", submessage.receiver.timestamp.0),
            Body::InfoDestination => format!(" {}", hex(&submessage.receiver.destination.0)),
            Body::AckNack(acknack) => format!(
                " {} {} {}",
                entity(acknack.reader),
                entity(acknack.writer),
                acknack.count
            ),
            Body::Heartbeat(heartbeat) => format!(
                " {} {} {} {} {}",
                entity(heartbeat.reader),
                entity(heartbeat.writer),
                heartbeat.first.0,
                heartbeat.last.0,
                heartbeat.count
            ),
            Body::Data(data) => {
                let payload = match rest.len() {
                    1.. if data.writer.entity == EntityId::SPDP_WRITER => {
                        rest = [].iter();
                        " ...".to_owned()
                    }
                    _ => scapy_payload(&data),
                };
                format!(
                    " {} {} {}{payload}",
                    entity(data.reader),
                    entity(data.writer),
                    data.sequence_number.0,
                )
            }
            _ => String::new(),
        };
        let (flags, length) = (submessage.flags.0, octets(bytes, submessage));
        parts.push(format!(
            "{:02x} {flags:02x} {length}{content}",
            submessage.id.0
        ));
    }
    parts.join(";")
}

/// Returns id, flags, length and writer of each submessage.
fn layout(bytes: &[u8], submessages: &[Submessage<'_>]) -> String {
    let parts = submessages.iter().map(|each| {
        let writer = ends(each).map_or_else(String::new, |(_, writer)| entity(writer));
        let (id, flags, length) = (each.id.0, each.flags.0, octets(bytes, each));
        format!("{id:02x} {flags:02x} {length} {writer};")
    });
    parts.collect()
}

#[test]
fn scapy_decodes_the_same_submessages() {
    let python = Path::new(env!("CARGO_TARGET_TMPDIR")).join("../tools/scapy/bin/python");
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/second_decoders/scapy_lines.py");
    let captures = captures();
    let files: Vec<_> = captures.iter().map(unpacked).collect();
    let paths = files.iter().map(tempfile::NamedTempFile::path);
    let text = output(Command::new(&python).arg(&script).args(paths));
    let parts: Vec<_> = text.split_terminator("--\n").collect();
    assert_eq!(parts.len(), captures.len());
    for (capture, part) in captures.iter().zip(parts) {
        let digests = for_messages(capture, |bytes, _| digest(bytes));
        let lines = part
            .lines()
            .map(|line| line.split_once(' ').unwrap_or((line, "")));
        let theirs: Vec<_> = lines.clone().map(|(digest, _)| digest.to_owned()).collect();
        assert_equal(capture, &digests, &theirs);

        let decoded: BTreeMap<_, _> = lines.filter(|(_, line)| !line.is_empty()).collect();
        let compared = for_messages(capture, |bytes, submessages| {
            let line = decoded.get(&*digest(bytes));
            if let Some(line) = line {
                let ours = as_scapy(bytes, submessages);
                assert_eq!(ours, *line, "{}", capture.path.display());
            }
            (layout(bytes, submessages), line.is_some())
        });
        let all: BTreeSet<_> = compared.iter().map(|(layout, _)| layout).collect();
        let seen = compared.iter().filter(|(_, is_decoded)| *is_decoded);
        let seen: BTreeSet<_> = seen.map(|(layout, _)| layout).collect();
        let missing: Vec<_> = all.difference(&seen).take(6).collect();
        assert!(
            missing.is_empty(),
            "{}: {missing:#?}",
            capture.path.display()
        );
    }
}

/// Returns the values that a submessage of a message contributes to a column.
type Values = fn(&[u8], &Submessage<'_>) -> Vec<String>;

/// Fields that tshark prints.
const COLUMNS: [(&str, Values); 14] = [
    ("rtps.sm.id", |_, each| vec![format!("0x{:02x}", each.id.0)]),
    ("rtps.sm.flags", |_, each| {
        vec![format!("0x{:02x}", each.flags.0)]
    }),
    ("rtps.sm.octetsToNextHeader", |bytes, each| {
        vec![octets(bytes, each).to_string()]
    }),
    ("rtps.guidPrefix.dst", |_, each| match each.body {
        Body::InfoDestination => vec![hex(&each.receiver.destination.0)],
        _ => Vec::new(),
    }),
    ("rtps.sm.rdEntityId", |_, each| {
        ends(each).map_or_else(Vec::new, |(reader, _)| {
            vec![format!("0x{}", entity(reader))]
        })
    }),
    ("rtps.sm.wrEntityId", |_, each| {
        ends(each).map_or_else(Vec::new, |(_, writer)| {
            vec![format!("0x{}", entity(writer))]
        })
    }),
    ("rtps.sm.seqNumber", |_, each| {
        texts(numbers(each).map(|number| number.0))
    }),
    ("rtps.bitmap.num_bits", |_, each| match each.body {
        Body::AckNack(acknack) => vec![acknack.missing.num_bits().to_string()],
        Body::Gap(gap) => vec![gap.list.num_bits().to_string()],
        _ => Vec::new(),
    }),
    ("rtps.acknack.count", |_, each| match each.body {
        Body::AckNack(acknack) => vec![acknack.count.to_string()],
        _ => Vec::new(),
    }),
    ("rtps.heartbeat_count", |_, each| match each.body {
        Body::Heartbeat(heartbeat) => vec![heartbeat.count.to_string()],
        _ => Vec::new(),
    }),
    ("rtps.data_frag.number", |_, each| {
        texts(fragments(each).map(|each| each.starting))
    }),
    ("rtps.data_frag.num_fragments", |_, each| {
        texts(fragments(each).map(|each| each.count))
    }),
    ("rtps.data_frag.size", |_, each| {
        texts(fragments(each).map(|each| each.fragment_size))
    }),
    ("rtps.data_frag.sample_size", |_, each| {
        texts(fragments(each).map(|each| each.sample_size))
    }),
];

fn texts<T: ToString>(values: impl IntoIterator<Item = T>) -> Vec<String> {
    values.into_iter().map(|value| value.to_string()).collect()
}

fn fragments<'a>(submessage: &Submessage<'a>) -> Option<DataFrag<'a>> {
    match submessage.body {
        Body::DataFrag(fragments) => Some(fragments),
        _ => None,
    }
}

/// Returns the reader and the writer of a submessage of endpoints.
fn ends(submessage: &Submessage<'_>) -> Option<(Guid, Guid)> {
    Some(match submessage.body {
        Body::AckNack(each) => (each.reader, each.writer),
        Body::Heartbeat(each) => (each.reader, each.writer),
        Body::HeartbeatFrag(each) => (each.reader, each.writer),
        Body::Gap(each) => (each.reader, each.writer),
        Body::NackFrag(each) => (each.reader, each.writer),
        Body::Data(each) => (each.reader, each.writer),
        Body::DataFrag(each) => (each.reader, each.writer),
        _ => return None,
    })
}

fn numbers(submessage: &Submessage<'_>) -> impl Iterator<Item = SequenceNumber> {
    let (first, second) = match submessage.body {
        Body::AckNack(each) => (Some(each.missing.base), None),
        Body::Heartbeat(each) => (Some(each.first), Some(each.last)),
        Body::HeartbeatFrag(each) => (Some(each.sequence_number), None),
        Body::Gap(each) => (Some(each.start), Some(each.list.base)),
        Body::NackFrag(each) => (Some(each.sequence_number), None),
        Body::Data(each) => (Some(each.sequence_number), None),
        Body::DataFrag(each) => (Some(each.sequence_number), None),
        _ => (None, None),
    };
    first.into_iter().chain(second)
}

/// Returns the payloads of a message's user writers as tshark prints them: fragment by fragment,
/// without the encapsulation header at the begin of a sample.
fn payloads(submessages: &[Submessage<'_>]) -> String {
    let payloads = submessages.iter().flat_map(|each| match each.body {
        Body::Data(data) if !data.writer.entity.is_builtin() => vec![(1, data.payload.bytes())],
        Body::DataFrag(each) => each.fragments().collect(),
        _ => Vec::new(),
    });
    let payloads = payloads.filter_map(|(number, bytes)| match number {
        1 => bytes.get(4..),
        _ => Some(bytes),
    });
    payloads.map(hex).collect::<Vec<_>>().join(",")
}

/// Returns a message as tshark prints the columns.
fn as_tshark(bytes: &[u8], submessages: &[Submessage<'_>]) -> String {
    let mut cells = vec![hex(&bytes[8..20])];
    for (_, values) in COLUMNS {
        let values: Vec<_> = submessages
            .iter()
            .flat_map(|submessage| values(bytes, submessage))
            .collect();
        cells.push(values.join(","));
    }
    cells.push(digest(payloads(submessages).as_bytes()));
    cells.join("\t")
}

#[test]
fn tshark_decodes_the_same_submessages_and_payloads() {
    for capture in captures() {
        let file = unpacked(&capture);
        let mut tshark = Command::new("tshark");
        tshark.args(["-n", "-T", "fields", "-Y", "rtps && udp && !icmp", "-r"]);
        tshark.arg(file.path()).args(["-e", "rtps.guidPrefix.src"]);
        for (column, _) in COLUMNS {
            tshark.args(["-e", column]);
        }
        tshark.args(["-e", "rtps.issueData"]);
        let text = output(&mut tshark);
        let theirs = text.lines().map(|line| {
            let (cells, payload) = line.rsplit_once('\t').unwrap();
            format!("{cells}\t{}", digest(payload.as_bytes()))
        });
        let theirs: Vec<_> = theirs.collect();
        assert_equal(&capture, &for_messages(&capture, as_tshark), &theirs);
    }
}

/// Returns a capture file of one UDP datagram (libpcap, LINKTYPE_RAW).
fn capture_of(payload: &[u8]) -> Vec<u8> {
    let length = u16::try_from(payload.len()).unwrap();
    let mut packet = vec![0x45, 0];
    packet.extend((28 + length).to_be_bytes());
    packet.extend([0, 1, 0, 0, 64, 17, 0, 0, 127, 0, 0, 1, 127, 0, 0, 1]);
    for half in [7411, 7411, 8 + length, 0] {
        packet.extend(half.to_be_bytes());
    }
    packet.extend(payload);
    let mut file = 0xa1b2_c3d4_u32.to_le_bytes().to_vec();
    file.extend([2, 0, 4, 0]);
    let length = u32::try_from(packet.len()).unwrap();
    for word in [0, 0, 65_535, 101, 1, 0, length, length] {
        file.extend(u32::to_le_bytes(word));
    }
    file.extend(packet);
    file
}

/// No implementation of DATA_BATCH is available here, so tshark alone confirms the fields.
#[test]
fn tshark_finds_the_same_samples_in_batches() {
    let message = include_bytes!("data/rti-batches.bin");
    let file = tempfile::NamedTempFile::new().unwrap();
    fs::write(file.path(), capture_of(message)).unwrap();
    let mut tshark = Command::new("tshark");
    tshark.args(["-n", "-T", "fields", "-r"]).arg(file.path());
    let columns = [
        "rtps.sm.wrEntityId",
        "rtps.sm.seqNumber",
        "rtps.data_batch.offset_to_last_sample_sn",
        "rtps.data_batch.sample_count",
    ];
    for column in columns {
        tshark.args(["-e", column]);
    }
    let text = output(&mut tshark);
    let theirs: Vec<Vec<_>> = text
        .trim()
        .split('\t')
        .map(|cell| cell.split(',').map(str::to_owned).collect())
        .collect();
    let mut ours = vec![Vec::new(); 4];
    walk::datagram(message, &Envelope::default(), None, |found| {
        let record::Body::Batch(batch) = found.record.body() else {
            panic!("{found:?}")
        };
        let distance = batch.last() - batch.first();
        ours[0].push(format!("0x{}", entity(batch.record().writer())));
        ours[1].push(batch.first().to_string());
        ours[2].push(distance.to_string());
        ours[3].push(batch.count().to_string());
    });
    // tshark prints the number of the batch before that of its first sample.
    let firsts: Vec<_> = theirs[1].iter().skip(1).step_by(2).cloned().collect();
    let theirs = [&theirs[0], &firsts, &theirs[2], &theirs[3]].map(Clone::clone);
    assert_eq!(ours, theirs);
}
