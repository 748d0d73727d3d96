//! Text of `rp topic`, `rp node`, `rp service`, `rp action` and `rp bag info`, in the format of
//! ros2cli of a distribution.
//!
//! Pure functions: no requests, no clock, no output.

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
