//! A decoded message: its fields in the order of its definition, numbers in their width.
//!
//! It borrows from the payload and from the type. Arrays of numbers stay in the payload's bytes, so
//! decoding a point cloud costs no more than its header; elements are converted on access.

use std::borrow::Cow;

use ros2probe_wire::cursor::Endianness;

use crate::definition::{Element, Field, Shape, Structure};

/// Value of a field.
#[derive(Debug, Clone, PartialEq)]
pub enum Value<'a> {
    /// A number, boolean or octet.
    Scalar(Scalar),
    /// A `string` or `wstring`.
    Text(Cow<'a, str>),
    /// Array of values.
    Array(Array<'a>),
    /// Nested message.
    Message(Message<'a>),
}

/// Values of a message.
#[derive(Debug, Clone, PartialEq)]
pub struct Message<'a> {
    /// Type of the message.
    pub structure: &'a Structure,
    /// One value per field of the type.
    pub values: Vec<Value<'a>>,
}

impl<'a> Message<'a> {
    /// Iterates over fields and their values, in the order of the definition.
    pub fn fields(&self) -> impl Iterator<Item = (&'a Field, &Value<'a>)> {
        self.structure.fields.iter().zip(&self.values)
    }

    /// Returns a field's value; `None` if the type has no such field.
    pub fn get(&self, name: &str) -> Option<&Value<'a>> {
        self.fields()
            .find(|(field, _)| field.name == name)
            .map(|(_, value)| value)
    }
}

/// The elements of an array or sequence.
#[derive(Debug, Clone, PartialEq)]
pub struct Array<'a> {
    /// The field with the array: its bounds and the element's type.
    pub field: &'a Field,
    /// Number of elements, including those that were not kept.
    pub length: usize,
    /// The kept elements, starting with the first.
    pub items: Items<'a>,
}

impl Array<'_> {
    /// Returns whether the array has a fixed length.
    pub fn is_fixed(&self) -> bool {
        matches!(self.field.shape, Shape::Array(_))
    }

    /// Returns an element, if it was kept.
    pub fn get(&self, index: usize) -> Option<Value<'_>> {
        match &self.items {
            Items::Scalars(scalars) => scalars.get(index).map(Value::Scalar),
            Items::Texts(texts) => texts
                .get(index)
                .map(|text| Value::Text(Cow::Borrowed(text))),
            Items::Messages(messages) => messages.get(index).cloned().map(Value::Message),
        }
    }
}

/// Elements of one type.
#[derive(Debug, Clone, PartialEq)]
pub enum Items<'a> {
    /// Numbers, booleans or octets.
    Scalars(Scalars<'a>),
    /// Strings.
    Texts(Vec<Cow<'a, str>>),
    /// Messages.
    Messages(Vec<Message<'a>>),
}

/// Numbers in wire format, one after the other.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Scalars<'a> {
    kind: ScalarKind,
    endianness: Endianness,
    bytes: &'a [u8],
}

impl<'a> Scalars<'a> {
    /// Wraps whole elements; remaining bytes at the end are ignored.
    pub fn new(kind: ScalarKind, endianness: Endianness, bytes: &'a [u8]) -> Self {
        Self {
            kind,
            endianness,
            bytes,
        }
    }

    /// Returns the kind of the elements.
    pub fn kind(&self) -> ScalarKind {
        self.kind
    }

    /// Returns the number of elements.
    pub fn len(&self) -> usize {
        self.bytes.len() / self.kind.size()
    }

    /// Returns whether it has no elements.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Returns one element; `None` beyond the last one.
    pub fn get(&self, index: usize) -> Option<Scalar> {
        let start = index.checked_mul(self.kind.size())?;
        Scalar::read(self.kind, self.endianness, self.bytes.get(start..)?)
    }

    /// Iterates over the elements in order.
    pub fn iter(&self) -> impl Iterator<Item = Scalar> + use<'a> {
        let Self {
            kind,
            endianness,
            bytes,
        } = *self;
        bytes
            .chunks_exact(kind.size())
            .filter_map(move |one| Scalar::read(kind, endianness, one))
    }
}

/// Kind of a scalar. `char` is an 8-bit number in ROS 2.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ScalarKind {
    /// `bool`.
    Bool,
    /// `byte`.
    Byte,
    /// `int8`.
    Int8,
    /// `uint8` and `char`.
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
}

impl ScalarKind {
    /// Returns the kind of an element; `None` for text and messages.
    pub fn of(element: &Element) -> Option<Self> {
        Some(match element {
            Element::Bool => Self::Bool,
            Element::Byte => Self::Byte,
            Element::Char | Element::UInt8 => Self::UInt8,
            Element::Int8 => Self::Int8,
            Element::Int16 => Self::Int16,
            Element::UInt16 => Self::UInt16,
            Element::Int32 => Self::Int32,
            Element::UInt32 => Self::UInt32,
            Element::Int64 => Self::Int64,
            Element::UInt64 => Self::UInt64,
            Element::Float32 => Self::Float32,
            Element::Float64 => Self::Float64,
            Element::String { .. } | Element::WString { .. } | Element::Nested(_) => return None,
        })
    }

    /// Returns the number of bytes on the wire.
    pub const fn size(self) -> usize {
        match self {
            Self::Bool | Self::Byte | Self::Int8 | Self::UInt8 => 1,
            Self::Int16 | Self::UInt16 => 2,
            Self::Int32 | Self::UInt32 | Self::Float32 => 4,
            Self::Int64 | Self::UInt64 | Self::Float64 => 8,
        }
    }
}

/// One scalar.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Scalar {
    /// `bool`.
    Bool(bool),
    /// `byte`, which Python prints as a string of one byte.
    Byte(u8),
    /// A signed number.
    Int(i64),
    /// An unsigned number.
    UInt(u64),
    /// `float32`.
    Float32(f32),
    /// `float64`.
    Float64(f64),
}

impl Scalar {
    /// Reads a scalar from the start of `bytes`; `None` if they are too short.
    pub fn read(kind: ScalarKind, endianness: Endianness, bytes: &[u8]) -> Option<Self> {
        let word = |size: usize| -> Option<u64> {
            let bytes = bytes.get(..size)?;
            let mut word = [0; 8];
            match endianness {
                Endianness::Little => word.get_mut(..size)?.copy_from_slice(bytes),
                Endianness::Big => {
                    for (to, from) in word.iter_mut().zip(bytes.iter().rev()) {
                        *to = *from;
                    }
                }
            }
            Some(u64::from_le_bytes(word))
        };
        let word = word(kind.size())?;
        let signed = |bits: u32| Self::Int((word << (64 - bits)).cast_signed() >> (64 - bits));
        Some(match kind {
            ScalarKind::Bool => Self::Bool(word != 0),
            ScalarKind::Byte => Self::Byte(word.to_le_bytes()[0]),
            ScalarKind::Int8 => signed(8),
            ScalarKind::Int16 => signed(16),
            ScalarKind::Int32 => signed(32),
            ScalarKind::Int64 => signed(64),
            ScalarKind::UInt8 | ScalarKind::UInt16 | ScalarKind::UInt32 | ScalarKind::UInt64 => {
                Self::UInt(word)
            }
            ScalarKind::Float32 => {
                let [a, b, c, d, ..] = word.to_le_bytes();
                Self::Float32(f32::from_le_bytes([a, b, c, d]))
            }
            ScalarKind::Float64 => Self::Float64(f64::from_bits(word)),
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn scalars_keep_sign_and_width_in_both_byte_orders() {
        let big = |kind, bytes: &[u8]| Scalar::read(kind, Endianness::Big, bytes);
        let little = |kind, bytes: &[u8]| Scalar::read(kind, Endianness::Little, bytes);
        assert_eq!(
            big(ScalarKind::Int16, &[0xff, 0xfe, 9]),
            Some(Scalar::Int(-2))
        );
        assert_eq!(
            little(ScalarKind::Int16, &[0xfe, 0xff]),
            Some(Scalar::Int(-2))
        );
        assert_eq!(little(ScalarKind::Int8, &[0x80]), Some(Scalar::Int(-128)));
        assert_eq!(
            big(ScalarKind::UInt32, &[0, 0, 1, 2]),
            Some(Scalar::UInt(258))
        );
        assert_eq!(
            little(ScalarKind::UInt64, &[0xff; 8]),
            Some(Scalar::UInt(u64::MAX))
        );
        assert_eq!(little(ScalarKind::Int64, &[0xff; 8]), Some(Scalar::Int(-1)));
        let half = 0.5_f32.to_be_bytes();
        assert_eq!(big(ScalarKind::Float32, &half), Some(Scalar::Float32(0.5)));
        assert_eq!(little(ScalarKind::Float64, &[0; 7]), None);
    }

    #[test]
    fn an_incomplete_element_at_the_end_is_ignored() {
        let scalars = Scalars::new(ScalarKind::UInt16, Endianness::Little, &[1, 0, 2, 0, 3]);
        assert_eq!(scalars.len(), 2);
        assert_eq!(
            scalars.iter().collect::<Vec<_>>(),
            [Scalar::UInt(1), Scalar::UInt(2)]
        );
        assert_eq!(scalars.get(2), None);
        assert_eq!(scalars.get(usize::MAX), None);
    }
}
