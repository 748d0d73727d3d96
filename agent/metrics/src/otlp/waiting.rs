//! Items that wait for export, between the thread that adds them and the exporter.

use std::collections::VecDeque;
use std::sync::{Mutex, MutexGuard, PoisonError};

use ros2probe_model::facts::bounded::{Bounded, Declared};
use tokio::sync::Notify;

/// A bounded queue. The thread that adds items never waits.
#[derive(Debug)]
pub(super) struct Waiting<D, T> {
    items: Mutex<Bounded<D, VecDeque<T>>>,
    added: Notify,
}

impl<D: Declared + Default, T> Default for Waiting<D, T> {
    fn default() -> Self {
        Self {
            items: Mutex::default(),
            added: Notify::new(),
        }
    }
}

impl<D: Declared, T> Waiting<D, T> {
    /// Appends items and returns the number of those that did not fit.
    pub(super) fn put(&self, items: impl IntoIterator<Item = T>) -> u64 {
        let mut items = items.into_iter().peekable();
        if items.peek().is_none() {
            return 0;
        }
        let mut waiting = self.items();
        let refused = items.filter_map(|item| waiting.push_back(item)).count();
        drop(waiting);
        self.added.notify_one();
        refused as u64
    }

    /// Appends all of these items, or none. Returns the number of items that did not fit.
    pub(super) fn add_all_or_none(&self, items: impl ExactSizeIterator<Item = T>) -> u64 {
        let count = items.len();
        let mut waiting = self.items();
        if waiting.len() + count > D::TABLE.entries {
            return count as u64;
        }
        items.for_each(|item| {
            waiting.push_back(item);
        });
        drop(waiting);
        self.added.notify_one();
        0
    }

    /// Removes and returns the oldest items, at most this many.
    pub(super) fn take(&self, most: usize) -> Vec<T> {
        let mut waiting = self.items();
        let most = waiting.len().min(most);
        waiting.drain(..most).collect()
    }

    /// Returns whether half of the places are taken.
    pub(super) fn is_half_full(&self) -> bool {
        self.items().len() >= D::TABLE.entries / 2
    }

    /// Completes once an item waits.
    pub(super) async fn wait_filled(&self) {
        loop {
            let added = self.added.notified();
            if !self.items().is_empty() {
                return;
            }
            added.await;
        }
    }

    fn items(&self) -> MutexGuard<'_, Bounded<D, VecDeque<T>>> {
        self.items.lock().unwrap_or_else(PoisonError::into_inner)
    }
}
