//! What to capture, and the memory for it.

use std::path::PathBuf;

use schemars::JsonSchema;
use serde::Deserialize;

/// Where packets come from and the memory used for it.
#[derive(Clone, Debug, PartialEq)]
pub struct CaptureSettings {
    /// At the sockets of this host, or on the wire.
    pub source: SourceChoice,
    /// Only sockets of this cgroup; `None` = the whole host.
    pub cgroup: Option<PathBuf>,
    /// Interface globs whose wire is looked at besides the host's sockets.
    pub mirror_interfaces: Vec<String>,
    /// Interface globs to look at; empty = all.
    pub include_interfaces: Vec<String>,
    /// Interface globs never looked at.
    pub exclude_interfaces: Vec<String>,
    /// Further network namespaces.
    pub network_namespaces: Vec<PathBuf>,
    /// Packet ring of each network namespace.
    pub ring_bytes: usize,
    /// Ring for measurement records.
    pub record_ring_bytes: usize,
    /// What goes through shared memory.
    pub shm: ShmSettings,
}

/// How shared memory is looked at.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ShmSettings {
    /// Whether it is.
    pub mode: ShmMode,
    /// Whether every message is to be seen in the process that sends it.
    pub exact: ExactChoice,
    /// Share of one CPU that it may cost, in percent.
    pub cpu_percent: f64,
    /// The same while samples are given one by one.
    pub reading_cpu_percent: f64,
}

/// Whether shared memory is looked at.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum ShmMode {
    /// Where there is any.
    #[default]
    Auto,
    /// Never.
    Off,
}

/// How every message into shared memory is seen, if at all.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum ExactChoice {
    /// It is not: shared memory is only read.
    #[default]
    Off,
    /// By a breakpoint of the kernel's in the code of the processes that send.
    Uprobe,
    /// As `uprobe`, but only while samples of a topic that goes through shared memory are given one
    /// by one; otherwise shared memory is only read.
    Auto,
}

/// Where the agent looks.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum SourceChoice {
    /// `host` where the kernel and the configuration allow it, otherwise `wire`.
    #[default]
    Auto,
    /// Datagrams at the sockets of this host: whole, once per socket, in every container.
    Host,
    /// Frames on the interfaces.
    Wire,
}

impl SourceChoice {
    /// As written in the file.
    #[must_use]
    pub const fn label(self) -> &'static str {
        match self {
            Self::Auto => "auto",
            Self::Host => "host",
            Self::Wire => "wire",
        }
    }
}
