use proptest::prelude::*;
use ros2probe_wire::record::kind;

use super::*;
use crate::tables::tests::assert_driven;

use ros2probe_wire::time::SECOND;
const PART: usize = 1480;

fn key(id: u32) -> FlowKey {
    FlowKey {
        namespace: 0,
        interface: 3,
        outgoing: false,
        source: [1; 16],
        destination: [2; 16],
        id,
    }
}

/// Returns a UDP header (7401 to 7400) and `length` bytes of payload that depend on their position.
fn transport(length: usize, seed: usize) -> Vec<u8> {
    let total = u16::try_from(length + 8).unwrap();
    let mut bytes = vec![0x1c, 0xe9, 0x1c, 0xe8];
    bytes.extend_from_slice(&total.to_be_bytes());
    bytes.extend_from_slice(&[0, 0]);
    bytes.extend((0..length).map(|at| u8::try_from((at * 7 + at / 251 + seed) % 256).unwrap()));
    bytes
}

fn fragment(bytes: &[u8], start: usize, end: usize) -> Fragment<'_> {
    let end = end.min(bytes.len());
    Fragment {
        id: 0,
        offset: u32::try_from(start).unwrap(),
        more: end < bytes.len(),
        bytes: &bytes[start..end],
        length: u32::try_from(end - start).unwrap(),
    }
}

fn fragments(bytes: &[u8]) -> Vec<Fragment<'_>> {
    (0..bytes.len())
        .step_by(PART)
        .map(|start| fragment(bytes, start, start + PART))
        .collect()
}

fn feed(reassembly: &mut Reassembly, id: u32, parts: &[Fragment<'_>]) -> Vec<Reassembled> {
    let key = key(id);
    parts
        .iter()
        .filter_map(|part| reassembly.fragment(Timestamp(SECOND), key, part))
        .collect()
}

fn handover(offset: u32, datagram_len: u16) -> Record {
    Record {
        kind: kind::HANDOVER,
        payload_len: offset,
        datagram_len,
        destination_port: 7410,
        ..Record::default()
    }
}

fn assert_empty(reassembly: &Reassembly) {
    assert_eq!((reassembly.flows(), reassembly.bytes()), (0, 0));
}

#[test]
fn fragments_in_any_order_yield_the_datagram_once() {
    let bytes = transport(60_000, 0);
    let parts = fragments(&bytes);
    let mut reversed = parts.clone();
    reversed.reverse();
    let mut twice: Vec<_> = parts.iter().flat_map(|part| [*part, *part]).collect();
    twice.rotate_left(31);
    for order in [parts, reversed, twice] {
        let mut reassembly = Reassembly::new(Limits::default());
        let done = feed(&mut reassembly, 1, &order);
        assert_eq!(done.len(), 1);
        assert_eq!(done[0].payload(), &bytes[8..]);
        assert_eq!(
            (done[0].length, done[0].start, done[0].handover),
            (60_000, 0, None)
        );
        assert_eq!(
            (done[0].source_port, done[0].destination_port),
            (7401, 7400)
        );
        assert_empty(&reassembly);
    }
}

#[test]
fn a_late_repeated_fragment_does_not_reopen_a_datagram() {
    let bytes = transport(4000, 0);
    let parts = fragments(&bytes);
    let mut reassembly = Reassembly::new(Limits::default());
    assert_eq!(feed(&mut reassembly, 1, &parts).len(), 1);
    assert_eq!(feed(&mut reassembly, 1, &parts[..2]), []);
    assert_eq!(reassembly.counters().duplicate, 2);
    assert_empty(&reassembly);
    // After a while another datagram may reuse the identification.
    let later = Timestamp(3 * SECOND);
    assert!(
        parts
            .iter()
            .any(|part| reassembly.fragment(later, key(1), part).is_some())
    );
}

#[test]
fn finished_and_incomplete_datagrams_are_forgotten_after_the_clock_was_set_back() {
    let bytes = transport(4000, 0);
    let parts = fragments(&bytes);
    let mut reassembly = Reassembly::new(Limits::default());
    let mut feed = |seconds: u64, id: u32, parts: &[Fragment<'_>]| {
        let at = Timestamp(seconds * SECOND);
        let done = parts
            .iter()
            .filter_map(|part| reassembly.fragment(at, key(id), part));
        (done.count(), reassembly.counters().timed_out)
    };
    assert_eq!(feed(7200, 1, &parts), (1, 0));
    assert_eq!(feed(7200, 2, &parts[1..]), (0, 0));
    // Other datagrams reuse both identifications.
    assert_eq!(feed(3602, 1, &parts), (1, 1));
    assert_eq!(feed(3602, 2, &parts), (1, 1));
    assert_empty(&reassembly);
}

#[test]
fn overlapping_fragments_yield_the_datagram() {
    let bytes = transport(4000, 0);
    let parts = [
        fragment(&bytes, 800, 1600),
        fragment(&bytes, 2400, 3200),
        fragment(&bytes, 0, 1200),
        fragment(&bytes, 1200, 2800),
        fragment(&bytes, 3000, 4008),
    ];
    let mut reassembly = Reassembly::new(Limits::default());
    let done = feed(&mut reassembly, 1, &parts);
    assert_eq!(done.len(), 1);
    assert_eq!(done[0].payload(), &bytes[8..]);
}

#[test]
fn a_reused_identification_starts_a_new_datagram() {
    let (old, new) = (transport(4000, 0), transport(4000, 1));
    let mut reassembly = Reassembly::new(Limits::default());
    assert_eq!(feed(&mut reassembly, 1, &fragments(&old)[..2]), []);
    let done = feed(&mut reassembly, 1, &fragments(&new));
    assert_eq!(done.len(), 1);
    assert_eq!(done[0].payload(), &new[8..]);
    assert_eq!(reassembly.counters().contradictory, 1);
    // A shorter datagram follows the middle of a longer one.
    let short = transport(1600, 2);
    assert_eq!(feed(&mut reassembly, 2, &fragments(&old)[1..2]), []);
    let done = feed(
        &mut reassembly,
        2,
        &[fragments(&short)[1], fragments(&short)[0]],
    );
    assert_eq!(done.len(), 1);
    assert_eq!(done[0].payload(), &short[8..]);
    assert_empty(&reassembly);
}

#[test]
fn fragments_of_different_interfaces_and_directions_do_not_mix() {
    let bytes = transport(4000, 0);
    let mut reassembly = Reassembly::new(Limits::default());
    let mut done = 0;
    for part in fragments(&bytes) {
        for (interface, outgoing) in [(3, false), (4, false), (4, true)] {
            let key = FlowKey {
                interface,
                outgoing,
                ..key(1)
            };
            done += usize::from(reassembly.fragment(Timestamp(0), key, &part).is_some());
        }
    }
    assert_eq!((done, reassembly.counters().duplicate), (3, 0));
}

#[test]
fn a_datagram_with_a_missing_fragment_times_out() {
    let bytes = transport(4000, 0);
    let mut reassembly = Reassembly::new(Limits::default());
    assert_eq!(feed(&mut reassembly, 1, &fragments(&bytes)[1..]), []);
    reassembly.advance(Timestamp(31 * SECOND));
    assert_eq!(
        (reassembly.flows(), reassembly.counters().timed_out),
        (1, 0)
    );
    reassembly.advance(Timestamp(31 * SECOND + 1));
    assert_eq!(reassembly.counters().timed_out, 1);
    assert_empty(&reassembly);
}

#[test]
fn datagrams_beyond_the_cap_evict_the_oldest_flow() {
    let bytes = transport(4000, 0);
    let limits = Limits {
        flows: 3,
        ..Limits::default()
    };
    let mut reassembly = Reassembly::new(limits);
    for id in 0..5 {
        assert_eq!(feed(&mut reassembly, id, &fragments(&bytes)[..1]), []);
    }
    assert_eq!((reassembly.flows(), reassembly.counters().evicted), (3, 2));
    assert_driven::<Flows>();
    assert_eq!(feed(&mut reassembly, 4, &fragments(&bytes)[1..]).len(), 1);
    assert_eq!(feed(&mut reassembly, 1, &fragments(&bytes)[1..]), []);
}

#[test]
fn memory_depends_on_received_bytes_and_not_on_the_announced_length() {
    let bytes = transport(65_000, 0);
    let tail = fragment(&bytes, 65_000, 65_008);
    let mut reassembly = Reassembly::new(Limits::default());
    assert_eq!(feed(&mut reassembly, 1, &[tail]), []);
    assert!(reassembly.bytes() < 1000, "{}", reassembly.bytes());
    let mut small = Reassembly::new(Limits {
        bytes: 100_000,
        ..Limits::default()
    });
    for id in 0..10 {
        assert_eq!(feed(&mut small, id, &fragments(&bytes)[1..]), []);
        assert!(small.bytes() <= 100_000);
    }
    assert_eq!((small.flows(), small.counters().evicted), (1, 9));
    for id in 100..300 {
        assert_eq!(feed(&mut small, id, &fragments(&bytes)[..1]), []);
        assert!(small.bytes() <= 100_000);
    }
    assert_driven::<FlowBytes>();
}

#[test]
fn finished_datagrams_are_remembered_within_a_cap() {
    let bytes = transport(2000, 0);
    let mut reassembly = Reassembly::new(Limits {
        max_finished: 10,
        ..Limits::default()
    });
    for id in 0..1000 {
        assert_eq!(feed(&mut reassembly, id, &fragments(&bytes)).len(), 1);
    }
    reassembly.advance(Timestamp(SECOND));
    assert_eq!(
        (reassembly.finished.len(), reassembly.finished_order.len()),
        (10, 10)
    );
    assert_driven::<FinishedFlows>();
    reassembly.advance(Timestamp(9 * SECOND));
    assert!(reassembly.finished.is_empty() && reassembly.finished_order.is_empty());
}

#[test]
fn a_handover_and_its_fragments_yield_a_datagram_in_either_order() {
    let bytes = transport(10_000, 0);
    let parts = fragments(&bytes);
    let record = handover(5000, 10_000);
    // Byte 5000 + 8 is in the fourth fragment.
    for record_at in 0..=4 {
        let mut reassembly = Reassembly::new(Limits::default());
        let mut done = Vec::new();
        for (count, part) in parts[3..].iter().enumerate() {
            if count == record_at {
                done.extend(reassembly.hand_over(Timestamp(7), key(1), &record));
            }
            done.extend(reassembly.fragment(Timestamp(9), key(1), part));
        }
        if record_at == 4 {
            done.extend(reassembly.hand_over(Timestamp(9), key(1), &record));
        }
        assert_eq!(done.len(), 1, "record before part {record_at}");
        let done = &done[0];
        assert_eq!(
            (done.start, done.length, done.destination_port),
            (5000, 10_000, 7410)
        );
        assert_eq!(done.handover, Some(record));
        assert_eq!(&done.payload()[..5000], &[0; 5000]);
        assert_eq!(&done.payload()[5000..], &bytes[5008..]);
        assert_empty(&reassembly);
        assert_eq!(reassembly.fragment(Timestamp(9), key(1), &parts[6]), None);
        assert_empty(&reassembly);
    }
}

#[test]
fn a_handover_survives_fragments_that_contradict_it() {
    let bytes = transport(10_000, 0);
    let longer = transport(12_000, 0);
    let mut reassembly = Reassembly::new(Limits::default());
    assert_eq!(
        reassembly.hand_over(Timestamp(0), key(1), &handover(5000, 10_000)),
        None
    );
    assert_eq!(feed(&mut reassembly, 1, &fragments(&longer)[7..]), []);
    assert_eq!(reassembly.counters().contradictory, 2);
    assert_eq!(feed(&mut reassembly, 1, &fragments(&bytes)[3..]).len(), 1);
    assert_eq!(
        reassembly.hand_over(Timestamp(0), key(2), &handover(10_000, 10_000)),
        None
    );
    assert_eq!(reassembly.counters().malformed, 1);
    assert_empty(&reassembly);
}

#[test]
fn a_handover_has_the_flow_key_of_its_fragments() {
    let record = Record {
        interface: 3,
        flags: flag::OUTGOING,
        encapsulation: 0xbeef,
        destination: [u32::from_ne_bytes([2; 4]); 4],
        stamp_seconds: u32::from_ne_bytes([1; 4]),
        stamp_nanoseconds: u32::from_ne_bytes([1; 4]),
        fragment_start: u32::from_ne_bytes([1; 4]),
        fragments: u32::from_ne_bytes([1; 4]),
        ..Record::default()
    };
    let expected = FlowKey {
        outgoing: true,
        ..key(0xbeef)
    };
    assert_eq!(FlowKey::of_handover(0, &record), expected);
}

#[test]
fn a_truncated_capture_yields_the_first_bytes_and_the_true_length() {
    let bytes = transport(4000, 0);
    let cut = |part: &Fragment<'_>| Fragment {
        bytes: &bytes[..0],
        ..*part
    };
    let parts = fragments(&bytes);
    let first = Fragment {
        bytes: &bytes[..222],
        ..parts[0]
    };
    for order in [
        [first, cut(&parts[1]), cut(&parts[2])],
        [cut(&parts[2]), first, cut(&parts[1])],
    ] {
        let mut reassembly = Reassembly::new(Limits::default());
        let done = feed(&mut reassembly, 1, &order);
        assert_eq!(done.len(), 1);
        assert_eq!((done[0].length, done[0].payload()), (4000, &bytes[8..222]));
        assert_empty(&reassembly);
    }
}

#[test]
fn a_datagram_with_an_impossible_udp_length_is_not_delivered() {
    for length in [0_u16, 7, 4009] {
        let mut bytes = transport(4000, 0);
        bytes[4..6].copy_from_slice(&length.to_be_bytes());
        let mut reassembly = Reassembly::new(Limits::default());
        assert_eq!(feed(&mut reassembly, 1, &fragments(&bytes)), []);
        assert_eq!(reassembly.counters().malformed, 1);
        assert_empty(&reassembly);
    }
}

proptest! {
    #[test]
    fn shuffled_fragments_of_many_datagrams_yield_every_datagram(
        lengths in prop::collection::vec(1500..9000_usize, 1..6),
        order in any::<prop::sample::Index>(),
        seed in any::<u64>(),
    ) {
        let datagrams: Vec<_> =
            lengths.iter().enumerate().map(|(seed, length)| transport(*length, seed)).collect();
        let mut parts = Vec::new();
        for (id, bytes) in datagrams.iter().enumerate() {
            for part in fragments(bytes) {
                parts.push((u32::try_from(id).unwrap(), part));
            }
        }
        let repeated = order.index(parts.len());
        parts.push(parts[repeated]);
        parts.sort_by_key(|(id, part)| {
            (seed ^ u64::from(*id) << 20 ^ u64::from(part.offset)).wrapping_mul(0x9e37_79b9_7f4a_7c15)
        });
        let mut reassembly = Reassembly::new(Limits::default());
        let mut done = vec![0; datagrams.len()];
        for (id, part) in parts {
            if let Some(datagram) = reassembly.fragment(Timestamp(0), key(id), &part) {
                let id = usize::try_from(id).unwrap();
                prop_assert_eq!(datagram.payload(), &datagrams[id][8..]);
                done[id] += 1;
            }
        }
        prop_assert!(done.iter().all(|count| *count == 1));
        assert_empty(&reassembly);
    }

    #[test]
    fn arbitrary_fragments_stay_within_the_caps(
        parts in prop::collection::vec(
            (0..6_u32, 0..8191_u32, 1..3000_u32, any::<bool>(), 0..3000_usize, 0..20_u64, 0..9_u8),
            1..200,
        ),
    ) {
        let limits = Limits { bytes: 20_000, flows: 4, max_finished: 3, ..Limits::default() };
        let mut reassembly = Reassembly::new(limits);
        let bytes = [0x11; 3000];
        for (id, offset, length, more, kept, seconds, handed_over) in parts {
            let at = Timestamp(seconds * SECOND);
            if handed_over == 0 {
                reassembly.hand_over(at, key(id), &handover(offset, 9000));
            }
            let part = Fragment {
                id,
                offset: offset * 8,
                more,
                bytes: &bytes[..kept.min(usize::try_from(length).unwrap())],
                length,
            };
            reassembly.fragment(at, key(id), &part);
            prop_assert!(reassembly.bytes() <= limits.bytes && reassembly.flows() <= limits.flows);
            let sum: usize = reassembly.flows.values().map(Flow::memory).sum();
            prop_assert_eq!(reassembly.bytes(), sum);
            prop_assert_eq!(reassembly.order.len(), reassembly.flows());
            prop_assert_eq!(reassembly.finished.len(), reassembly.finished_order.len());
        }
        reassembly.advance(Timestamp(100 * SECOND));
        assert_empty(&reassembly);
    }
}
