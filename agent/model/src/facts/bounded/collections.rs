//! Methods of bounded containers. Methods that add an entry apply the cap. Most others forward to
//! the standard library.

use std::borrow::Borrow;
use std::collections::{
    BTreeMap, BTreeSet, HashMap, HashSet, VecDeque, btree_map, hash_map, vec_deque,
};
use std::hash::{BuildHasher, Hash};
use std::ops::RangeBounds;

use super::Bounded;
use super::Declared;
use super::ledger;

/// A container of the standard library.
pub trait Collection: Default {
    /// One entry.
    type Entry;

    /// Whether the container has an order, so that a full one can drop its first entry.
    const HAS_ORDER: bool;

    /// Returns the number of entries.
    fn length(&self) -> usize;

    /// Returns whether this entry would replace an existing one.
    fn replaces(&self, entry: &Self::Entry) -> bool;

    /// Adds an entry.
    fn put(&mut self, entry: Self::Entry);

    /// Removes the first entry, or none from a container without an order.
    fn pop_oldest(&mut self) -> Option<Self::Entry>;
}

/// Implements [`Collection`] with these closures.
macro_rules! collection {
    ([$($generic:tt)*] $of:ty, $entry:ty, $has_order:expr, $replaces:expr, $put:expr, $pop:expr) => {
        impl<$($generic)*> Collection for $of {
            type Entry = $entry;

            const HAS_ORDER: bool = $has_order;

            #[inline]
            fn length(&self) -> usize {
                self.len()
            }

            #[inline]
            fn replaces(&self, entry: &Self::Entry) -> bool {
                let replaces: fn(&Self, &Self::Entry) -> bool = $replaces;
                replaces(self, entry)
            }

            #[inline]
            fn put(&mut self, entry: Self::Entry) {
                let put: fn(&mut Self, Self::Entry) = $put;
                put(self, entry);
            }

            #[inline]
            fn pop_oldest(&mut self) -> Option<Self::Entry> {
                let pop: fn(&mut Self) -> Option<Self::Entry> = $pop;
                pop(self)
            }
        }
    };
}

collection!([T] Vec<T>, T, false, |_, _| false, Vec::push, |_| None);
collection!([T] VecDeque<T>, T, true, |_, _| false, VecDeque::push_back, VecDeque::pop_front);
collection!(
    [K: Ord] BTreeSet<K>, K, true, |set, key| set.contains(key),
    |set, key| { set.insert(key); }, BTreeSet::pop_first
);
collection!(
    [K: Hash + Eq, S: BuildHasher + Default] HashSet<K, S>, K, false, |set, key| set.contains(key),
    |set, key| { set.insert(key); }, |_| None
);
collection!(
    [K: Ord, V] BTreeMap<K, V>, (K, V), true, |map, (key, _)| map.contains_key(key),
    |map, (key, value)| { map.insert(key, value); }, BTreeMap::pop_first
);
collection!(
    [K: Hash + Eq, V, S: BuildHasher + Default] HashMap<K, V, S>, (K, V), false, |map, (key, _)| map.contains_key(key),
    |map, (key, value)| { map.insert(key, value); }, |_| None
);

/// Defines methods that add no entry.
macro_rules! forward {
    ($(fn $name:ident($($argument:ident: $of:ty),*) $(-> $returned:ty)?;)*) => {
        $(
            /// Forwards to the method of the standard library.
            #[inline]
            pub fn $name(&mut self, $($argument: $of),*) $(-> $returned)? {
                self.inner.$name($($argument),*)
            }
        )*
    };
}

impl<D: Declared, T> Bounded<D, Vec<T>> {
    forward! {
        fn clear();
        fn pop() -> Option<T>;
        fn remove(index: usize) -> T;
        fn swap_remove(index: usize) -> T;
        fn get_mut(index: usize) -> Option<&mut T>;
        fn last_mut() -> Option<&mut T>;
        fn as_mut_slice() -> &mut [T];
        fn iter_mut() -> std::slice::IterMut<'_, T>;
        fn retain(keep: impl FnMut(&T) -> bool);
        fn retain_mut(keep: impl FnMut(&mut T) -> bool);
        fn drain(range: impl RangeBounds<usize>) -> std::vec::Drain<'_, T>;
    }

    /// Adds all of `entries`, or none if they exceed the cap. Returns whether they were added.
    pub fn extend_from_slice(&mut self, entries: &[T]) -> bool
    where
        T: Clone,
    {
        let length = self.inner.len().saturating_add(entries.len());
        let has_room = length <= self.declared.cap();
        if has_room {
            self.inner.extend_from_slice(entries);
            ledger::filled(&D::TABLE, length, self.declared.cap());
        } else {
            self.refuse();
        }
        has_room
    }

    /// Adds an entry. Returns it if the vector is full.
    pub fn push(&mut self, entry: T) -> Option<T> {
        self.add(entry)
    }

    /// Inserts an entry at `index`. Returns it if the vector is full.
    pub fn insert(&mut self, index: usize, entry: T) -> Option<T> {
        let left = self.add(entry);
        if left.is_none() {
            self.inner
                .get_mut(index..)
                .unwrap_or_default()
                .rotate_right(1);
        }
        left
    }
}

impl<D: Declared, T> Bounded<D, VecDeque<T>> {
    forward! {
        fn clear();
        fn pop_front() -> Option<T>;
        fn pop_back() -> Option<T>;
        fn pop_front_if(is_due: impl FnOnce(&mut T) -> bool) -> Option<T>;
        fn remove(index: usize) -> Option<T>;
        fn get_mut(index: usize) -> Option<&mut T>;
        fn front_mut() -> Option<&mut T>;
        fn back_mut() -> Option<&mut T>;
        fn iter_mut() -> vec_deque::IterMut<'_, T>;
        fn retain(keep: impl FnMut(&T) -> bool);
        fn drain(range: impl RangeBounds<usize>) -> vec_deque::Drain<'_, T>;
        fn make_contiguous() -> &mut [T];
        fn retain_mut(keep: impl FnMut(&mut T) -> bool);
    }

    /// Inserts an entry at `index`. Returns it if the deque is full.
    pub fn insert(&mut self, index: usize, entry: T) -> Option<T> {
        if self.is_full() {
            self.refuse();
            return Some(entry);
        }
        self.inner.insert(index, entry);
        ledger::filled(&D::TABLE, self.inner.len(), self.declared.cap());
        None
    }

    /// Appends an entry. Returns the entry that the cap refused or removed.
    pub fn push_back(&mut self, entry: T) -> Option<T> {
        self.add(entry)
    }
}

impl<D: Declared, K: Ord> Bounded<D, BTreeSet<K>> {
    forward! {
        fn clear();
        fn pop_first() -> Option<K>;
        fn pop_last() -> Option<K>;
        fn remove(key: &K) -> bool;
        fn retain(keep: impl FnMut(&K) -> bool);
    }

    /// Removes and returns the entries below this key.
    pub fn take_below(&mut self, key: &K) -> BTreeSet<K> {
        let kept = self.inner.split_off(key);
        std::mem::replace(&mut self.inner, kept)
    }

    /// Adds an entry. Returns whether the set has grown.
    pub fn insert(&mut self, key: K) -> bool {
        let before = self.inner.len();
        self.add(key).is_none() && self.inner.len() > before
    }
}

impl<D: Declared, K: Hash + Eq, S: BuildHasher + Default> Bounded<D, HashSet<K, S>> {
    forward! {
        fn clear();
        fn remove(key: &K) -> bool;
        fn retain(keep: impl FnMut(&K) -> bool);
    }

    /// Adds an entry. Returns whether the set has grown.
    pub fn insert(&mut self, key: K) -> bool {
        let before = self.inner.len();
        self.add(key).is_none() && self.inner.len() > before
    }
}

impl<D: Declared, K: Ord, V> Bounded<D, BTreeMap<K, V>> {
    forward! {
        fn clear();
        fn pop_first() -> Option<(K, V)>;
        fn pop_last() -> Option<(K, V)>;
        fn first_entry() -> Option<btree_map::OccupiedEntry<'_, K, V>>;
        fn remove(key: &K) -> Option<V>;
        fn iter_mut() -> btree_map::IterMut<'_, K, V>;
        fn values_mut() -> btree_map::ValuesMut<'_, K, V>;
        fn range_mut(range: impl RangeBounds<K>) -> btree_map::RangeMut<'_, K, V>;
        fn retain(keep: impl FnMut(&K, &mut V) -> bool);
    }

    /// Forwards to the method of the standard library.
    #[inline]
    pub fn get_mut<Q: Ord + ?Sized>(&mut self, key: &Q) -> Option<&mut V>
    where
        K: Borrow<Q>,
    {
        self.inner.get_mut(key)
    }

    /// Removes and returns the entries below this key.
    pub fn take_below(&mut self, key: &K) -> BTreeMap<K, V> {
        let kept = self.inner.split_off(key);
        std::mem::replace(&mut self.inner, kept)
    }

    /// Adds or replaces an entry. Returns the entry that the cap refused or removed.
    pub fn insert(&mut self, key: K, value: V) -> Option<(K, V)> {
        self.add((key, value))
    }

    /// Removes and returns the entry with the least age, counted as a refusal, if the map is full
    /// and lacks this key.
    pub fn make_room<T: Ord>(&mut self, key: &K, age: impl Fn(&V) -> T) -> Option<(K, V)>
    where
        K: Clone,
    {
        if !self.is_full() || self.inner.contains_key(key) {
            return None;
        }
        self.refuse();
        let oldest = self.inner.iter().min_by_key(|(_, value)| age(value));
        let key = oldest.map(|(key, _)| key.clone())?;
        self.inner.remove_entry(&key)
    }

    /// Returns the value of this key, and adds it if it is missing. Returns `None` if the map is
    /// full.
    pub fn get_or_insert_with(&mut self, key: K, value: impl FnOnce() -> V) -> Option<&mut V> {
        self.has_room_for(|map| map.contains_key(&key))
            .then(|| self.inner.entry(key).or_insert_with(value))
    }
}

impl<D: Declared, K: Hash + Eq, V, S: BuildHasher + Default> Bounded<D, HashMap<K, V, S>> {
    forward! {
        fn clear();
        fn remove(key: &K) -> Option<V>;
        fn iter_mut() -> hash_map::IterMut<'_, K, V>;
        fn values_mut() -> hash_map::ValuesMut<'_, K, V>;
        fn retain(keep: impl FnMut(&K, &mut V) -> bool);
    }

    /// Forwards to the method of the standard library.
    #[inline]
    pub fn get_mut<Q: Hash + Eq + ?Sized>(&mut self, key: &Q) -> Option<&mut V>
    where
        K: Borrow<Q>,
    {
        self.inner.get_mut(key)
    }

    /// Adds or replaces an entry. Returns the new entry if the map is full.
    pub fn insert(&mut self, key: K, value: V) -> Option<(K, V)> {
        self.add((key, value))
    }

    /// Returns the value of this key, and adds it if it is missing. Returns `None` if the map is
    /// full.
    pub fn get_or_insert_with(&mut self, key: K, value: impl FnOnce() -> V) -> Option<&mut V> {
        self.has_room_for(|map| map.contains_key(&key))
            .then(|| self.inner.entry(key).or_insert_with(value))
    }
}
