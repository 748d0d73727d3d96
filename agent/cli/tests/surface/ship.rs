//! `rp ship` delivers bags to a folder and to a store of S3, through refusals, cut connections and
//! its own death: each bag once, whole, with its manifest.

mod deletion;
mod fleet;
mod folder;
mod killed;
mod order;
mod service;
mod store;

use std::collections::BTreeMap;
use std::fs::{self, File, FileTimes};
use std::io::Read as _;
use std::path::{Path, PathBuf};
use std::process::{Child, Output, Stdio};
use std::time::{Duration, Instant, SystemTime};

use crate::rp;
use ros2probe_bag::{Options, TopicDescription, Writer};
use ros2probe_testing::s3::{BUCKET, Operation, Store, hex};
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
