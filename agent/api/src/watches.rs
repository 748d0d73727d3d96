//! `/watch` and `/watch/{topic}`.

use std::borrow::Cow;

use serde::{Deserialize, Serialize};

use crate::Open;

/// What is watched.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(default)]
pub struct WatchList {
    /// Those of the configuration, of the command line, and then of clients, as they came.
    pub watches: Vec<Watch>,
}

/// One watch.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(default)]
#[expect(
    missing_docs,
    reason = "the document describes expectations where they are declared"
)]
pub struct Watch {
    /// ROS name or glob.
    #[cfg_attr(feature = "openapi", schema(example = "/points"))]
    pub topic: String,
    /// Only in this domain; every domain when it is null.
    #[cfg_attr(feature = "openapi", schema(minimum = 0, maximum = 232))]
    pub domain_id: Option<u32>,
    /// Who asked for it.
    #[cfg_attr(feature = "openapi", schema(value_type = Origin))]
    pub origin: Open<Origin>,
    /// What has become of it.
    #[cfg_attr(feature = "openapi", schema(value_type = WatchState))]
    pub state: Open<WatchState>,
    /// Series per writer and subscriber.
    pub per_subscriber: bool,
    /// The part of the messages of which spans are exported.
    #[cfg_attr(feature = "openapi", schema(minimum = 0, maximum = 1))]
    pub trace: f64,
    /// `last`: the last message of each transient-local writer is kept for recordings that begin later.
    pub retain: Retain,
    #[serde(flatten)]
    pub expectations: Expectations,
    /// The topics it covers now, and a name that does not exist yet.
    pub topics: Vec<WatchedTopic>,
}

/// What is kept of a topic's messages for recordings that begin later.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(rename_all = "lowercase")]
pub enum Retain {
    /// Nothing.
    #[default]
    None,
    /// The last one of each writer that keeps its own for late joiners (transient local).
    Last,
}

/// What should hold for each topic; what is left out is not expected.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema), schema(as = ExpectationsView))]
pub struct Expectations {
    /// At least this many messages a second.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[cfg_attr(feature = "openapi", schema(nullable = false))]
    pub min_rate_hz: Option<f64>,
    /// At most this many messages a second.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[cfg_attr(feature = "openapi", schema(nullable = false))]
    pub max_rate_hz: Option<f64>,
    /// At most this part of the messages may be lost, 0 to 1.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[cfg_attr(feature = "openapi", schema(nullable = false))]
    pub max_loss_ratio: Option<f64>,
    /// Longest time from the writer's timestamp to the capture, in milliseconds.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[cfg_attr(feature = "openapi", schema(nullable = false))]
    pub max_latency_ms: Option<f64>,
    /// Longest time without a message, in seconds.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[cfg_attr(feature = "openapi", schema(nullable = false))]
    pub max_silence_s: Option<f64>,
}

/// Who asked for a watch.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(rename_all = "snake_case")]
pub enum Origin {
    /// The configuration file.
    Config,
    /// `--watch`.
    CommandLine,
    /// A client of this API.
    Api,
}

/// What has become of a watch.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema), schema(as = Stage))]
#[serde(rename_all = "snake_case")]
pub enum WatchState {
    /// Taken over with the next packets.
    Starting,
    /// No such topic yet: it is measured as soon as it appears.
    Waiting,
    /// Its topics are measured.
    Measuring,
    /// There is such a topic, but `limits.topics` are measured already.
    Rejected,
}

/// A watched topic.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema), schema(as = TopicView))]
#[serde(default)]
pub struct WatchedTopic {
    /// Domain.
    pub domain_id: u32,
    /// ROS name.
    pub topic: String,
    /// How it stands with what is expected.
    #[cfg_attr(feature = "openapi", schema(value_type = TopicState))]
    pub state: Open<TopicState>,
    /// Expectations that are broken.
    pub violations: Vec<Cow<'static, str>>,
    /// Messages counted while it was watched.
    pub messages: u64,
    /// Messages a second over the last window.
    pub rate_hertz: f64,
}

/// How a topic stands with what is expected of it.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(rename_all = "snake_case")]
pub enum TopicState {
    /// All expectations hold.
    Ok,
    /// One is broken.
    Violated,
    /// Nothing came for longer than `max_silence_s`.
    Silent,
    /// Nobody publishes it.
    NotPublished,
    /// Nobody subscribes to it.
    NoSubscriber,
}

/// How a topic is to be watched. Every field may be left out, and so may the body.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(deny_unknown_fields, default)]
pub struct WatchRequest {
    /// Only in this domain; every domain when left out. The same as the query's.
    #[cfg_attr(feature = "openapi", schema(minimum = 0, maximum = 232))]
    pub domain_id: Option<u32>,
    /// Series per writer and subscriber of each covered topic, besides those per topic.
    pub per_subscriber: bool,
    /// The part of each covered topic's messages of which spans are exported, 0 to 1.
    #[cfg_attr(feature = "openapi", schema(minimum = 0, maximum = 1))]
    pub trace: f64,
    /// `last`: keep the last message of each transient-local writer for recordings that begin later.
    pub retain: Retain,
    /// At least this many messages a second.
    #[cfg_attr(feature = "openapi", schema(minimum = 0, maximum = 1_000_000))]
    pub min_rate_hz: Option<f64>,
    /// At most this many messages a second.
    #[cfg_attr(feature = "openapi", schema(minimum = 0, maximum = 1_000_000))]
    pub max_rate_hz: Option<f64>,
    /// At most this part of the messages may be lost, 0 to 1.
    #[cfg_attr(feature = "openapi", schema(minimum = 0, maximum = 1))]
    pub max_loss_ratio: Option<f64>,
    /// Longest time from the writer's timestamp to the capture, in milliseconds.
    #[cfg_attr(feature = "openapi", schema(minimum = 0, maximum = 3_600_000))]
    pub max_latency_ms: Option<f64>,
    /// Longest time without a message, in seconds.
    #[cfg_attr(feature = "openapi", schema(minimum = 0.001, maximum = 604_800))]
    pub max_silence_s: Option<f64>,
}
