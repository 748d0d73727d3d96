//! `/chains`.

use std::borrow::Cow;

use serde::{Deserialize, Serialize};

/// Chains of messages.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(default)]
pub struct ChainList<'a> {
    /// Unix time of the state that this answer describes.
    pub timestamp_seconds: f64,
    /// Chains, sorted by domain, method and topics. Without `from` and `to`, chains that are part
    /// of another chain are left out.
    pub chains: Vec<Chain<'a>>,
    /// Configured chains, in the configuration's order, with one entry per domain and method.
    pub expected: Vec<ExpectedChain<'a>>,
}

/// A chain, or the part of it from one topic to another.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(default)]
pub struct Chain<'a> {
    /// Domain id.
    pub domain_id: u32,
    /// How the chain was recognised: by `stamps` of headers, or by `causality` within processes.
    #[cfg_attr(feature = "openapi", schema(example = "stamps"))]
    pub method: Cow<'a, str>,
    /// ROS name of the first topic.
    #[cfg_attr(feature = "openapi", schema(example = "/points"))]
    pub from: Cow<'a, str>,
    /// ROS name of the last topic.
    #[cfg_attr(feature = "openapi", schema(example = "/cmd_vel"))]
    pub to: Cow<'a, str>,
    /// Node that publishes the first topic; null if it is not known.
    pub source: Option<Cow<'a, str>>,
    /// Nodes of the chain with their inputs and outputs, in order.
    pub hops: Vec<Hop<'a>>,
    /// Messages that passed the whole path.
    pub messages: u64,
    /// Time from the first publication to the last.
    pub latency: Quantiles,
    /// Index in `hops` of the hop with the largest median.
    pub bottleneck: Option<u64>,
    /// Unix time of the latest message on the last topic.
    pub last_seen_seconds: f64,
}

/// A node of a chain. Durations that were not observed are null.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(default)]
pub struct Hop<'a> {
    /// Topic that the node reads.
    pub input: Cow<'a, str>,
    /// Name of the node; null if it is not known.
    pub node: Option<Cow<'a, str>>,
    /// Topic that the node publishes.
    pub output: Cow<'a, str>,
    /// Time from the publication of the input to that of the output.
    pub latency: Quantiles,
    /// Time from the publication of the input to its arrival at the node.
    pub transit: Option<Quantiles>,
    /// Time from the arrival to the start of the callback.
    pub wait: Option<Quantiles>,
    /// Time from the start of the callback to the publication of the output.
    pub callback: Option<Quantiles>,
    /// Time from the arrival to the publication of the output.
    pub processing: Option<Quantiles>,
}

/// Quantiles of the latest 256 durations, in seconds, by nearest rank.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(default)]
pub struct Quantiles {
    /// Median.
    pub p50_seconds: f64,
    /// 99th percentile.
    pub p99_seconds: f64,
    /// Maximum.
    pub maximum_seconds: f64,
}

/// A configured chain.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(default)]
pub struct ExpectedChain<'a> {
    /// Domain id; null for a chain of every domain before its first message.
    pub domain_id: Option<u32>,
    /// ROS name of the first topic.
    pub from: Cow<'a, str>,
    /// ROS name of the last topic.
    pub to: Cow<'a, str>,
    /// Maximum latency of the chain, in milliseconds; null without a limit.
    pub max_latency_ms: Option<f64>,
    /// How the chain was recognised; null before its first message.
    pub method: Option<Cow<'a, str>>,
    /// `ok`, `slow`, or `idle` without a message in the last 10 s.
    #[cfg_attr(feature = "openapi", schema(example = "ok"))]
    pub state: Cow<'a, str>,
    /// Time from the first publication to the last; null before the first message.
    pub latency: Option<Quantiles>,
}
