//! `--field a.b.[0].c`: selects a part of a message.

use std::str::FromStr;

use crate::ros2::Refused;
use ros2probe_message::value::{Items, Message};
use ros2probe_message::{Value, python};

/// Path to a part of a message.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct FieldPath {
    /// Text as typed, which ros2cli repeats in its errors.
    text: String,
    steps: Vec<Step>,
}

#[derive(Clone, Debug, PartialEq, Eq)]
enum Step {
    Name(String),
    Index(usize),
}

/// Part selected by a path.
#[derive(Debug)]
pub(super) enum Selected<'a> {
    Message(&'a Message<'a>),
    Value(&'a Value<'a>),
    /// An element of a sequence, without a value of its own.
    Element(Value<'a>),
    /// An element of a numpy array, which has the element's type.
    NumpyElement(Value<'a>),
}

impl FromStr for FieldPath {
    type Err = Refused;

    /// Parses names joined by points. An element is `.[0]`, `.0` or `[0]`.
    fn from_str(text: &str) -> Result<Self, Refused> {
        let wrong = || Refused(format!("Invalid field value '{text}'"));
        let mut steps = Vec::new();
        let parts: Vec<&str> = text.split('.').filter(|part| !part.is_empty()).collect();
        for part in &parts {
            let (name, indices) = part.split_at(part.find('[').unwrap_or(part.len()));
            match name.parse() {
                Ok(index) => steps.push(Step::Index(index)),
                Err(_) if name.is_empty() => {}
                Err(_) => steps.push(Step::Name(name.to_owned())),
            }
            for index in indices.split('[').skip(1) {
                let index = index.strip_suffix(']').and_then(|index| index.parse().ok());
                steps.push(Step::Index(index.ok_or_else(wrong)?));
            }
        }
        if steps.is_empty() {
            return Err(wrong());
        }
        Ok(Self {
            text: parts.join("."),
            steps,
        })
    }
}

impl FieldPath {
    /// Returns the error for a field of a serialized message, which has no names. Returns `None`
    /// for a path that begins with an index.
    pub(super) fn missing_in_bytes(&self) -> Option<Refused> {
        let Some(Step::Name(name)) = self.steps.first() else {
            return None;
        };
        let text = &self.text;
        Some(Refused(format!(
            "Invalid field '{text}': 'bytes' object has no attribute '{name}'"
        )))
    }

    pub(super) fn select<'a>(&self, message: &'a Message<'a>) -> Result<Selected<'a>, Refused> {
        let mut found = Selected::Message(message);
        for step in &self.steps {
            let next = match (&found, step) {
                (Selected::Message(message), Step::Name(name)) => {
                    message.get(name).map(Selected::of)
                }
                (Selected::Value(Value::Array(array)), Step::Index(index)) => match &array.items {
                    Items::Scalars(scalars) => {
                        let element = scalars.get(*index).map(Value::Scalar);
                        element.map(|element| match array.is_fixed() {
                            true => Selected::NumpyElement(element),
                            false => Selected::Element(element),
                        })
                    }
                    Items::Texts(texts) => {
                        let element = texts.get(*index).map(|text| Value::Text(text.clone()));
                        element.map(Selected::Element)
                    }
                    Items::Messages(messages) => messages.get(*index).map(Selected::Message),
                },
                _ => None,
            };
            let reason = match (&found, step) {
                (Selected::Value(Value::Array(_)), Step::Index(_)) => {
                    "list index out of range".to_owned()
                }
                (found, Step::Index(_)) => {
                    format!("'{}' object is not subscriptable", found.type_name())
                }
                (found, Step::Name(name)) => {
                    format!("'{}' object has no attribute '{name}'", found.type_name())
                }
            };
            let text = &self.text;
            let refused = || Refused(format!("Invalid field '{text}': {reason}"));
            found = next.ok_or_else(refused)?;
        }
        Ok(found)
    }
}

impl<'a> Selected<'a> {
    fn of(value: &'a Value<'a>) -> Self {
        match value {
            Value::Message(message) => Self::Message(message),
            value => Self::Value(value),
        }
    }

    fn type_name(&self) -> String {
        match self {
            Self::Message(message) => message.structure.name.name().to_owned(),
            Self::Value(value) => python::type_name(value).to_owned(),
            Self::Element(value) | Self::NumpyElement(value) => python::type_name(value).to_owned(),
        }
    }
}
