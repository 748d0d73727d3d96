//! Deliveries under forged records and virtual time: what each receiver got, what it lost, and where
//! that died. Every class by construction, and all of them adding up.

use ros2probe_model::input::Input;
use ros2probe_testing::model::host::{BOB, CAROL, GROUP, Host, READER, Seen};
use std::net::{Ipv4Addr, SocketAddrV4};

use proptest::prelude::*;
use ros2probe_model::cause::LossCause;

use ros2probe_model::observer::Settings;
use ros2probe_model::snapshot::{Direction, SocketFacts};
use ros2probe_wire::record::{flag, guid_words, kind};
use ros2probe_wire::{Guid, GuidPrefix, Record};

#[test]
fn every_cause_is_counted_for_itself_and_all_add_up() {
    let mut host = Host::new();
    let bob = host.reader(BOB, 7411);
    for number in 1..=100 {
        match number {
            // Never left the network.
            10 | 20 | 30 => {}
            40 | 41 => host.no_room(bob, number),
            50 => host.gap(bob, 50),
            60 => {}
            61 => {
                host.data(bob, 61);
                host.wait(20);
                host.data(bob, 60);
            }
            _ => host.data(bob, number),
        }
        host.wait(1);
    }
    host.wait(12_000);
    let [delivery] = &host.deliveries()[..] else {
        panic!("one receiver")
    };
    let facts = delivery.delivered;
    assert_eq!(facts.lost_before_host, 3);
    assert_eq!(facts.lost_in_socket_buffer, 2);
    assert_eq!(
        (facts.irrelevant, facts.recovered, facts.pending),
        (1, 1, 0)
    );
    assert_eq!(facts.messages + facts.lost() + facts.irrelevant, 100);
    assert_eq!(host.losses(LossCause::BeforeHost), [10, 20, 30]);
    assert_eq!(host.losses(LossCause::SocketBuffer), [40, 41]);
    let breakdown = host.topic().breakdown.unwrap();
    assert_eq!(breakdown.retransmission.count(), 1);
    assert_eq!(host.topic().received.unwrap().lost(), 5);
}

#[test]
fn two_subscribers_of_one_multicast_with_different_losses_are_told_apart() {
    let mut host = Host::new();
    let (bob, carol) = (host.reader(BOB, 7411), host.reader(CAROL, 7413));
    let (bob, carol) = (bob.multicast(101), carol.multicast(102));
    host.owner(bob, BOB);
    host.owner(carol, CAROL);
    for number in 1..=50 {
        if number % 5 != 0 {
            host.data(bob, number);
        } else {
            host.no_room(bob, number);
        }
        if number % 7 != 0 {
            host.data(carol, number);
        }
        host.wait(10);
    }
    host.wait(12_000);
    let deliveries = host.deliveries();
    let lost: Vec<_> = deliveries
        .iter()
        .map(|each| (each.participant.unwrap().prefix, each.delivered.lost()))
        .collect();
    // The last one of Bob's had no room, which is known; Carol lost none at the end.
    assert_eq!(lost, [(BOB, 10), (CAROL, 7)]);
    assert_eq!(deliveries[0].sockets, [101]);
    assert_eq!(deliveries[0].destination.to_string(), GROUP);
    // Every sample reached this host, if only a full socket.
    assert_eq!(host.measurement().messages, 50);
    assert_eq!(host.measurement().duplicates, 0);
}

#[test]
fn fragments_without_room_within_a_joined_run_lose_the_sample_and_its_repair_brings_it_back() {
    let mut host = Host::new();
    let bob = host.reader(BOB, 7411);
    let run = |host: &mut Host, number| {
        host.wait(10);
        for fragment in [4, 5, 6] {
            let late = Record {
                flags: bob.flags | flag::NO_ROOM,
                ..host.fragments(bob, number, fragment, 1)
            };
            host.put(late);
            host.wait(1);
        }
        host.wait(3);
        let arrival = Record {
            elapsed: 9_000_000,
            ..host.fragments(bob, number, 1, 10)
        };
        host.put(arrival);
    };
    let whole = Record {
        elapsed: 2_000_000,
        ..host.fragments(bob, 1, 1, 10)
    };
    host.put(whole);
    run(&mut host, 2);
    assert_eq!(host.deliveries()[0].delivered.messages, 1);
    host.wait(100);
    // A retransmission is another arrival; part of it has no room either.
    let again = host.fragments(bob, 2, 4, 3);
    host.put(Record {
        flags: bob.flags | flag::NO_ROOM,
        ..host.fragments(bob, 2, 5, 1)
    });
    host.put(again);
    assert_eq!(host.deliveries()[0].delivered.messages, 1);
    host.wait(100);
    host.put(host.fragments(bob, 2, 5, 1));
    let facts = host.deliveries()[0].delivered;
    assert_eq!(
        (facts.messages, facts.recovered, facts.duplicates),
        (2, 1, 0)
    );
    run(&mut host, 3);
    host.wait(15_000);
    let facts = host.deliveries()[0].delivered;
    assert_eq!((facts.lost(), facts.lost_in_socket_buffer), (1, 1));
    assert_eq!(host.losses(LossCause::SocketBuffer), [3]);
    // The union counts what reached the host, and knows nothing of room.
    let union = host.measurement();
    assert_eq!((union.messages, union.lost, union.recovered), (3, 0, 0));
}

#[test]
fn a_retransmission_without_room_is_lost_like_the_original() {
    let mut host = Host::new();
    let bob = host.reader(BOB, 7411);
    host.data(bob, 1);
    host.data(bob, 3);
    host.wait(100);
    host.no_room(bob, 2);
    host.wait(12_000);
    assert_eq!(host.losses(LossCause::SocketBuffer), [2]);
    assert_eq!(host.deliveries()[0].delivered.lost(), 1);
}

#[test]
fn a_late_joiner_and_its_history_lose_nothing() {
    let mut host = Host::new();
    let bob = host.reader(BOB, 7411);
    (1..=500).for_each(|number| host.data(bob, number));
    let carol = host.reader(CAROL, 7413);
    host.data(carol, 501);
    // What it asked for as history, and a HEARTBEAT that says what there is.
    host.heartbeat(carol, 1, 501);
    (490..=500).for_each(|number| host.data(carol, number));
    (502..=510).for_each(|number| host.data(carol, number));
    host.wait(15_000);
    let late = &host.deliveries()[1];
    assert_eq!(late.participant.unwrap().prefix, CAROL);
    assert_eq!((late.delivered.lost(), late.delivered.irrelevant), (0, 0));
    assert_eq!((late.delivered.messages, late.delivered.history), (21, 11));
}

#[test]
fn a_reader_that_leaves_loses_nothing_and_comes_back_without_a_gap() {
    let mut host = Host::new();
    let (bob, carol) = (host.reader(BOB, 7411), host.reader(CAROL, 7413));
    for number in 1..=100 {
        host.data(bob, number);
        host.data(carol, number);
    }
    host.wait(50);
    // A last HEARTBEAT tells of a sample that Carol does not wait for any more.
    host.heartbeat(carol.directed(CAROL), 1, 101);
    host.unsubscribe(CAROL, 2);
    for number in 101..=2000 {
        host.data(bob, number);
        host.heartbeat(bob, 1, number);
        host.wait(1);
    }
    host.wait(12_000);
    assert!(
        host.deliveries()
            .iter()
            .all(|each| each.delivered.lost() == 0)
    );
    host.subscribe(CAROL, 3);
    host.wait(100);
    for number in 2001..=2100 {
        host.data(bob, number);
        host.data(carol, number);
    }
    host.wait(12_000);
    let deliveries = host.deliveries();
    assert_eq!(deliveries.len(), 2);
    assert!(
        deliveries.iter().all(|each| each.delivered.lost() == 0),
        "{deliveries:#?}"
    );
    assert_eq!(deliveries[1].delivered.messages, 200);
}

#[test]
fn a_heartbeat_tells_the_tail_to_the_reader_it_is_for_and_to_no_other() {
    let mut host = Host::new();
    let (bob, carol) = (host.reader(BOB, 7411), host.reader(CAROL, 7413));
    for number in 1..=10 {
        host.data(bob, number);
        host.data(carol, number);
    }
    host.heartbeat(bob.directed(BOB), 1, 13);
    // The same socket, but for somebody else.
    host.heartbeat(carol.multicast(7413).directed(BOB), 1, 13);
    host.wait(12_000);
    let lost: Vec<_> = host
        .deliveries()
        .iter()
        .map(|each| each.delivered.lost())
        .collect();
    assert_eq!(lost, [3, 0]);
    assert_eq!(host.losses(LossCause::BeforeHost), [11, 12, 13]);
}

#[test]
fn a_multicast_original_and_its_unicast_repair_are_one_delivery() {
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
fn ways_are_put_together_when_their_socket_is_known_late() {
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
fn what_is_pending_when_ways_are_put_together_stays_pending_once() {
    let mut host = Host::new();
    let bob = host.reader(BOB, 7411);
    let group = bob.multicast(101);
    let large = |host: &mut Host, seen: Seen, number| {
        let record = host.record(seen, kind::DATA, number);
        host.put(Record {
            datagram_len: 60_000,
            ..record
        });
    };
    // By unicast what the multicast brings after all, and the other way round.
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
fn a_wire_tells_receivers_apart_by_destination_and_invents_no_losses_for_repairs() {
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
    assert_eq!(delivery.subscriber, "");
    assert_eq!(
        (delivery.delivered.recovered, delivery.delivered.lost()),
        (5, 4)
    );
    // Unicast only: two addresses are two receivers.
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
fn a_mirrored_wire_adds_what_sockets_do_not_see_and_nothing_else() {
    let mut host = Host::new();
    let bob = host.reader(BOB, 7411);
    let group = bob.multicast(101);
    let elsewhere = host.reader(CAROL, 7413).wire();
    host.owner(group, BOB);
    for number in 1..=100 {
        // The mirror is first, and shows what Bob and Carol get.
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
    // The very first came before it was known that a socket receives it.
    assert_eq!((union.messages, union.lost, union.duplicates), (100, 0, 10));
}

#[test]
fn a_loss_whose_fragments_the_kernel_gives_up_later_is_told_with_its_final_cause() {
    let mut host = Host::new();
    let bob = host.reader(BOB, 7411);
    for number in 1..=20 {
        if ![7, 8, 14].contains(&number) {
            host.put(Record {
                datagram_len: 60_000,
                ..host.record(bob, kind::DATA, number)
            });
        }
        host.wait(100);
    }
    host.wait(12_000);
    let facts = host.deliveries()[0].delivered;
    assert_eq!((facts.lost(), facts.pending), (3, 3));
    assert!(host.observer.journal().delivery_losses().next().is_none());
    host.wait(16_000);
    host.put(Record {
        flags: flag::NOT_REASSEMBLED,
        socket: 0,
        ..host.record(bob, kind::DATA, 8)
    });
    let facts = host.deliveries()[0].delivered;
    assert_eq!(
        (facts.lost(), facts.pending, facts.lost_in_reassembly),
        (3, 2, 1)
    );
    host.wait(30_000);
    let facts = host.deliveries()[0].delivered;
    assert_eq!((facts.pending, facts.lost_before_host), (0, 2));
    assert_eq!(host.losses(LossCause::Reassembly), [8]);
    assert_eq!(host.losses(LossCause::BeforeHost), [7, 14]);
    let topic = host.topic().received.unwrap();
    assert_eq!(
        (topic.lost(), topic.pending, topic.lost_in_reassembly),
        (3, 0, 1)
    );
}

#[test]
fn a_reassembly_that_is_given_up_after_the_repair_came_is_no_loss() {
    let mut host = Host::new();
    let bob = host.reader(BOB, 7411);
    host.data(bob, 1);
    host.data(bob, 3);
    host.wait(200);
    host.data(bob, 2);
    host.wait(30_000);
    host.put(Record {
        flags: flag::NOT_REASSEMBLED,
        socket: 0,
        ..host.record(bob, kind::DATA, 2)
    });
    host.wait(40_000);
    let facts = host.deliveries()[0].delivered;
    assert_eq!((facts.lost(), facts.recovered, facts.messages), (0, 1, 3));
}

#[test]
fn what_arrives_where_nobody_reads_is_unmatched_and_takes_no_room() {
    let mut host = Host::new();
    let (bob, carol) = (host.reader(BOB, 7411), host.bystander(CAROL, 7413));
    let (bob, carol) = (bob.multicast(101), carol.multicast(102));
    host.owner(bob, BOB);
    host.owner(carol, CAROL);
    for number in 1..=10 {
        host.data(bob, number);
        host.data(carol, number);
        host.heartbeat(carol, 1, number + 5);
    }
    host.wait(12_000);
    assert_eq!(host.deliveries().len(), 1);
    let facts = host.topic().received.unwrap();
    assert_eq!((facts.messages, facts.unmatched, facts.lost()), (10, 10, 0));
    let snapshot = host.snapshot();
    let tables = snapshot.tables.iter().map(|row| (row.table, row.size));
    assert!(tables.into_iter().any(|row| row == ("deliveries", 1)));
    host.unsubscribe(BOB, 2);
    (11..=13).for_each(|number| host.data(bob, number));
    let facts = host.deliveries()[0].delivered;
    assert_eq!((facts.messages, facts.unmatched), (10, 3));
    assert_eq!(host.topic().received.unwrap().unmatched, 13);
}

#[test]
fn what_left_this_host_and_never_arrived_is_lost_unless_its_socket_is_closed() {
    for is_closed in [false, true] {
        let mut host = Host::new();
        let bob = host.reader(BOB, 7411);
        for number in 1..=20 {
            host.data(bob.leaving(), number);
            host.wait(1);
            if number < 18 {
                host.data(bob, number);
            }
            host.wait(100);
        }
        if is_closed {
            host.observer.input(Input::SocketClosed(bob.socket));
        }
        for _ in 0..40 {
            host.wait(1000);
        }
        let lost = host.losses(LossCause::BeforeHost);
        let expected: &[u64] = if is_closed { &[] } else { &[18, 19, 20] };
        assert_eq!(lost, expected, "closed: {is_closed}");
        let topic = host.topic();
        assert_eq!(topic.sent.unwrap().messages, 20);
        let breakdown = topic.breakdown.unwrap();
        assert_eq!(
            (breakdown.send_delay.count(), breakdown.transit.count()),
            (20, 17)
        );
        assert_eq!(breakdown.transit.range(), Some((0.001, 0.001)));
    }
}

#[test]
fn what_left_for_a_receiver_that_still_talks_is_lost_soon() {
    let mut host = Host::new();
    let bob = host.reader(BOB, 7411);
    for number in 1..=20 {
        host.data(bob.leaving(), number);
        host.wait(1);
        if number < 18 {
            host.data(bob, number);
        }
        host.wait(100);
    }
    host.wait(3000);
    // Bob announces himself again.
    host.participant(BOB, bob.address);
    for _ in 0..12 {
        host.wait(1000);
    }
    assert_eq!(host.losses(LossCause::BeforeHost), [18, 19, 20]);
}

#[test]
fn a_killed_subscriber_does_not_lose_for_ever() {
    let mut host = Host::new();
    let bob = host.reader(BOB, 7411);
    for number in 1..=1000 {
        host.data(bob.leaving(), number);
        if number <= 100 {
            host.data(bob, number);
        }
        host.wait(100);
    }
    // What left in the first moments of its silence is taken for lost, no more.
    let lost = host.deliveries()[0].delivered.lost();
    assert!((30..=60).contains(&lost), "{lost}");
}

#[test]
fn copies_of_a_multicast_on_its_way_out_are_no_duplicates() {
    let mut host = Host::new();
    let bob = host.reader(BOB, 7411);
    let group = bob.multicast(101);
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
fn an_acknowledgement_tells_what_a_reader_waits_for() {
    let mut host = Host::new();
    let bob = host.reader(BOB, 7411);
    host.acknack(bob, 1);
    for number in 1..=20 {
        host.data(bob, number);
        host.wait(100);
    }
    host.request(bob, 11, 2, 0b11 << 30);
    let topic = host.topic();
    let [facts] = &topic.acknowledgements[..] else {
        panic!("one reader")
    };
    assert_eq!(
        (facts.acknowledged, facts.missing, facts.lag_samples),
        (10, 2, 10)
    );
    assert!(
        facts
            .lag_seconds
            .is_some_and(|lag| (lag - 1.0).abs() < 0.001)
    );
    host.unsubscribe(BOB, 2);
    host.wait(100);
    assert!(host.topic().acknowledgements.is_empty());
}

#[test]
fn a_full_table_refuses_counts_and_makes_room_when_somebody_is_silent() {
    let mut host = Host::with(Settings {
        deliveries: 3,
        ..Settings::default()
    });
    let bob = host.reader(BOB, 7411);
    let at = |socket: u64| Seen {
        socket,
        ..bob.multicast(socket)
    };
    for number in 1..=10 {
        (1..=5).for_each(|socket| host.data(at(socket), number));
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
        (3..=5).for_each(|socket| host.data(at(socket), number));
        host.wait(400);
    }
    let sockets: Vec<_> = host
        .deliveries()
        .iter()
        .map(|each| each.sockets.clone())
        .collect();
    assert_eq!(sockets, [[3], [4], [5]]);
    assert!(
        host.deliveries()
            .iter()
            .all(|each| each.delivered.lost() == 0)
    );
    // The sums keep what was counted of those that went.
    let sum: u64 = host
        .deliveries()
        .iter()
        .map(|each| each.delivered.messages)
        .sum();
    assert!(host.topic().received.unwrap().messages > sum);
}

#[test]
fn an_address_that_two_announce_in_turn_is_nobodys() {
    let mut host = Host::new();
    let bob = host.reader(BOB, 7411).wire();
    host.reader(CAROL, 7411);
    host.data(bob, 1);
    let owner = |host: &Host| host.deliveries()[0].participant.map(|guid| guid.prefix);
    assert_eq!(owner(&host), Some(CAROL));
    // Bob lives: containers have the same addresses.
    host.participant(BOB, bob.address);
    host.participant(CAROL, bob.address);
    host.data(bob, 2);
    host.wait(100);
    let deliveries = host.deliveries();
    assert!(
        deliveries.iter().any(|each| each.participant.is_none()),
        "{deliveries:#?}"
    );
    assert!(deliveries.iter().all(|each| each.delivered.lost() == 0));
}

#[test]
fn a_storm_of_forged_destinations_stays_bounded_and_real_receivers_are_counted() {
    let mut host = Host::new();
    let bob = host.reader(BOB, 7411).wire();
    for number in 1..=200 {
        host.data(bob, number);
        for forged in 0..100 {
            let address = u32::from_be_bytes([10, 1, 0, 0]) + (number as u32) * 100 + forged;
            let nowhere = Seen {
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

#[test]
fn who_is_silent_and_unknown_is_forgotten() {
    let mut host = Host::new();
    let bob = host.reader(BOB, 7411);
    let nobody = Seen {
        socket: 55,
        ..bob.multicast(55)
    };
    host.data(bob, 1);
    host.data(nobody, 2);
    assert_eq!(host.deliveries().len(), 2);
    for _ in 0..62 {
        host.wait(1000);
    }
    assert_eq!(host.deliveries().len(), 1);
    assert_eq!(host.deliveries()[0].participant.unwrap().prefix, BOB);
}

#[test]
fn what_a_participant_sends_to_an_address_of_its_own_by_mistake_tells_nothing_of_its_socket() {
    // RustDDS announces 127.0.0.1 to other hosts too: an ACKNACK for Alice comes back to Bob.
    let mut host = Host::new();
    let bob = host.reader(BOB, 7411);
    let stray = Record {
        reader: guid_words(Guid::new(BOB, READER)),
        ..host.record(bob, kind::ACKNACK, 1)
    };
    host.put(stray);
    host.owner(bob, BOB);
    let group = bob.multicast(101);
    host.owner(group, BOB);
    for number in 1..=10 {
        host.data(group, number);
        host.wait(10);
    }
    // Samples for a reader on another host come there as well.
    host.participant(CAROL, "127.0.0.1:7411".parse().unwrap());
    host.subscribe(CAROL, 1);
    (5..=8).for_each(|number| host.data(bob.directed(CAROL), number));
    let deliveries = host.deliveries();
    assert_eq!(deliveries.len(), 1);
    assert_eq!(deliveries[0].participant.unwrap().prefix, BOB);
    assert_eq!(deliveries[0].readers, [Guid::new(BOB, READER)]);
    assert_eq!(deliveries[0].delivered.duplicates, 0);
}

#[test]
fn a_socket_is_shown_with_its_process_and_what_died_there_without_a_name() {
    let mut host = Host::new();
    let bob = host.reader(BOB, 7411);
    host.data(bob, 1);
    host.observer.input(Input::Socket(SocketFacts {
        cookie: bob.socket,
        process_id: Some(42),
        own_process_id: Some(42),
        process: Some("planner".to_owned()),
        cgroup: Some("/robot".to_owned()),
        unidentified_drops: 3,
    }));
    let delivery = &host.deliveries()[0];
    assert_eq!(delivery.process_id, Some(42));
    assert_eq!(delivery.cgroup.as_deref(), Some("/robot"));
    let sockets = host.snapshot().sockets;
    assert_eq!(sockets.len(), 1);
    assert_eq!(sockets[0].unidentified_drops, 3);
}

#[test]
fn a_container_is_recognised_by_the_number_that_its_process_has_inside() {
    let mut host = Host::new();
    let fast_dds = |process: u8| GuidPrefix([1, 0x0f, 1, 2, process, 0, 3, 3, 3, 3, 3, 3]);
    for (process, port) in [(7, 7411), (9, 7413)] {
        host.reader(fast_dds(process), port);
    }
    let group = SocketAddrV4::new(Ipv4Addr::new(239, 255, 0, 1), 7401);
    for (process, socket) in [(9_u8, 1001), (7, 1002)] {
        host.observer.input(Input::Socket(SocketFacts {
            cookie: socket,
            process_id: Some(40_000 + u32::from(process)),
            own_process_id: Some(process.into()),
            ..SocketFacts::default()
        }));
        let seen = Seen {
            socket,
            address: group,
            directed: None,
            flags: flag::HOST,
        };
        host.data(seen, 1);
    }
    let mut found: Vec<_> = host
        .deliveries()
        .iter()
        .map(|each| (each.participant.unwrap().prefix, each.process_id))
        .collect();
    found.sort();
    assert_eq!(
        found,
        [(fast_dds(7), Some(40_007)), (fast_dds(9), Some(40_009))]
    );
}

#[test]
fn a_best_effort_reader_of_a_reliable_writer_is_sent_nothing_again() {
    let mut host = Host::new();
    let bob = host.reader(BOB, 7411);
    host.subscribe_with(BOB, 2, false);
    host.wait(10);
    for number in 1..=100 {
        if number % 10 != 0 {
            host.data(bob, number);
        }
        // All others have acknowledged all: the writer has nothing before this any more.
        host.heartbeat(bob, number, number);
        host.wait(10);
    }
    host.wait(2000);
    let facts = host.deliveries()[0].delivered;
    assert_eq!(
        (facts.lost(), facts.irrelevant, facts.recovered),
        (10, 0, 0)
    );
}

#[test]
fn heartbeats_alone_lose_nothing_until_the_reader_asks() {
    let mut host = Host::new();
    let bob = host.reader(BOB, 7411);
    // All samples go by shared memory.
    for number in 1..=100 {
        host.heartbeat(bob.directed(BOB), 1, number);
        host.wait(100);
    }
    host.wait(12_000);
    assert_eq!(host.deliveries()[0].delivered.lost(), 0);
    // All samples are larger than what gets through, and the reader asks for them.
    for number in 101..=120 {
        host.heartbeat(bob.directed(BOB), 1, number);
        host.request(bob, 101, 1, 1 << 31);
        host.wait(100);
    }
    host.wait(12_000);
    // What it acknowledged before came by shared memory.
    let facts = host.deliveries()[0].delivered;
    assert_eq!((facts.lost(), facts.irrelevant), (20, 99));
}

#[test]
fn what_a_writer_of_few_samples_overwrote_before_it_came_is_lost() {
    let mut host = Host::new();
    let bob = host.reader(BOB, 7411);
    for number in 1..=100 {
        // KEEP_LAST (1): of 50 and 51 only the HEARTBEAT with 51 came.
        match number {
            10 | 20 | 21 | 50 => {}
            51 => host.heartbeat(bob.directed(BOB), 51, 51),
            _ => {
                host.data(bob, number);
                host.heartbeat(bob.directed(BOB), number, number);
            }
        }
        host.wait(10);
    }
    host.wait(12_000);
    let facts = host.deliveries()[0].delivered;
    assert_eq!((facts.messages, facts.lost(), facts.irrelevant), (95, 5, 0));
    assert_eq!(host.losses(LossCause::BeforeHost), [10, 20, 21, 50, 51]);
    assert_eq!(host.measurement().lost, 5);
}

#[test]
fn what_its_reader_acknowledged_is_not_lost_although_it_was_not_seen() {
    let mut host = Host::new();
    let bob = host.reader(BOB, 7411);
    for number in 1..=101 {
        if number % 10 != 0 {
            host.data(bob, number);
        }
        host.acknack(bob, number + 1);
        host.heartbeat(bob.directed(BOB), number, number);
        host.wait(10);
    }
    host.wait(12_000);
    let facts = host.deliveries()[0].delivered;
    assert_eq!(
        (facts.messages, facts.lost(), facts.irrelevant),
        (91, 0, 10)
    );
    assert_eq!(
        (host.measurement().lost, host.measurement().irrelevant),
        (0, 10)
    );
}

#[test]
fn what_was_written_while_a_reader_was_away_is_not_lost_when_a_heartbeat_begins_later() {
    let mut host = Host::new();
    let bob = host.reader(BOB, 7411);
    (1..=100).for_each(|number| host.data(bob, number));
    host.wait(50);
    host.unsubscribe(BOB, 2);
    host.wait(1000);
    host.subscribe(BOB, 3);
    host.wait(10);
    host.heartbeat(bob.directed(BOB), 391, 400);
    (401..=410).for_each(|number| host.data(bob, number));
    host.wait(12_000);
    let facts = host.deliveries()[0].delivered;
    assert_eq!((facts.messages, facts.lost()), (110, 0));
    assert_eq!(host.measurement().lost, 0);
}

/// What becomes of one sample.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Fate {
    Arrives,
    ArrivesTwice,
    BeforeHost,
    NoRoom,
    Reassembly,
    /// Retransmitted after it was lost, or had no room.
    Repaired,
    RepairedAfterNoRoom,
    /// Retransmitted into a full buffer.
    RepairHadNoRoom,
    Excused,
}

fn fate() -> impl Strategy<Value = Fate> {
    prop_oneof![
        12 => Just(Fate::Arrives),
        1 => Just(Fate::ArrivesTwice),
        2 => Just(Fate::BeforeHost),
        2 => Just(Fate::NoRoom),
        1 => Just(Fate::Reassembly),
        2 => Just(Fate::Repaired),
        1 => Just(Fate::RepairedAfterNoRoom),
        1 => Just(Fate::RepairHadNoRoom),
        1 => Just(Fate::Excused),
    ]
}

/// One sample as a whole, or in fragments of which the middle ones meet that fate.
fn arrival(host: &Host, bob: Seen, number: u64, fragmented: bool, part: bool) -> Record {
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
    fn what_was_sent_is_delivered_lost_for_one_cause_or_irrelevant(
        fates in prop::collection::vec((fate(), any::<bool>(), 1u64..30), 1..300),
    ) {
        let mut host = Host::new();
        let bob = host.reader(BOB, 7411);
        let no_room = |record: Record| Record { flags: record.flags | flag::NO_ROOM, ..record };
        host.put(arrival(&host, bob, 1, false, false));
        // The kernel has been told of the writer by then: from here on no fragment is left out.
        host.wait(300);
        let mut given_up = Vec::new();
        let mut repairs = Vec::new();
        for (number, (fate, fragmented, pause)) in (2..).zip(&fates) {
            host.wait(*pause);
            let whole = arrival(&host, bob, number, *fragmented, false);
            let part = arrival(&host, bob, number, *fragmented, true);
            match fate {
                Fate::Arrives => host.put(whole),
                Fate::ArrivesTwice => {
                    host.put(whole);
                    host.put(whole);
                }
                Fate::BeforeHost => {}
                Fate::NoRoom | Fate::RepairedAfterNoRoom => {
                    host.put(no_room(part));
                    host.put(whole);
                }
                Fate::Reassembly => given_up.push(number),
                Fate::Repaired | Fate::RepairHadNoRoom => {}
                Fate::Excused => host.gap(bob, number),
            }
            if matches!(fate, Fate::Repaired | Fate::RepairedAfterNoRoom | Fate::RepairHadNoRoom) {
                repairs.push((number, *fate, *fragmented));
            }
            // Repairs come some samples later.
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
        // What is not known yet is pending, and nothing is open any more.
        let facts = host.deliveries()[0].delivered;
        prop_assert_eq!(facts.messages - facts.history + facts.lost() + facts.irrelevant, sent);
        let unknown = fates.iter().filter(|(fate, ..)| matches!(fate, Fate::BeforeHost | Fate::Reassembly));
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
        let with = |wanted: &[Fate]| -> Vec<u64> {
            let fates = (2..).zip(&fates);
            fates.filter(|(_, (fate, ..))| wanted.contains(fate)).map(|(number, _)| number).collect()
        };
        prop_assert_eq!(host.losses(LossCause::BeforeHost), with(&[Fate::BeforeHost]));
        prop_assert_eq!(host.losses(LossCause::Reassembly), with(&[Fate::Reassembly]));
        let full = with(&[Fate::NoRoom, Fate::RepairHadNoRoom]);
        prop_assert_eq!(host.losses(LossCause::SocketBuffer), full);
        let facts = host.deliveries()[0].delivered;
        let repaired = with(&[Fate::Repaired, Fate::RepairedAfterNoRoom]).len();
        prop_assert_eq!(facts.recovered, repaired as u64);
        prop_assert_eq!(facts.irrelevant, with(&[Fate::Excused]).len() as u64);
        prop_assert_eq!(facts.duplicates, with(&[Fate::ArrivesTwice]).len() as u64);
        prop_assert_eq!(facts.messages + facts.lost() + facts.irrelevant, sent);
        prop_assert_eq!(host.topic().received.map(|sum| *sum), Some(facts));
    }
}

fn repair(host: &mut Host, bob: Seen, number: u64, fate: Fate, fragmented: bool) {
    host.wait(10);
    let only_part = fate == Fate::RepairedAfterNoRoom;
    let again = arrival(host, bob, number, fragmented, only_part);
    if fate == Fate::RepairHadNoRoom {
        host.put(Record {
            flags: again.flags | flag::NO_ROOM,
            ..arrival(host, bob, number, fragmented, true)
        });
    }
    host.put(again);
}
