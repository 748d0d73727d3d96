//! The calendar clock may be set while the agent looks: by a time server on a robot without a clock
//! of its own, by hand, by waking from suspend.
//!
//! The model's time goes on evenly all the while: leases, windows and gaps know nothing of it. Only
//! what is held against the clocks of others, and what is shown, is calendar time. It reads no clock.

use std::sync::Arc;

use ros2probe_wire::{Record, Timestamp};

use super::event::{EventKind, Taken};
use super::payloads::{Given, News};
use super::snapshot::{DeliveryFacts, EndpointFacts, Measurement, Snapshot, TopicFacts};
use super::trace::Spans;

/// By how many nanoseconds the calendar has been set forward since the model's time began.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Calendar(i64);

impl Calendar {
    /// It was set forward by so many nanoseconds, or back.
    pub const fn set(&mut self, step: i64) {
        self.0 = self.0.saturating_add(step);
    }

    /// The model's time at this time of the calendar.
    #[must_use]
    pub const fn even(self, calendar: Timestamp) -> Timestamp {
        Timestamp(calendar.0.saturating_add_signed(self.0.saturating_neg()))
    }

    /// The calendar's time at this time of the model.
    #[must_use]
    pub const fn shown(self, even: Timestamp) -> Timestamp {
        Timestamp(even.0.saturating_add_signed(self.0))
    }

    /// A record in the model's time; `None` = as it is.
    #[must_use]
    pub fn even_record(self, record: &Record) -> Option<Record> {
        let time = self.even(Timestamp(record.time)).0;
        (self.0 != 0).then_some(Record { time, ..*record })
    }

    pub(super) fn show_snapshot(self, snapshot: &mut Snapshot) {
        if self.0 == 0 {
            return;
        }
        self.show(&mut snapshot.at);
        let diagnosed = snapshot.diagnosed.iter();
        snapshot.diagnosed = diagnosed
            .map(|since| self.shown(*since))
            .collect::<Vec<_>>()
            .into();
        for participant in &mut snapshot.participants {
            self.show(&mut participant.first_seen);
            self.show(&mut participant.last_seen);
        }
        for topic in &mut snapshot.topics {
            self.show_topic(topic);
        }
        for stranger in &mut snapshot.unknown_writers {
            self.show(&mut stranger.first_seen);
            self.show_measurement(&mut stranger.measurement);
        }
    }

    pub(super) fn show_events(self, taken: &mut Taken) {
        for event in &mut taken.events {
            self.show(&mut event.at);
            if let EventKind::Silence {
                last_message: Some(last),
                ..
            } = &mut event.kind
            {
                self.show(last);
            }
        }
    }

    pub(super) fn show_given(self, given: &mut [Given]) {
        if self.0 == 0 {
            return;
        }
        for each in given {
            if let News::Sample(sample) = &mut each.news {
                self.show(&mut Arc::make_mut(sample).time);
            }
        }
    }

    pub(super) fn show_spans(self, spans: &mut Spans) {
        for span in &mut spans.spans {
            self.show(&mut span.begin);
            self.show(&mut span.end);
        }
    }

    fn show_topic(self, topic: &mut TopicFacts) {
        if let Some(measurement) = &mut topic.measurement {
            self.show_measurement(measurement);
        }
        let endpoints = topic.publishers.iter_mut().chain(&mut topic.subscriptions);
        for endpoint in endpoints {
            self.show_endpoint(endpoint);
        }
        for DeliveryFacts {
            first_seen,
            last_seen,
            ..
        } in &mut topic.deliveries
        {
            self.show(first_seen);
            self.show(last_seen);
        }
        for acknowledgement in &mut topic.acknowledgements {
            self.show(&mut acknowledgement.last_seen);
        }
    }

    fn show_endpoint(self, endpoint: &mut EndpointFacts) {
        self.show(&mut endpoint.first_seen);
        if let Some(measurement) = &mut endpoint.measurement {
            self.show_measurement(measurement);
        }
    }

    fn show_measurement(self, measurement: &mut Measurement) {
        if let Some(last) = &mut measurement.last_message {
            self.show(last);
        }
    }

    const fn show(self, time: &mut Timestamp) {
        *time = self.shown(*time);
    }
}
