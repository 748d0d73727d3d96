//! `rp discover`: asks running participants to repeat what they announced once.
//!
//! The only thing in the product that sends, and only when somebody asks for it: a bare participant
//! of a few milliseconds introduces itself to one running participant at a time, by unicast, asks
//! for its announcements, and says goodbye. At most [`session::MOST_PACKETS`] packets each; nobody
//! else hears of it, it has no user endpoint, and nothing of it stays.

pub mod announcements;
mod announcer;
pub mod message;
pub mod participants;
pub mod session;

use std::fs::File;
use std::io::{self, Read as _};
use std::net::{IpAddr, Ipv4Addr, SocketAddr, SocketAddrV4, UdpSocket};
use std::time::{Duration, Instant};

pub use ros2probe_wire::GuidPrefix;
use ros2probe_wire::Timestamp;

use self::message::{LocalParticipant, VENDOR};
use self::session::{Outgoing, Session, Target};
use ros2probe_model::snapshot::ParticipantFacts;

/// How often the session advances while nothing comes.
const SLICE: Duration = Duration::from_millis(5);
/// After the goodbye, what is still under way is let in: a closed port would make the kernel answer.
const LINGER: Duration = Duration::from_millis(50);
/// Largest UDP payload.
const DATAGRAM: usize = 65_507;

/// Why a participant is not asked.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Refusal {
    /// It would not talk to a stranger, and its secrets are not ours to ask for.
    Secured,
    /// It announces no IPv4 address for discovery.
    NoAddress,
    /// Another one that asks.
    Asking,
}

/// Why asking failed.
#[derive(Debug, thiserror::Error)]
pub enum DiscoverError {
    /// No socket.
    #[error("cannot open a socket towards {target}")]
    Open {
        /// Where to.
        target: SocketAddrV4,
        /// Why not.
        source: io::Error,
    },
    /// No identity.
    #[error("cannot read random numbers")]
    Random(#[source] io::Error),
    /// The network refuses.
    #[error("cannot talk to {target}")]
    Talk {
        /// Whom.
        target: SocketAddrV4,
        /// Why not.
        source: io::Error,
    },
}

impl Target {
    /// This participant, if it can and may be asked.
    ///
    /// # Errors
    /// Why not.
    pub fn of(participant: &ParticipantFacts) -> Result<Self, Refusal> {
        if participant.secured {
            return Err(Refusal::Secured);
        }
        if participant.guid.prefix.0.starts_with(&VENDOR.0) {
            return Err(Refusal::Asking);
        }
        let addresses = &participant.addresses;
        let metatraffic = reachable(&addresses.metatraffic).ok_or(Refusal::NoAddress)?;
        let default = &addresses.default;
        // Of several, the one on the same interface as the other.
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
    /// In words.
    #[must_use]
    pub const fn reason(self) -> &'static str {
        match self {
            Self::Secured => "announces security: not asked",
            Self::NoAddress => "announces no IPv4 address for discovery",
            Self::Asking => "is another rp discover",
        }
    }
}

/// Who speaks to this target: a new identity, at the address that leads there. Nothing is sent.
///
/// # Errors
/// No socket or no random numbers.
pub fn local_participant(
    target: &Target,
    domain_id: u32,
) -> Result<(LocalParticipant, UdpSocket), DiscoverError> {
    let open = || {
        let address = leaving(target.metatraffic)?;
        let socket = UdpSocket::bind((address, 0))?;
        socket.set_read_timeout(Some(SLICE))?;
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

/// Holds the conversation, goodbye included; how long it took.
///
/// # Errors
/// When the network refuses; then, too, goodbye was tried.
pub fn converse(session: &mut Session, socket: &UdpSocket) -> Result<Duration, DiscoverError> {
    let began = Instant::now();
    // The session's time begins with 1: 0 is before everything.
    let now = || {
        let elapsed = u64::try_from(began.elapsed().as_nanos()).unwrap_or(u64::MAX);
        Timestamp(elapsed.saturating_add(1))
    };
    let mut buffer = vec![0; DATAGRAM];
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
    let end = Instant::now() + LINGER;
    while Instant::now() < end {
        listen(session, socket, &mut buffer, now)?;
    }
    Ok(took)
}

/// Waits a moment for a datagram.
fn listen(
    session: &mut Session,
    socket: &UdpSocket,
    buffer: &mut [u8],
    now: impl Fn() -> Timestamp,
) -> Result<(), DiscoverError> {
    match socket.recv_from(buffer) {
        Ok((length, _)) => session.datagram(now(), buffer.get(..length).unwrap_or_default()),
        // Refused: an earlier packet met a closed port. The session notices by itself.
        Err(error) if is_passing(&error) => {}
        Err(source) => {
            let target = session.target().metatraffic;
            return Err(DiscoverError::Talk { target, source });
        }
    }
    Ok(())
}

fn is_passing(error: &io::Error) -> bool {
    use io::ErrorKind::{ConnectionRefused, Interrupted, TimedOut, WouldBlock};
    matches!(
        error.kind(),
        WouldBlock | TimedOut | Interrupted | ConnectionRefused
    )
}

fn send(socket: &UdpSocket, outgoing: &[Outgoing]) -> Result<(), DiscoverError> {
    for Outgoing { to, bytes, .. } in outgoing {
        let sent = socket.send_to(bytes, to);
        sent.map_err(|source| DiscoverError::Talk {
            target: *to,
            source,
        })?;
    }
    Ok(())
}

/// The first IPv4 address that a route leads to; a loopback address only if there is no other, for
/// RustDDS announces its own to everybody.
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
        .find(|address| leaving(*address).is_ok())
}

/// By which of our addresses a packet for there would leave. Connecting a UDP socket sends nothing.
fn leaving(target: SocketAddrV4) -> io::Result<Ipv4Addr> {
    let probe = UdpSocket::bind((Ipv4Addr::UNSPECIFIED, 0))?;
    probe.connect(target)?;
    match probe.local_addr()?.ip() {
        IpAddr::V4(address) => Ok(address),
        IpAddr::V6(_) => Err(io::ErrorKind::AddrNotAvailable.into()),
    }
}
