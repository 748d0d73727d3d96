//! Requests to the receiver over HTTP/1.1, with TLS by rustls.

use std::sync::Arc;
use std::time::{Duration, SystemTime};

use http_body_util::{BodyExt as _, Full, Limited};
use hyper::header::{
    AUTHORIZATION, CONTENT_ENCODING, CONTENT_TYPE, HeaderMap, HeaderName, HeaderValue, RETRY_AFTER,
    USER_AGENT,
};
use hyper::{Request, Response, StatusCode};
use hyper_rustls::{ConfigBuilderExt as _, HttpsConnector, HttpsConnectorBuilder};
use hyper_util::client::legacy::Client as HttpClient;
use hyper_util::client::legacy::connect::HttpConnector;
use hyper_util::rt::TokioExecutor;
use prost::bytes::Bytes;
use tokio::time::timeout;
use tokio_rustls::rustls::pki_types::pem::PemObject as _;
use tokio_rustls::rustls::pki_types::{CertificateDer, PrivateKeyDer};
use tokio_rustls::rustls::{ClientConfig, RootCertStore};

use super::request::Version;
use super::settings::{Settings, SettingsError};
use crate::connector::connector;

const VERSION_HEADER: HeaderName = HeaderName::from_static("x-prometheus-remote-write-version");
/// Number of samples that a receiver of version 2.0 wrote.
const SAMPLES_WRITTEN_HEADER: &str = "x-prometheus-remote-write-samples-written";
/// Maximum length of an answer that is read, in bytes.
const ANSWER_BYTES: usize = 4 << 10;
/// Maximum length of a reason in the log, in characters.
const MAX_REASON: usize = 200;
/// Maximum pause that a receiver may demand.
const LONGEST_PAUSE: Duration = Duration::from_mins(5);

type Connections = HttpClient<HttpsConnector<HttpConnector>, Full<Bytes>>;

/// A client of one receiver.
pub(super) struct Client {
    settings: Arc<Settings>,
    connections: Connections,
    /// Times at which the files for TLS were changed, as of `connections`.
    files: Vec<Option<SystemTime>>,
}

/// Answer to a request.
#[derive(Debug, PartialEq, Eq)]
pub(super) enum WriteResult {
    /// The receiver wrote all samples.
    Accepted,
    /// The request may succeed later; at the earliest after this time.
    RetryLater(String, Option<Duration>),
    /// No answer arrived in time over a connection. On a slow link, a smaller request may succeed.
    Late,
    /// The receiver refuses these samples. It wrote this number of them, if it knows.
    Refused(String, Option<u64>),
    /// The receiver does not know this version.
    UnknownVersion,
    /// A success that does not state what was written: of a receiver that does not know version
    /// 2.0, or of something between it and the robot.
    Unconfirmed,
}

impl Client {
    /// Creates a client without a connection.
    ///
    /// Fails if a file of the settings cannot be used.
    pub(super) fn new(settings: Arc<Settings>) -> Result<Self, SettingsError> {
        let files = settings.changed();
        authorization(&settings)?;
        Ok(Self {
            connections: connections(&settings)?,
            settings,
            files,
        })
    }

    /// Uses replaced files from now on.
    ///
    /// Fails if a file cannot be used. The previous ones remain in use then.
    pub(super) fn reload_files(&mut self) -> Result<(), SettingsError> {
        let files = self.settings.changed();
        if files != self.files {
            self.connections = connections(&self.settings)?;
            self.files = files;
        }
        Ok(())
    }

    /// Sends a body once.
    pub(super) async fn send(&self, body: Bytes, version: Version) -> WriteResult {
        let request = match self.request(body, version) {
            Ok(request) => request,
            Err(error) => return WriteResult::RetryLater(in_words(&error), None),
        };
        let answered = async {
            let response = self.connections.request(request).await;
            let response = response.map_err(|error| in_words(&error))?;
            let (head, body) = response.into_parts();
            let body = Limited::new(body, ANSWER_BYTES).collect().await;
            let body = body.map(http_body_util::Collected::to_bytes);
            Ok::<_, String>(Response::from_parts(head, body.unwrap_or_default()))
        };
        match timeout(self.settings.timeout, answered).await {
            Ok(Ok(response)) => answer(&response, version),
            Ok(Err(reason)) => WriteResult::RetryLater(reason, None),
            Err(_) => WriteResult::Late,
        }
    }

    fn request(
        &self,
        body: Bytes,
        version: Version,
    ) -> Result<Request<Full<Bytes>>, SettingsError> {
        let mut request = Request::new(Full::new(body));
        *request.method_mut() = hyper::Method::POST;
        *request.uri_mut() = self.settings.url.clone();
        let headers = request.headers_mut();
        for (name, value) in [
            (CONTENT_ENCODING, "snappy"),
            (CONTENT_TYPE, version.content_type()),
            (VERSION_HEADER, version.header()),
            (USER_AGENT, concat!("ros2probe/", env!("CARGO_PKG_VERSION"))),
        ] {
            headers.insert(name, HeaderValue::from_static(value));
        }
        for (name, value) in &self.settings.headers {
            headers.insert(name.clone(), value.clone());
        }
        if let Some(value) = authorization(&self.settings)? {
            headers.insert(AUTHORIZATION, value);
        }
        Ok(request)
    }
}

/// Returns the value of `Authorization`. The file is read for each request, so that a replaced one
/// applies at once.
fn authorization(settings: &Settings) -> Result<Option<HeaderValue>, SettingsError> {
    let Some(path) = &settings.token_file else {
        return Ok(None);
    };
    let token = settings.read("token_file", path)?;
    let value = HeaderValue::try_from(format!("Bearer {}", token.trim()));
    let mut value = value.map_err(|_| SettingsError::content("token_file", path))?;
    value.set_sensitive(true);
    Ok(Some(value))
}

fn connections(settings: &Settings) -> Result<Connections, SettingsError> {
    let builder = HttpsConnectorBuilder::new().with_tls_config(tls(settings)?);
    let builder = builder.https_or_http().enable_http1();
    let connector = builder.wrap_connector(connector(settings.timeout));
    Ok(HttpClient::builder(TokioExecutor::new()).build(connector))
}

fn tls(settings: &Settings) -> Result<ClientConfig, SettingsError> {
    let builder = ClientConfig::builder();
    let is_secure = settings.url.scheme_str() == Some("https");
    let builder = match &settings.ca_file {
        // Without TLS, a system without certificate authorities suffices.
        None if !is_secure => builder.with_root_certificates(RootCertStore::empty()),
        None => builder
            .with_native_roots()
            .map_err(SettingsError::Authorities)?,
        Some(path) => {
            let unfit = || SettingsError::content("ca_file", path);
            let mut roots = RootCertStore::empty();
            for authority in certificates(&settings.read("ca_file", path)?).ok_or_else(unfit)? {
                roots.add(authority).map_err(|_| unfit())?;
            }
            builder.with_root_certificates(roots)
        }
    };
    let Some((certificate, key)) = &settings.certificate else {
        return Ok(builder.with_no_client_auth());
    };
    let chain = certificates(&settings.read("certificate_file", certificate)?);
    let chain = chain.ok_or_else(|| SettingsError::content("certificate_file", certificate))?;
    let unfit = || SettingsError::content("key_file", key);
    let text = settings.read("key_file", key)?;
    let key = PrivateKeyDer::from_pem_slice(text.as_bytes()).map_err(|_| unfit())?;
    builder
        .with_client_auth_cert(chain, key)
        .map_err(|_| unfit())
}

/// Returns the certificates of a PEM file; `None` if the file has none, or a damaged one.
fn certificates(text: &str) -> Option<Vec<CertificateDer<'static>>> {
    let all = CertificateDer::pem_slice_iter(text.as_bytes()).collect::<Result<Vec<_>, _>>();
    all.ok().filter(|all| !all.is_empty())
}

/// Interprets a response (Prometheus Remote-Write 2.0, "Responses").
fn answer(response: &Response<Bytes>, version: Version) -> WriteResult {
    let (status, headers) = (response.status(), response.headers());
    let written = headers.get(SAMPLES_WRITTEN_HEADER).and_then(number);
    // A receiver of version 1.0 ignores a body of version 2.0, or cannot parse it.
    let is_old = matches!(
        status,
        StatusCode::UNSUPPORTED_MEDIA_TYPE | StatusCode::BAD_REQUEST
    );
    if version == Version::Two && written.is_none() {
        if is_old {
            return WriteResult::UnknownVersion;
        }
        if status.is_success() {
            return WriteResult::Unconfirmed;
        }
    }
    if status.is_success() {
        return WriteResult::Accepted;
    }
    let text = String::from_utf8_lossy(response.body());
    let text: String = text.trim().chars().take(MAX_REASON).collect();
    let reason = format!("{status}: {text}");
    if status.is_server_error() || is_temporary(status) {
        WriteResult::RetryLater(reason, pause(headers))
    } else {
        WriteResult::Refused(reason, written)
    }
}

/// Returns whether a status other than 5xx may change without new samples. Wrong or expired
/// credentials are replaced some day, and the samples wait for it.
fn is_temporary(status: StatusCode) -> bool {
    matches!(
        status,
        StatusCode::TOO_MANY_REQUESTS
            | StatusCode::REQUEST_TIMEOUT
            | StatusCode::UNAUTHORIZED
            | StatusCode::FORBIDDEN
            | StatusCode::PROXY_AUTHENTICATION_REQUIRED
            | StatusCode::NOT_FOUND
    ) || status.is_redirection()
}

/// Returns the pause of `Retry-After`, if it is in seconds.
fn pause(headers: &HeaderMap) -> Option<Duration> {
    let seconds = headers.get(RETRY_AFTER).and_then(number)?;
    Some(Duration::from_secs(seconds).min(LONGEST_PAUSE))
}

fn number(value: &HeaderValue) -> Option<u64> {
    value.to_str().ok()?.trim().parse().ok()
}

/// Returns an error with its causes in one line.
fn in_words(error: &dyn std::error::Error) -> String {
    let causes = std::iter::successors(Some(error), |error| error.source());
    let words: Vec<_> = causes.map(ToString::to_string).collect();
    words.join(": ")
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::connector::tests::Unreachable;
    use crate::otlp::Host;
    use crate::remote_write::RemoteWriteSettings;

    /// Returns a client of a receiver whose requests may take a second.
    fn client(receiver: std::net::SocketAddr) -> Client {
        let file = RemoteWriteSettings {
            url: Some(format!("http://{receiver}/api/v1/write")),
            timeout: Duration::from_secs(1),
            ..RemoteWriteSettings::default()
        };
        let host = Host {
            name: Some("robot-7".to_owned()),
            ..Host::default()
        };
        let settings = Settings::resolve(&file, |path, _| std::fs::read_to_string(path), &host);
        Client::new(Arc::new(settings.unwrap().unwrap())).unwrap()
    }

    #[tokio::test]
    async fn a_receiver_out_of_reach_is_no_slow_one() {
        let receiver = Unreachable::new();
        let result = client(receiver.address)
            .send(Bytes::new(), Version::Two)
            .await;
        let WriteResult::RetryLater(reason, None) = result else {
            panic!("{result:?}");
        };
        assert!(reason.contains("tcp connect error"), "{reason}");
        // Its connections are accepted by the kernel, and nothing answers.
        let silent = std::net::TcpListener::bind("127.0.0.1:0").unwrap();
        let client = client(silent.local_addr().unwrap());
        let result = client.send(Bytes::new(), Version::Two).await;
        assert_eq!(result, WriteResult::Late);
    }

    #[test]
    fn an_answer_decides_whether_samples_are_sent_again() {
        let reply = |status: u16, headers: &[(&'static str, &str)], body: &'static str| {
            let mut response = Response::new(Bytes::from(body));
            *response.status_mut() = StatusCode::from_u16(status).unwrap();
            for (name, value) in headers {
                let value = HeaderValue::from_str(value).unwrap();
                response.headers_mut().insert(*name, value);
            }
            response
        };
        let one = |response: &_| answer(response, Version::One);
        let two = |response: &_| answer(response, Version::Two);
        let again = |text: &str, pause| WriteResult::RetryLater(text.to_owned(), pause);
        assert_eq!(one(&reply(204, &[], "")), WriteResult::Accepted);
        assert_eq!(
            two(&reply(204, &[(SAMPLES_WRITTEN_HEADER, "3")], "")),
            WriteResult::Accepted
        );
        assert_eq!(two(&reply(204, &[], "")), WriteResult::Unconfirmed);
        for status in [400, 415] {
            assert_eq!(two(&reply(status, &[], "")), WriteResult::UnknownVersion);
        }
        let old = one(&reply(400, &[], "out of order\n"));
        let reason = "400 Bad Request: out of order".to_owned();
        assert_eq!(old, WriteResult::Refused(reason.clone(), None));
        let partly = two(&reply(
            400,
            &[(SAMPLES_WRITTEN_HEADER, "2")],
            "out of order",
        ));
        assert_eq!(partly, WriteResult::Refused(reason, Some(2)));
        let pause = Some(Duration::from_secs(7));
        let busy = reply(429, &[("retry-after", "7")], "");
        assert_eq!(two(&busy), again("429 Too Many Requests: ", pause));
        let longest = reply(503, &[("retry-after", "99999")], "");
        let longest = one(&longest);
        assert_eq!(
            longest,
            again("503 Service Unavailable: ", Some(LONGEST_PAUSE))
        );
        assert_eq!(
            one(&reply(401, &[], "no")),
            again("401 Unauthorized: no", None)
        );
    }
}
