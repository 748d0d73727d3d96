//! The core: a plain state machine. Time and bytes in, facts out; no I/O, no clock, no thread.

pub mod ahead;
pub mod histogram;
pub mod reassembly;
pub mod snapshot;
