//! Runs the fuzz targets' entry functions over their seeds and all truncations, so their checks run
//! without a fuzzer too. Fuzzing found the seeds `found-*`: they are kept for their coverage,
//! unchanged.

#[path = "../../../fuzz/src/lib.rs"]
mod entry;

use std::fs;

/// Seeds longer than this are cut and changed only up to here.
const LENGTH: usize = 2_000;

/// Every seed in a directory, every truncation of it, and every byte of it changed.
fn run(directory: &str, entry: fn(&[u8])) {
    run_up_to(LENGTH, directory, entry);
}

fn run_up_to(length: usize, directory: &str, entry: fn(&[u8])) {
    let directory = ros2probe_testing::repository("agent").join(directory);
    let mut count = 0;
    for seed in fs::read_dir(directory).unwrap() {
        let seed = seed.unwrap();
        let mut bytes = fs::read(seed.path()).unwrap();
        count += 1;
        entry(&bytes);
        if seed.file_name().to_string_lossy().starts_with("found-") {
            continue;
        }
        bytes.truncate(length);
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
fn captures_survive() {
    run("fuzz/seeds/capture", entry::capture);
}

#[test]
fn ring_blocks_survive() {
    run("fuzz/seeds/ring_block", entry::ring_block);
}

#[test]
fn shared_memory_survives() {
    run("fuzz/seeds/shared_memory", entry::shared_memory);
}

#[test]
fn configurations_survive() {
    run("fuzz/seeds/configuration", entry::configuration);
}

#[test]
fn definitions_survive() {
    run("fuzz/seeds/definition", entry::definition);
}

#[test]
fn messages_survive() {
    run("fuzz/seeds/message", entry::message);
}

#[test]
fn filters_survive() {
    run("fuzz/seeds/filter", entry::filter);
}

#[test]
fn bags_survive() {
    // Each is written, read, made whole and read again.
    run_up_to(120, "fuzz/seeds/bag_file", entry::bag_file);
}

#[test]
fn messages_of_viewers_survive() {
    run("fuzz/seeds/viewer", entry::viewer);
}

#[test]
fn requests_of_ros2_survive() {
    run("fuzz/seeds/ros2_daemon", entry::ros2_daemon);
}

#[test]
fn libraries_survive_hostile_trees() {
    run("fuzz/seeds/library", entry::library);
}

#[test]
fn the_model_survives_any_input() {
    run_up_to(400, "fuzz/seeds/model", entry::model);
}
