//! The shape of the YAML file: what `config/ros2probe.schema.json` is generated from.
//!
//! Sections may be left empty (`watch:` with everything below it commented out). Ranges written
//! here are enforced while reading; what needs more than one value is checked in `meaning`.

use std::collections::BTreeMap;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::limits::LimitsShape;
use super::{
    Access, Compression, ExactChoice, Level, PageChoice, Retain, ShmMode, SourceChoice, defaults,
};

/// Configuration of the ros2probe agent. Every key may be left out.
#[derive(Debug, Default, Deserialize, JsonSchema)]
#[schemars(title = "ros2probe configuration")]
#[serde(deny_unknown_fields, default)]
pub(super) struct ConfigShape {
    /// The form of this file; 1 when left out. An rp that does not know it refuses the file.
    #[schemars(range(min = 1, max = 1))]
    pub(super) version: Option<u32>,
    /// Topics to measure: names (`/points`), globs (`/camera/*/image_raw`, `/**`), or maps with
    /// expectations. Nothing listed: the graph alone is reported. Applied on reload.
    pub(super) watch: Option<Vec<WatchShape>>,
    /// Caps of the agent's tables; what exceeds them is counted in `ros2probe_limit_reached_total`.
    pub(super) limits: Option<LimitsShape>,
    /// Where packets are taken from and how much memory is used for it.
    pub(super) capture: Option<CaptureShape>,
    /// The metrics listener and what it shows.
    pub(super) metrics: Option<MetricsShape>,
    /// The control API: watches that are added and removed while the agent runs.
    pub(super) api: Option<ApiShape>,
    /// What the page in the browser shows.
    pub(super) page: Option<PageShape>,
    /// Pushes metrics, events and traces to an OpenTelemetry receiver over gRPC. What is not
    /// written here the standard `OTEL_*` variables decide.
    pub(super) otlp: Option<OtlpShape>,
    /// Bags that the agent writes: on request (`POST /recordings`), and of the last seconds before
    /// an incident.
    pub(super) recordings: Option<RecordingsShape>,
    /// How long a topic without endpoints is still reported, in seconds.
    #[schemars(range(min = 0, max = 604_800))]
    #[serde(default = "defaults::topic_grace_s")]
    pub(super) topic_grace_s: u64,
    /// Where the agent keeps what discovery knows, so that a restart on a running robot loses no
    /// name: an absolute path to a directory, `off`, or `auto`: `$STATE_DIRECTORY` as the service
    /// manager sets it, else /var/lib/ros2probe if it is there and can be written.
    #[serde(default = "defaults::state_directory")]
    pub(super) state_directory: String,
    /// Least severe log level that is written to standard error. Applied on reload.
    #[serde(default)]
    pub(super) log: Level,
}

/// A topic name or glob, or one with a domain and expectations.
#[derive(Debug, Deserialize, JsonSchema)]
#[serde(untagged)]
pub(super) enum WatchShape {
    /// A topic name or glob.
    Pattern(String),
    /// A topic name or glob with what should hold.
    Entry(Box<WatchEntryShape>),
}

/// One watched topic or glob and what should hold for each topic it covers.
#[derive(Debug, Deserialize, JsonSchema)]
#[schemars(inline)]
#[serde(deny_unknown_fields)]
pub(super) struct WatchEntryShape {
    /// ROS name or glob: `*` stands for any part of one name token, `**` for any tokens.
    pub(super) topic: String,
    /// Only in this domain; every domain when left out.
    #[schemars(range(min = 0, max = 232))]
    pub(super) domain: Option<u32>,
    /// Series per delivery of each covered topic (what each writer sends where, what each
    /// subscriber received), besides those per topic.
    #[serde(default)]
    pub(super) per_subscriber: bool,
    /// The part of each covered topic's messages of which spans are exported (`otlp`), 0 to 1: when
    /// a message was on the wire, and when each reliable reader acknowledged it.
    #[schemars(range(min = 0.0, max = 1.0))]
    pub(super) trace: Option<f64>,
    /// `last`: the last message of each covered transient-local writer is kept in memory, so that
    /// a recording that begins later has it (`/tf_static`). Captures the covered topics.
    #[serde(default)]
    pub(super) retain: RetainShape,
    /// At least this many messages a second.
    #[schemars(range(min = 0.0, max = 1_000_000.0))]
    pub(super) min_rate_hz: Option<f64>,
    /// At most this many messages a second.
    #[schemars(range(min = 0.0, max = 1_000_000.0))]
    pub(super) max_rate_hz: Option<f64>,
    /// At most this part of the messages may be lost, 0 to 1.
    #[schemars(range(min = 0.0, max = 1.0))]
    pub(super) max_loss_ratio: Option<f64>,
    /// Longest time from the writer's timestamp to the wire, in milliseconds.
    #[schemars(range(min = 0.0, max = 3_600_000.0))]
    pub(super) max_latency_ms: Option<f64>,
    /// Longest time without a message, in seconds.
    #[schemars(range(min = 0.001, max = 604_800.0))]
    pub(super) max_silence_s: Option<f64>,
}

/// What is kept of a topic's messages for recordings that begin later.
#[derive(Clone, Copy, Debug, Default, Serialize, Deserialize, JsonSchema)]
#[schemars(rename = "Retain")]
#[serde(rename_all = "lowercase")]
pub(super) enum RetainShape {
    /// Nothing.
    #[default]
    None,
    /// The last one of each writer that keeps its own for late joiners (transient local).
    Last,
}

/// Where packets are taken from.
#[derive(Debug, Deserialize, JsonSchema)]
#[schemars(inline)]
#[serde(deny_unknown_fields, default)]
pub(super) struct CaptureShape {
    /// At the sockets of this host, or on the wire.
    pub(super) source: SourceChoice,
    /// Only the sockets of this cgroup (v2) and those below it, by absolute path; every socket of
    /// the host when left out. Not with `source: wire`.
    pub(super) cgroup: Option<String>,
    /// Interfaces (names or globs) whose wire is looked at besides the host's sockets, for traffic
    /// that no local socket receives: a mirror port, a gateway. Not with `source: wire`.
    pub(super) mirror_interfaces: Option<Vec<String>>,
    /// Which interfaces are looked at on the wire. Naming any rules out `source: host`.
    pub(super) interfaces: Option<InterfacesShape>,
    /// Further network namespaces to look into on the wire, by path (`/run/netns/robot`). Needs
    /// CAP_SYS_ADMIN. The host's sockets are seen in all of them.
    pub(super) network_namespaces: Option<Vec<String>>,
    /// Packet ring of each network namespace, in bytes.
    #[schemars(range(min = 262_144, max = 1_073_741_824))]
    pub(super) ring_bytes: usize,
    /// Ring for measurement records from the kernel filter, in bytes.
    #[schemars(range(min = 65_536, max = 1_073_741_824))]
    pub(super) record_ring_bytes: usize,
    /// Messages between processes of one host that go through Fast DDS's shared memory.
    pub(super) shm: Option<ShmShape>,
}

/// How shared memory is looked at: only ever read, at intervals.
#[derive(Debug, Deserialize, JsonSchema)]
#[schemars(inline)]
#[serde(deny_unknown_fields, default)]
pub(super) struct ShmShape {
    /// `auto`: where there is any; `off`: never.
    pub(super) mode: ShmMode,
    /// `uprobe`: see every message, by a breakpoint that the kernel puts into the code of all
    /// processes that use Fast DDS; where that is not possible, shared memory is read as usual.
    /// `auto`: the same, only while samples of a topic that goes through shared memory are recorded,
    /// echoed, retained or measured by a command.
    pub(super) exact: ExactChoice,
    /// Share of one CPU that looking may cost, in percent, but for moments in which participants
    /// meet. With less, fewer of the messages are seen; they are counted all the same.
    #[schemars(range(min = 0.1, max = 100))]
    pub(super) cpu_percent: f64,
    /// The same while samples of a topic that goes through shared memory are recorded, echoed,
    /// retained or measured by a command: then every message is wanted, and looks are many.
    #[schemars(range(min = 0.1, max = 100))]
    pub(super) reading_cpu_percent: f64,
}

/// Interface names or globs (`eth*`).
#[derive(Debug, Default, Deserialize, JsonSchema)]
#[schemars(inline)]
#[serde(deny_unknown_fields, default)]
pub(super) struct InterfacesShape {
    /// Look at these alone; all when empty.
    pub(super) include: Option<Vec<String>>,
    /// Never look at these.
    pub(super) exclude: Option<Vec<String>>,
}

/// The metrics listener.
#[derive(Debug, Deserialize, JsonSchema)]
#[schemars(inline)]
#[serde(deny_unknown_fields, default)]
pub(super) struct MetricsShape {
    /// `address:port` to serve `/metrics`, `/healthz` and `/readyz` on, or `off`.
    pub(super) listen: String,
    /// Histograms of inter-arrival time, latency and where it arises, of watched topics. Applied
    /// on reload.
    pub(super) histograms: bool,
    /// Series per writer of watched topics, besides those per topic. Applied on reload.
    pub(super) per_writer: bool,
    /// File that says who may scrape and with which certificate the listener proves who it is, of
    /// the form of exporter-toolkit's web.yml: `basic_auth_users` and `tls_server_config`.
    pub(super) web_config: Option<String>,
}

/// The control API.
#[derive(Debug, Deserialize, JsonSchema)]
#[schemars(inline)]
#[serde(deny_unknown_fields, default)]
pub(super) struct ApiShape {
    /// IP address and port to listen on, or `off`. Any address but a loopback one needs
    /// `token_file`.
    pub(super) listen: String,
    /// Unix socket to listen on besides, for members of its group: a path, `off`, or `auto`:
    /// api.sock in `$RUNTIME_DIRECTORY` as the service manager sets it, else in /run/ros2probe if
    /// that is there.
    pub(super) socket: String,
    /// What clients of a loopback `listen` may do without a token, be they any user of this host:
    /// `read` graph, figures and events; `watch`: also add watches; `all`: also message payloads,
    /// recordings, snapshots and reloads. The unix socket and a token always grant all.
    pub(super) loopback: Access,
    /// File with the bearer token that clients of `listen` must send, as the service manager's
    /// LoadCredential= provides it.
    pub(super) token_file: Option<String>,
    /// Whether `listen` also serves the page for browsers, at `/`.
    pub(super) page: PageChoice,
}

/// The page in the browser; `api.page` switches it off.
#[derive(Debug, Deserialize, JsonSchema)]
#[schemars(inline)]
#[serde(deny_unknown_fields, default)]
pub(super) struct PageShape {
    /// How many seconds of figures are kept of each measured topic, for charts; 0 = none. They
    /// take at most 6 MiB: more than 436 topics have fewer seconds.
    #[schemars(range(min = 0, max = 3_600))]
    pub(super) history_s: u32,
}

impl From<RetainShape> for Retain {
    fn from(shape: RetainShape) -> Self {
        match shape {
            RetainShape::None => Self::None,
            RetainShape::Last => Self::Last,
        }
    }
}

impl Default for PageShape {
    fn default() -> Self {
        Self {
            history_s: defaults::HISTORY_S,
        }
    }
}

impl Default for ApiShape {
    fn default() -> Self {
        Self {
            listen: defaults::API.to_owned(),
            socket: "auto".to_owned(),
            loopback: Access::default(),
            token_file: None,
            page: PageChoice::default(),
        }
    }
}

/// Bags that the agent writes.
#[derive(Debug, Deserialize, JsonSchema)]
#[schemars(inline)]
#[serde(deny_unknown_fields, default)]
pub(super) struct RecordingsShape {
    /// Where: an absolute path to a directory, `off`, or `auto`: `recordings` in the state directory.
    pub(super) directory: String,
    /// How large a recording may become, in bytes; it ends there with the reason. Any size when left out.
    #[schemars(range(min = 65_536))]
    pub(super) max_bytes: Option<u64>,
    /// How much all bags in the directory may take, in bytes; recordings end there. Any amount when left out.
    #[schemars(range(min = 65_536))]
    pub(super) max_total_bytes: Option<u64>,
    /// How much of the file system stays free, in percent: recordings end there.
    #[schemars(range(min = 0, max = 99))]
    pub(super) reserve_percent: u8,
    /// Likewise in bytes; the larger one counts.
    #[schemars(range(min = 0, max = 1_099_511_627_776_u64))]
    pub(super) reserve_bytes: u64,
    /// Topics of which the last seconds are kept in memory, and written when something happens.
    pub(super) snapshots: Option<Vec<SnapshotShape>>,
}

/// The last seconds of some topics.
#[derive(Debug, Deserialize, JsonSchema)]
#[schemars(inline)]
#[serde(deny_unknown_fields)]
pub(super) struct SnapshotShape {
    /// Names its bags.
    #[schemars(regex(pattern = r"^[A-Za-z0-9_-]{1,64}$"))]
    pub(super) name: String,
    /// ROS names or globs.
    pub(super) topics: Vec<String>,
    /// Of this domain.
    #[schemars(range(min = 0, max = 232))]
    #[serde(default)]
    pub(super) domain: u32,
    /// How many seconds are kept.
    #[schemars(range(min = 1, max = 600))]
    #[serde(default = "defaults::snapshot_seconds")]
    pub(super) seconds: u64,
    /// How much memory that may take; what does not fit is counted.
    #[schemars(range(min = 65_536, max = 4_294_967_296_u64))]
    #[serde(default = "defaults::snapshot_bytes")]
    pub(super) max_bytes: usize,
    /// Whether it is written when an expectation of a watch is violated.
    #[serde(default = "defaults::on_violation")]
    pub(super) on_violation: bool,
}

impl Default for RecordingsShape {
    fn default() -> Self {
        let limits = super::RecordingLimits::default();
        Self {
            directory: "auto".to_owned(),
            max_bytes: None,
            max_total_bytes: None,
            reserve_percent: limits.reserve_percent,
            reserve_bytes: limits.reserve_bytes,
            snapshots: None,
        }
    }
}

/// Push to an OpenTelemetry receiver.
#[derive(Debug, Default, Deserialize, JsonSchema)]
#[schemars(inline)]
#[serde(deny_unknown_fields, default)]
pub(super) struct OtlpShape {
    /// URL of the receiver, as `http://collector:4317`, or `off`. When left out,
    /// `OTEL_EXPORTER_OTLP_ENDPOINT` decides (and those of single signals); nothing is exported
    /// when it is not set either.
    pub(super) endpoint: Option<String>,
    /// How often metrics are exported, in seconds; 15 when nobody says.
    #[schemars(range(min = 1, max = 3_600))]
    pub(super) interval_s: Option<u64>,
    /// How long the receiver may take to answer, in seconds; 10 when nobody says.
    #[schemars(range(min = 1, max = 300))]
    pub(super) timeout_s: Option<u64>,
    /// Sent with each request: names and values. Secrets belong into headers_file.
    pub(super) headers: Option<BTreeMap<String, String>>,
    /// A file with one `name: value` a line, by absolute path.
    pub(super) headers_file: Option<String>,
    /// `none`, or `gzip` for slow links.
    pub(super) compression: Option<Compression>,
    /// Whether metrics are exported.
    pub(super) metrics: Option<bool>,
    /// Whether events are exported, as log records.
    pub(super) events: Option<bool>,
    /// Whether spans are exported, of the watches with `trace`.
    pub(super) traces: Option<bool>,
    /// What this robot is called: the attribute `robot.name` of all that is exported.
    pub(super) robot: Option<String>,
    /// Further attributes of the resource, names and values.
    pub(super) attributes: Option<BTreeMap<String, String>>,
}

impl Default for CaptureShape {
    fn default() -> Self {
        Self {
            source: SourceChoice::default(),
            cgroup: None,
            mirror_interfaces: None,
            interfaces: None,
            network_namespaces: None,
            ring_bytes: defaults::RING_BYTES,
            record_ring_bytes: defaults::RECORD_RING_BYTES,
            shm: None,
        }
    }
}

impl Default for ShmShape {
    fn default() -> Self {
        Self {
            mode: ShmMode::default(),
            exact: ExactChoice::default(),
            cpu_percent: defaults::SHM_CPU_PERCENT,
            reading_cpu_percent: defaults::SHM_READING_CPU_PERCENT,
        }
    }
}

impl Default for MetricsShape {
    fn default() -> Self {
        Self {
            listen: defaults::LISTEN.to_owned(),
            histograms: true,
            per_writer: false,
            web_config: None,
        }
    }
}
