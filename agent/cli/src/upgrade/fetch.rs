//! One request over HTTP or HTTPS, with the certificate authorities of this host.

use std::error::Error;
use std::time::Duration;

use bytes::Bytes;
use http_body_util::{BodyExt as _, Empty, Limited};
use hyper::header::{LOCATION, USER_AGENT};
use hyper::{Request, Uri};
use hyper_rustls::HttpsConnectorBuilder;
use hyper_util::client::legacy::Client;
use hyper_util::rt::TokioExecutor;
use tokio::runtime::Builder;
use tokio::time::timeout;

use super::feed::MAX_BYTES;

/// Maximum wait for the whole answer.
const TIMEOUT: Duration = Duration::from_secs(20);
/// Maximum number of redirections.
const MAX_REDIRECTIONS: usize = 5;

/// Returns the body of the answer, or the reason of the failure.
pub(super) fn fetch(address: &Uri) -> Result<Vec<u8>, String> {
    let runtime = Builder::new_current_thread().enable_all().build();
    let runtime = runtime.map_err(|error| error.to_string())?;
    runtime.block_on(async {
        let fetched = timeout(TIMEOUT, follow(address.clone())).await;
        fetched.unwrap_or_else(|_| Err(format!("no answer within {} s", TIMEOUT.as_secs())))
    })
}

async fn follow(mut address: Uri) -> Result<Vec<u8>, String> {
    let connector = HttpsConnectorBuilder::new()
        .with_native_roots()
        .map_err(|error| error.to_string())?
        .https_or_http()
        .enable_http1()
        .build();
    let client = Client::builder(TokioExecutor::new()).build(connector);
    for _ in 0..=MAX_REDIRECTIONS {
        let request = Request::get(&address)
            .header(USER_AGENT, concat!("rp/", env!("CARGO_PKG_VERSION")))
            .body(Empty::<Bytes>::new())
            .map_err(|error| error.to_string())?;
        let answer = client.request(request).await;
        let answer = answer.map_err(|error| with_causes(&error))?;
        if answer.status().is_redirection() {
            let target = answer.headers().get(LOCATION);
            let target = target.and_then(|value| value.to_str().ok()?.parse::<Uri>().ok());
            address = redirected(&address, target)?;
            continue;
        }
        if !answer.status().is_success() {
            return Err(format!("the server answers {}", answer.status()));
        }
        let body = Limited::new(answer.into_body(), MAX_BYTES).collect().await;
        let body = body.map_err(|error| with_causes(&*error))?;
        return Ok(body.to_bytes().into());
    }
    Err(format!("more than {MAX_REDIRECTIONS} redirections"))
}

/// Returns the next address. It keeps the host if `target` has none, and never leaves HTTPS.
fn redirected(from: &Uri, target: Option<Uri>) -> Result<Uri, String> {
    let mut parts = target.ok_or("a redirection without address")?.into_parts();
    if parts.scheme.is_none() {
        parts.scheme = from.scheme().cloned();
        parts.authority = from.authority().cloned();
    }
    let target = Uri::from_parts(parts).map_err(|error| error.to_string())?;
    if from.scheme_str() == Some("https") && target.scheme_str() != Some("https") {
        return Err(format!("a redirection to {target}, which is not encrypted"));
    }
    Ok(target)
}

fn with_causes(error: &(dyn Error + 'static)) -> String {
    let mut text = error.to_string();
    let mut next = error.source();
    while let Some(cause) = next {
        text = format!("{text}: {cause}");
        next = cause.source();
    }
    text
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
