//! Metrics on their way out: what the page shows, every so often.
//!
//! Points are cumulative, so nothing is kept while the receiver is away: the next collection says
//! it all.

use std::time::{Duration, Instant, SystemTime};

use opentelemetry_proto::tonic::resource::v1::Resource;
use tokio::time::{MissedTickBehavior, interval_at};

use super::points::{Collection, Points};
use super::signal_sender::SignalSender;
use crate::surface::collect::{MetricSources, collect};
use crate::surface::metric_sink::MetricSink;

/// As long as a scrape waits for the capture thread.
const REFRESH_TIMEOUT: Duration = Duration::from_millis(600);

/// Writes collections.
pub(super) struct Collector {
    sources: MetricSources,
    points: Points,
    previous: Duration,
}

impl Collector {
    /// Of an agent that started then.
    pub(super) fn new(sources: MetricSources, resource: Resource, started: SystemTime) -> Self {
        Self {
            sources,
            points: Points::new(resource, unix_nanoseconds(started)),
            previous: Duration::ZERO,
        }
    }

    /// Exports every `period` and at the end.
    pub(super) async fn run(mut self, mut sender: SignalSender, period: Duration) {
        // Not all robots of a fleet that was switched on at once report in the same moment.
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

    /// All metrics as they are now.
    pub(super) fn collect(&mut self, now: SystemTime) -> Collection {
        let begun = Instant::now();
        self.points.begin(unix_nanoseconds(now));
        // Points are pushed to memory, which does not fail.
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

/// Since 1970, as OTLP writes times.
fn unix_nanoseconds(time: SystemTime) -> u64 {
    let since = time.duration_since(SystemTime::UNIX_EPOCH);
    u64::try_from(since.unwrap_or_default().as_nanos()).unwrap_or(u64::MAX)
}
