//! Runs the functions of the fuzz targets over their seeds and all truncations of these, so that
//! the checks run without a fuzzer. The seeds `found-*` come from fuzzing. They are kept for the
//! code that they reach, and run unchanged.

#![expect(
    clippy::unwrap_used,
    clippy::indexing_slicing,
    reason = "a failed expectation may panic"
)]

#[path = "../fuzz/src/lib.rs"]
mod entry;

use std::fs;
use std::path::Path;

/// Runs `entry` on every seed in a directory, on every truncation of it, and with every byte
/// changed.
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
fn damaged_datagrams_pass_the_checks_and_walk_and_oracle_agree() {
    run("tests/data/datagrams", entry::datagram);
    run("fuzz/seeds/datagram", entry::datagram);
}

#[test]
fn damaged_discovery_samples_pass_the_checks() {
    run("fuzz/seeds/discovery", entry::discovery);
}

#[test]
fn damaged_entities_pass_the_checks() {
    run("fuzz/seeds/entities", entry::entities);
}

#[test]
fn damaged_zenoh_batches_pass_the_checks() {
    run("fuzz/seeds/zenoh", entry::zenoh);
}
