//! Addresses of OpenTelemetry receivers.

use tonic::codegen::http::Uri;

/// Default port of receivers.
const OTLP_PORT: u16 = 4317;

/// Parses a URL for gRPC: scheme and authority. A path after them belongs to OTLP over HTTP and is
/// dropped. `None` if the text is not such a URL.
#[must_use]
pub fn otlp_endpoint(text: &str) -> Option<Uri> {
    let uri: Uri = text.parse().ok()?;
    let scheme = uri
        .scheme_str()
        .filter(|scheme| ["http", "https"].contains(scheme))?;
    let authority = uri.authority()?;
    let authority = match authority.port_u16() {
        Some(_) => authority.to_string(),
        None if authority.as_str().contains('@') || authority.host().is_empty() => return None,
        None => format!("{}:{OTLP_PORT}", authority.host()),
    };
    Uri::builder()
        .scheme(scheme)
        .authority(authority)
        .path_and_query("/")
        .build()
        .ok()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn endpoints_are_urls_with_a_host() {
        let taken = |text: &str| otlp_endpoint(text).map(|uri| uri.to_string());
        for (text, uri) in [
            ("http://collector", "http://collector:4317/"),
            ("http://[::1]:9/v1/metrics", "http://[::1]:9/"),
            ("https://otlp.example", "https://otlp.example:4317/"),
        ] {
            assert_eq!(taken(text).as_deref(), Some(uri));
        }
        for text in [
            "",
            "collector",
            "collector:4317",
            "ftp://a",
            "http://",
            "/a",
            "grpc://a:1",
        ] {
            assert_eq!(taken(text), None, "{text}");
        }
    }
}
