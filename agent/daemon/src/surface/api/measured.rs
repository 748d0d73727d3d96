//! Counts and times of topics, writers and deliveries in answers.

use ros2probe_api::measurement::{
    Breakdown, Bucket, Delivered, Distribution, Measurement, Sampled,
};
use ros2probe_model::facts::histogram::Histogram;
use ros2probe_model::facts::wall_clock::WallClock;
use ros2probe_model::report::snapshot;

/// Returns the buckets of a histogram, or none if the histogram is empty.
pub(super) fn buckets(values: &Histogram) -> Vec<Bucket> {
    let buckets = values.buckets().filter(|_| values.count() > 0);
    let bucket = |(upper, count): (f64, u64)| Bucket {
        upper_seconds: upper.is_finite().then_some(upper),
        count,
    };
    buckets.map(bucket).collect()
}

/// Returns the API representation of a measurement.
pub(super) fn measurement(facts: &snapshot::Measurement, clock: WallClock) -> Measurement {
    let last_message = facts.last_message;
    Measurement {
        messages: facts.messages,
        bytes: facts.bytes,
        lost_messages: facts.lost,
        recovered_messages: facts.recovered,
        duplicate_messages: facts.duplicates,
        incomplete_messages: facts.incomplete,
        irrelevant_messages: facts.irrelevant,
        subscriber_expected_messages: facts.loss.expected,
        subscriber_lost_messages: facts.loss.lost,
        loss_ratio: facts.loss.ratio(),
        rate_hertz: Some(facts.rate_hz),
        bandwidth_bytes_per_second: Some(facts.bandwidth),
        last_message_timestamp_seconds: last_message.map(|at| clock.wall_time(at).seconds()),
        interarrival: distribution(&facts.interarrival),
        latency: distribution(&facts.source_latency),
        header_latency: distribution(&facts.header_latency),
        negative_latency_messages: facts.negative_latency,
        implausible_latency_messages: facts.implausible_latency,
        doubted_sequence_jumps: facts.sequence_jumps,
        sampled: facts.sampled.as_ref().map(|sampled| Sampled {
            seen_messages: sampled.seen,
            existing_messages: sampled.span,
            uncertain_looks: sampled.uncertain,
            coverage_ratio: sampled.coverage(),
        }),
    }
}

/// Returns the API representation of a topic's measurement.
pub(super) fn topic_measurement(
    facts: &snapshot::TopicFacts,
    clock: WallClock,
) -> Option<Measurement> {
    Some(Measurement {
        rate_hertz: facts.rate_hz(),
        bandwidth_bytes_per_second: facts.bandwidth(),
        ..measurement(facts.measurement.as_deref()?, clock)
    })
}

/// Returns the API representation of a delivery's counts.
pub(super) fn delivered(facts: &snapshot::Delivered) -> Delivered {
    Delivered {
        messages: facts.messages,
        bytes: facts.bytes,
        recovered_messages: facts.recovered,
        lost_messages: facts.lost_by_any(),
        lost_at_sender_messages: facts.lost_at_sender,
        lost_before_host_messages: facts.lost_before_host,
        lost_in_reassembly_messages: facts.lost_in_reassembly,
        lost_in_socket_buffer_messages: facts.lost_in_socket_buffer,
        pending_messages: facts.open(),
        unmatched_messages: facts.unmatched,
        duplicate_messages: facts.duplicates,
        irrelevant_messages: facts.irrelevant,
    }
}

/// Returns the API representation of the times per stage.
pub(super) fn breakdown(facts: &snapshot::Breakdown) -> Breakdown {
    Breakdown {
        send_delay: distribution(&facts.send_delay),
        transit: distribution(&facts.transit),
        transfer: distribution(&facts.transfer),
        retransmission: distribution(&facts.retransmission),
    }
}

/// Returns the distribution, or `None` if the histogram is empty.
#[expect(
    clippy::cast_precision_loss,
    reason = "a mean of counts far below 2^52"
)]
fn distribution(values: &Histogram) -> Option<Distribution> {
    let (minimum, maximum) = values.range()?;
    let count = values.count();
    Some(Distribution {
        count,
        mean_seconds: values.sum() / count as f64,
        minimum_seconds: minimum,
        p50_seconds: values.quantile(0.5)?,
        p95_seconds: values.quantile(0.95)?,
        p99_seconds: values.quantile(0.99)?,
        maximum_seconds: maximum,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn percentiles_are_within_their_buckets_and_the_range() {
        let mut values = Histogram::default();
        for _ in 0..98 {
            values.observe(0.0015);
        }
        values.observe(0.3);
        values.observe(40.0);
        let shown = distribution(&values).unwrap();
        assert!((0.001..=0.002).contains(&shown.p50_seconds), "{shown:?}");
        assert!((0.001..=0.002).contains(&shown.p95_seconds), "{shown:?}");
        assert!((0.2..=0.5).contains(&shown.p99_seconds), "{shown:?}");
        assert_eq!(
            (shown.minimum_seconds, shown.maximum_seconds),
            (0.0015, 40.0)
        );
        assert!(distribution(&Histogram::default()).is_none());
    }

    #[test]
    fn buckets_add_up_and_the_last_bucket_has_no_bound() {
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
    fn a_single_value_is_every_percentile() {
        let mut values = Histogram::default();
        values.observe(99.0);
        let shown = distribution(&values).unwrap();
        assert_eq!((shown.p50_seconds, shown.p99_seconds), (99.0, 99.0));
    }
}
