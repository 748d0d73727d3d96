//! Messages of topics with their bytes and types, for verbs that print each message.

use std::collections::HashMap;
use std::io::IsTerminal as _;
use std::path::PathBuf;
use std::sync::Arc;
use std::time::{Duration, Instant};

use anyhow::Result;
use bytes::Bytes;
use clap::Args;
use ros2probe::client::{Agent, ClientError, Target};
use ros2probe_api::messages::Definition;
use ros2probe_api::path::encoded;
use ros2probe_api::problem::Code;
use ros2probe_api::samples::{Line, Missed, Sample};
use ros2probe_api::topics::Topic;
use ros2probe_daemon::escape::{visible, visible_lines};
use ros2probe_message::filter::{Filter, Subject};
use ros2probe_message::yaml::Style;
use ros2probe_message::{Library, Limits, MessageType, Sources, Truncation, decode};
use ros2probe_wire::discovery::EquivalenceHash;

use super::UserError;
use super::notes::Notes;

/// Error for a live agent that ends its stream.
pub(crate) const AGENT_ENDED: &str = "the agent has ended: `systemctl status ros2probe` shows why, `rp run` starts one in a terminal";
/// Note at the end of a replay.
pub(crate) const END_OF_CAPTURE: &str = "end of capture";
/// Minimum interval of requests for a definition that the agent does not have.
const DEFINITION_RETRY_INTERVAL: Duration = Duration::from_secs(1);
/// Maximum number of writers with a remembered type.
const MAX_WRITERS: usize = 1024;

/// Options for printing messages, and directories of their definitions.
#[derive(Args, Clone, Debug)]
pub(crate) struct Printing {
    /// Print all fields of a message in one line, separated by commas
    #[arg(long)]
    pub(crate) csv: bool,
    /// Print all elements of arrays and all characters of strings
    #[arg(long, short = 'f')]
    full_length: bool,
    /// Print at most this many elements of arrays and characters of strings, then `...`
    #[arg(long, short = 'l', value_name = "N", default_value_t = 128)]
    truncate_length: usize,
    /// Print only type and length of arrays
    #[arg(long)]
    no_arr: bool,
    /// Print only the length of strings
    #[arg(long)]
    no_str: bool,
    /// Print sequences in YAML flow style
    #[arg(long)]
    flow_style: bool,
    /// Directory with definitions (package/msg/Type.msg); may be repeated. Searched before an
    /// installed ROS and the embedded definitions
    #[arg(long, value_name = "DIR")]
    definitions: Vec<PathBuf>,
}

impl Printing {
    pub(crate) fn truncation(&self) -> Truncation {
        Truncation {
            truncate: (!self.full_length).then_some(self.truncate_length),
            no_arrays: self.no_arr,
            no_strings: self.no_str,
        }
    }

    pub(crate) fn style(&self) -> Style {
        if self.flow_style {
            Style::Flow
        } else {
            Style::Block
        }
    }

    pub(crate) fn library(&self, target: &Target) -> Library {
        library(target, self.definitions.clone())
    }
}

/// Returns the definitions in these directories, in an installed ROS, and in `rp` itself.
pub(crate) fn library(target: &Target, directories: Vec<PathBuf>) -> Library {
    let installed = std::env::var_os("AMENT_PREFIX_PATH");
    Library::new(Sources::new(
        directories,
        installed.as_deref(),
        target.dialect(),
    ))
}

/// One item of a stream.
pub(crate) enum StreamItem<'a> {
    Message(&'a Sample, Bytes),
    Missed(&'a Missed),
    /// All messages up to this time have been delivered.
    Clock,
}

/// Escapes control characters if stdout is a terminal, which would interpret them. YAML output
/// contains none by itself.
pub(crate) fn for_stdout(text: String) -> String {
    if std::io::stdout().is_terminal() {
        visible_lines(&text).into_owned()
    } else {
        text
    }
}

/// State of a stream after `follow` returns.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum StreamStatus {
    Open,
    /// The visitor stopped the stream.
    Stopped,
    /// The capture has ended.
    CaptureEnded,
    /// The rest of the capture cannot be read; the error is on stderr.
    CaptureTruncated,
}

/// Passes each item of the topics with its time in nanoseconds to `visit`, until `visit` stops the
/// stream or it ends.
pub(crate) fn follow(
    agent: &Agent,
    domain_id: u32,
    topics: &[String],
    notes: &mut Notes<'_>,
    mut visit: impl FnMut(StreamItem<'_>, i64) -> Result<StreamStatus>,
) -> Result<StreamStatus> {
    let names: Vec<String> = topics.iter().map(|name| encoded(name)).collect();
    let names = names.join(",");
    let path = format!("/samples?topic={names}&domain_id={domain_id}&payload=true");
    let mut lines = agent.stream(&path)?;
    let mut now = None;
    while let Some(line) = lines.line()? {
        let went = match serde_json::from_slice(&line)? {
            Line::Open(_) => StreamStatus::Open,
            Line::Sample(sample) => {
                let length = sample.payload_bytes.unwrap_or(0);
                let payload = lines.bytes(usize::try_from(length)?)?;
                now = now.max(Some(sample.time_ns));
                notes.received(&sample.topic, sample.sampled);
                visit(StreamItem::Message(&sample, payload), sample.time_ns)?
            }
            Line::Clock(clock) => {
                now = now.max(Some(clock.time_ns));
                notes.now();
                visit(StreamItem::Clock, clock.time_ns)?
            }
            Line::Missed(missed) => {
                notes.missed(&missed);
                match now {
                    Some(now) => visit(StreamItem::Missed(&missed), now)?,
                    None => StreamStatus::Open,
                }
            }
            Line::End(end) if end.reason == END_OF_CAPTURE => {
                notes.end();
                return Ok(StreamStatus::CaptureEnded);
            }
            Line::End(_) if agent.outcome().is_some() => {
                notes.end();
                return Ok(StreamStatus::CaptureTruncated);
            }
            Line::End(_) => break,
        };
        if went != StreamStatus::Open {
            return Ok(went);
        }
    }
    Err(UserError(AGENT_ENDED.to_owned()).into())
}

/// Returns the agent's facts about a topic; `None` if the topic does not exist.
pub(crate) fn topic(agent: &Agent, domain_id: u32, name: &str) -> Result<Option<Topic<'static>>> {
    let path = encoded(name.strip_prefix('/').unwrap_or(name));
    match agent.get(&format!("/topics/{path}?domain_id={domain_id}")) {
        Ok(topic) => Ok(Some(topic)),
        Err(error @ ClientError::Refused(_)) if error.is(Code::NoSuchTopic) => Ok(None),
        Err(error) => Err(error.into()),
    }
}

/// Definitions for the messages of each writer.
pub(crate) struct Types<'a> {
    library: Library,
    /// The agent, which may have other definitions.
    agent: &'a Agent,
    /// Domain of the topics.
    domain_id: u32,
    /// The definition of each writer's type, or the time at which no source had one.
    writers: HashMap<String, Result<Arc<MessageType>, Instant>>,
    /// Types without a definition; each is reported once.
    undefined: Vec<String>,
}

impl<'a> Types<'a> {
    /// Returns definitions of the library and of the agent. The agent has those that nodes
    /// described, and may have other packages installed.
    pub(crate) fn new(library: Library, agent: &'a Agent, domain_id: u32) -> Self {
        Self {
            library,
            agent,
            domain_id,
            writers: HashMap::new(),
            undefined: Vec::new(),
        }
    }

    /// Returns the definition of a topic's type.
    pub(crate) fn find_for(
        &self,
        topic: &str,
        name: &str,
        hash: Option<&str>,
    ) -> Result<Arc<MessageType>> {
        if self.library.find(name, hash).is_err() {
            self.offer_definition(topic);
        }
        self.find(name, hash)
    }

    /// Adds the agent's definition of a topic's type. The library returns it only for its hash.
    fn offer_definition(&self, topic: &str) {
        let topic = encoded(topic.strip_prefix('/').unwrap_or(topic));
        let path = format!("/topics/{topic}/definition?domain_id={}", self.domain_id);
        if let Ok(Definition {
            name,
            definition: Some(text),
            equivalence_hash,
            ..
        }) = self.agent.get(&path)
            && let Ok(root) = name.parse()
            && let Ok(found) = MessageType::parse(&root, &text)
        {
            let hash = equivalence_hash.as_deref().and_then(EquivalenceHash::parse);
            self.library.add(found, hash);
        }
    }

    /// Returns the definition of a type named on the command line, or shared by all writers of a
    /// topic.
    pub(crate) fn find(&self, name: &str, hash: Option<&str>) -> Result<Arc<MessageType>> {
        let found = self.library.find(name, hash);
        found.map_err(|error| UserError(error_chain(&error)).into())
    }

    /// Returns the definition for a message; `None` if there is no definition of its type.
    pub(crate) fn of(&mut self, sample: &Sample) -> Option<Arc<MessageType>> {
        match self.writers.get(&sample.writer) {
            Some(Ok(known)) => return Some(Arc::clone(known)),
            // A node may describe the type to the agent at any time.
            Some(Err(at)) if at.elapsed() < DEFINITION_RETRY_INTERVAL => return None,
            _ => {}
        }
        let offered = sample.offered.as_ref();
        let hash = offered.and_then(|offered| offered.definition_hash());
        let mut found = self.library.find(&sample.message_type, hash);
        if found.is_err() {
            self.offer_definition(&sample.topic);
            found = self.library.find(&sample.message_type, hash);
        }
        let found = match found {
            Ok(found) => Some(found),
            Err(error) => {
                let text = error_chain(&error);
                if !self.undefined.contains(&text) && self.undefined.len() < MAX_WRITERS {
                    eprintln!(
                        "rp: {}",
                        visible_lines(&format!("{}: {text}", sample.topic))
                    );
                    self.undefined.push(text);
                }
                None
            }
        };
        if self.writers.len() < MAX_WRITERS || self.writers.contains_key(&sample.writer) {
            let known = found.clone().ok_or_else(Instant::now);
            self.writers.insert(sample.writer.clone(), known);
        }
        found
    }
}

/// Passes messages for which an expression is true. Messages without a definition, or of another
/// type, do not pass; stderr reports each such type once.
pub(crate) struct MessageFilter<'a> {
    filter: Filter,
    types: Types<'a>,
    is_reported: bool,
}

impl<'a> MessageFilter<'a> {
    pub(crate) fn new(filter: Filter, types: Types<'a>) -> Self {
        Self {
            filter,
            types,
            is_reported: false,
        }
    }

    pub(crate) fn is_passed(&mut self, sample: &Sample, payload: &[u8]) -> Result<bool> {
        let Some(message_type) = self.types.of(sample) else {
            return Ok(false);
        };
        match decode(&message_type, payload, &Limits::default()) {
            Ok(decoded) => {
                let passes = self.filter.passes(Subject::Message(&decoded.message));
                passes.map_err(|error| UserError(error.to_string()).into())
            }
            Err(error) => {
                if !std::mem::replace(&mut self.is_reported, true) {
                    let Sample { topic, writer, .. } = sample;
                    eprintln!(
                        "rp: {}",
                        visible(&format!("{topic} of writer {writer}: {error}"))
                    );
                }
                Ok(false)
            }
        }
    }
}

/// Returns an error and its causes in one line.
fn error_chain(error: &dyn std::error::Error) -> String {
    let mut text = error.to_string();
    let mut source = error.source();
    while let Some(cause) = source {
        text.push_str(": ");
        text.push_str(&cause.to_string());
        source = cause.source();
    }
    text
}

#[cfg(test)]
mod tests {
    use ros2probe_daemon::escape::visible_lines;

    #[test]
    fn control_characters_of_a_message_are_escaped() {
        let text = "a\tb\u{1b}[2J\u{9b}1m\u{7}\n\u{e9}";
        assert_eq!(visible_lines(text), "a\tb\\u{1b}[2J\\u{9b}1m\\u{7}\n\u{e9}");
    }
}
