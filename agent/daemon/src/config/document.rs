//! YAML text as a tree with the position of every key and value.
//!
//! Parsing is deliberately bounded: one document, no aliases (hence no alias bombs), limited depth
//! and size. This module does not interpret keys.

use std::collections::BTreeMap;

use saphyr_parser::{Event, Marker, Parser, ScalarStyle};

use super::mistake::{Mistakes, Position};

/// Maximum depth of nesting; no sensible configuration exceeds it.
const MAX_DEPTH: usize = 16;
/// Maximum number of values; enough for a watchlist of thousands.
const MAX_VALUES: usize = 50_000;

/// A value and the position of its first character.
#[derive(Debug)]
pub(super) struct Node {
    pub(super) position: Position,
    pub(super) content: Content,
}

#[derive(Debug)]
pub(super) enum Content {
    Scalar { text: String, plain: bool },
    List(Vec<Node>),
    Map(Vec<(Key, Node)>),
}

#[derive(Debug)]
pub(super) struct Key {
    pub(super) name: String,
    pub(super) position: Position,
}

/// A plain scalar in the YAML 1.2 core schema.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum Scalar {
    Null,
    Boolean,
    Integer(i128),
    Number(f64),
    Text,
}

/// An open container.
enum Open {
    List(Position, Vec<Node>),
    Map(Position, Vec<(Key, Node)>, Option<Key>),
}

impl Node {
    /// Parses the single document in `source`.
    pub(super) fn parse(source: &str) -> Result<Self, Mistakes> {
        let mut mistakes = Mistakes::default();
        let mut open: Vec<Open> = Vec::new();
        let mut root: Option<Self> = None;
        let mut values = 0_usize;
        for step in Parser::new_from_str(source) {
            let (event, span) = match step {
                Ok(step) => step,
                Err(error) => {
                    let message = format!("not valid YAML: {}", error.info());
                    mistakes.add(position(*error.marker()), "", message);
                    break;
                }
            };
            let at = position(span.start);
            values += 1;
            if open.len() > MAX_DEPTH || values > MAX_VALUES {
                mistakes.add(at, "", "nested too deep or too many values");
                break;
            }
            let done = match event {
                Event::Scalar(text, style, _, _) => {
                    let plain = style == ScalarStyle::Plain;
                    let content = Content::Scalar {
                        text: text.into_owned(),
                        plain,
                    };
                    Some(Self {
                        position: at,
                        content,
                    })
                }
                Event::SequenceStart(..) => {
                    open.push(Open::List(at, Vec::new()));
                    None
                }
                Event::MappingStart(..) => {
                    open.push(Open::Map(at, Vec::new(), None));
                    None
                }
                Event::SequenceEnd | Event::MappingEnd => open.pop().map(Open::close),
                Event::Alias(_) => {
                    mistakes.add(at, "", "aliases are not supported: repeat the value");
                    break;
                }
                Event::DocumentStart(_) if root.is_some() => {
                    mistakes.add(at, "", "the file has several documents: keep one");
                    break;
                }
                _ => None,
            };
            let Some(node) = done else { continue };
            if let Err(position) = node.put(&mut open, &mut root) {
                mistakes.add(position, "", "a key must be plain text");
                break;
            }
        }
        let empty = || Self {
            position: Position { line: 1, column: 1 },
            content: Content::Scalar {
                text: String::new(),
                plain: true,
            },
        };
        mistakes.none_or(root.unwrap_or_else(empty))
    }

    /// Puts a complete value into the innermost open container.
    ///
    /// # Errors
    ///
    /// Returns the value's position if it is a map's key and not a scalar.
    fn put(self, open: &mut [Open], root: &mut Option<Self>) -> Result<(), Position> {
        match open.last_mut() {
            None => *root = Some(self),
            Some(Open::List(_, items)) => items.push(self),
            Some(Open::Map(_, entries, key)) => match (key.take(), self.content) {
                (Some(key), content) => {
                    let position = self.position;
                    entries.push((key, Self { position, content }));
                }
                (None, Content::Scalar { text: name, .. }) => {
                    let position = self.position;
                    *key = Some(Key { name, position });
                }
                (None, _) => return Err(self.position),
            },
        }
        Ok(())
    }

    /// Returns whether the document consists of comments alone.
    pub(super) fn is_empty(&self) -> bool {
        self.scalar() == Some(Scalar::Null)
    }

    /// Returns the position of each value by its key path, and reports duplicate keys.
    pub(super) fn index(&self, mistakes: &mut Mistakes) -> BTreeMap<String, Position> {
        let mut places = BTreeMap::new();
        self.index_into("", &mut places, mistakes);
        places
    }

    fn index_into(
        &self,
        path: &str,
        places: &mut BTreeMap<String, Position>,
        mistakes: &mut Mistakes,
    ) {
        places.insert(path.to_owned(), self.position);
        match &self.content {
            Content::Scalar { .. } => {}
            Content::List(items) => {
                for (index, item) in items.iter().enumerate() {
                    item.index_into(&item_path(path, index), places, mistakes);
                }
            }
            Content::Map(entries) => {
                for (key, value) in entries {
                    let path = key_path(path, &key.name);
                    if let Some(first) = places.get(&path) {
                        let message = format!("duplicate key, first at {first}");
                        mistakes.add(key.position, &path, message);
                        continue;
                    }
                    value.index_into(&path, places, mistakes);
                }
            }
        }
    }

    /// Returns the version of the file with its position; `None` unless it is a whole number.
    pub(super) fn version(&self) -> Option<(i128, Position)> {
        let Content::Map(entries) = &self.content else {
            return None;
        };
        let (_, value) = entries.iter().find(|(key, _)| key.name == "version")?;
        match value.scalar()? {
            Scalar::Integer(version) => Some((version, value.position)),
            _ => None,
        }
    }

    /// Returns the meaning of a scalar; `None` for lists and maps.
    pub(super) fn scalar(&self) -> Option<Scalar> {
        let Content::Scalar { text, plain } = &self.content else {
            return None;
        };
        if !plain {
            return Some(Scalar::Text);
        }
        Some(match text.as_str() {
            "" | "~" | "null" | "Null" | "NULL" => Scalar::Null,
            "true" | "True" | "TRUE" | "false" | "False" | "FALSE" => Scalar::Boolean,
            ".inf" | ".Inf" | ".INF" | "+.inf" => Scalar::Number(f64::INFINITY),
            "-.inf" => Scalar::Number(f64::NEG_INFINITY),
            ".nan" | ".NaN" | ".NAN" => Scalar::Number(f64::NAN),
            text => match (integer(text), text.parse::<f64>()) {
                (Some(value), _) => Scalar::Integer(value),
                // Rust also parses `inf` and `nan`, which are text in YAML.
                (None, Ok(value)) if text.contains(|c: char| c.is_ascii_digit()) => {
                    Scalar::Number(value)
                }
                _ => Scalar::Text,
            },
        })
    }

    /// Returns the value as error messages show it.
    pub(super) fn describe(&self) -> String {
        let shown = |text: &str| -> String {
            let mut shown: String = text.chars().take(40).collect();
            if shown.len() < text.len() {
                shown.push_str("...");
            }
            shown
        };
        match (&self.content, self.scalar()) {
            (Content::List(_), _) => "a list".to_owned(),
            (Content::Map(_), _) => "a map of keys".to_owned(),
            (Content::Scalar { .. }, Some(Scalar::Null)) => "nothing".to_owned(),
            (Content::Scalar { text, .. }, Some(Scalar::Text) | None) => {
                format!("the text `{}`", shown(text))
            }
            (Content::Scalar { text, .. }, _) => format!("`{}`", shown(text)),
        }
    }
}

impl Open {
    fn close(self) -> Node {
        match self {
            Self::List(position, items) => Node {
                position,
                content: Content::List(items),
            },
            Self::Map(position, entries, _) => {
                // The parser reports a block mapping at its first colon, but the mapping begins at
                // its first key.
                let first = entries.first().map_or(position, |(key, _)| key.position);
                Node {
                    position: position.min(first),
                    content: Content::Map(entries),
                }
            }
        }
    }
}

/// Returns the path of a key: `path.key`.
pub(super) fn key_path(path: &str, key: &str) -> String {
    if path.is_empty() {
        key.to_owned()
    } else {
        format!("{path}.{key}")
    }
}

/// Returns the path of a list item: `path[index]`.
pub(super) fn item_path(path: &str, index: usize) -> String {
    format!("{path}[{index}]")
}

fn position(marker: Marker) -> Position {
    Position {
        line: marker.line(),
        column: marker.col() + 1,
    }
}

fn integer(text: &str) -> Option<i128> {
    if let Some(hexadecimal) = text.strip_prefix("0x") {
        return i128::from_str_radix(hexadecimal, 16).ok();
    }
    if let Some(octal) = text.strip_prefix("0o") {
        return i128::from_str_radix(octal, 8).ok();
    }
    text.parse().ok()
}
