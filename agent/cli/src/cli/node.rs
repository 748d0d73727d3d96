//! `rp node`.

use std::process::ExitCode;

use anyhow::Result;
use clap::{Args, Subcommand};
use ros2probe::client::Target;
use ros2probe::ros2::node::{self, NodeText};

use super::UserError;
use super::shared::{Graph, Spinning, print_text};

/// `rp node VERB`.
#[derive(Args, Debug)]
pub(crate) struct Node {
    #[command(subcommand)]
    verb: Option<Verb>,
}

#[derive(Debug, Subcommand)]
enum Verb {
    /// Print a list of nodes
    List(List),
    /// Print a node's publishers, subscriptions, services and actions
    Info(Info),
}

#[derive(Args, Debug)]
struct List {
    /// Also print hidden nodes
    #[arg(short = 'a', long)]
    all: bool,
    /// Only print the number of nodes
    #[arg(short = 'c', long)]
    count_nodes: bool,
    #[command(flatten)]
    spinning: Spinning,
    #[command(flatten)]
    target: Target,
}

#[derive(Args, Debug)]
struct Info {
    /// Fully qualified name of the node, e.g. /robot1/lidar
    node_name: String,
    /// Also print hidden topics, services and actions
    #[arg(long)]
    include_hidden: bool,
    #[command(flatten)]
    spinning: Spinning,
    #[command(flatten)]
    target: Target,
}

impl Node {
    pub(crate) fn run(self) -> Result<ExitCode> {
        match self.verb {
            None => super::help(&["node"]),
            Some(Verb::List(list)) => list.ask(),
            Some(Verb::Info(info)) => info.ask(),
        }
    }
}

impl List {
    fn ask(self) -> Result<ExitCode> {
        let names = Graph::reach(&self.target)?.names()?;
        print_node(&node::list(&names.nodes, self.all, self.count_nodes))
    }
}

impl Info {
    fn ask(self) -> Result<ExitCode> {
        let node = Graph::reach(&self.target)?.node(&self.node_name)?;
        let text = node::info(&self.node_name, node.as_ref(), self.include_hidden);
        print_node(&text.map_err(|refused| UserError(refused.0))?)
    }
}

fn print_node(text: &NodeText) -> Result<ExitCode> {
    if let Some(warning) = &text.warning {
        eprintln!("{warning}");
    }
    print_text(&text.text)
}
