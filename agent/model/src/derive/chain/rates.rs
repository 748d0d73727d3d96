//! Rates of measured topics, for the comparison of a node's output with its inputs.

use crate::facts::model_time::ModelTime;
use crate::facts::rate::{SECONDS, Slot};
use crate::measure::profiler::Profiler;
use crate::measure::topic::{TopicId, Topics};

/// Minimum number of messages for a comparison of rates.
const MIN_MESSAGES: u64 = 20;

/// The numbers of messages of the last seconds.
pub(super) struct Rates<'a> {
    topics: &'a Topics,
    profiler: &'a Profiler,
    now: ModelTime,
}

impl<'a> Rates<'a> {
    pub(super) const fn new(topics: &'a Topics, profiler: &'a Profiler, now: ModelTime) -> Self {
        Self {
            topics,
            profiler,
            now,
        }
    }

    /// Returns whether the rates of both topics differ by at most 5 %, or one message. Returns
    /// `false` if either topic has fewer than [`MIN_MESSAGES`] messages.
    pub(super) fn are_equal(&self, one: TopicId, other: TopicId) -> bool {
        let (one, other) = (self.messages(one), self.messages(other));
        one.min(other) >= MIN_MESSAGES && one.abs_diff(other) <= (one.max(other) / 20).max(1)
    }

    fn messages(&self, id: TopicId) -> u64 {
        let topic = self.topics.get(id);
        let lists = topic.map(|topic| [&topic.writers, &topic.buffer_endpoints]);
        let writers = lists.into_iter().flatten().flatten();
        let measured = writers.filter_map(|writer| self.profiler.get(*writer));
        let recent = measured.map(|each| each.writer.recent(self.now, SECONDS));
        let mut sum = Slot::default();
        recent.for_each(|(slot, _)| sum.add(&slot));
        sum.messages
    }
}
