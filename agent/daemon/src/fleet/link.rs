//! Addresses of the pages of robots.

use std::net::Ipv6Addr;
use std::str::FromStr;

use percent_encoding::{AsciiSet, NON_ALPHANUMERIC, utf8_percent_encode};

/// The place of a robot's name in a [`Link`].
const ROBOT: &str = "{robot}";

/// The address of a robot's own page.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Link(String);

/// A text is not the address of robots' pages.
#[derive(Debug, thiserror::Error)]
#[error("`{0}` is no URL with {ROBOT}, as in `http://{ROBOT}.example:17401/`")]
pub struct InvalidLink(String);

impl FromStr for Link {
    type Err = InvalidLink;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        let is_web = ["http://", "https://"]
            .iter()
            .any(|it| text.starts_with(it));
        match is_web && text.contains(ROBOT) {
            true => Ok(Self(text.to_owned())),
            false => Err(InvalidLink(text.to_owned())),
        }
    }
}

impl Link {
    /// Returns the address of a robot's page.
    ///
    /// The name of a robot that is scraped is HOST:PORT. As the host of the link it keeps the port
    /// only if the link names nothing after it.
    #[must_use]
    pub fn of(&self, robot: &str) -> String {
        // RFC 3986, 2.3: unreserved characters.
        const HOST: &AsciiSet = &NON_ALPHANUMERIC
            .remove(b'-')
            .remove(b'.')
            .remove(b'_')
            .remove(b'~');
        // RFC 3986, 3.3 and 3.4: a colon has no meaning in a path or query.
        const PATH: &AsciiSet = &HOST.remove(b':');
        let encoded = |name: &str| utf8_percent_encode(name, HOST).to_string();
        let (scheme, rest) = self.0.split_once("://").unwrap_or(("http", &self.0));
        let end = rest.find(['/', '?', '#']).unwrap_or(rest.len());
        let (authority, path) = rest.split_at(end);
        let (name, port) = match host_and_port(robot) {
            Some((host, port)) => (bracketed(host).unwrap_or_else(|| encoded(host)), Some(port)),
            None => (bracketed(robot).unwrap_or_else(|| encoded(robot)), None),
        };
        let mut authority = authority.replace(ROBOT, &name);
        if let Some(port) = port
            && rest.get(..end).is_some_and(|it| it.ends_with(ROBOT))
        {
            authority = format!("{authority}:{port}");
        }
        format!(
            "{scheme}://{authority}{}",
            path.replace(ROBOT, &utf8_percent_encode(robot, PATH).to_string())
        )
    }
}

/// Returns the parts of HOST:PORT; `None` for another name.
fn host_and_port(name: &str) -> Option<(&str, u16)> {
    let (host, port) = name.rsplit_once(':')?;
    let is_host = !host.is_empty() && (!host.contains(':') || bracketed(host).is_some());
    Some((host, port.parse().ok().filter(|_| is_host)?))
}

/// Returns a name that is an address of IPv6 in brackets.
fn bracketed(name: &str) -> Option<String> {
    let address = name.strip_prefix('[')?.strip_suffix(']')?;
    let address: Ipv6Addr = address.parse().ok()?;
    Some(format!("[{address}]"))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_link_leads_to_the_web_and_has_a_place_for_the_robot() {
        let link: Link = "https://{robot}.example/?to={robot}".parse().unwrap();
        assert_eq!(link.of("r-2.a"), "https://r-2.a.example/?to=r-2.a");
        assert_eq!(
            link.of("a/\"<"),
            "https://a%2F%22%3C.example/?to=a%2F%22%3C"
        );
        // A robot that is scraped has the port of its metrics in its name.
        let own_port: Link = "http://{robot}:17401/".parse().unwrap();
        let domain: Link = "http://{robot}.example/?to={robot}".parse().unwrap();
        let whole: Link = "http://{robot}/page".parse().unwrap();
        for (link, robot, expected) in [
            (&own_port, "r-2:17400", "http://r-2:17401/"),
            (&own_port, "[fd00::7]:17400", "http://[fd00::7]:17401/"),
            (&own_port, "10.0.0.7", "http://10.0.0.7:17401/"),
            (&domain, "r-2:17400", "http://r-2.example/?to=r-2:17400"),
            (&whole, "r-2:17400", "http://r-2:17400/page"),
            (&whole, "a:b", "http://a%3Ab/page"),
            (&whole, "robot_7", "http://robot_7/page"),
            (&whole, "evil@a:1", "http://evil%40a:1/page"),
            (&whole, "[x]:1", "http://%5Bx%5D:1/page"),
        ] {
            assert_eq!(link.of(robot), expected, "{robot}");
        }
        for text in ["ftp://{robot}/", "http://robot/", "javascript:{robot}"] {
            assert!(text.parse::<Link>().is_err(), "{text}");
        }
    }
}
