//! Entries that wait: endpoints for their participant, and participants for a free entry.
//!
//! The table is bounded: when it is full, the oldest entry of the lowest priority is dropped. Every
//! operation takes logarithmic time, since each packet of a flood may cause one.

use std::collections::{BTreeMap, BTreeSet};
use std::ops::RangeInclusive;

use super::priority::Priority;
use crate::facts::bounded::{Bounded, Declared};

/// Entries by key, and in the order of eviction.
#[derive(Debug)]
pub(super) struct PendingTable<D, K: Ord, T> {
    entries: Bounded<D, BTreeMap<K, Entry<T>>>,
    order: Bounded<D, BTreeSet<(Priority, u64, K)>>,
    age: u64,
}

#[derive(Debug)]
struct Entry<T> {
    priority: Priority,
    age: u64,
    value: T,
}

impl<D: Declared + Default, K: Copy + Ord, T> PendingTable<D, K, T> {
    /// Creates an empty table.
    pub(super) fn new() -> Self {
        Self {
            entries: Bounded::default(),
            order: Bounded::default(),
            age: 0,
        }
    }

    /// Inserts or replaces an entry. Returns whether an entry was dropped: another one, or the new
    /// one if all others have a higher priority.
    pub(super) fn put(&mut self, key: K, priority: Priority, value: T) -> bool {
        self.remove(&key);
        let is_full = self.entries.is_full();
        if is_full {
            self.entries.refuse();
            match self.order.first().copied() {
                Some((least, _, oldest)) if least <= priority => self.remove(&oldest),
                _ => return true,
            };
        }
        self.age += 1;
        let age = self.age;
        self.order.insert((priority, age, key));
        self.entries.insert(
            key,
            Entry {
                priority,
                age,
                value,
            },
        );
        is_full
    }

    /// Removes an entry.
    pub(super) fn remove(&mut self, key: &K) -> Option<(Priority, T)> {
        let entry = self.entries.remove(key)?;
        self.order.remove(&(entry.priority, entry.age, *key));
        Some((entry.priority, entry.value))
    }

    /// Returns the priority of this entry.
    pub(super) fn priority(&self, key: &K) -> Option<Priority> {
        Some(self.entries.get(key)?.priority)
    }

    /// Returns the keys in this range with their priorities.
    pub(super) fn range(
        &self,
        keys: RangeInclusive<K>,
    ) -> impl Iterator<Item = (K, Priority)> + '_ {
        let range = self.entries.range(keys);
        range.map(|(key, entry)| (*key, entry.priority))
    }

    /// Keeps the entries for which `keep` returns true.
    pub(super) fn retain(&mut self, keep: impl Fn(&K, &T) -> bool) {
        self.entries.retain(|key, entry| keep(key, &entry.value));
        let entries = &self.entries;
        self.order.retain(|(_, _, key)| entries.contains_key(key));
    }

    /// Recomputes every priority.
    pub(super) fn rate(&mut self, priority: impl Fn(Priority, &T) -> Priority) {
        self.order.clear();
        for (key, entry) in &mut self.entries {
            entry.priority = priority(entry.priority, &entry.value);
            self.order.insert((entry.priority, entry.age, *key));
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    mod declared {
        crate::tables! {
            /// Numbers
            Waiting { name: "waiting", entries: 3 }
        }
    }
    use declared::Waiting;

    const WATCHED: Priority = Priority {
        watched: true,
        ..Priority::NO_EVIDENCE
    };

    #[test]
    fn a_full_table_drops_the_oldest_entry_of_the_lowest_priority() {
        let mut waiting: PendingTable<Waiting, _, _> = PendingTable::new();
        assert!(!waiting.put(1, WATCHED, 'a'));
        assert!(!waiting.put(2, Priority::NO_EVIDENCE, 'b'));
        assert!(!waiting.put(3, Priority::NO_EVIDENCE, 'c'));
        assert!(waiting.put(4, Priority::NO_EVIDENCE, 'd'));
        assert_eq!(waiting.remove(&2), None);
        assert!(waiting.put(5, WATCHED, 'e') && waiting.put(6, WATCHED, 'f'));
        assert!(waiting.put(7, Priority::NO_EVIDENCE, 'g'));
        let left: Vec<_> = waiting.range(0..=9).map(|(key, _)| key).collect();
        assert_eq!((left, waiting.order.len()), (vec![1, 5, 6], 3));
        // Replacing an entry drops no other entry.
        assert!(!waiting.put(5, Priority::NO_EVIDENCE, 'h'));
        assert_eq!(waiting.priority(&5), Some(Priority::NO_EVIDENCE));
        waiting.rate(|_, value| {
            if *value == 'h' {
                WATCHED
            } else {
                Priority::NO_EVIDENCE
            }
        });
        assert!(waiting.put(8, Priority::NO_EVIDENCE, 'i'));
        assert_eq!(
            (waiting.priority(&1), waiting.priority(&5)),
            (None, Some(WATCHED))
        );
        waiting.retain(|key, _| *key == 8);
        assert_eq!((waiting.entries.len(), waiting.order.len()), (1, 1));
    }
}
