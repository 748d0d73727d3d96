//! The shipped files: binaries, packages, the systemd unit and `deploy/`.
#![allow(
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::panic,
    clippy::indexing_slicing,
    reason = "a test that meets the unexpected has failed"
)]

mod ansible;
mod binaries;
mod chart;
mod crates;
mod deploy;
mod licences;
mod package;
mod publish;
mod ros;
mod systemd;
