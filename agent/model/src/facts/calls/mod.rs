//! Calls inside processes, as values: reports of the uprobes, and what a snapshot shows.

pub mod durations;
pub mod facts;
pub mod late;
pub mod other_thread;
mod parts;
pub mod report;
