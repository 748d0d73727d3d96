//! Items that wait for one reader, in order of arrival and by topic.
//!
//! The oldest sample of the topic with most bytes is evicted first: a few point clouds rather than
//! all of `/tf`. Clock items are evicted before any sample, since a later one supersedes them. This
//! module has no limit and counts no losses.

use std::cmp::Reverse;
use std::collections::{BTreeMap, HashMap, VecDeque};
use std::sync::Arc;

use super::Item;
use super::channel::QueuedBytes;
use ros2probe_model::facts::names::DdsName;

/// Entries by arrival number.
#[derive(Debug, Default)]
pub(super) struct Backlog {
    entries: BTreeMap<u64, Entry>,
    /// Number of arrival numbers assigned so far.
    places: u64,
    bytes: usize,
    topics: HashMap<Key, Held>,
    /// Arrival numbers of entries without a topic.
    times: VecDeque<u64>,
}

#[derive(Debug)]
struct Entry {
    item: Item,
    bytes: usize,
    /// Released when the entry is removed.
    _charge: Option<Arc<QueuedBytes>>,
}

/// Domain and DDS name, which writers of one topic share.
type Key = (u32, DdsName);

/// Waiting entries of one topic; never empty.
#[derive(Debug, Default)]
struct Held {
    places: VecDeque<u64>,
    bytes: usize,
}

impl Backlog {
    /// Returns the size of all entries in bytes.
    pub(super) const fn bytes(&self) -> usize {
        self.bytes
    }

    pub(super) fn push(&mut self, item: Item, bytes: usize, charge: Option<Arc<QueuedBytes>>) {
        let place = self.places;
        self.places += 1;
        self.bytes += bytes;
        match key(&item) {
            Some(key) => {
                let held = self.topics.entry(key).or_default();
                held.places.push_back(place);
                held.bytes += bytes;
            }
            None => self.times.push_back(place),
        }
        let entry = Entry {
            item,
            bytes,
            _charge: charge,
        };
        self.entries.insert(place, entry);
    }

    /// Returns the newest entry, if any. Callers must not change its topic or size.
    pub(super) fn last_mut(&mut self) -> Option<&mut Item> {
        let last = self.entries.last_entry()?;
        Some(&mut last.into_mut().item)
    }

    /// Removes the oldest entry, if any.
    pub(super) fn pop(&mut self) -> Option<Item> {
        let place = *self.entries.first_key_value()?.0;
        self.remove(place)
    }

    /// Evicts the least important entry, if any.
    pub(super) fn evict_least_important(&mut self) -> Option<Item> {
        let time = self.times.front().copied();
        let place = time.or_else(|| {
            // Among topics with equal bytes, the one with the oldest entry is chosen.
            let rank = |held: &&Held| (held.bytes, Reverse(held.places.front().copied()));
            self.topics
                .values()
                .max_by_key(rank)?
                .places
                .front()
                .copied()
        })?;
        self.remove(place)
    }

    /// Removes an entry, which must be the oldest of its topic, or the oldest without a topic.
    fn remove(&mut self, place: u64) -> Option<Item> {
        let entry = self.entries.remove(&place)?;
        self.bytes -= entry.bytes;
        let Some(key) = key(&entry.item) else {
            self.times.pop_front();
            return Some(entry.item);
        };
        if let Some(held) = self.topics.get_mut(&key) {
            held.places.pop_front();
            held.bytes -= entry.bytes;
            if held.places.is_empty() {
                self.topics.remove(&key);
            }
        }
        Some(entry.item)
    }
}

fn key(item: &Item) -> Option<Key> {
    let topic = match item {
        Item::Sample(sample) => &sample.topic,
        Item::Missed(missed) => &missed.topic,
        Item::Clock(_) | Item::End(_) => return None,
    };
    Some((topic.domain_id.0, topic.dds_name.clone()))
}
