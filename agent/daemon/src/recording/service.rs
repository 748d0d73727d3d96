//! The agent's own recordings: begun and ended by clients, each on a thread of its own, written where
//! the configuration allows and nowhere else.

use std::collections::HashMap;
use std::path::{Path, PathBuf};
use std::sync::atomic::Ordering;
use std::sync::mpsc::{Receiver, Sender, channel};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::thread::JoinHandle;
use std::time::{Duration, SystemTime};

use jiff::Zoned;
use tokio::sync::Notify;

use super::disk_quota::DiskQuota;
use super::filter::{Filter, FilterError};
use super::graph::{DiscoveredTopic, GraphSnapshot};
use super::recorder::{Finished, Recorder, Sources};
use super::session::{self, Activity, Command};
use crate::config::{Limit, RecordingLimits};
use crate::events::{AgentEvent, EventLog};
use crate::limit_facts::{LimitFigures, Slot, Slots};
use crate::recording::RecordingFigures;
use crate::snapshot_cell::SnapshotCell;
use crate::subscriptions::{
    ChoiceError, Depth, NextItem, Overflow, Refused, Request, Selection, Subscription,
    Subscriptions,
};
use ros2probe_api::recording_report::Report;
use ros2probe_api::recordings::{FilterOptions, RecordingState};
use ros2probe_bag::{Error, Options, Schema, Writer};
use ros2probe_capture::system::give_back_memory;
use ros2probe_message::Library;
use ros2probe_wire::DomainId;

/// Ended ones whose report is kept.
const ENDED: usize = 16;
/// A larger chunk of a bag is not kept in memory, nor a larger index of a file.
const CHUNK_BYTES: u64 = 1 << 20;
const INDEX_BYTES: u64 = 1 << 20;
/// Longest name of a recording.
const NAME: usize = 128;

/// All recordings of an agent.
#[derive(Debug)]
pub struct Recordings {
    /// Where they are written; `None` = nowhere.
    directory: Option<PathBuf>,
    limits: RecordingLimits,
    queue_bytes: usize,
    latest: Arc<SnapshotCell>,
    pub(super) events: Arc<EventLog>,
    caps: Arc<LimitFigures>,
    pub(super) figures: Arc<RecordingFigures>,
    subscriptions: Arc<Subscriptions>,
    library: Arc<Library>,
    list: Mutex<Vec<Arc<Recording>>>,
    slots: Arc<Slots>,
}

/// What recordings are made of.
#[derive(Debug)]
pub struct Components {
    /// Where they are written; `None` = nowhere.
    pub directory: Option<PathBuf>,
    /// What they may take of the disk.
    pub limits: RecordingLimits,
    /// Bytes of each that may wait for being written.
    pub queue_bytes: usize,
    /// What discovery knows.
    pub latest: Arc<SnapshotCell>,
    /// Takes their beginnings and ends.
    pub events: Arc<EventLog>,
    /// Limits their number and that of topics.
    pub caps: Arc<LimitFigures>,
    /// Counts what they write.
    pub figures: Arc<RecordingFigures>,
    /// Where messages come from.
    pub subscriptions: Arc<Subscriptions>,
    /// Definitions of messages.
    pub library: Arc<Library>,
}

/// What a client wants to be recorded.
#[derive(Debug)]
pub struct RecordingOptions {
    /// Name of the directory; the time when it is left out.
    pub name: Option<String>,
    /// Which topics.
    pub asked: FilterOptions,
    /// Of which domain.
    pub domain_id: u32,
    /// How it is written.
    pub options: Options,
    /// Begins paused.
    pub paused: bool,
}

/// One recording.
#[derive(Debug)]
pub struct Recording {
    /// Name of its directory.
    pub name: String,
    /// Where it lies.
    pub directory: PathBuf,
    /// Of which domain.
    pub domain_id: u32,
    /// What is recorded.
    pub asked: FilterOptions,
    /// When it began.
    pub began: SystemTime,
    status: Mutex<Status>,
    commands: Mutex<Sender<Command>>,
    thread: Mutex<Option<JoinHandle<()>>>,
    over: Notify,
}

/// How it goes.
#[derive(Clone, Debug, Default)]
pub struct Status {
    /// What it is doing.
    pub state: RecordingState,
    /// What it has and has not.
    pub report: Report,
    /// Bytes of its files.
    pub file_bytes: u64,
    /// Files begun.
    pub files: usize,
    /// Why it ended, if that was not asked for.
    pub error: Option<String>,
}

/// Why nothing is recorded.
#[derive(Debug, thiserror::Error)]
pub enum Refusal {
    /// There is no place.
    #[error(
        "the agent has no place for recordings: set `recordings.directory`, or record with \
         `rp bag record`"
    )]
    NoDirectory,
    /// No name of a directory.
    #[error(
        "`{0}` is not a valid name: use letters, digits, `_`, `-` and `.`, not starting with \
             `.`"
    )]
    Name(String),
    /// There is one of that name.
    #[error("a recording named `{0}` already exists")]
    Exists(String),
    /// As many as may are under way.
    #[error("{0} recordings are running, which is the limit (limits.recordings)")]
    TooMany(usize),
    /// The topics.
    #[error(transparent)]
    Filter(#[from] FilterError),
    /// A topic's name.
    #[error(transparent)]
    Choice(#[from] ChoiceError),
    /// Too many subscriptions.
    #[error(transparent)]
    Subscription(#[from] Refused),
    /// It cannot be written.
    #[error("{reason}")]
    Storage {
        /// With its causes.
        reason: String,
    },
}

impl Recordings {
    /// None yet.
    #[must_use]
    pub fn new(components: Components) -> Self {
        let Components {
            directory,
            limits,
            queue_bytes,
            latest,
            events,
            caps,
            figures,
            subscriptions,
            library,
        } = components;
        Self {
            directory,
            limits,
            queue_bytes,
            slots: caps.slots(Limit::Recordings),
            latest,
            events,
            caps,
            figures,
            subscriptions,
            library,
            list: Mutex::new(Vec::new()),
        }
    }

    /// Begins one. The subscription is open when this returns; see [`Subscription::in_force`].
    ///
    /// # Errors
    /// It cannot be.
    pub fn begin(&self, wanted: RecordingOptions) -> Result<Arc<Recording>, Refusal> {
        let filter = Filter::new(wanted.asked.clone())?;
        let (name, directory) = self.bag_directory(wanted.name)?;
        let mut list = self.list();
        let Some(place) = self.slots.take() else {
            self.caps.reached(Limit::Recordings, 1);
            return Err(Refusal::TooMany(self.slots.cap()));
        };
        let quota = self.quota(&directory);
        quota.check().map_err(|error| refusal(&name, error))?;
        let before = GraphSnapshot::from(self.latest.state().known());
        let subscription = self.subscribe(&filter, wanted.domain_id, &name)?;
        let mut options = wanted.options;
        options.storage.chunk_bytes = options.storage.chunk_bytes.min(CHUNK_BYTES);
        options.max_index_bytes = Some(INDEX_BYTES);
        let writer = Writer::create(&directory, options);
        let writer = writer.map_err(|error| refusal(&name, error))?;
        let sources = self.sources(wanted.domain_id);
        let mut recorder =
            Recorder::new(writer, filter, wanted.domain_id, before, sources).within(quota);
        recorder.pause(wanted.paused);
        self.declare(&mut recorder, &subscription, wanted.domain_id)
            .map_err(|error| refusal(&name, error))?;
        let (give, commands) = channel();
        let recording = Arc::new(Recording {
            name,
            directory,
            domain_id: wanted.domain_id,
            asked: wanted.asked,
            began: SystemTime::now(),
            status: Mutex::default(),
            commands: Mutex::new(give),
            thread: Mutex::default(),
            over: Notify::new(),
        });
        self.events.record(AgentEvent::RecordingStarted {
            recording: recording.name.clone(),
        });
        let thread = self.spawn(&recording, recorder, (subscription, place), commands)?;
        *locked(&recording.thread) = Some(thread);
        list.push(Arc::clone(&recording));
        forget_ended(&mut list);
        Ok(recording)
    }

    /// Declares the known topics that the subscription covers, as many as are measured: a robot that
    /// announces thousands fills no bag.
    fn declare(
        &self,
        recorder: &mut Recorder<'_>,
        subscription: &Subscription,
        domain_id: u32,
    ) -> Result<(), Error> {
        let state = self.latest.state();
        let covered = state.known().topics.iter().filter(|topic| {
            let (kind, hidden) = (topic.kind, topic.hidden);
            topic.domain_id == DomainId(domain_id)
                && subscription
                    .selection()
                    .covers(kind, &topic.name, &topic.dds_name, hidden)
        });
        let covered = covered.take(self.caps.caps().topics);
        recorder.declare(covered.filter_map(|topic| {
            let message_type = topic.message_types.first()?;
            Some((topic.name.as_str(), message_type.as_str()))
        }))
    }

    /// Starts the thread of a recording; removes the bag, which is empty, if that fails.
    fn spawn(
        &self,
        recording: &Arc<Recording>,
        recorder: Recorder<'static>,
        source: (Subscription, Slot),
        commands: Receiver<Command>,
    ) -> Result<JoinHandle<()>, Refusal> {
        let worker = Arc::clone(recording);
        let (events, figures) = (Arc::clone(&self.events), Arc::clone(&self.figures));
        let work = move || worker.work(recorder, source, &commands, &events, &figures);
        let thread = std::thread::Builder::new().name("recording".to_owned());
        thread.spawn(work).map_err(|error| {
            let _ = std::fs::remove_dir_all(&recording.directory);
            let reason = format!("no thread for it: {error}");
            self.events.record(AgentEvent::RecordingEnded {
                recording: recording.name.clone(),
                messages: 0,
                missing: 0,
                reason: Some(reason.clone()),
            });
            Refusal::Storage { reason }
        })
    }

    /// All of them, as they began.
    #[must_use]
    pub fn all(&self) -> Vec<Arc<Recording>> {
        let mut list = self.list();
        forget_ended(&mut list);
        list.clone()
    }

    /// The one of this name.
    #[must_use]
    pub fn find(&self, name: &str) -> Option<Arc<Recording>> {
        // The latest, should one have been deleted and begun again.
        self.list().iter().rfind(|each| each.name == name).cloned()
    }

    /// Completes all bags, when the agent ends.
    pub fn finish(&self) {
        let list = self.all();
        for recording in &list {
            recording.command(Command::Stop);
        }
        for recording in list {
            let thread = locked(&recording.thread).take();
            if let Some(thread) = thread
                && thread.join().is_err()
            {
                tracing::error!(recording = recording.name, "the recording's thread failed");
            }
        }
    }

    /// Where the agent writes.
    #[must_use]
    pub fn directory(&self) -> Option<&Path> {
        self.directory.as_deref()
    }

    /// What they may take of the disk.
    #[must_use]
    pub const fn limits(&self) -> RecordingLimits {
        self.limits
    }

    /// The room of a bag that is to lie there.
    pub(super) fn quota(&self, bag: &Path) -> DiskQuota {
        DiskQuota::new(bag.parent().unwrap_or(bag), self.limits)
    }

    /// Opens what `filter` takes, of one domain.
    fn subscribe(
        &self,
        filter: &Filter,
        domain_id: u32,
        name: &str,
    ) -> Result<Subscription, Refusal> {
        self.open(filter.selection()?, domain_id, name)
    }

    /// Opens these topics of one domain.
    pub(super) fn open(
        &self,
        topics: Selection,
        domain_id: u32,
        name: &str,
    ) -> Result<Subscription, Refusal> {
        Ok(self.subscriptions.open(Request {
            topics,
            domain_id: Some(domain_id),
            depth: Depth::Payloads,
            queue_bytes: self.queue_bytes,
            overflow: Overflow::DropOldest,
            label: format!("recording {name}"),
        })?)
    }

    /// What the snapshot and the library know.
    pub(super) fn sources(&self, domain_id: u32) -> Sources<'static> {
        let (latest, library) = (Arc::clone(&self.latest), Arc::clone(&self.library));
        let seen = Arc::clone(&self.latest);
        Sources {
            graph: Box::new(move || GraphSnapshot::from(seen.state().known())),
            announced: Box::new(move |names| {
                let state = latest.state();
                let topics = state.known().topics.iter();
                let topics = topics.filter(|topic| topic.domain_id == DomainId(domain_id));
                let topics: HashMap<_, _> =
                    topics.map(|topic| (topic.name.as_str(), topic)).collect();
                let announced = names.iter().map(|name| {
                    let topic = topics.get(name.as_str());
                    topic.map_or_else(DiscoveredTopic::default, |topic| {
                        DiscoveredTopic::from(*topic)
                    })
                });
                announced.collect()
            }),
            schema: Box::new(move |name, hash| schema(&library, name, hash)),
        }
    }

    /// Name and directory, checked.
    pub(super) fn bag_directory(&self, name: Option<String>) -> Result<(String, PathBuf), Refusal> {
        let Some(directory) = &self.directory else {
            return Err(Refusal::NoDirectory);
        };
        let name = name.unwrap_or_else(default_name);
        let plain = |c: char| c.is_ascii_alphanumeric() || matches!(c, '_' | '-' | '.');
        let is_name = !name.is_empty()
            && name.len() <= NAME
            && !name.starts_with('.')
            && name.chars().all(plain);
        if !is_name {
            return Err(Refusal::Name(name.chars().take(NAME).collect()));
        }
        let place = directory.join(&name);
        Ok((name, place))
    }

    fn list(&self) -> MutexGuard<'_, Vec<Arc<Recording>>> {
        locked(&self.list)
    }
}

impl Recording {
    /// How it goes, at most half a second ago.
    #[must_use]
    pub fn status(&self) -> Status {
        locked(&self.status).clone()
    }

    /// Asks for something; nothing happens where it is over.
    pub fn command(&self, command: Command) {
        // Nobody takes orders where it is over.
        let _ = locked(&self.commands).send(command);
    }

    /// Waits until the bag is complete, but no longer than `timeout`.
    pub async fn over(&self, timeout: Duration) -> bool {
        let wait = async {
            loop {
                let over = self.over.notified();
                if self.is_over() {
                    return;
                }
                over.await;
            }
        };
        tokio::time::timeout(timeout, wait).await.is_ok()
    }

    fn is_over(&self) -> bool {
        locked(&self.status).state == RecordingState::Ended
    }

    fn work(
        &self,
        recorder: Recorder<'static>,
        (mut subscription, slot): (Subscription, Slot),
        commands: &Receiver<Command>,
        events: &EventLog,
        figures: &RecordingFigures,
    ) {
        let next = |timeout| {
            let item = subscription.next_blocking(timeout);
            Ok::<_, std::convert::Infallible>(item.map_or(NextItem::Pending, NextItem::Item))
        };
        figures.active.fetch_add(1, Ordering::Relaxed);
        let mut counted = (0, 0, 0);
        let mut count = |report: &Report| {
            let now = (report.messages, report.bytes, report.missing);
            figures.add(
                now.0.saturating_sub(counted.0),
                now.1.saturating_sub(counted.1),
                now.2.saturating_sub(counted.2),
            );
            counted = now;
        };
        let (ended, _) = session::record(recorder, next, commands, |going| {
            if let Activity::Recording(recorder) = going {
                count(recorder.report());
                self.report_status(recorder);
            }
        });
        count(&ended.report);
        figures.active.fetch_sub(1, Ordering::Relaxed);
        drop((subscription, slot));
        let error = ended.error.as_ref().map(causes);
        events.record(AgentEvent::RecordingEnded {
            recording: self.name.clone(),
            messages: ended.report.messages,
            missing: ended.report.missing,
            reason: error.clone(),
        });
        self.finish(ended, error);
        // A bag of many topics takes much, and it may be long until the next one.
        give_back_memory();
    }

    fn report_status(&self, recorder: &Recorder<'_>) {
        let status = Status {
            state: if recorder.is_paused() {
                RecordingState::Paused
            } else {
                RecordingState::Recording
            },
            report: recorder.report().clone(),
            file_bytes: recorder.writer().bytes(),
            files: recorder.writer().files(),
            error: None,
        };
        *locked(&self.status) = status;
    }

    fn finish(&self, ended: Finished, error: Option<String>) {
        let summary = ended.summary.as_ref();
        let status = Status {
            state: RecordingState::Ended,
            report: ended.report,
            file_bytes: summary.map_or(0, |summary| summary.bytes),
            files: summary.map_or(0, |summary| summary.files.len()),
            error,
        };
        *locked(&self.status) = status;
        self.over.notify_waiters();
    }
}

/// What is behind a lock here is whole at any moment.
fn locked<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

/// The definition of a type for a bag, where there is one that its hash agrees with.
pub fn schema(library: &Library, name: &str, hash: Option<&str>) -> Option<Schema> {
    let found = library.find(name, hash).ok()?;
    let (encoding, text) = found.schema_text();
    Some(Schema {
        encoding: encoding.to_owned(),
        text: text.into(),
    })
}

/// Local time, as rosbag2 names its directories.
#[must_use]
pub fn default_name() -> String {
    Zoned::now()
        .strftime("rosbag2_%Y_%m_%d-%H_%M_%S")
        .to_string()
}

pub(super) fn refusal(name: &str, error: ros2probe_bag::Error) -> Refusal {
    match error {
        ros2probe_bag::Error::Exists(_) => Refusal::Exists(name.to_owned()),
        error => Refusal::Storage {
            reason: causes(&error),
        },
    }
}

/// An error with its causes.
pub(super) fn causes(error: &ros2probe_bag::Error) -> String {
    let mut text = error.to_string();
    let mut cause = std::error::Error::source(error);
    while let Some(next) = cause {
        text.push_str(&format!(": {next}"));
        cause = next.source();
    }
    text
}

/// Keeps the latest of those that ended.
fn forget_ended(list: &mut Vec<Arc<Recording>>) {
    let mut surplus = list.iter().filter(|each| each.is_over()).count();
    surplus = surplus.saturating_sub(ENDED);
    list.retain(|each| {
        let goes = surplus > 0 && each.is_over();
        surplus -= usize::from(goes);
        !goes
    });
}
