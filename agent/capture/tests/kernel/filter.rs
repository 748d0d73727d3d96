//! The kernel program against the user-space walk: the same records, byte for byte.
//!
//! Every frame of every capture goes through the loaded program (BPF_PROG_TEST_RUN: no interface,
//! no socket) and through the reassembly and walk of user space. The tests need root.

mod captures;
mod fragments;

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use ros2probe_capture::pcap::PcapReader;
use ros2probe_capture::reassembly::{FlowKey, Limits, Reassembly};
use ros2probe_testing::program_run::{self, FrameResult, Hook, Kernel};
use ros2probe_wire::filter::Counter;
use ros2probe_wire::frame::{self, Link, PacketType, Payload};
use ros2probe_wire::record::{Record, Verdict, flag, guid_words, kind};
use ros2probe_wire::walk::{self, Envelope, Fate};
use ros2probe_wire::{EntityId, Guid, GuidPrefix};

use captures::{captures, ip_packets};

/// Runs a test at a packet socket, and at tcx where the kernel has it.
fn at_interfaces(test: fn(Hook)) {
    for hook in Hook::at_interfaces() {
        // A filter keeps its thread on one CPU.
        let thread = std::thread::spawn(move || test(hook));
        if let Err(panic) = thread.join() {
            std::panic::resume_unwind(panic);
        }
    }
}

#[test]
fn the_host_hook_drops_no_packet() {
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
fn the_verified_host_programs_can_only_return_1() {
    const EXIT: u8 = 0x95;
    const CALL: u8 = 0x85;
    for hook in [Hook::Ingress, Hook::Egress] {
        let kernel = Kernel::load_hook(hook);
        let main = kernel.verified_main();
        assert!(main.iter().any(|[code, ..]| *code == EXIT));
        for (at, [code, registers, low, high, immediate @ ..]) in main.iter().enumerate() {
            let (class, offset) = (code & 7, i16::from_le_bytes([*low, *high]));
            if *code == EXIT {
                // The instruction sets r0 to 1, in 32 or 64 bits.
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
fn an_unknown_writer_is_captured_within_its_budget_then_metered_then_counted() {
    at_interfaces(|hook| {
        let mut kernel = Kernel::load_hook(hook);
        let writer = Guid::new(GuidPrefix(*b"\x01\x0fsomebodyxx"), EntityId([0, 0, 1, 3]));
        let frame = |sn| program_run::data(writer, sn, 1000);

        assert!(kernel.frame(&frame(1)).kept, "a budget at first");
        kernel.set_unknown_budget(2500, 2);
        let seen: Vec<_> = (2..8).map(|sn| kernel.frame(&frame(sn))).collect();
        let kept: Vec<_> = seen.iter().map(|seen| seen.kept).collect();
        assert_eq!(kept, [true, true, true, false, false, false]);
        let records: Vec<_> = seen.iter().map(|seen| seen.records.len()).collect();
        assert_eq!(records, [0, 0, 0, 1, 1, 0]);

        kernel.set_interest(&BTreeMap::from([(writer, Verdict::Meter)]));
        assert_eq!(kernel.frame(&frame(9)).records.len(), 1);
    });
}

#[test]
fn up_to_32_samples_in_a_datagram_become_records_and_more_cause_a_capture() {
    at_interfaces(|hook| {
        let writer = Guid::new(GuidPrefix(*b"\x01\x10packspacks"), EntityId([0, 0, 1, 3]));
        let mut kernel = Kernel::load_hook(hook);
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
    });
}

#[test]
fn a_batch_becomes_the_record_of_the_walk() {
    at_interfaces(|hook| {
        let message = include_bytes!("../../../../wire/tests/data/rti-batches.bin");
        let writer = Guid::new(
            GuidPrefix([1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12]),
            EntityId([0, 0, 1, 3]),
        );
        let mut kernel = Kernel::load_hook(hook);
        kernel.set_interest(&BTreeMap::from([(writer, Verdict::Meter)]));
        let seen = kernel.frame(&program_run::datagram(message));
        let mut walked = Vec::new();
        walk::datagram(message, &Envelope::default(), None, |found| {
            walked.push(found.record);
        });
        let fields = |record: &Record| {
            (
                record.kind,
                record.writer,
                record.sequence_number,
                (
                    record.fragment_start,
                    record.sample_size,
                    record.payload_len,
                ),
                record.flags & flag::INLINE_QOS_UNREAD,
            )
        };
        assert_eq!(
            seen.records.iter().map(fields).collect::<Vec<_>>(),
            walked.iter().map(fields).collect::<Vec<_>>()
        );
        assert_eq!((seen.kept, walked.len()), (false, 3));
    });
}

#[test]
fn any_number_of_consecutive_fragments_in_a_datagram_is_one_record() {
    at_interfaces(|hook| {
        let writer = Guid::new(GuidPrefix(*b"\x01\x10manyfrags "), EntityId([0, 0, 1, 3]));
        let reports = |kernel: &mut Kernel, number, starts: Vec<u32>, of| {
            let seen = kernel.frame(&program_run::data_frags(writer, number, starts, of, 16));
            assert!(!seen.kept);
            let records = [seen.records, kernel.take_stalled()].concat();
            let reports = records.into_iter().map(|record| {
                let count = record.fragments_in_submessage();
                (record.sequence_number, record.fragment_start, count)
            });
            reports.collect::<Vec<_>>()
        };
        let mut kernel = Kernel::load_hook(hook);
        kernel.set_interest(&BTreeMap::from([(writer, Verdict::Meter)]));
        // These are more fragments than a datagram has records.
        let all: Vec<u32> = (1..=40).collect();
        assert_eq!(reports(&mut kernel, 1, all.clone(), 40), [(1, 1, 40)]);
        let later: Vec<u32> = (1..=5).chain(7..=12).collect();
        let holes = reports(&mut kernel, 2, later, 40);
        assert_eq!(holes, [(2, 1, 5), (2, 7, 6)]);
        let back = reports(&mut kernel, 3, vec![9, 10, 3, 4, 4], 40);
        assert_eq!(back, [(3, 9, 2), (3, 3, 2), (3, 4, 1)]);

        // Each submessage of an unknown writer is charged to the budget.
        kernel.forget_interest(&BTreeMap::from([(writer, Verdict::Meter)]));
        kernel.set_unknown_budget(0, 3);
        let before = kernel.counter(Counter::MeteredUnknown);
        let charged = reports(&mut kernel, 4, all, 40);
        assert_eq!(charged, [(4, 1, 3)]);
        assert_eq!(kernel.counter(Counter::MeteredUnknown) - before, 3);
    });
}

#[test]
fn an_acknack_is_metered_if_its_reader_is_metered() {
    at_interfaces(|hook| {
        let reader = Guid::new(GuidPrefix(*b"\x01\x0freaderread"), EntityId([0, 0, 7, 4]));
        let mut payload = b"RTPS\x02\x03\x01\x0f".to_vec();
        payload.extend_from_slice(&reader.prefix.0);
        payload.extend_from_slice(&[0x06, 1, 24, 0]);
        payload.extend_from_slice(&[reader.entity.0, [0, 0, 1, 3]].concat());
        payload.extend_from_slice(&[0, 0, 0, 0, 5, 0, 0, 0, 0, 0, 0, 0, 1, 0, 0, 0]);
        let mut kernel = Kernel::load_hook(hook);
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
    });
}

#[test]
fn foreign_and_damaged_frames_are_never_kept() {
    at_interfaces(|hook| {
        let mut kernel = Kernel::load_hook(hook);
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
    });
}

#[test]
fn a_change_of_any_source_of_the_kernel_object_is_noticed() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("../..");
    let object = root.join("agent-ebpf");
    let lists = ["filter.bpf.sha256", "inside.bpf.sha256"];
    let text = lists.map(|list| std::fs::read_to_string(object.join(list)).unwrap());
    let listed: BTreeSet<_> = text
        .iter()
        .flat_map(|list| list.lines())
        .filter_map(|line| Some(line.split_once("  ")?.1))
        .collect();
    for directory in ["src", "src/inside"] {
        for entry in std::fs::read_dir(object.join(directory)).unwrap() {
            let entry = entry.unwrap();
            let name = format!("{directory}/{}", entry.file_name().into_string().unwrap());
            let is_listed = entry.path().is_dir() || listed.contains(&*name);
            assert!(is_listed, "{name}");
        }
    }
    // A hand-written list once omitted these files.
    for name in [
        "frame.rs",
        "parameters.rs",
        "record/body.rs",
        "rtps/flags.rs",
    ] {
        assert!(listed.contains(&*format!("../wire/src/{name}")), "{name}");
    }
    let place = tempfile::tempdir().unwrap();
    for name in listed.iter().copied().chain(lists) {
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
    // The script writes the list as it would be just after a build.
    let sums = "for list in filter inside; do list=$list.bpf.sha256
                { head -n 1 $list; sed 1d $list | cut -c67- | xargs sha256sum; } > new && mv new $list
                done";
    for changed in ["wire/src/frame.rs", "agent-ebpf/src/inside/names.rs"] {
        assert!(run("bash", sums));
        assert!(run("bash", "./build.sh --stale"));
        std::fs::write(place.path().join(changed), "// changed").unwrap();
        assert!(!run("bash", "./build.sh --stale"), "{changed}");
    }
}
