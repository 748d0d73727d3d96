//! All tables at their caps together, within the memory that the unit allows.

use std::fs;
use std::io::Write as _;
use std::time::{Duration, Instant};

use anyhow::{Result, ensure};

use super::unit::{Allowance, UnitCgroups, mebibytes};
use super::{API_PORT, Counted, FaultBench, PATIENCE};
use ros2probe_testing::forged::storm::{Storm, forgery};
use ros2probe_testing::forged::{Carrier, Sender};
use ros2probe_testing::harness::agent::ON_THE_WIRE;
use ros2probe_testing::harness::network::Link;
use ros2probe_testing::harness::soak::{long, outcome};

/// A port without a socket on the robot.
pub(super) const UNUSED_PORT: u16 = 7399;

/// A sender that pauses, so that other tests get a share of the machine.
pub(super) struct PausingSender {
    sender: Sender,
    carried: u32,
    /// Number of messages between two pauses.
    pace: u32,
    rest: Duration,
}

impl PausingSender {
    /// Sends `pace` messages per millisecond.
    pub(super) fn start(link: &Link, pace: u32) -> Result<PausingSender> {
        PausingSender::with_pauses(link, pace, Duration::from_millis(1))
    }

    /// Sends `pace` messages between two pauses.
    pub(super) fn with_pauses(link: &Link, pace: u32, rest: Duration) -> Result<PausingSender> {
        let source = format!("{}:0", link.monitor.address());
        let target = format!("{}:{UNUSED_PORT}", link.robot.address());
        Ok(PausingSender {
            sender: Sender::new(&link.monitor, &source, &target)?,
            carried: 0,
            pace,
            rest,
        })
    }
}

impl Carrier for PausingSender {
    fn send(&mut self, payload: &[u8]) -> Result<()> {
        self.carried += 1;
        if self.carried.is_multiple_of(self.pace) {
            std::thread::sleep(self.rest);
        }
        self.sender.send(payload)
    }
}

#[test]
fn all_caps_reached_together_stay_within_the_memory_of_the_unit() -> Result<()> {
    let limit = Allowance::of_the_unit()?.memory;
    let group = UnitCgroups::to_memory(limit)?;
    let link = Link::new()?;
    let directory = tempfile::tempdir()?;
    let place = directory.path().display();
    fs::create_dir(directory.path().join("state"))?;
    let configuration = format!(
        "watch: [{{topic: /**, per_subscriber: true}}]\nlog: warn\nstate_directory: {place}/state\n\
         recordings: {{directory: {place}/bags, reserve_percent: 0, reserve_bytes: 0}}\n\
         {ON_THE_WIRE}"
    );
    let enter = group.enter();
    let words = ["sh", "-c", &enter];
    let scene = FaultBench::start(&link.robot, &directory, &configuration, &words)?;
    let idle = group.needed()?;
    let mut real = Counted::start(&link, 900_000, "real")?;
    real.send_samples(320, 50)?;
    let span = Duration::from_secs(if long().is_some() { 120 } else { 4 });
    let (sent, peak) = storm(&scene, &group, &link, span, 0.9)?;
    ensure!(peak < limit, "{peak} bytes with what sockets take");
    let took = scene.end()?;

    // The saved state does not exhaust the memory of the next agent, neither at its start nor
    // later.
    let state = fs::metadata(directory.path().join("state/discovery.json"))?.len();
    let scene = FaultBench::start(&link.robot, &directory, &configuration, &words)?;
    let restarted = group.needed()?;
    let (more, again) = storm(&scene, &group, &link, span / 2, 0.0)?;
    ensure!(again < limit, "{again} bytes with what sockets take");
    scene.end()?;
    outcome(
        &format!(
            "every cap at once in {} MiB (MemoryMax, no swap)",
            mebibytes(limit)
        ),
        &format!(
            "{} hostile datagrams, 12 readers that do not read, 4 recordings: {:.1} MiB at most ({:.1} MiB \
             before), not killed; ended in {took:?}; started again with a state of {:.1} MiB: {:.1} MiB, {:.1} MiB \
             at most",
            sent + more,
            mebibytes(peak),
            mebibytes(idle),
            mebibytes(state),
            mebibytes(restarted),
            mebibytes(again)
        ),
    )
}

/// Sends all messages concurrently, for at least this time and until this part of the tables is
/// used. Returns the number of datagrams sent and the maximum memory needed.
fn storm(
    scene: &FaultBench<'_>,
    group: &UnitCgroups,
    link: &Link,
    span: Duration,
    filled: f64,
) -> Result<(u64, u64)> {
    // These clients request all messages and never read them.
    let mut readers = Vec::new();
    for _ in 0..12 {
        let mut stream = scene.connect(API_PORT)?;
        let path = "/samples?all=true&hidden=true&payload=true&queue_bytes=16777216";
        let request = format!("GET {path} HTTP/1.1\r\nHost: localhost\r\n\r\n");
        stream.write_all(request.as_bytes())?;
        readers.push(stream);
    }
    for number in 0..4 {
        let body = format!(r#"{{"name": "all_{number}_{}"}}"#, scene.pid());
        let (status, begun) = scene.ask("POST", "/recordings", &body)?;
        ensure!(status == 201, "{status} {begun}");
    }
    let storms = [
        Storm::of_a_crowd(PausingSender::start(link, 64)?, 1200, 12),
        Storm::start(PausingSender::start(link, 8)?, forgery),
        Storm::of_large_samples(PausingSender::start(link, 4)?)?,
    ];
    let began = Instant::now();
    let (mut peak, mut is_full) = (0, false);
    while began.elapsed() < span || !is_full {
        ensure!(
            group.oom_kills()? == 0,
            "killed after {:?}",
            began.elapsed()
        );
        peak = peak.max(group.needed()?);
        // A page of all entries needs memory, too.
        let page = scene.agent.scrape()?;
        is_full = ["participants", "endpoints"].into_iter().all(|table| {
            let label = [("table", table)];
            let entries = page.sum("ros2probe_table_entries", &label);
            entries >= filled * page.sum("ros2probe_table_limit", &label)
        });
        ensure!(
            is_full || began.elapsed() < span + PATIENCE,
            "the tables are not full"
        );
        std::thread::sleep(Duration::from_millis(200));
    }
    let mut sent = 0;
    for storm in storms {
        sent += storm.end()?;
    }
    ensure!(group.oom_kills()? == 0, "killed at the end");
    Ok((sent, peak))
}
