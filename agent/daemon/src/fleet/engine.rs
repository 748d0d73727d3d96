//! Queries to an engine with the HTTP API of Prometheus.

use std::error::Error;
use std::io;
use std::path::{Path, PathBuf};
use std::str::FromStr;
use std::time::Duration;

use bytes::Bytes;
use http_body_util::{BodyExt as _, Full, LengthLimitError, Limited};
use hyper::header::{AUTHORIZATION, CONTENT_TYPE, HeaderValue, USER_AGENT};
use hyper::{Request, StatusCode, Uri};
use hyper_rustls::{HttpsConnector, HttpsConnectorBuilder};
use hyper_util::client::legacy::connect::HttpConnector;
use hyper_util::client::legacy::{Client, ResponseFuture};
use hyper_util::rt::TokioExecutor;
use percent_encoding::{NON_ALPHANUMERIC, utf8_percent_encode};
use serde::Deserialize;
use tokio::time::timeout;

use super::TOKEN_BYTES;
use crate::file;

/// Maximum wait for an answer.
const TIMEOUT: Duration = Duration::from_secs(30);
/// Maximum length of an answer for a command, in bytes.
pub const MAX_BYTES: usize = 64 << 20;
/// All answers of a reading have at most one series for this many bytes of the longest answer: the
/// shortest series need 30 bytes there, and several hundred in memory.
const BYTES_PER_SERIES: usize = 40;

/// Labels of a series that are read. Those that it does not have are empty, as in PromQL.
#[derive(Clone, Debug, Default, PartialEq, Eq, Deserialize)]
#[serde(default)]
pub(super) struct Labels {
    pub instance: String,
    pub version: String,
    pub ros_node: String,
    pub topic: String,
    pub message_type: String,
    pub reliability: String,
    pub durability: String,
    pub expectation: String,
    pub kind: String,
}

/// A connection to an engine.
#[derive(Debug)]
pub struct Engine {
    query: Uri,
    /// File with a bearer token. Each query reads it, so that a replaced one applies at once.
    token_file: Option<PathBuf>,
    /// Maximum length of an answer, in bytes.
    max_bytes: usize,
    client: HttpClient,
}

/// A client with or without encryption. Only the former needs the certificate authorities of this
/// host, which may have none.
#[derive(Debug)]
enum HttpClient {
    Plain(Client<HttpConnector, Full<Bytes>>),
    Encrypted(Client<HttpsConnector<HttpConnector>, Full<Bytes>>),
}

/// A text is not the address of an engine.
#[derive(Debug, thiserror::Error)]
#[error("`{0}` is not the URL of an engine, as in `http://prometheus.example:9090`")]
pub struct InvalidAddress(String);

/// An engine gave no usable answer.
#[derive(Debug, thiserror::Error)]
pub enum EngineError {
    /// The address is none.
    #[error(transparent)]
    Address(#[from] InvalidAddress),
    /// The certificate authorities of this host cannot be read.
    #[error("cannot prepare the request")]
    Prepare(#[source] io::Error),
    /// The file with the token cannot be read.
    #[error("cannot read {}", path.display())]
    TokenFile {
        /// Path of the file.
        path: PathBuf,
        /// Error of the operating system.
        source: io::Error,
    },
    /// The token cannot be part of a request.
    #[error("the token is not one line of ASCII")]
    Token,
    /// The engine cannot be reached.
    #[error("the connection failed")]
    Connection(#[source] hyper_util::client::legacy::Error),
    /// The answer broke off.
    #[error("cannot receive the answer")]
    Body(#[source] Box<dyn Error + Send + Sync>),
    /// The answer has more bytes than this.
    #[error("the answer is longer than {0} bytes")]
    TooLong(usize),
    /// The answers have more series than this.
    #[error("the answers have more than {0} series in all")]
    TooMany(usize),
    /// The answer took too long.
    #[error("no answer within {} s", TIMEOUT.as_secs())]
    Slow,
    /// The engine refuses the query.
    #[error("the engine answers {0}: {1}")]
    Status(StatusCode, String),
    /// The answer is no result of a query.
    #[error("the answer is not one of Prometheus's query API")]
    Form(#[source] serde_json::Error),
}

/// Base address of an engine, without the path of its API.
#[derive(Clone, Debug)]
pub(super) struct Address(Uri);

#[derive(Deserialize)]
struct Answer {
    data: Data,
}

#[derive(Deserialize)]
#[serde(tag = "resultType", content = "result", rename_all = "lowercase")]
enum Data {
    Vector(Vec<Sample>),
}

#[derive(Deserialize)]
struct Sample {
    metric: Labels,
    /// Time in seconds, and the value as text.
    value: (f64, String),
}

impl Address {
    /// Returns the address of queries.
    fn query(&self) -> Uri {
        let base = self.0.to_string();
        let address = format!("{}/api/v1/query", base.trim_end_matches('/'));
        address.parse().unwrap_or_else(|_| self.0.clone())
    }
}

impl FromStr for Address {
    type Err = InvalidAddress;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        let invalid = || InvalidAddress(text.to_owned());
        let uri: Uri = text.parse().map_err(|_| invalid())?;
        let is_http = matches!(uri.scheme_str(), Some("http" | "https"));
        let has_host = uri.host().is_some_and(|host| !host.is_empty());
        match is_http && has_host && uri.query().is_none() {
            true => Ok(Self(uri)),
            false => Err(invalid()),
        }
    }
}

/// Returns whether a text is the URL of an engine.
#[must_use]
pub fn is_engine(text: &str) -> bool {
    text.parse::<Address>().is_ok()
}

impl Engine {
    /// Creates a client of the engine at a URL. With a file, requests have its bearer token. The
    /// client refuses answers that are longer than `max_bytes`.
    ///
    /// # Errors
    ///
    /// Fails if the URL or the token is invalid.
    pub fn new(
        url: &str,
        token_file: Option<&Path>,
        max_bytes: usize,
    ) -> Result<Self, EngineError> {
        let address: Address = url.parse()?;
        let query = address.query();
        let client = HttpClient::of(&query).map_err(EngineError::Prepare)?;
        let engine = Self {
            query,
            token_file: token_file.map(Path::to_owned),
            max_bytes,
            client,
        };
        engine.authorization()?;
        Ok(engine)
    }

    /// Returns the value of `Authorization`.
    fn authorization(&self) -> Result<Option<HeaderValue>, EngineError> {
        let Some(path) = &self.token_file else {
            return Ok(None);
        };
        let token = file::read_text(path, TOKEN_BYTES);
        let token = token.map_err(|source| EngineError::TokenFile {
            path: path.clone(),
            source,
        })?;
        let value = HeaderValue::try_from(format!("Bearer {}", token.trim()));
        let mut value = value.map_err(|_| EngineError::Token)?;
        value.set_sensitive(true);
        Ok(Some(value))
    }

    /// Returns the maximum number of series in all answers of a reading.
    pub(super) const fn max_series(&self) -> usize {
        self.max_bytes / BYTES_PER_SERIES
    }

    /// Returns the current value of each series of an expression, and takes their number from
    /// `left`.
    ///
    /// # Errors
    ///
    /// Fails if the token cannot be read, if the engine cannot be reached, if it refuses the query,
    /// or if its answer is too large.
    pub(super) async fn query(
        &self,
        expression: &str,
        left: &mut usize,
    ) -> Result<Vec<(Labels, f64)>, EngineError> {
        let encoded = utf8_percent_encode(expression, NON_ALPHANUMERIC);
        let mut request = Request::new(Full::new(Bytes::from(format!("query={encoded}"))));
        *request.method_mut() = hyper::Method::POST;
        *request.uri_mut() = self.query.clone();
        let headers = request.headers_mut();
        let form = HeaderValue::from_static("application/x-www-form-urlencoded");
        headers.insert(CONTENT_TYPE, form);
        let agent = HeaderValue::from_static(concat!("rp/", env!("CARGO_PKG_VERSION")));
        headers.insert(USER_AGENT, agent);
        if let Some(token) = self.authorization()? {
            headers.insert(AUTHORIZATION, token);
        }
        let answered = async {
            let answer = self.client.request(request).await;
            let answer = answer.map_err(EngineError::Connection)?;
            let status = answer.status();
            let body = Limited::new(answer.into_body(), self.max_bytes)
                .collect()
                .await;
            let body = body.map_err(|error| match error.is::<LengthLimitError>() {
                true => EngineError::TooLong(self.max_bytes),
                false => EngineError::Body(error),
            });
            let body = body?.to_bytes();
            if status.is_success() {
                return Ok(body);
            }
            let text = String::from_utf8_lossy(&body);
            let text = text.trim().chars().take(200).collect();
            Err(EngineError::Status(status, text))
        };
        let answered = timeout(TIMEOUT, answered).await;
        let samples = read(&answered.unwrap_or(Err(EngineError::Slow))?)?;
        let rest = left.checked_sub(samples.len());
        *left = rest.ok_or(EngineError::TooMany(self.max_series()))?;
        Ok(samples)
    }
}

impl HttpClient {
    fn of(address: &Uri) -> io::Result<Self> {
        let builder = Client::builder(TokioExecutor::new());
        if address.scheme_str() != Some("https") {
            return Ok(Self::Plain(builder.build(HttpConnector::new())));
        }
        let connector = HttpsConnectorBuilder::new()
            .with_native_roots()?
            .https_only()
            .enable_http1()
            .build();
        Ok(Self::Encrypted(builder.build(connector)))
    }

    fn request(&self, request: Request<Full<Bytes>>) -> ResponseFuture {
        match self {
            Self::Plain(client) => client.request(request),
            Self::Encrypted(client) => client.request(request),
        }
    }
}

/// Reads the samples of an answer. Values that are no numbers are left out.
fn read(body: &[u8]) -> Result<Vec<(Labels, f64)>, EngineError> {
    let answer: Answer = serde_json::from_slice(body).map_err(EngineError::Form)?;
    let Data::Vector(samples) = answer.data;
    let samples = samples.into_iter().filter_map(|sample| {
        let value = sample.value.1.parse().ok()?;
        Some((sample.metric, value))
    });
    Ok(samples.collect())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_path_of_a_tenant_stays_in_the_address() {
        let query = |text: &str| text.parse::<Address>().unwrap().query().to_string();
        assert_eq!(query("http://a:9090"), "http://a:9090/api/v1/query");
        assert_eq!(
            query("https://a/prometheus/"),
            "https://a/prometheus/api/v1/query"
        );
        for text in ["", "a:9090", "ftp://a", "http://a/?b=c", "/a"] {
            assert!(text.parse::<Address>().is_err(), "{text}");
        }
    }

    #[test]
    fn only_results_of_queries_are_read() {
        let body = r#"{"status":"success","data":{"resultType":"vector","result":[
            {"metric":{"instance":"a","site":"b"},"value":[1.5,"2"]},
            {"metric":{},"value":[1.5,"NaN"]}]}}"#;
        let samples = read(body.as_bytes()).unwrap();
        let labels = Labels {
            instance: "a".to_owned(),
            ..Labels::default()
        };
        assert_eq!(samples[0], (labels, 2.0));
        assert!(samples[1].1.is_nan());
        assert!(read(b"<html>").is_err());
        assert!(read(br#"{"data":{"resultType":"matrix","result":[]}}"#).is_err());
    }
}
