//! Spans of the messages with one stamp.
//!
//! A span belongs to a node, and the agent of the node's host exports it: the path of the input to
//! the node, its processing, and the publication. Other agents derive the id of the span without
//! having the span.
//!
//! The stamp alone identifies the measurement if it is not rounded and close to the present time.
//! All agents that see a part of the chain then report one trace. Rounded, simulated and recorded
//! stamps may occur more than once. With them, the first message of the chain is a part of the
//! identity.

use std::sync::Arc;

use ros2probe_wire::Timestamp;

use super::ChainMessage;
use super::ChainSpan;
use super::ChainStage;
use super::ChainTracer;
use super::SpanId;
use crate::derive::chain::stamps::{Published, Stamp};
use crate::derive::chain::trace::Method;
use crate::derive::trace::Message;
use crate::facts::header::stamp_time;
use crate::facts::identity::Identity;

/// A stamp that is a multiple of this many nanoseconds may also occur on another robot.
const COARSE_STAMP_UNIT: u32 = 1000;

/// The messages with one stamp, in the order of their publication.
pub(in crate::derive::chain) struct Stamped<'a> {
    pub(in crate::derive::chain) stamp: Stamp,
    pub(in crate::derive::chain) messages: &'a [&'a Published],
    /// For each message, the index of the earlier message that it continues by an accepted hop.
    pub(in crate::derive::chain) causes: &'a [Option<usize>],
}

/// A hop: its input, its output, and when the input reached the node, if that was observed.
struct Hop<'a> {
    input: &'a Published,
    output: &'a Published,
    arrived: Option<Timestamp>,
}

impl Stamped<'_> {
    /// Completes the spans of all messages whose trace is exported. Returns the trace of each
    /// message with a span, by position; an empty list if no topic is traced.
    pub(in crate::derive::chain) fn trace(&self, tracer: &mut ChainTracer) -> Vec<Option<u128>> {
        let is_traced = |message: &&Published| message.output.share.is_some();
        if !self.messages.iter().any(is_traced) {
            return Vec::new();
        }
        let mut exported = vec![None; self.messages.len()];
        let messages = self.messages.iter().enumerate();
        for (index, message) in messages.filter(|(_, message)| message.is_local) {
            if let Some(trace_id) = self.trace_id(index) {
                if let Some(hop) = self.hop(index) {
                    self.pass(index, &hop, trace_id, tracer);
                }
                self.publish(index, message, trace_id, tracer);
                if let Some(exported) = exported.get_mut(index) {
                    *exported = Some(trace_id);
                }
            }
        }
        exported
    }

    /// Returns the trace of a message, or `None` if it is in no chain or not exported. If a node of
    /// another host reads the message, the chain may continue there, unobserved by this agent.
    fn trace_id(&self, index: usize) -> Option<u128> {
        let is_in_chain = self.cause(index).is_some() || self.causes.contains(&Some(index));
        if !is_in_chain && !self.messages.get(index)?.output.is_read_elsewhere {
            return None;
        }
        let mut first = index;
        while let Some(cause) = self.cause(first) {
            first = cause;
        }
        let first = self.messages.get(first)?;
        let trace_id = identity(self.stamp, first);
        first.output.share?.takes(trace_id).then_some(trace_id)
    }

    fn cause(&self, index: usize) -> Option<usize> {
        let cause = self.causes.get(index).copied().flatten();
        cause.filter(|cause| *cause < index)
    }

    /// Returns the hop that ends with this message.
    fn hop(&self, index: usize) -> Option<Hop<'_>> {
        let (input, output) = (self.cause(index)?, self.messages.get(index)?);
        let input = self.messages.get(input)?;
        Some(Hop {
            input,
            output,
            arrived: input.reached(output),
        })
    }

    /// Completes the span of a publication on this host.
    fn publish(&self, index: usize, message: &Published, trace_id: u128, tracer: &mut ChainTracer) {
        let end = if message.sampled {
            message.published
        } else {
            message.at
        };
        tracer.finish(ChainSpan {
            parent: self.hop(index).map(|hop| hop.id(trace_id)),
            ..self.span(
                (ChainStage::Publish, publish(message, trace_id)),
                (message, message),
                (message.published, end),
                trace_id,
            )
        });
    }

    /// Completes the spans of a hop.
    fn pass(&self, index: usize, hop: &Hop<'_>, trace_id: u128, tracer: &mut ChainTracer) {
        let Hop {
            input,
            output,
            arrived,
        } = *hop;
        let parent = Some(publish(input, trace_id));
        let messages = (input, output);
        let span = |named, times| ChainSpan {
            parent,
            ..self.span(named, messages, times, trace_id)
        };
        let Some(arrived) = arrived else {
            let times = (input.published, output.published);
            let named = (ChainStage::Hop, hop.id(trace_id));
            return tracer.finish(with_output(span(named, times), output));
        };
        // A node may publish several messages because of one input.
        let is_same = |other: &usize| {
            self.cause(*other) == self.cause(index)
                && self.hop(*other).is_some_and(|other| {
                    other.arrived.is_some() && other.output.output.node.is_same(&output.output.node)
                })
        };
        if !(0..index).any(|other| is_same(&other)) {
            let named = (ChainStage::Transit, transit(hop, trace_id));
            tracer.finish(span(named, (input.published, arrived)));
        }
        let named = (ChainStage::Node, hop.id(trace_id));
        let times = (arrived, output.published);
        tracer.finish(with_output(span(named, times), output));
    }

    /// Returns a span without a parent, about a message and the node that publishes another one.
    fn span(
        &self,
        (stage, id): (ChainStage, SpanId),
        (message, of_node): (&Published, &Published),
        (begin, end): (Timestamp, Timestamp),
        trace_id: u128,
    ) -> ChainSpan {
        let output = &message.output;
        let own_trace = Message::identity(message.writer, message.number);
        let is_sent = message.is_local && !message.sampled;
        let share = output.share.filter(|_| is_sent);
        ChainSpan {
            stage,
            trace_id,
            id,
            parent: None,
            begin,
            end: end.max(begin),
            domain_id: output.node.domain_id,
            method: Method::Stamps,
            topic: output.key.name.clone(),
            node: of_node.output.node.name.clone(),
            output: None,
            message: Some(Arc::new(ChainMessage {
                writer: message.writer,
                sequence_number: message.number,
                message_type: output.message_type.clone(),
                size: message.size,
                stamp: self.stamp,
                own_trace: share.and_then(|share| share.takes(own_trace).then_some(own_trace)),
            })),
        }
    }
}

impl Hop<'_> {
    /// Returns the id of the span that ends with the output.
    fn id(&self, trace_id: u128) -> SpanId {
        let stage = match self.arrived {
            Some(_) => ChainStage::Node,
            None => ChainStage::Hop,
        };
        let (input, output) = (key(self.input), key(self.output));
        SpanId::of(stage, trace_id, &[&input, &output])
    }
}

fn publish(message: &Published, trace_id: u128) -> SpanId {
    SpanId::of(ChainStage::Publish, trace_id, &[&key(message)])
}

fn transit(hop: &Hop<'_>, trace_id: u128) -> SpanId {
    let node = &hop.output.output.node;
    let name = node.name.as_deref().unwrap_or_default();
    let values: [&[u8]; 3] = [&key(hop.input), &node.prefix.0, name.as_bytes()];
    SpanId::of(ChainStage::Transit, trace_id, &values)
}

/// Returns bytes that identify the message.
fn key(message: &Published) -> [u8; 16] {
    Message::identity(message.writer, message.number).to_be_bytes()
}

fn with_output(span: ChainSpan, output: &Published) -> ChainSpan {
    ChainSpan {
        output: Some(output.output.key.name.clone()),
        ..span
    }
}

/// Returns the trace id of the messages with this stamp.
fn identity(stamp: Stamp, first: &Published) -> u128 {
    let (seconds, nanoseconds) = stamp;
    let mut identity = Identity::of(b"ros2 chain by stamps");
    identity.add(&first.output.node.domain_id.0.to_be_bytes());
    identity.add(&seconds.to_be_bytes());
    identity.add(&nanoseconds.to_be_bytes());
    let is_present = stamp_time(stamp, first.published).is_some();
    if nanoseconds.is_multiple_of(COARSE_STAMP_UNIT) || !is_present {
        identity.add(&key(first));
    }
    identity.bits()
}
