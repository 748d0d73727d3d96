//! `/health`, `/-/reload` and the token of the page.

use std::borrow::Cow;

use serde::{Deserialize, Serialize};

/// How the agent is.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(default)]
pub struct Health {
    /// Packets are captured and what is known is fresh.
    pub ready: bool,
    /// Why it is not.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[cfg_attr(feature = "openapi", schema(nullable = false))]
    pub reason: Option<String>,
    /// Why part of the robot is not seen although it is ready: which limits are reached.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[cfg_attr(feature = "openapi", schema(nullable = false))]
    pub degraded: Option<String>,
    /// Name of its host.
    pub host: Option<String>,
    /// Version of the agent.
    pub version: Cow<'static, str>,
    /// Where it looks: `host`, `wire` or `replay`.
    pub source: Cow<'static, str>,
    /// The replay reached the end of its capture; no figure changes after that.
    pub finished: bool,
    /// Age of what is known; null while nothing is.
    pub age_seconds: Option<f64>,
    /// Watches in force, of every origin.
    pub watches: usize,
    /// Watches that clients add outlive the agent: there is a state directory that can be written.
    pub watches_kept: bool,
    /// Packets lost because a ring was full: above 0, counts are lower bounds.
    pub dropped_packets: u64,
    /// Measurement records lost likewise.
    pub dropped_records: u64,
    /// Datagrams captured at the host's sockets that were lost likewise.
    pub dropped_datagrams: u64,
    /// Datagrams that the kernel programs could not look at.
    pub contended_datagrams: u64,
    /// Senders whose announcement was missed: their topics have no name.
    pub unknown_writers: usize,
    /// Topics that a watch matched but `limits.topics` kept from being measured.
    pub topics_rejected: u64,
    /// Why it does not look where it would see more.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[cfg_attr(feature = "openapi", schema(nullable = false))]
    pub source_reason: Option<String>,
    /// What it can see and what not.
    pub abilities: Vec<Ability>,
    /// Where packets come from: interfaces, or `sockets`.
    pub interfaces: Vec<Interface>,
    /// Bounded tables.
    pub tables: Vec<Table>,
    /// Caps of the configuration.
    pub limits: Vec<Limit>,
    /// Capabilities that some thread of it holds, after it has given up what it does not need any
    /// more. The thread that answers holds none.
    pub capabilities: Vec<String>,
    /// Its threads, as the kernel sees them.
    pub threads: Vec<Thread>,
    /// Why system calls are not filtered.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[cfg_attr(feature = "openapi", schema(nullable = false))]
    pub unfiltered_reason: Option<Cow<'static, str>>,
    /// Its process, in its own process namespace.
    pub process_id: u32,
    /// Since its process started; null where that cannot be read.
    pub uptime_seconds: Option<f64>,
}

/// One thing that an agent may be able to see.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(default)]
pub struct Ability {
    /// Which: see `ros2probe_capture_ability`.
    #[cfg_attr(feature = "openapi", schema(example = "socket_losses"))]
    pub ability: Cow<'static, str>,
    /// Whether this one can.
    pub able: bool,
    /// Why not, where there is more to say than that it was not asked for.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[cfg_attr(feature = "openapi", schema(nullable = false))]
    pub reason: Option<String>,
}

/// A thread and what it may do.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(default)]
pub struct Thread {
    /// Its name; `rp` for the one that answers.
    #[cfg_attr(feature = "openapi", schema(example = "capture"))]
    pub thread: String,
    /// Capabilities that it holds.
    pub capabilities: Vec<String>,
    /// The kernel refuses all system calls but those that it makes.
    pub filtered: bool,
}

/// Where packets come from.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(default)]
pub struct Interface {
    /// Its name; `sockets` for those of this host, `any` for all interfaces of a namespace.
    pub interface: String,
    /// Packets that the filter let through, where they are counted so.
    pub packets: Option<u64>,
    /// Packets lost because a ring was full, where they are counted so.
    pub dropped_packets: Option<u64>,
}

/// A bounded table.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(default)]
pub struct Table {
    /// Its name, as in `limits`.
    #[cfg_attr(feature = "openapi", schema(example = "endpoints"))]
    pub table: Cow<'static, str>,
    /// Entries; bytes for `reassembly`.
    pub entries: u64,
    /// Its cap.
    pub limit: u64,
    /// Entries given up because of the cap.
    pub evictions: u64,
}

/// A cap of the configuration.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(default)]
pub struct Limit {
    /// Its key below `limits`.
    #[cfg_attr(feature = "openapi", schema(example = "topics"))]
    pub limit: Cow<'static, str>,
    /// Entries, connections or bytes that may be.
    pub cap: u64,
    /// That are.
    pub used: u64,
    /// What was refused, or given up to make room, because of it.
    pub reached: u64,
    /// There is no room, or there was none within the last minute.
    pub at_limit: bool,
}

/// The configuration was taken over.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(default)]
pub struct Reloaded {
    /// Watches in force, of every origin.
    pub watches: usize,
    /// Changed keys that take effect only after a restart.
    pub needs_restart: Vec<Cow<'static, str>>,
}

/// Grants a page all rights.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(default)]
pub struct PageToken {
    /// Sent as `Authorization: Bearer`; valid until the agent ends, or until 16 newer ones are given.
    pub token: String,
    /// Where the page is served on the agent's host; null where it is not.
    #[cfg_attr(feature = "openapi", schema(example = "http://localhost:17401/"))]
    pub address: Option<String>,
}

impl Health {
    /// Packets, records and datagrams that were not looked at.
    #[must_use]
    pub const fn dropped(&self) -> u64 {
        self.dropped_packets
            .saturating_add(self.dropped_records)
            .saturating_add(self.dropped_datagrams)
            .saturating_add(self.contended_datagrams)
    }
}
