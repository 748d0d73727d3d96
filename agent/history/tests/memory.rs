//! Memory of writing: a minute of as many topics as may be measured.

#![allow(clippy::unwrap_used, reason = "a failed test may panic")]

use std::fs;

use ros2probe_history::{Block, Document, Kind, Series, Store, Tier, TopicName, TopicRow};

/// Default of `limits.topics`.
const TOPICS: u32 = 1000;
/// Documented memory without events, in KiB (docs/limits.md).
const ALLOWED: u64 = 6 << 10;
/// Documented memory of documents, in KiB (docs/limits.md).
const ALLOWED_FOR_DOCUMENTS: u64 = 14 << 10;
/// Maximum length of all documents, in bytes.
const DOCUMENTS: usize = 4 << 20;
/// Length of a large state, in bytes, and memory for its end, in KiB.
const STATE: usize = 32 << 20;
const ALLOWED_FOR_END: u64 = 1 << 10;

fn minute(begin: u32) -> Vec<Series<TopicName, TopicRow>> {
    let series = |topic| Series {
        of: TopicName {
            domain_id: 0,
            dds_name: format!("rt/robot/part_{topic:04}/data_raw"),
        },
        rows: (begin + 1..=begin + 60)
            .map(|at| TopicRow {
                at,
                seconds: 1,
                messages: at.wrapping_mul(topic) % 1000,
                ..TopicRow::default()
            })
            .collect(),
    };
    (0..TOPICS).map(series).collect()
}

/// Returns the most memory that this process has had, in KiB.
fn peak() -> u64 {
    let status = fs::read_to_string("/proc/self/status").unwrap();
    let line = status.lines().find_map(|line| line.strip_prefix("VmHWM:"));
    let number = line.unwrap().split_whitespace().next().unwrap();
    number.parse().unwrap()
}

#[test]
fn a_minute_of_all_topics_is_written_within_the_documented_memory() {
    let directory = tempfile::tempdir().unwrap();
    let store = Store::open(directory.path(), 64 << 20).unwrap();
    store
        .append(Tier::Seconds, &[Block::of_topics(0, 1, &[])])
        .unwrap();
    let before = peak();
    for begin in (60..=1200).step_by(60) {
        let block = Block::of_topics(begin, begin + 60, &minute(begin));
        store.append(Tier::Seconds, &[block]).unwrap();
        store.condense(begin + 60).unwrap();
    }
    let most = peak() - before;
    println!("{most} KiB");
    assert!(most <= ALLOWED, "{most} KiB");
}

#[test]
fn the_largest_documents_are_written_within_the_documented_memory() {
    let directory = tempfile::tempdir().unwrap();
    let store = Store::open(directory.path(), 256 << 20).unwrap();
    // In one document, each number changes with each minute.
    let document = |minute: u32| {
        let mut content = Vec::with_capacity(DOCUMENTS);
        for row in 0_u32.. {
            let number = row.wrapping_mul(2_654_435_761).wrapping_add(minute);
            let row = format!(r#"{{"name":"/part_{row}","messages":{number},"level":"ok"}},"#);
            if content.len() + row.len() > DOCUMENTS {
                break;
            }
            content.extend_from_slice(row.as_bytes());
        }
        Document {
            name: "topics".into(),
            content,
        }
    };
    store.append_documents(0, 60, std::iter::empty()).unwrap();
    let before = peak();
    for minute in 1..5 {
        let documents = std::iter::once_with(|| document(minute));
        let begin = minute * 60;
        store
            .append_documents(begin, begin + 60, documents)
            .unwrap();
    }
    let most = peak() - before;
    println!("{most} KiB");
    assert!(most <= ALLOWED_FOR_DOCUMENTS, "{most} KiB");
}

/// Earlier, each answer of a moment decompressed the whole state for its time.
#[test]
fn the_end_of_a_state_is_found_without_its_content() {
    let directory = tempfile::tempdir().unwrap();
    let store = Store::open(directory.path(), 64 << 20).unwrap();
    let state = Block {
        kind: Kind::State,
        begin: 60,
        end: 120,
        content: vec![b' '; STATE],
    };
    store.append(Tier::Seconds, &[state]).unwrap();
    // The peak is now the present size (proc(5)).
    fs::write("/proc/self/clear_refs", "5").unwrap();
    let before = peak();
    assert_eq!(store.state_end(130), Some(120));
    let most = peak() - before;
    assert!(most <= ALLOWED_FOR_END, "{most} KiB");
    assert_eq!(store.state(130).unwrap().content.len(), STATE);
    let whole = peak() - before;
    assert!(whole > STATE as u64 >> 10, "{whole} KiB");
}
