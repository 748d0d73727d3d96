//! Conversion of the model's output from model time to calendar time.

use std::sync::Arc;

use ros2probe_wire::Timestamp;

use crate::derive::trace::Spans;
use crate::facts::dispatch::{Dispatch, SampleOutcome};
use crate::facts::event::{EventKind, Taken};
use crate::facts::measurement::Measurement;
use crate::facts::wall_clock::WallClock;
use crate::report::snapshot::{DeliveryFacts, EndpointFacts, Snapshot, TopicFacts};

impl WallClock {
    pub(super) fn convert_snapshot(self, snapshot: &mut Snapshot) {
        if !self.is_set() {
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
        if let Some(inside) = &mut snapshot.inside {
            let inside = Arc::make_mut(inside);
            inside.convert(|time| self.wall_time(time));
        }
        for unknown_writer in &mut snapshot.unknown_writers {
            self.convert(&mut unknown_writer.first_seen);
            self.convert_measurement(&mut unknown_writer.measurement);
        }
    }

    pub(super) fn convert_events(self, taken: &mut Taken) {
        for event in &mut taken.events {
            self.convert(&mut event.at);
            match &mut event.kind {
                EventKind::Silence {
                    last_message: Some(last),
                    ..
                } => self.convert(last),
                EventKind::Lifecycle(state) => self.convert(&mut state.at),
                _ => {}
            }
        }
    }

    pub(super) fn convert_dispatches(self, given: &mut [Dispatch]) {
        if !self.is_set() {
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
        if let Some(last) = topic
            .inside
            .as_mut()
            .and_then(|inside| inside.last.as_mut())
        {
            self.convert(last);
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
