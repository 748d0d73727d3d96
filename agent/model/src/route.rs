//! By which route a record came: leaving this host or arriving, at which socket, for which address.

use std::net::{IpAddr, Ipv6Addr, SocketAddr};

use ros2probe_wire::Record;
use ros2probe_wire::record::flag;

/// Which side of the network a delivery was seen at.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Debug)]
pub enum Direction {
    /// On its way out of this host. Losses are not counted here: what did not leave is nobody's.
    Sent,
    /// At a receiver.
    Received,
}

impl Direction {
    /// Label value.
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
    /// IPv4-mapped for IPv4.
    pub address: [u8; 16],
    /// Port.
    pub port: u16,
}

impl Destination {
    /// Where the record's datagram was sent to.
    #[must_use]
    pub fn of(record: &Record) -> Self {
        let [a, b, c, d] = record.destination.map(u32::to_ne_bytes);
        let mut address = [0; 16];
        for (into, from) in address.iter_mut().zip([a, b, c, d].as_flattened()) {
            *into = *from;
        }
        Self {
            address,
            port: record.destination_port,
        }
    }

    /// Whether a datagram for it may reach several receivers.
    #[must_use]
    pub fn is_multicast(&self) -> bool {
        self.socket_address().ip().is_multicast()
    }

    /// As everybody writes it.
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

/// One route of a writer's samples.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Debug)]
pub struct Route {
    /// Leaving or arriving.
    pub direction: Direction,
    /// Cookie of the receiving socket; 0 when leaving, and on a wire source.
    pub socket: u64,
    /// Where to.
    pub destination: Destination,
}

impl Route {
    /// That of the record's datagram.
    #[must_use]
    pub fn of(record: &Record) -> Self {
        let destination = Destination::of(record);
        if record.flags & flag::OUTGOING != 0 {
            return Self {
                direction: Direction::Sent,
                socket: 0,
                destination,
            };
        }
        Self {
            direction: Direction::Received,
            socket: if record.flags & flag::HOST != 0 {
                record.socket
            } else {
                0
            },
            destination,
        }
    }
}

impl Route {
    /// On its way out.
    #[must_use]
    pub fn is_sent(&self) -> bool {
        self.direction == Direction::Sent
    }

    /// A multicast that arrives: of itself it tells nothing about who receives it.
    #[must_use]
    pub fn is_open(&self) -> bool {
        !self.is_sent() && self.destination.is_multicast()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn destination(address: &str) -> Destination {
        Destination::from(address.parse::<SocketAddr>().unwrap())
    }

    #[test]
    fn a_place_is_written_as_it_was_read() {
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

    #[test]
    fn a_socket_tells_ways_apart_only_where_it_receives() {
        let record = Record {
            destination: [
                0,
                0,
                u32::from_be(0xffff),
                u32::from_ne_bytes([10, 0, 0, 2]),
            ],
            destination_port: 7411,
            socket: 77,
            flags: flag::HOST,
            ..Record::default()
        };
        let received = Route::of(&record);
        assert_eq!(
            (received.direction, received.socket),
            (Direction::Received, 77)
        );
        assert_eq!(received.destination, destination("10.0.0.2:7411"));
        let sent = Route::of(&Record {
            flags: flag::HOST | flag::OUTGOING,
            ..record
        });
        assert_eq!((sent.direction, sent.socket), (Direction::Sent, 0));
        let on_the_wire = Route::of(&Record { flags: 0, ..record });
        assert_eq!(on_the_wire.socket, 0);
    }
}
