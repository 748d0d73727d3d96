//! History of the last days in the state directory: the store, and the counters of its writes.

use std::io;
use std::path::{Path, PathBuf};
use std::sync::OnceLock;
use std::sync::atomic::{AtomicU64, Ordering};

use ros2probe_history::Store;

/// Subdirectory of the state directory.
const HISTORY_DIRECTORY: &str = "history";

/// History on disk. The thread that writes it also opens it: a slow storage must not delay the
/// start of the agent.
#[derive(Debug, Default)]
pub struct DiskHistory {
    /// Directory, and maximum size in bytes; empty if no history is kept.
    place: OnceLock<(PathBuf, u64)>,
    /// `None` inside if the directory cannot be read.
    store: OnceLock<Option<Store>>,
    writes: AtomicU64,
    failures: AtomicU64,
}

impl DiskHistory {
    /// Selects the directory below the state directory, and its maximum size in bytes.
    pub fn keep_in(&self, state_directory: &Path, limit: u64) {
        let _ = self
            .place
            .set((state_directory.join(HISTORY_DIRECTORY), limit));
    }

    /// Opens the history, and logs why that fails. Returns whether a history is kept.
    pub fn open(&self) -> bool {
        let Some((directory, limit)) = self.place.get() else {
            return false;
        };
        let opened = Store::open(directory, *limit);
        if let Err(error) = &opened {
            let path = directory.display();
            tracing::warn!(%path, %error, "no history is kept on disk: charts reach back some minutes");
        }
        let _ = self.store.set(opened.ok());
        self.is_kept()
    }

    /// Returns whether a history is kept, also if it is not opened yet.
    #[must_use]
    pub fn is_kept(&self) -> bool {
        self.place.get().is_some() && !matches!(self.store.get(), Some(None))
    }

    /// Returns the store; `None` if no history is kept, or if it is not opened yet.
    #[must_use]
    pub fn store(&self) -> Option<&Store> {
        self.store.get()?.as_ref()
    }

    /// Waits until the store is opened. Returns `None` if no history is kept.
    #[must_use]
    pub fn opened(&self) -> Option<&Store> {
        self.place.get()?;
        self.store.wait().as_ref()
    }

    /// Counts a write.
    pub fn count(&self, written: &io::Result<()>) {
        let counter = match written {
            Ok(()) => &self.writes,
            Err(_) => &self.failures,
        };
        counter.fetch_add(1, Ordering::Relaxed);
    }

    /// Returns the numbers of successful and of failed writes.
    #[must_use]
    pub fn writes(&self) -> [u64; 2] {
        [&self.writes, &self.failures].map(|counter| counter.load(Ordering::Relaxed))
    }
}
