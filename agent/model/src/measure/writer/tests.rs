use ros2probe_wire::Record;
use ros2probe_wire::record::{flag, kind};
use ros2probe_wire::time::{MILLISECOND, SECOND};

use super::*;
use crate::facts::observation::tests::{observed, sample};

const START: u64 = 1_795_143_000 * SECOND;

/// A writer with its context, in virtual time.
struct Bench {
    writer: Writer,
    budget: Budget,
    journal: Journal,
    now: u64,
    opened: ModelTime,
}

impl Bench {
    fn new(traits: Traits) -> Self {
        Self {
            writer: Writer::new(Guid::default(), traits),
            budget: Budget::new(1 << 20),
            journal: Journal::default(),
            now: START,
            opened: ModelTime::ZERO,
        }
    }

    fn put(&mut self, record: Record) -> &mut Self {
        self.take(record);
        self
    }

    /// Processes a record as [`Self::put`] does, and returns the completed message.
    fn take(&mut self, record: Record) -> Option<Counted> {
        let observation = observed(&Record {
            time: self.now,
            ..record
        });
        let mut context = MeasurementContext {
            now: ModelTime::from_nanoseconds(self.now),
            budget: &mut self.budget,
            journal: &mut self.journal,
            wall_clock: WallClock::default(),
            has_receivers: false,
        };
        (self.writer).observe(&observation, self.opened, &mut context)
    }

    fn data(&mut self, number: u64) -> &mut Self {
        self.put(data(number))
    }

    fn fragments(&mut self, number: u64, range: std::ops::RangeInclusive<u32>) -> &mut Self {
        for start in range {
            self.put(fragment(number, start));
        }
        self
    }

    fn wait(&mut self, milliseconds: u64) -> &mut Self {
        let end = self.now + milliseconds * MILLISECOND;
        while self.now < end {
            self.now = (self.now + 100 * MILLISECOND).min(end);
            let mut context = MeasurementContext {
                now: ModelTime::from_nanoseconds(self.now),
                budget: &mut self.budget,
                journal: &mut self.journal,
                wall_clock: WallClock::default(),
                has_receivers: false,
            };
            self.writer.advance(&mut context);
        }
        self
    }

    fn facts(&self) -> Measurement {
        self.writer
            .measurement(ModelTime::from_nanoseconds(self.now))
    }
}

const RELIABLE: Traits = Traits {
    reliable: true,
    keeps_history: false,
    has_header: false,
};

fn data(number: u64) -> Record {
    Record {
        kind: kind::DATA,
        submessage_flags: 5,
        sequence_number: number,
        payload_len: 100,
        ..Record::default()
    }
}

fn heartbeat(first: u64, last: u32) -> Record {
    Record {
        kind: kind::HEARTBEAT,
        sequence_number: first,
        encapsulation: last,
        ..Record::default()
    }
}

/// Returns a record of a sample in ten fragments.
fn fragment(number: u64, start: u32) -> Record {
    Record {
        kind: kind::DATA_FRAG,
        submessage_flags: 1,
        sequence_number: number,
        fragment_start: start,
        fragments: 1 << 16 | 1000,
        sample_size: 9500,
        payload_len: 1000,
        ..Record::default()
    }
}

#[test]
fn a_sample_seen_on_several_interfaces_counts_once() {
    let mut bench = Bench::new(Traits::default());
    bench.data(1).data(1).data(2).data(2).data(1);
    let facts = bench.facts();
    assert_eq!((facts.messages, facts.bytes, facts.duplicates), (2, 200, 3));
}

#[test]
fn a_late_retransmitted_fragment_does_not_reopen_a_finished_sample() {
    let mut bench = Bench::new(RELIABLE);
    bench.fragments(1, 1..=10).wait(1000);
    for _ in 0..1000 {
        bench.fragments(1, 3..=4);
    }
    let facts = bench.facts();
    assert_eq!(
        (facts.messages, facts.bytes, facts.duplicates),
        (1, 9500, 2000)
    );
    assert_eq!((bench.budget.bytes, bench.budget.samples), (0, 0));
}

#[test]
fn an_incomplete_sample_is_lost_although_its_number_was_seen() {
    let mut bench = Bench::new(Traits::default());
    bench
        .fragments(1, 1..=10)
        .fragments(2, 1..=9)
        .fragments(3, 1..=10)
        .wait(5000);
    let facts = bench.facts();
    assert_eq!((facts.messages, facts.lost, facts.incomplete), (2, 1, 1));
    assert_eq!(
        bench
            .journal
            .losses()
            .map(|loss| loss.first.0)
            .collect::<Vec<_>>(),
        [2]
    );
    assert_eq!(bench.budget.samples, 0);
}

#[test]
fn missing_fragments_from_before_the_kernel_knew_the_writer_cause_no_loss() {
    let mut bench = Bench::new(Traits::default());
    bench
        .writer
        .allow_incomplete(ModelTime::from_nanoseconds(bench.now + 200 * MILLISECOND));
    bench.fragments(1, 1..=4).fragments(1, 8..=10).wait(300);
    bench.fragments(2, 1..=9).fragments(3, 1..=10).wait(5000);
    let facts = bench.facts();
    assert_eq!((facts.messages, facts.lost, facts.incomplete), (1, 1, 1));
    assert_eq!(facts.irrelevant, 1);
    assert_eq!(
        bench.journal.losses().next().map(|loss| loss.first.0),
        Some(2)
    );
    assert_eq!((bench.budget.bytes, bench.budget.samples), (0, 0));
}

#[test]
fn an_incomplete_last_sample_is_lost() {
    let mut bench = Bench::new(Traits::default());
    bench.fragments(1, 1..=10).fragments(2, 2..=10).wait(5000);
    assert_eq!(bench.facts().lost, 1);
}

#[test]
fn a_slow_fragmented_sample_is_not_settled_while_fragments_arrive() {
    let mut bench = Bench::new(Traits::default());
    bench.data(1);
    for start in 1..=10 {
        bench.fragments(2, start..=start).wait(700);
    }
    let facts = bench.facts();
    assert_eq!((facts.messages, facts.lost), (2, 0));
}

#[test]
fn a_first_sample_without_its_first_fragments_is_not_lost() {
    let mut bench = Bench::new(Traits::default());
    bench.fragments(7, 4..=10).fragments(8, 1..=10).wait(5000);
    let facts = bench.facts();
    assert_eq!((facts.messages, facts.lost, facts.incomplete), (1, 0, 0));
}

#[test]
fn sample_number_1_without_its_first_fragment_is_lost() {
    let mut bench = Bench::new(Traits::default());
    bench.fragments(1, 2..=10).fragments(2, 1..=10).wait(5000);
    let facts = bench.facts();
    assert_eq!((facts.messages, facts.lost, facts.incomplete), (1, 1, 1));
}

#[test]
fn a_sample_of_too_many_fragments_is_neither_counted_nor_lost() {
    let mut bench = Bench::new(Traits::default());
    bench.data(1);
    bench.put(Record {
        fragments: 1 << 16 | 8,
        sample_size: u32::MAX,
        ..fragment(2, 1)
    });
    bench.data(3).wait(5000);
    let facts = bench.facts();
    assert_eq!((facts.messages, facts.lost, facts.irrelevant), (2, 0, 1));
}

#[test]
fn a_sample_with_a_retransmitted_fragment_counts_as_recovered() {
    let mut bench = Bench::new(RELIABLE);
    bench
        .fragments(1, 1..=4)
        .fragments(1, 6..=10)
        .wait(50)
        .fragments(1, 5..=5);
    assert_eq!((bench.facts().messages, bench.facts().recovered), (1, 1));
}

#[test]
fn gaps_of_a_reliable_writer_stay_open_for_retransmissions() {
    let mut bench = Bench::new(RELIABLE);
    bench.data(1).data(3).wait(8000).data(2).wait(12_000);
    let facts = bench.facts();
    assert_eq!((facts.messages, facts.lost, facts.recovered), (3, 0, 1));
}

#[test]
fn an_unannounced_writer_that_sends_heartbeats_is_reliable() {
    let mut bench = Bench::new(Traits::default());
    bench.data(1).data(3);
    bench.put(heartbeat(1, 3)).wait(5000);
    assert_eq!(bench.facts().lost, 0);
    bench.wait(7000);
    assert_eq!(bench.facts().lost, 1);
}

#[test]
fn disposals_have_sequence_numbers_but_do_not_count_as_messages() {
    let mut bench = Bench::new(Traits::default());
    bench.data(1);
    bench.put(Record {
        status_info: 3,
        submessage_flags: 0x09,
        ..data(2)
    });
    bench.data(3).wait(5000);
    assert_eq!((bench.facts().messages, bench.facts().lost), (2, 0));
}

#[test]
fn negative_delays_are_counted_but_not_observed_as_latencies() {
    let mut bench = Bench::new(Traits {
        has_header: true,
        ..Traits::default()
    });
    let at = |nanoseconds: u64| (nanoseconds / SECOND) << 32;
    bench.put(Record {
        source_timestamp: at(START + 2 * SECOND),
        ..data(1)
    });
    bench.put(Record {
        source_timestamp: at(START - 2 * SECOND),
        ..data(2)
    });
    let facts = bench.facts();
    assert_eq!(
        (facts.negative_latency, facts.source_latency.count()),
        (1, 1)
    );
    assert_eq!(facts.source_latency.range(), Some((2.0, 2.0)));
}

#[test]
fn history_for_a_late_joiner_does_not_count_as_latency() {
    let mut bench = Bench::new(Traits {
        keeps_history: true,
        ..RELIABLE
    });
    let old = ((START - 3600 * SECOND) / SECOND) << 32;
    bench.put(Record {
        source_timestamp: old,
        ..data(1)
    });
    assert_eq!(
        (bench.facts().messages, bench.facts().source_latency.count()),
        (1, 0)
    );
}

#[test]
fn history_for_a_new_reader_has_neither_latency_nor_rate() {
    for depth in [10, 100] {
        let mut bench = Bench::new(Traits {
            keeps_history: true,
            ..RELIABLE
        });
        bench.opened = ModelTime::from_nanoseconds(bench.now);
        bench.now += 20 * MILLISECOND;
        // The youngest sample is a tenth of a second older than the reader.
        for number in 1..=depth {
            let sent = START - (depth + 1 - number) * SECOND / 10;
            bench.now += MILLISECOND / 2;
            bench.put(Record {
                source_timestamp: stamp(sent),
                ..data(number)
            });
        }
        bench.wait(2000);
        let facts = bench.facts();
        assert_eq!((facts.messages, facts.source_latency.count()), (depth, 0));
        assert!(facts.rate_hz.abs() < 1e-9, "{}", facts.rate_hz);
        for number in depth + 1..=depth + 100 {
            bench.now += SECOND / 10;
            bench.put(Record {
                source_timestamp: stamp(bench.now - MILLISECOND),
                ..data(number)
            });
        }
        let facts = bench.facts();
        assert_eq!(facts.source_latency.count(), 100);
        let (_, longest) = facts.source_latency.range().unwrap();
        assert!(longest < 0.002, "{longest}");
    }
}

#[test]
fn messages_of_a_host_whose_clock_is_behind_are_not_history() {
    let mut bench = Bench::new(Traits {
        keeps_history: true,
        ..RELIABLE
    });
    bench.opened = ModelTime::from_nanoseconds(bench.now);
    for number in 1..=150 {
        bench.now += SECOND / 10;
        bench.put(Record {
            source_timestamp: stamp(bench.now - 3600 * SECOND),
            ..data(number)
        });
    }
    let rate = bench.facts().rate_hz;
    assert!((rate - 10.0).abs() < 0.2, "{rate}");
}

/// Returns this time as INFO_TS has it.
fn stamp(nanoseconds: u64) -> u64 {
    let (seconds, rest) = (nanoseconds / SECOND, nanoseconds % SECOND);
    (seconds << 32) | ((rest << 32) / SECOND)
}

#[test]
fn intervals_between_messages_are_measured_exactly() {
    let mut bench = Bench::new(Traits::default());
    for number in 1..=201 {
        bench.data(number);
        bench.now += 5 * MILLISECOND;
    }
    let facts = bench.facts();
    assert_eq!(facts.interarrival.count(), 200);
    assert_eq!(facts.interarrival.range(), Some((0.005, 0.005)));
}

#[test]
fn samples_sent_to_other_hosts_before_a_local_reader_existed_are_not_lost() {
    let mut bench = Bench::new(Traits::default());
    bench.data(1).data(2).wait(60_000);
    bench.opened = ModelTime::from_nanoseconds(bench.now);
    for number in 500..=504 {
        bench.now += MILLISECOND;
        bench.data(number);
    }
    bench.wait(5000);
    let facts = bench.facts();
    assert_eq!((facts.messages, facts.lost, facts.irrelevant), (7, 0, 497));
}

#[test]
fn a_hundred_thousand_samples_without_a_reader_are_not_lost() {
    let mut bench = Bench::new(Traits::default());
    for number in 1..=100 {
        bench.now += MILLISECOND;
        bench.data(number);
    }
    bench.wait(100_000);
    bench.opened = ModelTime::from_nanoseconds(bench.now);
    for number in 100_101..=100_200 {
        bench.now += MILLISECOND;
        bench.data(number);
    }
    bench.wait(5000);
    let facts = bench.facts();
    assert_eq!((facts.messages, facts.lost, facts.duplicates), (200, 0, 0));
}

#[test]
fn messages_at_200_hz_have_a_rate_of_200_hz() {
    let mut bench = Bench::new(Traits::default());
    bench.now += 1234;
    for number in 1..=200 * 15 {
        bench.data(number);
        bench.now += 5 * MILLISECOND;
    }
    let facts = bench.facts();
    assert!((facts.rate_hz - 200.0).abs() < 1e-9, "{}", facts.rate_hz);
    assert!((facts.bandwidth - 20_000.0).abs() < 1e-6);
}

#[test]
fn an_idle_writer_needs_at_most_1400_bytes() {
    assert!(size_of::<Writer>() <= 1400, "{}", size_of::<Writer>());
}

fn in_shared_memory(record: Record) -> Record {
    Record {
        flags: flag::SHM,
        ..record
    }
}

#[test]
fn in_shared_memory_unseen_numbers_count_as_messages_and_not_as_losses() {
    let mut bench = Bench::new(RELIABLE);
    for number in [1, 2, 5, 9] {
        bench.put(in_shared_memory(data(number))).wait(10);
    }
    bench.wait(60_000);
    let facts = bench.facts();
    assert_eq!((facts.messages, facts.bytes, facts.lost), (9, 900, 0));
    assert_eq!((facts.irrelevant, facts.duplicates), (0, 0));
    let sampled = facts.sampled.unwrap();
    assert_eq!((sampled.seen, sampled.span), (4, 9));
    // Only the interval between 1 and 2 counts.
    assert_eq!(facts.interarrival.count(), 1);
}

#[test]
fn a_message_that_only_a_heartbeat_announces_counts_as_the_last_message() {
    let mut bench = Bench::new(RELIABLE);
    bench.put(in_shared_memory(data(1))).wait(1000);
    bench.put(in_shared_memory(heartbeat(1, 2)));
    assert_eq!(
        bench.writer.last_message(),
        Some(ModelTime::from_nanoseconds(bench.now))
    );
    let reported = bench.now;
    bench.wait(1000);
    bench.put(in_shared_memory(heartbeat(1, 2)));
    assert_eq!(
        bench.writer.last_message(),
        Some(ModelTime::from_nanoseconds(reported))
    );
}

#[test]
fn missed_polls_extend_the_possible_silence_of_a_writer() {
    let slowest = Duration::from_secs(2);
    let silence_of = |seen: &dyn Fn(u64) -> bool| {
        let mut bench = Bench::new(RELIABLE);
        for number in (1..=100).filter(|number| seen(*number)) {
            bench.now = START + number * SECOND;
            bench.put(in_shared_memory(data(number)));
        }
        bench.writer.max_unseen_time(slowest).as_secs_f64()
    };
    // The interval is one second. A missed message may be followed by others, unless misses were
    // always single.
    let all = silence_of(&|_| true);
    let most = silence_of(&|number| number % 4 > 0);
    let half = silence_of(&|number| number % 2 == 0);
    assert!((93.0..95.0).contains(&all), "{all}");
    assert!((10.0..11.0).contains(&most), "{most}");
    assert!((10.0..11.0).contains(&half), "{half}");
    // After one message, nothing is known.
    let one = silence_of(&|number| number == 1);
    assert!(one > 200.0, "{one}");
    let mut bench = Bench::new(RELIABLE);
    bench.data(1).wait(1000).data(2);
    assert_eq!(bench.writer.max_unseen_time(slowest), Duration::ZERO);
}

#[test]
fn messages_sent_while_shared_memory_was_not_polled_cause_no_rate_spike() {
    let mut bench = Bench::new(RELIABLE);
    let mut number = 1;
    let send = |bench: &mut Bench, number: &mut u64, count: u64, is_polled: bool| {
        for _ in 0..count {
            if is_polled {
                bench.put(in_shared_memory(data(*number)));
            }
            *number += 1;
            bench.wait(20);
        }
    };
    send(&mut bench, &mut number, 10, true);
    // 50 Hz: 14 s pass until the topic is requested.
    send(&mut bench, &mut number, 700, false);
    for second in 0..15 {
        send(&mut bench, &mut number, 50, true);
        let facts = bench.facts();
        assert!(
            (facts.rate_hz - 50.0).abs() < 0.5,
            "{second}: {}",
            facts.rate_hz
        );
        assert!((facts.bandwidth - 5000.0).abs() < 50.0, "{second}");
        // All but the last second of that time counts as earlier.
        assert!((600..=690).contains(&facts.earlier.messages), "{facts:?}");
    }
    let facts = bench.facts();
    assert_eq!((facts.messages, facts.bytes), (1460, 146_000));
    assert!((facts.interarrival.sum() - 0.02 * facts.interarrival.count() as f64).abs() < 1e-6);
}

#[test]
fn one_seen_fragment_counts_as_a_message_with_the_size_of_its_sample() {
    let mut bench = Bench::new(RELIABLE);
    bench.put(in_shared_memory(fragment(1, 4)));
    bench.put(in_shared_memory(fragment(3, 1)));
    bench.put(in_shared_memory(fragment(3, 10)));
    let facts = bench.wait(60_000).facts();
    assert_eq!((facts.messages, facts.bytes), (3, 28_500));
    assert_eq!((facts.lost, facts.incomplete), (0, 0));
    assert_eq!(facts.sampled.unwrap().seen, 2);
}

#[test]
fn a_message_on_the_network_and_in_shared_memory_counts_once() {
    let mut bench = Bench::new(RELIABLE);
    for number in 1..=10 {
        bench.data(number);
        if number % 2 == 0 {
            bench.put(in_shared_memory(data(number)));
        }
        bench.wait(10);
    }
    let facts = bench.facts();
    assert_eq!((facts.messages, facts.lost), (10, 0));
    // Shared memory falls silent. Samples missing before the next one may have used shared memory.
    // After it, gaps on the network are losses again.
    bench.wait(20_000);
    bench.data(21).data(24).wait(20_000);
    let facts = bench.facts();
    assert_eq!((facts.messages, facts.lost), (10 + 11 + 1, 2));
}

#[test]
fn a_sample_that_arrived_half_by_network_is_not_lost_in_shared_memory() {
    let mut bench = Bench::new(RELIABLE);
    bench.fragments(1, 1..=5);
    bench.put(in_shared_memory(fragment(1, 9)));
    bench.put(in_shared_memory(data(2)));
    let facts = bench.wait(60_000).facts();
    assert_eq!((facts.messages, facts.lost, facts.incomplete), (2, 0, 0));
}

fn with_intra_process(record: Record) -> Record {
    Record {
        flags: flag::SHM | flag::EXACT,
        ..record
    }
}

#[test]
fn with_uprobes_gaps_count_as_losses_and_copies_do_not_count_again() {
    let mut bench = Bench::new(Traits::default());
    for number in [1, 2, 3, 5, 6] {
        bench.put(with_intra_process(data(number)));
        // The sample goes to another host by the network, and is read from shared memory.
        bench.data(number);
        bench.put(in_shared_memory(data(number))).wait(10);
    }
    // A sample that is only read from shared memory is still pending.
    bench.put(in_shared_memory(data(8)));
    let facts = bench.wait(5_000).facts();
    assert_eq!((facts.messages, facts.bytes, facts.lost), (5, 500, 1));
    assert_eq!((facts.sampled, facts.duplicates), (None, 5));
    assert_eq!(facts.interarrival.count(), 4);
}

#[test]
fn messages_from_before_uprobes_began_count_by_the_span_of_their_numbers() {
    let mut bench = Bench::new(Traits::default());
    for number in [1, 4, 7] {
        bench.put(in_shared_memory(data(number))).wait(10);
    }
    for number in [10, 11, 13, 14] {
        bench.put(with_intra_process(data(number))).wait(10);
    }
    let facts = bench.wait(5_000).facts();
    let sampled = facts.sampled.unwrap();
    assert_eq!((sampled.seen, sampled.span), (4, 10));
    assert_eq!((facts.messages, facts.lost), (13, 1));
    // The uprobe's view ends, and shared memory is polled again.
    bench.wait(20_000);
    for number in [20, 25] {
        bench.put(in_shared_memory(data(number))).wait(10);
    }
    let facts = bench.wait(60_000).facts();
    assert_eq!((facts.messages, facts.lost), (13 + 11, 1));
}

#[test]
fn when_uprobes_end_messages_in_shared_memory_count_immediately() {
    let mut bench = Bench::new(Traits::default());
    for number in [1, 2, 3] {
        bench.put(with_intra_process(data(number))).wait(10);
    }
    bench.put(in_shared_memory(data(3)));
    bench.writer.end_exact_view();
    for number in [3, 5, 6] {
        bench.put(in_shared_memory(data(number))).wait(10);
    }
    let facts = bench.wait(60_000).facts();
    let sampled = facts.sampled.unwrap();
    assert_eq!((facts.messages, facts.lost, facts.duplicates), (6, 0, 0));
    assert_eq!((sampled.seen, sampled.span), (2, 3));
}

#[test]
fn when_uprobes_end_a_writer_is_unseen_until_another_view_shows_a_sample() {
    let mut bench = Bench::new(Traits::default());
    assert!(bench.writer.is_unseen());
    bench.writer.end_exact_view();
    bench.put(with_intra_process(data(1))).wait(1000);
    assert!(!bench.writer.is_unseen());
    for (number, in_view) in [
        (3, in_shared_memory as fn(Record) -> Record),
        (5, with_intra_process),
        (7, |record| record),
    ] {
        bench.put(with_intra_process(data(number - 1))).wait(1000);
        bench.writer.end_exact_view();
        assert!(bench.writer.is_unseen(), "{number}");
        bench.put(in_view(data(number))).wait(1000);
        assert!(!bench.writer.is_unseen(), "{number}");
    }
}

/// Returns a record of a sample in three fragments.
fn every_third(number: u64, start: u32) -> Record {
    Record {
        sample_size: 2500,
        ..fragment(number, start)
    }
}

/// Returns records of the samples `1..=4`, each in three fragments.
fn thirds() -> Vec<Record> {
    let starts = |number| (1..=3).map(move |start| every_third(number, start));
    (1..=4).flat_map(starts).collect()
}

/// Processes the records of two views in every interleaved order. Each sample must be dispatched
/// once or reported once as not captured.
fn every_sample_is_counted_or_missed(
    before: &[Record],
    after: &[Record],
    between: fn(&mut Bench),
    mixed: bool,
) -> [u64; 4] {
    let mut fewest = [1; 4];
    let shifts = if mixed { after.len() } else { 0 };
    for shift in 0..=shifts {
        // The first record is from the first view. The first `shift` records of the second view may
        // overtake the others.
        for at in 1..=before.len() {
            let mut bench = Bench::new(RELIABLE);
            let (early, late) = before.split_at(at);
            let (overtaking, rest) = after.split_at(shift);
            let mut given = [0; 4];
            let mut put = |bench: &mut Bench, records: &[Record]| {
                for record in records {
                    bench.now += MILLISECOND;
                    // A record without payload cannot complete a requested sample.
                    let time = bench.now;
                    let has = bench.writer.has(&sample(&Record { time, ..*record }));
                    if let Some(counted) = bench.take(*record) {
                        assert!(!has, "{record:?}");
                        given[usize::try_from(counted.number.0).unwrap() - 1] += 1;
                    }
                }
            };
            put(&mut bench, early);
            if overtaking.is_empty() {
                put(&mut bench, late);
                between(&mut bench);
            } else {
                put(&mut bench, overtaking);
                put(&mut bench, late);
            }
            put(&mut bench, rest);
            bench.wait(60_000);
            let facts = bench.facts();
            assert_eq!((facts.messages, facts.lost), (4, 0), "{shift} {at}");
            let mut accounted = given;
            for missing in bench.journal.take_missing() {
                assert_eq!(missing.reason, MissedReason::NotCaptured);
                for number in missing.first.0..=missing.last.0 {
                    accounted[usize::try_from(number).unwrap() - 1] += 1;
                }
            }
            assert_eq!(accounted, [1; 4], "{shift} {at}");
            fewest = std::array::from_fn(|index| fewest[index].min(given[index]));
        }
    }
    fewest
}

#[test]
fn a_sample_in_transit_when_uprobes_begin_is_counted() {
    let records = thirds();
    let looked: Vec<_> = records.iter().copied().map(in_shared_memory).collect();
    let exact: Vec<_> = records.into_iter().map(with_intra_process).collect();
    for begins in 0..exact.len() {
        for ends in begins.max(1)..exact.len() {
            let fewest =
                every_sample_is_counted_or_missed(&looked[..ends], &exact[begins..], |_| {}, true);
            assert_eq!(fewest, [1; 4], "{begins} {ends}");
        }
    }
}

#[test]
fn a_sample_in_transit_when_uprobes_begin_is_not_captured_if_a_part_is_missing() {
    let records = thirds();
    let looked = [in_shared_memory(records[0])];
    let exact: Vec<_> = records[2..]
        .iter()
        .copied()
        .map(with_intra_process)
        .collect();
    let fewest = every_sample_is_counted_or_missed(&looked, &exact, |_| {}, false);
    assert_eq!(fewest, [0, 1, 1, 1]);
}

#[test]
fn a_sample_in_transit_when_uprobes_end_is_counted_by_polling() {
    let records = thirds();
    for ends in 1..records.len() {
        let exact: Vec<_> = records[..ends]
            .iter()
            .copied()
            .map(with_intra_process)
            .collect();
        let looked: Vec<_> = records[ends..]
            .iter()
            .copied()
            .map(in_shared_memory)
            .collect();
        let end = |bench: &mut Bench| bench.writer.end_exact_view();
        let fewest = every_sample_is_counted_or_missed(&exact, &looked, end, false);
        assert_eq!(fewest, [1; 4], "{ends}");
    }
}
