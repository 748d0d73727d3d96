//! Reads bags with the PyPI readers `mcap` and `rosbags`.

use std::path::Path;
use std::process::Command;

use serde_json::Value;

use crate::repository;

/// Returns the results of both readers for each of these bags (`bag_readers.py` documents the
/// form).
#[must_use]
pub fn read_by_others(bags: &[&Path]) -> Vec<Value> {
    let python = repository("target/tools/bags/bin/python");
    let output = Command::new(&python)
        .arg(repository("agent/testing/src/bag_readers.py"))
        .args(bags)
        .output()
        .unwrap_or_else(|error| panic!("{}: {error}; run `make prerequisites`", python.display()));
    let stderr = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{stderr}");
    serde_json::from_slice(&output.stdout).unwrap()
}
