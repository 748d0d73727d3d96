//! Shared code of the tests, benchmarks and examples of `ros2probe`; not shipped.
//!
//! - [`harness`] starts agents and DDS peers in network namespaces.
//! - [`local_agent`] starts an agent on a capture without any privilege.
//! - [`forged`] sends RTPS messages that no real participant sends.
//! - [`viewer`] is a client of the Foxglove WebSocket protocol.
//! - [`model`] builds RTPS messages for a model in virtual time.
//!
//! If a tool is missing, the modules fail and name the package to install.
#![allow(
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::panic,
    clippy::indexing_slicing,
    reason = "a test that meets the unexpected has failed"
)]
#![allow(missing_docs, reason = "fields and short methods of test code say it")]

pub mod bag_messages;
pub mod bag_readers;
pub mod dashboard;
pub mod forged;
pub mod harness;
pub mod local_agent;
pub mod model;
pub mod ports;
pub mod program_run;
pub mod pseudo_terminal;
pub mod remote_write;
pub mod robot_diagnostics;
pub mod robot_log;
pub mod robot_parameters;
pub mod robot_pictures;
pub mod robot_states;
pub mod robot_transforms;
pub mod rotel;
pub mod s3;
pub mod sample_robot;
pub mod truth;
pub mod type_description;
pub mod viewer;
pub mod zenoh;

use std::path::{Path, PathBuf};

/// Returns the directory of the whole corpus of captures, named by `ROS2PROBE_FIXTURES` (`make
/// test-corpus`).
///
/// # Panics
///
/// Panics if the directory does not exist: a test that needs it must not pass without it.
#[must_use]
pub fn corpus() -> PathBuf {
    let named = std::env::var_os("ROS2PROBE_FIXTURES").map(PathBuf::from);
    let corpus = named.unwrap_or_else(|| repository("../shared/fixtures"));
    assert!(
        corpus.is_dir(),
        "no captures in {}: name their directory in ROS2PROBE_FIXTURES",
        corpus.display()
    );
    corpus
}

/// Returns the path of a file of the repository, given its path from the root.
#[must_use]
pub fn repository(path: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR"))
        .join("../..")
        .join(path)
}

/// Returns all permutations of these items.
#[must_use]
pub fn permutations<T: Copy>(items: &[T]) -> Vec<Vec<T>> {
    let Some((first, rest)) = items.split_first() else {
        return vec![Vec::new()];
    };
    let mut all = Vec::new();
    for order in permutations(rest) {
        for place in 0..=order.len() {
            let mut order = order.clone();
            order.insert(place, *first);
            all.push(order);
        }
    }
    all
}
