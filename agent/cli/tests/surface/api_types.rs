//! Each answer of the API can be read as its type of `ros2probe_api`, which serializes to the same
//! JSON. Bodies of requests are serialized from their types.

use std::path::Path;
use std::time::{Duration, Instant};

use crate::page::{self, Lines};
use crate::{read_as, rp};
use ros2probe_api::health::Reloaded;
use ros2probe_api::messages::{self, Definition};
use ros2probe_api::problem::{Code, Problem};
use ros2probe_api::recordings::{
    FilterOptions, Recording, RecordingFiles, RecordingList, RecordingRequest, RecordingState,
};
use ros2probe_api::snapshots::{SnapshotList, WrittenSnapshot};
use ros2probe_api::watches::{Watch, WatchRequest};
use ros2probe_api::{live, samples};
use ros2probe_testing::local_agent::{LocalAgent, PATIENCE, call_api};
use serde::Serialize;
use serde::de::DeserializeOwned;
use serde_json::Value;

const CONFIGURATION: &str = "watch: [{topic: '/**', retain: last}]\n";

/// Sends a typed body, and returns the typed answer, which must have this status.
fn asked<T: DeserializeOwned + Serialize>(
    agent: &LocalAgent,
    method: &str,
    path: &str,
    body: impl Serialize,
    status: u16,
) -> T {
    let body = serde_json::to_string(&body).unwrap();
    let (answered, answer) = call_api(agent.api, method, path, &body);
    assert_eq!(answered, status, "{method} {path}: {answer}");
    read_as(&answer)
}

fn get<T: DeserializeOwned + Serialize>(agent: &LocalAgent, path: &str) -> T {
    asked(agent, "GET", path, (), 200)
}

/// Starts a replay that outlasts the test, with a directory for bags.
fn agent(capture: &str, configuration: &Path) -> LocalAgent {
    let configuration = configuration.to_str().unwrap();
    let arguments = ["--speed", "0.5", "--config", configuration];
    let mut agent = LocalAgent::replay(&mut rp(), &page::data(capture), &arguments);
    agent.wait_for_log("ready");
    agent
}

#[test]
fn answers_of_a_running_robot_are_read_as_their_types_and_serialize_to_the_same_json() {
    for capture in ["cyclonedds/lifecycle-2ns", "fastrtps-udp/lifecycle-2ns"] {
        let directory = tempfile::tempdir().unwrap();
        let file = directory.path().join("ros2probe.yaml");
        let bags = directory.path().join("bags");
        let text = format!(
            "{CONFIGURATION}recordings:\n  directory: {}\n  reserve_percent: 0\n  \
             reserve_bytes: 0\n  snapshots: [{{name: last, topics: ['/**'], seconds: 5}}]\n",
            bags.display()
        );
        std::fs::write(&file, &text).unwrap();
        let agent = agent(capture, &file);
        recordings(&agent);
        let topic = published(&agent);
        streams(&agent, &topic);
        let watch: Watch = asked(&agent, "POST", "/watch/new", WatchRequest::default(), 201);
        assert_eq!(watch.topic, "/new");
        reload(&agent, &file, &text);
    }
}

fn recordings(agent: &LocalAgent) {
    let request = RecordingRequest {
        name: Some("drive".to_owned()),
        topics: FilterOptions::everything(),
        ..RecordingRequest::default()
    };
    let begun: Recording = asked(agent, "POST", "/recordings", &request, 201);
    assert_eq!(begun.state, RecordingState::Recording);
    assert_eq!((&*begun.name, &begun.topics), ("drive", &request.topics));
    let deadline = Instant::now() + PATIENCE;
    let is_steady = |recording: Recording| {
        let mut topics = recording.report.topics.values();
        topics.any(|topic| topic.messages > 4)
    };
    while !is_steady(get(agent, "/recordings/drive")) {
        assert!(Instant::now() < deadline, "nothing was recorded");
        std::thread::sleep(Duration::from_millis(50));
    }
    let list: RecordingList = get(agent, "/recordings");
    assert!(list.recordings.len() == 1 && list.directory.is_some());
    let ended: Recording = asked(agent, "DELETE", "/recordings/drive", (), 200);
    assert_eq!(ended.state, RecordingState::Ended);
    assert!(ended.report.topics.values().any(|topic| topic.messages > 0));
    let files: RecordingFiles = get(agent, "/recordings/drive/files");
    assert!(files.files.iter().any(|file| file.file == "metadata.yaml"));
    let written: WrittenSnapshot = asked(agent, "POST", "/snapshots/last", (), 201);
    assert!(written.messages > 0);
    let list: SnapshotList = get(agent, "/snapshots");
    assert_eq!(list.snapshots[0].name, "last");
    assert_eq!(list.snapshots.len(), 1);
}

/// Returns the topic with the most messages.
fn published(agent: &LocalAgent) -> String {
    let list: RecordingList = get(agent, "/recordings");
    let topics = &list.recordings[0].report.topics;
    let most = topics.iter().max_by_key(|(_, topic)| topic.messages);
    most.unwrap().0.clone()
}

fn streams(agent: &LocalAgent, topic: &str) {
    let open = |path: &str| Lines::open(agent.api, path, "").unwrap_or_else(|_| panic!("{path}"));
    let mut stream = open("/live");
    let line =
        |(name, value): (String, Value)| Value::Object([(name, value)].into_iter().collect());
    let lines = stream.batch().into_iter().chain(stream.batch());
    let lines: Vec<live::Line<'_>> = lines.map(|each| read_as(&line(each))).collect();
    assert!(matches!(lines.first(), Some(live::Line::Open(_))));
    let is_graph = |line: &live::Line<'_>| matches!(line, live::Line::Graph(graph) if !graph.publishers.is_empty());
    assert!(lines.iter().any(is_graph));
    assert!(
        lines
            .iter()
            .any(|line| matches!(line, live::Line::Findings(_)))
    );

    let known: Definition = get(agent, &format!("/topics{topic}/definition"));
    let mut stream = open(&format!("/topics{topic}/messages"));
    let mut has_type = false;
    loop {
        match read_as(&line(stream.next().unwrap())) {
            messages::Line::Type(found) => {
                has_type = true;
                assert_eq!(found, known);
            }
            messages::Line::<messages::Message<Value>>::Message(message) => {
                assert!(has_type && message.bytes > 0);
                break;
            }
            messages::Line::End(end) => panic!("{end:?}"),
            messages::Line::Missed(_) | messages::Line::Beat(_) => {}
        }
    }
    let mut stream = open(&format!("/samples?topic={topic}"));
    let mut has_sample = false;
    while !has_sample {
        let line: samples::Line = read_as(&line(stream.next().unwrap()));
        has_sample = matches!(line, samples::Line::Sample(_));
    }
}

fn reload(agent: &LocalAgent, file: &Path, text: &str) {
    std::fs::write(file, format!("{text}limits: {{topics: 7}}\n")).unwrap();
    let reloaded: Reloaded = asked(agent, "POST", "/-/reload", (), 200);
    assert_eq!(
        (reloaded.watches, &*reloaded.needs_restart),
        (2, &["limits".into()][..])
    );
    std::fs::write(file, "watsch: []\n").unwrap();
    let problem: Problem = asked(agent, "POST", "/-/reload", (), 422);
    assert!(problem.kind.ends_with(Code::InvalidConfiguration.as_str()));
    assert_eq!(problem.mistakes.len(), 1, "{problem:?}");
}

#[test]
fn a_missed_message_with_a_reason_of_a_newer_agent_is_read_and_kept() {
    let line = serde_json::json!({"missed": {
        "topic": "/a", "domain_id": 0, "writer": "01", "samples": 2, "first_sequence_number": 4,
        "last_sequence_number": 5, "reason": "writer_restarted",
    }});
    let samples::Line::Missed(missed) = read_as(&line) else {
        panic!("{line}");
    };
    assert_eq!(missed.known_reason(), samples::MissedReason::NotCaptured);
}
