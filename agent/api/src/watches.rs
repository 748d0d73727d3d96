//! `/watch` and `/watch/{topic}`.

use std::borrow::Cow;

use serde::{Deserialize, Serialize};

use crate::Open;

/// All watches.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(default)]
pub struct WatchList {
    /// Watches of the configuration, then of the command line, then of clients in the order of
    /// their creation.
    pub watches: Vec<Watch>,
}

/// A watch.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(default)]
#[expect(
    missing_docs,
    reason = "the document describes expectations where they are declared"
)]
pub struct Watch {
    /// ROS name or glob of the topics.
    #[cfg_attr(feature = "openapi", schema(example = "/points"))]
    pub topic: String,
    /// Domain id; null for every domain.
    #[cfg_attr(feature = "openapi", schema(minimum = 0, maximum = 232))]
    pub domain_id: Option<u32>,
    /// Origin of the watch.
    #[cfg_attr(feature = "openapi", schema(value_type = Origin))]
    pub origin: Open<Origin>,
    /// State of the watch.
    #[cfg_attr(feature = "openapi", schema(value_type = WatchState))]
    pub state: Open<WatchState>,
    /// Whether metrics have series per writer and subscriber.
    pub per_subscriber: bool,
    /// Share of messages for which spans are exported, from 0 to 1.
    #[cfg_attr(feature = "openapi", schema(minimum = 0, maximum = 1))]
    pub trace: f64,
    /// `last`: the agent keeps the last message of each transient-local writer for recordings that
    /// begin later.
    pub retain: Retain,
    #[serde(flatten)]
    pub expectations: Expectations,
    /// Whether the watch survives a restart of the agent. False for a watch of a client while the
    /// state directory is missing or cannot be written.
    #[serde(default = "yes")]
    pub kept: bool,
    /// Topics that the watch covers; a watched name without a topic is listed too.
    pub topics: Vec<WatchedTopic>,
}

/// Default for older agents, which do not send the field.
const fn yes() -> bool {
    true
}

/// Messages that the agent keeps for recordings that begin later.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(rename_all = "lowercase")]
pub enum Retain {
    /// No messages.
    #[default]
    None,
    /// The last message of each writer that keeps messages for late joiners (transient local).
    Last,
}

/// Expectations of each topic. A missing field sets no expectation.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema), schema(as = ExpectationsView))]
pub struct Expectations {
    /// Minimum rate, in messages per second.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[cfg_attr(feature = "openapi", schema(nullable = false))]
    pub min_rate_hz: Option<f64>,
    /// Maximum rate, in messages per second.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[cfg_attr(feature = "openapi", schema(nullable = false))]
    pub max_rate_hz: Option<f64>,
    /// Window of both rates, in seconds. Without it, the agent chooses a window of 1 to 10 s in
    /// which three messages are due.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[cfg_attr(feature = "openapi", schema(nullable = false))]
    pub window_s: Option<u32>,
    /// Maximum share of lost messages, from 0 to 1.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[cfg_attr(feature = "openapi", schema(nullable = false))]
    pub max_loss_ratio: Option<f64>,
    /// Maximum time from the writer's timestamp to the capture, in milliseconds.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[cfg_attr(feature = "openapi", schema(nullable = false))]
    pub max_latency_ms: Option<f64>,
    /// Maximum time without a message, in seconds.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[cfg_attr(feature = "openapi", schema(nullable = false))]
    pub max_silence_s: Option<f64>,
    /// Minimum number of publishers.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[cfg_attr(feature = "openapi", schema(nullable = false))]
    pub publishers: Option<u32>,
    /// Minimum number of subscribers.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[cfg_attr(feature = "openapi", schema(nullable = false))]
    pub subscribers: Option<u32>,
}

/// Origin of a watch.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(rename_all = "snake_case")]
pub enum Origin {
    /// The configuration file.
    Config,
    /// The option `--watch`.
    CommandLine,
    /// A client of this API.
    Api,
}

/// State of a watch.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema), schema(as = Stage))]
#[serde(rename_all = "snake_case")]
pub enum WatchState {
    /// The watch takes effect with the next packets.
    Starting,
    /// The topic does not exist yet. It is measured as soon as it appears.
    Waiting,
    /// The topics of the watch are measured.
    Measuring,
    /// The topic exists, but `limits.topics` is reached.
    Rejected,
}

/// A watched topic.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema), schema(as = TopicView))]
#[serde(default)]
pub struct WatchedTopic {
    /// Domain id.
    pub domain_id: u32,
    /// ROS name.
    pub topic: String,
    /// State of the topic's expectations.
    #[cfg_attr(feature = "openapi", schema(value_type = TopicState))]
    pub state: Open<TopicState>,
    /// Expectations that the topic violates.
    pub violations: Vec<Cow<'static, str>>,
    /// Messages counted since the agent began to watch the topic.
    pub messages: u64,
    /// Messages per second over the last window; null if messages cannot be observed.
    pub rate_hertz: Option<f64>,
}

/// State of a topic's expectations.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(rename_all = "snake_case")]
pub enum TopicState {
    /// All expectations are met.
    Ok,
    /// At least one expectation is violated.
    Violated,
    /// No message arrived for longer than `max_silence_s`.
    Silent,
    /// The topic has no publisher.
    NotPublished,
    /// The topic has no subscriber, and neither `publishers` nor `subscribers` is violated.
    NoSubscriber,
}

/// Settings of a watch. All fields are optional, and so is the body.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(deny_unknown_fields, default)]
pub struct WatchRequest {
    /// Domain id; null for every domain. The query parameter of this name has the same effect.
    #[cfg_attr(feature = "openapi", schema(minimum = 0, maximum = 232))]
    pub domain_id: Option<u32>,
    /// Whether metrics have series per writer and subscriber of each covered topic.
    pub per_subscriber: bool,
    /// Share of each covered topic's messages for which spans are exported, from 0 to 1.
    #[cfg_attr(feature = "openapi", schema(minimum = 0, maximum = 1))]
    pub trace: f64,
    /// `last`: the agent keeps the last message of each transient-local writer for recordings that
    /// begin later.
    pub retain: Retain,
    /// Minimum rate, in messages per second.
    #[cfg_attr(feature = "openapi", schema(minimum = 0, maximum = 1_000_000))]
    pub min_rate_hz: Option<f64>,
    /// Maximum rate, in messages per second.
    #[cfg_attr(feature = "openapi", schema(minimum = 0, maximum = 1_000_000))]
    pub max_rate_hz: Option<f64>,
    /// Window of both rates, in seconds. Without it, the agent chooses a window of 1 to 10 s in
    /// which three messages are due.
    #[cfg_attr(feature = "openapi", schema(minimum = 1, maximum = 10))]
    pub window_s: Option<u32>,
    /// Maximum share of lost messages, from 0 to 1.
    #[cfg_attr(feature = "openapi", schema(minimum = 0, maximum = 1))]
    pub max_loss_ratio: Option<f64>,
    /// Maximum time from the writer's timestamp to the capture, in milliseconds.
    #[cfg_attr(feature = "openapi", schema(minimum = 0, maximum = 3_600_000))]
    pub max_latency_ms: Option<f64>,
    /// Maximum time without a message, in seconds.
    #[cfg_attr(feature = "openapi", schema(minimum = 0.001, maximum = 604_800))]
    pub max_silence_s: Option<f64>,
    /// Minimum number of publishers. The check begins 10 s after the first publisher appears.
    #[cfg_attr(feature = "openapi", schema(minimum = 1, maximum = 10_000))]
    pub publishers: Option<u32>,
    /// Minimum number of subscribers. The check begins 10 s after the first publisher appears.
    #[cfg_attr(feature = "openapi", schema(minimum = 1, maximum = 10_000))]
    pub subscribers: Option<u32>,
}

impl Expectations {
    /// Returns the keys of the configuration that are set, in the order of the fields.
    #[must_use]
    pub fn keys(&self) -> Vec<&'static str> {
        let keys = [
            ("min_rate_hz", self.min_rate_hz.is_some()),
            ("max_rate_hz", self.max_rate_hz.is_some()),
            ("max_loss_ratio", self.max_loss_ratio.is_some()),
            ("max_latency_ms", self.max_latency_ms.is_some()),
            ("max_silence_s", self.max_silence_s.is_some()),
            ("publishers", self.publishers.is_some()),
            ("subscribers", self.subscribers.is_some()),
        ];
        let set = keys.into_iter().filter(|(_, is_set)| *is_set);
        set.map(|(key, _)| key).collect()
    }

    /// Returns the expectation of this key in words.
    #[must_use]
    pub fn in_words(&self, key: &str) -> String {
        let number = |limit: Option<f64>| limit.unwrap_or_default();
        let several = |limit: Option<u32>, noun: &str| match limit.unwrap_or_default() {
            1 => format!("at least 1 {noun}"),
            count => format!("at least {count} {noun}s"),
        };
        match key {
            "min_rate_hz" => format!("at least {} Hz", number(self.min_rate_hz)),
            "max_rate_hz" => format!("at most {} Hz", number(self.max_rate_hz)),
            "max_loss_ratio" => {
                // Without the digits that no double has.
                let percent = (number(self.max_loss_ratio) * 1e6).round() / 1e4;
                format!("a loss of at most {percent} %")
            }
            "max_latency_ms" => format!("a latency of at most {} ms", number(self.max_latency_ms)),
            "max_silence_s" => {
                format!("a message at least every {} s", number(self.max_silence_s))
            }
            "publishers" => several(self.publishers, "publisher"),
            "subscribers" => several(self.subscribers, "subscriber"),
            _ => key.to_owned(),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_expectation_has_words_with_its_limit() {
        let expectations = Expectations {
            min_rate_hz: Some(85.0),
            max_rate_hz: Some(95.0),
            window_s: Some(2),
            max_loss_ratio: Some(0.01),
            max_latency_ms: Some(20.0),
            max_silence_s: Some(1.5),
            publishers: Some(2),
            subscribers: Some(3),
        };
        let words = expectations.keys().into_iter();
        let words: Vec<_> = words.map(|key| expectations.in_words(key)).collect();
        assert_eq!(
            words,
            [
                "at least 85 Hz",
                "at most 95 Hz",
                "a loss of at most 1 %",
                "a latency of at most 20 ms",
                "a message at least every 1.5 s",
                "at least 2 publishers",
                "at least 3 subscribers",
            ]
        );
    }

    #[test]
    fn limits_have_no_digits_of_rounding_and_one_publisher_is_singular() {
        let expectations = Expectations {
            max_loss_ratio: Some(0.07),
            max_latency_ms: Some(1.1),
            publishers: Some(1),
            ..Expectations::default()
        };
        let words = ["max_loss_ratio", "max_latency_ms", "publishers"];
        assert_eq!(
            words.map(|key| expectations.in_words(key)),
            [
                "a loss of at most 7 %",
                "a latency of at most 1.1 ms",
                "at least 1 publisher"
            ]
        );
    }
}
