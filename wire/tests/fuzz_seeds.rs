//! Runs the fuzz targets' entry functions over their seeds and all truncations of them, so that
//! their checks run without a fuzzer. Of the seeds, `found-*` were found by fuzzing: kept for
//! what they reach, and taken as they are.

#![expect(
    clippy::unwrap_used,
    clippy::indexing_slicing,
    reason = "a failed expectation may panic"
)]

#[path = "../fuzz/src/lib.rs"]
mod entry;

use std::fs;
use std::path::Path;

/// Every seed in a directory, every truncation of it, and every byte of it changed.
fn run(directory: &str, entry: fn(&[u8])) {
    let directory = Path::new(env!("CARGO_MANIFEST_DIR")).join(directory);
    let mut count = 0;
    for seed in fs::read_dir(directory).unwrap() {
        let seed = seed.unwrap();
        let mut bytes = fs::read(seed.path()).unwrap();
        count += 1;
        entry(&bytes);
        if seed.file_name().to_string_lossy().starts_with("found-") {
            continue;
        }
        bytes.truncate(1500);
        for length in 0..bytes.len() {
            entry(&bytes[..length]);
        }
        for position in 0..bytes.len() {
            let byte = bytes[position];
            for changed in [0x00, 0xff, byte ^ 0x01, byte ^ 0x80] {
                bytes[position] = changed;
                entry(&bytes);
            }
            bytes[position] = byte;
        }
    }
    assert!(count > 0);
}

#[test]
fn datagrams_survive_and_the_walk_agrees_with_the_parser() {
    run("tests/data/datagrams", entry::datagram);
    run("fuzz/seeds/datagram", entry::datagram);
}

#[test]
fn discovery_samples_survive() {
    run("fuzz/seeds/discovery", entry::discovery);
}

#[test]
fn entities_survive() {
    run("fuzz/seeds/entities", entry::entities);
}

#[test]
fn zenoh_batches_survive() {
    run("fuzz/seeds/zenoh", entry::zenoh);
}
