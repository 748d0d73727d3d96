//! Only a reader that matches the writer makes a process a subscriber.

use ros2probe_model::observe::input::Input;
use ros2probe_model::report::snapshot::{Direction, SocketFacts};
use ros2probe_testing::model::host::{BOB, CAROL, CapturePoint, GROUP, Host};
use ros2probe_wire::record::{flag, kind};
use ros2probe_wire::{GuidPrefix, Record};

const DAVE: GuidPrefix = GuidPrefix(*b"\x01\x10davey-host");

/// Adds a participant whose announcements of readers were missed, as by a late agent.
fn unknown_participant(host: &mut Host, prefix: GuidPrefix, port: u16) -> CapturePoint {
    let address = format!("10.0.0.2:{port}").parse().unwrap();
    host.participant(prefix, address);
    CapturePoint {
        socket: port.into(),
        address,
        directed: None,
        flags: flag::HOST,
    }
}

/// Sends a sample that some sockets receive and others lose in reassembly.
fn send(host: &mut Host, number: u64, sockets: &[CapturePoint]) {
    for (place, socket) in (0..).zip(sockets) {
        if (number + place).is_multiple_of(5) {
            continue;
        }
        let record = host.record(*socket, kind::DATA, number);
        host.put(Record {
            datagram_len: 60_000,
            ..record
        });
    }
    if number.is_multiple_of(5) {
        host.put(Record {
            flags: flag::NOT_REASSEMBLED,
            socket: 0,
            ..host.record(sockets[0], kind::DATA, number)
        });
    }
    host.wait(100);
}

fn rest(host: &mut Host) {
    (0..50).for_each(|_| host.wait(1000));
}

#[test]
fn processes_without_a_reader_in_a_multicast_group_have_no_losses() {
    let mut host = Host::new();
    let bob = host.reader(BOB, 7411).multicast(100);
    host.owner(bob, BOB);
    let mut sockets = vec![bob];
    for other in 1..=11 {
        // Half of the participants are known by a socket that sends; the others never sent.
        let prefix = GuidPrefix([1, 0x10, 100 + other, 4, 5, 6, 7, 8, 9, 10, 11, 12]);
        let socket =
            unknown_participant(&mut host, prefix, 7500 + u16::from(other)).multicast(other.into());
        if other % 2 == 0 {
            host.owner(socket, prefix);
        }
        sockets.push(socket);
    }
    (1..=200).for_each(|number| send(&mut host, number, &sockets));
    rest(&mut host);
    let deliveries = host.deliveries();
    assert_eq!(deliveries.len(), 1, "{deliveries:#?}");
    assert_eq!(deliveries[0].participant.unwrap().prefix, BOB);
    let sum = host.topic().received.unwrap();
    let facts = deliveries[0].delivered;
    assert_eq!((facts.messages, facts.lost()), (160, 40));
    assert_eq!((sum.messages, sum.lost()), (facts.messages, facts.lost()));
    assert_eq!(sum.unmatched, 5 * 160);
    let journal = host.observer.journal().delivery_losses();
    let mut losers = journal.map(|loss| loss.participant);
    assert!(losers.all(|loser| loser == Some(BOB)));
}

#[test]
fn counts_of_a_socket_appear_once_its_participant_is_known_as_a_reader() {
    for is_reader in [true, false] {
        let mut host = Host::new();
        let bob = host.reader(BOB, 7411);
        let carol = match is_reader {
            true => host.reader(CAROL, 7413),
            false => unknown_participant(&mut host, CAROL, 7413),
        };
        let (bob, carol) = (bob.multicast(101), carol.multicast(102));
        host.owner(bob, BOB);
        (1..=50).for_each(|number| send(&mut host, number, &[bob, carol]));
        assert_eq!(host.deliveries().len(), 1);
        host.owner(carol, CAROL);
        (51..=100).for_each(|number| send(&mut host, number, &[bob, carol]));
        rest(&mut host);
        let deliveries = host.deliveries();
        let sum = host.topic().received.unwrap();
        if is_reader {
            let counts = deliveries.iter().map(|each| each.delivered);
            let counts: Vec<_> = counts.map(|each| (each.messages, each.lost())).collect();
            assert_eq!(counts, [(80, 20), (80, 20)]);
            assert_eq!((sum.messages, sum.lost(), sum.unmatched), (160, 40, 0));
            let journal = host.observer.journal().delivery_losses();
            let lost: u64 = journal.map(|loss| loss.last - loss.first + 1).sum();
            assert_eq!(lost, 40);
        } else {
            assert_eq!(deliveries.len(), 1);
            assert_eq!((sum.messages, sum.lost(), sum.unmatched), (80, 20, 80));
        }
    }
}

#[test]
fn a_history_counts_that_leaves_before_its_writer_is_announced() {
    let mut host = Host::unannounced();
    let group = CapturePoint {
        socket: 9,
        address: GROUP.parse().unwrap(),
        directed: None,
        flags: flag::HOST,
    };
    for number in 1..=20 {
        host.data(group.leaving(), number);
        host.wait(50);
    }
    let bob = host.reader(BOB, 7411);
    host.owner(bob, BOB);
    for number in 1..=20 {
        if number == 12 {
            host.writer(true);
        }
        host.data(bob.leaving(), number);
        host.data(bob, number);
    }
    (21..=40).for_each(|number| {
        host.wait(50);
        host.data(bob.leaving(), number);
        host.data(bob, number);
    });
    rest(&mut host);
    let deliveries = host.topic().deliveries.into_iter();
    let counts: Vec<_> = deliveries
        .map(|each| {
            (
                each.direction,
                each.delivered.messages,
                each.delivered.lost(),
            )
        })
        .collect();
    assert_eq!(
        counts,
        [(Direction::Sent, 40, 0), (Direction::Received, 40, 0)]
    );
    assert_eq!(host.measurement().messages, 40);
}

#[test]
fn samples_from_before_a_late_reader_are_neither_delivered_nor_lost() {
    let mut host = Host::new();
    let bob = host.reader(BOB, 7411).multicast(101);
    host.owner(bob, BOB);
    let carol = unknown_participant(&mut host, CAROL, 7413).multicast(102);
    let dave = unknown_participant(&mut host, DAVE, 7415).multicast(103);
    host.owner(carol, CAROL);
    (1..=50).for_each(|number| send(&mut host, number, &[bob, carol, dave]));
    // Carol and Dave announce a reader; Dave's socket is found later.
    host.subscribe(CAROL, 7);
    host.subscribe(DAVE, 7);
    host.wait(100);
    (51..=70).for_each(|number| send(&mut host, number, &[bob, carol, dave]));
    host.owner(dave, DAVE);
    (71..=100).for_each(|number| send(&mut host, number, &[bob, carol, dave]));
    rest(&mut host);
    let deliveries = host.deliveries();
    let counts = deliveries.iter().map(|each| {
        let facts = each.delivered;
        (
            each.participant.unwrap().prefix,
            facts.messages,
            facts.lost(),
        )
    });
    let counts: Vec<_> = counts.collect();
    // While Dave's socket is unknown, it may be another socket of Carol. Therefore four samples
    // that it received do not count as lost by Carol.
    assert_eq!(counts, [(BOB, 80, 20), (CAROL, 40, 6), (DAVE, 24, 6)]);
}

#[test]
fn a_socket_of_an_unknown_participant_receives_no_sample_of_a_known_one() {
    let mut host = Host::new();
    let bob = host.reader(BOB, 7411).multicast(101);
    host.owner(bob, BOB);
    // This order occurs with the loopback of the writer's own multicast.
    let carol = unknown_participant(&mut host, CAROL, 7413).multicast(102);
    (1..=50).for_each(|number| {
        host.data(carol, number);
        host.data(bob, number);
        host.wait(100);
    });
    host.owner(carol, CAROL);
    rest(&mut host);
    let deliveries = host.deliveries();
    assert_eq!(deliveries.len(), 1, "{deliveries:#?}");
    let facts = deliveries[0].delivered;
    assert_eq!((facts.messages, facts.lost()), (50, 0));
    let sum = host.topic().received.unwrap();
    assert_eq!((sum.messages, sum.unmatched), (50, 50));
}

#[test]
fn a_process_is_no_longer_a_subscriber_after_its_last_reader_left() {
    let mut host = Host::new();
    let bob = host.reader(BOB, 7411).multicast(101);
    host.owner(bob, BOB);
    let carol = unknown_participant(&mut host, CAROL, 7413).multicast(102);
    host.owner(carol, CAROL);
    // The agent knows only this announcement, and none before it.
    host.subscribe(CAROL, 9);
    (1..=50).for_each(|number| send(&mut host, number, &[bob, carol]));
    host.unsubscribe(CAROL, 10);
    (51..=100).for_each(|number| send(&mut host, number, &[bob, carol]));
    rest(&mut host);
    let sum = host.topic().received.unwrap();
    assert_eq!((sum.messages, sum.lost()), (80 + 40, 20 + 10));
    assert_eq!(sum.unmatched, 40);
}

#[test]
fn a_process_whose_only_reader_is_incompatible_is_not_a_subscriber() {
    let mut host = Host::new();
    host.writer(false);
    host.participant(BOB, "10.0.0.2:7411".parse().unwrap());
    host.subscribe_with(BOB, 1, false);
    let bob = CapturePoint {
        socket: 101,
        address: "239.255.0.1:7401".parse().unwrap(),
        directed: None,
        flags: flag::HOST,
    };
    host.owner(bob, BOB);
    // A reliable reader does not match a best-effort writer.
    let carol = host.reader(CAROL, 7413).multicast(102);
    host.owner(carol, CAROL);
    (1..=100).for_each(|number| send(&mut host, number, &[bob, carol]));
    rest(&mut host);
    let deliveries = host.deliveries();
    assert_eq!(deliveries.len(), 1, "{deliveries:#?}");
    assert_eq!(deliveries[0].participant.unwrap().prefix, BOB);
    assert_eq!(host.topic().received.unwrap().unmatched, 80);
}

#[test]
fn a_wire_source_has_no_delivery_without_a_reader_of_the_topic() {
    let mut host = Host::new();
    let group = unknown_participant(&mut host, BOB, 7411)
        .multicast(0)
        .wire();
    (1..=20).for_each(|number| send(&mut host, number, &[group]));
    assert!(host.deliveries().is_empty());
    host.subscribe(BOB, 4);
    (21..=40).for_each(|number| send(&mut host, number, &[group]));
    rest(&mut host);
    let [delivery] = &host.deliveries()[..] else {
        panic!("one group: {:#?}", host.deliveries())
    };
    assert_eq!(
        (delivery.delivered.messages, delivery.delivered.lost()),
        (16, 4)
    );
}

#[test]
fn a_process_with_participants_in_two_domains_is_a_subscriber_in_one_domain() {
    let mut host = Host::new();
    let bob = host.reader(BOB, 7411).multicast(101);
    let other = bob.multicast(102);
    host.owner(bob, BOB);
    let payload = ros2probe_testing::model::forge::participant_at(
        CAROL,
        1_000_000,
        Some(7),
        &["10.0.0.2:9161".parse().unwrap()],
    );
    host.announce(ros2probe_testing::model::forge::Message::from(CAROL).data(
        ros2probe_testing::model::forge::SPDP,
        1,
        &payload,
    ));
    host.owner(other, CAROL);
    // The same process holds the sockets of both participants.
    for cookie in [101, 1000 + u64::from(CAROL.0[2])] {
        host.observer.input(Input::Socket(SocketFacts {
            cookie,
            process_id: Some(BOB.0[2].into()),
            ..SocketFacts::default()
        }));
    }
    host.owner(other, CAROL);
    (1..=10).for_each(|number| send(&mut host, number, &[bob]));
    let [delivery] = &host.deliveries()[..] else {
        panic!("one subscriber: {:#?}", host.deliveries())
    };
    assert_eq!(delivery.participant.unwrap().prefix, BOB);
}

#[test]
fn losses_at_a_socket_of_an_unknown_participant_stay_bounded() {
    let mut host = Host::new();
    host.reader(BOB, 7411);
    let stranger = unknown_participant(&mut host, CAROL, 7413).multicast(102);
    for number in (1..=1000).filter(|number| number % 2 == 0) {
        host.data(stranger, number);
    }
    (0..15).for_each(|_| host.wait(1000));
    assert!(host.deliveries().is_empty());
    let withheld = ros2probe_model::facts::bounded::ledger()["delivery.withheld"];
    assert_eq!(withheld.largest, withheld.cap);
    assert!(withheld.refused > 0);
}
