//! Captures of real ROS 2 that are converted to bags: a bag contains exactly the samples that were
//! complete on the wire, byte for byte.

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};

use ros2probe_api::recording_report::Report;
use ros2probe_bag::read;
use serde_json::Value;

use super::metadata;
use ros2probe_testing::bag_readers::read_by_others;
use ros2probe_testing::truth::{self, Scenario};
use ros2probe_wire::Expansion;

fn convert(capture: &Path, bag: &Path, options: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_rp"))
        .args(["bag", "convert"])
        .args([capture, bag])
        .args(options)
        .env_remove("ROS_DISTRO")
        .env_remove("ROS_DOMAIN_ID")
        .env_remove("AMENT_PREFIX_PATH")
        .output()
        .unwrap()
}

fn data() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../testing/data")
}

#[test]
fn bags_of_captures_in_the_repository_have_exactly_the_complete_samples() {
    let scenarios = truth::scenarios(&data());
    assert!(scenarios.len() >= 8, "{scenarios:?}");
    check(&scenarios);
}

#[test]
#[ignore = "needs the corpus of captures: make test-corpus"]
fn bags_of_the_whole_corpus_have_exactly_the_complete_samples() {
    let scenarios = truth::scenarios(&ros2probe_testing::corpus());
    assert!(!scenarios.is_empty());
    check(&scenarios);
}

fn check(scenarios: &[Scenario]) {
    let directory = tempfile::tempdir().unwrap();
    let mut bags = Vec::new();
    for (index, scenario) in scenarios.iter().enumerate() {
        let name = scenario.name();
        let bag = directory.path().join(format!("bag{index}"));
        let output = convert(&scenario.capture, &bag, &["--include-hidden-topics"]);
        let stderr = String::from_utf8_lossy(&output.stderr);
        let reported: Report = serde_json::from_value(report(&bag)).unwrap();
        let code = if reported.is_complete() { 0 } else { 3 };
        assert_eq!(output.status.code(), Some(code), "{name}: {stderr}");
        assert!(!stderr.contains("stdin"), "{name}: {stderr}");
        let (complete, incomplete, gaps) = on_the_wire(scenario);
        let found = in_the_bag(&name, &bag);
        let incomplete_graphs = ["cli-observed", "fastrtps-default/lifecycle", "fastrtps-tcp"];
        if incomplete_graphs.iter().any(|each| name.contains(each)) {
            // In some captures, samples precede the writer's announcement, or announcements went
            // through shared memory. Such samples have no topic.
            let within = |(topic, count): (&String, &u64)| complete.get(topic) >= Some(count);
            assert!(found.iter().all(within), "{name}: {found:?} {complete:?}");
            continue;
        }
        assert_eq!(found, complete, "{name}");
        let report = report(&bag);
        let lost = |topic: &Value| topic["lost"].as_u64().unwrap();
        let topics = report["topics"].as_object().unwrap();
        let counted: u64 = topics.values().map(lost).sum();
        assert_eq!(counted, gaps, "{name}: {stderr}");
        assert_eq!(report["missing"], incomplete + gaps, "{name}: {stderr}");
        let named: u64 = report["missing_runs"]
            .as_array()
            .unwrap()
            .iter()
            .map(samples)
            .sum();
        assert_eq!(named, incomplete + gaps, "{name}");
        if !found.is_empty() {
            bags.push(bag);
        }
    }
    let paths: Vec<&Path> = bags.iter().map(AsRef::as_ref).collect();
    for (bag, found) in bags.iter().zip(read_by_others(&paths)) {
        let yaml = metadata(bag);
        let connections = found["rosbags"]["connections"].as_array().unwrap();
        for (topic, connection) in yaml.topics.iter().zip(connections) {
            assert_eq!(connection["topic"], topic.name);
            assert_eq!(connection["type"], topic.type_name);
            assert_eq!(connection["count"], topic.message_count);
            assert_eq!(connection["hash"], topic.type_description_hash);
            let publishers = topic.offered_qos_profiles.matches("- history: ").count();
            assert_eq!(connection["qos"].as_array().unwrap().len(), publishers);
            // Every type of these captures is known.
            assert!(
                topic.message_count == 0 || connection["definition"] == "MSG",
                "{topic:?}"
            );
        }
        let by_index = found["mcap"][0]["messages"].as_array().unwrap();
        let by_rosbags = found["rosbags"]["messages"].as_array().unwrap();
        assert_eq!(by_index.len() as u64, yaml.message_count);
        for (one, other) in by_index.iter().zip(by_rosbags) {
            assert_eq!(
                (&one["digest"], &one["log_time"]),
                (&other["digest"], &other["log_time"])
            );
        }
    }
}

fn samples(run: &Value) -> u64 {
    run["samples"].as_u64().unwrap()
}

/// Returns the complete samples of each topic by the independent decoder, and the numbers of
/// incomplete and of missing samples.
fn on_the_wire(scenario: &Scenario) -> (BTreeMap<String, u64>, u64, u64) {
    let (mut complete, mut incomplete, mut gaps) = (BTreeMap::new(), 0, 0);
    for writer in scenario.facts().writers.values() {
        if let Some(topic) = writer.topic.strip_prefix("rt/") {
            *complete.entry(format!("/{topic}")).or_default() += writer.complete();
            incomplete += writer.frag_samples_incomplete;
            gaps += writer.missing_in_range.len() as u64;
        }
    }
    complete.retain(|_, count| *count > 0);
    (complete, incomplete, gaps)
}

fn in_the_bag(name: &str, bag: &Path) -> BTreeMap<String, u64> {
    let mut counts = BTreeMap::new();
    let mut sequences: BTreeMap<String, Vec<u32>> = BTreeMap::new();
    for file in metadata(bag).relative_file_paths {
        let each = &mut |message: &ros2probe_bag::mcap::Message<'_>, known: &read::Contents| {
            let topic = known.channels[&message.channel_id].topic.clone();
            if topic == "/robot1/points" {
                assert_cloud(name, message.sequence, message.data);
            }
            assert!(
                message.publish_time <= message.log_time + 1_000_000_000,
                "{name}"
            );
            *counts.entry(topic.clone()).or_default() += 1;
            sequences.entry(topic).or_default().push(message.sequence);
        };
        read::scan(&bag.join(file), Expansion::Limited, each).unwrap();
    }
    for (topic, sequences) in sequences {
        // All topics but these have one writer. Its samples are in order and without duplicates.
        if !matches!(
            topic.as_str(),
            "/rosout" | "/parameter_events" | "/chatter" | "/tf"
        ) {
            assert!(sequences.is_sorted(), "{name}: {topic} {sequences:?}");
            let distinct: BTreeSet<_> = sequences.iter().collect();
            assert_eq!(distinct.len(), sequences.len(), "{name}: {topic}");
        }
    }
    counts
}

/// Checks the published payload. The byte at `i` of `data` is `i + n` in message n, which has the
/// sequence number n + 1.
fn assert_cloud(name: &str, sequence: u32, payload: &[u8]) {
    let length_of = |at: usize| {
        let length = payload.get(at..at + 4).unwrap().try_into().unwrap();
        u32::from_le_bytes(length) as usize
    };
    // `is_dense` and up to three bytes of padding follow `data`.
    let fits = |at: &usize| {
        let rest = payload.len().checked_sub(length_of(*at));
        rest.is_some_and(|rest| (at + 5..=at + 8).contains(&rest))
    };
    let at = (4..400).step_by(4).find(fits).unwrap();
    let data = &payload[at + 4..at + 4 + length_of(at)];
    assert!(data.len() > 100_000, "{name}: {}", data.len());
    let first = (sequence - 1) as usize;
    let is_sent = |(index, byte): (usize, &u8)| usize::from(*byte) == (index + first) % 256;
    assert!(data.iter().enumerate().all(is_sent), "{name}: {sequence}");
}

fn report(bag: &Path) -> Value {
    let data = metadata(bag).custom_data;
    let text = data
        .values()
        .find(|text| text.contains("missing_runs"))
        .unwrap();
    serde_json::from_str(text).unwrap()
}

#[test]
fn only_chosen_topics_are_converted_and_an_existing_directory_is_refused() {
    let directory = tempfile::tempdir().unwrap();
    let capture = data().join("cyclonedds/samehost-any/capture.pcap.gz");
    let bag = directory.path().join("bag");
    let output = convert(&capture, &bag, &["/chatter"]);
    assert!(output.status.success(), "{output:?}");
    let names = |bag: &Path| -> Vec<_> {
        metadata(bag)
            .topics
            .into_iter()
            .map(|topic| topic.name)
            .collect()
    };
    assert_eq!(names(&bag), ["/chatter"]);
    let before = fs::read(bag.join("metadata.yaml")).unwrap();
    let output = convert(&capture, &bag, &["-a"]);
    let stderr = String::from_utf8(output.stderr).unwrap();
    let printed = format!(
        "[ERROR] [ros2bag]: Output folder '{}' already exists.\n",
        bag.display()
    );
    assert_eq!((output.status.code(), stderr), (Some(1), printed));
    assert_eq!(fs::read(bag.join("metadata.yaml")).unwrap(), before);
    let by_pattern = directory.path().join("pattern");
    let options = [
        "-e",
        "robot1",
        "--storage-preset-profile",
        "zstd_fast",
        "--distro",
        "kilted",
    ];
    let output = convert(&capture, &by_pattern, &options);
    assert!(output.status.success(), "{output:?}");
    assert_eq!(names(&by_pattern), ["/robot1/points"]);
    assert_eq!(metadata(&by_pattern).version, 9);
    let nothing = directory.path().join("nothing");
    let output = convert(Path::new("/nowhere.pcap"), &nothing, &[]);
    assert_eq!(output.status.code(), Some(1), "{output:?}");
    assert!(!nothing.exists());
}
