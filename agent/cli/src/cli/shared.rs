//! Parts that the verbs of the graph share: accepted options without effect, and requests for all
//! names or for one entity.

use std::process::ExitCode;
use std::sync::Once;

use anyhow::Result;
use clap::Args;
use ros2probe::client::{Agent, ClientError, Target};
use ros2probe::ros2::Refused;
use ros2probe_api::names::Names;
use ros2probe_api::nodes::Node;
use ros2probe_api::path::encoded;
use ros2probe_api::problem::Code;
use ros2probe_api::services::ServiceList;
use ros2probe_api::topics::Topic;
use ros2probe_daemon::missed_announcements::{
    DISCOVER_COMMAND, NOTHING_TO_REQUEST, explanation, sentence,
};
use serde::de::DeserializeOwned;

use super::{Output, UserError};

/// Options of ros2cli's own node, accepted for existing scripts.
#[derive(Args, Clone, Debug, Default)]
pub(crate) struct Spinning {
    /// Accepted without effect: answers need no waiting
    #[arg(long, value_name = "SPIN_TIME")]
    spin_time: Option<f64>,
    /// Accepted without effect
    #[arg(long, short = 's')]
    use_sim_time: bool,
    /// Accepted without effect: rp uses no daemon
    #[arg(long)]
    no_daemon: bool,
}

/// QoS options of ros2cli's own subscription, accepted for existing scripts.
#[derive(Args, Clone, Debug, Default)]
pub(crate) struct Matching {
    /// Accepted without effect, as all QoS options: rp does not subscribe
    #[arg(long, value_name = "PROFILE")]
    qos_profile: Option<String>,
    #[arg(long, value_name = "N", hide = true)]
    qos_depth: Option<String>,
    #[arg(long, value_name = "HISTORY", hide = true)]
    qos_history: Option<String>,
    #[arg(long, value_name = "RELIABILITY", hide = true)]
    qos_reliability: Option<String>,
    #[arg(long, value_name = "DURABILITY", hide = true)]
    qos_durability: Option<String>,
    #[arg(long, value_name = "LIVELINESS", hide = true)]
    qos_liveliness: Option<String>,
    #[arg(long, value_name = "SECONDS", hide = true)]
    qos_liveliness_lease_duration_seconds: Option<String>,
}

impl Matching {
    /// Returns whether any option is set that makes ros2cli ignore the QoS of publishers.
    pub(crate) fn any(&self) -> bool {
        let given = [
            &self.qos_depth,
            &self.qos_history,
            &self.qos_reliability,
            &self.qos_durability,
            &self.qos_liveliness,
            &self.qos_liveliness_lease_duration_seconds,
        ];
        given.into_iter().any(Option::is_some)
    }
}

/// One domain of an agent.
#[derive(Debug)]
pub(crate) struct Graph {
    agent: Agent,
    domain_id: u32,
}

impl Graph {
    pub(crate) fn reach(target: &Target) -> Result<Self> {
        let domain_id = target.domain()?;
        let agent = Agent::reach(target)?;
        Ok(Self { agent, domain_id })
    }

    /// Returns all names, as [`names_of`] does.
    pub(crate) fn names(&self) -> Result<Names<'static>> {
        names_of(&self.agent, self.domain_id)
    }

    /// Returns what `answer` selects from all names. The reason for missing names is printed only
    /// without an answer, because missing names do not affect known ones.
    pub(crate) fn find<T>(
        &self,
        answer: impl FnOnce(&Names<'static>) -> Option<T>,
    ) -> Result<Option<T>> {
        let names = fetch(&self.agent, self.domain_id)?;
        let answer = answer(&names);
        if answer.is_none() {
            print_missing_reason(&names, &self.agent, self.domain_id);
        }
        Ok(answer)
    }

    /// Returns the topic of this name; `None` if it does not exist.
    pub(crate) fn topic(&self, name: &str) -> Result<Option<Topic<'static>>> {
        self.noun("topics", name, Code::NoSuchTopic)
    }

    /// Returns the node of this name, with hidden entities; `None` if it does not exist.
    pub(crate) fn node(&self, name: &str) -> Result<Option<Node<'static>>> {
        self.noun("nodes", name, Code::NoSuchNode)
    }

    /// Returns all services, including hidden ones, with their calls.
    pub(crate) fn services(&self) -> Result<ServiceList<'static>> {
        let domain_id = self.domain_id;
        let path = format!("/services?domain_id={domain_id}&hidden=true");
        Ok(self.agent.get_visible(&path)?)
    }

    fn noun<T: DeserializeOwned>(&self, noun: &str, name: &str, code: Code) -> Result<Option<T>> {
        let Some(name) = name.strip_prefix('/').filter(|name| !name.is_empty()) else {
            return Ok(None);
        };
        let hidden = if noun == "nodes" { "&hidden=true" } else { "" };
        let (name, domain_id) = (encoded(name), self.domain_id);
        let path = format!("/{noun}/{name}?domain_id={domain_id}{hidden}");
        match self.agent.get_visible(&path) {
            Ok(found) => Ok(Some(found)),
            Err(error @ ClientError::Refused(_)) if error.is(code) => {
                explain_late(&fetch(&self.agent, self.domain_id)?, &self.agent);
                Ok(None)
            }
            Err(error) => Err(error.into()),
        }
    }
}

/// Whether the note about missing names has been printed.
static EXPLANATION_PRINTED: Once = Once::new();

/// Returns all names in a domain, including hidden ones. The reason for missing names is printed
/// once on stderr.
pub(crate) fn names_of(agent: &Agent, domain_id: u32) -> Result<Names<'static>> {
    let names = fetch(agent, domain_id)?;
    print_missing_reason(&names, agent, domain_id);
    Ok(names)
}

fn fetch(agent: &Agent, domain_id: u32) -> Result<Names<'static>> {
    Ok(agent.get_visible(&format!("/names?domain_id={domain_id}&hidden=true"))?)
}

/// Prints why names may be missing, if there is a reason.
fn print_missing_reason(names: &Names<'_>, agent: &Agent, domain_id: u32) {
    let others = names.domains.iter().filter(|other| **other != domain_id);
    let others: Vec<String> = others.map(u32::to_string).collect();
    if names.is_empty() && !others.is_empty() {
        eprintln!(
            "rp: domain {domain_id} is empty; the agent sees domain {}: pass `--domain N`",
            others.join(", ")
        );
    }
    explain_late(names, agent);
}

/// Prints that announcements were missed, if any were.
fn explain_late(names: &Names<'_>, agent: &Agent) {
    if let Some(text) = late_start_note(names, agent.is_replay()) {
        EXPLANATION_PRINTED.call_once(|| eprintln!("rp: {text}"));
    }
}

/// Returns a note about announcements that were made before the agent or the capture started.
/// Endpoints are announced once, and only to other participants. Returns `None` if nothing is
/// missing.
fn late_start_note(names: &Names<'_>, is_replay: bool) -> Option<String> {
    let Names {
        participants,
        unknown_writers,
        remedy,
        ..
    } = names;
    let (is_nameless, remedy) = (
        names.topics.is_empty() && *participants > 0,
        remedy.as_deref(),
    );
    let is_one = *participants == 1;
    let what = match unknown_writers {
        _ if is_nameless && is_one => "1 participant is known, but none of its topics".to_owned(),
        _ if is_nameless => {
            format!("{participants} participants are known, but none of their topics")
        }
        0 => return None,
        many => sentence(*many),
    };
    Some(match remedy {
        None if is_nameless => format!("{what}: {NOTHING_TO_REQUEST}"),
        Some(_) if is_nameless && is_one && is_replay => {
            format!("{what}: a participant that is alone announces none")
        }
        Some(remedy) if is_nameless && is_one => format!(
            "{what}: a participant that is alone announces them when a second one starts; \
             `{remedy}` requests them"
        ),
        _ if is_replay => format!("{what}: the capture lacks their announcements"),
        remedy => format!(
            "{what}: {}",
            explanation(remedy.unwrap_or(DISCOVER_COMMAND))
        ),
    })
}

/// Prints the names of one type, or their number with `count`. `found` returns the text.
pub(crate) fn print_names(
    graph: &Graph,
    count: bool,
    found: impl Fn(&Names<'_>, bool) -> String,
) -> Result<ExitCode> {
    let text = graph.find(|names| {
        let is_any = !found(names, false).is_empty();
        is_any.then(|| found(names, count))
    })?;
    let none = || found(&Names::default(), count);
    print_text(&text.unwrap_or_else(none))
}

/// Prints a text and returns success.
pub(crate) fn print_text(text: &str) -> Result<ExitCode> {
    Output::new().write(text)?;
    Ok(ExitCode::SUCCESS)
}

/// Prints a text as [`print_text`] does; a refusal goes to stderr.
pub(crate) fn answer(text: Result<String, Refused>) -> Result<ExitCode> {
    print_text(&text.map_err(|refused| UserError(refused.0))?)
}

/// Prints a text as [`print_text`] does. Without a text, only the exit code reports the failure.
pub(crate) fn print_or_fail(text: Option<&str>) -> Result<ExitCode> {
    match text {
        Some(text) => print_text(text),
        None => Ok(ExitCode::FAILURE),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_note_names_a_command_only_if_the_agent_names_one() {
        let note = |participants, unknown_writers, remedy: Option<&'static str>, is_replay| {
            let names = Names {
                participants,
                unknown_writers,
                remedy: remedy.map(Into::into),
                ..Names::default()
            };
            late_start_note(&names, is_replay)
        };
        let command = Some("some command");
        assert_eq!(note(0, 0, None, false), None);
        let alone = note(1, 0, command, false).unwrap();
        assert!(alone.ends_with("when a second one starts; `some command` requests them"));
        let many = note(3, 0, command, false).unwrap();
        assert!(
            many.contains("started after them; `some command`"),
            "{many}"
        );
        // A Discovery Server, or participants whose announcements are hidden.
        for (count, is_replay) in [(1, false), (3, false), (1, true)] {
            let hidden = note(count, 0, None, is_replay).unwrap();
            assert!(hidden.ends_with(NOTHING_TO_REQUEST), "{hidden}");
        }
        let writers = note(0, 2, command, true).unwrap();
        assert!(writers.ends_with("the capture lacks their announcements"));
    }
}
