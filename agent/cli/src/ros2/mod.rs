//! What `rp topic`, `rp node`, `rp service`, `rp action` and `rp bag info` print: the text of the `ros2` command
//! line in the dialect of a distribution.
//!
//! Pure: facts in, text out. Nothing here asks an agent, reads a clock or prints.

pub mod action;
pub mod bag;
pub mod dialect;
pub mod echo;
mod endpoint;
pub mod name;
pub mod node;
pub mod rates;
mod refusal;
pub mod service;
pub mod topic;

pub use refusal::Refused;
pub use ros2probe_message::Dialect;
