//! Delivery to a store that refuses, cuts connections and forgets.

use std::fs;

use super::{MIB, Robot, assert_stored, assert_whole, files, served, stored};
use ros2probe_testing::s3::{Call, Operation, RequestOutcome, Store};

#[test]
fn the_manifest_is_the_last_object_and_a_large_file_has_parts() {
    let store = Store::start();
    let robot = Robot::of(&store);
    robot.record("drive", 20 * MIB, 100);
    robot.delivers();
    assert_stored(&store, &robot, "drive");
    let written = served(&store, |operation| {
        matches!(operation, Operation::Put | Operation::Complete)
    });
    let names: Vec<_> = written
        .iter()
        .map(|object| object.rsplit('/').next().unwrap())
        .collect();
    assert_eq!(names, ["drive_0.mcap", "metadata.yaml", "manifest.json"]);
    let parts = served(&store, |operation| matches!(operation, Operation::Part(_)));
    assert_eq!(parts.len(), 3);
    // A second pass sends nothing.
    let before = store.served().len();
    robot.delivers();
    assert_eq!(store.served().len(), before);
}

#[test]
fn a_store_that_refuses_and_cuts_has_each_bag_once_in_the_end() {
    let store = Store::start();
    let robot = Robot::of(&store);
    let mut number = 0;
    // Each second request fails.
    store.decide(move |call| {
        number += 1;
        match number % 12 {
            2 => RequestOutcome::Refuse(500, None),
            4 => RequestOutcome::Refuse(429, Some(1)),
            6 => RequestOutcome::Refuse(403, None),
            8 => RequestOutcome::CutAfter(call.length / 2),
            10 => RequestOutcome::CutAnswer,
            _ => RequestOutcome::Serve,
        }
    });
    robot.record("drive", 17 * MIB, 100);
    robot.snapshot("incident_1", 3 * MIB, 50);
    robot.record("short", 1000, 20);
    let running = robot.start();
    robot.wait_for("delivery", |status| status["delivered_bags"] == 3);
    let log = running.end();
    for bag in ["drive", "incident_1", "short"] {
        assert_stored(&store, &robot, bag);
    }
    assert_eq!(store.objects().len(), 3 * 3, "{:?}", store.objects().keys());
    assert!(
        log.contains("500 Internal Server Error (RefusedByTheTest)"),
        "{log}"
    );
    assert!(log.contains("403 Forbidden"), "{log}");
}

#[test]
fn an_unreachable_store_is_reported_and_no_bag_is_lost() {
    let store = Store::start();
    let robot = Robot::of(&store);
    robot.record("drive", 1000, 100);
    store.decide(|_| RequestOutcome::CutAfter(0));
    let output = robot.once();
    assert_eq!(output.status.code(), Some(1), "{output:?}");
    let error = String::from_utf8(output.stderr).unwrap();
    assert!(error.contains("the store is out of reach"), "{error}");
    assert_eq!(robot.status()["waiting_bags"], 1);
    assert!(robot.bag("drive").exists());
    store.decide(|_| RequestOutcome::Serve);
    robot.delivers();
    assert_stored(&store, &robot, "drive");
}

#[test]
fn an_upload_whose_completion_was_not_confirmed_is_not_repeated() {
    let store = Store::start();
    let robot = Robot::of(&store);
    let mut is_cut = false;
    store.decide(move |call| {
        let cuts = call.operation == Operation::Complete && !is_cut;
        is_cut |= cuts;
        if cuts {
            RequestOutcome::CutAnswer
        } else {
            RequestOutcome::Serve
        }
    });
    robot.record("drive", 12 * MIB, 100);
    robot.delivers();
    assert_stored(&store, &robot, "drive");
    let begun = served(&store, |operation| operation == Operation::Begin);
    assert_eq!(begun.len(), 1);
}

#[test]
fn an_upload_that_the_store_dropped_begins_again() {
    let store = Store::start();
    let robot = Robot::of(&store);
    store.decide(|call| match call.operation {
        Operation::Part(2) => RequestOutcome::Refuse(503, None),
        _ => RequestOutcome::Serve,
    });
    robot.record("drive", 12 * MIB, 100);
    assert_eq!(robot.once().status.code(), Some(1));
    store.expire_uploads();
    store.decide(|_| RequestOutcome::Serve);
    robot.delivers();
    assert_stored(&store, &robot, "drive");
}

#[test]
fn replaced_credentials_apply_without_a_restart() {
    let store = Store::start();
    store.accept_key("AK-2");
    let robot = Robot::of(&store);
    robot.record("drive", 1000, 100);
    let running = robot.start();
    robot.wait_for("refusal", |status| {
        let reason = status["last_failure"]["reason"].as_str();
        reason.is_some_and(|reason| reason.contains("403 Forbidden"))
    });
    robot.set_key("AK-2");
    robot.wait_for("delivery", |status| status["delivered_bags"] == 1);
    assert_stored(&store, &robot, "drive");
    // The next key applies to the next bag.
    store.accept_key("AK-3");
    robot.set_key("AK-3");
    robot.record("lap", 1000, 10);
    robot.wait_for("second delivery", |status| status["delivered_bags"] == 2);
    running.end();
    assert_stored(&store, &robot, "lap");
    let keys: Vec<_> = store
        .served()
        .into_iter()
        .map(|call: Call| call.key)
        .collect();
    assert!(
        keys.iter().all(|key| key == "AK-2" || key == "AK-3"),
        "{keys:?}"
    );
}

#[test]
fn after_a_loss_of_the_records_no_bag_is_delivered_twice() {
    let store = Store::start();
    let robot = Robot::of(&store);
    robot.record("drive", 10 * MIB, 100);
    robot.delivers();
    fs::remove_dir_all(robot.path("state/ship")).unwrap();
    let before = store.received();
    robot.delivers();
    assert_eq!(store.received(), before);
    assert_eq!(store.objects().len(), 3);
    assert_eq!(robot.status()["delivered_bags"], 1);
}

#[test]
fn another_bag_of_the_same_name_has_a_number() {
    let store = Store::start();
    let robot = Robot::of(&store);
    robot.record("drive", 1000, 100);
    robot.delivers();
    let first = stored(&store, "drive");
    fs::remove_dir_all(robot.bag("drive")).unwrap();
    robot.record("drive", 2000, 50);
    robot.delivers();
    assert!(stored(&store, "drive") == first);
    let manifest = assert_whole(&files(&robot.bag("drive")), stored(&store, "drive-2"));
    assert_eq!(manifest["bag"], "drive");
}

#[test]
fn an_answer_beyond_the_cap_is_refused() {
    let store = Store::start();
    let robot = Robot::of(&store);
    robot.record("drive", 1000, 100);
    let manifest = "fleet/north/robot-17/drive/manifest.json";
    store.insert(manifest, vec![b' '; 16 * MIB + 1]);
    let output = robot.once();
    assert_eq!(output.status.code(), Some(1), "{output:?}");
    let error = String::from_utf8(output.stderr).unwrap();
    assert!(error.contains("length limit exceeded"), "{error}");
    store.remove(manifest);
    robot.delivers();
    assert_stored(&store, &robot, "drive");
}
