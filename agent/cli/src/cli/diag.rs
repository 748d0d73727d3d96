//! `rp diag`: prints the diagnostics of the robot's parts.

use std::borrow::Cow;
use std::collections::BTreeMap;
use std::process::ExitCode;
use std::time::Duration;

use anyhow::Result;
use clap::Args;
use regex::Regex;
use ros2probe::client::{Agent, Target};
use ros2probe_api::diagnostics::{DiagnosticStatus, Diagnostics};
use ros2probe_daemon::escape::visible;
use ros2probe_wire::diagnostics::DiagnosticLevel;

use super::shared::names_of;
use super::{Output, UserError};

/// Interval between two views.
const VIEW_INTERVAL: Duration = Duration::from_secs(1);

/// `rp diag`.
#[derive(Args, Debug)]
pub(crate) struct Diag {
    /// Only parts whose name matches this regular expression
    pattern: Option<String>,
    /// Only this level and more severe ones
    #[arg(long, short = 'l', value_name = "LEVEL", default_value = DiagnosticLevel::Ok.label(),
        value_parser = DiagnosticLevel::ALL.map(DiagnosticLevel::label))]
    level: String,
    /// Only this topic [default: all but those of an aggregator]
    #[arg(long, value_name = "TOPIC")]
    topic: Option<String>,
    /// Print hardware, node, age and values as well
    #[arg(long, short = 'v')]
    verbose: bool,
    /// Go on, and print each change of a level
    #[arg(long, short = 'f')]
    follow: bool,
    #[command(flatten)]
    target: Target,
}

/// Topic, name and hardware id.
type Key = (String, String, String);

impl Diag {
    pub(crate) fn run(self) -> Result<ExitCode> {
        let compile = |pattern: &String| {
            Regex::new(pattern).map_err(|_| {
                UserError(format!("`{pattern}` is not a supported regular expression"))
            })
        };
        let pattern = self.pattern.as_ref().map(compile).transpose()?;
        let domain_id = self.target.domain()?;
        let agent = Agent::reach(&self.target)?;
        let path = format!("/diagnostics?domain_id={domain_id}");
        let mut output = Output::new();
        let mut known: BTreeMap<Key, String> = BTreeMap::new();
        let mut is_first = true;
        loop {
            let answer: Diagnostics<'_> = agent.get(&path)?;
            if is_first && !answer.is_on {
                eprintln!("rp: the agent reads no diagnostics: `robot.diagnostics` is `off`");
            }
            let mut selected: Vec<_> = (answer.statuses.iter())
                .filter(|status| self.selects(status, pattern.as_ref()))
                .collect();
            selected.sort_by_key(|status| std::cmp::Reverse(level(status)));
            let mut printed = 0;
            for status in selected {
                let key = key(status);
                if self.is_shown(status, known.get(&key)) {
                    self.write(&mut output, status, answer.timestamp_seconds)?;
                    printed += 1;
                }
                known.insert(key, status.level.clone().into_owned());
            }
            if is_first && printed == 0 {
                eprintln!("rp: {}", self.empty_reason(&answer));
                names_of(&agent, domain_id)?;
            }
            if !self.follow {
                return Ok(ExitCode::SUCCESS);
            }
            is_first = false;
            std::thread::sleep(VIEW_INTERVAL);
        }
    }

    /// Returns why nothing is printed.
    fn empty_reason(&self, answer: &Diagnostics<'_>) -> Cow<'static, str> {
        if answer.statuses.is_empty() {
            "no diagnostics were seen: nodes send them only if something subscribes to /diagnostics"
                .into()
        } else {
            let count = answer.statuses.len();
            format!("none of {count} statuses has this name, level and topic").into()
        }
    }

    /// Returns whether the status is selected, apart from its level.
    fn selects(&self, status: &DiagnosticStatus<'_>, pattern: Option<&Regex>) -> bool {
        let is_of_topic = match &self.topic {
            Some(topic) => *topic == status.topic,
            None => !status.topic.ends_with("diagnostics_agg"),
        };
        is_of_topic
            && pattern.is_none_or(|pattern| pattern.is_match(&status.name))
            && (self.follow || self.is_severe(&status.level))
    }

    /// Returns whether a change from this level is printed: one of both is severe enough. Without a
    /// level before, the status is new.
    fn is_shown(&self, status: &DiagnosticStatus<'_>, before: Option<&String>) -> bool {
        let is_changed = before.is_none_or(|before| *before != status.level);
        let is_severe = |level: &str| self.is_severe(level);
        is_changed && (is_severe(&status.level) || before.is_some_and(|before| is_severe(before)))
    }

    fn is_severe(&self, level: &str) -> bool {
        // A level that only a newer agent knows passes.
        let level = DiagnosticLevel::named(level).unwrap_or(DiagnosticLevel::Stale);
        Some(level) >= DiagnosticLevel::named(&self.level)
    }

    fn write(&self, output: &mut Output, status: &DiagnosticStatus<'_>, now: f64) -> Result<()> {
        let level = visible(&status.level).to_uppercase();
        let mut text = format!(
            "{level:<5}  {}: {}\n",
            visible(&status.name),
            visible(&status.message)
        );
        if self.verbose {
            let hardware = match &*status.hardware_id {
                "" => String::new(),
                id => format!("hardware {}, ", visible(id)),
            };
            let node = status.ros_node.as_deref().unwrap_or("an unknown node");
            let age = now - status.timestamp_seconds;
            text.push_str(&format!(
                "       {hardware}{} of {}, {age:.1} s ago\n",
                visible(&status.topic),
                visible(node)
            ));
            for each in &status.values {
                let (key, value) = (visible(&each.key), visible(&each.value));
                text.push_str(&format!("       {key}: {value}\n"));
            }
        }
        Ok(output.write(&text)?)
    }
}

fn key(status: &DiagnosticStatus<'_>) -> Key {
    (
        status.topic.clone().into_owned(),
        status.name.clone().into_owned(),
        status.hardware_id.clone().into_owned(),
    )
}

fn level(status: &DiagnosticStatus<'_>) -> Option<DiagnosticLevel> {
    DiagnosticLevel::named(&status.level)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_status_is_printed_if_it_or_the_one_before_is_severe_enough() {
        let diag = Diag {
            pattern: None,
            level: "error".to_owned(),
            topic: None,
            verbose: false,
            follow: true,
            target: Target::default(),
        };
        let is_shown = |level: &'static str, before: Option<&str>| {
            let status = DiagnosticStatus {
                level: level.into(),
                ..DiagnosticStatus::default()
            };
            diag.is_shown(&status, before.map(str::to_owned).as_ref())
        };
        assert!(is_shown("error", None) && !is_shown("ok", None));
        assert!(is_shown("stale", Some("ok")) && is_shown("ok", Some("error")));
        assert!(!is_shown("error", Some("error")) && !is_shown("warn", Some("ok")));
    }
}
