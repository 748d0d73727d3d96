//! Tokens that the agent sends without encryption.

use std::net::IpAddr;

use ros2probe_metrics::otlp::Endpoint;
use url::{Host, Url};

use super::Config;

/// A token that each host between this one and a receiver can read.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error(
    "the network between this host and {host} can read the token of {token}: use https:// in {address}, or a tunnel"
)]
pub struct ReadableToken {
    /// Key of the token.
    pub token: &'static str,
    /// Key of the receiver's address.
    pub address: &'static str,
    /// The receiver.
    pub host: String,
}

impl Config {
    /// Returns the tokens that are sent over plain HTTP to other hosts.
    #[must_use]
    pub fn readable_tokens(&self) -> Vec<ReadableToken> {
        let otlp = match &self.otlp.endpoint {
            Endpoint::At(url) => Some(url),
            Endpoint::Environment | Endpoint::Off => None,
        };
        let remote = &self.remote_write;
        let has_token = |mut names: std::collections::btree_map::Keys<'_, String, String>| {
            names.any(|name| is_secret(name))
        };
        [
            (
                "remote_write.token_file",
                "remote_write.url",
                remote.url.as_ref(),
                remote.token_file.is_some(),
            ),
            (
                "remote_write.headers",
                "remote_write.url",
                remote.url.as_ref(),
                has_token(remote.headers.keys()),
            ),
            (
                "otlp.headers_file",
                "otlp.endpoint",
                otlp,
                self.otlp.headers_file.is_some(),
            ),
            (
                "otlp.headers",
                "otlp.endpoint",
                otlp,
                has_token(self.otlp.headers.keys()),
            ),
            (
                "fleet.token_file",
                "fleet.engine",
                self.fleet.engine.as_ref(),
                self.fleet.token_file.is_some(),
            ),
        ]
        .into_iter()
        .filter_map(|(token, address, url, is_sent)| {
            let host = readable_by_others(url?).filter(|_| is_sent)?;
            Some(ReadableToken {
                token,
                address,
                host,
            })
        })
        .collect()
    }
}

/// Returns the host of a URL to which requests go without encryption; `None` for this host.
fn readable_by_others(url: &str) -> Option<String> {
    let url = Url::parse(url).ok().filter(|url| url.scheme() == "http")?;
    let is_here = match url.host()? {
        Host::Domain(name) => name == "localhost" || name.ends_with(".localhost"),
        Host::Ipv4(address) => address.is_loopback(),
        Host::Ipv6(address) => IpAddr::V6(address).to_canonical().is_loopback(),
    };
    (!is_here).then(|| url.host_str().unwrap_or_default().to_owned())
}

/// Returns whether the name of a header is that of a token.
fn is_secret(header: &str) -> bool {
    let header = header.to_ascii_lowercase();
    let parts = ["authorization", "token", "key", "secret"];
    parts.iter().any(|part| header.contains(part))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn keys(yaml: &str) -> Vec<&'static str> {
        let config = Config::parse(yaml.as_bytes()).unwrap();
        config.readable_tokens().iter().map(|it| it.token).collect()
    }

    #[test]
    fn a_token_over_plain_http_to_another_host_is_reported() {
        let remote = |url: &str| {
            keys(&format!(
                "remote_write: {{url: '{url}/api/v1/write', token_file: /token}}\n"
            ))
        };
        for url in ["http://prometheus.example", "http://10.0.0.7:9090"] {
            assert_eq!(remote(url), ["remote_write.token_file"], "{url}");
        }
        for url in [
            "https://prometheus.example",
            "http://localhost:9090",
            "http://127.0.0.1:9090",
            "http://[::1]:9090",
            "http://[::ffff:127.0.0.1]:9090",
        ] {
            assert!(remote(url).is_empty(), "{url}");
        }
        assert!(
            keys("remote_write: {url: 'http://a/b', headers: {x-scope-orgid: a}}\n").is_empty()
        );
        let all = "remote_write: {url: 'http://a/b', headers: {authorization: a}}\n\
                   otlp: {endpoint: 'http://a:4317', headers: {x-api-key: a}, headers_file: /h}\n\
                   fleet: {engine: 'http://a:9090', token_file: /t}\n";
        let expected = [
            "remote_write.headers",
            "otlp.headers_file",
            "otlp.headers",
            "fleet.token_file",
        ];
        assert_eq!(keys(all), expected);
        let config = Config::parse(all.as_bytes()).unwrap();
        let text = config.readable_tokens()[3].to_string();
        assert!(text.contains("use https:// in fleet.engine"), "{text}");
    }
}
