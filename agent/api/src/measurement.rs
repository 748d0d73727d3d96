//! Counts and times of a topic, a writer or a delivery.

use serde::{Deserialize, Serialize};

/// Counts and times of a topic or writer while it was watched.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(default)]
pub struct Measurement {
    /// Messages received whole, without duplicates.
    pub messages: u64,
    /// Payload bytes of the counted messages.
    pub bytes: u64,
    /// Messages that were sent but reached no receiver on this host whole. A subscriber may lose
    /// more: see `subscriber_lost_messages`.
    pub lost_messages: u64,
    /// Messages that arrived late and closed a gap.
    pub recovered_messages: u64,
    /// Messages and fragments received more than once.
    pub duplicate_messages: u64,
    /// Lost messages of which some fragments were received.
    pub incomplete_messages: u64,
    /// Messages that the writer skipped (GAP), or that readers acknowledged although the agent did
    /// not see them. They do not count as lost.
    pub irrelevant_messages: u64,
    /// Messages that the topic's worst subscriber expected, which means that it received or lost
    /// them. For a writer, and for a topic without observed deliveries, messages that were sent.
    pub subscriber_expected_messages: u64,
    /// Messages that the worst subscriber lost, anywhere on the path to its socket.
    pub subscriber_lost_messages: u64,
    /// Messages that the worst subscriber lost, divided by the messages that it expected; null
    /// before the first expected message.
    pub loss_ratio: Option<f64>,
    /// Messages per second over the last window; null if messages cannot be observed, for example
    /// within a process.
    pub rate_hertz: Option<f64>,
    /// Payload bytes per second over the same window; null if the sizes are unknown, for example of
    /// messages that only calls inside processes show.
    pub bandwidth_bytes_per_second: Option<f64>,
    /// Unix time of the last message.
    pub last_message_timestamp_seconds: Option<f64>,
    /// Time between consecutive messages of one writer.
    pub interarrival: Option<Distribution>,
    /// Time from the writer's timestamp to the capture; across hosts it requires synchronised
    /// clocks.
    pub latency: Option<Distribution>,
    /// Time from the message's `Header.stamp` to the capture; across hosts it requires synchronised
    /// clocks.
    pub header_latency: Option<Distribution>,
    /// Messages whose timestamp is later than their capture: the clocks differ.
    pub negative_latency_messages: u64,
    /// Messages whose timestamp is more than an hour before or after their capture. The sender's
    /// clock was never set, or the timestamp is forged.
    pub implausible_latency_messages: u64,
    /// Jumps of the sequence number that a single datagram suggests but does not prove.
    pub doubted_sequence_jumps: u64,
    /// Coverage of the shared-memory sampling; null if all messages were captured on the network.
    pub sampled: Option<Sampled>,
}

/// Coverage of shared-memory sampling.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(default)]
pub struct Sampled {
    /// Messages of which at least a part was read.
    pub seen_messages: u64,
    /// Messages that were written, according to their sequence numbers.
    pub existing_messages: u64,
    /// Number of times that the buffer may have been overwritten unseen between two readings.
    pub uncertain_looks: u64,
    /// Messages read divided by messages written; null before the first message.
    pub coverage_ratio: Option<f64>,
}

/// A distribution of durations. Percentiles are estimated from a histogram.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(default)]
pub struct Distribution {
    /// Number of values.
    pub count: u64,
    /// Mean.
    pub mean_seconds: f64,
    /// Minimum.
    pub minimum_seconds: f64,
    /// Median.
    pub p50_seconds: f64,
    /// 95th percentile.
    pub p95_seconds: f64,
    /// 99th percentile.
    pub p99_seconds: f64,
    /// Maximum.
    pub maximum_seconds: f64,
}

/// A bucket of a histogram.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(default)]
pub struct Bucket {
    /// Inclusive upper bound in seconds; null for the last bucket. The lower bound is the upper
    /// bound of the previous bucket.
    pub upper_seconds: Option<f64>,
    /// Number of values in this bucket.
    pub count: u64,
}

/// Delivered, lost and pending messages of a receiver or destination.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(default)]
pub struct Delivered {
    /// Messages that arrived whole, or left whole.
    pub messages: u64,
    /// Payload bytes of the counted messages.
    pub bytes: u64,
    /// Messages that arrived by retransmission.
    pub recovered_messages: u64,
    /// Messages that never arrived, by any known cause. The sum of delivered, lost and pending
    /// messages is the number that the receiver expected.
    pub lost_messages: u64,
    /// Lost messages that the sender dropped before its TCP connection.
    pub lost_at_sender_messages: u64,
    /// Lost messages that never reached this host.
    pub lost_before_host_messages: u64,
    /// Lost messages that failed IP reassembly on this host.
    pub lost_in_reassembly_messages: u64,
    /// Lost messages that the full receive buffer of the subscriber's socket dropped.
    pub lost_in_socket_buffer_messages: u64,
    /// Missing messages that may still arrive, or whose cause is not known yet.
    pub pending_messages: u64,
    /// Messages that arrived at a process without a known reader that matches the writer.
    pub unmatched_messages: u64,
    /// Messages and fragments that arrived more than once.
    pub duplicate_messages: u64,
    /// Messages that the writer skipped (GAP), or that readers acknowledged although the agent did
    /// not see them. They do not count as lost.
    pub irrelevant_messages: u64,
}

/// Time that messages spent in each stage on this host.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(default)]
pub struct Breakdown {
    /// From the writer's timestamp to the departure of the first datagram from this host.
    pub send_delay: Option<Distribution>,
    /// From departure to arrival, if both happen on this host.
    pub transit: Option<Distribution>,
    /// From the first to the last datagram of a message that needs several.
    pub transfer: Option<Distribution>,
    /// From the detection of a missing message to its arrival by retransmission.
    pub retransmission: Option<Distribution>,
}
