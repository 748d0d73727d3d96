//! `rp chain`.

use std::fmt::Write as _;
use std::io::{IsTerminal as _, stderr};
use std::path::Path;
use std::process::ExitCode;
use std::time::{Duration, Instant};

use anyhow::Result;
use clap::Args;
use ros2probe::chain;
use ros2probe::chain::bag::{BagChains, SharedStamps};
use ros2probe::client::{Agent, Target};
use ros2probe_api::chains::ChainList;
use ros2probe_api::path::encoded;
use ros2probe_bag::messages::is_bag;
use ros2probe_daemon::config::Watch;
use ros2probe_daemon::escape::{visible, visible_lines};
use serde_json::{Value, json};

use super::{Output, UserError};

/// Interval of progress reports on a terminal.
const PROGRESS_INTERVAL: Duration = Duration::from_secs(1);

/// `rp chain [FROM] [TO]`.
#[derive(Args, Debug)]
#[command(
    after_help = "A chain follows the stamps of headers from topic to topic. Topics between \
    its ends must be measured.\n\nWith --replay, FILE is a capture or a bag: a directory, or a \
    file of MCAP or sqlite3. A bag names no nodes, so its hops lead from topic to topic. The line \
    `times:` states whether they are computed from times of publication or from those at which \
    the recorder received the messages.\n\nExit code: 0, or 1 if there is no such chain.\n\n\
    Examples:\n  \
    rp chain /points /cmd_vel                       the part between both\n  \
    rp chain --replay robot.pcap.gz                 all chains of a capture\n  \
    rp chain --replay drive --from +60 --json       of a bag, without its first minute"
)]
pub(crate) struct Chain {
    /// First topic, e.g. /points [default: the first topic of each chain]
    #[arg(value_name = "FROM", value_parser = topic)]
    first_topic: Option<String>,
    /// Last topic, e.g. /cmd_vel [default: the last topic of each chain]
    #[arg(value_name = "TO", value_parser = topic)]
    last_topic: Option<String>,
    /// Print the answer of the API
    #[arg(long)]
    json: bool,
    #[command(flatten)]
    target: Target,
}

impl Chain {
    pub(crate) fn run(self) -> Result<ExitCode> {
        if let Some(path) = self.target.replay.as_deref().filter(|path| is_bag(path)) {
            return self.of_bag(path);
        }
        let domain_id = self.target.domain()?;
        let agent = Agent::reach_measured(&self.target, None)?;
        let mut path = format!("/chains?calls=true&domain_id={domain_id}");
        for (key, name) in [("from", &self.first_topic), ("to", &self.last_topic)] {
            if let Some(name) = name {
                let _ = write!(path, "&{key}={}", encoded(name));
            }
        }
        let list: ChainList<'_> = agent.get_visible(&path)?;
        if list.chains.is_empty() && !self.json {
            return Err(UserError(none(&self)).into());
        }
        let text = match self.json {
            true => serde_json::to_string_pretty(&list)? + "\n",
            false => chain::text(&list),
        };
        Output::new().write(&text)?;
        Ok(match list.chains.is_empty() {
            true => ExitCode::FAILURE,
            false => ExitCode::SUCCESS,
        })
    }
}

impl Chain {
    fn of_bag(&self, path: &Path) -> Result<ExitCode> {
        let ends = [&self.first_topic, &self.last_topic];
        let ends: Vec<&str> = ends.into_iter().flatten().map(String::as_str).collect();
        let times = (self.target.from, self.target.until);
        let is_shown = stderr().is_terminal();
        let mut last = Instant::now();
        let bag = BagChains::read(
            path,
            self.target.compressed.into(),
            times,
            &ends,
            &mut |messages, total| {
                if is_shown && last.elapsed() >= PROGRESS_INTERVAL {
                    last = Instant::now();
                    let all = total.map(|total| format!(" of {total}"));
                    let all = all.unwrap_or_default();
                    eprint!("\rread {messages}{all} messages\x1b[K");
                }
            },
        );
        if is_shown {
            eprint!("\r\x1b[K");
        }
        let bag = bag?;
        let [from, to] = [&self.first_topic, &self.last_topic].map(|end| end.as_deref());
        let chains = bag.chains(from, to);
        if !self.json {
            for note in notes(&bag) {
                eprintln!("rp: {}", visible(&note));
            }
        }
        if chains.is_empty() && !self.json {
            let reason = "no hop is proved by stamps that several topics share";
            return Err(UserError(no_chain(self) + ": " + reason).into());
        }
        let text = match self.json {
            true => serde_json::to_string_pretty(&answer(&bag, &chains)?)? + "\n",
            false => format!(
                "{}times: {} ({})\n",
                visible_lines(&chain::text_without_nodes(&chains)),
                bag.times(),
                match bag.times() {
                    "publish" => "by the clock of each publisher",
                    _ => "when the recorder received each message; the bag has no others",
                }
            ),
        };
        Output::new().write(&text)?;
        Ok(match chains.is_empty() {
            true => ExitCode::FAILURE,
            false => ExitCode::SUCCESS,
        })
    }
}

/// Returns the output of `--json` for a bag. Domain and nodes are null, since a bag has neither.
fn answer(bag: &BagChains, chains: &[ros2probe_api::chains::Chain<'_>]) -> Result<Value> {
    let mut chains = serde_json::to_value(chains)?;
    for chain in chains.as_array_mut().into_iter().flatten() {
        if let Some(domain_id) = chain.get_mut("domain_id") {
            *domain_id = Value::Null;
        }
    }
    let shared = |all: Vec<SharedStamps>| {
        let all = all.into_iter();
        let all = all.map(|each| json!({"topic": each.topic, "others": each.others}));
        Value::Array(all.collect())
    };
    Ok(json!({
        "times": bag.times(),
        "messages": bag.messages,
        "chains": chains,
        "published_together": shared(bag.simultaneous_topics()),
        "unclear": shared(bag.unclear()),
        "rounded_stamps": bag.rounded_messages(),
        "ignored_messages": bag.refused(),
        "faults": bag.faults,
    }))
}

/// Returns lines about what could not be read, and about topics that are in no chain.
fn notes(bag: &BagChains) -> Vec<String> {
    let mut notes = bag.faults.clone();
    for SharedStamps { topic, others } in bag.simultaneous_topics() {
        let others = others.join(", ");
        notes.push(format!(
            "{topic} stands for {others}: less than 1 ms apart with one stamp"
        ));
    }
    for SharedStamps { topic, others } in bag.unclear() {
        notes.push(format!(
            "{topic} has the stamps of {}: which one causes it is not clear",
            others.join(" and ")
        ));
    }
    if bag.rounded_messages() > 0 {
        notes.push(format!(
            "{} messages have stamps that are multiples of 100 µs, which prove nothing in a bag",
            bag.rounded_messages()
        ));
    }
    if bag.refused() > 0 {
        notes.push(format!(
            "{} messages above the limits were not used; --from and --until choose a part",
            bag.refused()
        ));
    }
    notes
}

/// Parses a topic's name. A relative name is in the root namespace, as in ros2cli.
fn topic(text: &str) -> Result<String, UserError> {
    let name = match text.starts_with('/') {
        true => text.to_owned(),
        false => format!("/{text}"),
    };
    match Watch::named(&name) {
        Ok(watch) if watch.is_literal() => Ok(name),
        Ok(_) => Err(UserError(
            "the topic has a `*`: a chain has two topics as ends".to_owned(),
        )),
        Err(error) => Err(UserError(format!("the topic {error}"))),
    }
}

fn none(chain: &Chain) -> String {
    no_chain(chain) + ": topics must be measured, and their stamps copied by each node"
}

fn no_chain(chain: &Chain) -> String {
    let mut text = "no chain".to_owned();
    for (word, name) in [("from", &chain.first_topic), ("to", &chain.last_topic)] {
        if let Some(name) = name {
            let _ = write!(text, " {word} {name}");
        }
    }
    text
}
