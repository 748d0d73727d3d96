//! Cost of open pages: the agent's CPU time and memory with 0, 1 and 10 streams of `/live`, and the
//! traffic of a stream. The agent measures 200 topics.

use std::fs;
use std::io::{Read as _, Write as _};
use std::net::{Shutdown, TcpStream};
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;

use anyhow::{Context as _, Result, ensure};
use ros2probe_capture::netns;

use crate::footprint::{TOPICS, configured, crowd, wait_for_topics};
use crate::report::Miss;
use ros2probe_testing::harness::agent::Agent;
use ros2probe_testing::harness::network::{Link, Namespace};
use ros2probe_testing::harness::usage::Usage;

/// Numbers of streams open at the same time.
const COUNTS: [usize; 3] = [0, 1, 10];
/// Time between opening the streams and the measurement, so that the whole state has been sent.
const SETTLED: Duration = Duration::from_secs(5);
/// Maximum fraction of a core that one page may use.
const MAX_CORE_SHARE: f64 = 0.01;

/// Figures of the agent with this number of streams.
struct Open {
    streams: usize,
    /// CPU time divided by wall time.
    of_core: f64,
    unreclaimable: u64,
    /// Bytes per second of each stream.
    bytes: u64,
}

/// A stream that is read until its value is dropped.
struct Tab {
    stream: TcpStream,
    bytes: Arc<AtomicU64>,
}

/// Prints the table. Returns a miss if one page exceeds its maximum.
pub(crate) fn measure(program: &Path, length: Duration) -> Result<Vec<Miss>> {
    let link = Link::new()?;
    let directory = tempfile::tempdir().context("cannot create a directory")?;
    let configuration = directory.path().join("ros2probe.yaml");
    fs::write(&configuration, configured("host", &link)?)?;
    let agent = Agent::start(&link.robot, program, &configuration)?;
    let _crowd = crowd(&link)?;
    let topics = wait_for_topics(&agent)?;
    ensure!(topics >= TOPICS, "only {topics} topics were measured");
    println!("| pages | of a core | MB unreclaimable | KB/s each |\n| ---: | ---: | ---: | ---: |");
    let mut all = Vec::new();
    for streams in COUNTS {
        let open = Open::measure(&agent, streams, length)?;
        println!(
            "| {streams} | {:.2} % | {:.1} | {:.1} |",
            open.of_core * 1e2,
            open.unreclaimable as f64 / 1e6,
            open.bytes as f64 / 1e3
        );
        all.push(open);
    }
    println!();
    let of = |streams: usize| {
        let mut all = all.iter().filter(|open| open.streams == streams);
        all.next().map_or(0.0, |open| open.of_core)
    };
    let one = of(1) - of(0);
    Ok(Vec::from_iter((one >= MAX_CORE_SHARE).then(|| {
        Miss::noted(format!("one page takes {:.2} % of a core", one * 1e2))
    })))
}

impl Open {
    fn measure(agent: &Agent<'_>, streams: usize, length: Duration) -> Result<Open> {
        let tabs = (0..streams).map(|_| Tab::open(agent.host));
        let tabs = tabs.collect::<Result<Vec<_>>>()?;
        std::thread::sleep(SETTLED);
        let carried = || tabs.iter().map(Tab::carried).sum::<u64>();
        let pid = agent.process.pid();
        let (before, first) = (Usage::of(pid)?, carried());
        std::thread::sleep(length);
        let used = Usage::of(pid)?.since(&before);
        let bytes = carried() - first;
        for tab in &tabs {
            ensure!(tab.carried() > 0, "a stream is empty");
        }
        Ok(Open {
            streams,
            of_core: used.cpu.as_secs_f64() / length.as_secs_f64(),
            unreclaimable: used.memory.unreclaimable,
            bytes: bytes / (length.as_secs() * streams.max(1) as u64).max(1),
        })
    }
}

impl Tab {
    fn open(host: &Namespace) -> Result<Tab> {
        let network = host.network();
        let mut stream = netns::within(&network, || TcpStream::connect("127.0.0.1:17401"))??;
        stream.write_all(b"GET /live HTTP/1.0\r\nHost: localhost:17401\r\n\r\n")?;
        let bytes = Arc::new(AtomicU64::new(0));
        let (mut reader, counter) = (stream.try_clone()?, Arc::clone(&bytes));
        std::thread::spawn(move || {
            let mut piece = [0; 64 << 10];
            while let Ok(read @ 1..) = reader.read(&mut piece) {
                counter.fetch_add(read as u64, Ordering::Relaxed);
            }
        });
        Ok(Tab { stream, bytes })
    }

    fn carried(&self) -> u64 {
        self.bytes.load(Ordering::Relaxed)
    }
}

impl Drop for Tab {
    fn drop(&mut self) {
        // Ends the reading thread.
        let _ = self.stream.shutdown(Shutdown::Both);
    }
}
