//! The configuration: YAML shape first, then meaning; all mistakes reported with their place.
//!
//! Nothing is bound, opened or read from the environment here.

mod check;
mod document;
mod limits;
mod meaning;
mod mistake;
mod otlp_endpoint;
mod shape;

use std::collections::BTreeMap;
use std::io;
use std::net::SocketAddr;
use std::path::{Path, PathBuf};
use std::time::Duration;

use schemars::JsonSchema;
use serde::Deserialize;

pub use limits::markdown as limits_markdown;
pub use mistake::{Mistake, Mistakes, Position};
pub use otlp_endpoint::otlp_endpoint;
pub use ros2probe_capture::settings::{
    CaptureSettings, ExactChoice, ShmMode, ShmSettings, SourceChoice,
};
pub use ros2probe_model::limits::{Limit, Limits, Row as LimitRow};
pub use ros2probe_model::watch::{
    self, Expectations, ManyGlobs, PatternError, Retain, Watch, Watchlist, check_globs,
    check_pattern,
};

/// A larger file is no configuration.
const MAX_BYTES: u64 = 1 << 20;

/// The checked configuration of the agent.
#[derive(Clone, Debug, PartialEq)]
pub struct Config {
    /// What to measure, in file order.
    pub watches: Vec<Watch>,
    /// Caps of the agent's tables.
    pub limits: Limits,
    /// Where packets come from.
    pub capture: CaptureSettings,
    /// The metrics surface.
    pub metrics: MetricsSettings,
    /// The control API.
    pub api: ApiSettings,
    /// How long figures of measured topics are kept for charts; zero = not at all.
    pub history: Duration,
    /// What is pushed to an OpenTelemetry receiver.
    pub otlp: OtlpSettings,
    /// What the agent records.
    pub recordings: RecordingSettings,
    /// How long a topic without endpoints is still reported.
    pub topic_grace: Duration,
    /// Where what discovery knows is kept for the next start.
    pub state_directory: StateChoice,
    /// Least severe level that is logged.
    pub log: Level,
}

/// How far a client of the control API may go; each level has those before it.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum Access {
    /// Graph, figures, events, and which topics are watched.
    Read,
    /// Also add and remove watches, and follow messages without their bytes.
    #[default]
    Watch,
    /// Also message payloads, recordings, snapshots and reloads.
    All,
}

impl Access {
    /// Its name in the configuration and on the command line.
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
    /// To browsers, beside the API.
    #[default]
    On,
    /// Not at all.
    Off,
}

/// Where state is kept.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub enum StateChoice {
    /// Where the service manager says (`$STATE_DIRECTORY`), else the default place if it can be
    /// used.
    #[default]
    Auto,
    /// Nowhere.
    Off,
    /// Here.
    At(PathBuf),
}

/// The metrics surface.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct MetricsSettings {
    /// Where to listen; `None` = nowhere.
    pub listen: Option<SocketAddr>,
    /// Histograms of watched topics.
    pub histograms: bool,
    /// Series per writer.
    pub per_writer: bool,
    /// Says who may scrape and how it is encrypted.
    pub web_config: Option<PathBuf>,
}

/// The control API.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ApiSettings {
    /// Where to listen; `None` = nowhere.
    pub listen: Option<SocketAddr>,
    /// Which unix socket to listen on besides.
    pub socket: SocketChoice,
    /// What loopback clients without a token may do.
    pub loopback: Access,
    /// Holds the bearer token that clients on the network address must send.
    pub token_file: Option<PathBuf>,
    /// Whether the page is served at `listen`.
    pub page: PageChoice,
}

/// Which unix socket.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub enum SocketChoice {
    /// Where the service manager says (`$RUNTIME_DIRECTORY`), else the default place if its
    /// directory is there.
    #[default]
    Auto,
    /// None.
    Off,
    /// This one.
    At(PathBuf),
}

/// What the agent records into bags.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct RecordingSettings {
    /// Where bags are written.
    pub directory: StateChoice,
    /// The last seconds of topics, kept in memory.
    pub snapshots: Vec<SnapshotSettings>,
    /// What bags may take of the disk.
    pub limits: RecordingLimits,
}

/// What bags may take of the disk.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct RecordingLimits {
    /// Bytes of each; `None` = any.
    pub max_bytes: Option<u64>,
    /// Bytes of all in the directory; `None` = any.
    pub max_total_bytes: Option<u64>,
    /// Of the file system stays free: the larger one of these percent and those bytes.
    pub reserve_percent: u8,
    /// Likewise.
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
    /// Bags go into the state directory, wherever that is.
    #[must_use]
    pub fn is_in(&self, state: &StateChoice) -> bool {
        self.directory == StateChoice::Auto && *state != StateChoice::Off
    }
}

/// The last seconds of some topics.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct SnapshotSettings {
    /// Names its bags.
    pub name: String,
    /// Names and globs.
    pub topics: Vec<String>,
    /// Their domain.
    pub domain_id: u32,
    /// Nothing older is kept.
    pub span: Duration,
    /// Nor more bytes.
    pub max_bytes: usize,
    /// Written when an expectation is violated.
    pub on_violation: bool,
}

/// What is pushed to an OpenTelemetry receiver; `None` = the standard variable decides, or a default.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct OtlpSettings {
    /// Where to.
    pub endpoint: Endpoint,
    /// How often metrics are.
    pub interval: Option<Duration>,
    /// How long an answer may take.
    pub timeout: Option<Duration>,
    /// Sent with each request.
    pub headers: BTreeMap<String, String>,
    /// A file with further ones.
    pub headers_file: Option<PathBuf>,
    /// Whether requests are compressed.
    pub compression: Option<Compression>,
    /// Whether metrics are exported.
    pub metrics: Option<bool>,
    /// Whether events are exported.
    pub events: Option<bool>,
    /// Whether spans of the watches that ask for them are exported.
    pub traces: Option<bool>,
    /// What the robot is called.
    pub robot: Option<String>,
    /// Further attributes of the resource.
    pub attributes: BTreeMap<String, String>,
}

/// Where an OpenTelemetry receiver is.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub enum Endpoint {
    /// Where the standard variables say; nowhere when they are silent.
    #[default]
    Environment,
    /// Nowhere.
    Off,
    /// Here.
    At(String),
}

/// How requests are compressed.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum Compression {
    /// Not at all.
    None,
    /// A fifth of the size or less, for some processor time.
    Gzip,
}

/// How much is logged.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum Level {
    /// Failures.
    Error,
    /// And what will hurt soon.
    Warn,
    /// And changes of state.
    #[default]
    Info,
    /// And why.
    Debug,
    /// And everything else.
    Trace,
}

/// Why there is no configuration.
#[derive(Debug, thiserror::Error)]
pub enum ConfigError {
    /// The file cannot be read.
    #[error("cannot read the configuration {}", path.display())]
    Read {
        /// Which file.
        path: PathBuf,
        /// Why not.
        source: io::Error,
    },
    /// Larger than any file written by hand.
    #[error("the configuration {} is larger than 1 MiB", path.display())]
    TooLarge {
        /// Which file.
        path: PathBuf,
    },
    /// It says what it must not; one line for each mistake.
    #[error("{}", mistakes.report(&path.display().to_string()))]
    Invalid {
        /// Which file.
        path: PathBuf,
        /// What is wrong.
        mistakes: Mistakes,
    },
}

impl Config {
    /// Reads and checks a file.
    ///
    /// # Errors
    /// When it cannot be read or has mistakes; then all of them.
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

    /// Checks the bytes of a file.
    ///
    /// # Errors
    /// All mistakes, in file order.
    pub fn parse(bytes: &[u8]) -> Result<Self, Mistakes> {
        meaning::parse(bytes)
    }

    /// Keys whose change in `new` takes effect only after a restart.
    #[must_use]
    pub fn needs_restart(&self, new: &Self) -> Vec<&'static str> {
        [
            ("limits", self.limits != new.limits),
            ("capture", self.capture != new.capture),
            ("metrics.listen", self.metrics.listen != new.metrics.listen),
            (
                "metrics.web_config",
                self.metrics.web_config != new.metrics.web_config,
            ),
            ("api", self.api != new.api),
            ("page", self.history != new.history),
            ("otlp", self.otlp != new.otlp),
            ("recordings", self.recordings != new.recordings),
            ("topic_grace_s", self.topic_grace != new.topic_grace),
            (
                "state_directory",
                self.state_directory != new.state_directory,
            ),
        ]
        .into_iter()
        .filter_map(|(key, changed)| changed.then_some(key))
        .collect()
    }

    /// The JSON schema of the file.
    #[must_use]
    pub fn schema() -> serde_json::Value {
        schemars::schema_for!(shape::ConfigShape).to_value()
    }
}

/// What an empty file means.
impl Default for Config {
    fn default() -> Self {
        Self {
            watches: Vec::new(),
            limits: Limits::default(),
            capture: CaptureSettings {
                source: SourceChoice::default(),
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
            history: Duration::from_secs(defaults::HISTORY_S.into()),
            otlp: OtlpSettings::default(),
            recordings: RecordingSettings::default(),
            topic_grace: Duration::from_secs(defaults::topic_grace_s()),
            state_directory: StateChoice::default(),
            log: Level::default(),
        }
    }
}

impl Level {
    /// As written in the file.
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
}

/// What is not written in the file.
mod defaults {
    pub(super) const RING_BYTES: usize = 4 << 20;
    pub(super) const RECORD_RING_BYTES: usize = 1 << 20;
    pub(super) const SHM_CPU_PERCENT: f64 = 1.5;
    pub(super) const SHM_READING_CPU_PERCENT: f64 = 25.0;
    pub(super) const LISTEN: &str = "127.0.0.1:17400";
    pub(super) const API: &str = "127.0.0.1:17401";
    pub(super) const HISTORY_S: u32 = 600;

    pub(super) const fn topic_grace_s() -> u64 {
        600
    }

    pub(super) const fn snapshot_seconds() -> u64 {
        10
    }

    pub(super) const fn snapshot_bytes() -> usize {
        16 << 20
    }

    pub(super) const fn on_violation() -> bool {
        true
    }

    pub(super) fn state_directory() -> String {
        "auto".to_owned()
    }
}
