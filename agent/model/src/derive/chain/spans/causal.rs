//! Spans of publications within callbacks.
//!
//! The source timestamp of the first input identifies the measurement, because every process that
//! takes the message knows it. Publications are observed only inside processes, so the host is a
//! part of all span ids.

use ros2probe_wire::Timestamp;

use super::ChainSpan;
use super::ChainStage;
use super::ChainTracer;
use super::SpanId;
use crate::derive::chain::causality::CausalPublication;
use crate::derive::chain::trace::{Method, Point};
use crate::derive::trace::share::Share;
use crate::facts::identity::Identity;
use crate::facts::names::{NodeName, TopicName};

/// A publication whose trace is exported.
#[derive(Clone, Copy, Debug)]
pub(in crate::derive::chain) struct Traced {
    trace_id: u128,
    /// Span of the input's path to the node.
    transit: SpanId,
    /// Span of the publication.
    publish: SpanId,
}

/// A publication, with the times of its input and its output.
pub(in crate::derive::chain) struct Step<'a> {
    pub(in crate::derive::chain) publication: &'a CausalPublication,
    /// The node that publishes the first input of the chain.
    pub(in crate::derive::chain) source: Option<&'a NodeName>,
    pub(in crate::derive::chain) input: Point,
    pub(in crate::derive::chain) output: Point,
}

impl Traced {
    /// Returns the id of the trace.
    pub(in crate::derive::chain) const fn trace_id(&self) -> u128 {
        self.trace_id
    }
}

impl Step<'_> {
    /// Completes the spans of a publication that begins a chain, if its trace is exported. `known`
    /// are the latest traced publications.
    pub(in crate::derive::chain) fn begin(
        &self,
        share: Share,
        known: impl Iterator<Item = Traced> + Clone,
        tracer: &mut ChainTracer,
    ) -> Option<Traced> {
        let CausalPublication {
            domain_id,
            input,
            input_source,
            ..
        } = self.publication;
        let mut identity = Identity::of(b"ros2 chain by causality");
        identity.add(&domain_id.0.to_be_bytes());
        identity.add(input.as_bytes());
        identity.add(&input_source.0.to_be_bytes());
        let trace_id = identity.bits();
        if !share.takes(trace_id) {
            return None;
        }
        let publish = SpanId::of(ChainStage::Publish, trace_id, &[]).of_host();
        if !known.clone().any(|known| known.trace_id == trace_id) {
            let at = self.input.published;
            tracer.finish(ChainSpan {
                node: self.source.cloned(),
                ..self.span((ChainStage::Publish, publish), (at, at), trace_id)
            });
        }
        Some(self.pass((trace_id, publish), known, tracer))
    }

    /// Completes the spans of a publication that continues another one.
    pub(in crate::derive::chain) fn continue_spans(
        &self,
        before: Traced,
        known: impl Iterator<Item = Traced>,
        tracer: &mut ChainTracer,
    ) -> Traced {
        self.pass((before.trace_id, before.publish), known, tracer)
    }

    /// Completes the spans from the input, whose publication is `parent`, to the output.
    fn pass(
        &self,
        (trace_id, parent): (u128, SpanId),
        mut known: impl Iterator<Item = Traced>,
        tracer: &mut ChainTracer,
    ) -> Traced {
        let CausalPublication {
            process,
            input,
            output,
            ..
        } = self.publication;
        let (begin, done) = (self.input.published, self.output.published);
        let taken = self.input.arrived.unwrap_or(begin);
        let started = self.input.started.unwrap_or(taken);
        let process = process.to_be_bytes();
        let id = |stage, topic: &TopicName, at: Timestamp| {
            let values: [&[u8]; 3] = [topic.as_bytes(), &process, &at.0.to_be_bytes()];
            SpanId::of(stage, trace_id, &values).of_host()
        };
        let transit = id(ChainStage::Transit, input, taken);
        let callback = id(ChainStage::Callback, output, done);
        let publish = id(ChainStage::Publish, output, done);
        let mut finish = |stage, id, times, parent, output: Option<&TopicName>| {
            tracer.finish(ChainSpan {
                parent: Some(parent),
                output: output.cloned(),
                ..self.span((stage, id), times, trace_id)
            });
        };
        // A callback may publish several messages.
        if !known.any(|known| known.transit == transit) {
            finish(ChainStage::Transit, transit, (begin, taken), parent, None);
            let wait = id(ChainStage::Wait, input, taken);
            finish(ChainStage::Wait, wait, (taken, started), parent, None);
        }
        let times = (started, done);
        finish(ChainStage::Callback, callback, times, parent, Some(output));
        let span = self.span((ChainStage::Publish, publish), (done, done), trace_id);
        tracer.finish(ChainSpan {
            topic: output.clone(),
            parent: Some(callback),
            ..span
        });
        Traced {
            trace_id,
            transit,
            publish,
        }
    }

    /// Returns a span without a parent, about the input.
    fn span(
        &self,
        (stage, id): (ChainStage, SpanId),
        (begin, end): (Timestamp, Timestamp),
        trace_id: u128,
    ) -> ChainSpan {
        ChainSpan {
            stage,
            trace_id,
            id,
            parent: None,
            begin,
            end: end.max(begin),
            domain_id: self.publication.domain_id,
            method: Method::Causality,
            topic: self.publication.input.clone(),
            node: self.publication.node.clone(),
            output: None,
            message: None,
        }
    }
}
