//! `rp service echo` and `rp action echo`: print service events and the parts of actions.

use std::borrow::Cow;
use std::process::ExitCode;

use anyhow::Result;
use clap::Args;
use ros2probe::client::{Agent, Target};
use ros2probe::ros2::Refused;
use ros2probe::ros2::echo::{self, Echo};
use ros2probe::ros2::name::{full_name, full_type};
use ros2probe_daemon::escape::visible_lines;
use ros2probe_message::{Kind, TypeName};

use super::follow::{Printing, StreamItem, StreamStatus, Types, follow, for_stdout, topic};
use super::notes::{NOT_ALL_PRINTED, Notes};
use super::shared::{Matching, Spinning, names_of};
use super::{Output, UserError};

/// `rp service echo`.
#[derive(Args, Debug)]
pub(crate) struct ServiceEcho {
    /// Name of the service, e.g. /add_two_ints
    service_name: String,
    /// Its type, e.g. example_interfaces/srv/AddTwoInts [default: the announced one]
    service_type: Option<String>,
    #[command(flatten)]
    printing: Printing,
    #[command(flatten)]
    matching: Matching,
    #[command(flatten)]
    spinning: Spinning,
    #[command(flatten)]
    target: Target,
}

/// `rp action echo`.
#[derive(Args, Debug)]
pub(crate) struct ActionEcho {
    /// Name of the action, e.g. /fibonacci
    action_name: String,
    /// Its type, e.g. example_interfaces/action/Fibonacci [default: the announced one]
    action_type: Option<String>,
    /// Only these parts, separated by `|`: GOAL_SERVICE, CANCEL_SERVICE, RESULT_SERVICE,
    /// FEEDBACK_TOPIC, STATUS_TOPIC
    #[arg(long, short = 'i', value_name = "PARTS")]
    interfaces: Option<String>,
    #[command(flatten)]
    printing: Printing,
    #[command(flatten)]
    spinning: Spinning,
    #[command(flatten)]
    target: Target,
}

/// Parts of an action, and their topics below its name.
const ACTION_PARTS: [(&str, &str); 5] = [
    ("GOAL_SERVICE", "/_action/send_goal/_service_event"),
    ("CANCEL_SERVICE", "/_action/cancel_goal/_service_event"),
    ("RESULT_SERVICE", "/_action/get_result/_service_event"),
    ("FEEDBACK_TOPIC", "/_action/feedback"),
    ("STATUS_TOPIC", "/_action/status"),
];

impl ServiceEcho {
    pub(crate) fn run(self) -> Result<ExitCode> {
        let name = full_name(&self.service_name).map_err(user_error)?;
        let events = format!("{name}/_service_event");
        let typed = self.service_type.as_deref();
        let service_type = typed.map(|typed| checked_type(typed, Kind::Service));
        let service_type = service_type.transpose()?;
        let domain_id = self.target.domain()?;
        let agent = Agent::reach_stream(&self.target)?;
        let mut output = Output::new();
        // A capture's topics are complete only after its end.
        if self.target.replay.is_none() {
            if self.service_type.is_none() {
                let names = names_of(&agent, domain_id)?;
                let types = names.services.iter().find(|service| service.name == name);
                let types = types.map(|service| service.types.as_slice());
                check_single_type(&self.service_name, types).map_err(user_error)?;
            }
            let known = topic(&agent, domain_id, &events)?;
            if known.is_none_or(|known| known.publishers.is_empty()) {
                let typed = &self.service_name;
                output.write(&format!(
                    "No publishers on topic '{typed}/_service_event'; is service introspection on \
                     the client or server enabled?\n"
                ))?;
            }
        }
        let expected = service_type.map(|name| format!("{name}_Event"));
        let topics = [(None, events)];
        print(
            &agent,
            &self.target,
            &self.printing,
            &topics,
            expected.as_deref(),
            output,
        )
    }
}

impl ActionEcho {
    pub(crate) fn run(self) -> Result<ExitCode> {
        let parts = selected_parts(self.interfaces.as_deref()).map_err(user_error)?;
        let name = full_name(&self.action_name).map_err(user_error)?;
        let typed = self.action_type.as_deref();
        let action_type = typed.map(|typed| checked_type(typed, Kind::Action));
        let action_type = action_type.transpose()?;
        let domain_id = self.target.domain()?;
        let agent = Agent::reach_stream(&self.target)?;
        let feedback = format!("{name}/_action/feedback");
        if let Some(action_type) = &action_type {
            let types = Types::new(self.printing.library(&self.target), &agent, domain_id);
            let expected = format!("{action_type}_FeedbackMessage");
            find_definition(&types, &agent, domain_id, &feedback, &expected)?;
        }
        if self.target.replay.is_none() && self.action_type.is_none() {
            let names = names_of(&agent, domain_id)?;
            if names.topics.iter().all(|topic| topic.name != feedback) {
                let text = format!("Cannot find type for '{}'", self.action_name);
                return Err(UserError(text).into());
            }
        }
        let topics: Vec<_> = parts
            .into_iter()
            .map(|(part, path)| (Some(part), format!("{name}{path}")))
            .collect();
        let output = Output::new();
        print(&agent, &self.target, &self.printing, &topics, None, output)
    }
}

/// Returns the full name of a type on the command line. Fails with ros2cli's message, which is the
/// same for a service and an action.
fn checked_type(typed: &str, kind: Kind) -> Result<String> {
    let name = full_type(typed, kind);
    let known: Result<TypeName, _> = name.parse();
    if known.is_ok_and(|known| known.kind() == kind) {
        return Ok(name);
    }
    let text = format!("The service type '{typed}' is invalid");
    Err(UserError(text).into())
}

/// Checks that the service has one type. Fails with ros2cli's message otherwise.
fn check_single_type(typed: &str, types: Option<&[Cow<'_, str>]>) -> Result<(), Refused> {
    match types {
        None => Err(Refused(format!("Cannot find type for '{typed}'"))),
        Some([_, _, ..]) => {
            let text = format!("More than one type associated with service '{typed}'");
            Err(Refused(text))
        }
        Some(_) => Ok(()),
    }
}

/// Finds the definition of this type, which may be the one that the topic's first publisher
/// announces. Fails without a definition.
fn find_definition(
    types: &Types<'_>,
    agent: &Agent,
    domain_id: u32,
    name: &str,
    expected: &str,
) -> Result<()> {
    let known = topic(agent, domain_id, name)?;
    let publisher = known.as_ref().and_then(|known| known.publishers.first());
    let hash = publisher.and_then(|publisher| publisher.definition_hash());
    types.find_for(name, expected, hash)?;
    Ok(())
}

/// Returns the parts that `--interfaces` selects. An unknown part fails with ros2cli's message.
fn selected_parts(interfaces: Option<&str>) -> Result<Vec<(&'static str, &'static str)>, Refused> {
    let Some(interfaces) = interfaces else {
        return Ok(ACTION_PARTS.to_vec());
    };
    if interfaces.is_empty() {
        let text = "Input action interface name is empty.";
        return Err(Refused(text.to_owned()));
    }
    let mut chosen = Vec::new();
    for name in interfaces.split('|').map(str::trim) {
        let known = ACTION_PARTS
            .iter()
            .find(|(part, _)| part.eq_ignore_ascii_case(name));
        let part =
            known.ok_or_else(|| Refused(format!("\"{name}\" is incorrect interface name.")))?;
        if !chosen.contains(part) {
            chosen.push(*part);
        }
    }
    Ok(chosen)
}

fn print(
    agent: &Agent,
    target: &Target,
    printing: &Printing,
    topics: &[(Option<&str>, String)],
    expected: Option<&str>,
    mut output: Output,
) -> Result<ExitCode> {
    let domain_id = target.domain()?;
    let mut types = Types::new(printing.library(target), agent, domain_id);
    if let (Some(expected), [(_, name)]) = (expected, topics) {
        find_definition(&types, agent, domain_id, name, expected)?;
    }
    let mut echo = Echo::new(echo::Options {
        dialect: target.dialect(),
        csv: printing.csv,
        style: printing.style(),
        shown: printing.truncation(),
        ..echo::Options::default()
    });
    let names: Vec<_> = topics.iter().map(|(_, name)| name.clone()).collect();
    let is_replay = target.replay.is_some();
    let notes = Notes::begin(agent, domain_id, is_replay, &names, NOT_ALL_PRINTED);
    let mut notes = notes.of_parts();
    let went = follow(agent, domain_id, &names, &mut notes, |received, _| {
        if let StreamItem::Message(sample, payload) = received
            && expected.is_none_or(|expected| expected == sample.message_type)
            && let Some(message_type) = types.of(sample)
        {
            let part = topics.iter().find(|(_, name)| *name == sample.topic);
            let part = part.and_then(|(part, _)| *part);
            let printed = echo.event(sample, &message_type, &payload, part);
            eprint!("{}", visible_lines(&printed.err));
            output.write(&for_stdout(printed.out.unwrap_or_default()))?;
        }
        Ok(StreamStatus::Open)
    })?;
    Ok(ExitCode::from(u8::from(
        went == StreamStatus::CaptureTruncated,
    )))
}

fn user_error(refused: Refused) -> anyhow::Error {
    UserError(refused.0).into()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn parts_of_an_action_are_chosen_by_name() {
        assert_eq!(selected_parts(None).map(|parts| parts.len()), Ok(5));
        let two = selected_parts(Some(" feedback_topic|STATUS_TOPIC | status_topic"));
        let two: Vec<_> = two.unwrap().into_iter().map(|(part, _)| part).collect();
        assert_eq!(two, ["FEEDBACK_TOPIC", "STATUS_TOPIC"]);
        let refused = |text: &str| selected_parts(Some(text)).unwrap_err().0;
        assert_eq!(refused(""), "Input action interface name is empty.");
        assert_eq!(
            refused("x|STATUS_TOPIC"),
            "\"x\" is incorrect interface name."
        );
    }
}
