//! Spans of chains: one trace for each measurement on its path through nodes.
//!
//! Spans contain only what was observed on this host, about nodes of this host. The agents of other
//! hosts report the spans of their nodes under the same trace, whose id follows from the
//! measurement. The number of finished spans is bounded, and dropped ones are counted.

pub(super) mod causal;
pub(super) mod stamped;

use std::sync::Arc;

use ros2probe_wire::{DomainId, Guid, SequenceNumber, Timestamp};

use super::trace::Method;
use crate::facts::bounded::Bounded;
use crate::facts::identity::Identity;
use crate::facts::names::{NodeName, TopicName, TypeName};
use crate::facts::tables::FinishedChainSpans;

/// The part of a chain that a span covers.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum ChainStage {
    /// From the publication of a message to its last datagram; an instant if its datagrams were not
    /// observed.
    Publish,
    /// From the publication of a message to its arrival at a node.
    Transit,
    /// From the arrival to the start of the callback.
    Wait,
    /// From the start of the callback to the publication of its output.
    Callback,
    /// From the arrival to the publication of the output, if the callback was not observed.
    Node,
    /// From the publication of the input to that of the output, if the arrival was not observed.
    Hop,
}

/// Id of a span.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct SpanId {
    /// The id, equal for every agent that derives it.
    pub bits: u64,
    /// Whether each host has a span of its own, so that the host is a part of the id.
    pub is_of_host: bool,
}

/// A span.
#[derive(Clone, Debug, PartialEq)]
pub struct ChainSpan {
    /// The stage.
    pub stage: ChainStage,
    /// The trace.
    pub trace_id: u128,
    /// Id of the span.
    pub id: SpanId,
    /// Id of the span that caused it; `None` for the first one.
    pub parent: Option<SpanId>,
    /// Begin, by the wall clock.
    pub begin: Timestamp,
    /// End, by the wall clock.
    pub end: Timestamp,
    /// Domain.
    pub domain_id: DomainId,
    /// How the hop was recognised.
    pub method: Method,
    /// Topic of the message that is published, or that the node processes.
    pub topic: TopicName,
    /// The node that publishes or processes; `None` if it is not known.
    pub node: Option<NodeName>,
    /// Topic of the output, from [`ChainStage::Callback`] on.
    pub output: Option<TopicName>,
    /// The message, if it was observed on the network.
    pub message: Option<Arc<ChainMessage>>,
}

/// A message of a chain by stamps.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ChainMessage {
    /// GUID of its writer.
    pub writer: Guid,
    /// Its sequence number.
    pub sequence_number: SequenceNumber,
    /// Its type.
    pub message_type: TypeName,
    /// Size of the payload in bytes.
    pub size: u32,
    /// Seconds and nanoseconds of its header.
    pub stamp: (i32, u32),
    /// Id of the message's own trace, if this agent exports it.
    pub own_trace: Option<u128>,
}

/// Spans completed since the last call.
#[derive(Debug, Default)]
pub struct ChainSpans {
    /// Spans in the order in which they were completed.
    pub spans: Bounded<FinishedChainSpans, Vec<ChainSpan>>,
    /// Number of spans dropped because the list was full.
    pub lost: u64,
}

/// Collects the spans of all chains.
#[derive(Debug, Default)]
pub(super) struct ChainTracer {
    finished: ChainSpans,
}

impl ChainStage {
    /// Returns the name of the stage.
    #[must_use]
    pub const fn label(self) -> &'static str {
        match self {
            Self::Publish => "publish",
            Self::Transit => "transit",
            Self::Wait => "wait",
            Self::Callback => "callback",
            Self::Node => "node",
            Self::Hop => "hop",
        }
    }
}

impl SpanId {
    /// Returns the id of the span that these values identify, at this stage of a trace.
    fn of(stage: ChainStage, trace_id: u128, values: &[&[u8]]) -> Self {
        let mut identity = Identity::of(stage.label().as_bytes());
        identity.add(&trace_id.to_be_bytes());
        for value in values {
            identity.add(value);
        }
        Self {
            bits: identity.bits() as u64,
            is_of_host: false,
        }
    }

    /// Makes the host a part of the id.
    const fn of_host(self) -> Self {
        Self {
            is_of_host: true,
            ..self
        }
    }
}

impl ChainTracer {
    /// Removes and returns the spans completed since the last call.
    pub(super) fn take(&mut self) -> ChainSpans {
        std::mem::take(&mut self.finished)
    }

    fn finish(&mut self, span: ChainSpan) {
        self.finished.lost += u64::from(self.finished.spans.push(span).is_some());
    }
}
