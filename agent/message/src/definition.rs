//! Definition of a ROS message: type names, fields, and a type with all its nested types.
//!
//! A [`MessageType`] is closed (every nested type is included), free of recursion and no deeper
//! than [`MAX_DEPTH`], so code that walks it needs no checks. Defaults and constants are kept only
//! in the text: they are neither on the wire nor part of the type hash.

mod idl;
mod implicit_types;
pub(crate) mod parse;
pub(crate) mod schema;

use std::collections::{BTreeMap, BTreeSet, HashMap};
use std::sync::Arc;

pub use crate::name::{Kind, NotATypeName, TypeName};
use implicit_types::implicit_types;
use parse::ParseError;

/// Maximum depth of nested types.
pub const MAX_DEPTH: usize = 32;
/// Maximum number of types in the definition of one type.
pub const MAX_TYPES: usize = 1024;
/// Maximum size of the text that defines one type, including its nested types, in bytes.
pub const MAX_TEXT: usize = 4 << 20;
/// One member of a message.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Field {
    /// Name of the field.
    pub name: String,
    /// Type of the value, or of an array's elements.
    pub element: Element,
    /// Whether the field is a single value or an array, and the array's length.
    pub shape: Shape,
}

/// Type of a field's value or elements.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Element {
    /// `bool`.
    Bool,
    /// `byte`, an octet.
    Byte,
    /// `char`, also an octet.
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
        /// Maximum number of characters; `None` = unbounded.
        bound: Option<u32>,
    },
    /// `wstring`, `wstring<=N`.
    WString {
        /// Maximum number of characters; `None` = unbounded.
        bound: Option<u32>,
    },
    /// Another message type.
    Nested(TypeName),
}

/// Number of elements of a field.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Shape {
    /// A single value, not an array.
    Single,
    /// `[N]`: exactly N elements.
    Array(u32),
    /// `[<=N]`: at most N elements.
    Bounded(u32),
    /// `[]`: any number of elements.
    Unbounded,
}

/// The fields of one type. A type without fields is an octet on the wire, which rosidl calls
/// `structure_needs_at_least_one_member`.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Structure {
    /// Name of the type.
    pub name: TypeName,
    /// Its fields, in wire order.
    pub fields: Vec<Field>,
}

/// The types of one file, including the types that services and actions imply.
#[derive(Debug, PartialEq, Eq)]
pub struct Definition {
    /// The type after which the file is named.
    pub name: TypeName,
    /// Content of the file; for an `.idl` file the equivalent `.msg` text.
    pub text: Arc<str>,
    pub(super) structures: Vec<Arc<Structure>>,
    /// The message types that the text names.
    pub(super) uses: BTreeSet<TypeName>,
}

impl Definition {
    /// Parses a `.msg`, `.srv` or `.action` file, depending on the name.
    pub fn parse(name: TypeName, text: &str) -> Result<Self, ParseError> {
        let structures = parse::file(&name, text)?;
        Ok(Self::new(name, text.into(), structures))
    }

    /// Parses an `.idl` file of the name's kind.
    pub fn parse_idl(name: TypeName, text: &str) -> Result<Self, ParseError> {
        idl::definition(name, text)
    }

    pub(super) fn new(name: TypeName, text: Arc<str>, written: Vec<Structure>) -> Self {
        let uses = uses(&written);
        let implied = implicit_types(&name);
        let structures = written.into_iter().chain(implied).map(Arc::new).collect();
        Self {
            name,
            text,
            structures,
            uses,
        }
    }

    /// Returns the definition of one structure, without the types that its name implies.
    pub(super) fn of_structure(text: Arc<str>, structure: Structure) -> Self {
        let name = structure.name.clone();
        let uses = uses(std::slice::from_ref(&structure));
        Self {
            name,
            text,
            structures: vec![Arc::new(structure)],
            uses,
        }
    }
}

/// Returns the message types that these structures name.
fn uses(written: &[Structure]) -> BTreeSet<TypeName> {
    let fields = written.iter().flat_map(|structure| &structure.fields);
    let nested = fields.filter_map(|field| match &field.element {
        Element::Nested(nested) if nested.kind() == Kind::Message => Some(nested.clone()),
        _ => None,
    });
    nested.collect()
}

/// A type and all types nested in it.
#[derive(Debug, PartialEq, Eq)]
pub struct MessageType {
    /// Name of the type itself.
    pub root: TypeName,
    pub(super) structures: BTreeMap<TypeName, Arc<Structure>>,
    /// The files that define it, by name.
    pub(super) definitions: BTreeMap<TypeName, Arc<Definition>>,
}

/// Why a type cannot be assembled.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum NotClosed {
    /// The type, or a nested one, has no definition.
    #[error("no definition of {0}")]
    Missing(TypeName),
    /// The type contains itself.
    #[error("{0} contains itself")]
    Recursive(TypeName),
    /// The types are nested too deeply.
    #[error("nested deeper than {MAX_DEPTH} types")]
    TooDeep,
    /// The type has too many nested types.
    #[error("made of more than {MAX_TYPES} types")]
    TooMany,
    /// The definitions are too long.
    #[error("defined by more than {MAX_TEXT} bytes of text")]
    TooLong,
}

impl MessageType {
    /// Parses the text of a bag's schema in encoding `ros2msg`: the type's own definition, then its
    /// nested types. Each nested type is below a line of 80 `=` and a line `MSG: package/Type`.
    pub fn parse(root: &TypeName, text: &str) -> Result<Self, SchemaError> {
        let mut definitions = HashMap::new();
        for (name, part) in crate::definition::schema::parts(root, text)? {
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

    /// Assembles a type from its files; calls `find` once or twice per file.
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

    /// Returns the depth of a type; fails if it contains itself. Recurses once per level, up to the
    /// limit.
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

    /// Returns the fields of the type itself or of a nested one; `None` for another type.
    pub fn structure(&self, name: &TypeName) -> Option<&Structure> {
        self.structures.get(name).map(Arc::as_ref)
    }

    /// Iterates over the type and all types nested in it, sorted by name.
    pub fn structures(&self) -> impl Iterator<Item = &Structure> {
        self.structures.values().map(Arc::as_ref)
    }
}

/// Why a schema's text is invalid.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum SchemaError {
    /// The line that begins a part does not have the form `MSG: package/Type`.
    #[error("line {line}: expected `MSG: package/Type` below the line of `=`")]
    Heading {
        /// Line number, counted from 1.
        line: usize,
    },
    /// A definition in the schema cannot be parsed.
    #[error("definition of {0}")]
    Definition(TypeName, #[source] ParseError),
    /// The definitions do not form one type.
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

    /// Returns a schema of `count` types, each with a field of the next one.
    fn chain(count: usize) -> String {
        let mut text = String::from("T1 next\n");
        for index in 1..count {
            let line = "=".repeat(80);
            text.push_str(&format!("{line}\nMSG: a/T{index}\nT{} next\n", index + 1));
        }
        text + &format!("{}\nMSG: a/T{count}\nint8 end\n", "=".repeat(80))
    }

    #[test]
    fn types_nested_deeper_than_the_limit_are_refused() {
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
    fn a_recursive_or_incomplete_definition_is_refused() {
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
    fn a_type_of_more_types_than_the_limit_is_refused() {
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
