//! Decodes a payload by its type: CDR as ROS 2 and other DDS applications write it.
//!
//! The payload is untrusted: a length is compared with the remaining bytes before it is used, and
//! the result is bounded by [`Limits`]. Supports XCDR1 and XCDR2 (plain and delimited) in both byte
//! orders; parameter lists are rejected by name.
//!
//! Strings that are not UTF-8 and invalid booleans are shown as `ros2 topic echo` shows them, and
//! counted ([`Oddities`]). A missing NUL at a string's end is accepted.

use std::borrow::Cow;

use ros2probe_wire::cursor::{Cursor, Endianness, Reason, WireError};

use crate::definition::{Element, Field, MessageType, Shape, Structure, TypeName};
use crate::value::{Array, Items, Message, Scalar, ScalarKind, Scalars, Value};

/// Size of the encapsulation header. XCDR aligns relative to the first byte after it.
const ENCAPSULATION_BYTES: usize = 4;
/// Maximum number of padding bytes after the last field: RTPS aligns submessages to four bytes.
const MAX_PADDING: usize = 3;

/// Limits of one decoded message.
#[derive(Debug, Clone, Copy)]
pub struct Limits {
    /// Maximum number of levels of nested messages.
    pub depth: usize,
    /// Maximum number of values that are kept. An array of numbers is one value.
    pub values: usize,
    /// Maximum number of elements that are kept per array of messages or strings. Further elements
    /// are only validated.
    pub kept: usize,
}

impl Default for Limits {
    fn default() -> Self {
        Self {
            depth: 64,
            values: 2_000_000,
            kept: usize::MAX,
        }
    }
}

/// A message and its oddities.
#[derive(Debug, Clone, PartialEq)]
pub struct Decoded<'a> {
    /// The message.
    pub message: Message<'a>,
    /// Possible signs of a wrong definition.
    pub oddities: Oddities,
}

/// Deviations that do not prevent a message from being shown.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Oddities {
    /// Number of bytes after the last field; 0 if they may be padding.
    pub trailing: usize,
    /// Number of strings that are not UTF-8 (UTF-16 for `wstring`).
    pub texts: usize,
    /// Number of booleans that are neither 0 nor 1. They count as true.
    pub booleans: usize,
}

impl Oddities {
    /// Returns whether any oddity occurred.
    pub fn any(&self) -> bool {
        *self != Self::default()
    }
}

/// Why a payload cannot be decoded as its type.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum DecodeError {
    /// The payload is shorter than the encapsulation header.
    #[error("the payload of {0} bytes has no encapsulation header")]
    NoEncapsulation(usize),
    /// The encoding is not supported.
    #[error("{name} (encapsulation {id:#06x}) is not supported")]
    Encapsulation {
        /// Encapsulation identifier in the header.
        id: u16,
        /// Name of the encoding in the specification.
        name: &'static str,
    },
    /// The bytes are not a message of this type.
    #[error("{0} (offset after the encapsulation header)")]
    Malformed(#[from] WireError),
    /// The message has more or deeper values than the limits allow.
    #[error("more than {0}")]
    Limit(&'static str),
}

/// Decodes a payload that begins with its encapsulation header.
///
/// # Errors
/// Fails if the payload cannot be of this type or exceeds the limits.
pub fn decode<'a>(
    message_type: &'a MessageType,
    payload: &'a [u8],
    limits: &Limits,
) -> Result<Decoded<'a>, DecodeError> {
    let (header, body) = payload
        .split_first_chunk::<ENCAPSULATION_BYTES>()
        .ok_or(DecodeError::NoEncapsulation(payload.len()))?;
    let encoding = Encoding::parse(u16::from_be_bytes([header[0], header[1]]))?;
    let mut reader = Reader {
        message_type,
        encoding,
        limits: *limits,
        values: 0,
        oddities: Oddities::default(),
    };
    let mut cursor = Cursor::new(body, encoding.endianness);
    let message = reader.message(&mut cursor, reader.structure(&message_type.root)?, 0)?;
    let trailing = cursor.remaining();
    if trailing > MAX_PADDING {
        reader.oddities.trailing = trailing;
    }
    Ok(Decoded {
        message,
        oddities: reader.oddities,
    })
}

/// Encoding of a payload (RTPS 2.5, 10.2; XTypes 1.3, 7.6.3.1.2).
#[derive(Debug, Clone, Copy)]
struct Encoding {
    endianness: Endianness,
    /// Alignment of 64-bit numbers.
    widest: usize,
    /// Whether collections of anything but numbers are preceded by their size in bytes.
    sized: bool,
    /// Whether structures are also preceded by their size in bytes.
    delimited: bool,
}

impl Encoding {
    fn parse(id: u16) -> Result<Self, DecodeError> {
        let endianness = if id & 1 == 0 {
            Endianness::Big
        } else {
            Endianness::Little
        };
        let refused = |name| Err(DecodeError::Encapsulation { id, name });
        match id {
            0x0000 | 0x0001 => Ok(Self {
                endianness,
                widest: 8,
                sized: false,
                delimited: false,
            }),
            0x0006 | 0x0007 => Ok(Self {
                endianness,
                widest: 4,
                sized: true,
                delimited: false,
            }),
            0x0008 | 0x0009 => Ok(Self {
                endianness,
                widest: 4,
                sized: true,
                delimited: true,
            }),
            0x0002 | 0x0003 => refused("a parameter list (PL_CDR)"),
            0x000a | 0x000b => refused("a parameter list (PL_CDR2)"),
            0x0004 => refused("XML"),
            _ => refused("an unknown encoding"),
        }
    }
}

struct Reader<'a> {
    message_type: &'a MessageType,
    encoding: Encoding,
    limits: Limits,
    values: usize,
    oddities: Oddities,
}

impl<'a> Reader<'a> {
    fn structure(&self, name: &TypeName) -> Result<&'a Structure, DecodeError> {
        self.message_type
            .structure(name)
            .ok_or(DecodeError::Limit("the definition describes"))
    }

    fn count(&mut self, values: usize) -> Result<(), DecodeError> {
        self.values = self.values.saturating_add(values);
        if self.values > self.limits.values {
            return Err(DecodeError::Limit("the allowed number of values"));
        }
        Ok(())
    }

    /// Reads the size before a structure or collection, if the encoding has one, and returns the
    /// bytes of its content.
    fn delimited(
        &self,
        there: bool,
        cursor: &mut Cursor<'a>,
        what: &'static str,
    ) -> Result<Option<Cursor<'a>>, DecodeError> {
        if !there {
            return Ok(None);
        }
        cursor.align(4);
        let size = length(cursor, what)?;
        Ok(Some(cursor.sub(what, size)?))
    }

    fn message(
        &mut self,
        cursor: &mut Cursor<'a>,
        structure: &'a Structure,
        depth: usize,
    ) -> Result<Message<'a>, DecodeError> {
        if depth >= self.limits.depth {
            return Err(DecodeError::Limit("the allowed levels of nested messages"));
        }
        let mut inner = self.delimited(self.encoding.delimited, cursor, "size of a structure")?;
        let cursor = inner.as_mut().unwrap_or(cursor);
        if structure.fields.is_empty() {
            cursor.u8("structure_needs_at_least_one_member")?;
        }
        self.count(structure.fields.len())?;
        let mut values = Vec::with_capacity(structure.fields.len());
        for field in &structure.fields {
            values.push(self.field(cursor, field, depth)?);
        }
        Ok(Message { structure, values })
    }

    fn field(
        &mut self,
        cursor: &mut Cursor<'a>,
        field: &'a Field,
        depth: usize,
    ) -> Result<Value<'a>, DecodeError> {
        if field.shape != Shape::Single {
            return self.array(cursor, field, depth).map(Value::Array);
        }
        if let Some(kind) = ScalarKind::of(&field.element) {
            return Ok(Value::Scalar(self.scalar(cursor, kind)?));
        }
        match &field.element {
            Element::Nested(name) => {
                let structure = self.structure(name)?;
                self.message(cursor, structure, depth + 1)
                    .map(Value::Message)
            }
            element => self.text(cursor, element).map(Value::Text),
        }
    }

    fn scalar(&mut self, cursor: &mut Cursor<'a>, kind: ScalarKind) -> Result<Scalar, DecodeError> {
        let scalars = self.scalars(cursor, kind, 1)?;
        scalars
            .get(0)
            .ok_or(cursor.error("number", Reason::Truncated).into())
    }

    fn scalars(
        &mut self,
        cursor: &mut Cursor<'a>,
        kind: ScalarKind,
        length: usize,
    ) -> Result<Scalars<'a>, DecodeError> {
        if length > 0 {
            cursor.align(kind.size().min(self.encoding.widest));
        }
        let size = length.checked_mul(kind.size());
        let size = size.ok_or(cursor.error("numbers", Reason::BadLength))?;
        let bytes = cursor.take("numbers", size)?;
        if kind == ScalarKind::Bool {
            self.oddities.booleans += bytes.iter().filter(|byte| **byte > 1).count();
        }
        Ok(Scalars::new(kind, self.encoding.endianness, bytes))
    }

    fn array(
        &mut self,
        cursor: &mut Cursor<'a>,
        field: &'a Field,
        depth: usize,
    ) -> Result<Array<'a>, DecodeError> {
        let kind = ScalarKind::of(&field.element);
        let sized = self.encoding.sized && kind.is_none();
        let mut inner = self.delimited(sized, cursor, "size of a collection")?;
        let cursor = inner.as_mut().unwrap_or(cursor);
        let length = match field.shape {
            Shape::Single => 1,
            Shape::Array(length) => {
                usize::try_from(length).map_err(|_| cursor.error("array", Reason::OverLimit))?
            }
            Shape::Bounded(_) | Shape::Unbounded => {
                cursor.align(4);
                let length = length(cursor, "sequence length")?;
                within(cursor, length, field.shape)?;
                length
            }
        };
        let items = match (kind, &field.element) {
            (Some(kind), _) => Items::Scalars(self.scalars(cursor, kind, length)?),
            (None, Element::Nested(name)) => {
                let structure = self.structure(name)?;
                Items::Messages(self.messages(cursor, structure, length, depth)?)
            }
            (None, element) => Items::Texts(self.texts(cursor, element, length)?),
        };
        Ok(Array {
            field,
            length,
            items,
        })
    }

    fn messages(
        &mut self,
        cursor: &mut Cursor<'a>,
        structure: &'a Structure,
        length: usize,
        depth: usize,
    ) -> Result<Vec<Message<'a>>, DecodeError> {
        // A message takes at least one octet, or the four bytes of its size if the encoding writes
        // sizes.
        let least = if self.encoding.delimited { 4 } else { 1 };
        let kept = self.keep(cursor, length, least)?;
        let mut messages = Vec::with_capacity(kept);
        for _ in 0..kept {
            messages.push(self.message(cursor, structure, depth + 1)?);
        }
        for _ in kept..length {
            self.skip_message(cursor, structure, depth + 1)?;
        }
        Ok(messages)
    }

    fn texts(
        &mut self,
        cursor: &mut Cursor<'a>,
        element: &Element,
        length: usize,
    ) -> Result<Vec<Cow<'a, str>>, DecodeError> {
        let kept = self.keep(cursor, length, 4)?;
        let mut texts = Vec::with_capacity(kept);
        for _ in 0..kept {
            texts.push(self.text(cursor, element)?);
        }
        for _ in kept..length {
            self.text_bytes(cursor, element)?;
        }
        Ok(texts)
    }

    /// Returns how many of `length` elements are kept; fails if the remaining bytes cannot hold
    /// them.
    fn keep(
        &mut self,
        cursor: &Cursor<'a>,
        length: usize,
        least: usize,
    ) -> Result<usize, DecodeError> {
        if length
            .checked_mul(least)
            .is_none_or(|size| size > cursor.remaining())
        {
            return Err(cursor
                .error("elements of a sequence", Reason::BadLength)
                .into());
        }
        let kept = length.min(self.limits.kept);
        self.count(kept)?;
        Ok(kept)
    }

    /// Skips what [`Self::message`] would read, keeping nothing.
    fn skip_message(
        &mut self,
        cursor: &mut Cursor<'a>,
        structure: &'a Structure,
        depth: usize,
    ) -> Result<(), DecodeError> {
        if depth >= self.limits.depth {
            return Err(DecodeError::Limit("the allowed levels of nested messages"));
        }
        if self
            .delimited(self.encoding.delimited, cursor, "size of a structure")?
            .is_some()
        {
            return Ok(());
        }
        if structure.fields.is_empty() {
            cursor.u8("structure_needs_at_least_one_member")?;
        }
        for field in &structure.fields {
            match (&field.element, field.shape) {
                (Element::Nested(name), Shape::Single) => {
                    let structure = self.structure(name)?;
                    self.skip_message(cursor, structure, depth + 1)?;
                }
                (_, Shape::Single) => {
                    self.field(cursor, field, depth)?;
                }
                _ => {
                    let kept = std::mem::replace(&mut self.limits.kept, 0);
                    let skipped = self.array(cursor, field, depth);
                    self.limits.kept = kept;
                    skipped?;
                }
            }
        }
        Ok(())
    }

    fn text(
        &mut self,
        cursor: &mut Cursor<'a>,
        element: &Element,
    ) -> Result<Cow<'a, str>, DecodeError> {
        let bytes = self.text_bytes(cursor, element)?;
        let text = match bytes {
            Characters::Octets(bytes) => {
                let bytes = bytes.strip_suffix(&[0]).unwrap_or(bytes);
                String::from_utf8_lossy(bytes)
            }
            Characters::Wide(units) => Cow::Owned(wide(&units)),
        };
        let replaced = |text: &str| text.contains(char::REPLACEMENT_CHARACTER);
        if matches!(&text, Cow::Owned(text) if replaced(text)) {
            self.oddities.texts += 1;
        }
        Ok(text)
    }

    fn text_bytes(
        &self,
        cursor: &mut Cursor<'a>,
        element: &Element,
    ) -> Result<Characters<'a>, DecodeError> {
        cursor.align(4);
        let length = length(cursor, "string length")?;
        let (bound, characters, written) = match element {
            Element::WString { bound } if self.encoding.sized => {
                // XTypes counts the octets of UTF-16.
                let bytes = cursor.take("wide string", length)?;
                let units = Scalars::new(ScalarKind::UInt16, self.encoding.endianness, bytes);
                (*bound, Characters::Wide(units), length / 2)
            }
            Element::WString { bound } => {
                // Both RMWs write each UTF-16 code unit in four octets.
                let size = length.checked_mul(4);
                let size = size.ok_or(cursor.error("wide string", Reason::BadLength))?;
                let bytes = cursor.take("wide string", size)?;
                let units = Scalars::new(ScalarKind::UInt32, self.encoding.endianness, bytes);
                (*bound, Characters::Wide(units), length)
            }
            Element::String { bound } => {
                let bytes = cursor.take("string", length)?;
                let written = bytes.strip_suffix(&[0]).unwrap_or(bytes).len();
                (*bound, Characters::Octets(bytes), written)
            }
            _ => return Err(cursor.error("string", Reason::BadValue).into()),
        };
        if let Some(bound) = bound {
            within(cursor, written, Shape::Bounded(bound))?;
        }
        Ok(characters)
    }
}

enum Characters<'a> {
    Octets(&'a [u8]),
    /// UTF-16 code units, each in a number of two or four octets.
    Wide(Scalars<'a>),
}

/// Reads a length field, already aligned.
fn length(cursor: &mut Cursor<'_>, what: &'static str) -> Result<usize, DecodeError> {
    let length = cursor.u32(what)?;
    usize::try_from(length).map_err(|_| cursor.error(what, Reason::BadLength).into())
}

fn within(cursor: &Cursor<'_>, length: usize, shape: Shape) -> Result<(), DecodeError> {
    match shape {
        Shape::Bounded(bound) if u32::try_from(length).map_or(true, |length| length > bound) => {
            Err(cursor
                .error("length over its type's bound", Reason::OverLimit)
                .into())
        }
        _ => Ok(()),
    }
}

/// Returns UTF-16 text; an invalid code unit counts as a character of its own. As in rclpy, a byte
/// order mark at the beginning determines the byte order and is not part of the text.
fn wide(units: &Scalars<'_>) -> String {
    const BYTE_ORDER_MARK: u64 = 0xfeff;
    const SWAPPED_BYTE_ORDER_MARK: u64 = 0xfffe;
    let mut text = String::with_capacity(units.len());
    let mut pending = Vec::new();
    let flush = |pending: &mut Vec<u16>, text: &mut String| {
        let decoded = char::decode_utf16(pending.drain(..));
        text.extend(decoded.map(|unit| unit.unwrap_or(char::REPLACEMENT_CHARACTER)));
    };
    let units = units.iter().filter_map(|unit| match unit {
        Scalar::UInt(unit) => Some(unit),
        _ => None,
    });
    let mut is_swapped = false;
    for (place, unit) in units.enumerate() {
        if place == 0 && matches!(unit, BYTE_ORDER_MARK | SWAPPED_BYTE_ORDER_MARK) {
            is_swapped = unit == SWAPPED_BYTE_ORDER_MARK;
        } else if let Ok(unit) = u16::try_from(unit) {
            pending.push(if is_swapped { unit.swap_bytes() } else { unit });
        } else {
            flush(&mut pending, &mut text);
            let character = u32::try_from(unit).ok().and_then(char::from_u32);
            text.push(character.unwrap_or(char::REPLACEMENT_CHARACTER));
        }
    }
    flush(&mut pending, &mut text);
    text
}

#[cfg(test)]
mod tests;
