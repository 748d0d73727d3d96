//! The agent beside real DDS participants and a browser, in network namespaces. Needs root.
#![allow(
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::panic,
    clippy::indexing_slicing,
    reason = "a test that meets the unexpected has failed"
)]

mod api;
mod attach;
mod between_robots;
mod browser;
mod buffers;
mod ci;
mod clocks;
mod counts;
mod dashboards;
mod deploy;
mod diagnosis;
mod discovery;
mod endurance;
mod events;
mod farewell;
mod faults;
mod fidelity;
mod foxglove;
mod history;
mod host;
mod hostile;
mod inside;
mod interoperability;
mod late_start;
mod learn;
mod links;
mod otlp;
mod page;
mod peers_talk;
mod privilege;
mod prometheus;
mod rates;
mod record;
mod remote_write;
mod robot;
mod robot_parts;
mod rtps_tcp;
mod samples;
mod shm;
mod shm_exact;
mod sources;
mod start_orders;
mod tcx;
mod type_objects;
mod unnoticed;

use std::process::Command;

/// Returns `rp` of this build, with an environment that is independent of the tests' own.
fn rp() -> Command {
    ros2probe_testing::local_agent::rp(env!("CARGO_BIN_EXE_rp"))
}
