//! Values as Python prints them: `print()` of a field, and numbers in all outputs.
//!
//! ROS keeps arrays of a fixed length in numpy arrays, sequences of numbers in `array.array` and
//! everything else in lists; each has its own format.

mod numpy;

use std::fmt::{LowerExp, Write as _};
use std::str::FromStr;

use crate::digits;
use crate::value::{Array, Items, Message, Scalar, ScalarKind, Value};

/// Returns `str()` of a value: the output of `--field` unless it selects a message.
pub fn str(value: &Value<'_>) -> String {
    match value {
        Value::Text(text) => text.clone().into_owned(),
        Value::Array(array) if array.is_fixed() && is_numeric(array) => match &array.items {
            Items::Scalars(scalars) => numpy::str(*scalars),
            Items::Texts(_) | Items::Messages(_) => repr(value),
        },
        _ => repr(value),
    }
}

/// Returns `repr()` of a value.
pub fn repr(value: &Value<'_>) -> String {
    let mut text = String::new();
    write_repr(&mut text, value);
    text
}

/// Returns `repr()` of a float.
pub fn float(value: f64) -> String {
    format_float(value)
}

/// Returns `str()` of a numpy `float32`: the digits that distinguish it from its neighbours.
pub fn float32(value: f32) -> String {
    format_float(value)
}

/// Returns `str()` of a scalar.
pub fn scalar(value: Scalar) -> String {
    match value {
        Scalar::Bool(true) => "True".to_owned(),
        Scalar::Bool(false) => "False".to_owned(),
        Scalar::Byte(byte) => bytes(&[byte]),
        Scalar::Int(number) => number.to_string(),
        Scalar::UInt(number) => number.to_string(),
        Scalar::Float32(number) => float(number.into()),
        Scalar::Float64(number) => float(number),
    }
}

/// Returns `repr()` of bytes.
pub fn bytes(bytes: &[u8]) -> String {
    let quote = quote(bytes.contains(&b'\''), bytes.contains(&b'"'));
    let mut text = String::with_capacity(bytes.len() * 4 + 3);
    text.push('b');
    text.push(quote);
    for byte in bytes {
        match byte {
            b'\\' => text.push_str("\\\\"),
            b'\t' => text.push_str("\\t"),
            b'\n' => text.push_str("\\n"),
            b'\r' => text.push_str("\\r"),
            0x20..=0x7e if char::from(*byte) == quote => {
                text.push('\\');
                text.push(quote);
            }
            0x20..=0x7e => text.push(char::from(*byte)),
            _ => drop(write!(text, "\\x{byte:02x}")),
        }
    }
    text.push(quote);
    text
}

/// Returns `repr()` of a string.
pub fn string(value: &str) -> String {
    let quote = quote(value.contains('\''), value.contains('"'));
    let mut text = String::with_capacity(value.len() + 2);
    text.push(quote);
    for character in value.chars() {
        let code = u32::from(character);
        match character {
            '\\' => text.push_str("\\\\"),
            '\t' => text.push_str("\\t"),
            '\n' => text.push_str("\\n"),
            '\r' => text.push_str("\\r"),
            _ if character == quote => {
                text.push('\\');
                text.push(character);
            }
            _ if is_printable(character) => text.push(character),
            _ if code <= 0xff => drop(write!(text, "\\x{code:02x}")),
            _ if code <= 0xffff => drop(write!(text, "\\u{code:04x}")),
            _ => drop(write!(text, "\\U{code:08x}")),
        }
    }
    text.push(quote);
    text
}

/// Returns Python's name of a value's type, for errors about missing attributes.
pub fn type_name<'a>(value: &Value<'a>) -> &'a str {
    match value {
        Value::Scalar(Scalar::Bool(_)) => "bool",
        Value::Scalar(Scalar::Byte(_)) => "bytes",
        Value::Scalar(Scalar::Int(_) | Scalar::UInt(_)) => "int",
        Value::Scalar(Scalar::Float32(_) | Scalar::Float64(_)) => "float",
        Value::Text(_) => "str",
        Value::Message(message) => message.structure.name.name(),
        Value::Array(array) if !is_numeric(array) => "list",
        Value::Array(array) if array.is_fixed() => "numpy.ndarray",
        Value::Array(_) => "array.array",
    }
}

/// Returns whether rclpy keeps the array in an `array.array` or a numpy array: booleans and octets
/// are in lists.
fn is_numeric(array: &Array<'_>) -> bool {
    match &array.items {
        Items::Scalars(scalars) => !matches!(scalars.kind(), ScalarKind::Bool | ScalarKind::Byte),
        Items::Texts(_) | Items::Messages(_) => false,
    }
}

fn quote(single: bool, double: bool) -> char {
    if single && !double { '"' } else { '\'' }
}

/// Returns whether Python's `str.isprintable()` is true. Rust knows the same categories, in a newer
/// version of Unicode than Humble's Python.
fn is_printable(character: char) -> bool {
    if character.is_ascii() {
        return !character.is_control();
    }
    // After another character, Rust escapes a combining character only if it is not printable.
    let text: String = ['a', character].iter().collect();
    text.escape_debug().count() == 2
}

/// Formats a float as Python does: with an exponent below 1e-4 and from 1e16. The exponent has a
/// sign and at least two digits.
fn format_float<T: LowerExp + FromStr + PartialEq + Copy>(value: T) -> String {
    let text = digits::scientific(value);
    let Some((mantissa, exponent)) = text.split_once('e') else {
        return text.to_ascii_lowercase();
    };
    match exponent.parse() {
        Ok(-4..=15) => {
            let text = digits::positional(value);
            let point = if text.contains('.') { "" } else { ".0" };
            format!("{text}{point}")
        }
        Ok::<i32, _>(exponent) => format!("{mantissa}e{exponent:+03}"),
        Err(_) => text,
    }
}

fn write_repr(text: &mut String, value: &Value<'_>) {
    match value {
        Value::Scalar(one) => text.push_str(&scalar(*one)),
        Value::Text(value) => text.push_str(&string(value)),
        Value::Message(message) => write_message(text, message),
        Value::Array(array) => match &array.items {
            Items::Scalars(scalars) if !is_numeric(array) => {
                write_list(text, scalars.iter(), |text, one| {
                    text.push_str(&scalar(one));
                });
            }
            Items::Scalars(scalars) if array.is_fixed() => text.push_str(&numpy::repr(*scalars)),
            Items::Scalars(scalars) => {
                let _ = write!(text, "array('{}'", type_code(scalars.kind()));
                if !scalars.is_empty() {
                    text.push_str(", ");
                    write_list(text, scalars.iter(), |text, one| {
                        text.push_str(&scalar(one));
                    });
                }
                text.push(')');
            }
            Items::Texts(texts) => {
                write_list(text, texts, |text, one| text.push_str(&string(one)));
            }
            Items::Messages(messages) => write_list(text, messages, write_message),
        },
    }
}

fn write_list<T>(
    text: &mut String,
    items: impl IntoIterator<Item = T>,
    mut write: impl FnMut(&mut String, T),
) {
    text.push('[');
    for (index, item) in items.into_iter().enumerate() {
        if index > 0 {
            text.push_str(", ");
        }
        write(text, item);
    }
    text.push(']');
}

/// Prints a message as `rosidl_generator_py` does: a sequence of numbers as a list.
fn write_message(text: &mut String, message: &Message<'_>) {
    let name = &message.structure.name;
    let _ = write!(
        text,
        "{}.{}.{}(",
        name.package(),
        name.kind().as_str(),
        name.name()
    );
    for (index, (field, value)) in message.fields().enumerate() {
        if index > 0 {
            text.push_str(", ");
        }
        let _ = write!(text, "{}=", field.name);
        match value {
            Value::Array(Array {
                items: Items::Scalars(scalars),
                ..
            }) if type_name(value) == "array.array" => {
                write_list(text, scalars.iter(), |text, one| {
                    text.push_str(&scalar(one));
                });
            }
            _ => write_repr(text, value),
        }
    }
    text.push(')');
}

/// Returns the type code of the `array` module.
fn type_code(kind: ScalarKind) -> char {
    match kind {
        ScalarKind::Int8 => 'b',
        ScalarKind::Bool | ScalarKind::Byte | ScalarKind::UInt8 => 'B',
        ScalarKind::Int16 => 'h',
        ScalarKind::UInt16 => 'H',
        ScalarKind::Int32 => 'i',
        ScalarKind::UInt32 => 'I',
        ScalarKind::Int64 => 'q',
        ScalarKind::UInt64 => 'Q',
        ScalarKind::Float32 => 'f',
        ScalarKind::Float64 => 'd',
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn floats_print_as_python_prints_them() {
        for (value, text) in [
            (0.0, "0.0"),
            (-0.0, "-0.0"),
            (1.0, "1.0"),
            (0.1, "0.1"),
            (1e-4, "0.0001"),
            (1e-5, "1e-05"),
            (1.5e-7, "1.5e-07"),
            (1e15, "1000000000000000.0"),
            (1e16, "1e+16"),
            (1.25e100, "1.25e+100"),
            (-1e-300, "-1e-300"),
            (9007199254740993.0, "9007199254740992.0"),
            (f64::NAN, "nan"),
            (f64::NEG_INFINITY, "-inf"),
            (f64::from(0.1_f32), "0.10000000149011612"),
            (f64::from(540.926_1_f32), "540.9260864257812"),
        ] {
            assert_eq!(float(value), text);
        }
        assert_eq!(float32(0.1), "0.1");
        assert_eq!(float32(1e-7), "1e-07");
        assert_eq!(float32(16_777_216.0), "16777216.0");
    }

    #[test]
    fn strings_and_bytes_choose_their_quotes_as_python_does() {
        assert_eq!(string("it's"), "\"it's\"");
        assert_eq!(string("it's \"so\""), "'it\\'s \"so\"'");
        assert_eq!(
            string("a\n\u{1}\u{200b}\u{e9}\u{301}\u{fffe}\\"),
            "'a\\n\\x01\\u200b\u{e9}\u{301}\\ufffe\\\\'"
        );
        assert_eq!(
            bytes(b"\x00\x01\x00'\"~\x7f\xff"),
            "b'\\x00\\x01\\x00\\'\"~\\x7f\\xff'"
        );
        assert_eq!(bytes(b"it's"), "b\"it's\"");
    }
}
