//! The readers that match a writer, as far as discovery knows.
//!
//! A process that shares a multicast group or a port with a reader receives the samples, too. It
//! counts as a subscriber only if it has a reader that matches the writer.

use ros2probe_wire::backends::Backends;
use ros2probe_wire::qos::Reliability;
use ros2probe_wire::{Guid, GuidPrefix};

use super::Graph;
use crate::facts::diagnosis::{Offer, Verdict, effort, verdict};
use crate::facts::model_time::ModelTime;
use crate::graph::discovery::Endpoint;
use crate::measure::topic::{Accelerated, Topic};

/// Maximum effort of one comparison. Endpoints whose lists of partitions exceed it count as a
/// match.
const MATCHING_EFFORT: usize = 4096;
/// Maximum number of readers that the search for any match compares.
const MAX_COMPARED: usize = 64;

/// The readers of one writer's topic.
#[derive(Clone, Copy, Debug)]
pub struct MatchedReaders<'a> {
    graph: &'a Graph,
    topic: Option<&'a Topic>,
    writer: Guid,
}

/// Whether a receiver has a reader that matches the writer.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum Matched {
    /// The receiver has a matching reader.
    Yes,
    /// No matching reader of the receiver is known.
    No,
    /// The receiver is not known.
    Unknown,
}

impl<'a> MatchedReaders<'a> {
    /// Creates a view of the readers that match `writer`, a writer of `topic`.
    #[must_use]
    pub const fn new(graph: &'a Graph, topic: Option<&'a Topic>, writer: Guid) -> Self {
        Self {
            graph,
            topic,
            writer,
        }
    }

    /// Returns the graph.
    #[must_use]
    pub const fn graph(&self) -> &'a Graph {
        self.graph
    }

    /// Returns the topic of the writer.
    #[must_use]
    pub const fn topic(&self) -> Option<&'a Topic> {
        self.topic
    }

    /// Returns this participant's readers that match the writer, sorted within the topic and its
    /// buffer topic.
    pub fn of(self, prefix: GuidPrefix) -> impl Iterator<Item = Guid> + 'a {
        let readers = self.topic.into_iter();
        readers
            .flat_map(move |topic| topic.readers_of(prefix))
            .filter(move |guid| self.matches(*guid))
    }

    /// Returns whether this participant has a reader that matches the writer.
    #[must_use]
    pub fn matched(self, prefix: GuidPrefix) -> Matched {
        match self.of(prefix).next() {
            Some(_) => Matched::Yes,
            None => Matched::No,
        }
    }

    /// Returns whether any participant has a reader that matches the writer.
    #[must_use]
    pub fn any(self) -> bool {
        let lists = self
            .topic
            .map(|topic| [&topic.readers, &topic.buffer_endpoints]);
        let mut readers = lists.into_iter().flatten().flatten();
        readers
            .by_ref()
            .filter(|guid| !guid.entity.is_writer())
            .take(MAX_COMPARED)
            .any(|guid| self.matches(*guid))
            || readers.next().is_some()
    }

    /// Returns the time at which this participant's first matching reader was announced.
    #[must_use]
    pub fn since(self, prefix: GuidPrefix) -> Option<ModelTime> {
        let endpoints = self.graph.discovery.endpoints();
        let readers = self.of(prefix);
        readers
            .filter_map(|guid| Some(endpoints.get(&guid)?.first_seen))
            .min()
    }

    /// Returns whether this participant has matching readers, all of them best effort.
    #[must_use]
    pub fn are_best_effort(self, prefix: GuidPrefix) -> bool {
        let endpoints = self.graph.discovery.endpoints();
        let known = self.of(prefix).filter_map(|guid| endpoints.get(&guid));
        let mut known = known.map(|endpoint| endpoint.qos.reliability == Reliability::RELIABLE);
        known.next() == Some(false) && !known.any(|is_reliable| is_reliable)
    }

    /// Returns whether the writer applies a content filter for each matching reader of this
    /// participant; `None` means all participants.
    #[must_use]
    pub fn are_filtered(self, prefix: Option<GuidPrefix>) -> bool {
        let Some(topic) = self.topic.filter(|topic| topic.has_filters) else {
            return false;
        };
        let readers: Vec<Guid> = match prefix {
            Some(prefix) => self.of(prefix).collect(),
            None if topic.readers.len() > MAX_COMPARED => return false,
            None => {
                let readers = topic.readers.iter().copied();
                readers.filter(|guid| self.matches(*guid)).collect()
            }
        };
        !readers.is_empty() && readers.iter().all(|guid| self.is_filtered(*guid))
    }

    /// Returns whether the writer applies a content filter of this reader. It does so only for
    /// readers of its own vendor; a reader of another vendor receives all samples.
    fn is_filtered(self, reader: Guid) -> bool {
        let discovery = &self.graph.discovery;
        let vendor = |guid: Guid| {
            let participant = discovery.participants().get(&guid.prefix);
            participant.map(|participant| participant.proxy.vendor)
        };
        let endpoint = discovery.endpoints().get(&reader);
        endpoint.is_some_and(|endpoint| endpoint.content_filter)
            && vendor(reader).is_some()
            && vendor(reader) == vendor(self.writer)
    }

    /// Returns who of the readers gets references to buffers instead of messages. If there are too
    /// many readers, some of them may get messages.
    #[must_use]
    pub fn accelerated(self) -> Accelerated {
        let endpoints = self.graph.discovery.endpoints();
        let readers = self.topic.map(|topic| &topic.readers);
        let (mut some, mut whole) = (false, false);
        for (place, reader) in readers.into_iter().flatten().enumerate() {
            if place == MAX_COMPARED {
                whole = true;
                break;
            }
            let endpoint = endpoints.get(reader);
            let backends = endpoint.and_then(|endpoint| endpoint.backends.as_deref());
            let is_accelerated = backends.is_some_and(Backends::is_accelerated);
            some |= is_accelerated;
            whole |= !is_accelerated && self.matches(*reader);
        }
        match (some, whole) {
            (false, _) => Accelerated::None,
            (true, true) => Accelerated::Some,
            (true, false) => Accelerated::All,
        }
    }

    fn matches(self, reader: Guid) -> bool {
        let endpoints = self.graph.discovery.endpoints();
        let (Some(one), Some(other)) = (endpoints.get(&self.writer), endpoints.get(&reader)) else {
            return true;
        };
        let (Some(writer), Some(reader)) =
            (self.offer(self.writer, one), self.offer(reader, other))
        else {
            return true;
        };
        // A topic and its buffer topics are several topics of DDS.
        one.topic == other.topic
            && one.message_type == other.message_type
            && writer.shares_protocol(reader)
            && (effort(writer.qos, reader.qos) > MATCHING_EFFORT
                || verdict(writer, reader) == Verdict::Match)
    }

    fn offer(self, guid: Guid, endpoint: &'a Endpoint) -> Option<Offer<'a>> {
        let participant = self.graph.discovery.participants().get(&guid.prefix)?;
        Some(Offer {
            qos: &endpoint.qos,
            vendor: participant.proxy.vendor,
        })
    }
}
