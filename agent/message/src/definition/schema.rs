//! A type's definition as one text, in the form of bags (encoding `ros2msg` of MCAP's registry).
//!
//! Uses the order of `rosbag2_cpp`: the type's own text, then each nested message once, below a
//! line of `=`. The messages that a file uses are sorted. Each is followed by its own nested
//! messages.

use std::collections::BTreeSet;
use std::fmt::Write as _;

use crate::definition::{
    Definition, Element, Kind, MessageType, SchemaError, Shape, Structure, TypeName,
};

/// The line between definitions.
const SEPARATOR_LINE: &str =
    "================================================================================";
const SCHEMA_ENCODING: &str = "ros2msg";

impl MessageType {
    /// Returns encoding and text for a bag's schema: the files as they were read. A service's event
    /// has the service's file below a heading, as in `rosbag2`. Other types implied by services and
    /// actions have no file: their text is generated from their fields.
    pub fn schema_text(&self) -> (&'static str, String) {
        let mut text = String::new();
        let mut written = BTreeSet::new();
        if let Some(definition) = self.definitions.get(&self.root)
            && self.root.kind() == Kind::Message
        {
            self.append_file(&mut text, definition, &mut written);
        } else if let Some(definition) = self.service_of_event() {
            heading(&mut text, "SRV", &definition.name.to_string());
            self.append_file(&mut text, definition, &mut written);
        } else if let Some(structure) = self.structure(&self.root) {
            self.append_structure(&mut text, structure, &mut written);
        }
        (SCHEMA_ENCODING, text)
    }

    fn service_of_event(&self) -> Option<&Definition> {
        let name = self.root.name().strip_suffix("_Event")?;
        let file = TypeName::new(self.root.package(), Kind::Service, name).ok()?;
        (self.root.kind() == Kind::Service)
            .then(|| self.definitions.get(&file))?
            .map(AsRef::as_ref)
    }

    /// Appends a file and the types that it uses. The recursion is as deep as the types are nested,
    /// which is bounded.
    fn append_file<'a>(
        &'a self,
        text: &mut String,
        definition: &'a Definition,
        written: &mut BTreeSet<&'a TypeName>,
    ) {
        text.push_str(&definition.text);
        for name in &definition.uses {
            if written.insert(name)
                && let Some(next) = self.definitions.get(name)
            {
                text.push('\n');
                heading(text, "MSG", &short(name));
                self.append_file(text, next, written);
            }
        }
    }

    /// Appends a type without a file, and the types that it uses.
    fn append_structure<'a>(
        &'a self,
        text: &mut String,
        structure: &'a Structure,
        written: &mut BTreeSet<&'a TypeName>,
    ) {
        text.push_str(&members(structure));
        let nested = structure
            .fields
            .iter()
            .filter_map(|field| match &field.element {
                Element::Nested(name) => Some(name),
                _ => None,
            });
        for name in nested.collect::<BTreeSet<_>>() {
            if !written.insert(name) {
                continue;
            }
            text.push('\n');
            heading(text, "MSG", &short(name));
            if let Some(definition) = self.definitions.get(name)
                && name.kind() == Kind::Message
            {
                self.append_file(text, definition, written);
            } else if let Some(next) = self.structure(name) {
                self.append_structure(text, next, written);
            }
        }
    }
}

/// Returns `package/Type`, the form used in a `.msg` file.
fn short(name: &TypeName) -> String {
    format!("{}/{}", name.package(), name.name())
}

fn heading(text: &mut String, kind: &str, name: &str) {
    let _ = writeln!(text, "{SEPARATOR_LINE}\n{kind}: {name}");
}

/// Returns the lines of a `.msg` file with these fields.
pub(crate) fn members(structure: &Structure) -> String {
    let mut text = String::new();
    for field in &structure.fields {
        let _ = match &field.element {
            Element::Bool => write!(text, "bool"),
            Element::Byte => write!(text, "byte"),
            Element::Char => write!(text, "char"),
            Element::Int8 => write!(text, "int8"),
            Element::UInt8 => write!(text, "uint8"),
            Element::Int16 => write!(text, "int16"),
            Element::UInt16 => write!(text, "uint16"),
            Element::Int32 => write!(text, "int32"),
            Element::UInt32 => write!(text, "uint32"),
            Element::Int64 => write!(text, "int64"),
            Element::UInt64 => write!(text, "uint64"),
            Element::Float32 => write!(text, "float32"),
            Element::Float64 => write!(text, "float64"),
            Element::String { bound: None } => write!(text, "string"),
            Element::String { bound: Some(bound) } => write!(text, "string<={bound}"),
            Element::WString { bound: None } => write!(text, "wstring"),
            Element::WString { bound: Some(bound) } => write!(text, "wstring<={bound}"),
            Element::Nested(name) => write!(text, "{}", short(name)),
        };
        let _ = match field.shape {
            Shape::Single => Ok(()),
            Shape::Array(size) => write!(text, "[{size}]"),
            Shape::Bounded(size) => write!(text, "[<={size}]"),
            Shape::Unbounded => write!(text, "[]"),
        };
        let _ = writeln!(text, " {}", field.name);
    }
    text
}

/// Returns the definitions in a schema's text, each with the type that it defines.
pub(crate) fn parts<'a>(
    root: &TypeName,
    text: &'a str,
) -> Result<Vec<(TypeName, &'a str)>, SchemaError> {
    let mut parts = Vec::new();
    let (mut name, mut start, mut offset) = (root.clone(), 0, 0);
    let mut lines = text.split_inclusive('\n').enumerate();
    while let Some((index, line)) = lines.next() {
        let line_start = offset;
        offset += line.len();
        if line.trim_end() != SEPARATOR_LINE {
            continue;
        }
        let (_, below) = lines.next().unwrap_or((index, ""));
        offset += below.len();
        let next = below.trim_end().strip_prefix("MSG: ").and_then(message);
        let next = next.ok_or(SchemaError::Heading { line: index + 2 })?;
        let part = text.get(start..line_start).unwrap_or_default();
        parts.push((std::mem::replace(&mut name, next), part));
        start = offset;
    }
    parts.push((name, text.get(start..).unwrap_or_default()));
    Ok(parts)
}

/// Parses `package/Type`, or `package/msg/Type` as some programs write it.
fn message(text: &str) -> Option<TypeName> {
    if let Ok(name) = text.parse() {
        return Some(name);
    }
    let (package, name) = text.split_once('/')?;
    TypeName::new(package, Kind::Message, name).ok()
}

#[cfg(test)]
mod tests {
    use std::fs::File;
    use std::io::Read as _;
    use std::path::Path;

    use flate2::read::GzDecoder;
    use proptest::collection::vec;
    use proptest::option;
    use proptest::prelude::*;
    use proptest::sample::select;

    use super::*;
    use crate::{Field, Library, Sources};

    const STAMPED: &str = "\
# This represents a Point with reference coordinate frame and timestamp

std_msgs/Header header
Point point

================================================================================
MSG: geometry_msgs/Point
float64 x
float64 y
float64 z

================================================================================
MSG: std_msgs/Header
builtin_interfaces/Time stamp # when
string frame_id

================================================================================
MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec
";

    #[test]
    fn a_schema_is_written_as_it_was_read() {
        let root = "geometry_msgs/msg/PointStamped".parse().unwrap();
        let parsed = MessageType::parse(&root, STAMPED).unwrap();
        // The text between two definitions ends with an empty line that belongs to the separator.
        let tight = STAMPED.replace("\n\n====", "\n====");
        let again = MessageType::parse(&root, &tight).unwrap();
        assert_eq!(again.schema_text(), (SCHEMA_ENCODING, STAMPED.to_owned()));
        assert_eq!(parsed.type_hash(), again.type_hash());
        assert_eq!(parsed.structures().count(), 4);
    }

    #[test]
    fn headings_with_and_without_msg_are_read_and_others_are_refused() {
        let text = format!("B b\n{SEPARATOR_LINE}\nMSG: a/msg/B\nint8 x\n");
        let read = MessageType::parse(&"a/msg/A".parse().unwrap(), &text).unwrap();
        assert_eq!(read.structures().count(), 2);
        for heading in ["IDL: a/msg/B", "MSG: B", "MSG: a/../B", ""] {
            let text = format!("B b\n{SEPARATOR_LINE}\n{heading}\nint8 x\n");
            let error = MessageType::parse(&"a/msg/A".parse().unwrap(), &text).unwrap_err();
            assert_eq!(error, SchemaError::Heading { line: 3 }, "{heading}");
        }
    }

    /// Returns the name and the text of each schema in a real bag.
    fn real() -> Vec<(String, String)> {
        let bag =
            "../../../shared/fixtures/cyclonedds/bag-record-2ns/bag_default/bag_default_0.mcap.gz";
        let bag = Path::new(env!("CARGO_MANIFEST_DIR")).join(bag);
        // The bag is not part of the repository.
        let Ok(file) = File::open(bag) else {
            return Vec::new();
        };
        let mut bytes = Vec::new();
        GzDecoder::new(file).read_to_end(&mut bytes).unwrap();
        let summary = mcap::Summary::read(&bytes).unwrap().unwrap();
        let text = |data: &[u8]| String::from_utf8(data.to_vec()).unwrap();
        summary
            .schemas
            .values()
            .map(|one| (one.name.clone(), text(&one.data)))
            .collect()
    }

    #[test]
    fn a_real_bags_schema_is_written_byte_for_byte_from_its_files() {
        for (name, expected) in real() {
            let root: TypeName = name.parse().unwrap();
            let installed = tempfile::tempdir().unwrap();
            for (name, text) in parts(&root, &expected).unwrap() {
                let package = installed
                    .path()
                    .join("share")
                    .join(name.package())
                    .join("msg");
                std::fs::create_dir_all(&package).unwrap();
                // The empty line before the next heading belongs to the heading.
                let is_last = expected.ends_with(text);
                let text = if is_last {
                    text
                } else {
                    text.strip_suffix('\n').unwrap()
                };
                std::fs::write(package.join(format!("{}.msg", name.name())), text).unwrap();
            }
            let prefixes = vec![installed.path().to_owned()];
            let library = Library::new(Sources {
                prefixes,
                ..Sources::default()
            });
            let found = library.find(&name, None).unwrap();
            assert_eq!(found.schema_text(), (SCHEMA_ENCODING, expected), "{name}");
        }
    }

    proptest! {
        #[test]
        fn a_written_schema_is_parsed_again(structure in structure(), more in structure()) {
            let text = members(&structure);
            let read = Definition::parse(structure.name.clone(), &text).unwrap();
            prop_assert_eq!(&*read.structures[0], &structure);
            // The same structure is read as a nested type.
            let root = "a/msg/Root".parse().unwrap();
            let text = format!("B b\n{}{SEPARATOR_LINE}\nMSG: a/B\n{}", members(&more), members(&structure));
            if let Ok(read) = MessageType::parse(&root, &text) {
                let again = MessageType::parse(&root, &read.schema_text().1).unwrap();
                prop_assert_eq!(again.type_hash(), read.type_hash());
            }
        }

        #[test]
        fn any_text_is_parsed_or_refused_without_a_panic(words in vec(select(WORDS), 0..60)) {
            let text = words.join(" ");
            for name in ["a/msg/B", "a/srv/B", "a/action/B"] {
                let name = || name.parse::<TypeName>().unwrap();
                let _ = Definition::parse(name(), &text);
                if let Ok(read) = Definition::parse_idl(name(), &text) {
                    prop_assert_eq!(Definition::parse(name(), &read.text).unwrap(), read);
                }
            }
            let root = "a/msg/B".parse().unwrap();
            if let Ok(read) = MessageType::parse(&root, &text) {
                let again = MessageType::parse(&root, &read.schema_text().1).unwrap();
                prop_assert_eq!(again.type_hash(), read.type_hash());
            }
        }
    }

    /// Tokens of definitions, combined in any order.
    const WORDS: &[&str] = &[
        "\n",
        "\n",
        "\n",
        "int8",
        "x",
        "y",
        "string<=5",
        "[<=3]",
        "B",
        "a/C",
        "=",
        "1",
        "#",
        "---",
        "@key",
        SEPARATOR_LINE,
        "MSG: a/C",
        "module a { module msg {",
        "struct B {",
        "};",
        "};",
        "long",
        ";",
        "sequence<",
        ">",
        "<",
        "[",
        "]",
        "typedef",
        "const",
        "\"",
        "'",
        "/*",
        "*/",
        "::",
        "é",
        "(",
        ")",
    ];

    fn structure() -> impl Strategy<Value = Structure> {
        let element = prop_oneof![
            Just(Element::Bool),
            Just(Element::Byte),
            Just(Element::Char),
            Just(Element::Int16),
            Just(Element::UInt64),
            Just(Element::Float32),
            option::of(1_u32..).prop_map(|bound| Element::String { bound }),
            option::of(1_u32..).prop_map(|bound| Element::WString { bound }),
            Just(Element::Nested("b/msg/Other".parse().unwrap())),
            Just(Element::Nested("a/msg/Same".parse().unwrap())),
        ];
        let shape = prop_oneof![
            Just(Shape::Single),
            Just(Shape::Unbounded),
            (1_u32..).prop_map(Shape::Array),
            (1_u32..).prop_map(Shape::Bounded),
        ];
        vec(("[a-z][a-z0-9_]{0,8}", element, shape), 0..12).prop_map(|fields| {
            let mut names = BTreeSet::new();
            let fields = fields
                .into_iter()
                .filter(|(name, _, _)| names.insert(name.clone()))
                .map(|(name, element, shape)| Field {
                    name,
                    element,
                    shape,
                });
            Structure {
                name: "a/msg/B".parse().unwrap(),
                fields: fields.collect(),
            }
        })
    }
}
