//! Clocks of hosts: a real publisher on another host has a clock that is ahead, behind, or drifts.
//! The agent's offset is within its bounds. Needs root, and libfaketime, which shifts the clock of
//! one process.

use std::path::PathBuf;
use std::time::{Duration, SystemTime};

use anyhow::{Context as _, Result, ensure};
use ros2probe_testing::harness::agent::{Agent, PACKETS_ALONE, get};
use ros2probe_testing::harness::network::Link;
use ros2probe_testing::harness::peer::{Peer, Role, Stack, Stream};
use serde_json::Value;

/// Rate of the messages to the agent's host, in hertz.
const RATE: f64 = 20.0;
/// Rate of the messages from it. Cyclone DDS requests an acknowledgement with a message that is 80
/// ms or more after the one before, and with no other.
const RATE_BACK: f64 = 5.0;
/// Maximum time until the agent knows the offset well.
const PATIENCE: Duration = Duration::from_secs(60);
/// Greatest error of the process's clock itself: libfaketime computes with microseconds, and each
/// process begins to drift at its own start.
const RESOLUTION: f64 = 0.000_1;

/// The clock of a publisher, in the notation of libfaketime, with its truth.
struct Clock {
    notation: &'static str,
    ahead_seconds: f64,
    drift: f64,
}

#[test]
fn a_clock_half_a_millisecond_ahead_is_within_the_bounds() -> Result<()> {
    is_within_bounds(Stack::Fast, "+0.0005", 0.0005, 0.0)
}

#[test]
fn a_clock_20_ms_behind_is_bounded_and_reported() -> Result<()> {
    is_within_bounds(Stack::Cyclone, "-0.02", -0.02, 0.0)
}

#[test]
fn a_clock_three_seconds_ahead_is_within_the_bounds_and_a_finding() -> Result<()> {
    is_within_bounds(Stack::Rust, "+3.0", 3.0, 0.0)
}

#[test]
fn a_clock_that_drifts_by_50_ppm_stays_within_the_bounds() -> Result<()> {
    is_within_bounds(Stack::Rust, "+0 x1.00005", 0.0, 50e-6)
}

fn is_within_bounds(
    stack: Stack,
    notation: &'static str,
    ahead_seconds: f64,
    drift: f64,
) -> Result<()> {
    let clock = Clock {
        notation,
        ahead_seconds,
        drift,
    };
    let link = Link::new()?;
    let directory = tempfile::tempdir()?;
    let configuration = directory.path().join("ros2probe.yaml");
    std::fs::write(
        &configuration,
        format!("watch: [/imu, /back]\n{PACKETS_ALONE}"),
    )?;
    let agent = Agent::start(&link.monitor, env!("CARGO_BIN_EXE_rp"), &configuration)?;

    let stream = Stream {
        rate: RATE,
        reliable: true,
        linger: 120.0,
        ..Stream::small(100_000)
    };
    // The agent's host sends as well: acknowledgements of these messages give the other bound.
    let back = Stream {
        topic: "/back".to_owned(),
        rate: RATE_BACK,
        ..stream.clone()
    };
    let began = SystemTime::now();
    let enter = clock.shifted(&link)?;
    let mut shifted = Peer::launch_behind(&enter, stack, Role::Publisher, &stream, &["/sensor"])?;
    let mut back_to = Peer::launch_behind(&enter, stack, Role::Subscriber, &back, &["/driver"])?;
    shifted.wait_ready()?;
    back_to.wait_ready()?;
    let monitor = &link.monitor;
    let mut listener = Peer::start(monitor, stack, Role::Subscriber, &stream, &["/listener"])?;
    let mut back_from = Peer::start(monitor, stack, Role::Publisher, &back, &["/operator"])?;
    for peer in [&mut shifted, &mut listener, &mut back_to, &mut back_from] {
        peer.wait_matched()?;
    }
    shifted.start_sending()?;
    back_from.start_sending()?;

    // The bounds hold from the first one on, and become narrow.
    let deadline = SystemTime::now() + PATIENCE;
    let mut seen = 0;
    loop {
        std::thread::sleep(Duration::from_millis(500));
        let asked = SystemTime::now();
        if let Some((offset, uncertainty)) = corrections(&agent)? {
            let truth = clock.ahead_seconds + clock.drift * began.elapsed()?.as_secs_f64();
            let error = (offset - truth).abs();
            // The page is at most two seconds older than its request.
            let drifted = clock.drift * (2.0 + asked.elapsed()?.as_secs_f64());
            ensure!(
                error <= uncertainty + RESOLUTION + drifted,
                "{offset} s is not {truth} s +- {uncertainty} s"
            );
            seen += 1;
            if uncertainty < uncertainty_of(stack) && seen >= 20 {
                println!("{stack:?} {notation}: {offset} s +- {uncertainty} s, in truth {truth} s");
                break;
            }
        }
        let known = || get(agent.host, "http://127.0.0.1:17401/clocks");
        ensure!(
            SystemTime::now() < deadline,
            "the offset stays unknown: {}",
            known()?
        );
    }
    let is_apart = clock.ahead_seconds.abs() > 0.01;
    let apart = move |found: Option<f64>| found.unwrap_or(0.0) >= 1.0;
    let labels = [("kind", "clocks_apart")];
    if is_apart {
        agent.scrape_until("a finding", |scrape| {
            apart(scrape.value("ros2_diagnoses", &labels))
        })?;
    } else {
        assert!(!apart(agent.scrape()?.value("ros2_diagnoses", &labels)));
    }
    Ok(())
}

impl Clock {
    /// Returns the words that run a program on the robot with this clock.
    fn shifted(&self, link: &Link) -> Result<Vec<String>> {
        let mut words = link.robot.inside();
        words.extend([
            "env".to_owned(),
            format!("LD_PRELOAD={}", library()?.display()),
            format!("FAKETIME={}", self.notation),
            "FAKETIME_DONT_FAKE_MONOTONIC=1".to_owned(),
            "FAKETIME_DONT_RESET=1".to_owned(),
        ]);
        Ok(words)
    }
}

/// Returns correction and uncertainty of the latencies of the publisher of `/imu`, if known.
fn corrections(agent: &Agent<'_>) -> Result<Option<(f64, f64)>> {
    let url = "http://127.0.0.1:17401/topics/imu";
    let topic: Value = serde_json::from_str(&get(agent.host, url)?)?;
    let clock = &topic["publishers"][0]["clock"];
    let both = clock["correction_seconds"]
        .as_f64()
        .zip(clock["uncertainty_seconds"].as_f64());
    Ok(both)
}

/// Returns the maximum uncertainty of an offset, in seconds. A reader of Fast DDS waits for 5 ms
/// before it acknowledges.
const fn uncertainty_of(stack: Stack) -> f64 {
    match stack {
        Stack::Fast => 0.01,
        _ => 0.001,
    }
}

/// Returns libfaketime for programs with several threads.
pub(crate) fn library() -> Result<PathBuf> {
    let mut directories = std::fs::read_dir("/usr/lib")?;
    let file = directories.find_map(|entry| {
        let file = entry.ok()?.path().join("faketime/libfaketimeMT.so.1");
        file.exists().then_some(file)
    });
    file.context("libfaketime is missing: apt install faketime")
}
