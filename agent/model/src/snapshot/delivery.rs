//! What became of a writer's samples on the way to each of its receivers.

use std::net::SocketAddr;

use ros2probe_wire::{Guid, Timestamp};

use crate::cause::LossCause;
use crate::histogram::Histogram;

/// Samples of one delivery, or of several. All but `pending` never go down.
///
/// `messages - history + lost() + irrelevant` are the sequence numbers that were decided since the
/// delivery's first sight; what is still awaited is not in it.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Delivered {
    /// Samples that came (or left) whole, each once.
    pub messages: u64,
    /// Their payload bytes, encapsulation included.
    pub bytes: u64,
    /// Of `messages`: samples older than the first sight, as late joiners ask for.
    pub history: u64,
    /// Of `messages`: samples that came by retransmission.
    pub recovered: u64,
    /// Seconds from noticing the gap to its filling, summed over `recovered`.
    pub recovery_seconds: f64,
    /// Samples that arrived where it is known that no reader of the topic is: undelivered, and not
    /// in `messages`.
    pub unmatched: u64,
    /// Samples and fragments that came again; copies of one multicast on its way out do not count.
    pub duplicates: u64,
    /// Samples that the writer left out (GAP), that were written while no reader was here, or that
    /// its readers acknowledged although no copy was seen.
    pub irrelevant: u64,
    /// Samples that never reached this host.
    pub lost_before_host: u64,
    /// Samples that died in IP reassembly on this host.
    pub lost_in_reassembly: u64,
    /// Samples that died in the full receive buffer of the subscriber's socket.
    pub lost_in_socket_buffer: u64,
    /// Lost samples whose cause is not known yet: the kernel may still wait for IP fragments.
    pub pending: u64,
}

impl Delivered {
    /// Samples that never came whole, whatever the cause. Never goes down.
    #[must_use]
    pub const fn lost(&self) -> u64 {
        self.lost_before_host + self.lost_in_reassembly + self.lost_in_socket_buffer + self.pending
    }

    /// Samples lost by this cause.
    #[must_use]
    pub const fn lost_by(&self, cause: LossCause) -> u64 {
        match cause {
            LossCause::BeforeHost => self.lost_before_host,
            LossCause::Reassembly => self.lost_in_reassembly,
            LossCause::SocketBuffer => self.lost_in_socket_buffer,
        }
    }

    /// Counts losses by this cause.
    pub const fn lose(&mut self, cause: LossCause, count: u64) {
        match cause {
            LossCause::BeforeHost => self.lost_before_host += count,
            LossCause::Reassembly => self.lost_in_reassembly += count,
            LossCause::SocketBuffer => self.lost_in_socket_buffer += count,
        }
    }

    /// Adds all of `other`.
    pub fn add(&mut self, other: &Self) {
        self.messages += other.messages;
        self.bytes += other.bytes;
        self.history += other.history;
        self.recovered += other.recovered;
        self.recovery_seconds += other.recovery_seconds;
        self.unmatched += other.unmatched;
        self.duplicates += other.duplicates;
        self.irrelevant += other.irrelevant;
        self.lost_before_host += other.lost_before_host;
        self.lost_in_reassembly += other.lost_in_reassembly;
        self.lost_in_socket_buffer += other.lost_in_socket_buffer;
        self.pending += other.pending;
    }
}

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

/// Where a writer's samples spent their time. Finer buckets than the other histograms.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Breakdown {
    /// INFO_TS to the first datagram leaving this host, seconds.
    pub send_delay: Histogram,
    /// The last datagram of a sample leaving this host to its arrival at a socket of this host,
    /// seconds; one value per receiver.
    pub transit: Histogram,
    /// First to last datagram of a sample that came in several, seconds.
    pub transfer: Histogram,
    /// Noticing a gap to its filling by retransmission, seconds; one value per receiver.
    pub retransmission: Histogram,
}

impl Default for Breakdown {
    fn default() -> Self {
        Self {
            send_delay: Histogram::fine(),
            transit: Histogram::fine(),
            transfer: Histogram::fine(),
            retransmission: Histogram::default(),
        }
    }
}

impl Breakdown {
    /// Adds all of `other`.
    pub fn add(&mut self, other: &Self) {
        self.send_delay.merge(&other.send_delay);
        self.transit.merge(&other.transit);
        self.transfer.merge(&other.transfer);
        self.retransmission.merge(&other.retransmission);
    }
}

/// What is known of one socket from outside the packets.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct SocketFacts {
    /// `SO_COOKIE`.
    pub cookie: u64,
    /// Process that holds it.
    pub process_id: Option<u32>,
    /// The same process as it knows itself: in a container another number, which is the one that
    /// participants announce.
    pub own_process_id: Option<u32>,
    /// Its name.
    pub process: Option<String>,
    /// Control group, as a path below the root.
    pub cgroup: Option<String>,
    /// Datagrams that the socket had no room for and of which it is not known what they held.
    pub unidentified_drops: u64,
}
