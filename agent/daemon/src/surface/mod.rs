//! Interfaces for people and machines: metrics, health and the control API over HTTP, based on
//! immutable snapshots. The capture never waits for them.

mod agent_metrics;
pub mod api;
pub mod authority;
mod basic_auth;
mod chain_metrics;
mod collect;
mod compressed_text;
mod connection;
mod delivery_metrics;
mod diagnosis_metrics;
#[cfg(test)]
mod export_queue_tests;
#[cfg(test)]
mod export_tests;
pub mod field_metrics;
pub mod foxglove;
pub mod http;
mod inside_metrics;
mod inside_nodes;
mod large_responses;
mod limited_listener;
mod link_metrics;
mod listen;
mod places;
mod process;
mod robot_metrics;
pub mod ros2_daemon;
mod ros2_metrics;
mod service_metrics;
mod serving;
mod tls;
pub mod web_config;
mod zenoh_metrics;

pub use collect::MetricSources;
pub use ros2probe_metrics::exposition::{Exposition, Format};
