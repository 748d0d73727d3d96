//! Export settings: the file's `otlp` section, then the standard `OTEL_*` variables, then defaults.
//! They are read once at startup, but for the file with headers.
//!
//! `opentelemetry-otlp` reads the variables of headers itself. However, it exports a signal even
//! without an endpoint, and accepts no settings for the connection of `transport.rs`.

use std::collections::BTreeMap;
use std::io;
use std::path::{Path, PathBuf};
use std::time::Duration;

use opentelemetry_otlp::ExporterBuildError;
use opentelemetry_sdk::Resource;
use ros2probe_wire::log::LogLevel;
use schemars::JsonSchema;
use serde::Deserialize;
use tonic::codegen::http::Uri;
use tracing_subscriber::filter::LevelFilter;

use super::endpoint::otlp_endpoint;
use super::exports::Signal;
use super::hardware::NoHardware;
use super::headers::Headers;
use super::resource::{Host, resource};

/// Default interval of metric exports, and default timeout of a request.
const DEFAULT_INTERVAL: Duration = Duration::from_secs(15);
const DEFAULT_TIMEOUT: Duration = Duration::from_secs(10);
/// Default and least size of each queue on disk, in bytes.
const DEFAULT_QUEUE: u64 = 32 << 20;
const MIN_QUEUE: u64 = 1 << 20;

/// Reads a text of at most this many bytes.
pub type ReadText = fn(&Path, u64) -> io::Result<String>;

/// Exports to an OpenTelemetry receiver; `None` = the standard variable, or a default.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct OtlpSettings {
    /// Address of the receiver.
    pub endpoint: Endpoint,
    /// Interval between exports of metrics.
    pub interval: Option<Duration>,
    /// Timeout for an answer.
    pub timeout: Option<Duration>,
    /// Headers of each request.
    pub headers: BTreeMap<String, String>,
    /// File with further headers.
    pub headers_file: Option<PathBuf>,
    /// Protocol of requests.
    pub protocol: Option<OtlpProtocol>,
    /// Whether requests are compressed.
    pub compression: Option<Compression>,
    /// Whether metrics are exported.
    pub metrics: Option<bool>,
    /// Whether events are exported.
    pub events: Option<bool>,
    /// Whether spans are exported, for watches with `trace`.
    pub traces: Option<bool>,
    /// Whether late calls of callbacks are exported as spans.
    pub late_calls: bool,
    /// Minimum severity of exported lines of the log; `None` exports no line.
    pub log: Option<LevelFilter>,
    /// Minimum level of exported messages of nodes' logs; `None` exports no message.
    pub node_logs: Option<LogLevel>,
    /// Name of the robot.
    pub robot: Option<String>,
    /// Additional attributes of the resource.
    pub attributes: BTreeMap<String, String>,
    /// Maximum size of the queue on disk of each signal but metrics, in bytes; zero = none.
    pub queue_bytes: Option<u64>,
}

/// Address of an OpenTelemetry receiver.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub enum Endpoint {
    /// The address in the standard variables; nothing is exported without one.
    #[default]
    Environment,
    /// Nothing is exported.
    Off,
    /// This URL.
    At(String),
}

/// Protocol of exports.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Deserialize, JsonSchema)]
pub enum OtlpProtocol {
    /// gRPC.
    #[serde(rename = "grpc")]
    Grpc,
    /// Protobuf in HTTP/1.1 requests, which pass through proxies.
    #[serde(rename = "http/protobuf")]
    HttpProtobuf,
}

/// Compression of requests.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum Compression {
    /// No compression.
    None,
    /// gzip: a fifth of the size or less, for some CPU time.
    Gzip,
}

/// Destination and connection settings of a signal.
#[derive(Clone, Debug)]
pub(super) struct Target {
    /// Whether requests use gRPC rather than HTTP with protobuf.
    pub(super) is_grpc: bool,
    pub(super) endpoint: Uri,
    /// Headers of the configuration.
    pub(super) headers: Headers,
    pub(super) timeout: Duration,
    pub(super) gzip: bool,
}

/// Settings of all exports.
#[derive(Clone, Debug)]
pub struct Settings {
    pub(super) resource: Resource,
    /// Identity of this host, for ids that depend on it.
    pub(super) host: u128,
    pub(super) interval: Duration,
    /// Maximum size of each queue on disk, in bytes; zero = none.
    pub(super) queue_bytes: u64,
    pub(super) metrics: Option<Target>,
    pub(super) events: Option<Target>,
    pub(super) traces: Option<Target>,
    pub(super) log: Option<Target>,
    pub(super) node_logs: Option<Target>,
}

/// Why exports cannot be set up.
#[derive(Debug, thiserror::Error)]
pub enum SettingsError {
    /// The endpoint is invalid.
    #[error(
        "{name} is `{value}`; it must be the URL of a receiver, such as `http://collector:4317`"
    )]
    Endpoint {
        /// Name of the setting.
        name: String,
        /// Its value.
        value: String,
    },
    /// The protocol is unknown.
    #[error("{name} is `{value}`; it must be `grpc` or `http/protobuf`")]
    Protocol {
        /// Name of the setting.
        name: String,
        /// Its value.
        value: String,
    },
    /// A header cannot be sent.
    #[error("{place}: `{name}` is not a valid header: names are lower case, values ASCII")]
    Header {
        /// Name of the setting.
        place: String,
        /// Name of the header.
        name: String,
    },
    /// The file with headers cannot be read.
    #[error("cannot read the headers in {}", path.display())]
    HeadersFile {
        /// Path of the file.
        path: PathBuf,
        /// Error of the operating system.
        source: io::Error,
    },
    /// The robot has no name.
    #[error("otlp.robot")]
    Robot(#[source] NoHardware),
    /// The connection cannot be configured.
    #[error("the OTLP connection cannot be set up")]
    Client(#[source] tonic::transport::Error),
    /// The certificate authorities of the system cannot be read.
    #[error("the certificate authorities for the OTLP connection cannot be read")]
    Authorities(#[source] io::Error),
    /// The library does not accept the settings.
    #[error(transparent)]
    Exporter(#[from] ExporterBuildError),
}

impl Settings {
    /// Returns the settings from `file` and the environment; `None` if nothing is exported. `read`
    /// reads the file with headers.
    ///
    /// # Errors
    /// Fails if an endpoint, a header or the name of the robot is invalid.
    pub fn resolve(
        file: &OtlpSettings,
        environment: &dyn Fn(&str) -> Option<String>,
        read: ReadText,
        host: &Host,
    ) -> Result<Option<Self>, SettingsError> {
        let variables = Variables(environment);
        // An endpoint in the file takes precedence over the variable.
        let disabled = variables.find("OTEL_SDK_DISABLED").is_some_and(|value| {
            value.eq_ignore_ascii_case("true") && !matches!(file.endpoint, Endpoint::At(_))
        });
        if disabled || file.endpoint == Endpoint::Off {
            return Ok(None);
        }
        let target = |signal| target(file, &variables, read, signal);
        let settings = Self {
            resource: resource(host, file).map_err(SettingsError::Robot)?,
            host: host.bits(),
            interval: file.interval.unwrap_or_else(|| {
                let variable = variables.find("OTEL_METRIC_EXPORT_INTERVAL");
                variable
                    .and_then(|value| milliseconds("OTEL_METRIC_EXPORT_INTERVAL", &value))
                    .unwrap_or(DEFAULT_INTERVAL)
                    .max(Duration::from_secs(1))
            }),
            queue_bytes: match file.queue_bytes {
                Some(0) => 0,
                limit => limit.unwrap_or(DEFAULT_QUEUE).max(MIN_QUEUE),
            },
            metrics: target(Signal::Metrics)?,
            events: target(Signal::Events)?,
            traces: target(Signal::Traces)?,
            log: target(Signal::Log)?,
            node_logs: target(Signal::NodeLogs)?,
        };
        let signals = [
            &settings.metrics,
            &settings.events,
            &settings.traces,
            &settings.log,
            &settings.node_logs,
        ];
        let any = signals.iter().any(|target| target.is_some());
        Ok(any.then_some(settings))
    }
}

/// The environment's variables.
struct Variables<'e>(&'e dyn Fn(&str) -> Option<String>);

impl Variables<'_> {
    /// Returns a variable's value; `None` if it is unset or empty.
    fn find(&self, name: &str) -> Option<String> {
        let value = (self.0)(name)?.trim().to_owned();
        (!value.is_empty()).then_some(value)
    }

    /// Returns the signal's own variable, or the one for all signals, with its name. `None` if both
    /// are unset.
    fn of(&self, signal: Signal, name: &str) -> Option<(String, String)> {
        let own = format!("OTEL_EXPORTER_OTLP_{}_{name}", standard(signal));
        let names = [own, format!("OTEL_EXPORTER_OTLP_{name}")];
        names
            .into_iter()
            .find_map(|name| Some((name.clone(), self.find(&name)?)))
    }
}

/// Returns the name of a signal in variables.
const fn standard(signal: Signal) -> &'static str {
    match signal {
        Signal::Metrics => "METRICS",
        Signal::Events | Signal::Log | Signal::NodeLogs => "LOGS",
        Signal::Traces => "TRACES",
    }
}

/// Parses a number of milliseconds. As the specification requires, an invalid value is logged and
/// ignored.
fn milliseconds(name: &str, value: &str) -> Option<Duration> {
    let milliseconds = value.parse().ok().filter(|value| *value > 0);
    if milliseconds.is_none() {
        tracing::warn!(name, value, "not a number of milliseconds; ignored");
    }
    milliseconds.map(Duration::from_millis)
}

fn target(
    file: &OtlpSettings,
    variables: &Variables<'_>,
    read: ReadText,
    signal: Signal,
) -> Result<Option<Target>, SettingsError> {
    let wanted = match signal {
        Signal::Metrics => file.metrics,
        Signal::Events => file.events,
        Signal::Traces => file.traces,
        Signal::Log => Some(file.log.is_some()),
        Signal::NodeLogs => Some(file.node_logs.is_some()),
    };
    let exporter = format!("OTEL_{}_EXPORTER", standard(signal));
    let refused = || variables.find(&exporter).is_some_and(|name| name == "none");
    if !wanted.unwrap_or_else(|| !refused()) {
        return Ok(None);
    }
    let is_grpc = match (file.protocol, variables.of(signal, "PROTOCOL")) {
        (Some(protocol), _) => protocol == OtlpProtocol::Grpc,
        (None, None) => true,
        (None, Some((name, value))) => match value.as_str() {
            "grpc" => true,
            "http/protobuf" => false,
            _ => return Err(SettingsError::Protocol { name, value }),
        },
    };
    let (name, value) = match &file.endpoint {
        Endpoint::At(endpoint) => ("otlp.endpoint".to_owned(), endpoint.clone()),
        Endpoint::Environment | Endpoint::Off => match variables.of(signal, "ENDPOINT") {
            Some(found) => found,
            None => return Ok(None),
        },
    };
    let endpoint = if is_grpc {
        otlp_endpoint(&value)
    } else {
        // The URL of a single signal already has a path.
        let is_whole = name.ends_with(&format!("_{}_ENDPOINT", standard(signal)));
        http_endpoint(&value, if is_whole { "" } else { path(signal) })
    };
    let Some(endpoint) = endpoint else {
        return Err(SettingsError::Endpoint { name, value });
    };
    let timeout = file.timeout.or_else(|| {
        let (name, value) = variables.of(signal, "TIMEOUT")?;
        milliseconds(&name, &value)
    });
    let gzip = match file.compression {
        Some(compression) => compression == Compression::Gzip,
        None => variables
            .of(signal, "COMPRESSION")
            .is_some_and(|(_, value)| value.eq_ignore_ascii_case("gzip")),
    };
    Ok(Some(Target {
        is_grpc,
        endpoint,
        headers: Headers::resolve(file, read)?,
        timeout: timeout.unwrap_or(DEFAULT_TIMEOUT),
        gzip,
    }))
}

const fn path(signal: Signal) -> &'static str {
    match signal {
        Signal::Metrics => "/v1/metrics",
        Signal::Events | Signal::Log | Signal::NodeLogs => "/v1/logs",
        Signal::Traces => "/v1/traces",
    }
}

/// Returns the URL of OTLP over HTTP; `None` if the text is not a URL.
fn http_endpoint(text: &str, path: &str) -> Option<Uri> {
    otlp_endpoint(text)?;
    format!("{}{path}", text.trim_end_matches('/')).parse().ok()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn resolve(
        file: &OtlpSettings,
        environment: &[(&str, &str)],
    ) -> Result<Option<Settings>, SettingsError> {
        let find = |name: &str| {
            let found = environment.iter().find(|(known, _)| *known == name);
            found.map(|(_, value)| (*value).to_owned())
        };
        let read = |path: &Path, _| std::fs::read_to_string(path);
        Settings::resolve(file, &find, read, &Host::default())
    }

    fn at(endpoint: &str) -> OtlpSettings {
        OtlpSettings {
            endpoint: Endpoint::At(endpoint.to_owned()),
            ..OtlpSettings::default()
        }
    }

    fn one_header(name: &str, value: &str) -> BTreeMap<String, String> {
        BTreeMap::from([(name.to_owned(), value.to_owned())])
    }

    fn endpoint_of(target: &Option<Target>) -> String {
        target
            .as_ref()
            .map_or_else(String::new, |target| target.endpoint.to_string())
    }

    #[test]
    fn without_an_endpoint_the_exporter_is_disabled() {
        let unset = OtlpSettings::default();
        assert!(resolve(&unset, &[]).unwrap().is_none());
        let set = [("OTEL_EXPORTER_OTLP_ENDPOINT", "http://collector:4317")];
        let disabled = OtlpSettings {
            endpoint: Endpoint::Off,
            ..OtlpSettings::default()
        };
        assert!(resolve(&disabled, &set).unwrap().is_none());
        let off = [set[0], ("OTEL_SDK_DISABLED", "TRUE")];
        assert!(resolve(&unset, &off).unwrap().is_none());
        assert!(resolve(&at("http://a"), &off).unwrap().is_some());
        let none = [
            set[0],
            ("OTEL_METRICS_EXPORTER", "none"),
            ("OTEL_LOGS_EXPORTER", "none"),
        ];
        let events = OtlpSettings {
            events: Some(true),
            ..OtlpSettings::default()
        };
        let settings = resolve(&events, &none).unwrap().unwrap();
        assert!(settings.metrics.is_none() && settings.traces.is_some());
        assert!(settings.events.is_some(), "the file wins");
        assert!(settings.log.is_none(), "only on request");
    }

    #[test]
    fn standard_otel_variables_are_applied() {
        let settings = resolve(
            &OtlpSettings::default(),
            &[
                ("OTEL_EXPORTER_OTLP_ENDPOINT", "http://collector/ignored"),
                ("OTEL_EXPORTER_OTLP_LOGS_ENDPOINT", "http://logs:9"),
                ("OTEL_EXPORTER_OTLP_TIMEOUT", "2500"),
                ("OTEL_EXPORTER_OTLP_METRICS_COMPRESSION", "gzip"),
                ("OTEL_METRIC_EXPORT_INTERVAL", "5000"),
            ],
        );
        let settings = settings.unwrap().unwrap();
        assert_eq!(endpoint_of(&settings.metrics), "http://collector:4317/");
        assert_eq!(endpoint_of(&settings.events), "http://logs:9/");
        let (metrics, traces) = (settings.metrics.unwrap(), settings.traces.unwrap());
        assert!(metrics.gzip && !traces.gzip);
        assert_eq!(metrics.timeout, Duration::from_millis(2500));
        assert_eq!(settings.interval, Duration::from_secs(5));
    }

    #[test]
    fn over_http_each_signal_has_its_path_below_the_common_endpoint() {
        let environment = [
            ("OTEL_EXPORTER_OTLP_ENDPOINT", "https://otlp.example/base/"),
            (
                "OTEL_EXPORTER_OTLP_TRACES_ENDPOINT",
                "http://a:1/own?key=value",
            ),
            ("OTEL_EXPORTER_OTLP_PROTOCOL", "http/protobuf"),
            ("OTEL_EXPORTER_OTLP_LOGS_PROTOCOL", "grpc"),
        ];
        let file = OtlpSettings {
            log: Some(LevelFilter::WARN),
            ..OtlpSettings::default()
        };
        let settings = resolve(&file, &environment).unwrap().unwrap();
        let metrics = "https://otlp.example/base/v1/metrics";
        assert_eq!(endpoint_of(&settings.metrics), metrics);
        assert_eq!(endpoint_of(&settings.traces), "http://a:1/own?key=value");
        assert_eq!(endpoint_of(&settings.events), "https://otlp.example:4317/");
        assert!(settings.events.unwrap().is_grpc && settings.log.unwrap().is_grpc);
        let file = OtlpSettings {
            protocol: Some(OtlpProtocol::HttpProtobuf),
            ..at("http://b:2")
        };
        let settings = resolve(&file, &environment).unwrap().unwrap();
        assert_eq!(endpoint_of(&settings.events), "http://b:2/v1/logs");
    }

    #[test]
    fn the_file_takes_precedence_over_the_environment() {
        let file = OtlpSettings {
            interval: Some(Duration::from_secs(30)),
            timeout: Some(Duration::from_secs(3)),
            compression: Some(Compression::None),
            headers: one_header("authorization", "Bearer x"),
            ..at("http://127.0.0.1:4317")
        };
        let environment = [
            ("OTEL_EXPORTER_OTLP_ENDPOINT", "http://collector:1"),
            ("OTEL_EXPORTER_OTLP_METRICS_ENDPOINT", "http://collector:2"),
            ("OTEL_EXPORTER_OTLP_TIMEOUT", "1"),
            ("OTEL_EXPORTER_OTLP_COMPRESSION", "gzip"),
            ("OTEL_METRIC_EXPORT_INTERVAL", "1000"),
        ];
        let settings = resolve(&file, &environment).unwrap().unwrap();
        assert_eq!(endpoint_of(&settings.metrics), "http://127.0.0.1:4317/");
        let metrics = settings.metrics.unwrap();
        assert!(!metrics.gzip && metrics.headers.current().len() == 1);
        assert_eq!(
            (metrics.timeout.as_secs(), settings.interval.as_secs()),
            (3, 30)
        );
    }

    #[test]
    fn invalid_settings_are_reported_at_the_start() {
        let failed = |file: &OtlpSettings, environment: &[(&str, &str)]| {
            resolve(file, environment).unwrap_err().to_string()
        };
        let message = failed(
            &OtlpSettings::default(),
            &[("OTEL_EXPORTER_OTLP_TRACES_ENDPOINT", "collector:4317")],
        );
        assert!(message.starts_with("OTEL_EXPORTER_OTLP_TRACES_ENDPOINT is `collector:4317`"));
        let message = failed(
            &at("http://a"),
            &[("OTEL_EXPORTER_OTLP_PROTOCOL", "http/json")],
        );
        assert!(
            message.contains("must be `grpc` or `http/protobuf`"),
            "{message}"
        );
        let file = OtlpSettings {
            headers: one_header("a b", "c"),
            ..at("http://a")
        };
        let message = failed(&file, &[]);
        assert!(message.starts_with("otlp.headers: `a b`"), "{message}");
        let file = OtlpSettings {
            headers_file: Some("/no/such".into()),
            ..at("http://a")
        };
        let message = failed(&file, &[]);
        assert_eq!(message, "cannot read the headers in /no/such");
    }

    #[test]
    fn headers_are_read_from_a_file_and_not_logged() {
        let file = tempfile::NamedTempFile::new().unwrap();
        std::fs::write(file.path(), "# token\nAuthorization: Bearer a:b=\n\n").unwrap();
        let settings = OtlpSettings {
            headers_file: Some(file.path().to_owned()),
            ..at("http://a")
        };
        let settings = resolve(&settings, &[]).unwrap().unwrap();
        let headers = settings.events.unwrap().headers.current();
        assert_eq!(headers.get("authorization").unwrap(), "Bearer a:b=");
        assert!(!format!("{headers:?}").contains("Bearer"), "not in a log");
    }
}
