//! The tests that exceed each cap of docs/limits-*.md.

/// A line for each fixed cap: the constant or table, its file, the file of the test, and the test.
const FIXED: &str = include_str!("driven.txt");

/// Returns the constant or table of each fixed cap, its file, the file of the test, and the test.
pub fn fixed() -> Vec<[&'static str; 4]> {
    let words = |line: &'static str| line.split(' ').collect::<Vec<_>>().try_into();
    FIXED
        .lines()
        .map(words)
        .collect::<Result<_, _>>()
        .expect("four words")
}

/// Each key of `limits:`, and its test in tests/surface/limits.rs.
pub const KEYS: &[[&str; 2]] = &[
    [
        "participants",
        "participants_beyond_the_cap_are_left_out_until_one_leaves",
    ],
    [
        "endpoints",
        "endpoints_beyond_the_cap_are_left_out_until_one_is_removed",
    ],
    [
        "topics",
        "topics_beyond_the_cap_are_listed_but_not_measured_until_one_is_removed",
    ],
    [
        "unknown_writers",
        "unknown_writers_beyond_the_cap_are_not_followed_until_one_is_forgotten",
    ],
    [
        "flows",
        "flows_beyond_the_cap_are_tracked_once_others_expire",
    ],
    [
        "watches",
        "watches_beyond_the_cap_are_refused_for_clients_and_for_a_reload",
    ],
    [
        "reassembly_bytes",
        "fragments_beyond_the_cap_in_bytes_evict_the_oldest",
    ],
    [
        "payload_bytes",
        "messages_beyond_the_bytes_of_all_queues_evict_the_oldest_until_the_queue_is_read",
    ],
    [
        "subscriptions",
        "messages_beyond_the_bytes_of_all_queues_evict_the_oldest_until_the_queue_is_read",
    ],
    [
        "recordings",
        "recordings_beyond_the_cap_are_refused_until_one_ends",
    ],
    [
        "api_clients",
        "clients_beyond_the_cap_are_refused_until_one_leaves",
    ],
    [
        "metrics_clients",
        "clients_beyond_the_cap_are_refused_until_one_leaves",
    ],
    [
        "foxglove_clients",
        "viewers_beyond_the_cap_are_refused_until_one_leaves",
    ],
];
