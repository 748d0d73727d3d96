//! `rp why`: late calls of callbacks, and what made them late.

use std::process::ExitCode;
use std::time::{Duration, Instant};

use anyhow::Result;
use clap::Args;
use jiff::civil::Time;
use jiff::tz::TimeZone;
use jiff::{SignedDuration, Zoned};
use ros2probe::client::{Agent, Target};
use ros2probe::why;
use ros2probe_api::path::encoded;
use ros2probe_api::why::Why as Answer;

use super::UserError;
use super::shared::print_text;

/// Interval of questions while no late call is known.
const POLL_INTERVAL: Duration = Duration::from_secs(1);

/// `rp why`.
#[derive(Args, Debug)]
#[command(after_help = "\
A call of a callback is late if it takes or waits longer than --above; without it, longer than
max_latency_ms of its topic in the watchlist; without that, three times as long as 99 % of its
calls in the last minutes, and at least 5 ms. The command waits until a late call is known.

The sums are those of the kernel's scheduler: cpu, throttled (CPU quota), runnable (others ran
instead) and blocked. From the first request until ten seconds after the last one, the agent also
observes the scheduler's events. They show who ran instead, and divide blocked into lock, sleep,
disk, page_fault, stopped and system_call. Before a call: where its message was, other_callback
(earlier calls), or arrival (the executor waited for the message too). The bar shows the share of
each part by its first letter. `capture: {late: on}` observes the events whenever callbacks are
observed, `off` reports no late calls.

Exit code: 0; 1 if no call was late, or if callbacks are not observed.

Examples:
  rp why
  rp why /cmd_vel --above 20
  rp why --node /controller --last 10m
  rp why /cmd_vel --at 12:36:04
  rp why --chain /points /cmd_vel
  rp why /scan --json | jq '.callbacks[].examples[0].parts'")]
pub(crate) struct Why {
    /// Only callbacks of this topic or node
    #[arg(value_name = "TOPIC|NODE")]
    name: Option<String>,
    /// Only callbacks of this node
    #[arg(long, conflicts_with = "name")]
    node: Option<String>,
    /// Only callbacks of the chains between these topics, as `rp chain` lists them
    #[arg(long, num_args = 2, value_names = ["FROM", "TO"], conflicts_with_all = ["name", "node"])]
    chain: Option<Vec<String>>,
    /// Calls are late that take or wait longer than this, in milliseconds
    #[arg(long, value_name = "MS", value_parser = milliseconds)]
    above: Option<f64>,
    /// Only late calls of this last time, e.g. 10m or 90s [default: all that are known]
    #[arg(long, value_name = "TIME")]
    last: Option<SignedDuration>,
    /// List each late call around this time of the last 24 hours, e.g. 12:36:04
    #[arg(long, value_name = "HH:MM:SS", conflicts_with_all = ["last", "above"])]
    at: Option<Time>,
    /// Maximum time to wait for a late call, in seconds; 0 = do not wait
    #[arg(long, value_name = "S", default_value_t = 30)]
    wait: u64,
    /// Print one JSON object, as GET /why answers
    #[arg(long)]
    json: bool,
    #[command(flatten)]
    target: Target,
}

impl Why {
    pub(crate) fn run(self) -> Result<ExitCode> {
        let agent = Agent::reach(&self.target)?;
        let begin = Instant::now();
        let end = Instant::now() + Duration::from_secs(self.wait);
        let mut has_said = false;
        let at = self.at.map(|at| latest(at, &Zoned::now())).transpose()?;
        let answer = loop {
            let now = Instant::now();
            let path = self.path(now.saturating_duration_since(begin))?;
            let mut answer: Answer<'static> = match self.json {
                true => agent.get(&path)?,
                false => agent.get_visible(&path)?,
            };
            if let Some(at) = at {
                why::keep_around(&mut answer, at);
                break answer;
            }
            if !why::is_empty(&answer) || answer.observed == "off" || now >= end {
                break answer;
            }
            if !std::mem::replace(&mut has_said, true) {
                let seconds = whole_seconds(end.saturating_duration_since(now));
                eprintln!("no late call so far: waiting for at most {seconds} s (Ctrl-C ends)");
            }
            std::thread::sleep(POLL_INTERVAL);
        };
        if self.json {
            print_text(&(serde_json::to_string_pretty(&answer)? + "\n"))?;
            return Ok(ExitCode::from(u8::from(why::is_empty(&answer))));
        }
        if why::is_empty(&answer) {
            return Err(UserError(self.no_late_calls(&answer)).into());
        }
        print_text(&why::text(&answer, &TimeZone::system()))
    }

    /// Returns the path of a request, `since` the command began. A bound says nothing about earlier
    /// calls.
    fn path(&self, since: Duration) -> Result<String> {
        let mut parameters = Vec::new();
        if let Some(name) = self.name.as_ref().or(self.node.as_ref()) {
            parameters.push(format!("name={}", encoded(name)));
        }
        if let Some([from, to]) = self.chain.as_deref() {
            parameters.push(format!("from={}&to={}", encoded(from), encoded(to)));
        }
        if self.at.is_some() {
            parameters.push("history=true".to_owned());
        }
        if let Some(above) = self.above {
            parameters.push(format!("above_ms={above}"));
        }
        if let Some(last) = self.last {
            let seconds = last.as_secs_f64();
            if seconds < 0.0 {
                let text = "--last must not be negative: 10m means the last ten minutes";
                return Err(UserError(text.to_owned()).into());
            }
            parameters.push(format!("last_s={seconds}"));
        } else if self.above.is_some() && self.wait > 0 {
            parameters.push(format!("last_s={:.1}", since.as_secs_f64()));
        }
        Ok(match parameters.is_empty() {
            true => "/why".to_owned(),
            false => format!("/why?{}", parameters.join("&")),
        })
    }

    fn no_late_calls(&self, answer: &Answer<'_>) -> String {
        if answer.observed == "off" {
            let reason = answer.reason.as_deref();
            let reason = reason.unwrap_or("capture.inside or capture.late is off");
            return format!("callbacks are not observed: {reason}");
        }
        if let Some(at) = self.at {
            let seconds = why::AROUND;
            return format!(
                "no late call is known from {seconds} s before to {seconds} s after {at}"
            );
        }
        let name = self.name.as_ref().or(self.node.as_ref());
        match (name, self.chain.as_deref()) {
            (Some(name), _) => format!("no call of a callback of {name} was late (see --above)"),
            (None, Some([from, to])) => format!(
                "no call of a callback from {from} to {to} was late (see --above, and `rp chain`)"
            ),
            (None, _) => "no call of a callback was late (see --above)".to_owned(),
        }
    }
}

/// Returns the last time before `now` at which the clock showed `at`, in Unix seconds.
fn latest(at: Time, now: &Zoned) -> Result<f64, jiff::Error> {
    let mut moment = now
        .date()
        .to_datetime(at)
        .to_zoned(now.time_zone().clone())?;
    if moment > *now {
        moment = moment.yesterday()?;
    }
    Ok(moment.timestamp().as_duration().as_secs_f64())
}

fn milliseconds(text: &str) -> Result<f64, UserError> {
    let number = text.parse().ok();
    let number = number.filter(|number| (0.0..=3_600_000.0).contains(number));
    number.ok_or_else(|| UserError("a number of milliseconds from 0 to 3600000".to_owned()))
}

/// Returns a duration in seconds, rounded up.
const fn whole_seconds(duration: Duration) -> u128 {
    duration.as_millis().div_ceil(1_000)
}

#[cfg(test)]
mod tests {
    use jiff::civil::date;

    use super::*;

    #[test]
    fn a_time_of_day_is_the_last_one() {
        let noon = date(2026, 11, 30).at(12, 0, 0, 0);
        let now = noon.to_zoned(TimeZone::UTC).unwrap();
        let ago = |at: &str| {
            let at = latest(at.parse().unwrap(), &now).unwrap();
            now.timestamp().as_duration().as_secs_f64() - at
        };
        assert_eq!([ago("11:59:30"), ago("12:00:01")], [30.0, 86_399.0]);
    }

    #[test]
    fn a_wait_of_less_than_a_second_is_no_wait_of_zero_seconds() {
        assert_eq!(whole_seconds(Duration::from_millis(987)), 1);
        assert_eq!(whole_seconds(Duration::from_secs(30)), 30);
    }
}
