//! Decoded messages as JSON for a browser, with fields in the order of the definition and truncated
//! arrays and strings. Numbers that JavaScript would round become strings.

use std::cell::Cell;

use serde::ser::{SerializeMap as _, SerializeSeq as _};
use serde::{Serialize, Serializer};

use ros2probe_message::{Array, Items, Message, Scalar, Value};

/// Maximum number of array elements shown.
pub(super) const MAX_ELEMENTS: usize = 64;
/// Maximum number of characters shown of a string.
const MAX_CHARACTERS: usize = 1024;
/// Maximum number of values shown of a message; 16 characters of a string count as one.
const MAX_VALUES: usize = 20_000;
/// A double represents all integers up to this value exactly.
const MAX_EXACT_INTEGER: u64 = 1 << 53;

/// A message to serialize.
pub(super) struct Tree<'a> {
    message: &'a Message<'a>,
    left: Cell<usize>,
}

/// A part of a message, with the remaining number of values.
struct Part<'a, T: ?Sized>(&'a T, &'a Cell<usize>);

impl<'a> Tree<'a> {
    pub(super) const fn new(message: &'a Message<'a>) -> Self {
        Self {
            message,
            left: Cell::new(MAX_VALUES),
        }
    }
}

impl Serialize for Tree<'_> {
    fn serialize<S: Serializer>(&self, out: S) -> Result<S::Ok, S::Error> {
        Part(self.message, &self.left).serialize(out)
    }
}

/// Subtracts `values` from the remaining number. Returns whether enough values were left.
fn draw(left: &Cell<usize>, values: usize) -> bool {
    let rest = left.get().checked_sub(values);
    left.set(rest.unwrap_or(0));
    rest.is_some()
}

impl Serialize for Part<'_, Message<'_>> {
    fn serialize<S: Serializer>(&self, out: S) -> Result<S::Ok, S::Error> {
        let Self(message, left) = self;
        let mut map = out.serialize_map(None)?;
        for (field, value) in message.fields() {
            map.serialize_entry(&field.name, &Part(value, left))?;
        }
        map.end()
    }
}

impl Serialize for Part<'_, Value<'_>> {
    fn serialize<S: Serializer>(&self, out: S) -> Result<S::Ok, S::Error> {
        let Self(value, left) = self;
        match value {
            Value::Scalar(scalar) => {
                draw(left, 1);
                number(*scalar, out)
            }
            Value::Text(text) => Part(&**text, left).serialize(out),
            Value::Array(array) => Part(array, left).serialize(out),
            Value::Message(message) => Part(message, left).serialize(out),
        }
    }
}

impl Serialize for Part<'_, Array<'_>> {
    fn serialize<S: Serializer>(&self, out: S) -> Result<S::Ok, S::Error> {
        let Self(array, left) = self;
        if array.length <= MAX_ELEMENTS && left.get() > array.length {
            return Elements(array, left).serialize(out);
        }
        let mut map = out.serialize_map(Some(2))?;
        map.serialize_entry("$length", &array.length)?;
        map.serialize_entry("$items", &Elements(array, left))?;
        map.end()
    }
}

/// The first elements of an array.
struct Elements<'a>(&'a Array<'a>, &'a Cell<usize>);

impl Serialize for Elements<'_> {
    fn serialize<S: Serializer>(&self, out: S) -> Result<S::Ok, S::Error> {
        let Self(array, left) = self;
        let mut list = out.serialize_seq(None)?;
        match &array.items {
            Items::Scalars(scalars) => {
                for scalar in scalars.iter().take(MAX_ELEMENTS) {
                    if !draw(left, 1) {
                        break;
                    }
                    list.serialize_element(&Part(&Value::Scalar(scalar), left))?;
                }
            }
            Items::Texts(texts) => {
                for text in texts.iter().take(MAX_ELEMENTS) {
                    if left.get() == 0 {
                        break;
                    }
                    list.serialize_element(&Part(&**text, left))?;
                }
            }
            Items::Messages(messages) => {
                for message in messages.iter().take(MAX_ELEMENTS) {
                    if left.get() == 0 {
                        break;
                    }
                    list.serialize_element(&Part(message, left))?;
                }
            }
        }
        list.end()
    }
}

impl Serialize for Part<'_, str> {
    fn serialize<S: Serializer>(&self, out: S) -> Result<S::Ok, S::Error> {
        let Self(text, left) = self;
        let most = MAX_CHARACTERS.min(left.get().saturating_mul(16));
        let cut = text.char_indices().nth(most).map(|(end, _)| end);
        draw(left, 1 + cut.unwrap_or(text.len()) / 16);
        let Some(beginning) = cut.and_then(|end| text.get(..end)) else {
            return out.serialize_str(text);
        };
        let mut map = out.serialize_map(Some(2))?;
        map.serialize_entry("$length", &text.chars().count())?;
        map.serialize_entry("$text", beginning)?;
        map.end()
    }
}

fn number<S: Serializer>(scalar: Scalar, out: S) -> Result<S::Ok, S::Error> {
    let real = |value: f64| match value {
        _ if value.is_nan() => Some("NaN"),
        f64::INFINITY => Some("Infinity"),
        f64::NEG_INFINITY => Some("-Infinity"),
        _ => None,
    };
    match scalar {
        Scalar::Bool(value) => out.serialize_bool(value),
        Scalar::Byte(value) => out.serialize_u8(value),
        Scalar::Int(value) if value.unsigned_abs() > MAX_EXACT_INTEGER => out.collect_str(&value),
        Scalar::Int(value) => out.serialize_i64(value),
        Scalar::UInt(value) if value > MAX_EXACT_INTEGER => out.collect_str(&value),
        Scalar::UInt(value) => out.serialize_u64(value),
        Scalar::Float32(value) => match real(f64::from(value)) {
            Some(word) => out.serialize_str(word),
            None => out.serialize_f32(value),
        },
        Scalar::Float64(value) => match real(value) {
            Some(word) => out.serialize_str(word),
            None => out.serialize_f64(value),
        },
    }
}

#[cfg(test)]
mod tests {
    use ros2probe_message::{Limits, MessageType, decode};

    use super::*;

    /// Returns a message with this definition and body as JSON.
    fn shown(definition: &str, body: &[u8]) -> String {
        let name = "a/msg/B".parse().unwrap();
        let message_type = MessageType::parse(&name, definition).unwrap();
        let payload = [&[0, 1, 0, 0], body].concat();
        let limits = Limits {
            kept: MAX_ELEMENTS,
            ..Limits::default()
        };
        let decoded = decode(&message_type, &payload, &limits).unwrap();
        serde_json::to_string(&Tree::new(&decoded.message)).unwrap()
    }

    fn parsed(text: &str) -> serde_json::Value {
        serde_json::from_str(text).unwrap()
    }

    #[test]
    fn numbers_that_a_browser_would_round_become_strings() {
        let body = [
            &i64::MAX.to_le_bytes()[..],
            &7_i64.to_le_bytes(),
            &f64::NAN.to_le_bytes(),
            &0.1_f32.to_le_bytes(),
            &[1, 200],
        ];
        let seen = shown(
            "int64 a\nint64 b\nfloat64 c\nfloat32 d\nbool e\nbyte f",
            &body.concat(),
        );
        assert_eq!(
            seen,
            r#"{"a":"9223372036854775807","b":7,"c":"NaN","d":0.1,"e":true,"f":200}"#
        );
    }

    #[test]
    fn long_arrays_and_strings_are_truncated_and_show_their_length() {
        let mut body = 1000_u32.to_le_bytes().to_vec();
        body.extend((0..1000_u32).map(|number| number as u8));
        body.extend(2001_u32.to_le_bytes());
        body.extend(vec![b'x'; 2000]);
        body.push(0);
        let seen = parsed(&shown("uint8[] data\nstring text", &body));
        assert_eq!(seen["data"]["$length"], 1000);
        assert_eq!(
            seen["data"]["$items"].as_array().unwrap().len(),
            MAX_ELEMENTS
        );
        assert_eq!(seen["data"]["$items"][63], 63);
        assert_eq!(seen["text"]["$length"], 2000);
        assert_eq!(
            seen["text"]["$text"].as_str().unwrap().len(),
            MAX_CHARACTERS
        );
    }

    #[test]
    fn nested_arrays_share_one_limit_of_values() {
        // 64 messages of 64 messages of 64 numbers would be a quarter of a million values.
        let line = "=".repeat(80);
        let definition = format!("C[] c\n{line}\nMSG: a/C\nD[] d\n{line}\nMSG: a/D\nint32[] e");
        let mut body = 64_u32.to_le_bytes().to_vec();
        for _ in 0..64 {
            body.extend(64_u32.to_le_bytes());
            for _ in 0..64 {
                body.extend(64_u32.to_le_bytes());
                body.extend((0..64_u32).flat_map(u32::to_le_bytes));
            }
        }
        let seen = shown(&definition, &body);
        assert!(seen.len() < 400_000, "{}", seen.len());
        let seen = parsed(&seen);
        assert_eq!(seen["c"][0]["d"][63]["e"][63], 63);
    }
}
