//! Why a router gave no graph, and the remedy.

use std::io;
use std::net::SocketAddr;
use std::time::Duration;

use super::address::RouterAddress;
use super::session::Unusable;

/// The conversation failed. Each text names the remedy.
#[derive(Debug, thiserror::Error)]
pub enum RouterError {
    /// The name has no address.
    #[error("cannot find the host of {address}: write its IP address, or correct the name")]
    Resolve {
        /// Address on the command line.
        address: RouterAddress,
        /// Error of the operating system.
        source: io::Error,
    },
    /// No program listens at the address.
    #[error(
        "no Zenoh router at {address}: start `ros2 run rmw_zenoh_cpp rmw_zenohd` there, or name \
         another address: --router HOST:PORT"
    )]
    Refused {
        /// Address on the command line.
        address: RouterAddress,
    },
    /// The host cannot be reached.
    #[error("cannot connect to {address}: check the address, the network and firewalls")]
    Connect {
        /// Address on the command line.
        address: RouterAddress,
        /// Error of the operating system.
        source: io::Error,
    },
    /// No random numbers for an id are available.
    #[error("cannot read random numbers")]
    Random(#[source] io::Error),
    /// The connection breaks.
    #[error(
        "the connection to {peer} broke after the {after}: see the router's log, and try again"
    )]
    Broken {
        /// The router.
        peer: SocketAddr,
        /// The last message that was sent.
        after: &'static str,
        /// Error of the operating system.
        source: io::Error,
    },
    /// The router ends the connection early.
    #[error(
        "{peer} closed the connection after the {after}: see the router's log; rp needs `rmw_zenohd` \
         of Zenoh 1.x without TLS"
    )]
    Ended {
        /// The router.
        peer: SocketAddr,
        /// The last message that was sent.
        after: &'static str,
    },
    /// The router is silent.
    #[error(
        "no answer from {peer} to the {after} within {} s: check that it is a Zenoh router, and try \
         again", .limit.as_secs()
    )]
    Silent {
        /// The router.
        peer: SocketAddr,
        /// The last message that was sent.
        after: &'static str,
        /// Maximum wait for the answer.
        limit: Duration,
    },
    /// The answer cannot be used.
    #[error("no graph from {peer}: {why}; {}", remedy(*.why))]
    Unusable {
        /// The router.
        peer: SocketAddr,
        /// Why the answer cannot be used.
        why: Unusable,
    },
}

/// Returns the remedy for an answer that cannot be used.
const fn remedy(why: Unusable) -> &'static str {
    match why {
        Unusable::Tls => "name one of the router's `tcp/` endpoints, without TLS",
        Unusable::NotZenoh => "name the address of `rmw_zenohd`, which listens on port 7447",
        Unusable::Version(_) => "rp needs a router of Zenoh 1.x",
        // Zenoh 1.8 sends 0 if it requires a user, and 2 if `max_sessions` is reached.
        Unusable::Closed(0..=2) => {
            "see the router's log: rp needs Zenoh 1.x, no user and password, and room for a session"
        }
        Unusable::Closed(3 | 4) => {
            "try again when a session has ended, or raise the router's \
             `transport/unicast/max_sessions`"
        }
        Unusable::Closed(_) => "see the router's log, and try again",
        Unusable::Framing | Unusable::Malformed(_) | Unusable::Unexpected(_) => {
            "please report this, with the router's version"
        }
    }
}
