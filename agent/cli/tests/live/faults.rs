//! Faults of an agent's host: full disks, receivers that hang, scrapers that do not read, no
//! descriptors, no memory, `kill -9`. The agent continues to observe, reports the fault, recovers,
//! and leaves nothing behind. `make soak` runs larger numbers.
//!
//! Faults of a single part are tested with that part. `live/record` has a recording on a full disk,
//! `otlp` and `live/otlp` have a receiver that returns, and `live/hostile` has forged traffic.

mod clients;
mod descriptors;
mod disk;
mod everything;
mod identities;
mod input_output_errors;
mod killed;
mod log;
mod memory;
mod receivers;
mod short_processes;
mod unit;
mod zenoh_storm;

use std::io::{Read, Write};
use std::net::TcpStream;
use std::path::{Path, PathBuf};
use std::process::Stdio;
use std::time::{Duration, Instant};

use anyhow::{Context as _, Result, ensure};
use ros2probe_capture::netns;
use ros2probe_testing::forged::{Carrier as _, Renewal, Sender, Talker, send_sizes};
use ros2probe_testing::harness;
use ros2probe_testing::harness::agent::{Agent, Scrape};
use ros2probe_testing::harness::network::{Link, Namespace};
use ros2probe_testing::harness::process::Process;
use serde_json::Value;
use tempfile::TempDir;

const METRICS_PORT: u16 = 17400;
const API_PORT: u16 = 17401;
const PATIENCE: Duration = Duration::from_secs(60);
/// Maximum duration of a shutdown: 3 s for answers and the last round, 2 s for the last export, and
/// the rest for a busy machine.
const ENDING: Duration = Duration::from_secs(60);

/// An agent on a separate host, with a directory for its files.
struct FaultBench<'a> {
    agent: Agent<'a>,
    log: PathBuf,
}

impl<'a> FaultBench<'a> {
    /// Starts the agent after the words of another command, with its log in a file.
    fn start(
        host: &'a Namespace,
        directory: &TempDir,
        configuration: &str,
        words: &[&str],
    ) -> Result<FaultBench<'a>> {
        let log = directory.path().join("log");
        let errors = std::fs::File::options()
            .create(true)
            .append(true)
            .open(&log)?;
        FaultBench::start_until_output(host, directory, configuration, words, errors.into())
    }

    fn start_until_output(
        host: &'a Namespace,
        directory: &TempDir,
        configuration: &str,
        words: &[&str],
        errors: Stdio,
    ) -> Result<FaultBench<'a>> {
        let file = directory.path().join("ros2probe.yaml");
        std::fs::write(&file, configuration)?;
        let mut enter: Vec<String> = words.iter().map(|word| (*word).to_owned()).collect();
        enter.extend(host.on_network());
        let process = launch(&enter, &file, errors)?;
        let mut agent = Agent { process, host };
        agent.wait_ready(PATIENCE)?;
        Ok(FaultBench {
            agent,
            log: directory.path().join("log"),
        })
    }

    fn pid(&self) -> u32 {
        self.agent.process.pid()
    }

    fn log(&self) -> String {
        std::fs::read_to_string(&self.log).unwrap_or_default()
    }

    /// Returns a connection to one of the agent's listeners.
    fn connect(&self, port: u16) -> Result<TcpStream> {
        let stream = netns::within(&self.agent.host.network(), || {
            TcpStream::connect(("127.0.0.1", port))
        })??;
        stream.set_read_timeout(Some(PATIENCE))?;
        Ok(stream)
    }

    /// Sends a request to the API on a new connection.
    fn ask(&self, method: &str, path: &str, body: &str) -> Result<(u16, Value)> {
        ask(&mut self.connect(API_PORT)?, method, path, body)
    }

    fn node_is_known(&self, node: &str) -> Result<()> {
        self.agent.scrape_until(&format!("{node} known"), |page| {
            page.labels_of("ros2_node_info", "ros_node").contains(node)
        })?;
        Ok(())
    }

    /// Ends the agent as the service manager does. Returns the duration.
    fn end(mut self) -> Result<Duration> {
        let began = Instant::now();
        self.agent.process.signal("TERM")?;
        let status = self.agent.process.wait(ENDING)?;
        ensure!(status.success(), "it ended with {status}: {}", self.log());
        Ok(began.elapsed())
    }
}

fn launch(enter: &[String], configuration: &Path, errors: Stdio) -> Result<Process> {
    let program = harness::soak::program(env!("CARGO_BIN_EXE_rp"));
    let arguments = [
        Path::new("run"),
        Path::new("--config"),
        configuration,
        // These tests request recordings over loopback.
        Path::new("--api-loopback"),
        Path::new("all"),
    ];
    Process::start_with(enter, program, arguments, errors)
}

/// A topic whose messages are all counted, whatever else happens. Its participant repeats its
/// announcement until this value is dropped.
struct Counted {
    talker: Talker,
    sender: Sender,
    topic: String,
    sent: u64,
    _renewal: Renewal,
}

impl Counted {
    fn start(link: &Link, number: u32, node: &str) -> Result<Counted> {
        let topic = format!("/counted_{number}");
        let talker = Talker::new(number, &topic);
        let mut sender = Sender::between(&link.monitor, &link.robot)?;
        for message in talker.introduction(node) {
            sender.send(&message)?;
        }
        let repeater = Sender::between(&link.monitor, &link.robot)?;
        let renewal = Renewal::start(repeater, talker.participant());
        Ok(Counted {
            talker,
            sender,
            topic,
            sent: 0,
            _renewal: renewal,
        })
    }

    fn send_samples(&mut self, size: usize, count: usize) -> Result<()> {
        self.sent += count as u64;
        send_sizes(
            &mut self.talker,
            &mut self.sender,
            std::iter::repeat_n(size, count),
        )
    }

    /// Fails unless the agent has counted all messages, and none as lost.
    fn check(&self, agent: &Agent<'_>) -> Result<()> {
        self.check_page(&agent.settled_scrape(&self.topic, self.sent)?)
    }

    fn check_page(&self, page: &Scrape) -> Result<()> {
        let label = [("topic", self.topic.as_str())];
        let counted = page.sum("ros2_topic_messages_total", &label);
        let lost = page.sum("ros2_topic_lost_messages_total", &label);
        ensure!(
            (counted, lost) == (self.sent as f64, 0.0),
            "{counted} of {} counted, {lost} lost: {}",
            self.sent,
            page.suspicious_counters()
        );
        Ok(())
    }
}

/// Sends one request on a connection that stays open.
fn ask(
    stream: &mut (impl Read + Write),
    method: &str,
    path: &str,
    body: &str,
) -> Result<(u16, Value)> {
    let (status, body) = request(stream, method, path, body)?;
    let value = serde_json::from_str(&body).unwrap_or(Value::String(body));
    Ok((status, value))
}

fn request(
    stream: &mut (impl Read + Write),
    method: &str,
    path: &str,
    body: &str,
) -> Result<(u16, String)> {
    let length = body.len();
    write!(
        stream,
        "{method} {path} HTTP/1.1\r\nHost: localhost\r\nContent-Type: application/json\r\n\
         Content-Length: {length}\r\n\r\n{body}"
    )?;
    let mut bytes = Vec::new();
    let head = loop {
        let end = bytes.windows(4).position(|it| it == b"\r\n\r\n");
        if let Some(end) = end {
            break end + 4;
        }
        read_more(stream, &mut bytes)?;
    };
    let text = String::from_utf8_lossy(&bytes[..head]).to_ascii_lowercase();
    let status = text.split(' ').nth(1).context("no status")?.parse()?;
    let length = text
        .lines()
        .find_map(|line| line.strip_prefix("content-length: "));
    let length: usize = length.map_or(Ok(0), str::parse)?;
    while bytes.len() < head + length {
        read_more(stream, &mut bytes)?;
    }
    Ok((status, String::from_utf8_lossy(&bytes[head..]).into_owned()))
}

fn read_more(stream: &mut impl Read, bytes: &mut Vec<u8>) -> Result<()> {
    let mut piece = [0; 16 << 10];
    let count = stream.read(&mut piece)?;
    ensure!(count > 0, "closed: {}", String::from_utf8_lossy(bytes));
    bytes.extend_from_slice(&piece[..count]);
    Ok(())
}
