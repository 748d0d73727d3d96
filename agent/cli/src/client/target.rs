//! Options that all verbs share: the agent, the domain and the distribution.

use std::io;
use std::path::PathBuf;

use clap::Args;

use super::{ClientError, Compressed};
use crate::ros2::{Dialect, dialect};
use ros2probe_api::MAX_DOMAIN_ID;
use ros2probe_daemon::run::CaptureTime;

/// Maximum size of a token file, in bytes.
const MAX_TOKEN: u64 = 4096;

/// Agent, domain and distribution of a command. Flatten it last, because of its heading.
#[derive(Args, Clone, Debug, Default)]
#[command(next_help_heading = "Which agent")]
pub struct Target {
    /// The agent on another host; the default port is 17401
    #[arg(long, value_name = "HOST[:PORT]", conflicts_with = "socket")]
    pub host: Option<String>,
    /// File with the agent's token [default: $ROS2PROBE_TOKEN_FILE]
    #[arg(long, value_name = "FILE")]
    pub token_file: Option<PathBuf>,
    /// The agent behind this unix socket [default: /run/ros2probe/api.sock, then loopback]
    #[arg(long, value_name = "PATH")]
    pub socket: Option<PathBuf>,
    /// Query a capture (pcap or pcapng, may be gzipped) or a bag instead of an agent
    #[arg(long, value_name = "FILE", conflicts_with_all = ["host", "socket"])]
    pub replay: Option<PathBuf>,
    /// Start at this time of the capture: Unix seconds, or +S from its beginning
    #[arg(long, value_name = "T", requires = "replay")]
    pub from: Option<CaptureTime>,
    /// End at this time of the capture
    #[arg(long, value_name = "T", requires = "replay")]
    pub until: Option<CaptureTime>,
    /// How far a compressed capture may expand.
    #[command(flatten)]
    pub compressed: Compressed,
    /// The robot's domain [default: $ROS_DOMAIN_ID, else 0]
    #[arg(long = "domain", value_name = "N",
        value_parser = clap::value_parser!(u32).range(..=i64::from(MAX_DOMAIN_ID)))]
    pub domain_id: Option<u32>,
    /// Distribution whose output to print [default: $ROS_DISTRO, else jazzy]
    #[arg(long, value_name = "DISTRO", value_parser = dialect::parser(), hide_possible_values = true)]
    pub distro: Option<Dialect>,
}

/// A variable of the environment has an invalid value.
#[derive(Debug, thiserror::Error)]
#[error("ROS_DOMAIN_ID is `{0}`, but must be a number from 0 to {MAX_DOMAIN_ID}")]
pub struct InvalidEnvironment(String);

impl Target {
    /// Returns the domain of the command.
    ///
    /// # Errors
    ///
    /// Fails if `ROS_DOMAIN_ID` is not a valid domain.
    pub fn domain(&self) -> Result<u32, InvalidEnvironment> {
        if let Some(domain_id) = self.domain_id {
            return Ok(domain_id);
        }
        match std::env::var("ROS_DOMAIN_ID") {
            Ok(text) if !text.trim().is_empty() => {
                let domain_id = text.trim().parse().ok();
                domain_id
                    .filter(|domain_id| *domain_id <= MAX_DOMAIN_ID)
                    .ok_or(InvalidEnvironment(text))
            }
            _ => Ok(0),
        }
    }

    /// Returns the dialect of the output.
    #[must_use]
    pub fn dialect(&self) -> Dialect {
        let named = || Dialect::of_distro(&std::env::var("ROS_DISTRO").ok()?);
        self.distro.or_else(named).unwrap_or_default()
    }

    /// Reads the token if one is configured.
    pub(super) fn token(&self) -> Result<Option<String>, ClientError> {
        let named = || std::env::var_os("ROS2PROBE_TOKEN_FILE").filter(|path| !path.is_empty());
        let path = self.token_file.clone();
        let Some(path) = path.or_else(|| named().map(PathBuf::from)) else {
            return Ok(None);
        };
        let read = || {
            let mut text = String::new();
            let file = std::fs::File::open(&path)?;
            io::Read::read_to_string(&mut io::Read::take(file, MAX_TOKEN), &mut text)?;
            let token = text.trim();
            if token.is_empty() || !token.bytes().all(|byte| byte.is_ascii_graphic()) {
                let reason = "it must hold one line of printable characters";
                return Err(io::Error::new(io::ErrorKind::InvalidData, reason));
            }
            Ok(token.to_owned())
        };
        match read() {
            Ok(token) => Ok(Some(token)),
            Err(source) => Err(ClientError::Token { path, source }),
        }
    }
}
