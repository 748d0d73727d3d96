//! Applies the watchlist and the sample requests: the topics that they select are measured.

use std::collections::BTreeMap;
use std::sync::Arc;

use ros2probe_wire::discovery::Role;
use ros2probe_wire::qos::{Durability, Reliability};
use ros2probe_wire::record::Verdict;
use ros2probe_wire::{Guid, RtpsDuration, SequenceNumber};

use super::MAX_MATCHES_PER_ROUND;
use super::Observer;
use super::references::Reference;
use crate::derive::trace::share::Share;
use crate::facts::dispatch::{self, Offered};
use crate::facts::header::begins_with_header;
use crate::facts::model_time::ModelTime;
use crate::facts::selection::SampleRequest;
use crate::facts::topic_kind::TopicKind;
use crate::facts::watch::{Retain, Watch, Watchlist};
use crate::graph::discovery::Endpoint;
use crate::measure::latched::LatchedTopic;
use crate::measure::receivers::MatchedReaders;
use crate::measure::topic::{Accelerated, Topic, TopicId, Watched};
use crate::measure::writer::Traits;

/// Maximum number of publishers of a topic whose references to buffers may count.
const MAX_PUBLISHERS: usize = 64;
/// End of the name of a buffer topic with whole messages; the others have references.
const CPU_TOPIC: &str = "/_buf_cpu";

impl Observer {
    /// Replaces the watchlist. It takes effect once `Input::MoreLists` has visited all
    /// topics. Counts of a topic that is no longer watched stay, as do the states of unchanged
    /// entries.
    pub(super) fn set_watchlist(&mut self, watchlist: Arc<Watchlist>) {
        let before = std::mem::replace(&mut self.requested.watchlist, watchlist);
        let moved = |watch: &Arc<Watch>| {
            let place = self
                .requested
                .watchlist
                .position(&watch.pattern, watch.domain_id)?;
            let after = self.requested.watchlist.watches().get(place)?;
            (after.expectations == watch.expectations).then_some(place)
        };
        let moved: Vec<_> = before.watches().iter().map(moved).collect();
        self.graph.topics.renumber(&moved);
        self.graph
            .discovery
            .watch(Arc::clone(&self.requested.watchlist));
        let watches = self.requested.watchlist.watches();
        self.derive
            .tracer
            .restart(watches.iter().any(|watch| watch.trace > 0.0));
        self.apply_lists_to_all();
    }

    /// Applies the lists to every topic again.
    pub(super) fn apply_lists_to_all(&mut self) {
        let is_watched = |id: &TopicId| {
            let topic = self.graph.topics.get(*id);
            topic.is_some_and(|topic| topic.watched == Watched::Yes)
        };
        let (watched, others): (Vec<_>, Vec<_>) =
            self.graph.topics.ids().into_iter().partition(is_watched);
        // Free measuring slots first, then assign them.
        self.requested.pending_topics = others.into_iter().rev().collect();
        self.requested
            .pending_topics
            .extend(watched.into_iter().rev());
        self.apply_more_lists();
    }

    /// Applies the lists to as many further topics as take a few milliseconds. Until then, the
    /// previous decision about a topic is valid.
    pub(super) fn apply_more_lists(&mut self) {
        if self.has_applied_lists() {
            return;
        }
        let requested = |request: &SampleRequest| {
            request.selection.globs().count() + request.selection.regexes()
        };
        let patterns = self.requested.watchlist.globs()
            + self
                .requested
                .sample_requests
                .iter()
                .map(requested)
                .sum::<usize>();
        for _ in 0..(MAX_MATCHES_PER_ROUND / patterns.max(1)).max(1) {
            let Some(id) = self.requested.pending_topics.pop() else {
                break;
            };
            self.apply_lists(id, self.clock);
        }
    }

    /// Returns whether the lists were applied to all topics since they last changed.
    #[must_use]
    pub const fn has_applied_lists(&self) -> bool {
        self.requested.pending_topics.is_empty()
    }

    /// Applies the lists to a topic and its endpoints.
    pub(super) fn apply_lists(&mut self, id: TopicId, now: ModelTime) {
        let is_needed = self.graph.topics.get(id).is_some_and(|topic| {
            let dds_name = &topic.naming.dds_name;
            self.derive.chains.needs(topic.domain_id, dds_name)
        });
        let displaced = self.graph.topics.apply_lists(
            id,
            (
                &self.requested.watchlist,
                &self.requested.sample_requests,
                is_needed,
            ),
            self.settings.topics,
            now,
        );
        self.derive.chains.changed();
        if let Some(id) = displaced {
            self.apply_all(id, now);
            self.graph.topics.forget_measurement(id);
        }
        self.apply_all(id, now);
    }

    /// Applies the decision about a topic to its endpoints.
    fn apply_all(&mut self, id: TopicId, now: ModelTime) {
        let Some(topic) = self.graph.topics.get(id) else {
            return;
        };
        let lists = [&topic.writers, &topic.readers, &topic.buffer_endpoints];
        let guids: Vec<_> = lists.into_iter().flatten().copied().collect();
        for guid in guids {
            self.apply(id, guid, now, false);
        }
    }

    /// Determines again which writers of a topic send references to buffers, after a change of its
    /// endpoints.
    pub(super) fn find_references(&mut self, id: TopicId) {
        let (graph, discovery) = (&self.graph, &self.graph.discovery);
        let Some(topic) = graph.topics.get(id).filter(|topic| topic.has_buffers) else {
            return;
        };
        let backends = |guid: &Guid| discovery.endpoints().get(guid)?.backends.as_ref();
        let publishers = topic.writers.iter().filter(|guid| backends(guid).is_some());
        let publishers = publishers.take(MAX_PUBLISHERS).map(|guid| {
            let readers = MatchedReaders::new(graph, Some(topic), *guid);
            (*guid, readers.accelerated())
        });
        let publishers: BTreeMap<_, _> = publishers.collect();
        // With Zenoh, a publisher itself sends references.
        let own = publishers.keys().filter(|guid| guid.prefix.is_zenoh());
        let mut senders: Vec<_> = own.map(|guid| (*guid, *guid)).collect();
        for (buffer, publisher) in topic.buffers(discovery) {
            let endpoint = discovery.endpoints().get(&buffer);
            let is_whole = endpoint.is_none_or(|endpoint| endpoint.topic.ends_with(CPU_TOPIC));
            if buffer.entity.is_writer() && !is_whole {
                senders.push((buffer, publisher));
            }
        }
        for (writer, publisher) in senders {
            let accelerated = publishers.get(&publisher).copied();
            let reference = Reference {
                publisher,
                accelerated: accelerated.unwrap_or(Accelerated::Some),
            };
            self.references.set(writer, reference);
        }
    }

    /// Applies the decision about a topic to one endpoint. `is_new`: it was announced just now.
    pub(super) fn apply(&mut self, id: TopicId, guid: Guid, now: ModelTime, is_new: bool) {
        let Some(topic) = self.graph.topics.get(id) else {
            return;
        };
        let Some(endpoint) = self.graph.discovery.endpoints().get(&guid) else {
            return;
        };
        let is_watched = topic.watched == Watched::Yes;
        match endpoint.role {
            Role::Reader if is_watched => self.requested.interest.set(guid, Verdict::Meter),
            Role::Reader => self.requested.interest.remove(guid),
            Role::Writer => {
                let counts = endpoint.naming().is_some_and(|naming| naming.counts);
                let measured = is_watched;
                let is_call = self
                    .derive
                    .services
                    .announce(guid, topic.domain_id, &topic.naming);
                match self.latched_topic(topic, endpoint, is_watched) {
                    Some(about) if counts => self.measure.latched.follow(guid, about),
                    _ => self.measure.latched.forget(guid),
                }
                let latched = self.measure.latched.verdict(guid);
                let (robot, parts) = (&mut self.derive.robot, self.settings.robot);
                let (domain_id, name) = (topic.domain_id, &topic.naming.name);
                match robot.reading(name, &endpoint.message_type, parts) {
                    Some(reading) if counts => robot.follow(guid, (domain_id, name), reading),
                    _ => robot.forget(guid),
                }
                let is_read = self.derive.robot.is_captured(guid);
                let verdict = match topic.naming.kind {
                    TopicKind::Discovery => Verdict::Capture,
                    _ if measured && counts && needs_payload(topic) => Verdict::Capture,
                    _ if is_call || is_read || latched == Some(Verdict::Capture) => {
                        Verdict::Capture
                    }
                    _ if measured => Verdict::Meter,
                    _ => latched.unwrap_or(Verdict::Ignore),
                };
                self.requested.interest.set(guid, verdict);
                match &topic.requested {
                    Some(requested) if measured && counts => {
                        let topic = published(topic, endpoint);
                        let known = self.measure.profiler.get(guid);
                        let next = known.map_or(SequenceNumber::ZERO, |known| known.writer.next());
                        self.measure.payloads.start_writer(
                            guid,
                            topic,
                            requested,
                            (next, now),
                            is_new,
                        );
                    }
                    _ => self.measure.payloads.release(guid, now),
                }
                if measured {
                    if topic.naming.kind.is_service() {
                        self.derive.services.note_measured();
                    }
                    let (traits, opened) = (traits(guid, endpoint), topic.reader_appeared);
                    let profiler = &mut self.measure.profiler;
                    if profiler.measure(guid, id, traits, opened, now) {
                        let journal = &mut self.journal;
                        profiler.deliver_earlier(guid, now, journal, &self.graph);
                    }
                } else {
                    self.retire(guid, now);
                }
            }
        }
    }

    /// Applies the decision about its topic to a writer whose last message is kept.
    pub(super) fn apply_lists_to_latched(&mut self, writer: Guid, now: ModelTime) {
        let endpoint = self.graph.discovery.endpoints().get(&writer);
        let id = endpoint.and_then(|endpoint| {
            let naming = endpoint.naming()?;
            self.graph.topics.find(endpoint.domain_id, &naming)
        });
        if let Some(id) = id {
            self.apply(id, writer, now, false);
        }
    }

    /// Reads the writers of standard types that were refused while their table was full, as far as
    /// there is room now.
    pub(super) fn read_refused_writers(&mut self, now: ModelTime) {
        if !self.derive.robot.may_retry() {
            return;
        }
        self.derive.robot.retry();
        let (robot, parts) = (&self.derive.robot, self.settings.robot);
        let endpoints = self.graph.discovery.endpoints();
        let mut candidates = Vec::new();
        for (id, topic) in self.graph.topics.iter() {
            for guid in topic.writers.iter().chain(&topic.buffer_endpoints) {
                let endpoint = endpoints.get(guid).filter(|endpoint| {
                    let naming = endpoint.naming();
                    endpoint.role == Role::Writer && naming.is_some_and(|naming| naming.counts)
                });
                let reading = endpoint.and_then(|endpoint| {
                    robot.reading(&topic.naming.name, &endpoint.message_type, parts)
                });
                candidates.extend(reading.map(|reading| (id, *guid, reading)));
            }
        }
        for (id, guid, reading) in candidates {
            if self.derive.robot.has_place_for(guid, reading) {
                self.apply(id, guid, now, false);
            }
        }
    }

    /// Returns the topic of a writer whose last message is kept; `None` for other writers. Messages
    /// that expire, such as those of `/rosout`, are kept only if a watch requests them.
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
        let watch = |place: usize| self.requested.watchlist.watches().get(place);
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
        let graph = &self.graph;
        let Some(retired) = self
            .measure
            .profiler
            .stop(guid, now, &mut self.journal, graph)
        else {
            return;
        };
        self.report_missing();
        if let Some(topic) = self.graph.topics.get_mut(retired.topic) {
            topic.retire(
                &retired.measurement,
                retired.totals.as_ref(),
                retired.departed,
            );
        }
    }

    /// Assigns free measuring slots, and those of vanished topics, to rejected topics.
    pub(super) fn assign_free_slots(&mut self) {
        if !self.graph.topics.has_place(self.settings.topics) {
            return;
        }
        let rejected = self
            .graph
            .topics
            .iter()
            .filter(|(_, topic)| topic.watched == Watched::Rejected && !topic.is_vanished());
        let rejected: Vec<_> = rejected.map(|(id, _)| id).collect();
        for id in rejected {
            if !self.graph.topics.has_place(self.settings.topics) {
                return;
            }
            self.apply_lists(id, self.clock);
        }
    }
}

/// Returns whether a subscription requests the payloads of the topic.
pub(super) fn needs_payload(topic: &Topic) -> bool {
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
            equivalence_hash: endpoint.equivalence_hash,
            qos: endpoint.qos.clone(),
        })),
    }
}

pub(super) fn traits(guid: Guid, endpoint: &Endpoint) -> Traits {
    Traits {
        // The agent does not see TCP retransmissions of Zenoh, so a missing number never arrives.
        reliable: !guid.prefix.is_zenoh() && endpoint.qos.reliability == Reliability::RELIABLE,
        keeps_history: endpoint.qos.durability != Durability::VOLATILE,
        has_header: begins_with_header(&endpoint.message_type),
    }
}
