//! `rp` against an installed ROS 2 (`make test-ros2`).
#![allow(
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::panic,
    clippy::indexing_slicing,
    reason = "a test that meets the unexpected has failed"
)]

mod chains;
mod cost;
mod counting;
mod discover;
mod echo;
mod frames;
mod host;
mod incident;
mod inside;
mod installed;
mod large_data;
mod late;
mod learn;
mod packages;
mod quiet;
mod robot;
mod ros2_daemon;
mod said;
mod services;
mod zenoh;
