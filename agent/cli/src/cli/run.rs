//! `rp run`: the agent's options.

use std::path::PathBuf;

use super::UserError;
use clap::Args;
use clap::builder::{PossibleValue, PossibleValuesParser, TypedValueParser};
use ros2probe::client::Compressed;
use ros2probe_daemon::agent::{Listen, Options, Speed};
use ros2probe_daemon::config::{Access, Watch};
use ros2probe_daemon::private_agent::PrivateAgent;
use ros2probe_wire::DomainId;

#[derive(Debug, Args)]
#[command(after_help = "\
Signals: SIGHUP reloads the configuration, SIGTERM and SIGINT end the agent.
Exit codes: 0 ended on request, 77 a capability is missing, 78 the configuration is invalid, 1 otherwise.
RUST_LOG, read at the start, overrides the configured log level.

Examples:
  sudo rp run                                     observe this host
  sudo rp run --fleet fleet.yaml                  also show the robots of a fleet on the page
  rp run --replay robot.pcap.gz --report          print the capture's metrics to stdout
  rp run --replay robot.pcap --watch '/camera/**' --metrics 127.0.0.1:9400")]
pub(crate) struct Run {
    /// Configuration file [default: /etc/ros2probe/ros2probe.yaml, if it exists]
    #[arg(long, value_name = "FILE")]
    pub(crate) config: Option<PathBuf>,
    /// Show a fleet on the page: configuration whose section `fleet` names engine and store,
    /// instead of the configured section
    #[arg(long, value_name = "FILE")]
    pub(crate) fleet: Option<PathBuf>,
    /// Observe a capture (pcap or pcapng, may be gzipped) or a bag of rosbag2 instead of this host;
    /// needs no privilege
    #[arg(long, value_name = "FILE")]
    pub(crate) replay: Option<PathBuf>,
    /// How fast to replay: a factor, or `max` [default: 1, with --report max]
    #[arg(long, value_name = "N|max", requires = "replay")]
    pub(crate) speed: Option<Speed>,
    #[command(flatten)]
    pub(crate) compressed: Compressed,
    /// At the end of the capture, print the metrics on stdout and exit
    #[arg(long, requires = "replay")]
    pub(crate) report: bool,
    /// Also measure this topic or glob, e.g. /points or '/camera/**'; may be repeated
    #[arg(long, value_name = "GLOB", value_parser = watch)]
    pub(crate) watch: Vec<Watch>,
    /// Address and port of the metrics listener, or `off`, instead of the configured one
    #[arg(long, value_name = "ADDR|off", value_parser = listen)]
    pub(crate) metrics: Option<Listen>,
    /// Address and port of the control API, or `off` (also for its unix socket), instead of the
    /// configured one
    #[arg(long, value_name = "ADDR|off", value_parser = listen)]
    pub(crate) api: Option<Listen>,
    /// Address and port of the listener for Foxglove and other viewers, or `off`, instead of the
    /// configured one
    #[arg(long, value_name = "ADDR|off", value_parser = listen)]
    pub(crate) foxglove: Option<Listen>,
    /// Rights of loopback clients of the control API without a token, instead of the configured
    /// ones
    #[arg(
        long,
        value_name = "LEVEL",
        value_parser = access(),
        overrides_with = "api_loopback"
    )]
    pub(crate) api_loopback: Option<Access>,
    /// Run for one command: socket and bags in this directory, no saved state
    #[arg(long, hide = true, value_name = "DIR", requires_all = ["domain", "parent"])]
    pub(crate) private: Option<PathBuf>,
    /// The only domain that a private agent measures
    #[arg(long, hide = true, value_name = "N", requires = "private")]
    pub(crate) domain: Option<u16>,
    /// Process id of the command that a private agent ends with
    #[arg(long, hide = true, value_name = "PID", requires = "private")]
    pub(crate) parent: Option<i32>,
}

impl From<Run> for Options {
    fn from(run: Run) -> Self {
        let command = run.private.zip(run.domain).zip(run.parent);
        Self {
            private: command.map(|((directory, domain_id), parent)| PrivateAgent {
                directory,
                domain_id: DomainId(domain_id.into()),
                parent,
            }),
            config: run.config,
            fleet: run.fleet,
            replay: run.replay,
            speed: run.speed,
            expansion: run.compressed.into(),
            report: run.report,
            watch: run.watch,
            metrics: run.metrics,
            api: run.api,
            foxglove: run.foxglove,
            api_loopback: run.api_loopback,
            doctor: ros2probe::doctor::of_agent(),
        }
    }
}

/// Reads the value of `--api-loopback`.
fn access() -> impl TypedValueParser<Value = Access> {
    let levels = [
        (
            Access::Read,
            "Graph, figures, events, and which topics are watched",
        ),
        (
            Access::Watch,
            "Also add and remove watches, and follow messages without their bytes",
        ),
        (
            Access::All,
            "Also message payloads, recordings, snapshots and reloads",
        ),
    ];
    let values = levels.map(|(access, help)| PossibleValue::new(access.name()).help(help));
    PossibleValuesParser::new(values).try_map(move |name| {
        let mut levels = levels.into_iter().map(|(access, _)| access);
        levels
            .find(|access| access.name() == name)
            .ok_or("unknown level")
    })
}

fn watch(pattern: &str) -> Result<Watch, UserError> {
    Watch::named(pattern).map_err(|error| UserError(format!("the topic {error}")))
}

fn listen(address: &str) -> Result<Listen, UserError> {
    if address == "off" {
        return Ok(Listen(None));
    }
    let wrong = "must be an IP address and port, as 127.0.0.1:17400, or `off`";
    let address = address.parse();
    address
        .map(|address| Listen(Some(address)))
        .map_err(|_| UserError(wrong.to_owned()))
}
