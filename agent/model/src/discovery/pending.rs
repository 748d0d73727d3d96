//! Entries that wait: endpoints for their participant, and participants for a free entry.
//!
//! The table is bounded: when it is full, the oldest entry of the lowest priority is dropped. Every
//! operation takes logarithmic time, since each packet of a flood may cause one.

use std::collections::{BTreeMap, BTreeSet};
use std::ops::RangeInclusive;

use super::priority::Priority;

/// Entries by key, and in the order of eviction.
#[derive(Debug)]
pub(super) struct PendingTable<K, T> {
    cap: usize,
    entries: BTreeMap<K, Entry<T>>,
    order: BTreeSet<(Priority, u64, K)>,
    age: u64,
}

#[derive(Debug)]
struct Entry<T> {
    priority: Priority,
    age: u64,
    value: T,
}

impl<K: Copy + Ord, T> PendingTable<K, T> {
    /// Creates an empty table for at most `cap` entries.
    pub(super) const fn new(cap: usize) -> Self {
        Self {
            cap,
            entries: BTreeMap::new(),
            order: BTreeSet::new(),
            age: 0,
        }
    }

    /// Returns the number of entries and of places in their order.
    pub(super) fn sizes(&self) -> (usize, usize) {
        let Self {
            cap: _,
            entries,
            order,
            age: _,
        } = self;
        (entries.len(), order.len())
    }

    /// Inserts or replaces an entry. Returns whether an entry was dropped for it; that is the new
    /// entry if all others have a higher priority.
    pub(super) fn put(&mut self, key: K, priority: Priority, value: T) -> bool {
        self.remove(&key);
        let is_full = self.entries.len() >= self.cap;
        if is_full {
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

    const WATCHED: Priority = Priority {
        watched: true,
        ..Priority::NOTHING
    };

    #[test]
    fn the_oldest_of_the_least_worth_goes_first_and_nothing_worth_more_than_the_newcomer() {
        let mut waiting = PendingTable::new(3);
        assert!(!waiting.put(1, WATCHED, 'a'));
        assert!(!waiting.put(2, Priority::NOTHING, 'b'));
        assert!(!waiting.put(3, Priority::NOTHING, 'c'));
        assert!(waiting.put(4, Priority::NOTHING, 'd'));
        assert_eq!(waiting.remove(&2), None);
        assert!(waiting.put(5, WATCHED, 'e') && waiting.put(6, WATCHED, 'f'));
        assert!(waiting.put(7, Priority::NOTHING, 'g'));
        let left: Vec<_> = waiting.range(0..=9).map(|(key, _)| key).collect();
        assert_eq!((left, waiting.sizes()), (vec![1, 5, 6], (3, 3)));
        // Replacing an entry drops no other entry.
        assert!(!waiting.put(5, Priority::NOTHING, 'h'));
        assert_eq!(waiting.priority(&5), Some(Priority::NOTHING));
        waiting.rate(|_, value| {
            if *value == 'h' {
                WATCHED
            } else {
                Priority::NOTHING
            }
        });
        assert!(waiting.put(8, Priority::NOTHING, 'i'));
        assert_eq!(
            (waiting.priority(&1), waiting.priority(&5)),
            (None, Some(WATCHED))
        );
        waiting.retain(|key, _| *key == 8);
        assert_eq!(waiting.sizes(), (1, 1));
    }
}
