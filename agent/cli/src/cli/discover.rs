//! `rp discover`: options for the participants, the router and the requests.

use std::path::PathBuf;

use super::UserError;
use clap::Args;
use ros2probe::discover::zenoh::address::RouterAddress;
use ros2probe::discover::{GuidPrefix, participants};

#[derive(Debug, Args)]
#[command(after_help = "\
An agent started after the robot knows the participants, but not their topics and nodes, which are
announced only once. This command finds participants by listening, prints what it will send, and
requests the announcements again: at most 6 unicast packets for each, from a participant that lives
for a few milliseconds and says goodbye. A running agent on this host sees the answers too. Without
--participant and --all it lists the participants.
Participants with DDS security receive no requests. Needs the same capabilities as `rp run`.
With rmw_zenoh, --router requests the graph from a Zenoh router instead: 4 messages over one TCP
connection, as a client that declares nothing. It needs no capability.
Exit codes: 0 all answered, 77 a capability is missing, 78 the configuration is invalid, 1 otherwise.

Examples:
  sudo rp discover --all --dry-run                print what would be sent
  sudo rp discover --all                          all participants
  sudo rp discover --participant 010f1a2b3c4d5e6f00000000
  rp discover --router                            the Zenoh router of this host
  rp discover --router 10.0.0.5:7447 --dry-run    print what would be sent to another router")]
pub(crate) struct Discover {
    /// Only participants of this domain, or with --router its nodes
    #[arg(long, value_name = "N")]
    pub(crate) domain: Option<u32>,
    /// Request from this participant, by its GUID prefix: 24 hexadecimal digits
    #[arg(long, value_name = "PREFIX", value_parser = prefix, conflicts_with = "all")]
    pub(crate) participant: Option<GuidPrefix>,
    /// Request from every participant found
    #[arg(long)]
    pub(crate) all: bool,
    /// Request the graph from the Zenoh router at this address [default: localhost:7447]
    #[arg(long, value_name = "HOST:PORT", num_args = 0..=1,
        default_missing_value = "localhost:7447", value_parser = RouterAddress::parse,
        conflicts_with_all = ["participant", "all", "no_nodes", "interface", "listen", "config"])]
    pub(crate) router: Option<RouterAddress>,
    /// Print what would be sent, but send nothing
    #[arg(long)]
    pub(crate) dry_run: bool,
    /// Request endpoints only: one packet less
    #[arg(long)]
    pub(crate) no_nodes: bool,
    /// Listen on this interface instead of at the host's sockets
    #[arg(long, value_name = "NAME")]
    pub(crate) interface: Option<String>,
    /// How long to listen for participants: most announce themselves every 3 to 8 seconds
    #[arg(long, value_name = "SECONDS", default_value_t = 10,
        value_parser = clap::value_parser!(u64).range(1..=120))]
    pub(crate) listen: u64,
    /// Configuration file, for its `capture` section [default: /etc/ros2probe/ros2probe.yaml, if it
    /// exists]
    #[arg(long, value_name = "FILE")]
    pub(crate) config: Option<PathBuf>,
}

fn prefix(text: &str) -> Result<GuidPrefix, UserError> {
    let prefix = participants::prefix(text);
    let wrong = "must be 24 hexadecimal digits, as in ros2_participant_info";
    prefix.ok_or_else(|| UserError(wrong.to_owned()))
}
