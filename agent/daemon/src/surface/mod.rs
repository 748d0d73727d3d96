//! Interfaces for people and machines: metrics, health and the control API over HTTP, based on
//! immutable snapshots. The capture never waits for them.

mod agent_metrics;
pub mod api;
mod authority;
mod basic_auth;
pub mod catalogue;
mod chain_metrics;
mod collect;
mod compressed_text;
mod connection;
mod delivery_metrics;
mod diagnosis_metrics;
mod exemplar_lines;
pub mod exposition;
pub mod foxglove;
pub mod http;
mod inside_metrics;
mod inside_nodes;
mod large_responses;
mod limited_listener;
mod listen;
mod metric_sink;
pub mod otlp;
mod places;
mod process;
pub mod ros2_daemon;
mod ros2_metrics;
mod service_metrics;
mod serving;
mod tls;
pub mod web_config;
mod zenoh_metrics;

pub use collect::MetricSources;
pub use exposition::{Exposition, Format};
