//! Bags that the agent writes on request of the API: start, pause, split and end. Also bags of the
//! last seconds before the violation of an expectation.

mod begin_and_end;
mod captures;
mod late;

use std::collections::BTreeMap;
use std::io::{BufRead as _, BufReader};
use std::net::SocketAddr;
use std::os::unix::net::UnixListener;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, ExitStatus, Stdio};
use std::sync::mpsc::{Receiver, channel};
use std::time::{Duration, Instant};

use crate::rp;
use ros2probe_testing::bag_messages::for_each_message;
use ros2probe_testing::local_agent::{self, LocalAgent, call_api};
use ros2probe_testing::model::capture::{Capture, ETHERNET, reader, writer};
use ros2probe_wire::GuidPrefix;
use ros2probe_wire::time::SECOND;
use serde_json::Value;
use tempfile::TempPath;

const START: u64 = 1_795_143_000 * SECOND;
const ALICE: GuidPrefix = GuidPrefix(*b"\x01\x10alice-host");
/// Maximum wait for an answer, a line or an end on a busy machine.
const PATIENCE: Duration = Duration::from_secs(90);
/// Number of topics of a robot with navigation and two cameras.
const MANY: usize = 171;

/// Starts an agent that may write bags and replays slowly.
fn agent(directory: &Path, more: &str) -> LocalAgent {
    agent_on(&local_agent::capture(), directory, "0.5", more)
}

/// Writes a capture of ten minutes with a publisher of `/chatter` at 10 Hz. No test outlasts it.
pub(crate) fn long_capture() -> TempPath {
    let file = tempfile::NamedTempFile::with_suffix(".pcap").unwrap();
    let path = file.into_temp_path();
    let mut capture = Capture::new(ETHERNET);
    let source = writer(ALICE, 0);
    capture.participant(START, 0, ALICE);
    capture.writer(START + 1, 0, source, "rt/chatter", 1);
    for number in 1..=6_000 {
        capture.sample(START + number * SECOND / 10, 0, source, number);
    }
    capture.write(&path);
    path
}

fn agent_on(capture: &Path, directory: &Path, speed: &str, more: &str) -> LocalAgent {
    let configuration = directory.join("ros2probe.yaml");
    let bags = directory.join("bags");
    // The free space of the disk is relevant only in tests that set a reserve.
    let reserve = match more.contains("reserve_") {
        true => "",
        false => "  reserve_percent: 0\n  reserve_bytes: 0\n",
    };
    let text = format!(
        "recordings:\n  directory: {}\n{reserve}{more}",
        bags.display()
    );
    std::fs::write(&configuration, text).unwrap();
    let configuration = configuration.to_str().unwrap();
    LocalAgent::replay(
        &mut rp(),
        capture,
        &["--speed", speed, "--config", configuration],
    )
}

/// Repeats the request for a recording until the recording has the wanted content.
fn wait_for(api: SocketAddr, name: &str, wanted: impl Fn(&Value) -> bool) -> Value {
    let deadline = Instant::now() + PATIENCE;
    loop {
        let (status, recording) = call_api(api, "GET", &format!("/recordings/{name}"), "");
        if status == 200 && wanted(&recording) {
            return recording;
        }
        assert!(Instant::now() < deadline, "{recording}");
        std::thread::sleep(Duration::from_millis(50));
    }
}

/// Returns the sequence numbers in a bag, by topic.
fn messages(directory: &Path) -> BTreeMap<String, Vec<u32>> {
    let mut found = BTreeMap::<_, Vec<_>>::new();
    for_each_message(directory, |message| {
        let topic = message.channel.topic.clone();
        found.entry(topic).or_default().push(message.sequence);
        Ok(())
    })
    .unwrap();
    found
}

#[test]
fn a_headless_robot_records_on_request_and_lists_its_recordings() {
    let directory = tempfile::tempdir().unwrap();
    let capture = long_capture();
    let agent = agent_on(&capture, directory.path(), "1", "");
    let api = agent.api;

    let (status, begun) = call_api(api, "POST", "/recordings", r#"{"name": "drive"}"#);
    assert_eq!(
        (status, &begun["name"]),
        (201, &Value::from("drive")),
        "{begun}"
    );
    assert_eq!(begun["topics"]["all_topics"], true);
    let (status, again) = call_api(api, "POST", "/recordings", r#"{"name": "drive"}"#);
    assert_eq!(status, 409, "{again}");
    let of = |recording: &Value, key: &str| recording["report"][key].as_u64().unwrap();
    wait_for(api, "drive", |recording| of(recording, "messages") > 5);

    assert_eq!(call_api(api, "POST", "/recordings/drive/split", "").0, 202);
    assert_eq!(call_api(api, "POST", "/recordings/drive/pause", "").0, 202);
    let paused = wait_for(api, "drive", |recording| recording["state"] == "paused");
    let held = of(&paused, "messages");
    let resumed = |recording: &Value| {
        let topics = recording["report"]["topics"].as_object().unwrap();
        topics
            .values()
            .any(|topic| topic["paused"].as_u64() > Some(2))
    };
    let paused = wait_for(api, "drive", resumed);
    assert_eq!(of(&paused, "messages"), held);
    assert_eq!(call_api(api, "POST", "/recordings/drive/resume", "").0, 202);
    wait_for(api, "drive", |recording| {
        of(recording, "messages") > held + 3
    });

    agent.wait_for_metric("ros2probe_recordings", |count| count == 1.0);
    let (status, ended) = call_api(api, "DELETE", "/recordings/drive", "");
    assert_eq!(
        (status, &ended["state"]),
        (200, &Value::from("ended")),
        "{ended}"
    );
    assert_eq!((of(&ended, "missing"), &ended["error"]), (0, &Value::Null));
    let messages = messages(&directory.path().join("bags/drive"));
    let counted = messages.values().map(Vec::len).sum::<usize>() as u64;
    assert_eq!(
        (counted, ended["files"].as_u64().unwrap() >= 2),
        (of(&ended, "messages"), true)
    );
    for (topic, numbers) in &messages {
        let mut sorted = numbers.clone();
        sorted.sort_unstable();
        sorted.dedup();
        // The capture has one publisher for each topic.
        assert_eq!(&sorted, numbers, "{topic}");
    }
    let recorded = |count| count == counted as f64;
    agent.wait_for_metric("ros2probe_recorded_messages_total", recorded);
    let events = local_agent::request(api, "GET", "/events?after=0&follow=false", "").body;
    assert!(events.contains("ros2probe.recording.started") && events.contains(r#""missing":0"#));
    // A repeated request has no effect.
    assert_eq!(call_api(api, "DELETE", "/recordings/drive", "").0, 200);
}

#[test]
fn a_recording_that_reaches_a_limit_ends_with_the_reason_and_the_next_is_refused() {
    use std::os::unix::fs::PermissionsExt as _;
    let directory = tempfile::tempdir().unwrap();
    let capture = long_capture();
    let agent = agent_on(
        &capture,
        directory.path(),
        "1",
        "  max_total_bytes: 1000000\n  reserve_bytes: 65536\n  reserve_percent: 0\n",
    );
    let api = agent.api;
    let (_, all) = call_api(api, "GET", "/recordings", "");
    assert_eq!(all["limits"]["max_total_bytes"], 1_000_000, "{all}");
    assert_eq!(
        call_api(api, "POST", "/recordings", r#"{"name": "cut"}"#).0,
        201
    );
    wait_for(api, "cut", |recording| {
        recording["report"]["messages"].as_u64() > Some(5)
    });
    let bags = directory.path().join("bags");
    std::fs::create_dir(bags.join("other")).unwrap();
    std::fs::write(bags.join("other/other_0.mcap"), vec![0; 1_000_000]).unwrap();
    let ended = wait_for(api, "cut", |recording| recording["state"] == "ended");
    let reason = ended["error"].as_str().unwrap();
    assert!(reason.contains("recordings.max_total_bytes"), "{reason}");
    assert_eq!(ended["report"]["limit_reached"], reason);
    let counted = messages(&bags.join("cut"))
        .values()
        .map(Vec::len)
        .sum::<usize>();
    assert_eq!(ended["report"]["messages"], counted, "{ended}");
    let metadata = std::fs::read_to_string(bags.join("cut/metadata.yaml")).unwrap();
    assert!(metadata.contains("limit_reached"), "{metadata}");
    for (path, mode) in [
        ("cut", 0o750),
        ("cut/cut_0.mcap", 0o640),
        ("cut/metadata.yaml", 0o640),
    ] {
        let about = std::fs::metadata(bags.join(path)).unwrap();
        assert_eq!(about.permissions().mode() & 0o777, mode, "{path}");
    }
    let events = local_agent::request(api, "GET", "/events?after=0&follow=false", "").body;
    assert!(events.contains("recordings.max_total_bytes"), "{events}");
    let (status, refused) = call_api(api, "POST", "/recordings", r#"{"name": "next"}"#);
    assert_eq!(status, 507, "{refused}");
    assert!(!bags.join("next").exists());
}

#[test]
fn a_recording_that_would_use_the_reserve_is_refused() {
    let directory = tempfile::tempdir().unwrap();
    let agent = agent(directory.path(), "  reserve_bytes: 1099511627776\n");
    let (status, refused) = call_api(agent.api, "POST", "/recordings", r#"{"name": "none"}"#);
    assert_eq!(status, 507, "{refused}");
    let detail = refused["detail"].as_str().unwrap();
    assert!(detail.contains("recordings.reserve_bytes"), "{detail}");
    assert!(!directory.path().join("bags/none").exists());
}

#[test]
fn an_invalid_recording_is_refused_and_leaves_no_files() {
    let directory = tempfile::tempdir().unwrap();
    let agent = agent(directory.path(), "");
    let long = "x".repeat(129);
    for body in [
        r#"{"name": "../escape"}"#,
        r#"{"name": ""}"#,
        r#"{"name": ".hidden"}"#,
        r#"{"name": "a/b"}"#,
        &format!(r#"{{"name": "{long}"}}"#),
        r#"{"topics": {"topics": ["chatter"]}}"#,
        r#"{"topics": {"regex": "("}}"#,
        r#"{"topics": {"exclude_regex": "x"}}"#,
        r#"{"storage_preset_profile": "fastest"}"#,
        r#"{"file_compression": "gzip"}"#,
        r#"{"max_bag_size": 5}"#,
        r#"{"domain_id": 300}"#,
        r#"{"no_such_key": 1}"#,
    ] {
        let (status, problem) = call_api(agent.api, "POST", "/recordings", body);
        assert_eq!(status, 422, "{body}: {problem}");
        assert_eq!(
            problem["type"], "urn:ros2probe:problem:invalid-request",
            "{body}"
        );
    }
    assert!(!directory.path().join("bags").exists());
    assert!(!directory.path().join("escape").exists());
    for path in ["/recordings/none", "/recordings/..%2F", "/snapshots"] {
        let (status, _) = call_api(agent.api, "GET", path, "");
        assert_eq!(
            status,
            if path == "/snapshots" { 200 } else { 404 },
            "{path}"
        );
    }
    assert_eq!(call_api(agent.api, "POST", "/snapshots/none", "").0, 404);
    drop(agent);

    let nowhere = LocalAgent::start(&mut rp(), &["--speed", "0.5"]);
    let (status, problem) = call_api(nowhere.api, "POST", "/recordings", "{}");
    assert_eq!(status, 409, "{problem}");
    assert!(
        problem["detail"]
            .as_str()
            .unwrap()
            .contains("recordings.directory")
    );
}

#[test]
fn the_seconds_before_the_violation_of_an_expectation_are_written_to_a_bag() {
    let directory = tempfile::tempdir().unwrap();
    let more = "  snapshots:\n    - {name: incident, topics: ['/**'], seconds: 5}\n\
                watch: [{topic: '/**', min_rate_hz: 1000000}]\n";
    let agent = agent(directory.path(), more);
    agent.wait_for_metric(
        r#"ros2probe_snapshots_written_total{snapshot="incident"}"#,
        |count| count >= 1.0,
    );
    let bags = directory.path().join("bags");
    let bag = std::fs::read_dir(&bags).unwrap().next().unwrap().unwrap();
    assert!(
        bag.file_name()
            .to_str()
            .unwrap()
            .starts_with("incident_rosbag2_")
    );
    assert!(!messages(&bag.path()).is_empty());
    let events = local_agent::request(agent.api, "GET", "/events?after=0&follow=false", "").body;
    assert!(events.contains("ros2probe.snapshot.taken"), "{events}");

    // A request writes the messages in memory, even in the same second.
    let (status, written) = call_api(agent.api, "POST", "/snapshots/incident", "");
    assert_eq!(status, 201, "{written}");
    let path = Path::new(written["directory"].as_str().unwrap());
    let count: usize = messages(path).values().map(Vec::len).sum();
    assert_eq!(written["messages"], count as u64);
    let (_, list) = call_api(agent.api, "GET", "/snapshots", "");
    assert_eq!(list["snapshots"][0]["written"], 2, "{list}");
    assert_eq!(list["snapshots"][0]["failed"], 0, "{list}");
}

/// The capture is replayed as fast as possible. The time of the event determines the messages, not
/// the time of its arrival.
#[test]
fn the_seconds_around_an_event_are_written_to_a_bag_with_the_name_of_the_event() {
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("gap.pcap");
    let mut capture = Capture::new(ETHERNET);
    let source = writer(ALICE, 0);
    capture.participant(START, 0, ALICE);
    capture.writer(START + 1, 0, source, "rt/whole", 1);
    capture.reader(START + 2, 0, reader(ALICE, 1), "rt/whole", 1);
    for number in (1..=300).filter(|number| !(150..155).contains(number)) {
        capture.sample(START + number * SECOND / 10, 0, source, number);
    }
    capture.write(&path);
    let more = "  snapshots:\n    - {name: incident, topics: [/whole], seconds: 3, \
                seconds_after: 2, trigger: [message_lost]}\nwatch: [/whole]\n";
    let agent = agent_on(&path, directory.path(), "max", more);
    agent.wait_for_metric(
        r#"ros2probe_snapshots_written_total{snapshot="incident"}"#,
        |count| count >= 1.0,
    );
    let bags = std::fs::read_dir(directory.path().join("bags")).unwrap();
    let bags: Vec<_> = bags.map(|bag| bag.unwrap().path()).collect();
    let [bag] = bags.as_slice() else {
        panic!("{bags:?}");
    };
    let metadata = std::fs::read_to_string(bag.join("metadata.yaml")).unwrap();
    let metadata: serde_yaml::Value = serde_yaml::from_str(&metadata).unwrap();
    let metadata = &metadata["rosbag2_bagfile_information"];
    let trigger = metadata["custom_data"]["ros2probe_trigger"].as_str();
    let trigger: Value = serde_json::from_str(trigger.unwrap()).unwrap();
    assert_eq!(trigger["event"], "ros2.message.lost", "{trigger}");
    assert_eq!(trigger["attributes"]["count"], 5, "{trigger}");
    let event: jiff::Timestamp = trigger["time"].as_str().unwrap().parse().unwrap();
    let event = u64::try_from(event.as_nanosecond()).unwrap() - START;
    // Message n was sent n tenths of a second after the start.
    let tenths = |nanoseconds: u64| u32::try_from(nanoseconds * 10 / SECOND).unwrap();
    let first = tenths((event - 3 * SECOND).next_multiple_of(SECOND / 10));
    let numbers = first..=tenths(event + 2 * SECOND);
    let numbers = numbers.filter(|number| !(150..155).contains(number));
    assert_eq!(
        messages(bag)["/whole"],
        numbers.collect::<Vec<_>>(),
        "{event}"
    );
}

#[test]
fn a_late_recording_and_a_late_echo_have_the_latched_message_sent_before_them() {
    for more in ["", "watch: [{topic: /tf_static, retain: last}]\n"] {
        let directory = tempfile::tempdir().unwrap();
        let agent = agent_on(&sent_once(), directory.path(), "10", more);
        agent.wait_for_metric("ros2probe_retained_bytes", |bytes| bytes > 50.0);
        // The capture contains one message of the topic, which precedes this recording.
        let ended = record_late(&agent, 1);
        assert_eq!(ended["report"]["sent_before"], serde_json::json!([]));
        let messages = messages(&directory.path().join("bags/late"));
        assert_eq!(messages["/tf_static"].len(), 1, "{messages:?}");
        let host = agent.api.to_string();
        let echo = ["topic", "echo", "/tf_static", "--once", "--host", &host];
        let echoed = rp().args(echo).output().unwrap();
        let (out, err) = (echoed.stdout, String::from_utf8(echoed.stderr).unwrap());
        let out = String::from_utf8(out).unwrap();
        assert!(out.starts_with("transforms:\n"), "{out}{err}");
        assert!(!err.contains("latched"), "{err}");
    }
}

#[test]
fn without_retention_a_late_echo_reports_the_missing_latched_message() {
    let directory = tempfile::tempdir().unwrap();
    let mut agent = agent_on(&sent_once(), directory.path(), "10", "retain: off\n");
    agent.wait_for_log("the capture has ended");
    let host = agent.api.to_string();
    let echo = [
        "topic",
        "echo",
        "/tf_static",
        "--timeout",
        "1",
        "--host",
        &host,
    ];
    let echoed = rp().args(echo).output().unwrap();
    let printed = String::from_utf8(echoed.stderr).unwrap();
    let missing = "the latched message of /tf_static is not kept: set `retain: last` in a watch";
    assert!(printed.contains(missing), "{printed}");
    assert!(echoed.stdout.is_empty());
}

fn sent_once() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/fixtures/echo/capture.pcap.gz")
}

/// Records until the recording has this number of messages of `/tf_static`.
fn record_late(agent: &LocalAgent, messages: u64) -> Value {
    let body = r#"{"name": "late", "topics": {"topics": ["/tf_static", "/chatter"]}}"#;
    let (status, begun) = call_api(agent.api, "POST", "/recordings", body);
    assert_eq!(status, 201, "{begun}");
    wait_for(agent.api, "late", |recording| {
        recording["report"]["topics"]["/tf_static"]["messages"] == messages
    });
    let (status, ended) = call_api(agent.api, "DELETE", "/recordings/late", "");
    assert_eq!(status, 200, "{ended}");
    ended
}

#[test]
fn snapshots_without_a_directory_are_an_error_only_if_the_directory_is_off() {
    let directory = tempfile::tempdir().unwrap();
    let configuration = directory.path().join("ros2probe.yaml");
    let run = |state: &str| {
        let snapshots = "recordings: {snapshots: [{name: incident, topics: ['/**']}]}\n";
        std::fs::write(&configuration, format!("{snapshots}{state}")).unwrap();
        let output = rp()
            .args(["run", "--report", "--replay"])
            .arg(local_agent::capture())
            .arg("--config")
            .arg(&configuration)
            .output()
            .unwrap();
        let printed = String::from_utf8_lossy(&output.stderr).into_owned();
        (output.status.code(), output.stdout.len(), printed)
    };
    // A replay has no state directory, like an agent whose disk is missing.
    let (code, length, printed) = run("");
    assert_eq!(code, Some(0), "{printed}");
    assert!(length > 1000 && printed.contains("snapshots are disabled"));
    let (code, _, printed) = run("state_directory: off\n");
    assert_eq!(code, Some(1), "{printed}");
    assert!(printed.contains("the agent has no directory for recordings"));
}

/// Converts a capture. Returns the exit code of `rp bag convert`, its standard error, and the
/// report in the bag.
fn converted(capture: &Path, bag: &Path, options: &[&str]) -> (Option<i32>, String, Value) {
    let mut command = rp();
    command
        .args(["bag", "convert"])
        .args([capture, bag])
        .args(options);
    command.env_remove("ROS_DISTRO").env_remove("ROS_DOMAIN_ID");
    let output = command.stdin(Stdio::null()).output().unwrap();
    assert!(output.stdout.is_empty(), "{output:?}");
    let printed = String::from_utf8(output.stderr).unwrap();
    let metadata = std::fs::read_to_string(bag.join("metadata.yaml")).unwrap_or_default();
    let metadata = ros2probe_bag::metadata::Metadata::read(&metadata).ok();
    let report = metadata.and_then(|mut metadata| metadata.custom_data.remove("ros2probe"));
    let report = report.map(|report| serde_json::from_str(&report).unwrap());
    (output.status.code(), printed, report.unwrap_or_default())
}

/// Writes a capture of one minute with `MANY` topics, each with one message per second.
fn many_topics(path: &Path) {
    let mut capture = Capture::new(ETHERNET);
    capture.participant(START, 0, ALICE);
    for topic in 0..MANY {
        let guid = writer(ALICE, topic);
        capture.writer(
            START,
            0,
            guid,
            &format!("rt/topic{topic}"),
            topic as u64 + 1,
        );
    }
    for second in 1..60 {
        for topic in 0..MANY {
            let time = START + second * SECOND + topic as u64 * 1_000_000;
            capture.sample(time, 0, writer(ALICE, topic), second);
        }
    }
    capture.write(path);
}

/// A process of `rp bag record`, and its lines on stderr.
struct Recording {
    child: Child,
    lines: Receiver<String>,
    printed: Vec<String>,
}

impl Recording {
    fn start(api: SocketAddr, bag: &Path, options: &[&str]) -> Self {
        let mut command = rp();
        command.args(["bag", "record", "-a", "--host", &api.to_string(), "-o"]);
        command.arg(bag).args(options);
        Self::of(&mut command)
    }

    fn of(command: &mut Command) -> Self {
        command.env_remove("ROS_DISTRO").env_remove("ROS_DOMAIN_ID");
        command.stdin(Stdio::null()).stderr(Stdio::piped());
        let mut child = command.spawn().unwrap();
        let stderr = BufReader::new(child.stderr.take().unwrap());
        let (give, lines) = channel();
        std::thread::spawn(move || {
            let mut lines = stderr.lines().map_while(Result::ok);
            lines.all(|line| give.send(line).is_ok())
        });
        Self {
            child,
            lines,
            printed: Vec::new(),
        }
    }

    /// Waits for a line with `text`, and returns the waiting time.
    fn wait_for(&mut self, text: &str) -> Duration {
        let begun = Instant::now();
        loop {
            let left = PATIENCE.saturating_sub(begun.elapsed());
            let Ok(line) = self.lines.recv_timeout(left) else {
                panic!("no `{text}` in {:#?}", self.printed);
            };
            self.printed.push(line);
            if self.printed.last().unwrap().contains(text) {
                return begun.elapsed();
            }
        }
    }

    fn signal(&self, name: &str) {
        let id = self.child.id().to_string();
        let sent = Command::new("kill").args([name, &id]).status().unwrap();
        assert!(sent.success());
    }

    /// Waits for the end, and returns the exit status and the waiting time.
    fn end(&mut self) -> (ExitStatus, Duration) {
        let begun = Instant::now();
        let status = loop {
            if let Some(status) = self.child.try_wait().unwrap() {
                break status;
            }
            assert!(begun.elapsed() < PATIENCE, "{:#?}", self.printed);
            std::thread::sleep(Duration::from_millis(20));
        };
        self.printed.extend(self.lines.iter());
        (status, begun.elapsed())
    }
}

impl Drop for Recording {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}
