//! Applies the watchlist and the sample requests: the topics that they select are measured.

use std::sync::Arc;

use ros2probe_wire::discovery::Role;
use ros2probe_wire::qos::{Durability, Reliability};
use ros2probe_wire::record::Verdict;
use ros2probe_wire::{Guid, RtpsDuration, SequenceNumber};

use super::MAX_MATCHES_PER_ROUND;
use super::Observer;
use super::graph;
use crate::derive::trace::share::Share;
use crate::facts::dispatch::{self, Offered};
use crate::facts::header::begins_with_header;
use crate::facts::model_time::ModelTime;
use crate::facts::selection::SampleRequest;
use crate::facts::topic_kind::TopicKind;
use crate::facts::watch::{Retain, Watch, Watchlist};
use crate::graph::discovery::Endpoint;
use crate::measure::latched::LatchedTopic;
use crate::measure::topic::{Topic, TopicId, Watched};
use crate::measure::writer::Traits;

impl Observer {
    /// Replaces the watchlist. It takes effect once [`Self::apply_more_lists`] has visited all
    /// topics. Counts of a topic that is no longer watched stay, as do the states of unchanged
    /// entries.
    pub(super) fn set_watchlist(&mut self, watchlist: Arc<Watchlist>) {
        let before = std::mem::replace(&mut self.watchlist, watchlist);
        let moved = |watch: &Arc<Watch>| {
            let place = self.watchlist.position(&watch.pattern, watch.domain_id)?;
            let after = self.watchlist.watches().get(place)?;
            (after.expectations == watch.expectations).then_some(place)
        };
        let moved: Vec<_> = before.watches().iter().map(moved).collect();
        self.topics.renumber(&moved);
        self.discovery.watch(Arc::clone(&self.watchlist));
        let watches = self.watchlist.watches();
        self.tracer
            .restart(watches.iter().any(|watch| watch.trace > 0.0));
        self.apply_lists_to_all();
    }

    /// Applies the lists to every topic again.
    pub(super) fn apply_lists_to_all(&mut self) {
        let is_watched = |id: &TopicId| {
            let topic = self.topics.get(*id);
            topic.is_some_and(|topic| topic.watched == Watched::Yes)
        };
        let (watched, others): (Vec<_>, Vec<_>) =
            self.topics.ids().into_iter().partition(is_watched);
        // Free measuring slots first, then assign them.
        self.pending_topics = others.into_iter().rev().collect();
        self.pending_topics.extend(watched.into_iter().rev());
        self.apply_more_lists();
    }

    /// Applies the lists to further topics, as many as take a few milliseconds. The previous
    /// decision holds for a topic until its turn. Returns whether all topics are done.
    pub fn apply_more_lists(&mut self) -> bool {
        if self.has_applied_lists() {
            return true;
        }
        let requested = |request: &SampleRequest| {
            request.selection.globs().count() + request.selection.regexes()
        };
        let patterns =
            self.watchlist.globs() + self.sample_requests.iter().map(requested).sum::<usize>();
        for _ in 0..(MAX_MATCHES_PER_ROUND / patterns.max(1)).max(1) {
            let Some(id) = self.pending_topics.pop() else {
                break;
            };
            self.apply_lists(id, self.clock);
        }
        self.has_applied_lists()
    }

    /// Returns whether the lists were applied to all topics since they last changed.
    #[must_use]
    pub const fn has_applied_lists(&self) -> bool {
        self.pending_topics.is_empty()
    }

    /// Applies the lists to a topic and its endpoints.
    pub(super) fn apply_lists(&mut self, id: TopicId, now: ModelTime) {
        let is_needed = self.topics.get(id).is_some_and(|topic| {
            let dds_name = &topic.naming.dds_name;
            self.chains.needs(topic.domain_id, dds_name)
        });
        let displaced = self.topics.apply_lists(
            id,
            (&self.watchlist, &self.sample_requests, is_needed),
            self.settings.topics,
            now,
        );
        self.chains.changed();
        if let Some(id) = displaced {
            self.apply_all(id, now);
            self.topics.forget_measurement(id);
        }
        self.apply_all(id, now);
    }

    /// Applies the decision about a topic to its endpoints.
    fn apply_all(&mut self, id: TopicId, now: ModelTime) {
        let Some(topic) = self.topics.get(id) else {
            return;
        };
        let lists = [&topic.writers, &topic.readers, &topic.buffer_endpoints];
        let guids: Vec<_> = lists.into_iter().flatten().copied().collect();
        for guid in guids {
            self.apply(id, guid, now);
        }
    }

    /// Applies the decision about a topic to one endpoint.
    pub(super) fn apply(&mut self, id: TopicId, guid: Guid, now: ModelTime) {
        let Some(topic) = self.topics.get(id) else {
            return;
        };
        let Some(endpoint) = self.discovery.endpoints().get(&guid) else {
            return;
        };
        let is_watched = topic.watched == Watched::Yes;
        match endpoint.role {
            Role::Reader if is_watched => self.interest.set(guid, Verdict::Meter),
            Role::Reader => self.interest.remove(guid),
            Role::Writer => {
                let counts = endpoint.naming().is_some_and(|naming| naming.counts);
                let measured = is_watched && counts;
                let is_call = self.services.announce(guid, topic.domain_id, &topic.naming);
                match self.latched_topic(topic, endpoint, is_watched) {
                    Some(about) if counts => self.latched.follow(guid, about),
                    _ => self.latched.forget(guid),
                }
                let latched = self.latched.verdict(guid);
                let verdict = match topic.naming.kind {
                    TopicKind::Discovery => Verdict::Capture,
                    _ if measured && wants_bytes(topic) => Verdict::Capture,
                    _ if is_call || latched == Some(Verdict::Capture) => Verdict::Capture,
                    _ if measured => Verdict::Meter,
                    _ => latched.unwrap_or(Verdict::Ignore),
                };
                self.interest.set(guid, verdict);
                match &topic.requested {
                    Some(requested) if measured => {
                        let topic = published(topic, endpoint);
                        let known = self.profiler.get(guid);
                        let next = known.map_or(SequenceNumber::ZERO, |known| known.writer.next());
                        self.payloads.want(guid, topic, requested, (next, now));
                    }
                    _ => self.payloads.release(guid, now),
                }
                if measured {
                    if topic.naming.kind.is_service() {
                        self.services.note_measured();
                    }
                    let (traits, opened) = (traits(guid, endpoint), topic.reader_appeared);
                    self.profiler.measure(guid, id, traits, opened, now);
                } else {
                    self.retire(guid, now);
                }
            }
        }
    }

    /// Applies the decision about its topic to a writer whose last message is kept.
    pub(super) fn apply_again(&mut self, writer: Guid, now: ModelTime) {
        let endpoint = self.discovery.endpoints().get(&writer);
        let id = endpoint.and_then(|endpoint| {
            let naming = endpoint.naming()?;
            self.topics.find(endpoint.domain_id, &naming)
        });
        if let Some(id) = id {
            self.apply(id, writer, now);
        }
    }

    /// Returns the topic of a writer whose last message is kept; `None` for other writers. Messages
    /// that expire, as those of `/rosout`, are kept only if a watch requests them.
    fn latched_topic(
        &self,
        topic: &Topic,
        endpoint: &Endpoint,
        is_watched: bool,
    ) -> Option<LatchedTopic> {
        let (kind, qos) = (topic.naming.kind, &endpoint.qos);
        if qos.durability == Durability::VOLATILE
            || kind.is_service()
            || kind == TopicKind::Discovery
        {
            return None;
        }
        let watch = |place: usize| self.watchlist.watches().get(place);
        let mut watches = topic
            .judgements
            .iter()
            .filter_map(|(place, _)| watch(*place));
        let asks = is_watched && watches.any(|watch| watch.retain == Retain::Last);
        let is_default = self.settings.keeps_latched && qos.lifespan == RtpsDuration::Infinite;
        (asks || is_default).then(|| LatchedTopic {
            topic: Arc::new(published(topic, endpoint)),
            has_header: begins_with_header(&endpoint.message_type),
            is_watched: asks,
        })
    }

    /// Stops measuring this writer; its topic keeps the counts.
    pub(super) fn retire(&mut self, guid: Guid, now: ModelTime) {
        let graph = graph!(self);
        let Some(retired) = self.profiler.stop(guid, now, &mut self.journal, graph) else {
            return;
        };
        self.report_missing();
        if let Some(topic) = self.topics.get_mut(retired.topic) {
            topic.retire(
                &retired.measurement,
                retired.totals.as_ref(),
                retired.departed,
            );
        }
    }

    /// Assigns free measuring slots, and those of vanished topics, to rejected topics.
    pub(super) fn promote(&mut self) {
        if !self.topics.has_place(self.settings.topics) {
            return;
        }
        let rejected = self
            .topics
            .iter()
            .filter(|(_, topic)| topic.watched == Watched::Rejected && !topic.is_vanished());
        let rejected: Vec<_> = rejected.map(|(id, _)| id).collect();
        for id in rejected {
            if !self.topics.has_place(self.settings.topics) {
                return;
            }
            self.apply_lists(id, self.clock);
        }
    }
}

/// Returns whether a subscription requests the payloads of the topic.
pub(super) fn wants_bytes(topic: &Topic) -> bool {
    let requested = topic.requested.as_ref();
    requested.is_some_and(|requested| !requested.payloads.is_empty())
}

/// Returns the share of a measured topic's messages that is traced: the largest of its watches.
pub(super) fn traced_share(topic: &Topic, watchlist: &Watchlist) -> Option<Share> {
    if topic.watched != Watched::Yes {
        return None;
    }
    let watch = |index: &usize| watchlist.watches().get(*index);
    let covering = topic.judgements.iter();
    let ratios = covering.filter_map(|(index, _)| Some(watch(index)?.trace));
    Share::of(ratios.fold(0.0, f64::max))
}

/// Returns a topic as one of its writers announces it.
fn published(topic: &Topic, endpoint: &Endpoint) -> dispatch::Topic {
    dispatch::Topic {
        domain_id: topic.domain_id,
        name: topic.naming.name.clone(),
        dds_name: topic.naming.dds_name.clone(),
        message_type: endpoint.message_type.clone(),
        offered: Some(Arc::new(Offered {
            type_hash: endpoint.type_hash,
            qos: endpoint.qos.clone(),
        })),
    }
}

pub(super) fn traits(guid: Guid, endpoint: &Endpoint) -> Traits {
    Traits {
        // TCP repeats for Zenoh, unseen: a missing number will not arrive.
        reliable: !guid.prefix.is_zenoh() && endpoint.qos.reliability == Reliability::RELIABLE,
        keeps_history: endpoint.qos.durability != Durability::VOLATILE,
        has_header: begins_with_header(&endpoint.message_type),
    }
}
