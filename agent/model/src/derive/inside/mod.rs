//! Figures from inside processes: what no wire shows.
//!
//! A source of uprobes reports calls of `libtracetools.so` once a second ([`report::Report`]).
//! [`Inside`] adds them up per topic and finds their nodes; [`facts`] are what a snapshot shows.
//! The counts of a topic come from the network or from inside, never from both: [`source`].

mod additions;
mod attribution;
mod findings;
pub mod reader_queue;
mod reader_queues;
pub mod source;
mod state;
mod topics;
mod tracked;
mod witness;

pub use state::Inside;
