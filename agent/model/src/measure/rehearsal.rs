//! Evaluates expectations on seconds that were counted earlier, as [`TopicEvaluation`] evaluates
//! them live. Thresholds that were learnt from a robot are checked on the counts of the same robot.

use std::time::Duration;

use ros2probe_wire::time::SECOND;

use crate::facts::loss_share::{self, LossShare};
use crate::facts::model_time::ModelTime;
use crate::facts::rate::Slot;
use crate::facts::watch::Expectations;
use crate::facts::watch::WatchState;
use crate::measure::expectation::{Evidence, TopicEvaluation};

pub use crate::facts::rate::SECONDS;
pub use crate::measure::expectation::{STARTUP_GRACE_SECONDS, window};

/// Model time at which a rehearsal begins, in seconds: late enough for a silence before it.
const START_SECOND: u64 = 1_000_000;

/// Counts of one second of a topic. The type is small, because a client keeps hours of many topics.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Second {
    /// Messages received whole.
    pub messages: u32,
    /// Messages that the worst subscriber lost.
    pub lost: u32,
    /// Messages that this subscriber received or lost.
    pub expected: u32,
    /// Messages with a latency.
    pub delayed: u32,
    /// Sum of these latencies, in seconds.
    pub delay: f32,
    /// Time since the last message at the end of the second, in seconds; `None` before the first
    /// message.
    pub silence: Option<f32>,
    /// Number of writers.
    pub publishers: u16,
    /// Number of readers.
    pub subscriptions: u16,
}

/// Returns the keys of the expectations that the topic violates at any time, after hysteresis. A
/// second without a publisher violates nothing.
#[must_use]
pub fn violations(expectations: &Expectations, seconds: &[Second]) -> Vec<&'static str> {
    let mut judgement = TopicEvaluation::default();
    let mut violated = Vec::new();
    let first = seconds.iter().position(|second| second.messages > 0);
    let (mut since, mut observed) = (0, 0);
    let (mut published, mut subscribed) = (false, false);
    for (place, second) in seconds.iter().enumerate() {
        if !published && second.publishers > 0 {
            (since, observed) = (place, place);
        }
        if !subscribed && second.subscriptions > 0 {
            observed = place;
        }
        (published, subscribed) = (second.publishers > 0, second.subscriptions > 0);
        // The second of the first message is incomplete, as in `rate::Window`.
        let begin = first.map_or(place, |first| (first + 1).min(place + 1));
        let recent = |length: u64| recent(seconds, begin, place + 1, length);
        let now = instant(place + 1);
        judgement.judge(
            expectations,
            &Evidence {
                now,
                publishers: second.publishers.into(),
                subscriptions: second.subscriptions.into(),
                last_message: second.silence.map(|silence| now - duration(silence)),
                max_unseen_time: &|_| Duration::ZERO,
                since: instant(since),
                observed: instant(observed),
                recent: &recent,
                loss: loss(seconds, place + 1),
            },
        );
        if matches!(judgement.state(), WatchState::Violated | WatchState::Silent) {
            for key in judgement.violations() {
                if !violated.contains(&key) {
                    violated.push(key);
                }
            }
        }
    }
    violated
}

/// Returns the sum of the last `length` seconds before `end`, none of them before `begin`, and the
/// number of these seconds.
fn recent(seconds: &[Second], begin: usize, end: usize, length: u64) -> (Slot, u64) {
    let length = usize::try_from(length).unwrap_or(usize::MAX);
    let begin = begin.max(end.saturating_sub(length)).min(end);
    let mut sum = Slot::default();
    for second in seconds.get(begin..end).unwrap_or_default() {
        sum.add(&Slot {
            messages: second.messages.into(),
            bytes: 0,
            lost: second.lost.into(),
            delayed: second.delayed,
            delay: second.delay.into(),
            longest_interval: 0.0,
        });
    }
    (sum, (end - begin) as u64)
}

/// Returns the loss of the seconds before `end`.
fn loss(seconds: &[Second], end: usize) -> LossShare {
    let begin = end.saturating_sub(loss_share::SECONDS);
    let mut sum = LossShare::default();
    for second in seconds.get(begin..end).unwrap_or_default() {
        sum.add(LossShare {
            lost: second.lost.into(),
            expected: second.expected.into(),
        });
    }
    sum
}

fn instant(place: usize) -> ModelTime {
    ModelTime::from_nanoseconds((START_SECOND + place as u64) * SECOND)
}

fn duration(seconds: f32) -> Duration {
    // The maximum is shorter than the time before `START_SECOND`.
    Duration::try_from_secs_f32(seconds.clamp(0.0, 900_000.0)).unwrap_or_default()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn steady_seconds(messages: u32) -> Second {
        Second {
            messages,
            silence: Some(0.1),
            publishers: 1,
            subscriptions: 1,
            ..Second::default()
        }
    }

    fn expecting() -> Expectations {
        Expectations {
            min_rate_hz: Some(8.0),
            max_rate_hz: Some(12.0),
            max_silence: Some(Duration::from_secs(2)),
            subscribers: Some(1),
            ..Expectations::default()
        }
    }

    #[test]
    fn two_consecutive_slow_seconds_violate_the_rate_and_one_does_not() {
        let mut seconds = vec![steady_seconds(10); 60];
        seconds[0].messages = 1;
        seconds[30].messages = 3;
        assert!(violations(&expecting(), &seconds).is_empty());
        seconds[31].messages = 3;
        assert_eq!(violations(&expecting(), &seconds), ["min_rate_hz"]);
    }

    #[test]
    fn a_window_tolerates_varying_seconds_and_detects_half_the_rate() {
        // 40 Hz on a busy robot, in pairs of slow seconds.
        let busy = |part: u32| -> Vec<Second> {
            let counts = [24, 26, 46, 44, 46, 46, 40, 48].into_iter().cycle();
            counts
                .take(80)
                .map(|count| steady_seconds(count / part))
                .collect()
        };
        let expecting = |window_s| Expectations {
            min_rate_hz: Some(30.0),
            window_s,
            ..Expectations::default()
        };
        assert_eq!(violations(&expecting(None), &busy(1)), ["min_rate_hz"]);
        assert!(violations(&expecting(Some(5)), &busy(1)).is_empty());
        assert_eq!(violations(&expecting(Some(5)), &busy(2)), ["min_rate_hz"]);
    }

    #[test]
    fn silence_and_a_missing_subscriber_are_reported_by_their_keys() {
        let mut silent = vec![steady_seconds(10); 60];
        for (place, second) in silent.iter_mut().enumerate().skip(40) {
            second.messages = 0;
            second.silence = Some((place - 39) as f32);
        }
        assert_eq!(
            violations(&expecting(), &silent),
            ["min_rate_hz", "max_silence_s"]
        );
        let mut alone = silent.clone();
        alone[40..]
            .iter_mut()
            .for_each(|second| second.subscriptions = 0);
        assert_eq!(violations(&expecting(), &alone), ["subscribers"]);
        // Nothing is expected of a topic without a publisher.
        let mut gone = silent;
        gone[40..]
            .iter_mut()
            .for_each(|second| second.publishers = 0);
        assert!(violations(&expecting(), &gone).is_empty());
    }
}
