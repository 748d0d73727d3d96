//! Settings of the capture and its memory.

use std::path::PathBuf;

use schemars::JsonSchema;
use serde::Deserialize;

/// Packet sources and their memory.
#[derive(Clone, Debug, PartialEq)]
pub struct CaptureSettings {
    /// Whether packets are captured at the sockets of this host or on interfaces.
    pub source: SourceChoice,
    /// How interfaces are observed.
    pub wire: WireChoice,
    /// Cgroup whose sockets are observed; `None` = the whole host.
    pub cgroup: Option<PathBuf>,
    /// Globs of interfaces that are observed in addition to the host's sockets.
    pub mirror_interfaces: Vec<String>,
    /// Globs of observed interfaces; empty = all.
    pub include_interfaces: Vec<String>,
    /// Globs of interfaces that are never observed.
    pub exclude_interfaces: Vec<String>,
    /// Further network namespaces to observe.
    pub network_namespaces: Vec<PathBuf>,
    /// Size of the packet ring of each network namespace.
    pub ring_bytes: usize,
    /// Size of the ring for measurement records.
    pub record_ring_bytes: usize,
    /// Settings for shared memory.
    pub shm: ShmSettings,
    /// Observation inside processes.
    pub inside: InsideChoice,
    /// Causes of late callbacks.
    pub late: LateChoice,
    /// Socket of the process that attaches breakpoints, if one listens there.
    pub broker: PathBuf,
    /// TCP ports of Zenoh, at most [`ros2probe_wire::filter::PORT_CAPACITY`].
    pub zenoh_ports: Vec<u16>,
}

/// What is observed inside processes, by uprobes on `libtracetools.so`.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum InsideChoice {
    /// The source is off.
    Off,
    /// Messages that are published and taken, also within a process.
    Topics,
    /// Also callbacks, timers and lifecycle transitions.
    Full,
    /// Like `full`, but calls are observed only while a client needs them; otherwise only the
    /// creation of nodes, publishers, subscriptions, timers and services.
    #[default]
    Auto,
}

/// Whether the scheduler's events are observed, which name the causes of late callbacks.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum LateChoice {
    /// Late calls are not reported.
    Off,
    /// While calls are observed.
    On,
    /// While a client or an event requires causes. At other times, late calls are reported with the
    /// sums of the scheduler's accounting.
    #[default]
    Auto,
}

/// How shared memory is observed.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ShmSettings {
    /// Whether shared memory is observed.
    pub mode: ShmMode,
    /// Whether every message is read in the process that sends it.
    pub exact: ExactChoice,
    /// Share of one CPU for reading shared memory, in percent.
    pub cpu_percent: f64,
    /// Share of one CPU while every sample is delivered, in percent.
    pub reading_cpu_percent: f64,
}

impl ShmSettings {
    /// Returns whether programs read every message in the processes that send it, always or on
    /// demand.
    #[must_use]
    pub const fn reads_in_senders(&self) -> bool {
        matches!(self.mode, ShmMode::Auto) && !matches!(self.exact, ExactChoice::Off)
    }
}

/// Whether shared memory is read.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum ShmMode {
    /// If it exists.
    #[default]
    Auto,
    /// Never.
    Off,
}

/// How every message in shared memory is read, if at all.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum ExactChoice {
    /// Shared memory is only sampled.
    Off,
    /// By a kernel breakpoint in the code of the sending processes.
    Uprobe,
    /// Like `uprobe`, but only while messages of a topic in shared memory are delivered to a client or
    /// recording; otherwise shared memory is sampled.
    #[default]
    Auto,
}

/// Where the agent captures packets.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum SourceChoice {
    /// `host` if the kernel and the configuration allow it, otherwise `wire`.
    #[default]
    Auto,
    /// Datagrams at the sockets of this host: whole, once per socket, in every container.
    Host,
    /// Frames on the interfaces.
    Wire,
}

/// How the agent reads frames on interfaces.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum WireChoice {
    /// `tcx` if the kernel and the privileges allow it, otherwise `packet`.
    #[default]
    Auto,
    /// Programs at the interfaces, which the kernel has from Linux 6.6 on.
    Tcx,
    /// A packet socket.
    Packet,
}

impl WireChoice {
    /// Returns the name of the choice in the configuration file.
    #[must_use]
    pub const fn label(self) -> &'static str {
        match self {
            Self::Auto => "auto",
            Self::Tcx => "tcx",
            Self::Packet => "packet",
        }
    }
}

impl SourceChoice {
    /// Returns the name of the choice in the configuration file.
    #[must_use]
    pub const fn label(self) -> &'static str {
        match self {
            Self::Auto => "auto",
            Self::Host => "host",
            Self::Wire => "wire",
        }
    }
}
