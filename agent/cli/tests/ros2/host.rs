//! A host of real ROS 2 nodes with one middleware, and of the agent that observes the nodes.

use std::fs;
use std::path::PathBuf;
use std::process::{Command, Stdio};

use anyhow::{Context as _, Result, ensure};
use ros2probe_testing::harness::agent::Agent;
use ros2probe_testing::harness::network::Namespace;
use ros2probe_testing::harness::process::Process;
use ros2probe_testing::harness::shared_memory::SharedMemory;
use ros2probe_testing::harness::wait_until;
use tempfile::TempDir;

use crate::installed;

pub const RP: &str = env!("CARGO_BIN_EXE_rp");
#[derive(Clone, Copy, PartialEq, Eq)]
pub enum Middleware {
    /// Shared memory, which the agent samples.
    FastSampled,
    /// Shared memory, with this value of `capture.shm.exact`.
    FastExact(&'static str),
    FastUdp,
    /// RTPS over TCP to other hosts, shared memory within a host. Humble has no such mode.
    FastLargeData,
    Cyclone,
    Zenoh,
}

/// The host, with its own `/dev/shm` and a directory for files.
pub struct Host<'n> {
    pub network: &'n Namespace,
    pub middleware: Middleware,
    shared_memory: SharedMemory,
    directory: TempDir,
}

impl<'n> Host<'n> {
    pub fn new(network: &'n Namespace, middleware: Middleware) -> Result<Self> {
        let directory = tempfile::tempdir()?;
        fs::write(directory.path().join("udp.xml"), udp_only(""))?;
        Ok(Self {
            network,
            middleware,
            shared_memory: SharedMemory::of(network, 128)?,
            directory,
        })
    }

    /// Returns the path of a file in the host's directory.
    pub fn file(&self, name: &str) -> PathBuf {
        self.directory.path().join(name)
    }

    /// Returns the same path as text.
    pub fn path(&self, name: &str) -> String {
        self.file(name).display().to_string()
    }

    /// Returns the path of the API's socket.
    pub fn socket(&self) -> String {
        self.path("api.sock")
    }

    /// Starts an agent at the host's sockets, with these further lines of configuration.
    pub fn agent(&self, lines: &str) -> Result<Agent<'n>> {
        let configuration = self.file("ros2probe.yaml");
        fs::write(&configuration, self.settings(lines))?;
        Agent::start(self.network, RP, &configuration)
    }

    /// Starts an agent as [`Self::agent`] does, which also observes processes from inside.
    pub fn agent_inside(&self, lines: &str) -> Result<Agent<'n>> {
        let configuration = self.file("ros2probe.yaml");
        let settings = self.settings(lines);
        let (capture, others) = settings.split_once("}\n").context("no capture")?;
        fs::write(
            &configuration,
            format!("{capture}, inside: full}}\n{others}"),
        )?;
        Agent::start(self.network, RP, &configuration)
    }

    /// Returns the configuration of [`Self::agent`].
    pub fn settings(&self, lines: &str) -> String {
        let exact = match self.middleware {
            Middleware::FastSampled => "off",
            Middleware::FastExact(choice) => choice,
            _ => "auto",
        };
        let capture = format!(
            "capture: {{source: host, cgroup: {}, shm: {{exact: {exact}}}}}\n",
            self.network.cgroup().display()
        );
        let directory = self.directory.path().display();
        format!(
            "{capture}api: {{socket: {directory}/api.sock}}\nstate_directory: {directory}\n{lines}"
        )
    }

    /// Returns the prefix that runs a program of ROS on this host.
    pub fn enter(&self) -> Vec<String> {
        let rmw = match self.middleware {
            Middleware::Cyclone => "rmw_cyclonedds_cpp",
            Middleware::Zenoh => "rmw_zenoh_cpp",
            _ => "rmw_fastrtps_cpp",
        };
        let mut enter = self.shared_memory.inside(self.network);
        enter.extend([
            "env".to_owned(),
            format!("RMW_IMPLEMENTATION={rmw}"),
            "ROS_DOMAIN_ID=0".to_owned(),
            format!("ROS_LOG_DIR={}", self.directory.path().display()),
        ]);
        if self.middleware == Middleware::FastUdp {
            let profile = self.path("udp.xml");
            enter.push(format!("FASTRTPS_DEFAULT_PROFILES_FILE={profile}"));
        }
        if self.middleware == Middleware::FastLargeData {
            enter.push("FASTDDS_BUILTIN_TRANSPORTS=LARGE_DATA".to_owned());
        }
        enter
    }

    /// Runs a shell line in ROS's environment, with these arguments as `$1` and following.
    pub fn run(&self, line: &str, arguments: &[&str], errors: Stdio) -> Result<Process> {
        let line = installed::in_environment(line);
        let words = ["-c", &line, "bash"]
            .into_iter()
            .chain(arguments.iter().copied());
        Process::start_with(&self.enter(), "bash", words, errors)
    }

    /// Starts the router, if the middleware has one.
    pub fn router_if_any(&self) -> Result<Option<Process>> {
        let has_router = self.middleware == Middleware::Zenoh;
        has_router.then(|| self.router("")).transpose()
    }

    /// Starts the router of rmw_zenoh, with these settings in addition to the default ones.
    pub fn router(&self, settings: &str) -> Result<Process> {
        let program = installed::prefix().join("lib/rmw_zenoh_cpp/rmw_zenohd");
        let log = self.file("router.log");
        let line = format!(
            "export ZENOH_CONFIG_OVERRIDE='{settings}'; exec {} > {} 2>&1",
            program.display(),
            log.display()
        );
        fs::write(&log, "")?;
        let router = self.run(&line, &[], Stdio::inherit())?;
        wait_until("the router has started", || {
            Ok(fs::read_to_string(&log)?.contains("Started Zenoh router"))
        })?;
        Ok(router)
    }

    /// Returns the output of `rp` with these arguments and the host's agent.
    pub fn rp(&self, arguments: &[&str]) -> Result<String> {
        let output = Command::new(RP)
            .args(arguments)
            .args(["--socket", &self.socket()])
            .env_remove("ROS_DOMAIN_ID")
            .env("ROS_DISTRO", installed::distro())
            .output()?;
        ensure!(output.status.success(), "{output:?}");
        Ok(String::from_utf8(output.stdout)?)
    }

    /// Runs a script of this directory with Python.
    pub fn python(&self, script: &str, arguments: &[&str]) -> Result<Process> {
        let directory = concat!(env!("CARGO_MANIFEST_DIR"), "/tests/ros2");
        let python = installed::python();
        let line = format!("exec {python} {directory}/{script} \"$@\"");
        self.run(&line, arguments, Stdio::inherit())
    }
}

/// Returns a profile of Fast DDS with UDP alone, and these elements of its transport.
pub fn udp_only(elements: &str) -> String {
    format!(
        r#"<?xml version="1.0" encoding="UTF-8"?>
<profiles xmlns="http://www.eprosima.com/XMLSchemas/fastRTPS_Profiles">
  <transport_descriptors>
    <transport_descriptor>
      <transport_id>udp</transport_id><type>UDPv4</type>{elements}
    </transport_descriptor>
  </transport_descriptors>
  <participant profile_name="udp" is_default_profile="true"><rtps>
    <userTransports><transport_id>udp</transport_id></userTransports>
    <useBuiltinTransports>false</useBuiltinTransports>
  </rtps></participant>
</profiles>
"#
    )
}
