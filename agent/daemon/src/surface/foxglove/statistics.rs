//! Statistics of a topic as a channel: a flat JSON object of numbers each second. Viewers can plot
//! each number as a series.

use std::sync::{Arc, LazyLock};

use ros2probe_model::facts::histogram::Histogram;
use ros2probe_model::report::snapshot::{Measurement, TopicFacts};
use serde_json::{Map, Value, json};

/// Name of the schema.
pub(super) const SCHEMA_NAME: &str = "ros2probe/TopicStatistics";
/// Prefix of the channels' topics.
pub(super) const TOPIC_PREFIX: &str = "/rp/topics";

/// Times of a topic's messages.
#[derive(Clone, Copy, Debug)]
struct Times {
    latency: Histogram,
    header_latency: Histogram,
    interarrival: Histogram,
}

/// A topic at the end of a second.
struct Second<'a> {
    topic: &'a TopicFacts,
    measured: &'a Measurement,
    /// Times of the messages of this second; `None` in the first second.
    times: Option<Times>,
}

/// The times of a topic at the end of the previous second.
#[derive(Debug, Default)]
pub(super) struct Previous(Option<Times>);

/// Name, description and value of a figure; a figure without a value is left out.
type Figure = (&'static str, &'static str, fn(&Second<'_>) -> Option<f64>);

/// All figures, named as in the API.
const FIGURES: [Figure; 13] = [
    (
        "rate_hertz",
        "Messages per second over the last window.",
        |second| second.topic.rate_hz(),
    ),
    (
        "bandwidth_bytes_per_second",
        "Payload bytes per second over the same window.",
        |second| second.topic.bandwidth(),
    ),
    (
        "messages",
        "Messages received whole, without duplicates.",
        |second| Some(number(second.measured.messages)),
    ),
    ("bytes", "Payload bytes of these messages.", |second| {
        Some(number(second.measured.bytes))
    }),
    (
        "lost_messages",
        "Messages that were sent and reached no receiver of this host whole.",
        |second| Some(number(second.measured.lost)),
    ),
    (
        "loss_ratio",
        "Messages that the worst subscriber lost divided by those that it expected, since the \
         start.",
        |second| second.measured.loss.ratio(),
    ),
    (
        "recovered_messages",
        "Messages that arrived late and closed a gap.",
        |second| Some(number(second.measured.recovered)),
    ),
    (
        "latency_p50_seconds",
        "Median time from the writer's timestamp to the capture, of the last second.",
        |second| second.times?.latency.quantile(0.5),
    ),
    (
        "latency_p99_seconds",
        "99th percentile of the same time.",
        |second| second.times?.latency.quantile(0.99),
    ),
    (
        "header_latency_p50_seconds",
        "Median time from the message's Header.stamp to the capture, of the last second.",
        |second| second.times?.header_latency.quantile(0.5),
    ),
    (
        "interarrival_p99_seconds",
        "99th percentile of the time between messages of one writer, of the last second.",
        |second| second.times?.interarrival.quantile(0.99),
    ),
    ("publishers", "Live writers.", |second| {
        Some(count(second.topic.publishers.len()))
    }),
    ("subscriptions", "Live readers.", |second| {
        Some(count(second.topic.subscriptions.len()))
    }),
];

/// Returns the JSON schema of the channels' messages.
pub(super) fn schema() -> Arc<str> {
    static SCHEMA: LazyLock<Arc<str>> = LazyLock::new(|| {
        let figures = FIGURES.iter().map(|(name, description, _)| {
            let schema = json!({"type": "number", "description": description});
            ((*name).to_owned(), schema)
        });
        let schema = json!({
            "title": SCHEMA_NAME,
            "type": "object",
            "properties": figures.collect::<Map<String, Value>>(),
        });
        schema.to_string().into()
    });
    Arc::clone(&SCHEMA)
}

/// Returns the message of a measured topic at the end of a second.
pub(super) fn message(
    topic: &TopicFacts,
    measured: &Measurement,
    previous: &mut Previous,
) -> Vec<u8> {
    let now = Times {
        latency: measured.source_latency,
        header_latency: measured.header_latency,
        interarrival: measured.interarrival,
    };
    let before = previous.0.replace(now);
    let times = before.map(|before| Times {
        latency: now.latency.since(&before.latency),
        header_latency: now.header_latency.since(&before.header_latency),
        interarrival: now.interarrival.since(&before.interarrival),
    });
    let second = Second {
        topic,
        measured,
        times,
    };
    let figures = FIGURES.iter().filter_map(|(name, _, read)| {
        let value = read(&second).filter(|value| value.is_finite())?;
        Some(((*name).to_owned(), json!(value)))
    });
    Value::Object(figures.collect()).to_string().into_bytes()
}

#[expect(
    clippy::cast_precision_loss,
    reason = "counts far below 2^52, and viewers plot them"
)]
fn number(count: u64) -> f64 {
    count as f64
}

fn count(length: usize) -> f64 {
    number(length as u64)
}
