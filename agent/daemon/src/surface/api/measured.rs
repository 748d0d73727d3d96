//! Numbers of a topic, a writer or a way to a receiver, as answers show them.

use serde::Serialize;
use utoipa::ToSchema;

use ros2probe_model::histogram::Histogram;
use ros2probe_model::snapshot::{Breakdown, Delivered, Measurement};

/// What was counted while the topic was watched.
#[derive(Debug, Serialize, ToSchema)]
#[schema(as = Measurement)]
pub(super) struct MeasurementView {
    /// Messages seen whole, each once.
    messages: u64,
    /// Their payload bytes.
    bytes: u64,
    /// Messages that were sent but never seen whole.
    lost_messages: u64,
    /// Messages that filled a gap later.
    recovered_messages: u64,
    /// Messages and fragments seen again.
    duplicate_messages: u64,
    /// Lost messages of which a part was seen.
    incomplete_messages: u64,
    /// Messages that the writer left out (GAP), or that readers acknowledged unseen; no losses.
    irrelevant_messages: u64,
    /// Lost of those that were sent; null while there were none.
    loss_ratio: Option<f64>,
    /// Messages a second over the last window.
    rate_hertz: f64,
    /// Payload bytes a second over the same window.
    bandwidth_bytes_per_second: f64,
    /// Unix time of the last message.
    last_message_timestamp_seconds: Option<f64>,
    /// Between consecutive messages of one writer.
    interarrival: Option<Distribution>,
    /// From the writer's timestamp to the capture; across hosts it needs synchronised clocks.
    latency: Option<Distribution>,
    /// From the message's `Header.stamp` to the capture; likewise.
    header_latency: Option<Distribution>,
    /// Messages stamped after their capture: clocks are apart.
    negative_latency_messages: u64,
    /// Messages stamped more than an hour before or after their capture: the sender's clock was never
    /// set, or the timestamp is forged.
    implausible_latency_messages: u64,
    /// Jumps of sequence numbers that one datagram does not prove.
    doubted_sequence_jumps: u64,
    /// Present when some of this was read from shared memory, which is a sampled view.
    sampled: Option<SampledView>,
}

/// How much a sampled view saw.
#[derive(Debug, Serialize, ToSchema)]
#[schema(as = Sampled)]
struct SampledView {
    /// Messages of which at least a part was seen.
    seen_messages: u64,
    /// Messages that there were, by their sequence numbers.
    existing_messages: u64,
    /// How often something may have gone unnoticed between two looks.
    uncertain_looks: u64,
    /// Seen of those that there were; null while there were none.
    coverage_ratio: Option<f64>,
}

/// Seconds that something took. Percentiles are estimates from a histogram.
#[derive(Debug, Serialize, ToSchema)]
pub(super) struct Distribution {
    /// How many values.
    count: u64,
    /// Mean.
    mean_seconds: f64,
    /// Smallest value.
    minimum_seconds: f64,
    /// Half of the values are below it.
    p50_seconds: f64,
    /// 95 % of the values are below it.
    p95_seconds: f64,
    /// 99 % of the values are below it.
    p99_seconds: f64,
    /// Largest value.
    maximum_seconds: f64,
}

/// Part of a histogram.
#[derive(Debug, Serialize, ToSchema)]
#[schema(as = Bucket)]
pub(super) struct BucketView {
    /// Values are at most this, and above the one before; null for those above all bounds.
    upper_seconds: Option<f64>,
    /// How many.
    count: u64,
}

/// The buckets of a histogram; none while it is empty.
pub(super) fn buckets(values: &Histogram) -> Vec<BucketView> {
    let buckets = values.buckets().filter(|_| values.count() > 0);
    let bucket = |(upper, count): (f64, u64)| BucketView {
        upper_seconds: upper.is_finite().then_some(upper),
        count,
    };
    buckets.map(bucket).collect()
}

/// What became of messages on their way.
#[derive(Debug, Serialize, ToSchema)]
#[schema(as = Delivered)]
pub(super) struct DeliveredView {
    /// Messages that came, or left, whole.
    messages: u64,
    /// Their payload bytes.
    bytes: u64,
    /// Messages that came by retransmission.
    recovered_messages: u64,
    /// Messages that never came, whatever the cause.
    lost_messages: u64,
    /// Of these: never reached this host.
    lost_before_host_messages: u64,
    /// Of these: died in IP reassembly on this host.
    lost_in_reassembly_messages: u64,
    /// Of these: died in the full receive buffer of the subscriber's socket.
    lost_in_socket_buffer_messages: u64,
    /// Of these: it is not known yet where.
    pending_messages: u64,
    /// Messages that arrived where no reader of the topic is.
    unmatched_messages: u64,
    /// Messages and fragments that came again.
    duplicate_messages: u64,
    /// Messages that the writer left out (GAP), or that readers acknowledged unseen; no losses.
    irrelevant_messages: u64,
}

/// Where messages spent their time on this host.
#[derive(Debug, Serialize, ToSchema)]
#[schema(as = Breakdown)]
pub(super) struct BreakdownView {
    /// From the writer's timestamp to the first datagram leaving this host.
    send_delay: Option<Distribution>,
    /// From leaving to arriving, where both happen on this host.
    transit: Option<Distribution>,
    /// From the first to the last datagram of a message that came in several.
    transfer: Option<Distribution>,
    /// From noticing that a message is missing to its arrival by retransmission.
    retransmission: Option<Distribution>,
}

impl From<&Measurement> for MeasurementView {
    #[expect(
        clippy::cast_precision_loss,
        reason = "a ratio of counts far below 2^52"
    )]
    fn from(facts: &Measurement) -> Self {
        let sent = facts.messages + facts.lost;
        let last_message = facts.last_message;
        Self {
            messages: facts.messages,
            bytes: facts.bytes,
            lost_messages: facts.lost,
            recovered_messages: facts.recovered,
            duplicate_messages: facts.duplicates,
            incomplete_messages: facts.incomplete,
            irrelevant_messages: facts.irrelevant,
            loss_ratio: (sent > 0).then(|| facts.lost as f64 / sent as f64),
            rate_hertz: facts.rate_hz,
            bandwidth_bytes_per_second: facts.bandwidth,
            last_message_timestamp_seconds: last_message.map(|time| time.seconds()),
            interarrival: Distribution::of(&facts.interarrival),
            latency: Distribution::of(&facts.source_latency),
            header_latency: Distribution::of(&facts.header_latency),
            negative_latency_messages: facts.negative_latency,
            implausible_latency_messages: facts.implausible_latency,
            doubted_sequence_jumps: facts.sequence_jumps,
            sampled: facts.sampled.as_ref().map(|sampled| SampledView {
                seen_messages: sampled.seen,
                existing_messages: sampled.span,
                uncertain_looks: sampled.uncertain,
                coverage_ratio: sampled.coverage(),
            }),
        }
    }
}

impl From<&Delivered> for DeliveredView {
    fn from(facts: &Delivered) -> Self {
        Self {
            messages: facts.messages,
            bytes: facts.bytes,
            recovered_messages: facts.recovered,
            lost_messages: facts.lost(),
            lost_before_host_messages: facts.lost_before_host,
            lost_in_reassembly_messages: facts.lost_in_reassembly,
            lost_in_socket_buffer_messages: facts.lost_in_socket_buffer,
            pending_messages: facts.pending,
            unmatched_messages: facts.unmatched,
            duplicate_messages: facts.duplicates,
            irrelevant_messages: facts.irrelevant,
        }
    }
}

impl From<&Breakdown> for BreakdownView {
    fn from(facts: &Breakdown) -> Self {
        Self {
            send_delay: Distribution::of(&facts.send_delay),
            transit: Distribution::of(&facts.transit),
            transfer: Distribution::of(&facts.transfer),
            retransmission: Distribution::of(&facts.retransmission),
        }
    }
}

impl Distribution {
    /// `None` while there is no value.
    #[expect(
        clippy::cast_precision_loss,
        reason = "a mean of counts far below 2^52"
    )]
    fn of(values: &Histogram) -> Option<Self> {
        let (minimum, maximum) = values.range()?;
        let count = values.count();
        let part = |part: f64| values.quantile(part).clamp(minimum, maximum);
        Some(Self {
            count,
            mean_seconds: values.sum() / count as f64,
            minimum_seconds: minimum,
            p50_seconds: part(0.5),
            p95_seconds: part(0.95),
            p99_seconds: part(0.99),
            maximum_seconds: maximum,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn percentiles_lie_within_their_buckets_and_the_range() {
        let mut values = Histogram::default();
        for _ in 0..98 {
            values.observe(0.0015);
        }
        values.observe(0.3);
        values.observe(40.0);
        let shown = Distribution::of(&values).unwrap();
        assert!((0.001..=0.002).contains(&shown.p50_seconds), "{shown:?}");
        assert!((0.001..=0.002).contains(&shown.p95_seconds), "{shown:?}");
        assert!((0.2..=0.5).contains(&shown.p99_seconds), "{shown:?}");
        assert_eq!(
            (shown.minimum_seconds, shown.maximum_seconds),
            (0.0015, 40.0)
        );
        assert!(Distribution::of(&Histogram::default()).is_none());
    }

    #[test]
    fn buckets_add_up_and_the_last_has_no_bound() {
        let mut values = Histogram::default();
        assert!(buckets(&values).is_empty());
        values.observe(0.0015);
        values.observe(40.0);
        let shown = buckets(&values);
        assert_eq!(shown.iter().map(|bucket| bucket.count).sum::<u64>(), 2);
        let last = shown.last().unwrap();
        assert_eq!((last.upper_seconds, last.count), (None, 1));
    }

    #[test]
    fn one_value_is_every_percentile() {
        let mut values = Histogram::default();
        values.observe(99.0);
        let shown = Distribution::of(&values).unwrap();
        assert_eq!((shown.p50_seconds, shown.p99_seconds), (99.0, 99.0));
    }
}
