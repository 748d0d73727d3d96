//! A table of what nodes sent, bounded in entries and bytes.
//!
//! If there is no room, the oldest entries that no lookup used make room. Forged entries thus do not
//! displace used ones.

use std::collections::BTreeMap;

/// The table.
#[derive(Debug)]
pub(super) struct Kept<K, V> {
    pub(super) entries: BTreeMap<K, Entry<V>>,
    max_entries: usize,
    max_bytes: usize,
    pub(super) bytes: usize,
    /// Number of entries so far.
    pub(super) added: u64,
    /// Number of entries dropped, or refused because all others are used.
    pub(super) evicted: u64,
}

#[derive(Debug)]
pub(super) struct Entry<V> {
    pub(super) value: V,
    bytes: usize,
    /// Place in the order of arrival.
    pub(super) number: u64,
    /// Whether a lookup used it.
    pub(super) is_used: bool,
}

impl<K: Ord + Clone, V> Kept<K, V> {
    pub(super) const fn new(max_entries: usize, max_bytes: usize) -> Self {
        Self {
            entries: BTreeMap::new(),
            max_entries,
            max_bytes,
            bytes: 0,
            added: 0,
            evicted: 0,
        }
    }

    /// Adds an entry unless the key exists. Returns whether it was added.
    pub(super) fn add(&mut self, key: K, value: V, bytes: usize) -> bool {
        if self.entries.contains_key(&key) {
            return false;
        }
        while self.entries.len() >= self.max_entries || self.bytes + bytes > self.max_bytes {
            self.evicted += 1;
            let unused = self.entries.iter().filter(|(_, entry)| !entry.is_used);
            let oldest = unused.min_by_key(|(_, entry)| entry.number);
            let Some(oldest) = oldest.map(|(key, _)| key.clone()) else {
                return false;
            };
            if let Some(dropped) = self.entries.remove(&oldest) {
                self.bytes -= dropped.bytes;
            }
        }
        self.added += 1;
        self.bytes += bytes;
        let number = self.added;
        let entry = Entry {
            value,
            bytes,
            number,
            is_used: false,
        };
        self.entries.insert(key, entry);
        true
    }
}
