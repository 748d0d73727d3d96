//! The agent under test, and what it exports.

use std::collections::BTreeSet;
use std::ffi::OsStr;
use std::fs::File;
use std::path::Path;
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

use anyhow::{Context as _, Result, bail};

use super::network::Namespace;
use super::process::Process;

/// The metrics listener's built-in address: every host is its own, so the port is free.
pub(crate) const METRICS: &str = "http://127.0.0.1:17400";

/// What a test of packet sockets adds to its configuration.
pub(crate) const ON_THE_WIRE: &str = "capture: {source: wire}\n";

/// `rp run` on a host.
pub(crate) struct Agent<'a> {
    pub(crate) process: Process,
    pub(crate) host: &'a Namespace,
}

/// One answer of `/metrics`.
pub(crate) struct Scrape(pub(crate) String);

/// What a test of the host's sockets adds to its configuration.
pub(crate) fn at_the_sockets_of(host: &Namespace) -> String {
    let cgroup = host.cgroup().display();
    format!("capture: {{source: host, cgroup: {cgroup}}}\n")
}

impl<'a> Agent<'a> {
    /// Starts `rp run` (`env!("CARGO_BIN_EXE_rp")` in a test) and waits until it is ready.
    pub(crate) fn start(
        host: &'a Namespace,
        program: impl AsRef<OsStr>,
        configuration: &Path,
    ) -> Result<Agent<'a>> {
        Agent::start_with(host, program, configuration, Stdio::inherit())
    }

    /// As [`Agent::start`], with what the agent logs in a file.
    pub(crate) fn start_logging(
        host: &'a Namespace,
        program: impl AsRef<OsStr>,
        configuration: &Path,
        log: &Path,
    ) -> Result<Agent<'a>> {
        let file = File::create(log).with_context(|| format!("cannot create {}", log.display()))?;
        Agent::start_with(host, program, configuration, file.into())
    }

    fn start_with(
        host: &'a Namespace,
        program: impl AsRef<OsStr>,
        configuration: &Path,
        errors: Stdio,
    ) -> Result<Agent<'a>> {
        let arguments = [
            OsStr::new("run"),
            OsStr::new("--config"),
            configuration.as_os_str(),
        ];
        let process = Process::start_with(&host.on_network(), program, arguments, errors)?;
        let mut agent = Agent { process, host };
        agent.wait_ready(Duration::from_secs(10))?;
        Ok(agent)
    }

    pub(crate) fn wait_ready(&mut self, limit: Duration) -> Result<()> {
        let deadline = Instant::now() + limit;
        while let Err(error) = self.request("/readyz") {
            if let Ok(status) = self.process.wait(Duration::ZERO) {
                bail!("the agent ended with {status} before it was ready");
            }
            if Instant::now() > deadline {
                return Err(error.context(format!("the agent is not ready after {limit:?}")));
            }
            std::thread::sleep(Duration::from_millis(50));
        }
        Ok(())
    }

    pub(crate) fn scrape(&self) -> Result<Scrape> {
        Ok(Scrape(self.request("/metrics")?))
    }

    /// A scrape after the agent has had time to take over what the kernel still held.
    pub(crate) fn settled_scrape(&self) -> Result<Scrape> {
        std::thread::sleep(Duration::from_millis(3500));
        self.scrape()
    }

    /// GETs a path from inside the host; anything but success is an error.
    pub(crate) fn request(&self, path: &str) -> Result<String> {
        get(self.host, &format!("{METRICS}{path}"))
    }
}

impl Scrape {
    /// The value of the sample of `name` that has all of these labels.
    pub(crate) fn value(&self, name: &str, labels: &[(&str, &str)]) -> Option<f64> {
        self.samples(name, labels).next()
    }

    /// The sum over all samples of `name` that have these labels.
    pub(crate) fn sum(&self, name: &str, labels: &[(&str, &str)]) -> f64 {
        self.samples(name, labels).sum()
    }

    /// The values that a label takes over the samples of `name`.
    pub(crate) fn labels_of(&self, name: &str, label: &str) -> BTreeSet<String> {
        let start = format!("{label}=\"");
        let values = self.0.lines().filter_map(|line| {
            let labels = line.strip_prefix(name)?.strip_prefix('{')?;
            let (_, value) = labels.split_once(&start)?;
            Some(value.split_once('"')?.0.to_owned())
        });
        values.collect()
    }

    /// Every counter above zero that could explain a difference.
    pub(crate) fn doubts(&self) -> String {
        let telling = [
            "lost",
            "dropped",
            "incomplete",
            "evict",
            "duplicate",
            "errors",
            "recovered",
        ];
        let lines = self.0.lines().filter(|line| {
            !line.starts_with('#')
                && !line.ends_with(" 0")
                && telling.iter().any(|word| line.contains(word))
        });
        lines.collect::<Vec<_>>().join("; ")
    }

    fn samples(&self, name: &str, labels: &[(&str, &str)]) -> impl Iterator<Item = f64> {
        let wanted: Vec<String> = labels
            .iter()
            .map(|(label, value)| format!("{label}=\"{value}\""))
            .collect();
        self.0.lines().filter_map(move |line| {
            let (series, rest) = match line.split_once('{') {
                Some((series, rest)) => (series, rest),
                None => line.split_once(' ')?,
            };
            let (labels, value) = rest.rsplit_once("} ").unwrap_or(("", rest));
            let named = series == name && wanted.iter().all(|pair| has_label(labels, pair));
            let value = value.split_whitespace().next().filter(|_| named)?;
            value.parse().ok()
        })
    }
}

/// Whether `label="value"` stands in a label set at the start or after a comma.
fn has_label(labels: &str, pair: &str) -> bool {
    labels
        .match_indices(pair)
        .any(|(at, _)| at == 0 || labels.as_bytes().get(at - 1) == Some(&b','))
}

/// GETs a URL from inside a host.
pub(crate) fn get(host: &Namespace, url: &str) -> Result<String> {
    let [program, arguments @ ..] = &host.outside();
    let output = Command::new(program)
        .args(arguments)
        .args([
            "curl",
            "--silent",
            "--show-error",
            "--fail",
            "--max-time",
            "5",
            url,
        ])
        .output()
        .context("cannot run curl")?;
    if !output.status.success() {
        bail!("{url}: {}", String::from_utf8_lossy(&output.stderr).trim());
    }
    Ok(String::from_utf8_lossy(&output.stdout).into_owned())
}
