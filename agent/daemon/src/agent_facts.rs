//! What the agent knows about itself at one moment: filled by the capture thread, read by the
//! surfaces. Plain numbers, collected where they are counted.

use std::time::Instant;

use ros2probe_wire::Timestamp;

use crate::privilege::{self, Sandbox};
use crate::state::StateFacts;
use ros2probe_model::dispatch::MissedReason;

/// One moment of the agent.
#[derive(Clone, Debug)]
pub struct AgentFacts {
    /// Where packets come from.
    pub source: SourceKind,
    /// Why it is not the one that sees more; `None` where it is, or where it was asked for.
    pub source_reason: Option<String>,
    /// What the source can see, each ability once; what is not listed it cannot.
    pub abilities: Vec<Ability>,
    /// Why it cannot see what it otherwise could, in words; not of every ability it lacks.
    pub blind: Vec<(Ability, String)>,
    /// What it looks at and is gone, in words: nothing is seen there.
    pub gone: Option<String>,
    /// How often the control group that it looks at was made anew.
    pub attached_anew: u64,
    /// When this was filled in.
    pub at: Instant,
    /// When the source last came back from waiting for packets, with or without any.
    pub capture_progress: Instant,
    /// A replay has reached its end.
    pub finished: bool,
    /// When the capture that is replayed begins, in its own time.
    pub capture_begin: Option<Timestamp>,
    /// Which part of the capture's file was read, 0 to 1; `None` if that is unknown.
    pub replayed: Option<f64>,
    /// Packets of a capture whose link layer cannot be read, by the layer's number.
    pub unsupported_packets: Vec<(u16, u64)>,
    /// Per interface, or per network namespace where the kernel counts no finer.
    pub interfaces: Vec<InterfaceFacts>,
    /// The kernel filter's counters of events, complete and in a fixed order.
    pub filter_events: Vec<(&'static str, u64)>,
    /// Bytes that reached user space: packets and records.
    pub copied_bytes: u64,
    /// Records lost because the record ring was full.
    pub records_dropped: u64,
    /// Captured datagrams of the host's sockets of which a piece was lost for want of room.
    pub pieces_dropped: u64,
    /// Frames and datagrams that the kernel programs could not look at: their working memory was
    /// in use.
    pub contended: u64,
    /// Fragmented datagrams that were begun and never became complete.
    pub incomplete_datagrams: u64,
    /// Bytes held to put IP fragments together.
    pub reassembly_bytes: u64,
    /// Bytes held to put captured datagrams together that come from the sockets in pieces.
    pub pieces_bytes: u64,
    /// Datagrams of which fragments were missing and that were given up for want of room.
    pub reassembly_evicted: u64,
    /// Changes of interest for which the kernel filter had no room.
    pub refused_updates: u64,
    /// What became of the state for the next start; `None` = none is kept.
    pub state: Option<StateFacts>,
    /// The look at shared memory, where there is one.
    pub shared_memory: Option<SharedMemoryFacts>,
    /// Libraries whose processes' messages into shared memory are to be seen one by one, if that was
    /// asked for.
    pub exact: Vec<ExactFacts>,
    /// Who gets messages one by one.
    pub subscriptions: SubscriptionFacts,
    /// What keeps the agent from system calls that it does not make.
    pub sandbox: Sandbox,
}

/// One library of exact mode.
#[derive(Clone, Debug, Default, PartialEq, Eq, PartialOrd, Ord)]
pub struct ExactFacts {
    /// Its path as its processes see it; empty = this is about all of them.
    pub library: String,
    /// Why messages are not seen, `None` where they are.
    pub refused: Option<String>,
}

/// The look at shared memory.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct SharedMemoryFacts {
    /// What is open, by kind.
    pub open: Vec<(&'static str, u64)>,
    /// What was met, by event, complete and in a fixed order.
    pub events: Vec<(&'static str, u64)>,
    /// CPU time it took.
    pub cpu_seconds: f64,
    /// Looks so far.
    pub looks: u64,
}

/// Where packets come from.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum SourceKind {
    /// Datagrams at this host's sockets.
    Host,
    /// Frames on this host's interfaces.
    Wire,
    /// A capture file.
    Replay,
}

/// What a source may be able to see.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Ability {
    /// What each subscriber received, also where several share a destination.
    Subscribers,
    /// Messages leaving this host.
    Sent,
    /// Which messages died in the full buffer of a subscriber's socket.
    SocketLosses,
    /// Which messages died in IP reassembly.
    ReassemblyLosses,
    /// Process and control group of sockets.
    Owners,
    /// Sockets in every network namespace: all containers.
    Containers,
    /// Traffic that no local socket sends or receives.
    Forwarded,
    /// Messages between processes of this host through shared memory, sampled.
    SharedMemory,
    /// Each of them, in every process that sends there.
    SharedMemoryExact,
}

/// Counters of one interface.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct InterfaceFacts {
    /// Name; with the namespace in front where it is not the agent's own.
    pub name: String,
    /// Packets that the filter let through, where they are counted so.
    pub packets: Option<u64>,
    /// Packets lost because the ring was full, where they are counted so.
    pub dropped: Option<u64>,
}

impl AgentFacts {
    /// Nothing has happened yet.
    #[must_use]
    pub fn new(source: SourceKind, at: Instant) -> Self {
        Self {
            source,
            source_reason: None,
            abilities: source.abilities().to_vec(),
            blind: Vec::new(),
            gone: None,
            attached_anew: 0,
            at,
            capture_progress: at,
            finished: false,
            capture_begin: None,
            replayed: None,
            unsupported_packets: Vec::new(),
            interfaces: Vec::new(),
            filter_events: Vec::new(),
            copied_bytes: 0,
            records_dropped: 0,
            pieces_dropped: 0,
            contended: 0,
            incomplete_datagrams: 0,
            reassembly_bytes: 0,
            pieces_bytes: 0,
            reassembly_evicted: 0,
            refused_updates: 0,
            state: None,
            shared_memory: None,
            exact: Vec::new(),
            subscriptions: SubscriptionFacts::default(),
            sandbox: privilege::sandbox(),
        }
    }
}

impl SourceKind {
    /// Label value.
    #[must_use]
    pub const fn label(self) -> &'static str {
        match self {
            Self::Host => "host",
            Self::Wire => "wire",
            Self::Replay => "replay",
        }
    }

    /// What every source of this kind can see; the kernel and the configuration may allow more.
    #[must_use]
    pub const fn abilities(self) -> &'static [Ability] {
        match self {
            Self::Host => &[Ability::Subscribers, Ability::Sent],
            Self::Wire => &[Ability::Sent, Ability::Forwarded],
            Self::Replay => &[Ability::Forwarded],
        }
    }
}

impl Ability {
    /// All of them.
    pub const ALL: [Self; 9] = [
        Self::Subscribers,
        Self::Sent,
        Self::SocketLosses,
        Self::ReassemblyLosses,
        Self::Owners,
        Self::Containers,
        Self::Forwarded,
        Self::SharedMemory,
        Self::SharedMemoryExact,
    ];

    /// Label value.
    #[must_use]
    pub const fn label(self) -> &'static str {
        match self {
            Self::Subscribers => "subscribers",
            Self::Sent => "sent",
            Self::SocketLosses => "socket_losses",
            Self::ReassemblyLosses => "reassembly_losses",
            Self::Owners => "owners",
            Self::Containers => "containers",
            Self::Forwarded => "forwarded",
            Self::SharedMemory => "shared_memory",
            Self::SharedMemoryExact => "shared_memory_exact",
        }
    }
}

/// Figures of all subscriptions.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct SubscriptionFacts {
    /// Open ones.
    pub open: usize,
    /// Refused ones so far.
    pub refused: u64,
    /// Samples put into queues so far, for each reader.
    pub given: u64,
    /// Samples not given so far, for each reader, in the order of [`MissedReason::ALL`].
    pub missed: [u64; MissedReason::ALL.len()],
    /// Of those, samples that had to go because all queues together were full.
    pub crowded_out: u64,
    /// Bytes that wait in queues.
    pub queued_bytes: usize,
    /// Bytes of messages that are retained.
    pub retained_bytes: usize,
}
