//! Parses `.idl` files to the extent that rosidl reads and writes them: modules, structures,
//! typedefs of arrays, sequences, constants and annotations.
//!
//! Used only for types without a `.msg`, `.srv` or `.action` file. Constructs that ROS cannot put
//! on the wire (enumerations, unions, `wchar`, IDL's own `char`) are rejected by name.

use std::collections::HashMap;

use crate::definition::parse::{
    MAX_FIELDS, MAX_TEXT, ParseError, Problem, SEPARATOR, parts, shortened,
};
use crate::definition::schema;
use crate::definition::{Definition, Element, Field, Kind, Shape, Structure, TypeName};
use crate::name::is_identifier;

/// Maximum depth of nested modules; ROS uses two.
const MAX_MODULES: usize = 16;
/// Field that rosidl adds to a type without fields.
const NO_MEMBER: &str = "structure_needs_at_least_one_member";

/// Parses an `.idl` file. The text of the definition is that of the equivalent `.msg` file.
pub(crate) fn definition(name: TypeName, text: &str) -> Result<Definition, ParseError> {
    if text.len() > MAX_TEXT {
        return Err(ParseError {
            line: 1,
            problem: Problem::TooLong,
        });
    }
    let mut reader = Reader::new(&name, text);
    reader.file().map_err(|problem| ParseError {
        line: reader.line,
        problem,
    })?;
    let mut structures = Vec::new();
    for part in parts(name.kind()) {
        let part = name.with_suffix(part);
        let found = reader
            .structures
            .iter()
            .position(|structure| structure.name == part);
        let Some(found) = found else {
            let problem = Problem::Missing(format!("struct {}", part.name()));
            return Err(ParseError {
                line: reader.line,
                problem,
            });
        };
        structures.push(reader.structures.swap_remove(found));
    }
    let text: Vec<_> = structures.iter().map(schema::members).collect();
    Ok(Definition::new(
        name,
        text.join(&format!("{SEPARATOR}\n")).into(),
        structures,
    ))
}

/// Reads a file token by token.
struct Reader<'a> {
    name: &'a TypeName,
    rest: &'a str,
    line: usize,
    modules: Vec<&'a str>,
    structures: Vec<Structure>,
    typedefs: HashMap<&'a str, (Element, Shape)>,
    constants: HashMap<&'a str, u32>,
}

impl<'a> Reader<'a> {
    fn new(name: &'a TypeName, text: &'a str) -> Self {
        Self {
            name,
            rest: text.strip_prefix('\u{feff}').unwrap_or(text),
            line: 1,
            modules: Vec::new(),
            structures: Vec::new(),
            typedefs: HashMap::new(),
            constants: HashMap::new(),
        }
    }

    fn file(&mut self) -> Result<(), Problem> {
        loop {
            match self.word()? {
                "" if self.modules.is_empty() => return Ok(()),
                "" => return Err(Problem::Missing("}".to_owned())),
                ";" => {}
                "}" if self.modules.pop().is_some() => {}
                "@" => self.annotation()?,
                "module" => {
                    let module = self.identifier()?;
                    self.expect("{")?;
                    if self.modules.len() == MAX_MODULES {
                        return Err(Problem::Unsupported(format!("module {module}")));
                    }
                    self.modules.push(module);
                }
                "struct" => self.structure()?,
                "typedef" => {
                    let declared = self.element_type()?;
                    let (name, declared) = self.declarator(declared)?;
                    self.typedefs.insert(name, declared);
                    self.expect(";")?;
                }
                "const" => self.constant()?,
                other => return Err(Problem::Unsupported(shortened(other))),
            }
        }
    }

    fn structure(&mut self) -> Result<(), Problem> {
        let name = self.identifier()?;
        let name = TypeName::new(self.name.package(), self.name.kind(), name)
            .map_err(|_| Problem::Name(shortened(name)))?;
        // A structure of another module is parsed, to validate it, and ignored.
        let own = [self.name.package(), self.name.kind().as_str()];
        let is_own = self.modules.as_slice() == own;
        self.expect("{")?;
        let mut fields: Vec<Field> = Vec::new();
        loop {
            if self.take("}")? {
                break;
            }
            if self.take("@")? {
                self.annotation()?;
                continue;
            }
            let declared = self.element_type()?;
            loop {
                let (name, (element, shape)) = self.declarator(declared.clone())?;
                if fields.iter().any(|field| field.name == name) {
                    return Err(Problem::Twice(shortened(name)));
                }
                if fields.len() == MAX_FIELDS {
                    return Err(Problem::TooMany);
                }
                fields.push(Field {
                    name: name.to_owned(),
                    element,
                    shape,
                });
                if !self.take(",")? {
                    break;
                }
            }
            self.expect(";")?;
        }
        if matches!(fields.as_slice(), [only] if only.name == NO_MEMBER) {
            fields.clear();
        }
        if is_own {
            self.structures.push(Structure { name, fields });
        }
        Ok(())
    }

    /// Parses `name`, or `name[N]`, given the element type.
    fn declarator(
        &mut self,
        (element, shape): (Element, Shape),
    ) -> Result<(&'a str, (Element, Shape)), Problem> {
        let name = self.identifier()?;
        if !self.take("[")? {
            return Ok((name, (element, shape)));
        }
        if shape != Shape::Single {
            return Err(Problem::Unsupported("an array of arrays".to_owned()));
        }
        let size = self.size()?;
        self.expect("]")?;
        if self.take("[")? {
            return Err(Problem::Unsupported("an array of arrays".to_owned()));
        }
        Ok((name, (element, Shape::Array(size))))
    }

    fn element_type(&mut self) -> Result<(Element, Shape), Problem> {
        let first = self.word()?;
        if first == "sequence" {
            self.expect("<")?;
            let (element, shape) = match self.word()? {
                "sequence" => {
                    return Err(Problem::Unsupported("a sequence of sequences".to_owned()));
                }
                word => self.single_type(word)?,
            };
            if shape != Shape::Single {
                return Err(Problem::Unsupported("a sequence of arrays".to_owned()));
            }
            let shape = if self.take(",")? {
                Shape::Bounded(self.size()?)
            } else {
                Shape::Unbounded
            };
            self.expect(">")?;
            return Ok((element, shape));
        }
        self.single_type(first)
    }

    fn single_type(&mut self, first: &'a str) -> Result<(Element, Shape), Problem> {
        let element = match first {
            "boolean" => Element::Bool,
            "octet" => Element::Byte,
            "int8" => Element::Int8,
            "uint8" => Element::UInt8,
            "int16" | "short" => Element::Int16,
            "uint16" => Element::UInt16,
            "int32" => Element::Int32,
            "uint32" => Element::UInt32,
            "int64" => Element::Int64,
            "uint64" => Element::UInt64,
            "float" => Element::Float32,
            "double" => Element::Float64,
            "string" => Element::String {
                bound: self.bound()?,
            },
            "wstring" => Element::WString {
                bound: self.bound()?,
            },
            "long" if self.take("long")? => Element::Int64,
            "long" if self.take("double")? => {
                return Err(Problem::Unsupported("long double".to_owned()));
            }
            "long" => Element::Int32,
            "unsigned" if self.take("short")? => Element::UInt16,
            "unsigned" => {
                self.expect("long")?;
                if self.take("long")? {
                    Element::UInt64
                } else {
                    Element::UInt32
                }
            }
            "char" | "wchar" | "map" | "any" | "fixed" => {
                return Err(Problem::Unsupported(first.to_owned()));
            }
            name => return self.named_type(name),
        };
        Ok((element, Shape::Single))
    }

    fn named_type(&mut self, first: &'a str) -> Result<(Element, Shape), Problem> {
        let mut parts = Vec::new();
        let mut next = if first == "::" { self.word()? } else { first };
        loop {
            if !is_identifier(next) || parts.len() == MAX_MODULES {
                return Err(Problem::Type(shortened(next)));
            }
            parts.push(next);
            if !self.take("::")? {
                break;
            }
            next = self.word()?;
        }
        let (own, kind) = (self.name.package(), self.name.kind().as_str());
        let (package, kind, name) = match parts.as_slice() {
            [name] => (own, kind, *name),
            [package, kind, name] => (*package, *kind, *name),
            _ => return Err(Problem::Type(shortened(&parts.join("::")))),
        };
        if (package, kind) == (own, self.name.kind().as_str())
            && let Some(declared) = self.typedefs.get(name)
        {
            return Ok(declared.clone());
        }
        // Names of message types begin with a capital letter.
        let is_message =
            kind == "msg" && name.starts_with(|first: char| first.is_ascii_uppercase());
        TypeName::new(package, Kind::Message, name)
            .ok()
            .filter(|_| is_message)
            .map(|nested| (Element::Nested(nested), Shape::Single))
            .ok_or_else(|| Problem::Type(shortened(&parts.join("::"))))
    }

    fn bound(&mut self) -> Result<Option<u32>, Problem> {
        if !self.take("<")? {
            return Ok(None);
        }
        let bound = self.size()?;
        self.expect(">")?;
        Ok(Some(bound))
    }

    /// Parses a number, or a constant with a numeric value.
    fn size(&mut self) -> Result<u32, Problem> {
        let mut word = self.word()?;
        while self.take("::")? {
            word = self.word()?;
        }
        let known = self.constants.get(word).copied().or_else(|| number(word));
        known
            .filter(|size| *size > 0)
            .ok_or_else(|| Problem::Size(shortened(word)))
    }

    fn constant(&mut self) -> Result<(), Problem> {
        self.element_type()?;
        let name = self.identifier()?;
        self.expect("=")?;
        let value = self.word()?;
        if let Some(value) = number(value) {
            self.constants.insert(name, value);
        }
        self.skip_until(";")
    }

    /// Parses an annotation after `@`: a name and optional parentheses. Only `@optional` changes
    /// the wire format of ROS.
    fn annotation(&mut self) -> Result<(), Problem> {
        let name = self.identifier()?;
        if name == "optional" {
            return Err(Problem::Unsupported("@optional".to_owned()));
        }
        if self.take("(")? {
            self.skip_until(")")
        } else {
            Ok(())
        }
    }

    /// Skips to the end of a token, over nested brackets.
    fn skip_until(&mut self, end: &str) -> Result<(), Problem> {
        let mut open = 0_usize;
        loop {
            match self.word()? {
                "" => return Err(Problem::Missing(end.to_owned())),
                word if word == end && open == 0 => return Ok(()),
                "(" => open += 1,
                ")" => open = open.saturating_sub(1),
                _ => {}
            }
        }
    }

    fn identifier(&mut self) -> Result<&'a str, Problem> {
        let word = self.word()?;
        if is_identifier(word) {
            Ok(word)
        } else {
            Err(Problem::Name(shortened(word)))
        }
    }

    fn expect(&mut self, expected: &str) -> Result<(), Problem> {
        if self.take(expected)? {
            Ok(())
        } else {
            Err(Problem::Missing(expected.to_owned()))
        }
    }

    /// Consumes the next token if it is the expected one.
    fn take(&mut self, expected: &str) -> Result<bool, Problem> {
        let (line, rest) = (self.line, self.rest);
        if self.word()? == expected {
            return Ok(true);
        }
        (self.line, self.rest) = (line, rest);
        Ok(false)
    }

    /// Returns the next word, quoted text or sign; empty at the end.
    fn word(&mut self) -> Result<&'a str, Problem> {
        self.skip_blanks()?;
        let length = match self.rest.bytes().next() {
            None => 0,
            Some(quote @ (b'"' | b'\'')) => quoted(self.rest, quote)
                .ok_or_else(|| Problem::Missing(char::from(quote).to_string()))?,
            Some(b':') if self.rest.starts_with("::") => 2,
            Some(byte) if byte.is_ascii_alphanumeric() || byte == b'_' => self
                .rest
                .find(|other: char| {
                    !(other.is_ascii_alphanumeric() || other == '_' || other == '.')
                })
                .unwrap_or(self.rest.len()),
            Some(_) => self.rest.chars().next().map_or(0, char::len_utf8),
        };
        Ok(self.advance(length))
    }

    /// Skips spaces, comments, and preprocessor lines: included files are found by name.
    fn skip_blanks(&mut self) -> Result<(), Problem> {
        loop {
            let blanks = self.rest.len() - self.rest.trim_start().len();
            self.advance(blanks);
            if self.rest.starts_with("//") || self.rest.starts_with('#') {
                let length = self.rest.find('\n').unwrap_or(self.rest.len());
                self.advance(length);
            } else if self.rest.starts_with("/*") {
                let length = self.rest.find("*/").map(|position| position + 2);
                let length = length.ok_or_else(|| Problem::Missing("*/".to_owned()))?;
                self.advance(length);
            } else {
                return Ok(());
            }
        }
    }

    fn advance(&mut self, length: usize) -> &'a str {
        let (passed, rest) = self
            .rest
            .split_at_checked(length)
            .unwrap_or((self.rest, ""));
        self.line += passed.bytes().filter(|byte| *byte == b'\n').count();
        self.rest = rest;
        passed
    }
}

/// Returns the length of a quoted text, including both quotes.
fn quoted(text: &str, quote: u8) -> Option<usize> {
    let mut escaped = false;
    for (index, byte) in text.bytes().enumerate().skip(1) {
        match byte {
            _ if escaped => escaped = false,
            b'\\' => escaped = true,
            _ if byte == quote => return Some(index + 1),
            _ => {}
        }
    }
    None
}

fn number(text: &str) -> Option<u32> {
    match text.strip_prefix("0x").or_else(|| text.strip_prefix("0X")) {
        Some(digits) => u32::from_str_radix(digits, 16).ok(),
        None => text.parse().ok(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn name(text: &str) -> TypeName {
        text.parse().unwrap()
    }

    /// The form in which `rosidl_adapter` writes a `.msg` file.
    const WRITTEN: &str = r#"// generated from rosidl_adapter/resource/msg.idl.em
// with input from a/msg/B.msg

#include "std_msgs/msg/Header.idl"
#include "a/msg/C.idl"

module a {
  module msg {
    typedef double double__9[9];
    typedef a::msg::C C__2[2];
    module B_Constants {
      @verbatim (language="comment", text=
        "A \"number\"; in {brackets} (too" "\n" "struct")
      const uint8 NUMBER = 0x3;
      const string TEXT = 'it;s';
    };
    @verbatim (language="comment", text="}")
    struct B {
      std_msgs::msg::Header header;

      @unit (value="m")
      @default (value=-1.5)
      double x;
      double__9 k;
      C__2 c;
      sequence<octet> data;
      sequence<string<5>, 4> names;
      wstring wide;
      uint8 raw[B_Constants::NUMBER];
      unsigned long long big; long small, /* both */ other;
      boolean flag;
    };
  };
};
"#;

    #[test]
    fn idl_that_rosidl_generates_from_a_message_is_read_as_that_message() {
        let message = "\
std_msgs/Header header
float64 x
float64[9] k
a/C[2] c
byte[] data
string<=5[<=4] names
wstring wide
uint8[3] raw
uint64 big
int32 small
int32 other
bool flag
";
        let read = definition(name("a/msg/B"), WRITTEN).unwrap();
        assert_eq!(read, Definition::parse(name("a/msg/B"), message).unwrap());
    }

    #[test]
    fn services_and_actions_and_empty_structures_are_read() {
        let service = "module a { module srv {\nstruct S_Request { uint8 \
                       structure_needs_at_least_one_member; };\nstruct S_Response { short x; };\n};};";
        let read = definition(name("a/srv/S"), service).unwrap();
        assert_eq!(
            read,
            Definition::parse(name("a/srv/S"), "---\nint16 x\n").unwrap()
        );
        let action = "module a { module action { typedef b::msg::C C__2[2]; struct A_Goal { float x; \
                      }; struct A_Result { C__2 two; }; struct A_Feedback { b::msg::C one; }; }; };";
        let read = definition(name("a/action/A"), action).unwrap();
        assert_eq!(&*read.text, "float32 x\n---\nb/C[2] two\n---\nb/C one\n");
    }

    #[test]
    fn mistakes_are_reported_with_their_line() {
        let problem = |text: &str| {
            let text = format!("module a {{ module msg {{\n{text}\n}}; }};");
            definition(name("a/msg/B"), &text).unwrap_err().to_string()
        };
        for (text, expected) in [
            ("struct B { char x; };", "line 2: `char` is not supported"),
            ("struct B { wchar x; };", "line 2: `wchar` is not supported"),
            (
                "struct B {\nlong double x; };",
                "line 3: `long double` is not supported",
            ),
            ("enum E { A };", "line 2: `enum` is not supported"),
            (
                "struct B { @optional\nlong x; };",
                "line 2: `@optional` is not supported",
            ),
            (
                "struct B { long x[2][2]; };",
                "line 2: `an array of arrays` is not supported",
            ),
            (
                "struct B { sequence<sequence<long>> x; };",
                "line 2: `a sequence of sequences` is not supported",
            ),
            (
                "struct B { long x[0]; };",
                "line 2: `0` is not a size from 1 to 4294967295",
            ),
            (
                "struct B { string<N> x; };",
                "line 2: `N` is not a size from 1 to 4294967295",
            ),
            ("struct B { long x, x; };", "line 2: `x` is declared twice"),
            ("struct B { b::C x; };", "line 2: `b::C` is not a type"),
            (
                "struct B { b::srv::C x; };",
                "line 2: `b::srv::C` is not a type",
            ),
            ("struct B { eouble x; };", "line 2: `eouble` is not a type"),
            ("struct B { long x };", "line 2: `;` is missing"),
            ("struct C { long x; };", "line 3: `struct B` is missing"),
            ("/* struct B", "line 2: `*/` is missing"),
            ("@verbatim(text=\"", "line 2: `\"` is missing"),
            ("@verbatim(text=1", "line 3: `)` is missing"),
            ("module b {", "line 3: `}` is missing"),
        ] {
            assert_eq!(problem(text), expected, "{text}");
        }
        let deep = "module m {".repeat(1000);
        assert!(problem(&deep).contains("not supported"));
        let long = " ".repeat(MAX_TEXT);
        assert_eq!(
            definition(name("a/msg/B"), &(long + "x"))
                .unwrap_err()
                .problem,
            Problem::TooLong
        );
    }
}
