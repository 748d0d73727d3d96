//! Permitted dependencies between the crates. A dependency on a higher crate fails a test with one
//! line that names it.
#![allow(
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::panic,
    clippy::indexing_slicing,
    reason = "a test that meets the unexpected has failed"
)]

use std::collections::{BTreeMap, BTreeSet};
use std::env::consts::ARCH;
use std::process::Command;

use serde_json::Value;

/// Each crate with the crates of this workspace on which it may depend, lowest first. A crate may
/// depend only on crates above it in this list, so no cycle can be allowed by mistake.
const ALLOWED: &[(&str, &[&str])] = &[
    ("wire", &[]),
    ("model", &["wire"]),
    // This crate reads libraries with the bounded cursor of `wire`.
    ("attach", &["wire"]),
    ("capture", &["wire", "model", "attach"]),
    // The next two crates read payloads and times with the bounded cursor of `wire`.
    ("message", &["wire"]),
    ("bag", &["wire"]),
    ("history", &[]),
    ("api", &[]),
    // The samples of this crate are the model's figures.
    // Samples that wait for a receiver are in a queue of `history`.
    ("metrics", &["wire", "model", "history"]),
    ("page", &[]),
    ("ship", &["bag"]),
    (
        "daemon",
        &[
            "wire", "model", "attach", "capture", "message", "bag", "history", "api", "metrics",
            "page", "ship",
        ],
    ),
    // The package is called ros2probe. It reaches a running agent only through the API. A replay
    // composes an agent of its own from source and model. `rp doctor` examines this host with the
    // code of the sources. `rp discover` listens with that code, and speaks RTPS and Zenoh itself.
    (
        "cli",
        &[
            "wire", "model", "attach", "capture", "message", "bag", "api", "metrics", "ship",
            "daemon",
        ],
    ),
];

/// Libraries that must not be in the model's dependency tree: the model has no I/O, no clock, no
/// configuration.
const NOT_IN_MODEL: &[&str] = &[
    "anyhow",
    "axum",
    "aya",
    "caps",
    "clap",
    "hyper",
    "libc",
    "rustix",
    "schemars",
    "serde_json",
    "socket2",
    "tokio",
    "tracing",
    "utoipa",
];

/// Libraries that must not be in the dependency tree of any crate below the daemon.
const NO_RUNTIME: &[&str] = &["axum", "hyper", "tokio", "tonic"];

/// The packages that the project's owner chose: the package, the crate that depends on it, and a
/// source of that crate with the words that use the package for its purpose.
const CHOSEN: &[(&str, &str, &str, &[&str])] = &[
    (
        "aya",
        "ros2probe-capture",
        "agent/capture/src/filter.rs",
        &["use aya::{Ebpf", "EbpfLoader::new()"],
    ),
    (
        "axum",
        "ros2probe-daemon",
        "agent/daemon/src/surface/http.rs",
        &["use axum::Router;", "Router::new()"],
    ),
    (
        "opentelemetry",
        "ros2probe-metrics",
        "agent/metrics/src/otlp/instruments.rs",
        &["u64_observable_counter(", "f64_observable_gauge("],
    ),
    (
        "opentelemetry_sdk",
        "ros2probe-metrics",
        "agent/metrics/src/otlp/traces.rs",
        &["-> SpanData {"],
    ),
    (
        "opentelemetry-otlp",
        "ros2probe-metrics",
        "agent/metrics/src/otlp/transport.rs",
        &[
            "MetricExporter::builder()",
            "LogExporter::builder()",
            "SpanExporter::builder()",
        ],
    ),
    (
        "opentelemetry-appender-tracing",
        "ros2probe-metrics",
        "agent/metrics/src/otlp/own_log.rs",
        &["OpenTelemetryTracingBridge::new("],
    ),
    (
        "prometheus-client",
        "ros2probe-metrics",
        "agent/metrics/src/exposition.rs",
        &[
            "impl Collector for",
            "prometheus_text::encode(",
            " text::encode(",
        ],
    ),
    (
        "tokio",
        "ros2probe-daemon",
        "agent/daemon/src/agent.rs",
        &["tokio::runtime::Builder::new_"],
    ),
    (
        "tracing",
        "ros2probe-daemon",
        "agent/daemon/src/agent.rs",
        &["tracing::info!("],
    ),
    (
        "tracing-subscriber",
        "ros2probe-daemon",
        "agent/daemon/src/logging.rs",
        &["tracing_subscriber::registry()", "fmt::layer()"],
    ),
    // The maintained replacement of serde_yaml, imported under that name.
    (
        "yaml_serde",
        "ros2probe-daemon",
        "agent/daemon/src/config/meaning.rs",
        &["serde_yaml::from_str"],
    ),
];

/// Texts that only the chosen packages may contain: the text format of metrics, and services and
/// variables of OTLP. Types of its requests are those of `opentelemetry-proto`.
const WRITTEN_BY_PACKAGES: &[&str] = &[
    "# HELP ",
    "# TYPE ",
    "# UNIT ",
    "# EOF",
    "opentelemetry.proto.collector",
    "OTEL_EXPORTER_OTLP_HEADERS",
    "grpc-status-details-bin",
];

struct Workspace {
    /// Package id by name.
    ids: BTreeMap<String, String>,
    /// Name by package id.
    names: BTreeMap<String, String>,
    /// Ids of normal dependencies by package id.
    dependencies: BTreeMap<String, Vec<String>>,
    /// Names of normal dependencies that are not optional, by package name.
    required: BTreeMap<String, BTreeSet<String>>,
}

impl Workspace {
    fn read() -> Self {
        let manifest = ros2probe_testing::repository("Cargo.toml");
        let output = Command::new(env!("CARGO"))
            .args(["metadata", "--format-version=1", "--locked", "--offline"])
            // A fresh machine has the packages of its own platform only.
            .args(["--filter-platform", &format!("{ARCH}-unknown-linux-gnu")])
            .arg("--manifest-path")
            .arg(manifest)
            .output()
            .unwrap();
        let errors = String::from_utf8_lossy(&output.stderr);
        assert!(output.status.success(), "cargo metadata: {errors}");
        let metadata: Value = serde_json::from_slice(&output.stdout).unwrap();
        let text = |value: &Value| value.as_str().unwrap().to_owned();
        let packages = metadata["packages"].as_array().unwrap().iter();
        let names: BTreeMap<_, _> = packages
            .map(|package| (text(&package["id"]), text(&package["name"])))
            .collect();
        let packages = metadata["packages"].as_array().unwrap().iter();
        let required = packages
            .map(|package| {
                let all = package["dependencies"].as_array().unwrap().iter();
                let required =
                    all.filter(|each| each["kind"].is_null() && each["optional"] == false);
                (
                    text(&package["name"]),
                    required.map(|each| text(&each["name"])).collect(),
                )
            })
            .collect();
        let members = metadata["workspace_members"].as_array().unwrap().iter();
        let ids = members
            .map(|id| (names[&text(id)].clone(), text(id)))
            .collect();
        let nodes = metadata["resolve"]["nodes"].as_array().unwrap().iter();
        let is_normal = |dependency: &&Value| {
            let kinds = dependency["dep_kinds"].as_array().unwrap();
            kinds.iter().any(|kind| kind["kind"].is_null())
        };
        let dependencies = nodes
            .map(|node| {
                let all = node["deps"].as_array().unwrap().iter();
                let normal = all.filter(is_normal).map(|each| text(&each["pkg"]));
                (text(&node["id"]), normal.collect())
            })
            .collect();
        Self {
            ids,
            names,
            dependencies,
            required,
        }
    }

    /// Returns the names of a crate's direct dependencies.
    fn direct(&self, name: &str) -> BTreeSet<&str> {
        let dependencies = self.dependencies[&self.ids[name]].iter();
        dependencies.map(|id| self.names[id].as_str()).collect()
    }

    /// Returns the names of all dependencies of a crate, without itself.
    fn tree(&self, name: &str) -> BTreeSet<&str> {
        let mut waiting = vec![&self.ids[name]];
        let mut seen = BTreeSet::new();
        while let Some(id) = waiting.pop() {
            for dependency in &self.dependencies[id] {
                if seen.insert(dependency) {
                    waiting.push(dependency);
                }
            }
        }
        seen.into_iter().map(|id| self.names[id].as_str()).collect()
    }
}

fn package(room: &str) -> String {
    match room {
        "cli" => "ros2probe".to_owned(),
        room => format!("ros2probe-{room}"),
    }
}

#[test]
fn no_crate_depends_on_one_above_it() {
    let workspace = Workspace::read();
    let mut listed = BTreeSet::from(["ros2probe-testing".to_owned()]);
    for (place, (room, allowed)) in ALLOWED.iter().enumerate() {
        let lower = ALLOWED[..place].iter().map(|(lower, _)| lower);
        let lower: Vec<_> = lower.collect();
        let name = package(room);
        for allowed in *allowed {
            assert!(
                lower.contains(&allowed),
                "{room} may not be allowed {allowed}"
            );
        }
        for other in workspace.direct(&name) {
            if !workspace.ids.contains_key(other) {
                continue;
            }
            let is_allowed = allowed.iter().any(|allowed| package(allowed) == other);
            assert!(is_allowed, "{name} must not depend on {other}");
        }
        listed.insert(name);
    }
    let members: BTreeSet<_> = workspace.ids.keys().cloned().collect();
    assert_eq!(listed, members, "each crate needs a row in ALLOWED");
}

#[test]
fn the_model_is_built_without_input_output_or_configuration() {
    let workspace = Workspace::read();
    let tree = workspace.tree("ros2probe-model");
    for library in NOT_IN_MODEL {
        assert!(
            !tree.contains(library),
            "ros2probe-model must not need {library}"
        );
    }
}

#[test]
fn the_api_crate_depends_only_on_serde() {
    let workspace = Workspace::read();
    let required = &workspace.required["ros2probe-api"];
    assert_eq!(*required, BTreeSet::from(["serde".to_owned()]));
}

#[test]
fn crates_below_the_daemon_need_no_runtime() {
    let workspace = Workspace::read();
    // The crate `metrics` is left out, because its export thread has a runtime, and the crate
    // `ship`, which is the program `rp ship`.
    for room in ["wire", "model", "capture", "message", "bag", "api", "page"] {
        let name = package(room);
        let tree = workspace.tree(&name);
        for library in NO_RUNTIME {
            assert!(!tree.contains(library), "{name} must not need {library}");
        }
    }
}

#[test]
fn each_chosen_package_is_used_for_its_purpose() {
    let workspace = Workspace::read();
    for (package, crate_name, source, uses) in CHOSEN {
        let required = &workspace.required[*crate_name];
        assert!(
            required.contains(*package),
            "{crate_name} must need {package}"
        );
        let text = read(source);
        for phrase in *uses {
            assert!(
                text.contains(phrase),
                "{source} must use {package}: {phrase}"
            );
        }
    }
    // The kernel programs are a separate workspace.
    assert!(read("agent-ebpf/Cargo.toml").contains("\naya-ebpf = "));
    let programs = read("agent-ebpf/src/host.rs");
    assert!(programs.contains("use aya_ebpf::{"));
}

#[test]
fn no_source_contains_text_that_a_chosen_package_writes() {
    let mut waiting = vec![ros2probe_testing::repository("agent")];
    let mut sources = 0;
    while let Some(path) = waiting.pop() {
        if path.is_dir() {
            let entries = std::fs::read_dir(&path).unwrap();
            waiting.extend(entries.map(|entry| entry.unwrap().path()));
        }
        let is_product = path.components().any(|part| part.as_os_str() == "src")
            && !path.starts_with(ros2probe_testing::repository("agent/testing"));
        if !is_product || path.extension().is_none_or(|extension| extension != "rs") {
            continue;
        }
        sources += 1;
        let text = std::fs::read_to_string(&path).unwrap();
        let product = text.split("#[cfg(test)]").next().unwrap_or_default();
        for phrase in WRITTEN_BY_PACKAGES {
            assert!(!product.contains(phrase), "{}: {phrase:?}", path.display());
        }
    }
    assert!(sources > 300, "{sources} sources");
}

fn read(source: &str) -> String {
    let path = ros2probe_testing::repository(source);
    std::fs::read_to_string(&path).unwrap_or_else(|error| panic!("{}: {error}", path.display()))
}
