//! Connections to the receiver, one per signal. `opentelemetry-otlp` encodes, compresses, sends and
//! retries, and reads `OTEL_EXPORTER_OTLP_*_HEADERS`.
//!
//! The connections themselves come from tonic and hyper, with rustls. The library's own gRPC
//! channel sends no HTTP/2 pings, so requests would wait for minutes after a failure of the
//! network. Requests that the library cannot send (`encoded_sender.rs`) use the same connection.

use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use hyper_rustls::HttpsConnectorBuilder;
use opentelemetry_http::hyper::HyperClient;
use opentelemetry_http::{Bytes, HttpClient, HttpError, Request, Response};
use opentelemetry_otlp::{
    Compression, LogExporter, MetricExporter, Protocol, SpanExporter, WithExportConfig,
    WithHttpConfig, WithTonicConfig,
};
use tonic::codegen::http::HeaderMap;
use tonic::metadata::MetadataMap;
use tonic::transport::{Channel, ClientTlsConfig, Endpoint};

use super::encoded_sender::EncodedSender;
use super::headers::Headers;
use super::reports;
use super::settings::{SettingsError, Target};
use crate::connector::{connect_timeout, connector};

/// Interval of HTTP/2 pings while a request is open. A connection that does not answer a ping is
/// closed and opened again.
const PING_INTERVAL: Duration = Duration::from_secs(30);

/// The connection of a signal; opened at the first request, and again after a failure.
pub(super) struct Transport {
    target: Target,
    connection: Connection,
    /// Headers of the last request.
    sent: SentHeaders,
}

/// Headers of the last request, with those that the library read from the environment; `None` if no
/// request was sent.
pub(super) type SentHeaders = Arc<Mutex<Option<HeaderMap>>>;

#[derive(Clone)]
enum Connection {
    Grpc(Channel),
    Http(Arc<dyn HttpClient>),
}

impl Transport {
    /// Creates a connection without opening it; requires a runtime.
    pub(super) fn new(target: Target) -> Result<Self, SettingsError> {
        let sent = SentHeaders::default();
        let connection = if target.is_grpc {
            Connection::Grpc(channel(&target)?)
        } else {
            Connection::Http(http_client(&target, &sent)?)
        };
        Ok(Self {
            target,
            connection,
            sent,
        })
    }

    /// Returns the receiver's address.
    pub(super) fn endpoint(&self) -> String {
        self.target.endpoint.to_string()
    }

    /// Returns the exporter of metrics.
    pub(super) fn metrics(&self) -> Result<MetricExporter, SettingsError> {
        let builder = MetricExporter::builder();
        Ok(match &self.connection {
            Connection::Grpc(channel) => self.grpc(builder.with_tonic(), channel).build()?,
            Connection::Http(client) => self.http(builder.with_http(), client).build()?,
        })
    }

    /// Returns the sender of requests that the exporter cannot send.
    pub(super) fn encoded(&self) -> EncodedSender {
        let headers = Arc::clone(&self.sent);
        match &self.connection {
            Connection::Grpc(channel) => {
                let own = self.target.headers.clone();
                EncodedSender::grpc(channel.clone(), self.target.gzip, headers, own)
            }
            Connection::Http(client) => {
                EncodedSender::http(Arc::clone(client), self.target.endpoint.clone(), headers)
            }
        }
    }

    /// Returns an exporter of log records.
    pub(super) fn logs(&self) -> Result<LogExporter, SettingsError> {
        let builder = LogExporter::builder();
        Ok(match &self.connection {
            Connection::Grpc(channel) => self.grpc(builder.with_tonic(), channel).build()?,
            Connection::Http(client) => self.http(builder.with_http(), client).build()?,
        })
    }

    /// Returns an exporter of spans.
    pub(super) fn spans(&self) -> Result<SpanExporter, SettingsError> {
        let builder = SpanExporter::builder();
        Ok(match &self.connection {
            Connection::Grpc(channel) => self.grpc(builder.with_tonic(), channel).build()?,
            Connection::Http(client) => self.http(builder.with_http(), client).build()?,
        })
    }

    fn grpc<B: WithTonicConfig + WithExportConfig>(&self, builder: B, channel: &Channel) -> B {
        let (own, sent) = (self.target.headers.clone(), Arc::clone(&self.sent));
        let interceptor = move |mut request: tonic::Request<()>| {
            reports::attempt();
            let mut headers = std::mem::take(request.metadata_mut()).into_headers();
            overwrite(&mut headers, &own.current());
            *sent.lock().unwrap_or_else(PoisonError::into_inner) = Some(headers.clone());
            *request.metadata_mut() = MetadataMap::from_headers(headers);
            Ok(request)
        };
        let builder = builder
            .with_channel(channel.clone())
            .with_interceptor(interceptor)
            .with_timeout(self.target.timeout);
        if self.target.gzip {
            builder.with_compression(Compression::Gzip)
        } else {
            builder
        }
    }

    fn http<B: WithHttpConfig + WithExportConfig>(
        &self,
        builder: B,
        client: &Arc<dyn HttpClient>,
    ) -> B {
        let builder = builder
            .with_shared_http_client(Arc::clone(client))
            .with_protocol(Protocol::HttpBinary)
            .with_endpoint(self.target.endpoint.to_string())
            .with_timeout(self.target.timeout);
        if self.target.gzip {
            builder.with_compression(Compression::Gzip)
        } else {
            builder
        }
    }
}

/// Configures TLS with the system's certificate authorities, or those in `SSL_CERT_FILE`.
fn channel(target: &Target) -> Result<Channel, SettingsError> {
    let endpoint = Endpoint::from(target.endpoint.clone())
        .user_agent(concat!("ros2probe/", env!("CARGO_PKG_VERSION")))
        .map_err(SettingsError::Client)?;
    let endpoint = if target.endpoint.scheme_str() == Some("https") {
        let authorities = ClientTlsConfig::new().with_native_roots();
        endpoint
            .tls_config(authorities)
            .map_err(SettingsError::Client)?
    } else {
        endpoint
    };
    let endpoint = endpoint
        .connect_timeout(connect_timeout(target.timeout))
        .timeout(target.timeout)
        .http2_keep_alive_interval(PING_INTERVAL);
    Ok(endpoint.connect_lazy())
}

fn http_client(target: &Target, sent: &SentHeaders) -> Result<Arc<dyn HttpClient>, SettingsError> {
    let (headers, sent) = (target.headers.clone(), Arc::clone(sent));
    if target.endpoint.scheme_str() != Some("https") {
        let client = HyperClient::new(connector(target.timeout), target.timeout, None);
        return Ok(Arc::new(Client {
            client,
            headers,
            sent,
        }));
    }
    let connector = HttpsConnectorBuilder::new()
        .with_native_roots()
        .map_err(SettingsError::Authorities)?
        .https_only()
        .enable_http1()
        .wrap_connector(connector(target.timeout));
    let client = HyperClient::new(connector, target.timeout, None);
    Ok(Arc::new(Client {
        client,
        headers,
        sent,
    }))
}

/// An HTTP client that adds the configured headers and notes each attempt.
#[derive(Debug)]
struct Client<C> {
    client: C,
    headers: Headers,
    sent: SentHeaders,
}

#[tonic::async_trait]
impl<C: HttpClient> HttpClient for Client<C> {
    async fn send_bytes(&self, mut request: Request<Bytes>) -> Result<Response<Bytes>, HttpError> {
        reports::attempt();
        overwrite(request.headers_mut(), &self.headers.current());
        *self.sent.lock().unwrap_or_else(PoisonError::into_inner) = Some(request.headers().clone());
        self.client.send_bytes(request).await
    }
}

/// Sets the headers of the configuration, which take precedence over those of the environment.
pub(super) fn overwrite(headers: &mut HeaderMap, own: &HeaderMap) {
    for (name, value) in own {
        headers.insert(name.clone(), value.clone());
    }
}

#[cfg(test)]
mod tests {
    use tokio::time::error::Elapsed;

    use super::*;
    use crate::connector::tests::Unreachable;

    #[tokio::test]
    async fn a_receiver_out_of_reach_is_no_slow_one_over_http() {
        let receiver = Unreachable::new();
        let timeout = Duration::from_secs(1);
        let is_slow = async |address| {
            let client = HyperClient::new(connector(timeout), timeout, None);
            let mut request = Request::new(Bytes::new());
            *request.uri_mut() = format!("http://{address}/v1/logs").parse().unwrap();
            client
                .send_bytes(request)
                .await
                .unwrap_err()
                .is::<Elapsed>()
        };
        assert!(!is_slow(receiver.address).await);
        let silent = std::net::TcpListener::bind("127.0.0.1:0").unwrap();
        assert!(is_slow(silent.local_addr().unwrap()).await);
    }
}
