//! One request over HTTP or HTTPS, with the certificate authorities of this host.

use std::error::Error;
use std::io;
use std::time::Duration;

use bytes::Bytes;
use http_body_util::{BodyExt as _, Empty, Limited};
use hyper::header::{LOCATION, USER_AGENT};
use hyper::http::uri::InvalidUriParts;
use hyper::{Request, StatusCode, Uri};
use hyper_rustls::HttpsConnectorBuilder;
use hyper_util::client::legacy::connect::HttpConnector;
use hyper_util::client::legacy::{Client, ResponseFuture};
use hyper_util::rt::TokioExecutor;
use tokio::runtime::Builder;
use tokio::time::timeout;

use super::feed::MAX_BYTES;

/// Maximum wait for the whole answer.
const TIMEOUT: Duration = Duration::from_secs(20);
/// Maximum number of redirections.
const MAX_REDIRECTIONS: usize = 5;

/// A request got no usable answer.
#[derive(Debug, thiserror::Error)]
pub enum FetchError {
    /// The certificate authorities of this host cannot be read, or no runtime starts.
    #[error("cannot prepare the request")]
    Prepare(#[from] io::Error),
    /// The address is not one of a request.
    #[error("cannot request it")]
    Request(#[from] hyper::http::Error),
    /// The server cannot be reached, or has no certificate of a known authority.
    #[error("the connection failed")]
    Connection(#[from] hyper_util::client::legacy::Error),
    /// The body broke off, or is too large.
    #[error("cannot receive it")]
    Body(#[source] Box<dyn Error + Send + Sync>),
    /// The answer took too long.
    #[error("no answer within {} s", TIMEOUT.as_secs())]
    Slow,
    /// The server has no such file.
    #[error("the server answers {0}")]
    Status(StatusCode),
    /// The answer names another address, and that one another.
    #[error("more than {MAX_REDIRECTIONS} redirections")]
    Redirections,
    /// The answer names no other address.
    #[error("a redirection without address")]
    NoAddress,
    /// The answer names an address that does not exist.
    #[error("a redirection to no address")]
    Address(#[from] InvalidUriParts),
    /// The answer of an encrypted connection names one without encryption.
    #[error("a redirection to {0}, which is not encrypted")]
    Unencrypted(Uri),
}

/// Returns the body of the answer.
pub(super) fn fetch(address: &Uri) -> Result<Vec<u8>, FetchError> {
    let runtime = Builder::new_current_thread().enable_all().build()?;
    runtime.block_on(async {
        let fetched = timeout(TIMEOUT, follow(address.clone())).await;
        fetched.unwrap_or(Err(FetchError::Slow))
    })
}

async fn follow(mut address: Uri) -> Result<Vec<u8>, FetchError> {
    for _ in 0..=MAX_REDIRECTIONS {
        let request = Request::get(&address)
            .header(USER_AGENT, concat!("rp/", env!("CARGO_PKG_VERSION")))
            .body(Empty::<Bytes>::new())?;
        let answer = send(request)?.await?;
        if answer.status().is_redirection() {
            let target = answer.headers().get(LOCATION);
            let target = target.and_then(|value| value.to_str().ok()?.parse::<Uri>().ok());
            address = redirected(&address, target)?;
            continue;
        }
        if !answer.status().is_success() {
            return Err(FetchError::Status(answer.status()));
        }
        let body = Limited::new(answer.into_body(), MAX_BYTES).collect().await;
        return Ok(body.map_err(FetchError::Body)?.to_bytes().into());
    }
    Err(FetchError::Redirections)
}

/// Sends a request. Only an encrypted one needs the certificate authorities of this host, which may
/// have none.
fn send(request: Request<Empty<Bytes>>) -> io::Result<ResponseFuture> {
    let builder = Client::builder(TokioExecutor::new());
    if request.uri().scheme_str() != Some("https") {
        return Ok(builder.build(HttpConnector::new()).request(request));
    }
    let connector = HttpsConnectorBuilder::new()
        .with_native_roots()?
        .https_only()
        .enable_http1()
        .build();
    Ok(builder.build(connector).request(request))
}

/// Returns the next address. It keeps the host if `target` has none, and never leaves HTTPS.
fn redirected(from: &Uri, target: Option<Uri>) -> Result<Uri, FetchError> {
    let mut parts = target.ok_or(FetchError::NoAddress)?.into_parts();
    if parts.scheme.is_none() {
        parts.scheme = from.scheme().cloned();
        parts.authority = from.authority().cloned();
    }
    let target = Uri::from_parts(parts)?;
    if from.scheme_str() == Some("https") && target.scheme_str() != Some("https") {
        return Err(FetchError::Unencrypted(target));
    }
    Ok(target)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_redirection_keeps_the_host_and_the_encryption() {
        let from: Uri = "https://a.org/x".parse().unwrap();
        let to = |target: &str| redirected(&from, target.parse().ok());
        assert_eq!(to("/y").unwrap(), "https://a.org/y");
        assert_eq!(to("https://b.org/y").unwrap(), "https://b.org/y");
        assert!(to("http://b.org/y").is_err());
        assert!(redirected(&from, None).is_err());
    }
}
