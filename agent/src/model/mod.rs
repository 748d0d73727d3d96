//! The core: a plain state machine. Time and bytes in, facts out; no I/O, no clock, no thread.

pub mod ahead;
pub mod cause;
pub mod churn;
pub mod discovery;
pub mod expectation;
pub mod header;
pub mod histogram;
pub mod interest;
pub mod journal;
pub mod observer;
pub mod pieces;
pub mod profiler;
pub mod rate;
pub mod reassembly;
pub mod reception;
mod report;
pub mod samples;
pub mod sequence;
pub mod snapshot;
pub mod sockets;
pub mod topic;
pub mod writer;
