//! Parameters of nodes: `rcl_interfaces/msg/ParameterEvent`, as published on `/parameter_events`,
//! requests of `rcl_interfaces/srv/SetParameters`, and requests and replies of
//! `rcl_interfaces/srv/GetParameters`.
//!
//! The layouts are the same in all distributions since Foxy. A value contains a field of each of
//! its types; the number of its type says which one counts.

use core::fmt;

use crate::cursor::{Reason, WireError};
use crate::plain::{PlainCursor, Sequence};

/// Name of the type of events, as ROS writes it.
pub const EVENT: &str = "rcl_interfaces/msg/ParameterEvent";

/// One event: what changed in a node.
#[derive(Clone, Debug)]
pub struct ParameterEvent<'a> {
    /// Fully qualified name of the node.
    pub node: &'a [u8],
    /// The changes, in the order of the message.
    pub changes: ParameterChanges<'a>,
}

/// A parameter of an event.
#[derive(Clone, Copy, Debug)]
pub struct ParameterChange<'a> {
    /// What happened to it.
    pub kind: ChangeKind,
    /// The parameter.
    pub parameter: Parameter<'a>,
}

/// What happened to a parameter.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ChangeKind {
    /// It was declared.
    New,
    /// It has another value.
    Changed,
    /// It was removed.
    Deleted,
}

/// Name and value of a parameter.
#[derive(Clone, Copy, Debug)]
pub struct Parameter<'a> {
    /// Name, of unverified bytes.
    pub name: &'a [u8],
    /// Value.
    pub value: ParameterValue<'a>,
}

/// A value (`rcl_interfaces/msg/ParameterValue`). Its text is that of YAML.
#[derive(Clone, Copy, Debug)]
pub enum ParameterValue<'a> {
    /// None, or of an unknown type.
    NotSet,
    /// A boolean.
    Bool(bool),
    /// An integer.
    Integer(i64),
    /// A floating-point number.
    Double(f64),
    /// A text, of unverified bytes.
    String(&'a [u8]),
    /// An array.
    Array(ParameterArray<'a>),
}

/// An array of values of one type.
#[derive(Clone, Copy, Debug)]
pub struct ParameterArray<'a> {
    of: Element,
    count: u32,
    cursor: PlainCursor<'a>,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Element {
    Byte,
    Bool,
    Integer,
    Double,
    String,
}

/// Reads the parameters of a sequence. It ends at the first malformed one.
#[derive(Clone, Debug)]
pub struct Parameters<'a>(Sequence<'a>);

/// Reads the names of a request for values. It ends at the first malformed one.
#[derive(Clone, Debug)]
pub struct RequestedNames<'a>(Sequence<'a>);

/// Reads the values of a reply, in the order of the requested names. It ends at the first malformed
/// one.
#[derive(Clone, Debug)]
pub struct RepliedValues<'a>(Sequence<'a>);

/// Reads the changes of an event. It ends at the first malformed one.
#[derive(Clone, Debug)]
pub struct ParameterChanges<'a> {
    parameters: Parameters<'a>,
    kind: ChangeKind,
}

impl<'a> PlainCursor<'a> {
    /// Reads an array, and goes on after it.
    fn array(&mut self, of: Element, what: &'static str) -> Result<ParameterArray<'a>, WireError> {
        let count = self.count(what)?;
        let array = ParameterArray {
            of,
            count,
            cursor: *self,
        };
        let error = self.cursor.error(what, Reason::BadLength);
        let elements = usize::try_from(count).map_err(|_| error)?;
        match of {
            Element::Byte | Element::Bool => {
                self.cursor.take(what, elements)?;
            }
            Element::Integer | Element::Double if count > 0 => {
                self.cursor.align(self.wide);
                let bytes = elements.checked_mul(8).ok_or(error)?;
                self.cursor.take(what, bytes)?;
            }
            Element::Integer | Element::Double => {}
            Element::String => {
                for _ in 0..count {
                    self.text(what)?;
                }
            }
        }
        Ok(array)
    }

    fn parameter(&mut self) -> Result<Parameter<'a>, WireError> {
        let name = self.text("parameter.name")?;
        let value = self.value()?;
        Ok(Parameter { name, value })
    }

    fn value(&mut self) -> Result<ParameterValue<'a>, WireError> {
        let kind = self.cursor.u8("value.type")?;
        let boolean = self.cursor.u8("value.bool_value")? != 0;
        let integer = self.wide("value.integer_value")?.cast_signed();
        let double = self.double("value.double_value")?;
        let string = self.text("value.string_value")?;
        let bytes = self.array(Element::Byte, "value.byte_array_value")?;
        let booleans = self.array(Element::Bool, "value.bool_array_value")?;
        let integers = self.array(Element::Integer, "value.integer_array_value")?;
        let doubles = self.array(Element::Double, "value.double_array_value")?;
        let strings = self.array(Element::String, "value.string_array_value")?;
        Ok(match kind {
            1 => ParameterValue::Bool(boolean),
            2 => ParameterValue::Integer(integer),
            3 => ParameterValue::Double(double),
            4 => ParameterValue::String(string),
            5 => ParameterValue::Array(bytes),
            6 => ParameterValue::Array(booleans),
            7 => ParameterValue::Array(integers),
            8 => ParameterValue::Array(doubles),
            9 => ParameterValue::Array(strings),
            _ => ParameterValue::NotSet,
        })
    }
}

impl<'a> ParameterEvent<'a> {
    /// Reads a sample's payload, encapsulation header included.
    ///
    /// # Errors
    /// Returns [`Reason::BadMarker`] if the payload is not plain CDR.
    pub fn parse(payload: &'a [u8]) -> Result<Self, WireError> {
        let mut cursor = PlainCursor::of(payload)?;
        cursor.cursor.u32("stamp.sec")?;
        cursor.cursor.u32("stamp.nanosec")?;
        let node = cursor.text("node")?;
        let parameters = Parameters(Sequence::at(cursor, "new_parameters")?);
        Ok(Self {
            node,
            changes: ParameterChanges {
                parameters,
                kind: ChangeKind::New,
            },
        })
    }
}

impl<'a> Parameters<'a> {
    /// Reads the request of a `set_parameters` service. `header` bytes precede the request itself,
    /// after the encapsulation header (rmw_cyclonedds: 16).
    ///
    /// # Errors
    /// Returns [`Reason::BadMarker`] if the payload is not plain CDR.
    pub fn of_request(payload: &'a [u8], header: usize) -> Result<Self, WireError> {
        sequence(payload, header, "parameters").map(Self)
    }
}

/// Begins to read the only sequence of a request or reply, after its header.
fn sequence<'a>(
    payload: &'a [u8],
    header: usize,
    what: &'static str,
) -> Result<Sequence<'a>, WireError> {
    let mut cursor = PlainCursor::of(payload)?;
    cursor.cursor.take("header of the call", header)?;
    Sequence::at(cursor, what)
}

impl<'a> RequestedNames<'a> {
    /// Reads the request of a `get_parameters` service. `header` bytes precede the request itself,
    /// after the encapsulation header (rmw_cyclonedds: 16).
    ///
    /// # Errors
    /// Returns [`Reason::BadMarker`] if the payload is not plain CDR.
    pub fn of_request(payload: &'a [u8], header: usize) -> Result<Self, WireError> {
        sequence(payload, header, "names").map(Self)
    }
}

impl<'a> RepliedValues<'a> {
    /// Reads the reply of a `get_parameters` service. `header` is the length of its header, as in a
    /// request.
    ///
    /// # Errors
    /// Returns [`Reason::BadMarker`] if the payload is not plain CDR.
    pub fn of_reply(payload: &'a [u8], header: usize) -> Result<Self, WireError> {
        sequence(payload, header, "values").map(Self)
    }
}

impl<'a> Iterator for RequestedNames<'a> {
    type Item = Result<&'a [u8], WireError>;

    fn next(&mut self) -> Option<Self::Item> {
        self.0.next(|cursor| cursor.text("name"))
    }
}

impl<'a> Iterator for RepliedValues<'a> {
    type Item = Result<ParameterValue<'a>, WireError>;

    fn next(&mut self) -> Option<Self::Item> {
        self.0.next(PlainCursor::value)
    }
}

impl<'a> Iterator for Parameters<'a> {
    type Item = Result<Parameter<'a>, WireError>;

    fn next(&mut self) -> Option<Self::Item> {
        self.0.next(PlainCursor::parameter)
    }
}

impl<'a> Iterator for ParameterChanges<'a> {
    type Item = Result<ParameterChange<'a>, WireError>;

    fn next(&mut self) -> Option<Self::Item> {
        loop {
            let kind = self.kind;
            match self.parameters.next() {
                Some(Ok(parameter)) => return Some(Ok(ParameterChange { kind, parameter })),
                Some(Err(error)) => {
                    self.kind = ChangeKind::Deleted;
                    return Some(Err(error));
                }
                None => {}
            }
            self.kind = match kind {
                ChangeKind::New => ChangeKind::Changed,
                ChangeKind::Changed => ChangeKind::Deleted,
                ChangeKind::Deleted => return None,
            };
            match Sequence::at(self.parameters.0.cursor(), "parameters") {
                Ok(next) => self.parameters = Parameters(next),
                Err(error) => {
                    self.kind = ChangeKind::Deleted;
                    return Some(Err(error));
                }
            }
        }
    }
}

impl fmt::Display for ParameterValue<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::NotSet => f.write_str("not set"),
            Self::Bool(value) => write!(f, "{value}"),
            Self::Integer(value) => write!(f, "{value}"),
            Self::Double(value) => write!(f, "{value:?}"),
            Self::String(text) => write_text(f, text),
            Self::Array(array) => array.fmt(f),
        }
    }
}

impl fmt::Display for ParameterArray<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let mut cursor = self.cursor;
        f.write_str("[")?;
        for index in 0..self.count {
            if index > 0 {
                f.write_str(", ")?;
            }
            // The array was read before, so no element is missing.
            match self.of {
                Element::Byte => write!(f, "{}", cursor.cursor.u8("").unwrap_or_default())?,
                Element::Bool => {
                    write!(f, "{}", cursor.cursor.u8("").unwrap_or_default() != 0)?;
                }
                Element::Integer => {
                    write!(f, "{}", cursor.wide("").unwrap_or_default().cast_signed())?;
                }
                Element::Double => {
                    write!(f, "{:?}", cursor.double("").unwrap_or_default())?;
                }
                Element::String => write_text(f, cursor.text("").unwrap_or_default())?,
            }
        }
        f.write_str("]")
    }
}

/// Writes a text; bytes that are not UTF-8 become the replacement character.
fn write_text(f: &mut fmt::Formatter<'_>, text: &[u8]) -> fmt::Result {
    text.utf8_chunks().try_for_each(|chunk| {
        f.write_str(chunk.valid())?;
        match chunk.invalid() {
            [] => Ok(()),
            _ => f.write_str("\u{fffd}"),
        }
    })
}

#[cfg(test)]
mod tests {
    use std::string::{String, ToString as _};
    use std::vec::Vec;

    use super::*;
    use crate::cursor::Endianness;
    use crate::testing::{Encoder, hurt};

    /// Writes a parameter whose fields all have a value.
    fn parameter(encoder: &mut Encoder, name: &str, kind: u8, alignment: usize) {
        encoder.unpadded(name);
        value(encoder, kind, alignment);
    }

    /// Writes a value whose fields all have a value.
    fn value(encoder: &mut Encoder, kind: u8, alignment: usize) {
        encoder.raw(&[kind, 1]);
        encoder.wide((-5_i64).cast_unsigned(), alignment);
        encoder.wide(0.5_f64.to_bits(), alignment);
        encoder.unpadded("text");
        encoder.u32(3).raw(&[1, 2, 255]);
        encoder.u32(2).raw(&[0, 1]);
        for value in [7, 0.25_f64.to_bits()] {
            encoder.u32(1).wide(value, alignment);
        }
        encoder.u32(2).unpadded("a").unpadded("bc");
    }

    fn event(endianness: Endianness, alignment: usize) -> Vec<u8> {
        let mut encoder = Encoder::new(endianness);
        encoder.u32(1).u32(2).unpadded("/planner").u32(2);
        parameter(&mut encoder, "is_on", 1, alignment);
        parameter(&mut encoder, "count", 2, alignment);
        encoder.u32(7);
        for kind in 3..=9 {
            parameter(&mut encoder, "p", kind, alignment);
        }
        encoder.u32(1);
        parameter(&mut encoder, "gone", 0, alignment);
        let little = u8::from(endianness == Endianness::Little);
        let kind = if alignment == 4 { 6 } else { 0 };
        [&[0, kind | little, 0, 0], &encoder.bytes[..]].concat()
    }

    #[test]
    fn every_type_of_value_reads_the_same_in_each_encoding() {
        for (endianness, alignment) in [
            (Endianness::Big, 8),
            (Endianness::Little, 8),
            (Endianness::Big, 4),
            (Endianness::Little, 4),
        ] {
            let bytes = event(endianness, alignment);
            let event = ParameterEvent::parse(&bytes).unwrap();
            assert_eq!(event.node, b"/planner");
            let changes: Vec<_> = event.changes.map(Result::unwrap).collect();
            let values: Vec<String> = (changes.iter())
                .map(|change| change.parameter.value.to_string())
                .collect();
            assert_eq!(
                values,
                [
                    "true",
                    "-5",
                    "0.5",
                    "text",
                    "[1, 2, 255]",
                    "[false, true]",
                    "[7]",
                    "[0.25]",
                    "[a, bc]",
                    "not set"
                ]
            );
            let count = |kind| changes.iter().filter(|change| change.kind == kind).count();
            assert_eq!(
                [ChangeKind::New, ChangeKind::Changed, ChangeKind::Deleted].map(count),
                [2, 7, 1]
            );
            assert_eq!(changes[9].parameter.name, b"gone");
        }
    }

    #[test]
    fn a_request_of_either_implementation_yields_its_parameters() {
        for header in [0, 16] {
            let mut encoder = Encoder::new(Endianness::Little);
            encoder.raw(&[9; 16][..header]).u32(1);
            parameter(&mut encoder, "speed", 3, 8);
            let bytes = [&[0, 1, 0, 0], &encoder.bytes[..]].concat();
            let parameters = Parameters::of_request(&bytes, header).unwrap();
            let parameters: Vec<_> = parameters.map(Result::unwrap).collect();
            assert_eq!(parameters[0].name, b"speed");
            assert_eq!(parameters[0].value.to_string(), "0.5");
        }
    }

    #[test]
    fn names_of_a_request_and_values_of_its_reply_have_one_order() {
        for header in [0, 16] {
            let mut encoder = Encoder::new(Endianness::Little);
            encoder.raw(&[9; 16][..header]).u32(2);
            encoder.unpadded("speed").unpadded("is_on");
            let bytes = [&[0, 1, 0, 0], &encoder.bytes[..]].concat();
            let names = RequestedNames::of_request(&bytes, header).unwrap();
            let names: Vec<_> = names.map(Result::unwrap).collect();
            assert_eq!(names, [b"speed", b"is_on"]);
            let cut = RequestedNames::of_request(&bytes[..bytes.len() - 1], header).unwrap();
            assert_eq!(cut.filter(Result::is_err).count(), 1);

            let mut encoder = Encoder::new(Endianness::Little);
            encoder.raw(&[9; 16][..header]).u32(2);
            value(&mut encoder, 3, 8);
            value(&mut encoder, 1, 8);
            let bytes = [&[0, 1, 0, 0], &encoder.bytes[..]].concat();
            let values = RepliedValues::of_reply(&bytes, header).unwrap();
            let values: Vec<_> = values.map(|value| value.unwrap().to_string()).collect();
            assert_eq!(values, ["0.5", "true"]);
            let cut = RepliedValues::of_reply(&bytes[..bytes.len() - 1], header).unwrap();
            assert_eq!(cut.filter(Result::is_err).count(), 1);
        }
    }

    #[test]
    fn a_truncated_event_yields_its_whole_changes_and_one_error() {
        let bytes = event(Endianness::Little, 8);
        let changes = |end: usize| ParameterEvent::parse(&bytes[..end]).unwrap().changes;
        assert_eq!(changes(bytes.len() - 1).filter(Result::is_ok).count(), 9);
        assert_eq!(changes(bytes.len() - 1).filter(Result::is_err).count(), 1);
        assert_eq!(changes(40).filter(Result::is_err).count(), 1);
    }

    #[test]
    fn counts_beyond_the_bytes_end_at_once() {
        let mut bytes = event(Endianness::Little, 8);
        bytes[28..32].fill(0xff);
        let event = ParameterEvent::parse(&bytes).unwrap();
        assert!(event.changes.count() < 16);
    }

    #[test]
    fn no_truncation_or_corruption_of_one_byte_makes_the_parser_panic() {
        hurt(&event(Endianness::Little, 8), |bytes| {
            for change in ParameterEvent::parse(bytes)
                .into_iter()
                .flat_map(|event| event.changes)
            {
                let _ = change.map(|change| change.parameter.value.to_string());
            }
        });
    }
}
