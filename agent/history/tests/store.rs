//! The store: budgets, damage, restarts, clocks that are set.

#![allow(
    clippy::unwrap_used,
    clippy::indexing_slicing,
    reason = "a failed test may panic"
)]

use std::fs;
use std::path::{Path, PathBuf};

use proptest::prelude::*;
use ros2probe_history::{
    Block, Document, Kind, ProcessName, ProcessRow, Series, Store, Tier, TopicName, TopicRow,
    merged,
};

const LIMIT: u64 = 8 << 20;

fn points() -> TopicName {
    TopicName {
        domain_id: 0,
        dds_name: "rt/points".into(),
    }
}

fn row(at: u32) -> TopicRow {
    TopicRow {
        at,
        seconds: 1,
        messages: 100 + at % 7,
        lost: u32::from(at.is_multiple_of(13)),
        bytes: u64::from(100 + at % 7) * 320,
        latency: Some([0.5, 2.0]),
        interarrival: None,
    }
}

/// Returns the block of one minute, with a row for each second.
fn minute(begin: u32) -> Vec<Block> {
    let rows = (begin + 1..=begin + 60).map(row).collect();
    let usage = ProcessRow {
        at: begin + 60,
        seconds: 60,
        cpu_ms: 700,
        memory_kib: 9000,
    };
    let robot = ProcessName {
        id: 7,
        name: "robot.py".into(),
    };
    let process = Series {
        of: robot,
        rows: vec![usage],
    };
    let text = |kind, text: String| Block {
        kind,
        begin,
        end: begin + 60,
        content: text.into_bytes(),
    };
    vec![
        Block::of_topics(begin, begin + 60, &[Series { of: points(), rows }]),
        Block::of_processes(begin, begin + 60, &[process]),
        text(Kind::State, format!("state {begin}")),
        text(Kind::Events, format!("event {begin}\n")),
    ]
}

fn filled(directory: &Path, limit: u64, minutes: std::ops::Range<u32>) -> Store {
    let store = Store::open(directory, limit).unwrap();
    for minute_of in minutes {
        store
            .append(Tier::Seconds, &minute(minute_of * 60))
            .unwrap();
        store.condense(minute_of * 60 + 60).unwrap();
    }
    store
}

fn rows(store: &Store, times: std::ops::Range<u32>, step: u32) -> Vec<TopicRow> {
    let mut seen = Vec::new();
    store.topics(times, step, &|name| *name == points(), &mut |_, row| {
        seen.push(row);
    });
    seen
}

fn files(directory: &Path) -> Vec<PathBuf> {
    let entries = fs::read_dir(directory).unwrap();
    let mut files: Vec<_> = entries.map(|entry| entry.unwrap().path()).collect();
    files.sort();
    files
}

#[test]
fn rows_exist_at_both_resolutions_after_a_restart() {
    let directory = tempfile::tempdir().unwrap();
    let store = filled(directory.path(), LIMIT, 1000..1075);
    let expected: Vec<_> = (60_001..=64_500).map(row).collect();
    for store in [store, Store::open(directory.path(), LIMIT).unwrap()] {
        assert_eq!(rows(&store, 60_000..64_500, 1), expected);
        // The last minutes are not condensed yet.
        let (condensed, rest) = expected.split_at(64_200 - 60_000);
        let mut tens = merged(condensed, 10);
        tens.extend(rest);
        assert_eq!(rows(&store, 60_000..64_500, 10), tens);
        assert_eq!(rows(&store, 60_100..60_102, 1), [row(60_101), row(60_102)]);
        let state = store.state(61_000).unwrap();
        assert_eq!((&*state.content, state.end), (&b"state 60900"[..], 60_960));
        assert_eq!(store.state_end(61_000), Some(60_960));
        assert!(store.state(60_059).is_none() && store.state_end(60_059).is_none());
        let mut usage = Vec::new();
        store.processes(60_000..64_500, 10, &|_| true, &mut |_, row| usage.push(row));
        assert_eq!(usage.len(), 75);
        assert!(
            usage
                .iter()
                .all(|row| row.seconds == 60 && row.cpu_ms == 700)
        );
        let mut events = String::new();
        store.events(60_000..64_500, &mut |text| {
            events += str::from_utf8(text).unwrap();
        });
        let each = (1000..1075).map(|minute| format!("event {}\n", minute * 60));
        assert_eq!(events, each.collect::<String>());
    }
}

#[test]
fn blocks_across_the_border_of_ten_minutes_lose_nothing() {
    for first in [60_001, 60_037, 60_599] {
        let directory = tempfile::tempdir().unwrap();
        let store = Store::open(directory.path(), LIMIT).unwrap();
        let begins = (0..45).map(|minute| first + minute * 60);
        let mut events = String::new();
        for begin in begins {
            store.append(Tier::Seconds, &minute(begin)).unwrap();
            store.condense(begin + 60).unwrap();
            events += &format!("event {begin}\n");
            let expected: u32 = (first + 1..=begin + 60).map(|at| row(at).messages).sum();
            for step in [1, 10, 60] {
                let rows = rows(&store, 0..begin + 60, step);
                let seen: u32 = rows.iter().map(|row| row.messages).sum();
                assert_eq!(seen, expected, "{first} {begin} {step}");
            }
            let mut seen = String::new();
            store.events(0..begin + 60, &mut |text| {
                seen += str::from_utf8(text).unwrap();
            });
            assert_eq!(seen, events, "{first} {begin}");
        }
    }
}

#[test]
fn the_oldest_history_is_deleted_beyond_the_limit_and_tens_reach_further() {
    let directory = tempfile::tempdir().unwrap();
    let limit = 120 << 10;
    let store = filled(directory.path(), limit, 0..4_000);
    let size: u64 = files(directory.path())
        .iter()
        .map(|file| file.metadata().unwrap().len())
        .sum();
    let facts = store.facts();
    assert_eq!((facts.bytes, facts.limit), (size, limit));
    assert!(size <= limit && size > limit / 2, "{size}");
    let (seconds, tens) = (facts.seconds.unwrap(), facts.tens.unwrap());
    assert_eq!(seconds.end, 240_000);
    assert!(tens.begin < seconds.begin && seconds.begin > 0, "{facts:?}");
    // Older rows than those of seconds come from the tens, without a gap or an overlap.
    let (border, end) = (seconds.begin, seconds.begin + 100);
    let found = rows(&store, border - 1000..end, 1);
    let covered: u32 = found.iter().map(|row| row.seconds).sum();
    assert_eq!((covered, found.len()), (1100, 200));
}

#[test]
fn a_time_without_an_agent_is_skipped() {
    let directory = tempfile::tempdir().unwrap();
    drop(filled(directory.path(), LIMIT, 0..15));
    let store = filled(directory.path(), LIMIT, 1_000_000..1_000_015);
    let found = rows(&store, 0..60_001_000, 10);
    // The second run condenses what the first run left. Its own last five minutes are not due.
    assert_eq!(found.len(), 60 + 30 + 60 + 300);
    let covered: u32 = found.iter().map(|row| row.seconds).sum();
    assert_eq!(covered, 1800);
}

#[test]
fn a_clock_that_was_in_the_future_does_not_end_the_history() {
    let directory = tempfile::tempdir().unwrap();
    drop(filled(directory.path(), LIMIT, 1000..1005));
    drop(filled(directory.path(), LIMIT, 30_000_000..30_000_015));
    let store = filled(directory.path(), LIMIT, 1005..1030);
    assert_eq!(rows(&store, 60_000..61_800, 1).len(), 1800);
    // The ten minutes in which the clock was set are in two parts.
    assert_eq!(rows(&store, 60_000..61_800, 10).len(), 180);
    assert_eq!(store.state(61_800).unwrap().content, b"state 61740");
}

#[test]
fn a_clock_that_was_some_minutes_ahead_hides_no_rows_of_the_right_time() {
    let directory = tempfile::tempdir().unwrap();
    drop(filled(directory.path(), LIMIT, 1000..1010));
    drop(filled(directory.path(), LIMIT, 1060..1090));
    let store = filled(directory.path(), LIMIT, 1040..1058);
    assert_eq!(rows(&store, 62_400..63_480, 1).len(), 1080);
    // Ten minutes are merged, and eight are not yet.
    assert_eq!(rows(&store, 62_400..63_480, 10).len(), 60 + 480);
}

fn messages(rows: &[TopicRow]) -> u32 {
    rows.iter().map(|row| row.messages).sum()
}

/// Returns the messages of all rows of these minutes.
fn expected(minutes: std::ops::Range<u32>) -> u32 {
    let seconds = minutes.start * 60 + 1..=minutes.end * 60;
    seconds.map(|at| row(at).messages).sum()
}

#[test]
fn after_a_clock_was_ahead_no_row_is_merged_twice() {
    let directory = tempfile::tempdir().unwrap();
    drop(filled(directory.path(), LIMIT, 0..480));
    drop(filled(directory.path(), LIMIT, 600..620));
    let store = filled(directory.path(), LIMIT, 500..960);
    let found = rows(&store, 0..480 * 60, 60);
    assert_eq!(messages(&found), expected(0..480));
    assert!(found.is_sorted_by(|one, two| one.at < two.at));
    // Both clocks had the minutes from 600 on.
    let found = rows(&store, 480 * 60..960 * 60, 60);
    assert_eq!(messages(&found), expected(500..960) + expected(600..620));
}

#[test]
fn rows_of_a_clock_that_was_set_back_into_written_hours_are_merged_once() {
    let directory = tempfile::tempdir().unwrap();
    drop(filled(directory.path(), LIMIT, 0..480));
    let store = filled(directory.path(), LIMIT, 400..490);
    let found = rows(&store, 0..490 * 60, 60);
    assert_eq!(messages(&found), expected(0..480) + expected(400..490));
}

#[test]
fn a_clock_that_is_set_back_by_seconds_merges_nothing_twice() {
    let directory = tempfile::tempdir().unwrap();
    let store = filled(directory.path(), LIMIT, 0..20);
    store.append(Tier::Seconds, &minute(1_130)).unwrap();
    store.condense(1_190).unwrap();
    let store = filled(directory.path(), LIMIT, 20..40);
    let found = rows(&store, 0..1_200, 60);
    assert_eq!(messages(&found), expected(0..20));
}

#[test]
fn the_first_write_creates_the_directory_with_owner_only_permissions() {
    use std::os::unix::fs::PermissionsExt as _;
    let parent = tempfile::tempdir().unwrap();
    let directory = parent.path().join("history");
    let store = Store::open(&directory, LIMIT).unwrap();
    assert!(!directory.exists() && store.facts().seconds.is_none());
    store.append(Tier::Seconds, &minute(60)).unwrap();
    let content = Document {
        name: "logs".into(),
        content: b"{}".to_vec(),
    };
    let documents = std::iter::once(content);
    store.append_documents(60, 120, documents).unwrap();
    let mode = |path: &Path| fs::metadata(path).unwrap().permissions().mode() & 0o777;
    assert_eq!(mode(&directory), 0o700);
    let files_of_all_tiers = files(&directory);
    assert_eq!(files_of_all_tiers.len(), 2);
    for file in files_of_all_tiers {
        assert_eq!(mode(&file), 0o600, "{}", file.display());
    }
    assert_eq!(rows(&store, 60..120, 1).len(), 60);
    // Nothing can be created below a file.
    let below = Store::open(&files(&directory)[0].join("history"), LIMIT);
    assert!(below.is_err() || below.unwrap().append(Tier::Seconds, &minute(60)).is_err());
}

#[test]
fn other_files_stay_untouched() {
    let directory = tempfile::tempdir().unwrap();
    let foreign = [
        ("notes.txt", "notes"),
        ("seconds-0000000001.history", "not a history"),
        ("tens-1.history.bak", "copy"),
        ("seconds.history", ""),
    ];
    for (name, text) in foreign {
        fs::write(directory.path().join(name), text).unwrap();
    }
    let store = filled(directory.path(), LIMIT, 0..3);
    assert_eq!(rows(&store, 0..180, 1).len(), 180);
    for (name, text) in foreign {
        let left = fs::read_to_string(directory.path().join(name)).unwrap();
        assert_eq!(left, text, "{name}");
    }
}

#[test]
fn a_symbolic_link_instead_of_a_file_is_not_followed() {
    let (directory, elsewhere) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
    drop(filled(elsewhere.path(), LIMIT, 0..3));
    let target = files(elsewhere.path()).remove(0);
    let link = directory.path().join("seconds-0000000000.history");
    std::os::unix::fs::symlink(&target, link).unwrap();
    let before = fs::read(&target).unwrap();
    let store = Store::open(directory.path(), LIMIT).unwrap();
    assert!(rows(&store, 0..180, 1).is_empty());
    assert!(store.append(Tier::Seconds, &minute(0)).is_err());
    assert_eq!(fs::read(&target).unwrap(), before);
}

#[test]
fn a_file_that_was_cut_anywhere_keeps_its_whole_blocks_and_is_continued() {
    let directory = tempfile::tempdir().unwrap();
    drop(filled(directory.path(), LIMIT, 0..3));
    let file = files(directory.path()).remove(0);
    let bytes = fs::read(&file).unwrap();
    for length in 0..bytes.len() {
        fs::write(&file, &bytes[..length]).unwrap();
        let store = Store::open(directory.path(), LIMIT).unwrap();
        let whole = rows(&store, 0..180, 1).len();
        assert!(whole.is_multiple_of(60) && whole < 180 || length > bytes.len() / 2);
        store.append(Tier::Seconds, &minute(180)).unwrap();
        for store in [store, Store::open(directory.path(), LIMIT).unwrap()] {
            assert_eq!(rows(&store, 0..240, 1).len(), whole + 60, "{length}");
        }
        for file in files(directory.path()) {
            fs::remove_file(file).unwrap();
        }
    }
}

#[test]
fn zeros_after_a_power_cut_are_no_blocks() {
    let directory = tempfile::tempdir().unwrap();
    let store = filled(directory.path(), LIMIT, 1000..1003);
    let (facts, state) = (store.facts(), store.state(60_180));
    drop(store);
    let file = files(directory.path()).remove(0);
    let mut bytes = fs::read(&file).unwrap();
    bytes.extend([0; 4096]);
    fs::write(&file, bytes).unwrap();
    let store = Store::open(directory.path(), LIMIT).unwrap();
    assert_eq!(store.facts(), facts);
    assert_eq!(rows(&store, 60_000..60_180, 1).len(), 180);
    assert_eq!(store.state(60_180), state);
    // The zeros are overwritten.
    store.append(Tier::Seconds, &minute(60_180)).unwrap();
    let store = Store::open(directory.path(), LIMIT).unwrap();
    assert_eq!(rows(&store, 60_000..60_240, 1).len(), 240);
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(300))]

    #[test]
    fn a_damaged_byte_invalidates_no_earlier_block(place: prop::sample::Index, value: u8) {
        let directory = tempfile::tempdir().unwrap();
        drop(filled(directory.path(), LIMIT, 0..3));
        let file = files(directory.path()).remove(0);
        let mut bytes = fs::read(&file).unwrap();
        let place = place.index(bytes.len());
        let minutes = place / (bytes.len() / 3 + 1);
        bytes[place] = value;
        fs::write(&file, &bytes).unwrap();
        let store = Store::open(directory.path(), LIMIT).unwrap();
        let found = rows(&store, 0..180, 1);
        let intact = if place < 8 { 0 } else { minutes.saturating_sub(1) };
        prop_assert!(found.len() >= intact * 60, "{} of {place}", found.len());
        prop_assert!(found.iter().all(|found| *found == row(found.at)));
        for time in [60, 119, 120, 180] {
            let state = store.state(time);
            prop_assert!(state.iter().all(|state| state.end <= time));
            prop_assert_eq!(store.state_end(time), state.map(|state| state.end));
        }
    }
}

#[test]
fn a_file_that_was_deleted_is_replaced_at_the_next_write() {
    let directory = tempfile::tempdir().unwrap();
    let store = filled(directory.path(), LIMIT, 1000..1015);
    for file in files(directory.path()) {
        fs::remove_file(file).unwrap();
    }
    for minute_of in 1015..1045 {
        store
            .append(Tier::Seconds, &minute(minute_of * 60))
            .unwrap();
        store.condense(minute_of * 60 + 60).unwrap();
    }
    assert_eq!(rows(&store, 60_900..62_700, 1).len(), 1800);
    let again = Store::open(directory.path(), LIMIT).unwrap();
    assert_eq!(rows(&again, 60_900..62_700, 1).len(), 1800);
}

/// Earlier, a file from before the network set the clock hid the merged rows of hours ago.
#[test]
fn a_file_of_an_unset_clock_does_not_hide_older_rows() {
    let directory = tempfile::tempdir().unwrap();
    drop(filled(directory.path(), LIMIT, 1000..1060));
    // The seconds of that hour were deleted for later ones.
    for file in files(directory.path()) {
        let name = file.file_name().unwrap().to_str().unwrap().to_owned();
        if name.contains("seconds") {
            fs::remove_file(file).unwrap();
        }
    }
    drop(filled(directory.path(), LIMIT, 0..3));
    let store = filled(directory.path(), LIMIT, 2000..2010);
    assert_eq!(store.begin_after(Tier::Seconds, 60_000), Some(120_000));
    assert!(!rows(&store, 60_000..61_000, 1).is_empty());
}
