//! One recording: samples in, a bag and a report out.
//!
//! No thread and no clock of its own: its owner feeds it from a subscription or from an agent's
//! stream, and time comes with the items. The first error of the storage ends it; what was
//! taken before is in the bag, and what is not is counted.

mod unrecorded;

use std::collections::{BTreeMap, BTreeSet, HashMap};
use std::sync::Arc;

use ros2probe_wire::qos::Qos;
use ros2probe_wire::time::SECOND;
use ros2probe_wire::{Guid, SequenceNumber, Timestamp};

use super::disk_quota::DiskQuota;
use super::filter::{Candidate, Filter};
use super::graph::{DiscoveredTopic, GraphSnapshot, PublishedTopic};
use super::report::{add_missed, add_paused, add_written, custom_data, take_back};
use super::sample_ring::SampleRing;
use crate::subscriptions::line::qos;
use crate::subscriptions::{Item, Topic};
use ros2probe_api::recording_report::{NO_SUBSCRIBER, Report};
use ros2probe_api::recordings::FilterOptions;
use ros2probe_bag::{
    Compressed, Error, FileCompression, Schema, Summary, TopicDescription, TopicId, Writer,
};
use ros2probe_model::dispatch::{Offered, Sample};

/// How often what was taken is handed to the system, by the time of the samples: so much is lost
/// when the process is killed.
const FLUSH: u64 = SECOND;
/// How often it is waited for until it is on the disk: so much is lost with the power.
const SYNC: u64 = 5 * SECOND;
/// Writers of one topic whose first number is remembered.
const WRITERS: usize = 256;

/// Where a recorder learns what it does not see in samples.
pub struct Sources<'a> {
    /// What is announced at the moment of the topics of these names, in their order.
    pub announced: Box<Announcements<'a>>,
    /// What is there at the moment, in all domains.
    pub graph: Box<dyn FnMut() -> GraphSnapshot + Send + 'a>,
    /// How messages of a type look; the type and its announced hash.
    pub schema: Box<Schemas<'a>>,
}

/// What is announced of topics, asked for all at once: each question may take a while.
pub type Announcements<'a> = dyn FnMut(&[String]) -> Vec<DiscoveredTopic> + Send + 'a;

/// The schema of a type, by its name and announced hash.
pub type Schemas<'a> = dyn FnMut(&str, Option<&str>) -> Option<Schema> + Send + 'a;

/// A bag in the making.
pub struct Recorder<'a> {
    writer: Writer,
    domain_id: u32,
    /// What was counted when it began.
    before: Baseline,
    filter: Filter,
    sources: Sources<'a>,
    topics: HashMap<String, TopicDecision>,
    /// Of those, the ones in the bag.
    order: Vec<String>,
    report: Report,
    sampled: BTreeSet<String>,
    paused: bool,
    /// In snapshot mode: samples that wait for being asked for.
    ring: Option<SampleRing>,
    /// What it may take of the disk.
    quota: Option<DiskQuota>,
    flushed: Timestamp,
    synced: Timestamp,
}

/// Counts at the beginning: messages of topics in other domains, and of writers that were never
/// announced.
#[derive(Default)]
struct Baseline {
    topics: HashMap<(u32, String), u64>,
    unknown_writers: HashMap<String, u64>,
}

/// What was decided for a topic.
enum TopicDecision {
    /// It is in the bag.
    Recorded(Box<RecordedTopic>),
    /// The filter does not take it.
    Excluded,
}

struct RecordedTopic {
    id: TopicId,
    description: TopicDescription,
    /// Of each publisher by its GUID, for the description.
    offered: BTreeMap<String, Qos>,
    /// Number of the first recorded sample of each writer.
    first: HashMap<Guid, SequenceNumber>,
}

/// What became of a recording.
#[derive(Debug)]
pub struct Finished {
    /// The bag, where it could be completed.
    pub summary: Option<Summary>,
    /// What it has and has not.
    pub report: Report,
    /// What the storage refused; the bag is whole up to there.
    pub error: Option<Error>,
}

impl<'a> Recorder<'a> {
    /// Records what `filter` takes of a domain into `writer`'s bag. `before` is what was there before
    /// the first sample.
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
            topics: HashMap::new(),
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

    /// Keeps the last samples in memory and writes them when [`Self::snapshot`] asks for them.
    #[must_use]
    pub fn waiting_in(self, ring: SampleRing) -> Self {
        Self {
            ring: Some(ring),
            ..self
        }
    }

    /// Ends with an error when the room is used up.
    #[must_use]
    pub fn within(self, quota: DiskQuota) -> Self {
        Self {
            quota: Some(quota),
            ..self
        }
    }

    /// Writes what waits in memory; nothing where it does not wait.
    ///
    /// # Errors
    /// The storage takes no more.
    pub fn snapshot(&mut self) -> Result<(), Error> {
        let waiting: Vec<_> = self.ring.iter_mut().flat_map(SampleRing::drain).collect();
        for sample in waiting {
            self.write(&sample)?;
        }
        self.writer.flush()
    }

    /// What it has so far.
    #[must_use]
    pub const fn report(&self) -> &Report {
        &self.report
    }

    /// Of these topics, the published ones that it takes and that have no message yet although the
    /// reason is known: by name, the reason as in [`Report::unobserved`].
    #[must_use]
    pub fn unobserved(&self, graph: &GraphSnapshot) -> BTreeMap<String, String> {
        let topics = graph.topics.iter();
        let topics = topics.filter(|topic| topic.domain_id == self.domain_id && self.takes(topic));
        let topics = topics.filter_map(|topic| {
            let recorded = self.report.topics.get(&topic.name);
            if recorded.is_some_and(|topic| topic.messages > 0 || topic.paused > 0) {
                return None;
            }
            let why = match &topic.other_transport {
                _ if !topic.subscribed => NO_SUBSCRIBER.to_owned(),
                other_transport => other_transport.clone()?,
            };
            Some((topic.name.clone(), why))
        });
        topics.collect()
    }

    /// What was asked for.
    #[must_use]
    pub const fn options(&self) -> &FilterOptions {
        self.filter.options()
    }

    /// Whether this topic is recorded, in whichever domain it is.
    #[must_use]
    pub fn takes(&self, topic: &PublishedTopic) -> bool {
        self.filter.takes(&Candidate {
            name: &topic.name,
            types: &topic.message_types,
            published: true,
            subscribed: topic.subscribed,
        })
    }

    /// Topics of which messages were sampled in shared memory.
    #[must_use]
    pub const fn sampled(&self) -> &BTreeSet<String> {
        &self.sampled
    }

    /// Topics in the bag, in the order in which they came into it.
    pub fn topics(&self) -> impl Iterator<Item = &str> {
        self.order.iter().map(String::as_str)
    }

    /// The bag so far.
    #[must_use]
    pub const fn writer(&self) -> &Writer {
        &self.writer
    }

    /// Whether samples are let go by.
    #[must_use]
    pub const fn is_paused(&self) -> bool {
        self.paused
    }

    /// Lets samples go by, or takes them again.
    pub const fn pause(&mut self, paused: bool) {
        self.paused = paused;
    }

    /// Goes on in a new file.
    ///
    /// # Errors
    /// The storage takes no more.
    pub fn split(&mut self) -> Result<(), Error> {
        self.writer.split()
    }

    /// Complete files that are to be compressed, by another thread.
    pub fn take_compressions(&mut self) -> Vec<FileCompression> {
        self.writer.take_file_compressions()
    }

    /// One of them is.
    ///
    /// # Errors
    /// The storage takes no more.
    pub fn compressed(&mut self, done: &Compressed) -> Result<(), Error> {
        self.writer.compressed(done)
    }

    /// Takes topics into the bag that may never have a message: each by its name and type, as
    /// discovery knows them.
    ///
    /// # Errors
    /// The storage takes no more.
    pub fn declare<'t>(
        &mut self,
        topics: impl IntoIterator<Item = (&'t str, &'t str)>,
    ) -> Result<(), Error> {
        let mut topics: Vec<(&str, &str)> = topics.into_iter().collect();
        topics.retain(|(name, _)| !self.topics.contains_key(*name));
        let names: Vec<String> = topics.iter().map(|(name, _)| (*name).to_owned()).collect();
        let announced = self.discover(&names);
        for ((name, message_type), announced) in topics.into_iter().zip(announced) {
            let place = self.decide(name, message_type, None, &announced, false)?;
            // One that is left out may yet be published.
            if matches!(place, TopicDecision::Recorded(_)) {
                self.topics.insert(name.to_owned(), place);
            }
        }
        Ok(())
    }

    /// Takes what the subscription gives.
    ///
    /// # Errors
    /// The storage takes no more; [`Self::finish`] completes the bag all the same.
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
                if self.place(&missed.topic)?.is_some() {
                    add_missed(&mut self.report, missed);
                }
                Ok(())
            }
            Item::End(_) => Ok(()),
        }
    }

    /// Completes the bag. `error` is what ended it, if that was the storage.
    #[must_use]
    pub fn finish(self, error: Option<Error>) -> Finished {
        self.finish_with(error, |work| work.run().map(Some))
    }

    /// As [`Self::finish`], with whole files compressed by `compress`: see [`Writer::close_with`].
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
        // Before the report goes into the bag.
        self.writer.settle();
        for (topic, messages, bytes) in self.writer.unwritten() {
            take_back(&mut self.report, topic, messages, bytes);
        }
        let custom_data = custom_data(&self.report);
        let closed = self.writer.close_with(custom_data, compress);
        let (summary, close_error) = match closed {
            Ok(summary) => (Some(summary), None),
            Err(error) => (None, Some(error)),
        };
        Finished {
            summary,
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
            if self.accepts(&topic.name) {
                add_paused(&mut self.report, &topic.name);
            }
            return Ok(());
        }
        let Some(taken) = self.place(topic)? else {
            return Ok(());
        };
        let id = taken.id;
        if let Some(first) = taken.first.get_mut(&sample.writer) {
            *first = sample.sequence_number.min(*first);
        } else if taken.first.len() < WRITERS {
            taken.first.insert(sample.writer, sample.sequence_number);
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
        let since = |before: Timestamp| now.0.abs_diff(before.0);
        if since(self.flushed) >= FLUSH
            && let Some(quota) = &self.quota
        {
            quota.check()?;
        }
        if since(self.synced) >= SYNC {
            (self.flushed, self.synced) = (now, now);
            self.writer.sync()
        } else if since(self.flushed) >= FLUSH {
            self.flushed = now;
            self.writer.flush()
        } else {
            Ok(())
        }
    }

    fn accepts(&self, name: &str) -> bool {
        !matches!(self.topics.get(name), Some(TopicDecision::Excluded))
    }

    /// The place of a topic of which something came; `None` where it is not recorded.
    fn place(&mut self, topic: &Topic) -> Result<Option<&mut RecordedTopic>, Error> {
        let Topic {
            name, message_type, ..
        } = topic;
        if !self.topics.contains_key(&**name) {
            let offered = topic.offered.as_deref();
            // What the writer announced comes with its messages; the rest has to be asked for.
            let announced = match offered {
                Some(_) if !self.filter.options().ignore_leaf_topics => DiscoveredTopic::default(),
                _ => self.discover_one(name),
            };
            let place = self.decide(name, message_type, offered, &announced, true)?;
            self.topics.insert(name.to_string(), place);
        }
        let Some(TopicDecision::Recorded(taken)) = self.topics.get_mut(&**name) else {
            return Ok(None);
        };
        // A loss may come before the first message, and without a type.
        if !message_type.is_empty() && taken.description.type_name != **message_type {
            if !self
                .report
                .left_out
                .iter()
                .any(|left_out| **left_out == **name)
            {
                self.report.left_out.push(name.to_string());
            }
            return Ok(None);
        }
        Ok(Some(taken))
    }

    /// What is announced of these topics: as many answers as there are names.
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
        let known = announced
            .message_types
            .first()
            .filter(|_| message_type.is_empty());
        let message_type = known.map_or(message_type, String::as_str);
        let types = [message_type.to_owned()];
        let candidate = Candidate {
            name,
            types: &types,
            published: came || !announced.publishers.is_empty(),
            subscribed: announced.subscribed,
        };
        if !self.filter.takes(&candidate) {
            return Ok(TopicDecision::Excluded);
        }
        let type_hash = offered.and_then(|offered| offered.type_hash.as_ref());
        let type_hash = type_hash.map(ToString::to_string);
        let type_hash = type_hash.or_else(|| announced.type_hashes.first().cloned());
        let publishers = announced.publishers.iter();
        let offered: BTreeMap<_, _> = publishers
            .map(|publisher| (publisher.guid.clone(), qos(&publisher.qos)))
            .collect();
        let mut description = TopicDescription {
            name: name.to_owned(),
            type_name: message_type.to_owned(),
            schema: (self.sources.schema)(message_type, type_hash.as_deref()),
            type_hash,
            publishers: offered.values().cloned().collect(),
        };
        // Before its first message comes its description: with that of its writer.
        let id = self.writer.topic(description.clone())?;
        // The bag has it now.
        description.schema = None;
        self.report.topic(name);
        self.order.push(name.to_owned());
        Ok(TopicDecision::Recorded(Box::new(RecordedTopic {
            id,
            description,
            offered,
            first: HashMap::new(),
        })))
    }

    /// Describes a topic again when a writer is new that offers something.
    fn describe_again(&mut self, topic: &Topic, writer: Guid) -> Result<(), Error> {
        let (Some(offered), Some(TopicDecision::Recorded(taken))) =
            (&topic.offered, self.topics.get_mut(&*topic.name))
        else {
            return Ok(());
        };
        let before = taken
            .offered
            .insert(writer.to_string(), (*offered.qos).clone());
        if before.is_some_and(|before| before == *offered.qos) {
            return Ok(());
        }
        taken.description.publishers = taken.offered.values().cloned().collect();
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
