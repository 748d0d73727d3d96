//! Export settings: the file's `otlp` section, then the standard `OTEL_*` variables, then defaults.
//! They are read once at startup.

use std::collections::BTreeMap;
use std::path::PathBuf;
use std::time::Duration;

use opentelemetry_proto::tonic::resource::v1::Resource;
use tonic::codegen::http::Uri;
use tonic::metadata::{AsciiMetadataKey, AsciiMetadataValue, MetadataMap};

use super::exports::Signal;
use super::resource::{Host, resource};
use crate::config::{Compression, Endpoint, OtlpSettings, otlp_endpoint};

/// Default interval of metric exports, and default timeout of a request.
const INTERVAL: Duration = Duration::from_secs(15);
const TIMEOUT: Duration = Duration::from_secs(10);
/// Largest size of a file with headers.
const HEADERS_BYTES: u64 = 1 << 20;

/// Destination and connection settings of a signal.
#[derive(Clone, Debug)]
pub(super) struct Target {
    pub(super) endpoint: Uri,
    pub(super) headers: MetadataMap,
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
    pub(super) metrics: Option<Target>,
    pub(super) events: Option<Target>,
    pub(super) traces: Option<Target>,
}

/// Why exports cannot be set up.
#[derive(Debug, thiserror::Error)]
pub enum SettingsError {
    /// The endpoint is invalid.
    #[error(
        "{name} is `{value}`; it must be the URL of a gRPC receiver, such as `http://collector:4317`"
    )]
    Endpoint {
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
        source: std::io::Error,
    },
    /// The connection cannot be configured.
    #[error("the OTLP connection cannot be set up")]
    Client(#[source] tonic::transport::Error),
}

impl Settings {
    /// Returns the settings from `file` and the environment; `None` if nothing is exported.
    ///
    /// # Errors
    /// Fails if an endpoint or header is invalid.
    pub fn resolve(
        file: &OtlpSettings,
        environment: &dyn Fn(&str) -> Option<String>,
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
        let target = |signal| target(file, &variables, signal);
        let settings = Self {
            resource: resource(host, &attributes(file, &variables)),
            host: host.bits(),
            interval: file.interval.unwrap_or_else(|| {
                variables
                    .milliseconds("OTEL_METRIC_EXPORT_INTERVAL")
                    .unwrap_or(INTERVAL)
                    .max(Duration::from_secs(1))
            }),
            metrics: target(Signal::Metrics)?,
            events: target(Signal::Events)?,
            traces: target(Signal::Traces)?,
        };
        let signals = [&settings.metrics, &settings.events, &settings.traces];
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
        let own = match signal {
            Signal::Metrics => "METRICS",
            Signal::Events => "LOGS",
            Signal::Traces => "TRACES",
        };
        let names = [
            format!("OTEL_EXPORTER_OTLP_{own}_{name}"),
            format!("OTEL_EXPORTER_OTLP_{name}"),
        ];
        names
            .into_iter()
            .find_map(|name| Some((name.clone(), self.find(&name)?)))
    }

    fn milliseconds(&self, name: &str) -> Option<Duration> {
        let value = self.find(name)?;
        number(name, &value)
    }
}

/// Parses a number of milliseconds. As the specification requires, an invalid value is logged and
/// ignored.
fn number(name: &str, value: &str) -> Option<Duration> {
    let milliseconds = value.parse().ok().filter(|value| *value > 0);
    if milliseconds.is_none() {
        tracing::warn!(name, value, "not a number of milliseconds; ignored");
    }
    milliseconds.map(Duration::from_millis)
}

fn target(
    file: &OtlpSettings,
    variables: &Variables<'_>,
    signal: Signal,
) -> Result<Option<Target>, SettingsError> {
    let (wanted, exporter) = match signal {
        Signal::Metrics => (file.metrics, "OTEL_METRICS_EXPORTER"),
        Signal::Events => (file.events, "OTEL_LOGS_EXPORTER"),
        Signal::Traces => (file.traces, "OTEL_TRACES_EXPORTER"),
    };
    let refused = || variables.find(exporter).is_some_and(|name| name == "none");
    if !wanted.unwrap_or_else(|| !refused()) {
        return Ok(None);
    }
    let (name, value) = match &file.endpoint {
        Endpoint::At(endpoint) => ("otlp.endpoint".to_owned(), endpoint.clone()),
        Endpoint::Environment | Endpoint::Off => match variables.of(signal, "ENDPOINT") {
            Some(found) => found,
            None => return Ok(None),
        },
    };
    let Some(endpoint) = otlp_endpoint(&value) else {
        return Err(SettingsError::Endpoint { name, value });
    };
    if let Some((name, value)) = variables.of(signal, "PROTOCOL")
        && value != "grpc"
    {
        tracing::warn!(name, value, "only the protocol grpc is supported");
    }
    let timeout = file.timeout.or_else(|| {
        let (name, value) = variables.of(signal, "TIMEOUT")?;
        number(&name, &value)
    });
    let gzip = match file.compression {
        Some(compression) => compression == Compression::Gzip,
        None => variables
            .of(signal, "COMPRESSION")
            .is_some_and(|(_, value)| value == "gzip"),
    };
    Ok(Some(Target {
        endpoint,
        headers: headers(file, variables, signal)?,
        timeout: timeout.unwrap_or(TIMEOUT),
        gzip,
    }))
}

/// Returns the headers of the file, or without any those of the environment.
fn headers(
    file: &OtlpSettings,
    variables: &Variables<'_>,
    signal: Signal,
) -> Result<MetadataMap, SettingsError> {
    let mut headers = MetadataMap::new();
    let mut add = |place: &str, name: &str, value: &str| {
        let pair = AsciiMetadataKey::from_bytes(name.trim().to_ascii_lowercase().as_bytes())
            .ok()
            .zip(AsciiMetadataValue::try_from(value.trim()).ok());
        let (key, mut value) = pair.ok_or_else(|| SettingsError::Header {
            place: place.to_owned(),
            name: name.to_owned(),
        })?;
        value.set_sensitive(true);
        headers.insert(key, value);
        Ok(())
    };
    if file.headers.is_empty() && file.headers_file.is_none() {
        let Some((place, list)) = variables.of(signal, "HEADERS") else {
            return Ok(headers);
        };
        for (name, value) in pairs(&list) {
            add(&place, &name, &value)?;
        }
        return Ok(headers);
    }
    for (name, value) in &file.headers {
        add("otlp.headers", name, value)?;
    }
    if let Some(path) = &file.headers_file {
        let text = crate::file::read_text(path, HEADERS_BYTES).map_err(|source| {
            SettingsError::HeadersFile {
                path: path.clone(),
                source,
            }
        })?;
        let place = path.display().to_string();
        for line in text.lines().map(str::trim) {
            if line.is_empty() || line.starts_with('#') {
                continue;
            }
            let (name, value) = line.split_once(':').unwrap_or((line, ""));
            add(&place, name, value)?;
        }
    }
    Ok(headers)
}

/// Returns the configured resource attributes; those of the file take precedence.
fn attributes(file: &OtlpSettings, variables: &Variables<'_>) -> BTreeMap<String, String> {
    let list = variables
        .find("OTEL_RESOURCE_ATTRIBUTES")
        .unwrap_or_default();
    let mut attributes: BTreeMap<String, String> = pairs(&list).into_iter().collect();
    if let Some(name) = variables.find("OTEL_SERVICE_NAME") {
        attributes.insert("service.name".to_owned(), name);
    }
    attributes.extend(
        file.attributes
            .iter()
            .map(|(key, value)| (key.clone(), value.clone())),
    );
    if let Some(robot) = &file.robot {
        attributes.insert("robot.name".to_owned(), robot.clone());
    }
    attributes
}

/// Parses `key=value,key=value`, percent-encoded as in W3C baggage.
fn pairs(list: &str) -> Vec<(String, String)> {
    let pairs = list.split(',').filter_map(|pair| pair.split_once('='));
    pairs
        .map(|(key, value)| (decoded(key.trim()), decoded(value.trim())))
        .filter(|(key, _)| !key.is_empty())
        .collect()
}

fn decoded(text: &str) -> String {
    let mut bytes = Vec::with_capacity(text.len());
    let mut rest = text.as_bytes();
    while let Some((first, tail)) = rest.split_first() {
        let digits = tail.get(..2).filter(|_| *first == b'%');
        let byte = digits
            .and_then(|digits| std::str::from_utf8(digits).ok())
            .and_then(|digits| u8::from_str_radix(digits, 16).ok());
        bytes.push(byte.unwrap_or(*first));
        rest = match byte {
            Some(_) => tail.get(2..).unwrap_or_default(),
            None => tail,
        };
    }
    String::from_utf8_lossy(&bytes).into_owned()
}

#[cfg(test)]
mod tests {
    use super::super::points::attribute;
    use super::*;

    fn resolve(
        yaml: &str,
        environment: &[(&str, &str)],
    ) -> Result<Option<Settings>, SettingsError> {
        let config = crate::config::Config::parse(yaml.as_bytes()).unwrap();
        let find = |name: &str| {
            let found = environment.iter().find(|(known, _)| *known == name);
            found.map(|(_, value)| (*value).to_owned())
        };
        Settings::resolve(&config.otlp, &find, &Host::default())
    }

    fn endpoint_of(target: &Option<Target>) -> String {
        target
            .as_ref()
            .map_or_else(String::new, |target| target.endpoint.to_string())
    }

    #[test]
    fn without_an_endpoint_nothing_is_exported() {
        assert!(resolve("", &[]).unwrap().is_none());
        let set = [("OTEL_EXPORTER_OTLP_ENDPOINT", "http://collector:4317")];
        assert!(resolve("otlp: {endpoint: 'off'}", &set).unwrap().is_none());
        let off = [set[0], ("OTEL_SDK_DISABLED", "TRUE")];
        assert!(resolve("", &off).unwrap().is_none());
        assert!(
            resolve("otlp: {endpoint: 'http://a'}", &off)
                .unwrap()
                .is_some()
        );
        let none = [
            set[0],
            ("OTEL_METRICS_EXPORTER", "none"),
            ("OTEL_LOGS_EXPORTER", "none"),
        ];
        let settings = resolve("otlp: {events: true}", &none).unwrap().unwrap();
        assert!(settings.metrics.is_none() && settings.traces.is_some());
        assert!(settings.events.is_some(), "the file wins");
    }

    #[test]
    fn standard_variables_are_honoured() {
        let settings = resolve(
            "",
            &[
                ("OTEL_EXPORTER_OTLP_ENDPOINT", "http://collector/ignored"),
                ("OTEL_EXPORTER_OTLP_LOGS_ENDPOINT", "http://logs:9"),
                (
                    "OTEL_EXPORTER_OTLP_HEADERS",
                    "API-Key=a%20b, x-scope=robots",
                ),
                ("OTEL_EXPORTER_OTLP_TRACES_HEADERS", "only=traces"),
                ("OTEL_EXPORTER_OTLP_TIMEOUT", "2500"),
                ("OTEL_EXPORTER_OTLP_METRICS_COMPRESSION", "gzip"),
                ("OTEL_METRIC_EXPORT_INTERVAL", "5000"),
                ("OTEL_RESOURCE_ATTRIBUTES", "site=hall%2C 2,service.name=x"),
                ("OTEL_SERVICE_NAME", "probe"),
            ],
        );
        let settings = settings.unwrap().unwrap();
        assert_eq!(endpoint_of(&settings.metrics), "http://collector:4317/");
        assert_eq!(endpoint_of(&settings.events), "http://logs:9/");
        let (metrics, traces) = (settings.metrics.unwrap(), settings.traces.unwrap());
        assert_eq!(metrics.headers.get("api-key").unwrap(), "a b");
        assert_eq!(metrics.headers.get("x-scope").unwrap(), "robots");
        assert!(traces.headers.get("only").is_some() && traces.headers.len() == 1);
        assert!(metrics.gzip && !traces.gzip);
        assert_eq!(metrics.timeout, Duration::from_millis(2500));
        assert_eq!(settings.interval, Duration::from_secs(5));
        let attributes = &settings.resource.attributes;
        assert!(attributes.contains(&attribute("service.name", "probe")));
        assert!(attributes.contains(&attribute("site", "hall, 2")));
    }

    #[test]
    fn the_file_wins_over_the_environment() {
        let yaml = "\
otlp:
  endpoint: http://127.0.0.1:4317
  interval_s: 30
  timeout_s: 3
  compression: none
  headers: {authorization: Bearer x}
  robot: marvin
  attributes: {site: roof, service.name: mine}
";
        let environment = [
            ("OTEL_EXPORTER_OTLP_ENDPOINT", "http://collector:1"),
            ("OTEL_EXPORTER_OTLP_METRICS_ENDPOINT", "http://collector:2"),
            ("OTEL_EXPORTER_OTLP_HEADERS", "other=1"),
            ("OTEL_EXPORTER_OTLP_TIMEOUT", "1"),
            ("OTEL_EXPORTER_OTLP_COMPRESSION", "gzip"),
            ("OTEL_METRIC_EXPORT_INTERVAL", "1000"),
            ("OTEL_SERVICE_NAME", "theirs"),
            ("OTEL_RESOURCE_ATTRIBUTES", "site=cellar,floor=2"),
        ];
        let settings = resolve(yaml, &environment).unwrap().unwrap();
        assert_eq!(endpoint_of(&settings.metrics), "http://127.0.0.1:4317/");
        let metrics = settings.metrics.unwrap();
        assert!(!metrics.gzip && metrics.headers.len() == 1);
        assert_eq!(
            (metrics.timeout.as_secs(), settings.interval.as_secs()),
            (3, 30)
        );
        let attributes = &settings.resource.attributes;
        for (key, value) in [
            ("site", "roof"),
            ("floor", "2"),
            ("service.name", "mine"),
            ("robot.name", "marvin"),
        ] {
            assert!(attributes.contains(&attribute(key, value)), "{key}");
        }
    }

    #[test]
    fn invalid_settings_are_reported_at_the_start() {
        let failed = |yaml: &str, environment: &[(&str, &str)]| {
            resolve(yaml, environment).unwrap_err().to_string()
        };
        let said = failed(
            "",
            &[("OTEL_EXPORTER_OTLP_TRACES_ENDPOINT", "collector:4317")],
        );
        assert!(said.starts_with("OTEL_EXPORTER_OTLP_TRACES_ENDPOINT is `collector:4317`"));
        let said = failed("otlp: {endpoint: 'http://a', headers: {'a b': c}}", &[]);
        assert!(said.starts_with("otlp.headers: `a b`"), "{said}");
        let said = failed("otlp: {endpoint: 'http://a', headers_file: /no/such}", &[]);
        assert_eq!(said, "cannot read the headers in /no/such");
    }

    #[test]
    fn a_file_of_headers_keeps_secrets_out_of_the_configuration() {
        let file = tempfile::NamedTempFile::new().unwrap();
        std::fs::write(file.path(), "# token\nAuthorization: Bearer a:b=\n\n").unwrap();
        let yaml = format!(
            "otlp: {{endpoint: 'http://a', headers_file: {}}}",
            file.path().display()
        );
        let settings = resolve(&yaml, &[]).unwrap().unwrap();
        let headers = settings.events.unwrap().headers;
        assert_eq!(headers.get("authorization").unwrap(), "Bearer a:b=");
        assert!(!format!("{headers:?}").contains("Bearer"), "not in a log");
    }
}
