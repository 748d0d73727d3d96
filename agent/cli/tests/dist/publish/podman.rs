//! podman with a storage of its own, and the commands of `docs/containers.md`.

use std::path::PathBuf;
use std::process::Command;
use std::time::Duration;

use anyhow::{Context as _, Result, ensure};
use ros2probe_testing::harness::process::Process;
use ros2probe_testing::harness::{require, wait_until};
use ros2probe_testing::repository as sources;

use super::{VERSION, succeed, tool};

/// A storage with the image of the release. podman runs in a mount namespace that has only version
/// 2 of the control groups, and crun puts containers into no group: otherwise both need rights that
/// this machine may lack. Dropping the value removes the containers and volumes.
pub struct Podman {
    /// Command prefix of each call, such as that of a host, with the mount namespace.
    enter: Vec<String>,
    storage: tempfile::TempDir,
    /// The process that keeps the mount namespace.
    _keeper: Process,
    /// Name of the image in the storage.
    pub image: String,
}

/// podman raises both to values that this machine may not permit.
const LIMITS: [&str; 2] = ["--ulimit=nofile=1024:1024", "--ulimit=nproc=1024:1024"];

impl Podman {
    /// Loads the image into a storage that podman uses behind a command prefix.
    pub fn load(enter: &[String]) -> Result<Self> {
        require()?;
        let unified = "mount -t cgroup2 cgroup2 /sys/fs/cgroup && echo ready && exec cat";
        let within: Vec<String> = match enter {
            [] => vec!["env".to_owned()],
            _ => enter.to_vec(),
        };
        let arguments = ["--mount", "sh", "-c", unified];
        let mut keeper = Process::start(&within, "unshare", arguments)?;
        keeper.wait_for("ready", Duration::from_secs(10))?;
        let mounts = format!("--mount=/proc/{}/ns/mnt", keeper.pid());
        let errors = "exec \"$@\" 2>&1";
        let inside = ["nsenter", &mounts, "sh", "-c", errors, "sh"].map(str::to_owned);
        let mut podman = Self {
            enter: within.into_iter().chain(inside).collect(),
            storage: tempfile::tempdir()?,
            _keeper: keeper,
            image: String::new(),
        };
        let printed = succeed(podman.command("load").arg("--input").arg(super::image()?))?;
        let (_, name) = printed.trim().rsplit_once(' ').context("not loaded")?;
        podman.image = name.to_owned();
        ensure!(name.ends_with(&format!("ros2probe:{VERSION}")), "{printed}");
        Ok(podman)
    }

    /// Returns the command prefix behind which podman runs. Standard error goes to standard output.
    pub fn enter(&self) -> &[String] {
        &self.enter
    }

    /// Returns the program.
    pub fn program() -> PathBuf {
        let unpacked = tool("usr/bin/podman");
        match unpacked.exists() {
            true => unpacked,
            false => "podman".into(),
        }
    }

    /// Returns the arguments of `podman VERB`. Those of the verb follow.
    pub fn arguments(&self, verb: &str) -> Vec<String> {
        let mut words = Vec::new();
        for (option, place) in [
            ("--root", "root"),
            ("--runroot", "run"),
            ("--tmpdir", "tmp"),
        ] {
            let place = self.storage.path().join(place);
            words.extend([option.to_owned(), place.display().to_string()]);
        }
        let rest = [
            "--cgroup-manager=cgroupfs",
            "--runtime-flag=cgroup-manager=disabled",
            "--events-backend=none",
            verb,
        ];
        words.extend(rest.map(str::to_owned));
        words
    }

    /// Returns `podman VERB`.
    pub fn command(&self, verb: &str) -> Command {
        let mut command = Command::new(&self.enter[0]);
        command.args(&self.enter[1..]).arg(Self::program());
        command.args(self.arguments(verb));
        command
    }

    /// Returns the arguments of `podman run` with these options. The image follows.
    pub fn run(&self, options: &Options) -> Vec<String> {
        let mut words = self.arguments("run");
        words.extend(LIMITS.map(str::to_owned));
        words.extend_from_slice(&options.0);
        words
    }

    /// Starts the image in the foreground, with these arguments after its name.
    pub fn start(&self, options: &Options, arguments: &[&str]) -> Result<Process> {
        let mut words = self.run(options);
        words.push(self.image.clone());
        words.extend(arguments.iter().map(|&word| word.to_owned()));
        Process::start(&self.enter, Self::program(), words)
    }

    /// Kills and removes all containers. Without a control group, `podman stop` and `podman rm` end
    /// no container that has the process ids of the host.
    pub fn remove_containers(&self) -> Result<()> {
        wait_until("removed containers", || {
            let mut kill = self.command("kill");
            kill.args(["--all", "--signal", "KILL"]).output()?;
            let mut remove = self.command("rm");
            remove.args(["--all", "--force", "--time", "0"]);
            Ok(remove.output()?.status.success())
        })
    }
}

impl Drop for Podman {
    fn drop(&mut self) {
        let removed = self.remove_containers().and_then(|()| {
            let mut volumes = self.command("volume");
            succeed(volumes.args(["rm", "--all", "--force"])).map(drop)
        });
        if let Err(error) = removed {
            eprintln!("{error:#}");
        }
    }
}

/// Options of a command in `docs/containers.md`.
#[derive(Clone, Debug)]
pub struct Options(pub Vec<String>);

impl Options {
    /// Returns the options of the `podman run` that has this one. Limits that this machine may not
    /// permit, and a restart, are left out.
    pub fn documented(with: &str) -> Result<Self> {
        let text = std::fs::read_to_string(page())?.replace("\\\n", " ");
        let mut lines = text.lines().filter(|line| line.contains("podman run "));
        let line = lines.find(|line| line.contains(with));
        let line = line.with_context(|| format!("no podman run with {with}"))?;
        let (_, line) = line.split_once("podman run ").context("no command")?;
        let mut found = Vec::new();
        let mut words = line.split_whitespace().peekable();
        while let Some(option) = words.next_if(|word| word.starts_with("--")) {
            if option == "--detach" {
                continue;
            }
            let value = match option.contains('=') || option == "--read-only" {
                true => None,
                false => Some(words.next().context("no value")?),
            };
            if !["--restart", "--ulimit", "--name"].contains(&option) {
                found.push(option.to_owned());
                found.extend(value.map(str::to_owned));
            }
        }
        let image = words.next().unwrap_or_default();
        ensure!(image == format!("ros2probe:{VERSION}"), "{line}");
        Ok(Self(found))
    }

    /// Adds an option with its value.
    pub fn with(mut self, option: &str, value: &str) -> Self {
        self.0.extend([option.to_owned(), value.to_owned()]);
        self
    }

    /// Removes an option with its value, which must be there.
    pub fn without(mut self, option: &str, value: &str) -> Result<Self> {
        let mut pairs = self.0.windows(2);
        let at = pairs.position(|pair| pair[0] == option && pair[1].starts_with(value));
        let at = at.with_context(|| format!("no {option} {value} in {:?}", self.0))?;
        self.0.drain(at..at + 2);
        Ok(self)
    }
}

/// Returns the page about containers.
pub fn page() -> PathBuf {
    sources("docs/containers.md")
}
