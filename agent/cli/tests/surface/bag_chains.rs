//! `rp chain` over bags that are made of a capture, in both storage formats, and over damaged bags.

use std::collections::BTreeMap;
use std::fs;
use std::io::Write as _;
use std::path::{Path, PathBuf};
use std::process::{Command, Output, Stdio};

use ros2probe_bag::messages;
use ros2probe_testing::repository;
use ros2probe_wire::Expansion;
use serde_json::{Value, json};
use tempfile::TempDir;

use crate::ros2::{run, stderr, stdout};

pub(crate) const CAPTURE: &str = "agent/testing/data/fastrtps-udp/chain-1ns/capture.pcap.gz";

/// A recorded message with its whole payload.
#[derive(Clone)]
pub(crate) struct Recorded {
    pub(crate) topic: String,
    pub(crate) type_name: String,
    pub(crate) log_time: u64,
    pub(crate) publish_time: u64,
    pub(crate) data: Vec<u8>,
}

/// Converts the capture to a bag.
pub(crate) fn converted(directory: &Path) -> PathBuf {
    let bag = directory.join("drive");
    let capture = repository(CAPTURE);
    let paths = [capture.to_str().unwrap(), bag.to_str().unwrap()];
    let output = run(&[&["bag", "convert"], &paths[..]].concat());
    assert!(bag.join("metadata.yaml").exists(), "{}", stderr(&output));
    bag
}

pub(crate) fn recorded(bag: &Path) -> Vec<Recorded> {
    let mut all = Vec::new();
    let read = messages::read(bag, Expansion::Limited, &mut |message, _| {
        all.push(Recorded {
            topic: message.topic.to_owned(),
            type_name: message.type_name.to_owned(),
            log_time: message.log_time,
            publish_time: message.publish_time.unwrap(),
            data: message.begin.to_vec(),
        });
    });
    assert!(read.unwrap().faults.is_empty());
    all
}

/// Writes an MCAP file with these messages.
fn mcap(path: &Path, messages: &[Recorded]) {
    let file = fs::File::create(path).unwrap();
    let mut writer = mcap::Writer::new(std::io::BufWriter::new(file)).unwrap();
    let mut channels = BTreeMap::new();
    for message in messages {
        let channel = *channels.entry(message.topic.clone()).or_insert_with(|| {
            let schema = writer.add_schema(&message.type_name, "ros2msg", b"");
            let topic = &message.topic;
            let about = BTreeMap::new();
            writer
                .add_channel(schema.unwrap(), topic, "cdr", &about)
                .unwrap()
        });
        let header = mcap::records::MessageHeader {
            channel_id: channel,
            sequence: 0,
            log_time: message.log_time,
            publish_time: message.publish_time,
        };
        writer
            .write_to_known_channel(&header, &message.data)
            .unwrap();
    }
    writer.finish().unwrap();
}

/// Writes a bag in sqlite3 storage with these messages.
pub(crate) fn sqlite3(directory: &Path, messages: &[Recorded]) -> PathBuf {
    let bag = directory.join("lite");
    let mut python = Command::new(repository("target/tools/bags/bin/python"))
        .arg(repository("agent/cli/tests/surface/bag_chains.py"))
        .arg(&bag)
        .stdin(Stdio::piped())
        .spawn()
        .unwrap();
    let mut lines = String::new();
    for message in messages {
        let hex: String = message
            .data
            .iter()
            .map(|byte| format!("{byte:02x}"))
            .collect();
        let line = json!({
            "topic": message.topic, "type": message.type_name, "time": message.log_time,
            "data": hex,
        });
        lines += &format!("{line}\n");
    }
    let mut stdin = python.stdin.take().unwrap();
    stdin.write_all(lines.as_bytes()).unwrap();
    drop(stdin);
    assert!(python.wait().unwrap().success());
    bag
}

fn ask(path: &Path, arguments: &[&str]) -> Output {
    let replay = ["--replay", path.to_str().unwrap()];
    run(&[&["chain"], arguments, &replay].concat())
}

fn answer(path: &Path, arguments: &[&str]) -> Value {
    let output = ask(path, &[arguments, &["--json"]].concat());
    assert!(output.status.success(), "{}", stderr(&output));
    serde_json::from_str(&stdout(&output)).unwrap()
}

/// Returns the names of the hops, and their medians in seconds.
fn hops(answer: &Value) -> Vec<(String, f64)> {
    let chains = answer["chains"].as_array().unwrap();
    assert_eq!(chains.len(), 1, "{answer:#}");
    let hops = chains[0]["hops"].as_array().unwrap();
    let hop = |hop: &Value| {
        let name = [&hop["input"], &hop["output"]].map(|name| name.as_str().unwrap());
        (
            name.join(" "),
            hop["latency"]["p50_seconds"].as_f64().unwrap(),
        )
    };
    hops.iter().map(hop).collect()
}

fn assert_near(one: &Value, other: &Value, seconds: f64) {
    let (one, other) = (hops(one), hops(other));
    assert_eq!(one.len(), other.len());
    for ((name, median), (expected, known)) in one.iter().zip(&other) {
        assert_eq!(name, expected);
        assert!((median - known).abs() < seconds, "{name}: {median} {known}");
    }
}

fn temporary() -> TempDir {
    tempfile::tempdir().unwrap()
}

#[test]
fn a_bag_has_the_same_hops_as_its_capture() {
    let directory = temporary();
    let bag = converted(directory.path());
    let (of_bag, of_capture) = (answer(&bag, &[]), answer(&repository(CAPTURE), &[]));
    // Both use source timestamps.
    assert_eq!(of_bag["times"], "publish");
    assert_near(&of_bag, &of_capture, 20e-6);
    let count = |answer: &Value| answer["chains"][0]["messages"].as_u64().unwrap();
    // The first matches in a capture are only evidence of a chain, and are not measured.
    assert!((0..=5).contains(&(count(&of_bag) - count(&of_capture))));
    assert_eq!(of_bag["chains"][0]["domain_id"], Value::Null);
    assert_eq!(of_bag["faults"], json!([]));
    // A single file, and a part of the chain.
    let file = bag.join("drive_0.mcap");
    let part = answer(&file, &["/filtered", "/cmd"]);
    assert_eq!(hops(&part)[0], hops(&of_bag)[1]);
}

#[test]
fn text_output_lists_topics_and_the_source_of_times_without_nodes() {
    let directory = temporary();
    let output = ask(&converted(directory.path()), &[]);
    let text = stdout(&output);
    let lines: Vec<_> = text.lines().collect();
    assert!(lines[0].starts_with("/points to /cmd: "), "{text}");
    let hop = lines
        .iter()
        .find(|line| line.starts_with("  /points -> /filtered "));
    assert!(hop.unwrap().ends_with("bottleneck"), "{text}");
    assert!(!text.contains("node"), "{text}");
    let times = "times: publish (by the clock of each publisher)";
    assert_eq!(*lines.last().unwrap(), times);
    assert_eq!(stderr(&output), "");
}

#[test]
fn bags_without_publish_times_are_measured_by_log_times() {
    let directory = temporary();
    let bag = converted(directory.path());
    let of_bag = answer(&bag, &[]);
    let mut messages = recorded(&bag);
    let lite = answer(&sqlite3(directory.path(), &messages), &[]);
    for message in &mut messages {
        // rosbag2 of Humble does the same.
        message.publish_time = message.log_time;
    }
    let file = directory.path().join("humble.mcap");
    mcap(&file, &messages);
    let humble = answer(&file, &[]);
    for found in [&lite, &humble] {
        assert_eq!(found["times"], "log");
        // The difference is the transport time of a message.
        assert_near(found, &of_bag, 500e-6);
    }
    assert_eq!(hops(&lite), hops(&humble));
    let text = stdout(&ask(&file, &[]));
    let times = "\ntimes: log (when the recorder received each message; the bag has no others)\n";
    assert!(text.ends_with(times), "{text}");
}

#[test]
fn a_topic_with_new_stamps_ends_the_chain() {
    let directory = temporary();
    let mut messages = recorded(&converted(directory.path()));
    for message in messages.iter_mut().filter(|each| each.topic == "/cmd") {
        let seconds = u32::try_from(message.publish_time / 1_000_000_000).unwrap();
        let nanoseconds = u32::try_from(message.publish_time % 1_000_000_000).unwrap() | 1;
        message.data[4..8].copy_from_slice(&seconds.to_le_bytes());
        message.data[8..12].copy_from_slice(&nanoseconds.to_le_bytes());
    }
    let file = directory.path().join("again.mcap");
    mcap(&file, &messages);
    let names: Vec<_> = hops(&answer(&file, &[]))
        .into_iter()
        .map(|hop| hop.0)
        .collect();
    assert_eq!(names, ["/points /filtered"]);
    let output = ask(&file, &["/points", "/cmd"]);
    assert_eq!(output.status.code(), Some(1));
    let reason = "no chain from /points to /cmd: ";
    assert!(stderr(&output).contains(reason), "{}", stderr(&output));
}

#[test]
fn a_step_of_the_clock_does_not_change_the_medians() {
    let directory = temporary();
    let bag = converted(directory.path());
    let of_bag = answer(&bag, &[]);
    let mut messages = recorded(&bag);
    let half = messages.len() / 2;
    for message in &mut messages[half..] {
        message.log_time -= 3_600_000_000_000;
        message.publish_time -= 3_600_000_000_000;
    }
    let file = directory.path().join("step.mcap");
    mcap(&file, &messages);
    assert_near(&answer(&file, &[]), &of_bag, 500e-6);
}

#[test]
fn a_truncated_bag_is_read_up_to_the_cut() {
    let directory = temporary();
    let bag = converted(directory.path());
    let lite = sqlite3(directory.path(), &recorded(&bag));
    let (file, database) = (bag.join("drive_0.mcap"), lite.join("lite_0.db3"));
    let whole = [answer(&bag, &[]), answer(&lite, &[])];
    for (path, whole) in [file, database].iter().zip(&whole) {
        let length = fs::metadata(path).unwrap().len();
        let cut = fs::OpenOptions::new().write(true).open(path).unwrap();
        cut.set_len(length * 2 / 3).unwrap();
        let found = answer(path.parent().unwrap(), &[]);
        let count = |answer: &Value| answer["messages"].as_u64().unwrap();
        let (read, all) = (count(&found), count(whole));
        assert!(read > all / 3 && read < all, "{read} of {all}");
        assert_eq!(hops(&found)[0].0, hops(whole)[0].0);
        let faults = found["faults"].as_array().unwrap();
        assert_eq!(faults.len(), 1, "{found:#}");
        // A recorder that is killed leaves no metadata.yaml.
        fs::remove_file(path.with_file_name("metadata.yaml")).unwrap();
        let output = ask(path.parent().unwrap(), &[]);
        assert!(output.status.success(), "{}", stderr(&output));
        let note = format!("rp: {}\n", faults[0].as_str().unwrap());
        assert_eq!(stderr(&output), note);
    }
}

#[test]
fn a_path_without_a_bag_is_refused_in_one_line() {
    let directory = temporary();
    let empty = directory.path().join("empty");
    fs::create_dir(&empty).unwrap();
    let other = directory.path().join("other.db3");
    let mut page = vec![0; 4096];
    page[..16].copy_from_slice(b"SQLite format 3\0");
    page[16..18].copy_from_slice(&4096_u16.to_be_bytes());
    page[56..60].copy_from_slice(&1_u32.to_be_bytes());
    page[100] = 13;
    fs::write(&other, page).unwrap();
    for (path, reason) in [
        (&empty, "holds no file of a bag"),
        (&other, "it lacks the tables of a bag"),
    ] {
        let output = ask(path, &[]);
        assert_eq!(output.status.code(), Some(1));
        let text = stderr(&output);
        assert!(text.contains(reason), "{text}");
        assert_eq!(text.trim_end().lines().count(), 1, "{text}");
        assert_eq!(stdout(&output), "");
    }
}
