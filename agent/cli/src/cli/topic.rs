//! `rp topic`.

use std::borrow::Cow;
use std::process::ExitCode;

use anyhow::Result;
use clap::{Args, Subcommand};
use ros2probe::client::Target;
use ros2probe::ros2::topic;
use ros2probe_api::names::{Names, TopicName};

use super::echo::Echo;
use super::interrupt::EXIT_INTERRUPTED;
use super::rates::{Bandwidth, Delay, Hz};
use super::shared::{Graph, Spinning, answer, print_names, print_or_fail, print_text};

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
    /// Print a topic's type and its endpoints
    Info(Info),
    /// Print a topic's type
    Type(Type),
    /// Print topics of a type
    Find(Find),
    /// Print messages as they arrive
    Echo(Box<Echo>),
    /// Print the rate of messages
    Hz(Hz),
    /// Print the bandwidth of messages
    Bw(Bandwidth),
    /// Print the age of messages by the stamp in their header
    Delay(Delay),
}

#[derive(Args, Debug)]
struct List {
    /// Also print the topics' types
    #[arg(short = 't', long)]
    show_types: bool,
    /// Only print the number of topics
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

#[derive(Args, Debug)]
struct Info {
    /// Name of the topic, e.g. /chatter
    topic_name: String,
    /// Also print each endpoint with its node, GID and QoS
    #[arg(short = 'v', long)]
    verbose: bool,
    #[command(flatten)]
    spinning: Spinning,
    #[command(flatten)]
    target: Target,
}

#[derive(Args, Debug)]
struct Type {
    /// Name of the topic, e.g. /chatter
    topic_name: String,
    #[command(flatten)]
    spinning: Spinning,
    #[command(flatten)]
    target: Target,
}

#[derive(Args, Debug)]
struct Find {
    /// The type, e.g. std_msgs/msg/String
    topic_type: String,
    /// Only print the number of topics
    #[arg(short = 'c', long)]
    count_topics: bool,
    /// Consider hidden topics as well
    #[arg(long)]
    include_hidden_topics: bool,
    #[command(flatten)]
    spinning: Spinning,
    #[command(flatten)]
    target: Target,
}

impl Topic {
    /// Returns the exit code after Ctrl-C.
    pub(crate) fn interrupted(&self) -> u8 {
        match &self.verb {
            Some(Verb::Hz(hz)) => hz.interrupted(),
            Some(Verb::Bw(bandwidth)) => bandwidth.interrupted(),
            _ => EXIT_INTERRUPTED,
        }
    }

    pub(crate) fn run(self) -> Result<ExitCode> {
        let hidden = self.include_hidden_topics;
        match self.verb {
            None => super::help(&["topic"]),
            Some(Verb::List(list)) => list.ask(hidden),
            Some(Verb::Info(info)) => info.ask(),
            Some(Verb::Type(kind)) => kind.ask(hidden),
            Some(Verb::Find(find)) => find.ask(hidden),
            Some(Verb::Echo(echo)) => echo.run(),
            Some(Verb::Hz(hz)) => hz.run(hidden),
            Some(Verb::Bw(bandwidth)) => bandwidth.run(hidden),
            Some(Verb::Delay(delay)) => delay.run(hidden),
        }
    }
}

impl List {
    fn ask(self, hidden: bool) -> Result<ExitCode> {
        let names = Graph::reach(&self.target)?.names()?;
        let options = topic::List {
            show_types: self.show_types,
            count: self.count_topics,
            verbose: self.verbose,
        };
        let topics = shown(&names, hidden || self.include_hidden_topics);
        print_text(&topic::list(topics, options))
    }
}

impl Info {
    fn ask(self) -> Result<ExitCode> {
        let topic = Graph::reach(&self.target)?.topic(&self.topic_name)?;
        let (name, dialect) = (&self.topic_name, self.target.dialect());
        answer(topic::info(name, topic.as_ref(), self.verbose, dialect))
    }
}

impl Type {
    fn ask(self, hidden: bool) -> Result<ExitCode> {
        let found = Graph::reach(&self.target)?
            .find(|names| topic::type_of(&self.topic_name, shown(names, hidden).map(typed)))?;
        print_or_fail(found.as_deref())
    }
}

impl Find {
    fn ask(self, hidden: bool) -> Result<ExitCode> {
        let hidden = hidden || self.include_hidden_topics;
        let graph = Graph::reach(&self.target)?;
        let found = |names: &Names<'_>, count| {
            topic::find(&self.topic_type, shown(names, hidden).map(typed), count)
        };
        print_names(&graph, self.count_topics, found)
    }
}

fn shown<'a>(names: &'a Names<'a>, hidden: bool) -> impl Iterator<Item = &'a TopicName<'a>> {
    let topics = names.topics.iter();
    topics.filter(move |topic| hidden || !topic.hidden)
}

fn typed<'a>(topic: &'a TopicName<'a>) -> (&'a str, &'a [Cow<'a, str>]) {
    (&topic.name, &topic.types)
}
