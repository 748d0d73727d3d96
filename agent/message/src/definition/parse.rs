//! Parses `.msg`, `.srv` and `.action` files as `rosidl_adapter` does.
//!
//! Constants and defaults are skipped, not interpreted. Style rules of rosidl (no capital letters
//! in a field's name, no spaces before it) are not enforced; anything without a wire format is
//! rejected.

use std::collections::BTreeSet;

use crate::definition::{Element, Field, Kind, Shape, Structure, TypeName};
use crate::name::is_identifier;

/// Maximum size of a file, in bytes. The largest file in use has 30 kB.
pub(crate) const MAX_TEXT: usize = 1 << 18;
/// Maximum number of fields per type.
pub(crate) const MAX_FIELDS: usize = 4096;
/// Separates a service's request and response, and the parts of an action.
pub(crate) const SEPARATOR: &str = "---";

/// Why a definition cannot be parsed, and where.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("line {line}: {problem}")]
pub struct ParseError {
    /// Line number, counted from 1.
    pub line: usize,
    /// Mistake in that line.
    pub problem: Problem,
}

/// A mistake in a definition.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum Problem {
    /// The file is too long for a definition.
    #[error("longer than {MAX_TEXT} bytes")]
    TooLong,
    /// The file is not text.
    #[error("not UTF-8")]
    NotText,
    /// A type without a field name.
    #[error("a type is not followed by a name")]
    NoName,
    /// The name of a field or constant is invalid.
    #[error("`{0}` is not a valid name")]
    Name(String),
    /// A field is declared twice.
    #[error("`{0}` is declared twice")]
    Twice(String),
    /// The text is neither a basic type nor the name of a message.
    #[error("`{0}` is not a type")]
    Type(String),
    /// The bound of a string or an array is invalid.
    #[error("`{0}` is not a size from 1 to 4294967295")]
    Size(String),
    /// A constant of a type that cannot be constant, or without a value.
    #[error("invalid constant: its type or value is not allowed")]
    Constant,
    /// An annotation that changes the wire format.
    #[error("`{0}` is not supported")]
    Unsupported(String),
    /// An expected word or sign is missing.
    #[error("`{0}` is missing")]
    Missing(String),
    /// Too many fields.
    #[error("more than {MAX_FIELDS} fields")]
    TooMany,
    /// The number of `---` lines does not match the kind of file.
    #[error("expected {expected} `---` lines, found {found}")]
    Separators {
        /// Required number.
        expected: usize,
        /// Number in the file.
        found: usize,
    },
}

/// Returns the types in a file: one for a message, two for a service, three for an action.
pub(crate) fn file(name: &TypeName, text: &str) -> Result<Vec<Structure>, ParseError> {
    if text.len() > MAX_TEXT {
        return Err(ParseError {
            line: 1,
            problem: Problem::TooLong,
        });
    }
    let text = text.strip_prefix('\u{feff}').unwrap_or(text);
    let parts = parts(name.kind());
    let mut parts_left = parts.iter();
    let mut current = match parts_left.next() {
        Some(part) => Members::of(name, part),
        None => return Ok(Vec::new()),
    };
    let mut structures = Vec::new();
    let (mut found, mut lines) = (0, 0);
    for (index, line) in text.lines().enumerate() {
        lines = index + 1;
        let line = line.trim_end();
        if line == SEPARATOR && name.kind() != Kind::Message {
            found += 1;
            if let Some(part) = parts_left.next() {
                structures.push(std::mem::replace(&mut current, Members::of(name, part)).structure);
            }
            continue;
        }
        current
            .line(name.package(), line)
            .map_err(|problem| ParseError {
                line: lines,
                problem,
            })?;
    }
    structures.push(current.structure);
    let expected = parts.len() - 1;
    if found != expected {
        let problem = Problem::Separators { expected, found };
        return Err(ParseError {
            line: lines.max(1),
            problem,
        });
    }
    Ok(structures)
}

/// Returns the name suffixes of the types in a file.
pub(crate) fn parts(kind: Kind) -> &'static [&'static str] {
    match kind {
        Kind::Message => &[""],
        Kind::Service => &["_Request", "_Response"],
        Kind::Action => &["_Goal", "_Result", "_Feedback"],
    }
}

/// The fields of the current part.
struct Members {
    structure: Structure,
    names: BTreeSet<String>,
}

impl Members {
    fn of(name: &TypeName, part: &str) -> Self {
        let structure = Structure {
            name: name.with_suffix(part),
            fields: Vec::new(),
        };
        Self {
            structure,
            names: BTreeSet::new(),
        }
    }

    fn line(&mut self, package: &str, line: &str) -> Result<(), Problem> {
        let line = line
            .split_once('#')
            .map_or(line, |(before, _)| before)
            .trim();
        let Some(line) = without_annotations(line)? else {
            return Ok(());
        };
        let Some((type_text, rest)) = line.split_once(char::is_whitespace) else {
            return Err(Problem::NoName);
        };
        let rest = rest.trim_start();
        if let Some((constant, value)) = rest.split_once('=')
            && !constant.trim_end().contains(char::is_whitespace)
        {
            return check_constant(type_text, constant.trim_end(), value.trim());
        }
        let name = rest.split(char::is_whitespace).next().unwrap_or(rest);
        if !is_identifier(name) {
            return Err(Problem::Name(shortened(name)));
        }
        let (element, shape) = field_type(package, type_text)?;
        if self.structure.fields.len() == MAX_FIELDS {
            return Err(Problem::TooMany);
        }
        if !self.names.insert(name.to_owned()) {
            return Err(Problem::Twice(name.to_owned()));
        }
        self.structure.fields.push(Field {
            name: name.to_owned(),
            element,
            shape,
        });
        Ok(())
    }
}

/// Returns the line after its annotations, if it is not empty. `@key` does not change ROS's
/// encoding; any other annotation may.
fn without_annotations(mut line: &str) -> Result<Option<&str>, Problem> {
    while line.starts_with('@') {
        let (annotation, rest) = line.split_once(char::is_whitespace).unwrap_or((line, ""));
        if annotation != "@key" {
            return Err(Problem::Unsupported(shortened(annotation)));
        }
        line = rest.trim_start();
    }
    Ok((!line.is_empty()).then_some(line))
}

fn check_constant(type_text: &str, name: &str, value: &str) -> Result<(), Problem> {
    if !is_identifier(name) {
        return Err(Problem::Name(shortened(name)));
    }
    // A string's value may be empty, or followed by a comment only.
    match basic(type_text)? {
        Some(Element::String { .. } | Element::WString { .. }) => Ok(()),
        Some(_) if !value.is_empty() => Ok(()),
        _ => Err(Problem::Constant),
    }
}

/// Parses `string<=5[<=3]`: an element type, and after it the number of elements.
fn field_type(package: &str, text: &str) -> Result<(Element, Shape), Problem> {
    let no_type = || Problem::Type(shortened(text));
    let (element, shape) = match text.strip_suffix(']') {
        None => (text, Shape::Single),
        Some(inside) => {
            let (element, number) = inside.rsplit_once('[').ok_or_else(no_type)?;
            let shape = match number.strip_prefix("<=") {
                _ if number.is_empty() => Shape::Unbounded,
                Some(bound) => Shape::Bounded(size(bound)?),
                None => Shape::Array(size(number)?),
            };
            (element, shape)
        }
    };
    if let Some(element) = basic(element)? {
        return Ok((element, shape));
    }
    let (package, name) = element.split_once('/').unwrap_or((package, element));
    if !name.starts_with(|first: char| first.is_ascii_uppercase()) {
        return Err(no_type());
    }
    let nested = TypeName::new(package, Kind::Message, name).map_err(|_| no_type())?;
    Ok((Element::Nested(nested), shape))
}

/// Parses a basic type; returns `None` for any other.
fn basic(text: &str) -> Result<Option<Element>, Problem> {
    let (name, bound) = match text.split_once("<=") {
        Some((name, bound)) => (name, Some(size(bound)?)),
        None => (text, None),
    };
    Ok(Some(match (name, bound) {
        ("string", bound) => Element::String { bound },
        ("wstring", bound) => Element::WString { bound },
        (_, Some(_)) => return Err(Problem::Type(shortened(text))),
        ("bool", _) => Element::Bool,
        ("byte", _) => Element::Byte,
        ("char", _) => Element::Char,
        ("int8", _) => Element::Int8,
        ("uint8", _) => Element::UInt8,
        ("int16", _) => Element::Int16,
        ("uint16", _) => Element::UInt16,
        ("int32", _) => Element::Int32,
        ("uint32", _) => Element::UInt32,
        ("int64", _) => Element::Int64,
        ("uint64", _) => Element::UInt64,
        ("float32", _) => Element::Float32,
        ("float64", _) => Element::Float64,
        _ => return Ok(None),
    }))
}

fn size(text: &str) -> Result<u32, Problem> {
    let digits = !text.is_empty() && text.bytes().all(|byte| byte.is_ascii_digit());
    let number = digits
        .then(|| text.parse().ok())
        .flatten()
        .filter(|number| *number > 0);
    number.ok_or_else(|| Problem::Size(shortened(text)))
}

/// Returns the text shortened for an error.
pub(crate) fn shortened(text: &str) -> String {
    text.chars().take(60).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn name(text: &str) -> TypeName {
        text.parse().unwrap()
    }

    fn fields(text: &str) -> Result<Vec<Field>, ParseError> {
        file(&name("a/msg/A"), text).map(|mut structures| structures.swap_remove(0).fields)
    }

    fn field(text: &str) -> (Element, Shape) {
        let mut fields = fields(text).unwrap();
        assert_eq!(fields.len(), 1, "{text}");
        let field = fields.swap_remove(0);
        (field.element, field.shape)
    }

    #[test]
    fn types_are_read_with_their_bounds() {
        let nested = |text| Element::Nested(name(text));
        let string = |bound| Element::String { bound };
        for (text, expected) in [
            ("bool x", (Element::Bool, Shape::Single)),
            ("byte x 7", (Element::Byte, Shape::Single)),
            ("char[] x", (Element::Char, Shape::Unbounded)),
            ("float32[9] x", (Element::Float32, Shape::Array(9))),
            ("uint64[<=3] x [1, 2]", (Element::UInt64, Shape::Bounded(3))),
            ("string x \"a b\"", (string(None), Shape::Single)),
            ("string<=5 x", (string(Some(5)), Shape::Single)),
            ("string<=5[<=3] x", (string(Some(5)), Shape::Bounded(3))),
            (
                "wstring<=4294967295[] x",
                (
                    Element::WString {
                        bound: Some(u32::MAX),
                    },
                    Shape::Unbounded,
                ),
            ),
            ("Point x", (nested("a/msg/Point"), Shape::Single)),
            ("b/Point[2] x", (nested("b/msg/Point"), Shape::Array(2))),
            ("  \tint8\t x\r", (Element::Int8, Shape::Single)),
            ("@key int8 x # why", (Element::Int8, Shape::Single)),
            ("string x 'a=b'", (string(None), Shape::Single)),
        ] {
            assert_eq!(field(text), expected, "{text}");
        }
    }

    #[test]
    fn comments_constants_and_empty_lines_are_not_fields() {
        let text = "\u{feff}# head\n\nuint8 A=1\nint8 B = -1 # b\nstring C=\nstring<=5 D=\"=#\"\n\
                    \t# indented\nfloat32 value # m\nbyte E=0x1\n@key\n";
        let fields = fields(text).unwrap();
        assert_eq!(fields.len(), 1);
        assert_eq!(fields.first().unwrap().name, "value");
        assert_eq!(self::fields(""), Ok(vec![]));
    }

    #[test]
    fn mistakes_are_reported_with_their_line() {
        let problem = |text: &str| {
            let text = format!("int8 ok\n# comment\n{text}\nint8 after\n");
            let error = fields(&text).unwrap_err();
            assert_eq!(error.line, 3, "{text}");
            error.to_string()
        };
        for (text, expected) in [
            ("int8", "line 3: a type is not followed by a name"),
            ("int8 9x", "line 3: `9x` is not a valid name"),
            ("int8 a-b", "line 3: `a-b` is not a valid name"),
            ("int8 ok", "line 3: `ok` is declared twice"),
            ("time x", "line 3: `time` is not a type"),
            ("a/b/C x", "line 3: `a/b/C` is not a type"),
            ("../C x", "line 3: `../C` is not a type"),
            ("int8] x", "line 3: `int8]` is not a type"),
            ("int8<=5 x", "line 3: `int8<=5` is not a type"),
            ("int8[][] x", "line 3: `int8[][]` is not a type"),
            (
                "int8[0] x",
                "line 3: `0` is not a size from 1 to 4294967295",
            ),
            (
                "int8[4294967296] x",
                "line 3: `4294967296` is not a size from 1 to 4294967295",
            ),
            (
                "int8[+1] x",
                "line 3: `+1` is not a size from 1 to 4294967295",
            ),
            (
                "int8[<=] x",
                "line 3: `` is not a size from 1 to 4294967295",
            ),
            (
                "string<= x",
                "line 3: `` is not a size from 1 to 4294967295",
            ),
            (
                "Point P=1",
                "line 3: invalid constant: its type or value is not allowed",
            ),
            (
                "int8 P=",
                "line 3: invalid constant: its type or value is not allowed",
            ),
            (
                "int8[2] P=1",
                "line 3: invalid constant: its type or value is not allowed",
            ),
            ("int8 =1", "line 3: `` is not a valid name"),
            ("@optional int8 x", "line 3: `@optional` is not supported"),
            ("---", "line 3: a type is not followed by a name"),
        ] {
            assert_eq!(problem(text), expected, "{text}");
        }
    }

    #[test]
    fn services_have_two_parts_and_actions_three() {
        let service = file(&name("a/srv/A"), "int8 x\n---   \n---").unwrap_err();
        assert_eq!(
            service.to_string(),
            "line 3: expected 1 `---` lines, found 2"
        );
        let parts = file(&name("a/srv/A"), "int8 x\r\n---\r\nB y\r\n").unwrap();
        assert_eq!(parts.len(), 2);
        let parts = file(&name("a/action/A"), "---\n#\n---\nint8 x").unwrap();
        let counts: Vec<_> = parts
            .iter()
            .map(|part| (part.name.name(), part.fields.len()))
            .collect();
        assert_eq!(counts, [("A_Goal", 0), ("A_Result", 0), ("A_Feedback", 1)]);
        let empty = file(&name("a/action/A"), "").unwrap_err();
        assert_eq!(empty.to_string(), "line 1: expected 2 `---` lines, found 0");
    }

    #[test]
    fn too_long_files_and_too_many_fields_are_refused() {
        let long = "#".repeat(MAX_TEXT + 1);
        assert_eq!(fields(&long).unwrap_err().problem, Problem::TooLong);
        let many: String = (0..=MAX_FIELDS)
            .map(|index| format!("int8 f{index}\n"))
            .collect();
        let error = fields(&many).unwrap_err();
        assert_eq!(
            (error.line, error.problem),
            (MAX_FIELDS + 1, Problem::TooMany)
        );
        let error = fields(&format!("{} x", "y".repeat(100_000))).unwrap_err();
        assert!(error.to_string().len() < 100);
    }
}
