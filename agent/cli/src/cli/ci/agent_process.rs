//! The agent of a run: a child process with its socket and its bags in a temporary directory. It
//! ends with this program, also if that is killed.

use std::fs::{self, File};
use std::io;
use std::net::SocketAddr;
use std::os::unix::fs::chown;
use std::os::unix::process::{CommandExt as _, ExitStatusExt as _};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::sync::mpsc::Receiver;
use std::time::{Duration, Instant};

use anyhow::{Context as _, Result, bail};
use ros2probe::client::{Agent, Target};
use ros2probe_api::health::{Health, PageToken};
use ros2probe_api::recordings::{FilterOptions, Recording, RecordingList, RecordingRequest};
use ros2probe_daemon::private_agent::{RECORDINGS_DIRECTORY, SOCKET_NAME};
use ros2probe_daemon::privilege::user_id;
use rustix::process::{Pid, Signal, geteuid, getpid, kill_process};
use serde_json::json;
use tempfile::TempDir;

use super::artefacts::Artefacts;

/// User of an agent that root starts.
const AGENT_USER: &str = "ros2probe";
/// Name of the recording.
const BAG_NAME: &str = "bag";
/// Maximum wait for the kernel to verify the programs on a busy machine.
const START_TIMEOUT: Duration = Duration::from_secs(60);
/// Maximum wait for the end, which completes the bag.
const END_TIMEOUT: Duration = Duration::from_secs(40);
const POLL_INTERVAL: Duration = Duration::from_millis(50);
/// Maximum number of bytes of the log that are searched for its last line.
const LOG_BYTES: u64 = 64 << 10;

/// The process.
pub(super) struct AgentProcess {
    child: Child,
    directory: TempDir,
    log: PathBuf,
    serves_page: bool,
}

impl AgentProcess {
    /// Starts an agent that measures every topic of a domain, with the watchlist `expect`.
    pub(super) fn start(
        expect: Option<&Path>,
        domain_id: u32,
        page: Option<SocketAddr>,
        artefacts: &Artefacts,
    ) -> Result<Self> {
        let directory = tempfile::Builder::new().prefix("rp-ci-").tempdir();
        let directory =
            directory.context("cannot create a temporary directory; TMPDIR names another place")?;
        if geteuid().is_root()
            && let Some(user) = user_id(AGENT_USER)
        {
            // Without the right to change the owner, the agent stays root as well.
            let _ = chown(directory.path(), Some(user), None);
        }
        let program = std::env::current_exe().context("cannot find the program rp")?;
        let log = artefacts.log();
        let mut command = Command::new(program);
        command.args(["run", "--private"]).arg(directory.path());
        command.args(["--domain", &domain_id.to_string()]);
        command.args(["--parent", &getpid().as_raw_pid().to_string()]);
        if let Some(file) = expect {
            command.arg("--config").arg(file);
        }
        if let Some(address) = page {
            command.args(["--api", &address.to_string()]);
        }
        // The service manager of this program does not supervise its agent.
        for variable in ["NOTIFY_SOCKET", "WATCHDOG_USEC", "WATCHDOG_PID"] {
            command.env_remove(variable);
        }
        let child = command
            .stdin(Stdio::null())
            .stdout(Stdio::null())
            .stderr(File::create(&log).with_context(|| format!("cannot write {}", log.display()))?)
            .process_group(0)
            .spawn()
            .context("cannot start the agent")?;
        Ok(Self {
            child,
            directory,
            log,
            serves_page: page.is_some(),
        })
    }

    /// Waits until the agent observes. Returns `None` if a signal ends this program before.
    pub(super) fn wait_ready(&mut self, signals: &Receiver<Signal>) -> Result<Option<Agent>> {
        let target = Target {
            socket: Some(self.directory.path().join(SOCKET_NAME)),
            ..Target::default()
        };
        let deadline = Instant::now() + START_TIMEOUT;
        loop {
            let agent = Agent::reach(&target)?;
            let health = agent.get::<Health>("/health").ok();
            if health.as_ref().is_some_and(|health| health.ready) {
                return Ok(Some(agent));
            }
            if signals.try_recv().is_ok() {
                return Ok(None);
            }
            if self.has_ended() {
                let reason = self.reason().unwrap_or_default();
                bail!("the agent does not start: {reason}");
            }
            if Instant::now() > deadline {
                let reason = health.and_then(|health| health.reason);
                let reason = reason.unwrap_or_else(|| "it does not answer".to_owned());
                let log = self.log.display();
                bail!("the agent is not ready after {START_TIMEOUT:?}: {reason}; its log is {log}");
            }
            std::thread::sleep(POLL_INTERVAL);
        }
    }

    /// Records every topic of the domain.
    pub(super) fn record(&self, agent: &Agent, domain_id: u32) -> Result<()> {
        let request = RecordingRequest {
            name: Some(BAG_NAME.to_owned()),
            topics: FilterOptions {
                include_hidden_topics: true,
                ..FilterOptions::everything()
            },
            domain_id,
            ..RecordingRequest::default()
        };
        let _: Recording = agent
            .post("/recordings", &request)
            .context("cannot record; --no-bag runs without a bag")?;
        Ok(())
    }

    /// Returns the address of the page, if it is served.
    pub(super) fn page(&self, agent: &Agent) -> Result<Option<String>> {
        if !self.serves_page {
            return Ok(None);
        }
        let page: PageToken = agent.post("/page/token", &json!({}))?;
        Ok(page.address)
    }

    /// Returns what the recording contains, in words.
    pub(super) fn bag(&self, agent: &Agent, is_off: bool) -> String {
        if is_off {
            return "none (--no-bag)".to_owned();
        }
        let list = agent.get::<RecordingList>("/recordings");
        let recordings = list.map(|list| list.recordings).unwrap_or_default();
        let Some(bag) = recordings.into_iter().find(|it| it.name == BAG_NAME) else {
            return "of unknown content: the agent did not answer".to_owned();
        };
        let (messages, missing) = (bag.report.messages, bag.report.missing);
        let mut text = format!("{messages} messages, {missing} missing");
        if let Some(reason) = bag.error {
            text = format!("{text}; it ended early: {reason}");
        }
        text
    }

    /// Returns the directory of the bag, which exists after [`Self::end`] if there is one.
    pub(super) fn recording(&self) -> PathBuf {
        self.directory
            .path()
            .join(RECORDINGS_DIRECTORY)
            .join(BAG_NAME)
    }

    pub(super) fn has_ended(&mut self) -> bool {
        !matches!(self.child.try_wait(), Ok(None))
    }

    /// Returns the signal that ended the agent, or the last line of its log without the name of the
    /// program.
    pub(super) fn reason(&mut self) -> Option<String> {
        if let Ok(Some(status)) = self.child.try_wait()
            && let Some(signal) = status.signal()
        {
            return Some(format!("signal {signal} ended it"));
        }
        let bytes = ros2probe_daemon::file::read(&self.log, LOG_BYTES).ok()?;
        let text = String::from_utf8_lossy(&bytes).into_owned();
        let line = text.lines().rfind(|line| !line.trim().is_empty())?;
        Some(line.strip_prefix("rp: ").unwrap_or(line).to_owned())
    }

    /// Ends the agent in order, which completes the bag.
    pub(super) fn end(&mut self) -> io::Result<()> {
        if self.has_ended() {
            return Ok(());
        }
        let _ = kill_process(Pid::from_child(&self.child), Signal::TERM);
        let deadline = Instant::now() + END_TIMEOUT;
        while !self.has_ended() {
            if Instant::now() > deadline {
                self.child.kill()?;
                self.child.wait()?;
            }
            std::thread::sleep(POLL_INTERVAL);
        }
        Ok(())
    }
}

impl Drop for AgentProcess {
    fn drop(&mut self) {
        // An agent that cannot be ended now ends with this process.
        let _ = self.end();
        let _ = fs::remove_dir_all(self.directory.path());
    }
}
