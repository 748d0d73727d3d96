//! Delivery of one signal, in order and with bounded memory.
//!
//! The library repeats a request within its timeout. The delivery then offers the same batch again,
//! until the receiver accepts or refuses it. Only one batch is in progress, and callers collect no
//! other before it is settled. Undelivered items are counted by reason.

use std::sync::Arc;
use std::time::Duration;

use opentelemetry_sdk::error::{OTelSdkError, OTelSdkResult};
use tokio::time::{Instant, sleep, timeout_at};
use tokio_util::sync::CancellationToken;

use super::exports::{Exports, Outcome, Reason, Signal};
use super::reports::Report;

/// Pauses before a batch is offered again.
const FIRST_RETRY_DELAY: Duration = Duration::from_secs(1);
const MAX_RETRY_DELAY: Duration = Duration::from_secs(30);
/// Time for the last batches, of the two seconds for stopping.
const LAST_BATCH_TIMEOUT: Duration = Duration::from_millis(1_400);

/// An exporter of the library and the form of its batches.
pub(super) trait Export {
    /// Items that one request carries.
    type Batch;

    /// Returns the number of points, records or spans.
    fn items(batch: &Self::Batch) -> u64;

    /// Sends a batch; the library repeats the request within its timeout.
    async fn export(&self, batch: &Self::Batch) -> OTelSdkResult;
}

/// Items that wait for the exporter.
pub(super) trait Queue {
    /// The exporter's form of items.
    type Batch;

    /// Completes once the queue has items.
    async fn wait_filled(&self);

    /// Returns the oldest items, or `None` without any, and the number of items that did not fit.
    fn take(&mut self) -> (Option<Self::Batch>, u64);
}

/// An exporter that stops with the agent.
pub(super) struct Delivery<E> {
    exporter: E,
    signal: Signal,
    endpoint: String,
    exports: Arc<Exports>,
    stop: CancellationToken,
    /// Whether the last request succeeded; `None` before the first.
    is_working: Option<bool>,
}

/// Result of the delivery of a batch.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum BatchResult {
    /// The receiver accepted or refused it.
    Answered,
    /// Newer points replace it. It is counted as dropped.
    Overtaken,
    /// The agent stops, and the batch is pending.
    Stopped,
}

impl<E: Export> Delivery<E> {
    pub(super) fn new(
        exporter: E,
        signal: Signal,
        endpoint: String,
        exports: Arc<Exports>,
        stop: CancellationToken,
    ) -> Self {
        exports.enable(signal);
        Self {
            exporter,
            signal,
            endpoint,
            exports,
            stop,
            is_working: None,
        }
    }

    /// Completes when the agent stops.
    pub(super) async fn wait_stopped(&self) {
        self.stop.cancelled().await;
    }

    /// Counts items that never became part of a batch.
    pub(super) fn overflowed(&self, items: u64) {
        self.drop(Reason::Overflow, items);
    }

    /// Delivers the items of a queue until the agent stops. Items that arrive within `gather` after
    /// the first one are collected into the same request.
    pub(super) async fn drain(mut self, mut queue: impl Queue<Batch = E::Batch>, gather: Duration) {
        let mut left = Vec::new();
        while left.is_empty() {
            let gathered = async {
                queue.wait_filled().await;
                sleep(gather).await;
            };
            tokio::select! {
                () = gathered => {}
                () = self.wait_stopped() => break,
            }
            while let Some(batch) = self.next(&mut queue) {
                if self.deliver(&batch, None).await == BatchResult::Stopped {
                    left.push(batch);
                    break;
                }
            }
        }
        left.extend(std::iter::from_fn(|| self.next(&mut queue)));
        self.finish(left).await;
    }

    fn next(&self, queue: &mut impl Queue<Batch = E::Batch>) -> Option<E::Batch> {
        let (batch, overflowed) = queue.take();
        self.overflowed(overflowed);
        batch
    }

    /// Delivers a batch until it is answered, until `newer`, or until the agent stops.
    pub(super) async fn deliver(
        &mut self,
        batch: &E::Batch,
        newer: Option<Instant>,
    ) -> BatchResult {
        let stop = self.stop.clone();
        let settled = {
            let offers = async {
                let Some(newer) = newer else {
                    self.send_until_settled(batch).await;
                    return BatchResult::Answered;
                };
                match timeout_at(newer, self.send_until_settled(batch)).await {
                    Ok(()) => BatchResult::Answered,
                    Err(_) => BatchResult::Overtaken,
                }
            };
            tokio::select! {
                settled = offers => settled,
                () = stop.cancelled() => BatchResult::Stopped,
            }
        };
        if settled == BatchResult::Overtaken {
            self.failed("no answer before the next export");
            self.count(Outcome::Failed);
            self.superseded(batch);
        }
        settled
    }

    /// Counts a batch as replaced by newer points.
    pub(super) fn superseded(&self, batch: &E::Batch) {
        self.drop(Reason::Superseded, E::items(batch));
    }

    /// Sends the last batches once each, until one fails.
    pub(super) async fn finish(mut self, batches: Vec<E::Batch>) {
        let deadline = Instant::now() + LAST_BATCH_TIMEOUT;
        let mut left = batches.iter();
        while let Some(batch) = left.next() {
            let sent = timeout_at(deadline, self.send(batch, false)).await;
            if let Ok(Err((error, _))) = &sent {
                self.failed(error);
                self.count(Outcome::Failed);
            }
            if !matches!(sent, Ok(Ok(()))) {
                let rest: u64 = left.map(E::items).sum();
                return self.drop(Reason::Shutdown, E::items(batch) + rest);
            }
        }
    }

    /// Offers a batch until the receiver accepts or refuses it.
    async fn send_until_settled(&mut self, batch: &E::Batch) {
        let (mut pause, mut is_again) = (FIRST_RETRY_DELAY, false);
        while let Err((error, is_refused)) = self.send(batch, is_again).await {
            self.failed(&error);
            if is_refused {
                self.count(Outcome::Failed);
                return self.drop(Reason::Refused, E::items(batch));
            }
            is_again = true;
            sleep(pause).await;
            pause = (pause * 2).min(MAX_RETRY_DELAY);
        }
    }

    /// Sends a batch and counts a success. An error includes whether the receiver refuses the
    /// batch.
    async fn send(&mut self, batch: &E::Batch, is_again: bool) -> Result<(), (String, bool)> {
        let report = Report::new(self.signal, Arc::clone(&self.exports), is_again);
        let (result, report) = report.of(self.exporter.export(batch)).await;
        match result {
            Ok(()) => {
                self.delivered(report.rejected());
                Ok(())
            }
            Err(error) => {
                let error = match error {
                    OTelSdkError::InternalFailure(reason) => reason,
                    other => other.to_string(),
                };
                let is_refused = report.is_refused() && !is_of_connection(&error);
                Err((error, is_refused))
            }
        }
    }

    fn delivered(&mut self, rejected: u64) {
        if self.is_working != Some(true) {
            self.is_working = Some(true);
            tracing::info!(
                signal = self.signal.label(),
                endpoint = self.endpoint,
                "exporting to the OTLP receiver"
            );
        }
        self.count(if rejected == 0 {
            Outcome::Delivered
        } else {
            Outcome::Partial
        });
        self.drop(Reason::Rejected, rejected);
    }

    /// Logs the first failure until a request succeeds again.
    fn failed(&mut self, reason: &str) {
        if self.is_working != Some(false) {
            self.is_working = Some(false);
            tracing::warn!(
                signal = self.signal.label(),
                endpoint = self.endpoint,
                reason,
                "the OTLP receiver refuses the export"
            );
        }
    }

    fn count(&self, outcome: Outcome) {
        self.exports.count_request(self.signal, outcome);
    }

    fn drop(&self, reason: Reason, items: u64) {
        if items > 0 {
            self.exports.count_dropped(self.signal, reason, items);
        }
    }
}

/// Returns whether the connection broke below the request. The library does not repeat such a
/// request, because tonic reports it with the code `Unknown`; it appends the cause only to such an
/// error.
fn is_of_connection(error: &str) -> bool {
    let after = error.split_once("gRPC code: ");
    after.is_some_and(|(_, after)| after.contains(": "))
}
