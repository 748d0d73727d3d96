//! Counts and times of a topic, a writer or a delivery.

use serde::{Deserialize, Serialize};

/// What was counted while the topic was watched.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(default)]
pub struct Measurement {
    /// Messages seen whole, each once.
    pub messages: u64,
    /// Their payload bytes.
    pub bytes: u64,
    /// Messages that were sent but never seen whole.
    pub lost_messages: u64,
    /// Messages that filled a gap later.
    pub recovered_messages: u64,
    /// Messages and fragments seen again.
    pub duplicate_messages: u64,
    /// Lost messages of which a part was seen.
    pub incomplete_messages: u64,
    /// Messages that the writer left out (GAP), or that readers acknowledged unseen; no losses.
    pub irrelevant_messages: u64,
    /// Lost of those that were sent; null while there were none.
    pub loss_ratio: Option<f64>,
    /// Messages a second over the last window.
    pub rate_hertz: f64,
    /// Payload bytes a second over the same window.
    pub bandwidth_bytes_per_second: f64,
    /// Unix time of the last message.
    pub last_message_timestamp_seconds: Option<f64>,
    /// Between consecutive messages of one writer.
    pub interarrival: Option<Distribution>,
    /// From the writer's timestamp to the capture; across hosts it needs synchronised clocks.
    pub latency: Option<Distribution>,
    /// From the message's `Header.stamp` to the capture; likewise.
    pub header_latency: Option<Distribution>,
    /// Messages stamped after their capture: clocks are apart.
    pub negative_latency_messages: u64,
    /// Messages stamped more than an hour before or after their capture: the sender's clock was never
    /// set, or the timestamp is forged.
    pub implausible_latency_messages: u64,
    /// Jumps of sequence numbers that one datagram does not prove.
    pub doubted_sequence_jumps: u64,
    /// Present when some of this was read from shared memory, which is a sampled view.
    pub sampled: Option<Sampled>,
}

/// How much a sampled view saw.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(default)]
pub struct Sampled {
    /// Messages of which at least a part was seen.
    pub seen_messages: u64,
    /// Messages that there were, by their sequence numbers.
    pub existing_messages: u64,
    /// How often something may have gone unnoticed between two looks.
    pub uncertain_looks: u64,
    /// Seen of those that there were; null while there were none.
    pub coverage_ratio: Option<f64>,
}

/// Seconds that something took. Percentiles are estimates from a histogram.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(default)]
pub struct Distribution {
    /// How many values.
    pub count: u64,
    /// Mean.
    pub mean_seconds: f64,
    /// Smallest value.
    pub minimum_seconds: f64,
    /// Half of the values are below it.
    pub p50_seconds: f64,
    /// 95 % of the values are below it.
    pub p95_seconds: f64,
    /// 99 % of the values are below it.
    pub p99_seconds: f64,
    /// Largest value.
    pub maximum_seconds: f64,
}

/// Part of a histogram.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(default)]
pub struct Bucket {
    /// Values are at most this, and above the one before; null for those above all bounds.
    pub upper_seconds: Option<f64>,
    /// How many.
    pub count: u64,
}

/// What became of messages on their way.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(default)]
pub struct Delivered {
    /// Messages that came, or left, whole.
    pub messages: u64,
    /// Their payload bytes.
    pub bytes: u64,
    /// Messages that came by retransmission.
    pub recovered_messages: u64,
    /// Messages that never came, whatever the cause.
    pub lost_messages: u64,
    /// Of these: never reached this host.
    pub lost_before_host_messages: u64,
    /// Of these: died in IP reassembly on this host.
    pub lost_in_reassembly_messages: u64,
    /// Of these: died in the full receive buffer of the subscriber's socket.
    pub lost_in_socket_buffer_messages: u64,
    /// Of these: it is not known yet where.
    pub pending_messages: u64,
    /// Messages that arrived where no reader of the topic is.
    pub unmatched_messages: u64,
    /// Messages and fragments that came again.
    pub duplicate_messages: u64,
    /// Messages that the writer left out (GAP), or that readers acknowledged unseen; no losses.
    pub irrelevant_messages: u64,
}

/// Where messages spent their time on this host.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(default)]
pub struct Breakdown {
    /// From the writer's timestamp to the first datagram leaving this host.
    pub send_delay: Option<Distribution>,
    /// From leaving to arriving, where both happen on this host.
    pub transit: Option<Distribution>,
    /// From the first to the last datagram of a message that came in several.
    pub transfer: Option<Distribution>,
    /// From noticing that a message is missing to its arrival by retransmission.
    pub retransmission: Option<Distribution>,
}
