//! The configuration: first the YAML shape, then its meaning. All mistakes are reported with their
//! positions.
//!
//! Nothing is bound, opened or read from the environment here.

mod check;
mod document;
mod limits;
mod meaning;
mod mistake;
mod readable_tokens;
mod shape;
mod text;

use std::collections::BTreeSet;
use std::io;
use std::net::SocketAddr;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;

use ros2probe_model::derive::robot::parameters::ExpectedParameter;
use ros2probe_model::derive::robot::{Parts, RobotExpectations};
use schemars::JsonSchema;
use serde::Deserialize;

use crate::events::Trigger;
use crate::fleet::{Link, Question};
pub use mistake::{Mistake, Mistakes, Position};
pub use readable_tokens::ReadableToken;
pub use ros2probe_capture::settings::{
    CaptureSettings, ExactChoice, InsideChoice, LateChoice, ShmMode, ShmSettings, SourceChoice,
    WireChoice,
};
use ros2probe_message::Dialect;
pub use ros2probe_metrics::otlp::{Compression, Endpoint, OtlpProtocol, OtlpSettings};
pub use ros2probe_metrics::remote_write::RemoteWriteSettings;
pub use ros2probe_model::derive::chain::expected::ExpectedChain;
pub use ros2probe_model::facts::glob;
pub use ros2probe_model::facts::limits::{Limit, Limits};
pub use ros2probe_model::facts::loss_share::LossShare;
pub use ros2probe_model::facts::watch::{
    self, Expectations, ManyGlobs, PatternError, Retain, Watch, Watchlist, check_globs,
    check_pattern,
};
pub use ros2probe_model::measure::rehearsal;
pub use ros2probe_ship::{StoreSettings, Windows};
use tracing_subscriber::filter::LevelFilter;

/// Maximum number of parameters that should have a value.
pub const MAX_PARAMETERS: usize = 1024;
/// Maximum size of the file, in bytes.
const MAX_BYTES: u64 = 1 << 20;

/// A field of the messages of a topic, and its metric.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Extraction {
    /// ROS name of the topic.
    pub topic: String,
    /// The field: names with dots, and indices.
    pub field: String,
    /// Name of the metric.
    pub metric: String,
}

/// The checked configuration.
#[derive(Clone, Debug, PartialEq)]
pub struct Config {
    /// Topics to measure, in file order.
    pub watches: Vec<Watch>,
    /// Chains with a limit for their latency, in file order.
    pub chains: Vec<ExpectedChain>,
    /// Caps of the agent's tables.
    pub limits: Limits,
    /// Sources of packets.
    pub capture: CaptureSettings,
    /// The metrics surface.
    pub metrics: MetricsSettings,
    /// The control API.
    pub api: ApiSettings,
    /// The WebSocket server for Foxglove and other viewers.
    pub foxglove: FoxgloveSettings,
    /// Whether the agent answers as the daemon of the `ros2` command line.
    pub ros2_daemon: Ros2DaemonSettings,
    /// Time for which figures of measured topics are kept for charts; zero = none.
    pub history: Duration,
    /// Maximum size of the history on disk, in bytes; zero = none.
    pub history_bytes: u64,
    /// Exports to an OpenTelemetry receiver.
    pub otlp: OtlpSettings,
    /// Delivery to a receiver of Prometheus remote write.
    pub remote_write: RemoteWriteSettings,
    /// Recordings of the agent.
    pub recordings: RecordingSettings,
    /// Delivery of bags by `rp ship`.
    pub ship: ShipSettings,
    /// The view of a fleet.
    pub fleet: FleetSettings,
    /// Time for which a topic without endpoints is still reported.
    pub topic_grace: Duration,
    /// Time without a reply after which a call of a service is reported as hanging.
    pub service_timeout: Duration,
    /// Last messages that are kept.
    pub retain: RetainChoice,
    /// What the agent reads of what the robot says.
    pub robot: Parts,
    /// Patterns of the names of managed nodes that should be active.
    pub active_nodes: Vec<String>,
    /// Parameters that should have a value.
    pub expected_parameters: Vec<ExpectedParameter>,
    /// Fields of messages with a metric.
    pub extractions: Vec<Extraction>,
    /// Values of diagnostics with a metric: patterns of name, slash and key.
    pub diagnostic_values: Vec<String>,
    /// Directory of the saved discovery state.
    pub state_directory: StateChoice,
    /// Path or address of the feed of releases, for `rp upgrade --check`.
    pub upgrade_feed: Option<String>,
    /// Minimum severity that is logged.
    pub log: Level,
}

/// Rights of a client of the control API; each level includes those before it.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum Access {
    /// Read the graph, figures, events, and the watched topics.
    Read,
    /// Also add and remove watches, and follow messages without their bytes.
    #[default]
    Watch,
    /// Also message payloads, recordings, snapshots and reloads.
    All,
}

impl Access {
    /// Returns its name in the configuration and on the command line.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::Read => "read",
            Self::Watch => "watch",
            Self::All => "all",
        }
    }
}

impl std::fmt::Display for Access {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(self.name())
    }
}

/// Whether the page is served.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum PageChoice {
    /// Serve the page beside the API.
    #[default]
    On,
    /// Do not serve the page.
    Off,
}

/// Last messages that are kept for clients that begin later.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum RetainChoice {
    /// Messages of up to 1 MiB of each transient-local writer, and larger ones of watches with
    /// `retain: last`; 16 MiB in total.
    #[default]
    Latched,
    /// Only messages of watches with `retain: last`.
    Off,
}

/// Directory of the saved state.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub enum StateChoice {
    /// The service manager's directory (`$STATE_DIRECTORY`), else the default one if it is usable.
    #[default]
    Auto,
    /// No state is saved.
    Off,
    /// This directory.
    At(PathBuf),
}

/// The metrics listener and its content.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct MetricsSettings {
    /// Address to listen on; `None` = off.
    pub listen: Option<SocketAddr>,
    /// Whether watched topics have histograms.
    pub histograms: bool,
    /// Whether watched topics have series per writer.
    pub per_writer: bool,
    /// File with permitted users and TLS settings.
    pub web_config: Option<PathBuf>,
}

/// The control API.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ApiSettings {
    /// Address to listen on; `None` = off.
    pub listen: Option<SocketAddr>,
    /// Additional unix socket.
    pub socket: SocketChoice,
    /// Rights of loopback clients without a token.
    pub loopback: Access,
    /// File with the bearer token that clients on the network address must send.
    pub token_file: Option<PathBuf>,
    /// Whether the page is served at `listen`.
    pub page: PageChoice,
}

/// The WebSocket server for viewers. Its rights and token are those of the control API.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct FoxgloveSettings {
    /// Address to listen on; `None` = off.
    pub listen: Option<SocketAddr>,
    /// Origins of web pages that may connect without a token, besides those of this host.
    pub origins: Vec<String>,
}

/// The daemon of the `ros2` command line.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Ros2DaemonSettings {
    /// Whether the agent answers in place of that daemon.
    pub is_on: bool,
    /// Distribution of the clients whose process cannot be inspected; `None` = guessed.
    pub distro: Option<Dialect>,
}

/// Unix socket of the control API.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub enum SocketChoice {
    /// In the service manager's directory (`$RUNTIME_DIRECTORY`), else in the default one if it
    /// exists.
    #[default]
    Auto,
    /// No socket.
    Off,
    /// At this path.
    At(PathBuf),
}

/// Recordings of the agent.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct RecordingSettings {
    /// Directory of the bags.
    pub directory: StateChoice,
    /// Topics whose last seconds are kept in memory.
    pub snapshots: Vec<SnapshotSettings>,
    /// Limits of disk usage.
    pub limits: RecordingLimits,
}

/// Limits of the bags' disk usage.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct RecordingLimits {
    /// Bytes per bag; `None` = no limit.
    pub max_bytes: Option<u64>,
    /// Bytes of all bags in the directory; `None` = no limit.
    pub max_total_bytes: Option<u64>,
    /// Percentage of the file system that stays free; the larger of it and `reserve_bytes` applies.
    pub reserve_percent: u8,
    /// Bytes of the file system that stay free.
    pub reserve_bytes: u64,
}

impl Default for RecordingLimits {
    fn default() -> Self {
        Self {
            max_bytes: None,
            max_total_bytes: None,
            reserve_percent: 5,
            reserve_bytes: 512 << 20,
        }
    }
}

impl RecordingSettings {
    /// Returns whether the bags are in the directory of saved state.
    #[must_use]
    pub fn is_in_state_directory(&self, state: &StateChoice) -> bool {
        self.directory == StateChoice::Auto && *state != StateChoice::Off
    }
}

/// Delivery of bags by `rp ship`.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct ShipSettings {
    /// Destination; `None` = bags stay on the robot.
    pub url: Option<String>,
    /// Address of a store other than that of the provider.
    pub endpoint: Option<String>,
    /// Region of the bucket.
    pub region: Option<String>,
    /// Name of this robot.
    pub instance: Option<String>,
    /// File with credentials.
    pub credentials_file: Option<PathBuf>,
    /// File with certificate authorities.
    pub ca_file: Option<PathBuf>,
    /// Maximum number of bytes of requests per second.
    pub max_bytes_per_second: Option<u64>,
    /// Times of the day in which bags are delivered.
    pub windows: Windows,
    /// Whether bags of snapshots are delivered outside the windows too.
    pub triggered_always: bool,
}

/// The view of a fleet.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct FleetSettings {
    /// URL of the engine; `None` = no view.
    pub engine: Option<String>,
    /// File with a bearer token for the engine.
    pub token_file: Option<PathBuf>,
    /// The robots.
    pub question: Question,
    /// Address of a robot's own page.
    pub link: Option<Link>,
    /// Store of the robots' bags.
    pub store: Option<StoreSettings>,
}

/// A snapshot: the last seconds of some topics.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct SnapshotSettings {
    /// Prefix of the names of its bags.
    pub name: String,
    /// Names and globs of topics.
    pub topics: Vec<String>,
    /// Domain of the topics.
    pub domain_id: u32,
    /// Time span before a trigger.
    pub before: Duration,
    /// Time span after a trigger.
    pub after: Duration,
    /// Maximum memory in bytes.
    pub max_bytes: usize,
    /// Events that write a bag.
    pub triggers: Vec<Trigger>,
    /// Minimum time between two triggered bags.
    pub min_interval: Duration,
    /// Maximum number of triggered bags.
    pub max_count: usize,
    /// Maximum size of all its bags, in bytes.
    pub max_total_bytes: u64,
}

/// Level of the log.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum Level {
    /// Only failures.
    Error,
    /// Also impending failures.
    Warn,
    /// Also changes of state.
    #[default]
    Info,
    /// Also their causes.
    Debug,
    /// Everything.
    Trace,
}

/// Why the configuration cannot be loaded.
#[derive(Debug, thiserror::Error)]
pub enum ConfigError {
    /// The file cannot be read.
    #[error("cannot read the configuration {}", path.display())]
    Read {
        /// Path of the file.
        path: PathBuf,
        /// Cause of the failure.
        source: io::Error,
    },
    /// The file is too large.
    #[error("the configuration {} is larger than 1 MiB", path.display())]
    TooLarge {
        /// Path of the file.
        path: PathBuf,
    },
    /// The file has mistakes; one line per mistake.
    #[error("{}", mistakes.report(&path.display().to_string()))]
    Invalid {
        /// Path of the file.
        path: PathBuf,
        /// All mistakes.
        mistakes: Mistakes,
    },
    /// The file is for the view of a fleet, and names no engine.
    #[error("{} has no `fleet.engine`, to which the robots of the fleet deliver", path.display())]
    NoEngine {
        /// Path of the file.
        path: PathBuf,
    },
}

impl FleetSettings {
    /// Reads the section `fleet` of a file.
    ///
    /// # Errors
    /// Fails as [`Config::load`] does, and if the section names no engine.
    pub fn load(path: &Path) -> Result<Self, ConfigError> {
        let settings = Config::load(path)?.fleet;
        if settings.engine.is_none() {
            return Err(ConfigError::NoEngine { path: path.into() });
        }
        Ok(settings)
    }
}

impl Config {
    /// Reads and checks a file.
    ///
    /// # Errors
    /// Fails if the file cannot be read. If the file has mistakes, the error contains all of them.
    pub fn load(path: &Path) -> Result<Self, ConfigError> {
        let bytes = crate::file::read(path, MAX_BYTES).map_err(|source| ConfigError::Read {
            path: path.into(),
            source,
        })?;
        if bytes.len() as u64 > MAX_BYTES {
            return Err(ConfigError::TooLarge { path: path.into() });
        }
        Self::parse(&bytes).map_err(|mistakes| ConfigError::Invalid {
            path: path.into(),
            mistakes,
        })
    }

    /// Checks the content of a file.
    ///
    /// # Errors
    /// Returns all mistakes, in file order.
    pub fn parse(bytes: &[u8]) -> Result<Self, Mistakes> {
        meaning::parse(bytes)
    }

    /// Returns what the model compares the robot with.
    #[must_use]
    pub fn expectations(&self) -> RobotExpectations {
        let active = self.active_nodes.iter().map(|name| name.as_str().into());
        let fields = self.extractions.iter();
        let fields: BTreeSet<_> = fields.map(|each| each.topic.as_str().into()).collect();
        RobotExpectations {
            active: Arc::new(active.collect()),
            parameters: Arc::new(self.expected_parameters.clone()),
            fields: Arc::new(fields.into_iter().collect()),
        }
    }

    /// Returns the keys whose change in `new` takes effect only after a restart.
    #[must_use]
    pub fn needs_restart(&self, new: &Self) -> Vec<&'static str> {
        [
            ("chains", self.chains != new.chains),
            ("limits", self.limits != new.limits),
            ("capture", self.capture != new.capture),
            ("metrics.listen", self.metrics.listen != new.metrics.listen),
            (
                "metrics.web_config",
                self.metrics.web_config != new.metrics.web_config,
            ),
            ("api", self.api != new.api),
            ("foxglove", self.foxglove != new.foxglove),
            ("ros2_daemon", self.ros2_daemon != new.ros2_daemon),
            (
                "page",
                (self.history, self.history_bytes) != (new.history, new.history_bytes),
            ),
            ("otlp", self.otlp != new.otlp),
            ("remote_write", self.remote_write != new.remote_write),
            ("recordings", self.recordings != new.recordings),
            ("ship", self.ship != new.ship),
            ("topic_grace_s", self.topic_grace != new.topic_grace),
            ("retain", self.retain != new.retain),
            ("robot", self.robot != new.robot),
            ("robot.active", self.active_nodes != new.active_nodes),
            ("robot.extract", self.extractions != new.extractions),
            (
                "robot.parameters_expected",
                self.expected_parameters != new.expected_parameters,
            ),
            (
                "service_timeout_s",
                self.service_timeout != new.service_timeout,
            ),
            (
                "state_directory",
                self.state_directory != new.state_directory,
            ),
        ]
        .into_iter()
        .filter_map(|(key, changed)| changed.then_some(key))
        .collect()
    }

    /// Returns the JSON schema of the file.
    #[must_use]
    pub fn schema() -> serde_json::Value {
        schemars::schema_for!(shape::ConfigShape).to_value()
    }
}

/// The configuration of an empty file.
impl Default for Config {
    fn default() -> Self {
        Self {
            watches: Vec::new(),
            chains: Vec::new(),
            limits: Limits::default(),
            capture: CaptureSettings {
                source: SourceChoice::default(),
                wire: WireChoice::default(),
                cgroup: None,
                mirror_interfaces: Vec::new(),
                include_interfaces: Vec::new(),
                exclude_interfaces: Vec::new(),
                network_namespaces: Vec::new(),
                ring_bytes: defaults::RING_BYTES,
                record_ring_bytes: defaults::RECORD_RING_BYTES,
                shm: ShmSettings {
                    mode: ShmMode::default(),
                    exact: ExactChoice::default(),
                    cpu_percent: defaults::SHM_CPU_PERCENT,
                    reading_cpu_percent: defaults::SHM_READING_CPU_PERCENT,
                },
                inside: InsideChoice::default(),
                late: LateChoice::default(),
                broker: PathBuf::from(defaults::BROKER),
                zenoh_ports: vec![defaults::ZENOH_PORT],
            },
            metrics: MetricsSettings {
                listen: defaults::LISTEN.parse().ok(),
                histograms: true,
                per_writer: false,
                web_config: None,
            },
            api: ApiSettings {
                listen: defaults::API.parse().ok(),
                socket: SocketChoice::default(),
                loopback: Access::default(),
                token_file: None,
                page: PageChoice::default(),
            },
            foxglove: FoxgloveSettings {
                listen: defaults::FOXGLOVE.parse().ok(),
                origins: defaults::ORIGINS.map(str::to_owned).into(),
            },
            ros2_daemon: Ros2DaemonSettings::default(),
            history: Duration::from_secs(defaults::HISTORY_S.into()),
            history_bytes: defaults::HISTORY_BYTES,
            otlp: OtlpSettings::default(),
            remote_write: RemoteWriteSettings::default(),
            recordings: RecordingSettings::default(),
            ship: ShipSettings::default(),
            fleet: FleetSettings::default(),
            topic_grace: Duration::from_secs(defaults::topic_grace_s()),
            service_timeout: Duration::from_secs_f64(defaults::service_timeout_s()),
            retain: RetainChoice::default(),
            robot: Parts::ALL,
            active_nodes: Vec::new(),
            expected_parameters: Vec::new(),
            extractions: Vec::new(),
            diagnostic_values: Vec::new(),
            state_directory: StateChoice::default(),
            upgrade_feed: None,
            log: Level::default(),
        }
    }
}

impl Level {
    /// Returns its name in the configuration file.
    #[must_use]
    pub const fn label(self) -> &'static str {
        match self {
            Self::Error => "error",
            Self::Warn => "warn",
            Self::Info => "info",
            Self::Debug => "debug",
            Self::Trace => "trace",
        }
    }

    /// Returns the filter that passes lines of this level and of more severe ones.
    #[must_use]
    pub const fn filter(self) -> LevelFilter {
        match self {
            Self::Error => LevelFilter::ERROR,
            Self::Warn => LevelFilter::WARN,
            Self::Info => LevelFilter::INFO,
            Self::Debug => LevelFilter::DEBUG,
            Self::Trace => LevelFilter::TRACE,
        }
    }
}

/// Defaults of missing keys.
mod defaults {
    use super::shape::Switch;

    pub(super) const RING_BYTES: usize = 4 << 20;
    pub(super) const BROKER: &str = ros2probe_attach::request::SOCKET;
    pub(super) const RECORD_RING_BYTES: usize = 1 << 20;
    pub(super) const ZENOH_PORT: u16 = ros2probe_wire::zenoh::PORT;
    pub(super) const SHM_CPU_PERCENT: f64 = 1.5;
    pub(super) const SHM_READING_CPU_PERCENT: f64 = 25.0;
    pub(super) const LISTEN: &str = "127.0.0.1:17400";
    pub(super) const API: &str = "127.0.0.1:17401";
    pub(super) const FOXGLOVE: &str = "127.0.0.1:8765";
    /// Origins of the web application and of desktop applications, whose pages are files.
    pub(super) const ORIGINS: [&str; 2] = ["https://app.foxglove.dev", "file://"];
    pub(super) const HISTORY_S: u32 = 600;

    /// Room for seven days of about 400 topics, in steps of 10 s.
    pub(super) const HISTORY_BYTES: u64 = 256 << 20;
    pub(super) const SNAPSHOT_COUNT: usize = 20;
    pub(super) const SNAPSHOT_TOTAL_BYTES: u64 = 1 << 30;

    pub(super) const fn topic_grace_s() -> u64 {
        600
    }

    pub(super) const fn service_timeout_s() -> f64 {
        5.0
    }

    pub(super) const fn ros2_daemon_in_a_map() -> Switch {
        Switch::On
    }

    pub(super) const fn snapshot_seconds() -> u64 {
        10
    }

    pub(super) const fn snapshot_bytes() -> usize {
        16 << 20
    }

    pub(super) const fn snapshot_count() -> usize {
        SNAPSHOT_COUNT
    }

    pub(super) const fn snapshot_total_bytes() -> u64 {
        SNAPSHOT_TOTAL_BYTES
    }

    pub(super) fn state_directory() -> String {
        "auto".to_owned()
    }
}
