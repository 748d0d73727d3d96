//! `rp discover`: requests that running participants repeat their announcements.
//!
//! This is the only part of the product that sends, and it runs only on request. [`zenoh`] sends to
//! a router, the other modules to participants of DDS. A bare participant exists for a few
//! milliseconds. It announces itself by unicast to one running participant at a time, requests its
//! announcements, and says goodbye. A conversation has at most [`session::MAX_PACKETS`] packets.
//! No other participant receives them, no user endpoint is created, and no trace remains.

pub mod announcements;
mod announcer;
pub mod message;
pub mod participants;
pub mod session;
pub mod zenoh;

use std::fs::File;
use std::io::{self, Read as _};
use std::net::{IpAddr, Ipv4Addr, SocketAddr, SocketAddrV4, UdpSocket};
use std::time::{Duration, Instant};

pub use ros2probe_wire::GuidPrefix;
use ros2probe_wire::Timestamp;

use self::message::{LocalParticipant, VENDOR};
use self::session::{Outgoing, Session, Target};
use ros2probe_model::report::snapshot::ParticipantFacts;

/// Interval at which the session advances without input.
const ADVANCE_INTERVAL: Duration = Duration::from_millis(5);
/// Wait after the goodbye for packets in flight, which a closed port would make the kernel answer.
const LINGER_TIME: Duration = Duration::from_millis(50);
/// Maximum size of a UDP payload, in bytes.
const MAX_DATAGRAM: usize = 65_507;

/// Reason why a participant receives no request.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Refusal {
    /// The participant uses DDS security, so it ignores unauthenticated participants.
    Secured,
    /// The participant announces no IPv4 address for discovery.
    NoAddress,
    /// The participant announces its endpoints by TCP.
    UsesTcp,
    /// The participant is another running `rp discover`.
    OtherDiscover,
}

/// A request failed.
#[derive(Debug, thiserror::Error)]
pub enum DiscoverError {
    /// The socket cannot be opened.
    #[error("cannot open a socket for {target}")]
    Open {
        /// Address of the participant.
        target: SocketAddrV4,
        /// Error of the operating system.
        source: io::Error,
    },
    /// No random numbers for a GUID prefix are available.
    #[error("cannot read random numbers")]
    Random(#[source] io::Error),
    /// A packet cannot be sent or received.
    #[error("cannot exchange packets with {target}")]
    Socket {
        /// Address of the participant.
        target: SocketAddrV4,
        /// Error of the operating system.
        source: io::Error,
    },
}

impl Target {
    /// Returns the target for a participant.
    ///
    /// # Errors
    ///
    /// Returns the reason why the participant receives no request.
    pub fn of(participant: &ParticipantFacts) -> Result<Self, Refusal> {
        if participant.secured {
            return Err(Refusal::Secured);
        }
        if participant.guid.prefix.0.starts_with(&VENDOR.0) {
            return Err(Refusal::OtherDiscover);
        }
        if participant.announces_by_tcp {
            return Err(Refusal::UsesTcp);
        }
        let addresses = &participant.addresses;
        let metatraffic = reachable(&addresses.metatraffic).ok_or(Refusal::NoAddress)?;
        let default = &addresses.default;
        // Among several default addresses, prefers one with the IP address of the discovery
        // endpoints.
        let same = default.iter().filter(|it| it.ip() == *metatraffic.ip());
        let same: Vec<SocketAddr> = same.copied().collect();
        let default = reachable(&same).or_else(|| reachable(default));
        Ok(Self {
            prefix: participant.guid.prefix,
            metatraffic,
            default: default.unwrap_or(metatraffic),
        })
    }
}

impl Refusal {
    /// Returns the text of the reason.
    #[must_use]
    pub const fn reason(self) -> &'static str {
        match self {
            Self::Secured => "uses DDS security: receives no requests",
            Self::NoAddress => "announces no IPv4 address for discovery",
            Self::UsesTcp => "announces by TCP: another participant with TCP makes it repeat that",
            Self::OtherDiscover => "is another rp discover",
        }
    }
}

/// Creates a participant with a new identity, and its socket on the route to the target. Sends
/// nothing.
///
/// # Errors
///
/// Fails if the socket cannot be opened, or if random numbers are unavailable.
pub fn local_participant(
    target: &Target,
    domain_id: u32,
) -> Result<(LocalParticipant, UdpSocket), DiscoverError> {
    let open = || {
        let address = local_address(target.metatraffic)?;
        // Fast DDS answers a participant of its own host at 127.0.0.1, whatever address is
        // announced.
        let socket = UdpSocket::bind((Ipv4Addr::UNSPECIFIED, 0))?;
        socket.set_read_timeout(Some(ADVANCE_INTERVAL))?;
        let port = socket.local_addr()?.port();
        Ok((SocketAddrV4::new(address, port), socket))
    };
    let (address, socket) = open().map_err(|source| DiscoverError::Open {
        target: target.metatraffic,
        source,
    })?;
    let mut prefix = [0; 12];
    File::open("/dev/urandom")
        .and_then(|mut random| random.read_exact(&mut prefix))
        .map_err(DiscoverError::Random)?;
    for (byte, mark) in prefix.iter_mut().zip(VENDOR.0) {
        *byte = mark;
    }
    let local = LocalParticipant {
        prefix: GuidPrefix(prefix),
        address,
        domain_id: u16::try_from(domain_id).unwrap_or(0),
    };
    Ok((local, socket))
}

/// Runs the session up to its goodbye. Returns the duration.
///
/// # Errors
///
/// Fails if the network fails. A goodbye is attempted nevertheless.
pub fn run_session(session: &mut Session, socket: &UdpSocket) -> Result<Duration, DiscoverError> {
    let began = Instant::now();
    // The session's time begins at 1, since 0 precedes all events.
    let now = || {
        let elapsed = u64::try_from(began.elapsed().as_nanos()).unwrap_or(u64::MAX);
        Timestamp(elapsed.saturating_add(1))
    };
    let mut buffer = vec![0; MAX_DATAGRAM];
    while !session.is_over() {
        let outgoing = session.advance(now());
        let round =
            send(socket, &outgoing).and_then(|()| listen(session, socket, &mut buffer, now));
        if let Err(error) = round {
            let _ = send(socket, &session.say_goodbye());
            return Err(error);
        }
    }
    let took = began.elapsed();
    let end = Instant::now() + LINGER_TIME;
    while Instant::now() < end {
        listen(session, socket, &mut buffer, now)?;
    }
    Ok(took)
}

/// Waits briefly for a datagram.
fn listen(
    session: &mut Session,
    socket: &UdpSocket,
    buffer: &mut [u8],
    now: impl Fn() -> Timestamp,
) -> Result<(), DiscoverError> {
    match socket.recv_from(buffer) {
        Ok((length, _)) => session.datagram(now(), buffer.get(..length).unwrap_or_default()),
        // A connection was refused because an earlier packet reached a closed port. The session
        // handles the silence.
        Err(error) if is_transient(&error) => {}
        Err(source) => {
            let target = session.target().metatraffic;
            return Err(DiscoverError::Socket { target, source });
        }
    }
    Ok(())
}

fn is_transient(error: &io::Error) -> bool {
    use io::ErrorKind::{ConnectionRefused, Interrupted, TimedOut, WouldBlock};
    matches!(
        error.kind(),
        WouldBlock | TimedOut | Interrupted | ConnectionRefused
    )
}

fn send(socket: &UdpSocket, outgoing: &[Outgoing]) -> Result<(), DiscoverError> {
    for Outgoing { to, bytes, .. } in outgoing {
        let sent = socket.send_to(bytes, to);
        sent.map_err(|source| DiscoverError::Socket {
            target: *to,
            source,
        })?;
    }
    Ok(())
}

/// Returns the first IPv4 address with a route. A loopback address is used only if there is no
/// other, because RustDDS announces its own to all hosts.
fn reachable(addresses: &[SocketAddr]) -> Option<SocketAddrV4> {
    let mut candidates: Vec<SocketAddrV4> = addresses
        .iter()
        .filter_map(|address| match address {
            SocketAddr::V4(address) => Some(*address),
            SocketAddr::V6(_) => None,
        })
        .filter(|address| !address.ip().is_unspecified() && !address.ip().is_multicast())
        .filter(|address| address.port() != 0)
        .collect();
    candidates.sort_by_key(|address| address.ip().is_loopback());
    candidates
        .into_iter()
        .find(|address| local_address(*address).is_ok())
}

/// Returns the local address of packets to the target. Connecting a UDP socket sends nothing.
fn local_address(target: SocketAddrV4) -> io::Result<Ipv4Addr> {
    let probe = UdpSocket::bind((Ipv4Addr::UNSPECIFIED, 0))?;
    probe.connect(target)?;
    match probe.local_addr()?.ip() {
        IpAddr::V4(address) => Ok(address),
        IpAddr::V6(_) => Err(io::ErrorKind::AddrNotAvailable.into()),
    }
}
