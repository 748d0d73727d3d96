//! Sums per topic over all processes.
//!
//! Every report adds its new counts, so a total never decreases when a process ends.

use std::collections::{BTreeMap, VecDeque};
use std::sync::Arc;
use std::time::Duration;

use ros2probe_wire::DomainId;
use ros2probe_wire::names::DdsTopic;

use super::source::{Choice, Seen, Source};
use super::witness::Witness;
use crate::facts::bounded::Bounded;
use crate::facts::calls::facts::{TopicCounts, TopicInside};
use crate::facts::calls::report::Durations;
use crate::facts::diagnosis::TopicKey;
use crate::facts::measurement::Measurement;
use crate::facts::model_time::ModelTime;
use crate::facts::names::TopicName;
use crate::facts::naming::Naming;
use crate::facts::rate::{SECONDS, Slot};
use crate::facts::tables::{InsideTopicSums, TopicTotals};
use crate::measure::topic::TopicId;

/// All topics that have handles in observed processes, or had one within the grace period.
#[derive(Debug, Default)]
pub(super) struct InsideTopics {
    topics: Bounded<InsideTopicSums, BTreeMap<(DomainId, TopicName), InsideTopic>>,
    /// Number of topics dropped or refused because of the cap.
    pub(super) evictions: u64,
}

/// One topic.
#[derive(Debug)]
pub(super) struct InsideTopic {
    pub(super) naming: Naming,
    counts: TopicCounts,
    messages: u64,
    witness: Witness,
    last: Option<ModelTime>,
    latency: Arc<Durations>,
    waiting: Arc<Durations>,
    /// Messages lost in queues of subscriptions; `None` before any queue was evaluated.
    lost_in_queues: Option<u64>,
    /// Times and totals of the last reports.
    past: Bounded<TopicTotals, VecDeque<(ModelTime, u64)>>,
    live: Live,
    choice: Choice,
    /// Its id among the topics of the graph, if known.
    pub(super) id: Option<TopicId>,
    /// Time of the last report with a handle of this topic.
    seen: ModelTime,
}

/// Handles of a topic at the last report.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Live {
    pub(super) publishers: usize,
    /// Subscriptions that take from the middleware, and buffers.
    pub(super) subscriptions: usize,
    /// Callbacks for messages of the same process.
    pub(super) receivers: usize,
    pub(super) depth: u64,
}

/// Counts that a report adds to a topic.
#[derive(Debug, Default)]
pub(super) struct TopicAdded {
    pub(super) counts: TopicCounts,
    /// Maximum number of messages that one subscription took.
    pub(super) taken_by_one: u64,
    pub(super) last: Option<ModelTime>,
    pub(super) latency: Option<Durations>,
    pub(super) waiting: Option<Durations>,
}

impl InsideTopics {
    /// Returns all topics.
    pub(super) fn iter_mut(
        &mut self,
    ) -> impl Iterator<Item = (&(DomainId, TopicName), &mut InsideTopic)> {
        self.topics.iter_mut()
    }

    /// Returns a topic.
    pub(super) fn get(&self, domain_id: DomainId, name: &TopicName) -> Option<&InsideTopic> {
        self.topics.get(&(domain_id, name.clone()))
    }

    /// Adds the figures of a report. The handles of all topics are counted again afterwards.
    pub(super) fn add(&mut self, key: &(DomainId, TopicName), added: TopicAdded, at: ModelTime) {
        if !self.topics.contains_key(key) {
            let dds_name = match key.1.starts_with('/') {
                true => format!("rt{}", key.1),
                false => key.1.to_string(),
            };
            let Ok(dds_topic) = DdsTopic::parse(&dds_name) else {
                return;
            };
            if !self.has_room() {
                self.topics.refuse();
                self.evictions += 1;
                return;
            }
            let topic = InsideTopic {
                naming: Naming::of(&dds_topic),
                counts: TopicCounts::default(),
                messages: 0,
                witness: Witness::default(),
                last: None,
                latency: Arc::default(),
                waiting: Arc::default(),
                lost_in_queues: None,
                past: Bounded::default(),
                live: Live::default(),
                choice: Choice::default(),
                id: None,
                seen: at,
            };
            self.topics.insert(key.clone(), topic);
        }
        if let Some(topic) = self.topics.get_mut(key) {
            topic.add(added);
        }
    }

    /// Records the live handles, and the totals at `at`.
    pub(super) fn turn(&mut self, live: &BTreeMap<(DomainId, TopicName), Live>, at: ModelTime) {
        for (key, topic) in &mut self.topics {
            topic.messages += topic.witness.turn(false);
            topic.live = live.get(key).copied().unwrap_or_default();
            if live.contains_key(key) {
                topic.seen = at;
            }
            while topic
                .past
                .get(1)
                .is_some_and(|(time, _)| at - *time >= Duration::from_secs(SECONDS))
            {
                topic.past.pop_front();
            }
            topic.past.push_back((at, topic.messages));
        }
    }

    /// Adds messages lost in the queues of subscriptions. A count of 0 marks the queues as
    /// evaluated.
    pub(super) fn add_queue_losses(&mut self, key: &(DomainId, TopicName), lost: u64) {
        if let Some(topic) = self.topics.get_mut(key) {
            *topic.lost_in_queues.get_or_insert_default() += lost;
        }
    }

    /// Forgets all handles; the totals remain for the grace period.
    pub(super) fn end(&mut self) {
        for topic in self.topics.values_mut() {
            topic.live = Live::default();
            topic.past.clear();
        }
    }

    /// Removes topics without a handle for longer than `grace`.
    pub(super) fn expire(&mut self, now: ModelTime, grace: Duration) {
        self.topics
            .retain(|_, topic| topic.is_live() || topic.seen + grace > now);
    }

    /// Returns whether an entry is free. If necessary, drops the topic whose last handle ended
    /// first.
    fn has_room(&mut self) -> bool {
        if !self.topics.is_full() {
            return true;
        }
        let ended = self.topics.iter().filter(|(_, topic)| !topic.is_live());
        let oldest = ended.min_by_key(|(_, topic)| topic.seen);
        let Some(key) = oldest.map(|(key, _)| key.clone()) else {
            return false;
        };
        self.evictions += 1;
        self.topics.remove(&key).is_some()
    }
}

impl Live {
    /// Returns the number of subscriptions. The buffer or subscription of a callback may be
    /// unknown, so the larger count applies.
    const fn subscriptions(&self) -> usize {
        if self.subscriptions > self.receivers {
            self.subscriptions
        } else {
            self.receivers
        }
    }
}

impl InsideTopic {
    fn add(&mut self, added: TopicAdded) {
        let TopicCounts {
            published,
            within_process,
            taken,
            failed,
            enqueued,
            overwritten,
            dequeued,
            receptions,
        } = added.counts;
        self.counts.published += published;
        self.counts.within_process += within_process;
        self.counts.taken += taken;
        self.counts.failed += failed;
        self.counts.enqueued += enqueued;
        self.counts.overwritten += overwritten;
        self.counts.dequeued += dequeued;
        self.counts.receptions += receptions;
        self.messages += published;
        self.witness.take(published, added.taken_by_one);
        if published.max(added.taken_by_one) > 0 {
            self.last = self.last.max(added.last);
        }
        if let Some(latency) = added.latency {
            Arc::make_mut(&mut self.latency).merge(&latency);
        }
        if let Some(waiting) = added.waiting {
            Arc::make_mut(&mut self.waiting).merge(&waiting);
        }
    }

    /// Returns whether an observed process has a publisher or subscription of the topic.
    pub(super) const fn is_live(&self) -> bool {
        self.live.publishers + self.live.subscriptions() > 0
    }

    /// Returns the numbers of live publishers and of live subscriptions.
    pub(super) const fn endpoints(&self) -> (usize, usize) {
        (self.live.publishers, self.live.subscriptions())
    }

    /// Returns the topic's identity.
    pub(super) fn key(&self, domain_id: DomainId) -> TopicKey {
        TopicKey::of(domain_id, &self.naming)
    }

    /// Returns where the topic's counts come from.
    pub(super) const fn source(&self) -> Source {
        self.choice.source()
    }

    /// Chooses the source; `wire` is `None` if the network does not measure the topic.
    pub(super) fn choose(&mut self, wire: Option<Seen>) {
        let inside = Seen {
            messages: self.messages,
            last: self.last,
        };
        self.choice.choose(wire, inside);
    }

    /// Replaces the values that the source determines in the sum over the topic's writers.
    pub(super) fn apply(&self, sum: &mut Measurement) {
        sum.messages = self.choice.messages(sum.messages, self.messages);
        if self.source() == Source::Inside {
            sum.rate_hz = self.rate();
            sum.bandwidth = 0.0;
            sum.last_message = sum.last_message.max(self.last);
        }
    }

    /// Returns the time of the last message.
    pub(super) const fn last(&self) -> Option<ModelTime> {
        self.last
    }

    /// Returns the messages of about the last `seconds` and the number of these seconds, which is
    /// lower if reports began later.
    #[expect(
        clippy::cast_precision_loss,
        clippy::cast_possible_truncation,
        clippy::cast_sign_loss,
        reason = "counts of ten seconds are far below 2^52"
    )]
    pub(super) fn recent(&self, seconds: u64) -> (Slot, u64) {
        let Some((end, total)) = self.past.back() else {
            return (Slot::default(), 0);
        };
        let is_in = |(at, _): &&(ModelTime, u64)| *end - *at >= Duration::from_secs(seconds);
        let begin = self.past.iter().rev().find(is_in).or(self.past.front());
        let Some((begin, before)) = begin else {
            return (Slot::default(), 0);
        };
        let span = (*end - *begin).as_secs_f64();
        if span < 0.5 {
            return (Slot::default(), 0);
        }
        let whole = (span.round() as u64).min(seconds);
        let messages = (total - before) as f64 / span * whole as f64;
        let slot = Slot {
            messages: messages.round() as u64,
            ..Slot::default()
        };
        (slot, whole)
    }

    /// Returns the messages per second of the last window.
    #[expect(
        clippy::cast_precision_loss,
        reason = "counts of ten seconds are far below 2^52"
    )]
    fn rate(&self) -> f64 {
        let (Some((begin, before)), Some((end, total))) = (self.past.front(), self.past.back())
        else {
            return 0.0;
        };
        let span = (*end - *begin).as_secs_f64();
        if span > 0.0 {
            (total - before) as f64 / span
        } else {
            0.0
        }
    }

    /// Returns the facts for a snapshot.
    pub(super) fn facts(&self) -> TopicInside {
        TopicInside {
            counts: self.counts,
            messages: self.messages,
            rate_hz: self.rate(),
            last: self.last,
            publishers: self.live.publishers,
            subscriptions: self.live.subscriptions(),
            depth: self.live.depth,
            latency: Arc::clone(&self.latency),
            waiting: Arc::clone(&self.waiting),
            lost_in_queues: self.lost_in_queues,
        }
    }
}

/// Evidence about a topic whose counts come from inside.
#[derive(Clone, Copy, Debug)]
pub struct Evidence<'a>(pub(super) &'a InsideTopic);

impl Evidence<'_> {
    /// Returns the numbers of live publishers and subscriptions.
    #[must_use]
    pub const fn endpoints(&self) -> (usize, usize) {
        self.0.endpoints()
    }

    /// Returns the time of the last message.
    #[must_use]
    pub const fn last_message(&self) -> Option<ModelTime> {
        self.0.last()
    }

    /// Returns the counts of the last seconds, and the number of these seconds.
    #[must_use]
    pub fn recent(&self, seconds: u64) -> (Slot, u64) {
        self.0.recent(seconds)
    }
}
