//! Basis of the live tests and the demo: hosts made of a network namespace and a cgroup, DDS peers
//! and the agent started inside them, packet loss, and the resulting logs and metrics.
//!
//! All names contain the process id and a counter, so tests run in parallel. Dropping a value
//! removes what it created, even if a test panics. If a tool is missing the harness fails and names
//! the package to install; it never skips.

pub mod agent;
pub mod alertmanager;
pub mod bpf;
pub mod capture;
pub mod cgroup;
pub mod code;
pub mod dissection;
pub mod event_log;
pub mod failing_disk;
pub mod loss;
pub mod network;
pub mod peer;
pub mod process;
pub mod prometheus;
pub mod quota;
pub mod relay;
pub mod shape;
pub mod shared_memory;
pub mod snmp;
pub mod soak;
pub mod switch;
pub mod tcx;
pub mod traced_program;
pub mod usage;
pub mod witness;

use std::path::Path;
use std::process::Command;
use std::time::{Duration, Instant};

use anyhow::{Context as _, Result, bail, ensure};

/// Tools used by the harness, with the Debian or Ubuntu package of each.
const TOOLS: [(&str, &str); 8] = [
    ("ip", "iproute2"),
    ("nft", "nftables"),
    ("ethtool", "ethtool"),
    ("nsenter", "util-linux"),
    ("setpriv", "util-linux"),
    ("sysctl", "procps"),
    ("curl", "curl"),
    ("tcpdump", "tcpdump"),
];

/// Prefix of the names of namespaces and cgroups, before the process id.
pub const PREFIX: &str = "r2p";

/// Fails unless this process is root and every tool is installed.
pub fn require() -> Result<()> {
    let status = std::fs::read_to_string("/proc/self/status").context("cannot read /proc")?;
    let effective = status.lines().find_map(|line| line.strip_prefix("Uid:"));
    if effective.and_then(|ids| ids.split_whitespace().nth(1)) != Some("0") {
        bail!("network namespaces need root: run `sudo -E make test`");
    }
    let path = std::env::var_os("PATH").unwrap_or_default();
    for (tool, package) in TOOLS {
        if !std::env::split_paths(&path).any(|directory| directory.join(tool).exists()) {
            bail!("`{tool}` is missing: run `apt-get install {package}` or `make prerequisites`");
        }
    }
    Ok(())
}

/// Evaluates `holds` ten times per second until it is true, for at most a minute.
pub fn wait_until(what: &str, holds: impl FnMut() -> Result<bool>) -> Result<()> {
    wait_within(Duration::from_secs(60), what, holds)
}

/// Waits as [`wait_until`] does, for a limited time.
pub fn wait_within(
    limit: Duration,
    what: &str,
    mut holds: impl FnMut() -> Result<bool>,
) -> Result<()> {
    let deadline = Instant::now() + limit;
    while !holds()? {
        ensure!(Instant::now() < deadline, "{what}: not within {limit:?}");
        std::thread::sleep(Duration::from_millis(100));
    }
    Ok(())
}

/// Completes after this many seconds, if any, or when a person or a service manager ends the
/// program.
pub async fn ended(after: Option<f64>) -> Result<()> {
    use tokio::signal::unix::{SignalKind, signal};
    let mut terminate = signal(SignalKind::terminate())?;
    let limit = async {
        match after {
            Some(seconds) => tokio::time::sleep(Duration::from_secs_f64(seconds.max(0.0))).await,
            None => std::future::pending().await,
        }
    };
    tokio::select! {
        interrupted = tokio::signal::ctrl_c() => interrupted?,
        _ = terminate.recv() => {}
        () = limit => {}
    }
    Ok(())
}

/// Runs a command line of words without spaces; fails with its output.
pub fn run(line: &str) -> Result<String> {
    let mut words = line.split_whitespace();
    let program = words.next().context("an empty command")?;
    let output = Command::new(program)
        .args(words)
        .output()
        .with_context(|| format!("cannot run `{line}`"))?;
    if !output.status.success() {
        bail!(
            "`{line}` failed: {}",
            String::from_utf8_lossy(&output.stderr).trim()
        );
    }
    Ok(String::from_utf8_lossy(&output.stdout).into_owned())
}

/// Calls `remove` with each name in a directory whose creating process is gone.
fn remove_leftovers(directory: &Path, remove: impl Fn(&str)) {
    let Ok(entries) = std::fs::read_dir(directory) else {
        return;
    };
    for entry in entries.flatten() {
        let name = entry.file_name().to_string_lossy().into_owned();
        let mut parts = name.split('-');
        let (prefix, owner) = (parts.next(), parts.next());
        let Some(owner) = owner.filter(|_| prefix == Some(PREFIX)) else {
            continue;
        };
        if !Path::new("/proc").join(owner).exists() {
            remove(&name);
        }
    }
}
