//! Types that nodes sent, for types without an installed package: responses of
//! `get_type_description`, and replies of the TypeLookup service of XTypes.
//!
//! Both wait until a lookup needs them, so receiving one costs nothing but its bytes. Every type is
//! filed under its name and its computed hash. A lookup with an announced hash therefore never
//! returns another type, even if a response is forged.

use std::collections::VecDeque;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use ros2probe_wire::discovery::EquivalenceHash;

use crate::definition::{MessageType, TypeName};
use crate::library::HASH_PREFIX;
use crate::library::kept::Kept;
use crate::library::objects::Objects;
use crate::type_description::{MAX_RESPONSE, described_type};
use crate::type_object::{self, NotUsable};

/// Maximum number of responses and replies that wait, and of their bytes.
pub(super) const MAX_WAITING: usize = 128;
pub(super) const MAX_WAITING_BYTES: usize = 2 << 20;
/// Maximum number of described types, and of the bytes of their definitions.
pub(super) const MAX_TYPES: usize = 512;
pub(super) const MAX_BYTES: usize = 8 << 20;
/// Approximate memory of a structure or field, in addition to its text.
const ENTRY_OVERHEAD: usize = 160;

/// Described types and their counters. Lookups read responses without a lock that
/// [`Self::offer`] or [`Self::figures`] takes, so the thread that captures never waits for them.
#[derive(Debug, Default)]
pub(super) struct Described {
    waiting: Mutex<Waiting>,
    /// Held by the lookup that reads responses; others wait for it.
    reading: Mutex<Objects>,
    types: Mutex<Types>,
}

/// What a node sent about its types.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) enum TypeSource {
    /// A response of `get_type_description`, with its encapsulation header.
    Description(Arc<[u8]>),
    /// A reply of the TypeLookup service of XTypes, with its encapsulation header.
    TypeObjects(Arc<[u8]>),
}

/// Responses and replies that no lookup has read, the oldest first.
#[derive(Debug, Default)]
struct Waiting {
    sources: VecDeque<TypeSource>,
    bytes: usize,
    refused: u64,
    refused_objects: u64,
    evicted: u64,
}

#[derive(Debug)]
struct Types {
    kept: Kept<(TypeName, String), Arc<MessageType>>,
    refused: u64,
    mismatched: u64,
    /// Figures of the type objects, as of the last lookup.
    objects: usize,
    object_bytes: usize,
    objects_refused: u64,
    objects_evicted: u64,
}

/// Why no node described a type.
#[derive(Debug)]
pub(super) enum NotSent {
    /// No node sent the type.
    Nothing,
    /// Nodes described types of this name with other hashes, such as this one.
    Another(String),
    /// The announced type is not usable, or a part of it was not sent.
    NotUsable(NotUsable),
}

/// Counts of responses and described types.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct DescribedFigures {
    /// Described types that are kept.
    pub types: usize,
    /// Bytes of their definitions.
    pub bytes: usize,
    /// Responses and replies that wait until a lookup reads them.
    pub waiting: usize,
    /// Bytes of these responses and replies.
    pub waiting_bytes: usize,
    /// Responses and replies dropped unread because of a cap.
    pub waiting_evicted: u64,
    /// Types that were described for the first time.
    pub learned: u64,
    /// Number of rejected responses.
    pub refused: u64,
    /// Lookups for which only descriptions with another hash than the announced one exist.
    pub mismatched: u64,
    /// Described types dropped because of a cap.
    pub evicted: u64,
    /// TypeObjects that are kept.
    pub objects: usize,
    /// Bytes of these objects.
    pub object_bytes: usize,
    /// Replies and TypeObjects that cannot be used.
    pub objects_refused: u64,
    /// TypeObjects dropped because of a cap.
    pub objects_evicted: u64,
}

impl DescribedFigures {
    /// Maximum of `types`.
    pub const MAX_TYPES: usize = MAX_TYPES;
    /// Maximum of `bytes`.
    pub const MAX_BYTES: usize = MAX_BYTES;
    /// Maximum of `waiting`.
    pub const MAX_WAITING: usize = MAX_WAITING;
    /// Maximum of `waiting_bytes`.
    pub const MAX_WAITING_BYTES: usize = MAX_WAITING_BYTES;
    /// Maximum of `objects`.
    pub const MAX_OBJECTS: usize = Objects::MAX;
    /// Maximum of `object_bytes`.
    pub const MAX_OBJECT_BYTES: usize = Objects::MAX_BYTES;
}

impl TypeSource {
    const fn bytes(&self) -> &Arc<[u8]> {
        match self {
            Self::Description(bytes) | Self::TypeObjects(bytes) => bytes,
        }
    }

    /// Returns whether both have the same types. Each node requests each type, and the replies
    /// differ in the identities of the requests.
    fn has_content_of(&self, other: &Self) -> bool {
        match (self, other) {
            (Self::TypeObjects(one), Self::TypeObjects(other)) => {
                type_object::without_request(one) == type_object::without_request(other)
            }
            _ => self == other,
        }
    }
}

impl Described {
    /// Keeps a response or reply until the next lookup; the oldest ones make room.
    pub(super) fn offer(&self, source: TypeSource) {
        let mut waiting = locked(&self.waiting);
        let length = source.bytes().len();
        match &source {
            TypeSource::Description(_) if length > MAX_RESPONSE => {
                waiting.refused += 1;
                return;
            }
            TypeSource::TypeObjects(_) if length > type_object::MAX_REPLY => {
                waiting.refused_objects += 1;
                return;
            }
            _ if waiting
                .sources
                .iter()
                .any(|kept| kept.has_content_of(&source)) =>
            {
                return;
            }
            _ => {}
        }
        waiting.bytes += length;
        waiting.sources.push_back(source);
        while waiting.sources.len() > MAX_WAITING || waiting.bytes > MAX_WAITING_BYTES {
            let Some(oldest) = waiting.sources.pop_front() else {
                break;
            };
            waiting.bytes -= oldest.bytes().len();
            waiting.evicted += 1;
        }
    }

    /// Returns the type with the announced hash, RIHS01 or that of XTypes. Returns the latest one
    /// if no hash is announced.
    pub(super) fn find(
        &self,
        name: &TypeName,
        announced: Option<&str>,
    ) -> Result<Arc<MessageType>, NotSent> {
        let mut objects = locked(&self.reading);
        self.read(&mut objects);
        let equivalence = announced.and_then(EquivalenceHash::parse);
        let mut failure = None;
        match equivalence {
            Some(hash) if locked(&self.types).has(name, hash) => {}
            Some(hash) => match objects.message_type(hash) {
                Some(Ok(found)) => self.add(found, Some(hash)),
                Some(Err(reason)) => failure = Some(reason),
                None => {}
            },
            None => {
                for found in objects.of_name(name) {
                    self.add(found, None);
                }
            }
        }
        let mut types = locked(&self.types);
        types
            .find(name, announced)
            .map_err(|other| match (failure, other) {
                (Some(reason), _) => NotSent::NotUsable(reason),
                (None, Some(other)) => NotSent::Another(other),
                (None, None) => NotSent::Nothing,
            })
    }

    /// Adds a type, under its hash of XTypes or else of ROS.
    pub(super) fn add(&self, message_type: MessageType, hash: Option<EquivalenceHash>) {
        let hash = match hash {
            Some(hash) => hash.to_string(),
            None => message_type.type_hash(),
        };
        let bytes = size(&message_type);
        let key = (message_type.root.clone(), hash);
        let mut types = locked(&self.types);
        types.kept.add(key, Arc::new(message_type), bytes);
    }

    pub(super) fn figures(&self) -> DescribedFigures {
        let (waiting, types) = (locked(&self.waiting), locked(&self.types));
        DescribedFigures {
            types: types.kept.entries.len(),
            bytes: types.kept.bytes,
            waiting: waiting.sources.len(),
            waiting_bytes: waiting.bytes,
            waiting_evicted: waiting.evicted,
            learned: types.kept.added,
            refused: types.refused + waiting.refused,
            mismatched: types.mismatched,
            evicted: types.kept.evicted,
            objects: types.objects,
            object_bytes: types.object_bytes,
            objects_refused: types.objects_refused + waiting.refused_objects,
            objects_evicted: types.objects_evicted,
        }
    }

    /// Reads the responses and replies that wait.
    fn read(&self, objects: &mut Objects) {
        let sources = {
            let mut waiting = locked(&self.waiting);
            waiting.bytes = 0;
            std::mem::take(&mut waiting.sources)
        };
        for source in sources {
            match source {
                TypeSource::Description(response) => match described_type(&response) {
                    Ok(message_type) => self.add(message_type, None),
                    Err(_) => locked(&self.types).refused += 1,
                },
                TypeSource::TypeObjects(reply) => objects.read(&reply),
            }
        }
        let mut types = locked(&self.types);
        (types.objects, types.object_bytes) = (objects.kept.entries.len(), objects.kept.bytes);
        (types.objects_refused, types.objects_evicted) = (objects.refused, objects.kept.evicted);
    }
}

impl Default for Types {
    fn default() -> Self {
        Self {
            kept: Kept::new(MAX_TYPES, MAX_BYTES),
            refused: 0,
            mismatched: 0,
            objects: 0,
            object_bytes: 0,
            objects_refused: 0,
            objects_evicted: 0,
        }
    }
}

impl Types {
    fn has(&self, name: &TypeName, hash: EquivalenceHash) -> bool {
        let key = (name.clone(), hash.to_string());
        self.kept.entries.contains_key(&key)
    }

    /// Fails with another hash of the same kind, if a type of this name has one.
    fn find(
        &mut self,
        name: &TypeName,
        announced: Option<&str>,
    ) -> Result<Arc<MessageType>, Option<String>> {
        let from = (name.clone(), String::new());
        let entries = self.kept.entries.range(from..);
        let mut of_name = entries.take_while(|((known, _), _)| known == name);
        let Some(announced) = announced else {
            let latest = of_name.max_by_key(|(_, entry)| entry.number);
            let found = latest.map(|(_, entry)| Arc::clone(&entry.value));
            return found.ok_or(None);
        };
        let is_same_kind =
            |hash: &str| hash.starts_with(HASH_PREFIX) == announced.starts_with(HASH_PREFIX);
        let other = of_name.find(|((_, hash), _)| is_same_kind(hash));
        let other = other.map(|((_, hash), _)| hash.clone());
        if let Some(entry) = self
            .kept
            .entries
            .get_mut(&(name.clone(), announced.to_owned()))
        {
            entry.is_used = true;
            return Ok(Arc::clone(&entry.value));
        }
        self.mismatched += u64::from(other.is_some());
        Err(other)
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
        ENTRY_OVERHEAD * (1 + structure.fields.len()) + names.sum::<usize>()
    });
    let texts = message_type.definitions.values();
    structures.sum::<usize>() + texts.map(|one| one.text.len()).sum::<usize>()
}
