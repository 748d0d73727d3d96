//! The connection of one signal to the receiver: gRPC, one request at a time, retried as OTLP
//! specifies.
//!
//! Requests stay encoded: retries copy nothing, and one client serves all signals, whose answers
//! have the same form.

use std::collections::VecDeque;
use std::hash::{BuildHasher as _, Hasher as _};
use std::sync::Arc;
use std::time::Duration;

use opentelemetry_proto::tonic::collector::metrics::v1::ExportMetricsServiceResponse as Answer;
use prost::Message;
use prost::bytes::{BufMut as _, Bytes};
use tonic::client::Grpc;
use tonic::codec::{Codec, CompressionEncoding, DecodeBuf, Decoder, EncodeBuf, Encoder};
use tonic::codegen::http::uri::PathAndQuery;
use tonic::transport::{Channel, Endpoint};
use tonic::{Code, Status};

use super::exports::{Exports, Outcome, Reason, Signal};
use super::settings::{SettingsError, Target};

/// Pauses between retries, unless the receiver requests another; random jitter shortens them by up
/// to half.
const FIRST_PAUSE: Duration = Duration::from_secs(1);
const LONGEST_PAUSE: Duration = Duration::from_secs(30);
/// Longest pause that a receiver can request.
const LONGEST_ASKED: Duration = Duration::from_mins(5);
/// A connection that does not answer a ping within this time is reopened.
const PING: Duration = Duration::from_secs(30);

/// An encoded part of the data to send.
#[derive(Clone, Debug)]
pub(super) struct Request {
    pub(super) body: Bytes,
    /// Number of points, records or spans in it.
    pub(super) items: u64,
}

/// The connection; opened at the first request, and again after a failure.
pub(super) struct Client {
    signal: Signal,
    grpc: Grpc<Channel>,
    target: Target,
    exports: Arc<Exports>,
    /// Whether the last request succeeded; `None` before the first.
    works: Option<bool>,
}

impl Client {
    /// Creates a client without a connection; requires a runtime.
    pub(super) fn new(
        signal: Signal,
        target: Target,
        exports: Arc<Exports>,
    ) -> Result<Self, SettingsError> {
        let endpoint = Endpoint::from(target.endpoint.clone())
            .user_agent(concat!("ros2probe/", env!("CARGO_PKG_VERSION")));
        let endpoint = endpoint.map_err(SettingsError::Client)?;
        let endpoint = secured(endpoint, &target)?;
        let endpoint = endpoint
            .connect_timeout(target.timeout)
            .http2_keep_alive_interval(PING);
        let mut grpc =
            Grpc::new(endpoint.connect_lazy()).accept_compressed(CompressionEncoding::Gzip);
        if target.gzip {
            grpc = grpc.send_compressed(CompressionEncoding::Gzip);
        }
        exports.enable(signal);
        Ok(Self {
            signal,
            grpc,
            target,
            exports,
            works: None,
        })
    }

    /// Sends the requests in `queue` and removes those that are delivered or finally refused.
    /// Retries without limit; the caller sets one.
    pub(super) async fn deliver(&mut self, queue: &mut VecDeque<Request>) {
        let mut pause = FIRST_PAUSE;
        while let Some(request) = queue.front() {
            let (body, items) = (request.body.clone(), request.items);
            let failed = match self.send(body).await {
                Ok(rejected) => {
                    self.delivered(rejected);
                    pause = FIRST_PAUSE;
                    queue.pop_front();
                    continue;
                }
                Err(failed) => failed,
            };
            self.failed(&failed);
            if let Some(asked) = retry_delay(&failed) {
                self.count(Outcome::Retried);
                tokio::time::sleep(asked.unwrap_or_else(|| shortened(pause))).await;
                pause = (pause * 2).min(LONGEST_PAUSE);
            } else {
                self.count(Outcome::Failed);
                self.drop(Reason::Refused, items);
                queue.pop_front();
            }
        }
    }

    /// Sends the requests in `queue` once each, until one fails.
    pub(super) async fn deliver_once(&mut self, queue: &mut VecDeque<Request>) {
        while let Some(request) = queue.front() {
            match self.send(request.body.clone()).await {
                Ok(rejected) => self.delivered(rejected),
                Err(failed) => {
                    self.failed(&failed);
                    return self.count(Outcome::Failed);
                }
            }
            queue.pop_front();
        }
    }

    /// Counts items that are dropped.
    pub(super) fn drop(&self, reason: Reason, items: u64) {
        if items > 0 {
            self.exports.count_dropped(self.signal, reason, items);
        }
    }

    /// Drops the pending request in favour of newer data, so that a receiver that never answers is
    /// not waited for.
    pub(super) fn overtaken(&mut self) {
        self.failed(&Status::deadline_exceeded(
            "no answer before the next export",
        ));
        self.count(Outcome::Failed);
    }

    pub(super) fn count(&self, outcome: Outcome) {
        self.exports.count_request(self.signal, outcome);
    }

    /// Sends a request and returns how many of its items the receiver rejected.
    async fn send(&mut self, body: Bytes) -> Result<u64, Status> {
        let mut request = tonic::Request::new(body);
        *request.metadata_mut() = self.target.headers.clone();
        request.set_timeout(self.target.timeout);
        let answer = async {
            let ready = self.grpc.ready().await;
            ready.map_err(|error| Status::unavailable(error.to_string()))?;
            let path = PathAndQuery::from_static(path(self.signal));
            self.grpc.unary(request, path, Encoded).await
        };
        let answer = tokio::time::timeout(self.target.timeout, answer).await;
        let answer = answer.map_err(|_| Status::deadline_exceeded("no answer in time"))??;
        let partial = answer.into_inner().partial_success;
        Ok(partial.map_or(0, |partial| {
            if !partial.error_message.is_empty() {
                tracing::debug!(
                    signal = self.signal.label(),
                    message = partial.error_message,
                    "the OTLP receiver accepted an export in part"
                );
            }
            u64::try_from(partial.rejected_data_points).unwrap_or(0)
        }))
    }

    fn delivered(&mut self, rejected: u64) {
        if self.works != Some(true) {
            self.works = Some(true);
            tracing::info!(
                signal = self.signal.label(),
                endpoint = %self.target.endpoint,
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
    fn failed(&mut self, status: &Status) {
        if self.works != Some(false) {
            self.works = Some(false);
            tracing::warn!(
                signal = self.signal.label(),
                endpoint = %self.target.endpoint,
                code = ?status.code(),
                reason = status.message(),
                "the OTLP receiver refuses the export"
            );
        }
    }
}

/// Configures TLS with the system's certificate authorities, or those in `SSL_CERT_FILE`.
fn secured(endpoint: Endpoint, target: &Target) -> Result<Endpoint, SettingsError> {
    if target.endpoint.scheme_str() != Some("https") {
        return Ok(endpoint);
    }
    let authorities = tonic::transport::ClientTlsConfig::new().with_native_roots();
    endpoint
        .tls_config(authorities)
        .map_err(SettingsError::Client)
}

const fn path(signal: Signal) -> &'static str {
    match signal {
        Signal::Metrics => "/opentelemetry.proto.collector.metrics.v1.MetricsService/Export",
        Signal::Events => "/opentelemetry.proto.collector.logs.v1.LogsService/Export",
        Signal::Traces => "/opentelemetry.proto.collector.trace.v1.TraceService/Export",
    }
}

/// Returns `None` if the request must not be retried (OTLP 1.x, "Failures"), otherwise the delay
/// that the receiver requests, if any.
fn retry_delay(status: &Status) -> Option<Option<Duration>> {
    let asked = retry_info(status.details());
    let again = match status.code() {
        Code::Cancelled
        | Code::DeadlineExceeded
        | Code::Aborted
        | Code::OutOfRange
        | Code::Unavailable
        | Code::DataLoss => true,
        Code::ResourceExhausted => asked.is_some(),
        // A broken connection has a source; an answer of the receiver has none.
        _ => std::error::Error::source(status).is_some(),
    };
    again.then_some(asked)
}

/// The relevant part of `google.rpc.Status` in `grpc-status-details-bin`.
#[derive(Clone, PartialEq, Message)]
struct Details {
    #[prost(message, repeated, tag = "3")]
    details: Vec<Detail>,
}

#[derive(Clone, PartialEq, Message)]
struct Detail {
    #[prost(string, tag = "1")]
    type_url: String,
    #[prost(bytes = "vec", tag = "2")]
    value: Vec<u8>,
}

#[derive(Clone, PartialEq, Message)]
struct RetryInfo {
    #[prost(message, optional, tag = "1")]
    retry_delay: Option<Delay>,
}

#[derive(Clone, PartialEq, Message)]
struct Delay {
    #[prost(int64, tag = "1")]
    seconds: i64,
    #[prost(int32, tag = "2")]
    nanos: i32,
}

fn retry_info(details: &[u8]) -> Option<Duration> {
    let details = Details::decode(details).ok()?.details;
    let info = details
        .iter()
        .find(|detail| detail.type_url.ends_with("/google.rpc.RetryInfo"))?;
    let delay = RetryInfo::decode(info.value.as_slice()).ok()?.retry_delay?;
    let seconds = u64::try_from(delay.seconds).ok()?;
    let nanoseconds = u32::try_from(delay.nanos)
        .ok()
        .filter(|rest| *rest < 1_000_000_000)?;
    Some(Duration::new(seconds, nanoseconds).min(LONGEST_ASKED))
}

/// Applies random jitter, so that the robots of a fleet do not reconnect simultaneously.
fn shortened(pause: Duration) -> Duration {
    let chance = std::hash::RandomState::new().build_hasher().finish();
    let sixteenths = u32::try_from(chance % 8).unwrap_or(0);
    pause - pause * sixteenths / 16
}

/// A codec for messages that are already encoded.
#[derive(Clone, Copy)]
struct Encoded;

impl Codec for Encoded {
    type Encode = Bytes;
    type Decode = Answer;
    type Encoder = Self;
    type Decoder = Self;

    fn encoder(&mut self) -> Self {
        Self
    }

    fn decoder(&mut self) -> Self {
        Self
    }
}

impl Encoder for Encoded {
    type Item = Bytes;
    type Error = Status;

    fn encode(&mut self, item: Bytes, out: &mut EncodeBuf<'_>) -> Result<(), Status> {
        out.put(item);
        Ok(())
    }
}

impl Decoder for Encoded {
    type Item = Answer;
    type Error = Status;

    fn decode(&mut self, bytes: &mut DecodeBuf<'_>) -> Result<Option<Answer>, Status> {
        let answer = Answer::decode(bytes);
        answer
            .map(Some)
            .map_err(|error| Status::internal(error.to_string()))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn asking(code: Code, seconds: i64) -> Status {
        let info = RetryInfo {
            retry_delay: Some(Delay { seconds, nanos: 5 }),
        };
        let details = Details {
            details: vec![Detail {
                type_url: "type.googleapis.com/google.rpc.RetryInfo".to_owned(),
                value: info.encode_to_vec(),
            }],
        };
        Status::with_details(code, "busy", details.encode_to_vec().into())
    }

    #[test]
    fn only_what_may_pass_is_tried_again_and_as_late_as_asked() {
        let again = |status: Status| retry_delay(&status);
        assert_eq!(again(Status::unavailable("")), Some(None));
        assert_eq!(again(Status::resource_exhausted("")), None);
        assert_eq!(
            again(asking(Code::ResourceExhausted, 3)),
            Some(Some(Duration::new(3, 5)))
        );
        assert_eq!(
            again(asking(Code::Unavailable, 1_000_000)),
            Some(Some(LONGEST_ASKED))
        );
        assert_eq!(again(asking(Code::Unavailable, -1)), Some(None));
        for refused in [
            Code::InvalidArgument,
            Code::Unauthenticated,
            Code::Unimplemented,
        ] {
            assert_eq!(again(Status::new(refused, "")), None, "{refused:?}");
        }
        assert_eq!(retry_info(b"\xff\xff\xff"), None);
    }

    #[test]
    fn pauses_differ_and_stay_near_what_they_are() {
        let pauses: Vec<Duration> = (0..64).map(|_| shortened(LONGEST_PAUSE)).collect();
        assert!(
            pauses
                .iter()
                .all(|pause| *pause > LONGEST_PAUSE / 2 && *pause <= LONGEST_PAUSE)
        );
        assert!(pauses.iter().any(|pause| *pause != LONGEST_PAUSE));
    }
}
