//! Command line: a module for each noun, and the parts that all verbs share. A verb queries an
//! agent, formats the answer and prints it.

mod action;
mod attach;
mod bag;
mod chain;
mod ci;
mod convert;
mod diag;
mod discover;
mod doctor;
mod echo;
mod events;
mod fleet;
mod follow;
mod foxglove;
mod inside;
mod interrupt;
mod learn;
mod log;
mod node;
mod notes;
mod output;
mod page;
mod param;
mod rates;
mod record;
mod reference;
mod run;
mod service;
mod shared;
mod ship;
mod tf;
mod top;
mod topic;
mod upgrade;
mod welcome;
mod why;

use std::path::PathBuf;
use std::process::ExitCode;

use anyhow::Result;
use clap::{CommandFactory as _, Parser, Subcommand};
use ros2probe_daemon::agent::DEFAULT_CONFIG;

pub(crate) use attach::Attach;
pub(crate) use ci::{CannotStart, Ci};
pub(crate) use discover::Discover;
pub(crate) use output::{Output, UserError, is_broken_pipe};
pub(crate) use run::Run;
pub(crate) use ship::NoDestination;
pub(crate) use welcome::print as welcome;

/// Watches a ROS 2 robot from copies of its DDS traffic, without joining it.
#[derive(Debug, Parser)]
#[command(name = "rp", version, max_term_width = 100)]
pub(crate) struct Arguments {
    #[command(subcommand)]
    pub(crate) command: Option<Command>,
}

#[derive(Debug, Subcommand)]
pub(crate) enum Command {
    /// Run the agent: observe this host or a capture, serve /metrics
    Run(Run),
    /// Check a configuration file and report every mistake
    #[command(after_help = "Exit code: 0 if the file is valid, 78 otherwise.")]
    CheckConfig {
        /// Configuration file to check
        #[arg(default_value = DEFAULT_CONFIG)]
        file: PathBuf,
    },
    /// Run a test of a robot in CI, and fail on loss, findings and violated expectations
    Ci(Ci),
    /// Request that participants repeat their announcements: the only command that sends
    Discover(Discover),
    /// Run the privileged broker that attaches uprobes for the agent
    #[command(after_help = "Without --listen, ros2probe-attach.socket or an agent starts it.")]
    Attach(Attach),
    /// Show the robots of a fleet from their engine: which is in trouble, and what differs
    Fleet(fleet::Fleet),
    /// Deliver finished bags to an object store or a folder
    Ship(ship::Ship),
    /// Check a feed of releases for a newer version
    Upgrade(upgrade::Upgrade),
    /// Print completions for a shell
    Completions(reference::Completions),
    /// Print or write man pages
    Man(reference::Manual),
    #[command(flatten)]
    Ask(Question),
}

/// Commands that query an agent or a capture.
#[derive(Debug, Subcommand)]
pub(crate) enum Question {
    /// Record, convert and inspect bags, as `ros2 bag` does
    Bag(bag::Bag),
    /// List, inspect and measure topics, as `ros2 topic` does
    Topic(topic::Topic),
    /// List and inspect nodes, as `ros2 node` does
    Node(node::Node),
    /// List and inspect services, as `ros2 service` does
    Service(service::Service),
    /// List and inspect actions, as `ros2 action` does
    Action(action::Action),
    /// Show chains of messages through nodes, with the time of each hop
    Chain(chain::Chain),
    /// Print what nodes log, and follow it
    Log(log::Log),
    /// Print the diagnostics of the robot's parts
    Diag(diag::Diag),
    /// Print parameters of nodes and their changes
    Param(param::Param),
    /// Print the trees of frames, or the transform between two of them
    Tf(tf::Tf),
    /// Check what is visible on this host and what is not, with remedies
    Doctor(doctor::Doctor),
    /// Show a robot's topics live in the terminal: rates, losses, latencies, problems
    Top(top::Top),
    /// Print what processes publish, take and call, and how long callbacks take
    Inside(inside::Inside),
    /// Print which calls of callbacks were late, and what made them late
    Why(why::Why),
    /// Write a watchlist with the expectations that a healthy robot meets
    Learn(learn::Learn),
    /// Print the address of the page that shows the robot in a browser
    Page(page::Page),
    /// Print the address that Foxglove, Lichtblick and PlotJuggler open, with a token
    Foxglove(foxglove::Foxglove),
}

impl Question {
    /// Runs the command and returns its exit code.
    pub(crate) fn ask(self) -> Result<ExitCode> {
        if let Some(code) = self.interrupted() {
            interrupt::listen(code)?;
        }
        match self {
            Self::Bag(bag) => bag.run(),
            Self::Topic(topic) => topic.run(),
            Self::Node(node) => node.run(),
            Self::Service(service) => service.run(),
            Self::Action(action) => action.run(),
            Self::Chain(chain) => chain.run(),
            Self::Log(log) => log.run(),
            Self::Diag(diag) => diag.run(),
            Self::Param(param) => param.run(),
            Self::Tf(tf) => tf.run(),
            Self::Doctor(doctor) => doctor.run(),
            Self::Top(top) => top.run(),
            Self::Inside(inside) => inside.run(),
            Self::Why(why) => why.run(),
            Self::Learn(learn) => learn.run(),
            Self::Page(page) => page.run(),
            Self::Foxglove(foxglove) => foxglove.run(),
        }
    }

    /// Exit code if Ctrl-C ends the command immediately. `None` for commands that handle Ctrl-C.
    fn interrupted(&self) -> Option<u8> {
        match self {
            Self::Bag(bag) => bag.interrupted(),
            Self::Topic(topic) => Some(topic.interrupted()),
            Self::Node(_)
            | Self::Service(_)
            | Self::Action(_)
            | Self::Chain(_)
            | Self::Log(_)
            | Self::Diag(_)
            | Self::Param(_)
            | Self::Tf(_)
            | Self::Doctor(_)
            | Self::Inside(_)
            | Self::Why(_)
            | Self::Page(_)
            | Self::Foxglove(_) => Some(interrupt::EXIT_INTERRUPTED),
            // `top` restores the terminal first, and `learn` writes what it has learnt.
            Self::Top(_) | Self::Learn(_) => None,
        }
    }
}

/// Prints the help of a command without a verb, as ros2cli does.
pub(crate) fn help(names: &[&str]) -> Result<ExitCode> {
    let mut command = Arguments::command();
    command.build();
    let named = names
        .iter()
        .try_fold(&command, |command, name| command.find_subcommand(name));
    let text = named.cloned().unwrap_or(command).render_help().to_string();
    Output::new().write(&text)?;
    Ok(ExitCode::SUCCESS)
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeMap;

    use super::*;

    #[test]
    fn clap_accepts_the_definition_of_the_command_line() {
        Arguments::command().debug_assert();
    }

    #[test]
    fn every_option_of_ros2cli_is_accepted() {
        let options = include_str!("../../tests/fixtures/cli/options.json");
        let options: BTreeMap<String, Vec<String>> = serde_json::from_str(options).unwrap();
        assert!(options.contains_key("topic list"));
        let mut root = Arguments::command();
        root.build();
        for (verb, names) in options {
            let mut words = verb.split(' ');
            let found = words.try_fold(&root, |command, word| command.find_subcommand(word));
            let command = found.unwrap_or_else(|| panic!("no command `rp {verb}`"));
            for name in names {
                let is_called = |argument: &clap::Arg| match name.strip_prefix("--") {
                    Some(long) => argument.get_long() == Some(long),
                    None => argument.get_short() == name.chars().nth(1),
                };
                let is_there = command.get_arguments().any(is_called);
                assert!(is_there, "`rp {verb}` has no {name}");
            }
        }
    }
}
