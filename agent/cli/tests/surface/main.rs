//! The agent's interfaces: API, metrics, configuration, command line, recordings and bags. `rp`
//! replays captures on free ports of this host, without network namespaces or DDS participants.
#![allow(
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::panic,
    clippy::indexing_slicing,
    reason = "a test that meets the unexpected has failed"
)]

mod api;
mod api_types;
mod api_views;
mod attach;
mod bag;
mod bag_chains;
mod bag_replay;
mod caps;
mod chains;
mod ci;
mod cli;
mod config;
mod coverage;
mod dashboards;
mod discover;
mod discover_router;
mod doctor;
mod documents;
mod doors;
mod events;
mod exemplars;
mod fleet;
mod foxglove;
mod fuzz_seeds;
mod http;
mod inside;
mod learn;
mod limits;
mod metrics;
mod otlp;
mod otlp_captures;
mod otlp_parts;
mod otlp_tls;
mod page;
mod recordings;
mod remote_write;
mod replay;
mod ros2;
mod ros2_daemon;
mod rules;
mod samples;
mod ship;
mod top;
mod upgrade;
mod web_config;

use std::process::Command;

use serde::Serialize;
use serde::de::DeserializeOwned;
use serde_json::Value;

/// Returns a command that runs `rp` of this build in a clean environment.
fn rp() -> Command {
    ros2probe_testing::local_agent::rp(env!("CARGO_BIN_EXE_rp"))
}

/// Asserts that an answer of the API can be read as `T`, which serializes to the same JSON.
fn read_as<T: DeserializeOwned + Serialize>(answer: &Value) -> T {
    let typed: T = serde_json::from_value(answer.clone()).unwrap();
    assert_eq!(serde_json::to_value(&typed).unwrap(), *answer);
    typed
}
