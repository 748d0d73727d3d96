//! `rp ship` delivers bags to a folder and to a store of S3, through refusals, cut connections and
//! its own death: each bag once, whole, with its manifest.

use std::collections::BTreeMap;
use std::fs::{self, File, FileTimes};
use std::io::{Read as _, Write as _};
use std::path::{Path, PathBuf};
use std::process::{Child, Output, Stdio};
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::{Duration, Instant, SystemTime};

use crate::rp;
use ros2probe_bag::{Options, TopicDescription, Writer};
use ros2probe_testing::local_agent::{LocalAgent, call_api};
use ros2probe_testing::s3::{BUCKET, Call, Operation, RequestOutcome, Store, hex};
use ros2probe_wire::Timestamp;
use serde_json::{Value, json};
use tempfile::TempDir;

const SECRET: &str = "the-secret-of-the-robot";
const MIB: usize = 1 << 20;
/// Size of the parts of a large file.
const PART: usize = 8 * MIB;
/// Maximum wait for a state.
const PATIENCE: Duration = Duration::from_secs(60);

/// A robot with bags, and the configuration of its delivery.
struct Robot {
    directory: TempDir,
    url: String,
    more: String,
}

impl Robot {
    /// Creates a robot that delivers to a store.
    fn of(store: &Store) -> Self {
        let more = format!("endpoint: http://{}", store.address);
        Self::to(&format!("s3://{BUCKET}/fleet/north"), &more)
    }

    fn to(url: &str, more: &str) -> Self {
        let robot = Self {
            directory: tempfile::tempdir().unwrap(),
            url: url.to_owned(),
            more: more.to_owned(),
        };
        robot.set_key("AK-1");
        robot.configure("", "");
        robot
    }

    fn path(&self, name: &str) -> PathBuf {
        self.directory.path().join(name)
    }

    fn bag(&self, name: &str) -> PathBuf {
        self.path("state/recordings").join(name)
    }

    /// Replaces the file with credentials, as a program that rotates them does.
    fn set_key(&self, key: &str) {
        let text = format!("AWS_ACCESS_KEY_ID={key}\nAWS_SECRET_ACCESS_KEY={SECRET}\n");
        fs::write(self.path("ship.new"), text).unwrap();
        fs::rename(self.path("ship.new"), self.path("ship.env")).unwrap();
    }

    /// Writes the configuration with further keys of `ship` and of `recordings`.
    fn configure(&self, ship: &str, recordings: &str) {
        let state = self.path("state");
        let text = format!(
            "state_directory: {}\nrecordings: {{reserve_percent: 0, reserve_bytes: 0{recordings}}}\n\
             ship:\n  url: {}\n  instance: robot-17\n  credentials_file: {}\n  {}\n{ship}",
            state.display(),
            self.url,
            self.path("ship.env").display(),
            self.more,
        );
        fs::create_dir_all(state.join("recordings")).unwrap();
        fs::write(self.path("ros2probe.yaml"), text).unwrap();
    }

    /// Records a bag of about this size that ended in order some seconds ago. Each has other bytes.
    fn record(&self, name: &str, bytes: usize, seconds: u64) {
        let writer = self.write(name, bytes, seconds, None);
        writer.close(BTreeMap::new()).unwrap();
        age(&self.bag(name), seconds);
    }

    /// Records a bag of a snapshot.
    fn snapshot(&self, name: &str, bytes: usize, seconds: u64) {
        let trigger = json!({
            "snapshot": "incident",
            "trigger": "participant_lost",
            "event": "ros2.participant.lost",
            "time": "2026-11-20T02:34:07Z",
        });
        let writer = self.write(name, bytes, seconds, Some(&trigger));
        writer.close(BTreeMap::new()).unwrap();
        age(&self.bag(name), seconds);
    }

    fn write(&self, name: &str, bytes: usize, seconds: u64, trigger: Option<&Value>) -> Writer {
        let mut options = Options::default();
        if let Some(trigger) = trigger {
            let key = "ros2probe_trigger".to_owned();
            options.custom_data.insert(key, trigger.to_string());
        }
        let mut writer = Writer::create(&self.bag(name), options).unwrap();
        let topic = writer
            .topic(TopicDescription {
                name: "/points".into(),
                type_name: "sensor_msgs/msg/PointCloud2".into(),
                type_hash: None,
                publishers: Vec::new(),
                schema: None,
            })
            .unwrap();
        let now = SystemTime::now().duration_since(SystemTime::UNIX_EPOCH);
        let begin = now.unwrap().as_nanos() as u64 - seconds * 1_000_000_000;
        let mut state = name
            .bytes()
            .fold(88_172_645_463_325_252_u64, |state, byte| {
                state.wrapping_mul(31).wrapping_add(byte.into())
            });
        let mut left = bytes;
        let mut number = 0;
        while left > 0 {
            let mut message = vec![0_u8; left.min(MIB / 4)];
            for chunk in message.chunks_mut(8) {
                state ^= state << 13;
                state ^= state >> 7;
                state ^= state << 17;
                chunk.copy_from_slice(&state.to_le_bytes()[..chunk.len()]);
            }
            let time = Timestamp(begin + number);
            writer.write(topic, time, time, number, &message).unwrap();
            left -= message.len();
            number += 1;
        }
        writer
    }

    fn command(&self, arguments: &[&str]) -> std::process::Command {
        let mut rp = rp();
        rp.args(["ship", "--config"])
            .arg(self.path("ros2probe.yaml"))
            .args(arguments)
            .env_remove("STATE_DIRECTORY");
        for (name, _) in std::env::vars() {
            if name.starts_with("AWS_") {
                rp.env_remove(name);
            }
        }
        rp
    }

    /// Runs `rp ship --once`. No output has the secret.
    fn once(&self) -> Output {
        let output = self.command(&["--once"]).output().unwrap();
        let all = format!("{output:?}");
        assert!(!all.contains(SECRET), "{all}");
        output
    }

    fn delivers(&self) {
        let output = self.once();
        assert!(output.status.success(), "{output:?}");
    }

    /// Starts `rp ship` as the service does.
    fn start(&self) -> Running {
        let child = self.command(&[]).stderr(Stdio::piped()).spawn().unwrap();
        Running(Some(child))
    }

    fn status(&self) -> Value {
        let output = self.command(&["--status", "--json"]).output().unwrap();
        assert!(output.status.success(), "{output:?}");
        serde_json::from_slice(&output.stdout).unwrap()
    }

    fn wait_for(&self, what: &str, wanted: impl Fn(&Value) -> bool) {
        let deadline = Instant::now() + PATIENCE;
        loop {
            let status = fs::read(self.path("state/ship/status.json")).ok();
            let status = status.and_then(|text| serde_json::from_slice::<Value>(&text).ok());
            if status.as_ref().is_some_and(&wanted) {
                return;
            }
            assert!(Instant::now() < deadline, "no {what}: {status:#?}");
            std::thread::sleep(Duration::from_millis(50));
        }
    }
}

/// A running `rp ship`; dropping the value kills it.
struct Running(Option<Child>);

impl Running {
    /// Kills it as `kill -9` does.
    fn kill(mut self) {
        let mut child = self.0.take().unwrap();
        child.kill().unwrap();
        child.wait().unwrap();
    }

    /// Ends it as a service manager does, and returns its log, which has no secret.
    fn end(mut self) -> String {
        let mut child = self.0.take().unwrap();
        let process = rustix::process::Pid::from_child(&child);
        rustix::process::kill_process(process, rustix::process::Signal::TERM).unwrap();
        assert_eq!(child.wait().unwrap().code(), Some(0));
        let mut log = String::new();
        child.stderr.unwrap().read_to_string(&mut log).unwrap();
        assert!(!log.contains(SECRET), "{log}");
        log
    }
}

impl Drop for Running {
    fn drop(&mut self) {
        if let Some(child) = &mut self.0 {
            let _ = child.kill();
            let _ = child.wait();
        }
    }
}

/// Sets the times of all files of a bag back.
fn age(bag: &Path, seconds: u64) {
    let then = SystemTime::now() - Duration::from_secs(seconds);
    for entry in fs::read_dir(bag).unwrap() {
        let file = File::open(entry.unwrap().path()).unwrap();
        file.set_times(FileTimes::new().set_modified(then)).unwrap();
    }
}

/// Returns the files of a bag by name.
fn files(bag: &Path) -> BTreeMap<String, Vec<u8>> {
    let entries = fs::read_dir(bag).unwrap().map(Result::unwrap);
    entries
        .map(|entry| {
            let name = entry.file_name().into_string().unwrap();
            (name, fs::read(entry.path()).unwrap())
        })
        .collect()
}

/// Asserts that delivered files are those of a bag, and that the manifest has their checksums.
/// Returns the manifest.
fn assert_whole(
    bag: &BTreeMap<String, Vec<u8>>,
    mut delivered: BTreeMap<String, Vec<u8>>,
) -> Value {
    let manifest = delivered.remove("manifest.json").expect("a manifest");
    let manifest: Value = serde_json::from_slice(&manifest).unwrap();
    let names = |files: &BTreeMap<String, Vec<u8>>| files.keys().cloned().collect::<Vec<_>>();
    assert_eq!(names(&delivered), names(bag));
    assert!(delivered == *bag, "other bytes");
    let listed = manifest["files"].as_array().unwrap();
    assert_eq!(listed.len(), bag.len());
    for file in listed {
        let content = &bag[file["name"].as_str().unwrap()];
        assert_eq!(file["bytes"], content.len());
        assert_eq!(file["sha256"], hex(content));
    }
    manifest
}

/// Returns the files of a bag in a store.
fn stored(store: &Store, bag: &str) -> BTreeMap<String, Vec<u8>> {
    let begin = format!("fleet/north/robot-17/{bag}/");
    let objects = store.objects().into_iter();
    objects
        .filter_map(|(name, content)| {
            let name = name.strip_prefix(&begin)?.to_owned();
            Some((name, content.to_vec()))
        })
        .collect()
}

fn assert_stored(store: &Store, robot: &Robot, bag: &str) -> Value {
    assert_whole(&files(&robot.bag(bag)), stored(store, bag))
}

/// Returns the objects for which the store served an operation, in their order.
fn served(store: &Store, operation: impl Fn(Operation) -> bool) -> Vec<String> {
    let served = store.served().into_iter();
    let served = served.filter(|call| operation(call.operation));
    served.map(|call| call.object).collect()
}

fn manifests(store: &Store) -> Vec<String> {
    let puts = served(store, |operation| operation == Operation::Put).into_iter();
    let bags = puts.filter_map(|object| {
        let bag = object.strip_suffix("/manifest.json")?;
        Some(bag.rsplit('/').next().unwrap().to_owned())
    });
    bags.collect()
}

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
fn a_status_that_cannot_be_read_has_the_reason_and_the_remedy() {
    use std::os::unix::fs::{MetadataExt as _, PermissionsExt as _};
    let folder = tempfile::tempdir().unwrap();
    let robot = Robot::to(&format!("file://{}", folder.path().display()), "");
    let status = || robot.command(&["--status"]).output().unwrap();
    let fails = |output: &Output, text: &str| {
        let printed = String::from_utf8(output.stderr.clone()).unwrap();
        assert_eq!(output.status.code(), Some(1), "{printed}");
        assert_eq!(printed.lines().count(), 1, "{printed}");
        assert!(printed.contains(text), "{printed}");
    };
    fails(&status(), "no delivery has begun: ");
    robot.record("drive", 1000, 100);
    robot.delivers();

    // The build directory may not be readable for other users.
    let program = robot.path("rp");
    fs::copy(env!("CARGO_BIN_EXE_rp"), &program).unwrap();
    let directory = robot.path("state/ship");
    for (path, mode) in [
        (robot.directory.path(), 0o755),
        (&program, 0o755),
        (&directory, 0o000),
    ] {
        fs::set_permissions(path, fs::Permissions::from_mode(mode)).unwrap();
    }
    let mut other = std::process::Command::new("setpriv");
    if fs::metadata("/proc/self").unwrap().uid() == 0 {
        other.args(["--reuid=65534", "--regid=65534", "--clear-groups"]);
    }
    other.arg("--inh-caps=-all").arg(&program);
    other.args(["ship", "--status", "--config"]);
    let denied = other.arg(robot.path("ros2probe.yaml")).output().unwrap();
    let remedy = "state/ship/status.json: use sudo, or join the group ros2probe";
    fails(&denied, remedy);

    fs::set_permissions(&directory, fs::Permissions::from_mode(0o750)).unwrap();
    fs::write(directory.join("status.json"), "").unwrap();
    fails(&status(), "status.json is damaged");
}

#[test]
fn an_idle_service_does_not_write_its_status_again() {
    let folder = tempfile::tempdir().unwrap();
    let robot = Robot::to(&format!("file://{}", folder.path().display()), "");
    let running = robot.start();
    robot.wait_for("status", |status| status["waiting_bags"] == 0);
    let changed = || {
        let about = fs::metadata(robot.path("state/ship/status.json"));
        about.unwrap().modified().unwrap()
    };
    let before = changed();
    // The service scans its directory every 2 s.
    std::thread::sleep(Duration::from_secs(3));
    assert_eq!(changed(), before);
    robot.record("drive", 1000, 100);
    robot.wait_for("delivery", |status| status["delivered_bags"] == 1);
    running.end();
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

#[test]
fn mistakes_of_the_configuration_are_reported_at_the_start() {
    let robot = Robot::to("s3://bags", "");
    let fails = |code: i32, text: &str| {
        let output = robot.once();
        let error = String::from_utf8(output.stderr).unwrap();
        assert_eq!(output.status.code(), Some(code), "{error}");
        assert!(error.contains(text), "{error}");
    };
    robot.configure("  windows: ['22-6']\n", "");
    fails(78, "ship.windows[0]");
    fs::write(robot.path("ros2probe.yaml"), "ship: {url: 'ftp://a'}\n").unwrap();
    fails(78, "ship.url");
    fs::write(robot.path("ros2probe.yaml"), "watch: []\n").unwrap();
    fails(78, "no destination is configured");
    robot.configure("", "");
    robot.record("drive", 1000, 100);
    fs::write(robot.path("ship.env"), format!("AWS_SECRET={SECRET}\n")).unwrap();
    fails(1, "line 1 of");
    let first = robot.start();
    let process = first.0.as_ref().unwrap().id();
    robot.wait_for("start", |status| status["process_id"] == process);
    fails(1, "another rp ship works with");
    first.kill();
}

/// Starts an engine that has one sample of this robot for each query.
fn engine() -> std::net::SocketAddr {
    let listener = std::net::TcpListener::bind("127.0.0.1:0").unwrap();
    let address = listener.local_addr().unwrap();
    std::thread::spawn(move || {
        for stream in listener.incoming() {
            let mut stream = stream.unwrap();
            let _ = stream.read(&mut [0; 4096]);
            let text = r#"{"status":"success","data":{"resultType":"vector","result":[
                {"metric":{"instance":"robot-17"},"value":[1,"1"]}]}}"#;
            let length = text.len();
            // The client may have closed the connection.
            let _ = write!(
                stream,
                "HTTP/1.1 200 OK\r\nContent-Length: {length}\r\n\r\n{text}"
            );
        }
    });
    address
}

/// Returns a configuration with the view of a fleet whose robots deliver as this one.
fn view(robot: &Robot, engine: std::net::SocketAddr) -> PathBuf {
    let text = format!(
        "fleet:\n  engine: http://{engine}\n  store:\n    url: {}\n    {}\n    credentials_file: {}\n",
        robot.url,
        robot.more,
        robot.path("ship.env").display()
    );
    fs::write(robot.path("fleet.yaml"), text).unwrap();
    robot.path("fleet.yaml")
}

fn fleet(config: &Path, arguments: &[&str]) -> String {
    let mut rp = rp();
    rp.args(["fleet", "--config"]).arg(config).args(arguments);
    let output = rp.output().unwrap();
    let all = format!("{output:?}");
    assert!(!all.contains(SECRET), "{all}");
    String::from_utf8(output.stdout).unwrap() + &String::from_utf8(output.stderr).unwrap()
}

#[test]
fn the_incidents_of_a_fleet_are_those_that_robots_delivered() {
    let store = Store::start();
    let robot = Robot::of(&store);
    let folder = tempfile::tempdir().unwrap();
    let to_folder = Robot::to(&format!("file://{}", folder.path().display()), "");
    for robot in [&robot, &to_folder] {
        robot.record("drive", 1_000, 50);
        robot.snapshot("incident_1", 2_000, 40);
        robot.snapshot("incident_2", 3_000, 30);
        robot.delivers();
        let config = view(robot, engine());
        for arguments in [&[][..], &["robot-17"]] {
            let text = fleet(&config, arguments);
            let (_, incidents) = text.split_once("\nincidents\n").expect(&text);
            let bags: Vec<_> = incidents
                .lines()
                .filter_map(|line| line.split_whitespace().last())
                .filter(|word| word.starts_with("incident_"))
                .collect();
            assert_eq!(bags, ["incident_2", "incident_1"], "{text}");
            assert!(incidents.contains(" robot-17  participant_lost "), "{text}");
            assert!(incidents.contains("findings unknown"), "{text}");
        }
        let json: Value = serde_json::from_str(&fleet(&config, &["robot-17", "--json"])).unwrap();
        let found = &json["incidents"]["bags"][0];
        assert_eq!(json["name"], "robot-17");
        assert_eq!(found["is_complete"], true);
        assert!(found["bytes"].as_u64() > Some(3_000), "{found}");
    }
    let other = fleet(
        &view(&robot, engine()),
        &["robot-17", "--engine", "http://127.0.0.1:9"],
    );
    assert!(other.contains("the connection failed"), "{other}");
    let pages = store.served();
    let lists = pages
        .iter()
        .filter(|call| call.operation == Operation::List);
    assert!(lists.count() > 3, "the listing has pages: {pages:#?}");
}

#[test]
fn a_fleet_shows_a_store_out_of_reach_and_keeps_the_last_incidents() {
    let store = Store::start();
    let robot = Robot::of(&store);
    robot.snapshot("incident_1", 2_000, 40);
    robot.delivers();
    let config = view(&robot, engine());
    let arguments = ["--config", config.to_str().unwrap(), "--speed", "max"];
    let agent = LocalAgent::start(&mut rp(), &arguments);
    let incidents = |wanted: &dyn Fn(&Value) -> bool| {
        let deadline = Instant::now() + 2 * PATIENCE;
        loop {
            let (status, answer) = call_api(agent.api, "GET", "/fleet", "");
            assert_eq!(status, 200, "{answer}");
            if wanted(&answer["incidents"]) && answer["at"].is_number() {
                return answer["incidents"].clone();
            }
            assert!(Instant::now() < deadline, "{answer}");
            std::thread::sleep(Duration::from_millis(50));
        }
    };
    let found = incidents(&|found| found["at"].is_number());
    assert_eq!(found["bags"][0]["bag"], "incident_1", "{found}");
    assert_eq!(found["bags"][0]["robot"], "robot-17", "{found}");
    assert_eq!(
        (&found["problem"], &found["is_cut"]),
        (&Value::Null, &json!(false))
    );
    let reads = |store: &Store| {
        let served = store.served();
        let of_manifest = |call: &&Call| {
            call.operation == Operation::Get && call.object.ends_with("manifest.json")
        };
        served.iter().filter(of_manifest).count()
    };
    let read = reads(&store);
    store.decide(|_| RequestOutcome::Refuse(503, None));
    let failed = incidents(&|found| found["problem"].is_string());
    let problem = failed["problem"].as_str().unwrap();
    assert!(problem.contains("503"), "{problem}");
    assert_eq!(failed["bags"], found["bags"], "the last known ones stay");
    store.decide(|_| RequestOutcome::Serve);
    incidents(&|found| found["problem"].is_null());
    assert_eq!(reads(&store), read, "no manifest is read twice");
    // `rp fleet` with a store that does not answer has a problem and no empty list.
    store.decide(|_| RequestOutcome::Refuse(403, None));
    let text = fleet(&config, &[]);
    assert!(text.contains("the store cannot be read: "), "{text}");
    assert!(text.contains("403") && !text.contains("\n  none"), "{text}");
}
