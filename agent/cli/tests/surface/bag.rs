//! `rp bag`: captures that are converted to bags, and the output for real bags.

mod captures;
mod real;

use std::fs;
use std::path::Path;

use ros2probe_bag::metadata::Metadata;

fn metadata(directory: &Path) -> Metadata {
    let text = fs::read_to_string(directory.join("metadata.yaml")).unwrap();
    Metadata::read(&text).unwrap()
}
