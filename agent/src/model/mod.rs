//! The core: a plain state machine. Time and bytes in, facts out; no I/O, no clock, no thread.

pub mod ahead;
pub mod header;
pub mod histogram;
pub mod journal;
pub mod rate;
pub mod reassembly;
pub mod samples;
pub mod sequence;
pub mod snapshot;
pub mod writer;
