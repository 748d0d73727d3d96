//! Runs the entry functions of the fuzz targets over their seeds, so that their checks also run
//! without a fuzzer. Fuzzing found the seeds `found-*`. They are kept for their coverage and are
//! not changed.

#[path = "../../../fuzz/src/lib.rs"]
mod entry;

use std::fs;

/// Maximum number of bytes of a seed that are truncated and changed.
const LENGTH: usize = 2_000;

/// Runs the entry function over every seed in a directory, every truncation, and with every byte
/// changed.
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
fn seeds_of_captures_cause_no_panic() {
    run("fuzz/seeds/capture", entry::capture);
}

#[test]
fn seeds_of_ring_blocks_cause_no_panic() {
    run("fuzz/seeds/ring_block", entry::ring_block);
}

#[test]
fn seeds_of_shared_memory_cause_no_panic() {
    run("fuzz/seeds/shared_memory", entry::shared_memory);
}

#[test]
fn seeds_of_configurations_cause_no_panic() {
    run("fuzz/seeds/configuration", entry::configuration);
}

#[test]
fn seeds_of_definitions_cause_no_panic() {
    run("fuzz/seeds/definition", entry::definition);
}

#[test]
fn seeds_of_messages_cause_no_panic() {
    run("fuzz/seeds/message", entry::message);
}

#[test]
fn seeds_of_type_objects_cause_no_panic() {
    run("fuzz/seeds/type_objects", entry::type_objects);
}

#[test]
fn seeds_of_filters_cause_no_panic() {
    run("fuzz/seeds/filter", entry::filter);
}

#[test]
fn seeds_of_bags_cause_no_panic() {
    // Each bag is written, read, repaired and read again.
    run_up_to(120, "fuzz/seeds/bag_file", entry::bag_file);
}

#[test]
fn seeds_of_messages_of_viewers_cause_no_panic() {
    run("fuzz/seeds/viewer", entry::viewer);
}

#[test]
fn seeds_of_requests_of_ros2_cause_no_panic() {
    run("fuzz/seeds/ros2_daemon", entry::ros2_daemon);
}

#[test]
fn seeds_of_library_trees_cause_no_panic() {
    run("fuzz/seeds/library", entry::library);
}

#[test]
fn stream_fuzz_seeds_do_not_panic() {
    run_up_to(700, "fuzz/seeds/stream", entry::stream);
}

#[test]
fn seeds_of_the_model_cause_no_panic() {
    run_up_to(400, "fuzz/seeds/model", entry::model);
}
