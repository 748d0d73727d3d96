//! The metrics of an agent: their declarations, pages of them, and exports over OTLP and Prometheus
//! remote write.
//!
//! - [`catalogue`] declares each metric once. [`metric_sink`] accepts their samples.
//! - [`exposition`] writes a page for a scrape.
//! - [`otlp`] pushes metrics, events, spans and the log to a receiver.
//! - [`remote_write`] pushes metrics to a receiver, with a queue on disk.
//! - [`export_thread`] is the thread of each of the two.
//! - [`metric_source`] and [`event`] are the interfaces through which pages and exports read an
//!   agent.
//!
//! This crate knows neither the configuration file nor privileges. The caller translates settings,
//! and passes a function that starts the threads of exports.

#![forbid(unsafe_code)]

pub mod catalogue;
mod connector;
pub mod event;
mod exemplar_lines;
pub mod export_thread;
pub mod exposition;
pub mod metric_sink;
pub mod metric_source;
pub mod otlp;
pub mod remote_write;
pub mod series_name;
pub mod stability;
pub mod tables;
