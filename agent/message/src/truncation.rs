//! Truncation of messages: the options shared by all outputs of `echo`, and the text in place of
//! omitted values (`rosidl_runtime_py`'s).

use crate::definition::{Element, Shape};
use crate::value::Array;

/// Limits of the printed arrays and strings.
#[derive(Debug, Clone, Copy, Default)]
pub struct Truncation {
    /// Maximum number of elements and characters; `...` replaces the others.
    pub truncate: Option<usize>,
    /// Whether arrays are printed only by type and length.
    pub no_arrays: bool,
    /// Whether strings are printed only by length.
    pub no_strings: bool,
}

impl Truncation {
    /// Returns the shortened string; `None` if it is within the limits.
    pub fn text(&self, text: &str) -> Option<String> {
        if self.no_strings {
            return Some(format!("<string length: <{}>>", text.chars().count()));
        }
        let limit = self.truncate?;
        // A string has no more characters than bytes.
        if text.len() <= limit {
            return None;
        }
        let (end, _) = text.char_indices().nth(limit)?;
        Some(format!("{}...", text.get(..end).unwrap_or_default()))
    }

    /// Returns how many of `length` elements are printed, and whether `...` follows.
    pub fn elements(&self, length: usize) -> (usize, bool) {
        match self.truncate {
            Some(limit) if length > limit => (limit, true),
            _ => (length, false),
        }
    }

    /// Returns the text for an array that is printed by type and length; `None` if its elements are
    /// printed.
    pub fn array(&self, array: &Array<'_>) -> Option<String> {
        if !self.no_arrays {
            return None;
        }
        let element = element_name(&array.field.element);
        let length = array.length;
        Some(match array.field.shape {
            Shape::Array(size) => format!("<array type: {element}[{size}]>"),
            Shape::Bounded(bound) => {
                format!("<sequence type: {element}[{bound}], length: {length}>")
            }
            Shape::Single | Shape::Unbounded => {
                format!("<sequence type: {element}, length: {length}>")
            }
        })
    }
}

/// Returns the name of an element's type in IDL, to which ROS converts messages.
fn element_name(element: &Element) -> String {
    match element {
        Element::Bool => "boolean".to_owned(),
        Element::Byte => "octet".to_owned(),
        Element::Char | Element::UInt8 => "uint8".to_owned(),
        Element::Int8 => "int8".to_owned(),
        Element::Int16 => "int16".to_owned(),
        Element::UInt16 => "uint16".to_owned(),
        Element::Int32 => "int32".to_owned(),
        Element::UInt32 => "uint32".to_owned(),
        Element::Int64 => "int64".to_owned(),
        Element::UInt64 => "uint64".to_owned(),
        Element::Float32 => "float".to_owned(),
        Element::Float64 => "double".to_owned(),
        Element::String { .. } => "string".to_owned(),
        Element::WString { .. } => "wstring".to_owned(),
        Element::Nested(name) => name.to_string(),
    }
}
