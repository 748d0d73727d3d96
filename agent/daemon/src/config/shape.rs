//! The shape of the YAML file, from which `config/ros2probe.schema.json` is generated.
//!
//! Sections may be empty (`watch:` with everything below it commented out). Ranges declared here
//! are enforced during parsing; `meaning` checks conditions on several values.

use std::collections::BTreeMap;

use ros2probe_message::Dialect;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::limits::LimitsShape;
use super::{
    Access, Compression, ExactChoice, InsideChoice, LateChoice, Level, OtlpProtocol, PageChoice,
    Retain, RetainChoice, ShmMode, SourceChoice, WireChoice, defaults,
};

/// Configuration of the ros2probe agent. Every key is optional.
#[derive(Debug, Default, Deserialize, JsonSchema)]
#[schemars(title = "ros2probe configuration")]
#[serde(deny_unknown_fields, default)]
pub(super) struct ConfigShape {
    /// Version of this file's format; default 1. rp rejects versions that it does not support.
    #[schemars(range(min = 1, max = 1))]
    pub(super) version: Option<u32>,
    /// Topics to measure: names (`/points`), globs (`/camera/*/image_raw`, `/**`), or maps with
    /// expectations. With an empty list, only the graph is reported. Applied on reload.
    pub(super) watch: Option<Vec<WatchShape>>,
    /// Chains of messages with a limit for their latency. The topics between their ends are
    /// measured if their messages begin with a header.
    pub(super) chains: Option<Vec<ChainShape>>,
    /// Caps of the agent's tables; `ros2probe_limit_reached_total` counts entries beyond them.
    pub(super) limits: Option<LimitsShape>,
    /// Sources of packets, and the memory for them.
    pub(super) capture: Option<CaptureShape>,
    /// The metrics listener and its content.
    pub(super) metrics: Option<MetricsShape>,
    /// The control API, for example to add and remove watches at run time.
    pub(super) api: Option<ApiShape>,
    /// The WebSocket server for Foxglove, Lichtblick and PlotJuggler.
    pub(super) foxglove: Option<FoxgloveShape>,
    /// Whether the agent answers in place of the daemon of the `ros2` command line, so that
    /// `ros2 topic list` and its like create no participant.
    pub(super) ros2_daemon: Option<Ros2DaemonShape>,
    /// Content of the web page.
    pub(super) page: Option<PageShape>,
    /// Pushes metrics, events and traces to an OpenTelemetry receiver over gRPC. The standard
    /// `OTEL_*` variables replace missing keys.
    pub(super) otlp: Option<OtlpShape>,
    /// Pushes metrics to a receiver of Prometheus remote write. What the receiver lacks waits on
    /// disk.
    pub(super) remote_write: Option<RemoteWriteShape>,
    /// Bags written by the agent: on request (`POST /recordings`), and of the last seconds before
    /// an incident.
    pub(super) recordings: Option<RecordingsShape>,
    /// Where `rp ship` delivers finished bags.
    pub(super) ship: Option<ShipShape>,
    /// The engine to which the robots of a fleet deliver, for the view of the fleet.
    pub(super) fleet: Option<FleetShape>,
    /// What the robot itself says, in topics of standard types. The agent reads it as it passes, on
    /// watched and other topics.
    pub(super) robot: Option<RobotShape>,
    /// Time for which a topic without endpoints is still reported, in seconds.
    #[schemars(range(min = 0, max = 604_800))]
    #[serde(default = "defaults::topic_grace_s")]
    pub(super) topic_grace_s: u64,
    /// Time without a reply after which a call of a service is reported as hanging, in seconds. The
    /// results of actions are exempt.
    #[schemars(range(min = 0.1, max = 86_400.0))]
    #[serde(default = "defaults::service_timeout_s")]
    pub(super) service_timeout_s: f64,
    /// Last messages that are kept for recordings, viewers and commands that begin later.
    #[serde(default)]
    pub(super) retain: RetainChoice,
    /// Directory of the saved discovery state, so that a restart on a running robot loses no name:
    /// an absolute path, `off` or `auto`. `auto` is `$STATE_DIRECTORY` as set by the service
    /// manager, else /var/lib/ros2probe if it exists and is writable.
    #[serde(default = "defaults::state_directory")]
    pub(super) state_directory: String,
    /// Newer versions of ros2probe, for `rp upgrade --check`. The agent does not use it.
    pub(super) upgrade: Option<UpgradeShape>,
    /// Minimum severity of log lines on standard error. Applied on reload.
    #[serde(default)]
    pub(super) log: Level,
}

/// Where newer versions are announced.
#[derive(Debug, Default, Deserialize, JsonSchema)]
#[schemars(inline)]
#[serde(deny_unknown_fields, default)]
pub(super) struct UpgradeShape {
    /// The file `release.json` of the newest release: an absolute path, or an address that begins
    /// with `https://` or `http://`.
    pub(super) feed: Option<String>,
}

/// A topic name or glob, or one with a domain and expectations.
#[derive(Debug, Deserialize, JsonSchema)]
#[serde(untagged)]
pub(super) enum WatchShape {
    /// A topic name or glob.
    Pattern(String),
    /// A topic name or glob with expectations.
    Entry(Box<WatchEntryShape>),
}

/// A watched topic or glob, and the expectations for each topic that it matches.
#[derive(Debug, Deserialize, JsonSchema)]
#[schemars(inline)]
#[serde(deny_unknown_fields)]
pub(super) struct WatchEntryShape {
    /// ROS name or glob: `*` stands for any part of one name token, `**` for any tokens.
    pub(super) topic: String,
    /// Only in this domain; default: every domain.
    #[schemars(range(min = 0, max = 232))]
    pub(super) domain: Option<u32>,
    /// Series per delivery of each matching topic (messages of each writer by destination, messages
    /// received by each subscriber), in addition to those per topic.
    #[serde(default)]
    pub(super) per_subscriber: bool,
    /// Fraction of each matching topic's messages for which spans are exported (`otlp`), 0 to 1.
    /// Spans cover the time on the wire, and the acknowledgements of each reliable reader. The same
    /// fraction of the chains that begin with the topic is exported, too.
    #[schemars(range(min = 0.0, max = 1.0))]
    pub(super) trace: Option<f64>,
    /// `last`: keep the last message of each matching transient-local writer in memory, for
    /// recordings that start later (`/tf_static`). Captures the matching topics.
    #[serde(default)]
    pub(super) retain: RetainShape,
    /// Minimum rate, in messages per second.
    #[schemars(range(min = 0.0, max = 1_000_000.0))]
    pub(super) min_rate_hz: Option<f64>,
    /// Maximum rate, in messages per second.
    #[schemars(range(min = 0.0, max = 1_000_000.0))]
    pub(super) max_rate_hz: Option<f64>,
    /// Window of `min_rate_hz` and `max_rate_hz`, in whole seconds, for a rate that varies from
    /// second to second. Default: the shortest window with at least three expected messages.
    #[schemars(range(min = 1, max = 10))]
    pub(super) window_s: Option<u32>,
    /// Maximum fraction of lost messages, 0 to 1.
    #[schemars(range(min = 0.0, max = 1.0))]
    pub(super) max_loss_ratio: Option<f64>,
    /// Maximum time from the writer's timestamp to the wire, in milliseconds.
    #[schemars(range(min = 0.0, max = 3_600_000.0))]
    pub(super) max_latency_ms: Option<f64>,
    /// Maximum time without a message, in seconds.
    #[schemars(range(min = 0.001, max = 604_800.0))]
    pub(super) max_silence_s: Option<f64>,
    /// Minimum number of publishers, checked from 10 s after the first one.
    #[schemars(range(min = 1, max = 10_000))]
    pub(super) publishers: Option<u32>,
    /// Minimum number of subscribers, checked from 10 s after the first publisher.
    #[schemars(range(min = 1, max = 10_000))]
    pub(super) subscribers: Option<u32>,
}

/// A chain of messages from a sensor's topic to an actuator's.
#[derive(Debug, Deserialize, JsonSchema)]
#[schemars(inline)]
#[serde(deny_unknown_fields)]
pub(super) struct ChainShape {
    /// ROS name of the first topic.
    pub(super) from: String,
    /// ROS name of the last topic.
    pub(super) to: String,
    /// Only in this domain; default: every domain.
    #[schemars(range(min = 0, max = 232))]
    pub(super) domain: Option<u32>,
    /// Maximum time from the publication on the first topic to that on the last, in milliseconds.
    #[schemars(range(min = 0.001, max = 5000.0))]
    pub(super) max_latency_ms: Option<f64>,
}

/// Messages of a topic kept for recordings that start later.
#[derive(Clone, Copy, Debug, Default, Serialize, Deserialize, JsonSchema)]
#[schemars(rename = "Retain")]
#[serde(rename_all = "lowercase")]
pub(super) enum RetainShape {
    /// No message.
    #[default]
    None,
    /// The last message of each transient-local writer.
    Last,
}

/// Sources of packets.
#[derive(Debug, Deserialize, JsonSchema)]
#[schemars(inline)]
#[serde(deny_unknown_fields, default)]
pub(super) struct CaptureShape {
    /// Where packets are captured: at the sockets of this host, or on its interfaces.
    pub(super) source: SourceChoice,
    /// How interfaces are observed. `tcx`: by programs at the interfaces, from Linux 6.6 on; `packet`:
    /// by a packet socket, which costs large messages more; `auto`: `tcx` where the kernel has it.
    pub(super) wire: WireChoice,
    /// Only the sockets of this cgroup (v2) and those below it, by absolute path; default: every
    /// socket of the host. Not with `source: wire`.
    pub(super) cgroup: Option<String>,
    /// Interfaces (names or globs) that are observed in addition to the host's sockets, for traffic
    /// that no local socket receives: a mirror port, a gateway. Not with `source: wire`.
    pub(super) mirror_interfaces: Option<Vec<String>>,
    /// Interfaces that are observed with `source: wire`. Any entry excludes `source: host`.
    pub(super) interfaces: Option<InterfacesShape>,
    /// Further network namespaces for `source: wire`, by path (`/run/netns/robot`). Needs
    /// CAP_SYS_ADMIN. `source: host` covers all of them.
    pub(super) network_namespaces: Option<Vec<String>>,
    /// Packet ring of each network namespace, in bytes. The ring for messages that processes write
    /// to shared memory is 4 times as large, up to 16 MiB.
    #[schemars(range(min = 262_144, max = 1_073_741_824))]
    pub(super) ring_bytes: usize,
    /// Ring for measurement records from the kernel filter, in bytes.
    #[schemars(range(min = 65_536, max = 1_073_741_824))]
    pub(super) record_ring_bytes: usize,
    /// Messages in Fast DDS's shared memory between processes of one host.
    pub(super) shm: Option<ShmShape>,
    /// Calls inside ROS processes, by kernel breakpoints in their library `libtracetools.so`,
    /// whatever their middleware. `topics`: messages published and taken, also within a process;
    /// `full`: also callbacks, timers and lifecycle transitions; `auto`: as `full`, while a client
    /// needs calls. Each observed call costs the process some microseconds.
    pub(super) inside: InsideChoice,
    /// Causes of late callbacks, where callbacks are observed: who ran instead, and for what a
    /// callback waited. `on`: by the events of the kernel's scheduler, as long as calls are observed;
    /// `auto`: only while a client requests causes, and for a minute after a violated expectation or
    /// a slow chain; `off`: late calls are not reported.
    pub(super) late: LateChoice,
    /// Socket of the process that attaches breakpoints (`rp attach`). Without a socket there, an
    /// agent with the privileges starts one of its own.
    pub(super) broker: String,
    /// Connections of Zenoh (rmw_zenoh).
    pub(super) zenoh: Option<ZenohShape>,
}

/// Settings of Zenoh's connections.
#[derive(Debug, Deserialize, JsonSchema)]
#[schemars(inline)]
#[serde(deny_unknown_fields, default)]
pub(super) struct ZenohShape {
    /// Ports of Zenoh, TCP and QUIC, at most 8: of routers, and of sessions that listen on a fixed
    /// port. Connections are recognized on any TCP port. On these ports, unreadable connections are
    /// reported, too.
    #[schemars(length(max = 8), inner(range(min = 1, max = 65_535)))]
    pub(super) ports: Vec<u16>,
}

/// Settings of shared memory, which the agent only reads.
#[derive(Debug, Deserialize, JsonSchema)]
#[schemars(inline)]
#[serde(deny_unknown_fields, default)]
pub(super) struct ShmShape {
    /// `auto`: read it if it exists; `off`: never.
    pub(super) mode: ShmMode,
    /// `auto`: read every message while a command records, echoes or measures a topic in shared
    /// memory. Kernel breakpoints in all processes that use Fast DDS report the messages. If
    /// breakpoints are impossible, shared memory is sampled. `uprobe`: the same, always; `off`:
    /// never.
    pub(super) exact: ExactChoice,
    /// Share of one CPU for polling, in percent; briefly exceeded while participants discover each
    /// other. With a lower share, fewer messages are read, but all are counted.
    #[schemars(range(min = 0.1, max = 100))]
    pub(super) cpu_percent: f64,
    /// Share of one CPU for polling, in percent, while messages of a topic in shared memory are
    /// recorded, echoed, retained or measured. These uses need frequent polls.
    #[schemars(range(min = 0.1, max = 100))]
    pub(super) reading_cpu_percent: f64,
}

/// Interface names or globs (`eth*`).
#[derive(Debug, Default, Deserialize, JsonSchema)]
#[schemars(inline)]
#[serde(deny_unknown_fields, default)]
pub(super) struct InterfacesShape {
    /// Observe only these; default: all.
    pub(super) include: Option<Vec<String>>,
    /// Never observe these.
    pub(super) exclude: Option<Vec<String>>,
}

/// The metrics listener.
#[derive(Debug, Deserialize, JsonSchema)]
#[schemars(inline)]
#[serde(deny_unknown_fields, default)]
pub(super) struct MetricsShape {
    /// `address:port` of `/metrics`, `/healthz` and `/readyz`, or `off`.
    pub(super) listen: String,
    /// Histograms of inter-arrival time and of latency with its parts, for watched topics. Applied
    /// on reload.
    pub(super) histograms: bool,
    /// Series per writer of watched topics, in addition to those per topic. Applied on reload.
    pub(super) per_writer: bool,
    /// File with the permitted users and the certificate of the listener, in the format of
    /// exporter-toolkit's web.yml: `basic_auth_users` and `tls_server_config`.
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
    /// Additional unix socket, for members of its group: a path, `off` or `auto`. `auto` is
    /// api.sock in `$RUNTIME_DIRECTORY` as set by the service manager, else in /run/ros2probe if
    /// that exists.
    pub(super) socket: String,
    /// Rights of clients without a token at a loopback `listen`; any user of this host can be such
    /// a client. `read`: graph, figures and events; `watch`: also add watches; `all`: also message
    /// payloads, recordings, snapshots and reloads. The unix socket and a token always grant all.
    pub(super) loopback: Access,
    /// File with the bearer token that clients of `listen` must send, for example from the service
    /// manager's LoadCredential=.
    pub(super) token_file: Option<String>,
    /// Whether `listen` also serves the web page, at `/`.
    pub(super) page: PageChoice,
}

/// The WebSocket server for viewers. Clients have the rights of `api.loopback`, or all with the
/// token of `api.token_file` or of `rp foxglove` in the address (`?token=`).
#[derive(Debug, Deserialize, JsonSchema)]
#[schemars(inline)]
#[serde(deny_unknown_fields, default)]
pub(super) struct FoxgloveShape {
    /// IP address and port to listen on, or `off`. Any address but a loopback one needs
    /// `api.token_file`.
    pub(super) listen: String,
    /// Origins of web pages that may connect without a token, as in `https://app.foxglove.dev`;
    /// `file://` for desktop applications. Pages of this host may always connect.
    pub(super) origins: Option<Vec<String>>,
}

/// `on`, `off`, or a map with the distribution.
#[derive(Clone, Copy, Debug, Deserialize, JsonSchema)]
#[schemars(inline)]
#[serde(untagged)]
pub(super) enum Ros2DaemonShape {
    /// On or off.
    Choice(Switch),
    /// On or off, with the distribution.
    Settings(Ros2DaemonSettingsShape),
}

/// The ros2 daemon with the distribution of its clients.
#[derive(Clone, Copy, Debug, Deserialize, JsonSchema)]
#[schemars(inline)]
#[serde(deny_unknown_fields)]
pub(super) struct Ros2DaemonSettingsShape {
    /// Whether the agent answers.
    #[serde(default = "defaults::ros2_daemon_in_a_map")]
    pub(super) enabled: Switch,
    /// Distribution of the clients whose process the agent cannot inspect; default: guessed from
    /// their Python release and from the robot.
    pub(super) distro: Option<DistroShape>,
}

/// On or off.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Deserialize, JsonSchema)]
#[schemars(rename = "Switch")]
#[serde(rename_all = "lowercase")]
pub(super) enum Switch {
    /// Enabled.
    On,
    /// Disabled.
    #[default]
    Off,
}

/// A level of a node's log.
#[derive(Clone, Copy, Debug, Deserialize, JsonSchema)]
#[schemars(rename = "LogLevel")]
#[serde(rename_all = "lowercase")]
pub(super) enum LogLevelShape {
    /// All messages.
    Debug,
    /// Without those of `debug`.
    Info,
    /// `warn`, `error` and `fatal`.
    Warn,
    /// `error` and `fatal`.
    Error,
    /// Only `fatal`.
    Fatal,
}

/// A ROS distribution.
#[derive(Clone, Copy, Debug, Deserialize, JsonSchema)]
#[schemars(rename = "Distro")]
#[serde(rename_all = "lowercase")]
pub(super) enum DistroShape {
    /// Humble.
    Humble,
    /// Iron, which writes endpoints as Jazzy does.
    Iron,
    /// Jazzy.
    Jazzy,
    /// Kilted.
    Kilted,
    /// Lyrical.
    Lyrical,
    /// Rolling, which writes endpoints as Lyrical does.
    Rolling,
}

impl From<DistroShape> for Dialect {
    fn from(shape: DistroShape) -> Self {
        match shape {
            DistroShape::Humble => Self::Humble,
            DistroShape::Iron | DistroShape::Jazzy => Self::Jazzy,
            DistroShape::Kilted => Self::Kilted,
            DistroShape::Lyrical | DistroShape::Rolling => Self::Rolling,
        }
    }
}

impl Default for Ros2DaemonShape {
    fn default() -> Self {
        Self::Choice(Switch::default())
    }
}

/// What the robot itself says.
#[derive(Debug, Deserialize, JsonSchema)]
#[schemars(inline)]
#[serde(deny_unknown_fields, default)]
pub(super) struct RobotShape {
    /// Logs of nodes (`/rosout`): counts by node and level, the latest messages, and bursts of
    /// errors as findings.
    pub(super) logs: Switch,
    /// Diagnostics (`/diagnostics`): the level of each part of the robot, and those in error as
    /// findings.
    pub(super) diagnostics: Switch,
    /// Values in diagnostics that have a metric: patterns of name, slash and key, as in
    /// `battery*/Voltage*`; `*` matches any characters. Applied on reload.
    #[schemars(length(max = 64))]
    pub(super) diagnostic_values: Option<Vec<String>>,
    /// Parameters of nodes (`/parameter_events`): last known values, changes, and who requested
    /// them.
    pub(super) parameters: Switch,
    /// Values that parameters should have; other values are findings. `rp learn --parameters` writes
    /// such a list.
    #[schemars(length(max = 1024))]
    pub(super) parameters_expected: Option<Vec<ExpectedParameterShape>>,
    /// States of managed nodes (`transition_event`), and failed transitions as findings.
    pub(super) lifecycle: Switch,
    /// Names of managed nodes that should be active; `*` matches any characters. Another state for
    /// 5 s is a finding.
    #[schemars(length(max = 64))]
    pub(super) active: Option<Vec<String>>,
    /// Fields of messages that have a metric: those of batteries, and those of `extract`.
    pub(super) fields: Switch,
    /// Fields of further messages that have a metric.
    #[schemars(length(max = 64))]
    pub(super) extract: Option<Vec<ExtractionShape>>,
    /// Transforms (`/tf`, `/tf_static`): trees of frames, their broadcasters, and faults.
    pub(super) transforms: Switch,
    /// Offsets between the clocks of hosts, from stamps, replies and acknowledgements.
    pub(super) clocks: Switch,
}

impl Default for RobotShape {
    fn default() -> Self {
        Self {
            logs: Switch::On,
            diagnostics: Switch::On,
            diagnostic_values: None,
            parameters: Switch::On,
            parameters_expected: None,
            lifecycle: Switch::On,
            active: None,
            fields: Switch::On,
            extract: None,
            transforms: Switch::On,
            clocks: Switch::On,
        }
    }
}

/// A parameter and the value that it should have.
#[derive(Debug, Deserialize, JsonSchema)]
#[schemars(inline)]
#[serde(deny_unknown_fields)]
pub(super) struct ExpectedParameterShape {
    /// Fully qualified name of the node, in any domain.
    pub(super) node: String,
    /// Name of the parameter.
    pub(super) name: String,
    /// Value as YAML, in quotes, as `rp param dump` prints it: `"0.5"`.
    pub(super) value: String,
}

/// A field of the messages of a topic, and its metric.
#[derive(Debug, Deserialize, JsonSchema)]
#[schemars(inline)]
#[serde(deny_unknown_fields)]
pub(super) struct ExtractionShape {
    /// ROS name of the topic. The messages may have up to 64 KiB.
    pub(super) topic: String,
    /// A number or boolean in the messages: names with dots, and indices, as in
    /// `cells[0].voltage`.
    pub(super) field: String,
    /// Name of the metric, a gauge with the labels `domain_id` and `topic`.
    pub(super) metric: String,
}

/// The web page; `api.page` disables it.
#[derive(Debug, Deserialize, JsonSchema)]
#[schemars(inline)]
#[serde(deny_unknown_fields, default)]
pub(super) struct PageShape {
    /// Seconds of figures kept per measured topic, for charts; 0 = none. They use at most 6 MiB:
    /// with more than 436 topics, fewer seconds are kept. At least 120 with `history_bytes`, which
    /// is written once a minute.
    #[schemars(range(min = 0, max = 3_600))]
    pub(super) history_s: u32,
    /// Maximum size of the history of the last days in `state_directory`, in bytes; 0 = none. It
    /// has one row per second of each measured topic, older ones per ten seconds, and needs
    /// `history_s`.
    #[schemars(range(min = 0, max = 1_099_511_627_776_u64))]
    pub(super) history_bytes: u64,
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
            history_bytes: defaults::HISTORY_BYTES,
        }
    }
}

impl Default for FoxgloveShape {
    fn default() -> Self {
        Self {
            listen: defaults::FOXGLOVE.to_owned(),
            origins: None,
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

/// Bags written by the agent.
#[derive(Debug, Deserialize, JsonSchema)]
#[schemars(inline)]
#[serde(deny_unknown_fields, default)]
pub(super) struct RecordingsShape {
    /// Directory of the bags: an absolute path, `off`, or `auto`: `recordings` in the state
    /// directory.
    pub(super) directory: String,
    /// Maximum size of a recording in bytes; it then ends with the reason. Default: no limit.
    #[schemars(range(min = 65_536))]
    pub(super) max_bytes: Option<u64>,
    /// Maximum size of all bags in the directory in bytes; recordings then end. Default: no limit.
    #[schemars(range(min = 65_536))]
    pub(super) max_total_bytes: Option<u64>,
    /// Share of the file system that recordings leave free, in percent.
    #[schemars(range(min = 0, max = 99))]
    pub(super) reserve_percent: u8,
    /// Bytes of the file system that recordings leave free; the larger of both reserves applies.
    #[schemars(range(min = 0, max = 1_099_511_627_776_u64))]
    pub(super) reserve_bytes: u64,
    /// Topics whose last seconds are kept in memory, and written on an incident.
    pub(super) snapshots: Option<Vec<SnapshotShape>>,
}

/// The last seconds of some topics.
#[derive(Debug, Deserialize, JsonSchema)]
#[schemars(inline)]
#[serde(deny_unknown_fields)]
pub(super) struct SnapshotShape {
    /// Prefix of the names of the snapshot's bags.
    #[schemars(regex(pattern = r"^[A-Za-z0-9_-]{1,64}$"))]
    pub(super) name: String,
    /// ROS names or globs.
    pub(super) topics: Vec<String>,
    /// Domain of the topics.
    #[schemars(range(min = 0, max = 232))]
    #[serde(default)]
    pub(super) domain: u32,
    /// Seconds before a trigger.
    #[schemars(range(min = 1, max = 600))]
    #[serde(default = "defaults::snapshot_seconds")]
    pub(super) seconds: u64,
    /// Seconds after a trigger; their messages are written as they arrive, and need no memory.
    #[schemars(range(min = 0, max = 600))]
    #[serde(default)]
    pub(super) seconds_after: u64,
    /// Maximum memory in bytes; messages that do not fit are counted.
    #[schemars(range(min = 65_536, max = 4_294_967_296_u64))]
    #[serde(default = "defaults::snapshot_bytes")]
    pub(super) max_bytes: usize,
    /// Events that write a bag: `expectation`, `message_lost`, `participant_lost`, a kind of
    /// finding such as `qos_incompatible`, or an event's name. Default: `[expectation]`.
    #[schemars(length(max = 32))]
    pub(super) trigger: Option<Vec<String>>,
    /// Minimum seconds between two triggered bags. Default: `seconds` and `seconds_after`, at least
    /// 10.
    #[schemars(range(min = 0, max = 86_400))]
    pub(super) min_interval_s: Option<u64>,
    /// Maximum number of triggered bags; the oldest is removed first.
    #[schemars(range(min = 1, max = 1000))]
    #[serde(default = "defaults::snapshot_count")]
    pub(super) max_count: usize,
    /// Maximum size of all bags of the snapshot, in bytes; the oldest triggered bag is removed
    /// first.
    #[schemars(range(min = 65_536))]
    #[serde(default = "defaults::snapshot_total_bytes")]
    pub(super) max_total_bytes: u64,
    /// Earlier form of `trigger`: `false` means `[]`, and `true` means `[expectation]`.
    pub(super) on_violation: Option<bool>,
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
    /// URL of the receiver, e.g. `http://collector:4317`, or `off`. By default
    /// `OTEL_EXPORTER_OTLP_ENDPOINT` and the variables of single signals apply; without them
    /// nothing is exported.
    pub(super) endpoint: Option<String>,
    /// Interval between exports of metrics, in seconds; default 15.
    #[schemars(range(min = 1, max = 3_600))]
    pub(super) interval_s: Option<u64>,
    /// Timeout for the receiver's answer, in seconds; default 10.
    #[schemars(range(min = 1, max = 300))]
    pub(super) timeout_s: Option<u64>,
    /// Headers of each request: names and values. Put secrets into headers_file.
    pub(super) headers: Option<BTreeMap<String, String>>,
    /// Absolute path of a file with one `name: value` per line.
    pub(super) headers_file: Option<String>,
    /// `grpc`, the default, or `http/protobuf`, which appends `/v1/metrics` and the like to the
    /// endpoint.
    pub(super) protocol: Option<OtlpProtocol>,
    /// `none`, or `gzip` for slow links.
    pub(super) compression: Option<Compression>,
    /// Whether metrics are exported.
    pub(super) metrics: Option<bool>,
    /// Whether events are exported, as log records.
    pub(super) events: Option<bool>,
    /// Whether spans are exported, for watches with `trace` and for `late_calls`.
    pub(super) traces: Option<bool>,
    /// Whether late calls of callbacks are exported as spans, with their stages; default false.
    pub(super) late_calls: Option<bool>,
    /// Minimum severity of lines of the agent's own log that are exported, e.g. `warn`. By default
    /// no line is exported.
    pub(super) log: Option<Level>,
    /// Minimum level of messages of nodes' logs (`/rosout`) that are exported as log records, e.g.
    /// `warn`. By default no message is exported. It needs `robot.logs`.
    pub(super) node_logs: Option<LogLevelShape>,
    /// Name of this robot: the attribute `robot.name` of all exports.
    pub(super) robot: Option<String>,
    /// Additional attributes of the resource, names and values.
    pub(super) attributes: Option<BTreeMap<String, String>>,
    /// Maximum size of the events that wait in `state_directory` while the receiver is out of reach,
    /// in bytes, and of spans, lines and messages each; 0 = none, default 33554432, at least 1048576.
    /// The oldest are dropped if it is full.
    #[schemars(range(min = 0, max = 1_099_511_627_776_u64))]
    pub(super) queue_bytes: Option<u64>,
}

/// Push to a receiver of Prometheus remote write.
#[derive(Debug, Default, Deserialize, JsonSchema)]
#[schemars(inline)]
#[serde(deny_unknown_fields, default)]
pub(super) struct RemoteWriteShape {
    /// URL of the receiver, e.g. `https://prometheus.example/api/v1/write`. Without it, nothing is
    /// sent.
    pub(super) url: Option<String>,
    /// Interval between samples, in seconds; default 5, as the dashboards expect.
    #[schemars(range(min = 1, max = 3_600))]
    pub(super) interval_s: Option<u64>,
    /// Timeout for the receiver's answer, in seconds; default 30.
    #[schemars(range(min = 1, max = 300))]
    pub(super) timeout_s: Option<u64>,
    /// Name of this robot: the label `instance`; default: the name of the host.
    pub(super) instance: Option<String>,
    /// Additional labels of all series, names and values.
    pub(super) labels: Option<BTreeMap<String, String>>,
    /// Additional headers of each request. Put secrets into token_file.
    pub(super) headers: Option<BTreeMap<String, String>>,
    /// Absolute path of a file with a bearer token. A replaced file applies to the next request.
    pub(super) token_file: Option<String>,
    /// Absolute path of a PEM file with the certificate authorities that may sign the receiver's
    /// certificate; default: those of the system.
    pub(super) ca_file: Option<String>,
    /// Absolute path of a PEM file with the certificate of this robot. A replaced file applies to
    /// the next request.
    pub(super) certificate_file: Option<String>,
    /// Absolute path of a PEM file with the key of that certificate.
    pub(super) key_file: Option<String>,
    /// Maximum size of the samples that wait in `state_directory`, in bytes; 0 = none, default
    /// 268435456. The oldest samples are dropped if it is full.
    #[schemars(range(min = 0, max = 1_099_511_627_776_u64))]
    pub(super) queue_bytes: Option<u64>,
    /// Maximum number of bytes of requests per second; by default they have no limit.
    #[schemars(range(min = 1_000, max = 1_000_000_000))]
    pub(super) max_bytes_per_second: Option<u64>,
    /// Maximum number of series that begin in an hour; 0 = no limit, default 50000. Samples of
    /// further ones are omitted, so that names with a UUID do not exhaust the receiver.
    #[schemars(range(min = 0, max = 1_000_000))]
    pub(super) max_new_series_per_hour: Option<u64>,
}

/// Delivery of finished bags by `rp ship`, a program of its own.
#[derive(Debug, Default, Deserialize, JsonSchema)]
#[schemars(inline)]
#[serde(deny_unknown_fields, default)]
pub(super) struct ShipShape {
    /// Destination: `s3://BUCKET/PREFIX`, `gs://BUCKET/PREFIX`, `az://CONTAINER/PREFIX` or
    /// `file:///DIRECTORY`. Without it, nothing is delivered. With it, the agent deletes no bag
    /// that was not delivered.
    pub(super) url: Option<String>,
    /// Address of a store other than that of the provider, e.g. `https://minio.example:9000`.
    pub(super) endpoint: Option<String>,
    /// Region of the bucket.
    pub(super) region: Option<String>,
    /// Name of this robot, a directory at the destination; default: `remote_write.instance`, then
    /// `otlp.robot`, then the name of the host.
    pub(super) instance: Option<String>,
    /// Absolute path of a file with credentials: lines NAME=value, with the names of the
    /// provider's environment variables. A replaced file applies to the next request.
    pub(super) credentials_file: Option<String>,
    /// Absolute path of a PEM file with the certificate authorities that may sign the store's
    /// certificate; default: those of the system.
    pub(super) ca_file: Option<String>,
    /// Maximum number of bytes of requests per second; by default they have no limit.
    #[schemars(range(min = 1_000, max = 1_000_000_000))]
    pub(super) max_bytes_per_second: Option<u64>,
    /// Times of the day in which bags are delivered, in local time, e.g. `22:00-06:00`; default:
    /// at any time.
    pub(super) windows: Option<Vec<String>>,
    /// Whether bags of snapshots are delivered outside the windows too.
    pub(super) triggered_always: bool,
}

/// The view of a fleet on the page (`/fleet`). The agent queries the engine only while a
/// browser has the view open.
#[derive(Debug, Default, Deserialize, JsonSchema)]
#[schemars(inline)]
#[serde(deny_unknown_fields, default)]
pub(super) struct FleetShape {
    /// URL of Prometheus, VictoriaMetrics, Mimir or Thanos, without the path of its API, e.g.
    /// `https://prometheus.example:9090`. Without it, the page has no view of a fleet.
    pub(super) engine: Option<String>,
    /// Absolute path of a file with a bearer token for the engine.
    pub(super) token_file: Option<String>,
    /// Value of the label `job` of the robots, `ros2probe` by default.
    pub(super) job: Option<String>,
    /// Hours for which a robot without samples is listed as out of reach, 24 by default.
    #[schemars(range(min = 1, max = 720))]
    pub(super) since_h: Option<u32>,
    /// Seconds without samples after which a robot is out of reach, 60 by default.
    #[schemars(range(min = 1, max = 86_400))]
    pub(super) reach_s: Option<u32>,
    /// Address of a robot's own page, with `{robot}` in place of its name, e.g.
    /// `http://{robot}.example:17401/`.
    pub(super) link: Option<String>,
    /// The store to which `rp ship` of the robots delivers: the view lists their incidents.
    pub(super) store: Option<FleetStoreShape>,
}

/// The store of the robots' bags, with the keys of `ship`.
#[derive(Debug, Default, Deserialize, JsonSchema)]
#[schemars(inline)]
#[serde(deny_unknown_fields, default)]
pub(super) struct FleetStoreShape {
    /// `s3://BUCKET/PREFIX`, `gs://BUCKET/PREFIX`, `az://CONTAINER/PREFIX` or `file:///DIRECTORY`.
    pub(super) url: Option<String>,
    /// Address of a store other than that of the provider, e.g. `https://minio.example:9000`.
    pub(super) endpoint: Option<String>,
    /// Region of the bucket.
    pub(super) region: Option<String>,
    /// Absolute path of a file with credentials that may list and read: lines NAME=value.
    pub(super) credentials_file: Option<String>,
    /// Absolute path of a PEM file with the certificate authorities that may sign the store's
    /// certificate; default: those of the system.
    pub(super) ca_file: Option<String>,
}

impl Default for CaptureShape {
    fn default() -> Self {
        Self {
            source: SourceChoice::default(),
            wire: WireChoice::default(),
            cgroup: None,
            mirror_interfaces: None,
            interfaces: None,
            network_namespaces: None,
            ring_bytes: defaults::RING_BYTES,
            record_ring_bytes: defaults::RECORD_RING_BYTES,
            shm: None,
            inside: InsideChoice::default(),
            late: LateChoice::default(),
            broker: defaults::BROKER.to_owned(),
            zenoh: None,
        }
    }
}

impl Default for ZenohShape {
    fn default() -> Self {
        Self {
            ports: vec![defaults::ZENOH_PORT],
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
