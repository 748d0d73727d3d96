//! `rp action`.

use std::borrow::Cow;
use std::process::ExitCode;

use anyhow::Result;
use clap::{Args, Subcommand};
use ros2probe::client::Target;
use ros2probe::ros2::name::full_name;
use ros2probe::ros2::{action, topic};
use ros2probe_api::names::Names;
use ros2probe_api::nodes::Named;

use super::UserError;
use super::events::ActionEcho;
use super::shared::{Graph, print_names, print_or_fail, print_text};

/// `rp action VERB`.
#[derive(Args, Debug)]
pub(crate) struct Action {
    #[command(subcommand)]
    verb: Option<Verb>,
}

#[derive(Debug, Subcommand)]
enum Verb {
    /// Print a list of actions
    List(List),
    /// Print the servers and clients of an action
    Info(Info),
    /// Print an action's type
    Type(Type),
    /// Print actions of a type
    Find(Find),
    /// Print goals, results, feedback and states of an action
    Echo(Box<ActionEcho>),
}

#[derive(Args, Debug)]
struct List {
    /// Also print the actions' types
    #[arg(short = 't', long)]
    show_types: bool,
    /// Only print the number of actions
    #[arg(short = 'c', long)]
    count_actions: bool,
    #[command(flatten)]
    target: Target,
}

#[derive(Args, Debug)]
struct Info {
    /// Name of the action, e.g. /fibonacci
    action_name: String,
    /// Also print the action's type
    #[arg(short = 't', long)]
    show_types: bool,
    /// Only print the number of its servers and clients
    #[arg(short = 'c', long)]
    count: bool,
    #[command(flatten)]
    target: Target,
}

#[derive(Args, Debug)]
struct Type {
    /// Name of the action, e.g. /fibonacci
    action_name: String,
    #[command(flatten)]
    target: Target,
}

#[derive(Args, Debug)]
struct Find {
    /// The type, e.g. example_interfaces/action/Fibonacci
    action_type: String,
    /// Only print the number of actions
    #[arg(short = 'c', long)]
    count_actions: bool,
    #[command(flatten)]
    target: Target,
}

impl Action {
    pub(crate) fn run(self) -> Result<ExitCode> {
        match self.verb {
            None => super::help(&["action"]),
            Some(Verb::List(list)) => list.ask(),
            Some(Verb::Info(info)) => info.ask(),
            Some(Verb::Type(kind)) => kind.ask(),
            Some(Verb::Find(find)) => find.ask(),
            Some(Verb::Echo(echo)) => echo.run(),
        }
    }
}

impl List {
    fn ask(self) -> Result<ExitCode> {
        let names = Graph::reach(&self.target)?.names()?;
        let actions = action::of_topics(&names.topics);
        print_text(&action::list(actions, self.show_types, self.count_actions))
    }
}

impl Info {
    fn ask(self) -> Result<ExitCode> {
        let typed = &self.action_name;
        let name = full_name(typed).map_err(|refused| UserError(refused.0))?;
        let feedback = Graph::reach(&self.target)?.topic(&action::feedback_of(&name))?;
        let text = action::info(typed, feedback.as_ref(), self.show_types, self.count);
        print_text(&text)
    }
}

impl Type {
    fn ask(self) -> Result<ExitCode> {
        let found = Graph::reach(&self.target)?.find(|names| {
            let actions: Vec<_> = action::of_topics(&names.topics).collect();
            topic::type_of(&self.action_name, actions.iter().map(typed))
        })?;
        print_or_fail(found.as_deref())
    }
}

impl Find {
    fn ask(self) -> Result<ExitCode> {
        let graph = Graph::reach(&self.target)?;
        let found = |names: &Names<'_>, count| {
            let actions: Vec<_> = action::of_topics(&names.topics).collect();
            topic::find(&self.action_type, actions.iter().map(typed), count)
        };
        print_names(&graph, self.count_actions, found)
    }
}

fn typed<'a>(action: &'a Named<'a>) -> (&'a str, &'a [Cow<'a, str>]) {
    (&action.name, &action.types)
}
