//! Tables that foreign input fills.
//!
//! A table is declared once, with [`tables!`]: its name, its caps and its rule at a cap. The type
//! of a field names its declaration, so that the container cannot grow beyond the cap. The rows of
//! the documented limits and of the metrics derive from the same declaration.

mod by_owner;
mod collections;
mod ledger;

use std::fmt::Debug;
use std::marker::PhantomData;
use std::ops::Deref;

pub use by_owner::{ByOwner, HeapBytes};
pub use collections::Collection;
pub use ledger::{Use, ledger};

/// Placeholder for a cap that is a key of the configuration or derives from one.
pub const CONFIGURED: usize = usize::MAX;

/// Size and cap of a bounded table.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct TableFacts {
    /// Name of the table, such as `participants`; also the label `table` of metrics.
    pub table: &'static str,
    /// Number of entries (bytes for `reassembly` and `payloads`).
    pub size: u64,
    /// Maximum of `size`.
    pub limit: u64,
    /// Bytes in use and their cap; `None` for a table without a cap in bytes.
    pub bytes: Option<(u64, u64)>,
    /// Entries dropped because of the cap.
    pub evictions: u64,
}

/// Declaration of a table.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Table {
    /// Name; for a table with its own series, the label `table` of metrics.
    pub name: &'static str,
    /// Meaning of the entries.
    pub what: &'static str,
    /// Maximum number of entries.
    pub entries: usize,
    /// Maximum number of bytes, including those of the table itself. `None` if the size of an entry
    /// has a bound of its own.
    pub bytes: Option<usize>,
    /// Effect when a cap is reached.
    pub rule: Rule,
    /// Description of the effect; empty if that of the rule suffices.
    pub effect: &'static str,
    /// Metric, or table with series, that counts the refused and removed entries.
    pub reported: &'static str,
}

/// Effect of a full table on a new entry.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Rule {
    /// The new entry is left out.
    LeaveOut,
    /// The first entry is dropped: the oldest of a list, the smallest of a tree.
    Oldest,
    /// The owner with the most bytes loses entries. A new entry of that owner is left out.
    LargestOwner,
}

/// A declaration of a table, as a type.
pub trait Declared {
    /// The declaration.
    const TABLE: Table;

    /// Returns the maximum number of entries.
    fn cap(&self) -> usize {
        Self::TABLE.entries
    }

    /// Counts entries that a cap refused or removed.
    fn count(&mut self, _entries: u64) {}
}

/// Declaration with a cap from the configuration and a counter, for tables that exist once.
#[derive(Debug)]
pub struct Counted<D> {
    cap: usize,
    evictions: u64,
    of: PhantomData<D>,
}

/// A container within the cap of its declaration.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Bounded<D, C> {
    inner: C,
    declared: D,
}

/// A sum over several containers, within the cap of its declaration.
#[derive(Clone, Copy, Debug, Default)]
pub struct Sum<D> {
    used: usize,
    declared: D,
}

impl Table {
    /// The default values of the fields.
    pub const DEFAULT: Self = Self {
        name: "",
        what: "",
        entries: 0,
        bytes: None,
        rule: Rule::LeaveOut,
        effect: "",
        reported: "",
    };

    /// Returns the documented description of what happens at a cap.
    #[must_use]
    pub const fn in_words(&self) -> &'static str {
        match self.rule {
            _ if !self.effect.is_empty() => self.effect,
            Rule::LeaveOut => "left out",
            Rule::Oldest => "the oldest is dropped",
            Rule::LargestOwner => "the connection with the most bytes loses entries",
        }
    }
}

impl<D: Declared> Counted<D> {
    const fn facts(&self, entries: usize) -> TableFacts {
        TableFacts {
            table: D::TABLE.name,
            size: entries as u64,
            limit: self.cap as u64,
            bytes: None,
            evictions: self.evictions,
        }
    }
}

impl<D: Declared> Declared for Counted<D> {
    const TABLE: Table = D::TABLE;

    fn cap(&self) -> usize {
        self.cap
    }

    fn count(&mut self, entries: u64) {
        self.evictions += entries;
    }
}

impl<D: Declared> Default for Counted<D> {
    fn default() -> Self {
        Self {
            cap: D::TABLE.entries,
            evictions: 0,
            of: PhantomData,
        }
    }
}

impl<D: Declared, C: Collection> Bounded<D, C> {
    /// Returns whether the container has reached its cap.
    pub fn is_full(&self) -> bool {
        self.inner.length() >= self.declared.cap()
    }

    /// Counts one entry that the cap refused or removed.
    pub fn refuse(&mut self) {
        self.refuse_all(1);
    }

    /// Counts entries that the cap refused or removed.
    pub fn refuse_all(&mut self, entries: u64) {
        ledger::refused(&D::TABLE, entries);
        self.declared.count(entries);
    }

    /// Removes and returns all entries.
    pub fn take(&mut self) -> C {
        std::mem::take(&mut self.inner)
    }

    /// Returns whether the entry is present, according to `has`, or fits. A refusal is counted.
    /// Nothing is removed, whatever the rule.
    fn has_room_for(&mut self, has: impl Fn(&C) -> bool) -> bool {
        let is_full = self.is_full();
        if (is_full || cfg!(debug_assertions)) && !has(&self.inner) {
            if is_full {
                self.refuse();
                return false;
            }
            ledger::filled(&D::TABLE, self.inner.length() + 1, self.declared.cap());
        }
        true
    }

    /// Adds an entry and applies the rule. Returns the entry that the cap refused or removed: the
    /// new one or the oldest.
    pub fn add(&mut self, entry: C::Entry) -> Option<C::Entry> {
        let is_full = self.is_full() && !self.inner.replaces(&entry);
        if is_full {
            self.refuse();
            if D::TABLE.rule != Rule::Oldest || !C::HAS_ORDER || self.declared.cap() == 0 {
                return Some(entry);
            }
        }
        self.inner.put(entry);
        let left = if is_full {
            self.inner.pop_oldest()
        } else {
            None
        };
        ledger::filled(&D::TABLE, self.inner.length(), self.declared.cap());
        left
    }
}

impl<D: Declared, C: Collection> Bounded<Counted<D>, C> {
    /// Creates an empty container with a cap from the configuration.
    #[must_use]
    pub fn capped(cap: usize) -> Self {
        let mut bounded = Self::default();
        bounded.declared.cap = cap;
        bounded
    }

    /// Returns size, cap and evictions for the metrics.
    pub fn facts(&self) -> TableFacts {
        self.declared.facts(self.inner.length())
    }
}

impl<D: Declared> Sum<D> {
    /// Returns the sum.
    pub const fn used(&self) -> usize {
        self.used
    }

    /// Returns whether the sum has reached the cap.
    pub fn is_full(&self) -> bool {
        self.used >= self.declared.cap()
    }

    /// Returns the amount that can be added.
    pub fn remaining(&self) -> usize {
        self.declared.cap().saturating_sub(self.used)
    }

    /// Returns whether the sum exceeds the cap, so that the caller has to remove entries.
    pub fn is_exceeded(&self) -> bool {
        self.used > self.declared.cap()
    }

    /// Adds to the sum.
    pub fn add(&mut self, count: usize) {
        self.used += count;
        // The sum may exceed the cap until the caller removes entries.
        let cap = self.declared.cap();
        ledger::filled(&D::TABLE, self.used.min(cap), cap);
    }

    /// Subtracts from the sum.
    pub fn sub(&mut self, count: usize) {
        self.used = self.used.saturating_sub(count);
    }

    /// Sets the sum to zero.
    pub fn clear(&mut self) {
        self.used = 0;
    }

    /// Counts one entry that the cap refused or removed.
    pub fn refuse(&mut self) {
        self.refuse_all(1);
    }

    /// Counts entries that the cap refused or removed.
    pub fn refuse_all(&mut self, entries: u64) {
        ledger::refused(&D::TABLE, entries);
        self.declared.count(entries);
    }
}

impl<D: Declared> Sum<Counted<D>> {
    /// Creates a sum of zero with a cap from the configuration.
    #[must_use]
    pub fn capped(cap: usize) -> Self {
        let mut sum = Self::default();
        sum.declared.cap = cap;
        sum
    }

    /// Returns sum, cap and evictions for the metrics.
    pub fn facts(&self) -> TableFacts {
        self.declared.facts(self.used)
    }
}

impl<D, C> Deref for Bounded<D, C> {
    type Target = C;

    fn deref(&self) -> &C {
        &self.inner
    }
}

impl<D: Declared + Default, C: Collection> FromIterator<C::Entry> for Bounded<D, C> {
    fn from_iter<I: IntoIterator<Item = C::Entry>>(entries: I) -> Self {
        let mut bounded = Self::default();
        entries
            .into_iter()
            .for_each(|entry| drop(bounded.add(entry)));
        bounded
    }
}

impl<D, C: IntoIterator> IntoIterator for Bounded<D, C> {
    type Item = C::Item;
    type IntoIter = C::IntoIter;

    fn into_iter(self) -> C::IntoIter {
        self.inner.into_iter()
    }
}

impl<'a, D, C> IntoIterator for &'a Bounded<D, C>
where
    &'a C: IntoIterator,
{
    type Item = <&'a C as IntoIterator>::Item;
    type IntoIter = <&'a C as IntoIterator>::IntoIter;

    fn into_iter(self) -> Self::IntoIter {
        self.inner.into_iter()
    }
}

impl<'a, D, C> IntoIterator for &'a mut Bounded<D, C>
where
    &'a mut C: IntoIterator,
{
    type Item = <&'a mut C as IntoIterator>::Item;
    type IntoIter = <&'a mut C as IntoIterator>::IntoIter;

    fn into_iter(self) -> Self::IntoIter {
        self.inner.into_iter()
    }
}

/// Records in the ledger a sum that the caller computes and keeps within the cap.
#[inline]
pub fn note<D: Declared>(sum: usize) {
    ledger::filled(&D::TABLE, sum, D::TABLE.entries);
}

/// Declares tables: a type for each, and their list `ALL`. The doc comment describes the entries.
/// Omitted fields have the values of [`Table::DEFAULT`].
#[macro_export]
macro_rules! tables {
    ($(#[doc = $what:literal] $name:ident { $($field:ident: $value:expr),* $(,)? })*) => {
        $(
            #[doc = $what]
            #[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
            pub struct $name;

            impl $name {
                /// Maximum number of entries.
                #[allow(dead_code, reason = "a container may suffice that knows it")]
                pub const CAP: usize = <Self as $crate::facts::bounded::Declared>::TABLE.entries;
            }

            impl $crate::facts::bounded::Declared for $name {
                const TABLE: $crate::facts::bounded::Table = $crate::facts::bounded::Table {
                    what: $what,
                    $($field: $value,)*
                    ..$crate::facts::bounded::Table::DEFAULT
                };
            }
        )*

        /// All declarations.
        #[allow(dead_code, reason = "tests declare tables without documenting them")]
        pub const ALL: &[$crate::facts::bounded::Table] =
            &[$(<$name as $crate::facts::bounded::Declared>::TABLE),*];
    };
}

#[cfg(test)]
mod tests {
    use std::collections::{BTreeMap, BTreeSet, HashMap, VecDeque};

    use super::*;

    mod declared {
        use crate::facts::bounded::Rule::Oldest;

        crate::tables! {
            /// Numbers
            Ring { name: "ring", entries: 3, rule: Oldest }
            /// Numbers
            Few { name: "few", entries: 3 }
        }
    }
    use declared::{Few, Ring};

    #[test]
    fn a_full_list_or_tree_drops_its_oldest_entry() {
        let mut list: Bounded<Ring, VecDeque<u32>> = Bounded::default();
        let left: Vec<_> = (0..5).filter_map(|number| list.push_back(number)).collect();
        assert_eq!((left, list.len()), (vec![0, 1], 3));
        let mut tree: Bounded<Ring, BTreeMap<u32, ()>> = Bounded::default();
        assert!((1..=3).all(|key| tree.insert(key, ()).is_none()));
        assert_eq!(tree.insert(9, ()), Some((1, ())));
        assert_eq!(
            tree.insert(0, ()),
            Some((0, ())),
            "the newcomer is the oldest"
        );
        assert_eq!(tree.keys().copied().collect::<Vec<_>>(), [2, 3, 9]);
    }

    #[test]
    fn a_full_map_refuses_new_keys_and_updates_known_keys() {
        let mut map: Bounded<Counted<Few>, HashMap<u32, u32>> = Bounded::capped(2);
        assert!(map.insert(1, 1).is_none() && map.insert(2, 1).is_none());
        assert_eq!(map.insert(3, 1), Some((3, 1)));
        assert!(map.insert(1, 5).is_none());
        assert_eq!(map.get_or_insert_with(3, || 1), None);
        assert_eq!(map.get_or_insert_with(1, || 1), Some(&mut 5));
        let facts = map.facts();
        assert_eq!((facts.size, facts.limit, facts.evictions), (2, 2, 2));
        let mut set: Bounded<Few, BTreeSet<u32>> = Bounded::default();
        assert_eq!((0..9).filter(|key| set.insert(*key)).count(), 3);
    }

    #[test]
    fn the_ledger_records_the_largest_length_and_the_refused_entries() {
        let mut list: Bounded<Few, Vec<u32>> = Bounded::default();
        for number in 0..5 {
            list.push(number);
        }
        list.clear();
        let used = ledger()[Few::TABLE.name];
        assert_eq!((used.largest, used.cap, used.refused), (3, 3, 2));
    }
}
