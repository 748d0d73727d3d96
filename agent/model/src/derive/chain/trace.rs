//! One message's path along a chain: the times at each topic, and the durations between them.

use std::sync::Arc;
use std::time::Duration;

use ros2probe_wire::{DomainId, Timestamp};

use crate::facts::names::{NodeName, TopicName};

/// How a chain was recognised.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum Method {
    /// A process published within the callback that processed the input.
    Causality,
    /// The header of the output has the stamp of the input.
    Stamps,
}

/// The identity of a chain.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct Path {
    /// Domain.
    pub domain_id: DomainId,
    /// How it was recognised.
    pub method: Method,
    /// Topics in the order of the chain, each with the node that publishes it; `None` if the node
    /// is not known.
    pub topics: Vec<(TopicName, Option<NodeName>)>,
}

/// A message's times on one topic, by the wall clock.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Point {
    /// Time of publication.
    pub published: Timestamp,
    /// Time at which it reached the next node: the process took it from the middleware, or its
    /// datagram arrived. `None` if that was not observed, and on the last topic.
    pub arrived: Option<Timestamp>,
    /// Begin of the callback in the next node; known only by causality.
    pub started: Option<Timestamp>,
}

/// One message's path along a chain.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Trace {
    /// The chain.
    pub path: Arc<Path>,
    /// One point for each topic.
    pub points: Vec<Point>,
    /// Its OpenTelemetry trace, if this agent exports spans of it.
    pub trace_id: Option<u128>,
}

/// Durations of a hop. The parts that are known add up to the whole.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct HopTimes {
    /// From the publication of the input to that of the output.
    pub whole: Duration,
    /// From the publication of the input to its arrival at the node.
    pub transit: Option<Duration>,
    /// From the arrival to the start of the callback.
    pub wait: Option<Duration>,
    /// From the start of the callback to the publication of the output.
    pub callback: Option<Duration>,
    /// From the arrival to the publication of the output.
    pub node: Option<Duration>,
}

impl Method {
    /// Returns the label value.
    #[must_use]
    pub const fn label(self) -> &'static str {
        match self {
            Self::Causality => "causality",
            Self::Stamps => "stamps",
        }
    }
}

impl Path {
    /// Returns the positions of topic `from` and of a later topic `to`, if the chain has both.
    #[must_use]
    pub fn section(&self, from: &str, to: &str) -> Option<(usize, usize)> {
        let begin = self.topics.iter().position(|(topic, _)| topic == from)?;
        let end = self.topics.iter().rposition(|(topic, _)| topic == to)?;
        (begin < end).then_some((begin, end))
    }

    /// Returns whether `other` is this chain with the names of nodes that are not known here.
    #[must_use]
    pub fn is_named_by(&self, other: &Self) -> bool {
        let mut topics = self.topics.iter().zip(&other.topics);
        (self.domain_id, self.method, self.topics.len())
            == (other.domain_id, other.method, other.topics.len())
            && topics.all(|((topic, node), (other, name))| {
                topic == other && (node.is_none() || node == name)
            })
    }

    /// Returns whether `other` is a part of this chain.
    #[must_use]
    pub fn contains(&self, other: &Self) -> bool {
        (self.domain_id, self.method) == (other.domain_id, other.method)
            && self
                .topics
                .windows(other.topics.len().max(1))
                .any(|part| part == other.topics)
    }
}

impl HopTimes {
    /// Returns the durations from one point to the next.
    #[must_use]
    pub fn between(input: &Point, output: &Point) -> Self {
        let between = |from: Timestamp, to: Timestamp| to - from;
        let transit = input.arrived.map(|at| between(input.published, at));
        let wait = input.arrived.zip(input.started);
        Self {
            whole: between(input.published, output.published),
            transit,
            wait: wait.map(|(arrived, started)| between(arrived, started)),
            callback: input.started.map(|at| between(at, output.published)),
            node: input.arrived.map(|at| between(at, output.published)),
        }
    }
}

/// Returns the paths of at least two messages that no other message continues, each from its first
/// message to its last. `causes` has the index of the cause of each message, which precedes the
/// message.
pub(super) fn paths(causes: &[Option<usize>]) -> impl Iterator<Item = Vec<usize>> {
    let ends = (0..causes.len()).filter(|end| !causes.contains(&Some(*end)));
    let paths = ends.map(|end| {
        let mut messages = vec![end];
        while let Some(cause) = messages.last().and_then(|last| *causes.get(*last)?) {
            messages.push(cause);
        }
        messages.reverse();
        messages
    });
    paths.filter(|messages| messages.len() > 1)
}
