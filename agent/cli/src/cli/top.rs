//! `rp top`.

use std::process::ExitCode;
use std::time::Duration;

use anyhow::Result;
use clap::Args;
use ros2probe::client::{Agent, Target};
use ros2probe::top::{self, Column, Options};
use ros2probe_daemon::agent::Speed;

use super::{Output, UserError};

/// Maximum interval between two requests, in seconds.
const MAX_INTERVAL: f64 = 3600.0;

/// `rp top`.
#[derive(Args, Debug)]
#[command(after_help = "\
Without --domain it shows all domains. Press ? for the keys. NO_COLOR and the locale are honoured.
Topics that are not watched are not measured: press w to measure the selected one until rp top ends.

Examples:
  rp top                                  the robot's topics, live
  rp top --sort loss --filter camera
  ssh robot rp top --once --problems      one table as text
  rp top --replay robot.pcap.gz           the same from a capture")]
pub(crate) struct Top {
    /// Print one table as text and end; needs no terminal
    #[arg(long, visible_alias = "batch")]
    once: bool,
    /// Column to sort by
    #[arg(long, value_enum, value_name = "COLUMN", default_value_t = Column::Name)]
    sort: Column,
    /// Reverse the order
    #[arg(long)]
    reverse: bool,
    /// Show only topics with this text in name, type or state
    #[arg(
        long,
        value_name = "TEXT",
        default_value = "",
        hide_default_value = true
    )]
    filter: String,
    /// Show only topics with problems
    #[arg(long)]
    problems: bool,
    /// Also show hidden topics and the topics of services
    #[arg(long)]
    hidden: bool,
    /// Interval between requests to the agent
    #[arg(long, value_name = "SECONDS", default_value = "1", value_parser = interval,
        conflicts_with = "once")]
    interval: Duration,
    /// How fast to replay a capture: a factor, or `max`
    #[arg(
        long,
        value_name = "N|max",
        requires = "replay",
        conflicts_with = "once"
    )]
    speed: Option<Speed>,
    #[command(flatten)]
    target: Target,
}

impl Top {
    pub(crate) fn run(self) -> Result<ExitCode> {
        let options = Options {
            domain_id: self.target.domain_id,
            sort: self.sort,
            reverse: self.reverse,
            filter: self.filter,
            problems: self.problems,
            hidden: self.hidden,
        };
        if self.target.from.is_some() {
            let text = "rp: rp top cannot start in the middle of a capture: leave out --from";
            return Err(UserError(text.to_owned()).into());
        }
        let speed = self.speed.unwrap_or(Speed::Times(1.0));
        let agent = Agent::reach_measured(&self.target, (!self.once).then_some(speed))?;
        if self.once {
            Output::new().write(&top::once(&agent, &options)?)?;
            return Ok(ExitCode::SUCCESS);
        }
        Ok(top::live(agent, &options, self.interval)?.into())
    }
}

fn interval(text: &str) -> Result<Duration, UserError> {
    let seconds: Option<f64> = text.parse().ok();
    let seconds = seconds.filter(|seconds| (0.1..=MAX_INTERVAL).contains(seconds));
    let wrong = || {
        UserError(format!(
            "must be a number of seconds, 0.1 to {MAX_INTERVAL}"
        ))
    };
    seconds.map(Duration::from_secs_f64).ok_or_else(wrong)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_too_short_or_too_long_interval_is_refused() {
        assert_eq!(interval("0.5").unwrap(), Duration::from_millis(500));
        for wrong in ["0", "-1", "inf", "nan", "", "1s", "1e9"] {
            assert!(interval(wrong).is_err(), "{wrong}");
        }
    }
}
