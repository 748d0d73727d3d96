//! HTTP/1.1 for the object stores, with TLS by rustls. Bodies of requests keep to the bandwidth
//! limit, and a request without progress ends.

use std::fmt;
use std::path::Path;
use std::pin::Pin;
use std::sync::Arc;
use std::task::{Context, Poll};
use std::time::Duration;

use async_trait::async_trait;
use bytes::Bytes;
use http_body_util::{BodyExt as _, Full, Limited};
use hyper::body::{Body, Frame, SizeHint};
use hyper::header::{HeaderValue, RETRY_AFTER, USER_AGENT};
use hyper_rustls::{ConfigBuilderExt as _, HttpsConnector, HttpsConnectorBuilder};
use hyper_util::client::legacy::Client;
use hyper_util::client::legacy::connect::HttpConnector as TcpConnector;
use hyper_util::rt::TokioExecutor;
use object_store::ClientOptions;
use object_store::client::{
    HttpClient, HttpConnector, HttpError, HttpErrorKind, HttpRequest, HttpRequestBody,
    HttpResponse, HttpResponseBody, HttpService,
};
use tokio::time::{Instant, Sleep, sleep_until, timeout};
use tokio_rustls::rustls::pki_types::CertificateDer;
use tokio_rustls::rustls::pki_types::pem::PemObject as _;
use tokio_rustls::rustls::{ClientConfig, RootCertStore};

use crate::credentials::read_text;
use crate::link::{Link, PIECE_BYTES};
use crate::settings::SettingsError;

/// Maximum wait for a connection.
const CONNECT_TIMEOUT: Duration = Duration::from_secs(20);
/// Time after which the kernel ends a connection whose other end confirms nothing.
const TCP_USER_TIMEOUT: Duration = Duration::from_mins(1);
/// Maximum wait for an answer after the last bytes.
const RESPONSE_TIMEOUT: Duration = Duration::from_mins(2);
/// Maximum length of an answer in bytes. Only manifests and short documents are read.
const ANSWER_BYTES: usize = 16 << 20;

/// Connections to a store.
#[derive(Clone)]
pub(crate) struct Connections {
    client: Client<HttpsConnector<TcpConnector>, Paced>,
    link: Arc<Link>,
}

/// A body that keeps to the bandwidth limit.
struct Paced {
    body: HttpRequestBody,
    /// Bytes of the current frame, and the time from which the next of them may be sent.
    rest: Bytes,
    turn: Option<Pin<Box<Sleep>>>,
    link: Arc<Link>,
}

/// No answer came in time.
#[derive(Debug, thiserror::Error)]
#[error("no answer in time")]
struct Slow;

/// The answer broke off, or is too long.
#[derive(Debug, thiserror::Error)]
#[error("the answer cannot be read: {0}")]
struct BadAnswer(Box<dyn std::error::Error + Send + Sync>);

impl Connections {
    /// Creates a client without a connection. Without TLS, a system without certificate authorities
    /// suffices.
    pub(crate) fn new(
        ca_file: Option<&Path>,
        is_secure: bool,
        link: Arc<Link>,
    ) -> Result<Self, SettingsError> {
        let mut tcp = TcpConnector::new();
        tcp.enforce_http(false);
        tcp.set_connect_timeout(Some(CONNECT_TIMEOUT));
        tcp.set_tcp_user_timeout(Some(TCP_USER_TIMEOUT));
        tcp.set_keepalive(Some(TCP_USER_TIMEOUT / 2));
        let connector = HttpsConnectorBuilder::new()
            .with_tls_config(tls(ca_file, is_secure)?)
            .https_or_http()
            .enable_http1()
            .wrap_connector(tcp);
        let client = Client::builder(TokioExecutor::new()).build(connector);
        Ok(Self { client, link })
    }

    /// Completes when the request has had no progress for too long.
    async fn stalled(&self) {
        loop {
            let deadline = self.link.progress() + RESPONSE_TIMEOUT;
            if deadline <= Instant::now() {
                return;
            }
            sleep_until(deadline).await;
        }
    }
}

impl fmt::Debug for Connections {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Connections").finish_non_exhaustive()
    }
}

impl HttpConnector for Connections {
    fn connect(&self, _: &ClientOptions) -> object_store::Result<HttpClient> {
        Ok(HttpClient::new(self.clone()))
    }
}

#[async_trait]
impl HttpService for Connections {
    async fn call(&self, request: HttpRequest) -> Result<HttpResponse, HttpError> {
        self.link.begin();
        let mut request = request.map(|body| Paced {
            body,
            rest: Bytes::new(),
            turn: None,
            link: Arc::clone(&self.link),
        });
        let agent = HeaderValue::from_static(concat!("ros2probe/", env!("CARGO_PKG_VERSION")));
        request.headers_mut().insert(USER_AGENT, agent);
        let response = tokio::select! {
            response = self.client.request(request) => response,
            () = self.stalled() => return Err(HttpError::new(HttpErrorKind::Timeout, Slow)),
        };
        let response = response.map_err(|error| {
            let kind = match error.is_connect() {
                true => HttpErrorKind::Connect,
                false => HttpErrorKind::Interrupted,
            };
            HttpError::new(kind, error)
        })?;
        let (head, body) = response.into_parts();
        if !head.status.is_success() {
            let pause = head.headers.get(RETRY_AFTER);
            let pause = pause.and_then(|pause| pause.to_str().ok()?.trim().parse().ok());
            self.link
                .refused(head.status, pause.map(Duration::from_secs));
        }
        let body = timeout(RESPONSE_TIMEOUT, Limited::new(body, ANSWER_BYTES).collect()).await;
        let body = body.map_err(|_| HttpError::new(HttpErrorKind::Timeout, Slow))?;
        let body = body.map_err(|error| HttpError::new(HttpErrorKind::Decode, BadAnswer(error)))?;
        let body = Full::new(body.to_bytes()).map_err(|never| match never {});
        Ok(HttpResponse::from_parts(head, HttpResponseBody::new(body)))
    }
}

impl Body for Paced {
    type Data = Bytes;
    type Error = HttpError;

    fn poll_frame(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
    ) -> Poll<Option<Result<Frame<Bytes>, HttpError>>> {
        if self.rest.is_empty() {
            match Pin::new(&mut self.body).poll_frame(context) {
                Poll::Ready(Some(Ok(frame))) => match frame.into_data() {
                    Ok(data) => self.rest = data,
                    Err(other) => return Poll::Ready(Some(Ok(other))),
                },
                other => return other,
            }
        }
        let length = self.rest.len().min(PIECE_BYTES);
        if self.turn.is_none() {
            self.turn = Some(Box::pin(sleep_until(self.link.reserve(length))));
        }
        if let Some(turn) = &mut self.turn
            && turn.as_mut().poll(context).is_pending()
        {
            return Poll::Pending;
        }
        self.turn = None;
        Poll::Ready(Some(Ok(Frame::data(self.rest.split_to(length)))))
    }

    fn is_end_stream(&self) -> bool {
        self.rest.is_empty() && self.body.is_end_stream()
    }

    fn size_hint(&self) -> SizeHint {
        let rest = self.rest.len() as u64;
        let hint = self.body.size_hint();
        let mut whole = SizeHint::new();
        whole.set_lower(hint.lower().saturating_add(rest));
        if let Some(upper) = hint.upper() {
            whole.set_upper(upper.saturating_add(rest));
        }
        whole
    }
}

fn tls(ca_file: Option<&Path>, is_secure: bool) -> Result<ClientConfig, SettingsError> {
    let builder = ClientConfig::builder();
    let Some(path) = ca_file else {
        if !is_secure {
            let builder = builder.with_root_certificates(RootCertStore::empty());
            return Ok(builder.with_no_client_auth());
        }
        let builder = builder.with_native_roots();
        let builder = builder.map_err(SettingsError::SystemAuthorities)?;
        return Ok(builder.with_no_client_auth());
    };
    let text = read_text("ca_file", path)?;
    let unfit = || SettingsError::Authorities(path.to_owned());
    let authorities = CertificateDer::pem_slice_iter(text.as_bytes());
    let mut roots = RootCertStore::empty();
    for authority in authorities {
        let authority = authority.map_err(|_| unfit())?;
        roots.add(authority).map_err(|_| unfit())?;
    }
    if roots.is_empty() {
        return Err(unfit());
    }
    Ok(builder.with_root_certificates(roots).with_no_client_auth())
}
