//! Periodic export of the metrics that the page shows.
//!
//! Points are cumulative, so none are kept while the receiver is unavailable: the next collection
//! supersedes them.

use std::time::{Duration, Instant, SystemTime};

use opentelemetry_proto::tonic::resource::v1::Resource;
use tokio::time::{MissedTickBehavior, interval_at};

use super::points::{Collection, Points};
use super::signal_sender::SignalSender;
use crate::surface::collect::{MetricSources, collect};
use crate::surface::metric_sink::MetricSink;

/// Longest time to wait for a fresh snapshot, as for a scrape.
const REFRESH_TIMEOUT: Duration = Duration::from_millis(600);

/// Collects the metrics.
pub(super) struct Collector {
    sources: MetricSources,
    points: Points,
    previous: Duration,
}

impl Collector {
    /// Creates a collector for an agent that started at this time.
    pub(super) fn new(sources: MetricSources, resource: Resource, started: SystemTime) -> Self {
        Self {
            sources,
            points: Points::new(resource, unix_nanoseconds(started)),
            previous: Duration::ZERO,
        }
    }

    /// Exports every `period`, and once at the end.
    pub(super) async fn run(mut self, mut sender: SignalSender, period: Duration) {
        // The offset spreads the exports of a fleet that was switched on simultaneously.
        let mut ticks = interval_at(tokio::time::Instant::now() + period / 4, period);
        ticks.set_missed_tick_behavior(MissedTickBehavior::Delay);
        loop {
            let now = tokio::select! {
                now = ticks.tick() => now,
                () = sender.stopped() => break,
            };
            self.sources.latest.refresh(REFRESH_TIMEOUT).await;
            let Collection { requests, dropped } = self.collect(SystemTime::now());
            sender.overflowed(dropped);
            sender.deliver(requests, Some(now + period)).await;
        }
        let Collection { requests, dropped } = self.collect(SystemTime::now());
        sender.overflowed(dropped);
        sender.finish(requests, true).await;
    }

    /// Returns all metrics as of now.
    pub(super) fn collect(&mut self, now: SystemTime) -> Collection {
        let begun = Instant::now();
        self.points.begin(unix_nanoseconds(now));
        // Writing points to memory cannot fail.
        let _ = collect(
            &mut MetricSink::Points(&mut self.points),
            &self.sources,
            self.previous,
        );
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
