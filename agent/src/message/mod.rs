//! ROS messages without ROS: what a type consists of, where its definition comes from, and its hash.
//!
//! Definitions are read from files as rosidl reads them; nothing is generated, loaded or executed.
//! Files and names may be anybody's: every size, number and depth is bounded.

pub mod definition;
mod hash;
mod parse;
mod schema;

pub use definition::{
    Definition, Element, Field, Kind, MessageType, NotClosed, Shape, Structure, TypeName,
};
pub use parse::{ParseError, Problem};
