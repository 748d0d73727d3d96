//! Chains of recorded messages, which name no nodes: a hop leads from topic to topic.
//!
//! A recording has the stamp and the time of each message, but neither its publisher nor its
//! readers. The rules of [`super::evidence`] therefore apply as far as they need no nodes, and
//! stronger rules replace the others:
//!
//! - A stamp that is a multiple of 100 µs is not evidence, because several nodes may use it
//!   independently.
//! - Topics whose messages of one stamp are less than 1 ms apart are published together. They count
//!   as one topic.
//! - Three topics may have their messages of one stamp in a fixed order. The second may then be the
//!   cause of the third, or both may derive from the first. The delays decide ([`relation`]).

mod hops;
mod relation;
#[cfg(test)]
mod tests;

use std::collections::VecDeque;
use std::time::Duration;

use foldhash::{HashMap, HashMapExt as _};
use ros2probe_wire::Timestamp;

use super::path::{ChainFacts, Paths};
use super::stamps::{EVALUATION_SILENCE, MAX_CHAIN_DURATION, Stamp};
use crate::facts::names::TopicName;

/// Maximum number of topics.
pub const MAX_TOPICS: usize = 1024;
/// Maximum number of kept messages. Messages whose stamp occurs on one topic only are not kept.
pub const MAX_RECORDED: usize = 4_000_000;
/// Maximum number of stamps for which further messages may follow.
pub const MAX_OPEN: usize = 65_536;
/// Maximum number of topics with one stamp. A stamp on more topics identifies nothing.
const MAX_OF_STAMP: usize = 64;
/// A stamp that is a multiple of this many nanoseconds is rounded.
const ROUNDED: u32 = 100_000;

/// Collects the messages of a recording.
#[derive(Debug)]
pub struct RecordedChains {
    /// Maximum number of messages to keep.
    limit: usize,
    topics: Vec<Topic>,
    ids: HashMap<TopicName, u16>,
    open: HashMap<Stamp, Open>,
    /// Stamps in the order of their first message.
    order: VecDeque<Stamp>,
    /// Time since the first message, without backward steps of the clock.
    elapsed: Duration,
    last: Option<Timestamp>,
    /// Messages of stamps with several topics, and the end of each stamp in this list.
    messages: Vec<Recorded>,
    ends: Vec<usize>,
    /// Whether publication times differ from log times, and whether some message has no publication
    /// time.
    has_published: bool,
    misses_publish_times: bool,
    rounded: u64,
    refused: u64,
    is_full: bool,
}

/// Which times of the messages are compared.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Times {
    /// Times of publication, by the clock of each publisher.
    Publish,
    /// Times at which the recorder received the messages.
    Log,
}

/// The chains of a recording.
#[derive(Clone, Debug)]
pub struct RecordedFacts {
    /// The times from which they are computed.
    pub times: Times,
    /// Chains, whose nodes are unknown.
    pub chains: Vec<ChainFacts>,
    /// Topics that are published together with another one, and the topic that represents them.
    pub together: Vec<(TopicName, TopicName)>,
    /// Topics with the stamps of several others, of which none is known to be the cause.
    pub unclear: Vec<(TopicName, Vec<TopicName>)>,
    /// Number of messages with a rounded stamp, which were not used.
    pub rounded: u64,
    /// Number of messages that were refused because of a cap.
    pub refused: u64,
}

#[derive(Debug)]
struct Topic {
    name: TopicName,
    /// Number of stamps with a message of this topic, without rounded stamps.
    stamps: u64,
}

/// A message.
#[derive(Clone, Copy, Debug)]
struct Recorded {
    topic: u16,
    logged: Timestamp,
    published: Timestamp,
}

/// Messages of a stamp for which further messages may follow.
#[derive(Debug)]
struct Open {
    first: Duration,
    last: Duration,
    messages: Vec<Recorded>,
    is_crowded: bool,
}

impl Default for RecordedChains {
    fn default() -> Self {
        Self::with_limit(MAX_RECORDED)
    }
}

impl RecordedChains {
    fn with_limit(room: usize) -> Self {
        Self {
            limit: room,
            topics: Vec::new(),
            ids: HashMap::new(),
            open: HashMap::new(),
            order: VecDeque::new(),
            elapsed: Duration::ZERO,
            last: None,
            messages: Vec::new(),
            ends: Vec::new(),
            has_published: false,
            misses_publish_times: false,
            rounded: 0,
            refused: 0,
            is_full: false,
        }
    }

    /// Adds a message whose type begins with a header. `published` is `None` if the recording has
    /// no publication time.
    pub fn add(
        &mut self,
        topic: &TopicName,
        stamp: (i32, u32),
        logged: Timestamp,
        published: Option<Timestamp>,
    ) {
        let step = self.last.map_or(Duration::ZERO, |last| logged - last);
        self.last = Some(logged);
        self.elapsed = self.elapsed.saturating_add(step);
        self.close(self.elapsed);
        let published = published.filter(|published| published.0 > 0);
        self.misses_publish_times |= published.is_none();
        self.has_published |= published.is_some_and(|published| published != logged);
        if stamp == (0, 0) {
            return;
        }
        if stamp.1.is_multiple_of(ROUNDED) {
            self.rounded += 1;
            return;
        }
        let Some(topic) = self.id(topic) else {
            self.refused += 1;
            return;
        };
        let elapsed = self.elapsed;
        let open = self.open.entry(stamp).or_insert_with(|| {
            self.order.push_back(stamp);
            Open {
                first: elapsed,
                last: elapsed,
                messages: Vec::new(),
                is_crowded: false,
            }
        });
        open.last = elapsed;
        // Later messages with the same stamp repeat the first.
        if open.messages.iter().any(|known| known.topic == topic) {
            return;
        }
        if open.messages.len() >= MAX_OF_STAMP {
            open.is_crowded = true;
            return;
        }
        open.messages.push(Recorded {
            topic,
            logged,
            published: published.unwrap_or(logged),
        });
    }

    /// Returns the chains. Topics that are published together are represented by one of them that
    /// is in `preferred`, or else by the first.
    #[must_use]
    pub fn finish(mut self, preferred: &[&str]) -> RecordedFacts {
        self.close(Duration::MAX);
        let times = match self.has_published && !self.misses_publish_times {
            true => Times::Publish,
            false => Times::Log,
        };
        let mut found = hops::find(&self, times, preferred);
        let mut paths = Paths::default();
        for trace in std::mem::take(&mut found.traces) {
            paths.add_found(trace);
        }
        RecordedFacts {
            times,
            chains: paths.shown(),
            together: found.together,
            unclear: found.unclear,
            rounded: self.rounded,
            refused: self.refused,
        }
    }

    fn id(&mut self, name: &TopicName) -> Option<u16> {
        if let Some(id) = self.ids.get(name) {
            return Some(*id);
        }
        if self.topics.len() >= MAX_TOPICS {
            return None;
        }
        let id = u16::try_from(self.topics.len()).ok()?;
        self.ids.insert(name.clone(), id);
        self.topics.push(Topic {
            name: name.clone(),
            stamps: 0,
        });
        Some(id)
    }

    /// Closes the stamps that no further message can have.
    fn close(&mut self, elapsed: Duration) {
        while let Some(stamp) = self.order.front() {
            let is_open = |open: &Open| {
                elapsed - open.first < MAX_CHAIN_DURATION
                    && elapsed - open.last < EVALUATION_SILENCE
            };
            if self.open.len() < MAX_OPEN && self.open.get(stamp).is_some_and(is_open) {
                return;
            }
            let open = self.open.remove(stamp);
            self.order.pop_front();
            let Some(open) = open else { continue };
            // Nothing after the cap counts, as if the recording ended there.
            self.is_full |= self.messages.len() + open.messages.len() > self.limit;
            if self.is_full {
                self.refused += open.messages.len() as u64;
                continue;
            }
            for message in &open.messages {
                if let Some(topic) = self.topics.get_mut(usize::from(message.topic)) {
                    topic.stamps += 1;
                }
            }
            if open.messages.len() < 2 || open.is_crowded {
                continue;
            }
            self.messages.extend(open.messages);
            self.ends.push(self.messages.len());
        }
    }

    /// Returns the number of stamps with a message of this topic.
    fn stamps_of(&self, topic: u16) -> u64 {
        let topic = self.topics.get(usize::from(topic));
        topic.map_or(0, |topic| topic.stamps)
    }

    fn name(&self, topic: u16) -> TopicName {
        let topic = self.topics.get(usize::from(topic));
        topic.map_or_else(|| TopicName::from(""), |topic| topic.name.clone())
    }

    /// Returns the messages of each stamp with their times, in the order of these times.
    fn stamps(&self, times: Times) -> impl Iterator<Item = Vec<(u16, Timestamp)>> {
        let mut start = 0;
        self.ends.iter().map(move |end| {
            let messages = self.messages.get(start..*end).unwrap_or_default();
            start = *end;
            let time = |message: &Recorded| match times {
                Times::Publish => message.published,
                Times::Log => message.logged,
            };
            let mut list: Vec<_> = messages
                .iter()
                .map(|message| (message.topic, time(message)))
                .collect();
            list.sort_by_key(|(_, at)| *at);
            list
        })
    }
}

impl Times {
    /// Returns the label: `publish` or `log`.
    #[must_use]
    pub const fn label(self) -> &'static str {
        match self {
            Self::Publish => "publish",
            Self::Log => "log",
        }
    }
}
