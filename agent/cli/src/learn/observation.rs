//! Counts of a topic in whole seconds.

use ros2probe_api::Open;
use ros2probe_api::topics::{ReasonCode, Topic};
use ros2probe_daemon::config::rehearsal::Second;

/// Counts of one topic.
#[derive(Debug, Default)]
pub struct Observation {
    /// Seconds of learning before the topic's first second.
    start: u32,
    /// Counts of each second of the topic.
    seconds: Vec<Second>,
    totals: Option<Totals>,
    /// Whether messages were sampled in shared memory.
    pub is_sampled: bool,
    /// Number of messages with a timestamp later than their capture, or an hour away from it.
    pub implausible_timestamps: u64,
    /// The agent's explanation of why it sees no message.
    pub reason: Option<String>,
}

/// Counters of the last view.
#[derive(Clone, Copy, Debug, Default)]
struct Totals {
    messages: u64,
    lost: u64,
    expected: u64,
    delayed: u64,
    delay: f64,
    odd_timestamps: u64,
}

impl Observation {
    /// Creates the counts of a topic that appears after `start` seconds of learning.
    pub const fn new(start: u32) -> Self {
        Self {
            start,
            seconds: Vec::new(),
            totals: None,
            is_sampled: false,
            implausible_timestamps: 0,
            reason: None,
        }
    }

    /// Creates the counts of a topic with these seconds.
    #[cfg(test)]
    pub fn of(seconds: Vec<Second>) -> Self {
        Self {
            seconds,
            ..Self::new(0)
        }
    }

    /// Returns the topic's seconds so far.
    pub fn seconds(&self) -> &[Second] {
        &self.seconds
    }

    /// Adds the counts since the last view, `elapsed` seconds ago, as `steps` seconds. Counts of
    /// the first view belong to the time before it.
    pub fn observe(&mut self, topic: &Topic<'_>, now: f64, elapsed: f64, steps: u32) {
        let before = self.totals;
        let measurement = topic.measurement.as_ref();
        let totals = measurement.map(|it| {
            let latency = it.latency.unwrap_or_default();
            Totals {
                messages: it.messages,
                lost: it.subscriber_lost_messages,
                expected: it.subscriber_expected_messages,
                delayed: latency.count,
                delay: latency.mean_seconds * count(latency.count),
                odd_timestamps: it.negative_latency_messages + it.implausible_latency_messages,
            }
        });
        let last = measurement.and_then(|it| it.last_message_timestamp_seconds);
        let since = match (before, totals) {
            (Some(before), Some(totals)) => totals.since(before),
            _ => Totals::default(),
        };
        // Views are about a second apart, and rates count whole seconds.
        let messages = scaled(since.messages, f64::from(steps) / elapsed);
        for step in 0..steps {
            let left = f64::from(steps - step - 1);
            self.seconds.push(Second {
                messages: share(messages, step, steps),
                lost: share(since.lost, step, steps),
                expected: share(since.expected, step, steps),
                delayed: share(since.delayed, step, steps),
                delay: to_f32(since.delay / f64::from(steps)),
                silence: last
                    .filter(|_| totals.is_some())
                    .map(|last| to_f32((now - left - last).max(0.0))),
                publishers: u16::try_from(topic.publishers.len()).unwrap_or(u16::MAX),
                subscriptions: u16::try_from(topic.subscriptions.len()).unwrap_or(u16::MAX),
            });
        }
        self.implausible_timestamps += since.odd_timestamps;
        self.is_sampled |= measurement.is_some_and(|it| it.sampled.is_some());
        self.reason = reason(topic);
        self.totals = totals.or(before);
    }

    /// Adds empty seconds for a view without the topic, which then has no endpoint.
    pub fn complete(&mut self, seconds: u32) {
        let wanted = usize::try_from(seconds.saturating_sub(self.start)).unwrap_or(usize::MAX);
        if self.seconds.len() < wanted {
            self.seconds.resize(wanted, Second::default());
        }
    }
}

impl Totals {
    /// Returns the difference to an earlier view. Counters that were reset count as 0.
    fn since(self, before: Self) -> Self {
        Self {
            messages: self.messages.saturating_sub(before.messages),
            lost: self.lost.saturating_sub(before.lost),
            expected: self.expected.saturating_sub(before.expected),
            delayed: self.delayed.saturating_sub(before.delayed),
            delay: (self.delay - before.delay).max(0.0),
            odd_timestamps: self.odd_timestamps.saturating_sub(before.odd_timestamps),
        }
    }
}

/// Returns why messages may exist that the agent does not see.
fn reason(topic: &Topic<'_>) -> Option<String> {
    let mut reasons = topic.reasons.iter();
    let is_cause = |code: &Open<ReasonCode>| {
        !matches!(
            code,
            Open::Known(ReasonCode::Quiet | ReasonCode::NotWatched)
        )
    };
    let found = reasons.find(|reason| is_cause(&reason.code))?;
    Some(found.detail.clone())
}

/// Returns the `step`th of `steps` nearly equal parts of a count.
fn share(count: u64, step: u32, steps: u32) -> u32 {
    let (step, steps) = (u64::from(step), u64::from(steps.max(1)));
    let part = count / steps + u64::from(step < count % steps);
    u32::try_from(part).unwrap_or(u32::MAX)
}

#[expect(
    clippy::cast_possible_truncation,
    clippy::cast_sign_loss,
    reason = "a count of messages, scaled by 0.5 to 2"
)]
fn scaled(messages: u64, factor: f64) -> u64 {
    (count(messages) * factor).round() as u64
}

#[expect(
    clippy::cast_precision_loss,
    reason = "a count of messages is far below 2^52"
)]
const fn count(messages: u64) -> f64 {
    messages as f64
}

#[expect(
    clippy::cast_possible_truncation,
    reason = "thresholds need three digits"
)]
const fn to_f32(value: f64) -> f32 {
    value as f32
}
