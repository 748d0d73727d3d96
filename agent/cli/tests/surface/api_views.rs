//! The control API for captures of real robots. The binary replays each capture up to a time at
//! which the graph of a real node is known.

use std::collections::{BTreeMap, BTreeSet};
use std::fs::File;
use std::io::Read as _;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use crate::{read_as, rp};
use flate2::read::MultiGzDecoder;
use ros2probe_api::Open;
use ros2probe_api::attributes;
use ros2probe_api::diagnosis::Finding;
use ros2probe_api::events::Event;
use ros2probe_api::graph::Graph;
use ros2probe_api::health::Health;
use ros2probe_api::names::Names;
use ros2probe_api::nodes::{Node, NodeList};
use ros2probe_api::participants::{ParticipantList, ProcessList};
use ros2probe_api::problem::{Code, Problem};
use ros2probe_api::services::{ActionList, ServiceList};
use ros2probe_api::topics::{History, TopicDetails, TopicList};
use ros2probe_api::watches::{WatchList, WatchState};
use ros2probe_testing::local_agent::{self, Answer, LocalAgent, request};
use ros2probe_testing::model::forge;
use ros2probe_testing::model::forge::Message;
use ros2probe_testing::truth::{self, GraphLine, Scenario};
use ros2probe_wire::{EntityId, Guid, GuidPrefix};
use serde_json::Value;

/// After this time, in nanoseconds, nodes have processed an announcement.
const SETTLED: u64 = 500_000_000;

/// An agent that has replayed a capture up to a point in time.
struct Robot {
    agent: LocalAgent,
    _capture: tempfile::TempPath,
}

impl Robot {
    fn at(capture: &Path, until: u64, watch: &str) -> Self {
        let mut file = tempfile::NamedTempFile::with_suffix(".pcap").unwrap();
        std::io::Write::write_all(&mut file, &beginning(capture, until)).unwrap();
        Self::of(file.into_temp_path(), watch)
    }

    fn of(capture: tempfile::TempPath, watch: &str) -> Self {
        let arguments = ["--speed", "max", "--watch", watch];
        let mut agent = LocalAgent::replay(&mut rp(), &capture, &arguments);
        agent.wait_for_log("the capture has ended");
        Self {
            agent,
            _capture: capture,
        }
    }

    fn ask(&self, path: &str) -> Answer {
        request(self.agent.api, "GET", path, "")
    }

    fn get(&self, path: &str) -> Value {
        let answer = self.ask(path);
        assert_eq!(answer.status, 200, "{path}: {}", answer.body);
        serde_json::from_str(&answer.body).unwrap()
    }

    /// Returns status, code and detail of a refusal.
    fn problem(&self, path: &str) -> (u16, String, String) {
        let answer = self.ask(path);
        let body: Value = serde_json::from_str(&answer.body).unwrap();
        let text = |key: &str| body[key].as_str().unwrap().to_owned();
        let code = text("type").replace("urn:ros2probe:problem:", "");
        (answer.status, code, text("detail"))
    }
}

fn data(scenario: &str) -> Vec<Scenario> {
    let data = Path::new(env!("CARGO_MANIFEST_DIR")).join("../testing/data");
    let mut scenarios = truth::scenarios(&data);
    scenarios.retain(|each| each.name().contains(scenario));
    scenarios
}

fn capture_of(scenario: &str) -> PathBuf {
    data(scenario).pop().unwrap().capture
}

/// Returns the packets of a capture file (classic, little-endian, microseconds) before a point in
/// time.
fn beginning(capture: &Path, until: u64) -> Vec<u8> {
    let mut all = Vec::new();
    let file = File::open(capture).unwrap();
    MultiGzDecoder::new(file).read_to_end(&mut all).unwrap();
    let number = |at: usize| u32::from_le_bytes(all[at..at + 4].try_into().unwrap());
    let unit = match number(0) {
        0xa1b2_c3d4 => 1_000,
        0xa1b2_3c4d => 1,
        magic => panic!("{magic:x}"),
    };
    let mut end = 24;
    while end < all.len() {
        let time = u64::from(number(end)) * 1_000_000_000 + u64::from(number(end + 4)) * unit;
        if time >= until {
            break;
        }
        end += 16 + number(end + 8) as usize;
    }
    all.truncate(end);
    all
}

fn names(list: &Value) -> BTreeSet<String> {
    let names = list.as_array().unwrap().iter();
    names
        .map(|each| each["name"].as_str().unwrap().to_owned())
        .collect()
}

fn texts(list: &Value) -> Vec<String> {
    let texts = list.as_array().unwrap().iter();
    texts
        .map(|each| each.as_str().unwrap().to_owned())
        .collect()
}

fn named<'a>(list: &'a Value, name: &str) -> &'a Value {
    let mut all = list.as_array().unwrap().iter();
    let found = all.find(|each| each["name"] == name);
    found.unwrap_or_else(|| panic!("no {name} in {list}"))
}

/// Returns the lines after which the graph did not change for at least 1 s.
fn settled(lines: &[GraphLine]) -> impl Iterator<Item = &GraphLine> {
    let pairs = lines.iter().zip(lines.iter().skip(1));
    let settled = pairs.filter(|(line, next)| next.t - line.t >= 2 * SETTLED);
    settled.map(|(line, _)| line)
}

#[test]
fn topics_services_and_nodes_equal_the_graph_of_a_real_node() {
    let mut compared = 0;
    for scenario in data("lifecycle-2ns") {
        for (witness, lines) in scenario.graphs() {
            // The first line describes the whole robot, the last line what remains of it.
            let all: Vec<_> = settled(&lines).collect();
            let (Some(first), Some(last)) = (all.first(), all.last()) else {
                continue;
            };
            for line in [first, last] {
                let name = format!("{} as {witness} saw it at {}", scenario.name(), line.t);
                believed(&name, &scenario.capture, line);
                compared += 1;
            }
        }
    }
    assert!(compared >= 6, "{compared}");
}

fn believed(name: &str, capture: &Path, line: &GraphLine) {
    let robot = Robot::at(capture, line.t + SETTLED, "/**");
    let nodes = robot.get("/nodes?hidden=true");
    let expected: BTreeSet<_> = line.nodes.iter().cloned().collect();
    assert_eq!(names(&nodes["nodes"]), expected, "{name}");

    let topics = robot.get("/topics?hidden=true");
    let mut found = BTreeMap::new();
    for topic in topics["topics"].as_array().unwrap() {
        let is_plumbing = ["service_request", "service_reply", "discovery", "dds"]
            .iter()
            .any(|kind| topic["kind"] == *kind);
        if topic["vanished"] == false && !is_plumbing {
            let count = |key: &str| topic[key].as_array().unwrap().len();
            let ends = (count("publishers"), count("subscriptions"));
            let name = topic["name"].as_str().unwrap().to_owned();
            found.insert(name, (texts(&topic["message_types"]), ends.0, ends.1));
        }
    }
    let expected: BTreeMap<_, _> = line
        .topics
        .iter()
        .map(|(topic, facts)| (topic.clone(), (facts.types.clone(), facts.pubs, facts.subs)))
        .collect();
    assert_eq!(found, expected, "{name}");

    let services = robot.get("/services?hidden=true");
    let services = services["services"].as_array().unwrap().iter();
    let found = services.map(|each| {
        let name = each["name"].as_str().unwrap().to_owned();
        (name, texts(&each["types"]))
    });
    let expected: BTreeMap<_, _> = line.services.clone().unwrap().into_iter().collect();
    assert_eq!(found.collect::<BTreeMap<_, _>>(), expected, "{name}");

    check_graph(&robot);
}

/// Checks that both ends of every edge exist, and that every listed node is in the graph.
fn check_graph(robot: &Robot) {
    let graph = robot.get("/graph?hidden=true");
    let vertices = graph["nodes"].as_array().unwrap();
    let ids: BTreeSet<_> = vertices
        .iter()
        .map(|each| &each["id"])
        .map(Value::to_string)
        .collect();
    assert_eq!(ids.len(), vertices.len());
    for edge in graph["edges"].as_array().unwrap() {
        for end in ["source", "target"] {
            assert!(ids.contains(&edge[end].to_string()), "{edge}");
        }
    }
    let nodes = robot.get("/nodes?hidden=true");
    for node in names(&nodes["nodes"]) {
        assert!(ids.contains(&format!("\"node:0:{node}\"")), "{node}");
    }
}

#[test]
fn one_robot_is_described_as_ros2_describes_it() {
    let scenario = data("jazzy-cyclonedds/lifecycle-2ns").pop().unwrap();
    let (_, lines) = scenario.graphs().pop().unwrap();
    let line = settled(&lines).next().unwrap();
    let robot = Robot::at(&scenario.capture, line.t + SETTLED, "/robot1/imu/data");

    let node = robot.get("/nodes/robot1/sensor_node");
    let published = names(&node["publishers"]);
    for topic in [
        "/robot1/imu/data",
        "/robot1/odom",
        "/rosout",
        "/parameter_events",
    ] {
        assert!(published.contains(topic), "{published:?}");
    }
    assert!(names(&node["subscriptions"]).contains("/robot1/cmd_vel"));
    assert!(names(&node["services"]).contains("/robot1/add_two_ints"));
    let fibonacci = named(&node["action_servers"], "/robot1/fibonacci");
    assert_eq!(
        texts(&fibonacci["types"]),
        ["example_interfaces/action/Fibonacci"]
    );
    assert_eq!(node["instances"].as_array().unwrap().len(), 1);
    assert!(!published.contains("/robot1/fibonacci/_action/feedback"));
    let listener = robot.get("/nodes/robot2/listener_node");
    assert!(names(&listener["action_clients"]).contains("/robot1/fibonacci"));

    let actions = robot.get("/actions");
    let action = named(&actions["actions"], "/robot1/fibonacci");
    assert_eq!(action["servers"][0]["node"], "/robot1/sensor_node");
    assert_eq!(action["clients"][0]["node"], "/robot2/listener_node");
    assert_eq!(action["parts"].as_array().unwrap().len(), 8);

    let services = robot.get("/services");
    let shown = names(&services["services"]);
    assert!(shown.iter().all(|name| !name.contains("/_")), "{shown:?}");
    let add = named(&services["services"], "/robot1/add_two_ints");
    assert_eq!(add["servers"][0]["node"], "/robot1/sensor_node");
    assert_eq!(texts(&add["types"]), ["example_interfaces/srv/AddTwoInts"]);

    topics_are_described(&robot);

    let participants = robot.get("/participants?domain_id=0");
    let participants = participants["participants"].as_array().unwrap();
    assert_eq!(participants.len(), 3);
    for participant in participants {
        assert_eq!(participant["host"], "vm");
        assert!(!participant["nodes"].as_array().unwrap().is_empty());
        assert!(participant["writers"].as_u64().unwrap() > 5);
    }

    check_edges(&robot);
    wrong_queries_are_refused_with_a_hint(&robot);
}

fn topics_are_described(robot: &Robot) {
    let topic = robot.get("/topics/robot1/imu/data");
    assert_eq!(texts(&topic["message_types"]), ["sensor_msgs/msg/Imu"]);
    assert!(
        topic["type_hashes"][0]
            .as_str()
            .unwrap()
            .starts_with("RIHS01_")
    );
    let publisher = &topic["publishers"][0];
    assert_eq!(publisher["node"], "/robot1/sensor_node");
    assert_eq!(publisher["vendor"], "Eclipse Cyclone DDS");
    assert_eq!(publisher["qos"]["reliability"], "BEST_EFFORT");
    assert_eq!(publisher["qos"]["deadline_seconds"], Value::Null);
    assert!(
        topic["measurement"]["messages"].as_u64().unwrap() > 50,
        "{topic}"
    );
    assert!(
        topic["measurement"]["rate_hertz"].as_f64().unwrap() > 10.0,
        "{topic}"
    );
    assert_eq!(topic["watches"][0]["origin"], "command_line");
    assert!(!topic["deliveries"].as_array().unwrap().is_empty());
    let reasons = |topic: &Value| -> Vec<String> {
        let reasons = topic["reasons"].as_array().unwrap().iter();
        reasons
            .map(|each| each["code"].as_str().unwrap().to_owned())
            .collect()
    };
    assert_eq!(reasons(&topic), [""; 0]);
    assert_eq!(reasons(&robot.get("/topics/robot1/odom")), ["not_watched"]);
    let temporary = robot.get("/topics/robot1/temporary");
    assert_eq!(temporary["domain_id"], 0);
    let request = robot.get("/topics/rq/robot1/add_two_intsRequest");
    assert_eq!(request["kind"], "service_request");
}

fn check_edges(robot: &Robot) {
    let graph = robot.get("/graph");
    let edges = graph["edges"].as_array().unwrap();
    let is_there = |source: &str, target: &str, kind: &str| {
        let same = |edge: &&Value| {
            edge["source"] == source && edge["target"] == target && edge["kind"] == kind
        };
        assert!(
            edges.iter().any(|edge| same(&edge)),
            "{source} {kind} {target}"
        );
    };
    let (sensor, listener) = ("node:0:/robot1/sensor_node", "node:0:/robot2/listener_node");
    is_there(sensor, "topic:0:/robot1/imu/data", "publishes");
    is_there("topic:0:/robot1/imu/data", listener, "feeds");
    is_there(listener, "action:0:/robot1/fibonacci", "calls");
    is_there("service:0:/robot1/add_two_ints", sensor, "served_by");
}

fn wrong_queries_are_refused_with_a_hint(robot: &Robot) {
    let (status, code, detail) = robot.problem("/topics/robot1/imu/dat");
    assert_eq!((status, code.as_str()), (404, "no-such-topic"));
    assert!(detail.contains("did you mean /robot1/imu/data"), "{detail}");
    let (status, code, detail) = robot.problem("/nodes/sensor_node");
    assert_eq!((status, code.as_str()), (404, "no-such-node"));
    assert!(detail.contains("/robot1/sensor_node"), "{detail}");
    let (status, ..) = robot.problem("/topics/robot1/imu/data?domain_id=7");
    assert_eq!(status, 404);
    for path in [
        "/topics?hiden=true",
        "/topics?domain_id=x",
        "/nodes?domain_id=233",
        "/nodes?hidden=perhaps",
        "/services?all",
        "/actions?hidden=",
        "/participants?hidden=true",
        "/graph?x=1",
        "/topics/robot1/imu/data?hidden=true",
    ] {
        let (status, code, _) = robot.problem(path);
        assert_eq!(
            (status, code.as_str()),
            (400, "malformed-request"),
            "{path}"
        );
    }
    for path in [
        "/topics",
        "/nodes",
        "/services",
        "/actions",
        "/participants",
        "/graph",
    ] {
        let elsewhere = robot.get(&format!("{path}?domain_id=7"));
        let lists = elsewhere.as_object().unwrap().values();
        let mut lists = lists.filter_map(Value::as_array);
        assert!(lists.all(Vec::is_empty), "{elsewhere}");
    }
}

/// Cyclone DDS did not match the two endpoints: the subscriber logged no message.
#[test]
fn incompatible_qos_of_real_participants_is_reported_in_the_topic_and_as_a_metric() {
    let capture = capture_of("qos-mismatch-2ns");
    // A point in time before the participants leave.
    let goodbye = 1_795_142_070_000_000_000;
    let robot = Robot::at(&capture, goodbye, "/chatter_be");
    let topic = robot.get("/topics/chatter_be");
    let findings = topic["diagnoses"].as_array().unwrap();
    let of = |kind: &str| findings.iter().find(|each| each["kind"] == kind);
    let incompatible = of("qos_incompatible").unwrap();
    assert_eq!(texts(&incompatible["policies"]), ["reliability"]);
    let guid_of = |node: &str, list: &str| {
        let list = topic[list].as_array().unwrap();
        let endpoint = list.iter().find(|each| each["node"] == node);
        endpoint.unwrap()["guid"].clone()
    };
    assert_eq!(incompatible["writer"], guid_of("/be_pub", "publishers"));
    assert_eq!(incompatible["reader"], guid_of("/rel_sub", "subscriptions"));
    let page = robot.agent.get("/metrics").body;
    let labels = "domain_id=\"0\",topic=\"/chatter_be\",policy=\"reliability\"";
    let series = format!("ros2_qos_incompatible_pairs{{{labels}}}");
    assert_eq!(local_agent::metric(&page, &series), Some(1.0));
    let others = page
        .lines()
        .filter(|line| line.starts_with("ros2_qos_incompatible_pairs{"));
    assert_eq!(others.count(), 1);
}

#[test]
fn each_answer_is_read_as_its_type_and_serializes_to_the_same_json() {
    // A point in time before the participants leave.
    let goodbye = 1_795_142_070_000_000_000;
    let robot = Robot::at(&capture_of("qos-mismatch-2ns"), goodbye, "/**");
    let topics: TopicList<'_> = read_as(&robot.get("/topics"));
    let mut topics = topics.topics.iter();
    assert!(topics.any(|topic| !topic.diagnoses.is_empty()));
    read_all(&robot);

    let scenario = data("jazzy-cyclonedds/lifecycle-2ns").pop().unwrap();
    let (_, lines) = scenario.graphs().pop().unwrap();
    let line = settled(&lines).next().unwrap();
    let robot = Robot::at(&scenario.capture, line.t + SETTLED, "/**");
    let actions: ActionList<'_> = read_as(&robot.get("/actions"));
    assert!(!actions.actions.is_empty());
    read_all(&robot);
}

fn read_all(robot: &Robot) {
    let names: Names<'_> = read_as(&robot.get("/names?hidden=true"));
    let list: TopicList<'_> = read_as(&robot.get("/topics?hidden=true"));
    let topics = list.topics.iter();
    let is_known = |finding: &Finding<'_>| matches!(finding, Open::Known(_));
    assert!(
        topics
            .clone()
            .flat_map(|topic| &topic.diagnoses)
            .all(is_known)
    );
    let mut reasons = topics.clone().flat_map(|topic| &topic.reasons);
    assert!(reasons.all(|reason| matches!(reason.code, Open::Known(_))));
    assert!(topics.clone().any(|topic| topic.measurement.is_some()));
    for topic in topics.filter(|topic| topic.dds_name.starts_with("rt/")) {
        let path = format!("/topics{}", topic.name);
        let details: TopicDetails<'_> = read_as(&robot.get(&path));
        assert_eq!(details.topic.dds_name, topic.dds_name);
        let _: History = read_as(&robot.get(&format!("{path}/history")));
    }
    let nodes: NodeList<'_> = read_as(&robot.get("/nodes?hidden=true"));
    assert!(!nodes.nodes.is_empty() && nodes.nodes.len() == names.nodes.len());
    for node in &nodes.nodes {
        let _: Node<'_> = read_as(&robot.get(&format!("/nodes{}?hidden=true", node.name)));
    }
    let services: ServiceList<'_> = read_as(&robot.get("/services?hidden=true"));
    assert!(!services.services.is_empty());
    let participants: ParticipantList<'_> = read_as(&robot.get("/participants"));
    assert!(!participants.participants.is_empty());
    let _: ProcessList = read_as(&robot.get("/processes"));
    let graph: Graph = read_as(&robot.get("/graph?hidden=true"));
    assert!(
        graph
            .edges
            .iter()
            .all(|edge| matches!(edge.kind, Open::Known(_)))
    );
    let health: Health = read_as(&robot.get("/health"));
    assert!(health.finished && !health.tables.is_empty() && !health.limits.is_empty());
    let watches: WatchList = read_as(&robot.get("/watch"));
    assert_eq!(watches.watches[0].state, WatchState::Measuring);
    let refused = robot.ask("/topics/nothing");
    let problem: Problem = read_as(&serde_json::from_str(&refused.body).unwrap());
    assert!(problem.kind.ends_with(Code::NoSuchTopic.as_str()));
    assert_eq!(
        (problem.status, refused.status),
        (404, Code::NoSuchTopic.status())
    );
    let events = robot.ask("/events?after=0&follow=false").body;
    let data = events
        .lines()
        .filter_map(|line| line.strip_prefix("data: "));
    let data: Vec<Value> = data
        .map(|data| serde_json::from_str(data).unwrap())
        .collect();
    assert!(!data.is_empty());
    for event in &data {
        let event: Event<'_> = read_as(event);
        let mut values = event.attributes.0.iter().map(|(_, value)| value);
        assert!(values.all(|value| !matches!(value, attributes::Value::Unknown(_))));
    }
}

#[test]
fn a_topic_in_shared_memory_is_not_reported_as_silent() {
    let capture = capture_of("fastrtps-default/samehost-any");
    // A point in time before the first participant leaves.
    let goodbye = 1_795_142_305_000_000_000;
    let robot = Robot::at(&capture, goodbye, "/**");
    let topic = robot.get("/topics/chatter");
    let passages = topic["passages"].as_array().unwrap();
    assert_eq!(passages[0]["passage"], "shared_memory", "{topic}");
    // A capture contains no traffic of shared memory.
    assert_eq!(passages[0]["view"], "none", "{topic}");
    assert_eq!(topic["reasons"][0]["code"], "shared_memory", "{topic}");
}

#[test]
fn a_thousand_topics_are_listed_within_seconds() {
    let mut file = tempfile::NamedTempFile::with_suffix(".pcap").unwrap();
    std::io::Write::write_all(&mut file, &large_robot(1000)).unwrap();
    let robot = Robot::of(file.into_temp_path(), "/**");
    for path in ["/topics", "/nodes", "/graph"] {
        let began = Instant::now();
        let answer = robot.ask(path);
        let took = began.elapsed();
        println!("{path}: {took:?} for {} bytes", answer.body.len());
        assert_eq!(answer.status, 200);
        // The limit allows for a build without optimizations and for other tests on the machine.
        assert!(took < Duration::from_secs(60), "{path}: {took:?}");
    }
    let topics = robot.get("/topics");
    assert_eq!(topics["topics"].as_array().unwrap().len(), 1000);
    let nodes = robot.get("/nodes");
    assert_eq!(nodes["nodes"].as_array().unwrap().len(), 100);
    let graph = robot.get("/graph");
    assert_eq!(graph["edges"].as_array().unwrap().len(), 2000);
    let (_, _, detail) = robot.problem("/topics/topic_0999x");
    assert!(detail.contains("did you mean /topic_0999"), "{detail}");
}

/// Returns a capture in which a participant announces a writer and a reader for each topic.
fn large_robot(topics: u32) -> Vec<u8> {
    const START: u64 = 1_795_143_000;
    let prefix = GuidPrefix(*b"\x01\x10large-host");
    let mut capture = vec![0xd4, 0xc3, 0xb2, 0xa1, 2, 0, 4, 0, 0, 0, 0, 0, 0, 0, 0, 0];
    capture.extend_from_slice(&[0xff, 0xff, 0, 0, 1, 0, 0, 0]);
    let mut put = |message: Message| {
        let payload = message.bytes();
        let length = u16::try_from(payload.len()).unwrap();
        let mut frame = vec![1, 0, 0x5e, 0x7f, 0, 1, 2, 0, 0, 0, 0, 1, 8, 0, 0x45, 0];
        frame.extend_from_slice(&(length + 28).to_be_bytes());
        frame.extend_from_slice(&[0, 1, 0, 0, 64, 17, 0, 0, 10, 0, 0, 1, 239, 255, 0, 1]);
        frame.extend_from_slice(&[0x1c, 0xe9, 0x1c, 0xe8]);
        frame.extend_from_slice(&(length + 8).to_be_bytes());
        frame.extend_from_slice(&[0, 0]);
        frame.extend_from_slice(&payload);
        let size = u32::try_from(frame.len()).unwrap();
        for number in [u32::try_from(START).unwrap(), 0, size, size] {
            capture.extend_from_slice(&number.to_le_bytes());
        }
        capture.extend_from_slice(&frame);
    };
    put(Message::from(prefix).data(forge::SPDP, 1, &forge::participant(prefix, 100, None)));
    let mut nodes = Vec::new();
    for number in 1..=topics {
        let [_, high, middle, low] = number.to_be_bytes();
        for (kind, sedp) in [(3, forge::SEDP_WRITERS), (4, forge::SEDP_READERS)] {
            let guid = Guid::new(prefix, EntityId([high, middle, low, kind]));
            let topic = format!("rt/topic_{number:04}");
            let endpoint = forge::endpoint(guid, &topic, "std_msgs::msg::dds_::String_", true);
            put(Message::from(prefix).data(sedp, number.into(), &endpoint));
            if kind == 3 && number % 10 == 0 {
                nodes.push((format!("node_{number}"), guid));
            }
        }
    }
    let nodes = nodes.iter().map(|(name, guid)| ("/", name.as_str(), *guid));
    let entities = forge::entities(prefix, 24, &nodes.collect::<Vec<_>>());
    let writer = EntityId([1, 0, 0, 3]);
    put(Message::from(prefix).data(writer, 1, &entities));
    capture
}
