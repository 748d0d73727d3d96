//! Converts the shape into its meaning, and checks conditions that types and ranges cannot express.

mod chains;

use std::collections::BTreeMap;
use std::net::SocketAddr;
use std::path::PathBuf;
use std::time::Duration;

use ros2probe_wire::DomainId;
use ros2probe_wire::filter::PORT_CAPACITY;
use ros2probe_wire::log::LogLevel;

use super::check::check;
use super::document::Node;
use super::mistake::{Mistakes, Position};
use super::shape::{
    ApiShape, CaptureShape, ConfigShape, FleetShape, FoxgloveShape, LogLevelShape, MetricsShape,
    OtlpShape, PageShape, RecordingsShape, RemoteWriteShape, RobotShape, Ros2DaemonShape,
    ShipShape, SnapshotShape, Switch, WatchEntryShape, WatchShape,
};
use super::watch::{ExpectationValues, Expectations, Retain, Watch, check_globs};
use super::{
    ApiSettings, CaptureSettings, Config, Endpoint, Extraction, FleetSettings, FoxgloveSettings,
    Level, Limits, MAX_PARAMETERS, MetricsSettings, OtlpSettings, RecordingLimits,
    RecordingSettings, RemoteWriteSettings, Ros2DaemonSettings, ShipSettings, ShmSettings,
    SnapshotSettings, SocketChoice, SourceChoice, StateChoice, Windows,
};
use crate::events::Trigger;
use crate::fleet::Question;
use ros2probe_model::derive::robot::parameters::ExpectedParameter;
use ros2probe_model::derive::robot::{Part, Parts};
use ros2probe_ship::StoreSettings;

/// Maximum number of configured snapshots; each needs memory and a thread.
const MAX_SNAPSHOTS: usize = 8;
/// Maximum number of patterns of nodes that should be active.
const MAX_ACTIVE: usize = 64;
/// Maximum number of fields of messages with a metric.
const MAX_EXTRACTIONS: usize = 64;
/// Minimum of the default interval between triggered bags of a snapshot, in seconds.
const SNAPSHOT_INTERVAL_S: u64 = 10;

/// Parses and checks a configuration.
pub(super) fn parse(bytes: &[u8]) -> Result<Config, Mistakes> {
    let mut mistakes = Mistakes::default();
    let source = match std::str::from_utf8(bytes) {
        Ok(source) => source,
        Err(error) => {
            let valid = bytes.get(..error.valid_up_to()).unwrap_or_default();
            let last = valid
                .rsplit(|byte| *byte == b'\n')
                .next()
                .unwrap_or_default();
            let line = 1 + valid.iter().filter(|byte| **byte == b'\n').count();
            let column = 1 + String::from_utf8_lossy(last).chars().count();
            mistakes.add(Position { line, column }, "", "not UTF-8");
            return mistakes.none_or(Config::default());
        }
    };
    let document = Node::parse(source)?;
    if document.is_empty() {
        return Ok(Config::default());
    }
    let read = reader(&document, &mut mistakes);
    let Some(read) = read else {
        return mistakes.none_or(Config::default());
    };
    read(source, &document)
}

/// The reader of each version of the file, the oldest first.
const VERSION_READERS: &[(u32, Read)] = &[(1, read_1)];
type Read = fn(&str, &Node) -> Result<Config, Mistakes>;

/// Returns the reader for the version of the file, which defaults to the first version. In a newer
/// file only the version is reported, since the meaning of its other keys is unknown.
fn reader(document: &Node, mistakes: &mut Mistakes) -> Option<Read> {
    let newest = VERSION_READERS.last().map_or(0, |(version, _)| *version);
    let Some((version, position)) = document.version() else {
        return VERSION_READERS.first().map(|(_, read)| *read);
    };
    let known = VERSION_READERS
        .iter()
        .find(|(known, _)| i128::from(*known) == version);
    if known.is_none() {
        let message = if version > i128::from(newest) {
            format!(
                "is {version}, this rp {} reads up to {newest}: upgrade rp, or write the file for \
                 version {newest}",
                env!("CARGO_PKG_VERSION")
            )
        } else {
            format!("is {version}, must be between 1 and {newest}")
        };
        mistakes.add(position, "version", message);
    }
    known.map(|(_, read)| *read)
}

/// Reads version 1.
fn read_1(source: &str, document: &Node) -> Result<Config, Mistakes> {
    let mut mistakes = Mistakes::default();
    let schema = Config::schema();
    let places = document.index(&mut mistakes);
    check(document, "", &schema, &schema, &mut mistakes);
    mistakes = match mistakes.none_or(()) {
        Ok(()) => Mistakes::default(),
        Err(mistakes) => return Err(mistakes),
    };
    let mut reader = Reader { places, mistakes };
    match serde_yaml::from_str::<ConfigShape>(source) {
        Ok(shape) => {
            let config = reader.config(shape);
            reader.mistakes.none_or(config)
        }
        // The two YAML readers rarely disagree. The error is then still reported with a position.
        Err(error) => {
            let place = error.location().map(|at| Position {
                line: at.line(),
                column: at.column(),
            });
            reader
                .mistakes
                .add(place.unwrap_or_default(), "", error.to_string());
            reader.mistakes.none_or(Config::default())
        }
    }
}

/// Positions of values, and mistakes found.
struct Reader {
    places: BTreeMap<String, Position>,
    mistakes: Mistakes,
}

impl Reader {
    fn wrong(&mut self, key: &str, message: impl Into<String>) {
        let position = self.places.get(key).copied().unwrap_or_default();
        self.mistakes.add(position, key, message);
    }

    fn config(&mut self, shape: ConfigShape) -> Config {
        let limits = Limits::from(shape.limits.unwrap_or_default());
        let api = self.api(shape.api.unwrap_or_default());
        let has_token = api.token_file.is_some();
        let robot = shape.robot.unwrap_or_default();
        let page = shape.page.unwrap_or_default();
        Config {
            watches: self.watches(shape.watch.unwrap_or_default(), limits.watches),
            chains: self.chains(shape.chains.unwrap_or_default()),
            limits,
            capture: self.capture(shape.capture.unwrap_or_default()),
            metrics: metrics(shape.metrics.unwrap_or_default()),
            api,
            foxglove: self.foxglove(shape.foxglove.unwrap_or_default(), has_token),
            ros2_daemon: ros2_daemon(shape.ros2_daemon.unwrap_or_default()),
            history: Duration::from_secs(history_seconds(&page).into()),
            history_bytes: page.history_bytes,
            otlp: otlp(shape.otlp.unwrap_or_default()),
            remote_write: self.remote_write(shape.remote_write.unwrap_or_default()),
            recordings: self.recordings(shape.recordings.unwrap_or_default()),
            ship: ship(shape.ship.unwrap_or_default()),
            fleet: fleet(shape.fleet.unwrap_or_default()),
            topic_grace: Duration::from_secs(shape.topic_grace_s),
            service_timeout: Duration::from_secs_f64(shape.service_timeout_s),
            retain: shape.retain,
            robot: parts(&robot),
            active_nodes: self.listed("robot.active", robot.active, MAX_ACTIVE),
            expected_parameters: self
                .listed(
                    "robot.parameters_expected",
                    robot.parameters_expected,
                    MAX_PARAMETERS,
                )
                .into_iter()
                .map(|shape| ExpectedParameter {
                    node: shape.node.as_str().into(),
                    name: shape.name.into(),
                    value: shape.value.into(),
                })
                .collect(),
            extractions: self
                .listed("robot.extract", robot.extract, MAX_EXTRACTIONS)
                .into_iter()
                .map(|shape| Extraction {
                    topic: shape.topic,
                    field: shape.field,
                    metric: shape.metric,
                })
                .collect(),
            diagnostic_values: robot.diagnostic_values.unwrap_or_default(),
            state_directory: state(&shape.state_directory),
            upgrade_feed: shape.upgrade.and_then(|upgrade| upgrade.feed),
            log: shape.log,
        }
    }

    /// Returns the entries of a list, unless they are too many.
    fn listed<T>(&mut self, key: &str, entries: Option<Vec<T>>, most: usize) -> Vec<T> {
        let entries = entries.unwrap_or_default();
        if entries.len() > most {
            let message = format!("has {} entries, at most {most} are allowed", entries.len());
            self.wrong(key, message);
        }
        entries
    }

    fn recordings(&mut self, shape: RecordingsShape) -> RecordingSettings {
        let shapes = self.listed("recordings.snapshots", shape.snapshots, MAX_SNAPSHOTS);
        let mut snapshots: Vec<SnapshotSettings> = Vec::new();
        for (index, shape) in shapes.into_iter().enumerate() {
            let key = format!("recordings.snapshots[{index}]");
            if snapshots.iter().any(|other| other.name == shape.name) {
                self.wrong(
                    &format!("{key}.name"),
                    "is already the name of another snapshot",
                );
            }
            if shape.topics.is_empty() {
                self.wrong(
                    &format!("{key}.topics"),
                    "is empty: list at least one topic",
                );
            }
            if shape.trigger.is_some() && shape.on_violation.is_some() {
                let message = "is the earlier form of `trigger`: remove it";
                self.wrong(&format!("{key}.on_violation"), message);
            }
            snapshots.push(snapshot(shape));
        }
        RecordingSettings {
            directory: state(&shape.directory),
            snapshots,
            limits: RecordingLimits {
                max_bytes: shape.max_bytes,
                max_total_bytes: shape.max_total_bytes,
                reserve_percent: shape.reserve_percent,
                reserve_bytes: shape.reserve_bytes,
            },
        }
    }

    fn watches(&mut self, shapes: Vec<WatchShape>, limit: usize) -> Vec<Watch> {
        if shapes.len() > limit {
            let message = format!(
                "has {} entries, at most {limit} are allowed: use globs, or raise limits.watches",
                shapes.len()
            );
            self.wrong("watch", message);
            return Vec::new();
        }
        let mut watches: Vec<Watch> = Vec::with_capacity(shapes.len());
        for (index, shape) in shapes.into_iter().enumerate() {
            let key = format!("watch[{index}]");
            let watch = match shape {
                WatchShape::Pattern(pattern) => Watch {
                    pattern,
                    domain_id: None,
                    expectations: Expectations::default(),
                    per_subscriber: false,
                    trace: 0.0,
                    retain: Retain::None,
                },
                WatchShape::Entry(entry) => self.entry(&key, *entry),
            };
            let twin = |other: &Watch| {
                other.pattern == watch.pattern && other.domain_id == watch.domain_id
            };
            if let Some(first) = watches.iter().position(twin) {
                self.wrong(&key, format!("repeats watch[{first}]"));
            }
            watches.push(watch);
        }
        if let Err(many) = check_globs(watches.iter().map(|watch| watch.pattern.as_str())) {
            self.wrong("watch", format!("has {many}"));
        }
        watches
    }

    fn entry(&mut self, key: &str, entry: WatchEntryShape) -> Watch {
        if let (Some(low), Some(high)) = (entry.min_rate_hz, entry.max_rate_hz)
            && low > high
        {
            self.wrong(
                &format!("{key}.max_rate_hz"),
                format!("is {high}, below min_rate_hz, which is {low}"),
            );
        }
        let has_rate = entry.min_rate_hz.or(entry.max_rate_hz).is_some();
        if entry.window_s.is_some() && !has_rate {
            self.wrong(
                &format!("{key}.window_s"),
                "needs min_rate_hz or max_rate_hz",
            );
        }
        let values = ExpectationValues {
            min_rate_hz: entry.min_rate_hz,
            max_rate_hz: entry.max_rate_hz,
            window_s: entry.window_s,
            max_loss_ratio: entry.max_loss_ratio,
            max_latency_ms: entry.max_latency_ms,
            max_silence_s: entry.max_silence_s,
            publishers: entry.publishers,
            subscribers: entry.subscribers,
        };
        Watch {
            pattern: entry.topic,
            domain_id: entry.domain.map(DomainId),
            // Values outside their ranges were reported before, by the schema or above.
            expectations: Expectations::try_from(values).unwrap_or_default(),
            per_subscriber: entry.per_subscriber,
            trace: entry.trace.unwrap_or_default(),
            retain: entry.retain.into(),
        }
    }

    /// An address beyond this host requires a token, because clients can change watches.
    fn api(&mut self, shape: ApiShape) -> ApiSettings {
        let listen = self.listen("api.listen", &shape.listen, shape.token_file.is_some());
        ApiSettings {
            listen,
            socket: match shape.socket.as_str() {
                "auto" => SocketChoice::Auto,
                "off" => SocketChoice::Off,
                path => SocketChoice::At(PathBuf::from(path)),
            },
            loopback: shape.loopback,
            token_file: shape.token_file.map(PathBuf::from),
            page: shape.page,
        }
    }

    /// An address beyond this host requires a token, because clients receive all messages.
    fn foxglove(&mut self, shape: FoxgloveShape, has_token: bool) -> FoxgloveSettings {
        let listen = self.listen("foxglove.listen", &shape.listen, has_token);
        let default = Config::default().foxglove.origins;
        FoxgloveSettings {
            listen,
            origins: shape.origins.unwrap_or(default),
        }
    }

    fn remote_write(&mut self, shape: RemoteWriteShape) -> RemoteWriteSettings {
        let labels = shape.labels.unwrap_or_default();
        for name in labels.keys().filter(|name| !is_label(name)) {
            let message = "is no name of a label: letters, digits and `_`, as in `site`";
            self.wrong(&format!("remote_write.labels.{name}"), message);
        }
        if shape.certificate_file.is_some() != shape.key_file.is_some() {
            self.wrong(
                "remote_write",
                "needs both certificate_file and key_file, or neither",
            );
        }
        let default = RemoteWriteSettings::default();
        let seconds = |seconds: Option<u64>, default| seconds.map_or(default, Duration::from_secs);
        RemoteWriteSettings {
            url: shape.url,
            interval: seconds(shape.interval_s, default.interval),
            timeout: seconds(shape.timeout_s, default.timeout),
            instance: shape.instance,
            labels,
            headers: shape.headers.unwrap_or_default(),
            token_file: shape.token_file.map(PathBuf::from),
            ca_file: shape.ca_file.map(PathBuf::from),
            certificate_file: shape.certificate_file.map(PathBuf::from),
            key_file: shape.key_file.map(PathBuf::from),
            queue_bytes: shape.queue_bytes.unwrap_or(default.queue_bytes),
            max_bytes_per_second: shape.max_bytes_per_second,
            max_new_series_per_hour: shape
                .max_new_series_per_hour
                .unwrap_or(default.max_new_series_per_hour),
        }
    }

    /// Returns the address; text other than an address is `off`, as the check of texts ensures.
    fn listen(&mut self, key: &str, text: &str, has_token: bool) -> Option<SocketAddr> {
        let listen: Option<SocketAddr> = text.parse().ok();
        let open = listen.filter(|address| !address.ip().is_loopback());
        if let (Some(address), false) = (open, has_token) {
            let token = match key {
                "api.listen" => "token_file",
                _ => "api.token_file",
            };
            let message = format!(
                "is {address}, which other hosts can reach: set `{token}`, or use 127.0.0.1"
            );
            self.wrong(key, message);
        }
        listen
    }

    fn capture(&mut self, shape: CaptureShape) -> CaptureSettings {
        let interfaces = shape.interfaces.unwrap_or_default();
        let namespaces = shape.network_namespaces.unwrap_or_default();
        let shm = shape.shm.unwrap_or_default();
        let settings = CaptureSettings {
            source: shape.source,
            wire: shape.wire,
            cgroup: shape.cgroup.map(PathBuf::from),
            mirror_interfaces: shape.mirror_interfaces.unwrap_or_default(),
            include_interfaces: interfaces.include.unwrap_or_default(),
            exclude_interfaces: interfaces.exclude.unwrap_or_default(),
            network_namespaces: namespaces.into_iter().map(PathBuf::from).collect(),
            ring_bytes: shape.ring_bytes,
            record_ring_bytes: shape.record_ring_bytes,
            shm: ShmSettings {
                mode: shm.mode,
                exact: shm.exact,
                cpu_percent: shm.cpu_percent,
                reading_cpu_percent: shm.reading_cpu_percent,
            },
            inside: shape.inside,
            late: shape.late,
            broker: PathBuf::from(shape.broker),
            zenoh_ports: shape.zenoh.unwrap_or_default().ports,
        };
        if settings.zenoh_ports.len() > PORT_CAPACITY {
            let message = format!("has more than {PORT_CAPACITY} ports");
            self.wrong("capture.zenoh.ports", message);
        }
        self.check_source(&settings);
        settings
    }

    /// Reports keys that do not apply to the selected source.
    fn check_source(&mut self, settings: &CaptureSettings) {
        let set = |keys: [(&'static str, bool); 2]| {
            let set = keys.into_iter().filter(|(_, set)| *set);
            set.map(|(key, _)| key).collect::<Vec<_>>()
        };
        let of_wire = set([
            (
                "interfaces.include",
                !settings.include_interfaces.is_empty(),
            ),
            (
                "interfaces.exclude",
                !settings.exclude_interfaces.is_empty(),
            ),
        ]);
        let of_host = set([
            ("cgroup", settings.cgroup.is_some()),
            ("mirror_interfaces", !settings.mirror_interfaces.is_empty()),
        ]);
        for key in &of_wire {
            let message = match (settings.source, of_host.first()) {
                (SourceChoice::Host, _) => {
                    "selects interfaces, which `source: host` does not capture; use \
                     mirror_interfaces or `source: wire`"
                        .to_owned()
                }
                (SourceChoice::Auto, Some(other)) => {
                    format!("selects `source: wire`, to which {other} does not apply")
                }
                _ => continue,
            };
            self.wrong(&format!("capture.{key}"), message);
        }
        if settings.source == SourceChoice::Wire {
            for key in of_host {
                let message = "does not apply to `source: wire`";
                self.wrong(&format!("capture.{key}"), message);
            }
        }
    }
}

fn snapshot(shape: SnapshotShape) -> SnapshotSettings {
    let triggers = shape.trigger.unwrap_or_else(|| {
        let expectation = shape.on_violation.unwrap_or(true);
        Vec::from_iter(expectation.then(|| "expectation".to_owned()))
    });
    let (before, after) = (shape.seconds, shape.seconds_after);
    let min_interval = (before + after).max(SNAPSHOT_INTERVAL_S);
    SnapshotSettings {
        name: shape.name,
        topics: shape.topics,
        domain_id: shape.domain,
        before: Duration::from_secs(before),
        after: Duration::from_secs(after),
        max_bytes: shape.max_bytes,
        // Unknown names were reported with their position.
        triggers: triggers
            .iter()
            .filter_map(|name| Trigger::parse(name))
            .collect(),
        min_interval: Duration::from_secs(shape.min_interval_s.unwrap_or(min_interval)),
        max_count: shape.max_count,
        max_total_bytes: shape.max_total_bytes,
    }
}

/// Returns whether the name is that of a label which no metric has by itself.
fn is_label(name: &str) -> bool {
    let is_plain = |c: char| c.is_ascii_alphanumeric() || c == '_';
    (1..=128).contains(&name.len())
        && name.chars().all(is_plain)
        && !name.starts_with(|c: char| c.is_ascii_digit())
        && !name.starts_with("__")
        && name != "le"
}

/// Returns the settings of a delivery; texts that are no windows are reported by the check of
/// texts.
fn ship(shape: ShipShape) -> ShipSettings {
    let windows = shape.windows.unwrap_or_default();
    let windows = windows.iter().filter_map(|text| text.parse().ok());
    ShipSettings {
        url: shape.url,
        endpoint: shape.endpoint,
        region: shape.region,
        instance: shape.instance,
        credentials_file: shape.credentials_file.map(PathBuf::from),
        ca_file: shape.ca_file.map(PathBuf::from),
        max_bytes_per_second: shape.max_bytes_per_second,
        windows: Windows(windows.collect()),
        triggered_always: shape.triggered_always,
    }
}

fn fleet(shape: FleetShape) -> FleetSettings {
    let default = Question::default();
    FleetSettings {
        engine: shape.engine,
        token_file: shape.token_file.map(PathBuf::from),
        question: Question {
            job: shape.job.unwrap_or(default.job),
            hours: shape.since_h.unwrap_or(default.hours),
            reach: shape.reach_s.unwrap_or(default.reach),
        },
        link: shape.link.and_then(|link| link.parse().ok()),
        store: shape.store.and_then(|store| {
            Some(StoreSettings {
                url: store.url?,
                endpoint: store.endpoint,
                region: store.region,
                credentials_file: store.credentials_file.map(PathBuf::from),
                ca_file: store.ca_file.map(PathBuf::from),
                max_bytes_per_second: None,
            })
        }),
    }
}

fn state(text: &str) -> StateChoice {
    match text {
        "auto" => StateChoice::Auto,
        "off" => StateChoice::Off,
        path => StateChoice::At(PathBuf::from(path)),
    }
}

fn ros2_daemon(shape: Ros2DaemonShape) -> Ros2DaemonSettings {
    let (switch, distro) = match shape {
        Ros2DaemonShape::Choice(switch) => (switch, None),
        Ros2DaemonShape::Settings(settings) => (settings.enabled, settings.distro),
    };
    Ros2DaemonSettings {
        is_on: switch == Switch::On,
        distro: distro.map(Into::into),
    }
}

fn metrics(shape: MetricsShape) -> MetricsSettings {
    MetricsSettings {
        // Text other than an address is `off`; the check of texts has refused all other text.
        listen: shape.listen.parse().ok(),
        histograms: shape.histograms,
        per_writer: shape.per_writer,
        web_config: shape.web_config.map(PathBuf::from),
    }
}

/// Shortest history in memory from which the one on disk is written, in seconds: each minute, and
/// later on a busy machine.
const MIN_WRITTEN_HISTORY_S: u32 = 120;

/// Returns the seconds of history in memory.
fn history_seconds(page: &PageShape) -> u32 {
    match page.history_s {
        0 => 0,
        seconds if page.history_bytes > 0 => seconds.max(MIN_WRITTEN_HISTORY_S),
        seconds => seconds,
    }
}

fn parts(shape: &RobotShape) -> Parts {
    let parts = [
        (Part::Logs, shape.logs),
        (Part::Diagnostics, shape.diagnostics),
        (Part::Parameters, shape.parameters),
        (Part::Transforms, shape.transforms),
        (Part::Lifecycle, shape.lifecycle),
        (Part::Fields, shape.fields),
        (Part::Clocks, shape.clocks),
    ];
    let on = parts
        .into_iter()
        .filter(|(_, switch)| *switch == Switch::On);
    on.map(|(part, _)| part).collect()
}

fn otlp(shape: OtlpShape) -> OtlpSettings {
    OtlpSettings {
        endpoint: match shape.endpoint.as_deref() {
            None => Endpoint::Environment,
            Some("off") => Endpoint::Off,
            Some(endpoint) => Endpoint::At(endpoint.to_owned()),
        },
        interval: shape.interval_s.map(Duration::from_secs),
        timeout: shape.timeout_s.map(Duration::from_secs),
        headers: shape.headers.unwrap_or_default(),
        headers_file: shape.headers_file.map(PathBuf::from),
        protocol: shape.protocol,
        compression: shape.compression,
        metrics: shape.metrics,
        events: shape.events,
        traces: shape.traces,
        late_calls: shape.late_calls.unwrap_or(false),
        log: shape.log.map(Level::filter),
        node_logs: shape.node_logs.map(|level| match level {
            LogLevelShape::Debug => LogLevel::Debug,
            LogLevelShape::Info => LogLevel::Info,
            LogLevelShape::Warn => LogLevel::Warn,
            LogLevelShape::Error => LogLevel::Error,
            LogLevelShape::Fatal => LogLevel::Fatal,
        }),
        robot: shape.robot,
        attributes: shape.attributes.unwrap_or_default(),
        queue_bytes: shape.queue_bytes,
    }
}

#[cfg(test)]
mod tests;
