//! `rp inside`: what processes publish, take and call.

use std::process::ExitCode;

use anyhow::Result;
use clap::Args;
use ros2probe::client::{Agent, Target};
use ros2probe::inside;
use ros2probe_api::inside::Inside as Answer;
use ros2probe_api::path::encoded;

use super::UserError;
use super::shared::print_text;

/// `rp inside`.
#[derive(Args, Debug)]
#[command(after_help = "\
By default the agent observes calls from this request until ten seconds after the last one. The first
answer takes up to five seconds, and counts begin then. `capture: {inside: full}` observes calls
always, `off` never.

PUBLISHER     messages published; WITHIN: passed directly to subscriptions of the same process
SUBSCRIPTION  messages taken from the middleware; FAILED: attempts without a message
BUFFER        messages within a process (Iron and later); OVERWRITTEN: lost before they were taken
CALLBACK      calls by topic, timer or service; BUSY: share of time; WAIT: from ready to the call

Rates, percentiles and shares cover the last 5 to 10 s; counts begin with the observation. A node is
named only if it is known for certain.

Exit code: 0; 1 if nothing is known about the node or topic, or if the source is off.

Examples:
  rp inside
  rp inside /nav
  rp inside /scan --json | jq '.callbacks[].duration.p99_seconds'")]
pub(crate) struct Inside {
    /// Print only entries of this node or topic
    #[arg(value_name = "NODE|TOPIC")]
    name: Option<String>,
    /// Print one JSON object, as GET /inside answers
    #[arg(long)]
    json: bool,
    #[command(flatten)]
    target: Target,
}

impl Inside {
    pub(crate) fn run(self) -> Result<ExitCode> {
        let agent = Agent::reach(&self.target)?;
        let path = match &self.name {
            Some(name) => format!("/inside?name={}", encoded(name)),
            None => "/inside".to_owned(),
        };
        let answer: Answer<'static> = match self.json {
            true => agent.get(&path)?,
            false => agent.get_visible(&path)?,
        };
        if self.json {
            return print_text(&(serde_json::to_string_pretty(&answer)? + "\n"));
        }
        if inside::is_empty(&answer) {
            let reason = match (&answer.reason, answer.mode.as_ref(), &self.name) {
                (Some(reason), _, _) => format!("the agent sees no process from inside: {reason}"),
                (None, "off", _) => {
                    "the agent does not look inside processes: capture.inside is off".to_owned()
                }
                (None, _, Some(name)) => format!("no observed process has {name}"),
                (None, _, None) => "no ROS process is observed now".to_owned(),
            };
            return Err(UserError(reason).into());
        }
        print_text(&inside::text(&answer))
    }
}
