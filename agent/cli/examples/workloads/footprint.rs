//! Footprint of the shipped agent: its file size, its startup time, and its memory with the default
//! configuration. Memory is measured idle without scrapes, and with 200 measured topics and a
//! scrape every 5 s. Only memory that cannot be reclaimed counts. It does not depend on the
//! machine's load, so too much of it is a failure.

use std::fmt;
use std::fs;
use std::io::{Read as _, Write as _};
use std::net::TcpStream;
use std::os::unix::net::UnixDatagram;
use std::path::{Path, PathBuf};
use std::process::{Child, Command};
use std::time::{Duration, Instant};

use anyhow::{Context as _, Result, bail, ensure};
use ros2probe_capture::netns;

use crate::report::Miss;
use ros2probe_testing::harness::agent::{Agent, METRICS, get};
use ros2probe_testing::harness::network::{Link, Namespace};
use ros2probe_testing::harness::peer::robot;
use ros2probe_testing::harness::process::Process;
use ros2probe_testing::harness::usage::Memory;

/// The shipped configuration.
const CONFIGURATION: &str = include_str!("../../../../config/ros2probe.yaml");
pub(crate) const TOPICS: usize = 200;
/// Messages per second of each topic.
const RATE: &str = "5";
const SCRAPES: Duration = Duration::from_secs(5);
/// Interval of reading the memory, since a scrape's page exists for some 20 ms.
const SAMPLING: Duration = Duration::from_millis(5);
/// Time after the start until one-time work is done.
const SETTLED: Duration = Duration::from_secs(10);
const STARTS: usize = 5;
const PATIENCE: Duration = Duration::from_secs(60);

/// Maximum unreclaimable memory of the agent, when idle, and while it measures [`TOPICS`].
const IDLE: u64 = 8_000_000;
const BUSY: u64 = 16_000_000;

/// All figures of one binary.
pub(crate) struct Footprint {
    /// Name and size of the file, and of the binaries for other architectures, if they were built.
    sizes: Vec<(String, u64)>,
    sources: Vec<SourceFootprint>,
}

/// Figures with one source.
struct SourceFootprint {
    name: &'static str,
    /// Medians of the startup times.
    start: Start,
    idle: Memory,
    busy: Memory,
    /// Number of topics with messages at the end.
    topics: usize,
}

/// Times from the start of the process.
#[derive(Clone, Copy)]
struct Start {
    /// Time until the process notified the service manager that it is ready.
    ready: Duration,
    /// Time until the process served the first metrics page.
    scrape: Duration,
}

/// A process that is killed when its value is dropped.
struct KillOnDrop(Child);

impl Footprint {
    pub(crate) fn measure(program: &Path, length: Duration) -> Result<Footprint> {
        let sources = ["host", "wire"].map(|name| SourceFootprint::measure(name, program, length));
        Ok(Footprint {
            sizes: sizes(program)?,
            sources: sources.into_iter().collect::<Result<_>>()?,
        })
    }

    pub(crate) fn missed(&self) -> Vec<Miss> {
        let mut missed = Vec::new();
        for source in &self.sources {
            for (what, memory, most) in [
                ("idle", &source.idle, IDLE),
                ("with 200 topics", &source.busy, BUSY),
            ] {
                if memory.unreclaimable >= most {
                    let megabytes = most / 1_000_000;
                    let what = format!(
                        "{}: what cannot be reclaimed is not below {megabytes} MB {what}",
                        source.name
                    );
                    missed.push(Miss::failing(what));
                }
            }
            if source.topics < TOPICS {
                let topics = source.topics;
                missed.push(Miss::failing(format!("only {topics} topics were measured")));
            }
        }
        missed
    }
}

impl SourceFootprint {
    fn measure(name: &'static str, program: &Path, length: Duration) -> Result<SourceFootprint> {
        let link = Link::new()?;
        let directory = tempfile::tempdir().context("cannot create a directory")?;
        let configuration = directory.path().join("ros2probe.yaml");
        fs::write(&configuration, configured(name, &link)?)?;
        let start = Start::measure(&link.robot, program, &configuration, directory.path())?;

        let agent = Agent::start(&link.robot, program, &configuration)?;
        std::thread::sleep(SETTLED);
        let idle = most_during(length, &agent, false)?;
        let _crowd = crowd(&link)?;
        wait_for_topics(&agent)?;
        let busy = most_during(length, &agent, true)?;
        Ok(SourceFootprint {
            name,
            start,
            idle,
            busy,
            topics: counted(&agent)?,
        })
    }
}

impl Start {
    /// Returns the medians of several runs.
    fn measure(
        host: &Namespace,
        program: &Path,
        configuration: &Path,
        directory: &Path,
    ) -> Result<Start> {
        let network = host.network();
        let mut starts = Vec::new();
        for number in 0..STARTS {
            let notify = directory.join(format!("notify{number}"));
            let once = || Start::once(program, configuration, &notify);
            starts.push(netns::within(&network, once)??);
        }
        let median = |of: fn(&Start) -> Duration| {
            let mut times: Vec<_> = starts.iter().map(of).collect();
            times.sort_unstable();
            times.get(STARTS / 2).copied().unwrap_or_default()
        };
        Ok(Start {
            ready: median(|start| start.ready),
            scrape: median(|start| start.scrape),
        })
    }

    fn once(program: &Path, configuration: &Path, notify: &Path) -> Result<Start> {
        let agent_totals =
            UnixDatagram::bind(notify).context("cannot bind a socket for READY=1")?;
        agent_totals.set_nonblocking(true)?;
        let began = Instant::now();
        // The process ends with this thread in any case.
        let mut command = Command::new("setpriv");
        command.args(["--pdeathsig", "KILL"]).arg(program);
        command.args(["run", "--config"]).arg(configuration);
        let agent = command.env("NOTIFY_SOCKET", notify).spawn();
        let mut agent = KillOnDrop(agent.context("cannot start the agent")?);
        let (mut ready, mut scrape) = (None, None);
        loop {
            if let (Some(ready), Some(scrape)) = (ready, scrape) {
                return Ok(Start { ready, scrape });
            }
            let mut message = [0; 4096];
            if let Ok(length) = agent_totals.recv(&mut message) {
                let message = String::from_utf8_lossy(message.get(..length).unwrap_or_default());
                if message.contains("READY=1") {
                    ready.get_or_insert(began.elapsed());
                }
            }
            if scrape.is_none() && is_page().unwrap_or(false) {
                scrape = Some(began.elapsed());
            }
            if let Some(status) = agent.0.try_wait()? {
                bail!("the agent ended with {status} before it was ready");
            }
            ensure!(began.elapsed() < PATIENCE, "the agent does not get ready");
            std::thread::sleep(Duration::from_millis(1));
        }
    }
}

/// Returns the agent's maximum memory, with or without scrapes.
fn most_during(length: Duration, agent: &Agent<'_>, scraped: bool) -> Result<Memory> {
    let began = Instant::now();
    let host = agent.host;
    std::thread::scope(|scope| {
        let scraping = scope.spawn(move || -> Result<()> {
            while scraped && began.elapsed() < length {
                get(host, &format!("{METRICS}/metrics"))?;
                std::thread::sleep(SCRAPES.min(length.saturating_sub(began.elapsed())));
            }
            Ok(())
        });
        let pid = agent.process.pid();
        let mut most = Memory::default();
        while began.elapsed() < length || !scraping.is_finished() {
            let now = Memory::of(pid)?;
            if now.unreclaimable > most.unreclaimable {
                most = now;
            }
            std::thread::sleep(SAMPLING);
        }
        let scraped = scraping.join();
        scraped.map_err(|_| anyhow::anyhow!("the thread that scrapes panicked"))??;
        Ok(most)
    })
}

impl fmt::Display for Footprint {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        writeln!(formatter, "| file | MB |\n| --- | ---: |")?;
        for (name, bytes) in &self.sizes {
            writeln!(formatter, "| {name} | {:.2} |", *bytes as f64 / 1e6)?;
        }
        writeln!(
            formatter,
            "\n| source | ready, first scrape after ms | state | MB unreclaimable | of these: rings | changed program | heap and stacks | RSS | PSS |"
        )?;
        writeln!(
            formatter,
            "| --- | ---: | --- | ---: | ---: | ---: | ---: | ---: | ---: |"
        )?;
        for source in &self.sources {
            let Start { ready, scrape } = source.start;
            let busy = format!("{} topics", source.topics);
            for (state, memory) in [("idle", &source.idle), (&*busy, &source.busy)] {
                let Memory { rings, program, .. } = *memory;
                let heap = memory.unreclaimable.saturating_sub(rings + program);
                write!(
                    formatter,
                    "| {} | {}, {} | {state} |",
                    source.name,
                    ready.as_millis(),
                    scrape.as_millis(),
                )?;
                let all = [
                    memory.unreclaimable,
                    rings,
                    program,
                    heap,
                    memory.rss,
                    memory.pss,
                ];
                for bytes in all {
                    write!(formatter, " {:.2} |", bytes as f64 / 1e6)?;
                }
                writeln!(formatter)?;
            }
        }
        Ok(())
    }
}

impl Drop for KillOnDrop {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

/// Returns the shipped configuration with one source. It observes only the sockets of these hosts,
/// because other processes on this machine may send.
pub(crate) fn configured(source: &str, link: &Link) -> Result<String> {
    let mut text = CONFIGURATION.to_owned();
    let cgroup = link.cgroup().display().to_string();
    let mut settings = vec![("source", source), ("log", "warn")];
    if source == "host" {
        settings.push(("cgroup", &cgroup));
    }
    for (key, value) in settings {
        let shown = format!("# {key}:");
        ensure!(
            text.contains(&shown),
            "the configuration does not show {key}"
        );
        text = text.replacen(&shown, &format!("{key}: {value} #"), 1);
    }
    Ok(text)
}

/// Starts processes that communicate on [`TOPICS`] topics from one host to the other.
pub(crate) fn crowd(link: &Link) -> Result<[Process; 2]> {
    let topics = TOPICS.to_string();
    let start = |host: &Namespace, role: &str| -> Result<Process> {
        let words = ["--role", role, "--topics", &topics, "--rate", RATE];
        let mut process = Process::start(&host.inside(), robot()?, words)?;
        process.wait_for("ready", PATIENCE)?;
        Ok(process)
    };
    Ok([
        start(&link.monitor, "listeners")?,
        start(&link.robot, "talkers")?,
    ])
}

/// Returns the number of topics with messages, once all topics have some or a timeout expires.
pub(crate) fn wait_for_topics(agent: &Agent<'_>) -> Result<usize> {
    let deadline = Instant::now() + PATIENCE;
    loop {
        let topics = counted(agent)?;
        if topics >= TOPICS || Instant::now() > deadline {
            return Ok(topics);
        }
        std::thread::sleep(Duration::from_secs(1));
    }
}

fn counted(agent: &Agent<'_>) -> Result<usize> {
    let page = agent.scrape()?;
    let messages = page.samples("ros2_topic_messages_total", &[]);
    Ok(messages.filter(|messages| *messages > 0.0).count())
}

/// Returns whether the agent in the calling thread's namespace serves its metrics.
fn is_page() -> Result<bool> {
    let mut stream = TcpStream::connect("127.0.0.1:17400")?;
    stream.write_all(b"GET /metrics HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\n\r\n")?;
    let mut answer = String::new();
    stream.read_to_string(&mut answer)?;
    Ok(answer.starts_with("HTTP/1.1 200") && answer.contains("ros2probe_build_info"))
}

/// Returns the size of the agent's file, and of the other architecture's if it was built.
fn sizes(program: &Path) -> Result<Vec<(String, u64)>> {
    let own = fs::canonicalize(program)?;
    let mut files = vec![own.clone()];
    for (here, there) in [("x86_64", "aarch64"), ("aarch64", "x86_64")] {
        let other = own.display().to_string();
        let other = PathBuf::from(other.replace(&format!("{here}-"), &format!("{there}-")));
        if other != own && other.exists() {
            files.push(other);
        }
    }
    let sizes = files.into_iter().map(|file| {
        let bytes = fs::metadata(&file)?.len();
        let parts: Vec<_> = file.iter().rev().take(3).collect();
        let parts: PathBuf = parts.into_iter().rev().collect();
        Ok((parts.display().to_string(), bytes))
    });
    sizes.collect()
}
