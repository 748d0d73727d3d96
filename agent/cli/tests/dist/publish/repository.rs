//! The repository for apt: a fresh Debian installs from it through a plain web server, and refuses
//! what was changed after the signature.

use std::fs;
use std::os::unix::fs::PermissionsExt as _;
use std::path::Path;
use std::process::Command;

use anyhow::{Result, ensure};
use serde_json::json;

use super::{VERSION, all, published, succeed};
use crate::ansible::Managed;
use crate::package::installation::debian::{Debian, Start};
use ros2probe_testing::harness::wait_until;

pub(super) const ADDRESS: &str = "http://127.0.0.1:8000";

/// Copies the repository to where the host's web server reads it.
pub(super) fn serve(directory: &Path) -> Result<()> {
    // A tempdir is private, but apt downloads as the user _apt.
    fs::set_permissions(directory, fs::Permissions::from_mode(0o755))?;
    let mut copy = Command::new("cp");
    copy.arg("-a").arg(published()?.join("apt")).arg(directory);
    succeed(&mut copy).map(drop)
}

/// Starts the web server in a host, which has no other source of packages.
pub(super) fn listen(host: &Debian) -> Result<()> {
    host.run(
        "rm -f /etc/apt/sources.list; \
         python3 -m http.server 8000 --directory /packages/apt >/srv/log 2>&1 &",
    )?;
    wait_until("the web server", || {
        Ok(host.get(8000, "/dists/stable/InRelease").is_ok())
    })
}

/// Fails unless a script fails with this in its output.
fn refused(host: &Debian, script: &str, expected: &str) -> Result<()> {
    let output = host.run_script(script)?;
    ensure!(
        !output.status.success() && all(&output).contains(expected),
        "{script}: {}\n{}",
        output.status,
        all(&output)
    );
    Ok(())
}

/// Runs `change` on the content of a file of the repository, and puts the old content back after
/// `check`.
fn while_changed(
    path: &Path,
    change: impl Fn(&mut Vec<u8>),
    check: impl Fn() -> Result<()>,
) -> Result<()> {
    let old = fs::read(path)?;
    let mut new = old.clone();
    change(&mut new);
    ensure!(new != old, "{} is unchanged", path.display());
    fs::write(path, new)?;
    check()?;
    Ok(fs::write(path, old)?)
}

fn replaced(text: &mut Vec<u8>, from: &str, to: &str) {
    *text = String::from_utf8_lossy(text).replace(from, to).into_bytes();
}

#[test]
#[ignore = "looks at a release: make release"]
fn apt_installs_the_package_and_refuses_what_was_changed() -> Result<()> {
    let directory = tempfile::tempdir()?;
    serve(directory.path())?;
    let host = Debian::start(Start::Nothing, directory.path())?;
    listen(&host)?;
    // As docs/install.md describes.
    host.run(&format!(
        "install -d /etc/apt/keyrings; cp /packages/apt/ros2probe.asc /etc/apt/keyrings; \
         echo 'deb [signed-by=/etc/apt/keyrings/ros2probe.asc] {ADDRESS} stable main' \
         >/etc/apt/sources.list.d/ros2probe.list"
    ))?;
    let update = "apt-get update -o APT::Update::Error-Mode=any";
    let fresh = "rm -rf /var/lib/apt/lists/*; apt-get clean;";
    let repository = directory.path().join("apt");
    let suite = repository.join("dists/stable");

    host.run(update)?;
    for architecture in ["amd64", "arm64"] {
        host.run(&format!("dpkg --add-architecture {architecture}"))?;
        host.run(update)?;
        let name = format!("ros2probe_{VERSION}_{architecture}.deb");
        host.run(&format!(
            "cd /srv && apt-get download ros2probe:{architecture} && \
             cmp {name} /packages/apt/pool/main/r/ros2probe/{name}"
        ))?;
        let released = fs::read(published()?.join(&name))?;
        let served = fs::read(repository.join("pool/main/r/ros2probe").join(&name))?;
        ensure!(released == served, "{name}");
    }

    let own = host.run("dpkg --print-architecture")?;
    let package = format!(
        "pool/main/r/ros2probe/ros2probe_{VERSION}_{}.deb",
        own.trim()
    );
    let install = format!("{fresh} {update} && apt-get install --yes ros2probe");
    let last = |bytes: &mut Vec<u8>| bytes.last_mut().into_iter().for_each(|byte| *byte ^= 1);
    while_changed(&repository.join(package), last, || {
        refused(&host, &install, "Hash Sum mismatch")
    })?;
    let index = format!("main/binary-{}/Packages.gz", own.trim());
    while_changed(&suite.join(index), last, || {
        refused(&host, &format!("{fresh} {update}"), "Hash Sum mismatch")
    })?;
    let origin = |text: &mut Vec<u8>| replaced(text, "Origin: ros2probe", "Origin: stranger");
    while_changed(&suite.join("InRelease"), origin, || {
        refused(&host, &format!("{fresh} {update}"), "BADSIG")
    })?;

    host.run(&install)?;
    let version = host.run("rp --version")?;
    ensure!(version == format!("rp {VERSION}\n"), "{version}");
    let policy = host.run("apt-cache policy ros2probe")?;
    ensure!(
        policy.contains(&format!("{ADDRESS} stable/main")),
        "{policy}"
    );

    // Another key of the same name is no substitute.
    host.run("rm /etc/apt/keyrings/ros2probe.asc; touch /etc/apt/keyrings/ros2probe.asc")?;
    refused(&host, &format!("{fresh} {update}"), "NO_PUBKEY")
}

#[test]
#[ignore = "looks at a release: make release"]
fn the_role_installs_from_the_repository() -> Result<()> {
    let directory = tempfile::tempdir()?;
    serve(directory.path())?;
    let robot = Managed::start(directory.path())?;
    listen(&robot.host)?;
    let variables = json!({
        "ros2probe_repository": ADDRESS,
        "ros2probe_repository_key": published()?.join("apt/ros2probe.asc"),
        "ros2probe_version": VERSION,
    });
    ensure!(robot.changed(&variables)?, "nothing was installed");
    let version = robot.host.run("rp --version")?;
    ensure!(version == format!("rp {VERSION}\n"), "{version}");
    ensure!(!robot.changed(&variables)?, "a second run changed the host");
    let active = robot.host.text("systemctl is-active ros2probe.service")?;
    ensure!(active.trim() == "active", "{active}");
    Ok(())
}
