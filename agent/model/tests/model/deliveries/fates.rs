//! Every sent sample is delivered, lost for exactly one cause, or irrelevant.

use proptest::prelude::*;
use ros2probe_model::facts::loss::LossCause;
use ros2probe_testing::model::host::{BOB, CapturePoint, Host};
use ros2probe_wire::Record;
use ros2probe_wire::record::{flag, kind};

/// The fate of one sample.
#[derive(Clone, Copy, Debug, PartialEq)]
enum SampleFate {
    Arrives,
    ArrivesTwice,
    BeforeHost,
    SocketFull,
    Reassembly,
    /// Retransmitted after it was lost or dropped by a full buffer.
    Repaired,
    RepairedAfterDrop,
    /// Retransmitted, and dropped again by a full buffer.
    RepairDropped,
    Irrelevant,
}

fn fate() -> impl Strategy<Value = SampleFate> {
    prop_oneof![
        12 => Just(SampleFate::Arrives),
        1 => Just(SampleFate::ArrivesTwice),
        2 => Just(SampleFate::BeforeHost),
        2 => Just(SampleFate::SocketFull),
        1 => Just(SampleFate::Reassembly),
        2 => Just(SampleFate::Repaired),
        1 => Just(SampleFate::RepairedAfterDrop),
        1 => Just(SampleFate::RepairDropped),
        1 => Just(SampleFate::Irrelevant),
    ]
}

/// Returns the arrival of a sample, unfragmented or as fragments of which the middle ones are
/// affected.
fn arrival(host: &Host, bob: CapturePoint, number: u64, fragmented: bool, part: bool) -> Record {
    let record = match (fragmented, part) {
        (false, _) => host.record(bob, kind::DATA, number),
        (true, false) => Record {
            elapsed: 100_000,
            ..host.fragments(bob, number, 1, 10)
        },
        (true, true) => host.fragments(bob, number, 4, 3),
    };
    Record {
        datagram_len: 9000,
        ..record
    }
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 64, failure_persistence: None, ..ProptestConfig::default() })]
    #[test]
    fn every_sent_sample_is_delivered_lost_for_one_cause_or_irrelevant(
        fates in prop::collection::vec((fate(), any::<bool>(), 1u64..30), 1..300),
    ) {
        let mut host = Host::new();
        let bob = host.reader(BOB, 7411);
        let socket_full = |record: Record| Record { flags: record.flags | flag::SOCKET_FULL, ..record };
        host.put(arrival(&host, bob, 1, false, false));
        // By then, the kernel knows the writer and captures every further fragment.
        host.wait(300);
        let mut given_up = Vec::new();
        let mut repairs = Vec::new();
        for (number, (fate, fragmented, pause)) in (2..).zip(&fates) {
            host.wait(*pause);
            let whole = arrival(&host, bob, number, *fragmented, false);
            let part = arrival(&host, bob, number, *fragmented, true);
            match fate {
                SampleFate::Arrives => host.put(whole),
                SampleFate::ArrivesTwice => {
                    host.put(whole);
                    host.put(whole);
                }
                SampleFate::BeforeHost => {}
                SampleFate::SocketFull | SampleFate::RepairedAfterDrop => {
                    host.put(socket_full(part));
                    host.put(whole);
                }
                SampleFate::Reassembly => given_up.push(number),
                SampleFate::Repaired | SampleFate::RepairDropped => {}
                SampleFate::Irrelevant => host.gap(bob, number),
            }
            if matches!(fate, SampleFate::Repaired | SampleFate::RepairedAfterDrop | SampleFate::RepairDropped) {
                repairs.push((number, *fate, *fragmented));
            }
            // Retransmissions follow some samples later.
            if repairs.len() > 4 {
                host.heartbeat(bob, 1, number);
                let (number, fate, fragmented) = repairs.remove(0);
                repair(&mut host, bob, number, fate, fragmented);
            }
        }
        let sent = 2 + fates.len() as u64;
        host.heartbeat(bob, 1, sent - 1);
        for (number, fate, fragmented) in repairs {
            repair(&mut host, bob, number, fate, fragmented);
        }
        host.data(bob, sent);
        for _ in 0..15 {
            host.wait(1000);
        }
        // Unknown causes are pending, and no sample is awaited any longer.
        let facts = host.deliveries()[0].delivered;
        prop_assert_eq!(facts.messages - facts.history + facts.lost() + facts.irrelevant, sent);
        let unknown = fates.iter().filter(|(fate, ..)| matches!(fate, SampleFate::BeforeHost | SampleFate::Reassembly));
        prop_assert_eq!(facts.pending, unknown.count() as u64);
        for number in given_up {
            host.put(Record {
                flags: flag::NOT_REASSEMBLED,
                socket: 0,
                ..host.record(bob, kind::DATA, number)
            });
        }
        for _ in 0..40 {
            host.wait(1000);
        }
        let with = |wanted: &[SampleFate]| -> Vec<u64> {
            let fates = (2..).zip(&fates);
            fates.filter(|(_, (fate, ..))| wanted.contains(fate)).map(|(number, _)| number).collect()
        };
        prop_assert_eq!(host.losses(LossCause::BeforeHost), with(&[SampleFate::BeforeHost]));
        prop_assert_eq!(host.losses(LossCause::Reassembly), with(&[SampleFate::Reassembly]));
        let full = with(&[SampleFate::SocketFull, SampleFate::RepairDropped]);
        prop_assert_eq!(host.losses(LossCause::SocketBuffer), full);
        let facts = host.deliveries()[0].delivered;
        let repaired = with(&[SampleFate::Repaired, SampleFate::RepairedAfterDrop]).len();
        prop_assert_eq!(facts.recovered, repaired as u64);
        prop_assert_eq!(facts.irrelevant, with(&[SampleFate::Irrelevant]).len() as u64);
        prop_assert_eq!(facts.duplicates, with(&[SampleFate::ArrivesTwice]).len() as u64);
        prop_assert_eq!(facts.messages + facts.lost() + facts.irrelevant, sent);
        prop_assert_eq!(host.topic().received.map(|sum| *sum), Some(facts));
    }
}

fn repair(host: &mut Host, bob: CapturePoint, number: u64, fate: SampleFate, fragmented: bool) {
    host.wait(10);
    let only_part = fate == SampleFate::RepairedAfterDrop;
    let again = arrival(host, bob, number, fragmented, only_part);
    if fate == SampleFate::RepairDropped {
        host.put(Record {
            flags: again.flags | flag::SOCKET_FULL,
            ..arrival(host, bob, number, fragmented, true)
        });
    }
    host.put(again);
}
