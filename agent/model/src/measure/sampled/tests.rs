use super::*;
use crate::measure::sequence::{MAX_ANNOUNCED_JUMP, MAX_TRUSTED_JUMP, Settled};
use ros2probe_wire::time::{SECOND, nanoseconds};

struct View {
    sampled: Sampled,
    sequence: Sequence,
    now: u64,
}

impl View {
    fn new() -> Self {
        Self {
            sampled: Sampled::new(ModelTime::from_nanoseconds(SECOND)),
            sequence: Sequence::default(),
            now: SECOND,
        }
    }

    fn receive(&mut self, number: u64) -> SampledUpdate {
        self.part(number, Completeness::Complete)
    }

    fn part(&mut self, number: u64, seen: Completeness) -> SampledUpdate {
        self.now += SECOND / 100;
        let now = ModelTime::from_nanoseconds(self.now);
        self.sampled.sample(
            (SequenceNumber(number), seen, Some(Timestamp(self.now))),
            MAX_ANNOUNCED_JUMP,
            now,
            &mut self.sequence,
        )
    }

    fn counts(&self) -> (u64, u64) {
        let SampledFacts { seen, span, .. } = self.sampled.facts();
        (seen, span)
    }

    fn losses(&mut self) -> Vec<Settled> {
        let mut losses = Vec::new();
        self.sequence
            .settle_all(&mut |settled| losses.push(settled));
        losses
    }
}

#[test]
fn unseen_messages_count_as_sent_and_not_as_lost() {
    let mut view = View::new();
    for number in [1, 2, 5, 6, 100] {
        view.receive(number);
    }
    assert_eq!(view.counts(), (5, 100));
    assert_eq!(view.losses(), []);
}

#[test]
fn a_sample_counts_once_despite_fragments_and_copies() {
    let mut view = View::new();
    let parts = [
        Completeness::Partial,
        Completeness::Partial,
        Completeness::Complete,
        Completeness::Complete,
    ];
    let update = parts.map(|seen| view.part(1, seen));
    assert_eq!(update.map(|update| update.samples), [1, 0, 0, 0]);
    assert_eq!(
        update.map(|update| update.arrived),
        [false, false, true, false]
    );
    assert_eq!(
        update.map(|update| update.finished),
        [false, false, true, false]
    );
    view.receive(3);
    // The sample is late but was seen after all.
    let late = SampledUpdate {
        finished: true,
        ..SampledUpdate::default()
    };
    assert_eq!(view.receive(2), late);
    assert_eq!(view.receive(2), SampledUpdate::default());
    assert_eq!(view.counts(), (3, 3));
}

#[test]
fn a_sample_with_a_known_number_still_waits_for_its_later_fragments() {
    let mut view = View::new();
    view.receive(1);
    let has = |view: &View, number| view.sampled.has(number, view.sequence.next());
    view.part(2, Completeness::Partial);
    assert_eq!(
        [1, 2, 3].map(|number| has(&view, SequenceNumber(number))),
        [true, false, false]
    );
    // The next sample begins before this one is whole.
    view.part(3, Completeness::Partial);
    view.part(2, Completeness::Complete);
    assert_eq!(
        [2, 3].map(|number| has(&view, SequenceNumber(number))),
        [true, false]
    );
    view.part(3, Completeness::LastFragment);
    view.receive(500);
    // 300 is too old to be waited for, and numbers skipped by a GAP are not waited for either.
    assert!(has(&view, SequenceNumber(300)) && !has(&view, SequenceNumber(499)));
    let now = ModelTime::from_nanoseconds(view.now);
    view.sampled.skip(
        (SequenceNumber(501), SequenceNumber(503)),
        MAX_ANNOUNCED_JUMP,
        now,
        &mut view.sequence,
    );
    assert!(has(&view, SequenceNumber(502)) && !has(&view, SequenceNumber(499)));
}

#[test]
fn an_interval_is_measured_only_between_two_seen_neighbours() {
    let mut view = View::new();
    assert_eq!(view.receive(1).interval, None);
    assert_eq!(view.receive(2).interval, Some(10_000_000));
    assert_eq!(view.receive(4).interval, None);
    assert_eq!(view.receive(5).interval, Some(10_000_000));
}

#[test]
fn a_heartbeat_reveals_unseen_samples_and_a_gap_those_never_sent() {
    let mut view = View::new();
    let now = ModelTime::from_nanoseconds(view.now);
    assert_eq!(
        view.sampled.note_existing(
            SequenceNumber(7),
            MAX_ANNOUNCED_JUMP,
            now,
            &mut view.sequence
        ),
        0
    );
    view.receive(5);
    assert_eq!(
        view.sampled.note_existing(
            SequenceNumber(7),
            MAX_ANNOUNCED_JUMP,
            now,
            &mut view.sequence
        ),
        2
    );
    assert_eq!(
        view.sampled.note_existing(
            SequenceNumber(6),
            MAX_ANNOUNCED_JUMP,
            now,
            &mut view.sequence
        ),
        0
    );
    assert_eq!(view.counts(), (1, 3));
    // Sample 8 was sent, 9 to 11 were not.
    assert_eq!(
        view.sampled.skip(
            (SequenceNumber(9), SequenceNumber(12)),
            MAX_ANNOUNCED_JUMP,
            now,
            &mut view.sequence
        ),
        1
    );
    assert_eq!(view.counts(), (1, 4));
    let update = view.receive(12);
    // The update includes 6, 7 and 8, whose sizes are not known either.
    assert_eq!((update.samples, update.alike), (1, 4));
    view.receive(7);
    assert_eq!(view.counts(), (3, 5));
    let forged = view.sampled.note_existing(
        SequenceNumber(1 << 40),
        MAX_ANNOUNCED_JUMP,
        now,
        &mut view.sequence,
    );
    assert_eq!((forged, view.counts()), (0, (3, 5)));
    assert_eq!(view.losses(), []);
}

#[test]
fn a_writer_that_restarts_under_its_guid_counts_from_its_new_numbers() {
    let mut view = View::new();
    view.receive(1);
    view.receive(1000);
    view.now += 60 * SECOND;
    assert_eq!(view.receive(1).samples, 1);
    assert_eq!(view.receive(2).samples, 1);
    assert_eq!(view.counts(), (4, 1002));
}

#[test]
fn a_late_sample_that_a_heartbeat_announced_is_not_a_restart() {
    let mut view = View::new();
    view.receive(1);
    let now = ModelTime::from_nanoseconds(view.now);
    assert_eq!(
        view.sampled.note_existing(
            SequenceNumber(5),
            MAX_ANNOUNCED_JUMP,
            now,
            &mut view.sequence
        ),
        4
    );
    view.now += SECOND;
    for seen in [
        Completeness::Partial,
        Completeness::Partial,
        Completeness::Complete,
    ] {
        assert_eq!(view.part(4, seen).samples, 0);
    }
    assert_eq!(view.counts(), (2, 5));
}

#[test]
fn an_unseen_message_is_reported_once_after_the_arrival_timeout() {
    let mut view = View::new();
    let settle = |view: &mut View| {
        view.now += nanoseconds(ARRIVAL_TIMEOUT);
        view.sampled.tick(ModelTime::from_nanoseconds(view.now));
        view.sampled.take_unseen()
    };
    view.receive(1);
    assert_eq!(settle(&mut view), []);
    view.receive(5);
    assert!(view.sampled.unseen_since().is_some());
    // The sample may still arrive until the next tick.
    assert_eq!(settle(&mut view), []);
    assert!(view.receive(3).finished);
    assert_eq!(settle(&mut view), runs(&[(2, 2), (4, 4)]));
    assert_eq!(view.sampled.unseen_since(), None);
    assert!(!view.receive(4).finished, "given after it was left out");
    // Neither a part of a sample nor a HEARTBEAT makes it seen.
    view.part(6, Completeness::Partial);
    let now = ModelTime::from_nanoseconds(view.now);
    view.sampled.note_existing(
        SequenceNumber(8),
        MAX_ANNOUNCED_JUMP,
        now,
        &mut view.sequence,
    );
    // Numbers skipped by a GAP are not missing.
    view.sampled.skip(
        (SequenceNumber(9), SequenceNumber(200)),
        MAX_ANNOUNCED_JUMP,
        now,
        &mut view.sequence,
    );
    assert_eq!(settle(&mut view), runs(&[(6, 8)]));
    assert_eq!(settle(&mut view), []);
    assert_eq!(
        (view.receive(200).finished, view.receive(1000).finished),
        (true, true)
    );
    view.sampled.settle_all();
    assert_eq!(view.sampled.take_unseen(), runs(&[(201, 999)]));
}

#[test]
fn a_message_counted_from_another_source_is_not_reported_as_unseen() {
    let mut view = View::new();
    view.receive(1);
    view.receive(3);
    view.sampled.end();
    // The sample may still arrive; it is skipped when the view begins again.
    assert_eq!(view.sampled.take_unseen(), []);
    assert!(view.sampled.awaits(SequenceNumber(2)) && !view.sampled.awaits(SequenceNumber(3)));
    let now = ModelTime::from_nanoseconds(view.now);
    for number in 4..500 {
        view.sequence
            .exists(SequenceNumber(number), now, &mut |_| {});
    }
    view.receive(500);
    view.receive(502);
    view.sampled.settle_all();
    assert_eq!(view.sampled.take_unseen(), runs(&[(2, 2), (501, 501)]));
}

#[test]
fn a_jump_beyond_all_windows_causes_bounded_work_and_no_loss() {
    let mut view = View::new();
    for number in 1..=6 {
        view.receive(number);
    }
    // Each counts alone until the jump is confirmed; then the skipped numbers count, too.
    let samples: Vec<_> = (1..=6)
        .map(|n| view.receive(1_000_000 + n).samples)
        .collect();
    assert_eq!(samples, [1, 1, 1, 1, 999_995, 1]);
    assert_eq!(view.losses(), []);
    view.receive(u64::MAX);
    view.receive(0);
    assert_eq!(view.counts(), (12, 1_000_006));
    assert!((1..=6).all(|n| {
        view.sampled
            .has(SequenceNumber(1_000_000 + n), view.sequence.next())
    }));
}

#[test]
fn a_forged_number_far_ahead_counts_as_one_message_and_affects_no_other() {
    let mut view = View::new();
    for number in 1..=5 {
        view.receive(number);
    }
    view.part(6, Completeness::Partial);
    let forged = view.part(1 << 40, Completeness::Partial);
    assert_eq!((forged.samples, forged.finished), (1, false));
    assert!(view.part(1 << 40, Completeness::Complete).finished);
    assert!(!view.part(1 << 40, Completeness::Complete).finished);
    assert!(view.part(6, Completeness::Complete).finished);
    assert_eq!(view.receive(7).samples, 1);
    let now = ModelTime::from_nanoseconds(view.now);
    let messages = view.sampled.note_existing(
        SequenceNumber(3000),
        MAX_TRUSTED_JUMP,
        now,
        &mut view.sequence,
    );
    let passed = view.sampled.skip(
        (SequenceNumber(2000), SequenceNumber(3000)),
        MAX_TRUSTED_JUMP,
        now,
        &mut view.sequence,
    );
    assert_eq!((messages, passed, view.counts()), (0, 0, (8, 8)));
}

#[test]
fn a_writer_is_sampled_until_shared_memory_is_silent() {
    let mut sampled = Sampled::new(ModelTime::from_nanoseconds(SECOND));
    assert!(sampled.is_current(ModelTime::from_nanoseconds(10 * SECOND)));
    assert!(!sampled.is_current(ModelTime::from_nanoseconds(11 * SECOND)));
    sampled.touch(ModelTime::from_nanoseconds(5 * SECOND));
    assert!(sampled.is_current(ModelTime::from_nanoseconds(11 * SECOND)));
}

#[test]
fn the_stamp_of_the_first_fragment_applies_to_the_whole_sample() {
    let mut sampled = Sampled::new(ModelTime::from_nanoseconds(SECOND));
    assert_eq!(sampled.stamp(SequenceNumber(1), Some((5, 6))), Some((5, 6)));
    assert_eq!(sampled.stamp(SequenceNumber(1), None), Some((5, 6)));
    assert_eq!(sampled.stamp(SequenceNumber(2), None), None);
}

/// Returns the runs, given as their first and last numbers.
fn runs(runs: &[(u64, u64)]) -> Vec<(SequenceNumber, SequenceNumber)> {
    let numbered = |(first, last): &(u64, u64)| (SequenceNumber(*first), SequenceNumber(*last));
    runs.iter().map(numbered).collect()
}

/// Returns the number of messages in a row that polling may have missed after these numbers were
/// seen.
fn possibly_missed(seen: impl Iterator<Item = u64>) -> u64 {
    let mut view = View::new();
    seen.for_each(|number| {
        view.receive(number);
    });
    let interval = Duration::from_secs(100);
    view.sampled.max_unseen_time(interval).as_secs() / interval.as_secs()
}

#[test]
fn consecutive_missed_messages_explain_a_longer_silence() {
    assert_eq!(possibly_missed(std::iter::empty()), 131);
    assert!((80..100).contains(&possibly_missed(1..=100)));
    // Every other message is missed, never two in a row; then half of them at random.
    assert!((4..8).contains(&possibly_missed((1..=100).step_by(2))));
    let at_random = (1..=400_u64).filter(|number| (number * number).count_ones() % 2 == 0);
    assert!((15..30).contains(&possibly_missed(at_random)));
    // Half of the messages are missed, all in a row.
    assert!(possibly_missed((1..=50).chain(100..=101)) > 400);
    // On a busy machine, polling can pause for seconds.
    let mut view = View::new();
    view.receive(1);
    let short = view.sampled.max_unseen_time(Duration::from_millis(1));
    assert_eq!(short, MAX_POLLING_GAP);
    view.sampled.end();
    assert!(
        view.sampled
            .max_unseen_time(Duration::from_secs(1))
            .is_zero()
    );
}
