//! `rp bag`: captures made into bags, and what it prints of real ones.

mod captures;
mod real;

use std::fs;
use std::path::Path;

use ros2probe_bag::metadata::Metadata;

fn metadata(directory: &Path) -> Metadata {
    let text = fs::read_to_string(directory.join("metadata.yaml")).unwrap();
    Metadata::read(&text).unwrap()
}
