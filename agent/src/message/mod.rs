//! ROS messages without ROS: what a type consists of, where its definition comes from, and its hash.
//!
//! Definitions are read from files as rosidl reads them; nothing is generated, loaded or executed.
//! Files and names may be anybody's: every size, number and depth is bounded.

pub mod csv;
pub mod decode;
pub mod definition;
mod digits;
mod embedded;
pub mod filter;
mod hash;
mod idl;
mod implied;
pub mod library;
mod name;
mod numpy;
mod parse;
mod place;
pub mod python;
mod schema;
mod search;
pub mod shown;
pub mod value;
pub mod yaml;

pub use decode::{DecodeError, Decoded, Limits, decode};
pub use definition::{
    Definition, Element, Field, Kind, MessageType, NotClosed, Shape, Structure, TypeName,
};
pub use library::{Library, NotFound, Sources};
pub use parse::{ParseError, Problem};
pub use shown::Shown;
pub use value::{Array, Items, Message, Scalar, Value};
