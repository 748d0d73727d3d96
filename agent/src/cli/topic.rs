//! `rp topic`.

use std::process::ExitCode;

use anyhow::Result;
use clap::{Args, Subcommand};
use ros2probe::client::Target;
use ros2probe::ros2::topic;

use super::Output;
use super::interrupt::INTERRUPTED;
use super::rates::{Bandwidth, Delay, Hz};
use super::shared::{Spinning, names};

/// `rp topic VERB`.
#[derive(Args, Debug)]
pub(crate) struct Topic {
    /// Consider hidden topics as well
    #[arg(long)]
    include_hidden_topics: bool,
    #[command(subcommand)]
    verb: Option<Verb>,
}

#[derive(Debug, Subcommand)]
enum Verb {
    /// Print a list of topics
    List(List),
    /// Print how often messages come
    Hz(Hz),
    /// Print how many bytes a second come
    Bw(Bandwidth),
    /// Print how old messages are by the stamp in their header
    Delay(Delay),
}

#[derive(Args, Debug)]
struct List {
    /// Also print the topics' types
    #[arg(short = 't', long)]
    show_types: bool,
    /// Only print how many topics there are
    #[arg(short = 'c', long)]
    count_topics: bool,
    /// Print types and numbers of publishers and subscribers
    #[arg(short = 'v', long)]
    verbose: bool,
    /// Consider hidden topics as well
    #[arg(long)]
    include_hidden_topics: bool,
    #[command(flatten)]
    spinning: Spinning,
    #[command(flatten)]
    target: Target,
}

impl Topic {
    /// With which code Ctrl-C ends it.
    pub(crate) fn interrupted(&self) -> u8 {
        match &self.verb {
            Some(Verb::Hz(hz)) => hz.interrupted(),
            Some(Verb::Bw(bandwidth)) => bandwidth.interrupted(),
            _ => INTERRUPTED,
        }
    }

    pub(crate) fn ask(self) -> Result<ExitCode> {
        let hidden = self.include_hidden_topics;
        match self.verb {
            None => super::help(&["topic"]),
            Some(Verb::List(list)) => list.ask(hidden),
            Some(Verb::Hz(hz)) => hz.ask(hidden),
            Some(Verb::Bw(bandwidth)) => bandwidth.ask(hidden),
            Some(Verb::Delay(delay)) => delay.ask(hidden),
        }
    }
}

impl List {
    fn ask(self, hidden: bool) -> Result<ExitCode> {
        let hidden = hidden || self.include_hidden_topics;
        let names = names(&self.target)?;
        let topics = names.topics.iter().filter(|topic| hidden || !topic.hidden);
        let options = topic::List {
            show_types: self.show_types,
            count: self.count_topics,
            verbose: self.verbose,
        };
        Output::new().write(&topic::list(topics, options))?;
        Ok(ExitCode::SUCCESS)
    }
}
