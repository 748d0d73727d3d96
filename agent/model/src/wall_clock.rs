//! The calendar clock may be set while the agent looks: by a time server on a robot without a clock
//! of its own, by hand, by waking from suspend.
//!
//! The model's time goes on evenly all the while: leases, windows and gaps know nothing of it. Only
//! what is held against the clocks of others, and what is shown, is calendar time. It reads no clock.

use std::sync::Arc;

use ros2probe_wire::{Record, Timestamp};

use super::event::{EventKind, Taken};
use super::payloads::{Dispatch, SampleOutcome};
use super::snapshot::{DeliveryFacts, EndpointFacts, Measurement, Snapshot, TopicFacts};
use super::trace::Spans;

/// By how many nanoseconds the calendar has been set forward since the model's time began.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct WallClock(i64);

impl WallClock {
    /// It was set forward by so many nanoseconds, or back.
    pub const fn set(&mut self, step: i64) {
        self.0 = self.0.saturating_add(step);
    }

    /// The model's time at this time of the calendar.
    #[must_use]
    pub const fn model_time(self, wall_clock: Timestamp) -> Timestamp {
        Timestamp(wall_clock.0.saturating_add_signed(self.0.saturating_neg()))
    }

    /// The calendar's time at this time of the model.
    #[must_use]
    pub const fn wall_time(self, model_time: Timestamp) -> Timestamp {
        Timestamp(model_time.0.saturating_add_signed(self.0))
    }

    /// A record in the model's time; `None` = as it is.
    #[must_use]
    pub fn model_record(self, record: &Record) -> Option<Record> {
        let time = self.model_time(Timestamp(record.time)).0;
        (self.0 != 0).then_some(Record { time, ..*record })
    }

    pub(super) fn convert_snapshot(self, snapshot: &mut Snapshot) {
        if self.0 == 0 {
            return;
        }
        self.convert(&mut snapshot.at);
        let diagnosed = snapshot.diagnosed.iter();
        snapshot.diagnosed = diagnosed
            .map(|since| self.wall_time(*since))
            .collect::<Vec<_>>()
            .into();
        for participant in &mut snapshot.participants {
            self.convert(&mut participant.first_seen);
            self.convert(&mut participant.last_seen);
        }
        for topic in &mut snapshot.topics {
            self.convert_topic(topic);
        }
        for unknown_writer in &mut snapshot.unknown_writers {
            self.convert(&mut unknown_writer.first_seen);
            self.convert_measurement(&mut unknown_writer.measurement);
        }
    }

    pub(super) fn convert_events(self, taken: &mut Taken) {
        for event in &mut taken.events {
            self.convert(&mut event.at);
            if let EventKind::Silence {
                last_message: Some(last),
                ..
            } = &mut event.kind
            {
                self.convert(last);
            }
        }
    }

    pub(super) fn convert_dispatches(self, given: &mut [Dispatch]) {
        if self.0 == 0 {
            return;
        }
        for each in given {
            if let SampleOutcome::Sample(sample) = &mut each.outcome {
                self.convert(&mut Arc::make_mut(sample).time);
            }
        }
    }

    pub(super) fn convert_spans(self, spans: &mut Spans) {
        for span in &mut spans.spans {
            self.convert(&mut span.begin);
            self.convert(&mut span.end);
        }
    }

    fn convert_topic(self, topic: &mut TopicFacts) {
        if let Some(measurement) = &mut topic.measurement {
            self.convert_measurement(measurement);
        }
        let endpoints = topic.publishers.iter_mut().chain(&mut topic.subscriptions);
        for endpoint in endpoints {
            self.convert_endpoint(endpoint);
        }
        for DeliveryFacts {
            first_seen,
            last_seen,
            ..
        } in &mut topic.deliveries
        {
            self.convert(first_seen);
            self.convert(last_seen);
        }
        for acknowledgement in &mut topic.acknowledgements {
            self.convert(&mut acknowledgement.last_seen);
        }
    }

    fn convert_endpoint(self, endpoint: &mut EndpointFacts) {
        self.convert(&mut endpoint.first_seen);
        if let Some(measurement) = &mut endpoint.measurement {
            self.convert_measurement(measurement);
        }
    }

    fn convert_measurement(self, measurement: &mut Measurement) {
        if let Some(last) = &mut measurement.last_message {
            self.convert(last);
        }
    }

    const fn convert(self, time: &mut Timestamp) {
        *time = self.wall_time(*time);
    }
}
