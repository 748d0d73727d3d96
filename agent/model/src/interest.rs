//! Which writers and readers the kernel filter is to meter, capture or leave alone.
//!
//! Holds what is wanted and what the kernel was told, so that only differences travel. It is
//! bounded like the kernel's map: when full, the uninteresting entries go first, for without one a
//! writer is merely captured within the kernel's budget for unknown writers.

use std::collections::{BTreeSet, HashMap};

use ros2probe_wire::Guid;

use super::size::Size;
use ros2probe_wire::record::Verdict;

/// The table of verdicts.
#[derive(Debug)]
pub struct Interest {
    entries: HashMap<Guid, Entry>,
    changed: BTreeSet<Guid>,
    limit: usize,
    evictions: u64,
}

#[derive(Clone, Copy, Debug, Default)]
struct Entry {
    wanted: Option<Verdict>,
    told: Option<Verdict>,
}

impl Interest {
    /// Entries and cap of every table.
    #[must_use]
    pub fn sizes(&self) -> Vec<Size> {
        // A new table does not compile before it has a place here.
        let Self {
            entries,
            changed,
            limit,
            evictions: _,
        } = self;
        // Those that go wait for the kernel to be told.
        vec![
            Size::new("interest.entries", entries.len(), 2 * limit),
            Size::new("interest.changed", changed.len(), 2 * limit),
        ]
    }

    /// Empty, for at most `limit` entries.
    #[must_use]
    pub fn new(limit: usize) -> Self {
        Self {
            entries: HashMap::new(),
            changed: BTreeSet::new(),
            limit,
            evictions: 0,
        }
    }

    /// Wants this verdict from now on.
    pub fn set(&mut self, guid: Guid, verdict: Verdict) {
        if !self.entries.contains_key(&guid) && self.entries.len() >= self.limit {
            self.evictions += 1;
            if verdict == Verdict::Ignore || !self.give_up_one() {
                return;
            }
        }
        let entry = self.entries.entry(guid).or_default();
        entry.wanted = Some(verdict);
        if entry.wanted == entry.told {
            self.changed.remove(&guid);
        } else {
            self.changed.insert(guid);
        }
    }

    /// Wants no entry any more.
    pub fn remove(&mut self, guid: Guid) {
        let Some(entry) = self.entries.get_mut(&guid) else {
            return;
        };
        entry.wanted = None;
        if entry.told.is_none() {
            self.entries.remove(&guid);
            self.changed.remove(&guid);
        } else {
            self.changed.insert(guid);
        }
    }

    /// What is wanted of this one.
    #[must_use]
    pub fn get(&self, guid: Guid) -> Option<Verdict> {
        self.entries.get(&guid)?.wanted
    }

    /// What changed since the last call, in the order of the GUIDs; `None` = remove. Removals come
    /// first: the kernel's map has no more room than this table.
    pub fn changes(&mut self) -> Vec<(Guid, Option<Verdict>)> {
        let mut changes = Vec::with_capacity(self.changed.len());
        for guid in std::mem::take(&mut self.changed) {
            let Some(entry) = self.entries.get_mut(&guid) else {
                continue;
            };
            entry.told = entry.wanted;
            changes.push((guid, entry.wanted));
            if entry.wanted.is_none() {
                self.entries.remove(&guid);
            }
        }
        changes.sort_by_key(|(_, verdict)| verdict.is_some());
        changes
    }

    /// Entries, cap, and entries not kept because of it.
    #[must_use]
    pub fn size(&self) -> (usize, usize, u64) {
        (self.entries.len(), self.limit, self.evictions)
    }

    /// Makes room by forgetting one uninteresting entry, one the kernel does not know if there is
    /// any.
    fn give_up_one(&mut self) -> bool {
        let mut ignored = self
            .entries
            .iter()
            .filter(|(_, entry)| entry.wanted == Some(Verdict::Ignore) && entry.told.is_none());
        let found = ignored.next().map(|(guid, _)| *guid);
        let told = || {
            let ignored = |entry: &Entry| entry.wanted == Some(Verdict::Ignore);
            self.entries
                .iter()
                .find(|(_, entry)| ignored(entry))
                .map(|(guid, _)| *guid)
        };
        let Some(guid) = found.or_else(told) else {
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
    fn only_differences_travel() {
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
    fn a_full_table_keeps_what_is_watched() {
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
