//! A message as one line of comma-separated values, without quoting, as `ros2 topic echo --csv`
//! prints it.
//!
//! A comma only follows a value: empty values at the beginning of a message or an array leave no
//! trace. Users of ros2cli parse this format.

use crate::python;
use crate::truncation::Truncation;
use crate::value::{Array, Items, Message, Scalar, Value};

/// Returns the line without its line break.
pub fn line(message: &Message<'_>, shown: &Truncation) -> String {
    let mut line = String::new();
    for (_, value) in message.fields() {
        if !line.is_empty() {
            line.push(',');
        }
        match value {
            Value::Scalar(value) => scalar(&mut line, *value, shown),
            Value::Text(text) => {
                line.push_str(&shown.text(text).unwrap_or_else(|| text.to_string()));
            }
            Value::Message(message) => line.push_str(&self::line(message, shown)),
            Value::Array(array) => match shown.array(array) {
                Some(words) => line.push_str(&words),
                None => line.push_str(&elements(array, shown)),
            },
        }
    }
    line
}

fn elements(array: &Array<'_>, shown: &Truncation) -> String {
    let (count, cut) = shown.elements(array.length);
    let mut line = String::new();
    let separate = |line: &mut String| {
        if !line.is_empty() {
            line.push(',');
        }
    };
    match &array.items {
        Items::Scalars(scalars) => {
            for value in scalars.iter().take(count) {
                separate(&mut line);
                match value {
                    // numpy prints a float32 with the digits of a float32.
                    Scalar::Float32(number) if array.is_fixed() => {
                        line.push_str(&python::float32(number));
                    }
                    _ => scalar(&mut line, value, shown),
                }
            }
        }
        Items::Texts(texts) => {
            for text in texts.iter().take(count) {
                separate(&mut line);
                line.push_str(&shown.text(text).unwrap_or_else(|| text.to_string()));
            }
        }
        Items::Messages(messages) => {
            for message in messages.iter().take(count) {
                separate(&mut line);
                line.push_str(&self::line(message, shown));
            }
        }
    }
    if cut {
        separate(&mut line);
        line.push_str("...");
    }
    line
}

fn scalar(line: &mut String, value: Scalar, shown: &Truncation) {
    match (value, shown.truncate) {
        (Scalar::Byte(_), Some(0)) => line.push_str("b'...'"),
        _ => line.push_str(&python::scalar(value)),
    }
}
