//! Processes that are killed while they deliver or record.

use std::time::Duration;

use super::{MIB, PART, Robot, age, assert_stored, served};
use ros2probe_testing::s3::{Operation, Store};

#[test]
fn a_killed_process_continues_with_the_part_in_which_it_died() {
    let store = Store::start();
    let robot = Robot::of(&store);
    robot.configure("  max_bytes_per_second: 8000000\n", "");
    robot.record("drive", 30 * MIB, 100);
    let running = robot.start();
    // The second part is on its way.
    store.wait_for("second part", |store| store.received() > PART + PART / 2);
    running.kill();
    let sent = served(&store, |operation| matches!(operation, Operation::Part(_)));
    assert_eq!(sent.len(), 1);
    robot.configure("", "");
    robot.delivers();
    assert_stored(&store, &robot, "drive");
    let parts: Vec<_> = store.served().iter().map(|call| call.operation).collect();
    let count = |wanted| parts.iter().filter(|part| **part == wanted).count();
    assert_eq!(count(Operation::Begin), 1);
    for number in 1..=4 {
        assert_eq!(count(Operation::Part(number)), 1, "part {number}");
    }
}

#[test]
fn a_process_that_is_killed_again_and_again_delivers_each_bag_once() {
    let store = Store::start();
    let robot = Robot::of(&store);
    robot.configure("  max_bytes_per_second: 20000000\n", "");
    robot.record("drive", 18 * MIB, 100);
    robot.record("lap", 2 * MIB, 50);
    for step in 1_usize..=12 {
        let running = robot.start();
        std::thread::sleep(Duration::from_millis(90 * step as u64 % 700 + 60));
        running.kill();
    }
    robot.configure("", "");
    robot.delivers();
    for bag in ["drive", "lap"] {
        assert_stored(&store, &robot, bag);
    }
    assert_eq!(store.objects().len(), 6);
}

#[test]
fn the_bag_of_a_killed_recorder_is_named_incomplete() {
    let store = Store::start();
    let robot = Robot::of(&store);
    let mut recording = robot.write("drive", 3000, 200, None);
    recording.flush().unwrap();
    age(&robot.bag("drive"), 200);
    robot.delivers();
    assert!(store.objects().is_empty(), "its recorder lives");
    drop(recording);
    robot.delivers();
    let manifest = assert_stored(&store, &robot, "drive");
    assert_eq!(manifest["is_complete"], false);
}
