//! Periodic export of the metrics that the page shows.
//!
//! Points are cumulative, so none are kept while the receiver is unavailable: the next collection
//! supersedes them.

use std::sync::Arc;
use std::time::{Duration, Instant, SystemTime};

use opentelemetry_otlp::MetricExporter;
use opentelemetry_sdk::Resource;
use opentelemetry_sdk::error::OTelSdkResult;
use opentelemetry_sdk::metrics::exporter::PushMetricExporter as _;
use tokio::time::{MissedTickBehavior, interval_at};

use super::delivery::{BatchResult, Delivery, Export};
use super::encoded_sender::EncodedSender;
use super::points::{Batch, Collection, Points};
use crate::metric_sink::MetricSink;
use crate::metric_source::MetricSource;

/// Maximum time to wait for a fresh snapshot, as for a scrape.
const REFRESH_TIMEOUT: Duration = Duration::from_millis(600);

/// Exports metrics.
pub(super) struct MetricExport {
    pub(super) exporter: MetricExporter,
    /// Sends the points that the exporter cannot carry.
    pub(super) encoded: EncodedSender,
}

impl Export for MetricExport {
    type Batch = Batch;

    fn items(batch: &Batch) -> u64 {
        batch.items()
    }

    async fn export(&self, batch: &Batch) -> OTelSdkResult {
        match batch {
            Batch::Metrics(metrics, _) => self.exporter.export(metrics).await,
            Batch::Encoded(request, _) => self.encoded.send(request).await,
        }
    }
}

/// Collects the metrics.
pub(super) struct Collector {
    source: Arc<dyn MetricSource>,
    points: Points,
    previous: Duration,
}

impl Collector {
    /// Creates a collector for an agent that started at this time.
    pub(super) fn new(
        source: Arc<dyn MetricSource>,
        resource: &Resource,
        started: SystemTime,
    ) -> Self {
        Self {
            source,
            points: Points::new(resource, unix_nanoseconds(started)),
            previous: Duration::ZERO,
        }
    }

    /// Exports every `period`, and once at the end.
    pub(super) async fn run(mut self, delivery: Delivery<MetricExport>, period: Duration) {
        // The offset spreads the exports of a fleet that was switched on simultaneously.
        let mut ticks = interval_at(tokio::time::Instant::now() + period / 4, period);
        ticks.set_missed_tick_behavior(MissedTickBehavior::Delay);
        loop {
            let now = tokio::select! {
                now = ticks.tick() => now,
                () = delivery.wait_stopped() => break,
            };
            self.source.refresh(REFRESH_TIMEOUT).await;
            let Collection { batches, dropped } = self.collect(SystemTime::now());
            delivery.overflowed(dropped);
            let mut is_overtaken = false;
            for batch in batches {
                if is_overtaken {
                    delivery.superseded(&batch);
                    continue;
                }
                is_overtaken = match delivery.deliver(&batch, now + period).await {
                    BatchResult::Answered => false,
                    BatchResult::Overtaken => true,
                    BatchResult::Stopped => {
                        // The last collection replaces the batch.
                        delivery.superseded(&batch);
                        true
                    }
                };
            }
        }
        let Collection { batches, dropped } = self.collect(SystemTime::now());
        delivery.overflowed(dropped);
        delivery.finish(batches).await;
    }

    /// Collects all metrics at the time `now`.
    pub(super) fn collect(&mut self, now: SystemTime) -> Collection {
        let begun = Instant::now();
        self.points.begin(unix_nanoseconds(now));
        // Writing points to memory cannot fail.
        let mut sink = MetricSink::points(&mut self.points);
        let _ = self.source.collect(&mut sink, self.previous);
        let collection = self.points.end();
        self.previous = begun.elapsed();
        collection
    }
}

/// Returns nanoseconds since 1970, the unit of times in OTLP.
fn unix_nanoseconds(time: SystemTime) -> u64 {
    let since = time.duration_since(SystemTime::UNIX_EPOCH);
    u64::try_from(since.unwrap_or_default().as_nanos()).unwrap_or(u64::MAX)
}
