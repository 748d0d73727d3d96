//! Topics: what endpoints meet on, who watches, and what its writers that have gone had counted.
//!
//! A topic is a DDS name in one domain; the CPU buffer topics of `rmw_fastrtps` belong to the ROS
//! topic they stand beside. A topic whose last endpoint has gone is kept for a grace period with
//! its counters, so that its silence is seen rather than its series missed.

use std::collections::{BTreeMap, BTreeSet, HashMap};

use ros2probe_wire::discovery::Role;
use ros2probe_wire::{DomainId, Guid, Timestamp};

use super::delivery::Totals;
use super::expectation::Judgement;
use super::measurement::Measurement;
use super::names::{DdsName, TypeName};
use super::naming::Naming;
use super::selection::{RequestIds, SampleRequest};
use super::size::Size;
use crate::watch::Watchlist;

/// Handle of a topic.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct TopicId(u64);

/// Whether a topic is measured.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Watched {
    /// Nobody asked.
    No,
    /// Measured.
    Yes,
    /// Asked for, but the cap is reached.
    Rejected,
}

/// One topic.
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
    /// Writers and readers beside it.
    pub buffer_endpoints: Vec<Guid>,
    /// Type of the endpoint that came last, for when none is left.
    pub last_type: Option<TypeName>,
    /// Whether it is measured.
    pub watched: Watched,
    /// Watchlist entries that cover it, and how it stands with them.
    pub judgements: Vec<(usize, Judgement)>,
    /// Who wants its samples; `None` = nobody.
    pub requested: Option<RequestIds>,
    /// What writers had counted that are measured no more.
    pub retired: Option<Box<Measurement>>,
    /// What had become of their samples.
    pub retired_totals: Option<Box<Totals>>,
    /// When a reader appeared last.
    pub reader_appeared: Timestamp,
    /// Since when it has been both published and watched.
    pub published: Timestamp,
    /// When its last endpoint went.
    pub vanished: Option<Timestamp>,
}

/// All topics of all domains.
///
/// Boxed: a table in which much comes and goes has up to four places for each entry.
#[derive(Debug, Default)]
pub struct Topics {
    topics: HashMap<TopicId, Box<Topic>>,
    index: BTreeMap<(DomainId, DdsName), TopicId>,
    /// Those without endpoints, by the time when the last one went.
    vanished: BTreeSet<(Timestamp, TopicId)>,
    /// Those of them that hold a measuring place.
    vanished_watched: BTreeSet<(Timestamp, TopicId)>,
    /// Those that are measured and not watched by their exact names.
    yielding: BTreeSet<TopicId>,
    created: u64,
    watched: usize,
    /// How often the cap kept out a topic that somebody wanted.
    pub rejected: u64,
    /// Vanished topics given up before their grace period ended.
    pub evictions: u64,
}

impl Topic {
    /// Whether any endpoint is left.
    #[must_use]
    pub const fn is_vanished(&self) -> bool {
        self.vanished.is_some()
    }

    /// Takes over what a writer had counted.
    pub fn retire(&mut self, measurement: &Measurement, totals: Option<&Totals>) {
        if let Some(totals) = totals {
            self.retired_totals.get_or_insert_default().add(totals);
        }
        let retired = self.retired.get_or_insert_default();
        retired.add(measurement);
        // What is gone sends no more.
        (retired.rate_hz, retired.bandwidth) = (0.0, 0.0);
    }
}

impl Topics {
    /// One topic.
    #[must_use]
    pub fn get(&self, id: TopicId) -> Option<&Topic> {
        self.topics.get(&id).map(Box::as_ref)
    }

    /// One topic.
    pub fn get_mut(&mut self, id: TopicId) -> Option<&mut Topic> {
        self.topics.get_mut(&id).map(Box::as_mut)
    }

    /// The topic of this DDS name, or of the topic it stands beside.
    #[must_use]
    pub fn find(&self, domain_id: DomainId, naming: &Naming) -> Option<TopicId> {
        self.index
            .get(&(domain_id, naming.dds_name.clone()))
            .copied()
    }

    /// All, by domain and DDS name.
    pub fn iter(&self) -> impl Iterator<Item = (TopicId, &Topic)> {
        self.index
            .values()
            .filter_map(|id| Some((*id, &**self.topics.get(id)?)))
    }

    /// All handles, by domain and DDS name.
    #[must_use]
    pub fn ids(&self) -> Vec<TopicId> {
        self.index.values().copied().collect()
    }

    /// Entries and cap of every table; there may be as many topics as endpoints.
    #[must_use]
    pub fn sizes(&self, endpoints: usize, measured: usize, watches: usize) -> Vec<Size> {
        // A new table does not compile before it has a place here.
        let Self {
            topics,
            index,
            vanished,
            vanished_watched,
            yielding,
            created: _,
            watched,
            rejected: _,
            evictions: _,
        } = self;
        let lists = |topic: &Topic| {
            let Topic {
                domain_id: _,
                naming: _,
                writers,
                readers,
                buffer_endpoints,
                last_type: _,
                watched: _,
                judgements,
                requested: _,
                retired: _,
                retired_totals: _,
                reader_appeared: _,
                published: _,
                vanished: _,
            } = topic;
            let members = writers.len() + readers.len() + buffer_endpoints.len();
            (members, judgements.len())
        };
        let each = || topics.values().map(|topic| lists(topic));
        let members = each().map(|(members, _)| members).max().unwrap_or(0);
        let judgements = each().map(|(_, judgements)| judgements).max().unwrap_or(0);
        vec![
            Size::new("topic.members", members, endpoints),
            Size::new("topic.judgements", judgements, watches),
            Size::new("topics.topics", topics.len(), endpoints),
            Size::new("topics.index", index.len(), endpoints),
            Size::new("topics.vanished", vanished.len(), endpoints),
            Size::new("topics.vanished_watched", vanished_watched.len(), measured),
            Size::new("topics.yielding", yielding.len(), measured),
            Size::new("topics.watched", *watched, measured),
        ]
    }

    /// How many.
    #[must_use]
    pub fn len(&self) -> usize {
        self.topics.len()
    }

    /// Whether there is none.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.topics.is_empty()
    }

    /// How many are measured.
    #[must_use]
    pub const fn watched(&self) -> usize {
        self.watched
    }

    /// Adds an endpoint; gives its topic and whether the topic is new.
    pub fn join(
        &mut self,
        domain_id: DomainId,
        naming: &Naming,
        guid: Guid,
        role: Role,
        now: Timestamp,
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
                Role::Reader => topic.reader_appeared = now,
            }
        }
        (id, is_new)
    }

    /// Takes an endpoint away.
    pub fn leave(&mut self, id: TopicId, guid: Guid, now: Timestamp) {
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
        if is_empty && topic.vanished.is_none() {
            topic.vanished = Some(now);
            self.vanished.insert((now, id));
            if topic.watched == Watched::Yes {
                self.vanished_watched.insert((now, id));
            }
        }
    }

    /// Watchlist entries stand elsewhere from now on: `moved` has the new place for each old one.
    pub fn renumber(&mut self, moved: &[Option<usize>]) {
        for topic in self.topics.values_mut() {
            topic.judgements.retain_mut(|(watch, _)| {
                let place = moved.get(*watch).copied().flatten();
                *watch = place.unwrap_or(*watch);
                place.is_some()
            });
        }
    }

    /// Asks the watchlist and the sample requests about one topic, within the cap. One that is
    /// watched by its exact name takes the place of the latest of the others, which is returned.
    pub fn apply_lists(
        &mut self,
        id: TopicId,
        watchlist: &Watchlist,
        sample_requests: &[SampleRequest],
        cap: usize,
        now: Timestamp,
    ) -> Option<TopicId> {
        let topic = self.topics.get(&id)?;
        let is_named = topic.naming.is_named_by(Some(topic.domain_id), watchlist);
        let covering = topic.naming.covered_by(topic.domain_id, watchlist);
        let requested = RequestIds::of(topic.domain_id, &topic.naming, sample_requests);
        let before = topic.watched;
        let mut displaced = None;
        let after = if covering.is_empty() && requested.is_none() {
            Watched::No
        } else if before == Watched::Yes
            || self.watched < cap
            || self.give_up_vanished(id, is_named)
        {
            Watched::Yes
        } else {
            displaced = is_named.then(|| self.displace()).flatten();
            displaced.map_or(Watched::Rejected, |_| Watched::Yes)
        };
        self.watched += usize::from(after == Watched::Yes);
        self.watched -= usize::from(before == Watched::Yes);
        self.rejected += u64::from(after == Watched::Rejected && before != Watched::Rejected);
        if after == Watched::Yes && !is_named {
            self.yielding.insert(id);
        } else {
            self.yielding.remove(&id);
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
                    known.copied().unwrap_or((watch, Judgement::default()))
                };
                covering.into_iter().map(judged).collect()
            }
            _ => Vec::new(),
        };
        displaced
    }

    /// Forgets what was measured of a topic that is measured no more: numbers that stand still
    /// would look like silence.
    pub fn forget_measurement(&mut self, id: TopicId) {
        if let Some(topic) = self.topics.get_mut(&id) {
            (topic.retired, topic.retired_totals) = (None, None);
        }
    }

    /// Whether one more topic can be measured: a place is free, or a vanished topic has it.
    #[must_use]
    pub fn has_place(&self, cap: usize) -> bool {
        self.watched < cap || !self.vanished_watched.is_empty()
    }

    /// Forgets topics that vanished longer than `grace` ago.
    pub fn expire(&mut self, now: Timestamp, grace: u64) {
        while let Some((at, id)) = self.vanished.first().copied()
            && at.0.saturating_add(grace) <= now.0
        {
            self.forget(id);
        }
    }

    /// Forgets the topics that vanished first until at most `cap` are left, as far as that goes.
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
                reader_appeared: Timestamp(0),
                published: Timestamp(0),
                vanished: None,
            }),
        );
        id
    }

    /// Frees the measuring place of the topic that vanished first; one that is watched by its exact
    /// name keeps it, unless the newcomer is, too.
    fn give_up_vanished(&mut self, keep: TopicId, is_named: bool) -> bool {
        let places = || self.vanished_watched.iter().map(|(_, id)| *id);
        let unnamed = places().find(|id| *id != keep && self.yielding.contains(id));
        let any = || places().find(|id| *id != keep && is_named);
        let Some(id) = unnamed.or_else(any) else {
            return false;
        };
        self.forget(id);
        self.evictions += 1;
        true
    }

    /// Takes its measuring place from the latest topic that is not watched by its exact name: what
    /// was there before a flood stays.
    fn displace(&mut self) -> Option<TopicId> {
        let id = self.yielding.pop_last()?;
        let topic = self.topics.get_mut(&id)?;
        (topic.watched, topic.requested) = (Watched::Rejected, None);
        topic.judgements.clear();
        self.watched -= 1;
        self.rejected += 1;
        Some(id)
    }

    fn forget(&mut self, id: TopicId) {
        self.yielding.remove(&id);
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
