//! A forged datagram with a live writer's GUID does not change the counts of the real stream.
//!
//! Each run is compared with the same run without the forgery.

use std::sync::Arc;

use proptest::prelude::*;
use ros2probe_model::facts::dispatch::{Dispatch, SampleOutcome};
use ros2probe_model::facts::selection::{Depth, SampleRequest, Selection};
use ros2probe_model::observe::input::Input;
use ros2probe_model::report::snapshot::Measurement;
use ros2probe_testing::model::host::{BOB, CapturePoint, Host};
use ros2probe_wire::Record;
use ros2probe_wire::record::kind;

const HOUR: i64 = 3600;

/// The compared counts of two runs.
#[derive(Clone, Debug, PartialEq)]
struct Counts {
    messages: u64,
    lost: u64,
    recovered: u64,
    duplicates: u64,
    irrelevant: u64,
    latencies: u64,
    delivered: u64,
    lost_at_receiver: u64,
    duplicates_at_receiver: u64,
}

/// A stream of 1000 messages, of which every 97th is lost.
struct Run {
    reliable: bool,
    /// Milliseconds between messages.
    period: u64,
    /// The first sequence number.
    first: u64,
    /// Index of the message before which the forgery is sent.
    forged_at: u64,
}

impl Run {
    const fn new(reliable: bool, period: u64) -> Self {
        Self {
            reliable,
            period,
            first: 1,
            forged_at: 500,
        }
    }

    fn play(&self, forgery: &dyn Fn(&mut Host, CapturePoint)) -> Host {
        let mut host = Host::new();
        host.writer(self.reliable);
        let bob = host.reader(BOB, 7411);
        host.subscribe_with(BOB, 2, self.reliable);
        for index in 0..1000 {
            if index == self.forged_at {
                forgery(&mut host, bob);
            }
            host.wait(self.period);
            let number = self.first + index;
            if index % 97 != 96 {
                host.data(bob, number);
            }
            if self.reliable && index % 10 == 0 {
                host.heartbeat(bob, 1, number);
            }
        }
        host.wait(60_000);
        host
    }

    fn counts(&self, forgery: &dyn Fn(&mut Host, CapturePoint)) -> Counts {
        let host = self.play(forgery);
        let facts = host.measurement();
        let deliveries = host.deliveries();
        let delivered = deliveries.first().unwrap().delivered;
        Counts {
            messages: facts.messages,
            lost: facts.lost,
            recovered: facts.recovered,
            duplicates: facts.duplicates,
            irrelevant: facts.irrelevant,
            latencies: facts.source_latency.count(),
            delivered: delivered.messages,
            lost_at_receiver: delivered.lost(),
            duplicates_at_receiver: delivered.duplicates,
        }
    }

    /// Asserts that the counts with this forgery equal those without it, plus `more` messages.
    fn stays_exact(&self, more: u64, forgery: &dyn Fn(&mut Host, CapturePoint)) {
        self.stays_exact_but(more, 0, forgery);
    }

    /// Asserts the same as [`Self::stays_exact`], except that `unmeasured` latencies are missing.
    fn stays_exact_but(
        &self,
        more: u64,
        unmeasured: u64,
        forgery: &dyn Fn(&mut Host, CapturePoint),
    ) {
        let honest = self.counts(&|_, _| {});
        assert_eq!((honest.messages, honest.delivered), (990, 990));
        let expected = Counts {
            messages: honest.messages + more,
            delivered: honest.delivered + more,
            latencies: honest.latencies - unmeasured,
            ..honest
        };
        assert_eq!(self.counts(forgery), expected);
    }
}

fn streams() -> impl Iterator<Item = Run> {
    [(true, 10), (false, 10), (true, 1000), (false, 1000)]
        .into_iter()
        .map(|(reliable, period)| Run::new(reliable, period))
}

/// Returns the record with an INFO_TS this many seconds from now.
fn stamped(record: Record, seconds: i64) -> Record {
    let now = record.source_timestamp >> 32;
    Record {
        source_timestamp: now.checked_add_signed(seconds).unwrap() << 32,
        ..record
    }
}

#[test]
fn one_datagram_with_a_number_far_ahead_hides_and_loses_no_message() {
    for run in streams() {
        for ahead in [100, 5000, 100_000, 1 << 21, 1 << 40] {
            run.stays_exact(1, &|host, bob| host.data(bob, 500 + ahead));
        }
    }
}

#[test]
fn a_number_far_ahead_with_its_own_heartbeat_is_not_confirmed() {
    for run in streams() {
        for ahead in [100_u64, 100_000, 1 << 40] {
            run.stays_exact(1, &|host, bob| {
                host.data(bob, 500 + ahead);
                if run.reliable {
                    host.heartbeat(bob, 500 + ahead, 500 + ahead);
                }
            });
        }
    }
}

#[test]
fn many_numbers_far_ahead_in_one_datagram_are_not_confirmed() {
    for run in streams() {
        run.stays_exact(20, &|host, bob| {
            (0..20).for_each(|number| host.data(bob, (1 << 40) + number));
        });
    }
}

#[test]
fn numbers_far_ahead_between_those_of_the_live_run_are_not_confirmed() {
    let run = Run::new(true, 10);
    let mut host = run.play(&|_, _| {});
    let bob = host.reader(BOB, 7411);
    let before = host.measurement();
    for number in 0..2000 {
        host.wait(10);
        host.data(bob, 1001 + number);
        host.data(bob, (1 << 30) + number);
    }
    host.wait(60_000);
    let after = host.measurement();
    assert_eq!(after.messages, before.messages + 4000);
    assert_eq!(
        (after.lost, after.duplicates),
        (before.lost, before.duplicates)
    );
}

#[test]
fn one_heartbeat_far_ahead_causes_no_loss() {
    for period in [10, 1000] {
        for last in [600, 4000, 1 << 20, 1 << 40] {
            let run = Run::new(true, period);
            run.stays_exact(0, &|host, bob| host.heartbeat(bob, 1, last));
            run.stays_exact(0, &|host, bob| host.heartbeat(bob, last, last));
        }
    }
}

#[test]
fn one_gap_far_ahead_marks_no_sample_irrelevant() {
    for period in [10, 1000] {
        for number in [600, 4000, 1 << 20, 1 << 31] {
            let run = Run::new(true, period);
            run.stays_exact(0, &|host, bob| host.gap(bob, number));
            run.stays_exact(0, &|host, bob| {
                let end = u32::try_from(number).unwrap();
                host.put(Record {
                    payload_len: 0,
                    encapsulation: end,
                    ..host.record(bob, kind::GAP, 501)
                });
            });
        }
    }
}

#[test]
fn one_acknack_far_ahead_acknowledges_no_sample() {
    let run = Run::new(true, 10);
    let mut host = run.play(&|host, bob| host.acknack(bob, 400));
    let bob = host.reader(BOB, 7411);
    host.acknack(bob, 1 << 40);
    let acknowledgements = host.topic().acknowledgements;
    let bases: Vec<_> = acknowledgements
        .iter()
        .map(|each| each.acknowledged.0)
        .collect();
    assert_eq!(bases, [399]);
    run.stays_exact(0, &|host, bob| {
        // Sample 486 is missing and undecided.
        host.acknack(bob, 1 << 40);
    });
}

#[test]
fn an_old_number_with_a_newer_timestamp_is_not_a_restart() {
    for run in streams() {
        for number in [1, 400, 499] {
            run.stays_exact(1, &|host, bob| {
                host.put(stamped(host.record(bob, kind::DATA, number), 3500));
            });
        }
    }
}

#[test]
fn a_fragment_with_a_number_far_ahead_or_far_behind_changes_no_count() {
    for run in streams() {
        for number in [1, 400, 700, 100_000, 1 << 40] {
            run.stays_exact(0, &|host, bob| {
                host.put(stamped(host.fragments(bob, number, 1, 1), 3500));
            });
        }
    }
}

#[test]
fn a_forgery_before_the_stream_hides_no_message() {
    for run in streams() {
        let first = |number: u64, first: u64| {
            let run = Run {
                first,
                forged_at: 0,
                ..Run::new(run.reliable, run.period)
            };
            // The first messages establish the writer's run, and their latencies are not measured.
            run.stays_exact_but(1, 4, &|host, bob| {
                host.put(stamped(host.record(bob, kind::DATA, number), 3000));
                host.wait(10);
            });
        };
        first(1 << 40, 1);
        first(100_000, 1);
        first(1, 900_000);
        first(1, 9_000_000);
    }
}

#[test]
fn a_timestamp_hours_away_is_counted_but_enters_no_sum() {
    for seconds in [2 * HOUR, -2 * HOUR, -1_700_000_000] {
        let run = Run::new(false, 10);
        let host = run.play(&|host, bob| {
            host.put(stamped(host.record(bob, kind::DATA, 501), seconds));
        });
        let facts = host.measurement();
        let honest = run.play(&|_, _| {}).measurement();
        assert_eq!(facts.implausible_latency, 1, "{seconds}");
        assert!(facts.source_latency.sum() < 1.0, "{seconds}");
        assert_eq!(facts.messages, honest.messages);
        assert_eq!(facts.lost, honest.lost);
    }
}

#[test]
fn a_timestamp_in_the_future_hides_no_restart_of_its_writer() {
    for period in [10, 1000] {
        let run = Run::new(true, period);
        let mut host = run.play(&|host, bob| {
            host.put(stamped(host.record(bob, kind::DATA, 501), 300 * HOUR));
        });
        let before = host.measurement();
        let bob = host.reader(BOB, 7411);
        for number in 1..=100 {
            host.wait(period);
            host.data(bob, number);
        }
        host.wait(60_000);
        let after = host.measurement();
        assert_eq!(after.messages, before.messages + 100);
        assert_eq!(
            (after.lost, after.duplicates),
            (before.lost, before.duplicates)
        );
    }
}

#[test]
fn every_message_of_a_writer_with_an_unset_clock_is_implausible() {
    let mut host = Host::new();
    let bob = host.reader(BOB, 7411);
    for number in 1..=50 {
        host.wait(100);
        host.put(stamped(
            host.record(bob, kind::DATA, number),
            -1_795_000_000,
        ));
    }
    let facts = host.measurement();
    assert_eq!((facts.messages, facts.implausible_latency), (50, 50));
    assert_eq!(
        (facts.source_latency.count(), facts.negative_latency),
        (0, 0)
    );
}

#[test]
fn a_confirmed_jump_loses_the_skipped_numbers_up_to_a_limit() {
    for (ahead, lost) in [(200, 200), (10_000, 10_000), (1 << 21, 0), (1 << 40, 0)] {
        let mut host = Host::new();
        let bob = host.reader(BOB, 7411);
        let mut records = Vec::new();
        for number in (1..=100).chain(101 + ahead..=200 + ahead) {
            host.wait(10);
            let record = host.record(bob, kind::DATA, number);
            records.push(record);
            host.put(record);
        }
        host.wait(60_000);
        let facts = host.measurement();
        assert_eq!(
            (facts.messages, facts.lost, facts.duplicates),
            (200, lost, 0),
            "{ahead}"
        );
        assert_eq!(facts.sequence_jumps, 1);
        let delivered = host.deliveries()[0].delivered;
        assert_eq!((delivered.messages, delivered.lost()), (200, lost));
        // Messages from before the confirmation are not counted again.
        for record in &records[100..106] {
            host.put(Record {
                time: host.now,
                ..*record
            });
        }
        assert_eq!(host.measurement().messages, 200);
    }
}

#[test]
fn a_jump_of_fragmented_messages_counts_each_message_once() {
    for reliable in [true, false] {
        let mut host = Host::new();
        host.writer(reliable);
        let bob = host.reader(BOB, 7411);
        host.subscribe_with(BOB, 2, reliable);
        for number in (1..=20).chain(1021..=1040) {
            for start in [1, 6] {
                host.wait(5);
                let half = host.fragments(bob, number, start, 5);
                host.put(half);
                host.put(half);
            }
        }
        host.wait(60_000);
        let facts = host.measurement();
        assert_eq!((facts.messages, facts.lost), (40, 1000));
        assert_eq!((facts.incomplete, facts.sequence_jumps), (0, 1));
        let delivered = host.deliveries()[0].delivered;
        assert_eq!((delivered.messages, delivered.lost()), (40, 1000));
    }
}

#[test]
fn a_heartbeat_of_a_later_datagram_confirms_a_jump() {
    let mut host = Host::new();
    let bob = host.reader(BOB, 7411);
    for number in (1..=100).chain([1101]) {
        host.wait(10);
        host.data(bob, number);
        host.heartbeat(bob, 1, number);
    }
    host.wait(10);
    host.heartbeat(bob, 1, 1101);
    host.wait(60_000);
    let facts = host.measurement();
    assert_eq!((facts.messages, facts.lost), (101, 1000));
}

#[test]
fn samples_of_a_gap_stay_irrelevant_after_a_confirmed_jump() {
    let mut host = Host::new();
    let bob = host.reader(BOB, 7411);
    for number in 1..=100 {
        host.wait(10);
        host.data(bob, number);
    }
    host.put(Record {
        payload_len: 0,
        encapsulation: 1101,
        ..host.record(bob, kind::GAP, 101)
    });
    for number in 1101..=1110 {
        host.wait(10);
        host.data(bob, number);
    }
    host.wait(60_000);
    let facts = host.measurement();
    assert_eq!((facts.messages, facts.lost), (110, 0));
    assert_eq!(facts.irrelevant, 1000);
}

#[test]
fn a_restart_after_few_messages_is_counted_without_losses() {
    for (before, after) in [(1, 1), (3, 2), (3, 5), (100, 3), (100, 50), (2000, 4)] {
        let mut host = Host::new();
        let bob = host.reader(BOB, 7411);
        for number in (1..=before).chain(1..=after) {
            host.wait(1000);
            host.data(bob, number);
            host.data(bob.multicast(99), number);
        }
        host.wait(60_000);
        let facts: Measurement = host.measurement();
        assert_eq!(
            (facts.messages, facts.lost),
            (before + after, 0),
            "{before} {after}"
        );
    }
}

#[test]
fn a_restart_fills_no_gaps_of_the_previous_run() {
    let mut host = Host::new();
    let bob = host.reader(BOB, 7411);
    let before = (1..=400).filter(|number| ![3, 150, 390].contains(number));
    for number in before.chain(1..=200) {
        host.wait(10);
        let record = host.record(bob, kind::DATA, number);
        host.put(record);
        if number == 400 {
            host.wait(11_000);
        }
    }
    host.wait(60_000);
    let facts = host.measurement();
    assert_eq!((facts.messages, facts.lost), (597, 3));
    assert_eq!((facts.duplicates, facts.recovered), (0, 0));
}

#[test]
fn an_unconfirmed_message_is_dispatched_once_and_delays_no_other() {
    let mut host = Host::new();
    let bob = host.reader(BOB, 7411);
    host.observer
        .input(Input::SampleRequests(Arc::new(vec![SampleRequest {
            id: 1,
            selection: Arc::new(Selection::all()),
            domain_id: None,
            depth: Depth::Arrivals,
        }])));
    let mut given = Vec::new();
    for number in 1..=100 {
        host.wait(10);
        if number == 50 {
            host.data(bob, 1 << 40);
            host.acknack(bob, 50);
        }
        host.data(bob, number);
        let samples = host.observer.drain().samples.into_iter();
        given.extend(samples.filter_map(|given: Dispatch| match given.outcome {
            SampleOutcome::Sample(sample) => Some(sample.sequence_number.0),
            SampleOutcome::Missed(_) => None,
        }));
    }
    let expected: Vec<_> = (1..50).chain([1 << 40]).chain(50..=100).collect();
    assert_eq!(given, expected);
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(48))]

    /// No single forged record changes the losses and messages of the real stream.
    #[test]
    fn no_single_forged_record_changes_the_counts_of_a_real_stream(
        reliable: bool,
        is_slow: bool,
        kind in prop::sample::select(vec![kind::DATA, kind::HEARTBEAT, kind::GAP]),
        number in prop_oneof![
            600_u64..700,
            1000_u64..6000,
            1_u64 << 16..1 << 22,
            1_u64 << 32..1 << 62
        ],
        length in 0_u64..1 << 20,
        seconds in -100_000_i64..100_000,
    ) {
        let run = Run::new(reliable, if is_slow { 1000 } else { 10 });
        let forgery = |host: &mut Host, bob: CapturePoint| {
            let record = stamped(host.record(bob, kind, number), seconds);
            let last = number + length;
            host.put(match kind {
                kind::DATA => record,
                _ => Record {
                    payload_len: u32::try_from(last >> 32).unwrap(),
                    encapsulation: last as u32,
                    ..record
                },
            });
        };
        let honest = run.counts(&|_, _| {});
        let forged = run.counts(&forgery);
        let more = u64::from(kind == kind::DATA);
        prop_assert_eq!(forged, Counts {
            messages: honest.messages + more,
            delivered: honest.delivered + more,
            ..honest
        });
    }
}
