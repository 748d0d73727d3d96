//! The verbs of the graph: the output equals that of ros2cli for the same robot, byte for byte,
//! except for listed differences.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

use serde_json::Value;

use super::{run, stderr, stdout};

pub fn own() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/fixtures/cli")
}

/// Returns the names of recorded commands in the table of `docs/ros2cli-differences.md` below this
/// heading.
fn listed(heading: &str) -> BTreeSet<String> {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../docs/ros2cli-differences.md");
    let text = std::fs::read_to_string(path).unwrap();
    let section = text
        .split("\n## ")
        .find(|section| section.starts_with(heading));
    let rows = section.unwrap().lines();
    let names = rows.filter_map(|row| row.strip_prefix("| `")?.split_once("` |"));
    names.map(|(name, _)| name.to_owned()).collect()
}

/// Replaces GIDs by their lengths, because they differ between runs.
fn without_gids(text: &str) -> String {
    let line = |line: &str| match line.split_once("GID: ") {
        Some((head, gid)) => format!("{head}GID: {} bytes\n", gid.split('.').count()),
        None => format!("{line}\n"),
    };
    text.lines().map(line).collect()
}

#[test]
fn verbs_of_the_graph_print_the_output_of_ros2cli() {
    let capture = own().join("graph.pcap.gz");
    let recorded = std::fs::read_to_string(own().join("recorded.jsonl")).unwrap();
    let differing = listed("Recorded commands");
    let (mut same, mut different) = (0, BTreeSet::new());
    for line in recorded.lines() {
        let line: Value = serde_json::from_str(line).unwrap();
        let text = |key: &str| line[key].as_str().unwrap();
        let words = line["arguments"].as_array().unwrap();
        let mut words: Vec<&str> = words.iter().map(|word| word.as_str().unwrap()).collect();
        words.extend(["--distro", "humble", "--until", text("until")]);
        words.extend(["--replay", capture.to_str().unwrap()]);
        let output = run(&words);
        let code = line["code"].as_i64().map(|code| code as i32);
        assert_eq!(output.status.code(), code, "{}", text("name"));
        assert_eq!(stderr(&output), text("stderr"), "{}", text("name"));
        let (mut out, mut expected) = (stdout(&output), text("stdout").to_owned());
        if line["second_run"] == true {
            (out, expected) = (without_gids(&out), without_gids(&expected));
        }
        if differing.contains(text("name")) {
            assert_ne!(out, expected, "{} is listed as different", text("name"));
            different.insert(text("name").to_owned());
        } else {
            assert_eq!(out, expected, "{}", text("name"));
            same += 1;
        }
    }
    assert_eq!((same, different), (56, differing));
}

/// The capture has nodes with the same name, and a topic and a service with two types each
/// (`fixtures/cli/mixed.py`).
#[test]
fn node_info_has_the_types_of_the_endpoints_if_a_topic_has_several() {
    let capture = own().join("mixed.pcap.gz");
    let recorded = std::fs::read_to_string(own().join("mixed.jsonl")).unwrap();
    let mut count = 0;
    for line in recorded.lines() {
        let line: Value = serde_json::from_str(line).unwrap();
        let text = |key: &str| line[key].as_str().unwrap();
        let words = line["arguments"].as_array().unwrap();
        let mut words: Vec<&str> = words.iter().map(|word| word.as_str().unwrap()).collect();
        words.extend(["--distro", "humble", "--replay", capture.to_str().unwrap()]);
        let output = run(&words);
        let code = line["code"].as_i64().map(|code| code as i32);
        assert_eq!(output.status.code(), code, "{}", text("name"));
        assert_eq!(stdout(&output), text("stdout"), "{}", text("name"));
        // The expected text has the warning of later releases, and names both nodes instead of one
        // (`ros2cli-differences.md`).
        let expected = text("stderr")
            .replace("aware that are nodes", "aware that there are nodes")
            .replace("exact name, this can", "exact name, which can")
            .replace("about only one of them", "about all of them");
        assert_eq!(stderr(&output), expected, "{}", text("name"));
        count += 1;
    }
    assert_eq!(count, 12);
}

/// A capture is read completely first, so the topic is treated as one that is known at the start.
#[test]
fn a_topic_of_two_types_is_not_echoed_from_a_capture() {
    let capture = own().join("mixed.pcap.gz");
    let capture = capture.to_str().unwrap();
    let output = run(&["topic", "echo", "/mixed/value", "--replay", capture]);
    assert_eq!(
        (stdout(&output).as_str(), output.status.code()),
        ("", Some(1))
    );
    assert_eq!(
        stderr(&output),
        "Cannot echo topic '/mixed/value', as it contains more than one type: [std_msgs/msg/Int32, \
         std_msgs/msg/String]\n"
    );
    let chosen = ["topic", "echo", "/mixed/value", "std_msgs/msg/String"];
    let output = run(&[&chosen[..], &["--replay", capture]].concat());
    assert_eq!(output.status.code(), Some(0), "{}", stderr(&output));
}

/// ros2cli prints `/robot1/sensor_node` as `//r/o/b/o/t/1sensor_node`.
#[test]
fn the_nodes_of_an_action_have_their_full_names() {
    let capture = own().join("graph.pcap.gz");
    let words = ["action", "info", "-t", "/robot1/fibonacci"];
    let output = run(&[&words[..], &["--replay", capture.to_str().unwrap()]].concat());
    assert_eq!(
        stdout(&output),
        "Action: /robot1/fibonacci\n\
         Action clients: 1\n    /robot2/listener_node [example_interfaces/action/Fibonacci]\n\
         Action servers: 1\n    /robot1/sensor_node [example_interfaces/action/Fibonacci]\n"
    );
}

#[test]
fn action_info_finds_a_relative_name_and_refuses_an_invalid_one() {
    let capture = own().join("graph.pcap.gz");
    let ask = |name: &str| {
        let replay = ["--replay", capture.to_str().unwrap()];
        run(&[&["action", "info", "-c", name][..], &replay].concat())
    };
    let found = "Action: robot1/fibonacci\nAction clients: 1\nAction servers: 1\n";
    let relative = ask("robot1/fibonacci");
    assert_eq!(stdout(&relative), found, "{}", stderr(&relative));
    let invalid = ask("/robot1//fibonacci");
    let reason = "Invalid topic name: topic name must not contain repeated '/':\n";
    assert!(stderr(&invalid).starts_with(reason), "{}", stderr(&invalid));
    assert_eq!(
        (stdout(&invalid).as_str(), invalid.status.code()),
        ("", Some(1))
    );
}

#[test]
fn commands_missing_in_humble_print_the_output_of_jazzy() {
    let capture = own().join("graph.pcap.gz");
    let ask = |words: &str| {
        let mut words: Vec<&str> = words.split(' ').collect();
        words.extend(["--replay", capture.to_str().unwrap()]);
        let output = run(&words);
        (stdout(&output), stderr(&output), output.status.code())
    };
    let printed = |out: &str| (out.to_owned(), String::new(), Some(0));
    assert_eq!(
        ask("service info /robot1/add_two_ints"),
        printed("Type: example_interfaces/srv/AddTwoInts\nClients count: 1\nServices count: 1\n")
    );
    let (out, err, code) = ask("service info /robot1/nope");
    assert_eq!((out.as_str(), code), ("", Some(1)));
    assert_eq!(err, "Unknown service '/robot1/nope'\n");
    let fibonacci = "example_interfaces/action/Fibonacci\n";
    assert_eq!(ask("action type /robot1/fibonacci"), printed(fibonacci));
    assert_eq!(
        ask("action type /nope"),
        (String::new(), String::new(), Some(1))
    );
    let found = printed("/robot1/fibonacci\n");
    assert_eq!(ask(&format!("action find {}", fibonacci.trim())), found);
    // Hidden services are listed with the option of the command, and also with that of the verb.
    let hidden = "/robot1/fibonacci/_action/send_goal";
    assert_eq!(ask(&format!("service type {hidden}")).2, Some(1));
    let shown = ask(&format!("service --include-hidden-services type {hidden}"));
    assert_eq!(shown.0, "example_interfaces/action/Fibonacci_SendGoal\n");
    let (out, ..) = ask("topic info -v /chatter --distro jazzy");
    assert!(out.contains("\nTopic type hash: INVALID\n"), "{out}");
    let gid = "\nGID: 01.10.b4.2b.fd.42.e1.d5.5f.39.f0.30.00.00.30.03\n";
    assert!(out.contains(gid), "{out}");
}

#[test]
fn service_info_prints_the_calls_only_when_verbose() {
    let data = Path::new(env!("CARGO_MANIFEST_DIR")).join("../testing/data");
    let capture = data.join("cyclonedds/lifecycle-2ns/capture.pcap.gz");
    let ask = |option: &[&str]| {
        let mut words = vec!["service", "info", "/robot1/add_two_ints"];
        words.extend([
            "--until",
            "1795143025",
            "--replay",
            capture.to_str().unwrap(),
        ]);
        words.extend(option);
        stdout(&run(&words))
    };
    let plain = ask(&[]);
    assert_eq!(
        plain,
        "Type: example_interfaces/srv/AddTwoInts\nClients count: 1\nServices count: 1\n"
    );
    let calls = "Calls: 5\n  Answered: 5\n  Unanswered: 0\n  Hanging: 0\n  Latency p50: 0.933 ms\n  \
                 Latency p99: 1.855 ms\n";
    assert_eq!(ask(&["-v"]), format!("{plain}{calls}"));
}
