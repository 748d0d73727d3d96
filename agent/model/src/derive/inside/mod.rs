//! Figures from calls inside processes, which the network does not show.
//!
//! A source of uprobes reports calls of `libtracetools.so` once a second
//! ([`crate::facts::calls::report::Report`]). [`Inside`] adds them up per topic and finds their
//! nodes. Snapshots show them as [`crate::facts::calls::facts`]. The counts of a topic come from
//! the network or from inside processes, never from both: [`source`].

mod additions;
mod attribution;
mod findings;
mod late;
pub mod reader_queue;
mod reader_queues;
pub mod source;
mod state;
mod topics;
mod tracked;
mod witness;

pub use state::Inside;
