//! Requests that the library does not send: points that the SDK cannot carry, and requests that
//! waited on disk. They use the connection of an exporter, with the exporter's headers.

use std::io::Write as _;
use std::sync::{Arc, PoisonError};

use flate2::write::GzEncoder;
use opentelemetry_http::{HttpClient, Request as HttpRequest};
use opentelemetry_proto::tonic::collector::logs::v1::logs_service_client::LogsServiceClient;
use opentelemetry_proto::tonic::collector::logs::v1::{
    ExportLogsServiceRequest, ExportLogsServiceResponse,
};
use opentelemetry_proto::tonic::collector::metrics::v1::metrics_service_client::MetricsServiceClient;
use opentelemetry_proto::tonic::collector::metrics::v1::{
    ExportMetricsServiceRequest, ExportMetricsServiceResponse,
};
use opentelemetry_proto::tonic::collector::trace::v1::trace_service_client::TraceServiceClient;
use opentelemetry_proto::tonic::collector::trace::v1::{
    ExportTraceServiceRequest, ExportTraceServiceResponse,
};
use opentelemetry_proto::tonic::common::v1::{AnyValue, KeyValue, any_value};
use opentelemetry_proto::tonic::logs::v1::ResourceLogs;
use opentelemetry_proto::tonic::resource::v1::Resource;
use opentelemetry_proto::tonic::trace::v1::ResourceSpans;
use opentelemetry_sdk::error::{OTelSdkError, OTelSdkResult};
use prost::Message;
use tokio::time::error::Elapsed;
use tonic::codec::CompressionEncoding;
use tonic::codegen::http::Uri;
use tonic::codegen::http::header::CONTENT_ENCODING;
use tonic::metadata::MetadataMap;
use tonic::transport::Channel;
use tonic::{Code, Status, TimeoutExpired};

use super::headers::Headers;
use super::reports::{self, Failure};
use super::transport::{SentHeaders, overwrite};

/// A service of OTLP, as the type of its requests.
pub(super) trait Service: Message + Default + Clone {
    /// Answer of the service.
    type Response: Message + Default;

    /// Calls the service over gRPC.
    async fn call(
        channel: Channel,
        gzip: bool,
        request: tonic::Request<Self>,
    ) -> Result<Self::Response, Status>;

    /// Returns the number of items that the receiver rejected.
    fn rejected(response: &Self::Response) -> i64;
}

macro_rules! service {
    ($request:ident, $response:ident, $client:ident, $rejected:ident) => {
        impl Service for $request {
            type Response = $response;

            async fn call(
                channel: Channel,
                gzip: bool,
                request: tonic::Request<Self>,
            ) -> Result<$response, Status> {
                let mut client = $client::new(channel).accept_compressed(CompressionEncoding::Gzip);
                if gzip {
                    client = client.send_compressed(CompressionEncoding::Gzip);
                }
                Ok(client.export(request).await?.into_inner())
            }

            fn rejected(response: &$response) -> i64 {
                let partial = response.partial_success.as_ref();
                partial.map_or(0, |partial| partial.$rejected)
            }
        }
    };
}

service!(
    ExportMetricsServiceRequest,
    ExportMetricsServiceResponse,
    MetricsServiceClient,
    rejected_data_points
);
service!(
    ExportLogsServiceRequest,
    ExportLogsServiceResponse,
    LogsServiceClient,
    rejected_log_records
);
service!(
    ExportTraceServiceRequest,
    ExportTraceServiceResponse,
    TraceServiceClient,
    rejected_spans
);

/// Requests with items that may be sent in parts.
pub(super) trait Divisible: Service {
    /// Removes the items from this place on, and returns them as a request.
    fn split_off(&mut self, place: usize) -> Self;

    /// Returns a request without items, whose resource has these bytes.
    fn padded(padding: Vec<u8>) -> Self;
}

macro_rules! divisible {
    ($request:ident, $group:ident, $groups:ident, $scopes:ident, $items:ident) => {
        impl Divisible for $request {
            fn split_off(&mut self, mut place: usize) -> Self {
                let mut rest = Self::default();
                for mut group in std::mem::take(&mut self.$groups) {
                    let scopes = std::mem::take(&mut group.$scopes);
                    let mut after = group.clone();
                    for mut scope in scopes {
                        let mut items = std::mem::take(&mut scope.$items);
                        let later = items.split_off(place.min(items.len()));
                        place -= items.len();
                        if !later.is_empty() {
                            let mut scope = scope.clone();
                            scope.$items = later;
                            after.$scopes.push(scope);
                        }
                        if !items.is_empty() {
                            scope.$items = items;
                            group.$scopes.push(scope);
                        }
                    }
                    if !group.$scopes.is_empty() {
                        self.$groups.push(group);
                    }
                    if !after.$scopes.is_empty() {
                        rest.$groups.push(after);
                    }
                }
                rest
            }

            fn padded(padding: Vec<u8>) -> Self {
                let value = Some(any_value::Value::BytesValue(padding));
                let attribute = KeyValue {
                    key: "padding".to_owned(),
                    value: Some(AnyValue { value }),
                    ..KeyValue::default()
                };
                let resource = Resource {
                    attributes: vec![attribute],
                    ..Resource::default()
                };
                let group = $group {
                    resource: Some(resource),
                    ..$group::default()
                };
                Self {
                    $groups: vec![group],
                }
            }
        }
    };
}

divisible!(
    ExportLogsServiceRequest,
    ResourceLogs,
    resource_logs,
    scope_logs,
    log_records
);
divisible!(
    ExportTraceServiceRequest,
    ResourceSpans,
    resource_spans,
    scope_spans,
    spans
);

/// Sends such requests.
pub(super) struct EncodedSender {
    protocol: Protocol,
    headers: SentHeaders,
}

enum Protocol {
    Grpc {
        channel: Channel,
        gzip: bool,
        /// Headers of the configuration, which may be newer than those of the last request. A client
        /// of HTTP adds them itself.
        own: Headers,
    },
    Http(Arc<dyn HttpClient>, Uri),
}

impl EncodedSender {
    pub(super) const fn grpc(
        channel: Channel,
        gzip: bool,
        headers: SentHeaders,
        own: Headers,
    ) -> Self {
        Self {
            protocol: Protocol::Grpc { channel, gzip, own },
            headers,
        }
    }

    pub(super) const fn http(
        client: Arc<dyn HttpClient>,
        endpoint: Uri,
        headers: SentHeaders,
    ) -> Self {
        Self {
            protocol: Protocol::Http(client, endpoint),
            headers,
        }
    }

    /// Returns whether the exporter sent a request before, so that its headers are known.
    pub(super) fn has_headers(&self) -> bool {
        let headers = self.headers.lock().unwrap_or_else(PoisonError::into_inner);
        headers.is_some()
    }

    /// Sends the request with these bytes once.
    pub(super) async fn send_encoded<S: Service>(&self, request: &[u8]) -> OTelSdkResult {
        match S::decode(request) {
            Ok(request) => self.send(&request).await,
            Err(error) => {
                // Another version of the agent wrote it.
                reports::failed(Failure::Refused);
                failure(error.to_string())
            }
        }
    }

    /// Returns the request with these bytes as two: the first `place` items, and the others; `None`
    /// if it cannot be read.
    pub(super) fn divided<S: Divisible>(request: &[u8], place: u64) -> Option<[Vec<u8>; 2]> {
        let mut first = S::decode(request).ok()?;
        let second = first.split_off(usize::try_from(place).ok()?);
        Some([first.encode_to_vec(), second.encode_to_vec()])
    }

    /// Returns a request without items that is about as long as another one.
    pub(super) fn padded<S: Divisible>(request: &[u8]) -> Vec<u8> {
        match request {
            [] => Vec::new(),
            request => S::padded(request.to_vec()).encode_to_vec(),
        }
    }

    /// Sends a request once. The delivery offers a failed request again. The exporter must have
    /// sent a request before, because only the library reads headers from the environment.
    pub(super) async fn send<S: Service>(&self, request: &S) -> OTelSdkResult {
        let mut headers = self
            .headers
            .lock()
            .unwrap_or_else(PoisonError::into_inner)
            .clone()
            .unwrap_or_default();
        let response = match &self.protocol {
            Protocol::Grpc { channel, gzip, own } => {
                reports::attempt();
                overwrite(&mut headers, &own.current());
                let mut request = tonic::Request::new(request.clone());
                *request.metadata_mut() = MetadataMap::from_headers(headers);
                match S::call(channel.clone(), *gzip, request).await {
                    Ok(response) => response,
                    Err(status) => {
                        reports::failed(failure_of(&status));
                        let code = format!("export failed with gRPC code: {:?}", status.code());
                        let source = std::error::Error::source(&status);
                        return failure(match source {
                            Some(source) => format!("{code}: {source}"),
                            None => code,
                        });
                    }
                }
            }
            Protocol::Http(client, endpoint) => {
                let mut body = request.encode_to_vec();
                if headers.get(CONTENT_ENCODING).is_some_and(|it| it == "gzip") {
                    let mut gzip = GzEncoder::new(Vec::new(), flate2::Compression::default());
                    // Writing to memory cannot fail.
                    let _ = gzip.write_all(&body);
                    body = gzip.finish().unwrap_or_default();
                }
                let mut request = HttpRequest::new(body.into());
                *request.method_mut() = tonic::codegen::http::Method::POST;
                *request.uri_mut() = endpoint.clone();
                *request.headers_mut() = headers;
                let response = match client.send_bytes(request).await {
                    Ok(response) => response,
                    Err(error) => {
                        if error.is::<Elapsed>() {
                            reports::failed(Failure::TimedOut);
                        }
                        return failure(error.to_string());
                    }
                };
                if !response.status().is_success() {
                    match response.status().as_u16() {
                        413 => reports::failed(Failure::TooLarge),
                        status if is_temporary(status) => {}
                        _ => reports::failed(Failure::Refused),
                    }
                    return failure(format!("export failed with status {}", response.status()));
                }
                match S::Response::decode(response.into_body()) {
                    Ok(response) => response,
                    // The portal of a network answers, not the receiver.
                    Err(_) => return failure("the answer is not one of OTLP".to_owned()),
                }
            }
        };
        reports::rejected(S::rejected(&response));
        Ok(())
    }
}

fn failure(reason: String) -> OTelSdkResult {
    Err(OTelSdkError::InternalFailure(reason))
}

/// Returns whether a status of HTTP concerns the credentials, the address or the state of the
/// receiver. Other items would get it, too. OTLP 1.x lets a client repeat only 429 and 502 to 504. An
/// expired token, or the portal of a network, would cost all items then.
pub(super) const fn is_temporary(status: u16) -> bool {
    matches!(status, 300..=399 | 401 | 403 | 404 | 407 | 408 | 429 | 500..=599)
}

/// Returns why a request failed, and with it whether it may be repeated (OTLP 1.x, "Failures").
/// Credentials are replaced some day, and the items wait for it.
fn failure_of(status: &Status) -> Failure {
    match status.code() {
        Code::ResourceExhausted | Code::OutOfRange if is_of_size(status.message()) => {
            Failure::TooLarge
        }
        // A proxy refused the request before the receiver.
        Code::Unknown if status.message().ends_with(" HTTP status code 413") => Failure::TooLarge,
        Code::Cancelled if status.message() == TimeoutExpired(()).to_string() => Failure::TimedOut,
        Code::Cancelled
        | Code::DeadlineExceeded
        | Code::Aborted
        | Code::OutOfRange
        | Code::Unavailable
        | Code::DataLoss
        | Code::Unauthenticated
        | Code::PermissionDenied => Failure::Temporary,
        // Details mean that the receiver is busy, and when to try again.
        Code::ResourceExhausted if !status.details().is_empty() => Failure::Temporary,
        _ => Failure::Refused,
    }
}

/// Returns whether the receiver says that a message is too large. The texts are those of gRPC for
/// Go, Java and C++, and of tonic.
fn is_of_size(message: &str) -> bool {
    let parts = [
        "larger than max",
        "exceeds maximum size",
        "length too large",
    ];
    let message = message.to_ascii_lowercase();
    parts.iter().any(|part| message.contains(part))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_answer_about_the_size_is_no_refusal_of_the_items() {
        let failure = |code, message: &str| failure_of(&Status::new(code, message));
        for message in [
            "grpc: received message larger than max (5000000 vs. 4194304)",
            "gRPC message exceeds maximum size 4194304: 5000000",
            "Received message larger than max (5000000 vs. 4194304)",
        ] {
            assert_eq!(failure(Code::ResourceExhausted, message), Failure::TooLarge);
        }
        let of_proxy = "grpc-status header missing, mapped from HTTP status code 413";
        assert_eq!(failure(Code::Unknown, of_proxy), Failure::TooLarge);
        let of_tonic = "Error, decoded message length too large: found 9 bytes, the limit is: 8";
        assert_eq!(failure(Code::OutOfRange, of_tonic), Failure::TooLarge);
        for (code, message, expected) in [
            (Code::ResourceExhausted, "quota", Failure::Refused),
            (Code::OutOfRange, "", Failure::Temporary),
            (Code::Unknown, "HTTP status code 418", Failure::Refused),
            (Code::Cancelled, "Timeout expired", Failure::TimedOut),
            (Code::Cancelled, "", Failure::Temporary),
            (Code::DeadlineExceeded, "", Failure::Temporary),
            (Code::InvalidArgument, "length too large", Failure::Refused),
            (Code::Unauthenticated, "", Failure::Temporary),
            (Code::PermissionDenied, "", Failure::Temporary),
        ] {
            assert_eq!(failure(code, message), expected, "{code:?} {message}");
        }
        let busy = Status::with_details(Code::ResourceExhausted, "", vec![1].into());
        assert_eq!(failure_of(&busy), Failure::Temporary);
    }
}
