//! The logs of nodes: counts by level, the last messages, and bursts of errors.

use std::collections::{BTreeMap, VecDeque};
use std::sync::Arc;

use ros2probe_wire::log::{Log, LogLevel};
use ros2probe_wire::{DomainId, Guid, SequenceNumber};

use super::Origin;
use super::text::truncated_text;
use crate::facts::bounded::{Bounded, Counted, TableFacts};
use crate::facts::diagnosis::Diagnosis;
use crate::facts::model_time::ModelTime;
use crate::facts::names::NodeName;
use crate::facts::tables::{FreshLogMessages, LogMessages, LogNodes};

/// Maximum length of a message's text, in bytes.
const MAX_TEXT: usize = 512;
/// Maximum length of its other texts, in bytes.
const MAX_NAME: usize = 128;
/// Seconds in which errors are counted.
const WINDOW_SECONDS: usize = 60;
/// Errors within the window that are a burst. A fatal error is one.
const MIN_BURST_ERRORS: u32 = 10;

/// The logs of all nodes.
#[derive(Debug, Default)]
pub struct Logs {
    nodes: Bounded<Counted<LogNodes>, BTreeMap<(DomainId, NodeName), NodeLog>>,
    /// The latest messages of all nodes, oldest first.
    latest: Bounded<Counted<LogMessages>, VecDeque<Arc<LogMessage>>>,
    /// Messages that are not yet taken.
    fresh: Bounded<FreshLogMessages, Vec<Arc<LogMessage>>>,
    /// Messages that were not taken because there were too many.
    lost: u64,
    revision: u64,
}

/// A message of a log, with bounded texts.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct LogMessage {
    /// Time of its arrival.
    pub at: ModelTime,
    /// Seconds and nanoseconds of the node's clock, when it was logged.
    pub stamp: (i32, u32),
    /// Domain of its writer.
    pub domain_id: DomainId,
    /// Its writer.
    pub writer: Guid,
    /// Its sequence number.
    pub number: SequenceNumber,
    /// The node; if it is unknown, the name of the logger as that of a node.
    pub node: NodeName,
    /// Severity.
    pub level: LogLevel,
    /// Name of the logger.
    pub logger: Box<str>,
    /// The text, at most 512 bytes.
    pub text: Box<str>,
    /// Source file.
    pub file: Box<str>,
    /// Function.
    pub function: Box<str>,
    /// Line in the file.
    pub line: u32,
}

/// The log of one node.
#[derive(Debug)]
struct NodeLog {
    levels: [LevelLog; LogLevel::ALL.len()],
    /// Time of the last message.
    at: ModelTime,
    /// Errors by second, the current one last.
    errors: [u32; WINDOW_SECONDS],
    burst: Option<Burst>,
}

/// Messages of one level.
#[derive(Clone, Debug, Default)]
struct LevelLog {
    messages: u64,
    last: Option<Arc<LogMessage>>,
}

/// A burst of errors, as it began.
#[derive(Debug)]
struct Burst {
    errors: u64,
    text: Arc<str>,
}

/// Messages since the last call.
#[derive(Debug, Default)]
pub struct NewLogs {
    /// The messages, oldest first.
    pub messages: Vec<Arc<LogMessage>>,
    /// Number of messages that were dropped because there were too many.
    pub lost: u64,
}

/// Figures of the log of one node.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct NodeLogFacts {
    /// Domain.
    pub domain_id: DomainId,
    /// The node.
    pub node: NodeName,
    /// Number of messages and last message of each level, in the order of [`LogLevel::ALL`].
    pub levels: [(u64, Option<Arc<LogMessage>>); LogLevel::ALL.len()],
}

/// Figures of all logs.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct LogFacts {
    /// Whether logs are read.
    pub are_read: bool,
    /// Nodes, sorted by domain and name.
    pub nodes: Vec<NodeLogFacts>,
    /// The latest messages of all nodes, oldest first.
    pub latest: Vec<Arc<LogMessage>>,
}

impl Logs {
    /// Adds a message.
    pub fn add(&mut self, origin: &Origin<'_>, log: &Log<'_>) {
        let logger = truncated_text(log.logger, MAX_NAME);
        let node = match origin.node {
            Some(node) => node.clone(),
            None => NodeName::from(format!("/{}", logger.replace('.', "/"))),
        };
        let message = Arc::new(LogMessage {
            at: origin.at,
            stamp: log.stamp,
            domain_id: origin.domain_id,
            writer: origin.writer,
            number: origin.number,
            node: node.clone(),
            level: log.level,
            logger,
            text: truncated_text(log.text, MAX_TEXT),
            file: truncated_text(log.file, MAX_NAME),
            function: truncated_text(log.function, MAX_NAME),
            line: log.line,
        });
        self.latest.push_back(Arc::clone(&message));
        self.lost += u64::from(self.fresh.push(Arc::clone(&message)).is_some());
        let key = (origin.domain_id, node);
        let silent = self.nodes.make_room(&key, |log| log.at);
        self.revision += u64::from(silent.is_some());
        if let Some(known) = self.nodes.get_or_insert_with(key, NodeLog::default) {
            self.revision += u64::from(known.add(message));
        }
    }

    /// Removes and returns the messages since the last call.
    pub fn take(&mut self) -> NewLogs {
        NewLogs {
            messages: self.fresh.take(),
            lost: std::mem::take(&mut self.lost),
        }
    }

    /// Ends a second of the window in which errors are counted.
    pub(super) fn end_second(&mut self) {
        for log in self.nodes.values_mut() {
            log.errors.rotate_left(1);
            if let Some(current) = log.errors.last_mut() {
                *current = 0;
            }
            if log.burst.is_some() && log.recent() == 0 {
                log.burst = None;
                self.revision += 1;
            }
        }
    }

    /// Returns the number of changes of [`Self::findings`].
    pub(super) const fn revision(&self) -> u64 {
        self.revision
    }

    /// Returns the bursts of errors.
    pub(super) fn findings(&self) -> impl Iterator<Item = Diagnosis> {
        self.nodes.iter().filter_map(|((domain_id, node), log)| {
            let burst = log.burst.as_ref()?;
            Some(Diagnosis::LogErrors {
                domain_id: *domain_id,
                node: node.clone(),
                errors: burst.errors,
                text: Arc::clone(&burst.text),
            })
        })
    }

    /// Returns the figures.
    #[must_use]
    pub fn facts(&self, are_read: bool) -> LogFacts {
        let nodes = self.nodes.iter().map(|((domain_id, node), log)| {
            let level = |level: &LevelLog| (level.messages, level.last.clone());
            NodeLogFacts {
                domain_id: *domain_id,
                node: node.clone(),
                levels: log.levels.each_ref().map(level),
            }
        });
        LogFacts {
            are_read,
            nodes: nodes.collect(),
            latest: self.latest.iter().cloned().collect(),
        }
    }

    pub(super) fn tables(&self) -> [TableFacts; 2] {
        [self.nodes.facts(), self.latest.facts()]
    }
}

impl Default for NodeLog {
    fn default() -> Self {
        Self {
            levels: Default::default(),
            at: ModelTime::ZERO,
            errors: [0; WINDOW_SECONDS],
            burst: None,
        }
    }
}

impl NodeLog {
    /// Adds a message. Returns whether a burst of errors begins.
    fn add(&mut self, message: Arc<LogMessage>) -> bool {
        self.at = message.at;
        let level = message.level;
        if let (true, Some(current)) = (level >= LogLevel::Error, self.errors.last_mut()) {
            *current = current.saturating_add(1);
        }
        let begins = self.burst.is_none()
            && level >= LogLevel::Error
            && (level == LogLevel::Fatal || self.recent() >= MIN_BURST_ERRORS);
        if begins {
            self.burst = Some(Burst {
                errors: self.recent().into(),
                text: (&*message.text).into(),
            });
        }
        if let Some(known) = self.levels.get_mut(level as usize) {
            known.messages += 1;
            known.last = Some(message);
        }
        begins
    }

    /// Returns the number of errors within the window.
    fn recent(&self) -> u32 {
        self.errors
            .iter()
            .fold(0, |sum, errors| sum.saturating_add(*errors))
    }
}
