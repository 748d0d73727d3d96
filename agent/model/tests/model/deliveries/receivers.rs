//! Receivers of datagrams: sockets, addresses, processes, readers that appear and vanish.

use std::net::{Ipv4Addr, SocketAddrV4};

use ros2probe_model::observe::input::Input;
use ros2probe_model::report::snapshot::SocketFacts;
use ros2probe_testing::model::host::{BOB, CAROL, CapturePoint, GROUP, Host, READER};
use ros2probe_wire::record::{flag, guid_words, kind};
use ros2probe_wire::{Guid, GuidPrefix, Record};

#[test]
fn two_subscribers_of_one_multicast_have_separate_losses() {
    let mut host = Host::new();
    let (bob, carol) = (host.reader(BOB, 7411), host.reader(CAROL, 7413));
    let (bob, carol) = (bob.multicast(101), carol.multicast(102));
    host.owner(bob, BOB);
    host.owner(carol, CAROL);
    for number in 1..=50 {
        if number % 5 != 0 {
            host.data(bob, number);
        } else {
            host.socket_full(bob, number);
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
    // Bob's last sample was dropped with a known cause; Carol lost none at the end.
    assert_eq!(lost, [(BOB, 10), (CAROL, 7)]);
    assert_eq!(deliveries[0].sockets, [101]);
    assert_eq!(deliveries[0].destination.to_string(), GROUP);
    // Every sample reached this host, even if a buffer was full.
    assert_eq!(host.measurement().messages, 50);
    assert_eq!(host.measurement().duplicates, 0);
}

#[test]
fn a_late_joiner_with_requested_history_has_no_losses() {
    let mut host = Host::new();
    let bob = host.reader(BOB, 7411);
    (1..=500).for_each(|number| host.data(bob, number));
    let carol = host.reader(CAROL, 7413);
    host.data(carol, 501);
    // The reader gets the history that it requested, and a HEARTBEAT.
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
fn a_reader_that_leaves_and_returns_has_no_losses() {
    let mut host = Host::new();
    let (bob, carol) = (host.reader(BOB, 7411), host.reader(CAROL, 7413));
    for number in 1..=100 {
        host.data(bob, number);
        host.data(carol, number);
    }
    host.wait(50);
    // A last HEARTBEAT announces a sample that Carol no longer waits for.
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
fn samples_that_arrive_without_a_reader_are_unmatched_and_add_no_delivery() {
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
fn a_killed_subscriber_soon_has_no_further_losses() {
    let mut host = Host::new();
    let bob = host.reader(BOB, 7411);
    for number in 1..=1000 {
        host.data(bob.leaving(), number);
        if number <= 100 {
            host.data(bob, number);
        }
        host.wait(100);
    }
    // Only samples from the first moments of its silence count as lost.
    let lost = host.deliveries()[0].delivered.lost();
    assert!((30..=60).contains(&lost), "{lost}");
}

#[test]
fn an_address_that_two_participants_announce_identifies_neither() {
    let mut host = Host::new();
    let bob = host.reader(BOB, 7411).wire();
    host.reader(CAROL, 7411);
    host.data(bob, 1);
    let owner = |host: &Host| host.deliveries()[0].participant.map(|guid| guid.prefix);
    assert_eq!(owner(&host), Some(CAROL));
    // Bob is alive: containers may have the same addresses.
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
fn a_silent_unknown_receiver_is_removed() {
    let mut host = Host::new();
    let bob = host.reader(BOB, 7411);
    let nobody = CapturePoint {
        socket: 55,
        ..bob.multicast(55)
    };
    host.data(bob, 1);
    host.data(nobody, 2);
    let followed = |host: &Host| {
        let tables = host.snapshot().tables;
        let row = tables.iter().find(|row| row.table == "deliveries");
        row.unwrap().size
    };
    assert_eq!((followed(&host), host.deliveries().len()), (2, 1));
    for _ in 0..62 {
        host.wait(1000);
    }
    assert_eq!((followed(&host), host.deliveries().len()), (1, 1));
    assert_eq!(host.topic().received.unwrap().unmatched, 1);
    assert_eq!(host.deliveries()[0].participant.unwrap().prefix, BOB);
}

#[test]
fn a_packet_to_the_senders_own_address_does_not_identify_its_socket() {
    // RustDDS announces 127.0.0.1 to other hosts too, so an ACKNACK for Alice returns to Bob.
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
    // Samples for a reader on another host use the same address.
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
fn a_socket_is_shown_with_its_process_and_its_unidentified_drops() {
    let mut host = Host::new();
    let bob = host.reader(BOB, 7411);
    host.data(bob, 1);
    host.observer.input(Input::Socket(SocketFacts {
        cookie: bob.socket,
        process_id: Some(42),
        own_process_id: Some(42),
        process: Some("planner".into()),
        cgroup: Some("/robot".into()),
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
fn a_container_is_recognized_by_the_process_id_in_its_namespace() {
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
        let seen = CapturePoint {
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
