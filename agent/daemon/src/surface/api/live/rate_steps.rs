//! Sums of steps, which become the small charts of the page.

use std::collections::BTreeMap;

use super::super::history::thousandths;
use ros2probe_api::live::{History, Rates};

/// Length of a step, in seconds.
pub(in super::super) const STEP_SECONDS: u32 = 10;
/// Maximum number of steps.
pub(in super::super) const MAX_STEPS: u32 = 60;

/// Sums of each step: of all topics together, and the messages and seconds of each topic.
#[derive(Debug)]
pub(in super::super) struct RateSteps {
    totals: [Vec<f64>; 3],
    topics: BTreeMap<u32, Vec<Option<(u32, u32)>>>,
}

/// What a topic adds to a step.
#[derive(Clone, Copy, Debug)]
pub(in super::super) struct Part {
    pub(in super::super) messages: u32,
    pub(in super::super) bytes: f64,
    pub(in super::super) lost: u32,
    /// Measured time, in seconds.
    pub(in super::super) seconds: u32,
}

impl RateSteps {
    /// Creates the sums of this number of steps.
    pub(in super::super) fn new(steps: usize) -> Self {
        Self {
            totals: [(); 3].map(|()| vec![0.0; steps]),
            topics: BTreeMap::new(),
        }
    }

    /// Adds a part to a step. A topic without a number counts in the totals alone.
    pub(in super::super) fn add(&mut self, step: usize, topic: Option<u32>, part: Part) {
        let [messages, bytes, lost] = &mut self.totals;
        for (column, value) in [
            (&mut *messages, f64::from(part.messages)),
            (bytes, part.bytes),
            (lost, f64::from(part.lost)),
        ] {
            if let Some(sum) = column.get_mut(step) {
                *sum += value;
            }
        }
        let Some(topic) = topic else { return };
        let steps = messages.len();
        let column = self.topics.entry(topic);
        let column = column.or_insert_with(|| vec![None; steps]);
        if let Some(sums) = column.get_mut(step) {
            let (messages, seconds) = sums.get_or_insert((0, 0));
            *messages = messages.saturating_add(part.messages);
            *seconds = seconds.saturating_add(part.seconds);
        }
    }

    /// Returns the line. Each step has the time of its end, and its length in seconds.
    pub(in super::super) fn history(self, steps: impl Iterator<Item = (f64, f64)>) -> History {
        let [mut messages, mut bytes, lost] = self.totals;
        let mut times = Vec::new();
        for (place, (end, length)) in steps.enumerate() {
            times.push(end);
            if let (Some(messages), Some(bytes)) = (messages.get_mut(place), bytes.get_mut(place)) {
                *messages = thousandths(*messages / length);
                *bytes = (*bytes / length).round();
            }
        }
        let rate = |(messages, seconds): (u32, u32)| {
            thousandths(f64::from(messages) / f64::from(seconds.max(1)))
        };
        let topics = self.topics.into_iter().map(|(topic, steps)| {
            let steps = steps.into_iter().map(|step| step.map(rate));
            Rates(topic, steps.collect())
        });
        History {
            step_seconds: STEP_SECONDS,
            t: times,
            totals: [messages, bytes, lost],
            topics: topics.collect(),
        }
    }
}
