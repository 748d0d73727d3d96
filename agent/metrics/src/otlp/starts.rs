//! Start times of cumulative series, which OTLP requires in every point.
//!
//! A new or reset series starts at the previous collection, and a series of the first collection at
//! the agent's start. The number of series is bounded; further series start at the agent's start,
//! too.

use std::collections::HashMap;
use std::collections::hash_map::RandomState;
use std::hash::{BuildHasher as _, Hash as _, Hasher as _};

use crate::catalogue::Metric;
use crate::metric_sink::Label;
use crate::tables::SeriesStarts;
use ros2probe_model::facts::bounded::Bounded;

/// The series of the last collection.
#[derive(Debug)]
pub(super) struct Starts {
    hashes: RandomState,
    series: Bounded<SeriesStarts, HashMap<u64, Series>>,
    agent: u64,
    /// Times of the previous and of the current collection.
    previous: u64,
    now: u64,
}

#[derive(Clone, Copy, Debug)]
struct Series {
    start: u64,
    seen: u64,
    value: f64,
}

impl Starts {
    /// Creates the state of an agent that started at this time, in Unix nanoseconds.
    pub(super) fn new(agent: u64) -> Self {
        Self {
            hashes: RandomState::new(),
            series: Bounded::default(),
            agent,
            previous: agent,
            now: agent,
        }
    }

    /// Begins a collection.
    pub(super) fn begin(&mut self, now: u64) {
        self.now = now;
    }

    /// Ends a collection and removes the series that it did not contain.
    pub(super) fn end(&mut self) {
        let now = self.now;
        self.series.retain(|_, series| series.seen == now);
        self.previous = now;
    }

    /// Returns the start time of the series that has this value now.
    pub(super) fn start(&mut self, metric: &Metric, labels: &[Label<'_>], value: f64) -> u64 {
        let (previous, now) = (self.previous, self.now);
        let key = self.key(metric, labels);
        let new = || Series {
            start: previous,
            seen: now,
            value,
        };
        let Some(series) = self.series.get_or_insert_with(key, new) else {
            return self.agent;
        };
        if value < series.value {
            series.start = previous;
        }
        (series.seen, series.value) = (now, value);
        series.start
    }

    fn key(&self, metric: &Metric, labels: &[Label<'_>]) -> u64 {
        let mut hasher = self.hashes.build_hasher();
        metric.name.hash(&mut hasher);
        for label in labels {
            match label {
                Label::Text(text) => text.hash(&mut hasher),
                Label::Number(number) => number.hash(&mut hasher),
                Label::Guid(guid) => guid.hash(&mut hasher),
                Label::Address(address) => address.hash(&mut hasher),
                Label::Vendor(vendor) => vendor.hash(&mut hasher),
                Label::Subscriber(subscriber) => subscriber.hash(&mut hasher),
            }
        }
        hasher.finish()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::catalogue::CATALOGUE;

    #[test]
    fn a_new_or_reset_series_starts_at_the_previous_collection() {
        let [metric, other] = CATALOGUE.first_chunk().unwrap();
        let mut starts = Starts::new(100);
        let points = [Label::Number(0), Label::Text("/points")];
        let imu = [Label::Number(0), Label::Text("/imu")];
        starts.begin(200);
        assert_eq!(starts.start(metric, &points, 5.0), 100, "the first");
        starts.end();
        starts.begin(300);
        assert_eq!(starts.start(metric, &points, 7.0), 100);
        assert_eq!(starts.start(metric, &imu, 1.0), 200, "new");
        assert_eq!(starts.start(other, &points, 1.0), 200, "another metric");
        starts.end();
        starts.begin(400);
        assert_eq!(starts.start(metric, &points, 3.0), 300, "began again");
        starts.end();
        starts.begin(500);
        assert_eq!(starts.start(metric, &imu, 9.0), 400, "gone and back");
        starts.end();
        assert_eq!(starts.series.len(), 1);
    }

    #[test]
    fn series_beyond_the_cap_start_with_the_agent() {
        let [metric, ..] = CATALOGUE else { panic!() };
        let mut starts = Starts::new(100);
        starts.begin(200);
        starts.end();
        starts.begin(300);
        for index in 0..SeriesStarts::CAP as u64 {
            assert_eq!(starts.start(metric, &[Label::Number(index)], 1.0), 200);
        }
        assert_eq!(starts.start(metric, &[Label::Text("late")], 1.0), 100);
        crate::tables::tests::assert_driven::<SeriesStarts>();
    }
}
