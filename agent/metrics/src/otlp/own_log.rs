//! The agent's own log as log records, on request (`otlp.log`).
//!
//! `opentelemetry-appender-tracing` creates a record of each event, and a queue holds it until the
//! export thread sends it. The thread that logs never waits. The export thread's own lines are not
//! exported.

use std::collections::VecDeque;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use opentelemetry::InstrumentationScope;
use opentelemetry::logs::AnyValue;
use opentelemetry_appender_tracing::layer::OpenTelemetryTracingBridge;
use opentelemetry_sdk::error::OTelSdkResult;
use opentelemetry_sdk::logs::{LogProcessor, SdkLogRecord, SdkLoggerProvider};
use tokio::sync::Notify;
use tracing::Subscriber;
use tracing_subscriber::Layer;
use tracing_subscriber::filter::{LevelFilter, Targets};
use tracing_subscriber::registry::LookupSpan;

use super::delivery::Queue;

/// Maximum number of lines in the queue, their maximum size in bytes, and the maximum number of
/// lines in one request.
const MAX_LINES: usize = 1024;
const LINES_BYTES: usize = 1 << 20;
const MAX_PER_REQUEST: usize = 256;
/// Time for which lines are collected into one request.
pub(super) const BATCH_DELAY: Duration = Duration::from_millis(500);
/// Estimated size of a record or an attribute without its texts.
const RECORD_OVERHEAD: usize = 64;

/// The queue of lines between the threads that log and the exporter.
#[derive(Debug, Default)]
pub struct LogQueue {
    waiting: Mutex<Waiting>,
    added: Notify,
    overflowed: AtomicU64,
}

#[derive(Debug, Default)]
struct Waiting {
    lines: VecDeque<SdkLogRecord>,
    bytes: usize,
}

impl LogQueue {
    /// Returns a layer that queues the agent's lines of this level and of more severe ones.
    pub fn layer<S>(queue: &Arc<Self>, level: LevelFilter) -> impl Layer<S> + use<S>
    where
        S: Subscriber + for<'span> LookupSpan<'span>,
    {
        let provider = SdkLoggerProvider::builder()
            .with_log_processor(Queueing(Arc::clone(queue)))
            .build();
        // The exporter's libraries write log lines, too, which are not exported.
        let own = Targets::new().with_target("ros2probe", level);
        OpenTelemetryTracingBridge::new(&provider).with_filter(own)
    }

    fn put(&self, line: SdkLogRecord) {
        let bytes = size(&line);
        let mut waiting = self.waiting();
        if waiting.lines.len() >= MAX_LINES || waiting.bytes + bytes > LINES_BYTES {
            self.overflowed.fetch_add(1, Ordering::Relaxed);
            return;
        }
        waiting.bytes += bytes;
        waiting.lines.push_back(line);
        drop(waiting);
        self.added.notify_one();
    }

    /// Returns the oldest lines; `None` if the queue is empty.
    fn take(&self) -> Option<Vec<SdkLogRecord>> {
        let mut waiting = self.waiting();
        let most = waiting.lines.len().min(MAX_PER_REQUEST);
        let lines: Vec<_> = waiting.lines.drain(..most).collect();
        waiting.bytes -= lines.iter().map(size).sum::<usize>().min(waiting.bytes);
        (!lines.is_empty()).then_some(lines)
    }

    async fn filled(&self) {
        loop {
            let added = self.added.notified();
            if !self.waiting().lines.is_empty() {
                return;
            }
            added.await;
        }
    }

    fn waiting(&self) -> MutexGuard<'_, Waiting> {
        self.waiting.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Queue for &LogQueue {
    type Batch = Vec<SdkLogRecord>;

    async fn wait_filled(&self) {
        LogQueue::filled(self).await;
    }

    fn is_half_full(&self) -> bool {
        let waiting = self.waiting();
        waiting.lines.len() >= MAX_LINES / 2 || waiting.bytes >= LINES_BYTES / 2
    }

    fn take(&mut self) -> (Option<Vec<SdkLogRecord>>, u64) {
        let overflowed = self.overflowed.swap(0, Ordering::Relaxed);
        (LogQueue::take(self), overflowed)
    }
}

/// Puts records into the queue.
#[derive(Debug)]
struct Queueing(Arc<LogQueue>);

impl LogProcessor for Queueing {
    fn emit(&self, record: &mut SdkLogRecord, _: &InstrumentationScope) {
        self.0.put(record.clone());
    }

    fn force_flush(&self) -> OTelSdkResult {
        Ok(())
    }
}

/// Returns the estimated size of a record in bytes.
fn size(record: &SdkLogRecord) -> usize {
    let text = |value: &AnyValue| match value {
        AnyValue::String(text) => text.as_str().len(),
        _ => 0,
    };
    let attributes = record.attributes_iter();
    let attributes: usize = attributes
        .map(|(key, value)| RECORD_OVERHEAD + key.as_str().len() + text(value))
        .sum();
    RECORD_OVERHEAD + record.body().map_or(0, text) + attributes
}

#[cfg(test)]
mod tests {
    use opentelemetry::Context;
    use tracing_subscriber::layer::SubscriberExt as _;

    use super::*;

    fn queued(log: impl FnOnce()) -> (Arc<LogQueue>, Vec<SdkLogRecord>) {
        let queue = Arc::<LogQueue>::default();
        let layer = LogQueue::layer(&queue, LevelFilter::WARN);
        tracing::subscriber::with_default(tracing_subscriber::registry().with(layer), log);
        let lines = std::iter::from_fn(|| queue.take()).flatten().collect();
        (queue, lines)
    }

    #[test]
    fn only_lines_of_the_agent_are_queued_not_those_of_libraries_or_exports() {
        let (_, lines) = queued(|| {
            tracing::warn!(socket = 7, "the socket drops packets");
            tracing::info!("the capture has ended");
            tracing::error!(target: "h2::client", "broken pipe");
            let _suppressed = Context::enter_telemetry_suppressed_scope();
            tracing::error!("the OTLP receiver refuses the export");
        });
        let [line] = lines.as_slice() else {
            panic!("{lines:?}")
        };
        let body = AnyValue::from("the socket drops packets");
        assert_eq!(line.body(), Some(&body));
        assert_eq!(line.severity_text(), Some("WARN"));
        let attributes: Vec<_> = line.attributes_iter().collect();
        assert_eq!(attributes.len(), 1, "{attributes:?}");
    }

    #[test]
    fn the_queue_bounds_lines_and_bytes_and_counts_overflowing_lines() {
        let (queue, lines) = queued(|| {
            for line in 0..MAX_LINES + 5 {
                tracing::warn!(line, "short");
            }
        });
        assert_eq!(lines.len(), MAX_LINES);
        assert_eq!(queue.overflowed.load(Ordering::Relaxed), 5);
        assert_eq!(queue.waiting().bytes, 0);

        let long = "x".repeat(LINES_BYTES / 4);
        let (queue, lines) = queued(|| {
            for _ in 0..10 {
                tracing::warn!(long, "long");
            }
        });
        assert_eq!(lines.len(), 3);
        assert_eq!(queue.overflowed.load(Ordering::Relaxed), 7);
    }
}
