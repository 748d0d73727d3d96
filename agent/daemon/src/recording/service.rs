//! Recordings of the agent, started and ended by clients. Each runs on its own thread, and writes
//! only below the configured directory.

use std::collections::HashMap;
use std::path::{Path, PathBuf};
use std::sync::atomic::Ordering;
use std::sync::mpsc::{Receiver, Sender, channel};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::thread::JoinHandle;
use std::time::{Duration, Instant, SystemTime};

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
    Begin, Candidate, ChoiceError, Depth, NextItem, Overflow, Refused, Request, Selection,
    Subscription, Subscriptions,
};
use ros2probe_api::recording_report::Report;
use ros2probe_api::recordings::{FilterOptions, RecordingState};
use ros2probe_bag::{Error, Options, Schema, Writer};
use ros2probe_capture::system::give_back_memory;
use ros2probe_message::Library;
use ros2probe_wire::DomainId;

/// Maximum number of ended recordings whose report is kept.
const MAX_ENDED: usize = 16;
/// Maximum sizes of a bag's chunk and of a file's index in memory, in bytes.
const CHUNK_BYTES: u64 = 1 << 20;
const INDEX_BYTES: u64 = 1 << 20;
/// Maximum time in which recordings complete their bags at the end of the agent. A service manager
/// kills an agent that takes much longer, for example to compress whole files.
const FINISH_TIMEOUT: Duration = session::DRAIN_TIMEOUT.saturating_add(Duration::from_secs(1));
/// Interval at which the end of the agent checks whether the bags are complete.
const FINISH_POLL: Duration = Duration::from_millis(20);
/// Maximum length of the name of a recording, in bytes.
const MAX_NAME: usize = 128;

/// All recordings of an agent.
#[derive(Debug)]
pub struct Recordings {
    /// Directory of the bags; `None` if recordings are refused.
    directory: Option<PathBuf>,
    limits: RecordingLimits,
    queue_bytes: usize,
    latest: Arc<SnapshotCell>,
    pub(super) events: Arc<EventLog>,
    caps: Arc<LimitFigures>,
    pub(super) figures: Arc<RecordingFigures>,
    subscriptions: Arc<Subscriptions>,
    library: Arc<Library>,
    /// State directory with the receipts of delivered bags; `None` if bags are not delivered.
    receipts: Option<PathBuf>,
    list: Mutex<Vec<Arc<Recording>>>,
    /// Held while a recording begins. A slow storage delays other starts, but no list.
    beginning: Mutex<()>,
    slots: Arc<Slots>,
}

/// Parts that recordings need.
#[derive(Debug)]
pub struct Components {
    /// Directory of the bags; `None` if recordings are refused.
    pub directory: Option<PathBuf>,
    /// Limits of disk usage.
    pub limits: RecordingLimits,
    /// Maximum number of bytes of each recording that wait for the storage.
    pub queue_bytes: usize,
    /// Latest snapshot of the model.
    pub latest: Arc<SnapshotCell>,
    /// Log for the start and end of recordings.
    pub events: Arc<EventLog>,
    /// Caps on the number of recordings and topics.
    pub caps: Arc<LimitFigures>,
    /// Counters of written messages.
    pub figures: Arc<RecordingFigures>,
    /// Source of messages.
    pub subscriptions: Arc<Subscriptions>,
    /// Definitions of messages.
    pub library: Arc<Library>,
    /// State directory with the receipts of delivered bags; `None` if bags are not delivered.
    pub receipts: Option<PathBuf>,
}

/// Recording requested by a client.
#[derive(Debug)]
pub struct RecordingOptions {
    /// Name of the directory; the current time if omitted.
    pub name: Option<String>,
    /// Selection of topics.
    pub requested: FilterOptions,
    /// Domain of the topics.
    pub domain_id: u32,
    /// Options of the bag.
    pub options: Options,
    /// Whether it starts paused.
    pub paused: bool,
}

/// One recording.
#[derive(Debug)]
pub struct Recording {
    /// Name of its directory.
    pub name: String,
    /// Path of its directory.
    pub directory: PathBuf,
    /// Domain of the topics.
    pub domain_id: u32,
    /// Selection of topics.
    pub requested: FilterOptions,
    /// Time of its start.
    pub began: SystemTime,
    begin: Begin,
    status: Mutex<Status>,
    commands: Mutex<Sender<Command>>,
    thread: Mutex<Option<JoinHandle<()>>>,
    completed: Notify,
}

impl Recording {
    /// Returns a handle that waits until each message of the requested topics is captured.
    #[must_use]
    pub const fn begin(&self) -> &Begin {
        &self.begin
    }
}

/// Status of a recording.
#[derive(Clone, Debug, Default)]
pub struct Status {
    /// State of the recording.
    pub state: RecordingState,
    /// Recorded and missing messages.
    pub report: Report,
    /// Bytes of its files.
    pub file_bytes: u64,
    /// Number of files, including the open one.
    pub files: usize,
    /// Reason of an end that was not requested.
    pub error: Option<String>,
}

/// Why a recording was refused.
#[derive(Debug, thiserror::Error)]
pub enum Refusal {
    /// No directory is available.
    #[error(
        "the agent has no directory for recordings: set `recordings.directory`, or record with \
         `rp bag record`"
    )]
    NoDirectory,
    /// The name is not a valid directory name.
    #[error(
        "`{0}` is not a valid name: use letters, digits, `_`, `-` and `.`, not starting with \
             `.`"
    )]
    Name(String),
    /// A bag of this name exists.
    #[error("a recording named `{0}` already exists")]
    Exists(String),
    /// The number of active recordings is at its limit.
    #[error("{0} recordings are running, which is the limit (limits.recordings)")]
    TooMany(usize),
    /// The selection is invalid.
    #[error(transparent)]
    Filter(#[from] FilterError),
    /// A topic's name is invalid.
    #[error(transparent)]
    Choice(#[from] ChoiceError),
    /// The subscription was refused.
    #[error(transparent)]
    Subscription(#[from] Refused),
    /// The bag cannot be written.
    #[error("{reason}")]
    Storage {
        /// Error with its causes.
        reason: String,
    },
}

impl Recordings {
    /// Creates the service without recordings.
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
            receipts,
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
            receipts,
            list: Mutex::new(Vec::new()),
            beginning: Mutex::new(()),
        }
    }

    /// Starts a recording. Its subscription is open when this returns; see [`Recording::begin`].
    ///
    /// # Errors
    ///
    /// Returns [`Refusal`] if the recording cannot start.
    pub fn begin(&self, wanted: RecordingOptions) -> Result<Arc<Recording>, Refusal> {
        self.begin_with(wanted, Writer::create)
    }

    fn begin_with(
        &self,
        wanted: RecordingOptions,
        create: impl FnOnce(&Path, Options) -> Result<Writer, Error>,
    ) -> Result<Arc<Recording>, Refusal> {
        let filter = Filter::new(wanted.requested.clone())?;
        let (name, directory) = self.bag_directory(wanted.name)?;
        let _beginning = locked(&self.beginning);
        let Some(place) = self.slots.take() else {
            self.caps.reached(Limit::Recordings, 1);
            return Err(Refusal::TooMany(self.slots.cap()));
        };
        let quota = self.quota(&directory);
        quota.check().map_err(|error| refusal(&name, error))?;
        let before = GraphSnapshot::from(&*self.latest.state());
        let subscription = self.subscribe(&filter, wanted.domain_id, &name)?;
        let mut options = wanted.options;
        options.storage.chunk_bytes = options.storage.chunk_bytes.min(CHUNK_BYTES);
        options.max_index_bytes = Some(INDEX_BYTES);
        let writer = create(&directory, options).map_err(|error| refusal(&name, error))?;
        let sources = self.sources(wanted.domain_id);
        let mut recorder =
            Recorder::new(writer, filter, wanted.domain_id, before, sources).with_quota(quota);
        recorder.pause(wanted.paused);
        self.declare(&mut recorder, &subscription, wanted.domain_id)
            .map_err(|error| refusal(&name, error))?;
        let (give, commands) = channel();
        let recording = Arc::new(Recording {
            name,
            directory,
            domain_id: wanted.domain_id,
            requested: wanted.requested,
            began: SystemTime::now(),
            begin: subscription.begin(),
            status: Mutex::default(),
            commands: Mutex::new(give),
            thread: Mutex::default(),
            completed: Notify::new(),
        });
        self.events.record(AgentEvent::RecordingStarted {
            recording: recording.name.clone(),
        });
        let thread = self.spawn(&recording, recorder, (subscription, place), commands)?;
        *locked(&recording.thread) = Some(thread);
        let mut list = self.list();
        list.push(Arc::clone(&recording));
        forget_ended(&mut list);
        Ok(recording)
    }

    /// Adds the known topics of the subscription to the bag, at most as many as can be measured.
    /// Thousands of announced topics thus cannot fill a bag.
    fn declare(
        &self,
        recorder: &mut Recorder<'_>,
        subscription: &Subscription,
        domain_id: u32,
    ) -> Result<(), Error> {
        let state = self.latest.state();
        let selection = subscription.selection();
        let covered = state.known().topics.iter().filter(|topic| {
            topic.domain_id == DomainId(domain_id) && selection.covers(&Candidate::from(*topic))
        });
        let covered = covered.take(self.caps.caps().topics);
        recorder.declare(covered.map(|topic| (topic.name.as_str(), topic.message_types.as_slice())))
    }

    /// Starts the thread of a recording. Removes the empty bag on failure.
    fn spawn(
        &self,
        recording: &Arc<Recording>,
        recorder: Recorder<'static>,
        source: (Subscription, Slot),
        commands: Receiver<Command>,
    ) -> Result<JoinHandle<()>, Refusal> {
        let worker = Arc::clone(recording);
        let (events, figures) = (Arc::clone(&self.events), Arc::clone(&self.figures));
        let work = move || worker.record(recorder, source, &commands, &events, &figures);
        let thread = std::thread::Builder::new().name("recording".to_owned());
        thread.spawn(work).map_err(|error| {
            let _ = std::fs::remove_dir_all(&recording.directory);
            let reason = format!("cannot start the recording's thread: {error}");
            self.events.record(AgentEvent::RecordingEnded {
                recording: recording.name.clone(),
                messages: 0,
                missing: 0,
                reason: Some(reason.clone()),
            });
            Refusal::Storage { reason }
        })
    }

    /// Returns all recordings in the order of their start.
    #[must_use]
    pub fn all(&self) -> Vec<Arc<Recording>> {
        let mut list = self.list();
        forget_ended(&mut list);
        list.clone()
    }

    /// Returns the recording of this name; `None` if it does not exist.
    #[must_use]
    pub fn find(&self, name: &str) -> Option<Arc<Recording>> {
        // The latest recording counts, since the name of a deleted one can be used again.
        self.list().iter().rfind(|each| each.name == name).cloned()
    }

    /// Completes all bags at the end of the agent. Whole files that are not compressed within some
    /// seconds stay uncompressed.
    pub fn finish(&self) {
        self.finish_within(FINISH_TIMEOUT);
    }

    fn finish_within(&self, timeout: Duration) {
        let deadline = Instant::now() + timeout;
        // A recording that begins at this moment is completed as well.
        drop(locked(&self.beginning));
        let list = self.all();
        for recording in &list {
            recording.command(Command::Stop);
        }
        while !list.iter().all(|recording| recording.has_thread_ended())
            && Instant::now() < deadline
        {
            std::thread::sleep(FINISH_POLL);
        }
        for recording in &list {
            recording.command(Command::Abort);
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

    /// Returns the directory of the bags; `None` if recordings are refused.
    #[must_use]
    pub fn directory(&self) -> Option<&Path> {
        self.directory.as_deref()
    }

    /// Returns the limits of disk usage.
    #[must_use]
    pub const fn limits(&self) -> RecordingLimits {
        self.limits
    }

    /// Creates a quota for a bag at this path.
    pub(super) fn quota(&self, bag: &Path) -> DiskQuota {
        DiskQuota::new(bag.parent().unwrap_or(bag), self.limits)
    }

    /// Subscribes to topics selected by `filter` in one domain.
    fn subscribe(
        &self,
        filter: &Filter,
        domain_id: u32,
        name: &str,
    ) -> Result<Subscription, Refusal> {
        self.open(filter.selection()?, domain_id, name)
    }

    /// Subscribes to these topics of one domain.
    pub(super) fn open(
        &self,
        topics: Selection,
        domain_id: u32,
        name: &str,
    ) -> Result<Subscription, Refusal> {
        Ok(self.subscriptions.open(Request {
            topics,
            domain_id: Some(DomainId(domain_id)),
            depth: Depth::Payloads,
            queue_bytes: self.queue_bytes,
            overflow: Overflow::DropOldest,
            is_clock_complete: true,
            latched: true,
            label: format!("recording {name}"),
        })?)
    }

    /// Returns the sources for a recorder, from the snapshot and the library.
    pub(super) fn sources(&self, domain_id: u32) -> Sources<'static> {
        let (latest, library) = (Arc::clone(&self.latest), Arc::clone(&self.library));
        let seen = Arc::clone(&self.latest);
        Sources {
            graph: Box::new(move || GraphSnapshot::from(&*seen.state())),
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

    /// Returns whether a bag may be removed for another one: if bags are delivered, only a
    /// delivered one.
    pub(super) fn may_remove(&self, bag: &Path) -> bool {
        let receipts = self.receipts.as_deref();
        receipts.is_none_or(|state| ros2probe_ship::is_delivered(state, bag))
    }

    /// Returns the validated name and the path of a new bag.
    pub(super) fn bag_directory(&self, name: Option<String>) -> Result<(String, PathBuf), Refusal> {
        let Some(directory) = &self.directory else {
            return Err(Refusal::NoDirectory);
        };
        let name = name.unwrap_or_else(default_name);
        let plain = |c: char| c.is_ascii_alphanumeric() || matches!(c, '_' | '-' | '.');
        let is_name = !name.is_empty()
            && name.len() <= MAX_NAME
            && !name.starts_with('.')
            && name.chars().all(plain);
        if !is_name {
            return Err(Refusal::Name(name.chars().take(MAX_NAME).collect()));
        }
        let place = directory.join(&name);
        Ok((name, place))
    }

    fn list(&self) -> MutexGuard<'_, Vec<Arc<Recording>>> {
        locked(&self.list)
    }
}

impl Recording {
    /// Returns the status, which is at most half a second old.
    #[must_use]
    pub fn status(&self) -> Status {
        locked(&self.status).clone()
    }

    /// Sends a command. Does nothing if the recording has ended.
    pub fn command(&self, command: Command) {
        // Fails only if the recording has ended.
        let _ = locked(&self.commands).send(command);
    }

    /// Waits at most `timeout` for the bag to be complete. Returns whether the bag is complete.
    pub async fn wait_complete(&self, timeout: Duration) -> bool {
        let wait = async {
            loop {
                let over = self.completed.notified();
                if self.is_complete() {
                    return;
                }
                over.await;
            }
        };
        tokio::time::timeout(timeout, wait).await.is_ok()
    }

    fn has_thread_ended(&self) -> bool {
        let thread = locked(&self.thread);
        thread.as_ref().is_none_or(JoinHandle::is_finished)
    }

    fn is_complete(&self) -> bool {
        locked(&self.status).state == RecordingState::Ended
    }

    fn record(
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
        let (ended, _) = session::record(
            recorder,
            next,
            || false,
            commands,
            |going| {
                if let Activity::Recording(recorder) = going {
                    count(recorder.report());
                    self.report_status(recorder);
                }
            },
        );
        count(&ended.report);
        figures.active.fetch_sub(1, Ordering::Relaxed);
        drop((subscription, slot));
        let error = ended.error.as_ref().map(causes);
        if let Some(reason) = &error {
            tracing::warn!(recording = self.name, reason, "a recording ended early");
        }
        events.record(AgentEvent::RecordingEnded {
            recording: self.name.clone(),
            messages: ended.report.messages,
            missing: ended.report.missing,
            reason: error.clone(),
        });
        self.finish(ended, error);
        // A bag of many topics uses much memory, and the next recording may begin much later.
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
        self.completed.notify_waiters();
    }
}

/// Locks the mutex. A poisoned lock is usable, since the contents are always consistent.
fn locked<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Returns the definition of a type for a bag; `None` if no definition has this name and hash.
pub fn schema(library: &Library, name: &str, hash: Option<&str>) -> Option<Schema> {
    let found = library.find(name, hash).ok()?;
    let (encoding, text) = found.schema_text();
    Some(Schema {
        encoding: encoding.to_owned(),
        text: text.into(),
    })
}

/// Returns the name of a bag from the local time, in the format of rosbag2.
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

/// Returns the text of an error with its causes.
pub(super) fn causes(error: &ros2probe_bag::Error) -> String {
    let mut text = error.to_string();
    let mut cause = std::error::Error::source(error);
    while let Some(next) = cause {
        text.push_str(&format!(": {next}"));
        cause = next.source();
    }
    text
}

/// Removes all but the latest ended recordings.
fn forget_ended(list: &mut Vec<Arc<Recording>>) {
    let mut surplus = list.iter().filter(|each| each.is_complete()).count();
    surplus = surplus.saturating_sub(MAX_ENDED);
    list.retain(|each| {
        let goes = surplus > 0 && each.is_complete();
        surplus -= usize::from(goes);
        !goes
    });
}

#[cfg(test)]
mod tests {
    use ros2probe_message::Sources as LibrarySources;
    use tokio_util::sync::CancellationToken;

    use super::*;
    use crate::agent_facts::SourceKind;
    use crate::config::Limits;
    use crate::subscriptions::Caps;

    impl Components {
        /// Returns the parts of an agent without messages, which records into this directory.
        pub(crate) fn in_directory(directory: &Path) -> Self {
            let latest = Arc::new(SnapshotCell::new(SourceKind::Wire));
            let caps = Caps {
                subscriptions: 4,
                bytes: 1 << 20,
            };
            let stop = CancellationToken::new();
            let subscriptions = Arc::new(Subscriptions::new(Arc::clone(&latest), caps, stop));
            Self {
                directory: Some(directory.to_owned()),
                limits: RecordingLimits {
                    reserve_percent: 0,
                    reserve_bytes: 0,
                    ..RecordingLimits::default()
                },
                queue_bytes: 1 << 20,
                latest,
                events: Arc::new(EventLog::new()),
                caps: Arc::new(LimitFigures::new(Limits::default())),
                figures: Arc::new(RecordingFigures::default()),
                subscriptions,
                library: Arc::new(Library::new(LibrarySources::default())),
                receipts: None,
            }
        }
    }

    fn wanted(name: &str) -> RecordingOptions {
        RecordingOptions {
            name: Some(name.to_owned()),
            requested: FilterOptions::everything(),
            domain_id: 0,
            options: Options::default(),
            paused: false,
        }
    }

    /// Earlier, the end of the agent waited without bound for the compression of whole files.
    #[test]
    fn a_recording_that_completes_too_slowly_is_aborted_at_the_end_of_the_agent() {
        let directory = tempfile::tempdir().unwrap();
        let recordings = Recordings::new(Components::in_directory(directory.path()));
        let recording = recordings.begin(wanted("drive")).unwrap();
        // Without a clock of the source, it would wait for messages in flight.
        let begun = Instant::now();
        recordings.finish_within(Duration::ZERO);
        assert!(begun.elapsed() < session::DRAIN_TIMEOUT);
        assert_eq!(recording.status().state, RecordingState::Ended);
        assert!(recording.directory.join("metadata.yaml").exists());
    }

    #[test]
    fn recordings_are_listed_while_the_storage_of_a_new_one_is_slow() {
        let directory = tempfile::tempdir().unwrap();
        let recordings = Recordings::new(Components::in_directory(directory.path()));
        let begun = recordings.begin_with(wanted("slow"), |directory, options| {
            assert!(recordings.list.try_lock().is_ok(), "the list is locked");
            assert!(recordings.all().is_empty() && recordings.find("slow").is_none());
            Writer::create(directory, options)
        });
        let recording = begun.unwrap();
        assert_eq!(recordings.all().len(), 1);
        recording.command(Command::Abort);
        recordings.finish();
        assert_eq!(recording.status().state, RecordingState::Ended);
    }
}
