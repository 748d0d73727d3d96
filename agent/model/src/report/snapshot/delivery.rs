//! Fate of a writer's samples on the way to each of its receivers.

use std::cmp::Ordering;
use std::fmt;
use std::net::SocketAddr;
use std::sync::Arc;

use ros2probe_wire::Guid;

use crate::facts::measurement::Delivered;
use crate::facts::model_time::ModelTime;
use crate::facts::names::NodeName;
use crate::facts::route::Direction;

/// Samples from one writer to one receiver, or to one destination for outgoing samples.
#[derive(Clone, Debug)]
pub struct DeliveryFacts {
    /// GUID of the writer.
    pub writer: Guid,
    /// Outgoing or incoming.
    pub direction: Direction,
    /// Destination of new samples; retransmissions may use another.
    pub destination: SocketAddr,
    /// The receiver, in a stable form.
    pub subscriber: Subscriber,
    /// The receiving participant, if known.
    pub participant: Option<Guid>,
    /// Readers of the topic in that participant, sorted.
    pub readers: Vec<Guid>,
    /// Nodes of these readers, sorted and without duplicates.
    pub nodes: Vec<NodeName>,
    /// Cookies of the receiving sockets, sorted; empty for a wire source.
    pub sockets: Vec<u64>,
    /// Process that owns the receiving (or sending) socket.
    pub process_id: Option<u32>,
    /// Name of that process.
    pub process: Option<Arc<str>>,
    /// Control group of that socket, as a path below the root.
    pub cgroup: Option<Arc<str>>,
    /// Time of the first observation.
    pub first_seen: ModelTime,
    /// Time of the last observation.
    pub last_seen: ModelTime,
    /// Fate of the samples.
    pub delivered: Delivered,
    /// Delivered samples that the process never took from the queue of its subscription; `None` if
    /// its calls are not observed, or other writers fill the same queue.
    pub lost_in_reader_queue: Option<u64>,
}

/// The receiver, as far as it is known. It is displayed as `participant GUID`, `process ID`,
/// `socket COOKIE` or empty text, and sorted by that text.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash)]
pub enum Subscriber {
    /// Receivers of this destination cannot be distinguished.
    #[default]
    Unknown,
    /// A participant.
    Participant(Guid),
    /// A process, by its id.
    Process(u32),
    /// A socket, by its cookie.
    Socket(u64),
}

impl fmt::Display for Subscriber {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Unknown => Ok(()),
            Self::Participant(guid) => write!(f, "participant {guid}"),
            Self::Process(id) => write!(f, "process {id}"),
            Self::Socket(cookie) => write!(f, "socket {cookie}"),
        }
    }
}

impl Ord for Subscriber {
    fn cmp(&self, other: &Self) -> Ordering {
        // Numbers are compared as decimal text, as they are displayed.
        match (self, other) {
            (Self::Unknown, Self::Unknown) => Ordering::Equal,
            (Self::Participant(one), Self::Participant(other)) => one.cmp(other),
            (Self::Process(one), Self::Process(other)) => one.to_string().cmp(&other.to_string()),
            (Self::Socket(one), Self::Socket(other)) => one.to_string().cmp(&other.to_string()),
            _ => self.rank().cmp(&other.rank()),
        }
    }
}

impl PartialOrd for Subscriber {
    fn partial_cmp(&self, other: &Self) -> Option<Ordering> {
        Some(self.cmp(other))
    }
}

impl Subscriber {
    const fn rank(&self) -> u8 {
        match self {
            Self::Unknown => 0,
            Self::Participant(_) => 1,
            Self::Process(_) => 2,
            Self::Socket(_) => 3,
        }
    }
}
