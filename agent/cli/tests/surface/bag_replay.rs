//! Bags as a source: every command that reads a capture reads a bag, and prints the same of it.

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::path::{Path, PathBuf};

use ros2probe_bag::{Form, Options, TopicDescription, Writer};
use ros2probe_testing::local_agent::{LocalAgent, call_api};
use ros2probe_testing::repository;
use ros2probe_wire::Timestamp;
use ros2probe_wire::discovery::Role;
use ros2probe_wire::qos::{Durability, History, HistoryKind, Qos, Reliability};
use ros2probe_wire::rtps::VendorId;
use serde_json::json;

use crate::bag_chains::{CAPTURE, converted, recorded, sqlite3};
use crate::replay::wait_for;
use crate::ros2::{run, stderr, stdout};
use crate::rp;

/// A bag that Humble recorded.
const REAL: &str = "agent/testing/data/bags/bag_zstd_fast";

fn of(path: &Path, arguments: &[&str]) -> String {
    let replay = ["--replay", path.to_str().unwrap()];
    let output = run(&[arguments, &replay].concat());
    assert!(output.status.success(), "{arguments:?} {}", stderr(&output));
    stdout(&output)
}

/// Copies a bag's files into a directory of this name.
fn copy(bag: &Path, into: &Path) -> PathBuf {
    fs::create_dir(into).unwrap();
    for entry in fs::read_dir(bag).unwrap() {
        let from = entry.unwrap().path();
        fs::copy(&from, into.join(from.file_name().unwrap())).unwrap();
    }
    into.to_owned()
}

#[test]
fn a_bag_and_the_capture_that_it_was_made_of_print_the_same() {
    let directory = tempfile::tempdir().unwrap();
    let capture = repository(CAPTURE);
    let bag = converted(directory.path());
    let messages = recorded(&bag);
    let topics: BTreeSet<&str> = messages.iter().map(|one| one.topic.as_str()).collect();
    assert!(topics.len() >= 4, "{topics:?}");
    for topic in topics {
        for command in ["echo", "hz", "bw"] {
            let arguments = ["topic", command, topic];
            assert_eq!(
                of(&bag, &arguments),
                of(&capture, &arguments),
                "{arguments:?}"
            );
        }
        let types = of(&bag, &["topic", "type", topic]);
        assert_eq!(types, of(&capture, &["topic", "type", topic]));
    }
}

#[test]
fn both_storages_of_a_bag_print_the_same() {
    let directory = tempfile::tempdir().unwrap();
    let bag = converted(directory.path());
    let mut messages = recorded(&bag);
    // A message in many pages of the sqlite3 file.
    let last = messages.last().unwrap().log_time;
    let mut large = messages[0].clone();
    (large.topic, large.type_name) = ("/large".to_owned(), "std_msgs/msg/String".to_owned());
    large.log_time = last + 1;
    large.data = b"\0\x01\0\0".to_vec();
    large.data.extend_from_slice(&300_001_u32.to_le_bytes());
    large.data.extend_from_slice(&b"x".repeat(300_000));
    large.data.push(0);
    messages.push(large);
    let lite = sqlite3(directory.path(), &messages);
    let text = of(&lite, &["topic", "echo", "/large", "--full-length"]);
    assert_eq!(
        text.trim_end().len(),
        "data: ".len() + 300_000 + "\n---".len()
    );
    let topic = messages[0].topic.as_str();
    for command in ["echo", "hz"] {
        let arguments = ["topic", command, topic];
        assert_eq!(of(&lite, &arguments), of(&bag, &arguments), "{arguments:?}");
    }
}

#[test]
fn topics_of_a_bag_are_published_by_the_player_with_the_recorded_qos() {
    let bag = repository(REAL);
    assert_eq!(of(&bag, &["node", "list"]), "/rosbag2_player\n");
    assert_eq!(
        of(&bag, &["topic", "list", "-t"]),
        "/chatter [std_msgs/msg/String]\n/robot1/imu/data [sensor_msgs/msg/Imu]\n\
         /tf_static [tf2_msgs/msg/TFMessage]\n"
    );
    let info = of(&bag, &["topic", "info", "-v", "/robot1/imu/data"]);
    for line in [
        "Publisher count: 1",
        "Node name: rosbag2_player",
        "  Reliability: BEST_EFFORT",
        "  History (Depth): KEEP_LAST (5)",
        "  Durability: VOLATILE",
        "Subscription count: 0",
    ] {
        assert!(info.contains(line), "{line}: {info}");
    }
    let tree = of(&bag, &["tf"]);
    assert!(tree.contains("lidar_link  static"), "{tree}");
    // Its file, without metadata.yaml.
    let file = bag.join("bag_zstd_fast_0.mcap");
    assert_eq!(
        of(&file, &["topic", "list", "-t"]),
        of(&bag, &["topic", "list", "-t"])
    );
    assert_eq!(
        of(&file, &["topic", "info", "-v", "/robot1/imu/data"]),
        info
    );
}

/// Since Jazzy, metadata.yaml has the QoS as a list. It was read as the default QoS.
#[test]
fn a_bag_of_jazzy_is_replayed_with_the_recorded_qos() {
    let directory = tempfile::tempdir().unwrap();
    let bag = directory.path().join("jazzy");
    let options = Options {
        form: Form::of("jazzy"),
        ros_distro: "jazzy".to_owned(),
        ..Options::default()
    };
    let mut writer = Writer::create(&bag, options).unwrap();
    let history = History {
        kind: HistoryKind::KEEP_LAST,
        depth: 5,
    };
    let publisher = Qos {
        reliability: Reliability::BEST_EFFORT,
        durability: Durability::TRANSIENT_LOCAL,
        history: Some(history),
        ..Qos::defaults(Role::Writer, VendorId::CYCLONE)
    };
    let topic = TopicDescription {
        name: "/map".to_owned(),
        type_name: "std_msgs/msg/String".to_owned(),
        type_hash: None,
        publishers: vec![publisher],
        schema: None,
    };
    let topic = writer.topic(topic).unwrap();
    let time = Timestamp(1_795_142_331_000_000_000);
    let message = b"\0\x01\0\0\x06\0\0\0hello\0";
    writer.write(topic, time, time, 1, message).unwrap();
    writer.close(BTreeMap::new()).unwrap();
    let text = fs::read_to_string(bag.join("metadata.yaml")).unwrap();
    assert!(text.contains("version: 9"), "{text}");
    let info = of(&bag, &["topic", "info", "-v", "/map"]);
    for line in [
        "  Reliability: BEST_EFFORT",
        "  History (Depth): KEEP_LAST (5)",
        "  Durability: TRANSIENT_LOCAL",
    ] {
        assert!(info.contains(line), "{line}: {info}");
    }
}

#[test]
fn a_damaged_bag_is_replayed_as_far_as_possible_and_says_so() {
    let directory = tempfile::tempdir().unwrap();
    let whole = fs::read(converted(directory.path()).join("drive_0.mcap")).unwrap();
    let cut = directory.path().join("cut.mcap");
    fs::write(&cut, &whole[..whole.len() / 2]).unwrap();
    let replay = ["--replay", cut.to_str().unwrap()];
    let output = run(&[&["topic", "list"][..], &replay].concat());
    assert!(stdout(&output).lines().count() >= 3, "{}", stdout(&output));
    let said = stderr(&output);
    assert!(said.contains("was not completed"), "{said}");
    assert_eq!(said.lines().count(), 1, "{said}");

    for (path, reason) in [
        (directory.path().join("nothing"), "cannot open capture"),
        (directory.path().join("empty"), "holds no file of a bag"),
        (repository("Cargo.toml"), "not a capture"),
    ] {
        if path.ends_with("empty") {
            fs::create_dir(&path).unwrap();
        }
        let output = run(&["topic", "list", "--replay", path.to_str().unwrap()]);
        assert_eq!(output.status.code(), Some(1), "{}", path.display());
        let said = stderr(&output);
        assert!(said.contains(reason), "{said}");
        assert_eq!(said.lines().count(), 1, "{said}");
    }
}

/// Earlier, the agent served its page, and then reported that the rest of the capture was unreadable.
#[test]
fn an_agent_refuses_a_bag_without_its_files_before_it_serves_anything() {
    let directory = tempfile::tempdir().unwrap();
    let bag = copy(&repository(REAL), &directory.path().join("drive"));
    let file = bag.join("bag_zstd_fast_0.mcap");
    let path = bag.to_str().unwrap();
    let refused = |reason: &str| {
        let output = run(&["run", "--replay", path, "--metrics", "127.0.0.1:0"]);
        assert_eq!(output.status.code(), Some(1));
        let file = file.display();
        let expected = format!(
            "rp: cannot replay {path}: {}\n",
            reason.replace('F', &file.to_string())
        );
        assert_eq!(stderr(&output), expected);
    };
    let whole = fs::read(&file).unwrap();
    fs::remove_file(&file).unwrap();
    refused("cannot read F: No such file or directory (os error 2)");
    fs::write(&file, b"another").unwrap();
    refused("F is neither an MCAP file nor a sqlite3 bag");

    // Of a bag with several files, the others are replayed, and the missing one is reported.
    fs::write(&file, whole).unwrap();
    let description = bag.join("metadata.yaml");
    let text = fs::read_to_string(&description).unwrap();
    let entry = "    - bag_zstd_fast_0.mcap\n";
    assert!(text.contains(entry), "{text}");
    let more = format!("    - lost.mcap\n{entry}");
    fs::write(&description, text.replacen(entry, &more, 1)).unwrap();
    let output = run(&["topic", "list", "--replay", path]);
    assert!(output.status.success() && stdout(&output).lines().count() > 2);
    let said = stderr(&output);
    assert!(
        said.contains("lost.mcap was not read: No such file"),
        "{said}"
    );
}

#[test]
fn messages_that_are_not_cdr_are_skipped_and_counted() {
    let directory = tempfile::tempdir().unwrap();
    let mut messages = recorded(&converted(directory.path()));
    messages.truncate(20);
    for (index, message) in messages.iter_mut().enumerate() {
        match index % 4 {
            0 => message.data = b"{}".to_vec(),
            1 => message.topic = "no/slash".to_owned(),
            _ => {}
        }
    }
    let lite = sqlite3(directory.path(), &messages);
    let output = run(&["topic", "list", "--replay", lite.to_str().unwrap()]);
    let said = stderr(&output);
    assert!(said.contains("10 messages skipped"), "{said}");
}

#[test]
fn the_bag_of_an_incident_pauses_at_its_trigger() {
    let directory = tempfile::tempdir().unwrap();
    let bag = copy(&repository(REAL), &directory.path().join("incident"));
    let trigger = json!({
        "snapshot": "last", "trigger": "message_lost", "event": "ros2.message.lost",
        "time": "2026-11-20T02:39:08.500000000Z", "attributes": {"topic": "/chatter", "domain_id": 0},
    });
    let file = bag.join("metadata.yaml");
    let text = fs::read_to_string(&file).unwrap();
    assert!(!text.contains("custom_data"), "{text}");
    let trigger = trigger.to_string().replace('"', "\\\"");
    fs::write(
        &file,
        format!(
            "{}\n  custom_data:\n    ros2probe_trigger: \"{trigger}\"\n",
            text.trim_end()
        ),
    )
    .unwrap();
    let agent = LocalAgent::replay(&mut rp(), &bag, &["--watch", "/**"]);
    let paused = wait_for(&agent, "paused", |replay| {
        replay["is_paused"] == true && replay["is_jumping"] == false
    });
    let at = paused["timestamp_seconds"].as_f64().unwrap();
    assert!((at - 1_795_142_348.5).abs() < 0.001, "{paused}");
    let change = json!({"is_paused": false, "speed": 0}).to_string();
    let (status, _) = call_api(agent.api, "POST", "/replay", &change);
    assert_eq!(status, 200);
    wait_for(&agent, "finished", |replay| replay["is_finished"] == true);
}
