//! What the agent knows about itself at one moment: filled by the capture thread, read by the
//! surfaces. Plain numbers; whoever fills them decides what they cost.

use std::time::Instant;

/// One moment of the agent.
#[derive(Clone, Debug)]
pub struct AgentFacts {
    /// Where packets come from.
    pub source: SourceKind,
    /// When this was filled in.
    pub at: Instant,
    /// When the source last came back from waiting for packets, with or without any.
    pub capture_progress: Instant,
    /// A replay has reached its end.
    pub finished: bool,
    /// Per interface, or per network namespace where the kernel counts no finer.
    pub interfaces: Vec<InterfaceFacts>,
    /// The kernel filter's counters of events, complete and in a fixed order.
    pub filter_events: Vec<(&'static str, u64)>,
    /// Bytes that reached user space: packets and records.
    pub copied_bytes: u64,
    /// Records lost because the record ring was full.
    pub records_dropped: u64,
    /// Fragmented datagrams that were begun and never became complete.
    pub incomplete_datagrams: u64,
    /// Bytes held to put fragments together.
    pub reassembly_bytes: u64,
    /// Changes of interest for which the kernel filter had no room.
    pub refused_updates: u64,
}

/// Where packets come from.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum SourceKind {
    /// This host's interfaces.
    Live,
    /// A capture file.
    Replay,
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
            at,
            capture_progress: at,
            finished: false,
            interfaces: Vec::new(),
            filter_events: Vec::new(),
            copied_bytes: 0,
            records_dropped: 0,
            incomplete_datagrams: 0,
            reassembly_bytes: 0,
            refused_updates: 0,
        }
    }
}

impl SourceKind {
    /// Label value.
    #[must_use]
    pub const fn label(self) -> &'static str {
        match self {
            Self::Live => "live",
            Self::Replay => "replay",
        }
    }
}
