//! A real OpenTelemetry receiver, rotel, and its printed output.
use std::collections::BTreeMap;
use std::fs::{self, File};
use std::net::SocketAddr;
use std::path::{Path, PathBuf};
use std::process::{Child, Command};
use std::time::{Duration, Instant};

use crate::{ports::free_address, repository};

/// Maximum wait for output.
const PATIENCE: Duration = Duration::from_secs(90);

/// A running receiver. Dropping the value kills it and keeps its output.
pub struct Rotel {
    child: Child,
    output: PathBuf,
    /// Address for OTLP over gRPC.
    pub address: SocketAddr,
    /// Address for OTLP over HTTP.
    pub http: SocketAddr,
}

/// One printed data point, span or record: fields and attributes by name.
#[derive(Clone, Debug, Default)]
pub struct Item {
    /// `Name`, `Unit`, `Value`, `Trace ID`, ...
    pub fields: BTreeMap<String, String>,
    pub attributes: BTreeMap<String, String>,
    /// Counts of a histogram's buckets.
    pub buckets: Vec<u64>,
    /// Traces and spans that a span links to.
    pub links: Vec<BTreeMap<String, String>>,
}

/// Content of one request.
#[derive(Clone, Debug, Default)]
pub struct Export {
    pub resource: BTreeMap<String, String>,
    pub items: Vec<Item>,
}

impl Rotel {
    /// Starts a receiver at `address`, or on a free port, with its output in `directory`.
    pub fn start(command: &mut Command, directory: &Path, address: Option<SocketAddr>) -> Self {
        Self::start_at(
            command,
            directory,
            [address.unwrap_or_else(free_address), free_address()],
        )
    }

    /// Starts a receiver at these addresses for gRPC and HTTP, with its output in `directory`.
    pub fn start_at(
        command: &mut Command,
        directory: &Path,
        [address, other]: [SocketAddr; 2],
    ) -> Self {
        let output = directory.join(format!("rotel-{}", other.port()));
        let child = command
            .arg("start")
            .args([
                "--exporter",
                "blackhole",
                "--debug-log-verbosity",
                "detailed",
            ])
            .args([
                "--debug-log",
                "metrics",
                "--debug-log",
                "logs",
                "--debug-log",
                "traces",
            ])
            .args(["--otlp-grpc-endpoint", &address.to_string()])
            .args(["--otlp-http-endpoint", &other.to_string()])
            .stdout(File::create(&output).unwrap())
            .stderr(File::create(output.with_extension("errors")).unwrap())
            .spawn()
            .unwrap_or_else(|error| panic!("rotel: {error}; run `make prerequisites`"));
        let mut rotel = Self {
            child,
            output,
            address,
            http: other,
        };
        rotel.wait_for("it starts", |text| text.contains("Starting Rotel"));
        rotel
    }

    /// Returns the binary installed by the prerequisites.
    pub fn binary() -> PathBuf {
        let tools = repository("target/tools/rotel/lib");
        let directories = fs::read_dir(&tools).into_iter().flatten().flatten();
        let binary = directories
            .map(|python| python.path().join("site-packages/rotel/rotel-agent"))
            .find(|path| path.exists());
        binary
            .unwrap_or_else(|| panic!("no rotel in {}: run `make prerequisites`", tools.display()))
    }

    /// Returns all output so far.
    pub fn text(&self) -> String {
        fs::read_to_string(&self.output).unwrap()
    }

    /// Waits until `wanted` accepts the output, and returns it.
    pub fn wait_for(&mut self, what: &str, wanted: impl Fn(&str) -> bool) -> String {
        let deadline = Instant::now() + PATIENCE;
        loop {
            let text = self.text();
            if wanted(&text) {
                return text;
            }
            let ended = self.child.try_wait().unwrap();
            assert!(
                ended.is_none() && Instant::now() < deadline,
                "rotel, while waiting until {what} ({ended:?}):\n{}\n{}",
                names(&text),
                fs::read_to_string(self.output.with_extension("errors")).unwrap_or_default()
            );
            std::thread::sleep(Duration::from_millis(50));
        }
    }
}

impl Drop for Rotel {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// Returns all names in the output, with their counts.
fn names(text: &str) -> String {
    let mut counts: BTreeMap<&str, usize> = BTreeMap::new();
    for line in text.lines().map(str::trim_start) {
        if line.starts_with("Name ")
            || line.starts_with("-> Name:")
            || line.starts_with("EventName")
        {
            *counts.entry(line).or_default() += 1;
        }
    }
    format!("{counts:#?}")
}

/// Returns the output by request. The last request may be truncated.
pub fn exports(text: &str) -> Vec<Export> {
    let mut exports: Vec<Export> = Vec::new();
    let mut family = BTreeMap::new();
    let mut resource = false;
    for line in text.lines() {
        if line.starts_with("Resource") && line.ends_with(" #0") {
            exports.push(Export::default());
            resource = true;
            continue;
        }
        let Some(export) = exports.last_mut() else {
            continue;
        };
        if line.starts_with("Scope") {
            resource = false;
        } else if line.starts_with("Metric #") {
            family = BTreeMap::new();
        } else if line.contains("DataPoints #")
            || line.starts_with("Span #")
            || line.starts_with("LogRecord #")
        {
            export.items.push(Item {
                fields: family.clone(),
                ..Item::default()
            });
        } else if let Some((name, value)) =
            line.trim_start().trim_start_matches("-> ").split_once(": ")
        {
            let (name, value) = (name.trim().to_owned(), value.trim());
            let attribute = plain(value);
            match (export.items.last_mut(), attribute) {
                (_, Some(value)) if resource => drop(export.resource.insert(name, value)),
                (Some(item), Some(value)) => drop(item.attributes.insert(name, value)),
                (Some(item), None) if name.starts_with("Buckets #") => {
                    item.buckets
                        .push(value.trim_start_matches("Count: ").parse().unwrap_or(0));
                }
                (Some(item), None) if name == "Trace ID" && is_listed(line) => {
                    item.links.push(BTreeMap::from([(name, value.to_owned())]));
                }
                (Some(item), None) if name == "ID" && is_listed(line) => {
                    let link = item.links.last_mut();
                    link.and_then(|link| link.insert(name, value.to_owned()));
                }
                (Some(item), None) if !is_listed(line) => {
                    item.fields.insert(name, value.to_owned());
                }
                _ => drop(family.insert(name, value.to_owned())),
            }
        }
    }
    exports
}

/// Returns whether the line is an attribute, or a field of a link.
fn is_listed(line: &str) -> bool {
    line.starts_with("     ->")
}

/// Returns the value in `Str(value)` or `Int(value)`.
fn plain(value: &str) -> Option<String> {
    let inner = ["Str(", "Int(", "Double(", "Bool("]
        .into_iter()
        .find_map(|kind| value.strip_prefix(kind))?;
    inner.strip_suffix(')').map(str::to_owned)
}
