//! Tables whose entries have an owner, for example a connection. All entries of an owner can be
//! removed together, and no owner can use up the capacity of the others.

use std::borrow::Borrow;
use std::collections::{BTreeMap, BTreeSet};
use std::marker::PhantomData;
use std::sync::Arc;

use super::Declared;
use super::Rule;
use super::TableFacts;
use super::ledger;

/// Bytes of an allocation besides its content: header, rounding, and the counters of an `Arc`.
const ALLOCATION_OVERHEAD: usize = 32;
/// Bytes of an owner without entries, in the tree of owners and in the order of their shares.
const OWNER_OVERHEAD: usize = 256;

/// Bytes of a value on the heap.
pub trait HeapBytes {
    /// Returns the bytes on the heap that the value keeps alive.
    fn heap_bytes(&self) -> usize;
}

impl HeapBytes for () {
    fn heap_bytes(&self) -> usize {
        0
    }
}

impl HeapBytes for u16 {
    fn heap_bytes(&self) -> usize {
        0
    }
}

impl HeapBytes for u32 {
    fn heap_bytes(&self) -> usize {
        0
    }
}

impl HeapBytes for u64 {
    fn heap_bytes(&self) -> usize {
        0
    }
}

impl HeapBytes for ros2probe_wire::zenoh::ZenohId {
    fn heap_bytes(&self) -> usize {
        0
    }
}

impl HeapBytes for Arc<str> {
    fn heap_bytes(&self) -> usize {
        ALLOCATION_OVERHEAD + self.len()
    }
}

/// A table within the caps of its declaration, in entries and bytes.
#[derive(Debug)]
pub struct ByOwner<D, O, K, V> {
    shares: BTreeMap<O, Share<K, V>>,
    /// Owners, sorted by their bytes.
    by_bytes: BTreeSet<(usize, O)>,
    entries: usize,
    bytes: usize,
    evictions: u64,
    declared: PhantomData<D>,
}

/// The entries of one owner.
#[derive(Debug)]
struct Share<K, V> {
    /// Value and bytes of each entry.
    entries: BTreeMap<K, (V, usize)>,
    bytes: usize,
}

impl<D: Declared, O: Ord + Copy, K: Ord + HeapBytes, V: HeapBytes> ByOwner<D, O, K, V> {
    const BYTES: usize = match D::TABLE.bytes {
        Some(bytes) => bytes,
        None => usize::MAX,
    };

    /// Adds or replaces an entry. `beside` is its size in other tables, in bytes. Returns whether
    /// the entry was added.
    pub fn insert(&mut self, owner: O, key: K, value: V, beside: usize) -> bool {
        self.remove(owner, &key);
        // Half of a node of the tree may be empty.
        let own = 2 * size_of::<(K, V, usize)>() + key.heap_bytes() + value.heap_bytes() + beside;
        let of_owner = match self.shares.get(&owner) {
            Some(share) => share.bytes,
            None => OWNER_OVERHEAD,
        };
        let is_new = !self.shares.contains_key(&owner);
        let needed = if is_new { own + OWNER_OVERHEAD } else { own };
        while self.entries >= D::TABLE.entries || self.bytes + needed > Self::BYTES {
            if !self.make_room(of_owner + own) {
                self.count();
                return false;
            }
        }
        let share = self.shares.entry(owner).or_insert_with(|| Share {
            entries: BTreeMap::new(),
            bytes: OWNER_OVERHEAD,
        });
        self.by_bytes.remove(&(share.bytes, owner));
        share.bytes += own;
        self.by_bytes.insert((share.bytes, owner));
        share.entries.insert(key, (value, own));
        self.entries += 1;
        self.bytes += needed;
        ledger::filled(&D::TABLE, self.entries, D::TABLE.entries);
        true
    }

    /// Returns the value of an entry.
    #[must_use]
    pub fn get<Q: Ord + ?Sized>(&self, owner: O, key: &Q) -> Option<&V>
    where
        K: Borrow<Q>,
    {
        let (value, _) = self.shares.get(&owner)?.entries.get(key)?;
        Some(value)
    }

    /// Removes an entry and returns its value.
    pub fn remove<Q: Ord + ?Sized>(&mut self, owner: O, key: &Q) -> Option<V>
    where
        K: Borrow<Q>,
    {
        let (value, bytes) = self.shares.get_mut(&owner)?.entries.remove(key)?;
        self.shrink(owner, bytes);
        Some(value)
    }

    /// Removes all entries of an owner and returns their keys.
    pub fn remove_owner(&mut self, owner: O) -> impl Iterator<Item = K> + use<D, O, K, V> {
        let share = self.shares.remove(&owner);
        if let Some(share) = &share {
            self.by_bytes.remove(&(share.bytes, owner));
            self.bytes -= share.bytes;
            self.entries -= share.entries.len();
        }
        let entries = share.into_iter().flat_map(|share| share.entries);
        entries.map(|(key, _)| key)
    }

    /// Returns the owners.
    pub fn owners(&self) -> impl Iterator<Item = O> {
        self.shares.keys().copied()
    }

    /// Returns the entries of an owner.
    pub fn of(&self, owner: O) -> impl Iterator<Item = (&K, &V)> {
        let share = self.shares.get(&owner).into_iter();
        let entries = share.flat_map(|share| &share.entries);
        entries.map(|(key, (value, _))| (key, value))
    }

    /// Returns size, caps and evictions for the snapshot.
    #[must_use]
    pub const fn facts(&self) -> TableFacts {
        TableFacts {
            table: D::TABLE.name,
            size: self.entries as u64,
            limit: D::TABLE.entries as u64,
            bytes: Some((self.bytes as u64, Self::BYTES as u64)),
            evictions: self.evictions,
        }
    }

    /// Removes an entry of the owner with the most bytes, if that owner has more than `newcomer`
    /// bytes. `newcomer` is what the owner of the new entry would have. Returns whether an entry
    /// was removed.
    fn make_room(&mut self, newcomer: usize) -> bool {
        if D::TABLE.rule == Rule::LeaveOut {
            return false;
        }
        let Some(&(_, owner)) = self.by_bytes.last().filter(|(most, _)| *most > newcomer) else {
            return false;
        };
        let share = self.shares.get_mut(&owner);
        let last = share.and_then(|share| share.entries.pop_last());
        let Some((_, (_, bytes))) = last else {
            return false;
        };
        self.count();
        self.shrink(owner, bytes);
        true
    }

    /// Counts an entry that a cap refused or removed.
    fn count(&mut self) {
        self.evictions += 1;
        ledger::refused(&D::TABLE, 1);
    }

    /// Adjusts the sums after an entry of an owner was removed.
    fn shrink(&mut self, owner: O, bytes: usize) {
        let Some(share) = self.shares.get_mut(&owner) else {
            return;
        };
        self.by_bytes.remove(&(share.bytes, owner));
        share.bytes -= bytes;
        self.bytes -= bytes;
        self.entries -= 1;
        if share.entries.is_empty() {
            self.bytes -= share.bytes;
            self.shares.remove(&owner);
        } else {
            self.by_bytes.insert((share.bytes, owner));
        }
    }
}

impl<D, O, K, V> Default for ByOwner<D, O, K, V> {
    fn default() -> Self {
        Self {
            shares: BTreeMap::new(),
            by_bytes: BTreeSet::new(),
            entries: 0,
            bytes: 0,
            evictions: 0,
            declared: PhantomData,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    mod declared {
        use crate::facts::bounded::Rule::LargestOwner;

        crate::tables! {
            /// Texts
            Fair { name: "fair", entries: 100, bytes: Some(20_000), rule: LargestOwner }
            /// Texts
            First { name: "first", entries: 100, bytes: Some(20_000) }
        }
    }
    use declared::{Fair, First};

    fn text(length: usize) -> Arc<str> {
        "x".repeat(length).into()
    }

    /// Asserts that the sums equal those of the entries and are within the caps.
    fn check<D: Declared>(table: &ByOwner<D, u32, u32, Arc<str>>) {
        let bytes: usize = table.shares.values().map(|share| share.bytes).sum();
        let entries: usize = table.shares.values().map(|share| share.entries.len()).sum();
        assert_eq!((table.bytes, table.entries), (bytes, entries));
        assert!(bytes <= 20_000 && entries <= D::TABLE.entries);
        let orders: BTreeSet<_> = table
            .shares
            .iter()
            .map(|(owner, share)| (share.bytes, *owner))
            .collect();
        assert_eq!(table.by_bytes, orders);
    }

    #[test]
    fn a_flood_by_one_owner_leaves_the_others_their_entries() {
        let mut table: ByOwner<Fair, _, _, _> = ByOwner::default();
        for key in 0..10 {
            assert!(table.insert(1, key, text(100), 0));
        }
        for key in 0..1000 {
            table.insert(2, key, text(1000), 0);
            check(&table);
        }
        assert_eq!(table.of(1).count(), 10);
        assert!(table.of(2).count() > 10);
        // A third owner gets space from the largest owner.
        assert!((0..10).all(|key| table.insert(3, key, text(100), 0)));
        assert_eq!((table.of(1).count(), table.of(3).count()), (10, 10));
        check(&table);
        assert!(table.facts().evictions > 900);
    }

    #[test]
    fn a_new_entry_of_the_largest_owner_is_refused() {
        let mut table: ByOwner<Fair, _, _, _> = ByOwner::default();
        assert!(table.insert(1, 1, text(10_000), 0));
        assert!(!table.insert(1, 2, text(10_000), 0));
        assert!(table.insert(2, 2, text(5_000), 0));
        assert_eq!(table.get(1, &1), Some(&text(10_000)));
        check(&table);
    }

    #[test]
    fn a_full_table_without_fair_shares_keeps_its_first_entries() {
        let mut table: ByOwner<First, _, _, _> = ByOwner::default();
        let room = (0..200_u32).filter(|key| table.insert(*key, *key, text(0), 0));
        let room = room.count();
        assert!((10..100).contains(&room), "{room}");
        check(&table);
        assert!(table.get(0, &0).is_some());
        assert_eq!(table.facts().evictions, 200 - room as u64);
    }

    #[test]
    fn small_entries_are_refused_above_the_maximum_number() {
        let mut table: ByOwner<First, _, _, _> = ByOwner::default();
        assert_eq!(
            (0..200_u32)
                .filter(|key| table.insert(0, *key, (), 0))
                .count(),
            100
        );
    }

    #[test]
    fn removed_and_replaced_entries_free_their_bytes() {
        let mut table: ByOwner<Fair, _, _, _> = ByOwner::default();
        for turn in 0..1000 {
            assert!(table.insert(turn % 3, turn % 5, text(turn as usize), 0));
            check(&table);
        }
        assert_eq!(table.remove(0, &7), None);
        assert!(table.remove(0, &4).is_some());
        check(&table);
        assert_eq!(table.remove_owner(0).count(), 4);
        check(&table);
        for owner in [1, 2] {
            for key in 0..5 {
                table.remove(owner, &key);
                check(&table);
            }
        }
        assert_eq!((table.bytes, table.entries), (0, 0));
    }

    #[test]
    fn bytes_in_other_tables_count_toward_the_cap() {
        let mut table: ByOwner<First, _, _, _> = ByOwner::default();
        let room = (0..100_u32).filter(|key| table.insert(0, *key, (), 5_000));
        assert_eq!(room.count(), 3);
    }
}
