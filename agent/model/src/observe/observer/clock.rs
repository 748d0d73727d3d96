//! Decisions that depend on time: leases, windows, gaps, expectations and diagnosis.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::Duration;

use ros2probe_wire::record::Verdict;
use ros2probe_wire::time::SECOND;
use ros2probe_wire::{Guid, Timestamp};

use super::MAX_CLOCK_STEP;
use super::Observer;
use super::TICK;
use crate::facts::diagnosis;
use crate::facts::event::{EventKind, MAX_TEXT, bounded_finding, truncated};
use crate::facts::loss_share::LossShare;
use crate::facts::measurement::Measurement;
use crate::facts::model_time::ModelTime;
use crate::facts::rate::Slot;
use crate::facts::route::Receiver;
use crate::facts::watch::WatchState;
use crate::measure::expectation::Evidence;
use crate::measure::receivers::Graph;
use crate::measure::sampled::Sampled;
use crate::report::transport::is_polled;

/// Number of a topic's readers that are examined for each writer that seems silent.
const EXAMINED_READERS: usize = 64;

impl Observer {
    /// Advances the time: expires leases, settles gaps, evaluates expectations.
    pub(super) fn advance(&mut self, now: ModelTime) {
        if self.clock == ModelTime::ZERO || now - self.clock > MAX_CLOCK_STEP {
            self.clock = now.round_down(TICK);
            self.tick(self.clock);
        }
        while now - self.clock >= TICK {
            self.clock = self.clock + TICK;
            self.tick(self.clock);
        }
    }

    /// Returns the time of the next decision that may become output: a whole second or the end of a
    /// lease. A timer of a writer becomes output only if it may end the wait for a requested
    /// sample.
    #[must_use]
    pub fn next_decision(&self) -> Timestamp {
        if !self.requested.sample_requests.is_empty() {
            return self.next_due();
        }
        let second = ModelTime::of_second(self.clock.whole_seconds() + 1);
        let second = self.graph.wall_clock.wall_time(second);
        self.next_expiry().map_or(second, |end| end.min(second))
    }

    /// Returns the earliest time at which [`Self::tick`] has an effect without further input.
    #[must_use]
    pub fn next_due(&self) -> Timestamp {
        let second = ModelTime::of_second(self.clock.whole_seconds() + 1);
        let due = match self.measure.payloads.unsettled().is_empty() {
            true => self.measure.profiler.next_due(&self.graph).min(second),
            false => self.clock,
        };
        let due = due.round_up(TICK).max(self.clock + TICK);
        let due = self.graph.wall_clock.wall_time(due);
        self.next_expiry().map_or(due, |end| end.min(due))
    }

    /// Returns the earliest end of a participant's lease, unless further packets renew it. Leases
    /// are checked at multiples of an interval, even if they end immediately.
    #[must_use]
    pub fn next_expiry(&self) -> Option<Timestamp> {
        let end = self.graph.discovery.next_expiry()?;
        let end = end.round_up(TICK);
        Some(self.graph.wall_clock.wall_time(end.max(self.clock + TICK)))
    }

    /// Makes all open decisions at the end of the input, without elapsed time.
    pub(super) fn settle(&mut self) {
        let graph = &self.graph;
        self.measure
            .profiler
            .settle(self.clock, &mut self.journal, graph);
        self.dispatch_waiting();
        self.end_second_of_losses();
        self.report_losses();
        self.settle_chains();
        self.examine(self.clock);
    }

    /// Determines the loss of each measured topic's worst subscriber in the last second.
    fn end_second_of_losses(&mut self) {
        for id in self.graph.topics.ids() {
            let Some(topic) = self.graph.topics.get_mut(id) else {
                continue;
            };
            let Some(retired) = &topic.retired else {
                continue;
            };
            let mut unreached = retired.loss;
            let mut subscribers: BTreeMap<Receiver, (LossShare, LossShare)> = BTreeMap::new();
            for writer in topic.writers.iter().chain(&topic.buffer_endpoints) {
                let Some(measured) = self.measure.profiler.get_mut(*writer) else {
                    continue;
                };
                unreached.add(measured.writer.share());
                let Some(receivers) = &mut measured.subscribers else {
                    continue;
                };
                topic.loss.note_departed(receivers.take_departed());
                for (receiver, recent) in receivers.losses() {
                    let (window, last) = subscribers.entry(receiver).or_default();
                    window.add(recent.window());
                    last.add(recent.last());
                }
            }
            let mut counted = Measurement {
                messages: unreached.expected - unreached.lost,
                ..Measurement::default()
            };
            self.derive
                .inside
                .apply(topic.domain_id, &topic.naming, &mut counted);
            unreached.expected = unreached.lost + counted.messages;
            topic.loss.end_second(subscribers.into_values(), unreached);
        }
    }

    /// Reports the losses of the last second.
    fn report_losses(&mut self) {
        let graph = &self.graph;
        let discovery = &graph.discovery;
        self.journal.events.end_bursts(|burst| {
            if let Some(endpoint) = discovery.endpoints().get(&burst.writer) {
                burst.topic = Some((endpoint.domain_id, endpoint.topic.bounded(MAX_TEXT)));
            }
            let node = discovery.node_of(graph.base_of(burst.writer));
            burst.node = node.map(|node| node.name.bounded(MAX_TEXT));
        });
    }

    pub(super) fn tick(&mut self, now: ModelTime) {
        self.graph.discovery.advance(now, &mut self.journal);
        self.apply_discovery_changes(now);
        let graph = &self.graph;
        let unknown_writers = self.measure.profiler.advance(now, &mut self.journal, graph);
        for guid in unknown_writers.metered {
            self.requested.interest.set(guid, Verdict::Meter);
        }
        for guid in unknown_writers.forgotten {
            self.requested.interest.remove(guid);
        }
        self.report_missing();
        for writer in self.measure.payloads.unsettled() {
            self.turn(writer, now);
        }
        if now.nanoseconds().is_multiple_of(SECOND) {
            self.measure.links.end_second(now);
            self.measure.tls.end_second(now, &self.graph.discovery);
            self.measure.payloads.expire(now);
            for writer in self.measure.latched.advance(now) {
                self.apply_lists_to_latched(writer, now);
            }
            self.end_second_of_clocks(now);
            let graph = &self.graph;
            let is_hidden = |writer| is_hidden(graph, writer);
            let events = &mut self.journal.events;
            for writer in self.derive.robot.end_second(now, is_hidden, events) {
                self.apply_lists_to_latched(writer, now);
            }
            let profiler = &self.measure.profiler;
            self.measure.payloads.retain_unknown_writers(|writer| {
                let known = profiler.get(writer);
                known.is_some_and(|known| known.topic.is_none())
            });
            self.graph.topics.expire(now, self.settings.topic_grace);
            self.link_sessions();
            self.end_unreachable_sessions(now);
            self.graph.receivers.remove_unknown(&self.graph.discovery);
            self.graph
                .discovery
                .update_locality(|prefix| self.graph.receivers.is_local(prefix));
            self.settle_inside(now);
            self.assign_free_slots();
            self.read_refused_writers(now);
            self.end_second_of_losses();
            self.judge(now);
            self.advance_calls(now);
            self.advance_chains(now);
            self.report_losses();
            self.examine(now);
            self.derive.tracer.advance(now);
        }
    }

    pub(super) fn examine(&mut self, now: ModelTime) {
        let before = Arc::clone(self.derive.examiner.current());
        self.derive.examiner.examine(
            &self.graph.discovery,
            &self.graph.topics,
            &self.derive.services,
            (
                &self.derive.inside,
                &self.derive.chains,
                &self.measure.links,
            ),
            (&self.derive.robot, &self.derive.clocks, &self.derive.stamps),
            now,
        );
        let after = self.derive.examiner.current();
        if Arc::ptr_eq(&before, after) {
            return;
        }
        for change in diagnosis::changes(&before.list, &after.list) {
            let (resolved, finding) = match change {
                diagnosis::Change::Appeared(finding) | diagnosis::Change::Changed(finding) => {
                    (false, finding)
                }
                diagnosis::Change::Resolved(finding) => (true, finding),
            };
            let finding = bounded_finding(finding);
            let kind = EventKind::Diagnosis { resolved, finding };
            self.journal.events.push(now, kind);
        }
    }

    /// Evaluates every watched topic under every entry that covers it.
    pub(super) fn judge(&mut self, now: ModelTime) {
        for id in self.graph.topics.ids() {
            let Some(topic) = self.graph.topics.get(id) else {
                continue;
            };
            if topic.judgements.is_empty() {
                continue;
            }
            let writers: Vec<_> = topic
                .writers
                .iter()
                .chain(&topic.buffer_endpoints)
                .filter_map(|guid| self.measure.profiler.get(*guid))
                .collect();
            let last_message = writers
                .iter()
                .filter_map(|each| each.writer.last_message())
                .max();
            let retired = topic
                .retired
                .as_ref()
                .and_then(|retired| retired.last_message);
            let recent = |seconds: u64| {
                let (mut sum, mut longest) = (Slot::default(), 0);
                for each in &writers {
                    let (slot, seconds) = each.writer.recent(now, seconds);
                    sum.add(&slot);
                    longest = seconds.max(longest);
                }
                if writers.len() > 1 {
                    // Messages of other writers may fall into the gaps of one writer.
                    sum.longest_interval = 0.0;
                }
                (sum, longest)
            };
            let inside = self.derive.inside.evidence(topic.domain_id, &topic.naming);
            let (publishers, subscriptions) = inside.map_or((0, 0), |inside| inside.endpoints());
            let seen_inside = inside.and_then(|inside| inside.last_message());
            let recent: &dyn Fn(u64) -> (Slot, u64) = match &inside {
                Some(inside) => &|seconds| inside.recent(seconds),
                None => &recent,
            };
            let seeming_silence = |slowest| {
                let polled = writers.iter();
                let longest = polled.map(|each| each.writer.max_unseen_time(slowest));
                let longest = longest.max().unwrap_or_default();
                let is_unseen = |guid: &&Guid| {
                    let known = self.measure.profiler.get(**guid);
                    known.is_none_or(|each| each.writer.is_unseen())
                };
                let mut unseen = topic.writers.iter().filter(is_unseen);
                match unseen.any(|guid| is_polled(&self.graph.discovery, *guid, &topic.readers)) {
                    true => longest.max(Sampled::max_unseen_time_of_new_writer(slowest)),
                    false => longest,
                }
            };
            let seeming_silence: &dyn Fn(Duration) -> Duration = match &inside {
                Some(_) => &|_| Duration::ZERO,
                None => &seeming_silence,
            };
            let last_message = last_message.max(retired).max(seen_inside);
            let evidence = Evidence {
                now,
                publishers: topic.writers.len().max(publishers),
                subscriptions: topic.readers.len().max(subscriptions),
                last_message,
                max_unseen_time: seeming_silence,
                since: topic.published,
                observed: topic.published.max(topic.subscribed).max(self.view_began),
                recent,
                loss: topic.loss.window,
            };
            let mut judgements = topic.judgements.clone();
            for (index, judgement) in &mut judgements {
                let Some(watch) = self.requested.watchlist.watches().get(*index) else {
                    continue;
                };
                let changed = judgement.judge(&watch.expectations, &evidence);
                let Some(from) = changed else { continue };
                let to = judgement.state();
                let (domain_id, name) = (topic.domain_id, &topic.naming.name);
                let kind = EventKind::Expectation {
                    domain_id,
                    topic: name.bounded(MAX_TEXT),
                    watch: truncated(&watch.pattern).into(),
                    from,
                    to,
                    violations: judgement.violations(),
                };
                self.journal.events.push(now, kind);
                if to == WatchState::Silent {
                    let kind = EventKind::Silence {
                        domain_id,
                        topic: name.bounded(MAX_TEXT),
                        watch: truncated(&watch.pattern).into(),
                        last_message: last_message.map(|at| self.graph.wall_clock.wall_time(at)),
                    };
                    self.journal.events.push(now, kind);
                }
            }
            if let Some(topic) = self.graph.topics.get_mut(id) {
                topic.judgements = judgements;
            }
        }
    }
}

/// Returns whether all messages of a writer pass through shared memory, according to its first
/// readers.
fn is_hidden(graph: &Graph, writer: Guid) -> bool {
    let topic = graph
        .discovery
        .endpoints()
        .get(&writer)
        .and_then(|endpoint| {
            let id = graph.topics.find(endpoint.domain_id, &endpoint.naming()?)?;
            graph.topics.get(id)
        });
    topic.is_some_and(|topic| {
        let readers = topic.readers.get(..EXAMINED_READERS);
        is_polled(&graph.discovery, writer, readers.unwrap_or(&topic.readers))
    })
}

#[cfg(test)]
mod tests;
