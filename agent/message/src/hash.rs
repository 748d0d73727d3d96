//! The type hash of ROS 2 since Iron: REP-2011, version 01.
//!
//! SHA-256 of a JSON text with names and types of all fields, with exactly the spaces that Python's
//! `json.dumps` writes. Names are ASCII identifiers, so nothing needs escaping.

use std::fmt::Write as _;

use sha2::{Digest as _, Sha256};

use crate::definition::{Element, MessageType, Shape, Structure};

/// `type_description_interfaces/msg/FieldType`: offset of an array type's number from its
/// element's.
pub(crate) const ARRAY_OFFSET: u8 = 48;
pub(crate) const BOUNDED_OFFSET: u8 = 96;
pub(crate) const UNBOUNDED_OFFSET: u8 = 144;

impl MessageType {
    /// Returns `RIHS01_` and 64 hexadecimal digits, as discovery announces it.
    pub fn type_hash(&self) -> String {
        let mut text = String::from(r#"{"type_description": "#);
        if let Some(root) = self.structure(&self.root) {
            describe(&mut text, root);
        }
        text.push_str(r#", "referenced_type_descriptions": ["#);
        let mut separator = "";
        for structure in self
            .structures()
            .filter(|structure| structure.name != self.root)
        {
            text.push_str(separator);
            describe(&mut text, structure);
            separator = ", ";
        }
        text.push_str("]}");
        let mut hash = String::from("RIHS01_");
        for byte in Sha256::digest(text.as_bytes()) {
            let _ = write!(hash, "{byte:02x}");
        }
        hash
    }
}

fn describe(text: &mut String, structure: &Structure) {
    let _ = write!(text, r#"{{"type_name": "{}", "fields": ["#, structure.name);
    if structure.fields.is_empty() {
        member(
            text,
            "structure_needs_at_least_one_member",
            &Element::UInt8,
            Shape::Single,
        );
    }
    let mut separator = "";
    for field in &structure.fields {
        text.push_str(separator);
        member(text, &field.name, &field.element, field.shape);
        separator = ", ";
    }
    text.push_str("]}");
}

fn member(text: &mut String, name: &str, element: &Element, shape: Shape) {
    let (id, string_capacity) = match element {
        Element::Nested(_) => (1, 0),
        Element::Int8 => (2, 0),
        Element::UInt8 | Element::Char => (3, 0),
        Element::Int16 => (4, 0),
        Element::UInt16 => (5, 0),
        Element::Int32 => (6, 0),
        Element::UInt32 => (7, 0),
        Element::Int64 => (8, 0),
        Element::UInt64 => (9, 0),
        Element::Float32 => (10, 0),
        Element::Float64 => (11, 0),
        Element::Bool => (15, 0),
        Element::Byte => (16, 0),
        Element::String { bound: None } => (17, 0),
        Element::WString { bound: None } => (18, 0),
        Element::String { bound: Some(bound) } => (21, *bound),
        Element::WString { bound: Some(bound) } => (22, *bound),
    };
    let (offset, capacity) = match shape {
        Shape::Single => (0_u8, 0),
        Shape::Array(size) => (ARRAY_OFFSET, size),
        Shape::Bounded(size) => (BOUNDED_OFFSET, size),
        Shape::Unbounded => (UNBOUNDED_OFFSET, 0),
    };
    let _ = write!(
        text,
        r#"{{"name": "{name}", "type": {{"type_id": {}, "capacity": {capacity}, "string_capacity": {string_capacity}, "nested_type_name": ""#,
        id + offset
    );
    if let Element::Nested(nested) = element {
        let _ = write!(text, "{nested}");
    }
    text.push_str(r#""}}"#);
}

#[cfg(test)]
mod tests {
    use super::*;

    fn hash(name: &str, text: &str) -> String {
        MessageType::parse(&name.parse().unwrap(), text)
            .unwrap()
            .type_hash()
    }

    /// Hashes announced by nodes of ROS 2 Jazzy.
    #[test]
    fn a_string_has_the_hash_that_jazzy_announces() {
        assert_eq!(
            hash("std_msgs/msg/String", "string data # text\nint8 A=1"),
            "RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18"
        );
    }

    #[test]
    fn every_change_of_the_wire_format_changes_the_hash() {
        let one = |text| hash("a/msg/A", text);
        let all = [
            "int8 x",
            "int8 y",
            "uint8 x",
            "int8[] x",
            "int8[2] x",
            "int8[<=2] x",
            "int8[<=3] x",
            "string x",
            "string<=2 x",
            "wstring x",
            "byte x",
            "",
        ];
        let mut hashes = all.map(one);
        hashes.sort_unstable();
        assert!(hashes.is_sorted_by(|before, after| before < after));
        assert_eq!(one("char x"), one("uint8 x 5 # and a constant\nint8 A=3"));
    }
}
