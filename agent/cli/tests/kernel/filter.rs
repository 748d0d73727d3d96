//! The kernel program against the user-space walk: the same records, to the byte.
//!
//! Every frame of every capture goes through the loaded program (BPF_PROG_TEST_RUN: no interface,
//! no socket) and through the reassembly and walk of user space. Needs root.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use ros2probe::capture::pcap::PcapReader;
use ros2probe::capture::reassembly::{FlowKey, Limits, Reassembly};
use ros2probe_testing::program_run::{self, Hook, Kernel, Seen};
use ros2probe_wire::filter::Counter;
use ros2probe_wire::frame::{self, Link, PacketType, Payload};
use ros2probe_wire::record::{Record, Verdict, flag, guid_words, kind};
use ros2probe_wire::walk::{self, Envelope, Fate};
use ros2probe_wire::{EntityId, Guid, GuidPrefix};

/// One IP packet of a capture.
struct IpPacket {
    bytes: Vec<u8>,
    time: u64,
}

fn captures() -> Vec<PathBuf> {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("../..");
    let mut found = Vec::new();
    for folder in [
        "wire/tests/data",
        "agent/testing/data",
        "../shared/fixtures",
    ] {
        collect(&root.join(folder), &mut found);
    }
    assert!(
        found.len() >= 3,
        "the captures of the project itself are missing: {found:?}"
    );
    // Captures with a shortened frame length cannot be given to the kernel as frames.
    found.retain(|path| !path.to_string_lossy().contains("snap256"));
    // It has a datagram of 300 submessages, more than a program follows: user space gets its rest.
    found.retain(|path| !path.to_string_lossy().contains("announced-late"));
    found.sort();
    found
}

fn collect(folder: &Path, found: &mut Vec<PathBuf>) {
    let Ok(entries) = std::fs::read_dir(folder) else {
        return;
    };
    for path in entries.map(|entry| entry.unwrap().path()) {
        // What Zenoh sends is no RTPS.
        if path.ends_with("zenoh") {
            continue;
        }
        if path.is_dir() {
            collect(&path, found);
        } else if path.to_string_lossy().ends_with(".pcap.gz") {
            found.push(path);
        }
    }
}

fn ip_packets(path: &Path) -> Vec<IpPacket> {
    let mut reader = PcapReader::open(path).unwrap();
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
            // A program run takes a page at most: show it as a link with a smaller MTU would.
            Payload::Datagram(udp) if bytes.len() > 3000 => {
                let id = u32::try_from(packets.len()).unwrap() % 60_000;
                program_run::fragments(udp.payload, 2960, false, id)
            }
            _ => vec![bytes.to_vec()],
        };
        let time = captured.time.0;
        packets.extend(pieces.into_iter().map(|bytes| IpPacket { bytes, time }));
    }
    packets
}

/// What user space makes of a packet: every datagram it completes, in whole.
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

/// The filter's verdict on a whole datagram, stated once more and plainly.
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

/// All user endpoints that a capture mentions as sender.
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

fn compare(path: &Path, interest: &BTreeMap<Guid, Verdict>) -> (usize, usize) {
    let packets = ip_packets(path);
    let mut kernel = Kernel::load();
    kernel.set_interest(interest);
    let (mut user, mut records, mut captures) = (user_space(), 0, 0);
    let mut runs = Runs::default();
    for (number, packet) in packets.iter().enumerate() {
        let Seen {
            kept,
            records: found,
        } = kernel.frame(&packet.bytes);
        let mut wanted = Vec::new();
        let mut captured = false;
        let mut finished = false;
        user.packet(packet, |payload, envelope| {
            let (capture, records) = expected(payload, envelope, interest);
            captured = capture;
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
    (records + stalled.len(), captures)
}

/// Fragments that follow each other, joined as the filter joins them: by stream, one CPU.
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

#[test]
fn the_kernel_and_user_space_make_the_same_records_of_every_capture() {
    for path in captures() {
        let all = endpoints(&ip_packets(&path));
        let meter_all = all.iter().map(|guid| (*guid, Verdict::Meter)).collect();
        let (records, captured) = compare(&path, &meter_all);
        assert!(captured > 0, "{}: no discovery seen", path.display());
        println!("{}: {records} records, {captured} captured", path.display());

        let verdicts = [Verdict::Ignore, Verdict::Meter, Verdict::Capture];
        let mixed = all
            .iter()
            .copied()
            .zip(verdicts.into_iter().cycle())
            .collect();
        compare(&path, &mixed);
    }
}

/// A datagram as sockets see it: one IP packet, however many fragments it came in.
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
    // A program run takes a page at most; longer ones pass real sockets in `live/host_hook`.
    found.retain(|datagram| datagram.packet.len() <= 3000);
    found
}

/// What the host hook says of a datagram besides what [`comparable`] leaves out.
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
    kernel: &mut Kernel,
    hook: Hook,
    interest: &BTreeMap<Guid, Verdict>,
) -> (usize, usize) {
    kernel.set_interest(interest);
    let (mut records, mut captures) = (0, 0);
    let mut copied = kernel.counter(Counter::CopiesNotCaptured);
    for (number, datagram) in datagrams(&ip_packets(path)).into_iter().enumerate() {
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
            // The run before was within a millisecond, however long ago the captured one was.
            copied += 1;
            assert_eq!(kernel.counter(Counter::CopiesNotCaptured), copied, "{case}");
            let metered = interest.iter().map(|(guid, verdict)| match verdict {
                Verdict::Capture => (*guid, Verdict::Meter),
                verdict => (*guid, *verdict),
            });
            wanted = metered_records(&datagram.payload, &envelope, &metered.collect());
        }
        // Each run has a socket of its own, so fragments join within one datagram only.
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

/// The records of everything that is metered, whatever else is in the datagram.
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
    // The kernel takes half a second to verify a program: once is enough.
    let mut kernels = [Hook::Ingress, Hook::Egress].map(|hook| (hook, Kernel::load_hook(hook)));
    for path in captures() {
        let all = endpoints(&ip_packets(&path));
        let meter_all = all.iter().map(|guid| (*guid, Verdict::Meter)).collect();
        let verdicts = [Verdict::Ignore, Verdict::Meter, Verdict::Capture];
        let mixed = all
            .iter()
            .copied()
            .zip(verdicts.into_iter().cycle())
            .collect();
        for (hook, kernel) in &mut kernels {
            let (records, captured) = compare_host(&path, kernel, *hook, &meter_all);
            assert!(captured > 0, "{}: no discovery seen", path.display());
            println!(
                "{} {hook:?}: {records} records, {captured} captured",
                path.display()
            );
            compare_host(&path, kernel, *hook, &mixed);
        }
    }
}

#[test]
fn the_host_hook_lets_everything_pass() {
    let writer = Guid::new(GuidPrefix(*b"\x01\x0fpasspasspa"), EntityId([0, 0, 1, 3]));
    let mut noise = 1_u32;
    let mut random = || {
        noise = noise.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
        (noise >> 24) as u8
    };
    for hook in [Hook::Ingress, Hook::Egress] {
        let mut kernel = Kernel::load_hook(hook);
        kernel.set_unknown_budget(1 << 20, 1 << 20);
        let whole = program_run::data(writer, 1, 100);
        let mut packets: Vec<_> = captures()
            .iter()
            .take(3)
            .flat_map(|path| ip_packets(path))
            .map(|packet| packet.bytes)
            .collect();
        packets.extend((20..whole.len()).map(|len| whole[..len].to_vec()));
        packets.extend((0..whole.len()).map(|at| {
            let mut damaged = whole.clone();
            damaged[at] ^= 0xff;
            damaged
        }));
        packets.extend((0..2000).map(|len| {
            let mut bytes: Vec<_> = (0..40 + len % 200).map(|_| random()).collect();
            bytes[0] = if len % 2 == 0 { 0x45 } else { 0x60 };
            bytes[9] = 17;
            bytes[6] = if len % 2 == 0 { 0 } else { 17 };
            bytes
        }));
        for packet in &packets {
            assert_eq!(kernel.run(packet, 1).0, 1, "{hook:?}: {packet:02x?}");
            kernel.drain();
        }
    }
}

#[test]
fn the_verified_host_programs_can_only_return_one() {
    const EXIT: u8 = 0x95;
    const CALL: u8 = 0x85;
    for hook in [Hook::Ingress, Hook::Egress] {
        let kernel = Kernel::load_hook(hook);
        let main = kernel.verified_main();
        assert!(main.iter().any(|[code, ..]| *code == EXIT));
        for (at, [code, registers, low, high, immediate @ ..]) in main.iter().enumerate() {
            let (class, offset) = (code & 7, i16::from_le_bytes([*low, *high]));
            if *code == EXIT {
                // r0 = 1, in 32 or 64 bits.
                let [before, registers, _, _, value @ ..] = main[at - 1];
                assert!(matches!(before, 0xb4 | 0xb7), "{hook:?}: {main:02x?}");
                assert_eq!((registers & 0x0f, value), (0, [1, 0, 0, 0]), "{hook:?}");
            } else if matches!(class, 5 | 6) && *code != CALL {
                let target = at.strict_add_signed(1 + isize::from(offset));
                assert_ne!(main[target][0], EXIT, "{hook:?}: a jump past the value");
                assert_ne!(*code, 0x06, "{hook:?}: {registers} {immediate:?}");
            }
        }
    }
}

#[test]
fn an_unknown_writer_is_captured_until_its_budget_ends_then_metered_then_only_counted() {
    let mut kernel = Kernel::load();
    let writer = Guid::new(GuidPrefix(*b"\x01\x0fsomebodyxx"), EntityId([0, 0, 1, 3]));
    let frame = |sn| program_run::data(writer, sn, 1000);

    assert!(!kernel.frame(&frame(1)).kept, "no budget at first");
    kernel.set_unknown_budget(2500, 2);
    let seen: Vec<_> = (2..8).map(|sn| kernel.frame(&frame(sn))).collect();
    let kept: Vec<_> = seen.iter().map(|seen| seen.kept).collect();
    assert_eq!(kept, [true, true, true, false, false, false]);
    let records: Vec<_> = seen.iter().map(|seen| seen.records.len()).collect();
    assert_eq!(records, [0, 0, 0, 1, 1, 0]);

    kernel.set_interest(&BTreeMap::from([(writer, Verdict::Meter)]));
    assert_eq!(kernel.frame(&frame(9)).records.len(), 1);
}

#[test]
fn thirty_two_samples_in_one_datagram_become_records_and_more_make_it_captured() {
    let writer = Guid::new(GuidPrefix(*b"\x01\x10packspacks"), EntityId([0, 0, 1, 3]));
    let mut kernel = Kernel::load();
    kernel.set_interest(&BTreeMap::from([(writer, Verdict::Meter)]));
    let seen = kernel.frame(&program_run::datagram(&program_run::message(
        writer,
        1..=32,
        20,
    )));
    let numbers: Vec<_> = seen
        .records
        .iter()
        .map(|record| record.sequence_number)
        .collect();
    assert_eq!(
        (seen.kept, numbers),
        (false, (1..=32).collect::<Vec<u64>>())
    );
    let seen = kernel.frame(&program_run::datagram(&program_run::message(
        writer,
        1..=33,
        20,
    )));
    assert_eq!((seen.kept, seen.records.len()), (true, 0));
}

/// Cuts a message into fragments, shows them to the kernel in `order`, and gives all records found
/// and the fragments kept.
fn fragmented(
    kernel: &mut Kernel,
    payload: &[u8],
    ipv6: bool,
    order: &[usize],
) -> (Vec<Record>, Vec<usize>) {
    let fragments = program_run::fragments(payload, 1480, ipv6, kernel.next_identification());
    show(kernel, &fragments, order)
}

/// Shows fragments to the kernel in `order`, and gives all records found and the fragments kept.
fn show(kernel: &mut Kernel, fragments: &[Vec<u8>], order: &[usize]) -> (Vec<Record>, Vec<usize>) {
    let (mut records, mut kept) = (Vec::new(), Vec::new());
    for index in order {
        let seen = kernel.frame(&fragments[*index]);
        records.extend(seen.records);
        if seen.kept {
            kept.push(*index);
        }
    }
    (records, kept)
}

#[test]
fn samples_in_later_fragments_are_found_and_count_only_when_all_fragments_came() {
    let writer = Guid::new(GuidPrefix(*b"\x01\x10fragmented"), EntityId([0, 0, 1, 3]));
    let mut kernel = Kernel::load();
    kernel.set_interest(&BTreeMap::from([(writer, Verdict::Meter)]));
    // Submessages of 496 bytes from offset 20 on: none begins or ends its header across a cut.
    let payload = program_run::message(writer, 1..=9, 472);
    for ipv6 in [false, true] {
        let (records, kept) = fragmented(&mut kernel, &payload, ipv6, &[0, 1, 2, 3]);
        let numbers: BTreeSet<_> = records
            .iter()
            .map(|record| record.sequence_number)
            .collect();
        assert_eq!(numbers, (1..=9).collect(), "IPv6 {ipv6}: {kept:?} kept");

        let (records, _) = fragmented(&mut kernel, &payload, ipv6, &[0, 1, 3]);
        assert!(
            records.is_empty(),
            "a fragment is missing: nothing was delivered"
        );

        let (records, _) = fragmented(&mut kernel, &payload, ipv6, &[0, 1, 1, 2, 3, 3]);
        assert_eq!(records.len(), 9, "a repeated fragment changes nothing");
    }
}

#[test]
fn two_fragments_that_begin_within_512_bytes_of_each_other_both_count() {
    let writer = Guid::new(GuidPrefix(*b"\x01\x10smallcells"), EntityId([0, 0, 1, 3]));
    let mut kernel = Kernel::load();
    kernel.set_interest(&BTreeMap::from([(writer, Verdict::Meter)]));
    let payload = program_run::message(writer, 1..=9, 472);
    let numbers = |records: &[Record]| -> Vec<u64> {
        records
            .iter()
            .map(|record| record.sequence_number)
            .collect()
    };
    let all: Vec<u64> = (1..=9).collect();
    for ipv6 in [false, true] {
        // Half a submessage each.
        let id = kernel.next_identification();
        let fragments = program_run::fragments(&payload, 248, ipv6, id);
        let order: Vec<_> = (0..fragments.len()).collect();
        let (records, _) = show(&mut kernel, &fragments, &order);
        assert_eq!(numbers(&records), all, "IPv6 {ipv6}: in order");

        let id = kernel.next_identification();
        let fragments = program_run::fragments(&payload, 248, ipv6, id);
        let twice: Vec<_> = order.iter().flat_map(|index| [*index; 2]).collect();
        let (records, _) = show(&mut kernel, &fragments, &twice);
        assert_eq!(numbers(&records), all, "IPv6 {ipv6}: each one twice");

        let id = kernel.next_identification();
        let fragments = program_run::fragments(&payload, 248, ipv6, id);
        let (records, _) = show(&mut kernel, &fragments, &order[..order.len() - 1]);
        assert!(records.is_empty(), "IPv6 {ipv6}: the last one is missing");
    }
    // A link that takes 8 bytes less than the one before cuts them off each fragment.
    let id = kernel.next_identification();
    let fragments = program_run::fragments_of(&payload, &[1472, 8], false, id);
    let order: Vec<_> = (0..fragments.len()).collect();
    let (records, _) = show(&mut kernel, &fragments, &order);
    assert_eq!(numbers(&records), all, "8 bytes cut off each");
}

#[test]
fn a_header_cut_in_two_and_fragments_out_of_order_are_handed_over() {
    let writer = Guid::new(GuidPrefix(*b"\x01\x10cutheaders"), EntityId([0, 0, 1, 3]));
    let mut kernel = Kernel::load();
    kernel.set_interest(&BTreeMap::from([(writer, Verdict::Meter)]));
    for size in [20, 100, 244, 472, 700] {
        let payload = program_run::message(writer, 1..=30, size);
        kernel.set_unknown_budget(1 << 20, 0);
        let count = program_run::fragments(&payload, 1480, false, 1).len();
        let mut orders = vec![(0..count).collect::<Vec<_>>(), (0..count).rev().collect()];
        let mut swapped: Vec<_> = (0..count).collect();
        let middle = count / 2;
        swapped.swap(middle, middle.saturating_sub(1).max(1).min(count - 1));
        orders.push(swapped);
        for order in orders {
            let (mut records, kept) = fragmented(&mut kernel, &payload, false, &order);
            if kept.len() == count {
                continue; // user space has all of it
            }
            // What was handed over is read by user space from the kept fragments.
            records.extend(kernel.take_rest());
            let numbers: BTreeSet<_> = records
                .iter()
                .map(|record| record.sequence_number)
                .collect();
            assert_eq!(numbers, (1..=30).collect(), "size {size}, order {order:?}");
            assert_eq!(
                records.len(),
                30,
                "size {size}, order {order:?}: none twice"
            );
        }
    }
}

#[test]
fn discovery_behind_user_data_in_a_later_fragment_is_captured() {
    let prefix = GuidPrefix(*b"\x01\x10behindbehi");
    let writer = Guid::new(prefix, EntityId([0, 0, 1, 3]));
    let mut kernel = Kernel::load();
    kernel.set_interest(&BTreeMap::from([(writer, Verdict::Meter)]));
    let mut payload = program_run::message(writer, 1..=3, 1200);
    let announcement = Guid::new(prefix, EntityId::SEDP_PUBLICATIONS_WRITER);
    payload.extend(&program_run::message(announcement, 1..=1, 300)[20..]);
    let (records, kept) = fragmented(&mut kernel, &payload, false, &[0, 1, 2]);
    assert_eq!(
        kept,
        [2],
        "the fragment with the announcement, and no other"
    );
    assert!(records.is_empty(), "they wait for the rest");
    let rest = kernel.take_rest();
    let seen: BTreeSet<_> = rest
        .iter()
        .map(|record| (record.writer, record.sequence_number))
        .collect();
    assert_eq!(seen.len(), 4);
    assert!(seen.contains(&(guid_words(announcement), 1)));
}

#[test]
fn an_acknack_is_metered_by_its_reader() {
    let reader = Guid::new(GuidPrefix(*b"\x01\x0freaderread"), EntityId([0, 0, 7, 4]));
    let mut payload = b"RTPS\x02\x03\x01\x0f".to_vec();
    payload.extend_from_slice(&reader.prefix.0);
    payload.extend_from_slice(&[0x06, 1, 24, 0]);
    payload.extend_from_slice(&[reader.entity.0, [0, 0, 1, 3]].concat());
    payload.extend_from_slice(&[0, 0, 0, 0, 5, 0, 0, 0, 0, 0, 0, 0, 1, 0, 0, 0]);
    let mut kernel = Kernel::load();
    kernel.set_unknown_budget(10_000, 10);
    assert!(
        kernel
            .frame(&program_run::datagram(&payload))
            .records
            .is_empty()
    );
    kernel.set_interest(&BTreeMap::from([(reader, Verdict::Meter)]));
    let seen = kernel.frame(&program_run::datagram(&payload));
    assert_eq!(seen.records.len(), 1);
    assert_eq!(
        (seen.records[0].reader(), seen.records[0].sequence_number),
        (reader, 5)
    );
}

#[test]
fn foreign_and_damaged_frames_are_never_kept() {
    let mut kernel = Kernel::load();
    kernel.set_unknown_budget(1 << 20, 100);
    let writer = Guid::new(GuidPrefix(*b"\x01\x0fdamageddam"), EntityId([0, 0, 1, 3]));
    let whole = program_run::data(writer, 1, 100);
    assert!(kernel.frame(&whole).kept);
    for len in 20..whole.len() {
        kernel.frame(&whole[..len]);
    }
    for at in 0..whole.len() {
        let mut damaged = whole.clone();
        damaged[at] ^= 0xff;
        kernel.frame(&damaged);
    }
    assert!(
        !kernel
            .frame(&program_run::datagram(b"not RTPS at all, but long enough"))
            .kept
    );
}

#[test]
fn a_sample_in_many_datagrams_is_one_record_and_a_hole_ends_it() {
    let writer = Guid::new(GuidPrefix(*b"\x01\x12manyframes"), EntityId([0, 0, 1, 3]));
    let mut kernel = Kernel::load();
    kernel.set_interest(&BTreeMap::from([(writer, Verdict::Meter)]));
    let mut show = |fragments: &[u32]| -> Vec<(u32, u32)> {
        let frames = fragments
            .iter()
            .map(|start| program_run::fragment(writer, 1, *start, 20));
        let mut records: Vec<_> = frames
            .flat_map(|frame| kernel.frame(&frame).records)
            .collect();
        records.extend(kernel.take_stalled());
        records
            .iter()
            .map(|each| (each.fragment_start, each.fragments_in_submessage()))
            .collect()
    };
    let all: Vec<_> = (1..=20).collect();
    assert_eq!(show(&all), [(1, 20)]);
    assert_eq!(show(&[1, 2, 3, 5, 6]), [(1, 3), (5, 1), (6, 1)]);
    assert_eq!(show(&[7]), [(7, 1)], "a retransmission waits for nothing");
    assert_eq!(
        show(&[1, 2]),
        [(1, 2)],
        "what nobody continues is taken out"
    );
}

#[test]
fn a_sender_that_moves_to_another_cpu_leaves_no_fragments_behind() {
    let cpus = std::thread::available_parallelism().unwrap().get();
    assert!(
        cpus >= 2,
        "with one CPU there is nowhere to move to: run this on two"
    );
    let writer = Guid::new(GuidPrefix(*b"\x01\x12wanderers!"), EntityId([0, 0, 1, 3]));
    let mut kernel = Kernel::load();
    kernel.set_interest(&BTreeMap::from([(writer, Verdict::Meter)]));
    let mut records = Vec::new();
    for start in 1..=20 {
        program_run::go_to_cpu(usize::from((8..15).contains(&start)));
        records.extend(
            kernel
                .frame(&program_run::fragment(writer, 1, start, 20))
                .records,
        );
    }
    let runs: Vec<_> = records
        .iter()
        .map(|record| (record.fragment_start, record.fragments_in_submessage()))
        .collect();
    assert_eq!(runs, [(1, 7), (8, 7), (15, 6)]);
    assert!(kernel.take_stalled().is_empty());
}

#[test]
fn a_change_of_any_source_of_the_kernel_object_is_noticed() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("../..");
    let object = root.join("agent-ebpf");
    let list = std::fs::read_to_string(object.join("filter.bpf.sha256")).unwrap();
    let listed: BTreeSet<_> = list
        .lines()
        .filter_map(|line| Some(line.split_once("  ")?.1))
        .collect();
    for entry in std::fs::read_dir(object.join("src")).unwrap() {
        let name = entry.unwrap().file_name().into_string().unwrap();
        assert!(listed.contains(&*format!("src/{name}")), "{name}");
    }
    // Files that a list kept by hand left out for long.
    for name in ["frame.rs", "parameters.rs", "rtps/submessage.rs"] {
        assert!(listed.contains(&*format!("../wire/src/{name}")), "{name}");
    }
    let place = tempfile::tempdir().unwrap();
    for name in listed.iter().copied().chain(["filter.bpf.sha256"]) {
        let copy = place.path().join("agent-ebpf").join(name);
        let parts: PathBuf = copy.components().fold(PathBuf::new(), |path, part| {
            if part == std::path::Component::ParentDir {
                return path.parent().unwrap().to_path_buf();
            }
            path.join(part)
        });
        std::fs::create_dir_all(parts.parent().unwrap()).unwrap();
        std::fs::copy(object.join(name), parts).unwrap();
    }
    let copied = place.path().join("agent-ebpf");
    let run = |program: &str, arguments: &str| {
        let mut command = std::process::Command::new(program);
        let command = command.args(["-c", arguments]).current_dir(&copied);
        command.output().unwrap().status.success()
    };
    // As it would be just after it was built.
    let sums = "{ head -n 1 filter.bpf.sha256; sed 1d filter.bpf.sha256 | cut -c67- | xargs sha256sum; } \
                > new && mv new filter.bpf.sha256";
    assert!(run("bash", sums));
    assert!(run("bash", "./build.sh --stale"));
    std::fs::write(place.path().join("wire/src/frame.rs"), "// changed").unwrap();
    assert!(!run("bash", "./build.sh --stale"));
}
