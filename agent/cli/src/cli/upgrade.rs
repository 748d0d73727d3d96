//! `rp upgrade`.

use std::path::{Path, PathBuf};
use std::process::ExitCode;

use anyhow::{Context as _, Result};
use clap::Args;
use ros2probe::upgrade::{Comparison, Feed, Installation, Location, Version};
use ros2probe_daemon::agent::DEFAULT_CONFIG;
use ros2probe_daemon::config::Config;

use super::{Output, UserError};

/// Exit code if there is a newer version, as that of `dnf check-update`.
const EXIT_NEWER: u8 = 100;

/// `rp upgrade`.
#[derive(Args, Debug)]
#[command(after_help = "\
It reads the feed once, compares versions, and prints the commands that upgrade this installation. It
changes nothing. The feed is the file release.json of a release, from --feed or from `upgrade.feed`
in the configuration. There is no default, and neither the agent nor another command reads it.
Before you install a file, verify the signature of its release (docs/release.md).
Exit codes: 0 no newer version, 100 a newer version, 78 the configuration is invalid, 2 wrong usage,
1 otherwise.

Examples:
  rp upgrade --check
  rp upgrade --check --feed https://example.org/ros2probe/release.json
  rp upgrade --check --json | jq -r '.commands[]'")]
pub(crate) struct Upgrade {
    /// Only check: rp does not replace itself
    #[arg(long, required = true)]
    check: bool,
    /// Path or address of the feed [default: `upgrade.feed` of the configuration]
    #[arg(long, value_name = "PATH|URL")]
    feed: Option<Location>,
    /// Configuration file [default: /etc/ros2probe/ros2probe.yaml, if it exists]
    #[arg(long, value_name = "FILE", conflicts_with = "feed")]
    config: Option<PathBuf>,
    /// Print JSON: one object
    #[arg(long)]
    json: bool,
}

impl Upgrade {
    pub(crate) fn print(self) -> Result<ExitCode> {
        let feed = match self.feed {
            Some(feed) => feed,
            None => configured(self.config.as_deref())?,
        };
        let program = std::env::current_exe().context("the path of this program")?;
        let installed = env!("CARGO_PKG_VERSION").parse::<Version>()?;
        let installation = Installation::find(&program, Path::new("/"));
        let comparison = Comparison::new(installed, &Feed::read(&feed)?, &feed, installation);
        let text = match self.json {
            true => serde_json::to_string_pretty(&comparison)? + "\n",
            false => comparison.to_string(),
        };
        Output::new().write(&text)?;
        Ok(match comparison.is_newer() {
            true => ExitCode::from(EXIT_NEWER),
            false => ExitCode::SUCCESS,
        })
    }
}

/// Returns the feed in a configuration. A file named on the command line must exist.
fn configured(file: Option<&Path>) -> Result<Location> {
    let path = file.unwrap_or(Path::new(DEFAULT_CONFIG));
    let config = match file.is_none() && !path.exists() {
        true => Config::default(),
        false => Config::load(path)?,
    };
    let Some(feed) = config.upgrade_feed else {
        let text = format!(
            "rp: no feed of releases is configured: pass --feed PATH|URL, or set `upgrade.feed` in {}",
            path.display()
        );
        return Err(UserError(text).into());
    };
    feed.parse::<Location>().context("upgrade.feed")
}
