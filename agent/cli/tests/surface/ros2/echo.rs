//! `rp topic echo` on a capture: the output equals that of ros2cli for the same messages.

use std::path::{Path, PathBuf};

use ros2probe_message::MessageType;
use ros2probe_testing::local_agent::LocalAgent;
use ros2probe_testing::model::capture::{Capture, ETHERNET};
use ros2probe_testing::model::forge::{self, Message, SEDP_WRITERS};
use ros2probe_testing::type_description::{Response, described, field};
use ros2probe_wire::{EntityId, Guid, GuidPrefix};
use serde::Deserialize;

use super::{fails_with, run, stderr, stdout};
use crate::rp;

#[derive(Deserialize)]
struct Recorded {
    name: String,
    command: Vec<String>,
    start: String,
    end: String,
    code: i32,
    stdout: String,
    stderr: String,
}

fn own() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/fixtures/echo")
}

/// Runs a command with the capture. Messages between `from` and `until` are echoed.
fn echo(arguments: &[&str], from: &str, until: &str) -> std::process::Output {
    let capture = own().join("capture.pcap.gz");
    let capture = ["--replay", capture.to_str().unwrap()];
    let times = ["--from", from, "--until", until];
    run(&[arguments, &["--distro", "humble"], &capture, &times].concat())
}

/// The recorded subscription began at an unknown time between the start and the end of its command.
/// Its output is therefore a part of the whole output for this time.
#[test]
fn echo_prints_the_output_of_ros2cli() {
    let text = std::fs::read_to_string(own().join("recorded.jsonl")).unwrap();
    let differences =
        Path::new(env!("CARGO_MANIFEST_DIR")).join("../../docs/ros2cli-differences.md");
    let differences = std::fs::read_to_string(differences).unwrap();
    let mut same = 0;
    let mut listed = 0;
    for line in text.lines() {
        let recorded: Recorded = serde_json::from_str(line).unwrap();
        let Recorded {
            name,
            command,
            start,
            end,
            ..
        } = &recorded;
        if differences.contains(&format!("| `{name}` |")) {
            listed += 1;
            continue;
        }
        let arguments: Vec<&str> = command.iter().map(String::as_str).collect();
        let arguments: Vec<&str> = arguments
            .into_iter()
            .filter(|argument| *argument != "--once")
            .collect();
        let output = echo(&arguments, start, end);
        let output_text = stdout(&output);
        let whole = output_text.split_inclusive('\n').collect::<Vec<_>>();
        let part = recorded.stdout.split_inclusive('\n').collect::<Vec<_>>();
        let is_part = part.is_empty() && whole.is_empty()
            || !part.is_empty() && whole.windows(part.len()).any(|window| window == part);
        assert!(is_part, "{name}: {output_text}{}", stderr(&output));
        if recorded.code == 1 {
            assert_eq!(output_text, recorded.stdout, "{name}");
            // The reason for missing messages follows the output of ros2cli.
            let why = |line: &&str| !line.starts_with("rp: no message on ");
            let err = stderr(&output);
            let err: String = err.split_inclusive('\n').filter(why).collect();
            assert_eq!(err, recorded.stderr, "{name}");
            assert_eq!(output.status.code(), Some(1), "{name}");
        } else {
            assert_eq!(output.status.code(), Some(0), "{name}: {}", stderr(&output));
        }
        same += 1;
    }
    assert_eq!((same, listed), (16, 5));
}

const START: &str = "1795142521.395070661";
const END: &str = "1795142522.806041638";
const IMU: &str = "/robot1/imu/data";

#[test]
fn options_select_the_echoed_messages_and_the_end() {
    let lines = |further: &[&str]| {
        let output = echo(&[&["topic", "echo", IMU], further].concat(), START, END);
        assert_eq!(
            (output.status.code(), stderr(&output).as_str()),
            (Some(0), "")
        );
        stdout(&output)
    };
    let all = lines(&["--field", "linear_acceleration.x"]);
    assert!(all.starts_with("260"), "{all}");
    let count = all.matches("---\n").count();
    assert!((200..400).contains(&count), "{count}");
    let once = lines(&["--field", "linear_acceleration.x", "--once"]);
    assert_eq!(
        once.lines().collect::<Vec<_>>(),
        all.lines().take(2).collect::<Vec<_>>()
    );
    let half = lines(&["--field", "linear_acceleration.x", "--timeout", "0.5"]);
    let count = half.matches("---\n").count();
    assert!((95..=105).contains(&count), "{count}");
    let filter = "26100 <= m.linear_acceleration.x < 26103 and m.header.frame_id == 'imu_link'";
    let chosen = lines(&["--filter", filter, "--csv"]);
    assert_eq!(chosen.lines().count(), 3, "{chosen}");
    let array = lines(&["--field", "orientation_covariance", "--once"]);
    assert_eq!(array, "[-1.  0.  0.  0.  0.  0.  0.  0.  0.]\n---\n");
    let flow = lines(&["--once", "--flow-style"]);
    assert!(flow.starts_with("header:\n  stamp:\n"), "{flow}");
    assert!(
        flow.contains("\norientation_covariance: [-1.0, 0.0, 0.0, 0.0,"),
        "{flow}"
    );
    let words = lines(&["--once", "--flow-style", "--no-arr"]);
    assert!(
        words.contains("\norientation_covariance: '<array type: double[9]>'\n"),
        "{words}"
    );
    let raw = lines(&["--once", "--raw"]);
    assert!(raw.starts_with("b'\\x00\\x01\\x00\\x00"), "{raw}");
    let twice = lines(&[
        "--once",
        "--field",
        "header.frame_id",
        "--field",
        "orientation",
    ]);
    assert_eq!(twice, "imu_link\nx: 0.0\ny: 0.0\nz: 0.0\nw: 1.0\n---\n");
}

#[test]
fn a_topic_that_cannot_be_echoed_is_reported_in_one_line() {
    let ask = |further: &[&str]| echo(&[&["topic", "echo", IMU], further].concat(), START, END);
    fails_with(
        &ask(&["--field", "orientation.v"]),
        "Invalid field 'orientation.v': 'Quaternion' object has no attribute 'v'",
    );
    fails_with(&ask(&["--field", "."]), "Invalid field value '.'");
    fails_with(
        &ask(&["--filter", "m.x = 1"]),
        "filter, column 5: `=` assigns",
    );
    fails_with(
        &ask(&["--filter", "m.x > 1"]),
        "'Imu' object has no attribute 'x'",
    );
    fails_with(&ask(&["Imu"]), "The passed message type is invalid");
    fails_with(
        &ask(&["no_msgs/msg/None"]),
        "no definition of no_msgs/msg/None",
    );
    assert_eq!(ask(&["--timeout", "0"]).status.code(), Some(2));
    assert_eq!(ask(&["-l", "-1"]).status.code(), Some(2));
    // With a type other than the writer's, no message is printed, and stderr has the reason.
    let other = ask(&["std_msgs/msg/String"]);
    assert_eq!(
        (stdout(&other).as_str(), other.status.code()),
        ("", Some(0))
    );
    assert!(
        stderr(&other).contains("carries sensor_msgs/msg/Imu"),
        "{}",
        stderr(&other)
    );
}

/// Service events are not in this capture: only the type is checked.
#[test]
fn a_type_without_its_kind_is_that_of_the_command() {
    let once = ["topic", "echo", IMU, "--once"];
    let full = echo(&[&once[..], &["sensor_msgs/msg/Imu"]].concat(), START, END);
    let short = echo(&[&once[..], &["sensor_msgs/Imu"]].concat(), START, END);
    assert!(stdout(&full).starts_with("header:\n"), "{}", stderr(&full));
    assert_eq!(short, full);

    let capture = Path::new(env!("CARGO_MANIFEST_DIR"))
        .join("../testing/data/cyclonedds/lifecycle-2ns/capture.pcap.gz");
    let replay = ["--csv", "--replay", capture.to_str().unwrap()];
    for (command, name, package, kind, type_name) in [
        (
            "action",
            "fibonacci",
            "example_interfaces",
            "action",
            "Fibonacci",
        ),
        (
            "service",
            "add_two_ints",
            "example_interfaces",
            "srv",
            "AddTwoInts",
        ),
    ] {
        let name = format!("/robot1/{name}");
        let ask = |type_name: &str| {
            let words = [command, "echo", &name, type_name];
            run(&[&words[..], &replay].concat())
        };
        let full = ask(&format!("{package}/{kind}/{type_name}"));
        assert_eq!(full.status.code(), Some(0), "{}", stderr(&full));
        assert_eq!(ask(&format!("{package}/{type_name}")), full, "{command}");
    }
}

#[test]
fn a_type_that_is_no_service_or_action_is_refused() {
    for (command, type_name) in [
        ("service", "AddTwoInts"),
        ("service", "std_msgs/msg/String"),
        ("action", "example_interfaces/"),
        ("action", "example_interfaces/srv/AddTwoInts"),
    ] {
        let output = run(&[
            command,
            "echo",
            "/a",
            type_name,
            "--replay",
            "/nowhere.pcap",
        ]);
        let reason = format!("The service type '{type_name}' is invalid");
        fails_with(&output, &reason);
    }
}

#[test]
fn a_service_of_two_types_is_echoed_only_with_its_type() {
    let capture = super::graph::own().join("mixed.pcap.gz");
    let mut agent = LocalAgent::replay(&mut rp(), &capture, &["--speed", "max"]);
    agent.wait_for_log("the capture has ended");
    let host = agent.api.to_string();
    let ask = |words: &[&str]| {
        let command = ["service", "echo", "--host", &host];
        run(&[&command[..], words].concat())
    };
    fails_with(
        &ask(&["/mixed/serve"]),
        "More than one type associated with service '/mixed/serve'",
    );
    fails_with(&ask(&["/nope"]), "Cannot find type for '/nope'");
    // The name is printed as it was typed.
    let silent = ask(&["mixed/serve", "std_srvs/srv/Trigger"]);
    let begin = "No publishers on topic 'mixed/serve/_service_event'; is service introspection";
    let printed = stdout(&silent);
    assert!(printed.starts_with(begin), "{printed}{}", stderr(&silent));
}

#[test]
fn only_messages_that_match_the_filter_are_measured() {
    let hz = |further: &[&str]| {
        let output = echo(&[&["topic", "hz", IMU], further].concat(), START, END);
        assert_eq!(output.status.code(), Some(0), "{}", stderr(&output));
        stdout(&output)
    };
    let rate = hz(&["--filter", "m.linear_acceleration.x % 2 == 0"]);
    assert!(
        rate.starts_with("average rate: 100.0") || rate.starts_with("average rate: 99.9"),
        "{rate}"
    );
    assert!(
        hz(&[]).starts_with("average rate: 200.0") || hz(&[]).starts_with("average rate: 199.9")
    );
}

/// The recordings have goals of order 4. Jazzy announces type hashes.
#[test]
fn action_echo_prints_feedback_and_states_with_every_middleware() {
    let directory = tempfile::tempdir().unwrap();
    let place = directory.path().join("example_interfaces/action");
    std::fs::create_dir_all(&place).unwrap();
    let another = "int64 order\n---\nint64 sum\n---\nint64 sum\n";
    std::fs::write(place.join("Fibonacci.action"), another).unwrap();
    let definitions = ["--definitions", directory.path().to_str().unwrap()];
    let data = Path::new(env!("CARGO_MANIFEST_DIR")).join("../testing/data");
    for software in ["cyclonedds", "fastrtps-udp", "jazzy-cyclonedds"] {
        let capture = data.join(software).join("lifecycle-2ns/capture.pcap.gz");
        let command = ["action", "echo", "/robot1/fibonacci", "--csv", "--replay"];
        let arguments = [&command[..], &[capture.to_str().unwrap()]].concat();
        let output = run(&arguments);
        assert_eq!(stderr(&output), "", "{software}");
        let output_text = stdout(&output);
        let lines: Vec<&str> = output_text.lines().collect();
        let of = |part: &str| -> Vec<&str> {
            let pairs = lines.chunks_exact(2);
            pairs
                .filter(|pair| pair[0] == format!("interface: {part}"))
                .map(|pair| pair[1])
                .collect()
        };
        let feedback = of("FEEDBACK_TOPIC");
        let sequences = [",0,1,1", ",0,1,1,2", ",0,1,1,2,3", ",0,1,1,2,3,5"];
        assert_eq!(feedback.len(), sequences.len(), "{software}: {output_text}");
        for (line, sequence) in feedback.iter().zip(sequences) {
            let goal = line.strip_suffix(sequence).unwrap();
            assert_eq!(goal.split(',').count(), 16, "{line}");
        }
        let states: Vec<_> = of("STATUS_TOPIC")
            .iter()
            .map(|line| line.rsplit(',').next().unwrap().to_owned())
            .collect();
        assert_eq!(states, ["2", "4"], "executing, succeeded");
        // A definition of the same name is not used if its hash differs from the announced hash.
        if software == "jazzy-cyclonedds" {
            let again = run(&[&arguments[..], &definitions].concat());
            assert_eq!((stdout(&again), stderr(&again).as_str()), (output_text, ""));
        }
    }
}

const THING: &str = "my_msgs/msg/Thing";

/// Writes a capture of Cyclone DDS: a node describes its type, then publishes a message. Discovery
/// announces this hash of the type.
fn described_capture(path: &Path, hash: &str) {
    const START: u64 = 1_700_000_000_000_000_000;
    const MILLISECOND: u64 = 1_000_000;
    let talker = GuidPrefix([1, 0x10, 0, 0, 0, 0, 0, 0, 0, 0, 1, 1]);
    let [things, replies] = [1, 2].map(|number| Guid::new(talker, EntityId([0, 0, number, 3])));
    let mut capture = Capture::new(ETHERNET);
    capture.participant(START, 0, talker);
    let user_data = format!("typehash={hash};");
    let length = u32::try_from(user_data.len()).unwrap().to_le_bytes();
    let mut user_data = [&length[..], user_data.as_bytes()].concat();
    user_data.resize(user_data.len().next_multiple_of(4), 0);
    let announcements = [
        (things, "rt/things", "my_msgs::msg::dds_::Thing_"),
        (
            replies,
            "rr/talker/get_type_descriptionReply",
            "type_description_interfaces::srv::dds_::GetTypeDescription_Response_",
        ),
    ];
    for (number, (guid, topic, name)) in (1..).zip(announcements) {
        let payload = forge::endpoint_with(guid, topic, name, &[(0x2c, &user_data)]);
        let message = Message::from(talker).data(SEDP_WRITERS, number, &payload);
        capture.put(START + number * MILLISECOND, 0, message);
    }
    let thing = described(THING, &[field("count", 6), field("label", 17)]);
    let response = Response::of(&[thing]).payload();
    // The identity of the request, as rmw_cyclonedds writes it.
    let response = [&response[..4], &[7; 16], &response[4..]].concat();
    let message = Message::from(talker).data(replies.entity, 1, &response);
    capture.put(START + 100 * MILLISECOND, 0, message);
    for number in 1..=3_u64 {
        let payload = [
            &[0, 1, 0, 0, number as u8, 0, 0, 0, 3, 0, 0, 0][..],
            b"hi\0\0",
        ]
        .concat();
        let message = Message::from(talker).data(things.entity, number, &payload);
        capture.put(START + (1000 + number * 100) * MILLISECOND, 0, message);
    }
    capture.write(path);
}

#[test]
fn a_type_without_an_installed_package_is_echoed_after_a_node_described_it() {
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("described.pcap");
    let expected = MessageType::parse(&THING.parse().unwrap(), "int32 count\nstring label\n");
    described_capture(&path, &expected.unwrap().type_hash());
    let capture = path.to_str().unwrap();
    let echoed = run(&["topic", "echo", "/things", "--replay", capture]);
    let expected: String = (1..=3)
        .map(|number| format!("count: {number}\nlabel: hi\n---\n"))
        .collect();
    assert_eq!(stdout(&echoed), expected, "{}", stderr(&echoed));
}

#[test]
fn a_description_with_another_hash_than_the_announced_one_is_not_used() {
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("mismatched.pcap");
    described_capture(&path, &format!("RIHS01_{}", "0".repeat(64)));
    let echoed = run(&[
        "topic",
        "echo",
        "/things",
        "--replay",
        path.to_str().unwrap(),
    ]);
    let text = stderr(&echoed);
    assert!(stdout(&echoed).is_empty());
    assert!(
        text.contains("no definition of my_msgs/msg/Thing here"),
        "{text}"
    );
}

/// Returns what `rp topic echo` prints of a topic in the capture of Cyclone DDS 11.
fn of_type_lookup(topic: &str, arguments: &[&str]) -> std::process::Output {
    let capture = Path::new(env!("CARGO_MANIFEST_DIR"))
        .join("../testing/data/cyclonedds11/type-lookup.pcap.gz");
    let capture = capture.to_str().unwrap();
    let first = ["topic", "echo", topic, "--replay", capture];
    run(&[&first[..], arguments].concat())
}

#[test]
fn a_type_without_an_installed_package_is_echoed_after_another_participant_requested_it() {
    let echoed = of_type_lookup("/things", &["--once"]);
    let text = stdout(&echoed);
    let rest = text.strip_prefix("label: hello\nok: true\nparts:\n- count: ");
    let rest = rest.unwrap_or_else(|| panic!("{text}{}", stderr(&echoed)));
    let (number, rest) = rest.split_once('\n').unwrap();
    assert!(number.parse::<i32>().unwrap() > 0);
    let expected = "  values:\n  - 1.5\n  - 2.5\ngrid:\n- 1\n- 2\n- 3\none:\n  count: 7\n  \
        values: []\nnames:\n- a\n- b\nname: n\nb: \"\\t\"\ni8: -1\nu16: 2\ni16: -3\n\
        u32: 4\nu64: 5\ni64: -6\nf32: 0.5\n---\n";
    assert_eq!(rest, expected);
    // A base type, an enumeration, an alias of a sequence, and an array of two dimensions.
    let echoed = of_type_lookup("/derived", &["--once"]);
    let text = stdout(&echoed);
    let (number, rest) = text.split_once('\n').unwrap();
    assert!(number.starts_with("id: "), "{text}{}", stderr(&echoed));
    let expected = "mode: 1\nticks:\n- 1\n- 2\ntable:\n- 1\n- 2\n- 3\n- 4\n- 5\n- 6\n---\n";
    assert_eq!(rest, expected);
}

#[test]
fn messages_of_a_type_that_only_the_agent_knows_are_filtered() {
    let capture = Path::new(env!("CARGO_MANIFEST_DIR"))
        .join("../testing/data/cyclonedds11/type-lookup.pcap.gz");
    let capture = capture.to_str().unwrap();
    let filter = ["--filter", "m.ok", "--replay", capture];
    let measured = run(&[&["topic", "hz", "/things"][..], &filter].concat());
    let text = stdout(&measured);
    assert!(text.contains("average rate: 4.98"), "{text}");
    assert_eq!(stderr(&measured), "", "{text}");
}

#[test]
fn a_type_with_a_union_is_not_echoed() {
    let echoed = of_type_lookup("/odd", &[]);
    let text = stderr(&echoed);
    assert!(stdout(&echoed).is_empty());
    let reason = "no definition of my_robot_msgs/msg/Odd here";
    assert!(text.contains(reason), "{text}");
}
