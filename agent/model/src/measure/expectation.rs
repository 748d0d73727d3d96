//! Evaluates the expectations of watchlist entries on their topics.
//!
//! Evaluation takes place once per second of the source's clock. A topic becomes violated after
//! `EVALUATIONS_TO_VIOLATE` bad evaluations in a row and recovers after `EVALUATIONS_TO_RECOVER`
//! good ones. Rates are evaluated over a window of at least three expected messages (1 to 10 s), or
//! over the window of the entry. One message of tolerance at the window's edges keeps a healthy
//! periodic topic stable. If less than one message is due in the window, `min_rate_hz` is evaluated
//! as a silence of `SLOW_TOPIC_INTERVALS` intervals. Latency is that of the last second. A second
//! without a message keeps the verdict of the last two with messages, so that a slow topic needs
//! two late ones. Silence has its own time and no hysteresis. A silence between two messages, which
//! ended before it was evaluated, violates at once, and recovers as the others do. The end of a
//! window counts for `min_rate_hz` only as far as its messages are known. The messages of a sampled
//! topic are known once polling sees the next one.
//!
//! Windows and silences begin at the earliest when the agent can see the messages. That is after
//! its own start, the first publisher or subscriber, and a time in which the source saw nothing. A
//! topic that was silent before such a time stays silent until its next message.
//!
//! The numbers of publishers and subscribers are evaluated once `STARTUP_GRACE_SECONDS` has passed
//! since the first publisher appeared, because a robot needs time to start. A writer without a
//! reader mostly sends nothing. A quiet topic without a subscriber therefore violates neither
//! `min_rate_hz` nor `max_silence_s`, but it may violate `publishers` and `subscribers`.

use std::time::Duration;

use ros2probe_wire::time::SECOND;

use crate::facts::loss_share::LossShare;
use crate::facts::model_time::ModelTime;
use crate::facts::rate::{SECONDS, Slot};
use crate::facts::watch::{Expectations, WatchState};

/// Number of bad evaluations in a row after which a topic is violated.
const EVALUATIONS_TO_VIOLATE: u8 = 2;
/// Number of good evaluations in a row after which a violated topic recovers.
const EVALUATIONS_TO_RECOVER: u8 = 3;
/// Number of evaluations after a silence in which its end is no silence of its own.
const SILENCE_END_EVALUATIONS: u8 = 2;
/// Expected intervals without a message after which a rate below one message in its window is
/// violated.
const SLOW_TOPIC_INTERVALS: f64 = 1.5;
/// Seconds from a topic's first publisher until the numbers of its endpoints are evaluated.
pub const STARTUP_GRACE_SECONDS: u64 = 10;
const EXPECTATION_NAMES: [&str; 7] = [
    "min_rate_hz",
    "max_rate_hz",
    "max_loss_ratio",
    "max_latency_ms",
    "max_silence_s",
    "publishers",
    "subscribers",
];
const MIN_RATE: u8 = 1 << 0;
const MAX_RATE: u8 = 1 << 1;
const MAX_LOSS: u8 = 1 << 2;
const MAX_LATENCY: u8 = 1 << 3;
const MAX_SILENCE: u8 = 1 << 4;
const PUBLISHERS: u8 = 1 << 5;
const SUBSCRIBERS: u8 = 1 << 6;

/// The facts that an evaluation uses.
pub struct Evidence<'a> {
    /// Time of the evaluation.
    pub now: ModelTime,
    /// Number of live writers.
    pub publishers: usize,
    /// Number of live readers.
    pub subscriptions: usize,
    /// Time of the last message of any writer.
    pub last_message: Option<ModelTime>,
    /// Returns how long the topic may seem silent while messages are sent. The argument is their
    /// interval if it is not known.
    pub max_unseen_time: &'a dyn Fn(Duration) -> Duration,
    /// Time at which the topic became both published and watched.
    pub since: ModelTime,
    /// Time at which messages became expected and visible; at least `since`.
    pub observed: ModelTime,
    /// Returns counts of the last whole seconds and the number of these seconds. Without a longest
    /// interval if several publishers share the topic.
    pub recent: &'a dyn Fn(u64) -> (Slot, u64),
    /// Loss of the worst subscriber in the last ten seconds.
    pub loss: LossShare,
}

/// State of one topic under one watchlist entry.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct TopicEvaluation {
    /// Whether no evaluation has taken place.
    fresh: bool,
    state: WatchState,
    violated: bool,
    violated_bits: u8,
    bad: u8,
    good: u8,
    /// Evaluations until an interval counts again after a silence.
    ending: u8,
    /// Number of consecutive seconds with messages whose latency was too high.
    late: u8,
}

impl Evidence<'_> {
    /// Returns whether two messages, both sent while they were expected, were further apart than
    /// this.
    fn has_gap(&self, maximum: Duration) -> bool {
        let last_second = ModelTime::of_second(self.now.whole_seconds().saturating_sub(1));
        let longest = f64::from((self.recent)(1).0.longest_interval);
        longest > maximum.as_secs_f64() && longest <= (last_second - self.observed).as_secs_f64()
    }

    /// Returns the number of whole seconds in which messages would have been seen.
    fn observed_seconds(&self) -> u64 {
        let first = self.observed.nanoseconds().div_ceil(SECOND);
        self.now.whole_seconds().saturating_sub(first)
    }

    /// Returns the part of the last whole seconds that is not known yet, in seconds. Messages are
    /// expected at `rate`.
    fn unknown_seconds(&self, rate: f64) -> f64 {
        let interval = Duration::try_from_secs_f64(1.0 / rate).unwrap_or(Duration::MAX);
        let seeming = (self.max_unseen_time)(interval);
        let last = self.last_message.unwrap_or_default().max(self.observed);
        if seeming.is_zero() || self.now - last > seeming {
            return 0.0;
        }
        let end = ModelTime::of_second(self.now.whole_seconds());
        (end - last).as_secs_f64()
    }
}

impl Default for TopicEvaluation {
    fn default() -> Self {
        Self {
            fresh: true,
            state: WatchState::Ok,
            violated: false,
            violated_bits: 0,
            bad: 0,
            good: 0,
            ending: 0,
            late: 0,
        }
    }
}

impl TopicEvaluation {
    /// Returns the state.
    #[must_use]
    pub const fn state(&self) -> WatchState {
        self.state
    }

    /// Returns the keys of the violated expectations.
    #[must_use]
    pub fn violations(&self) -> Vec<&'static str> {
        let broken = |bit: &usize| self.violated_bits & 1 << bit != 0;
        (0..EXPECTATION_NAMES.len())
            .filter(broken)
            .filter_map(|bit| EXPECTATION_NAMES.get(bit).copied())
            .collect()
    }

    /// Evaluates the topic. Returns the previous state if the state changed; it is `None` at the
    /// first evaluation, at which any state but `Ok` counts as a change.
    pub fn judge(
        &mut self,
        expectations: &Expectations,
        evidence: &Evidence<'_>,
    ) -> Option<Option<WatchState>> {
        let before = (!self.fresh).then_some(self.state);
        let is_silent = self.state == WatchState::Silent;
        let broken = violated_bits(expectations, evidence, is_silent)
            | self.latency_bit(expectations, evidence);
        let quiet = broken & MAX_SILENCE != 0
            || broken & MIN_RATE != 0 && longest_interval(expectations).is_some()
            || evidence.last_message.is_none();
        let broken = without_subscriber_effects(broken, quiet, evidence);
        let silent = broken & MAX_SILENCE != 0;
        let has_gap = !silent
            && self.ending == 0
            && evidence.subscriptions > 0
            && expectations
                .max_silence
                .is_some_and(|maximum| evidence.has_gap(maximum));
        self.ending = match silent {
            true => SILENCE_END_EVALUATIONS,
            false => self.ending.saturating_sub(1),
        };
        if broken & !MAX_SILENCE == 0 && !has_gap {
            (self.bad, self.good) = (0, self.good.saturating_add(1));
        } else {
            (self.bad, self.good) = (self.bad.saturating_add(1), 0);
        }
        let broken = if has_gap {
            broken | MAX_SILENCE
        } else {
            broken
        };
        if self.bad >= EVALUATIONS_TO_VIOLATE || has_gap {
            self.violated = true;
        } else if self.good >= EVALUATIONS_TO_RECOVER {
            self.violated = false;
        }
        let lacks_endpoints = self.violated && broken & (PUBLISHERS | SUBSCRIBERS) != 0;
        self.state = if evidence.publishers == 0 {
            WatchState::NotPublished
        } else if evidence.subscriptions == 0 && quiet && !lacks_endpoints {
            WatchState::NoSubscriber
        } else if silent {
            WatchState::Silent
        } else if self.violated {
            WatchState::Violated
        } else {
            WatchState::Ok
        };
        match self.state {
            WatchState::Silent => self.violated_bits = broken,
            // In a violated state without a currently violated expectation, the last ones stay
            // listed.
            WatchState::Violated if broken != 0 => self.violated_bits = broken,
            WatchState::Violated => {}
            _ => self.violated_bits = 0,
        }
        self.fresh = false;
        (before.unwrap_or(WatchState::Ok) != self.state).then_some(before)
    }

    /// Returns [`MAX_LATENCY`] if the latency is too high, and 0 otherwise.
    fn latency_bit(&mut self, expectations: &Expectations, evidence: &Evidence<'_>) -> u8 {
        let Some(maximum) = expectations.max_latency else {
            return 0;
        };
        let (slot, _) = (evidence.recent)(1);
        let is_late = slot.delay > maximum.as_secs_f64() * f64::from(slot.delayed);
        if slot.delayed > 0 {
            self.late = match is_late {
                true => self.late.saturating_add(1),
                false => 0,
            };
            return if is_late { MAX_LATENCY } else { 0 };
        }
        if evidence.publishers == 0 || evidence.subscriptions == 0 {
            // No further message can be late.
            self.late = 0;
        }
        match self.late >= EVALUATIONS_TO_VIOLATE {
            true => MAX_LATENCY,
            false => 0,
        }
    }
}

#[expect(
    clippy::cast_precision_loss,
    reason = "counts of ten seconds are far below 2^52"
)]
fn violated_bits(expectations: &Expectations, evidence: &Evidence<'_>, is_silent: bool) -> u8 {
    let mut broken = 0;
    let rates = |rate: f64| {
        let window = window_of(expectations, rate);
        (evidence.recent)(window.min(evidence.observed_seconds()))
    };
    if let Some((expected, longest)) = longest_interval(expectations) {
        let last = evidence.last_message.unwrap_or_default();
        let silence = evidence.now - last.max(evidence.observed);
        if silence > longest.max((evidence.max_unseen_time)(expected)) {
            broken |= MIN_RATE;
        }
    } else if let Some(minimum) = expectations.min_rate_hz {
        let (slot, seconds) = rates(minimum);
        let known = seconds as f64 - evidence.unknown_seconds(minimum).min(seconds as f64);
        if known > 0.0 && (slot.messages + 1) as f64 <= minimum * known {
            broken |= MIN_RATE;
        }
    }
    if let Some(maximum) = expectations.max_rate_hz {
        let (slot, seconds) = rates(maximum);
        if seconds > 0 && slot.messages as f64 >= maximum * seconds as f64 + 1.0 {
            broken |= MAX_RATE;
        }
    }
    if let Some(maximum) = expectations.max_loss_ratio
        && evidence.loss.exceeds(maximum)
    {
        broken |= MAX_LOSS;
    }
    if let Some(maximum) = expectations.max_silence {
        let last = evidence.last_message.unwrap_or_default();
        let begin = match is_silent {
            true => last,
            false => last.max(evidence.observed),
        };
        if evidence.now - begin > maximum.max((evidence.max_unseen_time)(maximum)) {
            broken |= MAX_SILENCE;
        }
    }
    if evidence.now - evidence.since >= Duration::from_secs(STARTUP_GRACE_SECONDS) {
        let lacks = |expected: Option<u32>, there: usize| {
            expected.is_some_and(|expected| there < usize::try_from(expected).unwrap_or(usize::MAX))
        };
        if lacks(expectations.publishers, evidence.publishers) {
            broken |= PUBLISHERS;
        }
        if lacks(expectations.subscribers, evidence.subscriptions) {
            broken |= SUBSCRIBERS;
        }
    }
    broken
}

/// Returns the number of seconds over which a rate is evaluated.
fn window_of(expectations: &Expectations, rate: f64) -> u64 {
    let configured = expectations.window_s;
    configured.map_or_else(|| window(rate), u64::from)
}

/// Returns the interval that `min_rate_hz` expects, and the longest one that it permits; `None` if
/// its window is long enough to count messages.
#[expect(
    clippy::cast_precision_loss,
    reason = "a window has at most ten seconds"
)]
fn longest_interval(expectations: &Expectations) -> Option<(Duration, Duration)> {
    let minimum = expectations.min_rate_hz.filter(|minimum| *minimum > 0.0)?;
    let interval = |seconds: f64| Duration::try_from_secs_f64(seconds).unwrap_or(Duration::MAX);
    let is_slow = minimum * (window_of(expectations, minimum) as f64) < 1.0;
    is_slow.then(|| {
        let longest = interval(SLOW_TOPIC_INTERVALS / minimum);
        (interval(1.0 / minimum), longest)
    })
}

/// Removes the violations that follow from the absence of all subscribers.
const fn without_subscriber_effects(broken: u8, quiet: bool, evidence: &Evidence<'_>) -> u8 {
    let is_expected = broken & SUBSCRIBERS != 0;
    if evidence.subscriptions == 0 && (quiet || is_expected) {
        broken & !(MIN_RATE | MAX_SILENCE)
    } else {
        broken
    }
}

/// Returns the number of whole seconds in which three messages at this rate are due, from 1 to 10.
#[must_use]
pub fn window(rate: f64) -> u64 {
    let seconds = (3.0 / rate.max(0.01)).ceil();
    (1..SECONDS)
        .find(|window| seconds <= f64::from(u32::try_from(*window).unwrap_or(1)))
        .unwrap_or(SECONDS)
}

#[cfg(test)]
mod tests {
    use super::*;

    struct Bench {
        judgement: TopicEvaluation,
        expectations: Expectations,
        now: u64,
        last_message: Option<ModelTime>,
        seeming_silence: Duration,
        /// Time before an evaluation in which polling has seen nothing.
        unseen: Duration,
        subscriptions: usize,
        publishers: usize,
        observed: ModelTime,
    }

    impl Bench {
        fn new(expectations: Expectations) -> Self {
            Self {
                judgement: TopicEvaluation::default(),
                expectations,
                now: 1000 * SECOND,
                last_message: None,
                seeming_silence: Duration::ZERO,
                unseen: Duration::ZERO,
                subscriptions: 1,
                publishers: 1,
                observed: ModelTime::from_nanoseconds(1000 * SECOND),
            }
        }

        /// Evaluates one second with these counts.
        fn second(&mut self, slot: Slot) -> WatchState {
            self.now += SECOND;
            if slot.messages > 0 {
                let unseen = u64::try_from(self.unseen.as_nanos()).unwrap();
                self.last_message = Some(ModelTime::from_nanoseconds(self.now - unseen));
            }
            let recent = |seconds: u64| {
                let mut sum = Slot::default();
                (0..seconds).for_each(|_| sum.add(&slot));
                (sum, seconds)
            };
            self.judgement.judge(
                &self.expectations,
                &Evidence {
                    now: ModelTime::from_nanoseconds(self.now),
                    publishers: self.publishers,
                    subscriptions: self.subscriptions,
                    last_message: self.last_message,
                    max_unseen_time: &|_| self.seeming_silence,
                    since: ModelTime::from_nanoseconds(1000 * SECOND),
                    observed: self.observed,
                    recent: &recent,
                    loss: LossShare {
                        lost: 10 * slot.lost,
                        expected: 10 * (slot.messages + slot.lost),
                    },
                },
            );
            self.judgement.state()
        }
    }

    fn rate(messages: u64) -> Slot {
        Slot {
            messages,
            ..Slot::default()
        }
    }

    #[test]
    fn two_bad_seconds_in_a_row_cause_a_violation_and_three_good_ones_end_it() {
        let mut bench = Bench::new(Expectations {
            min_rate_hz: Some(10.0),
            ..Expectations::default()
        });
        let states: Vec<_> = [10, 4, 10, 4, 4, 10, 10, 10]
            .map(|messages| bench.second(rate(messages)))
            .into();
        let (ok, bad) = (WatchState::Ok, WatchState::Violated);
        assert_eq!(states, [ok, ok, ok, ok, bad, bad, bad, ok]);
    }

    /// Returns the counts of a second with ten messages, of which two are this far apart.
    fn gap(seconds: f32) -> Slot {
        Slot {
            longest_interval: seconds,
            ..rate(10)
        }
    }

    fn without_silence_above(seconds: f64) -> Bench {
        Bench::new(Expectations {
            max_silence: Some(Duration::from_secs_f64(seconds)),
            ..Expectations::default()
        })
    }

    #[test]
    fn a_gap_between_messages_violates_at_once_and_three_good_seconds_end_it() {
        let mut bench = without_silence_above(0.2);
        let gaps = [0.1, 0.1, 0.1, 0.3, 0.1, 0.1, 0.1];
        let states = gaps.map(|seconds| bench.second(gap(seconds)));
        let (ok, bad) = (WatchState::Ok, WatchState::Violated);
        assert_eq!(states, [ok, ok, ok, bad, bad, bad, ok]);
        assert!(bench.judgement.violations().is_empty());
        bench.second(gap(0.3));
        assert_eq!(bench.judgement.violations(), ["max_silence_s"]);
    }

    #[test]
    fn an_interval_that_began_before_messages_were_expected_is_not_a_gap() {
        let mut bench = without_silence_above(0.2);
        assert_eq!(bench.second(gap(60.0)), WatchState::Ok);
        assert_eq!(bench.second(gap(0.1)), WatchState::Ok);
        bench.subscriptions = 0;
        assert_ne!(bench.second(gap(0.3)), WatchState::Violated);
    }

    #[test]
    fn the_end_of_a_silence_is_not_a_second_violation() {
        let mut bench = without_silence_above(1.5);
        for messages in [10, 10, 10, 0, 0] {
            bench.second(rate(messages));
        }
        assert_eq!(bench.judgement.state(), WatchState::Silent);
        assert_eq!(bench.second(gap(2.1)), WatchState::Ok);
        assert_eq!(bench.second(gap(2.1)), WatchState::Ok);
        assert_eq!(bench.second(gap(2.1)), WatchState::Violated);
    }

    #[test]
    fn jitter_at_the_rate_limit_does_not_make_a_topic_silent() {
        let mut bench = Bench::new(Expectations {
            min_rate_hz: Some(20.0),
            max_rate_hz: Some(20.0),
            ..Expectations::default()
        });
        for messages in [20, 19, 21, 20, 20, 19] {
            // With jitter, the window contains 19 to 21 messages instead of 20.
            let state = bench.second(rate(messages));
            assert!(matches!(state, WatchState::Ok | WatchState::Violated));
        }
        assert_eq!(window(0.5), 6);
        assert_eq!((window(200.0), window(0.01)), (1, 10));
    }

    #[test]
    fn violations_are_reported_by_their_keys() {
        let mut bench = Bench::new(Expectations {
            max_rate_hz: Some(5.0),
            max_loss_ratio: Some(0.01),
            max_latency: Some(Duration::from_millis(50)),
            ..Expectations::default()
        });
        let slot = Slot {
            messages: 10,
            lost: 1,
            delayed: 10,
            delay: 1.0,
            bytes: 0,
            ..Slot::default()
        };
        bench.second(slot);
        assert_eq!(bench.second(slot), WatchState::Violated);
        let violations = bench.judgement.violations();
        assert_eq!(
            violations,
            ["max_rate_hz", "max_loss_ratio", "max_latency_ms"]
        );
    }

    #[test]
    fn two_late_messages_of_a_slow_topic_cause_a_violation_and_one_does_not() {
        let mut bench = Bench::new(Expectations {
            max_latency: Some(Duration::from_millis(50)),
            ..Expectations::default()
        });
        let message = |delay: f64| Slot {
            delayed: 1,
            delay,
            ..rate(1)
        };
        let (late, timely, none) = (message(3.0), message(0.01), rate(0));
        let (ok, bad) = (WatchState::Ok, WatchState::Violated);
        let seconds = [late, none, timely, none, late, none, none, late, none, none];
        let states = seconds.map(|slot| bench.second(slot));
        assert_eq!(states[..8], [ok; 8]);
        assert_eq!(states[8..], [bad, bad]);
        assert_eq!(bench.judgement.violations(), ["max_latency_ms"]);
        let states = [timely, none, none].map(|slot| bench.second(slot));
        assert_eq!(states, [bad, bad, ok]);
        for slot in [late, none, late, none] {
            bench.second(slot);
        }
        assert_eq!(bench.judgement.state(), bad);
        // Nothing is sent without a subscription.
        bench.subscriptions = 0;
        let states = [none; 3].map(|slot| bench.second(slot));
        assert_eq!(states[2], ok);
    }

    #[test]
    fn silence_counts_from_the_first_publisher() {
        let mut bench = Bench::new(Expectations {
            max_silence: Some(Duration::from_secs(2)),
            ..Expectations::default()
        });
        let states: Vec<_> = [0, 0, 0, 5]
            .map(|messages| bench.second(rate(messages)))
            .into();
        let (ok, silent) = (WatchState::Ok, WatchState::Silent);
        assert_eq!(states, [ok, ok, silent, ok]);
    }

    #[test]
    fn silence_counts_from_when_the_agent_sees_messages_again() {
        let expectations = Expectations {
            max_silence: Some(Duration::from_secs(2)),
            ..Expectations::default()
        };
        let mut bench = Bench::new(expectations);
        let (ok, silent) = (WatchState::Ok, WatchState::Silent);
        assert_eq!(bench.second(rate(5)), ok);
        // Five seconds pass unobserved.
        bench.now += 5 * SECOND;
        bench.observed = ModelTime::from_nanoseconds(bench.now);
        let states = [(); 3].map(|()| bench.second(rate(0)));
        assert_eq!(states, [ok, ok, silent]);
        // A topic that was silent before stays silent.
        bench.now += 5 * SECOND;
        bench.observed = ModelTime::from_nanoseconds(bench.now);
        assert_eq!([0, 1].map(|count| bench.second(rate(count))), [silent, ok]);
    }

    #[test]
    fn a_sampled_topic_is_silent_once_missed_messages_cannot_explain_it() {
        let mut bench = Bench::new(Expectations {
            max_silence: Some(Duration::from_secs(2)),
            ..Expectations::default()
        });
        bench.seeming_silence = Duration::from_secs(4);
        assert_eq!(bench.second(rate(5)), WatchState::Ok);
        let states = [(); 5].map(|()| bench.second(rate(0)));
        let (ok, silent) = (WatchState::Ok, WatchState::Silent);
        assert_eq!(states, [ok, ok, ok, ok, silent]);
    }

    #[test]
    fn the_rate_of_a_sampled_topic_counts_up_to_the_last_message_seen() {
        let mut bench = Bench::new(Expectations {
            min_rate_hz: Some(40.0),
            ..Expectations::default()
        });
        bench.seeming_silence = Duration::from_secs(1);
        bench.unseen = Duration::from_millis(400);
        // 50 Hz, the last 0.4 s of each second unseen.
        let states = [(); 4].map(|()| bench.second(rate(30)));
        assert_eq!(states, [WatchState::Ok; 4]);
        // 30 Hz: too few up to the last message.
        let states = [(); 2].map(|()| bench.second(rate(18)));
        let (ok, bad) = (WatchState::Ok, WatchState::Violated);
        assert_eq!(states, [ok, bad]);
        // The topic recovers, and then its messages end.
        (0..3).for_each(|_| assert_ne!(bench.second(rate(30)), WatchState::Silent));
        let states = [(); 3].map(|()| bench.second(rate(0)));
        assert_eq!(states, [ok, bad, bad]);
        // Without sampling, all messages are known immediately.
        (0..3).for_each(|_| assert_ne!(bench.second(rate(50)), WatchState::Silent));
        bench.seeming_silence = Duration::ZERO;
        let states = [(); 2].map(|()| bench.second(rate(30)));
        assert_eq!(states, [ok, bad]);
    }

    #[test]
    fn a_rate_counts_from_when_the_agent_sees_messages_again() {
        let mut bench = Bench::new(Expectations {
            min_rate_hz: Some(0.5),
            ..Expectations::default()
        });
        // Messages of the window before the view began are unknown.
        bench.now += 20 * SECOND;
        bench.observed = ModelTime::from_nanoseconds(bench.now);
        let states = [(); 7].map(|()| bench.second(rate(0)));
        let (ok, bad) = (WatchState::Ok, WatchState::Violated);
        assert_eq!(states, [ok, ok, bad, bad, bad, bad, bad]);
    }

    /// Evaluates these seconds of a topic that has a message every `period` of them.
    fn slow_seconds(bench: &mut Bench, seconds: u64, period: u64) -> Vec<WatchState> {
        let each = |second: u64| bench.second(rate(u64::from(second.is_multiple_of(period))));
        (1..=seconds).map(each).collect()
    }

    #[test]
    fn a_rate_of_less_than_one_message_per_window_is_violated_after_one_and_a_half_intervals() {
        let (ok, bad) = (WatchState::Ok, WatchState::Violated);
        for (minimum, window_s, interval) in
            [(0.025, None, 40), (0.08, None, 12), (0.5, Some(1), 2)]
        {
            let mut bench = Bench::new(Expectations {
                min_rate_hz: Some(minimum),
                window_s,
                ..Expectations::default()
            });
            let states = slow_seconds(&mut bench, 5 * interval, interval);
            assert!(states.iter().all(|state| *state == ok), "{minimum}");
            let permitted = usize::try_from(interval * 3 / 2).unwrap();
            let states = slow_seconds(&mut bench, 3 * interval, u64::MAX);
            let first = states.iter().position(|state| *state == bad);
            // Two evaluations in a row cause a violation.
            assert_eq!(first, Some(permitted + 1), "{minimum}");
            assert_eq!(bench.judgement.violations(), ["min_rate_hz"]);
            let states = [1, 0, 0].map(|messages| bench.second(rate(messages)));
            assert_eq!(states, [bad, bad, ok], "{minimum}");
        }
    }

    #[test]
    fn a_slow_topic_that_is_quiet_without_a_subscriber_violates_nothing() {
        let mut bench = Bench::new(Expectations {
            min_rate_hz: Some(0.05),
            ..Expectations::default()
        });
        assert_eq!(bench.second(rate(1)), WatchState::Ok);
        bench.subscriptions = 0;
        let states = slow_seconds(&mut bench, 60, u64::MAX);
        assert!(!states.contains(&WatchState::Violated));
        assert_eq!(bench.judgement.state(), WatchState::NoSubscriber);
    }

    #[test]
    fn a_topic_without_subscriber_or_publisher_violates_nothing() {
        let mut bench = Bench::new(Expectations {
            max_silence: Some(Duration::from_secs(1)),
            ..Expectations::default()
        });
        bench.subscriptions = 0;
        assert_eq!(bench.second(rate(0)), WatchState::NoSubscriber);
        bench.publishers = 0;
        assert_eq!(bench.second(rate(0)), WatchState::NotPublished);
        assert!(bench.judgement.violations().is_empty());
    }

    /// Returns a bench after its grace period, with ten messages each second.
    fn counted(publishers: Option<u32>, subscribers: Option<u32>) -> Bench {
        let mut bench = Bench::new(Expectations {
            min_rate_hz: Some(8.0),
            max_silence: Some(Duration::from_secs(1)),
            publishers,
            subscribers,
            ..Expectations::default()
        });
        bench.publishers = publishers.map_or(1, |count| count as usize);
        bench.subscriptions = subscribers.map_or(1, |count| count as usize);
        for _ in 0..STARTUP_GRACE_SECONDS {
            assert_eq!(bench.second(rate(10)), WatchState::Ok);
        }
        bench
    }

    #[test]
    fn too_few_publishers_cause_a_violation_after_two_seconds() {
        let mut bench = counted(Some(2), None);
        bench.publishers = 1;
        let states = [(); 2].map(|()| bench.second(rate(10)));
        assert_eq!(states, [WatchState::Ok, WatchState::Violated]);
        assert_eq!(bench.judgement.violations(), ["publishers"]);
        bench.publishers = 3;
        let states = [(); 3].map(|()| bench.second(rate(10)));
        let (ok, bad) = (WatchState::Ok, WatchState::Violated);
        assert_eq!(states, [bad, bad, ok]);
        bench.publishers = 0;
        assert_eq!(bench.second(rate(0)), WatchState::NotPublished);
        assert_eq!(bench.second(rate(0)), WatchState::NotPublished);
        assert!(bench.judgement.violations().is_empty());
    }

    #[test]
    fn a_writer_that_is_silent_without_subscribers_violates_only_the_subscriber_count() {
        let mut bench = counted(None, Some(1));
        bench.subscriptions = 0;
        let states = [(); 5].map(|()| bench.second(rate(0)));
        assert_eq!(states[1..], [WatchState::Violated; 4]);
        assert_eq!(bench.judgement.violations(), ["subscribers"]);
        let silent = &mut counted(None, Some(2));
        silent.subscriptions = 1;
        let states = [(); 5].map(|()| silent.second(rate(0)));
        assert_eq!(states[4], WatchState::Silent);
        let violations = silent.judgement.violations();
        assert_eq!(violations, ["min_rate_hz", "max_silence_s", "subscribers"]);
    }

    #[test]
    fn too_few_publishers_cause_a_violation_even_without_a_subscriber() {
        let mut bench = Bench::new(Expectations {
            min_rate_hz: Some(8.0),
            max_silence: Some(Duration::from_secs(1)),
            publishers: Some(2),
            ..Expectations::default()
        });
        bench.subscriptions = 0;
        bench.publishers = 2;
        for _ in 0..=STARTUP_GRACE_SECONDS {
            assert_eq!(bench.second(rate(0)), WatchState::NoSubscriber);
        }
        bench.publishers = 1;
        let states = [(); 3].map(|()| bench.second(rate(0)));
        let (alone, bad) = (WatchState::NoSubscriber, WatchState::Violated);
        assert_eq!(states, [alone, bad, bad]);
        assert_eq!(bench.judgement.violations(), ["publishers"]);
    }

    #[test]
    fn missing_subscribers_are_tolerated_during_the_grace_period() {
        let mut bench = Bench::new(Expectations {
            subscribers: Some(1),
            ..Expectations::default()
        });
        bench.subscriptions = 0;
        for _ in 0..STARTUP_GRACE_SECONDS {
            assert_eq!(bench.second(rate(0)), WatchState::NoSubscriber);
        }
        assert_eq!(bench.second(rate(0)), WatchState::Violated);
    }
}
