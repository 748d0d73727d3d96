//! Files that `make release` creates in `target/publish`, which `ROS2PROBE_DIST` names. Other
//! projects' programs verify, install and run them: minisign, pip, podman, apt.

mod containers;
mod crates;
mod deploy;
mod feed;
mod image;
pub mod podman;
mod provenance;
mod repository;
mod ros;
mod ways;
mod wheel;

use std::path::{Path, PathBuf};
use std::process::{Command, Output};

use anyhow::{Context as _, Result, ensure};
use ros2probe_testing::harness::wait_until;
use ros2probe_testing::local_agent::LocalAgent;
use ros2probe_testing::repository as sources;

use super::binaries::program;
use super::package::installation::{all, succeed};

const VERSION: &str = env!("CARGO_PKG_VERSION");

/// Returns the directory. Fails for one that only `make dist` has written.
fn published() -> Result<PathBuf> {
    let directory = program::directory().context("ROS2PROBE_DIST is unset: run `make release`")?;
    let signature = directory.join("SHA256SUMS.minisig");
    ensure!(
        signature.exists(),
        "no {}: run `make release`",
        signature.display()
    );
    Ok(directory)
}

/// Returns the release's Debian package of an architecture.
fn package(architecture: &str) -> Result<PathBuf> {
    let name = format!("ros2probe_{VERSION}_{architecture}.deb");
    Ok(published()?.join(name))
}

/// Returns the image of all architectures.
fn image() -> Result<PathBuf> {
    Ok(published()?.join(format!("ros2probe-{VERSION}-image.tar")))
}

/// Returns a command for a script in `packaging/`, with the time of the release.
fn packaging(script: &str) -> Result<Command> {
    let date = succeed(
        Command::new("git")
            .args(["log", "-1", "--format=%ct"])
            .current_dir(sources("")),
    )?;
    let mut command = Command::new(sources("packaging").join(script));
    command.env("SOURCE_DATE_EPOCH", date.trim());
    Ok(command)
}

/// Returns a program that `.ci/prerequisites.sh` unpacks below `target/tools`.
fn tool(path: &str) -> PathBuf {
    sources("target/tools").join(path)
}

/// Runs a command that must fail, and returns its output.
fn refuse(command: &mut Command) -> Result<String> {
    let output = command.output().with_context(|| format!("{command:?}"))?;
    ensure!(!output.status.success(), "{command:?}: {}", all(&output));
    Ok(all(&output))
}

/// Replays a capture with a binary of a release for aarch64, and waits for the first metric. It runs
/// under qemu elsewhere.
fn measures_on_arm(binary: &Path) -> Result<()> {
    let capture = sources("wire/tests/data/cyclonedds-samehost-any.pcap.gz");
    let mut command = program::command("aarch64", binary);
    let agent = LocalAgent::replay(
        &mut command,
        &capture,
        &["--speed", "max", "--watch", "/**"],
    );
    let series = "ros2_topic_messages_total{domain_id=\"0\",topic=\"/chatter\"";
    wait_until("the first metric", || {
        let page = agent.get("/metrics").body;
        Ok(page
            .lines()
            .any(|line| line.starts_with(series) && !line.ends_with(" 0")))
    })
}

/// Runs a binary of a release for aarch64, under qemu elsewhere.
fn on_arm(binary: &Path, arguments: &[&str]) -> Result<Output> {
    let mut command = program::command("aarch64", binary);
    command.args(arguments).output().context("qemu")
}
