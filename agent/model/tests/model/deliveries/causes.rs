//! Causes of losses: before the host, in a socket buffer, in reassembly.

use ros2probe_model::facts::loss::LossCause;
use ros2probe_model::observe::input::Input;
use ros2probe_testing::model::host::{BOB, CapturePoint, Host};
use ros2probe_wire::Record;
use ros2probe_wire::record::{flag, kind};
use ros2probe_wire::time::SECOND;

#[test]
fn each_cause_has_its_own_count_and_all_counts_add_up() {
    let mut host = Host::new();
    let bob = host.reader(BOB, 7411);
    for number in 1..=100 {
        match number {
            // These samples were never sent to the host.
            10 | 20 | 30 => {}
            40 | 41 => host.socket_full(bob, number),
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
fn fragments_dropped_by_a_full_buffer_lose_the_sample_until_it_is_repaired() {
    let mut host = Host::new();
    let bob = host.reader(BOB, 7411);
    let run = |host: &mut Host, number| {
        host.wait(10);
        for fragment in [4, 5, 6] {
            let late = Record {
                flags: bob.flags | flag::SOCKET_FULL,
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
    // A retransmission is another arrival, and a part of it is dropped, too.
    let again = host.fragments(bob, 2, 4, 3);
    host.put(Record {
        flags: bob.flags | flag::SOCKET_FULL,
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
    // The writer's measurement counts samples that reached the host, whether or not a buffer was
    // full.
    let union = host.measurement();
    assert_eq!((union.messages, union.lost, union.recovered), (3, 0, 0));
}

#[test]
fn a_retransmission_dropped_by_a_full_buffer_is_lost_in_the_buffer() {
    let mut host = Host::new();
    let bob = host.reader(BOB, 7411);
    host.data(bob, 1);
    host.data(bob, 3);
    host.wait(100);
    host.socket_full(bob, 2);
    host.wait(12_000);
    assert_eq!(host.losses(LossCause::SocketBuffer), [2]);
    assert_eq!(host.deliveries()[0].delivered.lost(), 1);
}

#[test]
fn a_pending_loss_gets_its_cause_when_its_fragments_expire() {
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
fn a_failed_reassembly_after_the_retransmission_is_not_a_loss() {
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
fn a_sample_that_left_this_host_is_lost_if_it_never_arrives_at_an_open_socket() {
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
fn send_delays_continue_after_the_wall_clock_was_set_back() {
    const HOUR: i64 = 3600 * SECOND.cast_signed();
    for step in [-HOUR, HOUR] {
        let mut host = Host::new();
        let bob = host.reader(BOB, 7411);
        for number in 1..=20 {
            if number == 11 {
                // The writer uses the same clock.
                host.now = host.now.saturating_add_signed(step);
                host.observer.input(Input::ClockSet(step));
            }
            host.data(bob.leaving(), number);
            host.wait(100);
        }
        let breakdown = host.topic().breakdown.unwrap();
        assert_eq!(breakdown.send_delay.count(), 20, "{step}");
    }
}

#[test]
fn a_sample_that_never_arrives_at_a_live_receiver_is_lost_within_seconds() {
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

/// Puts a sample of the TCP connection with this source port.
fn by_tcp(host: &mut Host, seen: CapturePoint, source_port: u16, number: u64) {
    let record = host.record(seen, kind::DATA, number);
    host.put(Record {
        flags: seen.flags | flag::TCP,
        source_port,
        ..record
    });
    host.wait(5);
}

#[test]
fn a_gap_within_one_tcp_connection_is_the_senders() {
    let mut host = Host::new();
    let bob = host.reader(BOB, 7411);
    for number in [1, 2, 4, 5, 9, 10] {
        by_tcp(&mut host, bob, 5100, number);
    }
    host.wait(12_000);
    assert_eq!(host.losses(LossCause::Sender), [3, 6, 7, 8]);
    assert!(host.losses(LossCause::BeforeHost).is_empty());
    assert_eq!(host.deliveries()[0].delivered.lost_at_sender, 4);
    // Datagrams may be lost on the network.
    for number in [11, 13] {
        host.data(bob, number);
    }
    host.wait(12_000);
    assert_eq!(host.losses(LossCause::Sender), [3, 6, 7, 8]);
    assert_eq!(host.losses(LossCause::BeforeHost), [12]);
}

#[test]
fn a_sample_missing_between_two_tcp_connections_may_have_been_in_transit() {
    let mut host = Host::new();
    let bob = host.reader(BOB, 7411);
    for (source_port, number) in [(5100, 1), (5100, 2), (5101, 5), (5101, 7)] {
        by_tcp(&mut host, bob, source_port, number);
    }
    host.wait(12_000);
    assert_eq!(host.losses(LossCause::BeforeHost), [3, 4]);
    assert_eq!(host.losses(LossCause::Sender), [6]);
}

#[test]
fn a_sample_that_entered_the_connection_was_not_dropped_before_it() {
    let mut host = Host::new();
    let bob = host.reader(BOB, 7411);
    let sent = bob.leaving();
    for number in 1..=20 {
        by_tcp(&mut host, sent, 5100, number);
        if number <= 10 {
            by_tcp(&mut host, bob, 5100, number);
        }
    }
    for _ in 0..40 {
        host.wait(1000);
        host.acknack(bob, 11);
    }
    assert!(host.losses(LossCause::Sender).is_empty());
    assert_eq!(
        host.losses(LossCause::BeforeHost),
        (11..=20).collect::<Vec<_>>()
    );
}
