//! HEARTBEAT and ACKNACK: the samples that a writer still has, and those that a reader waits for.

use ros2probe_model::facts::loss::LossCause;
use ros2probe_testing::model::forge::{self, Message, SEDP_READERS};
use ros2probe_testing::model::host::{BOB, CAROL, Host, READER, STRING};
use ros2probe_wire::Guid;

#[test]
fn a_directed_heartbeat_announces_the_last_samples_only_to_its_reader() {
    let mut host = Host::new();
    let (bob, carol) = (host.reader(BOB, 7411), host.reader(CAROL, 7413));
    for number in 1..=10 {
        host.data(bob, number);
        host.data(carol, number);
    }
    host.heartbeat(bob.directed(BOB), 1, 13);
    // The same socket receives a HEARTBEAT for another participant.
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
fn an_acknack_shows_the_acknowledged_and_missing_samples() {
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
        (facts.acknowledged.0, facts.missing, facts.lag_samples),
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
fn a_best_effort_reader_of_a_reliable_writer_gets_no_retransmission() {
    let mut host = Host::new();
    let bob = host.reader(BOB, 7411);
    host.subscribe_with(BOB, 2, false);
    host.wait(10);
    for number in 1..=100 {
        if number % 10 != 0 {
            host.data(bob, number);
        }
        // All other readers have acknowledged everything, so the writer drops the earlier samples.
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
fn heartbeats_cause_no_loss_until_the_reader_requests_samples() {
    let mut host = Host::new();
    let bob = host.reader(BOB, 7411);
    // All samples use shared memory.
    for number in 1..=100 {
        host.heartbeat(bob.directed(BOB), 1, number);
        host.wait(100);
    }
    host.wait(12_000);
    assert_eq!(host.deliveries()[0].delivered.lost(), 0);
    // All samples exceed the size of shared memory, and the reader requests them.
    for number in 101..=120 {
        host.heartbeat(bob.directed(BOB), 1, number);
        host.request(bob, 101, 1, 1 << 31);
        host.wait(100);
    }
    host.wait(12_000);
    // The samples that it acknowledged before used shared memory.
    let facts = host.deliveries()[0].delivered;
    assert_eq!((facts.lost(), facts.irrelevant), (20, 99));
}

#[test]
fn a_sample_that_a_short_history_overwrote_before_it_arrived_is_lost() {
    let mut host = Host::new();
    let bob = host.reader(BOB, 7411);
    for number in 1..=100 {
        // With KEEP_LAST (1), only the HEARTBEAT for 51 arrives, but neither 50 nor 51.
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
fn an_acknowledged_sample_that_was_not_captured_is_not_lost() {
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
fn samples_that_a_content_filter_rejects_are_lost_only_if_the_cause_is_known() {
    for is_reliable in [false, true] {
        let mut host = Host::new();
        let bob = host.reader(BOB, 7411);
        let reliability = [&(1 + u32::from(is_reliable)).to_le_bytes()[..], &[0; 8]].concat();
        let filtered: [(u16, &[u8]); 2] = [(0x1a, &reliability), (0x35, &[0; 4])];
        let guid = Guid::new(BOB, READER);
        let payload = forge::endpoint_with(guid, "rt/chatter", STRING, &filtered);
        host.announce(Message::from(BOB).data(SEDP_READERS, 2, &payload));
        for number in (20..=800).step_by(20) {
            host.data(bob, number);
            if is_reliable {
                host.heartbeat(bob, number - 9, number);
                host.acknack(bob, number + 1);
            }
            host.wait(100);
        }
        host.socket_full(bob, 810);
        host.data(bob, 820);
        (0..15).for_each(|_| host.wait(1000));
        let facts = host.deliveries()[0].delivered;
        let lost = (facts.lost(), facts.lost_in_socket_buffer);
        assert_eq!((facts.messages, lost), (41, (1, 1)), "{is_reliable}");
        assert_eq!(facts.irrelevant, 39 * 19 + 18, "{is_reliable}");
        assert_eq!(host.measurement().lost, 0, "{is_reliable}");
    }
}

#[test]
fn a_history_of_thousands_of_samples_is_delivered_whole() {
    for is_first_live in [false, true] {
        let mut host = Host::new();
        let bob = host.reader(BOB, 7411);
        if is_first_live {
            host.data(bob, 3000);
        }
        host.heartbeat(bob.directed(BOB), 1, 3000);
        for number in (1..3000).chain(3000 + u64::from(is_first_live)..=3100) {
            host.data(bob, number);
            if number.is_multiple_of(100) {
                host.wait(10);
            }
        }
        (0..15).for_each(|_| host.wait(1000));
        let facts = host.deliveries()[0].delivered;
        let history = 3000 - u64::from(is_first_live);
        assert_eq!((facts.messages, facts.history), (3100, history));
        assert_eq!((facts.duplicates, facts.lost()), (0, 0));
    }
}

#[test]
fn a_hundred_thousand_samples_written_without_a_reader_are_lost_at_neither_end() {
    for is_sender in [false, true] {
        let mut host = Host::new();
        let bob = host.reader(BOB, 7411);
        let seen = if is_sender { bob.leaving() } else { bob };
        for number in 1..=100 {
            host.data(seen, number);
            host.wait(10);
        }
        host.unsubscribe(BOB, 2);
        (0..100).for_each(|_| host.wait(1000));
        host.subscribe(BOB, 3);
        for number in 100_101..=100_200 {
            host.data(seen, number);
            host.wait(10);
        }
        (0..15).for_each(|_| host.wait(1000));
        let facts = host.measurement();
        assert_eq!((facts.messages, facts.lost), (200, 0), "{is_sender}");
    }
}

#[test]
fn samples_written_while_a_reader_was_absent_are_not_lost() {
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
