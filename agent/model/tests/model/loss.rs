//! The loss of a topic, which is that of its worst subscriber: expectation, event, history,
//! counters.

use std::sync::Arc;

use ros2probe_model::facts::event::EventKind;
use ros2probe_model::facts::loss_share::LossShare;
use ros2probe_model::facts::watch::WatchState;
use ros2probe_model::facts::watch::{Expectations, Watch, Watchlist};
use ros2probe_model::observe::input::Input;
use ros2probe_testing::model::host::{BOB, CAROL, CapturePoint, Host};

/// Creates a host that expects at most this share of losses.
fn host(max_loss_ratio: f64) -> Host {
    let mut host = Host::new();
    let mut watch = Watch::named("/chatter").unwrap();
    watch.expectations = Expectations {
        max_loss_ratio: Some(max_loss_ratio),
        ..Expectations::default()
    };
    let list = Watchlist::new(vec![watch]).unwrap();
    host.observer.input(Input::Watchlist(Arc::new(list)));
    host.observer.drain();
    host
}

/// Sends 100 samples in ten seconds. Each receiver loses the multiples of its number.
fn send(host: &mut Host, from: u64, receivers: &[(CapturePoint, u64)]) {
    for number in from..from + 100 {
        for (receiver, every) in receivers {
            if number % every == 0 {
                host.socket_full(*receiver, number);
            } else {
                host.data(*receiver, number);
            }
        }
        host.wait(100);
    }
}

fn state(host: &Host) -> WatchState {
    host.snapshot().watches[0].topics[0].state
}

/// Returns the counts of the loss events so far.
fn lost(host: &mut Host) -> Vec<u64> {
    let events = host.observer.drain().events.events.into_iter();
    events
        .filter_map(|event| match event.kind {
            EventKind::Loss(burst) => Some(burst.count),
            _ => None,
        })
        .collect()
}

#[test]
fn losses_at_one_of_two_subscribers_violate_the_expectation_and_raise_an_event() {
    let mut host = host(0.05);
    let (bob, carol) = (host.reader(BOB, 7411), host.reader(CAROL, 7413));
    send(&mut host, 1, &[(bob, 1000), (carol, 5)]);
    (0..15).for_each(|second| send(&mut host, 101 + 100 * second, &[(bob, 1000), (carol, 5)]));
    // Every sample reached this host, and one of two subscribers loses a fifth.
    let measured = host.measurement();
    assert_eq!((measured.messages, measured.lost), (1600, 0));
    assert_eq!(state(&host), WatchState::Violated);
    let ratio = measured.loss.ratio().unwrap();
    assert!((0.18..=0.2).contains(&ratio), "{ratio}");
    let topic = host.topic();
    assert_eq!(topic.measurement.unwrap().loss, measured.loss);
    let counts = lost(&mut host);
    let sum: u64 = counts.iter().sum();
    assert!((280..=320).contains(&sum), "{counts:?}");
}

#[test]
fn losses_of_each_subscriber_within_the_limit_violate_no_expectation() {
    let mut host = host(0.15);
    let (bob, carol) = (host.reader(BOB, 7411), host.reader(CAROL, 7413));
    // Together they lose more than either.
    (0..4).for_each(|round| send(&mut host, 1 + 100 * round, &[(bob, 9), (carol, 10)]));
    assert_eq!(state(&host), WatchState::Ok);
}

#[test]
fn a_sample_that_reaches_no_receiver_is_lost_once_and_not_per_subscriber() {
    let mut host = host(0.05);
    let (bob, carol) = (host.reader(BOB, 7411), host.reader(CAROL, 7413));
    for number in (1..=400).filter(|number| number % 10 != 0) {
        host.data(bob, number);
        host.data(carol, number);
        host.wait(if number % 10 == 9 { 200 } else { 100 });
    }
    (0..12).for_each(|_| host.wait(1000));
    let measured = host.measurement();
    assert_eq!((measured.messages, measured.lost), (360, 39));
    assert_eq!(
        measured.loss,
        LossShare {
            lost: 39,
            expected: 399
        }
    );
    assert_eq!(lost(&mut host).iter().sum::<u64>(), 39);
}

#[test]
fn without_an_observed_delivery_samples_that_did_not_reach_this_host_are_lost() {
    let mut host = host(0.05);
    let carol = host.bystander(CAROL, 7413);
    for number in (1..=400).filter(|number| number % 10 != 0) {
        host.data(carol, number);
        host.wait(if number % 10 == 9 { 200 } else { 100 });
    }
    assert_eq!(state(&host), WatchState::Violated);
    (0..12).for_each(|_| host.wait(1000));
    let measured = host.measurement();
    assert!(host.deliveries().is_empty());
    assert_eq!(
        measured.loss,
        LossShare {
            lost: measured.lost,
            expected: 399
        }
    );
    assert_eq!(lost(&mut host).iter().sum::<u64>(), 39);
}

#[test]
fn a_retransmitted_sample_is_not_a_loss_of_the_worst_subscriber() {
    let mut host = host(0.0);
    let bob = host.reader(BOB, 7411);
    for number in 1..=200 {
        if number % 10 != 0 {
            host.data(bob, number);
        }
        host.wait(100);
        if number % 10 == 5 && number > 10 {
            host.data(bob, number - 5);
        }
    }
    (0..20).for_each(|_| host.wait(1000));
    assert_eq!(state(&host), WatchState::Ok);
    assert_eq!(host.measurement().loss.lost, 0);
    assert!(lost(&mut host).is_empty());
}
