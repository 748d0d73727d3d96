//! Delivery of one signal, in order and with bounded memory.
//!
//! The library repeats a request within its timeout. The delivery then offers the same batch again,
//! until the receiver accepts or refuses it. Only one batch is in progress. Undelivered items are
//! counted by reason. `queued.rs` lets items wait on disk.

use std::cell::Cell;
use std::path::Path;
use std::sync::Arc;
use std::time::Duration;

use opentelemetry_sdk::error::{OTelSdkError, OTelSdkResult};
use tokio::time::{Instant, sleep, timeout_at};
use tokio_util::sync::CancellationToken;

use super::encoded_sender::is_temporary;
use super::exports::{Exports, Outcome, Reason, Signal};
use super::kept::{Kept, KeptRequest};
use super::reports::{Failure, Report, unreported_failure};

/// Time for the last batches, of the two seconds for stopping.
pub(super) const LAST_BATCH_TIMEOUT: Duration = Duration::from_millis(1_400);

/// An exporter of the library and the form of its batches.
pub(super) trait Export {
    /// Items that one request carries.
    type Batch;

    /// Returns the number of points, records or spans.
    fn items(batch: &Self::Batch) -> u64;

    /// Sends a batch; the library repeats the request within its timeout.
    async fn export(&self, batch: &Self::Batch) -> OTelSdkResult;
}

/// An exporter of items that may wait on disk.
pub(super) trait Persist: Export {
    /// Returns the request with these items in the form of the protocol.
    fn encode(&self, batch: &Self::Batch) -> Vec<u8>;

    /// Sends such a request once.
    async fn export_encoded(&self, request: &[u8]) -> OTelSdkResult;

    /// Returns such a request as two: the first `place` items, and the others; `None` if it cannot
    /// be read.
    fn divided(request: &[u8], place: u64) -> Option<[Vec<u8>; 2]>;

    /// Returns such a request without items, which is about as long as another one.
    fn padded(request: &[u8]) -> Vec<u8>;
}

/// Items that wait for the exporter.
pub(super) trait Queue {
    /// The exporter's form of items.
    type Batch;

    /// Completes once the queue has items.
    async fn wait_filled(&self);

    /// Returns whether more items should be taken soon, because the queue is half full.
    fn is_half_full(&self) -> bool;

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
    is_working: Cell<Option<bool>>,
    /// Whether the log has a line about an item that is too large.
    has_logged_large: Cell<bool>,
}

/// Pauses before a batch is offered again: each is twice as long as the one before it.
pub(super) struct Pauses(Duration);

impl Default for Pauses {
    fn default() -> Self {
        Self(Duration::from_secs(1))
    }
}

impl Pauses {
    const MAX: Duration = Duration::from_secs(30);

    /// Returns the next pause.
    pub(super) fn next(&mut self) -> Duration {
        let pause = self.0;
        self.0 = (pause * 2).min(Self::MAX);
        pause
    }
}

/// Result of one attempt to deliver items.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Attempt {
    /// The receiver accepted or refused them.
    Settled,
    /// They must be offered again.
    Unsettled,
    /// The same, since no answer came in time.
    TimedOut,
    /// The receiver does not accept requests of this size.
    TooLarge,
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
            is_working: Cell::new(None),
            has_logged_large: Cell::new(false),
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

    /// Takes the oldest items of a queue, and counts those that did not fit.
    pub(super) fn take(&self, queue: &mut impl Queue<Batch = E::Batch>) -> Option<E::Batch> {
        let (batch, overflowed) = queue.take();
        self.overflowed(overflowed);
        batch
    }

    /// Delivers a batch until it is answered, until `newer`, or until the agent stops.
    pub(super) async fn deliver(&self, batch: &E::Batch, newer: Instant) -> BatchResult {
        let offers = timeout_at(newer, self.send_until_settled(batch));
        let settled = tokio::select! {
            answered = offers => match answered {
                Ok(()) => BatchResult::Answered,
                Err(_) => BatchResult::Overtaken,
            },
            () = self.wait_stopped() => BatchResult::Stopped,
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
    pub(super) async fn finish(self, batches: Vec<E::Batch>) {
        let deadline = Instant::now() + LAST_BATCH_TIMEOUT;
        let mut left = batches.iter();
        while let Some(batch) = left.next() {
            let sent = timeout_at(deadline, self.send(self.exporter.export(batch), false)).await;
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
    async fn send_until_settled(&self, batch: &E::Batch) {
        let (mut pauses, mut is_again) = (Pauses::default(), false);
        while self.offer(batch, is_again).await != Attempt::Settled {
            is_again = true;
            sleep(pauses.next()).await;
        }
    }

    /// Offers a batch once. `is_again`: this batch was offered before.
    async fn offer(&self, batch: &E::Batch, is_again: bool) -> Attempt {
        let Err((error, failure)) = self.send(self.exporter.export(batch), is_again).await else {
            return Attempt::Settled;
        };
        // A batch of this kind is not divided: the next one has newer points.
        let failure = match failure {
            Failure::TooLarge => Failure::Refused,
            failure => failure,
        };
        self.settle(&error, failure, E::items(batch))
    }

    /// Counts a refusal of this number of items.
    fn settle(&self, error: &str, failure: Failure, items: u64) -> Attempt {
        self.failed(error);
        match failure {
            Failure::Temporary => Attempt::Unsettled,
            Failure::TimedOut => Attempt::TimedOut,
            Failure::TooLarge => Attempt::TooLarge,
            Failure::Refused => {
                self.count(Outcome::Failed);
                self.drop(Reason::Refused, items);
                Attempt::Settled
            }
        }
    }

    /// Runs an export and counts a success.
    async fn send(
        &self,
        export: impl Future<Output = OTelSdkResult>,
        is_again: bool,
    ) -> Result<(), (String, Failure)> {
        let report = Report::new(self.signal, Arc::clone(&self.exports), is_again);
        let (result, report) = report.of(export).await;
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
                let failure = match report.failure() {
                    Failure::Refused if is_of_connection(&error) || is_of_receiver(&error) => {
                        Failure::Temporary
                    }
                    failure => failure,
                };
                Err((error, failure))
            }
        }
    }

    fn delivered(&self, rejected: u64) {
        if self.is_working.replace(Some(true)) != Some(true) {
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
    fn failed(&self, reason: &str) {
        if self.is_working.replace(Some(false)) != Some(false) {
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

    pub(super) fn drop(&self, reason: Reason, items: u64) {
        if items > 0 {
            self.exports.count_dropped(self.signal, reason, items);
        }
    }
}

impl<E: Persist> Delivery<E> {
    /// Opens the signal's queue on disk.
    pub(super) fn open_queue(&self, directory: &Path, limit: u64) -> Option<Kept> {
        Kept::open(directory, limit, self.signal, &self.exports)
    }

    /// Offers a batch for the first time. Only the answer to its encoded form shows whether it is
    /// too large.
    pub(super) async fn offer_first(&self, batch: &E::Batch) -> Attempt {
        let Err((error, failure)) = self.send(self.exporter.export(batch), false).await else {
            return Attempt::Settled;
        };
        let failure = match failure {
            Failure::Refused if may_be_too_large(&error) => Failure::Temporary,
            failure => failure,
        };
        self.settle(&error, failure, E::items(batch))
    }

    /// Offers an encoded request once. `is_again`: this process offered its items before.
    pub(super) async fn offer_encoded(&self, request: &KeptRequest, is_again: bool) -> Attempt {
        let export = self.exporter.export_encoded(&request.encoded);
        let Err((error, failure)) = self.send(export, is_again).await else {
            return Attempt::Settled;
        };
        self.settle(&error, failure, request.items)
    }

    /// Returns whether a single item does not fit the link: the receiver answers a request without
    /// items in time, but not one that is padded to the length of this one.
    pub(super) async fn is_too_long(&self, request: &KeptRequest) -> bool {
        let offer = async |like: &[u8]| {
            let request = E::padded(like);
            unreported_failure(self.exporter.export_encoded(&request)).await
        };
        let (empty, failure) = offer(&[]).await;
        // A refusal is an answer in time.
        if empty.is_err() && failure != Failure::Refused {
            return false;
        }
        let (padded, failure) = offer(&request.encoded).await;
        padded.is_err() && failure == Failure::TimedOut
    }

    /// Counts an item that no request can deliver, and logs the first one.
    pub(super) fn drop_too_large(&self, request: &KeptRequest) {
        self.count(Outcome::Failed);
        self.drop(Reason::TooLarge, request.items);
        if !self.has_logged_large.replace(true) {
            tracing::warn!(
                signal = self.signal.label(),
                endpoint = self.endpoint,
                bytes = request.encoded.len(),
                "an item is too large for the OTLP receiver or the link: it is dropped"
            );
        }
    }

    /// Returns the request for these items, which can wait on disk.
    pub(super) fn kept(&self, batch: &E::Batch) -> KeptRequest {
        KeptRequest {
            items: E::items(batch),
            encoded: self.exporter.encode(batch),
            settled: 0,
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

/// Returns whether a refusal that the library does not repeat concerns the credentials, the address
/// or the state of the receiver.
fn is_of_receiver(error: &str) -> bool {
    let after = |text: &str| Some(error.split_once(text)?.1);
    let status = after("status code: ").and_then(|status| status.parse().ok());
    let code = after("gRPC code: ").unwrap_or_default();
    ["Unauthenticated", "PermissionDenied"].contains(&code) || status.is_some_and(is_temporary)
}

/// Returns whether the receiver, or a proxy before it, may have refused a request of the library for
/// its size. The library does not return the status of HTTP that a proxy answers a gRPC request with.
fn may_be_too_large(error: &str) -> bool {
    let is_of_proxy = error.ends_with("gRPC code: Unknown");
    let is_of_receiver = ["gRPC code: ResourceExhausted", "status code: 413"]
        .iter()
        .any(|part| error.contains(part));
    is_of_proxy || is_of_receiver
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_refusal_of_all_requests_is_no_refusal_of_the_items() {
        for error in [
            "TonicLogsClient export failed with gRPC code: Unauthenticated",
            "TonicLogsClient export failed with gRPC code: PermissionDenied",
            "HTTP export failed with status code: 302",
            "HTTP export failed with status code: 401",
            "HTTP export failed with status code: 404",
            "HTTP export failed with status code: 500",
        ] {
            assert!(is_of_receiver(error), "{error}");
        }
        for error in [
            "TonicLogsClient export failed with gRPC code: InvalidArgument",
            "HTTP export failed with status code: 400",
            "HTTP export failed with status code: 413",
            "export timed out",
        ] {
            assert!(!is_of_receiver(error), "{error}");
        }
    }
}
