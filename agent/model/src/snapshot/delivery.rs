//! What became of a writer's samples on the way to each of its receivers.

use std::net::SocketAddr;

use ros2probe_wire::{Guid, Timestamp};

use crate::measurement::Delivered;
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
    /// The receiver, in a form that stays: `participant GUID`, `process ID`, `socket COOKIE`, or
    /// empty where nothing tells receivers of this destination apart.
    pub subscriber: String,
    /// The participant that receives, when it is known.
    pub participant: Option<Guid>,
    /// Readers of the topic in that participant, sorted.
    pub readers: Vec<Guid>,
    /// Their nodes, sorted, each once.
    pub nodes: Vec<String>,
    /// Cookies of the sockets by which samples came, sorted; empty for a wire source.
    pub sockets: Vec<u64>,
    /// Process of the receiving (or sending) socket.
    pub process_id: Option<u32>,
    /// Its name.
    pub process: Option<String>,
    /// Control group of that socket, as a path below the root.
    pub cgroup: Option<String>,
    /// First record.
    pub first_seen: Timestamp,
    /// Last record.
    pub last_seen: Timestamp,
    /// What became of the samples.
    pub delivered: Delivered,
}

/// What one reliable reader acknowledged to one writer.
#[derive(Clone, Debug)]
pub struct AcknowledgementFacts {
    /// To whom.
    pub writer: Guid,
    /// By whom.
    pub reader: Guid,
    /// The reader's node.
    pub node: Option<String>,
    /// All samples up to this one are acknowledged; 0 = none.
    pub acknowledged: u64,
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
