//! Types as nodes describe them: the response of
//! `type_description_interfaces/srv/GetTypeDescription` (ROS 2 Iron and later, REP-2016).
//!
//! A response holds the fields of a type and of its nested types. With `include_type_sources` it
//! also holds their files. The files are used if they define the described type, because they have
//! comments and constants. Everything in a response is untrusted, and so is its sender: the hash of
//! the result shows whether it is the type that discovery announces.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::{Arc, LazyLock};

use crate::decode::{DecodeError, Limits, decode};
use crate::definition::parse::{MAX_FIELDS, shortened};
use crate::definition::schema::members;
use crate::definition::{
    Definition, Element, Field, MAX_TYPES, MessageType, NotClosed, Shape, Structure, TypeName,
};
use crate::dialect::Dialect;
use crate::hash::{ARRAY_OFFSET, BOUNDED_OFFSET, UNBOUNDED_OFFSET};
use crate::library::definition_source::DefinitionSource;
use crate::library::search::Search;
use crate::name::is_identifier;
use crate::value::{Array, Items, Message, Scalar, Value};

/// Maximum size of a response, in bytes. The largest types in use, with their files, have 100 kB.
pub const MAX_RESPONSE: usize = 256 << 10;
/// Maximum number of values in a response.
const MAX_VALUES: usize = 100_000;
const RESPONSE_TYPE_NAME: &str = "type_description_interfaces/srv/GetTypeDescription_Response";
/// Name of the member that rosidl adds to a type without fields.
const PLACEHOLDER_MEMBER: &str = "structure_needs_at_least_one_member";

/// Why a response does not describe a usable type.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum NotDescribed {
    /// The response is too long.
    #[error("longer than {MAX_RESPONSE} bytes")]
    TooLong,
    /// The bytes are not a response.
    #[error(transparent)]
    Malformed(#[from] DecodeError),
    /// The node does not know the requested type.
    #[error("the node does not know the type")]
    Unknown,
    /// A member is absent or has another type than in the service's definition.
    #[error("the response has no {0}")]
    Member(&'static str),
    /// The name of a type or field is invalid.
    #[error("`{0}` is not a valid name")]
    Name(String),
    /// A field is described twice.
    #[error("`{0}` is described twice")]
    Twice(String),
    /// The kind of a field has no definition in a `.msg` file.
    #[error("field type {0} is not supported")]
    FieldType(u64),
    /// The capacity of a string or an array is invalid.
    #[error("{0} is not a capacity from 1 to 4294967295")]
    Capacity(u64),
    /// A type has too many fields.
    #[error("more than {MAX_FIELDS} fields")]
    TooManyFields,
    /// The descriptions do not form one type.
    #[error(transparent)]
    NotClosed(#[from] NotClosed),
}

/// The type of a response, from the embedded definitions.
static RESPONSE_TYPE: LazyLock<Option<MessageType>> = LazyLock::new(|| {
    let sources = [DefinitionSource::Embedded(Dialect::default())];
    Search::new(&sources, &RESPONSE_TYPE_NAME.parse().ok()?)
        .run(None)
        .ok()
});

/// Returns the type that a response describes. The payload begins with its encapsulation header.
///
/// # Errors
/// Fails if the payload is not a successful response, or if the type cannot be used.
pub fn described_type(payload: &[u8]) -> Result<MessageType, NotDescribed> {
    if payload.len() > MAX_RESPONSE {
        return Err(NotDescribed::TooLong);
    }
    let response_type = RESPONSE_TYPE
        .as_ref()
        .ok_or(NotDescribed::Member("definition"))?;
    let limits = Limits {
        values: MAX_VALUES,
        ..Limits::default()
    };
    let response = decode(response_type, payload, &limits)?.message;
    if !matches!(
        response.get("successful"),
        Some(Value::Scalar(Scalar::Bool(true)))
    ) {
        return Err(NotDescribed::Unknown);
    }
    let description = message(&response, "type_description")?;
    let root = structure(message(description, "type_description")?)?;
    let root_name = root.name.clone();
    let mut described = BTreeMap::from([(root_name.clone(), root)]);
    for nested in messages(description, "referenced_type_descriptions")? {
        if described.len() == MAX_TYPES {
            return Err(NotClosed::TooMany.into());
        }
        let nested = structure(nested)?;
        described.entry(nested.name.clone()).or_insert(nested);
    }
    let described = MessageType::assemble(&root_name, |name| {
        let structure = described.get(name).cloned();
        Ok::<_, NotDescribed>(structure.map(definition).map(Arc::new))
    })?;
    let files = sources(&response)?;
    let written = MessageType::assemble(&root_name, |name| {
        Ok::<_, NotClosed>(files.get(name).cloned())
    });
    Ok(match written {
        Ok(written) if written.type_hash() == described.type_hash() => written,
        _ => described,
    })
}

/// Returns the files in a response by the types after which they are named. Files that cannot be
/// parsed are left out, because the description suffices without them.
fn sources(response: &Message<'_>) -> Result<BTreeMap<TypeName, Arc<Definition>>, NotDescribed> {
    let mut files = BTreeMap::new();
    for source in messages(response, "type_sources")?.iter().take(MAX_TYPES) {
        let text = text(source, "raw_file_contents")?;
        let Ok(name) = self::text(source, "type_name")?.parse::<TypeName>() else {
            continue;
        };
        // `implicit` has no text: the type is implied by the file of a service or an action.
        let definition = match self::text(source, "encoding")? {
            "msg" | "srv" | "action" => Definition::parse(name, text),
            "idl" => Definition::parse_idl(name, text),
            _ => continue,
        };
        if let Ok(definition) = definition {
            files.insert(definition.name.clone(), Arc::new(definition));
        }
    }
    Ok(files)
}

/// Returns the definition of one described type, with the text of an equivalent `.msg` file.
pub(crate) fn definition(structure: Structure) -> Definition {
    let text = members(&structure);
    Definition::of_structure(text.into(), structure)
}

/// Reads an `IndividualTypeDescription`.
fn structure(description: &Message<'_>) -> Result<Structure, NotDescribed> {
    let name = type_name(text(description, "type_name")?)?;
    let described = messages(description, "fields")?;
    if described.len() > MAX_FIELDS {
        return Err(NotDescribed::TooManyFields);
    }
    let mut names = BTreeSet::new();
    let mut fields = Vec::with_capacity(described.len());
    for one in described {
        let field = field(one)?;
        if !names.insert(field.name.clone()) {
            return Err(NotDescribed::Twice(field.name));
        }
        fields.push(field);
    }
    Ok(structure_of(name, fields))
}

/// Returns the structure with these fields, of which the placeholder of rosidl is none.
pub(crate) fn structure_of(name: TypeName, mut fields: Vec<Field>) -> Structure {
    if let [only] = &*fields
        && (&*only.name, &only.element, only.shape)
            == (PLACEHOLDER_MEMBER, &Element::UInt8, Shape::Single)
    {
        fields.clear();
    }
    Structure { name, fields }
}

/// Reads a `Field`. Its default value is neither on the wire nor part of the hash.
fn field(description: &Message<'_>) -> Result<Field, NotDescribed> {
    let name = text(description, "name")?;
    if !is_identifier(name) {
        return Err(NotDescribed::Name(shortened(name)));
    }
    let described = message(description, "type")?;
    let id = number(described, "type_id")?;
    let size = || capacity(number(described, "capacity")?);
    let (base, shape) = match id {
        _ if id > UNBOUNDED_OFFSET.into() => (id - u64::from(UNBOUNDED_OFFSET), Shape::Unbounded),
        _ if id > BOUNDED_OFFSET.into() => {
            (id - u64::from(BOUNDED_OFFSET), Shape::Bounded(size()?))
        }
        _ if id > ARRAY_OFFSET.into() => (id - u64::from(ARRAY_OFFSET), Shape::Array(size()?)),
        _ => (id, Shape::Single),
    };
    let bound = || capacity(number(described, "string_capacity")?).map(Some);
    let element = match base {
        1 => Element::Nested(type_name(text(described, "nested_type_name")?)?),
        2 => Element::Int8,
        3 => Element::UInt8,
        4 => Element::Int16,
        5 => Element::UInt16,
        6 => Element::Int32,
        7 => Element::UInt32,
        8 => Element::Int64,
        9 => Element::UInt64,
        10 => Element::Float32,
        11 => Element::Float64,
        15 => Element::Bool,
        16 => Element::Byte,
        17 => Element::String { bound: None },
        18 => Element::WString { bound: None },
        21 => Element::String { bound: bound()? },
        22 => Element::WString { bound: bound()? },
        // `long double`, characters and strings of fixed length exist in IDL only.
        _ => return Err(NotDescribed::FieldType(id)),
    };
    Ok(Field {
        name: name.to_owned(),
        element,
        shape,
    })
}

fn capacity(number: u64) -> Result<u32, NotDescribed> {
    let size = u32::try_from(number).ok().filter(|size| *size > 0);
    size.ok_or(NotDescribed::Capacity(number))
}

fn type_name(text: &str) -> Result<TypeName, NotDescribed> {
    let name = text.parse();
    name.map_err(|_| NotDescribed::Name(shortened(text)))
}

fn text<'a>(of: &'a Message<'_>, member: &'static str) -> Result<&'a str, NotDescribed> {
    match of.get(member) {
        Some(Value::Text(text)) => Ok(text),
        _ => Err(NotDescribed::Member(member)),
    }
}

fn number(of: &Message<'_>, member: &'static str) -> Result<u64, NotDescribed> {
    match of.get(member) {
        Some(Value::Scalar(Scalar::UInt(number))) => Ok(*number),
        _ => Err(NotDescribed::Member(member)),
    }
}

fn message<'a, 'b>(
    of: &'a Message<'b>,
    member: &'static str,
) -> Result<&'a Message<'b>, NotDescribed> {
    match of.get(member) {
        Some(Value::Message(message)) => Ok(message),
        _ => Err(NotDescribed::Member(member)),
    }
}

fn messages<'a, 'b>(
    of: &'a Message<'b>,
    member: &'static str,
) -> Result<&'a [Message<'b>], NotDescribed> {
    match of.get(member) {
        Some(Value::Array(Array {
            items: Items::Messages(messages),
            ..
        })) => Ok(messages),
        _ => Err(NotDescribed::Member(member)),
    }
}

#[cfg(test)]
mod tests;
