//! TypeObjects of XTypes by their hashes, from which lookups assemble types.
//!
//! The types of one topic may arrive in several replies, in any order. Each object is kept under the
//! hash of its bytes, so another object cannot take its place.

use ros2probe_wire::discovery::EquivalenceHash;

use crate::definition::{MessageType, TypeName};
use crate::library::kept::Kept;
use crate::type_object::{self, NotUsable, TypeObject};

/// Maximum number of TypeObjects, and of their bytes.
pub(super) const MAX_OBJECTS: usize = 2048;
pub(super) const MAX_OBJECT_BYTES: usize = 8 << 20;
/// Maximum number of types that one lookup without a hash of XTypes assembles.
const MAX_ASSEMBLED: usize = 16;

#[derive(Debug)]
pub(super) struct Objects {
    pub(super) kept: Kept<EquivalenceHash, Object>,
    /// Number of replies and objects that cannot be used.
    pub(super) refused: u64,
}

/// An object, or why it cannot be used.
#[derive(Debug)]
pub(super) struct Object {
    parsed: Result<TypeObject, NotUsable>,
    /// Number of objects that were known when it could not be assembled.
    tried: Option<u64>,
    is_assembled: bool,
}

impl Default for Objects {
    fn default() -> Self {
        Self {
            kept: Kept::new(Self::MAX, Self::MAX_BYTES),
            refused: 0,
        }
    }
}

impl Objects {
    pub(super) const MAX: usize = MAX_OBJECTS;
    pub(super) const MAX_BYTES: usize = MAX_OBJECT_BYTES;

    /// Adds the objects of a reply.
    pub(super) fn read(&mut self, reply: &[u8]) {
        let Ok(objects) = type_object::objects(reply) else {
            self.refused += 1;
            return;
        };
        for (hash, bytes) in objects {
            let parsed = TypeObject::parse(&bytes);
            let size = parsed
                .as_ref()
                .map_or(size_of::<Object>(), TypeObject::size);
            let is_refused = parsed.is_err();
            let object = Object {
                parsed,
                tried: None,
                is_assembled: false,
            };
            let is_new = self.kept.add(hash, object, size);
            self.refused += u64::from(is_new && is_refused);
        }
    }

    /// Returns the type with this hash; `None` if no reply had it.
    pub(super) fn message_type(
        &mut self,
        hash: EquivalenceHash,
    ) -> Option<Result<MessageType, NotUsable>> {
        self.kept.entries.get_mut(&hash)?.is_used = true;
        Some(self.assemble(hash))
    }

    /// Returns the latest types of this name that were not returned before.
    pub(super) fn of_name(&mut self, name: &TypeName) -> Vec<MessageType> {
        let added = self.kept.added;
        let is_of_name = |object: &Object| {
            let parsed = object.parsed.as_ref().ok();
            parsed.and_then(TypeObject::name) == Some(name)
        };
        let entries = self.kept.entries.iter();
        let mut roots: Vec<_> = entries
            .filter(|(_, entry)| {
                let object = &entry.value;
                !object.is_assembled && object.tried != Some(added) && is_of_name(object)
            })
            .map(|(hash, entry)| (entry.number, *hash))
            .collect();
        roots.sort_unstable_by(|one, other| other.cmp(one));
        let mut found = Vec::new();
        for (_, hash) in roots.into_iter().take(MAX_ASSEMBLED) {
            let assembled = self.assemble(hash);
            if let Some(entry) = self.kept.entries.get_mut(&hash) {
                entry.value.tried = Some(added);
                entry.value.is_assembled = assembled.is_ok();
            }
            found.extend(assembled);
        }
        found
    }

    fn assemble(&self, root: EquivalenceHash) -> Result<MessageType, NotUsable> {
        type_object::message_type(root, |hash| {
            let entry = self.kept.entries.get(&hash);
            let entry = entry.ok_or(NotUsable::Missing(hash))?;
            entry.value.parsed.as_ref().map_err(Clone::clone)
        })
    }
}
