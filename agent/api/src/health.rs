//! `/health`, `/-/reload`, and the access token of the web page.

use std::borrow::Cow;

use serde::{Deserialize, Serialize};

/// Readiness, limits and abilities of the agent.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(default)]
pub struct Health {
    /// The agent captures packets, and its state is fresh.
    pub ready: bool,
    /// Why the agent is not ready; null if it is.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[cfg_attr(feature = "openapi", schema(nullable = false))]
    pub reason: Option<String>,
    /// Limits that are reached, so that a part of the robot is not observed; null if no limit is
    /// reached.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[cfg_attr(feature = "openapi", schema(nullable = false))]
    pub degraded: Option<String>,
    /// Name of the agent's host.
    pub host: Option<String>,
    /// Version of the agent.
    pub version: Cow<'static, str>,
    /// Where the agent captures: `host`, `wire` or `replay`.
    pub source: Cow<'static, str>,
    /// The replay has reached the end of its capture, so its values are final.
    pub finished: bool,
    /// Age of the agent's state, in seconds; null before the first packet.
    pub age_seconds: Option<f64>,
    /// Number of active watches, from every origin.
    pub watches: usize,
    /// Watches that clients add survive a restart: the agent has a writable state directory.
    pub watches_kept: bool,
    /// Packets dropped because a capture ring was full. Above 0, counts are lower bounds.
    pub dropped_packets: u64,
    /// Measurement records dropped because their ring was full.
    pub dropped_records: u64,
    /// Datagrams, captured at the host's sockets, that were dropped because their ring was full.
    pub dropped_datagrams: u64,
    /// Datagrams that the kernel programs skipped because they interrupted each other too often.
    pub contended_datagrams: u64,
    /// Number of writers whose announcement was missed. The names of their topics are unknown.
    pub unknown_writers: usize,
    /// Command that requests the announcements of unknown writers; null without unknown writers.
    pub unknown_writers_remedy: Option<String>,
    /// Topics that match a watch but are not measured because `limits.topics` is reached.
    pub topics_rejected: u64,
    /// Why the agent uses a capture source that shows less than another one; null otherwise.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[cfg_attr(feature = "openapi", schema(nullable = false))]
    pub source_reason: Option<String>,
    /// How interfaces are observed; null if none are.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[cfg_attr(feature = "openapi", schema(nullable = false))]
    pub wire: Option<Wire>,
    /// Abilities, and whether the agent has each of them.
    pub abilities: Vec<Ability>,
    /// Capture points: network interfaces, or `sockets`.
    pub interfaces: Vec<Interface>,
    /// Fill level of the bounded tables.
    pub tables: Vec<Table>,
    /// Use of the configured limits.
    pub limits: Vec<Limit>,
    /// Capabilities that at least one thread still has after startup. The thread that serves this
    /// answer has no capabilities.
    pub capabilities: Vec<String>,
    /// Threads of the agent, as the kernel reports them.
    pub threads: Vec<Thread>,
    /// Why system calls are not filtered; null if they are.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[cfg_attr(feature = "openapi", schema(nullable = false))]
    pub unfiltered_reason: Option<Cow<'static, str>>,
    /// The listener for viewers; null if it is off.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[cfg_attr(feature = "openapi", schema(nullable = false))]
    pub foxglove: Option<Foxglove>,
    /// Ports at which the agent answers as the daemon of the `ros2` command line, by domain; empty
    /// if it does not.
    pub ros2_daemon: Vec<Ros2DaemonPort>,
    /// Zenoh connections and routers on this host; null until the agent has seen Zenoh.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[cfg_attr(feature = "openapi", schema(nullable = false))]
    pub zenoh: Option<Zenoh>,
    /// Address of the page on the agent's host; null if the page is not served.
    pub page: Option<String>,
    /// Process id of the agent, in its own PID namespace.
    pub process_id: u32,
    /// Seconds since the agent's process started; null if unknown.
    pub uptime_seconds: Option<f64>,
}

/// The listener for viewers over the Foxglove protocol, and the viewers.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(default)]
pub struct Foxglove {
    /// Address that viewers open on the agent's host.
    #[cfg_attr(feature = "openapi", schema(example = "ws://localhost:8765/"))]
    pub address: String,
    /// Why the agent does not listen at the address; null if it does.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[cfg_attr(feature = "openapi", schema(nullable = false))]
    pub reason: Option<String>,
    /// Rights of viewers without a token: `read`, `watch` or `all`; null if every viewer needs a
    /// token. Messages need `all`.
    pub access: Option<Cow<'static, str>>,
    /// Connected viewers, in the order in which they connected.
    pub clients: Vec<FoxgloveClient>,
}

/// A connected viewer.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(default)]
pub struct FoxgloveClient {
    /// IP address and port of the viewer; null if unknown.
    #[cfg_attr(feature = "openapi", schema(example = "127.0.0.1:50412"))]
    pub address: Option<String>,
    /// Rights of the viewer: `read`, `watch` or `all`.
    pub access: Cow<'static, str>,
    /// Number of channels that the viewer subscribes to.
    pub subscriptions: usize,
    /// Messages sent to the viewer, statistics included.
    pub sent_messages: u64,
    /// Messages dropped because the viewer reads too slowly.
    pub dropped_messages: u64,
}

/// The port at which the agent acts as the ros2 daemon of a domain.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(default)]
pub struct Ros2DaemonPort {
    /// Domain id.
    pub domain_id: u32,
    /// TCP port on loopback.
    #[cfg_attr(feature = "openapi", schema(example = 11511))]
    pub port: u16,
    /// `listening` (the agent answers), `occupied` (another process has the port), `released` (by
    /// `ros2 daemon stop`), `failed` or `limit` (more domains than ports).
    #[cfg_attr(feature = "openapi", schema(example = "listening"))]
    pub state: Cow<'static, str>,
    /// Why the port cannot be bound; null unless the state is `failed`.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[cfg_attr(feature = "openapi", schema(nullable = false))]
    pub reason: Option<String>,
}

/// Zenoh connections and routers on this host.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(default)]
pub struct Zenoh {
    /// Number of current connections, each counted once.
    pub connections: u64,
    /// Number of current routers.
    pub routers: u64,
    /// Number of times that bytes of a connection were not captured.
    pub gaps: u64,
    /// Connections that the agent cannot read, by reason.
    pub unseen: Vec<UnseenConnections>,
}

/// Zenoh connections that the agent cannot read for one reason.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(default)]
pub struct UnseenConnections {
    /// `tls`, `quic`, `version`, `compression`, `low_latency` or `shared_memory`. With
    /// `shared_memory`, only the payloads cannot be read.
    #[cfg_attr(feature = "openapi", schema(example = "tls"))]
    pub reason: Cow<'static, str>,
    /// The reason in words, to be appended to "connections".
    #[cfg_attr(feature = "openapi", schema(example = "encrypted with TLS"))]
    pub text: Cow<'static, str>,
    /// Number of connections.
    pub connections: u64,
}

/// An ability that depends on privileges, the kernel or the configuration.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(default)]
pub struct Ability {
    /// Name of the ability, as in the metric `ros2probe_capture_ability`.
    #[cfg_attr(feature = "openapi", schema(example = "socket_losses"))]
    pub ability: Cow<'static, str>,
    /// Whether the agent has the ability.
    pub able: bool,
    /// The agent gains the ability while a client needs it (`capture.shm.exact: auto`).
    pub on_demand: bool,
    /// Why the agent lacks the ability; null if the agent has it or it is not requested.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[cfg_attr(feature = "openapi", schema(nullable = false))]
    pub reason: Option<String>,
}

/// How interfaces are observed.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(default)]
pub struct Wire {
    /// `tcx`: by programs at the interfaces; `packet`: by packet sockets.
    #[cfg_attr(feature = "openapi", schema(example = "tcx"))]
    pub hook: Cow<'static, str>,
    /// Why tcx is not used although the configuration permits it; null otherwise.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[cfg_attr(feature = "openapi", schema(nullable = false))]
    pub reason: Option<String>,
}

/// A thread of the agent and its privileges.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(default)]
pub struct Thread {
    /// Name of the thread; `rp` for the thread that serves this answer.
    #[cfg_attr(feature = "openapi", schema(example = "capture"))]
    pub thread: String,
    /// Capabilities of the thread.
    pub capabilities: Vec<String>,
    /// A seccomp filter limits the thread to the system calls that it needs.
    pub filtered: bool,
}

/// A capture point.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(default)]
pub struct Interface {
    /// Name of the interface; `sockets` for the host's sockets, `any` for all interfaces of a
    /// namespace.
    pub interface: String,
    /// Packets that passed the filter; null if they are not counted per interface.
    pub packets: Option<u64>,
    /// Packets dropped because the ring was full; null if they are not counted per interface.
    pub dropped_packets: Option<u64>,
}

/// A bounded table.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(default)]
pub struct Table {
    /// Name of the table, as in `limits`.
    #[cfg_attr(feature = "openapi", schema(example = "endpoints"))]
    pub table: Cow<'static, str>,
    /// Number of entries; for `reassembly`, bytes.
    pub entries: u64,
    /// Maximum number of entries; for `reassembly`, bytes.
    pub limit: u64,
    /// Entries evicted because the table was full.
    pub evictions: u64,
}

/// A limit of the configuration and its use.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(default)]
pub struct Limit {
    /// Key below `limits` in the configuration.
    #[cfg_attr(feature = "openapi", schema(example = "topics"))]
    pub limit: Cow<'static, str>,
    /// Maximum number of entries, connections or bytes.
    pub cap: u64,
    /// Entries, connections or bytes in use.
    pub used: u64,
    /// Number of times that an entry was refused or evicted because the limit was reached.
    pub reached: u64,
    /// The limit is reached now or was reached within the last minute.
    pub at_limit: bool,
}

/// Result of a successful reload of the configuration.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(default)]
pub struct Reloaded {
    /// Number of active watches, from every origin.
    pub watches: usize,
    /// Changed keys that take effect only after a restart.
    pub needs_restart: Vec<Cow<'static, str>>,
}

/// An access token for the web page; it grants all rights.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(default)]
pub struct PageToken {
    /// Token to send as `Authorization: Bearer`. It is valid until the agent stops or 16 newer
    /// tokens exist.
    pub token: String,
    /// Address of the page on the agent's host; null if the page is not served.
    #[cfg_attr(feature = "openapi", schema(example = "http://localhost:17401/"))]
    pub address: Option<String>,
}

impl Health {
    /// Returns the number of packets, records and datagrams that were dropped or skipped.
    #[must_use]
    pub const fn dropped(&self) -> u64 {
        self.dropped_packets
            .saturating_add(self.dropped_records)
            .saturating_add(self.dropped_datagrams)
            .saturating_add(self.contended_datagrams)
    }
}
