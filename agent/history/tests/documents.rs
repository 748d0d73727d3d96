//! Documents: their versions after restarts, damage, steps of the clock, and within the budget.

#![allow(
    clippy::unwrap_used,
    clippy::indexing_slicing,
    reason = "a failed test may panic"
)]

use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};

use proptest::prelude::*;
use ros2probe_history::{Document, Store};

const LIMIT: u64 = 8 << 20;

fn document(name: &str, content: impl Into<Vec<u8>>) -> Document {
    Document {
        name: name.to_owned(),
        content: content.into(),
    }
}

/// Returns what a node has as parameters, one of which has this value.
fn parameters(value: u32) -> Document {
    let rows = (0..200).map(|each| {
        let value = if each == 77 { value } else { each * 31 };
        format!(r#"{{"ros_node":"/planner","name":"weight_{each}","value":"{value}"}}"#)
    });
    let rows: Vec<_> = rows.collect();
    document(
        "parameters",
        format!(r#"{{"parameters":[{}]}}"#, rows.join(",")),
    )
}

fn append(store: &Store, minute: u32, documents: Vec<Document>) {
    let end = minute * 60 + 60;
    let documents = documents.into_iter();
    store.append_documents(end - 60, end, documents).unwrap();
}

fn content(store: &Store, name: &str, time: u32) -> Option<Vec<u8>> {
    store.document(name, time).map(|version| version.content)
}

fn files(directory: &Path) -> Vec<PathBuf> {
    let mut files: Vec<_> = fs::read_dir(directory)
        .unwrap()
        .map(|entry| entry.unwrap().path())
        .collect();
    files.sort();
    files
}

fn size(directory: &Path) -> u64 {
    let files = files(directory);
    files
        .iter()
        .map(|file| file.metadata().unwrap().len())
        .sum()
}

#[test]
fn a_document_is_as_it_was_before_it_changed_also_after_a_restart() {
    let directory = tempfile::tempdir().unwrap();
    let store = Store::open(directory.path(), LIMIT).unwrap();
    append(&store, 0, vec![parameters(1), document("clocks", "{}")]);
    append(&store, 1, vec![parameters(2), document("clocks", "{}")]);
    drop(store);
    let store = Store::open(directory.path(), LIMIT).unwrap();
    append(&store, 2, vec![parameters(3)]);
    append(&store, 3, vec![parameters(3)]);
    drop(store);
    let store = Store::open(directory.path(), LIMIT).unwrap();
    for (time, value) in [(60, 1), (119, 1), (120, 2), (179, 2), (180, 3), (9_999, 3)] {
        let version = store.document("parameters", time).unwrap();
        assert_eq!(version.content, parameters(value).content, "{time}");
        assert_eq!(version.at, time.min(240) / 60 * 60);
    }
    assert_eq!(store.document("parameters", 59), None);
    assert_eq!(content(&store, "clocks", 179).as_deref(), Some(&b"{}"[..]));
    // The agent that started later did not keep it.
    assert_eq!(store.document("clocks", 180), None);
    assert_eq!(store.document("logs", 180), None);
    assert_eq!(store.facts().documents.map(|span| span.end), Some(240));
}

#[test]
fn a_document_that_does_not_change_is_stored_once() {
    let directory = tempfile::tempdir().unwrap();
    let store = Store::open(directory.path(), LIMIT).unwrap();
    append(&store, 0, vec![parameters(1)]);
    let first = size(directory.path());
    for minute in 1..60 {
        append(&store, minute, vec![parameters(1)]);
    }
    let unchanged = (size(directory.path()) - first) / 59;
    assert!(unchanged <= 24, "{unchanged} bytes");
    let before = size(directory.path());
    append(&store, 60, vec![parameters(2)]);
    let changed = size(directory.path()) - before;
    assert!(changed <= 90, "{changed} bytes of {first}");
}

/// Returns a mixed number.
const fn mixed(number: u32) -> u32 {
    let number = number.wrapping_mul(2_654_435_761);
    (number ^ (number >> 15)).wrapping_mul(2_246_822_519)
}

/// Returns the last 1000 messages up to this number.
fn logs(last: u32) -> Document {
    const WORDS: [&str; 8] = [
        "goal", "battery", "timeout", "retry", "path", "planner", "map", "failed",
    ];
    let message = |number: u32| {
        let words = (0..9).map(|place| WORDS[(mixed(number * 9 + place) >> 29) as usize]);
        let words: Vec<_> = words.collect();
        let stamp = format!(r#""stamp_sec":{number},"stamp_nanosec":{}"#, mixed(number));
        let text = format!("{} {}", words.join(" "), mixed(number + 7) % 1_000);
        let node = format!(r#""ros_node":"/node_{}""#, mixed(number + 9) % 30);
        let place = format!(r#""file":"node.cpp","line":{}"#, mixed(number + 11) % 900);
        format!(r#"{{{stamp},{node},"text":"{text}",{place},"sequence_number":{number}}}"#)
    };
    let messages: Vec<_> = (last - 1_000..last).map(message).collect();
    let text = format!(r#"{{"messages":[{}]}}"#, messages.join(","));
    document("logs", text)
}

#[test]
fn a_message_of_a_log_is_stored_once() {
    let directory = tempfile::tempdir().unwrap();
    let store = Store::open(directory.path(), LIMIT).unwrap();
    append(&store, 0, vec![logs(1_000)]);
    let before = size(directory.path());
    for minute in 1..=10 {
        append(&store, minute, vec![logs(1_000 + minute * 60)]);
    }
    let each = (size(directory.path()) - before) / 600;
    assert!((20..=90).contains(&each), "{each} bytes");
    assert_eq!(content(&store, "logs", 360), Some(logs(1_300).content));
}

#[test]
fn the_oldest_documents_are_deleted_beyond_their_sixth_of_the_limit() {
    let directory = tempfile::tempdir().unwrap();
    let limit = 4 << 20;
    let store = Store::open(directory.path(), limit).unwrap();
    let random = |seed: u32| {
        let words = (0..1_000).map(|place| mixed(place + seed).to_string());
        document("logs", words.collect::<Vec<_>>().join(","))
    };
    for minute in 0..400 {
        append(&store, minute, vec![random(minute * 1_000)]);
        assert!(size(directory.path()) <= limit / 6);
    }
    assert!(size(directory.path()) > limit / 8);
    assert_eq!(store.document("logs", 60), None);
    let last = content(&store, "logs", 400 * 60);
    assert_eq!(last, Some(random(399 * 1_000).content));
}

#[test]
fn a_document_without_room_is_left_out_and_the_others_are_kept() {
    let directory = tempfile::tempdir().unwrap();
    let store = Store::open(directory.path(), 256 << 20).unwrap();
    let large = || document("topics", vec![b'x'; (4 << 20) - 100]);
    append(&store, 0, vec![large(), document("logs", "small")]);
    append(
        &store,
        1,
        vec![
            document("logs", vec![b'y'; 101]),
            large(),
            document("clocks", "{}"),
        ],
    );
    assert_eq!(content(&store, "topics", 60), Some(large().content));
    assert_eq!(content(&store, "logs", 60).as_deref(), Some(&b"small"[..]));
    assert_eq!(content(&store, "topics", 120), None);
    assert_eq!(content(&store, "logs", 120), Some(vec![b'y'; 101]));
    assert_eq!(content(&store, "clocks", 120).as_deref(), Some(&b"{}"[..]));
}

#[test]
fn after_a_step_back_of_the_clock_a_new_file_has_whole_documents() {
    let directory = tempfile::tempdir().unwrap();
    let store = Store::open(directory.path(), LIMIT).unwrap();
    for minute in 100..110 {
        append(&store, minute, vec![parameters(minute)]);
    }
    for minute in 105..107 {
        append(&store, minute, vec![parameters(1_000 + minute)]);
    }
    assert_eq!(files(directory.path()).len(), 2);
    let last = content(&store, "parameters", 107 * 60);
    assert_eq!(last, Some(parameters(1_106).content));
    let before = content(&store, "parameters", 104 * 60);
    assert_eq!(before, Some(parameters(103).content));
}

#[test]
fn a_file_that_was_deleted_is_replaced_by_one_with_whole_documents() {
    let directory = tempfile::tempdir().unwrap();
    let store = Store::open(directory.path(), LIMIT).unwrap();
    append(&store, 0, vec![parameters(1)]);
    fs::remove_file(&files(directory.path())[0]).unwrap();
    append(&store, 1, vec![parameters(2)]);
    append(&store, 2, vec![parameters(3)]);
    let store = Store::open(directory.path(), LIMIT).unwrap();
    for (time, value) in [(120, 2), (180, 3)] {
        assert_eq!(
            content(&store, "parameters", time),
            Some(parameters(value).content)
        );
    }
}

/// What each document was like after each minute.
type Minutes = Vec<BTreeMap<usize, Vec<u16>>>;

const NAMES: [&str; 3] = ["logs", "parameters", "topics"];

fn minutes() -> impl Strategy<Value = Minutes> {
    let rows = prop::collection::vec(0..40_u16, 0..12);
    let documents = prop::collection::btree_map(0..NAMES.len(), rows, 0..=NAMES.len());
    prop::collection::vec(documents, 1..20)
}

fn text(rows: &[u16]) -> Vec<u8> {
    let rows = rows
        .iter()
        .map(|row| format!(r#"{{"id":{row},"ok":true}}"#));
    format!("[{}]", rows.collect::<Vec<_>>().join(",")).into_bytes()
}

/// Writes these minutes, and opens the store again after some of them.
fn write(directory: &Path, minutes: &Minutes, restarts: &[prop::sample::Index]) {
    let restarts: Vec<_> = restarts.iter().map(|it| it.index(minutes.len())).collect();
    let mut store = Store::open(directory, LIMIT).unwrap();
    for (minute, documents) in minutes.iter().enumerate() {
        if restarts.contains(&minute) {
            store = Store::open(directory, LIMIT).unwrap();
        }
        let documents = documents.iter();
        let documents = documents.map(|(name, rows)| document(NAMES[*name], text(rows)));
        append(&store, u32::try_from(minute).unwrap(), documents.collect());
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(64))]

    #[test]
    fn any_versions_are_read_as_they_were_written(
        minutes in minutes(),
        restarts in prop::collection::vec(any::<prop::sample::Index>(), 0..3),
    ) {
        let directory = tempfile::tempdir().unwrap();
        write(directory.path(), &minutes, &restarts);
        let store = Store::open(directory.path(), LIMIT).unwrap();
        for (minute, documents) in minutes.iter().enumerate() {
            let time = u32::try_from(minute).unwrap() * 60 + 60;
            for (place, name) in NAMES.iter().enumerate() {
                let expected = documents.get(&place).map(|rows| text(rows));
                prop_assert_eq!(content(&store, name, time + 59), expected);
            }
        }
    }

    #[test]
    fn damage_hides_versions_and_changes_none(
        minutes in minutes(),
        place in any::<prop::sample::Index>(),
        value: u8,
    ) {
        let directory = tempfile::tempdir().unwrap();
        write(directory.path(), &minutes, &[]);
        let file = files(directory.path()).remove(0);
        let mut bytes = fs::read(&file).unwrap();
        let place = place.index(bytes.len());
        bytes[place] = value;
        fs::write(&file, bytes).unwrap();
        let store = Store::open(directory.path(), LIMIT).unwrap();
        for (minute, documents) in minutes.iter().enumerate() {
            let time = u32::try_from(minute).unwrap() * 60 + 60;
            for (place, name) in NAMES.iter().enumerate() {
                // Only the time of the version proves which minutes it describes.
                let found = store.document(name, time).filter(|found| found.at == time);
                if let Some(found) = found {
                    let expected = documents.get(&place).map(|rows| text(rows));
                    prop_assert_eq!(Some(found.content), expected);
                }
            }
        }
    }
}
