//! Joins TypeObjects to one type.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

use ros2probe_wire::discovery::EquivalenceHash;

use super::{NotUsable, Reference, StructureObject, Target, TypeObject};
use crate::definition::{
    Definition, Element, Field, MAX_DEPTH, MAX_TYPES, MessageType, NotClosed, Shape, TypeName,
};
use crate::type_description::{definition, structure_of};

/// Maximum number of fields of one type and its nested types. A base type counts in each structure
/// that it extends.
const MAX_TOTAL_FIELDS: usize = 1 << 16;

/// Returns the type with this hash. `find` returns an object by its hash.
///
/// # Errors
/// Fails if an object is missing, or if the objects do not form one type.
pub(crate) fn message_type<'a>(
    root: EquivalenceHash,
    find: impl Fn(EquivalenceHash) -> Result<&'a TypeObject, NotUsable>,
) -> Result<MessageType, NotUsable> {
    let mut assembly = Assembly {
        find,
        fields: 0,
        names: BTreeMap::new(),
        wanted: Vec::new(),
    };
    let root = assembly.structure(root)?;
    let mut definitions = BTreeMap::new();
    assembly.wanted.push(root);
    while let Some(structure) = assembly.wanted.pop() {
        if structure.is_appendable != root.is_appendable {
            // XCDR2 writes the size of appendable structures only.
            return Err(NotUsable::Kind(
                "a mixture of final and appendable structures",
            ));
        }
        if definitions.contains_key(&structure.name) {
            continue;
        }
        if definitions.len() == MAX_TYPES {
            return Err(NotClosed::TooMany.into());
        }
        let definition = assembly.definition(structure)?;
        definitions.insert(structure.name.clone(), Arc::new(definition));
    }
    MessageType::assemble(&root.name, |name| {
        Ok::<_, NotUsable>(definitions.get(name).cloned())
    })
}

struct Assembly<'a, F> {
    find: F,
    fields: usize,
    /// The hash of each name.
    names: BTreeMap<&'a TypeName, EquivalenceHash>,
    wanted: Vec<&'a StructureObject>,
}

impl<'a, F> Assembly<'a, F>
where
    F: Fn(EquivalenceHash) -> Result<&'a TypeObject, NotUsable>,
{
    fn structure(&mut self, hash: EquivalenceHash) -> Result<&'a StructureObject, NotUsable> {
        let TypeObject::Structure(structure) = (self.find)(hash)? else {
            return Err(NotUsable::Kind("a type without fields"));
        };
        let known = *self.names.entry(&structure.name).or_insert(hash);
        if known != hash {
            return Err(NotUsable::Ambiguous(structure.name.clone()));
        }
        Ok(structure)
    }

    fn definition(&mut self, structure: &'a StructureObject) -> Result<Definition, NotUsable> {
        // The base types, the outermost first.
        let mut levels = vec![structure];
        let mut level = structure;
        while let Some(base) = level.base {
            if levels.len() == MAX_DEPTH {
                return Err(NotClosed::TooDeep.into());
            }
            level = self.structure(base)?;
            levels.push(level);
        }
        let (mut fields, mut names) = (Vec::new(), BTreeSet::new());
        for (name, reference) in levels.iter().rev().flat_map(|level| &level.members) {
            self.fields += 1;
            if self.fields > MAX_TOTAL_FIELDS {
                return Err(NotClosed::TooLong.into());
            }
            if !names.insert(name) {
                return Err(NotUsable::Twice(name.clone()));
            }
            let (element, shape) = self.element(reference)?;
            fields.push(Field {
                name: name.clone(),
                element,
                shape,
            });
        }
        let structure = structure_of(structure.name.clone(), fields);
        Ok(definition(structure))
    }

    /// Resolves aliases.
    fn element(&mut self, reference: &Reference) -> Result<(Element, Shape), NotUsable> {
        let mut reference = reference.clone();
        for _ in 0..MAX_DEPTH {
            let hash = match reference.target {
                Target::Element(element) => return Ok((element, reference.shape)),
                Target::Type(hash) => hash,
            };
            match (self.find)(hash)? {
                TypeObject::Alias(other) => {
                    reference = other.clone().in_collection(reference.shape)?;
                }
                TypeObject::Enumeration(_) if reference.shape != Shape::Single => {
                    return Err(NotUsable::Kind("a collection of enumerations"));
                }
                TypeObject::Enumeration(element) => {
                    return Ok((element.clone(), reference.shape));
                }
                TypeObject::Structure(structure) => {
                    let structure_of_hash = self.structure(hash)?;
                    self.wanted.push(structure_of_hash);
                    return Ok((Element::Nested(structure.name.clone()), reference.shape));
                }
            }
        }
        Err(NotClosed::TooDeep.into())
    }
}
