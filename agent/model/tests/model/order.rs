//! Samples in the order of a reliable subscriber: which ones wait for a retransmission, and for how
//! long. The tests use virtual time and forged records.

use std::sync::Arc;

use proptest::prelude::*;
use ros2probe_model::facts::dispatch::{MissedReason, SampleOutcome};
use ros2probe_model::facts::selection::{Depth, SampleRequest, Selection};
use ros2probe_model::observe::input::Input;
use ros2probe_model::observe::observer::Settings;
use ros2probe_testing::model::forge;
use ros2probe_testing::model::forge::Message;
use ros2probe_testing::model::host::{
    ALICE, BOB, CapturePoint, Host, MILLISECOND, READER, START, STRING, WRITER,
};
use ros2probe_wire::record::{flag, kind};
use ros2probe_wire::{Guid, GuidPrefix, Record, Timestamp};

fn request(host: &mut Host, depth: Depth) {
    sample_requests(host, &[1], depth);
}

fn sample_requests(host: &mut Host, ids: &[u64], depth: Depth) {
    let sample_requests = ids.iter().map(|id| SampleRequest {
        id: *id,
        selection: Arc::new(Selection::all()),
        domain_id: None,
        depth,
    });
    host.observer
        .input(Input::SampleRequests(Arc::new(sample_requests.collect())));
}

/// Returns a host on which Bob has a reader that acknowledges.
fn listening() -> (Host, CapturePoint) {
    let mut host = Host::new();
    let bob = host.reader(BOB, 7411);
    request(&mut host, Depth::Arrivals);
    host.acknack(bob, 1);
    (host, bob)
}

/// Returns the numbers of the dispatched samples in order, with milliseconds since the start.
fn dispatched(host: &mut Host) -> Vec<(u64, u64)> {
    let given = host.observer.drain().samples.into_iter();
    given
        .filter_map(|given| match given.outcome {
            SampleOutcome::Sample(sample) => {
                let at = (sample.time.0 - START) / MILLISECOND;
                Some((sample.sequence_number.0, at))
            }
            SampleOutcome::Missed(_) => None,
        })
        .collect()
}

fn numbers(host: &mut Host) -> Vec<u64> {
    dispatched(host)
        .into_iter()
        .map(|(number, _)| number)
        .collect()
}

/// Returns reason, first and last number of missing samples.
fn missed(host: &mut Host) -> Vec<(MissedReason, u64, u64)> {
    let given = host.observer.drain().samples.into_iter();
    given
        .filter_map(|given| match given.outcome {
            SampleOutcome::Missed(missed) => Some((missed.reason, missed.first.0, missed.last.0)),
            SampleOutcome::Sample(_) => None,
        })
        .collect()
}

#[test]
fn a_stream_without_gaps_is_dispatched_without_delay() {
    let (mut host, bob) = listening();
    for number in 1..=100 {
        host.wait(10);
        host.data(bob, number);
        assert_eq!(dispatched(&mut host), [(number, number * 10)]);
    }
}

#[test]
fn samples_after_a_gap_are_dispatched_at_the_time_of_its_repair() {
    let (mut host, bob) = listening();
    for number in [1, 2, 4, 5] {
        host.wait(10);
        host.data(bob, number);
    }
    assert_eq!(dispatched(&mut host), [(1, 10), (2, 20)]);
    host.request(bob, 3, 1, 1 << 31);
    host.wait(200);
    assert!(dispatched(&mut host).is_empty());
    host.data(bob, 3);
    assert_eq!(dispatched(&mut host), [(3, 240), (4, 240), (5, 240)]);
    assert_eq!(host.measurement().recovered, 1);
}

#[test]
fn a_wait_ends_with_a_gap_a_heartbeat_or_an_acknack() {
    let (mut host, bob) = listening();
    host.data(bob, 1);
    host.data(bob, 3);
    host.wait(10);
    host.gap(bob, 2);
    assert_eq!(dispatched(&mut host), [(1, 0), (3, 10)]);
    host.data(bob, 5);
    host.wait(10);
    host.heartbeat(bob.directed(BOB), 5, 5);
    assert_eq!(dispatched(&mut host), [(5, 20)]);
    host.acknack(bob, 6);
    host.data(bob, 7);
    host.wait(10);
    host.acknack(bob, 8);
    assert_eq!(dispatched(&mut host), [(7, 30)]);
    host.wait(12_000);
    // Sample 6 used an unobserved transport; only the withdrawn one is lost.
    assert_eq!(missed(&mut host), [(MissedReason::Lost, 4, 4)]);
}

#[test]
fn an_unexplained_gap_delays_dispatch_for_a_limited_time() {
    let (mut host, bob) = listening();
    for number in [1, 3, 4] {
        host.data(bob, number);
    }
    host.wait(3_900);
    assert_eq!(numbers(&mut host), [1]);
    host.wait(200);
    assert_eq!(numbers(&mut host), [3, 4]);
    // Later samples do not wait for the same gap again.
    host.data(bob, 5);
    assert_eq!(numbers(&mut host), [5]);
    host.data(bob, 7);
    host.data(bob, 2);
    assert_eq!(dispatched(&mut host), [(2, 4_100)]);
    host.data(bob, 6);
    assert_eq!(numbers(&mut host), [6, 7]);
}

#[test]
fn best_effort_writers_and_readers_cause_no_wait() {
    for reliable in [false, true] {
        let mut host = Host::new();
        host.writer(reliable);
        let bob = host.reader(BOB, 7411);
        request(&mut host, Depth::Arrivals);
        if reliable {
            host.subscribe_with(BOB, 2, false);
        } else {
            host.acknack(bob, 1);
        }
        for number in [1, 3, 2, 6] {
            host.data(bob, number);
            assert_eq!(numbers(&mut host), [number], "{reliable}");
        }
    }
}

#[test]
fn a_reliable_reader_is_awaited_before_its_first_acknack_for_a_limited_time() {
    let mut host = Host::new();
    let bob = host.reader(BOB, 7411);
    request(&mut host, Depth::Arrivals);
    host.data(bob, 1);
    host.data(bob, 3);
    host.data(bob, 2);
    assert_eq!(numbers(&mut host), [1, 2, 3]);
    host.data(bob, 5);
    host.wait(4_100);
    assert_eq!(numbers(&mut host), [5]);
    // The reader's ACKNACKs use a path that is not observed.
    host.data(bob, 7);
    assert_eq!(numbers(&mut host), [7]);
    host.acknack(bob, 8);
    host.data(bob, 9);
    assert!(numbers(&mut host).is_empty());
    host.data(bob, 8);
    assert_eq!(numbers(&mut host), [8, 9]);
}

#[test]
fn the_end_of_the_input_or_of_the_writer_dispatches_waiting_samples() {
    let (mut host, bob) = listening();
    for number in [1, 3, 5] {
        host.data(bob, number);
    }
    assert_eq!(numbers(&mut host), [1]);
    host.observer.input(Input::End);
    assert_eq!(numbers(&mut host), [3, 5]);
    let (mut host, bob) = listening();
    for number in [1, 3, 5] {
        host.data(bob, number);
    }
    host.announce(Message::from(ALICE).dispose_by_hash(
        forge::SEDP_WRITERS,
        2,
        Guid::new(ALICE, WRITER),
    ));
    assert_eq!(numbers(&mut host), [1, 3, 5]);
}

#[test]
fn samples_that_wait_are_dispatched_once_a_new_incarnation_is_confirmed() {
    let (mut host, bob) = listening();
    for number in [1, 2, 4, 5, 6, 7, 8] {
        host.data(bob, number);
    }
    host.wait(1000);
    for number in 1..=6 {
        host.data(bob, number);
        host.wait(1);
    }
    // The first four may be forged: they delay no other sample and end no wait.
    let expected = [1, 2, 1, 2, 3, 4, 4, 5, 6, 7, 8, 5, 6];
    assert_eq!(numbers(&mut host), expected);
}

#[test]
fn the_number_of_waiting_samples_is_bounded() {
    let (mut host, bob) = listening();
    host.data(bob, 1);
    (3..=10_000).for_each(|number| host.data(bob, number));
    let given = numbers(&mut host);
    assert!(given.len() >= 5_000, "{}", given.len());
    assert!(given.is_sorted());
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 64, failure_persistence: None, ..ProptestConfig::default() })]
    #[test]
    fn samples_retransmitted_in_time_are_dispatched_once_and_in_order(
        fates in prop::collection::vec((0_u8..6, 1_u64..60), 1..200),
    ) {
        let (mut host, bob) = listening();
        host.data(bob, 1);
        let mut repairs = Vec::new();
        let mut expected = vec![1];
        let mut lost = Vec::new();
        for (number, (fate, pause)) in (2..).zip(&fates) {
            host.wait(*pause);
            match fate {
                0 => repairs.push(number),
                1 => host.gap(bob, number),
                2 => lost.push(number),
                _ => host.data(bob, number),
            }
            if !matches!(fate, 1 | 2) {
                expected.push(number);
            }
            if repairs.len() > 3 {
                repairs.drain(..).for_each(|number| host.data(bob, number));
                host.heartbeat(bob.directed(BOB), number + 1, number);
            }
        }
        repairs.into_iter().for_each(|number| host.data(bob, number));
        let end = 2 + fates.len() as u64;
        host.data(bob, end);
        expected.push(end);
        host.heartbeat(bob.directed(BOB), end, end);
        host.wait(15_000);
        let mut times = Vec::new();
        let mut numbers = Vec::new();
        let mut reported = Vec::new();
        for given in host.observer.drain().samples {
            match given.outcome {
                SampleOutcome::Sample(sample) => {
                    numbers.push(sample.sequence_number.0);
                    times.push(sample.time);
                }
                SampleOutcome::Missed(missed) => {
                    prop_assert_eq!(missed.reason, MissedReason::Lost);
                    reported.extend(missed.first.0..=missed.last.0);
                }
            }
        }
        prop_assert_eq!(numbers, expected);
        prop_assert!(times.is_sorted());
        prop_assert_eq!(reported.len() as u64, host.measurement().lost);
        prop_assert_eq!(reported, lost);
        prop_assert_eq!(host.measurement().messages, times.len() as u64);
    }
}

const DORA: GuidPrefix = GuidPrefix(*b"\x01\x10dora-sends");

/// A host on which Dora's writer sends before its announcement, with Bob's reader.
struct Unannounced {
    host: Host,
    bob: CapturePoint,
}

impl Unannounced {
    fn new(depth: Depth) -> Self {
        let mut host = Host::with(Settings::default());
        let bob = host.reader(BOB, 7411);
        request(&mut host, depth);
        host.participant(DORA, "10.0.0.3:7411".parse().unwrap());
        Self { host, bob }
    }

    fn data(&mut self, number: u64) {
        self.host.wait(20);
        let payload = [&[0, 1, 0, 0][..], format!("hello {number}").as_bytes()].concat();
        let message = Message::from(DORA).data(WRITER, number, &payload);
        self.host.announce(message);
    }

    fn announce(&mut self, reliable: bool) {
        let guid = Guid::new(DORA, WRITER);
        let payload = forge::endpoint(guid, "rt/chatter", "std_msgs::msg::dds_::String_", reliable);
        self.host
            .announce(Message::from(DORA).data(forge::SEDP_WRITERS, 1, &payload));
    }

    fn acknack(&mut self, base: u64) {
        let record = Record {
            writer: ros2probe_wire::record::guid_words(Guid::new(DORA, WRITER)),
            reader: ros2probe_wire::record::guid_words(Guid::new(BOB, READER)),
            ..self.host.record(self.bob.leaving(), kind::ACKNACK, base)
        };
        self.host.put(record);
    }

    /// Returns the numbers of the dispatched samples, after checking their payloads against
    /// `depth`.
    fn given(&mut self, depth: Depth) -> Vec<u64> {
        let mut numbers = Vec::new();
        for given in self.host.observer.drain().samples {
            let SampleOutcome::Sample(sample) = given.outcome else {
                panic!("{given:?}")
            };
            let number = sample.sequence_number.0;
            if depth == Depth::Payloads {
                let payload = sample.payload.as_ref().unwrap();
                let text = format!("hello {number}");
                assert!(payload[4..].starts_with(text.as_bytes()), "{sample:?}");
            }
            numbers.push(number);
        }
        numbers
    }
}

#[test]
fn a_sample_before_the_announcement_is_dispatched_once_when_repeated() {
    for depth in [Depth::Arrivals, Depth::Payloads] {
        let mut dora = Unannounced::new(depth);
        (1..=4).for_each(|number| dora.data(number));
        assert!(dora.given(depth).is_empty());
        dora.announce(true);
        dora.acknack(1);
        dora.data(5);
        // The subscriber gets the earlier samples first.
        assert!(dora.given(depth).is_empty());
        for number in [1, 2, 3, 4, 2, 5] {
            dora.data(number);
        }
        dora.data(6);
        assert_eq!(dora.given(depth), [1, 2, 3, 4, 5, 6], "{depth:?}");
        dora.acknack(7);
        dora.host.wait(15_000);
        assert!(dora.given(depth).is_empty());
        let measured = dora.host.measurement();
        assert_eq!((measured.messages, measured.duplicates), (6, 6));
    }
}

#[test]
fn a_subscription_reports_unannounced_samples_only_since_its_start() {
    let mut dora = Unannounced::new(Depth::Arrivals);
    (1..=3).for_each(|number| dora.data(number));
    sample_requests(&mut dora.host, &[1, 2], Depth::Arrivals);
    dora.data(4);
    dora.announce(false);
    dora.data(5);
    let given = dora.host.observer.drain().samples.into_iter();
    let mut reported: Vec<_> = given
        .filter_map(|given| match given.outcome {
            SampleOutcome::Missed(missed) => {
                Some((given.to.to_vec(), missed.first.0, missed.last.0))
            }
            SampleOutcome::Sample(_) => None,
        })
        .collect();
    reported.sort();
    assert_eq!(reported, [(vec![1], 1, 4), (vec![2], 4, 4)]);
}

#[test]
fn a_sample_that_precedes_the_announcement_is_unannounced_if_never_repeated() {
    for (reliable, acknowledged) in [(false, false), (true, false), (true, true)] {
        let mut dora = Unannounced::new(Depth::Payloads);
        for number in [1, 2, 4] {
            dora.data(number);
        }
        dora.announce(reliable);
        dora.data(5);
        if acknowledged {
            dora.acknack(6);
            assert_eq!(
                missed(&mut dora.host),
                [
                    (MissedReason::Unannounced, 1, 2),
                    (MissedReason::Unannounced, 4, 4)
                ]
            );
        } else {
            dora.host.wait(4_100);
            assert!(!numbers(&mut dora.host).is_empty(), "{reliable}");
            dora.data(6);
            dora.host.wait(10_000);
            dora.data(7);
        }
        if reliable && !acknowledged {
            let reported: Vec<_> = missed(&mut dora.host);
            assert_eq!(reported.len(), 2, "{reported:?}");
        }
        assert_eq!(dora.host.measurement().lost, 0);
    }
}

/// Messages in shared memory while uprobes take over from polling.
struct Handover {
    host: Host,
    alice: CapturePoint,
}

impl Handover {
    /// Starts with polled samples `1..=to`, 4 ms apart, of a writer without a waiting reader.
    fn new(depth: Depth, to: u64) -> Self {
        let mut host = Host::new();
        host.writer(false);
        let alice = host.reader(BOB, 7411);
        let mut handover = Self { host, alice };
        for number in 1..=to {
            handover.polled(number);
            handover.host.wait(4);
            if number == 1 {
                request(&mut handover.host, depth);
                handover.host.observer.drain();
            }
        }
        handover
    }

    fn polled(&mut self, number: u64) {
        self.put(number, flag::SHM);
    }

    fn seen_in_its_process(&mut self, number: u64) {
        self.put(number, flag::SHM | flag::EXACT);
    }

    fn put(&mut self, number: u64, flags: u16) {
        let record = self.host.record(self.alice, kind::DATA, number);
        self.host.put(Record {
            flags,
            socket: 0,
            ..record
        });
    }
}

#[test]
fn samples_keep_their_order_and_times_while_breakpoints_attach() {
    let mut handover = Handover::new(Depth::Arrivals, 2);
    dispatched(&mut handover.host);
    // Sample 3 was sent before the breakpoint was attached, and is polled after sample 4.
    handover.seen_in_its_process(4);
    handover.host.wait(1);
    handover.seen_in_its_process(5);
    assert_eq!(dispatched(&mut handover.host), []);
    handover.host.wait(1);
    handover.polled(3);
    handover.polled(4);
    // Of the two observations of sample 4, the first one counts. Times neither decrease nor jump to
    // a later one.
    assert_eq!(dispatched(&mut handover.host), [(3, 10), (4, 10), (5, 10)]);
    handover.host.wait(10);
    handover.seen_in_its_process(6);
    assert_eq!(dispatched(&mut handover.host), [(6, 20)]);
    assert_eq!(handover.host.measurement().messages, 6);
}

#[test]
fn samples_missed_while_breakpoints_attach_are_reported_once() {
    let mut handover = Handover::new(Depth::Arrivals, 2);
    dispatched(&mut handover.host);
    for number in [5, 6, 7] {
        handover.seen_in_its_process(number);
        handover.host.wait(4);
    }
    assert_eq!(dispatched(&mut handover.host), []);
    handover.host.wait(500);
    let (mut numbers, mut times, mut reported) = (Vec::new(), Vec::new(), Vec::new());
    for dispatch in handover.host.observer.drain().samples {
        match dispatch.outcome {
            SampleOutcome::Sample(sample) => {
                numbers.push(sample.sequence_number.0);
                times.push((sample.time.0 - START) / MILLISECOND);
            }
            SampleOutcome::Missed(missed) => {
                reported.push((missed.reason, missed.first.0, missed.last.0));
            }
        }
    }
    // No reader waits for the missing samples, so the others keep their own times.
    assert_eq!((numbers, times), (vec![5, 6, 7], vec![8, 12, 16]));
    assert_eq!(reported, [(MissedReason::NotCaptured, 3, 4)]);
    handover.host.wait(10_000);
    assert_eq!(missed(&mut handover.host), []);
    assert_eq!(handover.host.measurement().lost, 0);
}

#[test]
fn samples_sent_before_a_subscription_are_not_missing_from_it() {
    let mut handover = Handover::new(Depth::Arrivals, 1);
    // 2 to 7 were sent before the subscription, and polling missed them.
    handover.host.wait(600);
    handover.seen_in_its_process(8);
    handover.host.wait(4);
    handover.seen_in_its_process(9);
    handover.host.wait(1_000);
    let dispatches = handover.host.observer.drain().samples;
    let reported: Vec<_> = dispatches
        .iter()
        .filter(|dispatch| matches!(dispatch.outcome, SampleOutcome::Missed(_)))
        .collect();
    assert_eq!(dispatches.len() - reported.len(), 2, "{dispatches:?}");
    assert!(reported.is_empty(), "{reported:?}");
    // Samples after the start of the subscription are missing from it.
    handover.host.wait(20_000);
    handover.polled(12);
    handover.host.wait(1_000);
    assert_eq!(
        missed(&mut handover.host),
        [(MissedReason::NotCaptured, 10, 11)]
    );
}

#[test]
fn a_sample_polled_after_the_first_one_of_a_subscription_is_not_dispatched_to_it() {
    let mut handover = Handover::new(Depth::Arrivals, 1);
    handover.host.wait(600);
    for number in [8, 9] {
        handover.seen_in_its_process(number);
        handover.host.wait(500);
    }
    assert_eq!(numbers(&mut handover.host), [8, 9]);
    // A busy machine polls 7 only now.
    handover.polled(7);
    handover.seen_in_its_process(10);
    assert_eq!(numbers(&mut handover.host), [10]);
    handover.host.wait(1_000);
    assert_eq!(missed(&mut handover.host), []);
}

/// Returns the dispatched numbers, and first and last number of missing samples.
fn outcomes(host: &mut Host) -> (Vec<u64>, Vec<(u64, u64)>) {
    let (mut numbers, mut runs) = (Vec::new(), Vec::new());
    for dispatch in host.observer.drain().samples {
        match dispatch.outcome {
            SampleOutcome::Sample(sample) => numbers.push(sample.sequence_number.0),
            SampleOutcome::Missed(missed) => runs.push((missed.first.0, missed.last.0)),
        }
    }
    (numbers, runs)
}

#[test]
fn a_missed_sample_between_a_reported_one_and_the_first_one_is_reported() {
    let mut handover = Handover::new(Depth::Arrivals, 1);
    let alice = handover.alice;
    handover.host.wait(1_000);
    handover.host.heartbeat(alice, 1, 3);
    handover.host.wait(500);
    assert_eq!(outcomes(&mut handover.host), (vec![], vec![(2, 3)]));
    handover.host.heartbeat(alice, 1, 4);
    handover.polled(5);
    handover.host.wait(500);
    assert_eq!(outcomes(&mut handover.host), (vec![5], vec![(4, 4)]));
}

#[test]
fn a_missed_sample_after_one_without_its_payload_is_reported() {
    let mut handover = Handover::new(Depth::Payloads, 1);
    let alice = handover.alice;
    let polled = |host: &mut Host, message: Message| {
        let envelope = forge::multicast(host.now, 0);
        host.observer.input(Input::SharedMemory {
            envelope: &envelope,
            payload: &message.bytes(),
        });
    };
    let payload = [[0, 1, 0, 0].as_slice(), &[7; 2_000]].concat();
    handover.host.wait(500);
    // Polling saw only the last fragment.
    let last = Message::from(ALICE).fragment(WRITER, 2, 2, 1_500, &payload);
    polled(&mut handover.host, last);
    assert_eq!(outcomes(&mut handover.host), (vec![], vec![(2, 2)]));
    handover.host.heartbeat(alice, 1, 3);
    let whole = Message::from(ALICE).data(WRITER, 4, &payload);
    polled(&mut handover.host, whole);
    handover.host.wait(500);
    assert_eq!(outcomes(&mut handover.host), (vec![4], vec![(3, 3)]));
}

#[test]
fn a_recording_names_the_first_missed_samples_of_a_writer_that_appears_during_it() {
    let mut host = Host::new();
    request(&mut host, Depth::Arrivals);
    host.wait(5_000);
    let bob = GuidPrefix(*b"\x01\x10bobby-host");
    host.participant(bob, "10.0.0.1:7415".parse().unwrap());
    let payload = forge::endpoint(Guid::new(bob, WRITER), "rt/chatter", STRING, false);
    host.announce(Message::from(bob).data(forge::SEDP_WRITERS, 1, &payload));
    let polled = |host: &mut Host, number: u64| {
        let message = Message::from(bob).data(WRITER, number, &[0, 1, 0, 0, 7, 7, 7, 7]);
        let envelope = forge::multicast(host.now, 0);
        host.observer.input(Input::SharedMemory {
            envelope: &envelope,
            payload: &message.bytes(),
        });
    };
    host.wait(100);
    polled(&mut host, 1);
    host.wait(10);
    polled(&mut host, 4);
    host.wait(1_000);
    assert_eq!(outcomes(&mut host), (vec![1, 4], vec![(2, 3)]));
}

#[test]
fn a_clock_is_not_ahead_of_samples_that_are_not_decided() {
    let mut handover = Handover::new(Depth::Arrivals, 1);
    let alice = handover.alice;
    let host = &mut handover.host;
    host.wait(1_950);
    let noticed = host.now;
    host.heartbeat(alice, 1, 2);
    let mut reported = Vec::new();
    while reported.is_empty() {
        let now = Timestamp(host.now);
        assert!(host.observer.dispatched_until(now).0 <= noticed);
        host.wait(50);
        reported = missed(host);
    }
    assert_eq!(reported, [(MissedReason::NotCaptured, 2, 2)]);
    let now = Timestamp(host.now);
    assert_eq!(host.observer.dispatched_until(now), now);
}

#[test]
fn a_restart_that_a_heartbeat_confirms_dispatches_the_new_samples() {
    let (mut host, bob) = listening();
    host.acknack(bob, 500);
    for number in [500, 502] {
        host.data(bob, number);
        host.wait(10);
    }
    assert_eq!(numbers(&mut host), [500]);
    host.wait(500);
    host.data(bob, 1);
    host.wait(10);
    host.heartbeat(bob, 1, 1);
    host.wait(10);
    for number in 2..=4 {
        host.data(bob, number);
        host.wait(10);
    }
    let mut numbers = numbers(&mut host);
    numbers.retain(|number| *number != 502);
    assert_eq!(numbers, [1, 2, 3, 4]);
}

#[test]
fn a_complete_clock_waits_for_samples_that_wait_for_a_repetition() {
    let (mut host, bob) = listening();
    for number in [1, 2, 4] {
        host.wait(10);
        host.data(bob, number);
    }
    let waiting = host.now;
    host.wait(1_000);
    let now = Timestamp(host.now);
    assert_eq!(host.observer.dispatched_until(now), now);
    assert_eq!(host.observer.complete_until(now), Timestamp(waiting));
    host.data(bob, 3);
    assert_eq!(host.observer.complete_until(now), now);
    assert_eq!(numbers(&mut host), [1, 2, 3, 4]);
}

#[test]
fn waiting_samples_are_dispatched_and_unseen_ones_reported_when_the_agent_stops() {
    let (mut host, bob) = listening();
    for number in [1, 3] {
        host.wait(10);
        host.data(bob, number);
    }
    host.observer.input(Input::Stopping);
    assert_eq!(outcomes(&mut host), (vec![1, 3], vec![]));
    assert_eq!(host.measurement().lost, 0);

    let mut handover = Handover::new(Depth::Arrivals, 1);
    let alice = handover.alice;
    handover.host.wait(1_000);
    handover.host.heartbeat(alice, 1, 3);
    handover.host.observer.input(Input::Stopping);
    assert_eq!(outcomes(&mut handover.host), (vec![], vec![(2, 3)]));
}
