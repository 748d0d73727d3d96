//! The snapshot: the state at one moment.

pub mod snapshot;
pub(crate) mod transport;
