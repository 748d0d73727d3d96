//! Documents name files that exist.
#![allow(
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::panic,
    reason = "a test that meets the unexpected has failed"
)]

use std::fs;
use std::path::Path;

use ros2probe_testing::repository;

/// Paths of the Rust sources below a folder, `/` before each name.
fn sources(folder: &Path, into: &mut Vec<String>) {
    for entry in fs::read_dir(folder).unwrap() {
        let path = entry.unwrap().path();
        let is_output = path.file_name().is_some_and(|name| name == "target");
        if path.is_dir() && !is_output {
            sources(&path, into);
        } else if path.extension().is_some_and(|end| end == "rs") {
            into.push(path.to_str().unwrap().to_owned());
        }
    }
}

#[test]
fn every_source_that_a_document_names_exists() {
    let mut paths = Vec::new();
    for folder in ["agent", "agent-ebpf", "wire"] {
        sources(&repository(folder), &mut paths);
    }
    let mut named = 0;
    for document in [
        "ARCHITECTURE.md",
        "GLOSSARY.md",
        "README.md",
        "docs/limits.md",
    ] {
        let text = fs::read_to_string(repository(document)).unwrap();
        for file in text.split('`').skip(1).step_by(2) {
            if !file.ends_with(".rs") || file.contains([' ', '*']) {
                continue;
            }
            let end = format!("/{file}");
            let exists = paths.iter().any(|path| path.ends_with(&end));
            assert!(exists, "{document} names {file}, which does not exist");
            named += 1;
        }
    }
    assert!(named > 40, "{named} names");
}
