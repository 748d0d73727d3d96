//! `GET /events` of the real binary. The events of a replay are in order, with names and
//! attributes. A client can resume and filter the stream, and the stream does not delay the end of
//! the agent.

use std::collections::BTreeMap;
use std::io::{BufRead as _, BufReader, Read as _, Write as _};
use std::net::{SocketAddr, TcpStream};
use std::path::Path;
use std::time::{Duration, Instant};

use crate::replay::change;
use crate::rp;
use ros2probe_testing::local_agent::{self, LocalAgent, PATIENCE, request};
use ros2probe_testing::model::capture;
use serde_json::Value;

/// The end of a message of a stream.
const END: &str = "\n\n";

/// A message of a stream.
#[derive(Clone, Debug, Default, PartialEq)]
pub(crate) struct Message {
    pub(crate) event: String,
    id: String,
    data: String,
}

impl Message {
    fn parse(text: &str) -> Self {
        let mut message = Self::default();
        for line in text.lines() {
            let Some((field, value)) = line.split_once(": ") else {
                continue;
            };
            match field {
                "event" => message.event = value.to_owned(),
                "id" => message.id = value.to_owned(),
                "data" => message.data = value.to_owned(),
                _ => {}
            }
        }
        message
    }

    pub(crate) fn json(&self) -> Value {
        serde_json::from_str(&self.data).unwrap_or_else(|error| panic!("{error}: {self:?}"))
    }

    fn attribute(&self, name: &str) -> Value {
        self.json()["attributes"][name].clone()
    }
}

/// Returns all events that the agent keeps, without the greeting.
pub(crate) fn kept(agent: &LocalAgent, query: &str) -> Vec<Message> {
    let path = format!("/events?after=0&follow=false{query}");
    messages(&request(agent.api, "GET", &path, "").body)
}

/// Returns the messages of a chunked answer. Chunk boundaries are between messages.
fn messages(body: &str) -> Vec<Message> {
    let body: String = body
        .split("\r\n")
        .filter(|line| !line.chars().all(|c| c.is_ascii_hexdigit()))
        .collect();
    let messages = body.split(END).map(Message::parse);
    messages
        .filter(|message| !message.event.is_empty())
        .collect()
}

/// Replays a capture to its end.
fn replayed(capture: &Path, arguments: &[&str]) -> LocalAgent {
    let mut agent = LocalAgent::replay(
        &mut rp(),
        capture,
        &[&["--speed", "max"], arguments].concat(),
    );
    agent.wait_for_log("the capture has ended");
    agent
}

/// An open stream.
struct Stream(BufReader<TcpStream>);

impl Stream {
    fn open(api: SocketAddr, path: &str, headers: &str) -> Self {
        let mut stream = TcpStream::connect(api).unwrap();
        stream.set_read_timeout(Some(PATIENCE)).unwrap();
        let request = format!("GET {path} HTTP/1.1\r\nHost: {api}\r\n{headers}\r\n");
        stream.write_all(request.as_bytes()).unwrap();
        let mut stream = Self(BufReader::new(stream));
        let head: Vec<String> =
            std::iter::from_fn(|| stream.line().filter(|line| !line.is_empty())).collect();
        assert!(head[0].contains(" 200 "), "{head:?}");
        let media = "content-type: text/event-stream";
        assert!(
            head.iter()
                .any(|line| line.to_lowercase().starts_with(media))
        );
        stream
    }

    fn line(&mut self) -> Option<String> {
        let mut line = String::new();
        let count = self.0.read_line(&mut line).unwrap();
        (count > 0).then(|| line.trim_end().to_owned())
    }

    /// Returns the next message that is an event. The greeting has only an id.
    fn next(&mut self) -> Message {
        let mut text = String::new();
        loop {
            let line = self.line().unwrap_or_else(|| panic!("ended after {text}"));
            if line.is_empty() {
                let message = Message::parse(&text);
                text.clear();
                if !message.event.is_empty() {
                    return message;
                }
            } else {
                text.push_str(&line);
                text.push('\n');
            }
        }
    }

    fn wait_for(&mut self, event: &str) -> Message {
        loop {
            let message = self.next();
            if message.event == event {
                return message;
            }
        }
    }
}

#[test]
fn events_of_a_robot_are_in_order_and_filtered_by_name_and_topic() {
    let agent = replayed(&local_agent::capture(), &[]);
    let all = kept(&agent, "");
    let mut counts = BTreeMap::<&str, usize>::new();
    for message in &all {
        *counts.entry(message.event.as_str()).or_default() += 1;
    }
    assert_eq!(all[0].event, "ros2probe.agent.started");
    assert_eq!(all[0].attribute("source"), "replay");
    assert_eq!(counts["ros2.participant.discovered"], 4, "{counts:?}");
    assert_eq!(counts["ros2.node.discovered"], 4, "{counts:?}");
    let page = agent.get("/metrics").body;
    for (name, count) in &counts {
        let series = format!("ros2probe_events_total{{name=\"{name}\"}}");
        let reported = local_agent::metric(&page, &series);
        assert_eq!(
            reported,
            Some(f64::from(u32::try_from(*count).unwrap())),
            "{name}"
        );
    }
    for (number, message) in all.iter().enumerate() {
        let end = format!("-{}", number + 1);
        assert!(message.id.ends_with(&end), "{message:?}");
        let json = message.json();
        assert_eq!(
            (&json["id"], &json["name"]),
            (&message.id.clone().into(), &message.event.clone().into())
        );
        assert_eq!(json["severity"], "INFO", "{message:?}");
        let time = json["time"].as_str().unwrap();
        assert!(time.len() == 30 && time.ends_with('Z'), "{time}");
    }

    let chatter = kept(
        &agent,
        "&name=ros2.endpoint.*,ros2.node.lost&topic=/chatter",
    );
    let reported = chatter
        .iter()
        .map(|message| (message.event.as_str(), message.attribute("role")));
    assert_eq!(
        reported.collect::<Vec<_>>(),
        [
            ("ros2.endpoint.discovered", "reader".into()),
            ("ros2.endpoint.discovered", "writer".into()),
            ("ros2.endpoint.lost", "writer".into()),
        ],
        "{chatter:?}"
    );
    let writer = &chatter[2];
    assert_eq!(writer.attribute("message_type"), "std_msgs/msg/String");
    assert_eq!(writer.attribute("kind"), "topic");
    assert_eq!(writer.attribute("domain_id"), 0);
    assert_eq!(writer.attribute("cause"), "disposed");
}

#[test]
fn a_client_that_reconnects_continues_or_gets_the_number_of_missed_events() {
    let agent = replayed(&local_agent::capture(), &[]);
    let all = kept(&agent, "");
    let again = |path: &str, header: &str| {
        let headers = format!("Last-Event-ID: {header}\r\n");
        messages(&request(agent.api, "GET", path, &headers).body)
    };
    // The header takes precedence over the address, which a browser never changes.
    assert_eq!(again("/events?after=0&follow=false", &all[4].id), all[5..]);
    let end = all.last().unwrap();
    assert_eq!(again("/events?follow=false", &end.id), []);
    assert_eq!(again("/events?after=0&follow=false", ""), all);

    let (_, number) = end.id.split_once('-').unwrap();
    for other_run in [format!("5f0a1b2c3d4e5-{number}"), format!("{}9", end.id)] {
        let reported = again("/events?follow=false", &other_run);
        assert_eq!(reported[0].event, "lagged", "{other_run}");
        assert_eq!(reported[0].json()["reason"], "restarted");
        assert!(reported[0].json()["missed"].is_null());
        assert_eq!(reported[1..], all);
    }
    for (path, status) in [
        ("/events?after=last", 422),
        ("/events?name=ros2.nothing", 422),
        ("/events?topic=points", 422),
        ("/events?follow=perhaps", 400),
        ("/events?since=0", 400),
    ] {
        let answer = request(agent.api, "GET", path, "");
        assert_eq!(answer.status, status, "{path}");
        assert!(
            answer.headers.contains("application/problem+json"),
            "{path}"
        );
    }
}

#[test]
fn lost_messages_and_incompatible_readers_are_events_with_node_and_topic() {
    let directory = tempfile::tempdir().unwrap();
    let capture = directory.path().join("lossy.pcap");
    let data = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../wire/tests/data");
    let source = data.join("cyclonedds-qos-mismatch.pcap.gz");
    // A best-effort writer with 30 samples at 10 Hz.
    let writer = [0x00, 0x00, 0x14, 0x03];
    let left_out = without_samples(&source, &capture, writer, 10..=12);
    assert!(left_out >= 3, "{left_out} packets left out");
    let agent = replayed(&capture, &["--watch", "/chatter_be"]);
    let lost = kept(&agent, "&name=ros2.message.lost&topic=/chatter_*");
    // Three consecutive samples are one event, unless a second ends between them.
    let sum = |name: &str| -> u64 {
        let counts = lost.iter().map(|message| message.attribute(name));
        counts.map(|count| count.as_u64().unwrap()).sum()
    };
    assert!(
        (1..=2).contains(&lost.len()) && sum("count") == 3,
        "{lost:?}"
    );
    assert_eq!(lost[0].attribute("first_sequence_number"), 10);
    assert_eq!(lost[lost.len() - 1].attribute("last_sequence_number"), 12);
    assert_eq!(lost[0].json()["severity"], "WARN");
    assert_eq!(lost[0].attribute("topic"), "/chatter_be");
    assert!(
        lost[0]
            .attribute("writer")
            .as_str()
            .unwrap()
            .ends_with(".00001403")
    );
    assert!(lost[0].attribute("ros_node").is_string(), "{lost:?}");

    // The other reader requests more than the writer offers.
    let unfit = kept(&agent, "&name=ros2.qos.*");
    assert_eq!(unfit[0].event, "ros2.qos.incompatible");
    assert_eq!(unfit[0].attribute("topic"), "/chatter_be");
    assert_eq!(
        unfit[0].attribute("policies"),
        serde_json::json!(["reliability"])
    );
    assert_eq!(unfit[0].attribute("writer"), lost[0].attribute("writer"));
    assert_eq!(unfit[0].json()["severity"], "WARN");
}

#[test]
fn a_stream_reports_events_as_they_occur_and_does_not_delay_the_end_of_the_agent() {
    // 3 s of traffic are replayed in 10 s.
    let mut agent = LocalAgent::start(&mut rp(), &["--speed", "0.3"]);
    let mut stream = Stream::open(agent.api, "/events?name=ros2.node.*,ros2probe.watch.*", "");
    let node = stream.wait_for("ros2.node.discovered");
    assert!(
        node.attribute("ros_node")
            .as_str()
            .unwrap()
            .starts_with('/')
    );
    // The rest of the capture lasts minutes.
    change(&agent, &serde_json::json!({"speed": 0.01}));
    for (method, event) in [
        ("POST", "ros2probe.watch.added"),
        ("DELETE", "ros2probe.watch.removed"),
    ] {
        let answer = request(agent.api, method, "/watch/imu/data", "");
        assert!(matches!(answer.status, 201 | 204), "{}", answer.body);
        assert_eq!(stream.wait_for(event).attribute("watch"), "/imu/data");
    }

    // With the first stream, these are as many as are permitted without a token. The next one is
    // refused until a stream is closed.
    let others: Vec<_> = (0..11)
        .map(|_| Stream::open(agent.api, "/events", ""))
        .collect();
    let refused = request(agent.api, "GET", "/events", "");
    assert_eq!(refused.status, 503, "{}", refused.body);
    drop(others);
    let deadline = Instant::now() + PATIENCE;
    while request(agent.api, "GET", "/events?follow=false", "").status != 200 {
        assert!(Instant::now() < deadline);
        std::thread::sleep(Duration::from_millis(50));
    }

    agent.signal("-TERM");
    let mut rest = String::new();
    stream.0.read_to_string(&mut rest).unwrap();
    assert!(agent.wait().success());
    assert!(agent.log().contains("drained=true"), "{}", agent.log());
}

/// Copies a capture without the packets that have samples of these numbers. Returns the number of
/// omitted packets.
fn without_samples(
    from: &Path,
    to: &Path,
    writer: [u8; 4],
    numbers: std::ops::RangeInclusive<u32>,
) -> usize {
    let mut bytes = Vec::new();
    let file = std::fs::File::open(from).unwrap();
    flate2::read::GzDecoder::new(file)
        .read_to_end(&mut bytes)
        .unwrap();
    let (header, mut rest) = bytes.split_at(24);
    let mut kept = header.to_vec();
    let mut left_out = 0;
    while let Some(length) = rest.get(8..12) {
        let length = u32::from_le_bytes(length.try_into().unwrap()) as usize;
        let (packet, following) = rest.split_at(16 + length);
        // The writer and the sequence number of DATA, low word last, little-endian.
        let holds = |number: u32| {
            let wanted = [writer, [0; 4], number.to_le_bytes()].concat();
            packet.windows(wanted.len()).any(|window| window == wanted)
        };
        if numbers.clone().any(holds) {
            left_out += 1;
        } else {
            kept.extend_from_slice(packet);
        }
        rest = following;
    }
    std::fs::write(to, kept).unwrap();
    left_out
}

#[test]
fn a_replay_reports_every_endpoint_at_any_speed() {
    use ros2probe_wire::time::SECOND;
    const START: u64 = 1_795_143_000 * SECOND;
    let alice = ros2probe_wire::GuidPrefix(*b"\x01\x10alice-host");
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("announced.pcap");
    let mut capture = capture::Capture::new(capture::ETHERNET);
    capture.participant(START, 0, alice);
    // 422 endpoints in 4 s: 200 per second are a storm, and 106 per second are not.
    for number in 0..422 {
        let time = START + number as u64 * SECOND / 106;
        let topic = format!("rt/topic{number}");
        let guid = capture::writer(alice, number);
        capture.writer(time, 0, guid, &topic, number as u64 + 1);
    }
    capture.write(&path);
    let reported = |speed: &str| {
        let mut agent = LocalAgent::replay(&mut rp(), &path, &["--speed", speed]);
        agent.wait_for_log("the capture has ended");
        let events = kept(&agent, "&name=ros2.endpoint.*");
        let reported = events
            .iter()
            .map(|event| (event.event.clone(), event.attribute("topic")));
        reported.collect::<Vec<_>>()
    };
    let at_once = reported("max");
    assert_eq!(at_once.len(), 422, "{:?}", at_once.last());
    assert_eq!(at_once, reported("4"));
}
