//! Delivery to a folder.

use std::collections::BTreeMap;
use std::fs;
use std::path::Path;

use super::{MIB, Robot, age, assert_stored, assert_whole, files};
use ros2probe_testing::s3::Store;
use serde_json::{Value, json};

#[test]
fn a_bag_arrives_in_a_folder_with_its_manifest() {
    let folder = tempfile::tempdir().unwrap();
    let robot = Robot::to(&format!("file://{}", folder.path().display()), "");
    robot.record("drive", 9 * MIB, 100);
    robot.snapshot("incident_1", 1000, 50);
    let recording = robot.write("running", 1000, 10, None);
    robot.delivers();
    for bag in ["drive", "incident_1"] {
        let delivered = files(&folder.path().join("robot-17").join(bag));
        let manifest = assert_whole(&files(&robot.bag(bag)), delivered);
        assert_eq!(manifest["robot"], "robot-17");
        assert_eq!(manifest["bag"], bag);
        assert_eq!(manifest["is_complete"], true);
        assert_eq!(manifest["findings"], Value::Null, "no agent runs");
        assert_eq!(manifest["topics"][0]["name"], "/points");
        let trigger = &manifest["trigger"]["trigger"];
        assert_eq!(
            *trigger,
            if bag == "drive" {
                Value::Null
            } else {
                json!("participant_lost")
            }
        );
        assert!(manifest["start"].as_str() <= manifest["end"].as_str());
        assert!(manifest["start"].is_string());
    }
    assert!(!folder.path().join("robot-17/running").exists());
    let status = robot.status();
    assert_eq!(status["delivered_bags"], 2);
    assert_eq!(status["waiting_bags"], 0);
    assert_eq!(status["unfinished_bags"], 1);
    assert_eq!(status["last_delivered"]["path"], "robot-17/drive");
    drop(recording);
    // Space is not needed.
    assert!(robot.bag("drive").exists());
}

/// Begins the delivery of a bag to a folder, and kills the process after the first file.
fn begin_delivery(folder: &Path) -> Robot {
    let robot = Robot::to(&format!("file://{}", folder.display()), "");
    robot.configure("  max_bytes_per_second: 2000000\n", "");
    robot.record("drive", MIB, 100);
    fs::write(robot.bag("drive").join("notes.bin"), vec![7; 8 * MIB]).unwrap();
    age(&robot.bag("drive"), 100);
    let running = robot.start();
    robot.wait_for("first file", |status| {
        let done = status["uploading"]["done_bytes"].as_u64();
        done.is_some_and(|done| done >= MIB as u64)
    });
    running.kill();
    robot.configure("", "");
    let delivered = files(&folder.join("robot-17/drive"));
    assert!(delivered.contains_key("drive_0.mcap"));
    assert!(!delivered.contains_key("manifest.json"));
    robot
}

#[test]
fn a_bag_is_whole_at_the_destination_that_was_configured_in_the_middle() {
    let first = tempfile::tempdir().unwrap();
    let mut robot = begin_delivery(first.path());
    let second = tempfile::tempdir().unwrap();
    robot.url = format!("file://{}", second.path().display());
    robot.configure("", "");
    robot.delivers();
    let delivered = files(&second.path().join("robot-17/drive"));
    assert_whole(&files(&robot.bag("drive")), delivered);
    // A delivered bag is not sent to the next one.
    let third = tempfile::tempdir().unwrap();
    robot.url = format!("file://{}", third.path().display());
    robot.configure("", "");
    robot.delivers();
    assert!(!third.path().join("robot-17").exists());
}

#[test]
fn a_bag_is_whole_after_the_destination_lost_its_first_file() {
    let folder = tempfile::tempdir().unwrap();
    let robot = begin_delivery(folder.path());
    let delivered = folder.path().join("robot-17/drive");
    fs::remove_dir_all(&delivered).unwrap();
    robot.delivers();
    assert_whole(&files(&robot.bag("drive")), files(&delivered));
}

#[test]
fn one_pass_delivers_the_bag_that_ended_just_before() {
    let store = Store::start();
    let robot = Robot::of(&store);
    let writer = robot.write("drive", 1000, 10, None);
    writer.close(BTreeMap::new()).unwrap();
    robot.delivers();
    assert_stored(&store, &robot, "drive");
    assert_eq!(robot.status()["unfinished_bags"], 0);
}

#[test]
fn a_missing_folder_is_not_created() {
    let folder = tempfile::tempdir().unwrap();
    let missing = folder.path().join("not-mounted");
    let robot = Robot::to(&format!("file://{}", missing.display()), "");
    robot.record("drive", 1000, 100);
    let output = robot.once();
    assert_eq!(output.status.code(), Some(1), "{output:?}");
    let error = String::from_utf8(output.stderr).unwrap();
    assert!(error.contains("not-mounted does not exist"), "{error}");
    assert!(!missing.exists());
    fs::create_dir(&missing).unwrap();
    robot.delivers();
    assert!(missing.join("robot-17/drive/manifest.json").exists());
}
