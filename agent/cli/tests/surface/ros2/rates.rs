//! `rp topic hz`, `bw` and `delay` on captures. The output agrees with that of ros2cli on the same
//! capture, within the tolerances of docs/ros2cli-differences.md, and with the messages that were
//! sent and received.

use std::collections::BTreeMap;
use std::io::Read as _;
use std::path::{Path, PathBuf};

use flate2::read::MultiGzDecoder;
use ros2probe_testing::model::capture::{Capture, ETHERNET, writer};
use ros2probe_testing::model::forge::{self, Message, SEDP_WRITERS};
use ros2probe_wire::GuidPrefix;
use serde_json::Value;

use super::{run, stderr, stdout};

/// Time in seconds after which the recorded command of ros2cli was stopped.
const RECORDED_SECONDS: f64 = 7.0;

/// A row of the list of tolerances.
#[derive(Debug)]
struct Tolerance {
    start_up: f64,
    rate: f64,
    time: f64,
    messages: f64,
}

/// A recorded command of ros2cli, and its output.
struct Recorded {
    name: String,
    arguments: Vec<String>,
    start: f64,
    out: String,
    err: String,
}

fn own() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/fixtures/rates")
}

/// Returns the directory of recordings in the corpus.
fn corpus() -> PathBuf {
    ros2probe_testing::corpus().join("cyclonedds/cli-observed-2ns")
}

#[test]
fn printed_rates_agree_with_those_of_ros2cli() {
    let list = tolerances();
    let mut compared = 0;
    for recorded in recorded(&own()) {
        recorded.compare(&own().join("capture.pcap.gz"), &list[&recorded.name]);
        compared += 1;
    }
    assert_eq!(compared, 6);
}

#[test]
#[ignore = "needs the corpus of captures: make test-corpus"]
fn printed_rates_of_the_corpus_agree_with_those_of_ros2cli() {
    let (list, corpus) = (tolerances(), corpus());
    let mut compared = 0;
    for recorded in recorded(&corpus.join("cli")) {
        if let Some(tolerance) = list.get(&recorded.name) {
            recorded.compare(&corpus.join("capture-with-observers.pcap.gz"), tolerance);
            compared += 1;
        } else {
            assert!(recorded.name.ends_with("_points"), "{}", recorded.name);
        }
    }
    assert_eq!(compared, list.len());
}

#[test]
fn received_messages_of_a_lossy_topic_are_counted() {
    let data = Path::new(env!("CARGO_MANIFEST_DIR")).join("../testing/data");
    let on = |capture: &str, arguments: &str| {
        let capture = data.join(capture);
        let mut words: Vec<&str> = arguments.split(' ').collect();
        words.extend(["--replay", capture.to_str().unwrap()]);
        let output = run(&[&["topic"], &words[..]].concat());
        assert_eq!(output.status.code(), Some(0), "{}", stderr(&output));
        stdout(&output)
    };
    let small = "cyclonedds/loss-small-2ns/capture-senderside.pcap.gz";
    let truth = std::fs::read(data.join("cyclonedds/loss-small-2ns/groundtruth.json")).unwrap();
    let truth: Value = serde_json::from_slice(&truth).unwrap();
    let received = truth["received"].as_array().unwrap();
    let imu = received
        .iter()
        .find(|one| one["topic"] == "/robot1/imu/data")
        .unwrap();
    // 902 of 1000 messages were received, so there are 901 intervals.
    let printed = on(small, "hz /robot1/imu/data --distro kilted");
    let window = imu["count"].as_u64().unwrap() - 1;
    assert!(
        printed.ends_with(&format!(" window: {window}\n")),
        "{printed}"
    );
    let (rate, truth) = (
        last(&printed, "average rate: "),
        imu["rate_hz"].as_f64().unwrap(),
    );
    assert!((rate - truth).abs() <= truth / 1000.0, "{rate} of {truth}");
    // Each repair of a reliable topic is counted once. The table also has the other topic.
    let printed = on(small, "hz /chatter robot1/imu/data --distro kilted");
    assert!(
        printed.contains("\n/chatter          ") && printed.contains("   249   \n"),
        "{printed}"
    );
    assert!(printed.contains("\nrobot1/imu/data   180.19"), "{printed}");
    let printed = on(small, "delay /robot1/imu/data");
    assert!(
        printed.contains(&format!("window: {window}\nno new messages\n")),
        "{printed}"
    );

    // 4 of 10 point clouds were complete. The reliable topic has 9 intervals, although fragments
    // were repeated.
    let lossy = "cyclonedds/points-besteffort-lossy-2ns/capture.pcap.gz";
    let printed = on(lossy, "hz /robot1/points --distro kilted");
    assert!(
        printed.contains("average rate: 3.77") && printed.ends_with("window: 3\n"),
        "{printed}"
    );
    let printed = on(lossy, "bw /robot1/points --distro rolling");
    let sizes = "Message size mean: 0.64 MB min: 0.64 MB max: 0.64 MB";
    assert!(
        printed.ends_with(&format!("from 4 messages\n\t{sizes}\n")),
        "{printed}"
    );
    let repeated = "fastrtps-udp/points-reliable-2ns/capture.pcap.gz";
    let printed = on(repeated, "hz /robot1/points --distro kilted");
    assert!(printed.ends_with("window: 9\n"), "{printed}");
}

/// The first message is sent nine seconds before the measurement, and kept by the agent.
#[test]
fn a_latched_message_that_was_sent_before_does_not_count() {
    const START: u64 = 1_700_000_000_000_000_000;
    const MILLISECOND: u64 = 1_000_000;
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("latched.pcap");
    let participant = GuidPrefix([1, 0x10, 0, 0, 0, 0, 0, 0, 0, 0, 1, 1]);
    let talker = writer(participant, 1);
    let mut capture = Capture::new(ETHERNET);
    capture.participant(START, 0, participant);
    let transient_local = 1_u32.to_le_bytes();
    let reliable = [2_u8, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0];
    let qos = [(0x1d, &transient_local[..]), (0x1a, &reliable[..])];
    let announced = "std_msgs::msg::dds_::String_";
    let payload = forge::endpoint_with(talker, "rt/chatter", announced, &qos);
    let message = Message::from(participant).data(SEDP_WRITERS, 1, &payload);
    capture.put(START + MILLISECOND, 0, message);
    capture.sample(START + 1_000 * MILLISECOND, 0, talker, 1);
    for number in 2..24 {
        let time = START + (10_050 + number * 100) * MILLISECOND;
        capture.sample(time, 0, talker, number);
    }
    capture.write(&path);
    let words = ["topic", "hz", "/chatter", "--distro", "kilted"];
    let replay = ["--from", "1700000009.9", "--replay", path.to_str().unwrap()];
    let output = run(&[&words[..], &["--filter", "m.data == 'hello'"], &replay].concat());
    let printed = stdout(&output);
    let expected = "min: 0.100s max: 0.100s std dev: 0.00000s window: 16\n";
    assert!(printed.ends_with(expected), "{printed}{}", stderr(&output));
}

#[test]
fn topics_that_cannot_be_measured_are_refused() {
    let capture = own().join("capture.pcap.gz");
    let on = |arguments: &str| {
        let mut words: Vec<&str> = arguments.split(' ').collect();
        words.extend(["--replay", capture.to_str().unwrap()]);
        let output = run(&[&["topic"], &words[..]].concat());
        (output.status.code(), stderr(&output))
    };
    let neither = "Either specify topic names or use --all/-a option\n".to_owned();
    assert_eq!(on("hz --distro kilted"), (Some(1), neither.clone()));
    assert_eq!(on("bw --distro rolling"), (Some(1), neither));
    assert_eq!(on("hz").0, Some(2));
    let both = "Cannot specify both --all/-a and topic names\n".to_owned();
    assert_eq!(on("hz -a /chatter"), (Some(1), both));
    let (code, printed) = on("delay /a//b");
    assert!(
        code == Some(1) && printed.starts_with("Invalid topic name: "),
        "{printed}"
    );
    let (code, printed) = on("hz -w 0 /chatter");
    assert!(
        code == Some(2) && printed.contains("value must be a positive integer"),
        "{printed}"
    );
}

/// Rates agree with the logs of the nodes to 0.1 %. Those of `ros2 topic hz` differ by 3 %.
#[test]
#[ignore = "needs the corpus of captures: make test-corpus"]
fn rates_of_the_corpus_agree_with_the_logs_of_the_nodes() {
    let (list, corpus) = (tolerances(), corpus());
    let sent = sent(&corpus.join("sensor.jsonl.gz"));
    for recorded in recorded(&corpus.join("cli")) {
        let is_whole = ["hz_chatter", "hz_imu"].contains(&recorded.name.as_str());
        let Some(tolerance) = list.get(&recorded.name).filter(|_| is_whole) else {
            continue;
        };
        let printed = recorded.replayed(&corpus.join("capture-with-observers.pcap.gz"), tolerance);
        let times = &sent[recorded.arguments.last().unwrap()];
        let first = times.partition_point(|time| *time < recorded.start + tolerance.start_up);
        for block in printed.0.split("average rate: ").skip(1) {
            let rate: f64 = block.split('\n').next().unwrap().parse().unwrap();
            let window: usize = block
                .trim_end()
                .rsplit(' ')
                .next()
                .unwrap()
                .parse()
                .unwrap();
            let truth = window as f64 / (times[first + window] - times[first]);
            let name = &recorded.name;
            assert!(
                (rate - truth).abs() <= truth / 1000.0,
                "{name}: {rate} of {truth}"
            );
        }
    }
}

impl Recorded {
    fn compare(&self, capture: &Path, tolerance: &Tolerance) {
        let (out, err) = self.replayed(capture, tolerance);
        let name = &self.name;
        // The reason for missing messages follows the output of ros2cli.
        let why = |line: &&str| {
            let reasons = ["rp: no message on ", "whose announcement was missed"];
            !reasons.iter().any(|reason| line.contains(reason))
        };
        let err: String = err.split_inclusive('\n').filter(why).collect();
        assert_eq!(err, self.err, "{name}");
        let printed = format!("{name} said\n{out}and the original\n{}", self.out);
        assert_eq!(out.lines().count(), self.out.lines().count(), "{printed}");
        for (line, original) in out.lines().zip(self.out.lines()) {
            let (line, original) = (words(line), words(original));
            assert_eq!(line.len(), original.len(), "{printed}");
            let mut before = "";
            for (word, original) in line.iter().zip(&original) {
                let same = tolerance.is_within(before, word, original);
                assert!(same, "`{before} {word}` is not `{original}`: {printed}");
                before = word;
            }
        }
    }

    /// Returns standard output and standard error of the same command on a capture.
    fn replayed(&self, capture: &Path, tolerance: &Tolerance) -> (String, String) {
        let from = format!("{:.9}", self.start + tolerance.start_up);
        let until = format!("{:.9}", self.start + RECORDED_SECONDS);
        let mut words: Vec<&str> = self.arguments.iter().map(String::as_str).collect();
        words.extend(["--distro", "humble", "--replay", capture.to_str().unwrap()]);
        words.extend(["--from", &from, "--until", &until]);
        let output = run(&words);
        (stdout(&output), stderr(&output))
    }
}

impl Tolerance {
    fn is_within(&self, before: &str, word: &str, original: &str) -> bool {
        let (Some(value), Some(wanted)) = (number(word), number(original)) else {
            return word == original;
        };
        match before {
            "rate:" => (value - wanted).abs() <= wanted * self.rate,
            // A bandwidth is the first word of its line.
            "" => (value - wanted).abs() <= wanted * self.rate,
            "window:" | "from" => (value - wanted).abs() <= self.messages,
            _ if word.ends_with('s') || before == "delay:" => (value - wanted).abs() <= self.time,
            _ => word == original,
        }
    }
}

fn words(line: &str) -> Vec<&str> {
    line.split_whitespace().collect()
}

fn number(word: &str) -> Option<f64> {
    word.strip_suffix('s').unwrap_or(word).parse().ok()
}

fn last(printed: &str, words: &str) -> f64 {
    let mut numbers = printed
        .lines()
        .rev()
        .filter_map(|line| line.strip_prefix(words)?.parse().ok());
    numbers.next().unwrap()
}

/// Returns the recorded commands of these verbs.
fn recorded(directory: &Path) -> Vec<Recorded> {
    let mut found = Vec::new();
    for entry in std::fs::read_dir(directory).unwrap() {
        let path = entry.unwrap().path();
        let name = path.file_stem().unwrap().to_str().unwrap().to_owned();
        let verb = name.split('_').next().unwrap();
        if path.extension().is_none_or(|end| end != "cmd") || !["hz", "bw", "delay"].contains(&verb)
        {
            continue;
        }
        let text = std::fs::read_to_string(&path).unwrap();
        let command = text
            .lines()
            .find_map(|line| line.strip_prefix("$ ros2 "))
            .unwrap();
        let start = text
            .lines()
            .find_map(|line| line.strip_prefix("start "))
            .unwrap();
        let read = |end| std::fs::read_to_string(path.with_extension(end)).unwrap_or_default();
        found.push(Recorded {
            name,
            arguments: command.split(' ').map(str::to_owned).collect(),
            start: start.parse().unwrap(),
            out: read("stdout"),
            err: read("stderr"),
        });
    }
    found
}

/// Returns the list of tolerances by recorded command.
fn tolerances() -> BTreeMap<String, Tolerance> {
    let list = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../docs/ros2cli-differences.md");
    let list = std::fs::read_to_string(list).unwrap();
    let (_, rows) = list.split_once("| recorded | start-up |").unwrap();
    let mut tolerances = BTreeMap::new();
    for row in rows.lines().skip(2).take_while(|row| row.starts_with('|')) {
        let cells: Vec<&str> = row.split('|').map(str::trim).collect();
        let [_, name, start_up, rate, time, messages, ..] = cells[..] else {
            panic!("{row}");
        };
        let number = |cell: &str| cell.parse::<f64>().unwrap();
        let tolerance = Tolerance {
            start_up: number(start_up),
            rate: number(rate.trim_end_matches(" %")) / 100.0,
            time: number(time),
            messages: number(messages),
        };
        tolerances.insert(name.trim_matches('`').to_owned(), tolerance);
    }
    assert_eq!(tolerances.len(), 8, "{tolerances:?}");
    tolerances
}

/// Returns the times at which messages were sent, by topic.
fn sent(log: &Path) -> BTreeMap<String, Vec<f64>> {
    let mut text = String::new();
    let file = std::fs::File::open(log).unwrap();
    MultiGzDecoder::new(file).read_to_string(&mut text).unwrap();
    let mut sent: BTreeMap<String, Vec<f64>> = BTreeMap::new();
    for line in text.lines() {
        let event: Value = serde_json::from_str(line).unwrap();
        if event["ev"] == "pub" {
            let topic = event["topic"].as_str().unwrap().to_owned();
            let time = event["t"].as_u64().unwrap() as f64 / 1e9;
            sent.entry(topic).or_default().push(time);
        }
    }
    sent
}
