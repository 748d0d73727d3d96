//! What a ROS message consists of: type names, fields, and a type with everything it is made of.
//!
//! A [`MessageType`] is closed (every nested type is there), free of recursion and no deeper than
//! [`MAX_DEPTH`], so whoever walks it needs no checks of its own. Defaults and constants are not
//! kept but in the text: neither is on the wire nor part of the type hash.

use std::collections::{BTreeMap, BTreeSet, HashMap};
use std::sync::Arc;

use super::idl;
use super::implicit_types::implicit_types;
pub use super::name::{Kind, NotATypeName, TypeName};
use super::parse::{self, ParseError};

/// How deep types may be nested.
pub const MAX_DEPTH: usize = 32;
/// How many types one type may be made of.
pub const MAX_TYPES: usize = 1024;
/// How much text may define one type, all its parts together.
pub const MAX_TEXT: usize = 4 << 20;
/// One member of a message.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Field {
    /// Its name.
    pub name: String,
    /// What it holds, or an array of it does.
    pub element: Element,
    /// How many.
    pub shape: Shape,
}

/// What a field holds one or many of.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Element {
    /// `bool`.
    Bool,
    /// `byte`, an octet.
    Byte,
    /// `char`, an octet too.
    Char,
    /// `int8`.
    Int8,
    /// `uint8`.
    UInt8,
    /// `int16`.
    Int16,
    /// `uint16`.
    UInt16,
    /// `int32`.
    Int32,
    /// `uint32`.
    UInt32,
    /// `int64`.
    Int64,
    /// `uint64`.
    UInt64,
    /// `float32`.
    Float32,
    /// `float64`.
    Float64,
    /// `string`, `string<=N`.
    String {
        /// How long at most.
        bound: Option<u32>,
    },
    /// `wstring`, `wstring<=N`.
    WString {
        /// How long at most.
        bound: Option<u32>,
    },
    /// Another type.
    Nested(TypeName),
}

/// How many elements a field has.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Shape {
    /// One, no array.
    Single,
    /// `[N]`.
    Array(u32),
    /// `[<=N]`.
    Bounded(u32),
    /// `[]`.
    Unbounded,
}

/// The members of one type. One without members is an octet on the wire, which rosidl calls
/// `structure_needs_at_least_one_member`.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Structure {
    /// The type.
    pub name: TypeName,
    /// Its members, in the order of the wire.
    pub fields: Vec<Field>,
}

/// One file: what it defines, including the types that services and actions imply.
#[derive(Debug, PartialEq, Eq)]
pub struct Definition {
    /// The type it is named after.
    pub name: TypeName,
    /// The file as it was read; for an `.idl` file the `.msg` text that means the same.
    pub text: Arc<str>,
    pub(super) structures: Vec<Arc<Structure>>,
    /// The messages that the text itself names.
    pub(super) uses: BTreeSet<TypeName>,
}

impl Definition {
    /// Reads a `.msg`, `.srv` or `.action` file, whichever the name is of.
    pub fn parse(name: TypeName, text: &str) -> Result<Self, ParseError> {
        let structures = parse::file(&name, text)?;
        Ok(Self::new(name, text.into(), structures))
    }

    /// Reads an `.idl` file of the kind that the name is of.
    pub fn parse_idl(name: TypeName, text: &str) -> Result<Self, ParseError> {
        idl::definition(name, text)
    }

    pub(super) fn new(name: TypeName, text: Arc<str>, written: Vec<Structure>) -> Self {
        let uses = written
            .iter()
            .flat_map(|structure| &structure.fields)
            .filter_map(|field| match &field.element {
                Element::Nested(nested) if nested.kind() == Kind::Message => Some(nested.clone()),
                _ => None,
            })
            .collect();
        let implied = implicit_types(&name);
        let structures = written.into_iter().chain(implied).map(Arc::new).collect();
        Self {
            name,
            text,
            structures,
            uses,
        }
    }
}

/// A type and all that it is made of.
#[derive(Debug, PartialEq, Eq)]
pub struct MessageType {
    /// The type itself.
    pub root: TypeName,
    pub(super) structures: BTreeMap<TypeName, Arc<Structure>>,
    /// The files that it comes from, by what they are named after.
    pub(super) definitions: BTreeMap<TypeName, Arc<Definition>>,
}

/// Why a type cannot be put together.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum NotClosed {
    /// It, or something in it, is defined nowhere.
    #[error("no definition of {0}")]
    Missing(TypeName),
    /// It contains itself.
    #[error("{0} contains itself")]
    Recursive(TypeName),
    /// Its types are nested too deeply.
    #[error("nested deeper than {MAX_DEPTH} types")]
    TooDeep,
    /// It has too many types.
    #[error("made of more than {MAX_TYPES} types")]
    TooMany,
    /// Its definitions are too long.
    #[error("defined by more than {MAX_TEXT} bytes of text")]
    TooLong,
}

impl MessageType {
    /// Reads the text of a bag's schema in encoding `ros2msg`: the type's own definition, then
    /// those that it needs, each below a line of 80 `=` and a line `MSG: package/Type`.
    pub fn parse(root: &TypeName, text: &str) -> Result<Self, SchemaError> {
        let mut definitions = HashMap::new();
        for (name, part) in super::schema::parts(root, text)? {
            let definition = Definition::parse(name.clone(), part)
                .map_err(|error| SchemaError::Definition(name.clone(), error))?;
            if definitions.len() == MAX_TYPES {
                return Err(NotClosed::TooMany.into());
            }
            definitions
                .entry(name)
                .or_insert_with(|| Arc::new(definition));
        }
        Ok(Self::assemble(root, |name| {
            Ok::<_, NotClosed>(definitions.get(name).cloned())
        })?)
    }

    /// Puts a type together from its files; `find` is asked for each of them once or twice.
    pub(super) fn assemble<E: From<NotClosed>>(
        root: &TypeName,
        mut find: impl FnMut(&TypeName) -> Result<Option<Arc<Definition>>, E>,
    ) -> Result<Self, E> {
        let mut found = Self {
            root: root.clone(),
            structures: BTreeMap::new(),
            definitions: BTreeMap::new(),
        };
        let mut wanted = vec![root.clone()];
        while let Some(name) = wanted.pop() {
            if found.structures.contains_key(&name) {
                continue;
            }
            if found.structures.len() == MAX_TYPES {
                return Err(NotClosed::TooMany.into());
            }
            let structure = found.resolve(&name, &mut find)?;
            for field in &structure.fields {
                if let Element::Nested(nested) = &field.element {
                    wanted.push(nested.clone());
                }
            }
            found.structures.insert(name, structure);
        }
        found.check(root, &mut Vec::new(), &mut HashMap::new())?;
        Ok(found)
    }

    fn resolve<E: From<NotClosed>>(
        &mut self,
        name: &TypeName,
        find: &mut impl FnMut(&TypeName) -> Result<Option<Arc<Definition>>, E>,
    ) -> Result<Arc<Structure>, E> {
        for file in name.files() {
            let definition = match self.definitions.get(&file) {
                Some(definition) => Some(definition.clone()),
                None => find(&file)?,
            };
            let Some(definition) = definition else {
                continue;
            };
            let structure = definition
                .structures
                .iter()
                .find(|structure| structure.name == *name)
                .cloned();
            if let Some(structure) = structure {
                self.definitions.insert(file, definition);
                let text = self
                    .definitions
                    .values()
                    .map(|definition| definition.text.len());
                if text.sum::<usize>() > MAX_TEXT {
                    return Err(NotClosed::TooLong.into());
                }
                return Ok(structure);
            }
        }
        Err(NotClosed::Missing(name.clone()).into())
    }

    /// How deep a type is; refuses what contains itself. A level of the stack for each level of
    /// types, no more than the limit.
    fn check(
        &self,
        name: &TypeName,
        above: &mut Vec<TypeName>,
        depths: &mut HashMap<TypeName, usize>,
    ) -> Result<usize, NotClosed> {
        if let Some(depth) = depths.get(name) {
            return Ok(*depth);
        }
        if above.contains(name) {
            return Err(NotClosed::Recursive(name.clone()));
        }
        if above.len() == MAX_DEPTH {
            return Err(NotClosed::TooDeep);
        }
        above.push(name.clone());
        let mut depth = 0;
        let structure = self
            .structure(name)
            .ok_or_else(|| NotClosed::Missing(name.clone()))?;
        for field in &structure.fields {
            if let Element::Nested(nested) = &field.element {
                depth = depth.max(self.check(nested, above, depths)?);
            }
        }
        above.pop();
        depth += 1;
        if above.len() + depth > MAX_DEPTH {
            return Err(NotClosed::TooDeep);
        }
        depths.insert(name.clone(), depth);
        Ok(depth)
    }

    /// The members of the type itself or of one that it is made of.
    pub fn structure(&self, name: &TypeName) -> Option<&Structure> {
        self.structures.get(name).map(Arc::as_ref)
    }

    /// Every type that it is made of, itself included, sorted by name.
    pub fn structures(&self) -> impl Iterator<Item = &Structure> {
        self.structures.values().map(Arc::as_ref)
    }
}

/// Why a schema's text cannot be used.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum SchemaError {
    /// The line that names a part is not one of `MSG: package/Type`.
    #[error("line {line}: expected `MSG: package/Type` below the line of `=`")]
    Heading {
        /// Which line.
        line: usize,
    },
    /// One of its definitions cannot be read.
    #[error("definition of {0}")]
    Definition(TypeName, #[source] ParseError),
    /// They do not belong together.
    #[error(transparent)]
    NotClosed(#[from] NotClosed),
}

#[cfg(test)]
mod tests {
    use super::*;

    fn name(text: &str) -> TypeName {
        text.parse().unwrap()
    }

    #[test]
    fn services_and_actions_imply_types() {
        let definition =
            Definition::parse(name("a/action/B"), "int8 a\n---\n---\nint8 c\n").unwrap();
        let names: Vec<_> = definition
            .structures
            .iter()
            .map(|one| one.name.name())
            .collect();
        assert_eq!(
            names,
            [
                "B_Goal",
                "B_Result",
                "B_Feedback",
                "B_SendGoal_Request",
                "B_SendGoal_Response",
                "B_GetResult_Request",
                "B_GetResult_Response",
                "B_FeedbackMessage",
                "B",
                "B_SendGoal_Event",
                "B_SendGoal",
                "B_GetResult_Event",
                "B_GetResult"
            ]
        );
        for implied in &definition.structures {
            assert!(
                implied.name.files().contains(&definition.name),
                "{}",
                implied.name
            );
        }
    }

    /// A schema in which each of `count` types has a member of the next one.
    fn chain(count: usize) -> String {
        let mut text = String::from("T1 next\n");
        for index in 1..count {
            let line = "=".repeat(80);
            text.push_str(&format!("{line}\nMSG: a/T{index}\nT{} next\n", index + 1));
        }
        text + &format!("{}\nMSG: a/T{count}\nint8 end\n", "=".repeat(80))
    }

    #[test]
    fn types_are_nested_up_to_the_limit() {
        let root = name("a/msg/T0");
        let deepest = MessageType::parse(&root, &chain(MAX_DEPTH - 1)).unwrap();
        assert_eq!(deepest.structures().count(), MAX_DEPTH);
        let deeper = MessageType::parse(&root, &chain(MAX_DEPTH));
        assert_eq!(
            deeper.unwrap_err(),
            SchemaError::NotClosed(NotClosed::TooDeep)
        );
    }

    #[test]
    fn what_contains_itself_or_misses_a_part_is_refused() {
        let text = format!("B b\n{}\nMSG: a/B\nA a\n", "=".repeat(80));
        let error = MessageType::parse(&name("a/msg/A"), &text).unwrap_err();
        assert!(
            matches!(error, SchemaError::NotClosed(NotClosed::Recursive(_))),
            "{error}"
        );
        let error = MessageType::parse(&name("a/msg/A"), "B b\n").unwrap_err();
        assert_eq!(
            error,
            SchemaError::NotClosed(NotClosed::Missing(name("a/msg/B")))
        );
    }

    #[test]
    fn a_type_has_a_bounded_number_of_types() {
        let mut text = String::new();
        for index in 0..=MAX_TYPES {
            text.push_str(&format!("other/T{index} f{index}\n"));
        }
        for index in 0..=MAX_TYPES {
            text.push_str(&format!("{}\nMSG: other/T{index}\n", "=".repeat(80)));
        }
        let error = MessageType::parse(&name("a/msg/A"), &text).unwrap_err();
        assert_eq!(error, SchemaError::NotClosed(NotClosed::TooMany));
    }
}
