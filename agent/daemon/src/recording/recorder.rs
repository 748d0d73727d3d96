//! One recording: samples in, a bag and a report out.
//!
//! A recorder has no thread and no clock. Its owner feeds it from a subscription or from an agent's
//! stream, and times are part of the items. The first error of the storage ends the recording.
//! Earlier samples are in the bag, and missing ones are counted.

mod unrecorded;

use std::collections::{BTreeMap, BTreeSet, HashMap};
use std::sync::Arc;
use std::time::Duration;

use ros2probe_wire::qos::Qos;
use ros2probe_wire::{Guid, SequenceNumber, Timestamp};

use super::disk_quota::DiskQuota;
use super::filter::{Candidate, Filter};
use super::graph::{DiscoveredTopic, GraphSnapshot, PublishedTopic};
use super::report::{add_missed, add_paused, add_written, custom_data, take_back};
use super::sample_ring::SampleRing;
use crate::subscriptions::line::qos;
use crate::subscriptions::{Item, Missed, Topic};
use crate::tables::{RecordedNames, RecordedTopics, RecordedWriters, RecordingWriters};
use ros2probe_api::recording_report::{NO_SUBSCRIBER, Report};
use ros2probe_api::recordings::FilterOptions;
use ros2probe_bag::{
    Compressed, Error, FileCompression, Schema, Summary, TopicDescription, TopicId, Writer,
};
use ros2probe_model::facts::bounded::{Bounded, Sum};
use ros2probe_model::facts::dispatch::{Offered, Sample};
use ros2probe_model::report::snapshot::Transport;

/// Interval of writes to the operating system, by the time of samples. A killed process loses at
/// most one interval.
const FLUSH_INTERVAL: Duration = Duration::from_secs(1);
/// Interval of syncs to disk. A power failure loses at most one interval.
const SYNC_INTERVAL: Duration = Duration::from_secs(5);

/// Sources of facts that samples do not contain.
pub struct Sources<'a> {
    /// Returns the current announcements about the named topics, in the order of the names.
    pub announced: Box<Announcements<'a>>,
    /// Returns the current graph of all domains.
    pub graph: Box<dyn FnMut() -> GraphSnapshot + Send + 'a>,
    /// Returns the schema of a type, by its name and announced hash.
    pub schema: Box<Schemas<'a>>,
}

/// Returns announcements about several topics in one call, since each request may take long.
pub type Announcements<'a> = dyn FnMut(&[String]) -> Vec<DiscoveredTopic> + Send + 'a;

/// Returns the schema of a type, by its name and announced hash.
pub type Schemas<'a> = dyn FnMut(&str, Option<&str>) -> Option<Schema> + Send + 'a;

/// A bag in progress.
pub struct Recorder<'a> {
    writer: Writer,
    domain_id: u32,
    /// Counts at the start.
    before: Baseline,
    filter: Filter,
    sources: Sources<'a>,
    topics: Bounded<RecordedTopics, HashMap<String, TopicDecision>>,
    /// Bytes of the names and types of `topics`.
    names: Sum<RecordedNames>,
    /// Number of writers of all topics.
    writers: Sum<RecordingWriters>,
    /// Topics in the bag, in order.
    order: Vec<String>,
    report: Report,
    sampled: BTreeSet<String>,
    paused: bool,
    /// In snapshot mode: samples in memory that wait for a request.
    ring: Option<SampleRing>,
    /// Quota of disk usage.
    quota: Option<DiskQuota>,
    flushed: Timestamp,
    synced: Timestamp,
}

/// Counts at the start: messages of topics in other domains, and of unannounced writers.
#[derive(Default)]
struct Baseline {
    topics: HashMap<(u32, String), u64>,
    unknown_writers: HashMap<String, u64>,
}

/// Decision about a topic.
enum TopicDecision {
    /// The topic is in the bag.
    Recorded(Box<RecordedTopic>),
    /// The filter excludes the topic.
    Excluded,
    /// The filter selects the topic, but the recording has reached a cap.
    NoRoom,
    /// A loss precedes the first message, and the topic has several types or none. The type of the
    /// first message counts.
    Untyped {
        /// Whether the filter selects the topic by what is known.
        is_selected: bool,
    },
}

/// Where messages of a topic go.
enum Placed<'r> {
    /// Into the bag.
    At(&'r mut RecordedTopic),
    /// The recording selects the topic, whose type is known with its first message.
    Later,
    /// The topic is not recorded.
    Nowhere,
}

struct RecordedTopic {
    id: TopicId,
    description: TopicDescription,
    /// Offered QoS of each publisher, sorted by GUID, for the description.
    offered: Bounded<RecordedWriters, Vec<(String, Qos)>>,
    /// Sequence number of the first recorded sample of each writer.
    first: Bounded<RecordedWriters, HashMap<Guid, SequenceNumber>>,
}

/// Result of a recording.
#[derive(Debug)]
pub struct Finished {
    /// Summary of the bag, if it could be completed.
    pub summary: Option<Summary>,
    /// Recorded and missing messages.
    pub report: Report,
    /// Error of the storage; the bag is complete up to the error.
    pub error: Option<Error>,
}

impl<'a> Recorder<'a> {
    /// Creates a recorder of topics that `filter` selects in one domain, into the bag of `writer`.
    /// `before` is the graph before the first sample.
    #[must_use]
    pub fn new(
        writer: Writer,
        filter: Filter,
        domain_id: u32,
        before: GraphSnapshot,
        sources: Sources<'a>,
    ) -> Self {
        let GraphSnapshot {
            topics,
            unknown_writers,
        } = before;
        let topics = topics.into_iter();
        let topics = topics.filter(|topic| topic.domain_id != domain_id);
        let topics = topics.filter_map(|topic| {
            let messages = topic.messages?;
            Some(((topic.domain_id, topic.name), messages))
        });
        Self {
            before: Baseline {
                topics: topics.collect(),
                unknown_writers,
            },
            domain_id,
            writer,
            filter,
            sources,
            topics: Bounded::default(),
            names: Sum::default(),
            writers: Sum::default(),
            order: Vec::new(),
            report: Report::default(),
            sampled: BTreeSet::new(),
            paused: false,
            ring: None,
            quota: None,
            flushed: Timestamp(0),
            synced: Timestamp(0),
        }
    }

    /// Keeps the last samples in memory, and writes them on [`Self::snapshot`].
    #[must_use]
    pub fn with_ring(self, ring: SampleRing) -> Self {
        Self {
            ring: Some(ring),
            ..self
        }
    }

    /// Makes the recording end with an error when the quota is exhausted.
    #[must_use]
    pub fn with_quota(self, quota: DiskQuota) -> Self {
        Self {
            quota: Some(quota),
            ..self
        }
    }

    /// Writes the samples in memory. Does nothing without snapshot mode.
    ///
    /// # Errors
    ///
    /// Fails if the storage fails.
    pub fn snapshot(&mut self) -> Result<(), Error> {
        let waiting: Vec<_> = self.ring.iter_mut().flat_map(SampleRing::drain).collect();
        // A pause concerns the messages during it, which are not in memory.
        let paused = std::mem::replace(&mut self.paused, false);
        let written = waiting.iter().try_for_each(|sample| self.write(sample));
        self.paused = paused;
        written?;
        self.writer.flush()
    }

    /// Returns the report so far.
    #[must_use]
    pub const fn report(&self) -> &Report {
        &self.report
    }

    /// Returns the selected and published topics of `graph` that have no message yet for a known
    /// reason. The values are the reasons, as in [`Report::unobserved_topics`].
    #[must_use]
    pub fn unobserved_topics(&self, graph: &GraphSnapshot) -> BTreeMap<String, String> {
        let topics = graph.topics.iter();
        let topics =
            topics.filter(|topic| topic.domain_id == self.domain_id && self.is_selected(topic));
        let topics = topics.filter_map(|topic| {
            let recorded = self.report.topics.get(&topic.name);
            if recorded.is_some_and(|topic| topic.messages > 0 || topic.paused > 0) {
                return None;
            }
            let why = match &topic.other_transport {
                _ if !topic.subscribed => NO_SUBSCRIBER.to_owned(),
                // Every message is captured, so nothing was sent.
                Some(transport)
                    if topic.is_exact && transport == Transport::SharedMemory.label() =>
                {
                    return None;
                }
                other_transport => other_transport.clone()?,
            };
            Some((topic.name.clone(), why))
        });
        topics.collect()
    }

    /// Returns the options of the selection.
    #[must_use]
    pub const fn options(&self) -> &FilterOptions {
        self.filter.options()
    }

    /// Returns whether this topic would be recorded, regardless of its domain.
    #[must_use]
    pub fn is_selected(&self, topic: &PublishedTopic) -> bool {
        self.filter.is_selected(&Candidate {
            name: &topic.name,
            types: &topic.message_types,
            published: true,
            subscribed: topic.subscribed,
        })
    }

    /// Returns the topics with messages sampled in shared memory.
    #[must_use]
    pub const fn sampled(&self) -> &BTreeSet<String> {
        &self.sampled
    }

    /// Iterates over the topics in the bag, in order of their addition.
    pub fn topics(&self) -> impl Iterator<Item = &str> {
        self.order.iter().map(String::as_str)
    }

    /// Returns the writer of the bag.
    #[must_use]
    pub const fn writer(&self) -> &Writer {
        &self.writer
    }

    /// Returns whether the recording is paused.
    #[must_use]
    pub const fn is_paused(&self) -> bool {
        self.paused
    }

    /// Pauses or resumes the recording.
    pub const fn pause(&mut self, paused: bool) {
        self.paused = paused;
    }

    /// Continues in a new file.
    ///
    /// # Errors
    ///
    /// Fails if the storage fails.
    pub fn split(&mut self) -> Result<(), Error> {
        self.writer.split()
    }

    /// Returns complete files to compress on another thread.
    pub fn take_compressions(&mut self) -> Vec<FileCompression> {
        self.writer.take_file_compressions()
    }

    /// Records that a file is compressed.
    ///
    /// # Errors
    ///
    /// Fails if the storage fails.
    pub fn compressed(&mut self, done: &Compressed) -> Result<(), Error> {
        self.writer.compressed(done)
    }

    /// Adds topics to the bag by name and types, even if no message follows. A topic of several
    /// types is left to its first message: a subscriber may have announced another type than the
    /// publishers.
    ///
    /// # Errors
    ///
    /// Fails if the storage fails.
    pub fn declare<'t, T: AsRef<str> + 't>(
        &mut self,
        topics: impl IntoIterator<Item = (&'t str, &'t [T])>,
    ) -> Result<(), Error> {
        let topics = topics.into_iter().filter_map(|(name, types)| match types {
            [only] if !self.topics.contains_key(name) => Some((name, only.as_ref())),
            _ => None,
        });
        let topics: Vec<(&str, &str)> = topics.collect();
        let names: Vec<String> = topics.iter().map(|(name, _)| (*name).to_owned()).collect();
        let announced = self.discover(&names);
        for ((name, message_type), announced) in topics.into_iter().zip(announced) {
            let place = self.decide(name, message_type, None, &announced, false)?;
            // Other topics are decided again later, since they may be published or fit by then.
            if matches!(place, TopicDecision::Recorded(_)) {
                self.store_decision(name, place);
            }
        }
        Ok(())
    }

    /// Processes an item of the subscription.
    ///
    /// # Errors
    ///
    /// Fails if the storage fails; [`Self::finish`] completes the bag nevertheless.
    pub fn take(&mut self, item: &Item) -> Result<(), Error> {
        match item {
            Item::Sample(sample) if sample.payload.is_none() => Ok(()),
            Item::Sample(sample) => match &mut self.ring {
                Some(ring) if !self.paused => {
                    ring.push(Arc::clone(sample));
                    Ok(())
                }
                _ => self.write(sample),
            },
            Item::Clock(now) => self.clock(*now),
            Item::Missed(missed) => {
                if self.paused {
                    return Ok(());
                }
                self.miss(missed)
            }
            Item::End(_) => Ok(()),
        }
    }

    /// Reports messages that will never be in the bag, if the recording has their topic or may get
    /// it.
    fn miss(&mut self, missed: &Missed) -> Result<(), Error> {
        let is_known = match self.place(&missed.topic, missed.samples)? {
            Placed::At(_) => true,
            Placed::Later => self.has_room_in_report(&missed.topic.name),
            Placed::Nowhere => return Ok(()),
        };
        if is_known {
            add_missed(&mut self.report, missed);
        } else {
            self.report.missing += missed.samples;
            self.report.missing_runs_unnamed += 1;
        }
        Ok(())
    }

    /// Returns whether the report can list a topic.
    fn has_room_in_report(&self, name: &str) -> bool {
        let known = &self.report.topics;
        known.len() < RecordedTopics::CAP || known.contains_key(name)
    }

    /// Completes the bag. `error` is the storage error that ended the recording, if any.
    #[must_use]
    pub fn finish(self, error: Option<Error>) -> Finished {
        self.finish_with(error, |work| work.run().map(Some))
    }

    /// Does the same as [`Self::finish`], but compresses whole files with `compress`: see
    /// [`Writer::close_with`].
    #[must_use]
    pub fn finish_with(
        mut self,
        error: Option<Error>,
        compress: impl FnMut(FileCompression) -> Result<Option<Compressed>, Error>,
    ) -> Finished {
        if let Some(Error::Limit(limit)) = &error {
            self.report.limit_reached = Some(limit.clone());
        }
        let graph = (self.sources.graph)();
        self.note_what_was_sent_before(&graph);
        self.note_what_was_not_observed(graph);
        // Unwritten messages are known before the report is added to the bag.
        self.writer.settle();
        for (topic, messages, bytes) in self.writer.unwritten() {
            take_back(&mut self.report, topic, messages, bytes);
        }
        let custom_data = custom_data(&self.report);
        let (summary, close_error) = self.writer.close_with(custom_data, compress);
        Finished {
            summary: Some(summary),
            report: self.report,
            error: error.or(close_error),
        }
    }

    fn write(&mut self, sample: &Sample) -> Result<(), Error> {
        let Some(payload) = &sample.payload else {
            return Ok(());
        };
        let topic = &*sample.topic;
        if self.paused {
            if self.has_room_in_report(&topic.name) && self.accepts(&topic.name) {
                add_paused(&mut self.report, &topic.name);
            }
            return Ok(());
        }
        let are_writers_full = self.writers.is_full();
        let Placed::At(taken) = self.place(topic, 1)? else {
            return Ok(());
        };
        let id = taken.id;
        if let Some(first) = taken.first.get_mut(&sample.writer) {
            *first = sample.sequence_number.min(*first);
        } else if are_writers_full {
            self.writers.refuse();
        } else if taken
            .first
            .insert(sample.writer, sample.sequence_number)
            .is_none()
        {
            self.writers.add(1);
            self.describe_again(topic, sample.writer)?;
        }
        if let Some(quota) = &mut self.quota {
            quota.take(self.writer.expected_bytes(), payload.len() as u64)?;
        }
        let sent = sample.source_timestamp.unwrap_or(sample.time);
        self.writer
            .write(id, sample.time, sent, sample.sequence_number.0, payload)?;
        add_written(&mut self.report, &topic.name, payload.len());
        if sample.sampled && !self.sampled.contains(&*topic.name) {
            self.sampled.insert(topic.name.to_string());
        }
        Ok(())
    }

    fn clock(&mut self, now: Timestamp) -> Result<(), Error> {
        if self.synced.0 == 0 {
            (self.flushed, self.synced) = (now, now);
        }
        if now.distance(self.flushed) >= FLUSH_INTERVAL
            && let Some(quota) = &self.quota
        {
            quota.check()?;
        }
        if now.distance(self.synced) >= SYNC_INTERVAL {
            (self.flushed, self.synced) = (now, now);
            self.writer.sync()
        } else if now.distance(self.flushed) >= FLUSH_INTERVAL {
            self.flushed = now;
            self.writer.flush()
        } else {
            Ok(())
        }
    }

    fn accepts(&self, name: &str) -> bool {
        !matches!(self.topics.get(name), Some(TopicDecision::Excluded))
    }

    /// Returns the place of a topic's `messages` new messages.
    fn place(&mut self, topic: &Topic, messages: u64) -> Result<Placed<'_>, Error> {
        let Topic {
            name, message_type, ..
        } = topic;
        if !self.topics.contains_key(&**name) {
            let offered = topic.offered.as_deref();
            // Messages carry the announcement of their writer; other facts have to be requested.
            let announced = match offered {
                Some(_) if !self.filter.options().ignore_leaf_topics => DiscoveredTopic::default(),
                _ => self.discover_one(name),
            };
            let place = self.decide(name, message_type, offered, &announced, true)?;
            match place {
                TopicDecision::NoRoom => {
                    self.report.missing += messages;
                    self.report.no_room += messages;
                    return Ok(Placed::Nowhere);
                }
                TopicDecision::Untyped { is_selected: true } => return Ok(Placed::Later),
                TopicDecision::Untyped { is_selected: false } => return Ok(Placed::Nowhere),
                place => self.store_decision(name, place),
            }
        }
        let Some(TopicDecision::Recorded(taken)) = self.topics.get_mut(&**name) else {
            return Ok(Placed::Nowhere);
        };
        // A loss may precede the first message and has no type.
        if !message_type.is_empty() && taken.description.type_name != **message_type {
            if !self
                .report
                .left_out
                .iter()
                .any(|left_out| **left_out == **name)
            {
                self.report.left_out.push(name.to_string());
            }
            return Ok(Placed::Nowhere);
        }
        Ok(Placed::At(taken))
    }

    /// Stores the decision about a topic. Excluded topics take at most half of the table; beyond
    /// that, they are decided again each time.
    fn store_decision(&mut self, name: &str, place: TopicDecision) {
        let bytes = match &place {
            TopicDecision::Recorded(taken) => name.len() + taken.description.type_name.len(),
            TopicDecision::Excluded | TopicDecision::NoRoom | TopicDecision::Untyped { .. } => {
                name.len()
            }
        };
        let is_half_full = self.topics.len() >= RecordedTopics::CAP / 2
            || self.names.remaining() < RecordedNames::CAP / 2;
        if is_half_full && matches!(place, TopicDecision::Excluded) {
            return;
        }
        if bytes > self.names.remaining() {
            self.names.refuse();
        } else if self.topics.insert(name.to_owned(), place).is_none() {
            self.names.add(bytes);
        }
    }

    /// Returns the announcements about the named topics, one result per name.
    fn discover(&mut self, names: &[String]) -> Vec<DiscoveredTopic> {
        if names.is_empty() {
            return Vec::new();
        }
        let mut announced = (self.sources.announced)(names);
        announced.resize_with(names.len(), DiscoveredTopic::default);
        announced
    }

    fn discover_one(&mut self, name: &str) -> DiscoveredTopic {
        self.discover(&[name.to_owned()]).pop().unwrap_or_default()
    }

    fn decide(
        &mut self,
        name: &str,
        message_type: &str,
        offered: Option<&Offered>,
        announced: &DiscoveredTopic,
        came: bool,
    ) -> Result<TopicDecision, Error> {
        let message_type = match announced.message_types.as_slice() {
            [known] if message_type.is_empty() => known.as_str(),
            _ => message_type,
        };
        let is_untyped = message_type.is_empty() && offered.is_none();
        let types = [message_type.to_owned()];
        let candidate = Candidate {
            name,
            types: match is_untyped {
                true => &announced.message_types,
                false => &types,
            },
            published: came || !announced.publishers.is_empty(),
            subscribed: announced.subscribed,
        };
        let is_selected = self.filter.is_selected(&candidate);
        if is_untyped {
            return Ok(TopicDecision::Untyped { is_selected });
        }
        if !is_selected {
            return Ok(TopicDecision::Excluded);
        }
        if self.topics.is_full() {
            self.topics.refuse();
            return Ok(TopicDecision::NoRoom);
        }
        if name.len() + message_type.len() > self.names.remaining() {
            self.names.refuse();
            return Ok(TopicDecision::NoRoom);
        }
        let type_hash = offered.and_then(|offered| offered.type_hash.as_ref());
        let type_hash = type_hash.map(ToString::to_string);
        let type_hash = type_hash.or_else(|| announced.type_hashes.first().cloned());
        let definition_hash = type_hash.clone().or_else(|| match offered {
            Some(offered) => offered.equivalence_hash.map(|hash| hash.to_string()),
            None => announced.publishers.first()?.equivalence_hash.clone(),
        });
        let publishers = announced.publishers.iter().take(self.writers.remaining());
        let mut offered: Vec<_> = publishers
            .map(|publisher| (publisher.guid.clone(), qos(&publisher.qos)))
            .collect();
        offered.sort_by(|one, other| one.0.cmp(&other.0));
        let offered: Bounded<RecordedWriters, Vec<_>> = offered.into_iter().collect();
        self.writers.add(offered.len());
        let mut description = TopicDescription {
            name: name.to_owned(),
            type_name: message_type.to_owned(),
            schema: (self.sources.schema)(message_type, definition_hash.as_deref()),
            type_hash,
            publishers: offered.iter().map(|(_, qos)| qos.clone()).collect(),
        };
        // The bag describes a topic before its first message; `describe_again` adds the QoS of the
        // writer.
        let id = self.writer.topic(description.clone())?;
        // The schema is in the bag now.
        description.schema = None;
        self.report.topic(name);
        self.order.push(name.to_owned());
        Ok(TopicDecision::Recorded(Box::new(RecordedTopic {
            id,
            description,
            offered,
            first: Bounded::default(),
        })))
    }

    /// Writes a topic's description again if a writer is new, or its offered QoS has changed.
    fn describe_again(&mut self, topic: &Topic, writer: Guid) -> Result<(), Error> {
        let (Some(offered), Some(TopicDecision::Recorded(taken))) =
            (&topic.offered, self.topics.get_mut(&*topic.name))
        else {
            return Ok(());
        };
        let writer = writer.to_string();
        let qos = (*offered.qos).clone();
        let place = taken
            .offered
            .binary_search_by(|(known, _)| known.cmp(&writer));
        match place {
            Ok(place) => match taken.offered.get_mut(place) {
                Some((_, known)) if *known != qos => *known = qos,
                _ => return Ok(()),
            },
            Err(place) if taken.offered.insert(place, (writer, qos)).is_none() => {}
            Err(_) => return Ok(()),
        }
        let publishers = taken.offered.iter().map(|(_, qos)| qos.clone());
        taken.description.publishers = publishers.collect();
        self.writer.topic(taken.description.clone()).map(drop)
    }
}

impl std::fmt::Debug for Recorder<'_> {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Recorder")
            .field("writer", &self.writer)
            .field("report", &self.report)
            .finish_non_exhaustive()
    }
}

#[cfg(test)]
mod tests;
