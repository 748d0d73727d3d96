//! `make bench`: what observing costs. Each workload runs between two hosts without an observer,
//! with the agent beside the publisher, and with a Cyclone DDS subscriber in C++ there instead; the
//! table shows the observer's CPU time and memory, and what the whole machine spent.
//!
//! It measures and prints; limits are asserted by the tests.

use std::path::PathBuf;
use std::time::{Duration, Instant};

use anyhow::{Context as _, Result, bail};
use clap::Parser;

use crate::harness::agent::Agent;
use crate::harness::network::Link;
use crate::harness::peer::{Peer, Role, Stack, Stream};
use crate::harness::usage::{Usage, machine_cpu};

#[path = "../../tests/harness/mod.rs"]
mod harness;

/// Time for discovery to settle and caches to fill before the window opens.
const WARM_UP: Duration = Duration::from_secs(3);

const WORKLOADS: [(&str, usize, f64); 6] = [
    ("320 B @ 200 Hz", 320, 200.0),
    ("644 KB @ 20 Hz", 644_000, 20.0),
    ("2.72 MB @ 20 Hz", 2_720_000, 20.0),
    ("64 KiB @ 100 Hz", 65_536, 100.0),
    ("64 KiB @ 500 Hz", 65_536, 500.0),
    ("64 KiB @ 1000 Hz", 65_536, 1000.0),
];

#[derive(Parser)]
#[command(about = "Measures what observing costs; needs root for network namespaces")]
struct Options {
    /// The agent; `rp` of the same build when left out
    #[arg(long)]
    agent: Option<PathBuf>,
    /// Length of each measurement
    #[arg(long, default_value_t = 20)]
    seconds: u64,
    /// Only workloads whose name contains this
    #[arg(long, default_value = "")]
    only: String,
}

#[derive(Clone, Copy)]
enum Observer {
    None,
    Agent,
    Subscriber,
}

struct Cost {
    machine: Duration,
    observer: Option<Usage>,
    /// Samples sent and samples the agent counted, over its whole life.
    counted: Option<(u64, f64)>,
    /// Bytes copied to user space of the bytes that the agent reports.
    copied: Option<f64>,
}

fn main() -> Result<()> {
    let options = Options::parse();
    let program = match &options.agent {
        Some(program) => program.clone(),
        None => peer_directory()?.join("rp"),
    };
    if !program.exists() {
        bail!("{} is missing: run `make bench`", program.display());
    }
    let window = Duration::from_secs(options.seconds.max(1));
    println!(
        "{} s each; machine: all processes and the kernel\n",
        window.as_secs()
    );
    println!(
        "{:<17} {:<11} {:>10} {:>9} {:>12} {:>10} {:>14}",
        "workload", "observer", "CPU s", "PSS MB", "machine s", "copied", "counted/sent"
    );
    for (name, size, rate) in WORKLOADS {
        if !name.contains(&options.only) {
            continue;
        }
        for observer in [Observer::None, Observer::Agent, Observer::Subscriber] {
            let cost = measure(size, rate, observer, &program, window)
                .with_context(|| format!("{name} with {}", observer.name()))?;
            println!("{name:<17} {:<11} {cost}", observer.name());
        }
    }
    Ok(())
}

fn measure(
    size: usize,
    rate: f64,
    observer: Observer,
    program: &PathBuf,
    window: Duration,
) -> Result<Cost> {
    let link = Link::new()?;
    let stream = Stream {
        rate,
        ..Stream::point_cloud(size, 0)
    };
    let unlogged = Stream {
        logged: false,
        ..stream.clone()
    };
    let directory = tempfile::tempdir().context("cannot create a directory")?;
    let configuration = directory.path().join("ros2probe.yaml");
    std::fs::write(&configuration, "watch:\n  - /**\n").context("cannot write a configuration")?;

    let agent = match observer {
        Observer::Agent => Some(Agent::start(&link.robot, program, &configuration)?),
        _ => None,
    };
    let second = match observer {
        Observer::Subscriber => Some(Peer::start(
            &link.robot,
            Stack::Cyclone,
            Role::Subscriber,
            &unlogged,
            &["/observer"],
        )?),
        _ => None,
    };
    let mut subscriber = Peer::start(
        &link.monitor,
        Stack::Cyclone,
        Role::Subscriber,
        &unlogged,
        &["/listener"],
    )?;
    let mut publisher = Peer::start(
        &link.robot,
        Stack::Cyclone,
        Role::Publisher,
        &stream,
        &["/lidar"],
    )?;
    publisher.wait_matched()?;
    subscriber.wait_matched()?;
    publisher.go()?;
    std::thread::sleep(WARM_UP);

    let observing = match (&agent, &second) {
        (Some(agent), _) => Some(&agent.process),
        (None, Some(second)) => Some(&second.process),
        (None, None) => None,
    };
    let before = observing
        .map(|process| Usage::of(process.pid()))
        .transpose()?;
    let (machine, began) = (machine_cpu()?, Instant::now());
    std::thread::sleep(window.saturating_sub(began.elapsed()));
    let machine = machine_cpu()?.saturating_sub(machine);
    let after = observing
        .map(|process| Usage::of(process.pid()))
        .transpose()?;

    publisher.process.terminate()?;
    let sent = publisher.log()?.sequences("pub").len() as u64;
    let scrape = agent.as_ref().map(Agent::settled_scrape).transpose()?;
    let topic = [("topic", stream.topic)];
    let counted = scrape
        .as_ref()
        .map(|scrape| scrape.sum("ros2_topic_messages_total", &topic));
    let copied = scrape.as_ref().map(|scrape| {
        scrape.sum("ros2probe_capture_copied_bytes_total", &[])
            / scrape.sum("ros2_topic_bytes_total", &topic)
    });
    Ok(Cost {
        machine,
        observer: after
            .zip(before)
            .map(|(after, before)| after.since(&before)),
        counted: counted.map(|counted| (sent, counted)),
        copied,
    })
}

fn peer_directory() -> Result<PathBuf> {
    let program = std::env::current_exe().context("cannot tell where this program is")?;
    Ok(program
        .ancestors()
        .nth(2)
        .context("this program is in no directory")?
        .to_owned())
}

impl Observer {
    fn name(self) -> &'static str {
        match self {
            Observer::None => "none",
            Observer::Agent => "agent",
            Observer::Subscriber => "subscriber",
        }
    }
}

impl std::fmt::Display for Cost {
    fn fmt(&self, formatter: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let dash = || "-".to_owned();
        let cpu = self
            .observer
            .map_or_else(dash, |usage| format!("{:.3}", usage.cpu.as_secs_f64()));
        let pss = self
            .observer
            .map_or_else(dash, |usage| format!("{:.1}", usage.pss as f64 / 1e6));
        let copied = self
            .copied
            .map_or_else(dash, |ratio| format!("{:.3} %", ratio * 100.0));
        let counted = self
            .counted
            .map_or_else(dash, |(sent, counted)| format!("{counted}/{sent}"));
        let machine = self.machine.as_secs_f64();
        write!(
            formatter,
            "{cpu:>10} {pss:>9} {machine:>12.2} {copied:>10} {counted:>14}"
        )
    }
}
