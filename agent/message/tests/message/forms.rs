//! Strings, floats and arrays with Python's output for them.

use std::borrow::Cow;
use std::fs::File;
use std::io::Read as _;

use flate2::read::GzDecoder;
use ros2probe_message::value::{Array, Items, Message, Scalar, ScalarKind, Scalars};
use ros2probe_message::yaml::{self, Style};
use ros2probe_message::{Element, Field, Shape, Structure, Truncation, Value, python};
use ros2probe_wire::cursor::Endianness::Little;
use serde::Deserialize;

use super::golden::{bytes, data};

#[derive(Deserialize)]
#[serde(untagged)]
pub enum Form {
    Text {
        string: String,
        repr: String,
        block: String,
        flow: String,
        nested: String,
        listed: String,
    },
    Array {
        dtype: String,
        bytes: String,
        str: String,
        repr: String,
    },
    Float {
        bits: String,
        repr: String,
        single_bits: String,
        single: String,
        yaml: String,
    },
}

pub fn read() -> Vec<Form> {
    let file = File::open(data().join("python/forms.jsonl.gz")).unwrap();
    let mut text = String::new();
    GzDecoder::new(file).read_to_string(&mut text).unwrap();
    text.lines()
        .map(|line| serde_json::from_str(line).unwrap())
        .collect()
}

impl Form {
    /// Returns the index of the form's kind, and the outputs that differ from Python's.
    pub fn differences(&self) -> (usize, Vec<String>) {
        match self {
            Self::Text {
                string,
                repr,
                block,
                flow,
                nested,
                listed,
            } => {
                let differ = [
                    (python::string(string), repr),
                    (document(string, Nesting::Single, Style::Block), block),
                    (document(string, Nesting::Nested, Style::Flow), flow),
                    (document(string, Nesting::Nested, Style::Block), nested),
                    (document(string, Nesting::Listed, Style::Block), listed),
                ];
                (0, differences(&differ))
            }
            Self::Array {
                dtype,
                bytes: hex,
                str,
                repr,
            } => {
                let bytes = bytes(hex);
                let (element, kind) = element(dtype);
                let scalars = Scalars::new(kind, Little, &bytes);
                let shape = Shape::Array(u32::try_from(scalars.len()).unwrap());
                let field = Field {
                    name: "data".into(),
                    element,
                    shape,
                };
                let items = Items::Scalars(scalars);
                let value = Value::Array(Array {
                    field: &field,
                    length: scalars.len(),
                    items,
                });
                (
                    1,
                    differences(&[(python::str(&value), str), (python::repr(&value), repr)]),
                )
            }
            Self::Float {
                bits,
                repr,
                single_bits,
                single,
                yaml: document,
            } => {
                let Some(Scalar::Float64(double)) =
                    Scalar::read(ScalarKind::Float64, Little, &bytes(bits))
                else {
                    unreachable!()
                };
                let Some(Scalar::Float32(short)) =
                    Scalar::read(ScalarKind::Float32, Little, &bytes(single_bits))
                else {
                    unreachable!()
                };
                let structure = structure("data", Element::Float64, Shape::Single);
                let values = vec![Value::Scalar(Scalar::Float64(double))];
                let message = Message {
                    structure: &structure,
                    values,
                };
                let printed = yaml::document(&message, &Truncation::default(), Style::Block);
                let differ = [
                    (python::float(double), repr),
                    (python::float32(short), single),
                    (printed, document),
                ];
                (2, differences(&differ))
            }
        }
    }
}

fn differences<const N: usize>(pairs: &[(String, &String); N]) -> Vec<String> {
    let differ = pairs.iter().filter(|(here, there)| here != *there);
    differ
        .map(|(here, there)| format!("{here:?}\n{there:?}\n"))
        .collect()
}

#[derive(Clone, Copy)]
enum Nesting {
    Single,
    Nested,
    Listed,
}

fn document(text: &str, nesting: Nesting, style: Style) -> String {
    let string = || Element::String { bound: None };
    let nested = || Element::Nested("a/msg/B".parse().unwrap());
    let list = structure("data", string(), Shape::Unbounded);
    let single = structure("data", string(), Shape::Single);
    let inner = structure("b", nested(), Shape::Unbounded);
    let outer = structure("a", nested(), Shape::Single);
    let one = |structure| Message {
        structure,
        values: vec![Value::Text(Cow::Borrowed(text))],
    };
    let message = match nesting {
        Nesting::Single => one(&single),
        Nesting::Nested => {
            let items = Items::Messages(vec![one(&single), one(&single)]);
            let array = Value::Array(Array {
                field: &inner.fields[0],
                length: 2,
                items,
            });
            let inner = Message {
                structure: &inner,
                values: vec![array],
            };
            Message {
                structure: &outer,
                values: vec![Value::Message(inner)],
            }
        }
        Nesting::Listed => {
            let items = Items::Texts(vec![Cow::Borrowed(text), Cow::Borrowed("x")]);
            let array = Value::Array(Array {
                field: &list.fields[0],
                length: 2,
                items,
            });
            let inner = Message {
                structure: &list,
                values: vec![array],
            };
            Message {
                structure: &outer,
                values: vec![Value::Message(inner)],
            }
        }
    };
    yaml::document(&message, &Truncation::default(), style)
}

fn structure(name: &str, element: Element, shape: Shape) -> Structure {
    let field = Field {
        name: name.to_owned(),
        element,
        shape,
    };
    Structure {
        name: "a/msg/B".parse().unwrap(),
        fields: vec![field],
    }
}

fn element(dtype: &str) -> (Element, ScalarKind) {
    let element = match dtype {
        "float64" => Element::Float64,
        "float32" => Element::Float32,
        "int8" => Element::Int8,
        "uint8" => Element::UInt8,
        "int32" => Element::Int32,
        "int64" => Element::Int64,
        "uint64" => Element::UInt64,
        _ => unreachable!("{dtype}"),
    };
    let kind = ScalarKind::of(&element).unwrap();
    (element, kind)
}
