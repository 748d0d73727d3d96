//! The route of a datagram: direction, receiving socket and destination address.

use std::net::{IpAddr, Ipv6Addr, SocketAddr};

use ros2probe_wire::GuidPrefix;

/// The direction of a delivery.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Debug)]
pub enum Direction {
    /// The samples left this host. A gap is not a loss here, because no receiver awaits unsent
    /// samples.
    Sent,
    /// The samples arrived at a receiver.
    Received,
}

impl Direction {
    /// Returns the label value.
    #[must_use]
    pub const fn label(self) -> &'static str {
        match self {
            Self::Sent => "sent",
            Self::Received => "received",
        }
    }
}

/// A UDP destination.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Debug, Default)]
pub struct Destination {
    /// Address, IPv4-mapped for IPv4.
    pub address: [u8; 16],
    /// Port.
    pub port: u16,
}

impl Destination {
    /// Returns whether its datagrams may reach several receivers.
    #[must_use]
    pub fn is_multicast(&self) -> bool {
        self.socket_address().ip().is_multicast()
    }

    /// Returns the address in its usual form, with mapped IPv4 addresses converted.
    #[must_use]
    pub fn socket_address(&self) -> SocketAddr {
        let address = Ipv6Addr::from(self.address).to_canonical();
        SocketAddr::new(address, self.port)
    }
}

impl From<SocketAddr> for Destination {
    fn from(address: SocketAddr) -> Self {
        let mapped = match address.ip() {
            IpAddr::V4(ip) => ip.to_ipv6_mapped(),
            IpAddr::V6(ip) => ip,
        };
        Self {
            address: mapped.octets(),
            port: address.port(),
        }
    }
}

/// A route of a writer's samples.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Debug)]
pub struct Route {
    /// Outgoing or incoming.
    pub direction: Direction,
    /// Cookie of the receiving socket; 0 for outgoing samples and on a wire source.
    pub socket: u64,
    /// Destination of the samples.
    pub destination: Destination,
}

impl Route {
    /// Returns whether the route is outgoing.
    #[must_use]
    pub fn is_sent(&self) -> bool {
        self.direction == Direction::Sent
    }

    /// Returns whether it is an incoming multicast route, whose receiver is not evident.
    #[must_use]
    pub fn is_open(&self) -> bool {
        !self.is_sent() && self.destination.is_multicast()
    }
}

/// The receiver of the samples.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Debug)]
pub enum Receiver {
    /// A participant, on any route.
    Participant(GuidPrefix),
    /// The receivers of this route.
    Route(Route),
}

#[cfg(test)]
mod tests {
    use super::*;

    fn destination(address: &str) -> Destination {
        Destination::from(address.parse::<SocketAddr>().unwrap())
    }

    #[test]
    fn a_destination_prints_as_parsed_and_recognizes_multicast() {
        for text in ["10.0.0.2:7411", "239.255.0.1:7401", "[fe80::1]:7411"] {
            assert_eq!(destination(text).socket_address().to_string(), text);
        }
        assert!(
            destination("239.255.0.1:7401").is_multicast()
                && destination("[ff02::1]:1").is_multicast()
        );
        assert!(
            !destination("10.0.0.2:7411").is_multicast()
                && !destination("[fe80::1]:1").is_multicast()
        );
    }
}
