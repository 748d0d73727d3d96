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
use opentelemetry_sdk::error::{OTelSdkError, OTelSdkResult};
use prost::Message;
use tonic::codec::CompressionEncoding;
use tonic::codegen::http::Uri;
use tonic::codegen::http::header::CONTENT_ENCODING;
use tonic::metadata::MetadataMap;
use tonic::transport::Channel;
use tonic::{Code, Status};

use super::reports;
use super::transport::SentHeaders;

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

/// Sends such requests.
pub(super) struct EncodedSender {
    protocol: Protocol,
    headers: SentHeaders,
}

enum Protocol {
    Grpc { channel: Channel, gzip: bool },
    Http(Arc<dyn HttpClient>, Uri),
}

impl EncodedSender {
    pub(super) const fn grpc(channel: Channel, gzip: bool, headers: SentHeaders) -> Self {
        Self {
            protocol: Protocol::Grpc { channel, gzip },
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
                reports::refused();
                failure(error.to_string())
            }
        }
    }

    /// Sends a request once. The delivery offers a failed request again. The exporter must have
    /// sent a request before, because only the library reads headers from the environment.
    pub(super) async fn send<S: Service>(&self, request: &S) -> OTelSdkResult {
        let headers = self
            .headers
            .lock()
            .unwrap_or_else(PoisonError::into_inner)
            .clone()
            .unwrap_or_default();
        let response = match &self.protocol {
            Protocol::Grpc { channel, gzip } => {
                reports::attempt();
                let mut request = tonic::Request::new(request.clone());
                *request.metadata_mut() = MetadataMap::from_headers(headers);
                match S::call(channel.clone(), *gzip, request).await {
                    Ok(response) => response,
                    Err(status) => {
                        if is_final(&status) {
                            reports::refused();
                        }
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
                    Err(error) => return failure(error.to_string()),
                };
                if !response.status().is_success() {
                    if ![429, 502, 503, 504].contains(&response.status().as_u16()) {
                        reports::refused();
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

/// Returns whether a request must not be repeated (OTLP 1.x, "Failures").
fn is_final(status: &Status) -> bool {
    match status.code() {
        Code::Cancelled
        | Code::DeadlineExceeded
        | Code::Aborted
        | Code::OutOfRange
        | Code::Unavailable
        | Code::DataLoss => false,
        // Details mean that the receiver is busy, and when to try again. Without them, the request
        // is too large.
        Code::ResourceExhausted => status.details().is_empty(),
        _ => true,
    }
}
