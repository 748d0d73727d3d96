//! What became of a writer's samples on the way to each of its receivers.

use std::cmp::Ordering;
use std::fmt;
use std::net::SocketAddr;
use std::sync::Arc;

use ros2probe_wire::{Guid, SequenceNumber, Timestamp};

use crate::measurement::Delivered;
use crate::names::NodeName;
use crate::route::Direction;

/// One writer's samples to one receiver, or to one destination where they were seen leaving.
#[derive(Clone, Debug)]
pub struct DeliveryFacts {
    /// Whose samples.
    pub writer: Guid,
    /// Leaving or arriving.
    pub direction: Direction,
    /// Where new samples are sent to; retransmissions may come another way.
    pub destination: SocketAddr,
    /// The receiver, in a form that stays.
    pub subscriber: Subscriber,
    /// The participant that receives, when it is known.
    pub participant: Option<Guid>,
    /// Readers of the topic in that participant, sorted.
    pub readers: Vec<Guid>,
    /// Their nodes, sorted, each once.
    pub nodes: Vec<NodeName>,
    /// Cookies of the sockets by which samples came, sorted; empty for a wire source.
    pub sockets: Vec<u64>,
    /// Process of the receiving (or sending) socket.
    pub process_id: Option<u32>,
    /// Its name.
    pub process: Option<Arc<str>>,
    /// Control group of that socket, as a path below the root.
    pub cgroup: Option<Arc<str>>,
    /// First record.
    pub first_seen: Timestamp,
    /// Last record.
    pub last_seen: Timestamp,
    /// What became of the samples.
    pub delivered: Delivered,
}

/// Who receives, as far as it is known. Printed as `participant GUID`, `process ID`, `socket
/// COOKIE` or nothing, and in the order of that text.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash)]
pub enum Subscriber {
    /// Nothing tells receivers of this destination apart.
    #[default]
    Unknown,
    /// This participant.
    Participant(Guid),
    /// The process of this id.
    Process(u32),
    /// The socket with this cookie.
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
        // Decimal numbers of different lengths stand in the order of their digits.
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

/// What one reliable reader acknowledged to one writer.
#[derive(Clone, Debug)]
pub struct AcknowledgementFacts {
    /// To whom.
    pub writer: Guid,
    /// By whom.
    pub reader: Guid,
    /// The reader's node.
    pub node: Option<NodeName>,
    /// All samples up to this one are acknowledged; 0 = none.
    pub acknowledged: SequenceNumber,
    /// Samples that the reader asked for in its last ACKNACK.
    pub missing: u64,
    /// Samples asked for again since the start, every request counted.
    pub requested: u64,
    /// ACKNACKs seen.
    pub acknacks: u64,
    /// Samples that exist and are not acknowledged.
    pub lag_samples: u64,
    /// Age of the oldest of them, seconds; 0 when there is none, `None` when it is too old to know.
    pub lag_seconds: Option<f64>,
    /// Last ACKNACK.
    pub last_seen: Timestamp,
}
