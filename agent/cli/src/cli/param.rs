//! `rp param`: prints parameters of nodes and their changes.

use std::process::ExitCode;
use std::time::Duration;

use anyhow::Result;
use clap::{Args, Subcommand};
use jiff::tz::TimeZone;
use ros2probe::client::{Agent, Target};
use ros2probe::why::time;
use ros2probe_api::parameters::{ParameterChange, Parameters};
use ros2probe_api::path::encoded;
use ros2probe_daemon::escape::visible;

use super::Output;
use super::shared::names_of;

/// Interval between two views.
const VIEW_INTERVAL: Duration = Duration::from_millis(500);

/// `rp param`.
#[derive(Args, Debug)]
pub(crate) struct Param {
    #[command(subcommand)]
    command: Command,
}

/// Commands about parameters.
#[derive(Debug, Subcommand)]
enum Command {
    /// Print last known values of parameters
    Dump(Dump),
    /// Print changes: time, node, name, old and new value, and who requested it
    Changes(Changes),
}

/// `rp param dump`.
#[derive(Args, Debug)]
struct Dump {
    /// Only this node, e.g. /robot1/planner
    node: Option<String>,
    #[command(flatten)]
    target: Target,
}

/// `rp param changes`.
#[derive(Args, Debug)]
struct Changes {
    /// Only this node, e.g. /robot1/planner
    node: Option<String>,
    /// Go on, and print further changes
    #[arg(long, short = 'f')]
    follow: bool,
    #[command(flatten)]
    target: Target,
}

impl Param {
    pub(crate) fn run(self) -> Result<ExitCode> {
        match self.command {
            Command::Dump(dump) => dump.ask(),
            Command::Changes(changes) => changes.ask(),
        }
    }
}

impl Dump {
    fn ask(self) -> Result<ExitCode> {
        let domain_id = self.target.domain()?;
        let path = path(domain_id, self.node.as_deref());
        let agent = Agent::reach(&self.target)?;
        let answer: Parameters<'_> = agent.get(&path)?;
        note(&answer);
        if answer.parameters.is_empty() {
            eprintln!(
                "rp: no parameters were seen: nodes announce them when they start or change them"
            );
            names_of(&agent, domain_id)?;
        }
        let mut output = Output::new();
        let mut node = "";
        for parameter in &answer.parameters {
            if parameter.ros_node != node {
                node = &parameter.ros_node;
                output.write(&format!("{}:\n", visible(node)))?;
            }
            let (name, value) = (visible(&parameter.name), visible(&parameter.value));
            output.write(&format!("  {name}: {value}\n"))?;
        }
        Ok(ExitCode::SUCCESS)
    }
}

impl Changes {
    fn ask(self) -> Result<ExitCode> {
        let domain_id = self.target.domain()?;
        let path = path(domain_id, self.node.as_deref());
        let agent = Agent::reach(&self.target)?;
        let mut output = Output::new();
        let mut printed: Vec<ParameterChange<'static>> = Vec::new();
        let mut is_first = true;
        loop {
            let answer: Parameters<'static> = agent.get(&path)?;
            if is_first {
                note(&answer);
            }
            if is_first && answer.changes.is_empty() && !self.follow {
                eprintln!("rp: no changes were seen since the agent started");
                names_of(&agent, domain_id)?;
            }
            for change in unprinted(&answer.changes, printed.last()) {
                output.write(&line(change))?;
            }
            if !self.follow {
                return Ok(ExitCode::SUCCESS);
            }
            if !answer.changes.is_empty() {
                printed = answer.changes;
            }
            is_first = false;
            std::thread::sleep(VIEW_INTERVAL);
        }
    }
}

fn path(domain_id: u32, node: Option<&str>) -> String {
    let node = node.map(|node| format!("&node={}", encoded(node)));
    format!(
        "/parameters?domain_id={domain_id}{}",
        node.unwrap_or_default()
    )
}

fn note(answer: &Parameters<'_>) {
    if !answer.is_on {
        eprintln!("rp: the agent reads no parameters: `robot.parameters` is `off`");
    }
}

/// Returns the changes after the last printed one. The list is in the order of time, and old
/// changes leave it at its beginning.
fn unprinted<'a>(
    changes: &'a [ParameterChange<'static>],
    last: Option<&ParameterChange<'static>>,
) -> &'a [ParameterChange<'static>] {
    let known = last.and_then(|last| changes.iter().rposition(|each| is_same(each, last)));
    let begin = known.map_or(0, |known| known + 1);
    changes.get(begin..).unwrap_or_default()
}

/// Returns whether both are one change. The wall clock may have been set between their answers.
fn is_same(one: &ParameterChange<'static>, other: &ParameterChange<'static>) -> bool {
    let other_then = || ParameterChange {
        timestamp_seconds: one.timestamp_seconds,
        ..other.clone()
    };
    // An older agent sends no monotonic time.
    one == other || one.monotonic_ns != 0 && *one == other_then()
}

/// Returns the line of a change.
fn line(change: &ParameterChange<'_>) -> String {
    let at = time(change.timestamp_seconds, &TimeZone::system());
    let before = change.before.as_deref().unwrap_or("?");
    let value = match change.value.as_deref() {
        Some(value) => format!("{} -> {}", visible(before), visible(value)),
        None => format!("{} -> removed", visible(before)),
    };
    let by = match (&change.requested_by, &change.requested_by_writer) {
        (Some(node), _) => format!("requested by {}", visible(node)),
        (None, Some(writer)) => format!("requested by the client {}", visible(writer)),
        (None, None) => "by the node itself, or by a client that was not seen".to_owned(),
    };
    format!(
        "{at} {} {}: {value} ({by})\n",
        visible(&change.ros_node),
        visible(&change.name)
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    fn change(at: u64, step: f64) -> ParameterChange<'static> {
        ParameterChange {
            timestamp_seconds: at as f64 + step,
            monotonic_ns: at * 1_000_000_000,
            ros_node: "/planner".into(),
            name: "max_speed".into(),
            value: Some("0.5".into()),
            ..ParameterChange::default()
        }
    }

    #[test]
    fn a_printed_change_is_recognized_after_a_step_of_the_clock() {
        let changes = |step| [1, 2, 3].map(|at| change(at, step));
        assert_eq!(unprinted(&changes(0.0), None), changes(0.0));
        let last = change(2, 0.0);
        for step in [0.0, 3600.0, -0.5] {
            let found = unprinted(&changes(step), Some(&last)).to_vec();
            assert_eq!(found, [change(3, step)]);
        }
        let evicted = change(0, 0.0);
        assert_eq!(unprinted(&changes(0.0), Some(&evicted)), changes(0.0));
    }

    #[test]
    fn equal_changes_of_an_older_agent_differ_by_their_time() {
        let changes = [1, 2].map(|at| ParameterChange {
            monotonic_ns: 0,
            ..change(at, 0.0)
        });
        assert_eq!(unprinted(&changes, changes.first()), &changes[1..]);
    }
}
