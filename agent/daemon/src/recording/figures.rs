//! Counters of recordings and snapshots, for metrics and the page.

use std::collections::BTreeMap;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Mutex, PoisonError};

/// Counters of all recordings of a run, and the state of each snapshot.
#[derive(Debug, Default)]
pub struct RecordingFigures {
    /// Active recordings.
    pub active: AtomicU64,
    /// Messages written to bags.
    pub messages: AtomicU64,
    /// Bytes of the messages written to bags.
    pub bytes: AtomicU64,
    /// Messages that were sent and are in no bag.
    pub missing: AtomicU64,
    snapshots: Mutex<BTreeMap<String, SnapshotFigures>>,
}

/// State of one configured snapshot.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct SnapshotFigures {
    /// Messages in memory.
    pub messages: u64,
    /// Memory used by the messages, in bytes.
    pub bytes: u64,
    /// Messages, and reports of missing ones, evicted before the end of the time span, for lack of
    /// memory.
    pub evicted: u64,
    /// Bags written.
    pub written: u64,
    /// Bags that could not be written.
    pub failed: u64,
    /// Triggers ignored during another bag, or within the minimum interval.
    pub suppressed: u64,
    /// Old triggered bags removed for new ones.
    pub removed: u64,
}

impl RecordingFigures {
    /// Adds the changes of one recording since its last call.
    pub fn add(&self, messages: u64, bytes: u64, missing: u64) {
        self.messages.fetch_add(messages, Ordering::Relaxed);
        self.bytes.fetch_add(bytes, Ordering::Relaxed);
        self.missing.fetch_add(missing, Ordering::Relaxed);
    }

    /// Sets the state of the snapshot of this name.
    pub fn snapshot(&self, name: &str, figures: SnapshotFigures) {
        let mut snapshots = self
            .snapshots
            .lock()
            .unwrap_or_else(PoisonError::into_inner);
        snapshots.insert(name.to_owned(), figures);
    }

    /// Returns the state of all snapshots.
    #[must_use]
    pub fn snapshots(&self) -> Vec<(String, SnapshotFigures)> {
        let snapshots = self
            .snapshots
            .lock()
            .unwrap_or_else(PoisonError::into_inner);
        let snapshots = snapshots.iter();
        snapshots
            .map(|(name, figures)| (name.clone(), *figures))
            .collect()
    }
}
