//! `make demo`: a robot and an operator's host in separate network namespaces, the agent on the
//! robot, and a live summary of its metrics. The machine's own network does not change. Metrics,
//! control API and page are relayed to ports of this machine. `rp`, `curl` and a browser reach them
//! there as on a real host.
//!
//! The summary reads only `/metrics`, which is public.

use std::io::IsTerminal;
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::time::Duration;

use anyhow::{Context as _, Result, bail};
use clap::Parser;

use crate::summary::Summary;
use ros2probe_testing::harness::agent::Agent;
use ros2probe_testing::harness::network::Link;
use ros2probe_testing::harness::relay::{self, Relay};
use ros2probe_testing::harness::{ended, peer};

mod summary;

const REFRESH: Duration = Duration::from_secs(2);
/// The agent's default ports, which are also used here if they are free.
const METRICS: u16 = 17400;
const API: u16 = 17401;
/// Port of the listener for viewers.
const VIEWERS: u16 = 8765;

#[derive(Parser)]
#[command(about = "Shows the agent watching a small robot; needs root for network namespaces")]
struct Options {
    /// Program of the agent [default: `rp` of the same build]
    #[arg(long)]
    agent: Option<PathBuf>,
    #[arg(long, default_value = "config/ros2probe.yaml")]
    config: PathBuf,
    /// End after this many seconds
    #[arg(long)]
    seconds: Option<f64>,
    #[arg(long, hide = true)]
    relay: Option<PathBuf>,
    #[arg(long, hide = true, default_value_t = METRICS)]
    port: u16,
}

/// The relayed listeners of the agent.
pub(crate) struct Relays {
    pub(crate) metrics: Relay,
    /// The control API and the page.
    pub(crate) api: Relay,
    /// The listener for viewers.
    pub(crate) viewers: Relay,
}

impl Relays {
    /// Returns the options with which commands reach the agent; empty if the default ports are
    /// relayed.
    pub(crate) fn options(&self, port: u16) -> String {
        match self.api.address() {
            address if address.port() == port => String::new(),
            address => format!(" --host {address}"),
        }
    }
}

fn main() -> ExitCode {
    match demo(&Options::parse()) {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("demo: {error:#}");
            ExitCode::FAILURE
        }
    }
}

/// Runs on one thread: the processes started below live as long as this thread.
#[tokio::main(flavor = "current_thread")]
async fn demo(options: &Options) -> Result<()> {
    if let Some(socket) = &options.relay {
        return relay::serve(socket, options.port);
    }
    let agent = options.agent.clone().map_or_else(peer::rp, Ok)?;
    let command = as_typed(&agent);
    for needed in [&agent, &options.config] {
        if !needed.exists() {
            bail!(
                "{} is missing: run `make demo`, which builds it",
                needed.display()
            );
        }
    }
    let mut end = std::pin::pin!(ended(options.seconds));

    let link = Link::new()?;
    println!(
        "two hosts, {} and {}, on one cable",
        link.robot.name(),
        link.monitor.name()
    );
    let directory = tempfile::tempdir().context("cannot create a directory")?;
    let log = directory.path().join("agent.log");
    let config = directory.path().join("ros2probe.yaml");
    std::fs::write(&config, for_one_host(&options.config, link.robot.cgroup())?)
        .context("cannot write a configuration")?;
    let agent = Agent::start_logging(&link.robot, agent, &config, &log)
        .with_context(|| format!("the agent said: {}", read_lossy(&log).trim()))?;
    let relays = Relays {
        metrics: Relay::start(&link.robot, directory.path(), METRICS)?,
        api: Relay::start(&link.robot, directory.path(), API)?,
        viewers: Relay::start(&link.robot, directory.path(), VIEWERS)?,
    };
    let robots = [
        peer::start_robot(&link.robot, "lidar")?,
        peer::start_robot(&link.robot, "base")?,
        peer::start_robot(&link.monitor, "monitor")?,
    ];

    let mut summary = Summary::new(std::io::stdout().is_terminal(), command);
    let mut failure = None;
    loop {
        tokio::select! {
            interrupted = &mut end => {
                interrupted?;
                break;
            }
            () = tokio::time::sleep(REFRESH) => {}
        }
        match agent.scrape() {
            Ok(scrape) => summary.show(&scrape, &relays, &link),
            Err(error) => {
                failure =
                    Some(error.context(format!("the agent said: {}", read_lossy(&log).trim())));
                break;
            }
        }
    }
    println!("\nstopping the robot and the agent");
    drop(relays);
    for mut robot in robots {
        robot.terminate()?;
    }
    let mut agent = agent;
    let status = agent.process.terminate()?;
    match failure {
        Some(error) => Err(error),
        None if !status.success() => bail!("the agent ended with {status}"),
        None => Ok(()),
    }
}

/// Returns the configuration for the sockets of one host only, since both hosts are this machine.
/// An agent of this machine keeps its unix socket. Loopback has all rights (`Agent::start`).
fn for_one_host(config: &Path, cgroup: &Path) -> Result<String> {
    let mut text = std::fs::read_to_string(config)
        .with_context(|| format!("cannot read {}", config.display()))?;
    for (section, key) in [
        ("capture", format!("cgroup: {}", cgroup.display())),
        ("api", "socket: off".to_owned()),
    ] {
        let head = format!("\n{section}:\n");
        let (before, after) = text.split_once(&head).unwrap_or((&text, ""));
        text = format!("{before}{head}  {key}\n{after}");
    }
    Ok(text)
}

/// Returns a program as a user of this directory types it.
fn as_typed(program: &Path) -> String {
    let here = std::env::current_dir().ok();
    let below = here.and_then(|here| program.strip_prefix(here).ok());
    below.unwrap_or(program).display().to_string()
}

fn read_lossy(path: &Path) -> String {
    let bytes = std::fs::read(path).unwrap_or_default();
    String::from_utf8_lossy(&bytes).into_owned()
}
