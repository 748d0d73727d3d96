//! The address of a router, as a person writes it: `HOST`, `HOST:PORT` or `tcp/HOST:PORT`.

use std::fmt;
use std::io;
use std::net::{IpAddr, Ipv4Addr, Ipv6Addr, SocketAddr, ToSocketAddrs as _};

/// Port of `rmw_zenohd`.
pub const ROUTER_PORT: u16 = 7447;
const LOCALHOST: &str = "localhost";

/// Host and port of a router.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct RouterAddress {
    host: String,
    port: u16,
}

impl RouterAddress {
    /// Parses an address. A missing port is [`ROUTER_PORT`].
    ///
    /// # Errors
    ///
    /// Returns what is wrong with the text.
    pub fn parse(text: &str) -> Result<Self, &'static str> {
        let rest = match text.split_once('/') {
            Some(("tcp", rest)) => rest,
            Some(_) => return Err("only TCP: write HOST:PORT or tcp/HOST:PORT"),
            None => text,
        };
        let form = "must be HOST or HOST:PORT, such as 10.0.0.5:7447";
        let (host, port) = if let Some(inner) = rest.strip_prefix('[') {
            inner.split_once(']').ok_or(form)?
        } else if rest.parse::<IpAddr>().is_ok() {
            (rest, "")
        } else {
            rest.split_at(rest.find(':').unwrap_or(rest.len()))
        };
        let is_part = |c: char| c.is_ascii_alphanumeric() || matches!(c, '.' | '-' | '_');
        let is_host = if rest.starts_with('[') {
            host.parse::<Ipv6Addr>().is_ok()
        } else {
            host.parse::<IpAddr>().is_ok() || !host.is_empty() && host.chars().all(is_part)
        };
        if !is_host {
            return Err(form);
        }
        let port = match port.strip_prefix(':').map(str::parse) {
            None if port.is_empty() => ROUTER_PORT,
            None => return Err(form),
            Some(Ok(port)) if port > 0 => port,
            Some(_) => return Err("the port must be a number from 1 to 65535"),
        };
        Ok(Self {
            host: host.to_owned(),
            port,
        })
    }

    /// Returns the addresses in the order of attempts. This host and numeric addresses are resolved
    /// without a name server.
    ///
    /// # Errors
    ///
    /// Fails if the name cannot be resolved.
    pub fn resolve(&self) -> io::Result<Vec<SocketAddr>> {
        if self.host.eq_ignore_ascii_case(LOCALHOST) {
            let both = [Ipv4Addr::LOCALHOST.into(), Ipv6Addr::LOCALHOST.into()];
            return Ok(both.map(|ip: IpAddr| (ip, self.port).into()).to_vec());
        }
        if let Ok(ip) = self.host.parse::<IpAddr>() {
            return Ok(vec![(ip, self.port).into()]);
        }
        Ok((&*self.host, self.port).to_socket_addrs()?.collect())
    }
}

impl Default for RouterAddress {
    fn default() -> Self {
        Self {
            host: LOCALHOST.to_owned(),
            port: ROUTER_PORT,
        }
    }
}

impl fmt::Display for RouterAddress {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self.host.parse::<IpAddr>() {
            Ok(ip) => SocketAddr::new(ip, self.port).fmt(f),
            Err(_) => write!(f, "{}:{}", self.host, self.port),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn written(text: &str) -> String {
        RouterAddress::parse(text).unwrap().to_string()
    }

    #[test]
    fn a_host_without_a_port_has_the_default_port_of_routers() {
        assert_eq!(written("localhost"), "localhost:7447");
        assert_eq!(written("robot-1.local:7448"), "robot-1.local:7448");
        assert_eq!(written("tcp/10.0.0.5:7447"), "10.0.0.5:7447");
        assert_eq!(written("::1"), "[::1]:7447");
        assert_eq!(written("[fe80::1]:7000"), "[fe80::1]:7000");
        assert_eq!(written("[fe80::1]"), "[fe80::1]:7447");
        assert_eq!(
            RouterAddress::default(),
            RouterAddress::parse("localhost").unwrap()
        );
    }

    #[test]
    fn localhost_resolves_to_both_loopback_addresses_without_a_look_up() {
        let resolved = RouterAddress::default().resolve().unwrap();
        let resolved: Vec<_> = resolved.iter().map(ToString::to_string).collect();
        assert_eq!(resolved, ["127.0.0.1:7447", "[::1]:7447"]);
    }

    #[test]
    fn an_invalid_address_of_a_router_is_refused() {
        for wrong in [
            "",
            ":7447",
            "tls/robot:7447",
            "udp/robot:7447",
            "robot:0",
            "robot:70000",
            "robot:",
            "[robot]:7447",
            "[10.0.0.5]:7447",
            "[::1]7447",
            "[::1",
            "robot:7447:1",
            "a b",
            "http://robot",
        ] {
            assert!(RouterAddress::parse(wrong).is_err(), "{wrong}");
        }
    }
}
