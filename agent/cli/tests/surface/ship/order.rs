//! Which bag is delivered when: windows, and bags of triggers.

use std::path::Path;
use std::time::{Duration, Instant};

use super::{MIB, PATIENCE, Robot, assert_stored, assert_whole, files, manifests, served};
use ros2probe_testing::s3::{Operation, Store};
use serde_json::json;

#[test]
fn outside_the_windows_only_triggered_bags_are_delivered_if_configured() {
    let store = Store::start();
    let robot = Robot::of(&store);
    let now = jiff::Zoned::now();
    let at = |hours: i64| {
        let time = now.time().wrapping_add(jiff::Span::new().hours(hours));
        time.strftime("%H:%M").to_string()
    };
    let closed = format!(
        "  windows: ['{}-{}']\n  triggered_always: true\n",
        at(2),
        at(3)
    );
    robot.configure(&closed, "");
    robot.record("drive", 1000, 100);
    robot.snapshot("incident_1", 1000, 50);
    let running = robot.start();
    robot.wait_for("delivery", |status| status["delivered_bags"] == 1);
    std::thread::sleep(Duration::from_secs(3));
    let status = robot.status();
    assert_eq!(status["waiting"], json!(["drive"]));
    let opens = status["opens_in_seconds"].as_u64().unwrap();
    assert!((6_900..=7_200).contains(&opens), "{opens}");
    running.end();
    assert_eq!(manifests(&store), ["incident_1"]);
    let open = format!("  windows: ['{}-{}']\n", at(-1), at(1));
    robot.configure(&open, "");
    let running = robot.start();
    robot.wait_for("delivery", |status| status["delivered_bags"] == 2);
    running.end();
    assert_stored(&store, &robot, "drive");
}

#[test]
fn a_triggered_bag_overtakes_one_that_is_being_delivered() {
    let store = Store::start();
    let robot = Robot::of(&store);
    robot.configure("  max_bytes_per_second: 8000000\n", "");
    robot.record("drive", 40 * MIB, 100);
    let running = robot.start();
    store.wait_for("first bytes", |store| store.received() > MIB);
    robot.snapshot("incident_1", 1000, 5);
    store.wait_for("the triggered bag", |store| !manifests(store).is_empty());
    running.kill();
    assert_eq!(manifests(&store), ["incident_1"]);
    assert_stored(&store, &robot, "incident_1");
    robot.configure("", "");
    robot.delivers();
    assert_stored(&store, &robot, "drive");
    let begun = served(&store, |operation| operation == Operation::Begin);
    assert_eq!(begun.len(), 1, "the parts before are not sent again");
}

#[test]
fn a_triggered_bag_overtakes_a_file_that_is_being_copied_into_a_folder() {
    let folder = tempfile::tempdir().unwrap();
    let robot = Robot::to(&format!("file://{}", folder.path().display()), "");
    robot.configure("  max_bytes_per_second: 8000000\n", "");
    robot.record("drive", 60 * MIB, 100);
    let running = robot.start();
    let delivered = folder.path().join("robot-17");
    let wait_for = |path: &Path| {
        let deadline = Instant::now() + PATIENCE;
        while !path.exists() {
            assert!(Instant::now() < deadline, "no {}", path.display());
            std::thread::sleep(Duration::from_millis(20));
        }
    };
    wait_for(&delivered.join("drive"));
    robot.snapshot("incident_1", 1000, 5);
    wait_for(&delivered.join("incident_1/manifest.json"));
    assert!(!delivered.join("drive/drive_0.mcap").exists());
    running.kill();
    robot.configure("", "");
    robot.delivers();
    for bag in ["drive", "incident_1"] {
        assert_whole(&files(&robot.bag(bag)), files(&delivered.join(bag)));
    }
}
