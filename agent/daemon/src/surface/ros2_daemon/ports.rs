//! Listeners of the domains in use, at 127.0.0.1:11511 + domain.
//!
//! The agent does not compete with another process for a port. It tries again every second, and
//! takes over a port that has become free. The `ros2` command line binds the port before it starts
//! a daemon, so a daemon and the agent never have the same port.

use std::collections::{BTreeMap, BTreeSet};
use std::io;
use std::net::{Ipv4Addr, SocketAddr};
use std::sync::Arc;
use std::task::Poll;
use std::time::Duration;

use rustix::net::{AddressFamily, SocketFlags, SocketType, bind, socket_with, sockopt};
use tokio::net::{TcpListener, TcpStream};
use tokio::time::Instant;
use tokio_util::sync::CancellationToken;

use super::figures::{PortState, Ros2DaemonFigures, port};
use crate::surface::listen::listen;
use crate::tables::Ros2DaemonPorts;
use ros2probe_model::facts::bounded::Bounded;

/// Time for which a released port stays free.
pub(super) const RELEASE_TIME: Duration = Duration::from_secs(60);

/// Time for which a port of another process has to be free before the agent takes it over.
const TAKEOVER_DELAY: Duration = Duration::from_secs(3);

/// The ports of all domains.
#[derive(Debug)]
pub(super) struct Ports {
    figures: Arc<Ros2DaemonFigures>,
    /// A host has few domains, but any process can announce participants in every domain.
    ports: Bounded<Ros2DaemonPorts, BTreeMap<u32, Port>>,
}

#[derive(Debug)]
enum Port {
    /// Listening, with the token that ends its connections.
    Open(TcpListener, CancellationToken),
    /// Not bound yet.
    Waiting,
    /// Another process had the port at the last attempt.
    Occupied,
    /// The port is free. The time is when the agent first noticed it.
    Free(Instant),
    Released(Instant),
}

/// A new connection.
pub(super) struct Accepted {
    pub(super) domain_id: u32,
    pub(super) stream: TcpStream,
    pub(super) address: SocketAddr,
    /// Ends the connection when its port is released.
    pub(super) end: CancellationToken,
}

impl Ports {
    /// Creates an empty set of ports.
    pub(super) fn new(figures: Arc<Ros2DaemonFigures>) -> Self {
        Self {
            figures,
            ports: Bounded::default(),
        }
    }

    /// Binds the ports of domains in use that are not bound, and ports that have become free. A
    /// port stays bound when its domain is no longer in use.
    pub(super) fn update(&mut self, domains: &BTreeSet<u32>, now: Instant) {
        for domain_id in domains {
            if self.ports.contains_key(domain_id) {
                continue;
            }
            let is_left_out = self.ports.insert(*domain_id, Port::Waiting).is_some();
            if is_left_out && port(*domain_id).is_some() {
                self.set_state(*domain_id, PortState::Limit);
            }
        }
        let is_due = |port: &Port| match port {
            Port::Open(..) => false,
            Port::Waiting | Port::Occupied | Port::Free(_) => true,
            Port::Released(since) => now.saturating_duration_since(*since) >= RELEASE_TIME,
        };
        let due = self.ports.iter().filter(|(_, port)| is_due(port));
        let due: Vec<u32> = due.map(|(domain_id, _)| *domain_id).collect();
        for domain_id in due {
            if self.is_takeover_due(domain_id, now) {
                self.bind(domain_id);
            }
        }
    }

    /// Closes the listener of a domain and leaves its port free for a while. Returns the token that
    /// ends the port's connections.
    pub(super) fn release(&mut self, domain_id: u32, now: Instant) -> Option<CancellationToken> {
        let port = self.ports.get_mut(&domain_id)?;
        let Port::Open(_, end) = std::mem::replace(port, Port::Released(now)) else {
            return None;
        };
        self.set_state(domain_id, PortState::Released);
        Some(end)
    }

    /// Ends the time for which released ports stay free.
    pub(super) fn end_releases(&mut self) {
        for port in self.ports.values_mut() {
            if matches!(port, Port::Released(_)) {
                *port = Port::Waiting;
            }
        }
    }

    /// Returns the next connection to any port. Never returns without a port.
    pub(super) async fn accept(&mut self) -> Accepted {
        std::future::poll_fn(|context| {
            for (domain_id, port) in &*self.ports {
                let Port::Open(listener, end) = port else {
                    continue;
                };
                // An error means that the client has gone, or that no descriptor is free. The next
                // event polls again.
                if let Poll::Ready(Ok((stream, address))) = listener.poll_accept(context) {
                    return Poll::Ready(Accepted {
                        domain_id: *domain_id,
                        stream,
                        address,
                        end: end.clone(),
                    });
                }
            }
            Poll::Pending
        })
        .await
    }

    /// Returns whether the port may be bound: immediately if no other process had it, otherwise
    /// some time after it became free. The delay is necessary because `ros2 daemon stop` waits
    /// until no process listens.
    fn is_takeover_due(&mut self, domain_id: u32, now: Instant) -> bool {
        let (Some(state), Some(number)) = (self.ports.get_mut(&domain_id), port(domain_id)) else {
            return false;
        };
        match *state {
            Port::Open(..) | Port::Waiting | Port::Released(_) => true,
            Port::Occupied | Port::Free(_) if !is_free(number) => {
                *state = Port::Occupied;
                false
            }
            Port::Occupied => {
                *state = Port::Free(now);
                false
            }
            Port::Free(since) => now.saturating_duration_since(since) >= TAKEOVER_DELAY,
        }
    }

    fn bind(&mut self, domain_id: u32) {
        let Some(number) = port(domain_id) else {
            return;
        };
        let address = SocketAddr::from((Ipv4Addr::LOCALHOST, number));
        let bound = listen(address).and_then(TcpListener::from_std);
        let (port, state) = match bound {
            Ok(listener) => (
                Port::Open(listener, CancellationToken::new()),
                PortState::Listening,
            ),
            Err(error) if error.kind() == io::ErrorKind::AddrInUse => {
                (Port::Occupied, PortState::Occupied)
            }
            Err(error) => (Port::Waiting, PortState::Failed(error.to_string())),
        };
        self.ports.insert(domain_id, port);
        self.set_state(domain_id, state);
    }

    /// Records the state of a port, and logs its changes.
    fn set_state(&self, domain_id: u32, state: PortState) {
        if !self.figures.set_port(domain_id, state.clone()) {
            return;
        }
        let port = port(domain_id).unwrap_or_default();
        match state {
            PortState::Listening => {
                tracing::info!(domain_id, port, "answering as the ros2 daemon");
            }
            PortState::Occupied => tracing::warn!(
                domain_id,
                port,
                "another process has the port of the ros2 daemon; waiting for it"
            ),
            PortState::Released => {
                tracing::info!(domain_id, port, "released the port of the ros2 daemon");
            }
            PortState::Failed(reason) => tracing::warn!(
                domain_id,
                port,
                reason,
                "cannot bind the port of the ros2 daemon"
            ),
            PortState::Limit => tracing::warn!(
                domain_id,
                port,
                "too many domains are in use to act as the ros2 daemon in each"
            ),
        }
    }
}

/// Returns whether the port can be bound, without listening.
fn is_free(port: u16) -> bool {
    let bound = || -> rustix::io::Result<()> {
        let flags = SocketFlags::CLOEXEC;
        let socket = socket_with(AddressFamily::INET, SocketType::STREAM, flags, None)?;
        sockopt::set_socket_reuseaddr(&socket, true)?;
        bind(&socket, &SocketAddr::from((Ipv4Addr::LOCALHOST, port)))
    };
    bound().is_ok()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test(start_paused = true)]
    async fn a_free_port_of_another_process_is_taken_over_after_a_delay() {
        const OTHER: u32 = DOMAIN + 3;
        let figures = Arc::<Ros2DaemonFigures>::default();
        let mut ports = Ports::new(Arc::clone(&figures));
        let domains = BTreeSet::from([OTHER]);
        let state = || figures.ports().remove(&OTHER).unwrap();
        let address = (Ipv4Addr::LOCALHOST, port(OTHER).unwrap());
        let other = std::net::TcpListener::bind(address).unwrap();
        let start = Instant::now();
        ports.update(&domains, start);
        ports.update(&domains, start + TAKEOVER_DELAY);
        assert_eq!(state(), PortState::Occupied);
        drop(other);
        ports.update(&domains, start + TAKEOVER_DELAY);
        ports.update(
            &domains,
            start + TAKEOVER_DELAY * 2 - Duration::from_millis(1),
        );
        // No process listens, so `ros2 daemon stop` ends.
        assert!(std::net::TcpStream::connect(address).is_err());
        ports.update(&domains, start + TAKEOVER_DELAY * 2);
        assert_eq!(state(), PortState::Listening);
    }

    /// A domain that no other test and no robot uses.
    const DOMAIN: u32 = 229;

    #[tokio::test(start_paused = true)]
    async fn a_released_port_is_bound_again_after_a_minute_or_a_reload() {
        let figures = Arc::<Ros2DaemonFigures>::default();
        let mut ports = Ports::new(Arc::clone(&figures));
        let domains = BTreeSet::from([DOMAIN]);
        let state = || figures.ports().remove(&DOMAIN).unwrap();
        ports.update(&domains, Instant::now());
        assert_eq!(state(), PortState::Listening);
        let released = Instant::now();
        let end = ports.release(DOMAIN, released).unwrap();
        assert!(!end.is_cancelled());
        assert!(ports.release(DOMAIN, released).is_none());
        ports.update(&domains, released + RELEASE_TIME - Duration::from_millis(1));
        assert_eq!(state(), PortState::Released);
        ports.update(&domains, released + RELEASE_TIME);
        assert_eq!(state(), PortState::Listening);
        ports.release(DOMAIN, released + RELEASE_TIME).unwrap();
        ports.end_releases();
        ports.update(&domains, released + RELEASE_TIME);
        assert_eq!(state(), PortState::Listening);
        assert!(ports.release(DOMAIN + 1, released).is_none());
    }

    #[tokio::test]
    async fn a_connection_is_accepted_with_its_domain() {
        let mut ports = Ports::new(Arc::default());
        ports.update(&BTreeSet::from([DOMAIN + 1, DOMAIN + 2]), Instant::now());
        let address = (Ipv4Addr::LOCALHOST, port(DOMAIN + 2).unwrap());
        let client = std::net::TcpStream::connect(address).unwrap();
        let accepted = ports.accept().await;
        assert_eq!(accepted.domain_id, DOMAIN + 2);
        assert_eq!(accepted.address, client.local_addr().unwrap());
    }

    #[test]
    fn domains_beyond_the_cap_have_no_port() {
        let figures = Arc::<Ros2DaemonFigures>::default();
        let mut ports = Ports::new(Arc::clone(&figures));
        for domain_id in 0..32 {
            ports
                .ports
                .insert(domain_id, Port::Released(Instant::now()));
        }
        assert_eq!(ports.ports.len(), Ros2DaemonPorts::CAP);
        ports.update(&BTreeSet::from([DOMAIN]), Instant::now());
        crate::tables::tests::assert_driven::<Ros2DaemonPorts>();
        assert_eq!(figures.ports().get(&DOMAIN), Some(&PortState::Limit));
        assert_eq!(ports.ports.len(), Ros2DaemonPorts::CAP);
    }

    #[test]
    fn each_domain_has_the_port_of_its_ros2_daemon() {
        assert_eq!(
            (port(0), port(232), port(233)),
            (Some(11_511), Some(11_743), None)
        );
    }
}
