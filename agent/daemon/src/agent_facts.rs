//! Facts about the agent itself at one moment. The capture thread fills them in, and the surfaces
//! read them. The facts are plain values, collected from counters.

use std::time::Instant;

use ros2probe_wire::Timestamp;

use crate::privilege::{self, Sandbox};
use crate::replay_pace::Pace;
use crate::state::StateFacts;
use ros2probe_api::recordings::BagTrigger;
use ros2probe_capture::pcap::Speed;
use ros2probe_model::facts::dispatch::MissedReason;

/// How interfaces are observed.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct WireFacts {
    /// `tcx` or `packet`.
    pub hook: &'static str,
    /// Why tcx is not used although the configuration permits it.
    pub reason: Option<String>,
}

/// State of the agent at one moment.
#[derive(Clone, Debug)]
pub struct AgentFacts {
    /// Kind of the packet source.
    pub source: SourceKind,
    /// Reason why the source with more visibility is not used. `None` if that source is used, or if
    /// the configuration selects `source`.
    pub source_reason: Option<String>,
    /// How interfaces are observed; `None` if none are.
    pub wire: Option<WireFacts>,
    /// Abilities of the source, each at most once.
    pub abilities: Vec<Ability>,
    /// Missing abilities that the source gains while a client needs them.
    pub on_demand: Vec<Ability>,
    /// Reasons for missing abilities, as text. Not every missing ability has one.
    pub missing_abilities: Vec<(Ability, String)>,
    /// Observed object that no longer exists, as text; its traffic is not observed.
    pub missing_object: Option<String>,
    /// Part of the source that makes no progress, as text.
    pub stalled: Option<String>,
    /// Part of the source that is not observed yet after the start, as text.
    pub pending: Option<String>,
    /// Number of times the host hook was attached again to a recreated control group.
    pub reattachments: u64,
    /// Time at which these facts were collected.
    pub collected_at: Instant,
    /// Time of the source's last return from a wait, with or without packets.
    pub capture_progress: Instant,
    /// Whether a replay has reached its end.
    pub finished: bool,
    /// Start of the replayed capture, in its own time.
    pub capture_begin: Option<Timestamp>,
    /// Fraction of the capture's file that was read, 0 to 1. `None` if unknown.
    pub replayed: Option<f64>,
    /// Speed with which the replay began; `None` for a live source.
    pub replay_speed: Option<Speed>,
    /// How clients want the replay to go on.
    pub replay_pace: Pace,
    /// Parts of a bag that were not replayed, as lines for people.
    pub replay_faults: Vec<String>,
    /// What triggered the bag in replay, if a snapshot wrote it.
    pub replay_incident: Option<BagTrigger>,
    /// Packets of a capture with an unsupported link layer, by link-layer number.
    pub unsupported_packets: Vec<(u16, u64)>,
    /// Counters per interface, or per network namespace if the kernel has no finer ones.
    pub interfaces: Vec<InterfaceFacts>,
    /// Event counters of the kernel filter, all of them in a fixed order.
    pub filter_events: Vec<(&'static str, u64)>,
    /// Bytes copied to user space: packets and records.
    pub copied_bytes: u64,
    /// Records lost because the record ring was full.
    pub records_dropped: u64,
    /// Captured datagrams of the host's sockets that lost a piece because the ring was full.
    pub pieces_dropped: u64,
    /// Frames and datagrams that the kernel programs could not process, because their working
    /// memory was in use.
    pub contended: u64,
    /// Fragmented datagrams that never became complete.
    pub incomplete_datagrams: u64,
    /// Bytes held for reassembly of IP fragments.
    pub reassembly_bytes: u64,
    /// Bytes held for reassembly of captured datagrams that arrive from the sockets in pieces.
    pub pieces_bytes: u64,
    /// Incomplete datagrams evicted because the reassembly buffer was full.
    pub reassembly_evicted: u64,
    /// Updates of topics of interest that did not fit into the kernel filter's maps.
    pub refused_updates: u64,
    /// Result of saving the state. `None` if no state is saved.
    pub state: Option<StateFacts>,
    /// Facts about reading shared memory. `None` if it is not read.
    pub shared_memory: Option<SharedMemoryFacts>,
    /// Libraries with uprobes for exact capture of shared memory. Empty if exact mode is off.
    pub exact: Vec<ExactFacts>,
    /// State of the observation inside processes. `None` if it is off.
    pub inside: Option<InsideSourceFacts>,
    /// Facts about subscriptions.
    pub subscriptions: SubscriptionFacts,
    /// Filter of system calls in force.
    pub sandbox: Sandbox,
}

/// State of exact capture for one library.
#[derive(Clone, Debug, Default, PartialEq, Eq, PartialOrd, Ord)]
pub struct ExactFacts {
    /// Path of the library as seen by its processes. Empty for facts about all libraries.
    pub library: String,
    /// Reason for the failure. `None` while messages are captured.
    pub refused: Option<String>,
}

/// State of the observation inside processes.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct InsideSourceFacts {
    /// `topics`, `full` or `auto`.
    pub mode: &'static str,
    /// Whether calls are observed on demand, and no client needs them.
    pub is_idle: bool,
    /// Whether calls have been observed for long enough to show rates.
    pub shows_rates: bool,
    /// Observed libraries.
    pub libraries: Vec<InsideLibrary>,
    /// Counters of the kernel programs, all of them in a fixed order.
    pub counters: Vec<(&'static str, u64)>,
    /// What is observed about late calls: `off`, `sums` or `events`.
    pub late: &'static str,
    /// Why the scheduler's events are not observed when they are needed.
    pub without_events: Option<String>,
    /// Why deliveries of messages are not followed although they are needed.
    pub without_deliveries: Option<String>,
    /// Why nothing is observed although the source is switched on. `None` if it works.
    pub reason_off: Option<String>,
}

/// An observed library.
#[derive(Clone, Debug, Default, PartialEq, Eq, PartialOrd, Ord)]
pub struct InsideLibrary {
    /// Path as seen by its processes.
    pub path: String,
    /// Number of processes that use it.
    pub processes: u64,
    /// Reason for the failure. `None` while its calls are observed.
    pub refused: Option<String>,
}

/// Facts about reading shared memory.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct SharedMemoryFacts {
    /// Open objects by kind.
    pub open: Vec<(&'static str, u64)>,
    /// Events by kind, all of them in a fixed order.
    pub events: Vec<(&'static str, u64)>,
    /// CPU time used, in seconds.
    pub cpu_seconds: f64,
    /// Number of polls.
    pub polls: u64,
}

/// Kind of a packet source.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum SourceKind {
    /// Datagrams at the sockets of this host.
    Host,
    /// Frames on the interfaces of this host.
    Wire,
    /// A capture file.
    Replay,
}

/// Ability of a source.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Ability {
    /// Messages received by each subscriber, also if several share a destination.
    Subscribers,
    /// Messages sent by this host.
    Sent,
    /// Messages lost in the full receive buffer of a subscriber's socket.
    SocketLosses,
    /// Messages lost in IP reassembly.
    ReassemblyLosses,
    /// Process and control group of sockets.
    Owners,
    /// Sockets in every network namespace, which includes all containers.
    Containers,
    /// Traffic that no local socket sends or receives.
    Forwarded,
    /// Messages in shared memory between processes of this host, sampled.
    SharedMemory,
    /// Every message in shared memory, from all processes.
    SharedMemoryExact,
    /// Counts from inside processes, whatever the transport.
    Inside,
    /// All causes of late calls: by the scheduler's events, and by the way of messages.
    LateCauses,
}

/// Counters of one interface.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct InterfaceFacts {
    /// Name, preceded by the namespace unless it is the agent's own.
    pub name: String,
    /// Packets that passed the filter. `None` without such a counter.
    pub packets: Option<u64>,
    /// Packets lost because the ring was full. `None` without such a counter.
    pub dropped: Option<u64>,
}

impl AgentFacts {
    /// Returns the initial facts of a source.
    #[must_use]
    pub fn new(source: SourceKind, at: Instant) -> Self {
        Self {
            source,
            source_reason: None,
            wire: None,
            abilities: source.abilities().to_vec(),
            on_demand: Vec::new(),
            missing_abilities: Vec::new(),
            missing_object: None,
            stalled: None,
            pending: None,
            reattachments: 0,
            collected_at: at,
            capture_progress: at,
            finished: false,
            capture_begin: None,
            replayed: None,
            replay_speed: None,
            replay_pace: Pace::default(),
            replay_faults: Vec::new(),
            replay_incident: None,
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
            inside: None,
            subscriptions: SubscriptionFacts::default(),
            sandbox: privilege::sandbox(),
        }
    }
}

impl InsideSourceFacts {
    /// Returns why not all causes of late calls are observed. Where late calls are off, nothing is
    /// missing for them.
    #[must_use]
    pub fn without_causes(&self) -> Option<&str> {
        let without_deliveries = self.without_deliveries.as_deref();
        let without_deliveries = without_deliveries.filter(|_| self.late != "off");
        self.without_events.as_deref().or(without_deliveries)
    }
}

impl SourceKind {
    /// Returns the label value.
    #[must_use]
    pub const fn label(self) -> &'static str {
        match self {
            Self::Host => "host",
            Self::Wire => "wire",
            Self::Replay => "replay",
        }
    }

    /// Returns the abilities of every source of this kind. The kernel and the configuration may add
    /// more.
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
    /// All abilities.
    pub const ALL: [Self; 11] = [
        Self::Subscribers,
        Self::Sent,
        Self::SocketLosses,
        Self::ReassemblyLosses,
        Self::Owners,
        Self::Containers,
        Self::Forwarded,
        Self::SharedMemory,
        Self::SharedMemoryExact,
        Self::Inside,
        Self::LateCauses,
    ];

    /// Returns the label value.
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
            Self::Inside => "inside",
            Self::LateCauses => "late_causes",
        }
    }
}

/// Figures of all subscriptions.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct SubscriptionFacts {
    /// Open subscriptions.
    pub open: usize,
    /// Refused subscriptions since the start.
    pub refused: u64,
    /// Samples put into queues since the start, per reader.
    pub enqueued: u64,
    /// Samples not delivered since the start, per reader, in the order of [`MissedReason::ALL`].
    pub missed: [u64; MissedReason::ALL.len()],
    /// Samples of `missed` that were evicted because all queues together were full.
    pub crowded_out: u64,
    /// Bytes of the samples in queues.
    pub queued_bytes: usize,
    /// Bytes of retained messages.
    pub retained_bytes: usize,
}
