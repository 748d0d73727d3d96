//! One recording: samples in, a bag and a report out.
//!
//! No thread and no clock of its own: whoever owns it feeds it from a subscription or from an agent's
//! stream, and time comes with what it is fed. The first error of the storage ends it; what was
//! taken before is in the bag, and what is not is counted.

use std::collections::{BTreeMap, HashMap, HashSet};

use ros2probe_wire::{Guid, Timestamp};

use super::announced::Announced;
use super::filter::{Candidate, Filter};
use super::report::Report;
use crate::bag::{Error, Schema, Summary, TopicDescription, TopicId, Writer};
use crate::model::payloads::Sample;
use crate::subscriptions::{Item, Topic};

const SECOND: u64 = 1_000_000_000;
/// How often what was taken is handed to the system, by the time of the samples: so much is lost
/// when the process is killed.
const FLUSH: u64 = SECOND;
/// How often it is waited for until it is on the disk: so much is lost with the power.
const SYNC: u64 = 5 * SECOND;
/// Writers of one topic whose first number is remembered.
const WRITERS: usize = 256;

/// Where a recorder learns what it does not see in samples.
pub struct Sources {
    /// What is announced of a topic at the moment.
    pub announced: Box<dyn FnMut(&str) -> Announced + Send>,
    /// How messages of a type look; the type and its announced hash.
    pub schema: Box<dyn FnMut(&str, Option<&str>) -> Option<Schema> + Send>,
}

/// A bag in the making.
pub struct Recorder {
    writer: Writer,
    filter: Filter,
    sources: Sources,
    topics: HashMap<String, Place>,
    report: Report,
    paused: bool,
    flushed: Timestamp,
    synced: Timestamp,
}

/// What was decided for a topic.
enum Place {
    /// It is in the bag.
    Taken(Taken),
    /// The filter does not take it.
    LeftOut,
}

struct Taken {
    id: TopicId,
    message_type: String,
    /// Number of the first recorded sample of each writer.
    first: BTreeMap<Guid, u64>,
}

/// What became of a recording.
#[derive(Debug)]
pub struct Ended {
    /// The bag, where it could be completed.
    pub summary: Option<Summary>,
    /// What it has and has not.
    pub report: Report,
    /// What the storage refused; the bag is whole up to there.
    pub error: Option<Error>,
}

impl Recorder {
    /// Records what `filter` takes into `writer`'s bag.
    #[must_use]
    pub fn new(writer: Writer, filter: Filter, sources: Sources) -> Self {
        Self {
            writer,
            filter,
            sources,
            topics: HashMap::new(),
            report: Report::default(),
            paused: false,
            flushed: Timestamp(0),
            synced: Timestamp(0),
        }
    }

    /// What it has so far.
    #[must_use]
    pub const fn report(&self) -> &Report {
        &self.report
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

    /// Takes a topic into the bag that may never have a message; `name` as discovery knows it.
    ///
    /// # Errors
    /// The storage takes no more.
    pub fn declare(&mut self, name: &str, message_type: &str) -> Result<(), Error> {
        self.place(name, message_type, false).map(drop)
    }

    /// Takes what the subscription gives.
    ///
    /// # Errors
    /// The storage takes no more; [`Self::finish`] completes the bag all the same.
    pub fn take(&mut self, item: &Item) -> Result<(), Error> {
        match item {
            Item::Sample(sample) => self.sample(sample),
            Item::Clock(now) => self.clock(*now),
            Item::Missed(missed) => {
                let Topic {
                    name, message_type, ..
                } = &*missed.topic;
                if !self.paused && self.place(name, message_type, true)?.is_some() {
                    self.report.missed(missed);
                }
                Ok(())
            }
            Item::End(_) => Ok(()),
        }
    }

    /// Completes the bag. `error` is what ended it, if that was the storage.
    #[must_use]
    pub fn finish(mut self, error: Option<Error>) -> Ended {
        self.note_what_was_sent_before();
        let closed = self.writer.close(self.report.custom_data());
        let (summary, close_error) = match closed {
            Ok(summary) => (Some(summary), None),
            Err(error) => (None, Some(error)),
        };
        for topic in summary.iter().flat_map(|summary| &summary.topics) {
            if topic.unwritten > 0 {
                self.report.unwritten(&topic.name, topic.unwritten);
            }
        }
        Ended {
            summary,
            report: self.report,
            error: error.or(close_error),
        }
    }

    fn sample(&mut self, sample: &Sample) -> Result<(), Error> {
        let Some(payload) = &sample.payload else {
            return Ok(());
        };
        let topic = &*sample.topic;
        if self.paused {
            if self.would_take(&topic.name) {
                self.report.paused(&topic.name);
            }
            return Ok(());
        }
        let Some(taken) = self.place(&topic.name, &topic.message_type, true)? else {
            return Ok(());
        };
        let id = taken.id;
        let writers = taken.first.len();
        if writers < WRITERS {
            let first = taken.first.entry(sample.writer).or_insert(u64::MAX);
            *first = sample.sequence_number.min(*first);
        }
        if writers > 0 && taken.first.len() > writers {
            // One more publisher, perhaps with other QoS.
            let announced = (self.sources.announced)(&topic.name);
            self.describe(&topic.name, &topic.message_type, &announced)?;
        }
        let sent = sample.source_timestamp.unwrap_or(sample.time);
        self.writer
            .write(id, sample.time, sent, sample.sequence_number, payload)?;
        self.report.written(&topic.name, payload.len());
        Ok(())
    }

    fn clock(&mut self, now: Timestamp) -> Result<(), Error> {
        if self.synced.0 == 0 {
            (self.flushed, self.synced) = (now, now);
        }
        let since = |before: Timestamp| now.0.abs_diff(before.0);
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

    fn would_take(&self, name: &str) -> bool {
        !matches!(self.topics.get(name), Some(Place::LeftOut))
    }

    /// The topic's place in the bag; `None` where it is not recorded.
    fn place(
        &mut self,
        name: &str,
        message_type: &str,
        seen: bool,
    ) -> Result<Option<&mut Taken>, Error> {
        if !self.topics.contains_key(name) {
            let place = self.decide(name, message_type, seen)?;
            if !seen && matches!(place, Place::LeftOut) {
                // It may yet be published.
                return Ok(None);
            }
            self.topics.insert(name.to_owned(), place);
        }
        let Some(Place::Taken(taken)) = self.topics.get_mut(name) else {
            return Ok(None);
        };
        if taken.message_type != message_type {
            if !self.report.left_out.iter().any(|left_out| left_out == name) {
                self.report.left_out.push(name.to_owned());
            }
            return Ok(None);
        }
        Ok(Some(taken))
    }

    fn decide(&mut self, name: &str, message_type: &str, seen: bool) -> Result<Place, Error> {
        let announced = (self.sources.announced)(name);
        let types = [message_type.to_owned()];
        let candidate = Candidate {
            name,
            types: &types,
            published: seen || !announced.publishers.is_empty(),
            subscribed: !announced.subscriptions.is_empty(),
        };
        if !self.filter.takes(&candidate) {
            return Ok(Place::LeftOut);
        }
        let id = self.describe(name, message_type, &announced)?;
        self.report.topic(name);
        Ok(Place::Taken(Taken {
            id,
            message_type: message_type.to_owned(),
            first: BTreeMap::new(),
        }))
    }

    fn describe(
        &mut self,
        name: &str,
        message_type: &str,
        announced: &Announced,
    ) -> Result<TopicId, Error> {
        let hash = announced.type_hashes.first().cloned();
        let schema = (self.sources.schema)(message_type, hash.as_deref());
        let publishers = announced.publishers.iter();
        self.writer.topic(TopicDescription {
            name: name.to_owned(),
            type_name: message_type.to_owned(),
            type_hash: hash,
            publishers: publishers.map(|publisher| publisher.qos.qos()).collect(),
            schema,
        })
    }

    /// Publishers that keep samples for late joiners, of which the first ones are not in the bag.
    fn note_what_was_sent_before(&mut self) {
        let mut names: Vec<String> = Vec::new();
        for (name, place) in &self.topics {
            let Place::Taken(taken) = place else { continue };
            let announced = (self.sources.announced)(name);
            let keepers = announced.publishers.iter();
            let keepers = keepers.filter(|publisher| publisher.keeps_samples());
            let begun: HashSet<String> = taken
                .first
                .iter()
                .filter(|(_, first)| **first <= 1)
                .map(|(writer, _)| writer.to_string())
                .collect();
            if keepers
                .into_iter()
                .any(|keeper| !begun.contains(&keeper.guid))
            {
                names.push(name.clone());
            }
        }
        names.sort();
        self.report.sent_before = names;
    }
}

impl std::fmt::Debug for Recorder {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Recorder")
            .field("writer", &self.writer)
            .field("report", &self.report)
            .finish_non_exhaustive()
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use ros2probe_wire::{EntityId, GuidPrefix};

    use super::*;
    use crate::bag::Options;
    use crate::recording::Asked;
    use crate::subscriptions::{Missed, MissedReason};

    const KEEPER: &str = r#"{"reliability": "RELIABLE", "durability": "TRANSIENT_LOCAL",
        "history": "KEEP_LAST (1)", "deadline_seconds": null, "lifespan_seconds": null,
        "liveliness": "AUTOMATIC", "liveliness_lease_seconds": null}"#;

    fn writer(number: u8) -> Guid {
        Guid {
            prefix: GuidPrefix([number; 12]),
            entity: EntityId([0, 0, number, 3]),
        }
    }

    fn topic(name: &str, message_type: &str) -> Arc<Topic> {
        Arc::new(Topic {
            domain_id: 0,
            name: name.into(),
            dds_name: format!("rt{name}").into(),
            message_type: message_type.into(),
        })
    }

    fn sample(name: &str, number: u64) -> Item {
        Item::Sample(Arc::new(Sample {
            topic: topic(name, "std_msgs/msg/String"),
            time: Timestamp(1_000 + number),
            writer: writer(1),
            sequence_number: number,
            source_timestamp: Some(Timestamp(number)),
            header_stamp: None,
            size: 12,
            payload: Some(vec![0, 1, 0, 0, 4, 0, 0, 0, b'a', b'b', b'c', 0].into()),
        }))
    }

    fn keepers() -> Announced {
        let publishers = format!(r#"[{{"guid": "{}", "qos": {KEEPER}}}]"#, writer(1));
        let json = format!(
            r#"{{"message_types": [], "type_hashes": [], "publishers": {publishers},
                "subscriptions": []}}"#
        );
        serde_json::from_str(&json).unwrap()
    }

    fn recorder(directory: &std::path::Path, asked: Asked) -> Recorder {
        let sources = Sources {
            announced: Box::new(|name| match name {
                "/tf_static" => keepers(),
                _ => Announced::default(),
            }),
            schema: Box::new(|_, _| None),
        };
        let bag = Writer::create(directory, Options::default()).unwrap();
        Recorder::new(bag, Filter::new(asked).unwrap(), sources)
    }

    fn numbers(ended: &Ended) -> Vec<(String, u32)> {
        let mut found = Vec::new();
        for file in &ended.summary.as_ref().unwrap().files {
            let bytes = std::fs::read(file).unwrap();
            for message in mcap::MessageStream::new(&bytes).unwrap() {
                let message = message.unwrap();
                found.push((message.channel.topic.clone(), message.sequence));
            }
        }
        found
    }

    #[test]
    fn what_the_filter_takes_is_in_the_bag_and_what_is_missing_in_the_report() {
        let directory = tempfile::tempdir().unwrap();
        let asked = Asked {
            exclude_topics: vec!["/noise".to_owned()],
            ..Asked::everything()
        };
        let mut recorder = recorder(&directory.path().join("bag"), asked);
        for item in [sample("/a", 1), sample("/noise", 1), sample("/a", 2)] {
            recorder.take(&item).unwrap();
        }
        let missed = |name| {
            Item::Missed(Missed {
                topic: topic(name, "std_msgs/msg/String"),
                writer: writer(1),
                first: 3,
                last: 4,
                samples: 2,
                reason: MissedReason::QueueFull,
            })
        };
        recorder.take(&missed("/a")).unwrap();
        recorder.take(&missed("/noise")).unwrap();
        let ended = recorder.finish(None);
        assert_eq!(
            numbers(&ended),
            [("/a".to_owned(), 1), ("/a".to_owned(), 2)]
        );
        assert_eq!((ended.report.messages, ended.report.missing), (2, 2));
        assert_eq!(ended.report.topics.keys().collect::<Vec<_>>(), ["/a"]);
        let metadata = ended.summary.unwrap().directory.join("metadata.yaml");
        assert!(
            std::fs::read_to_string(metadata)
                .unwrap()
                .contains("first_sequence_number")
        );
    }

    #[test]
    fn samples_go_by_while_it_is_paused() {
        let directory = tempfile::tempdir().unwrap();
        let mut recorder = recorder(&directory.path().join("bag"), Asked::everything());
        recorder.take(&sample("/a", 1)).unwrap();
        recorder.pause(true);
        recorder.take(&sample("/a", 2)).unwrap();
        recorder.pause(false);
        recorder.take(&sample("/a", 3)).unwrap();
        let ended = recorder.finish(None);
        assert_eq!(numbers(&ended).len(), 2);
        assert_eq!(
            (ended.report.topics["/a"].paused, ended.report.missing),
            (1, 0)
        );
    }

    #[test]
    fn a_topic_of_two_types_keeps_the_first_and_says_so() {
        let directory = tempfile::tempdir().unwrap();
        let mut recorder = recorder(&directory.path().join("bag"), Asked::everything());
        recorder.take(&sample("/a", 1)).unwrap();
        let Item::Sample(other) = sample("/a", 2) else {
            unreachable!()
        };
        let other = Sample {
            topic: topic("/a", "std_msgs/msg/Int32"),
            ..Sample::clone(&other)
        };
        recorder.take(&Item::Sample(Arc::new(other))).unwrap();
        let ended = recorder.finish(None);
        assert_eq!(numbers(&ended).len(), 1);
        assert_eq!(ended.report.left_out, ["/a"]);
        assert!(ended.report.shortfalls()[0].ends_with("it has several types"));
    }

    #[test]
    fn what_publishers_sent_before_is_named_unless_it_is_there() {
        for (number, expected) in [(1, 0), (2, 1)] {
            let directory = tempfile::tempdir().unwrap();
            let mut recorder = recorder(&directory.path().join("bag"), Asked::everything());
            recorder.take(&sample("/tf_static", number)).unwrap();
            recorder.take(&sample("/a", 2)).unwrap();
            assert_eq!(recorder.finish(None).report.sent_before.len(), expected);
        }
        // Nothing came at all: it is in the bag by its name.
        let directory = tempfile::tempdir().unwrap();
        let mut recorder = recorder(&directory.path().join("bag"), Asked::everything());
        recorder
            .declare("/tf_static", "tf2_msgs/msg/TFMessage")
            .unwrap();
        recorder.declare("/nobody", "std_msgs/msg/String").unwrap();
        let ended = recorder.finish(None);
        assert_eq!(ended.report.sent_before, ["/tf_static"]);
        assert_eq!(ended.report.topics.len(), 1);
    }

    #[test]
    fn what_came_is_on_the_disk_after_a_second_of_samples() {
        let directory = tempfile::tempdir().unwrap();
        let bag = directory.path().join("bag");
        let mut recorder = recorder(&bag, Asked::everything());
        recorder.take(&Item::Clock(Timestamp(1))).unwrap();
        recorder.take(&sample("/a", 1)).unwrap();
        let size = || std::fs::metadata(bag.join("bag_0.mcap")).unwrap().len();
        let before = size();
        recorder.take(&Item::Clock(Timestamp(SECOND + 1))).unwrap();
        assert!(size() > before);
    }
}
