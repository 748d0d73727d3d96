//! The queue: order, restarts, the limit, damage.

#![allow(
    clippy::unwrap_used,
    clippy::indexing_slicing,
    reason = "a failed test may panic"
)]

use std::collections::VecDeque;
use std::fs;
use std::path::Path;

use proptest::prelude::*;
use ros2probe_history::{Queue, Record};

const LIMIT: u64 = 1 << 20;

/// Returns a record of some kilobytes that compression cannot shorten.
fn long(number: u32) -> Vec<u8> {
    let mut value = u64::from(number) + 1;
    let mut bytes = number.to_le_bytes().to_vec();
    bytes.extend((0..4000).map(|_| {
        value = value.wrapping_mul(0x5851_f42d_4c95_7f2d).wrapping_add(1);
        (value >> 56) as u8
    }));
    bytes
}

fn number(record: &Record) -> u32 {
    u32::from_le_bytes(*record.content.first_chunk().unwrap())
}

fn append(queue: &mut Queue, number: u32) -> Vec<u32> {
    let mut lost = Vec::new();
    let mut each = |record: Record| {
        if record.is_waiting {
            lost.push(self::number(&record));
        }
    };
    queue.append(number, long(number), &mut each).unwrap();
    lost
}

/// Returns the numbers of the waiting records that are left to read.
fn rest(queue: &mut Queue) -> Vec<u32> {
    let records = std::iter::from_fn(|| queue.read().unwrap());
    let waiting = records.filter(|record| record.is_waiting);
    waiting.map(|record| number(&record)).collect()
}

fn files(directory: &Path) -> usize {
    let entries = fs::read_dir(directory).unwrap();
    let names = entries.map(|entry| entry.unwrap().path());
    names
        .filter(|path| path.extension().is_some_and(|end| end == "queue"))
        .count()
}

#[test]
fn a_queue_whose_records_were_removed_takes_no_space() {
    let place = tempfile::tempdir().unwrap();
    let directory = place.path().join("queue");
    let mut queue = Queue::open(&directory, LIMIT).unwrap();
    assert!(queue.is_empty() && queue.read().unwrap().is_none() && !directory.exists());
    for number in 0..20 {
        assert_eq!(
            queue.begins_file(),
            number == 0 || number % 9 == 0,
            "{number}"
        );
        append(&mut queue, number);
    }
    assert_eq!(rest(&mut queue), (0..20).collect::<Vec<_>>());
    queue.remove();
    assert!(queue.is_empty() && queue.begins_file());
    assert_eq!((queue.bytes(), files(&directory)), (0, 0));
    append(&mut queue, 20);
    assert_eq!(rest(&mut queue), [20]);
}

#[test]
fn a_full_queue_loses_its_oldest_records_and_reports_them() {
    let place = tempfile::tempdir().unwrap();
    let mut queue = Queue::open(place.path(), LIMIT).unwrap();
    // The first five were read: the receiver has them.
    let mut lost: Vec<u32> = (0..3)
        .flat_map(|number| append(&mut queue, number))
        .collect();
    assert_eq!(rest(&mut queue).len(), 3);
    lost.extend((3..600).flat_map(|number| append(&mut queue, number)));
    assert!(queue.bytes() <= LIMIT);
    let left = rest(&mut queue);
    let all: Vec<u32> = lost.iter().chain(&left).copied().collect();
    assert_eq!(all, (3..600).collect::<Vec<_>>());
    assert!(left.len() > 200, "{}", left.len());
}

#[test]
fn the_settled_part_of_a_record_is_kept_until_the_record_is_removed_or_lost() {
    let place = tempfile::tempdir().unwrap();
    let mut queue = Queue::open(place.path(), LIMIT).unwrap();
    for number in 0..3 {
        append(&mut queue, number);
    }
    let next = |queue: &mut Queue| {
        let record = queue.read().unwrap().unwrap();
        (number(&record), record.settled)
    };
    assert_eq!(next(&mut queue), (0, 0));
    queue.settle(7);
    assert_eq!(next(&mut queue), (1, 0));
    queue.rewind();
    assert_eq!(next(&mut queue), (0, 7));
    let mut queue = Queue::open(place.path(), LIMIT).unwrap();
    assert_eq!(next(&mut queue), (0, 7));
    queue.remove();
    assert_eq!(next(&mut queue), (1, 0));
    queue.settle(3);
    // The file with the record is lost, and with it the settled part.
    fs::remove_file(place.path().join("0000000000.queue")).unwrap();
    fs::write(place.path().join("place"), "0 99 3\n").unwrap();
    let mut queue = Queue::open(place.path(), LIMIT).unwrap();
    append(&mut queue, 4);
    assert_eq!(next(&mut queue), (4, 0));
}

#[test]
fn files_beyond_the_cap_are_lost() {
    let place = tempfile::tempdir().unwrap();
    let mut queue = Queue::open(place.path(), LIMIT).unwrap();
    let mut lost = 0;
    for number in 0..300 {
        queue.begin_file();
        queue.append(number, vec![1], &mut |_| lost += 1).unwrap();
    }
    assert_eq!((lost, files(place.path())), (44, 256));
}

#[test]
fn a_damaged_record_is_skipped() {
    let place = tempfile::tempdir().unwrap();
    let mut queue = Queue::open(place.path(), LIMIT).unwrap();
    for number in 0..5 {
        append(&mut queue, number);
    }
    let path = place.path().join("0000000000.queue");
    let mut bytes = fs::read(&path).unwrap();
    let middle = bytes.len() / 2;
    bytes[middle] ^= 1;
    fs::write(&path, bytes).unwrap();
    assert_eq!(
        rest(&mut Queue::open(place.path(), LIMIT).unwrap()),
        [0, 1, 3, 4]
    );
}

#[test]
fn an_unwritable_directory_loses_no_record_of_the_queue() {
    let place = tempfile::tempdir().unwrap();
    fs::write(place.path().join("file"), "").unwrap();
    let mut queue = Queue::open(&place.path().join("new"), LIMIT).unwrap();
    append(&mut queue, 1);
    fs::remove_dir_all(place.path().join("new")).unwrap();
    fs::write(place.path().join("new"), "").unwrap();
    queue.append(2, long(2), &mut |_| {}).unwrap_err();
}

#[derive(Clone, Debug)]
enum Step {
    Append,
    Read(usize),
    Remove,
    Restart,
}

fn step() -> impl Strategy<Value = Step> {
    prop_oneof![
        5 => Just(Step::Append),
        3 => (1_usize..12).prop_map(Step::Read),
        2 => Just(Step::Remove),
        1 => Just(Step::Restart),
    ]
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(64))]

    #[test]
    fn records_are_read_in_order_until_they_are_removed(
        steps in proptest::collection::vec(step(), 1..120),
    ) {
        let place = tempfile::tempdir().unwrap();
        let mut queue = Queue::open(place.path(), LIMIT).unwrap();
        // What waits, and how many of it were read.
        let (mut waiting, mut read, mut next) = (VecDeque::new(), 0, 0);
        for step in steps {
            match step {
                Step::Append => {
                    prop_assert!(append(&mut queue, next).is_empty());
                    waiting.push_back(next);
                    next += 1;
                }
                Step::Read(count) => {
                    let mut seen = Vec::new();
                    while seen.len() < count && let Some(record) = queue.read().unwrap() {
                        if record.is_waiting {
                            seen.push(number(&record));
                        }
                    }
                    let expected: Vec<_> = waiting.iter().skip(read).take(count).copied().collect();
                    read += expected.len();
                    prop_assert_eq!(seen, expected);
                }
                Step::Remove => {
                    queue.remove();
                    waiting.drain(..read);
                    read = 0;
                }
                Step::Restart => {
                    queue = Queue::open(place.path(), LIMIT).unwrap();
                    read = 0;
                }
            }
            prop_assert_eq!(queue.is_empty(), waiting.is_empty());
        }
    }
}

#[test]
fn after_a_power_cut_all_records_of_a_new_file_are_waiting() {
    let place = tempfile::tempdir().unwrap();
    let directory = place.path().join("queue");
    let mut queue = Queue::open(&directory, LIMIT).unwrap();
    append(&mut queue, 0);
    drop(queue);
    // The place was written, and the records before it were not.
    fs::write(directory.join("place"), "0 9000").unwrap();
    drop(Queue::open(&directory, LIMIT).unwrap());
    let mut queue = Queue::open(&directory, LIMIT).unwrap();
    assert!(queue.is_empty());
    append(&mut queue, 1);
    assert_eq!(rest(&mut queue), [1]);
}

#[test]
fn a_file_that_cannot_be_opened_is_read_later_and_not_skipped() {
    let place = tempfile::tempdir().unwrap();
    let directory = place.path().join("queue");
    let mut queue = Queue::open(&directory, LIMIT).unwrap();
    for number in 0..20 {
        append(&mut queue, number);
    }
    let first = directory.join("0000000000.queue");
    let aside = directory.join("aside");
    fs::rename(&first, &aside).unwrap();
    // A loop of links: an error other than a missing file.
    std::os::unix::fs::symlink(&first, &first).unwrap();
    assert!(queue.read().is_err() && queue.read().is_err());
    fs::rename(&aside, &first).unwrap();
    assert_eq!(rest(&mut queue), (0..20).collect::<Vec<_>>());
}
