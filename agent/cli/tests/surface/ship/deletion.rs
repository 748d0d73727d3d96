//! Deletion of delivered bags, for space.

use std::fs;
use std::path::Path;
use std::process::Stdio;
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::{Duration, Instant};

use super::{MIB, PATIENCE, Robot, Running, assert_stored, assert_whole, files, manifests, stored};
use ros2probe_testing::s3::{RequestOutcome, Store};
use serde_json::Value;

#[test]
fn delivered_bags_are_deleted_only_if_space_is_needed_and_the_store_has_them() {
    let store = Store::start();
    let robot = Robot::of(&store);
    robot.record("drive", 30_000, 100);
    robot.record("lap", 60_000, 50);
    robot.delivers();
    assert!(robot.bag("drive").exists() && robot.bag("lap").exists());
    robot.configure("", ", max_total_bytes: 65536");
    store.remove("fleet/north/robot-17/drive/drive_0.mcap");
    robot.delivers();
    assert!(robot.bag("drive").exists(), "it was delivered again first");
    assert_stored(&store, &robot, "drive");
    robot.delivers();
    // The oldest bag is not enough.
    assert!(!robot.bag("drive").exists() && !robot.bag("lap").exists());
    assert_eq!(robot.status()["deleted_bags"], 2);
    assert_eq!(store.objects().len(), 6);
    // A bag that the store does not have stays.
    store.decide(|_| RequestOutcome::Refuse(503, None));
    robot.record("new", 90_000, 10);
    assert_eq!(robot.once().status.code(), Some(1));
    assert!(robot.bag("new").exists());
}

#[test]
fn a_deletion_for_space_keeps_to_pauses_and_windows() {
    let store = Store::start();
    let robot = Robot::of(&store);
    robot.record("drive", 90_000, 100);
    robot.delivers();
    let requests = Arc::new(AtomicUsize::new(0));
    let counted = Arc::clone(&requests);
    store.decide(move |_| {
        counted.fetch_add(1, Ordering::Relaxed);
        RequestOutcome::Refuse(429, Some(60))
    });
    let passes = |ship: &str, is_open: bool| {
        robot.configure(ship, ", max_total_bytes: 65536");
        let running = robot.start();
        if is_open {
            let deadline = Instant::now() + PATIENCE;
            while requests.load(Ordering::Relaxed) == 0 {
                assert!(Instant::now() < deadline, "no request");
                std::thread::sleep(Duration::from_millis(20));
            }
        } else {
            let opens = |status: &Value| status["opens_in_seconds"].as_u64();
            robot.wait_for("scan", |status| opens(status) > Some(0));
        }
        // Without a pause or a window, a scan within 2 s would repeat the request.
        std::thread::sleep(Duration::from_secs(4));
        running.end();
        requests.swap(0, Ordering::Relaxed)
    };
    let now = jiff::Zoned::now();
    let at = |hours: i64| {
        let time = now.time().wrapping_add(jiff::Span::new().hours(hours));
        time.strftime("%H:%M").to_string()
    };
    let closed = format!("  windows: ['{}-{}']\n", at(2), at(3));
    assert_eq!(passes(&closed, false), 0);
    assert_eq!(passes("", true), 1);
    assert!(robot.bag("drive").exists());
}

#[test]
fn a_deletion_for_space_keeps_what_was_not_delivered() {
    let store = Store::start();
    let robot = Robot::of(&store);
    robot.record("drive", 90_000, 100);
    robot.delivers();
    // Only the plain files of a bag are delivered.
    let camera = robot.bag("drive").join("camera");
    fs::create_dir(&camera).unwrap();
    fs::write(camera.join("left.yaml"), "width: 640").unwrap();
    robot.configure("", ", max_total_bytes: 65536");
    robot.delivers();
    let left = fs::read_dir(robot.bag("drive")).unwrap().count();
    assert_eq!(left, 1, "only the directory is left");
    let text = fs::read_to_string(camera.join("left.yaml")).unwrap();
    assert_eq!(text, "width: 640");
    assert_eq!(robot.status()["deleted_bags"], 1);
    robot.delivers();
    assert_eq!(robot.status()["deleted_bags"], 1);
    assert!(camera.join("left.yaml").exists());
}

/// The test needs root, for a disk of its own.
#[test]
fn bags_on_a_full_disk_are_delivered_and_deleted() {
    let store = Store::start();
    let robot = Robot::of(&store);
    robot.configure("", ", max_total_bytes: 1000000");
    robot.record("drive", 12 * MIB, 100);
    robot.record("lap", 2 * MIB, 50);
    let before = ["drive", "lap"].map(|bag| files(&robot.bag(bag)));
    fs::rename(robot.path("state"), robot.path("before")).unwrap();
    fs::create_dir(robot.path("state")).unwrap();
    let script = r#"mount -t tmpfs -o size=16m none "$0/state" || exit 99
        cp -a "$0/before/recordings" "$0/state/" || exit 98
        dd if=/dev/zero of="$0/state/others" bs=4k 2>/dev/null
        echo x >> "$0/state/others" && exit 97
        exec "$@""#;
    let rp = robot.command(&[]);
    let child = std::process::Command::new("unshare")
        .args(["--mount", "sh", "-c", script])
        .arg(robot.directory.path())
        .arg(rp.get_program())
        .args(rp.get_args())
        .stderr(Stdio::piped())
        .spawn()
        .unwrap();
    let state = format!("/proc/{}/root{}", child.id(), robot.path("state").display());
    let running = Running(Some(child));
    store.wait_for("both bags", |store| manifests(store).len() == 2);
    let recordings = Path::new(&state).join("recordings");
    let deadline = Instant::now() + PATIENCE;
    while fs::read_dir(&recordings).unwrap().count() > 0 {
        assert!(Instant::now() < deadline, "bags are still there");
        std::thread::sleep(Duration::from_millis(50));
    }
    let log = running.end();
    assert!(log.contains("failed to record a delivery"), "{log}");
    for (bag, before) in ["drive", "lap"].into_iter().zip(&before) {
        assert_whole(before, stored(&store, bag));
    }
    assert_eq!(store.objects().len(), 6);
}
