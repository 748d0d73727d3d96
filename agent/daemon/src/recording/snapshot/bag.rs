//! One bag of a snapshot: created on a trigger, filled from memory and then from the subscription.

use std::collections::{BTreeMap, HashSet};
use std::fs;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, PoisonError};

use ros2probe_bag::metadata::{self, Metadata};
use ros2probe_bag::{Error, Options, Writer};
use serde::{Deserialize, Serialize};

use super::WrittenBag;
use super::retention::{Space, make_space};
use crate::config::SnapshotSettings;
use crate::events::Record;
use crate::recording::filter::Filter;
use crate::recording::graph::{GraphSnapshot, PublishedTopic};
use crate::recording::recorder::Recorder;
use crate::recording::service::{Recordings, Refusal, causes, default_name, refusal};
use crate::subscriptions::Item;
use ros2probe_api::recordings::{BagTrigger, FilterOptions};

/// Key of the trigger in the bag's custom data.
const TRIGGER_DATA: &str = "ros2probe_trigger";
/// Maximum size of a metadata.yaml that is read, in bytes.
const METADATA_BYTES: u64 = 1 << 20;

/// Bytes that completing a bag adds: summary, statistics and metadata.yaml of some topics.
const CLOSING_BYTES: u64 = 8 << 10;

/// Why a bag is written.
pub(super) enum Cause {
    /// A client of the API.
    Request,
    /// SIGUSR1.
    Signal,
    /// An event that meets a trigger of the configuration.
    Event {
        /// Name of the trigger.
        trigger: &'static str,
        /// Id of the event.
        id: String,
        /// The event.
        record: Box<Record>,
    },
}

/// The trigger in the bag's custom data, as JSON.
#[derive(Debug, Deserialize, Serialize)]
struct TriggerData {
    /// Name of the snapshot in the configuration.
    snapshot: String,
    /// Place in the order of the snapshot's bags; zero for bags of earlier versions.
    #[serde(default)]
    number: u64,
    /// Name of the trigger, `request` or `signal`.
    trigger: String,
    /// Name of the event that met the trigger.
    #[serde(skip_serializing_if = "Option::is_none")]
    event: Option<String>,
    /// Id of the event that met the trigger.
    #[serde(skip_serializing_if = "Option::is_none")]
    event_id: Option<String>,
    /// Time of the event, RFC 3339.
    #[serde(skip_serializing_if = "Option::is_none")]
    time: Option<String>,
    /// Attributes of the event.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    attributes: BTreeMap<String, serde_json::Value>,
}

/// The event that triggered a bag, by its metadata.
#[derive(Debug)]
pub struct TriggeredBag {
    /// Name of the snapshot in the configuration.
    pub snapshot: String,
    /// Place in the order of the snapshot's bags; zero for bags of earlier versions.
    pub number: u64,
    /// The event.
    pub trigger: BagTrigger,
}

impl TriggeredBag {
    /// Reads the metadata of a bag; `None` without an event as its trigger.
    #[must_use]
    pub fn read(bag: &Path) -> Option<Self> {
        let file = bag.join(metadata::FILE_NAME);
        let size = fs::metadata(&file).ok()?.len();
        let text = (size <= METADATA_BYTES).then(|| fs::read_to_string(&file).ok())??;
        let metadata = Metadata::read(&text).ok()?;
        let data = metadata.custom_data.get(TRIGGER_DATA)?;
        let data: TriggerData = serde_json::from_str(data).ok()?;
        let attribute = |name| data.attributes.get(name);
        let topic = attribute("topic").and_then(|topic| topic.as_str());
        let domain = attribute("domain_id").and_then(serde_json::Value::as_u64);
        Some(Self {
            trigger: BagTrigger {
                topic: topic.map(str::to_owned),
                domain_id: domain.and_then(|domain| domain.try_into().ok()),
                trigger: data.trigger,
                event: data.event?,
                time: data.time?,
            },
            snapshot: data.snapshot,
            number: data.number,
        })
    }
}

/// A bag in progress.
pub(super) struct SnapshotBag {
    recorder: Recorder<'static>,
    cause: Cause,
    name: String,
    directory: PathBuf,
    settings: SnapshotSettings,
    /// Maximum size of the bag, in bytes.
    bytes: u64,
    /// Number of old bags removed for this bag.
    removed: u64,
    topics: Topics,
}

/// Names of topics with a message, which the report covers.
type Topics = Arc<Mutex<HashSet<String>>>;

/// A bag that could not be created.
pub(super) struct Failed {
    pub(super) cause: Cause,
    pub(super) name: String,
    pub(super) reason: String,
    /// Number of old bags removed for this bag.
    pub(super) removed: u64,
}

/// A completed bag.
pub(super) struct Ended {
    pub(super) cause: Cause,
    pub(super) bag: WrittenBag,
    /// Number of old bags removed for this bag.
    pub(super) removed: u64,
    /// Error of the storage; the bag is complete up to the error.
    pub(super) error: Option<Error>,
}

impl Cause {
    /// Returns the name of the trigger, `request` or `signal`.
    pub(super) const fn name(&self) -> &'static str {
        match self {
            Self::Request => "request",
            Self::Signal => "signal",
            Self::Event { trigger, .. } => trigger,
        }
    }

    /// Returns the id of the event, if an event is the cause.
    pub(super) fn event_id(&self) -> Option<&str> {
        match self {
            Self::Event { id, .. } => Some(id),
            Self::Request | Self::Signal => None,
        }
    }

    fn data(&self, snapshot: &str, number: u64) -> TriggerData {
        let record = match self {
            Self::Event { record, .. } => Some(record),
            Self::Request | Self::Signal => None,
        };
        let attributes = record.iter().flat_map(|record| &record.attributes);
        let attributes = attributes.map(|(name, value)| {
            // Texts and numbers cannot fail to serialize.
            let value = serde_json::to_value(value).unwrap_or_default();
            ((*name).to_owned(), value)
        });
        TriggerData {
            snapshot: snapshot.to_owned(),
            number,
            trigger: self.name().to_owned(),
            event: record.map(|record| record.definition.name.to_owned()),
            event_id: self.event_id().map(str::to_owned),
            time: record.map(|record| record.time()),
            attributes: attributes.collect(),
        }
    }
}

impl SnapshotBag {
    /// Creates an empty bag after making space for `needed` bytes of messages.
    pub(super) fn create(
        recordings: &Recordings,
        settings: &SnapshotSettings,
        cause: Cause,
        needed: u64,
    ) -> Result<Self, Failed> {
        let wanted = unused_name(recordings, &settings.name);
        let failed = |cause, reason, removed| Failed {
            cause,
            name: wanted.clone(),
            reason,
            removed,
        };
        let (name, directory) = match recordings.bag_directory(Some(wanted.clone())) {
            Ok(place) => place,
            Err(refusal) => return Err(failed(cause, refusal.to_string(), 0)),
        };
        let needed = needed + CLOSING_BYTES;
        let others = settings.max_count - usize::from(cause.event_id().is_some());
        let space = make_space(&directory, settings, others, needed, |bag| {
            recordings.may_remove(bag)
        });
        let Space {
            bytes,
            removed,
            number,
        } = space;
        if bytes < needed {
            return Err(failed(cause, no_space(settings).to_string(), removed));
        }
        let topics = Topics::default();
        let data = cause.data(&settings.name, number);
        match recorder(recordings, settings, &directory, &data, &topics) {
            Ok(recorder) => Ok(Self {
                recorder,
                cause,
                name,
                directory,
                settings: settings.clone(),
                bytes,
                removed,
                topics,
            }),
            Err(refusal) => Err(failed(cause, refusal.to_string(), removed)),
        }
    }

    /// Adds an item of the subscription.
    ///
    /// # Errors
    ///
    /// Fails if the storage fails or a limit of the snapshot is reached. [`Self::finish`] completes
    /// the bag nevertheless.
    pub(super) fn take(&mut self, item: &Item, recordings: &Recordings) -> Result<(), Error> {
        if let Item::Sample(sample) = item {
            let payload = sample
                .payload
                .as_ref()
                .map_or(0, |payload| payload.len() as u64);
            let size = self.recorder.writer().expected_bytes() + payload + CLOSING_BYTES;
            if size > self.bytes {
                self.grow(size, recordings)?;
            }
            let mut topics = self.topics.lock().unwrap_or_else(PoisonError::into_inner);
            if !topics.contains(&*sample.topic.name) {
                topics.insert(sample.topic.name.to_string());
            }
        }
        self.recorder.take(item)
    }

    /// Removes further old bags, so that this bag may have `size` bytes.
    fn grow(&mut self, size: u64, recordings: &Recordings) -> Result<(), Error> {
        let others = self.settings.max_count;
        let space = make_space(&self.directory, &self.settings, others, size, |bag| {
            recordings.may_remove(bag)
        });
        self.bytes = space.bytes;
        self.removed += space.removed;
        if space.bytes < size {
            return Err(no_space(&self.settings));
        }
        Ok(())
    }

    /// Completes the bag. `error` is the storage error that ended the bag, if any.
    pub(super) fn finish(self, error: Option<Error>) -> Ended {
        let ended = self.recorder.finish(error);
        Ended {
            cause: self.cause,
            bag: WrittenBag {
                name: self.name,
                directory: self.directory,
                messages: ended.report.messages,
            },
            removed: self.removed,
            error: ended.error,
        }
    }

    /// Removes the bag, whose messages are all still in memory.
    pub(super) fn discard(self, error: &Error) -> Failed {
        drop(self.recorder);
        let _ = fs::remove_dir_all(&self.directory);
        Failed {
            cause: self.cause,
            name: self.name,
            reason: causes(error),
            removed: self.removed,
        }
    }
}

fn no_space(settings: &SnapshotSettings) -> Error {
    Error::Limit(format!(
        "all bags of this snapshot would use more than {} bytes (max_total_bytes): remove some",
        settings.max_total_bytes
    ))
}

/// Returns a name for a new bag, with a number if bags of the same second exist.
fn unused_name(recordings: &Recordings, snapshot: &str) -> String {
    let base = format!("{snapshot}_{}", default_name());
    let Some(directory) = recordings.directory() else {
        return base;
    };
    let mut name = base.clone();
    let mut copies = 1;
    while directory.join(&name).exists() {
        copies += 1;
        name = format!("{base}_{copies}");
    }
    name
}

/// Creates an empty bag with its recorder.
fn recorder(
    recordings: &Recordings,
    settings: &SnapshotSettings,
    directory: &Path,
    data: &TriggerData,
    topics: &Topics,
) -> Result<Recorder<'static>, Refusal> {
    let filter = Filter::new(FilterOptions {
        include_hidden_topics: true,
        all_services: true,
        ..FilterOptions::everything()
    })?;
    let name = settings.name.as_str();
    let quota = recordings.quota(directory);
    quota.check().map_err(|error| refusal(name, error))?;
    // Texts and numbers cannot fail to serialize.
    let data = serde_json::to_string(data).unwrap_or_default();
    let options = Options {
        custom_data: BTreeMap::from([(TRIGGER_DATA.to_owned(), data)]),
        ..Options::default()
    };
    let writer = Writer::create(directory, options).map_err(|error| refusal(name, error))?;
    let domain_id = settings.domain_id;
    let mut sources = recordings.sources(domain_id);
    let (mut graph, topics) = (sources.graph, Arc::clone(topics));
    sources.graph = Box::new(move || {
        let names = topics.lock().unwrap_or_else(PoisonError::into_inner);
        let mut graph = graph();
        graph.unknown_writers.clear();
        let is_covered = |topic: &PublishedTopic| names.contains(&topic.name);
        graph
            .topics
            .retain(|topic| topic.domain_id == domain_id && is_covered(topic));
        graph
    });
    let before = GraphSnapshot::default();
    Ok(Recorder::new(writer, filter, domain_id, before, sources).with_quota(quota))
}
