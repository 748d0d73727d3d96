//! At any time, every sample is delivered, lost or pending, even if the writer falls silent.

use ros2probe_model::facts::loss::LossCause;
use ros2probe_model::facts::route::Destination;
use ros2probe_model::observe::input::Input;
use ros2probe_testing::model::forge::{Message, SEDP_WRITERS};
use ros2probe_testing::model::host::{ALICE, BOB, CapturePoint, Host, WRITER};
use ros2probe_wire::{Guid, Timestamp};

/// Adds Bob with a best-effort reader, and makes the writer best effort.
fn best_effort(host: &mut Host) -> CapturePoint {
    let bob = host.reader(BOB, 7411);
    host.writer(false);
    host.subscribe_with(BOB, 2, false);
    bob
}

/// Returns samples that are delivered, lost with a cause, and pending.
fn states(host: &Host) -> (u64, u64, u64) {
    let facts = host.deliveries()[0].delivered;
    let sum = host.topic().received.unwrap();
    assert_eq!((sum.lost(), sum.open()), (facts.lost(), facts.open()));
    (facts.messages, facts.lost_by_any(), facts.open())
}

#[test]
fn half_received_messages_of_a_stopped_writer_are_pending_and_then_lost() {
    let mut host = Host::new();
    let bob = best_effort(&mut host);
    host.data(bob, 1);
    host.wait(300);
    for number in 2..=50 {
        // Every fifth message loses its second half, as with lost IP fragments.
        let count = if number % 5 == 0 { 5 } else { 10 };
        host.put(host.fragments(bob, number, 1, count));
        host.wait(100);
        let (delivered, lost, pending) = states(&host);
        assert_eq!(delivered + lost + pending, number);
    }
    let (delivered, lost, pending) = states(&host);
    assert_eq!(delivered + lost + pending, 50);
    assert!(pending > 0);
    host.wait(3000);
    assert_eq!(states(&host), (40, 10, 0));
}

#[test]
fn the_last_messages_of_a_best_effort_writer_are_pending_until_they_are_lost() {
    let mut host = Host::new();
    let bob = best_effort(&mut host);
    for number in 1..=20 {
        host.data(bob.leaving(), number);
        host.wait(1);
        if number <= 17 {
            host.data(bob, number);
        }
        host.wait(100);
    }
    host.wait(2000);
    assert_eq!(states(&host), (17, 0, 3));
    // Bob still announces himself.
    host.participant(BOB, bob.address);
    host.wait(1000);
    host.participant(BOB, bob.address);
    (0..4).for_each(|_| host.wait(1000));
    assert_eq!(states(&host), (17, 3, 0));
    assert_eq!(host.losses(LossCause::BeforeHost), [18, 19, 20]);
}

#[test]
fn samples_to_a_removed_reader_do_not_stay_pending() {
    let mut host = Host::new();
    let bob = best_effort(&mut host);
    for number in 1..=100 {
        host.data(bob.leaving(), number);
        host.wait(1);
        if number <= 17 {
            host.data(bob, number);
        }
        host.wait(100);
    }
    host.unsubscribe(BOB, 3);
    (0..3).for_each(|_| host.wait(1000));
    let facts = host.deliveries()[0].delivered;
    assert_eq!((facts.messages, facts.lost(), facts.awaited), (17, 0, 0));
}

#[test]
fn the_losses_of_a_reliable_writer_that_leaves_are_settled_when_it_leaves() {
    let mut host = Host::new();
    let bob = host.reader(BOB, 7411);
    for number in (1..=20).filter(|number| ![7, 19].contains(number)) {
        host.data(bob, number);
        host.wait(10);
    }
    host.heartbeat(bob, 1, 21);
    host.wait(100);
    assert_eq!(states(&host), (18, 0, 3));
    let writer = Guid::new(ALICE, WRITER);
    host.announce(Message::from(ALICE).dispose_by_hash(SEDP_WRITERS, 2, writer));
    host.wait(100);
    assert_eq!(host.losses(LossCause::BeforeHost), [7, 19, 21]);
    let sum = host.topic().received.unwrap();
    assert_eq!((sum.messages, sum.lost_by_any(), sum.open()), (18, 3, 0));
    host.wait(1000);
    assert_eq!(host.measurement().loss.lost, 3);
}

#[test]
fn samples_dropped_from_the_writers_history_are_lost_within_two_seconds() {
    let mut host = Host::new();
    let bob = host.reader(BOB, 7411);
    for number in (1..=20).filter(|number| *number != 7) {
        host.data(bob, number);
        host.wait(10);
    }
    assert_eq!(states(&host), (19, 0, 1));
    // The writer keeps only the last ten samples.
    host.heartbeat(bob, 11, 20);
    host.wait(2000);
    assert_eq!(states(&host), (19, 1, 0));
}

#[test]
fn a_missing_sample_of_a_reliable_writer_is_pending_until_its_repair() {
    let mut host = Host::new();
    let bob = host.reader(BOB, 7411);
    for number in (1..=20).filter(|number| *number != 7) {
        host.data(bob, number);
    }
    host.wait(8000);
    assert_eq!(states(&host), (19, 0, 1));
    host.data(bob, 7);
    assert_eq!(states(&host), (20, 0, 0));
}

/// Reports that bytes of the connection to Bob were not captured.
fn miss_bytes(host: &mut Host, bob: CapturePoint) {
    let destination = Destination {
        address: bob.address.ip().to_ipv6_mapped().octets(),
        port: bob.address.port(),
    };
    let at = Timestamp(host.now);
    host.observer.input(Input::StreamGap(destination, at));
}

/// Bob's connection is TCP: bytes are missing in sample 4, those of 5, and the beginning of 6.
#[test]
fn samples_of_which_bytes_were_not_captured_are_not_lost_and_later_ones_are() {
    let mut host = Host::new();
    let bob = best_effort(&mut host);
    for number in 1..=3 {
        host.put(host.fragments(bob, number, 1, 10));
        host.wait(100);
    }
    host.put(host.fragments(bob, 4, 1, 5));
    host.wait(10);
    miss_bytes(&mut host, bob);
    host.put(host.fragments(bob, 6, 3, 8));
    host.wait(100);
    // The connection loses nothing, but its sender drops 8 and the end of 10.
    for (number, count) in [(7, 10), (9, 10), (10, 5), (11, 10)] {
        host.put(host.fragments(bob, number, 1, count));
        host.wait(100);
    }
    host.wait(3000);
    assert_eq!(states(&host), (6, 2, 0));
    assert_eq!(host.losses(LossCause::BeforeHost), [8, 10]);
    assert_eq!(host.measurement().loss.lost, 2);
}

#[test]
fn a_gap_of_another_connection_marks_no_number_irrelevant() {
    let mut host = Host::new();
    let bob = best_effort(&mut host);
    for number in [1, 2, 5] {
        if number == 5 {
            let mut other = bob;
            other.address.set_port(1);
            miss_bytes(&mut host, other);
        }
        host.put(host.fragments(bob, number, 1, 10));
        host.wait(100);
    }
    host.wait(3000);
    assert_eq!(states(&host), (3, 2, 0));
}
