//! Samples for subscriptions: in order, once each, or reported as missing.

use std::sync::Arc;

use ros2probe_wire::{Guid, SequenceNumber, Timestamp};

use ros2probe_wire::names::DdsTopic;
use ros2probe_wire::rtps::VendorId;

use super::Observer;
use crate::derive::robot::ReadOutcome;
use crate::derive::services::Half;
use crate::derive::services::service::CallId;
use crate::facts::dispatch::{self, Dispatch, SampleOutcome};
use crate::facts::model_time::ModelTime;
use crate::facts::naming::Naming;
use crate::facts::observation::{Content, Sample};
use crate::facts::selection::SampleRequest;
use crate::measure::profiler::Measured;
use crate::measure::writer::Counted;

impl Observer {
    /// Replaces the sample requests. They take effect once `Input::MoreLists` has visited
    /// all topics. Requested topics are measured even without a watch; existing counts stay.
    pub(super) fn set_sample_requests(&mut self, sample_requests: Arc<Vec<SampleRequest>>) {
        self.requested.sample_requests = sample_requests;
        self.requested.requests_changed = self.clock;
        if self.requested.sample_requests.is_empty() {
            self.measure.payloads.retain_unknown_writers(|_| false);
        }
        self.apply_lists_to_all();
    }

    /// Returns the latest time before which all samples have been dispatched or reported as
    /// missing.
    #[must_use]
    pub fn dispatched_until(&self, now: Timestamp) -> Timestamp {
        let writers = self.measure.payloads.requested_writers();
        let writers = writers.filter_map(|writer| self.measure.profiler.get(*writer));
        let unseen = writers.filter_map(|measured| measured.writer.unseen_since());
        unseen.fold(now, |until, since| {
            until.min(self.graph.wall_clock.wall_time(since))
        })
    }

    /// Returns the latest time up to `dispatched_until` before which no sample waits for lower numbers
    /// either. A reliable writer may take seconds to repeat one.
    #[must_use]
    pub fn complete_until(&self, dispatched_until: Timestamp) -> Timestamp {
        let waiting = self.measure.payloads.waiting_since();
        waiting.map_or(dispatched_until, |since| {
            dispatched_until.min(self.graph.wall_clock.wall_time(since))
        })
    }

    /// Dispatches waiting samples and reports unseen ones at the end of the agent. What is lost stays
    /// undecided.
    pub(super) fn release_waiting(&mut self) {
        let (profiler, graph) = (&mut self.measure.profiler, &self.graph);
        profiler.settle_sampled(self.clock, &mut self.journal, graph);
        self.dispatch_waiting();
    }

    /// Reports what was settled as missing, and dispatches the samples that wait for others.
    pub(super) fn dispatch_waiting(&mut self) {
        self.report_missing();
        for writer in self.measure.payloads.unsettled() {
            self.measure.payloads.dispatch_all(writer, self.clock);
        }
    }

    /// Dispatches a sample in the order of numbers, or stores its number if the writer is unknown.
    pub(super) fn counted(&mut self, writer: Guid, counted: &Counted) {
        if self.requested.sample_requests.is_empty() {
            return;
        }
        if !self.measure.payloads.is_requested(writer) {
            let known = self.measure.profiler.get(writer);
            if known.is_some_and(|known| known.topic.is_none()) {
                let sample_requests = self
                    .requested
                    .sample_requests
                    .iter()
                    .map(|request| request.id);
                let number = counted.number;
                // Unknown writers that the profiler has dropped since the last second free their
                // entries.
                if self.measure.payloads.unknown_writers() >= self.settings.unknown_writers {
                    let profiler = &self.measure.profiler;
                    self.measure.payloads.retain_unknown_writers(|writer| {
                        let known = profiler.get(writer);
                        known.is_some_and(|known| known.topic.is_none())
                    });
                }
                self.measure
                    .payloads
                    .note_unknown_writer(writer, number, sample_requests);
            }
            return;
        }
        let progress = self
            .measure
            .profiler
            .progress(writer, counted.at, &self.graph);
        if let Some(progress) = progress {
            let skip = self.measure.payloads.counted(writer, counted, &progress);
            self.skip(writer, skip);
        }
    }

    /// Dispatches a retransmitted sample that was first counted before its writer's announcement.
    pub(super) fn note_retransmitted(&mut self, sample: &Sample) {
        let (writer, at) = (sample.head.writer, sample.head.at);
        let number = sample.sequence_number;
        let stamp = match sample.content {
            Content::Data { .. } => sample.header_stamp,
            Content::DataFrag(_) => None,
        };
        if !sample.is_delivered() || !self.measure.payloads.is_undispatched(writer, number) {
            return;
        }
        let has_header = |known: &Measured| known.writer.traits().has_header;
        let counted = Counted {
            number,
            bytes: sample.size().into(),
            source: sample.source_timestamp,
            stamp: stamp.filter(|_| self.measure.profiler.get(writer).is_some_and(has_header)),
            at,
            began: at,
            sampled: false,
            unconfirmed: false,
        };
        let progress = self.measure.profiler.progress(writer, at, &self.graph);
        if let Some(progress) =
            progress.filter(|_| sample.is_end() || self.measure.payloads.needs_payload(writer))
        {
            let skip = self
                .measure
                .payloads
                .dispatch_retransmitted(writer, &counted, &progress);
            self.skip(writer, skip);
        }
    }

    /// Dispatches the samples of this writer that no longer wait for lower numbers.
    pub(super) fn turn(&mut self, writer: Guid, now: ModelTime) {
        let progress = self.measure.profiler.progress(writer, now, &self.graph);
        if let Some(progress) = progress {
            let skip = self.measure.payloads.dispatch_ready(writer, &progress, now);
            self.skip(writer, skip);
        }
    }

    pub(super) fn skip(&mut self, writer: Guid, number: Option<SequenceNumber>) {
        if let Some(number) = number {
            self.measure.profiler.settle_below(writer, number);
        }
    }

    /// Keeps the payload of a sample that is not counted yet, if it is requested.
    pub(super) fn keep_payload(&mut self, sample: &Sample, payload: &[u8]) {
        let writer = sample.head.writer;
        if self.measure.payloads.needs_payload(writer) {
            let known = self.measure.profiler.get(writer);
            let lacks = self
                .measure
                .payloads
                .is_undispatched(writer, sample.sequence_number);
            if lacks || known.is_some_and(|known| !known.writer.has(sample)) {
                self.measure.payloads.keep(sample, payload);
            }
        } else if self.measure.latched.verdict(writer).is_some()
            && self
                .measure
                .latched
                .put(sample, self.graph.wall_clock, payload)
        {
            self.apply_lists_to_latched(writer, sample.head.at);
        }
    }

    /// Reads a sample of a standard type, in which the robot itself says something.
    pub(super) fn read_robot_sample(
        &mut self,
        sample: &Sample,
        payload: &[u8],
        vendor: VendorId,
        call: impl FnOnce(Half) -> Option<CallId>,
    ) {
        let writer = sample.head.writer;
        if !self.derive.robot.is_captured(writer) {
            return;
        }
        let node = self.graph.discovery.node_of(writer).map(|node| &node.name);
        let events = &mut self.journal.events;
        match (self.derive.robot).read_sample(sample, payload, (node, vendor), call, events) {
            ReadOutcome::Nothing | ReadOutcome::Decoded => {}
            ReadOutcome::Paused => self.apply_lists_to_latched(writer, sample.head.at),
            ReadOutcome::Transition(from, node) => self.note_transition(from, node),
            ReadOutcome::Malformed(standard, error) => {
                self.decode_error(standard.stage(), error.reason);
            }
        }
    }

    /// Keeps dispatched samples of transient-local writers, and drops those that are no longer the
    /// last.
    pub(super) fn keep_dispatched(&mut self, samples: &[Dispatch]) {
        for each in samples {
            match &each.outcome {
                SampleOutcome::Sample(sample) => {
                    let at = self.graph.wall_clock.model_time(sample.time);
                    self.measure.latched.dispatched(sample, at);
                }
                SampleOutcome::Missed(missed) => self.measure.latched.missed(missed),
            }
        }
    }

    /// Returns the last messages of transient-local writers that a new request covers, the oldest
    /// first. Messages that the request received since the requests changed are left out.
    pub fn latched(&mut self, request: &SampleRequest) -> Vec<Arc<dispatch::Sample>> {
        let covers = |sample: &Arc<dispatch::Sample>| {
            let topic = &sample.topic;
            DdsTopic::parse(&topic.dds_name)
                .is_ok_and(|name| request.covers(topic.domain_id, &Naming::of(&name)))
        };
        let mut samples = self.measure.latched.samples();
        samples.retain(|(at, sample)| {
            let number = sample.sequence_number;
            let is_recent = *at >= self.requested.requests_changed;
            let writer = sample.writer;
            covers(sample)
                && (self.measure.payloads).dispatch_latched(writer, (request.id, number), is_recent)
        });
        let samples = samples.into_iter().map(|(at, mut sample)| {
            let time = self.graph.wall_clock.wall_time(at);
            // The clock may have been set since the message arrived.
            if sample.time != time {
                Arc::make_mut(&mut sample).time = time;
            }
            sample
        });
        samples.collect()
    }

    /// Returns the bytes of the kept last messages.
    #[must_use]
    pub const fn latched_bytes(&self) -> usize {
        self.measure.latched.bytes()
    }

    /// Reports missing samples to the subscriptions.
    pub(super) fn report_missing(&mut self) {
        for missing in self.journal.take_missing() {
            self.measure.payloads.missing(&missing, self.clock);
        }
    }
}
