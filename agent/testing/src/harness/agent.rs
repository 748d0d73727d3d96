//! The agent under test, and its metrics.

use std::collections::BTreeSet;
use std::ffi::OsStr;
use std::fs::File;
use std::io::{Read as _, Write as _};
use std::net::TcpStream;
use std::path::Path;
use std::process::Stdio;
use std::time::{Duration, Instant};

use anyhow::{Context as _, Result, bail, ensure};
use ros2probe_capture::netns;

use super::network::Namespace;
use super::process::Process;
use super::soak::dropped;

/// The default address of the metrics listener: every host has its own network, so the port is
/// free.
pub const METRICS: &str = "http://127.0.0.1:17400";

/// Configuration for tests of packet sockets.
pub const ON_THE_WIRE: &str = "capture: {source: wire}\n";

/// Like [`ON_THE_WIRE`], for tests of packets alone: without breakpoints in processes, which the
/// kernel needs time to verify and to attach.
pub const PACKETS_ALONE: &str = "capture: {source: wire, inside: off}\n";

/// Maximum wait until the metrics show the sent messages, on a busy machine.
const PATIENCE: Duration = Duration::from_secs(90);
/// Maximum wait for the kernel to verify the BPF programs on a busy machine.
const START: Duration = Duration::from_secs(90);
/// Maximum wait for further bytes of a response.
const ANSWER: Duration = Duration::from_secs(60);
/// Time between two snapshots with the same counters: longer than the second after which a gap of a
/// best-effort stream is settled.
const QUIET_TIME: Duration = Duration::from_millis(1500);
/// The same time if the agent reports lost records or frames, so that some messages may never be
/// counted.
const STILL_WITHOUT_SOME: Duration = Duration::from_secs(6);
/// The same time after which missing messages are no longer expected.
const STILL_INCOMPLETE: Duration = Duration::from_secs(30);

/// `rp run` on a host.
pub struct Agent<'a> {
    pub process: Process,
    pub host: &'a Namespace,
}

/// The text of one `/metrics` page.
pub struct Scrape(pub String);

/// Returns the configuration for tests of the host's sockets.
pub fn at_the_sockets_of(host: &Namespace) -> String {
    let cgroup = host.cgroup().display();
    format!("capture: {{source: host, cgroup: {cgroup}}}\n")
}

/// Like [`at_the_sockets_of`], for tests of datagrams alone: without breakpoints in processes, as
/// [`PACKETS_ALONE`].
pub fn datagrams_alone_of(host: &Namespace) -> String {
    let cgroup = host.cgroup().display();
    format!("capture: {{source: host, cgroup: {cgroup}, shm: {{exact: off}}, inside: off}}\n")
}

impl<'a> Agent<'a> {
    /// Starts `rp run` (`env!("CARGO_BIN_EXE_rp")` in a test) and waits until it is ready.
    pub fn start(
        host: &'a Namespace,
        program: impl AsRef<OsStr>,
        configuration: &Path,
    ) -> Result<Agent<'a>> {
        Agent::start_with(host, program, configuration, Stdio::inherit())
    }

    /// Starts the agent as [`Agent::start`] does, with its log in a file.
    pub fn start_logging(
        host: &'a Namespace,
        program: impl AsRef<OsStr>,
        configuration: &Path,
        log: &Path,
    ) -> Result<Agent<'a>> {
        let file = File::create(log).with_context(|| format!("cannot create {}", log.display()))?;
        Agent::start_with(host, program, configuration, file.into())
    }

    fn start_with(
        host: &'a Namespace,
        program: impl AsRef<OsStr>,
        configuration: &Path,
        errors: Stdio,
    ) -> Result<Agent<'a>> {
        let arguments = [
            OsStr::new("run"),
            OsStr::new("--config"),
            configuration.as_os_str(),
            // A test host has no service manager, and therefore no Unix socket.
            OsStr::new("--api-loopback"),
            OsStr::new("all"),
        ];
        let process = Process::start_with(&host.on_network(), program, arguments, errors)?;
        let mut agent = Agent { process, host };
        agent.wait_ready(START)?;
        Ok(agent)
    }

    pub fn wait_ready(&mut self, limit: Duration) -> Result<()> {
        let deadline = Instant::now() + limit;
        while let Err(error) = self.request("/readyz") {
            if let Ok(status) = self.process.wait(Duration::ZERO) {
                bail!("the agent ended with {status} before it was ready");
            }
            if Instant::now() > deadline {
                return Err(error.context(format!("the agent is not ready after {limit:?}")));
            }
            std::thread::sleep(Duration::from_millis(50));
        }
        Ok(())
    }

    pub fn scrape(&self) -> Result<Scrape> {
        Ok(Scrape(self.request("/metrics")?))
    }

    /// Scrapes until `shows` accepts the page, and returns it.
    pub fn scrape_until(&self, what: &str, shows: impl Fn(&Scrape) -> bool) -> Result<Scrape> {
        let deadline = Instant::now() + PATIENCE;
        loop {
            let page = self.scrape()?;
            if shows(&page) {
                return Ok(page);
            }
            if Instant::now() > deadline {
                bail!("not {what} within {PATIENCE:?}: {}", page.0);
            }
            std::thread::sleep(Duration::from_millis(100));
        }
    }

    /// Scrapes until two snapshots that lie apart have the same counters of a topic. By then, the
    /// agent has counted this many messages, or no further one for a long time.
    pub fn settled_scrape(&self, topic: &str, messages: u64) -> Result<Scrape> {
        let label = [("topic", topic)];
        let deadline = Instant::now() + PATIENCE;
        let (mut before, mut since) = (Vec::new(), Instant::now());
        loop {
            let asked = Instant::now();
            let page = self.scrape()?;
            let answered = Instant::now();
            let age = page.sum("ros2probe_snapshot_age_seconds", &[]);
            let age = Duration::try_from_secs_f64(age)?;
            let taken = |at: Instant| at.checked_sub(age).unwrap_or(at);
            let now = page.counters(topic);
            if now != before {
                (before, since) = (now, taken(answered));
            }
            // The snapshot is at most as old as its age at the time of the request.
            let still = taken(asked).saturating_duration_since(since);
            let all = page.sum("ros2_topic_messages_total", &label) >= messages as f64;
            let in_time = Instant::now() < deadline;
            let is_lossy = dropped(&page) > 0.0 && still >= STILL_WITHOUT_SOME;
            let is_over = is_lossy || still >= STILL_INCOMPLETE || !in_time;
            if still >= QUIET_TIME && (all || is_over) {
                return Ok(page);
            }
            if Instant::now() > deadline + QUIET_TIME {
                bail!(
                    "what is counted of {topic} does not stand still: {}",
                    page.0
                );
            }
            std::thread::sleep(Duration::from_millis(100));
        }
    }

    /// Requests a path with GET from inside the host. Fails unless the status is a success.
    pub fn request(&self, path: &str) -> Result<String> {
        get(self.host, &format!("{METRICS}{path}"))
    }
}

impl Scrape {
    /// Returns the value of the sample of `name` with all of these labels.
    pub fn value(&self, name: &str, labels: &[(&str, &str)]) -> Option<f64> {
        self.samples(name, labels).next()
    }

    /// Returns the sum over all samples of `name` with these labels.
    pub fn sum(&self, name: &str, labels: &[(&str, &str)]) -> f64 {
        self.samples(name, labels).sum()
    }

    /// Returns the values of a label over the samples of `name`.
    pub fn labels_of(&self, name: &str, label: &str) -> BTreeSet<String> {
        let start = format!("{label}=\"");
        let values = self.0.lines().filter_map(|line| {
            let labels = line.strip_prefix(name)?.strip_prefix('{')?;
            let (_, value) = labels.split_once(&start)?;
            Some(value.split_once('"')?.0.to_owned())
        });
        values.collect()
    }

    /// Returns every counter above zero that could explain a difference.
    pub fn suspicious_counters(&self) -> String {
        let telling = [
            "lost",
            "dropped",
            "incomplete",
            "evict",
            "duplicate",
            "errors",
            "recovered",
        ];
        let lines = self.0.lines().filter(|line| {
            !line.starts_with('#')
                && !line.ends_with(" 0")
                && telling.iter().any(|word| line.contains(word))
        });
        lines.collect::<Vec<_>>().join("; ")
    }

    /// Returns the counters of a topic's messages, with their values.
    fn counters(&self, topic: &str) -> Vec<String> {
        let topic = format!("topic=\"{topic}\"");
        let counters = self.0.lines().filter(|line| {
            let name = line.split_once('{').map_or("", |(name, _)| name);
            name.ends_with("_messages_total") && line.contains(&topic)
        });
        counters.map(str::to_owned).collect()
    }

    pub fn samples(&self, name: &str, labels: &[(&str, &str)]) -> impl Iterator<Item = f64> {
        let wanted: Vec<String> = labels
            .iter()
            .map(|(label, value)| format!("{label}=\"{value}\""))
            .collect();
        self.0.lines().filter_map(move |line| {
            let (series, rest) = match line.split_once('{') {
                Some((series, rest)) => (series, rest),
                None => line.split_once(' ')?,
            };
            let (labels, value) = rest.rsplit_once("} ").unwrap_or(("", rest));
            let named = series == name && wanted.iter().all(|pair| has_label(labels, pair));
            let value = value.split_whitespace().next().filter(|_| named)?;
            value.parse().ok()
        })
    }
}

/// Returns whether `label="value"` occurs in a label set at the start or after a comma.
fn has_label(labels: &str, pair: &str) -> bool {
    labels
        .match_indices(pair)
        .any(|(at, _)| at == 0 || labels.as_bytes().get(at - 1) == Some(&b','))
}

/// Requests a URL such as `http://127.0.0.1:17400/metrics` with GET on a host's network. Fails
/// unless the status is a success.
pub fn get(host: &Namespace, url: &str) -> Result<String> {
    let (address, path) = url
        .strip_prefix("http://")
        .and_then(|rest| rest.split_at_checked(rest.find('/')?))
        .with_context(|| format!("{url} is not http://ADDRESS/PATH"))?;
    let answer = (|| {
        let mut stream = netns::within(&host.network(), || TcpStream::connect(address))??;
        stream.set_read_timeout(Some(ANSWER))?;
        // With HTTP/1.0, the response is not chunked and ends with the connection.
        write!(stream, "GET {path} HTTP/1.0\r\nHost: {address}\r\n\r\n")?;
        let mut answer = Vec::new();
        stream.read_to_end(&mut answer)?;
        anyhow::Ok(String::from_utf8_lossy(&answer).into_owned())
    })()
    .with_context(|| url.to_owned())?;
    let (head, body) = answer
        .split_once("\r\n\r\n")
        .with_context(|| format!("{url}: {answer}"))?;
    let status = head.split(' ').nth(1).unwrap_or_default();
    ensure!(status.starts_with('2'), "{url}: {answer}");
    Ok(body.to_owned())
}
