//! A host with an agent and the demo's robot, and queries of the agent's state.

use std::io::{BufRead as _, BufReader, Write as _};
use std::net::TcpStream;
use std::time::Duration;

use anyhow::{Context as _, Result};
use ros2probe_capture::netns;
use serde_json::Value;
use tempfile::TempDir;

use ros2probe_testing::harness::agent::{Agent, at_the_sockets_of, get};
use ros2probe_testing::harness::network::Namespace;
use ros2probe_testing::harness::peer;
use ros2probe_testing::harness::process::Process;

const PATIENCE: Duration = Duration::from_secs(60);
/// Number of streams that clients without a token may open.
const STREAMS: usize = 12;

/// A host without a link to any other.
pub(crate) struct Place {
    pub(crate) host: Namespace,
    pub(crate) directory: TempDir,
}

/// The demo's nodes.
pub(crate) struct Robot {
    pub(crate) lidar: Process,
    _base: Process,
    _monitor: Process,
}

impl Place {
    pub(crate) fn new() -> Result<Self> {
        let directory = tempfile::tempdir()?;
        std::fs::create_dir(directory.path().join("bags"))?;
        Ok(Self {
            host: Namespace::isolated()?,
            directory,
        })
    }

    /// Starts an agent at the sockets of the host, with additional configuration.
    pub(crate) fn agent(&self, more: &str) -> Result<Agent<'_>> {
        self.configured(at_the_sockets_of(&self.host) + more)
    }

    /// Starts an agent as [`Self::agent`] does, which also observes processes from inside.
    pub(crate) fn agent_inside(&self, more: &str) -> Result<Agent<'_>> {
        let capture = at_the_sockets_of(&self.host).replace("}\n", ", inside: full}\n");
        self.configured(capture + more)
    }

    fn configured(&self, text: String) -> Result<Agent<'_>> {
        let configuration = self.directory.path().join("ros2probe.yaml");
        std::fs::write(&configuration, text)?;
        let log = self.directory.path().join("agent.log");
        let agent =
            Agent::start_logging(&self.host, env!("CARGO_BIN_EXE_rp"), &configuration, &log);
        agent.with_context(|| std::fs::read_to_string(&log).unwrap_or_default())
    }

    /// Returns a configuration with which the agent records even on a full disk.
    pub(crate) fn recordings(&self) -> String {
        let bags = self.directory.path().join("bags");
        let bags = bags.display();
        format!("recordings:\n  directory: {bags}\n  reserve_percent: 0\n  reserve_bytes: 0\n")
    }

    /// Returns the words that run the browser on this host.
    pub(crate) fn inside(&self) -> Vec<String> {
        self.host.outside().to_vec()
    }

    /// Starts a subscriber of a topic of [`Self::publisher`].
    pub(crate) fn subscriber(&self, topic: &str) -> Result<Process> {
        let words = [
            "--role",
            "sub",
            "--topic",
            topic,
            "--size",
            "320",
            "--best-effort",
        ];
        Process::start(&self.host.inside(), peer::robot()?, words)
    }

    /// Starts a node that publishes its own topic until the returned value is dropped.
    pub(crate) fn publisher(&self, topic: &str, node: &str) -> Result<Process> {
        let words = ["--role", "pub", "--topic", topic, "--node", node];
        let stream = [
            "--size",
            "320",
            "--rate",
            "20",
            "--peers",
            "0",
            "--best-effort",
        ];
        let words = words.into_iter().chain(stream);
        let mut process = Process::start(&self.host.inside(), peer::robot()?, words)?;
        process.wait_for("ready", PATIENCE)?;
        Ok(process)
    }

    /// Returns the answer of the control API.
    pub(crate) fn ask(&self, path: &str) -> Result<Value> {
        let answer = get(&self.host, &format!("http://127.0.0.1:17401{path}"))?;
        serde_json::from_str(&answer).context(answer)
    }

    /// Returns how much of a limit is in use.
    pub(crate) fn used(&self, limit: &str) -> Result<u64> {
        super::number(&self.ask("/health")?["limits"], "limit", limit, "used")
    }

    /// Returns the number of open streams of the page: the limit minus the streams that can still
    /// be opened.
    pub(crate) fn streams(&self) -> Result<usize> {
        let mut held = Vec::new();
        for _ in 0..STREAMS {
            let path = self.host.network();
            let connect = || TcpStream::connect("127.0.0.1:17401");
            let mut stream = netns::within(&path, connect)??;
            stream.set_read_timeout(Some(PATIENCE))?;
            stream.write_all(b"GET /live HTTP/1.0\r\nHost: localhost:17401\r\n\r\n")?;
            let mut reader = BufReader::new(stream);
            let mut status = String::new();
            reader.read_line(&mut status)?;
            if !status.contains(" 200 ") {
                break;
            }
            held.push(reader);
        }
        let open = STREAMS - held.len();
        drop(held);
        // The agent notices within a second that the streams are closed.
        std::thread::sleep(Duration::from_millis(1500));
        Ok(open)
    }
}

impl Robot {
    pub(crate) fn start(host: &Namespace) -> Result<Self> {
        let start = |role: &str| {
            let mut process = Process::start(&host.inside(), peer::robot()?, ["--role", role])?;
            process.wait_for("ready", PATIENCE)?;
            Ok::<_, anyhow::Error>(process)
        };
        Ok(Self {
            lidar: start("lidar")?,
            _base: start("base")?,
            _monitor: start("monitor")?,
        })
    }
}
