//! Snapshots: the last seconds of selected topics in memory, written into a bag on an event of the
//! configuration, a client's request, or SIGUSR1. After an event, the following seconds are added.
//!
//! The memory is bounded in bytes and seconds, and its use is reported. Repeated events cannot fill
//! the disk: triggered bags have a minimum interval, and their number and bytes are limited. A
//! requested bag is never removed.

mod bag;
mod retention;
mod task;
#[cfg(test)]
mod tests;

use std::path::PathBuf;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{SyncSender, sync_channel};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread::JoinHandle;

use tokio::sync::oneshot;

pub use self::bag::TriggeredBag;
use self::task::SnapshotTask;
use super::service::{Recordings, Refusal};
use crate::config::SnapshotSettings;
use crate::subscriptions::Selection;

/// Maximum number of clients that wait for a bag at the same time.
const CLIENTS: usize = 8;

/// A bag that was written.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct WrittenBag {
    /// Name of its directory.
    pub name: String,
    /// Path of its directory.
    pub directory: PathBuf,
    /// Number of messages in it.
    pub messages: u64,
}

/// Why a requested bag was not written.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum Unwritten {
    /// [`CLIENTS`] clients are already waiting.
    #[error("too many clients wait for this snapshot")]
    Busy,
    /// The snapshot's thread has ended.
    #[error("the agent is shutting down")]
    ShuttingDown,
    /// No directory, no space, or an error of the storage, with its causes.
    #[error("{0}")]
    Storage(String),
}

type Answer = oneshot::Sender<Result<WrittenBag, Unwritten>>;

/// All configured snapshots.
#[derive(Debug, Default)]
pub struct Snapshots {
    list: Vec<Snapshot>,
    stop: Arc<AtomicBool>,
}

#[derive(Debug)]
struct Snapshot {
    settings: SnapshotSettings,
    clients: SyncSender<Answer>,
    is_requested: Arc<AtomicBool>,
    thread: Mutex<Option<JoinHandle<()>>>,
}

impl Snapshots {
    /// Starts one buffer and one thread for each configured snapshot.
    ///
    /// # Errors
    ///
    /// Fails if no directory is available, a subscription is refused, or a thread cannot be
    /// started.
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
            let keeper = SnapshotTask::new(settings.clone(), Arc::clone(recordings));
            let (stopping, ordered) = (Arc::clone(&stop), Arc::clone(&asked));
            let work = move || keeper.run(subscription, &waiting, &ordered, &stopping);
            let thread = std::thread::Builder::new().name("snapshot".to_owned());
            let thread = thread.spawn(work).map_err(|error| Refusal::Storage {
                reason: format!("cannot start the snapshot's thread: {error}"),
            })?;
            list.push(Snapshot {
                settings: settings.clone(),
                clients,
                is_requested: asked,
                thread: Mutex::new(Some(thread)),
            });
        }
        Ok(Self { list, stop })
    }

    /// Iterates over the settings of all snapshots.
    pub fn settings(&self) -> impl Iterator<Item = &SnapshotSettings> {
        self.list.iter().map(|snapshot| &snapshot.settings)
    }

    /// Writes the messages in memory immediately, regardless of earlier bags; returns `None` if the
    /// snapshot does not exist.
    pub async fn write(&self, name: &str) -> Option<Result<WrittenBag, Unwritten>> {
        let snapshot = self.list.iter().find(|each| each.settings.name == name)?;
        let (answer, written) = oneshot::channel();
        if snapshot.clients.try_send(answer).is_err() {
            return Some(Err(Unwritten::Busy));
        }
        let written = written.await;
        Some(written.unwrap_or(Err(Unwritten::ShuttingDown)))
    }

    /// Requests a bag of each snapshot.
    pub fn write_all(&self) {
        for snapshot in &self.list {
            snapshot.is_requested.store(true, Ordering::Relaxed);
        }
    }

    /// Stops all snapshots at the end of the agent.
    pub fn finish(&self) {
        self.stop.store(true, Ordering::Relaxed);
        for snapshot in &self.list {
            let thread = snapshot.thread.lock();
            let thread = thread.unwrap_or_else(PoisonError::into_inner).take();
            if thread.is_some_and(|thread| thread.join().is_err()) {
                tracing::error!(
                    snapshot = snapshot.settings.name,
                    "the snapshot's thread failed"
                );
            }
        }
    }
}
