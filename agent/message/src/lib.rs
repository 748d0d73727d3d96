//! ROS messages without ROS: definitions of types, their hashes, and the text of a payload.
//!
//! - [`Library`] finds a type's definition by name and announced hash, in directories, an installed
//!   ROS or the embedded definitions, and returns a [`MessageType`].
//!   [`Library::offer`] takes descriptions of types from nodes.
//! - [`decode()`] decodes a CDR payload of that type into a [`Value`] tree that borrows from it.
//! - [`yaml`], [`csv`] and [`python`] print values as `ros2 topic echo` prints them; [`Truncation`]
//!   limits their length. [`filter`] evaluates an expression over a message.
//!
//! Definitions are read from files as rosidl reads them. Nothing is generated, loaded or executed.
//! Files, names and payloads are untrusted: every size, number and depth is bounded.
//!
//! ```
//! use ros2probe_message::yaml::{self, Style};
//! use ros2probe_message::{Library, Limits, Sources, Truncation, decode};
//!
//! let library = Library::new(Sources::default());
//! let message_type = library.find("std_msgs/msg/String", None)?;
//! let payload = b"\0\x01\0\0\x06\0\0\0hello\0";
//! let decoded = decode(&message_type, payload, &Limits::default())?;
//! let text = yaml::document(&decoded.message, &Truncation::default(), Style::Block);
//! assert_eq!(text, "data: hello\n");
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```

#![forbid(unsafe_code)]

pub mod csv;
pub mod decode;
pub mod definition;
mod dialect;
mod digits;
mod embedded;
pub mod filter;
mod hash;
pub mod library;
mod name;
pub mod preview;
pub mod python;
pub mod truncation;
pub mod type_description;
pub mod type_object;
pub mod value;
pub mod yaml;

pub use decode::{DecodeError, Decoded, Limits, decode};
pub use definition::parse::{ParseError, Problem};
pub use definition::{
    Definition, Element, Field, Kind, MessageType, NotClosed, Shape, Structure, TypeName,
};
pub use dialect::Dialect;
pub use library::{Library, NotFound, Sources};
pub use truncation::Truncation;
pub use value::{Array, Items, Message, Scalar, Value};
