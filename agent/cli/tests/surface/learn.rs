//! `rp learn` on captures in virtual time. Its output is a valid configuration, and the learnt
//! robot meets it. Each fault of another robot violates only the expectations of its topic.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};
use std::process::{Output, Stdio};

use crate::rp;
use ros2probe::learn::watchlist::parameters;
use ros2probe_api::parameters::{Parameter, Parameters};
use ros2probe_daemon::config::Config;
use ros2probe_testing::local_agent::{LocalAgent, request};
use ros2probe_testing::model::capture::{Capture, ETHERNET, reader, writer};
use ros2probe_testing::pseudo_terminal::Terminal;
use ros2probe_wire::GuidPrefix;
use serde_json::Value;

const ALICE: GuidPrefix = GuidPrefix(*b"\x01\x10learn.alic");
const BOB: GuidPrefix = GuidPrefix(*b"\x01\x10learn.bobb");
const START: u64 = 1_800_000_000 * SECOND;
const SECOND: u64 = 1_000_000_000;
const CAPTURE_SECONDS: u64 = 60;

/// Topics and their periods in milliseconds.
const TOPICS: [(&str, u64); 6] = [
    ("rt/imu", 10),
    ("rt/scan", 100),
    ("rt/odom", 50),
    ("rt/points", 95),
    ("rt/status", 1000),
    ("rt/map", 5000),
];

/// A fault of a topic.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Fault {
    /// Only every second message is sent.
    HalfRate,
    /// No message is sent after 30 s.
    Silent,
    /// Every fifth message is lost.
    Lossy,
    /// The topic has no subscriber, so the writer sends nothing.
    NoSubscriber,
}

/// The time of a packet, and a function that adds the packet to a capture.
type Packet = (u64, Box<dyn Fn(&mut Capture)>);

/// Writes a capture of the robot, with these faults by topic.
fn robot(path: &Path, faults: &[(&str, Fault)]) {
    let mut packets: Vec<Packet> = Vec::new();
    for prefix in [ALICE, BOB] {
        let announce = move |capture: &mut Capture| capture.participant(START, 0, prefix);
        packets.push((START, Box::new(announce)));
    }
    for (number, (name, period)) in TOPICS.into_iter().enumerate() {
        let fault = faults.iter().find(|(topic, _)| *topic == name);
        let fault = fault.map(|(_, fault)| *fault);
        topic(&mut packets, number, name, period, fault);
    }
    packets.sort_by_key(|(time, _)| *time);
    let mut capture = Capture::new(ETHERNET);
    for (_, put) in packets {
        put(&mut capture);
    }
    capture.write(path);
}

/// Adds the endpoints and the messages of one topic.
fn topic(
    packets: &mut Vec<Packet>,
    number: usize,
    name: &'static str,
    period: u64,
    fault: Option<Fault>,
) {
    let (from, to) = (writer(ALICE, number), reader(BOB, number));
    let announcement = number as u64 + 1;
    let at = START + SECOND / 10;
    packets.push((
        at,
        Box::new(move |capture| capture.writer(at, 0, from, name, announcement)),
    ));
    if fault == Some(Fault::NoSubscriber) {
        return;
    }
    packets.push((
        at,
        Box::new(move |capture| capture.reader(at, 0, to, name, announcement)),
    ));
    let mut sequence_number = 0;
    for count in 0..CAPTURE_SECONDS * 1000 / period {
        let since = SECOND / 2 + count * period * 1_000_000;
        let is_sent = match fault {
            Some(Fault::HalfRate) => count % 2 == 0,
            Some(Fault::Silent) => since < 30 * SECOND,
            _ => true,
        };
        sequence_number += u64::from(is_sent);
        let is_lost = fault == Some(Fault::Lossy) && count % 5 == 4;
        if is_sent && !is_lost {
            let (at, number) = (START + since, sequence_number);
            packets.push((
                at,
                Box::new(move |capture| capture.sample(at, 0, from, number)),
            ));
        }
    }
}

fn run(arguments: &[&str]) -> Output {
    let mut rp = rp();
    rp.env_remove("ROS_DOMAIN_ID").env_remove("ROS_DISTRO");
    rp.args(arguments).stdin(Stdio::null()).output().unwrap()
}

fn stdout(output: &Output) -> String {
    String::from_utf8(output.stdout.clone()).unwrap()
}

fn stderr(output: &Output) -> String {
    String::from_utf8(output.stderr.clone()).unwrap()
}

/// Learns from a capture, and writes the result to a file beside it.
fn learn(capture: &Path) -> PathBuf {
    let file = capture.with_extension("yaml");
    let words = ["learn", "--replay", capture.to_str().unwrap(), "-o"];
    let output = run(&[&words[..], &[file.to_str().unwrap()]].concat());
    assert_eq!(output.status.code(), Some(0), "{}", stderr(&output));
    let output_text = stderr(&output);
    assert_eq!(output_text.lines().count(), 1, "{output_text}");
    assert!(
        output_text.starts_with("rp: expectations for "),
        "{output_text}"
    );
    file
}

/// Replays a capture with this configuration. Returns the topics that were violated or silent at
/// any time, with the violated expectations.
fn violations(capture: &Path, configuration: &Path) -> BTreeMap<String, BTreeSet<String>> {
    let configuration = configuration.to_str().unwrap();
    let arguments = ["--speed", "max", "--config", configuration];
    let mut agent = LocalAgent::replay(&mut rp(), capture, &arguments);
    agent.wait_for_log("the capture has ended");
    let path = "/events?after=0&follow=false&name=ros2.topic.expectation_changed";
    let body = request(agent.api, "GET", path, "").body;
    let mut violations: BTreeMap<String, BTreeSet<String>> = BTreeMap::new();
    for data in body.lines().filter_map(|line| line.strip_prefix("data: ")) {
        let event: Value = serde_json::from_str(data).unwrap();
        let attributes = &event["attributes"];
        if !matches!(attributes["to"].as_str(), Some("violated" | "silent")) {
            continue;
        }
        let topic = attributes["topic"].as_str().unwrap().to_owned();
        let keys = attributes["violations"].as_array().unwrap().iter();
        let keys = keys.map(|key| key.as_str().unwrap().to_owned());
        violations.entry(topic).or_default().extend(keys);
    }
    violations
}

#[test]
fn a_healthy_robot_violates_no_learnt_expectation_and_each_fault_violates_one() {
    let directory = tempfile::tempdir().unwrap();
    let healthy = directory.path().join("healthy.pcap");
    robot(&healthy, &[]);
    let file = learn(&healthy);
    let checked = run(&["check-config", file.to_str().unwrap()]);
    assert_eq!(checked.status.code(), Some(0), "{}", stderr(&checked));
    assert!(
        stdout(&checked).contains("6 watched"),
        "{}",
        stdout(&checked)
    );
    let text = std::fs::read_to_string(&file).unwrap();
    for (line, count) in [
        ("    min_rate_hz: 80 ", 1),
        ("    max_rate_hz: 120\n", 1),
        ("    publishers: 1 ", 6),
        ("    subscribers: 1 ", 6),
        ("    max_silence_s: 13.5 ", 1),
        ("    # no max_loss_ratio: 2 messages in 10 s are too few", 1),
    ] {
        assert_eq!(text.matches(line).count(), count, "`{line}` in\n{text}");
    }
    assert!(violations(&healthy, &file).is_empty(), "{text}");

    let faulty = directory.path().join("faulty.pcap");
    robot(
        &faulty,
        &[
            ("rt/imu", Fault::HalfRate),
            ("rt/scan", Fault::Silent),
            ("rt/odom", Fault::Lossy),
            ("rt/points", Fault::NoSubscriber),
        ],
    );
    let found = violations(&faulty, &file);
    let topics: Vec<_> = found.keys().map(String::as_str).collect();
    assert_eq!(topics, ["/imu", "/odom", "/points", "/scan"], "{found:?}");
    let keys = |topic: &str| -> Vec<&str> { found[topic].iter().map(String::as_str).collect() };
    assert_eq!(keys("/imu"), ["min_rate_hz"]);
    assert!(found["/odom"].contains("max_loss_ratio"), "{found:?}");
    assert_eq!(keys("/points"), ["subscribers"]);
    assert!(found["/scan"].contains("max_silence_s"), "{found:?}");
}

#[test]
fn real_robots_violate_no_expectation_learnt_from_them() {
    let data = Path::new(env!("CARGO_MANIFEST_DIR")).join("../testing/data");
    let directory = tempfile::tempdir().unwrap();
    for capture in [
        "cyclonedds/lifecycle-2ns/capture.pcap.gz",
        "fastrtps-udp/lifecycle-2ns/capture.pcap.gz",
        "jazzy-cyclonedds/lifecycle-2ns/capture.pcap.gz",
    ] {
        let copy = directory.path().join(capture.replace('/', "-"));
        std::fs::copy(data.join(capture), &copy).unwrap();
        let file = learn(&copy);
        let text = std::fs::read_to_string(&file).unwrap();
        let checked = run(&["check-config", file.to_str().unwrap()]);
        assert!(checked.status.success(), "{}{text}", stderr(&checked));
        assert!(text.contains("    # no min_rate_hz"), "{capture}: {text}");
        let found = violations(&copy, &file);
        assert!(found.is_empty(), "{capture}: {found:?} {text}");
    }
}

#[test]
fn the_known_parameters_of_a_domain_are_a_valid_configuration() {
    let parameter = |domain_id, value: &'static str| Parameter {
        domain_id,
        ros_node: "/planner".into(),
        name: "frame".into(),
        value: value.into(),
        timestamp_seconds: 0.0,
    };
    let known = |parameters| Parameters {
        parameters,
        ..Parameters::default()
    };
    let text = parameters(
        &known(vec![parameter(0, "'a \"b\"'"), parameter(5, "1")]),
        0,
    );
    let config = Config::parse(text.as_bytes()).unwrap();
    let values = config.expected_parameters.iter().map(|each| &*each.value);
    assert_eq!(values.collect::<Vec<_>>(), ["'a \"b\"'"], "{text}");
    let many = parameters(&known(vec![parameter(0, "1"); 1030]), 0);
    assert!(many.ends_with("    # Parameters beyond the limit of 1024: 6\n"));
    let many = Config::parse(many.as_bytes()).unwrap();
    assert_eq!(many.expected_parameters.len(), 1024);
    assert!(parameters(&known(Vec::new()), 0).starts_with("# No parameter is known"));
}

#[test]
fn a_file_is_replaced_only_with_force_and_a_failure_leaves_no_file() {
    let directory = tempfile::tempdir().unwrap();
    let capture = directory.path().join("robot.pcap");
    robot(&capture, &[]);
    let capture = capture.to_str().unwrap();
    let file = directory.path().join("watchlist.yaml");
    std::fs::write(
        &file,
        "mine: a long text that must not remain behind a shorter one",
    )
    .unwrap();
    let file = file.to_str().unwrap();
    let words = ["learn", "/status", "--replay", capture, "-o", file];
    let refused = run(&words);
    assert_eq!(refused.status.code(), Some(1));
    let expected = format!("rp: {file} exists; pass --force to replace it\n");
    assert_eq!(stderr(&refused), expected);
    assert!(std::fs::read_to_string(file).unwrap().starts_with("mine"));
    let forced = run(&[&words[..], &["--force"]].concat());
    assert!(forced.status.success(), "{}", stderr(&forced));
    let text = std::fs::read_to_string(file).unwrap();
    assert_eq!(text.matches("  - topic: ").count(), 1, "{text}");
    assert!(!text.contains("mine"), "{text}");

    // Without -o, the text goes to standard output.
    let printed = run(&["learn", "/status", "--replay", capture]);
    assert_eq!(stdout(&printed), text);
    for (words, part) in [
        (["learn", "/a b"], "the topic `/a b` has the character ` `"),
        (
            ["learn", "/nowhere"],
            "no topic was seen; nothing is written",
        ),
        (["learn", "/a//b"], "has a name token without letters"),
    ] {
        let other = directory.path().join("other.yaml");
        let output = other.to_str().unwrap();
        let failed = run(&[&words[..], &["--replay", capture, "-o", output]].concat());
        let output_text = stderr(&failed);
        assert_eq!(failed.status.code(), Some(1), "{output_text}");
        assert!(
            output_text.contains(part),
            "`{part}` is not in {output_text}"
        );
        assert!(!other.exists());
    }
    let missing = directory.path().join("no/such/directory.yaml");
    let failed = run(&[
        "learn",
        "--replay",
        capture,
        "-o",
        missing.to_str().unwrap(),
    ]);
    assert!(
        stderr(&failed).contains("cannot write"),
        "{}",
        stderr(&failed)
    );
    let nothing = run(&["learn", "--replay", "/nowhere.pcap"]);
    assert!(stderr(&nothing).contains("cannot replay /nowhere.pcap"));
}

#[test]
fn the_progress_takes_one_line_of_a_terminal() {
    let directory = tempfile::tempdir().unwrap();
    let capture = directory.path().join("robot.pcap");
    robot(&capture, &[]);
    let file = directory.path().join("watchlist.yaml");
    let mut rp = rp();
    rp.args(["learn", "--replay"])
        .arg(&capture)
        .arg("-o")
        .arg(&file);
    let mut terminal = Terminal::start(&mut rp);
    assert_eq!(terminal.ends(), Some(0), "{}", terminal.written());
    let written = terminal.written();
    let progress = "\rlearning 6 topics: 0:59 of the capture; Ctrl-C ends early\u{1b}[K";
    assert!(written.contains(progress), "{written:?}");
    let screen = terminal.screen();
    assert!(
        screen.starts_with("rp: expectations for 6 of 6 topics"),
        "{screen}"
    );
}

#[test]
fn rp_learn_reads_a_capture_up_to_the_end_time_and_refuses_invalid_minutes() {
    let directory = tempfile::tempdir().unwrap();
    let capture = directory.path().join("robot.pcap");
    robot(&capture, &[]);
    let words = [
        "learn",
        "--replay",
        capture.to_str().unwrap(),
        "--until",
        "+40",
    ];
    let cut = run(&words);
    assert!(stderr(&cut).contains("learnt in 40 s"), "{}", stderr(&cut));
    for wrong in ["0", "121", "x"] {
        let refused = run(&[&words[..], &["--minutes", wrong]].concat());
        assert_eq!(refused.status.code(), Some(2), "{wrong}");
    }
}
