//! Outcomes of requests that `opentelemetry-otlp` does not return.
//!
//! The library returns only a text for a failure. It reports rejected items, and requests that must
//! not be repeated, only as `tracing` events (`*.PartialSuccess`, `Export.Failed.NonRetryable`).
//! The export thread therefore has a subscriber of its own. It turns these events into outcomes of
//! the request in progress, and drops the library's other events. All other lines of the thread go
//! to the agent's log, so an unavailable receiver causes one line there.

use std::cell::Cell;
use std::fmt;
use std::sync::Arc;

use opentelemetry_sdk::error::OTelSdkResult;
use tracing::dispatcher::Dispatch;
use tracing::field::{Field, Visit};
use tracing::span::{Attributes, Id, Record};
use tracing::subscriber::Interest;
use tracing::{Event, Level, Metadata, Subscriber};

use super::exports::{Exports, Outcome, Signal};

tokio::task_local! {
    static REPORT: Report;
}

/// Facts about a request.
#[derive(Clone, Debug)]
pub(super) struct Report {
    signal: Signal,
    exports: Arc<Exports>,
    has_attempt: Cell<bool>,
    failure: Cell<Failure>,
    rejected: Cell<u64>,
}

/// Why a request failed.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(super) enum Failure {
    /// The connection broke, or the receiver is busy.
    #[default]
    Temporary,
    /// The answer did not come in time.
    TimedOut,
    /// The receiver does not accept messages of this size.
    TooLarge,
    /// The request must not be repeated.
    Refused,
}

impl Report {
    /// Creates the report of a request. Every attempt but the first counts as retried; with
    /// `is_again`, the first one counts, too.
    pub(super) fn new(signal: Signal, exports: Arc<Exports>, is_again: bool) -> Self {
        Self {
            signal,
            exports,
            has_attempt: Cell::new(is_again),
            failure: Cell::default(),
            rejected: Cell::default(),
        }
    }

    /// Runs an export and returns its result with the completed report.
    pub(super) async fn of(
        self,
        export: impl Future<Output = OTelSdkResult>,
    ) -> (OTelSdkResult, Self) {
        let export = async {
            let result = export.await;
            (result, REPORT.with(Clone::clone))
        };
        REPORT.scope(self, export).await
    }

    /// Returns why the request failed.
    pub(super) fn failure(&self) -> Failure {
        self.failure.get()
    }

    /// Returns the number of items that the receiver rejected while it accepted the others.
    pub(super) fn rejected(&self) -> u64 {
        self.rejected.get()
    }
}

/// Runs an export whose outcome does not belong to the request in progress.
pub(super) async fn unreported(export: impl Future<Output = OTelSdkResult>) -> OTelSdkResult {
    unreported_failure(export).await.0
}

/// The same, and returns why it failed.
pub(super) async fn unreported_failure(
    export: impl Future<Output = OTelSdkResult>,
) -> (OTelSdkResult, Failure) {
    let report = Report::new(Signal::Log, Arc::default(), false);
    let (result, report) = report.of(export).await;
    (result, report.failure())
}

/// Notes that a request is sent; called by the transport.
pub(super) fn attempt() {
    // Fails outside an export.
    let _ = REPORT.try_with(|report| {
        if report.has_attempt.replace(true) {
            report
                .exports
                .count_request(report.signal, Outcome::Retried);
        }
    });
}

/// Notes that the receiver rejected some items of the request in progress.
pub(super) fn rejected(items: i64) {
    let _ = REPORT.try_with(|report| report.rejected.set(u64::try_from(items).unwrap_or(0)));
}

/// Notes why the request in progress failed.
pub(super) fn failed(failure: Failure) {
    let _ = REPORT.try_with(|report| report.failure.set(failure));
}

/// The subscriber of the export thread.
pub(super) struct Reports {
    log: Dispatch,
}

impl Reports {
    /// Creates a subscriber that passes other events on to the current subscriber.
    pub(super) fn dispatch() -> Dispatch {
        let log = tracing::dispatcher::get_default(Clone::clone);
        Dispatch::new(Self { log })
    }
}

fn is_library(metadata: &Metadata<'_>) -> bool {
    metadata.target().starts_with("opentelemetry")
}

fn is_report(metadata: &Metadata<'_>) -> bool {
    *metadata.level() <= Level::WARN
}

impl Subscriber for Reports {
    fn register_callsite(&self, metadata: &'static Metadata<'static>) -> Interest {
        if !is_library(metadata) {
            self.log.register_callsite(metadata)
        } else if is_report(metadata) {
            Interest::always()
        } else {
            Interest::never()
        }
    }

    fn max_level_hint(&self) -> Option<tracing::level_filters::LevelFilter> {
        let log = tracing::level_filters::LevelFilter::current();
        Some(log.max(tracing::level_filters::LevelFilter::WARN))
    }

    fn enabled(&self, metadata: &Metadata<'_>) -> bool {
        if is_library(metadata) {
            is_report(metadata)
        } else {
            self.log.enabled(metadata)
        }
    }

    fn event(&self, event: &Event<'_>) {
        let metadata = event.metadata();
        if !is_library(metadata) {
            return self.log.event(event);
        }
        if metadata.name().ends_with(".PartialSuccess") {
            event.record(&mut PartialSuccess);
        } else if metadata.name() == "Export.Failed.NonRetryable" {
            failed(Failure::Refused);
        }
    }

    fn new_span(&self, span: &Attributes<'_>) -> Id {
        self.log.new_span(span)
    }

    fn record(&self, span: &Id, values: &Record<'_>) {
        self.log.record(span, values);
    }

    fn record_follows_from(&self, span: &Id, follows: &Id) {
        self.log.record_follows_from(span, follows);
    }

    fn enter(&self, span: &Id) {
        self.log.enter(span);
    }

    fn exit(&self, span: &Id) {
        self.log.exit(span);
    }

    fn clone_span(&self, id: &Id) -> Id {
        self.log.clone_span(id)
    }

    fn try_close(&self, id: Id) -> bool {
        self.log.try_close(id)
    }
}

/// Reads `rejected_data_points`, `rejected_log_records` or `rejected_spans`.
struct PartialSuccess;

impl Visit for PartialSuccess {
    fn record_i64(&mut self, field: &Field, value: i64) {
        if field.name().starts_with("rejected_") {
            rejected(value);
        }
    }

    fn record_debug(&mut self, _: &Field, _: &dyn fmt::Debug) {}
}
