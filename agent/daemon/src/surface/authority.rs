//! The names under which a loopback listener answers (RFC 9112, 3.2: the Host header).
//!
//! A web page can make a browser on this host send requests to loopback under a name of its own
//! (DNS rebinding). It cannot make `localhost` or a loopback address its own name.

use std::net::{IpAddr, Ipv6Addr};

use axum::http::HeaderMap;
use axum::http::header::HOST;

/// Checks that the request has exactly one Host header, which names this host.
///
/// # Errors
/// Returns the header's value; empty if it is missing or repeated.
pub fn own(headers: &HeaderMap) -> Result<(), &str> {
    let mut hosts = headers.get_all(HOST).iter();
    let (Some(host), None) = (hosts.next(), hosts.next()) else {
        return Err("");
    };
    let host = host.to_str().unwrap_or_default();
    if is_own(host) { Ok(()) } else { Err(host) }
}

/// Returns whether the text is `localhost` or a loopback address, with or without a port.
pub(super) fn is_own(host: &str) -> bool {
    if let Some(rest) = host.strip_prefix('[') {
        let Some((address, port)) = rest.split_once(']') else {
            return false;
        };
        let address = address.parse::<Ipv6Addr>();
        return address.is_ok_and(|address| address.is_loopback()) && is_port(port);
    }
    let end = host.find(':').unwrap_or(host.len());
    let (name, port) = host.split_at(end);
    let is_loopback = |address: IpAddr| address.is_loopback();
    let is_here = name.eq_ignore_ascii_case("localhost") || name.parse().is_ok_and(is_loopback);
    is_here && is_port(port)
}

/// Returns whether the text is empty, or a colon and a port.
fn is_port(text: &str) -> bool {
    let digits = |port: &str| port.bytes().all(|byte| byte.is_ascii_digit());
    let port = |port: &str| digits(port) && port.parse::<u16>().is_ok();
    text.is_empty() || text.strip_prefix(':').is_some_and(port)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_localhost_and_loopback_addresses_are_names_of_this_host() {
        for host in [
            "localhost",
            "LOCALHOST:17401",
            "127.0.0.1:17401",
            "127.8.9.1",
            "[::1]:9000",
            "[::1]",
        ] {
            assert!(is_own(host), "{host}");
        }
        for host in [
            "",
            "[",
            "[]",
            "[::2]",
            "[::1",
            "[::1]evil",
            "[::1]evil:80",
            "[::1]:80@evil.example",
            "[127.0.0.1]",
            "localhost:x@evil",
            "localhost:80@evil.example",
            "localhost:",
            "localhost:+80",
            "localhost:65536",
            "localhost:80:80",
            "localhost.evil.example",
            "127.0.0.1.evil.example:17401",
            "127.0.0.1@evil.example",
            "10.0.0.1:17401",
            "evil.example",
        ] {
            assert!(!is_own(host), "{host}");
        }
    }

    #[test]
    fn a_missing_or_repeated_host_header_is_refused() {
        let named = |hosts: &[&str]| {
            let mut headers = HeaderMap::new();
            for host in hosts {
                headers.append(HOST, host.parse().unwrap());
            }
            own(&headers).map_err(str::to_owned)
        };
        assert_eq!(named(&["localhost"]), Ok(()));
        assert_eq!(named(&["evil.example"]), Err("evil.example".to_owned()));
        for none in [&[][..], &["localhost", "localhost"]] {
            assert_eq!(named(none), Err(String::new()));
        }
    }
}
