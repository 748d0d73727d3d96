//! Datagrams in IP fragments: samples in later fragments, headers cut in two, and missing
//! fragments.

use super::*;

/// Cuts a message into fragments, passes them to the kernel in `order`, and returns all records and
/// the captured fragments.
fn fragmented(
    kernel: &mut Kernel,
    payload: &[u8],
    ipv6: bool,
    order: &[usize],
) -> (Vec<Record>, Vec<usize>) {
    let fragments = program_run::fragments(payload, 1480, ipv6, kernel.next_identification());
    show(kernel, &fragments, order)
}

/// Passes fragments to the kernel in `order`, and returns all records and the captured fragments.
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
fn samples_in_later_fragments_count_only_when_all_fragments_have_arrived() {
    at_interfaces(|hook| {
        let writer = Guid::new(GuidPrefix(*b"\x01\x10fragmented"), EntityId([0, 0, 1, 3]));
        let mut kernel = Kernel::load_hook(hook);
        kernel.set_interest(&BTreeMap::from([(writer, Verdict::Meter)]));
        // The submessages have 496 bytes from offset 20, so no header crosses a cut.
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
    });
}

#[test]
fn two_fragments_that_begin_within_512_bytes_of_each_other_both_count() {
    at_interfaces(|hook| {
        let writer = Guid::new(GuidPrefix(*b"\x01\x10smallcells"), EntityId([0, 0, 1, 3]));
        let mut kernel = Kernel::load_hook(hook);
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
            // Each fragment has half a submessage.
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
        // A link with an MTU that is 8 bytes smaller cuts 8 bytes off each fragment.
        let id = kernel.next_identification();
        let fragments = program_run::fragments_of(&payload, &[1472, 8], false, id);
        let order: Vec<_> = (0..fragments.len()).collect();
        let (records, _) = show(&mut kernel, &fragments, &order);
        assert_eq!(numbers(&records), all, "8 bytes cut off each");
    });
}

#[test]
fn a_split_header_or_reordered_fragments_cause_a_handover() {
    at_interfaces(|hook| {
        let writer = Guid::new(GuidPrefix(*b"\x01\x10cutheaders"), EntityId([0, 0, 1, 3]));
        let mut kernel = Kernel::load_hook(hook);
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
                // User space reads the handed-over rest from the captured fragments.
                records.extend(kernel.take_remainder());
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
    });
}

#[test]
fn discovery_after_user_data_in_a_later_fragment_is_captured() {
    at_interfaces(|hook| {
        let prefix = GuidPrefix(*b"\x01\x10behindbehi");
        let writer = Guid::new(prefix, EntityId([0, 0, 1, 3]));
        let mut kernel = Kernel::load_hook(hook);
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
        let rest = kernel.take_remainder();
        let seen: BTreeSet<_> = rest
            .iter()
            .map(|record| (record.writer, record.sequence_number))
            .collect();
        assert_eq!(seen.len(), 4);
        assert!(seen.contains(&(guid_words(announcement), 1)));
    });
}

#[test]
fn a_sample_in_many_datagrams_is_one_record_up_to_a_missing_fragment() {
    at_interfaces(|hook| {
        let writer = Guid::new(GuidPrefix(*b"\x01\x12manyframes"), EntityId([0, 0, 1, 3]));
        let mut kernel = Kernel::load_hook(hook);
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
            "a record without a continuation is written, too"
        );
    });
}

#[test]
fn a_sender_that_moves_to_another_cpu_loses_no_fragments() {
    at_interfaces(|hook| {
        let cpus = std::thread::available_parallelism().unwrap().get();
        assert!(
            cpus >= 2,
            "with one CPU there is nowhere to move to: run this on two"
        );
        let writer = Guid::new(GuidPrefix(*b"\x01\x12wanderers!"), EntityId([0, 0, 1, 3]));
        let mut kernel = Kernel::load_hook(hook);
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
    });
}
