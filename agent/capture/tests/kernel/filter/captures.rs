//! The kernel programs and user space write the same records for every capture.

use super::*;
use ros2probe_testing::{corpus, repository};
use ros2probe_wire::Expansion;

/// One IP packet of a capture.
#[derive(Clone)]
pub(super) struct IpPacket {
    pub(super) bytes: Vec<u8>,
    pub(super) time: u64,
}

/// Returns the captures of the project.
pub(super) fn captures() -> Vec<PathBuf> {
    let mut found = Vec::new();
    for folder in ["wire/tests/data", "agent/testing/data"] {
        collect(&repository(folder), &mut found);
    }
    let found = distinct(found);
    assert!(found.len() >= 10, "captures are missing: {found:?}");
    found
}

/// Returns the captures of the corpus that are not among those of the project.
fn captures_of_the_corpus() -> Vec<PathBuf> {
    let own = captures();
    let mut more = Vec::new();
    collect(&corpus(), &mut more);
    let all = [own.clone(), distinct(more)].concat();
    distinct_in_order(all).split_off(own.len())
}

fn distinct(mut found: Vec<PathBuf>) -> Vec<PathBuf> {
    // Truncated captures cannot be passed to the kernel as frames.
    found.retain(|path| !path.to_string_lossy().contains("snap256"));
    // This capture has a datagram of 300 submessages, which exceeds a program: user space reads the
    // rest.
    found.retain(|path| !path.to_string_lossy().contains("announced-late"));
    found.sort();
    distinct_in_order(found)
}

/// Returns the paths without those of copies.
fn distinct_in_order(mut paths: Vec<PathBuf>) -> Vec<PathBuf> {
    let mut seen = BTreeSet::new();
    paths.retain(|path| seen.insert(std::fs::read(path).unwrap()));
    paths
}

fn collect(folder: &Path, found: &mut Vec<PathBuf>) {
    let Ok(entries) = std::fs::read_dir(folder) else {
        return;
    };
    for path in entries.map(|entry| entry.unwrap().path()) {
        // Zenoh traffic is not RTPS, and RTPS over TCP is not read.
        if path.ends_with("zenoh") || path.ends_with("fastrtps-tcp") {
            continue;
        }
        if path.is_dir() {
            collect(&path, found);
        } else if path.to_string_lossy().ends_with(".pcap.gz") {
            found.push(path);
        }
    }
}

pub(super) fn ip_packets(path: &Path) -> Vec<IpPacket> {
    let mut reader = PcapReader::open(path, Expansion::Limited).unwrap();
    let mut packets = Vec::new();
    while let Some(captured) = reader.next_packet().unwrap() {
        let header = match captured.link {
            Link::ETHERNET => 14,
            Link::LINUX_SLL => 16,
            Link::LINUX_SLL2 => 20,
            other => panic!("{}: link type {other:?}", path.display()),
        };
        let parsed = frame::parse(captured.link, captured.bytes, captured.length).unwrap();
        let Some(packet) = parsed.packet else {
            continue;
        };
        let bytes = &captured.bytes[header..];
        let pieces = match packet.payload {
            // A program run accepts a page at most, so the packet is cut as by a link with a
            // smaller MTU.
            Payload::Datagram(udp) if bytes.len() > 3000 => {
                let id = u32::try_from(packets.len()).unwrap() % 60_000;
                program_run::fragments(udp.payload, 2960, false, id)
            }
            // The packet is a long TCP segment, such as a page of metrics; both sides ignore it.
            _ if bytes.len() > 3000 => continue,
            _ => vec![bytes.to_vec()],
        };
        let time = captured.time.0;
        packets.extend(pieces.into_iter().map(|bytes| IpPacket { bytes, time }));
    }
    packets
}

/// User space's result for a packet: every datagram that it completes.
struct UserSpace {
    reassembly: Reassembly,
}

impl UserSpace {
    fn packet(&mut self, packet: &IpPacket, mut datagram: impl FnMut(&[u8], &Envelope)) {
        let protocol = if packet.bytes[0] >> 4 == 4 {
            0x0800
        } else {
            0x86dd
        };
        let len = u32::try_from(packet.bytes.len()).unwrap();
        let parsed = frame::parse_cooked(protocol, PacketType::HOST, &packet.bytes, len);
        let parsed = parsed.unwrap().unwrap();
        let mut envelope = Envelope {
            destination: parsed.destination,
            interface: program_run::INTERFACE,
            ..Envelope::default()
        };
        match parsed.payload {
            Payload::Datagram(udp) => {
                (envelope.source_port, envelope.destination_port) =
                    (udp.source_port, udp.destination_port);
                datagram(udp.payload, &envelope);
            }
            Payload::Fragment(fragment) => {
                let at = ros2probe_wire::Timestamp(packet.time);
                let key = FlowKey::new(0, program_run::INTERFACE, false, &parsed, &fragment);
                if let Some(whole) = self.reassembly.fragment(at, key, &fragment) {
                    (envelope.source_port, envelope.destination_port) =
                        (whole.source_port, whole.destination_port);
                    envelope.fragmented = true;
                    datagram(whole.payload(), &envelope);
                }
            }
            _ => {}
        }
    }
}

fn user_space() -> UserSpace {
    UserSpace {
        reassembly: Reassembly::new(Limits {
            bytes: 64 << 20,
            ..Limits::default()
        }),
    }
}

/// Returns the expected verdict of the filter on a whole datagram, computed independently.
fn expected(
    payload: &[u8],
    envelope: &Envelope,
    interest: &BTreeMap<Guid, Verdict>,
) -> (bool, Vec<Record>) {
    let (mut capture, mut records) = (false, Vec::new());
    walk::datagram(payload, envelope, None, |found| {
        let record = found.record;
        let endpoint = match walk::fate(&record) {
            Fate::Ignore => return,
            Fate::Capture => return capture = true,
            Fate::Writer => record.writer(),
            Fate::Reader => record.reader(),
        };
        match interest.get(&endpoint) {
            Some(Verdict::Meter) => records.push(record),
            Some(Verdict::Capture) => capture = true,
            Some(Verdict::Ignore) | None => {}
        }
    });
    (capture, if capture { Vec::new() } else { records })
}

/// Returns all user endpoints that send in a capture.
fn endpoints(packets: &[IpPacket]) -> BTreeSet<Guid> {
    let mut found = BTreeSet::new();
    let mut user = user_space();
    for packet in packets {
        user.packet(packet, |payload, envelope| {
            walk::datagram(payload, envelope, None, |each| {
                match walk::fate(&each.record) {
                    Fate::Writer => drop(found.insert(each.record.writer())),
                    Fate::Reader => drop(found.insert(each.record.reader())),
                    _ => {}
                }
            });
        });
    }
    found
}

fn comparable(record: Record) -> Record {
    Record {
        time: 0,
        datagram: 0,
        elapsed: 0,
        flags: record.flags & !flag::AHEAD,
        ..record
    }
}

/// Changes the sources of packets, so that none continues a flow of an earlier run.
fn from_elsewhere(packets: &[IpPacket], run: u8) -> Vec<IpPacket> {
    let mut packets = packets.to_vec();
    for IpPacket { bytes, .. } in &mut packets {
        let source = if bytes[0] >> 4 == 4 { 12 } else { 8 };
        bytes[source] ^= run;
    }
    packets
}

fn compare(
    path: &Path,
    packets: &[IpPacket],
    kernel: &mut Kernel,
    interest: &BTreeMap<Guid, Verdict>,
) -> (usize, usize) {
    kernel.set_interest(interest);
    // Each run has a whole budget.
    kernel.set_unknown_budget(4 << 20, 1 << 20);
    let (mut user, mut records, mut captures) = (user_space(), 0, 0);
    let mut runs = Runs::default();
    for (number, packet) in packets.iter().enumerate() {
        let FrameResult {
            kept,
            records: found,
        } = kernel.frame(&packet.bytes);
        let mut wanted = Vec::new();
        let mut captured = false;
        let mut finished = false;
        user.packet(packet, |payload, envelope| {
            let (capture, records) = expected(payload, envelope, interest);
            captured = capture;
            let records = joined(records);
            let joins = records.len() == 1 || !envelope.fragmented;
            records
                .into_iter()
                .for_each(|record| runs.give(record, joins, &mut wanted));
            finished = true;
        });
        if finished {
            assert_eq!(kept, captured, "{} packet {number}: kept", path.display());
            captures += usize::from(kept);
        }
        let found: Vec<_> = found.into_iter().map(comparable).collect();
        let wanted: Vec<_> = wanted.into_iter().map(comparable).collect();
        assert_eq!(found, wanted, "{} packet {number}: records", path.display());
        records += found.len();
    }
    let mut stalled: Vec<_> = kernel.take_stalled().into_iter().map(comparable).collect();
    let mut wanted: Vec<_> = runs.0.into_values().map(comparable).collect();
    stalled.sort_by_key(|record| (record.writer, record.destination, record.sequence_number));
    wanted.sort_by_key(|record| (record.writer, record.destination, record.sequence_number));
    assert_eq!(stalled, wanted, "{}: runs left over", path.display());
    kernel.forget_interest(interest);
    (records + stalled.len(), captures)
}

/// Joins consecutive DATA_FRAGs of a datagram.
fn joined(records: Vec<Record>) -> Vec<Record> {
    let mut joined: Vec<Record> = Vec::new();
    for record in records {
        let last = joined.last_mut().filter(|last| {
            (last.kind, record.kind) == (kind::DATA_FRAG, kind::DATA_FRAG)
                && last.writer == record.writer
        });
        if !last.is_some_and(|last| last.extend(&record)) {
            joined.push(record);
        }
    }
    joined
}

/// Joins consecutive fragments as the filter does: by stream, on one CPU.
#[derive(Default)]
struct Runs(BTreeMap<([u32; 4], [u32; 4], u16), Record>);

impl Runs {
    fn give(&mut self, record: Record, joins: bool, out: &mut Vec<Record>) {
        if record.kind != kind::DATA_FRAG {
            return out.push(record);
        }
        let key = (record.writer, record.destination, record.destination_port);
        if let Some(mut run) = self.0.remove(&key) {
            if joins && run.extend(&record) {
                if run.ends_sample() {
                    out.push(run);
                } else {
                    self.0.insert(key, run);
                }
                return;
            }
            out.push(run);
        }
        if joins && record.fragment_start == 1 && !record.ends_sample() {
            self.0.insert(key, record);
        } else {
            out.push(record);
        }
    }
}

/// Returns verdicts for these endpoints: all are metered, or some are and others not.
fn interests(endpoints: &BTreeSet<Guid>) -> [BTreeMap<Guid, Verdict>; 2] {
    let endpoints = endpoints.iter().copied();
    let meter_all = endpoints.clone().map(|guid| (guid, Verdict::Meter));
    let verdicts = [Verdict::Ignore, Verdict::Meter, Verdict::Capture];
    let mixed = endpoints.zip(verdicts.into_iter().cycle());
    [meter_all.collect(), mixed.collect()]
}

#[test]
fn the_kernel_and_user_space_make_the_same_records_of_every_capture() {
    compare_at_interfaces(&captures());
}

#[test]
#[ignore = "needs the corpus of captures: make test-corpus"]
fn the_kernel_and_user_space_make_the_same_records_of_the_whole_corpus() {
    compare_at_interfaces(&captures_of_the_corpus());
}

fn compare_at_interfaces(captures: &[PathBuf]) {
    // The kernel takes half a second to verify a program, so each is loaded only once.
    let load = |hook| (hook, Kernel::load_hook(hook));
    let mut kernels: Vec<_> = by_receivers().into_iter().map(load).collect();
    let mut run = 0;
    for path in captures {
        let packets = ip_packets(path);
        for interest in interests(&endpoints(&packets)) {
            run += 1;
            let packets = from_elsewhere(&packets, run);
            for (hook, kernel) in &mut kernels {
                let (records, captured) = compare(path, &packets, kernel, &interest);
                let path = path.display();
                assert!(captured > 0, "{path}: no discovery seen");
                println!("{path}, {hook:?}: {records} records, {captured} captured");
            }
        }
    }
}

/// Returns the hooks at interfaces that see received packets.
fn by_receivers() -> Vec<Hook> {
    let mut hooks = Hook::at_interfaces();
    hooks.retain(|hook| *hook != Hook::TcxEgress);
    hooks
}

/// A datagram as sockets see it: one IP packet, however many fragments it was cut into.
struct Datagram {
    packet: Vec<u8>,
    payload: Vec<u8>,
    envelope: Envelope,
}

fn datagrams(packets: &[IpPacket]) -> Vec<Datagram> {
    let (mut user, mut found) = (user_space(), Vec::new());
    for packet in packets {
        user.packet(packet, |payload, envelope| {
            let mut envelope = Envelope {
                host: true,
                ..*envelope
            };
            let packet = if envelope.fragmented {
                envelope.fragmented = false;
                envelope.source_port = 7411;
                envelope.destination_port = 7411;
                envelope.destination = [0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 255, 255, 10, 99, 0, 2];
                program_run::datagram(payload)
            } else {
                packet.bytes.clone()
            };
            found.push(Datagram {
                packet,
                payload: payload.to_vec(),
                envelope,
            });
        });
    }
    // A program run accepts a page at most; `live/host_hook` sends longer ones through real
    // sockets.
    found.retain(|datagram| datagram.packet.len() <= 3000);
    found
}

/// Clears the fields of a host hook record that [`comparable`] leaves, so that any socket compares
/// equal.
fn of_any_socket(record: Record) -> Record {
    assert_ne!(record.flags & flag::HOST, 0);
    assert_ne!((record.socket, record.datagram), (0, 0));
    Record {
        socket: 0,
        ..comparable(record)
    }
}

fn compare_host(
    path: &Path,
    datagrams: &[Datagram],
    kernel: &mut Kernel,
    hook: Hook,
    interest: &BTreeMap<Guid, Verdict>,
) -> (usize, usize) {
    kernel.set_interest(interest);
    let (mut records, mut captures) = (0, 0);
    let mut copied = kernel.counter(Counter::CopiesNotCaptured);
    for (number, datagram) in datagrams.iter().enumerate() {
        let case = format!("{} {hook:?} datagram {number}", path.display());
        let envelope = Envelope {
            outgoing: hook == Hook::Egress,
            ..datagram.envelope
        };
        let seen = kernel.datagram(&datagram.packet);
        let (capture, mut wanted) = expected(&datagram.payload, &envelope, interest);
        if let Some((piece, bytes)) = &seen.captured {
            assert!(capture, "{case}: captured");
            assert!(*bytes == datagram.payload, "{case}: captured bytes");
            assert_eq!(piece.destination_port, envelope.destination_port, "{case}");
            assert_eq!(piece.source_port, envelope.source_port, "{case}");
            captures += 1;
        } else if capture {
            // The previous run was within a millisecond, however old the captured packet is.
            copied += 1;
            assert_eq!(kernel.counter(Counter::CopiesNotCaptured), copied, "{case}");
            let metered = interest.iter().map(|(guid, verdict)| match verdict {
                Verdict::Capture => (*guid, Verdict::Meter),
                verdict => (*guid, *verdict),
            });
            wanted = metered_records(&datagram.payload, &envelope, &metered.collect());
        }
        // Each run has its own socket, so only fragments of one datagram are joined.
        let (mut runs, mut joined) = (Runs::default(), Vec::new());
        for record in wanted {
            runs.give(record, true, &mut joined);
        }
        joined.extend(runs.0.into_values());
        let key = |record: &Record| (record.writer, record.sequence_number, record.kind);
        let mut found: Vec<_> = seen.records.into_iter().map(of_any_socket).collect();
        let mut joined: Vec<_> = joined.into_iter().map(comparable).collect();
        found.sort_by_key(key);
        joined.sort_by_key(key);
        assert_eq!(found, joined, "{case}: records");
        records += found.len();
    }
    kernel.forget_interest(interest);
    (records, captures)
}

/// Returns the records of all metered submessages, whatever else is in the datagram.
fn metered_records(
    payload: &[u8],
    envelope: &Envelope,
    interest: &BTreeMap<Guid, Verdict>,
) -> Vec<Record> {
    let mut records = Vec::new();
    walk::datagram(payload, envelope, None, |found| {
        let endpoint = match walk::fate(&found.record) {
            Fate::Ignore | Fate::Capture => return,
            Fate::Writer => found.record.writer(),
            Fate::Reader => found.record.reader(),
        };
        if interest.get(&endpoint) == Some(&Verdict::Meter) {
            records.push(found.record);
        }
    });
    records
}

#[test]
fn the_host_hook_makes_the_same_records_of_every_capture_in_both_directions() {
    compare_at_sockets(&captures());
}

#[test]
#[ignore = "needs the corpus of captures: make test-corpus"]
fn the_host_hook_makes_the_same_records_of_the_whole_corpus_in_both_directions() {
    compare_at_sockets(&captures_of_the_corpus());
}

fn compare_at_sockets(captures: &[PathBuf]) {
    let mut kernels = [Hook::Ingress, Hook::Egress].map(|hook| (hook, Kernel::load_hook(hook)));
    for path in captures {
        let packets = ip_packets(path);
        let datagrams = datagrams(&packets);
        for (number, interest) in (0..).zip(interests(&endpoints(&packets))) {
            for (hook, kernel) in &mut kernels {
                let (records, captured) = compare_host(path, &datagrams, kernel, *hook, &interest);
                let path = path.display();
                // Later, these datagrams may be copies of those just captured.
                assert!(captured > 0 || number > 0, "{path}: no discovery seen");
                println!("{path}, {hook:?}: {records} records, {captured} captured");
            }
        }
    }
}
