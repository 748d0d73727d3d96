//! A Debian host: a container over a fresh system, whose writes go to memory.

use std::fs::File;
use std::io;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Output, Stdio};
use std::sync::atomic::{AtomicU32, Ordering};

use anyhow::{Context as _, Result, bail, ensure};

use super::all;
use ros2probe_testing::harness::cgroup::Cgroup;
use ros2probe_testing::harness::{PREFIX, require, wait_until};

/// The container's first process.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Start {
    Systemd,
    /// No service manager, as in a chroot or in most containers.
    Nothing,
}

/// A container that ends when this value is dropped.
pub(crate) struct Debian {
    container: Child,
    /// Process id of the container's first process.
    first: u32,
    /// Output of the container and of its first process.
    console: PathBuf,
    cgroup: Cgroup,
}

/// Runs a command over the fresh system in `$0`, and writes to memory. `$1` is the directory for
/// the mounts; the command follows.
const CHROOT_COMMAND: &str = "set -e; mkdir -p \"$1\"; mount -t tmpfs tmpfs \"$1\"; \
    mkdir \"$1/new\" \"$1/work\" \"$1/root\"; \
    mount -t overlay -o \"lowerdir=$0,upperdir=$1/new,workdir=$1/work\" overlay \"$1/root\"; \
    shift; exec \"$@\" </dev/null";

impl Debian {
    /// Starts a host whose `/packages` is `packages`.
    pub(crate) fn start(start: Start, packages: &Path) -> Result<Self> {
        require()?;
        let system = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../target/tools/debian");
        ensure!(
            system.join("complete").exists(),
            "no Debian system in {}: run `.ci/prerequisites.sh test`",
            system.display()
        );
        // Hosts of one process run at the same time.
        static STARTED: AtomicU32 = AtomicU32::new(0);
        let number = STARTED.fetch_add(1, Ordering::Relaxed);
        let name = format!("{PREFIX}-{}-{start:?}{number}", std::process::id()).to_lowercase();
        let cgroup = Cgroup::create(&name)?;
        let place = packages.join(&name);
        let mut words = cgroup.inside();
        words.extend(["unshare", "--mount", "sh", "-c", CHROOT_COMMAND].map(str::to_owned));
        words.push(system.display().to_string());
        words.push(place.display().to_string());
        words.extend(
            [
                "systemd-nspawn",
                "--quiet",
                "--register=no",
                "--keep-unit",
                "--private-network",
                "--console=pipe",
                "--capability=all",
                "--system-call-filter=bpf perf_event_open",
            ]
            .map(str::to_owned),
        );
        words.push(format!("--machine={name}"));
        words.push(format!("--directory={}", place.join("root").display()));
        words.push(format!("--bind-ro={}:/packages", packages.display()));
        match start {
            Start::Systemd => words.push("--boot".to_owned()),
            Start::Nothing => words.extend(["--as-pid2", "sleep", "infinity"].map(str::to_owned)),
        }
        let console = packages.join(format!("{name}.log"));
        let log = File::create(&console)?;
        let (program, arguments) = words.split_first().context("no words")?;
        let container = Command::new(program)
            .args(arguments)
            // Hosts have only version 2; a mixture of both versions is specific to this machine.
            .env("SYSTEMD_NSPAWN_UNIFIED_HIERARCHY", "1")
            .stdin(Stdio::null())
            .stdout(log.try_clone()?)
            .stderr(log)
            .spawn()
            .context("cannot start the container")?;
        let mut host = Self {
            container,
            first: 0,
            console,
            cgroup,
        };
        host.wait(start)?;
        Ok(host)
    }

    /// Returns the process id of the container's first process.
    pub(crate) fn first(&self) -> u32 {
        self.first
    }

    /// Returns the command prefix that runs a program of this machine on the host's network and in
    /// a control group of the host. systemd-nspawn names the root of these groups `payload`.
    pub(crate) fn on_host_network(&self) -> Vec<String> {
        let enter = "mkdir -p \"$0\" && echo 0 >\"$0/cgroup.procs\" && exec \"$@\"";
        let group = self
            .cgroup
            .path()
            .join("payload/beside")
            .display()
            .to_string();
        let network = format!("--net=/proc/{}/ns/net", self.first);
        ["sh", "-c", enter, &group, "nsenter", &network]
            .map(str::to_owned)
            .to_vec()
    }

    /// Runs a script that must succeed, and returns its output.
    pub(crate) fn run(&self, script: &str) -> Result<String> {
        let output = self.run_script(script)?;
        ensure!(
            output.status.success(),
            "{script}: {}\n{}",
            output.status,
            all(&output)
        );
        Ok(String::from_utf8_lossy(&output.stdout).into_owned())
    }

    /// Runs a script, and returns its exit status and output.
    pub(crate) fn run_script(&self, script: &str) -> Result<Output> {
        let first = self.first.to_string();
        let mut command = Command::new("nsenter");
        command.args(["--target", &first, "--all", "env", "--ignore-environment"]);
        command.args([
            "PATH=/usr/sbin:/usr/bin:/sbin:/bin",
            "LC_ALL=C.UTF-8",
            "HOME=/root",
        ]);
        command.args(["DEBIAN_FRONTEND=noninteractive", "bash", "-c", script]);
        command.stdin(Stdio::null());
        command.output().context("nsenter")
    }

    /// Runs a script, and returns its output whatever its exit status.
    pub(crate) fn text(&self, script: &str) -> Result<String> {
        Ok(all(&self.run_script(script)?))
    }

    /// Returns the answer of a port of the container.
    pub(crate) fn get(&self, port: u16, path: &str) -> Result<String> {
        self.run(&format!(
            "exec 3<>/dev/tcp/127.0.0.1/{port} && \
             printf 'GET {path} HTTP/1.0\\r\\nHost: localhost\\r\\n\\r\\n' >&3 && cat <&3"
        ))
    }

    fn wait(&mut self, start: Start) -> Result<()> {
        let nspawn = self.container.id();
        let children = format!("/proc/{nspawn}/task/{nspawn}/children");
        wait_until("the container's first process", || {
            if let Some(status) = self.container.try_wait()? {
                bail!("{status}\n{}", std::fs::read_to_string(&self.console)?);
            }
            let text = std::fs::read_to_string(&children)?;
            self.first = text.split_whitespace().next().map_or(Ok(0), str::parse)?;
            // A process that prepares the container precedes its first process, and soon ends.
            let (is_up, printed): (_, &[_]) = match start {
                Start::Systemd => ("systemctl is-system-running", &["running", "degraded"]),
                Start::Nothing => ("cat /proc/1/comm", &["(sd-stubinit)"]),
            };
            Ok(self.first != 0 && printed.contains(&self.text(is_up)?.trim()))
        })
    }
}

impl Drop for Debian {
    fn drop(&mut self) {
        let _ = self.container.kill();
        let _ = self.container.wait();
        // Kills all processes inside, then removes their groups, also in the hierarchy of version 1
        // if systemd uses it.
        let _ = std::fs::write(self.cgroup.path().join("cgroup.kill"), "1");
        let own = self.cgroup.path().file_name().unwrap_or_default();
        let own = Path::new("/sys/fs/cgroup/systemd").join(own);
        for group in [self.cgroup.path(), &own] {
            let gone = || Ok(!group.exists() || remove_below(group).is_ok());
            if let Err(error) = wait_until("nobody in a container", gone) {
                eprintln!("{}: {error}", group.display());
            }
        }
        let _ = std::fs::remove_dir(own);
    }
}

/// Removes the control groups below this one.
fn remove_below(group: &Path) -> io::Result<()> {
    for entry in group.read_dir()? {
        let entry = entry?;
        if entry.file_type()?.is_dir() {
            remove_below(&entry.path())?;
            std::fs::remove_dir(entry.path())?;
        }
    }
    Ok(())
}
