//! One delivery with several routes: multicast and unicast, mirrored, and the caps of routes.

use std::net::{Ipv4Addr, SocketAddrV4};

use ros2probe_model::facts::loss::LossCause;
use ros2probe_model::observe::observer::Settings;
use ros2probe_model::report::snapshot::Direction;
use ros2probe_model::report::snapshot::Subscriber;
use ros2probe_testing::model::host::{BOB, CAROL, CapturePoint, GROUP, Host};
use ros2probe_wire::Record;
use ros2probe_wire::record::kind;

#[test]
fn multicast_samples_and_unicast_retransmissions_are_one_delivery() {
    let mut host = Host::new();
    let bob = host.reader(BOB, 7411);
    let group = bob.multicast(101);
    host.owner(group, BOB);
    for number in 1..=100 {
        if number % 10 != 0 {
            host.data(group, number);
        }
        host.wait(1);
    }
    for number in (10..100).step_by(10).filter(|number| *number != 50) {
        host.data(bob.directed(BOB), number);
    }
    host.data(group, 101);
    host.wait(12_000);
    let [delivery] = &host.deliveries()[..] else {
        panic!("one receiver: {:#?}", host.deliveries())
    };
    let facts = delivery.delivered;
    assert_eq!((facts.recovered, facts.lost(), facts.messages), (8, 2, 99));
    assert_eq!(host.losses(LossCause::BeforeHost), [50, 100]);
    assert_eq!(delivery.sockets, [101, 7411]);
    assert_eq!(delivery.destination.to_string(), GROUP);
    assert_eq!(delivery.process.as_deref(), Some("listener"));
}

#[test]
fn routes_are_merged_when_their_socket_is_identified_late() {
    let mut host = Host::new();
    let bob = host.reader(BOB, 7411);
    let group = bob.multicast(101);
    for number in 1..=100 {
        if number % 10 != 0 {
            host.data(group, number);
        }
        host.wait(1);
        if number % 20 == 5 && number > 20 {
            host.data(bob.directed(BOB), number - 5);
        }
        if number == 50 {
            host.owner(group, BOB);
        }
    }
    host.data(group, 101);
    host.wait(12_000);
    let [delivery] = &host.deliveries()[..] else {
        panic!("one receiver: {:#?}", host.deliveries())
    };
    assert_eq!(
        (delivery.delivered.recovered, delivery.delivered.lost()),
        (4, 6)
    );
    assert_eq!(
        host.losses(LossCause::BeforeHost),
        [10, 30, 50, 70, 90, 100]
    );
}

#[test]
fn samples_on_both_routes_before_they_are_merged_count_once() {
    // The owner of the multicast socket is known late, or that of the unicast socket.
    for is_group_late in [true, false] {
        let mut host = Host::new();
        let bob = host.reader(BOB, 7411);
        let (group, other) = (bob.multicast(101), bob.multicast(102));
        let repairs = if is_group_late {
            bob.directed(BOB)
        } else {
            other
        };
        if !is_group_late {
            host.owner(group, BOB);
        }
        // RustDDS announces samples before it sends them, so that readers request them at once.
        for number in 1..=20 {
            if number % 5 == 0 {
                host.data(repairs, number);
            }
            host.data(group, number);
            host.wait(1);
        }
        host.wait(1000);
        host.owner(if is_group_late { group } else { other }, BOB);
        host.wait(100);
        assert_eq!(host.topic().received.unwrap().messages, 20);
        for number in 21..=30 {
            host.data(group, number);
            host.wait(1);
        }
        host.wait(12_000);
        let [delivery] = &host.deliveries()[..] else {
            panic!("one receiver: {:#?}", host.deliveries())
        };
        let facts = delivery.delivered;
        assert_eq!((facts.messages, facts.duplicates, facts.lost()), (30, 4, 0));
        let total = host.topic().received.unwrap();
        let sums = (total.messages, total.bytes, total.duplicates);
        assert_eq!(sums, (30, facts.bytes, 4));
    }
}

#[test]
fn a_copy_after_its_route_was_merged_is_a_duplicate() {
    let mut host = Host::new();
    let bob = host.reader(BOB, 7411);
    let group = bob.multicast(101);
    for number in 1..=20 {
        host.data(bob, number);
        host.wait(1);
    }
    // Fast DDS changes to multicast at the second reader, and sends by each interface.
    host.wait(1000);
    host.data(group, 21);
    host.owner(group, BOB);
    host.data(group, 21);
    for number in 22..=30 {
        host.wait(1);
        host.data(group, number);
        host.data(group, number);
    }
    host.wait(12_000);
    let [delivery] = &host.deliveries()[..] else {
        panic!("one receiver: {:#?}", host.deliveries())
    };
    let facts = delivery.delivered;
    assert_eq!(
        (facts.messages, facts.duplicates, facts.lost()),
        (30, 10, 0)
    );
    let total = host.topic().received.unwrap();
    assert_eq!((total.messages, total.duplicates), (30, 10));
}

#[test]
fn a_receiver_whose_socket_is_identified_late_has_one_delivery() {
    for names in [&[false, true][..], &[true, true], &[false, false, true]] {
        let mut host = Host::new();
        // The participant does not announce the address of a connection.
        let bob = CapturePoint {
            address: SocketAddrV4::new(Ipv4Addr::LOCALHOST, 33_983),
            ..host.reader(BOB, 7411)
        };
        let unknown = CapturePoint { socket: 0, ..bob };
        let mut number = 0;
        for is_known in names {
            if *is_known {
                host.owner(bob, BOB);
            }
            for _ in 0..100 {
                number += 1;
                host.data(bob.leaving(), number);
                host.data(if *is_known { bob } else { unknown }, number);
                host.wait(1);
            }
            // The connection is idle.
            (0..30).for_each(|_| host.wait(1000));
        }
        let deliveries = host.deliveries();
        let received = deliveries
            .iter()
            .filter(|delivery| delivery.direction == Direction::Received);
        let [delivery] = &received.collect::<Vec<_>>()[..] else {
            panic!("one receiver: {deliveries:#?}")
        };
        let facts = delivery.delivered;
        assert_eq!(
            (facts.messages, facts.lost(), facts.pending),
            (number, 0, 0)
        );
        let total = host.topic().received.unwrap();
        assert_eq!((total.messages, total.lost()), (number, 0));
        assert_eq!(delivery.sockets, [7411]);
    }
}

#[test]
fn samples_pending_when_routes_are_merged_are_counted_once() {
    let mut host = Host::new();
    let bob = host.reader(BOB, 7411);
    let group = bob.multicast(101);
    let large = |host: &mut Host, seen: CapturePoint, number| {
        let record = host.record(seen, kind::DATA, number);
        host.put(Record {
            datagram_len: 60_000,
            ..record
        });
    };
    // Samples missing by multicast arrive by unicast, and vice versa.
    (1..=5).for_each(|number| large(&mut host, bob, number));
    (9..=20).for_each(|number| large(&mut host, bob, number));
    host.wait(11_000);
    assert_eq!(host.topic().received.unwrap().pending, 3);
    for number in [6, 8, 20, 22] {
        large(&mut host, group, number);
    }
    assert_eq!(host.topic().received.unwrap().pending, 1);
    host.wait(11_000);
    host.owner(group, BOB);
    host.wait(100);
    let [delivery] = &host.deliveries()[..] else {
        panic!("one receiver: {:#?}", host.deliveries())
    };
    assert_eq!(
        delivery.delivered.pending,
        host.topic().received.unwrap().pending
    );
    for _ in 0..50 {
        host.wait(1000);
    }
    assert_eq!(host.topic().received.unwrap().pending, 0);
    assert_eq!(host.losses(LossCause::BeforeHost), [7, 21]);
}

#[test]
fn a_wire_source_separates_destinations_and_accepts_unicast_retransmissions() {
    let mut host = Host::new();
    let (bob, carol) = (
        host.reader(BOB, 7411).wire(),
        host.reader(CAROL, 7413).wire(),
    );
    let group = bob.multicast(0);
    for number in 1..=100 {
        if number % 10 != 0 {
            host.data(group, number);
        }
        host.wait(1);
    }
    for number in (10..100).step_by(20) {
        host.data(bob.directed(BOB), number);
    }
    host.wait(12_000);
    let [delivery] = &host.deliveries()[..] else {
        panic!("one group: {:#?}", host.deliveries())
    };
    assert_eq!(delivery.subscriber, Subscriber::Unknown);
    assert_eq!(
        (delivery.delivered.recovered, delivery.delivered.lost()),
        (5, 4)
    );
    // With unicast only, two addresses are two receivers.
    let mut host = Host::new();
    host.reader(BOB, 7411);
    host.reader(CAROL, 7413);
    for number in 1..=10 {
        host.data(bob, number);
        if number != 5 {
            host.data(carol, number);
        }
    }
    host.wait(12_000);
    let lost: Vec<_> = host
        .deliveries()
        .iter()
        .map(|each| {
            (
                each.participant.map(|guid| guid.prefix),
                each.delivered.lost(),
            )
        })
        .collect();
    assert_eq!(lost, [(Some(BOB), 0), (Some(CAROL), 1)]);
}

#[test]
fn a_mirrored_wire_adds_only_samples_that_sockets_do_not_see() {
    let mut host = Host::new();
    let bob = host.reader(BOB, 7411);
    let group = bob.multicast(101);
    let elsewhere = host.reader(CAROL, 7413).wire();
    host.owner(group, BOB);
    for number in 1..=100 {
        // The mirror is first and shows the samples of Bob and Carol.
        host.data(group.wire(), number);
        host.data(group, number);
        if number % 10 == 0 {
            host.data(elsewhere.directed(CAROL), number - 5);
        }
        host.wait(10);
    }
    host.wait(12_000);
    let [delivery] = &host.deliveries()[..] else {
        panic!("Bob alone: {:#?}", host.deliveries())
    };
    assert_eq!(delivery.participant.unwrap().prefix, BOB);
    let facts = delivery.delivered;
    assert_eq!(
        (facts.messages, facts.lost(), facts.duplicates),
        (100, 0, 0)
    );
    let union = host.measurement();
    // The first sample arrived before the socket of the receiver was known.
    assert_eq!((union.messages, union.lost, union.duplicates), (100, 0, 10));
}

#[test]
fn copies_of_an_outgoing_multicast_are_not_duplicates() {
    let mut host = Host::new();
    let bob = host.reader(BOB, 7411);
    let group = bob.multicast(101);
    host.owner(group, BOB);
    for number in 1..=10 {
        host.data(group.leaving(), number);
        host.data(group.leaving(), number);
        host.data(group, number);
    }
    let topic = host.topic();
    let sent: Vec<_> = topic
        .deliveries
        .iter()
        .map(|each| (each.direction, each.delivered))
        .collect();
    assert_eq!(sent[0].0, Direction::Sent);
    assert_eq!((sent[0].1.messages, sent[0].1.duplicates), (10, 0));
    assert_eq!((sent[1].1.messages, sent[1].1.duplicates), (10, 0));
    assert_eq!(
        (host.measurement().messages, host.measurement().duplicates),
        (10, 0)
    );
    host.data(group, 10);
    assert_eq!(host.measurement().duplicates, 1);
}

#[test]
fn a_full_table_counts_refusals_and_evicts_silent_deliveries() {
    let mut host = Host::with(Settings {
        deliveries: 3,
        ..Settings::default()
    });
    let bob = host.reader(BOB, 7411);
    let at = |port: u16| CapturePoint {
        address: SocketAddrV4::new([10, 0, 0, 9].into(), port),
        ..bob.wire()
    };
    for number in 1..=10 {
        (1..=5).for_each(|port| host.data(at(port), number));
    }
    assert_eq!(host.deliveries().len(), 3);
    let row = |host: &Host| {
        let tables = host.snapshot().tables;
        let row = tables
            .into_iter()
            .find(|row| row.table == "deliveries")
            .unwrap();
        (row.size, row.limit, row.evictions)
    };
    assert_eq!(row(&host), (3, 3, 20));
    for number in 11..=60 {
        (3..=5).for_each(|port| host.data(at(port), number));
        host.wait(400);
    }
    let ports: Vec<_> = host
        .deliveries()
        .iter()
        .map(|each| each.destination.port())
        .collect();
    assert_eq!(ports, [3, 4, 5]);
    assert!(
        host.deliveries()
            .iter()
            .all(|each| each.delivered.lost() == 0)
    );
    // The sums include the deliveries that were dropped.
    let sum: u64 = host
        .deliveries()
        .iter()
        .map(|each| each.delivered.messages)
        .sum();
    assert!(host.topic().received.unwrap().messages > sum);
}

#[test]
fn a_storm_of_forged_destinations_stays_bounded_and_real_receivers_are_counted() {
    let mut host = Host::new();
    let bob = host.reader(BOB, 7411).wire();
    for number in 1..=200 {
        host.data(bob, number);
        for forged in 0..100 {
            let address = u32::from_be_bytes([10, 1, 0, 0]) + (number as u32) * 100 + forged;
            let nowhere = CapturePoint {
                address: SocketAddrV4::new(address.into(), 7411),
                ..bob
            };
            host.data(nowhere, number);
        }
        host.wait(50);
    }
    let tables = host.snapshot().tables;
    let row = tables.iter().find(|row| row.table == "deliveries").unwrap();
    assert!(row.size <= 2000 && row.evictions > 10_000, "{row:?}");
    let deliveries = host.deliveries();
    let of_bob = deliveries
        .iter()
        .find(|each| each.participant.is_some())
        .unwrap();
    assert_eq!(
        (of_bob.delivered.messages, of_bob.delivered.lost()),
        (200, 0)
    );
    for _ in 0..70 {
        host.wait(1000);
    }
    assert_eq!(host.deliveries().len(), 1);
}
