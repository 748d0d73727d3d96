//! Each way to get `rp`: from a fresh host to the first metric of a robot, and back to a host
//! without a trace.
//!
//! The durations are printed. Nothing but the patience of a person limits them, because the machine
//! may be busy.

use std::collections::BTreeSet;
use std::fs;
use std::io::Write as _;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::{Duration, Instant};

use anyhow::{Context as _, Result, ensure};
use ros2probe_testing::harness::agent::{Agent, Scrape, at_the_sockets_of};
use ros2probe_testing::harness::network::Namespace;
use ros2probe_testing::harness::peer::robot;
use ros2probe_testing::harness::process::Process;
use ros2probe_testing::harness::wait_within;
use serde_json::json;

use super::containers::{seccomp, start_in_container};
use super::podman::{Options, Podman};
use super::repository::{ADDRESS, listen, serve};
use super::{VERSION, all, deploy, package, published, succeed, tool};
use crate::ansible::Ansible;
use crate::package::installation::debian::{Debian, Start};

/// Maximum time from the start of an agent to the first metric.
const PATIENCE: Duration = Duration::from_secs(60);
/// The network of a container: loopback, and an interface with a route for multicast.
const NETWORK: &str = "ip link set lo multicast on up && \
    ip link add robot type veth peer name unplugged && ip link set unplugged up && \
    ip addr add 10.99.0.1/24 dev robot && ip link set robot up && \
    ip route add 239.0.0.0/8 dev robot";
/// Prints each path with its type, mode, owner and target, and the checksum of each file in `/etc`.
/// Left out are file systems in memory, logs, caches of apt, backups, and files that systemd writes
/// while it runs.
const LIST_PATHS: &str = r"find / -xdev \( -path /proc -o -path /sys -o -path /dev -o -path /run -o -path /tmp \
    -o -path /packages -o -path /var/log -o -path /var/cache/apt -o -path /var/lib/apt \
    -o -path '/var/lib/dpkg/*-old' -o -path /var/lib/systemd/timers -o -path /var/lib/systemd/random-seed \
    -o -path /var/lib/private -o -path '/etc/*-' \) -prune -o -printf '%p %y %m %U:%G %l\n' | sort;
    find /etc -type f ! -name '*-' -exec sha256sum {} + | sort -k 2";

/// A publisher and a subscriber of a topic, which no other test has: some agents observe the whole
/// machine.
struct Robot {
    topic: &'static str,
    _nodes: [Process; 2],
}

impl Robot {
    /// Starts the nodes behind a command prefix.
    fn start(prefix: &[String], topic: &'static str) -> Result<Self> {
        let program = robot()?;
        ensure!(
            program.exists(),
            "no {}: cargo build --example robot",
            program.display()
        );
        let node = |role: &str, name: &str| {
            let words = format!(
                "--role {role} --topic {topic} --node {name} --size 320 --rate 50 --depth 200"
            );
            Process::start(prefix, &program, words.split(' '))
        };
        let nodes = [node("sub", "/ekf")?, node("pub", "/driver")?];
        Ok(Self {
            topic,
            _nodes: nodes,
        })
    }

    /// Returns whether a page of metrics has counted messages of the robot.
    fn is_counted(&self, page: &str) -> bool {
        let topic = [("topic", self.topic)];
        Scrape(page.to_owned()).sum("ros2_topic_messages_total", &topic) > 0.0
    }
}

/// Returns a configuration that measures every topic at the sockets of a host.
pub(super) fn everything_at(host: &Namespace) -> String {
    format!("watch: [/**]\n{}", at_the_sockets_of(host))
}

/// Starts a robot beside an agent that is ready, and waits for the first metric of its topic.
pub(super) fn measures(
    agent: &Agent<'_>,
    way: &str,
    topic: &'static str,
    began: Instant,
) -> Result<()> {
    let ready = began.elapsed();
    let robot = Robot::start(&agent.host.inside(), topic)?;
    agent.scrape_until("measured", |page| robot.is_counted(&page.0))?;
    report(way, ready, began)
}

/// Prints how long a way took, past the capture of output by the test program.
fn report(way: &str, ready: Duration, began: Instant) -> Result<()> {
    let (ready, measured) = (ready.as_secs_f64(), began.elapsed().as_secs_f64());
    writeln!(
        std::io::stderr(),
        "{way}: ready after {ready:.1} s, first metric of a robot after {measured:.1} s"
    )?;
    Ok(())
}

/// A fresh Debian. The fields are dropped in this order.
struct FreshDebian {
    host: Debian,
    /// Paths of the host before the installation.
    before: String,
    _directory: tempfile::TempDir,
}

impl FreshDebian {
    /// Starts a host whose `/packages` is a copy of these files of the release. The repository is
    /// its only source of packages.
    fn start(start: Start, files: &[PathBuf]) -> Result<Self> {
        let directory = tempfile::tempdir()?;
        serve(directory.path())?;
        for file in files {
            let name = file.file_name().context("no name")?;
            fs::copy(file, directory.path().join(name))?;
        }
        let host = Debian::start(start, directory.path())?;
        let mut network = Command::new("nsenter");
        network.arg(format!("--net=/proc/{}/ns/net", host.first()));
        succeed(network.args(["sh", "-c", NETWORK]))?;
        listen(&host)?;
        Ok(Self {
            before: host.run(LIST_PATHS)?,
            host,
            _directory: directory,
        })
    }

    /// Waits until the agent is ready, starts a robot, and waits for the first metric of its topic.
    fn measures(&self, way: &str, topic: &'static str, began: Instant) -> Result<()> {
        let get = |path: &str| self.host.get(17400, path).unwrap_or_default();
        wait_within(PATIENCE, way, || Ok(get("/readyz").contains("200 OK")))
            .with_context(|| self.log())?;
        let ready = began.elapsed();
        let robot = Robot::start(&self.host.on_host_network(), topic)?;
        wait_within(PATIENCE, way, || Ok(robot.is_counted(&get("/metrics"))))
            .with_context(|| self.log())?;
        report(way, ready, began)
    }

    /// Returns the log of the agent.
    fn log(&self) -> String {
        let text = "cat /tmp/log; journalctl --unit ros2probe --output cat";
        self.host.text(text).unwrap_or_default()
    }

    /// Starts a program in the background, whose process id is in `/tmp/pid`.
    fn run_agent(&self, program: &str) -> Result<()> {
        self.host
            .run(&format!(
                "{program} run --watch '/**' >/tmp/log 2>&1 & echo $! >/tmp/pid"
            ))
            .map(drop)
    }

    /// Ends the program of [`Self::run_agent`].
    fn end_agent(&self) -> Result<()> {
        self.host
            .run("kill $(cat /tmp/pid); while kill -0 $(cat /tmp/pid) 2>/dev/null; do sleep 0.1; done")
            .map(drop)
    }

    /// Checks that the host is as before the installation.
    fn check_unchanged(&self) -> Result<()> {
        let after = self.host.run(LIST_PATHS)?;
        let before: BTreeSet<&str> = self.before.lines().collect();
        let after: BTreeSet<&str> = after.lines().collect();
        let left: Vec<_> = after.difference(&before).collect();
        let missing: Vec<_> = before.difference(&after).collect();
        ensure!(
            left.is_empty() && missing.is_empty(),
            "left: {left:#?}\nmissing: {missing:#?}"
        );
        Ok(())
    }
}

/// Removes the package with its user, as `docs/install.md` describes.
const PURGE: &str = "apt-get purge --yes ros2probe && deluser --system ros2probe";

#[test]
#[ignore = "looks at a release: make release"]
fn the_repository_for_apt() -> Result<()> {
    let fresh = FreshDebian::start(Start::Systemd, &[])?;
    let host = &fresh.host;
    let began = Instant::now();
    host.run(&format!(
        "install -d /etc/apt/keyrings; cp /packages/apt/ros2probe.asc /etc/apt/keyrings; \
         echo 'deb [signed-by=/etc/apt/keyrings/ros2probe.asc] {ADDRESS} stable main' \
         >/etc/apt/sources.list.d/ros2probe.list; \
         apt-get update && apt-get install --yes ros2probe"
    ))?;
    fresh.measures("repository for apt", "/by_repository", began)?;
    host.run(PURGE)?;
    host.run("rm /etc/apt/keyrings/ros2probe.asc /etc/apt/sources.list.d/ros2probe.list")?;
    fresh.check_unchanged()
}

#[test]
#[ignore = "looks at a release: make release"]
fn the_role_measures_and_removes_everything() -> Result<()> {
    let directory = tempfile::tempdir()?;
    let playbook = deploy::released(directory.path())?.join("deploy/ansible/site.yaml");
    let fresh = FreshDebian::start(Start::Systemd, &[])?;
    let ansible = Ansible::over(&fresh.host, directory.path(), playbook)?;
    let key = published()?.join("apt/ros2probe.asc");
    let apply = |state: &str| -> Result<()> {
        let output = ansible.apply(&json!({
            "ros2probe_repository": ADDRESS,
            "ros2probe_repository_key": key,
            "ros2probe_state": state,
        }))?;
        ensure!(
            output.status.success(),
            "{state}: {}{}",
            all(&output),
            fresh.log()
        );
        Ok(())
    };
    let began = Instant::now();
    apply("present")?;
    fresh.measures("Ansible role", "/by_role", began)?;
    apply("absent")?;
    fresh.check_unchanged()
}

#[test]
#[ignore = "looks at a release: make release"]
fn the_package_measures_and_is_removed_without_a_trace() -> Result<()> {
    let own = match std::env::consts::ARCH {
        "aarch64" => package("arm64")?,
        _ => package("amd64")?,
    };
    let fresh = FreshDebian::start(Start::Systemd, &[own])?;
    let began = Instant::now();
    fresh.host.run("apt-get install --yes /packages/*.deb")?;
    fresh.measures("package", "/by_package", began)?;
    fresh.host.run(PURGE)?;
    fresh.check_unchanged()
}

#[test]
#[ignore = "looks at a release: make release"]
fn the_wheel_measures_and_is_removed_without_a_trace() -> Result<()> {
    let wheel = super::wheel::name(std::env::consts::ARCH);
    let fresh = FreshDebian::start(Start::Nothing, &[published()?.join(wheel)])?;
    let began = Instant::now();
    fresh.host.run(
        "python3 -m venv /opt/rp && \
         /opt/rp/bin/pip install --no-index --no-cache-dir /packages/*.whl",
    )?;
    fresh.run_agent("/opt/rp/bin/rp")?;
    fresh.measures("wheel in a venv", "/by_wheel", began)?;
    fresh.end_agent()?;
    fresh.host.run(
        "/opt/rp/bin/pip uninstall --yes ros2probe && \
         ! find /opt/rp -name '*ros2probe*' -o -name rp -type f | grep . && rm -r /opt/rp",
    )?;
    fresh.check_unchanged()
}

#[test]
#[ignore = "looks at a release: make release"]
fn the_static_binary_measures_and_is_removed_without_a_trace() -> Result<()> {
    let name = format!("rp-{VERSION}-{}", std::env::consts::ARCH);
    let fresh = FreshDebian::start(Start::Nothing, &[published()?.join(&name)])?;
    let began = Instant::now();
    fresh.host.run(&format!(
        "install -m 755 /packages/{name} /usr/local/bin/rp"
    ))?;
    fresh.run_agent("/usr/local/bin/rp")?;
    fresh.measures("static binary", "/by_binary", began)?;
    fresh.end_agent()?;
    fresh.host.run("rm /usr/local/bin/rp")?;
    fresh.check_unchanged()
}

#[test]
#[ignore = "looks at a release: make release"]
fn the_image_measures_and_is_removed_without_a_trace() -> Result<()> {
    let host = Namespace::isolated()?;
    let directory = tempfile::tempdir()?;
    let options = Options::documented("--network host")?
        .with("--name", "way")
        .with("--security-opt", &seccomp(directory.path())?);
    let began = Instant::now();
    let podman = Podman::load(&host.inside())?;
    let mut agent = start_in_container(&podman, &options, &host)?;
    measures(&agent, "image by podman", "/by_image", began)?;
    let status = agent.process.terminate()?;
    ensure!(status.success(), "{status}");
    podman.remove_containers()?;
    for line in ["volume rm ros2probe-state ros2probe-run", "rmi --all"] {
        let mut words = line.split(' ');
        let mut command = podman.command(words.next().unwrap_or_default());
        succeed(command.args(words))?;
    }
    for line in [
        "ps --all --quiet",
        "volume ls --quiet",
        "images --all --quiet",
    ] {
        let mut words = line.split(' ');
        let mut command = podman.command(words.next().unwrap_or_default());
        let left = succeed(command.args(words))?;
        ensure!(left.trim().is_empty(), "{line}: {left}");
    }
    Ok(())
}

#[test]
#[ignore = "looks at a release: make release"]
fn the_packages_for_ros() -> Result<()> {
    let host = Namespace::isolated()?;
    let directory = tempfile::tempdir()?;
    let place = directory.path();
    let began = Instant::now();
    let mut tar = Command::new("tar");
    tar.arg("--extract").arg("--directory").arg(place);
    tar.arg("--file")
        .arg(published()?.join(format!("ros2probe-{VERSION}-ros.tar.gz")));
    succeed(&mut tar)?;
    let before = paths(place)?;
    let mut colcon = Command::new(tool("ros/bin/colcon"));
    colcon.args(["--log-base", "log", "build", "--cmake-args"]);
    colcon.arg(format!(
        "-DROS2PROBE_DOWNLOADS=file://{}",
        published()?.display()
    ));
    colcon.arg("-DPython3_EXECUTABLE=/usr/bin/python3");
    colcon.env("COLCON_HOME", place.join("colcon"));
    succeed(colcon.current_dir(place))?;
    let configuration = place.join("robot.yaml");
    fs::write(&configuration, everything_at(&host))?;
    let program = place.join("install/ros2probe/lib/ros2probe/rp");
    let agent = Agent::start(&host, program, &configuration)?;
    measures(&agent, "packages for ROS by colcon", "/by_ros", began)?;
    drop(agent);
    fs::remove_file(configuration)?;
    for made in ["build", "install", "log"] {
        fs::remove_dir_all(place.join(made))?;
    }
    ensure!(paths(place)? == before, "{:?}", paths(place)?);
    Ok(())
}

/// Returns the paths below a directory.
fn paths(directory: &Path) -> Result<String> {
    succeed(
        Command::new("sh")
            .args(["-c", "find \"$0\" | sort"])
            .arg(directory),
    )
}
