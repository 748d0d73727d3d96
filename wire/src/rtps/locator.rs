//! Locators: addresses of endpoints (RTPS 2.5, 9.3.2.3 and 9.4.2.11).

use core::fmt;
use core::net::{IpAddr, Ipv4Addr, Ipv6Addr, SocketAddr};

use crate::cursor::{Cursor, WireError};

/// Kind of transport; vendors add their own.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Debug)]
pub struct LocatorKind(pub i32);

impl LocatorKind {
    /// Not a locator.
    pub const INVALID: Self = Self(-1);
    /// UDP over IPv4.
    pub const UDP_V4: Self = Self(1);
    /// UDP over IPv6.
    pub const UDP_V6: Self = Self(2);
    /// TCP over IPv4.
    pub const TCP_V4: Self = Self(4);
    /// TCP over IPv6.
    pub const TCP_V6: Self = Self(8);
    /// Shared memory of Fast DDS 2.x and of Cyclone DDS.
    pub const SHARED_MEMORY: Self = Self(16);
    /// Shared memory of Fast DDS 3.x.
    pub const SHARED_MEMORY_FAST_3: Self = Self(19);
}

/// One address of one transport.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct Locator {
    /// Kind of transport.
    pub kind: LocatorKind,
    /// Port, in the transport's own numbering.
    pub port: u32,
    /// Address; an IPv4 address is in the last four bytes.
    pub address: [u8; 16],
}

impl Locator {
    /// Length on the wire, in bytes.
    pub const LEN: usize = 24;

    /// Reads a locator in the cursor's byte order.
    ///
    /// # Errors
    /// Returns [`Truncated`](crate::cursor::Reason::Truncated) if fewer than [`Self::LEN`] bytes
    /// remain.
    pub fn read(cursor: &mut Cursor<'_>) -> Result<Self, WireError> {
        Ok(Self {
            kind: LocatorKind(cursor.i32("locator kind")?),
            port: cursor.u32("locator port")?,
            address: cursor.array("locator address")?,
        })
    }

    /// Returns the UDP address; `None` for other transports.
    #[must_use]
    pub fn udp(&self) -> Option<SocketAddr> {
        let address = match self.kind {
            LocatorKind::UDP_V4 => {
                let [.., a, b, c, d] = self.address;
                IpAddr::V4(Ipv4Addr::new(a, b, c, d))
            }
            LocatorKind::UDP_V6 => IpAddr::V6(Ipv6Addr::from(self.address)),
            _ => return None,
        };
        Some(SocketAddr::new(address, u16::try_from(self.port).ok()?))
    }

    /// Returns the addresses at which the participant accepts TCP connections: its own, and the one
    /// outside of its network if it announces one. They are empty for other transports, and if the
    /// participant only opens connections. In the port, the upper half is the logical port.
    pub fn tcp(&self) -> impl Iterator<Item = SocketAddr> {
        let port = (self.port & 0xffff) as u16;
        let [.., e, f, g, h, a, b, c, d] = self.address;
        let wan = Ipv4Addr::new(e, f, g, h);
        let addresses = match self.kind {
            LocatorKind::TCP_V4 => [
                Some(IpAddr::V4(Ipv4Addr::new(a, b, c, d))),
                (!wan.is_unspecified()).then_some(IpAddr::V4(wan)),
            ],
            LocatorKind::TCP_V6 => [Some(IpAddr::V6(Ipv6Addr::from(self.address))), None],
            _ => [None, None],
        };
        let addresses = addresses.into_iter().flatten();
        let addresses = addresses.map(move |address| SocketAddr::new(address, port));
        addresses.filter(|address| address.port() != 0)
    }

    /// Returns whether the transport is TCP (Fast DDS).
    #[must_use]
    pub const fn is_tcp(&self) -> bool {
        matches!(self.kind, LocatorKind::TCP_V4 | LocatorKind::TCP_V6)
    }

    /// Returns whether these locators include TCP and not UDP. A sender then uses TCP, or shared
    /// memory on the same host.
    #[must_use]
    pub fn are_tcp(locators: &[Self]) -> bool {
        let is_udp = |locator: &Self| locator.udp().is_some();
        locators.iter().any(Self::is_tcp) && !locators.iter().any(is_udp)
    }

    /// Returns whether the transport is shared memory, in the numbering of any vendor.
    #[must_use]
    pub const fn is_shared_memory(&self) -> bool {
        matches!(
            self.kind,
            LocatorKind::SHARED_MEMORY | LocatorKind::SHARED_MEMORY_FAST_3
        )
    }
}

impl fmt::Display for Locator {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        if let Some(address) = self.udp() {
            return write!(f, "udp:{address}");
        }
        write!(f, "{}:", self.kind.0)?;
        self.address
            .iter()
            .try_for_each(|byte| write!(f, "{byte:02x}"))?;
        write!(f, ":{}", self.port)
    }
}

impl fmt::Debug for Locator {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        fmt::Display::fmt(self, f)
    }
}
