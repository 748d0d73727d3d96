//! Types that nodes described, for types without an installed package.
//!
//! Responses wait until a lookup needs them, so receiving one costs nothing but its bytes. Every
//! type is filed under its name and its computed hash. A lookup with an announced hash therefore
//! never returns another type, even if a response is forged.

use std::collections::{BTreeMap, VecDeque};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use crate::definition::{MessageType, TypeName};
use crate::type_description::{MAX_RESPONSE, described_type};

/// Maximum number of responses that wait, and of their bytes.
pub(super) const MAX_WAITING: usize = 128;
pub(super) const MAX_WAITING_BYTES: usize = 2 << 20;
/// Maximum number of described types, and of the bytes of their definitions.
pub(super) const MAX_TYPES: usize = 512;
pub(super) const MAX_BYTES: usize = 8 << 20;
/// Approximate memory of a structure or field, in addition to its text.
const OVERHEAD: usize = 160;

/// Described types and their counters. Lookups read responses without a lock that
/// [`Self::offer`] or [`Self::figures`] takes, so the thread that captures never waits for them.
#[derive(Debug, Default)]
pub(super) struct Described {
    waiting: Mutex<Waiting>,
    /// Held by the lookup that reads responses; others wait for it.
    reading: Mutex<()>,
    types: Mutex<Types>,
}

/// Responses that no lookup has read, the oldest first.
#[derive(Debug, Default)]
struct Waiting {
    responses: VecDeque<Arc<[u8]>>,
    bytes: usize,
    refused: u64,
    evicted: u64,
}

#[derive(Debug, Default)]
struct Types {
    entries: BTreeMap<(TypeName, String), Entry>,
    bytes: usize,
    learned: u64,
    refused: u64,
    mismatched: u64,
    evicted: u64,
}

#[derive(Debug)]
struct Entry {
    message_type: Arc<MessageType>,
    bytes: usize,
    /// Place in the order of arrival.
    number: u64,
    /// Whether a lookup with an announced hash returned it.
    is_used: bool,
}

/// Counts of responses and described types.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct DescribedFigures {
    /// Described types that are kept.
    pub types: usize,
    /// Bytes of their definitions, and of responses that wait.
    pub bytes: usize,
    /// Responses that describe a type for the first time.
    pub learned: u64,
    /// Responses that cannot be used.
    pub refused: u64,
    /// Lookups for which only descriptions with another hash than the announced one exist.
    pub mismatched: u64,
    /// Responses and types dropped because of a cap.
    pub evicted: u64,
}

impl DescribedFigures {
    /// Maximum of `types`.
    pub const MAX_TYPES: usize = MAX_TYPES;
    /// Maximum of `bytes`.
    pub const MAX_BYTES: usize = MAX_BYTES + MAX_WAITING_BYTES;
}

impl Described {
    /// Keeps a response until the next lookup; the oldest ones make room.
    pub(super) fn offer(&self, response: Arc<[u8]>) {
        let mut waiting = locked(&self.waiting);
        if response.len() > MAX_RESPONSE {
            waiting.refused += 1;
            return;
        }
        if waiting.responses.contains(&response) {
            return;
        }
        waiting.bytes += response.len();
        waiting.responses.push_back(response);
        while waiting.responses.len() > MAX_WAITING || waiting.bytes > MAX_WAITING_BYTES {
            let Some(oldest) = waiting.responses.pop_front() else {
                break;
            };
            waiting.bytes -= oldest.len();
            waiting.evicted += 1;
        }
    }

    /// Returns the type with the announced hash, or the latest one if no hash is announced. Fails
    /// with the hash of another description of this name, if one exists.
    pub(super) fn find(
        &self,
        name: &TypeName,
        announced: Option<&str>,
    ) -> Result<Arc<MessageType>, Option<String>> {
        self.read();
        locked(&self.types).find(name, announced)
    }

    /// Adds a type.
    pub(super) fn add(&self, message_type: MessageType) {
        let (hash, bytes) = (message_type.type_hash(), size(&message_type));
        locked(&self.types).add(message_type, hash, bytes);
    }

    pub(super) fn figures(&self) -> DescribedFigures {
        let (waiting, types) = (locked(&self.waiting), locked(&self.types));
        DescribedFigures {
            types: types.entries.len(),
            bytes: types.bytes + waiting.bytes,
            learned: types.learned,
            refused: types.refused + waiting.refused,
            mismatched: types.mismatched,
            evicted: types.evicted + waiting.evicted,
        }
    }

    /// Reads the responses that wait.
    fn read(&self) {
        let _reading = locked(&self.reading);
        let responses = {
            let mut waiting = locked(&self.waiting);
            waiting.bytes = 0;
            std::mem::take(&mut waiting.responses)
        };
        for response in responses {
            match described_type(&response) {
                Ok(message_type) => self.add(message_type),
                Err(_) => locked(&self.types).refused += 1,
            }
        }
    }
}

impl Types {
    fn find(
        &mut self,
        name: &TypeName,
        announced: Option<&str>,
    ) -> Result<Arc<MessageType>, Option<String>> {
        let Some(announced) = announced else {
            let latest = self.of_name(name).max_by_key(|(_, entry)| entry.number);
            let found = latest.map(|(_, entry)| Arc::clone(&entry.message_type));
            return found.ok_or(None);
        };
        if let Some(entry) = self.entries.get_mut(&(name.clone(), announced.to_owned())) {
            entry.is_used = true;
            return Ok(Arc::clone(&entry.message_type));
        }
        let other = self.of_name(name).next().map(|((_, hash), _)| hash.clone());
        self.mismatched += u64::from(other.is_some());
        Err(other)
    }

    /// Adds a type. If there is no room, the oldest types that no lookup returned are dropped.
    /// Forged descriptions thus do not displace those of announced types.
    fn add(&mut self, message_type: MessageType, hash: String, bytes: usize) {
        let key = (message_type.root.clone(), hash);
        if self.entries.contains_key(&key) {
            return;
        }
        while self.entries.len() >= MAX_TYPES || self.bytes + bytes > MAX_BYTES {
            self.evicted += 1;
            let unused = self.entries.iter().filter(|(_, entry)| !entry.is_used);
            let oldest = unused.min_by_key(|(_, entry)| entry.number);
            let Some(oldest) = oldest.map(|(key, _)| key.clone()) else {
                return;
            };
            if let Some(dropped) = self.entries.remove(&oldest) {
                self.bytes -= dropped.bytes;
            }
        }
        self.learned += 1;
        self.bytes += bytes;
        let entry = Entry {
            message_type: Arc::new(message_type),
            bytes,
            number: self.learned,
            is_used: false,
        };
        self.entries.insert(key, entry);
    }

    fn of_name<'a>(
        &'a self,
        name: &'a TypeName,
    ) -> impl Iterator<Item = (&'a (TypeName, String), &'a Entry)> {
        let from = self.entries.range((name.clone(), String::new())..);
        from.take_while(move |((known, _), _)| known == name)
    }
}

/// Locks the mutex. A poisoned lock is usable, since the contents are always consistent.
fn locked<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Returns the approximate memory of a type, in bytes.
fn size(message_type: &MessageType) -> usize {
    let structures = message_type.structures().map(|structure| {
        let names = structure.fields.iter().map(|field| field.name.len());
        OVERHEAD * (1 + structure.fields.len()) + names.sum::<usize>()
    });
    let texts = message_type.definitions.values();
    structures.sum::<usize>() + texts.map(|one| one.text.len()).sum::<usize>()
}
