//! XML-RPC values in the format of Python's `xmlrpc.client`, with ros2cli's marshalling of rclpy
//! objects. Each object is an element named after its Python class.

use std::fmt::Write as _;

use base64::Engine as _;
use base64::engine::general_purpose::STANDARD;

/// Maximum size of an answer, in bytes. A topic with 1000 publishers takes 3 MB in `topic info -v`.
pub(super) const MAX_ANSWER: usize = 4 << 20;
/// Characters in a line of base64, as Python breaks it.
const BASE64_LINE: usize = 76;

/// A value in an answer.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) enum Value {
    /// `nil`.
    Nil,
    /// `boolean`.
    Boolean(bool),
    /// `int`.
    Integer(i32),
    /// `string`.
    Text(String),
    /// `base64`.
    Bytes(Vec<u8>),
    /// `array`.
    Array(Vec<Value>),
    /// `struct`.
    Struct(Vec<(&'static str, Value)>),
    /// A Python object that consists of one number: its class and the number.
    Number(&'static str, i64),
    /// A Python object with named fields: its class and the fields.
    Object(&'static str, Vec<(&'static str, Value)>),
}

/// A fault, which a client raises as an exception.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct Fault {
    /// Python class of the exception.
    class: &'static str,
    text: String,
}

/// The answer has more than [`MAX_ANSWER`] bytes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct TooLarge;

impl Value {
    /// Creates a text.
    pub(super) fn text(text: &str) -> Self {
        Self::Text(text.to_owned())
    }

    /// Creates an array.
    pub(super) fn array(values: impl IntoIterator<Item = Self>) -> Self {
        Self::Array(values.into_iter().collect())
    }

    /// Creates an integer from a number of entries.
    pub(super) fn count(count: usize) -> Self {
        Self::Integer(i32::try_from(count).unwrap_or(i32::MAX))
    }

    fn write(&self, out: &mut String) -> Result<(), TooLarge> {
        if out.len() > MAX_ANSWER {
            return Err(TooLarge);
        }
        match self {
            Self::Nil => out.push_str("<value><nil/></value>"),
            Self::Boolean(is_true) => {
                push(
                    out,
                    format_args!("<value><boolean>{}</boolean></value>\n", u8::from(*is_true)),
                );
            }
            Self::Integer(number) => {
                push(out, format_args!("<value><int>{number}</int></value>\n"));
            }
            Self::Text(text) => {
                out.push_str("<value><string>");
                escape(text, out);
                out.push_str("</string></value>\n");
            }
            Self::Bytes(bytes) => {
                out.push_str("<value><base64>\n");
                for (at, character) in STANDARD.encode(bytes).chars().enumerate() {
                    if at > 0 && at % BASE64_LINE == 0 {
                        out.push('\n');
                    }
                    out.push(character);
                }
                out.push_str("\n</base64></value>\n");
            }
            Self::Array(values) => {
                out.push_str("<value><array><data>\n");
                values.iter().try_for_each(|value| value.write(out))?;
                out.push_str("</data></array></value>\n");
            }
            Self::Struct(members) => write_struct(members, out)?,
            Self::Number(class, number) => {
                push(
                    out,
                    format_args!("<value><{class}>{number}</{class}></value>"),
                );
            }
            Self::Object(class, members) => {
                push(out, format_args!("<value><{class}>"));
                write_struct(members, out)?;
                push(out, format_args!("</{class}></value>"));
            }
        }
        Ok(())
    }
}

impl Fault {
    /// Creates a fault.
    pub(super) fn new(class: &'static str, text: impl Into<String>) -> Self {
        Self {
            class,
            text: text.into(),
        }
    }
}

/// Returns the body of an answer. An answer that is too large becomes a fault.
pub(super) fn answer(result: &Result<Value, Fault>) -> String {
    let fault = match result {
        Ok(value) => match response(value) {
            Ok(body) => return body,
            Err(TooLarge) => Fault::new(
                "MemoryError",
                format!("the answer has more than {MAX_ANSWER} bytes"),
            ),
        },
        Err(fault) => fault.clone(),
    };
    let Fault { class, text } = fault;
    let members = [
        ("faultCode", Value::Integer(1)),
        (
            "faultString",
            Value::Text(format!("<class '{class}'>:{text}")),
        ),
    ];
    let mut body = "<?xml version='1.0'?>\n<methodResponse>\n<fault>\n".to_owned();
    // The request bounds the text of a fault, so it never exceeds the limit.
    let _ = write_struct(&members, &mut body);
    body.push_str("</fault>\n</methodResponse>\n");
    body
}

fn response(value: &Value) -> Result<String, TooLarge> {
    let mut body = "<?xml version='1.0'?>\n<methodResponse>\n<params>\n<param>\n".to_owned();
    value.write(&mut body)?;
    body.push_str("</param>\n</params>\n</methodResponse>\n");
    Ok(body)
}

fn write_struct(members: &[(&'static str, Value)], out: &mut String) -> Result<(), TooLarge> {
    out.push_str("<value><struct>\n");
    for (name, value) in members {
        push(out, format_args!("<member>\n<name>{name}</name>\n"));
        value.write(out)?;
        out.push_str("</member>\n");
    }
    out.push_str("</struct></value>\n");
    Ok(())
}

fn push(out: &mut String, text: std::fmt::Arguments<'_>) {
    // Writing to a string cannot fail.
    let _ = out.write_fmt(text);
}

/// Writes text with the escapes of XML. XML cannot express most control characters. A name with
/// such a character is hostile, and the character is replaced.
fn escape(text: &str, out: &mut String) {
    for character in text.chars() {
        match character {
            '&' => out.push_str("&amp;"),
            '<' => out.push_str("&lt;"),
            '>' => out.push_str("&gt;"),
            '\t' | '\n' => out.push(character),
            '\0'..='\x1f' | '\u{fffe}' | '\u{ffff}' => out.push(char::REPLACEMENT_CHARACTER),
            _ => out.push(character),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn values_are_written_as_python_writes_them() {
        let body = answer(&Ok(Value::array([
            Value::Nil,
            Value::Boolean(true),
            Value::Integer(-3),
            Value::text("<a> & \u{1}"),
            Value::Bytes((0..32).collect()),
            Value::Number("rclpy.duration.Duration", i64::MAX),
            Value::Object(
                "rclpy.type_hash.TypeHash",
                vec![("version", Value::Integer(1))],
            ),
        ])));
        assert_eq!(
            body,
            "<?xml version='1.0'?>\n<methodResponse>\n<params>\n<param>\n<value><array><data>\n\
             <value><nil/></value><value><boolean>1</boolean></value>\n\
             <value><int>-3</int></value>\n\
             <value><string>&lt;a&gt; &amp; \u{fffd}</string></value>\n\
             <value><base64>\nAAECAwQFBgcICQoLDA0ODxAREhMUFRYXGBkaGxwdHh8=\n</base64></value>\n\
             <value><rclpy.duration.Duration>9223372036854775807</rclpy.duration.Duration></value>\
             <value><rclpy.type_hash.TypeHash><value><struct>\n<member>\n<name>version</name>\n\
             <value><int>1</int></value>\n</member>\n</struct></value>\n\
             </rclpy.type_hash.TypeHash></value></data></array></value>\n\
             </param>\n</params>\n</methodResponse>\n"
        );
    }

    #[test]
    fn long_base64_text_is_broken_into_lines_as_in_python() {
        let body = answer(&Ok(Value::Bytes(vec![0; 60])));
        let first = format!("<base64>\n{}\nAAAA\n</base64>", "A".repeat(76));
        assert!(body.contains(&first), "{body}");
    }

    #[test]
    fn a_fault_is_written_as_ros2cli_writes_it() {
        let fault = Fault::new("Exception", "method \"nope\" is not supported");
        assert_eq!(
            answer(&Err(fault)),
            "<?xml version='1.0'?>\n<methodResponse>\n<fault>\n<value><struct>\n<member>\n\
             <name>faultCode</name>\n<value><int>1</int></value>\n</member>\n<member>\n\
             <name>faultString</name>\n<value><string>&lt;class 'Exception'&gt;:method \"nope\" is \
             not supported</string></value>\n</member>\n</struct></value>\n</fault>\n\
             </methodResponse>\n"
        );
    }

    #[test]
    fn an_oversized_response_is_an_xmlrpc_fault() {
        let large = |bytes: usize| Value::array([Value::Text("a".repeat(bytes)), Value::Nil]);
        assert!(answer(&Ok(large(MAX_ANSWER / 2))).contains("<params>"));
        let body = answer(&Ok(large(MAX_ANSWER + 1)));
        assert!(
            body.contains("&lt;class 'MemoryError'&gt;"),
            "{}",
            body.len()
        );
    }
}
