//! The command line.

use std::net::SocketAddr;
use std::path::PathBuf;

use clap::{Args, Parser, Subcommand};
use ros2probe::capture::pcap::Speed;
use ros2probe::config::Watch;
use ros2probe::model::discovery::hexadecimal;
use ros2probe_wire::GuidPrefix;

/// Where the package puts it.
pub(crate) const DEFAULT_CONFIG: &str = "/etc/ros2probe/ros2probe.yaml";

/// Watches a ROS 2 robot from copies of its DDS traffic, without joining it.
#[derive(Debug, Parser)]
#[command(name = "rp", version, max_term_width = 100)]
pub(crate) struct Arguments {
    #[command(subcommand)]
    pub(crate) command: Command,
}

#[derive(Debug, Subcommand)]
pub(crate) enum Command {
    /// Run the agent: observe this host or a capture, serve /metrics
    Run(Run),
    /// Check a configuration file and report every mistake
    #[command(after_help = "Exit code: 0 when it is good, 78 when it is not.")]
    CheckConfig {
        /// The file
        #[arg(default_value = DEFAULT_CONFIG)]
        file: PathBuf,
    },
    /// Ask running participants to repeat their announcements: the only command that sends
    Discover(Discover),
}

#[derive(Debug, Args)]
#[command(after_help = "\
Signals: SIGHUP reads the configuration again, SIGTERM and SIGINT end the agent.
Exit codes: 0 ended as asked, 77 a capability is missing, 78 the configuration is wrong, 1 otherwise.
RUST_LOG, read at the start, overrides the configured log level.

Examples:
  sudo rp run                                     observe this host
  rp run --replay robot.pcap.gz --report          what was on the wire, as metrics on stdout
  rp run --replay robot.pcap --watch '/camera/**' --metrics 127.0.0.1:9400")]
pub(crate) struct Run {
    /// Configuration file; when left out, /etc/ros2probe/ros2probe.yaml if there is one
    #[arg(long, value_name = "FILE")]
    pub(crate) config: Option<PathBuf>,
    /// Observe a capture (pcap or pcapng, may be gzipped) instead of this host; needs no privilege
    #[arg(long, value_name = "FILE")]
    pub(crate) replay: Option<PathBuf>,
    /// How fast to replay: a factor, or `max` [default: 1, with --report max]
    #[arg(long, value_name = "N|max", requires = "replay")]
    pub(crate) speed: Option<Speed>,
    /// At the end of the capture, print the metrics on stdout and exit
    #[arg(long, requires = "replay")]
    pub(crate) report: bool,
    /// Also measure this topic or glob, as /points or '/camera/**'; may be repeated
    #[arg(long, value_name = "GLOB", value_parser = watch)]
    pub(crate) watch: Vec<Watch>,
    /// Address and port of the metrics listener, or `off`, instead of the configured one
    #[arg(long, value_name = "ADDR|off", value_parser = listen)]
    pub(crate) metrics: Option<Listen>,
    /// Address and port of the control API, or `off` (also for its unix socket), instead of the
    /// configured one
    #[arg(long, value_name = "ADDR|off", value_parser = listen)]
    pub(crate) api: Option<Listen>,
}

#[derive(Debug, Args)]
#[command(after_help = "\
An agent that was started after the robot knows who is there, but not what they called their topics
and nodes: that is said once. This command finds the participants by listening, prints what it will
send, and asks: at most 6 packets for each, to it alone, from a participant of a few milliseconds
that says goodbye. A running agent on this host sees the answers too. With neither --participant
nor --all it lists whom it could ask.
Participants with DDS security are not asked. Needs the same capabilities as `rp run`.
Exit codes: 0 all answered, 77 a capability is missing, 78 the configuration is wrong, 1 otherwise.

Examples:
  sudo rp discover --all --dry-run                what would be sent to whom
  sudo rp discover --all                          everybody
  sudo rp discover --participant 010f1a2b3c4d5e6f00000000")]
pub(crate) struct Discover {
    /// Only participants of this domain
    #[arg(long, value_name = "N")]
    pub(crate) domain: Option<u32>,
    /// Ask this participant, by its GUID prefix: 24 hexadecimal digits
    #[arg(long, value_name = "PREFIX", value_parser = prefix, conflicts_with = "all")]
    pub(crate) participant: Option<GuidPrefix>,
    /// Ask every participant that is heard
    #[arg(long)]
    pub(crate) all: bool,
    /// Print what would be sent, and send nothing
    #[arg(long)]
    pub(crate) dry_run: bool,
    /// Ask for endpoints alone: one packet less
    #[arg(long)]
    pub(crate) no_nodes: bool,
    /// Listen on the wire of this interface instead of at the host's sockets
    #[arg(long, value_name = "NAME")]
    pub(crate) interface: Option<String>,
    /// How long to listen for participants: most announce themselves every 3 to 8 seconds
    #[arg(long, value_name = "SECONDS", default_value_t = 10,
        value_parser = clap::value_parser!(u64).range(1..=120))]
    pub(crate) listen: u64,
    /// Configuration file, for its `capture`; when left out, /etc/ros2probe/ros2probe.yaml if there is one
    #[arg(long, value_name = "FILE")]
    pub(crate) config: Option<PathBuf>,
}

/// Where `--metrics` or `--api` wants the listener.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Listen(pub(crate) Option<SocketAddr>);

fn watch(pattern: &str) -> Result<Watch, String> {
    Watch::named(pattern).map_err(|error| format!("the topic {error}"))
}

fn prefix(text: &str) -> Result<GuidPrefix, String> {
    // The label `participant` goes on with the entity.
    let text = text.strip_suffix(".000001c1").unwrap_or(text);
    let prefix = hexadecimal(text).map(GuidPrefix);
    prefix.ok_or_else(|| "must be 24 hexadecimal digits, as in ros2_participant_info".to_owned())
}

fn listen(address: &str) -> Result<Listen, String> {
    if address == "off" {
        return Ok(Listen(None));
    }
    let address = address.parse();
    address
        .map(|address| Listen(Some(address)))
        .map_err(|_| "must be an IP address and port, as 127.0.0.1:17400, or `off`".to_owned())
}

#[cfg(test)]
mod tests {
    use clap::CommandFactory as _;

    use super::*;

    #[test]
    fn the_command_line_is_consistent() {
        Arguments::command().debug_assert();
    }

    #[test]
    fn a_participant_is_named_as_the_metrics_name_it() {
        let digits = "010f1a2b3c4d5e6f00000000";
        assert_eq!(prefix(digits).unwrap().to_string(), digits);
        assert_eq!(prefix(&format!("{digits}.000001c1")), prefix(digits));
        for wrong in [
            "",
            "010f",
            "all",
            &digits[1..],
            &format!("{digits}.00000103"),
        ] {
            assert!(prefix(wrong).is_err(), "{wrong}");
        }
    }
}
