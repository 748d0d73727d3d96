//! Types as participants exchange them: TypeObjects, and the replies of the TypeLookup service that
//! contain them (DDS-XTypes 1.3, 7.3.4 and 7.6.3.3).
//!
//! A TypeObject describes one type. It refers to others by their hash: the first 14 bytes of the
//! MD5 of their own TypeObject. A sender therefore cannot forge an object. Everything else in a
//! reply is untrusted. Types that a `.msg` file cannot define are refused by name.

mod assembly;
mod padding;

use std::borrow::Cow;

use md5::{Digest as _, Md5};
use ros2probe_wire::cursor::{Cursor, Endianness, WireError};
use ros2probe_wire::discovery::EquivalenceHash;
use ros2probe_wire::names::DdsType;
use ros2probe_wire::xcdr2::{Members, delimited, string};

use crate::definition::parse::{MAX_FIELDS, shortened};
use crate::definition::{Element, MAX_TYPES, NotClosed, Shape, TypeName};
use crate::name::is_identifier;

pub(crate) use assembly::message_type;

/// Maximum size of a reply, in bytes.
pub const MAX_REPLY: usize = 256 << 10;
/// Maximum depth of collections in one field.
const MAX_COLLECTIONS: usize = 8;
/// Maximum number of dimensions of an array.
const MAX_DIMENSIONS: u32 = 8;
/// Maximum length of a name, in bytes.
const MAX_NAME: usize = 256;
/// Length of the request's identity in a reply, in bytes.
const REQUEST_IDENTITY: usize = 24;
/// Length of an `EquivalenceHash`, in bytes.
const EQUIVALENCE_HASH: usize = size_of::<EquivalenceHash>();
/// Discriminator of a TypeIdentifier or TypeObject of a minimal and of a complete type.
const EK_MINIMAL: u8 = 0xf1;
const EK_COMPLETE: u8 = 0xf2;
/// `TypeLookup_getTypes_HashId`, and the identifier of the member `types`: from the MD5 of the
/// names.
const GET_TYPES: u32 = 0x0182_52d3;
const TYPES: u32 = 0x0280_4ad1;
/// Bits of a structure's flags.
const IS_APPENDABLE: u16 = 1 << 1;
const IS_MUTABLE: u16 = 1 << 2;
/// Bit of a member's flags.
const IS_OPTIONAL: u16 = 1 << 3;

/// Why the bytes are not a usable reply or TypeObject.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum NotUsable {
    /// The reply is too long.
    #[error("longer than {MAX_REPLY} bytes")]
    TooLong,
    /// The bytes have another form.
    #[error(transparent)]
    Malformed(#[from] WireError),
    /// The encoding is not XCDR2 in little-endian order, the order in which hashes are computed.
    #[error("encapsulation {0:#06x} is not XCDR2 in little-endian order")]
    Encapsulation(u16),
    /// The object is not the one that its hash names.
    #[error("the object does not have the hash {0}")]
    Forged(EquivalenceHash),
    /// A `.msg` file cannot define the type.
    #[error("{0} is not supported")]
    Kind(&'static str),
    /// The name of a type is not a ROS type's.
    #[error("`{0}` is not the name of a ROS type")]
    TypeName(String),
    /// The name of a field is invalid.
    #[error("`{0}` is not a valid name of a field")]
    FieldName(String),
    /// A field occurs twice.
    #[error("`{0}` occurs twice")]
    Twice(String),
    /// A capacity is zero or too large.
    #[error("{0} is not a capacity from 1 to 4294967295")]
    Capacity(u64),
    /// A type has too many fields.
    #[error("more than {MAX_FIELDS} fields")]
    TooManyFields,
    /// Two nested types have one name.
    #[error("two different types have the name {0}")]
    Ambiguous(TypeName),
    /// The type with this hash was not in any reply.
    #[error("no reply with the type {0} was seen")]
    Missing(EquivalenceHash),
    /// The types do not form one type.
    #[error(transparent)]
    NotClosed(#[from] NotClosed),
}

/// One type.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) enum TypeObject {
    Structure(StructureObject),
    /// Another name of a type.
    Alias(Reference),
    /// An enumeration, as the number that represents it.
    Enumeration(Element),
}

#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct StructureObject {
    /// ROS name.
    pub(crate) name: TypeName,
    /// The structure whose fields precede the members.
    base: Option<EquivalenceHash>,
    members: Vec<(String, Reference)>,
    is_appendable: bool,
}

/// The type of a member or of an alias.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct Reference {
    target: Target,
    shape: Shape,
}

#[derive(Debug, Clone, PartialEq, Eq)]
enum Target {
    Element(Element),
    Type(EquivalenceHash),
}

/// Returns the part of a reply that does not name its request: replies to several participants
/// differ in the rest alone.
pub(crate) fn without_request(payload: &[u8]) -> &[u8] {
    let header = match payload.get(1) {
        Some(9) => 8,
        _ => 4,
    };
    payload.get(header + REQUEST_IDENTITY..).unwrap_or(payload)
}

/// The bytes of a complete type, and their hash.
pub(crate) type HashedObject<'a> = (EquivalenceHash, Cow<'a, [u8]>);

/// Returns the hashes and the bytes of the complete types in a reply. The payload begins with its
/// encapsulation header. A reply to another request, or with a failure, has none.
///
/// Objects that do not have their hash are left out. Their padding does not count: Fast DDS 3
/// leaves it undefined, and the returned bytes have zeros instead.
///
/// # Errors
/// Fails if the payload is not a reply, or if no object has its hash.
pub(crate) fn objects(payload: &[u8]) -> Result<Vec<HashedObject<'_>>, NotUsable> {
    if payload.len() > MAX_REPLY {
        return Err(NotUsable::TooLong);
    }
    let mut cursor = Cursor::new(payload, Endianness::Big);
    // The reply is final for Cyclone DDS, and appendable in the IDL of Fast DDS.
    let is_delimited = match cursor.u16("encapsulation")? {
        0x0007 => false,
        0x0009 => true,
        other => return Err(NotUsable::Encapsulation(other)),
    };
    cursor.u16("encapsulation options")?;
    let mut cursor = cursor.with_endianness(Endianness::Little);
    if is_delimited {
        cursor = delimited(&mut cursor, "TypeLookup_Reply")?;
    }
    cursor.take("related_request_id", REQUEST_IDENTITY)?;
    if cursor.u32("remote_ex")? != 0 {
        return Ok(Vec::new());
    }
    let mut returned = delimited(&mut cursor, "TypeLookup_Return")?;
    if returned.u32("TypeLookup_Return")? != GET_TYPES {
        return Ok(Vec::new());
    }
    let mut result = delimited(&mut returned, "TypeLookup_getTypes_Result")?;
    if result.u32("return code")? != 0 {
        return Ok(Vec::new());
    }
    let members = Members::read(&mut result, "TypeLookup_getTypes_Out")?;
    let Some(mut types) = members.find(TYPES)? else {
        return Ok(Vec::new());
    };
    let mut pairs = delimited(&mut types, "types")?;
    let count = pairs.u32("number of types")?;
    let (mut found, mut forged) = (Vec::new(), None);
    for _ in 0..count {
        if found.len() == MAX_TYPES {
            return Err(NotClosed::TooMany.into());
        }
        let kind = pairs.u8("type_identifier")?;
        if kind != EK_MINIMAL && kind != EK_COMPLETE {
            return Err(NotUsable::Kind("a type identifier without a hash"));
        }
        let hash = EquivalenceHash(pairs.array("equivalence_hash")?);
        pairs.align(4);
        let bytes = pairs.rest();
        let object = delimited(&mut pairs, "type_object")?;
        let bytes = bytes.get(..4 + object.remaining()).unwrap_or_default();
        if kind == EK_COMPLETE {
            match with_hash(bytes, hash) {
                Some(object) => found.push((hash, object)),
                None => forged = Some(hash),
            }
        }
    }
    match forged {
        Some(hash) if found.is_empty() => Err(NotUsable::Forged(hash)),
        _ => Ok(found),
    }
}

/// Returns the object if it has the hash with zeros as padding; `None` if it is another object.
fn with_hash(bytes: &[u8], hash: EquivalenceHash) -> Option<Cow<'_, [u8]>> {
    let has_hash = |bytes: &[u8]| Md5::digest(bytes).starts_with(&hash.0);
    if has_hash(bytes) {
        return Some(Cow::Borrowed(bytes));
    }
    let zeroed = padding::zeroed(bytes)?;
    has_hash(&zeroed).then_some(Cow::Owned(zeroed))
}

impl TypeObject {
    /// Parses a complete TypeObject, from its size on.
    ///
    /// # Errors
    /// Fails if the bytes are not a TypeObject, or if a `.msg` file cannot define the type.
    pub(crate) fn parse(bytes: &[u8]) -> Result<Self, NotUsable> {
        let mut cursor = Cursor::new(bytes, Endianness::Little);
        let mut object = delimited(&mut cursor, "TypeObject")?;
        if object.u8("TypeObject")? != EK_COMPLETE {
            return Err(NotUsable::Kind("a minimal type"));
        }
        match object.u8("CompleteTypeObject")? {
            0x30 => alias(&mut object),
            0x40 => enumeration(&mut object),
            0x51 => structure(&mut object).map(Self::Structure),
            0x41 => Err(NotUsable::Kind("a bitmask")),
            0x50 => Err(NotUsable::Kind("an annotation")),
            0x52 => Err(NotUsable::Kind("a union")),
            0x53 => Err(NotUsable::Kind("a bitset")),
            0x60 | 0x61 => Err(NotUsable::Kind("a collection with annotations")),
            0x62 => Err(NotUsable::Kind("a map")),
            _ => Err(NotUsable::Kind("an unknown kind of type")),
        }
    }

    /// Returns the ROS name of a structure.
    pub(crate) const fn name(&self) -> Option<&TypeName> {
        match self {
            Self::Structure(structure) => Some(&structure.name),
            Self::Alias(_) | Self::Enumeration(_) => None,
        }
    }

    /// Returns the approximate memory, in bytes.
    pub(crate) fn size(&self) -> usize {
        let members = match self {
            Self::Structure(structure) => structure.members.as_slice(),
            Self::Alias(_) | Self::Enumeration(_) => &[],
        };
        let sizes = members
            .iter()
            .map(|(name, _)| size_of::<(String, Reference)>() + name.len());
        size_of::<Self>() + MAX_NAME + sizes.sum::<usize>()
    }
}

/// Reads a CompleteStructType (7.3.4.6).
fn structure(object: &mut Cursor<'_>) -> Result<StructureObject, NotUsable> {
    let flags = flags(object, "struct_flags")?;
    if flags & IS_MUTABLE != 0 {
        return Err(NotUsable::Kind("a mutable structure"));
    }
    let mut header = delimited(object, "CompleteStructHeader")?;
    let base = match header.rest().first() {
        Some(0) => {
            header.u8("base_type")?;
            None
        }
        _ => match identifier(&mut header, 0)? {
            Reference {
                target: Target::Type(hash),
                shape: Shape::Single,
            } => Some(hash),
            _ => return Err(NotUsable::Kind("a base type without fields")),
        },
    };
    let text = type_name(&mut header)?;
    let name = DdsType::parse(text)
        .ok()
        .and_then(|name| name.message().as_str().parse().ok());
    let name = name.ok_or_else(|| NotUsable::TypeName(shortened(text)))?;
    let mut all = delimited(object, "member_seq")?;
    let count = all.u32("number of members")?;
    let mut members = Vec::new();
    for _ in 0..count {
        if members.len() == MAX_FIELDS {
            return Err(NotUsable::TooManyFields);
        }
        let mut member = delimited(&mut all, "CompleteStructMember")?;
        member.u32("member_id")?;
        if self::flags(&mut member, "member_flags")? & IS_OPTIONAL != 0 {
            return Err(NotUsable::Kind("an optional member"));
        }
        let reference = identifier(&mut member, 0)?;
        let name = string(&mut member, "member name", MAX_NAME)?;
        if !is_identifier(name) {
            return Err(NotUsable::FieldName(shortened(name)));
        }
        members.push((name.to_owned(), reference));
    }
    // `rosidl` generates IDL for some middlewares whose members end with an underscore, which names
    // of ROS never do.
    if members.iter().all(|(name, _)| name.ends_with('_')) {
        for (name, _) in &mut members {
            name.pop();
        }
    }
    Ok(StructureObject {
        name,
        base,
        members,
        is_appendable: flags & IS_APPENDABLE != 0,
    })
}

/// Reads a CompleteAliasType (7.3.4.6).
fn alias(object: &mut Cursor<'_>) -> Result<TypeObject, NotUsable> {
    flags(object, "alias_flags")?;
    delimited(object, "CompleteAliasHeader")?;
    let mut body = delimited(object, "CompleteAliasBody")?;
    flags(&mut body, "related_flags")?;
    identifier(&mut body, 0).map(TypeObject::Alias)
}

/// Reads the size of a CompleteEnumeratedType (7.3.4.6).
fn enumeration(object: &mut Cursor<'_>) -> Result<TypeObject, NotUsable> {
    flags(object, "enum_flags")?;
    let mut header = delimited(object, "CompleteEnumeratedHeader")?;
    header.align(2);
    let element = match header.u16("bit_bound")? {
        1..=8 => Element::Int8,
        9..=16 => Element::Int16,
        17..=32 => Element::Int32,
        _ => return Err(NotUsable::Kind("an enumeration of more than 32 bits")),
    };
    Ok(TypeObject::Enumeration(element))
}

/// Reads the name in a CompleteTypeDetail, after its annotations.
fn type_name<'a>(header: &mut Cursor<'a>) -> Result<&'a str, NotUsable> {
    for what in ["ann_builtin", "ann_custom"] {
        if header.u8(what)? != 0 {
            delimited(header, what)?;
        }
    }
    Ok(string(header, "type_name", MAX_NAME)?)
}

fn flags(cursor: &mut Cursor<'_>, what: &'static str) -> Result<u16, WireError> {
    cursor.align(2);
    cursor.u16(what)
}

/// Reads a TypeIdentifier (7.3.4.2), which nests to the depth of its collections.
fn identifier(cursor: &mut Cursor<'_>, depth: usize) -> Result<Reference, NotUsable> {
    let element = |element| Target::Element(element);
    let kind = cursor.u8("TypeIdentifier")?;
    let target = match kind {
        0x01 => element(Element::Bool),
        0x02 => element(Element::Byte),
        0x03 => element(Element::Int16),
        0x04 => element(Element::Int32),
        0x05 => element(Element::Int64),
        0x06 => element(Element::UInt16),
        0x07 => element(Element::UInt32),
        0x08 => element(Element::UInt64),
        0x09 => element(Element::Float32),
        0x0a => element(Element::Float64),
        0x0c => element(Element::Int8),
        0x0d => element(Element::UInt8),
        0x10 => element(Element::Char),
        0x70 | 0x71 => {
            let bound = bound(cursor, kind == 0x71)?;
            element(Element::String { bound })
        }
        0x72 | 0x73 => {
            let bound = bound(cursor, kind == 0x73)?;
            element(Element::WString { bound })
        }
        0x80 | 0x81 | 0x90 | 0x91 => {
            if depth == MAX_COLLECTIONS {
                return Err(NotClosed::TooDeep.into());
            }
            cursor.u8("equiv_kind")?;
            flags(cursor, "element_flags")?;
            let is_large = kind & 1 != 0;
            let shape = match kind & 0xf0 {
                0x80 => bound(cursor, is_large)?.map_or(Shape::Unbounded, Shape::Bounded),
                _ => Shape::Array(dimensions(cursor, is_large)?),
            };
            return identifier(cursor, depth + 1)?.in_collection(shape);
        }
        EK_COMPLETE => Target::Type(EquivalenceHash(cursor.array("equivalence_hash")?)),
        EK_MINIMAL => return Err(NotUsable::Kind("a minimal type")),
        0x0b => return Err(NotUsable::Kind("long double")),
        0x11 => return Err(NotUsable::Kind("wchar")),
        0xa0 | 0xa1 => return Err(NotUsable::Kind("a map")),
        0xb0 => return Err(NotUsable::Kind("a recursive type")),
        _ => return Err(NotUsable::Kind("an unknown kind of type")),
    };
    let shape = Shape::Single;
    Ok(Reference { target, shape })
}

/// Reads the bound of a string or sequence; `None` means unbounded.
fn bound(cursor: &mut Cursor<'_>, is_large: bool) -> Result<Option<u32>, WireError> {
    let bound = if is_large {
        cursor.align(4);
        cursor.u32("bound")?
    } else {
        cursor.u8("bound")?.into()
    };
    Ok((bound > 0).then_some(bound))
}

/// Reads the dimensions of an array, and returns the number of its elements.
fn dimensions(cursor: &mut Cursor<'_>, is_large: bool) -> Result<u32, NotUsable> {
    cursor.align(4);
    let count = cursor.u32("number of dimensions")?;
    if count == 0 || count > MAX_DIMENSIONS {
        return Err(NotUsable::Capacity(count.into()));
    }
    let mut elements = 1;
    for _ in 0..count {
        let bound = bound(cursor, is_large)?.unwrap_or_default();
        elements = product(elements, bound)?;
    }
    Ok(elements)
}

fn product(one: u32, other: u32) -> Result<u32, NotUsable> {
    let product = u64::from(one) * u64::from(other);
    let elements = u32::try_from(product).ok().filter(|number| *number > 0);
    elements.ok_or(NotUsable::Capacity(product))
}

impl Reference {
    /// Returns a collection of this. Arrays of arrays are one array on the wire.
    fn in_collection(self, shape: Shape) -> Result<Self, NotUsable> {
        let shape = match (shape, self.shape) {
            (shape, Shape::Single) | (Shape::Single, shape) => shape,
            (Shape::Array(outer), Shape::Array(inner)) => Shape::Array(product(outer, inner)?),
            _ => return Err(NotUsable::Kind("a sequence in a collection")),
        };
        Ok(Self { shape, ..self })
    }
}

#[cfg(test)]
mod tests;
