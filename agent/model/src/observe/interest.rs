//! Verdicts of the kernel filter: which writers and readers it meters, captures or ignores.
//!
//! The table keeps the wanted verdicts and those that the kernel has, so that only differences are
//! sent. It has the cap of the kernel's map. A full table drops entries with [`Verdict::Ignore`]
//! first. Without an entry, the kernel captures a writer within its budget for unknown writers.

use std::collections::BTreeSet;

use foldhash::HashMap;
use ros2probe_wire::Guid;

use crate::facts::bounded::{Bounded, Counted};
use crate::facts::tables::InterestEntries;
use ros2probe_wire::record::Verdict;

/// The table of verdicts.
#[derive(Debug)]
pub struct Interest {
    entries: Bounded<Counted<InterestEntries>, HashMap<Guid, Entry>>,
    changed: Bounded<Counted<InterestEntries>, BTreeSet<Guid>>,
    limit: usize,
    evictions: u64,
}

#[derive(Clone, Copy, Debug, Default)]
struct Entry {
    wanted: Option<Verdict>,
    reported: Option<Verdict>,
}

impl Interest {
    /// Creates an empty table for at most `limit` entries.
    #[must_use]
    pub fn new(limit: usize) -> Self {
        Self {
            // Removed entries stay until the kernel's map is updated.
            entries: Bounded::capped(2 * limit),
            changed: Bounded::capped(2 * limit),
            limit,
            evictions: 0,
        }
    }

    /// Sets the wanted verdict.
    pub fn set(&mut self, guid: Guid, verdict: Verdict) {
        if !self.entries.contains_key(&guid) && self.entries.len() >= self.limit {
            self.evictions += 1;
            if verdict == Verdict::Ignore || !self.drop_ignored() {
                return;
            }
        }
        let Some(entry) = self.entries.get_or_insert_with(guid, Entry::default) else {
            return;
        };
        entry.wanted = Some(verdict);
        if entry.wanted == entry.reported {
            self.changed.remove(&guid);
        } else {
            self.changed.insert(guid);
        }
    }

    /// Removes the wanted verdict.
    pub fn remove(&mut self, guid: Guid) {
        let Some(entry) = self.entries.get_mut(&guid) else {
            return;
        };
        entry.wanted = None;
        if entry.reported.is_none() {
            self.entries.remove(&guid);
            self.changed.remove(&guid);
        } else {
            self.changed.insert(guid);
        }
    }

    /// Returns the wanted verdict.
    #[must_use]
    pub fn get(&self, guid: Guid) -> Option<Verdict> {
        self.entries.get(&guid)?.wanted
    }

    /// Returns the changes since the last call, sorted by GUID; `None` removes an entry. Removals
    /// come first, because the kernel's map has the same cap as this table.
    pub fn changes(&mut self) -> Vec<(Guid, Option<Verdict>)> {
        let mut changes = Vec::with_capacity(self.changed.len());
        for guid in self.changed.take() {
            let Some(entry) = self.entries.get_mut(&guid) else {
                continue;
            };
            entry.reported = entry.wanted;
            changes.push((guid, entry.wanted));
            if entry.wanted.is_none() {
                self.entries.remove(&guid);
            }
        }
        changes.sort_by_key(|(_, verdict)| verdict.is_some());
        changes
    }

    /// Returns the number of entries, the cap, and the number of entries dropped because of the
    /// cap.
    #[must_use]
    pub fn size(&self) -> (usize, usize, u64) {
        (self.entries.len(), self.limit, self.evictions)
    }

    /// Drops one entry with [`Verdict::Ignore`], if possible one that the kernel does not have.
    /// Returns whether one was dropped.
    fn drop_ignored(&mut self) -> bool {
        let mut ignored = self
            .entries
            .iter()
            .filter(|(_, entry)| entry.wanted == Some(Verdict::Ignore) && entry.reported.is_none());
        let found = ignored.next().map(|(guid, _)| *guid);
        let reported = || {
            let ignored = |entry: &Entry| entry.wanted == Some(Verdict::Ignore);
            self.entries
                .iter()
                .find(|(_, entry)| ignored(entry))
                .map(|(guid, _)| *guid)
        };
        let Some(guid) = found.or_else(reported) else {
            return false;
        };
        self.remove(guid);
        true
    }
}

#[cfg(test)]
mod tests {
    use ros2probe_wire::{EntityId, GuidPrefix};

    use super::*;

    fn guid(number: u16) -> Guid {
        let [high, low] = number.to_be_bytes();
        Guid::new(GuidPrefix([1; 12]), EntityId([0, high, low, 3]))
    }

    #[test]
    fn only_changed_verdicts_are_returned() {
        let mut interest = Interest::new(8);
        interest.set(guid(1), Verdict::Meter);
        interest.set(guid(2), Verdict::Ignore);
        interest.set(guid(2), Verdict::Capture);
        interest.set(guid(3), Verdict::Meter);
        interest.remove(guid(3));
        assert_eq!(
            interest.changes(),
            [
                (guid(1), Some(Verdict::Meter)),
                (guid(2), Some(Verdict::Capture))
            ]
        );
        interest.set(guid(1), Verdict::Meter);
        interest.set(guid(2), Verdict::Ignore);
        interest.set(guid(2), Verdict::Capture);
        assert!(interest.changes().is_empty());
        interest.remove(guid(1));
        assert_eq!(interest.changes(), [(guid(1), None)]);
        assert_eq!(interest.size().0, 1);
    }

    #[test]
    fn a_full_table_drops_ignored_entries_for_metered_ones() {
        let mut interest = Interest::new(4);
        for number in 0..4 {
            interest.set(guid(number), Verdict::Ignore);
        }
        interest.set(guid(9), Verdict::Ignore);
        assert_eq!(interest.get(guid(9)), None);
        for number in 10..14 {
            interest.set(guid(number), Verdict::Meter);
        }
        interest.set(guid(14), Verdict::Meter);
        assert!((10..14).all(|number| interest.get(guid(number)) == Some(Verdict::Meter)));
        assert_eq!((interest.get(guid(14)), interest.size().0), (None, 4));
    }
}
