//! What recordings and snapshots have done and cost, counted where they work and shown on the page.

use std::collections::BTreeMap;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Mutex, PoisonError};

/// Counts of all recordings of a run, and what each snapshot holds.
#[derive(Debug, Default)]
pub struct RecordingFigures {
    /// Recordings under way.
    pub active: AtomicU64,
    /// Messages in bags.
    pub messages: AtomicU64,
    /// Bytes of those messages.
    pub bytes: AtomicU64,
    /// Messages that were sent and are in no bag.
    pub missing: AtomicU64,
    snapshots: Mutex<BTreeMap<String, SnapshotFigures>>,
}

/// One snapshot of the configuration.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct SnapshotFigures {
    /// Messages in memory.
    pub messages: u64,
    /// What they take.
    pub bytes: u64,
    /// Messages that were young enough and had to go for want of room.
    pub crowded_out: u64,
    /// Bags written.
    pub written: u64,
    /// Bags that could not be.
    pub failed: u64,
}

impl RecordingFigures {
    /// Adds up what one recording has since it was last counted.
    pub fn add(&self, messages: u64, bytes: u64, missing: u64) {
        self.messages.fetch_add(messages, Ordering::Relaxed);
        self.bytes.fetch_add(bytes, Ordering::Relaxed);
        self.missing.fetch_add(missing, Ordering::Relaxed);
    }

    /// This is how the snapshot of this name stands.
    pub fn snapshot(&self, name: &str, figures: SnapshotFigures) {
        let mut snapshots = self
            .snapshots
            .lock()
            .unwrap_or_else(PoisonError::into_inner);
        snapshots.insert(name.to_owned(), figures);
    }

    /// All snapshots.
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
