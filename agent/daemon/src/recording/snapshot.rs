//! Snapshots: the last seconds of chosen topics, always in memory, written into a bag when something
//! happens: an expectation is violated, a client asks, the agent gets SIGUSR1.
//!
//! Bounded in bytes and seconds; what that costs is shown. A robot that goes on failing fills no
//! disk: one bag at most for each length of the snapshot, and a sum of bytes for all of them.

use std::collections::HashSet;
use std::path::PathBuf;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, SyncSender, sync_channel};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use tokio::sync::oneshot;

use super::filter::Filter;
use super::graph::GraphSnapshot;
use super::recorder::Recorder;
use super::sample_ring::SampleRing;
use super::service::{Recordings, Refusal, causes, default_name, refusal};
use crate::config::SnapshotSettings;
use crate::events::AgentEvent;
use crate::events::Value;
use crate::recording::SnapshotFigures;
use crate::subscriptions::{Item, Selection, Subscription};
use ros2probe_api::recordings::FilterOptions;
use ros2probe_bag::{Options, Writer};

/// How long orders and events wait at most.
const POLL_INTERVAL: Duration = Duration::from_millis(100);
/// Between two bags, at least.
const PAUSE: Duration = Duration::from_secs(10);
/// All bags of one snapshot together.
const DISK: u64 = 1 << 30;
/// Clients that wait for one at once.
const CLIENTS: usize = 8;
const EXPECTATION: &str = "ros2.topic.expectation_changed";

/// A bag that was written.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct WrittenBag {
    /// Name of its directory.
    pub name: String,
    /// Where it lies.
    pub directory: PathBuf,
    /// Messages in it.
    pub messages: u64,
}

type Answer = oneshot::Sender<Result<WrittenBag, String>>;

/// All snapshots of the configuration.
#[derive(Debug, Default)]
pub struct Snapshots {
    list: Vec<Snapshot>,
    stop: Arc<AtomicBool>,
}

#[derive(Debug)]
struct Snapshot {
    settings: SnapshotSettings,
    clients: SyncSender<Answer>,
    asked: Arc<AtomicBool>,
    thread: Mutex<Option<JoinHandle<()>>>,
}

/// What its thread works with.
struct SnapshotTask {
    settings: SnapshotSettings,
    recordings: Arc<Recordings>,
    ring: SampleRing,
    figures: SnapshotFigures,
    /// The last event that was looked at.
    event: u64,
    written: Option<Instant>,
}

impl Snapshots {
    /// Keeps them from now on.
    ///
    /// # Errors
    /// There is no directory, no room for a subscription, or no thread.
    pub fn start(
        settings: &[SnapshotSettings],
        recordings: &Arc<Recordings>,
    ) -> Result<Self, Refusal> {
        let stop = Arc::new(AtomicBool::new(false));
        let mut list = Vec::new();
        for settings in settings {
            if recordings.directory().is_none() {
                return Err(Refusal::NoDirectory);
            }
            let names = settings.topics.iter().map(String::as_str);
            let selection = Selection::named(names)?;
            let subscription = recordings.open(selection, settings.domain_id, &settings.name)?;
            let (clients, waiting) = sync_channel(CLIENTS);
            let asked = Arc::new(AtomicBool::new(false));
            let keeper = SnapshotTask {
                settings: settings.clone(),
                recordings: Arc::clone(recordings),
                ring: SampleRing::new(settings.max_bytes, Some(settings.span)),
                figures: SnapshotFigures::default(),
                event: recordings.events.last(),
                written: None,
            };
            let (stopping, ordered) = (Arc::clone(&stop), Arc::clone(&asked));
            let work = move || keeper.work(subscription, &waiting, &ordered, &stopping);
            let thread = std::thread::Builder::new().name("snapshot".to_owned());
            let thread = thread.spawn(work).map_err(|error| Refusal::Storage {
                reason: format!("no thread for the snapshot: {error}"),
            })?;
            list.push(Snapshot {
                settings: settings.clone(),
                clients,
                asked,
                thread: Mutex::new(Some(thread)),
            });
        }
        Ok(Self { list, stop })
    }

    /// Those that are kept.
    pub fn settings(&self) -> impl Iterator<Item = &SnapshotSettings> {
        self.list.iter().map(|snapshot| &snapshot.settings)
    }

    /// Has the one of this name written, whatever was written before; `None` = there is none.
    pub async fn write(&self, name: &str) -> Option<Result<WrittenBag, String>> {
        let snapshot = self.list.iter().find(|each| each.settings.name == name)?;
        let (answer, written) = oneshot::channel();
        if snapshot.clients.try_send(answer).is_err() {
            return Some(Err("too many clients wait for it".to_owned()));
        }
        let written = written.await;
        Some(written.unwrap_or_else(|_| Err("the agent is shutting down".to_owned())))
    }

    /// Has all of them written.
    pub fn write_all(&self) {
        for snapshot in &self.list {
            snapshot.asked.store(true, Ordering::Relaxed);
        }
    }

    /// When the agent ends.
    pub fn finish(&self) {
        self.stop.store(true, Ordering::Relaxed);
        for snapshot in &self.list {
            let thread = snapshot.thread.lock();
            let thread = thread.unwrap_or_else(PoisonError::into_inner).take();
            if thread.is_some_and(|thread| thread.join().is_err()) {
                tracing::error!(snapshot = snapshot.settings.name, "its thread failed");
            }
        }
    }
}

impl SnapshotTask {
    fn work(
        mut self,
        mut subscription: Subscription,
        clients: &Receiver<Answer>,
        asked: &AtomicBool,
        stop: &AtomicBool,
    ) {
        let mut looked = Instant::now();
        while !stop.load(Ordering::Relaxed) {
            match subscription.next_blocking(POLL_INTERVAL) {
                Some(Item::Sample(sample)) => self.ring.push(sample),
                Some(Item::Clock(now)) => self.ring.advance(now),
                Some(Item::Missed(_)) => {}
                Some(Item::End(_)) => std::thread::sleep(POLL_INTERVAL),
                None => {}
            }
            if looked.elapsed() < POLL_INTERVAL {
                continue;
            }
            looked = Instant::now();
            self.show();
            if let Ok(client) = clients.try_recv() {
                // Who does not wait any more has it in the directory all the same.
                let _ = client.send(self.write());
            }
            let violated = self.settings.on_violation && self.is_violated();
            let asked = asked.swap(false, Ordering::Relaxed);
            let pause = self.settings.span.max(PAUSE);
            let rested = self
                .written
                .is_none_or(|written| written.elapsed() >= pause);
            // A topic that never came is no incident that something was kept of.
            if asked || (violated && rested && !self.ring.is_empty()) {
                // Told as an event.
                let _ = self.write();
            }
        }
    }

    /// Whether an expectation has been broken since the last look.
    fn is_violated(&mut self) -> bool {
        let events = Arc::clone(&self.recordings.events);
        let mut violated = false;
        while events.last() > self.event {
            let batch = events.read(self.event, 256);
            self.event = batch.last;
            for record in batch.records {
                let to = record.attributes.iter().find(|(name, _)| *name == "to");
                let is_ok = matches!(to, Some((_, Value::Text(to))) if to == "ok");
                violated |= record.definition.name == EXPECTATION && !is_ok;
            }
        }
        violated
    }

    fn write(&mut self) -> Result<WrittenBag, String> {
        self.written = Some(Instant::now());
        let (name, outcome) = self.bag();
        match &outcome {
            Ok(_) => self.figures.written += 1,
            Err(_) => self.figures.failed += 1,
        }
        self.recordings.events.record(AgentEvent::SnapshotTaken {
            snapshot: self.settings.name.clone(),
            recording: name,
            messages: outcome.as_ref().map_or(0, |written| written.messages),
            reason: outcome.as_ref().err().cloned(),
        });
        self.show();
        outcome
    }

    /// What is kept, in a bag of its own; it stays in memory where that fails.
    fn bag(&mut self) -> (String, Result<WrittenBag, String>) {
        let base = format!("{}_{}", self.settings.name, default_name());
        let mut wanted = base.clone();
        let directory = self.recordings.directory();
        let mut copies = 1;
        while directory.is_some_and(|directory| directory.join(&wanted).exists()) {
            // Another one in the same second.
            copies += 1;
            wanted = format!("{base}_{copies}");
        }
        let (name, directory) = match self.recordings.bag_directory(Some(wanted.clone())) {
            Ok(place) => place,
            Err(refusal) => return (wanted, Err(refusal.to_string())),
        };
        let used = self.used();
        if used >= DISK {
            let reason = format!(
                "the snapshots there take {used} bytes already, of {DISK} they may: remove some"
            );
            return (name, Err(reason));
        }
        let write = || -> Result<WrittenBag, Refusal> {
            let filter = Filter::new(FilterOptions {
                include_hidden_topics: true,
                all_services: true,
                ..FilterOptions::everything()
            })?;
            let quota = self.recordings.quota(&directory);
            quota.check().map_err(|error| refusal(&name, error))?;
            let writer = Writer::create(&directory, Options::default());
            let writer = writer.map_err(|error| refusal(&name, error))?;
            let mut sources = self.recordings.sources(self.settings.domain_id);
            let domain_id = self.settings.domain_id;
            // The report is about the topics in memory, not about what else is there.
            let names = self.ring.iter().map(|sample| sample.topic.name.to_string());
            let names: HashSet<String> = names.collect();
            let mut all = sources.graph;
            sources.graph = Box::new(move || {
                let mut graph = all();
                graph.unknown_writers.clear();
                graph
                    .topics
                    .retain(|topic| topic.domain_id == domain_id && names.contains(&topic.name));
                graph
            });
            let before = GraphSnapshot::default();
            let mut recorder =
                Recorder::new(writer, filter, domain_id, before, sources).within(quota);
            let mut failed = None;
            for sample in self.ring.iter() {
                if let Err(error) = recorder.take(&Item::Sample(Arc::clone(sample))) {
                    failed = Some(error);
                    break;
                }
            }
            let ended = recorder.finish(failed);
            if let Some(error) = &ended.error {
                return Err(Refusal::Storage {
                    reason: causes(error),
                });
            }
            Ok(WrittenBag {
                name: name.clone(),
                directory: directory.clone(),
                messages: ended.report.messages,
            })
        };
        let outcome = write();
        match &outcome {
            Ok(_) => self.ring.clear(),
            // There was one before this.
            Err(Refusal::Exists(_)) => {}
            // All of it is still in memory: the part of a bag is of no use, and would be
            // joined by the next one.
            Err(_) => {
                let _ = std::fs::remove_dir_all(&directory);
            }
        }
        (name, outcome.map_err(|refusal| refusal.to_string()))
    }

    /// Bytes of the bags of this snapshot that still lie there.
    fn used(&self) -> u64 {
        let prefix = format!("{}_rosbag2_", self.settings.name);
        let entries = |path: &std::path::Path| std::fs::read_dir(path).into_iter().flatten();
        let directory = self.recordings.directory();
        let bags = directory.into_iter().flat_map(entries).flatten();
        let ours = bags.filter(|bag| bag.file_name().to_string_lossy().starts_with(&prefix));
        let files = ours.flat_map(|bag| entries(&bag.path()).flatten().collect::<Vec<_>>());
        let sizes = files.filter_map(|file| Some(file.metadata().ok()?.len()));
        sizes.sum()
    }

    fn show(&mut self) {
        self.figures.messages = self.ring.len() as u64;
        self.figures.bytes = self.ring.bytes() as u64;
        self.figures.crowded_out = self.ring.crowded_out();
        let figures = &self.recordings.figures;
        figures.snapshot(&self.settings.name, self.figures);
    }
}
