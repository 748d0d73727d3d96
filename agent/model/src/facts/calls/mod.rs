//! Calls inside processes, as values: what the source of uprobes reports, and what a snapshot shows.

pub mod durations;
pub mod facts;
pub mod report;
