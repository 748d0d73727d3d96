//! The broker: the only process with rights over other processes.
//!
//! The agent cannot read other processes, and cannot put breakpoints into them. The broker answers
//! a closed list of [requests](request::Request) over a unix socket, and verifies everything that a
//! request names. It passes the descriptors of breakpoints to the agent, and keeps none. Therefore
//! the kernel removes the breakpoints when the agent ends, even if the broker or the agent is
//! killed.
//!
//! Each request runs in a fork with a deadline. A file or memory that never answers blocks only the
//! fork, which is left behind.

pub mod attach;
pub mod client;
pub mod functions;
pub mod kernel;
pub mod library;
pub mod mapped;
mod message;
pub mod open;
pub mod request;
pub mod server;
