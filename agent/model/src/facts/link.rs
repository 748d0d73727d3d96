//! Identity of a link: the TCP connections of one protocol between two hosts.

use std::net::IpAddr;

/// The protocol of a connection.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Debug)]
pub enum LinkProtocol {
    /// RTPS, as Fast DDS sends it over TCP.
    Rtps,
    /// Zenoh.
    Zenoh,
}

/// Identifies a link.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Debug)]
pub struct LinkKey {
    /// The protocol.
    pub protocol: LinkProtocol,
    /// Address of this host.
    pub source: IpAddr,
    /// Address of the other host.
    pub destination: IpAddr,
}

impl LinkProtocol {
    /// Returns the label value.
    #[must_use]
    pub const fn label(self) -> &'static str {
        match self {
            Self::Rtps => "rtps",
            Self::Zenoh => "zenoh",
        }
    }
}
