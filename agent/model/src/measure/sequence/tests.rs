use std::time::Duration;

use ros2probe_wire::Timestamp;

use super::*;
use ros2probe_wire::time::SECOND;

/// A sequence with virtual time, and lists of its decisions.
#[derive(Default)]
struct Bench {
    sequence: Sequence,
    now: u64,
    recovered: Vec<u64>,
    duplicates: Vec<u64>,
    lost: Vec<u64>,
    irrelevant: Vec<u64>,
}

impl Bench {
    fn receive(&mut self, numbers: impl IntoIterator<Item = u64>) -> &mut Self {
        for number in numbers {
            self.now += SECOND / 1000;
            self.receive_at(number, None);
        }
        self
    }

    fn receive_at(&mut self, number: u64, source: Option<u64>) {
        let number = SequenceNumber(number);
        let (lost, irrelevant) = (&mut self.lost, &mut self.irrelevant);
        let (source, now) = (source.map(Timestamp), ModelTime::from_nanoseconds(self.now));
        match self
            .sequence
            .recognise(number, source, MAX_TRUSTED_JUMP, now)
        {
            RunMembership::Live => {}
            RunMembership::Unconfirmed { .. } => {
                if !self.sequence.complete_unconfirmed(number) {
                    self.duplicates.push(number.0);
                }
                return;
            }
            RunMembership::Confirmed(run) => self.sequence.accept(&run, now, &mut |settled| {
                note(settled, lost, irrelevant);
            }),
        }
        let arrival = self.sequence.receive(
            number,
            RepairMode::Reliable,
            ModelTime::from_nanoseconds(self.now),
            &mut |settled| note(settled, lost, irrelevant),
        );
        match arrival {
            Arrival::New {
                recovered: true, ..
            } => self.recovered.push(number.0),
            Arrival::New { .. } => {}
            Arrival::Duplicate => self.duplicates.push(number.0),
        }
    }

    fn heartbeat(&mut self, first: u64, last: u64) -> &mut Self {
        let (lost, irrelevant) = (&mut self.lost, &mut self.irrelevant);
        let mut note = |settled| note(settled, lost, irrelevant);
        self.sequence.heartbeat(
            SequenceNumber(first),
            SequenceNumber(last),
            ModelTime::from_nanoseconds(self.now),
            &mut note,
        );
        self
    }

    fn wait(&mut self, seconds: u64) -> &mut Self {
        let end = self.now + seconds * SECOND;
        while self.now < end {
            self.now += SECOND / 10;
            let (lost, irrelevant) = (&mut self.lost, &mut self.irrelevant);
            self.sequence.advance(
                ModelTime::from_nanoseconds(self.now),
                (Duration::from_secs(1), Duration::from_secs(1)),
                None,
                &mut |settled| {
                    note(settled, lost, irrelevant);
                },
            );
        }
        self
    }
}

fn note(settled: Settled, lost: &mut Vec<u64>, irrelevant: &mut Vec<u64>) {
    match settled {
        Settled::Lost(number) => lost.push(number.0),
        Settled::LostRun(start, end) => lost.extend(start.0..end.0),
        Settled::Irrelevant(number) => irrelevant.push(number.0),
    }
}

#[test]
fn reordered_samples_are_neither_lost_nor_recovered() {
    let mut bench = Bench::default();
    bench.receive([1, 2, 4, 3, 5]).wait(5);
    assert_eq!(
        (
            bench.lost.len(),
            bench.recovered.len(),
            bench.duplicates.len()
        ),
        (0, 0, 0)
    );
}

#[test]
fn a_gap_counts_as_lost_only_once_after_the_settle_window() {
    let mut bench = Bench::default();
    bench.receive([1, 2, 5]);
    assert!(bench.lost.is_empty());
    bench.wait(3);
    assert_eq!(bench.lost, [3, 4]);
    bench.wait(5);
    assert_eq!(bench.lost, [3, 4]);
}

#[test]
fn a_retransmission_recovers_a_missing_sample() {
    let mut bench = Bench::default();
    bench.receive([1, 2, 4]);
    bench.now += SECOND / 5;
    bench.receive([3]).wait(5);
    assert_eq!(
        (bench.lost.as_slice(), bench.recovered.as_slice()),
        (&[][..], &[3][..])
    );
}

#[test]
fn a_fast_retransmission_on_request_counts_as_recovered() {
    let mut bench = Bench::default();
    bench.receive([1, 2, 4]);
    bench
        .sequence
        .requested([3].map(SequenceNumber).into_iter());
    bench.receive([3]);
    assert_eq!(bench.recovered, [3]);
}

#[test]
fn numbers_before_the_first_observed_sample_are_not_lost() {
    let mut bench = Bench::default();
    bench.receive([385, 386]).wait(5);
    assert!(bench.lost.is_empty());
}

#[test]
fn a_gap_marks_numbers_irrelevant_and_a_heartbeat_does_not() {
    let mut bench = Bench::default();
    bench.receive([1, 4, 7, 9]);
    bench.sequence.gap(
        SequenceNumber(2),
        SequenceNumber(4),
        [].into_iter(),
        ModelTime::from_nanoseconds(bench.now),
        &mut |_| {},
    );
    bench.heartbeat(7, 9).wait(3);
    assert_eq!(
        (bench.irrelevant.as_slice(), bench.lost.as_slice()),
        (&[2, 3][..], &[5, 6, 8][..])
    );
}

#[test]
fn a_missing_number_has_a_source_time_between_those_of_its_neighbours() {
    let mut bench = Bench::default();
    for number in [1, 2, 5] {
        bench.now = number * SECOND;
        bench.receive_at(number, Some(number * SECOND));
    }
    bench.heartbeat(1, 6);
    let around = |bench: &Bench, start, end| {
        let (start, end) = (SequenceNumber(start), SequenceNumber(end));
        let source = bench.sequence.source_around(start, end);
        source.map(|source| source.0)
    };
    let of_3 = around(&bench, 1, 10).unwrap();
    assert!(2 * SECOND < of_3 && of_3 < 5 * SECOND, "{of_3}");
    // The HEARTBEAT revealed the number, so the last sample is the one before.
    assert_eq!(around(&bench, 6, 7), Some(5 * SECOND));
    assert_eq!(around(&bench, 5, 6), None);
    bench.sequence.gap(
        SequenceNumber(3),
        SequenceNumber(5),
        [].into_iter(),
        ModelTime::from_nanoseconds(bench.now),
        &mut |_| {},
    );
    assert_eq!(around(&bench, 1, 6), None);
}

#[test]
fn acknowledged_samples_are_lost_only_if_the_writer_had_withdrawn_them() {
    let mut bench = Bench::default();
    bench.receive([1, 4]);
    bench.sequence.acknowledged(SequenceNumber(4));
    bench.heartbeat(4, 4).receive([7]);
    bench.heartbeat(7, 7);
    bench.sequence.acknowledged(SequenceNumber(8));
    bench.wait(3);
    assert_eq!(
        (bench.irrelevant.as_slice(), bench.lost.as_slice()),
        (&[2, 3][..], &[5, 6][..])
    );
}

#[test]
fn samples_that_one_heartbeat_announces_and_withdraws_are_lost() {
    let mut bench = Bench::default();
    bench.receive([1, 2]).heartbeat(6, 6).wait(3);
    assert_eq!(bench.lost, [3, 4, 5, 6]);
}

#[test]
fn withdrawn_samples_are_decided_after_the_grace_period() {
    let mut bench = Bench::default();
    bench.receive([1, 4, 6]).heartbeat(4, 6);
    let mut lost = Vec::new();
    for (after, decided) in [(SECOND - 1, &[][..]), (SECOND, &[2, 3])] {
        let now = ModelTime::from_nanoseconds(bench.now + after);
        let windows = (Duration::from_secs(10), Duration::from_secs(1));
        let mut note = |settled| note(settled, &mut lost, &mut Vec::new());
        bench.sequence.advance(now, windows, None, &mut note);
        assert_eq!(lost, decided);
    }
}

#[test]
fn a_gap_ahead_of_the_data_marks_no_later_sample_irrelevant() {
    let mut bench = Bench::default();
    bench.receive([1]);
    bench.sequence.gap(
        SequenceNumber(2),
        SequenceNumber(4),
        [SequenceNumber(4)].into_iter(),
        ModelTime::from_nanoseconds(bench.now),
        &mut |_| {},
    );
    bench.receive([3, 5]).wait(3);
    assert_eq!(
        (bench.irrelevant.as_slice(), bench.lost.len()),
        (&[2, 4][..], 0)
    );
    assert!(bench.duplicates.is_empty());
}

#[test]
fn a_heartbeat_reveals_that_the_last_sample_of_a_burst_is_lost() {
    let mut bench = Bench::default();
    bench.receive([1, 2]);
    bench.sequence.heartbeat(
        SequenceNumber(1),
        SequenceNumber(3),
        ModelTime::from_nanoseconds(bench.now),
        &mut |_| {},
    );
    bench.wait(3);
    assert_eq!(bench.lost, [3]);
}

#[test]
fn forged_heartbeats_and_gaps_cause_no_losses() {
    let mut bench = Bench::default();
    bench.receive([1, 2]);
    let now = ModelTime::from_nanoseconds(bench.now);
    for (first, last) in [(1, u64::MAX), (0, 5), (9, 3), (u64::MAX, u64::MAX)] {
        bench.sequence.heartbeat(
            SequenceNumber(first),
            SequenceNumber(last),
            now,
            &mut |_| {},
        );
    }
    bench.sequence.gap(
        SequenceNumber(1),
        SequenceNumber(u64::MAX),
        [SequenceNumber(u64::MAX)].into_iter(),
        now,
        &mut |_| {},
    );
    bench.sequence.gap(
        SequenceNumber(0),
        SequenceNumber(0),
        [].into_iter(),
        now,
        &mut |_| {},
    );
    bench.receive([3, 4]).wait(3);
    assert!(bench.lost.is_empty());
}

#[test]
fn a_restart_under_the_same_guid_begins_a_new_incarnation() {
    let mut bench = Bench::default();
    for number in 1..=100 {
        bench.now += SECOND / 100;
        bench.receive_at(number, Some(bench.now));
    }
    bench.wait(3);
    for number in 1..=50 {
        bench.now += SECOND / 100;
        bench.receive_at(number, Some(bench.now));
    }
    bench.wait(3);
    assert!(bench.duplicates.is_empty() && bench.lost.is_empty());
}

#[test]
fn history_for_a_late_joiner_counts_as_duplicates() {
    let mut bench = Bench::default();
    for number in 1..=100 {
        bench.now += SECOND / 100;
        bench.receive_at(number, Some(number * SECOND / 100));
    }
    for number in 60..=100 {
        bench.receive_at(number, Some(number * SECOND / 100));
    }
    assert_eq!(bench.duplicates.len(), 41);
}

#[test]
fn a_forged_jump_causes_no_losses() {
    let mut bench = Bench::default();
    bench.receive([1, 2, u64::MAX >> 1, 1 << 40]).wait(3);
    assert!(bench.lost.is_empty());
    let mut numbers = 3..;
    bench.receive(numbers.by_ref().take(2000)).wait(3);
    assert!(bench.lost.is_empty());
    assert!(bench.duplicates.is_empty());
}

#[test]
fn a_fragment_with_an_invalid_sequence_number_causes_no_losses() {
    for number in [(u64::MAX >> 1) + 1, u64::MAX - 1, u64::MAX] {
        let mut bench = Bench::default();
        bench.receive([1, 2]);
        let mut decided = 0;
        let now = ModelTime::from_nanoseconds(bench.now);
        bench
            .sequence
            .exists(SequenceNumber(number), now, &mut |_| decided += 1);
        assert_eq!((decided, bench.sequence.next().0), (0, 3));
        bench.receive([3]).wait(3);
        assert!(bench.lost.is_empty() && bench.duplicates.is_empty());
    }
}

#[test]
fn a_jump_beyond_the_window_decides_the_skipped_numbers() {
    let mut bench = Bench::default();
    bench.receive((1..10).chain(200_000..200_010));
    bench.wait(3);
    assert_eq!(bench.lost.len(), 199_990);
    assert!(bench.duplicates.is_empty());
    assert!(bench.sequence.received.len() <= MAX_WINDOW);
}

#[test]
fn batches_after_a_long_gap_lose_only_the_numbers_of_the_gap() {
    let mut bench = Bench::default();
    bench.receive(1..=100);
    for batch in 0..8 {
        // All samples of a batch have one time.
        bench.now += SECOND / 100;
        for number in 0..100 {
            bench.receive_at(1101 + batch * 100 + number, None);
        }
    }
    bench.wait(3);
    assert_eq!(bench.lost, (101..=1100).collect::<Vec<_>>());
    assert!(bench.duplicates.is_empty());
}

#[test]
fn a_sample_that_arrives_after_settling_counts_once() {
    let mut bench = Bench::default();
    bench.receive([1, 3]).wait(3);
    bench.receive([2, 2]);
    assert_eq!(
        (bench.lost.as_slice(), bench.recovered.as_slice()),
        (&[2][..], &[2][..])
    );
    assert_eq!(bench.duplicates, [2]);
}

#[test]
fn bitmap_ranges_are_set_and_cleared_exactly_across_the_end() {
    for (start, end) in [
        (0, 0),
        (5, 6),
        (60, 70),
        (64, 128),
        (100, 300),
        (1000, 1255),
        (1000, 1256),
        (1000, 5000),
    ] {
        let mut bits = Bitmap::with_len(256);
        bits.set_all(SequenceNumber(start), SequenceNumber(end));
        let is_within = |number: u64| {
            let number = start + (number.wrapping_sub(start) & 255);
            (start..end).contains(&number)
        };
        for number in 1000..1256 {
            assert_eq!(
                bits.get(SequenceNumber(number)),
                is_within(number),
                "{start} {end} {number}"
            );
        }
        bits.set_all(SequenceNumber(0), SequenceNumber(256));
        bits.clear(SequenceNumber(start), SequenceNumber(end));
        for number in 1000..1256 {
            assert_eq!(
                bits.get(SequenceNumber(number)),
                !is_within(number),
                "{start} {end} {number}"
            );
        }
    }
}

#[test]
fn checkpoints_stay_bounded_while_an_unfinished_sample_holds_later_numbers_open() {
    let mut sequence = Sequence::default();
    let mut lost = 0;
    let mut count = |settled| lost += u64::from(matches!(settled, Settled::Lost(_)));
    for step in 1..10_000_u64 {
        let now = ModelTime::from_nanoseconds(step * SECOND / 10);
        sequence.receive(
            SequenceNumber(2 * step),
            RepairMode::BestEffort,
            now,
            &mut count,
        );
        sequence.advance(
            now,
            (Duration::from_secs(1), Duration::from_secs(1)),
            Some(SequenceNumber(100)),
            &mut count,
        );
        assert!(!sequence.checkpoints.is_full());
    }
    let end = ModelTime::from_nanoseconds(2000 * SECOND);
    sequence.advance(
        end,
        (Duration::from_secs(1), Duration::from_secs(1)),
        None,
        &mut count,
    );
    assert_eq!(lost, 9_998);
}
