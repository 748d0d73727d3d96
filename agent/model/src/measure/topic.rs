//! Topics with their endpoints, watches, and the counts of vanished writers.
//!
//! A topic is a DDS name in one domain; CPU buffer topics of `rmw_fastrtps` belong to their base
//! topic. A topic without endpoints is kept with its counters for a grace period, so that its
//! series show silence instead of disappearing.

use std::collections::{BTreeMap, BTreeSet};
use std::time::Duration;

use foldhash::HashMap;
use ros2probe_wire::discovery::Role;
use ros2probe_wire::{DomainId, Guid, GuidPrefix};

use crate::facts::loss_share::{LossShare, TopicLoss};
use crate::facts::measurement::Measurement;
use crate::facts::model_time::ModelTime;
use crate::facts::names::{DdsName, TypeName};
use crate::facts::naming::Naming;
use crate::facts::selection::{RequestIds, SampleRequest};
use crate::facts::watch::Watchlist;
use crate::graph::discovery::Discovery;
use crate::measure::delivery::Totals;
use crate::measure::expectation::TopicEvaluation;

/// Handle of a topic.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct TopicId(u64);

/// Whether a topic is measured.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Watched {
    /// The topic is neither watched nor requested.
    No,
    /// The topic is measured.
    Yes,
    /// The topic is watched or requested, but the cap is reached.
    Rejected,
}

/// A topic.
#[derive(Debug)]
pub struct Topic {
    /// Domain.
    pub domain_id: DomainId,
    /// Names.
    pub naming: Naming,
    /// Live writers.
    pub writers: Vec<Guid>,
    /// Live readers.
    pub readers: Vec<Guid>,
    /// Writers and readers of its buffer topic.
    pub buffer_endpoints: Vec<Guid>,
    /// Type of the last announced endpoint. It is kept when all endpoints are gone.
    pub last_type: Option<TypeName>,
    /// Whether it is measured.
    pub watched: Watched,
    /// Indices of the watchlist entries that cover it, with the state of each.
    pub judgements: Vec<(usize, TopicEvaluation)>,
    /// Requests for its samples; `None` without any.
    pub requested: Option<RequestIds>,
    /// Counts of writers that are no longer measured.
    pub retired: Option<Box<Measurement>>,
    /// Sums over the deliveries of writers that are no longer measured.
    pub retired_totals: Option<Box<Totals>>,
    /// Losses of its worst subscriber.
    pub loss: TopicLoss,
    /// Time at which a reader last appeared.
    pub reader_appeared: ModelTime,
    /// Time at which the number of its readers last rose from zero.
    pub subscribed: ModelTime,
    /// Time at which it became both published and watched.
    pub published: ModelTime,
    /// Time at which its last endpoint vanished.
    pub vanished: Option<ModelTime>,
    /// Whether an observed process has a publisher or subscription of it, even without an announced
    /// endpoint.
    pub is_held: bool,
    /// Whether one of its endpoints accepted buffers.
    pub has_buffers: bool,
    /// Whether one of its readers announced a content filter.
    pub has_filters: bool,
}

/// The subscriptions of a publisher that accept buffers of other backends than `cpu`.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum Accelerated {
    /// No subscription.
    None,
    /// Some subscriptions; others get messages as a whole.
    Some,
    /// All subscriptions.
    All,
}

/// All topics of all domains.
///
/// Values are boxed: a hash table under churn allocates up to four slots per entry.
#[derive(Debug, Default)]
pub struct Topics {
    topics: HashMap<TopicId, Box<Topic>>,
    index: BTreeMap<(DomainId, DdsName), TopicId>,
    /// Topics without endpoints, by the time at which the last one vanished.
    vanished: BTreeSet<(ModelTime, TopicId)>,
    /// Topics among `vanished` that still count as measured.
    vanished_watched: BTreeSet<(ModelTime, TopicId)>,
    /// Measured topics that are not watched by exact name.
    displaceable: BTreeSet<TopicId>,
    created: u64,
    watched: usize,
    /// Number of times that a watched or requested topic exceeded the cap.
    pub rejected: u64,
    /// Number of vanished topics dropped before their grace period ended.
    pub evictions: u64,
}

impl Topic {
    /// Returns a participant's readers of the topic and then those of its buffer topic, each
    /// sorted.
    pub fn readers_of(&self, prefix: GuidPrefix) -> impl Iterator<Item = Guid> + '_ {
        let lists = [&self.readers, &self.buffer_endpoints].into_iter();
        let own = lists.flat_map(move |list| {
            let start = list.partition_point(|guid| guid.prefix < prefix);
            let own = list.get(start..).unwrap_or_default().iter().copied();
            own.take_while(move |guid| guid.prefix == prefix)
        });
        own.filter(|guid| !guid.entity.is_writer())
    }

    /// Returns the publisher or subscription for which a buffer endpoint carries messages: the one
    /// that it announces, otherwise the one that its participant created last before it
    /// (`rmw_fastrtps_cpp` of Lyrical, `publisher.cpp`).
    #[must_use]
    pub fn base_of(&self, buffer: Guid, announced: Option<Guid>) -> Option<Guid> {
        let list = match buffer.entity.is_writer() {
            true => &self.writers,
            false => &self.readers,
        };
        if let Some(announced) = announced {
            let is_own = announced.prefix == buffer.prefix;
            return list
                .binary_search(&announced)
                .ok()
                .filter(|_| is_own)
                .map(|_| announced);
        }
        let start = list.partition_point(|guid| guid.prefix < buffer.prefix);
        let before = list.partition_point(|guid| *guid < buffer);
        list.get(start..before)?.last().copied()
    }

    /// Returns the buffer endpoints, each with the publisher or subscription to which it belongs.
    pub fn buffers<'a>(
        &'a self,
        discovery: &'a Discovery,
    ) -> impl Iterator<Item = (Guid, Guid)> + 'a {
        self.buffer_endpoints.iter().filter_map(|guid| {
            let announced = discovery.endpoints().get(guid)?.base;
            Some((*guid, self.base_of(*guid, announced)?))
        })
    }

    /// Returns whether no endpoint is left.
    #[must_use]
    pub const fn is_vanished(&self) -> bool {
        self.vanished.is_some()
    }

    /// Adds the counts of a writer that is no longer measured, and the losses of its worst receiver
    /// in this second.
    pub fn retire(
        &mut self,
        measurement: &Measurement,
        totals: Option<&Totals>,
        departed: LossShare,
    ) {
        self.loss.note_departed(departed);
        if let Some(totals) = totals {
            self.retired_totals.get_or_insert_default().add(totals);
        }
        let retired = self.retired.get_or_insert_default();
        retired.add(measurement);
        // A vanished writer sends nothing, so it has no rate.
        (retired.rate_hz, retired.bandwidth) = (0.0, 0.0);
    }
}

impl Topics {
    /// Returns a topic.
    #[must_use]
    pub fn get(&self, id: TopicId) -> Option<&Topic> {
        self.topics.get(&id).map(Box::as_ref)
    }

    /// Returns a topic.
    pub fn get_mut(&mut self, id: TopicId) -> Option<&mut Topic> {
        self.topics.get_mut(&id).map(Box::as_mut)
    }

    /// Returns the topic with this DDS name; for a buffer topic, its base topic.
    #[must_use]
    pub fn find(&self, domain_id: DomainId, naming: &Naming) -> Option<TopicId> {
        self.index
            .get(&(domain_id, naming.dds_name.clone()))
            .copied()
    }

    /// Returns whether there is a topic with this DDS name.
    #[must_use]
    pub fn knows(&self, domain_id: DomainId, dds_name: &str) -> bool {
        self.index.contains_key(&(domain_id, dds_name.into()))
    }

    /// Returns all topics, sorted by domain and DDS name.
    pub fn iter(&self) -> impl Iterator<Item = (TopicId, &Topic)> {
        self.index
            .values()
            .filter_map(|id| Some((*id, &**self.topics.get(id)?)))
    }

    /// Returns all handles, sorted by domain and DDS name.
    #[must_use]
    pub fn ids(&self) -> Vec<TopicId> {
        self.index.values().copied().collect()
    }

    /// Returns the number of topics.
    #[must_use]
    pub fn len(&self) -> usize {
        self.topics.len()
    }

    /// Returns whether there are no topics.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.topics.is_empty()
    }

    /// Returns the number of measured topics.
    #[must_use]
    pub const fn watched(&self) -> usize {
        self.watched
    }

    /// Adds an endpoint. Returns its topic and whether the topic is new.
    pub fn join(
        &mut self,
        domain_id: DomainId,
        naming: &Naming,
        guid: Guid,
        role: Role,
        now: ModelTime,
    ) -> (TopicId, bool) {
        let (id, is_new) = match self.find(domain_id, naming) {
            Some(id) => (id, false),
            None => (self.create(domain_id, naming), true),
        };
        if let Some(topic) = self.topics.get_mut(&id) {
            if let Some(at) = topic.vanished.take() {
                self.vanished.remove(&(at, id));
                self.vanished_watched.remove(&(at, id));
            }
            let list = match role {
                _ if naming.is_buffer => &mut topic.buffer_endpoints,
                Role::Writer => &mut topic.writers,
                Role::Reader => &mut topic.readers,
            };
            if let Err(place) = list.binary_search(&guid) {
                list.insert(place, guid);
            }
            match role {
                Role::Writer if topic.writers.len() == 1 => topic.published = now,
                Role::Writer => {}
                Role::Reader => {
                    topic.reader_appeared = now;
                    if topic.readers.len() == 1 && !naming.is_buffer {
                        topic.subscribed = now;
                    }
                }
            }
        }
        (id, is_new)
    }

    /// Removes an endpoint.
    pub fn leave(&mut self, id: TopicId, guid: Guid, now: ModelTime) {
        let Some(topic) = self.topics.get_mut(&id) else {
            return;
        };
        for list in [
            &mut topic.writers,
            &mut topic.readers,
            &mut topic.buffer_endpoints,
        ] {
            list.retain(|each| *each != guid);
        }
        let is_empty = topic.writers.is_empty()
            && topic.readers.is_empty()
            && topic.buffer_endpoints.is_empty();
        if is_empty && !topic.is_held && topic.vanished.is_none() {
            topic.vanished = Some(now);
            self.vanished.insert((now, id));
            if topic.watched == Watched::Yes {
                self.vanished_watched.insert((now, id));
            }
        }
    }

    /// Keeps a topic of an observed process, even without an endpoint. Returns it and whether it is
    /// new; `None` if there are `cap` topics already.
    pub fn keep_process_topic(
        &mut self,
        domain_id: DomainId,
        naming: &Naming,
        cap: usize,
        now: ModelTime,
    ) -> Option<(TopicId, bool)> {
        let (id, is_new) = match self.find(domain_id, naming) {
            Some(id) => (id, false),
            None => {
                self.shrink(cap.saturating_sub(1));
                if self.topics.len() >= cap {
                    return None;
                }
                (self.create(domain_id, naming), true)
            }
        };
        let topic = self.topics.get_mut(&id)?;
        topic.is_held = true;
        if is_new {
            topic.published = now;
        }
        if let Some(at) = topic.vanished.take() {
            self.vanished.remove(&(at, id));
            self.vanished_watched.remove(&(at, id));
        }
        Some((id, is_new))
    }

    /// Ends [`Self::keep_process_topic`]: the topic vanishes if it has no endpoint.
    pub fn release(&mut self, id: TopicId, now: ModelTime) {
        let Some(topic) = self.topics.get_mut(&id).filter(|topic| topic.is_held) else {
            return;
        };
        topic.is_held = false;
        // No endpoint has this GUID.
        self.leave(id, Guid::default(), now);
    }

    /// Renumbers the watchlist entries: `moved` has the new index for each old one.
    pub fn renumber(&mut self, moved: &[Option<usize>]) {
        for topic in self.topics.values_mut() {
            topic.judgements.retain_mut(|(watch, _)| {
                let place = moved.get(*watch).copied().flatten();
                *watch = place.unwrap_or(*watch);
                place.is_some()
            });
        }
    }

    /// Applies the watchlist and the sample requests to one topic, within the cap. `is_needed`
    /// states whether a configured chain needs the topic. A topic that is watched by exact name
    /// displaces the latest other one, which is returned.
    pub fn apply_lists(
        &mut self,
        id: TopicId,
        (watchlist, sample_requests, is_needed): (&Watchlist, &[SampleRequest], bool),
        cap: usize,
        now: ModelTime,
    ) -> Option<TopicId> {
        let topic = self.topics.get(&id)?;
        let is_named = topic.naming.is_named_by(Some(topic.domain_id), watchlist);
        let covering = topic.naming.covered_by(topic.domain_id, watchlist);
        let requested = RequestIds::of(topic.domain_id, &topic.naming, sample_requests);
        let before = topic.watched;
        let mut displaced = None;
        let after = if covering.is_empty() && requested.is_none() && !is_needed {
            Watched::No
        } else if before == Watched::Yes
            || self.watched < cap
            || self.free_vanished_slot(id, is_named)
        {
            Watched::Yes
        } else {
            displaced = is_named.then(|| self.free_latest_slot()).flatten();
            displaced.map_or(Watched::Rejected, |_| Watched::Yes)
        };
        self.watched += usize::from(after == Watched::Yes);
        self.watched -= usize::from(before == Watched::Yes);
        self.rejected += u64::from(after == Watched::Rejected && before != Watched::Rejected);
        if after == Watched::Yes && !is_named {
            self.displaceable.insert(id);
        } else {
            self.displaceable.remove(&id);
        }
        let topic = self.topics.get_mut(&id)?;
        if after == Watched::Yes && before != Watched::Yes {
            topic.published = now;
            topic.retired.get_or_insert_default();
        }
        topic.watched = after;
        topic.requested = requested.filter(|_| after == Watched::Yes);
        if let Some(at) = topic.vanished {
            match after {
                Watched::Yes => self.vanished_watched.insert((at, id)),
                _ => self.vanished_watched.remove(&(at, id)),
            };
        }
        topic.judgements = match after {
            Watched::Yes => {
                let before = std::mem::take(&mut topic.judgements);
                let judged = |watch| {
                    let known = before.iter().find(|(other, _)| *other == watch);
                    known
                        .copied()
                        .unwrap_or((watch, TopicEvaluation::default()))
                };
                covering.into_iter().map(judged).collect()
            }
            _ => Vec::new(),
        };
        displaced
    }

    /// Drops the measurement of a topic that is no longer measured: constant counters would look
    /// like silence.
    pub fn forget_measurement(&mut self, id: TopicId) {
        if let Some(topic) = self.topics.get_mut(&id) {
            (topic.retired, topic.retired_totals) = (None, None);
            topic.loss = TopicLoss::default();
        }
    }

    /// Returns whether one more topic can be measured: a slot is free, or a vanished topic holds
    /// one.
    #[must_use]
    pub fn has_place(&self, cap: usize) -> bool {
        self.watched < cap || !self.vanished_watched.is_empty()
    }

    /// Removes topics that vanished more than `grace` ago.
    pub fn expire(&mut self, now: ModelTime, grace: Duration) {
        while let Some((at, id)) = self.vanished.first().copied()
            && at + grace <= now
        {
            self.forget(id);
        }
    }

    /// Removes the topics that vanished first until at most `cap` topics are left.
    pub fn shrink(&mut self, cap: usize) {
        while self.topics.len() > cap {
            let Some((_, id)) = self.vanished.first().copied() else {
                return;
            };
            self.forget(id);
            self.evictions += 1;
        }
    }

    fn create(&mut self, domain_id: DomainId, naming: &Naming) -> TopicId {
        self.created += 1;
        let id = TopicId(self.created);
        self.index.insert((domain_id, naming.dds_name.clone()), id);
        self.topics.insert(
            id,
            Box::new(Topic {
                domain_id,
                naming: Naming {
                    is_buffer: false,
                    counts: true,
                    ..naming.clone()
                },
                writers: Vec::new(),
                readers: Vec::new(),
                buffer_endpoints: Vec::new(),
                last_type: None,
                watched: Watched::No,
                judgements: Vec::new(),
                requested: None,
                retired: None,
                retired_totals: None,
                loss: TopicLoss::default(),
                reader_appeared: ModelTime::ZERO,
                subscribed: ModelTime::ZERO,
                published: ModelTime::ZERO,
                vanished: None,
                is_held: false,
                has_buffers: false,
                has_filters: false,
            }),
        );
        id
    }

    /// Frees the slot of the topic that vanished first. A topic watched by exact name keeps its
    /// slot unless the new topic is watched by exact name, too. Returns whether a slot was freed.
    fn free_vanished_slot(&mut self, keep: TopicId, is_named: bool) -> bool {
        let places = || self.vanished_watched.iter().map(|(_, id)| *id);
        let unnamed = places().find(|id| *id != keep && self.displaceable.contains(id));
        let any = || places().find(|id| *id != keep && is_named);
        let Some(id) = unnamed.or_else(any) else {
            return false;
        };
        self.forget(id);
        self.evictions += 1;
        true
    }

    /// Frees the slot of the latest topic that is not watched by exact name, so that topics that
    /// were known before a flood stay.
    fn free_latest_slot(&mut self) -> Option<TopicId> {
        let id = self.displaceable.pop_last()?;
        let topic = self.topics.get_mut(&id)?;
        (topic.watched, topic.requested) = (Watched::Rejected, None);
        topic.judgements.clear();
        self.watched -= 1;
        self.rejected += 1;
        Some(id)
    }

    fn forget(&mut self, id: TopicId) {
        self.displaceable.remove(&id);
        if let Some(topic) = self.topics.remove(&id) {
            self.watched -= usize::from(topic.watched == Watched::Yes);
            if let Some(at) = topic.vanished {
                self.vanished.remove(&(at, id));
                self.vanished_watched.remove(&(at, id));
            }
            self.index.remove(&(topic.domain_id, topic.naming.dds_name));
        }
    }
}

#[cfg(test)]
mod tests;
