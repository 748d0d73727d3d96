//! The listener for viewers: a strict client of the Foxglove protocol with an agent that replays a
//! capture. It checks messages, rights and refusals. Hostile clients must not leave connections or
//! subscriptions.

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::io::{Read as _, Write as _};
use std::net::{SocketAddr, TcpStream};
use std::process::Command;
use std::time::{Duration, Instant};

use crate::replay::change;
use crate::rp;
use crate::samples::replayed;
use ros2probe_model::facts::dispatch::SampleOutcome;
use ros2probe_model::facts::selection::Depth;
use ros2probe_testing::local_agent::{self, LocalAgent, call_api, metric};
use ros2probe_testing::repository;
use ros2probe_testing::viewer::{
    Data, PATIENCE, Refused, SUBPROTOCOLS, ServerMessage, Status, Viewer, open,
};
use serde_json::{Value, json};
use tokio_tungstenite::tungstenite::Message;

/// Text of the log line that has the address of the listener.
const SERVING: &str = "serving viewers";
/// Maximum duration of a replay on a busy machine.
const REPLAY_PATIENCE: Duration = Duration::from_secs(90);
const WATCHED: [&str; 4] = ["--foxglove", "127.0.0.1:0", "--watch", "/**"];

/// Starts an agent that replays a capture. Returns the agent and the address for viewers.
fn agent(arguments: &[&str]) -> (LocalAgent, SocketAddr) {
    let arguments: Vec<_> = WATCHED.iter().chain(arguments).copied().collect();
    let mut agent = LocalAgent::start(&mut rp(), &arguments);
    let viewers = agent.wait_for_address(SERVING);
    (agent, viewers)
}

/// Connects with these headers.
fn connect(address: SocketAddr, path: &str, headers: &[(&str, &str)]) -> Result<Viewer, Refused> {
    open(
        TcpStream::connect(address).unwrap(),
        path,
        &SUBPROTOCOLS,
        headers,
    )
    .unwrap()
}

/// Waits until the metrics page shows these numbers of viewers and subscriptions.
fn wait_for_viewers(agent: &LocalAgent, viewers: f64, subscriptions: f64) {
    agent.wait_for_metric("ros2probe_foxglove_clients", |count| count == viewers);
    agent.wait_for_metric("ros2probe_foxglove_subscriptions", |count| {
        count == subscriptions
    });
}

fn descriptors(agent: &LocalAgent) -> usize {
    let directory = format!("/proc/{}/fd", agent.pid());
    fs::read_dir(directory).unwrap().count()
}

#[test]
fn a_viewer_gets_the_messages_of_a_capture_as_they_were_sent() {
    // The replay stays near its begin until the viewer is connected.
    let (agent, address) = agent(&["--speed", "0.02"]);
    let (_, outcomes) = replayed(&local_agent::capture(), Some(Depth::Payloads));
    let mut expected: BTreeMap<String, Vec<(u64, Vec<u8>)>> = BTreeMap::new();
    for outcome in outcomes {
        if let SampleOutcome::Sample(sample) = outcome {
            let messages = expected.entry(sample.topic.name.to_string()).or_default();
            messages.push((sample.time.0, sample.payload.as_ref().unwrap().to_vec()));
        }
    }
    let mut viewer = Viewer::connect(address).unwrap();
    let capabilities: BTreeSet<_> = viewer
        .info
        .capabilities
        .iter()
        .map(String::as_str)
        .collect();
    assert_eq!(capabilities, ["connectionGraph", "time"].into());
    assert!(
        viewer.info.metadata["mode"].starts_with("read-only"),
        "{:?}",
        viewer.info
    );
    viewer
        .send(&json!({"op": "subscribeConnectionGraph"}))
        .unwrap();
    change(&agent, &json!({"speed": 0.5}));
    let mut received: BTreeMap<String, Vec<(u64, Vec<u8>)>> = BTreeMap::new();
    let mut names = BTreeMap::new();
    let (mut clock, mut figures) = (0, BTreeMap::new());
    let mut is_published = false;
    let deadline = Instant::now() + REPLAY_PATIENCE;
    loop {
        assert!(Instant::now() < deadline, "the capture does not end");
        match viewer.next_within(PATIENCE).unwrap().expect("no news") {
            ServerMessage::Channels => {
                let subscribed: BTreeSet<_> = viewer.subscriptions.values().copied().collect();
                let new: Vec<_> = viewer.channels.keys().copied().collect();
                let new: Vec<_> = new
                    .into_iter()
                    .filter(|id| !subscribed.contains(id))
                    .collect();
                let ids = viewer.subscribe_to(&new).unwrap();
                for (id, channel) in ids.into_iter().zip(new) {
                    names.insert(id, viewer.channels[&channel].topic.clone());
                }
            }
            ServerMessage::Data(Data {
                subscription,
                time,
                payload,
            }) => {
                let name = &names[&subscription];
                if let Some(topic) = name.strip_prefix("/rp/topics") {
                    let value: Value = serde_json::from_slice(&payload).unwrap();
                    // Nodes may leave before the capture ends.
                    if value["rate_hertz"].as_f64() > Some(0.0) {
                        figures.insert(topic.to_owned(), value);
                    }
                } else {
                    received
                        .entry(name.clone())
                        .or_default()
                        .push((time, payload));
                }
            }
            ServerMessage::Time(time) => {
                assert!(time >= clock, "{time} after {clock}");
                clock = time;
            }
            ServerMessage::Status(status) if status.id == "end" => break,
            // Topics such as `/rosout` have no subscriber.
            ServerMessage::Status(status) if status.id == "no_subscriber" => {}
            ServerMessage::Graph => is_published |= viewer.graph.published.contains_key("/chatter"),
            server_message => panic!("{server_message:?}"),
        }
    }
    assert!(
        received["/chatter"].len() >= 10,
        "{}",
        received["/chatter"].len()
    );
    assert!(
        received.contains_key("/robot1/points"),
        "{:?}",
        received.keys()
    );
    for (topic, received) in &received {
        // Only messages before the subscription are missing.
        assert!(
            expected[topic].ends_with(received),
            "{topic}: {} messages",
            received.len()
        );
    }
    assert!(clock >= received["/chatter"].last().unwrap().0);
    check_schemas(&viewer);
    check_figures(&agent, &figures, &viewer);
    assert!(is_published, "{:?}", viewer.graph);
    drop(viewer);
    wait_for_viewers(&agent, 0.0, 0.0);
}

/// The definitions equal those of bags. Another parser reads each definition as the type that it
/// names.
fn check_schemas(viewer: &Viewer) {
    let channels = viewer.channels.values();
    let messages: Vec<_> = channels
        .filter(|channel| channel.encoding == "cdr")
        .collect();
    assert!(messages.len() >= 2, "{messages:?}");
    let mut definitions = Vec::new();
    for channel in messages {
        assert_eq!(
            channel.schema_encoding.as_deref(),
            Some("ros2msg"),
            "{channel:?}"
        );
        definitions.push(json!([channel.schema_name, channel.schema]));
    }
    let python = repository("target/tools/bags/bin/python");
    let output = Command::new(&python)
        .args(["-c", PARSE])
        .arg(Value::from(definitions).to_string())
        .output()
        .unwrap_or_else(|error| panic!("{}: {error}; run `make prerequisites`", python.display()));
    let stderr = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{stderr}");
}

/// Parses definitions with rosbags.
const PARSE: &str = "
import json, sys
from rosbags.typesys import get_types_from_msg
for name, text in json.loads(sys.argv[1]):
    assert name in get_types_from_msg(text, name), name
";

/// The figures agree with those of the API, and each matches its schema.
fn check_figures(agent: &LocalAgent, figures: &BTreeMap<String, Value>, viewer: &Viewer) {
    let (_, topic) = call_api(agent.api, "GET", "/topics/chatter", "");
    let chatter = &figures["/chatter"];
    let measured = &topic["measurement"];
    assert!(
        chatter["messages"].as_f64() <= measured["messages"].as_f64(),
        "{chatter} {measured}"
    );
    assert!(chatter["messages"].as_f64().unwrap() >= 10.0, "{chatter}");
    assert_eq!(chatter["publishers"], 1.0, "{chatter}");
    for channel in viewer
        .channels
        .values()
        .filter(|each| each.encoding == "json")
    {
        assert_eq!(channel.schema_encoding.as_deref(), Some("jsonschema"));
        let schema: Value = serde_json::from_str(&channel.schema).unwrap();
        let topic = channel.topic.strip_prefix("/rp/topics").unwrap();
        let Some(value) = figures.get(topic) else {
            continue;
        };
        let valid = jsonschema::validate(&schema, value);
        assert!(valid.is_ok(), "{value}: {valid:?}");
        let described = schema["properties"].as_object().unwrap();
        let shown = value.as_object().unwrap();
        assert!(
            shown.keys().all(|name| described.contains_key(name)),
            "{value}"
        );
    }
}

#[test]
fn a_request_without_the_handshake_of_a_viewer_is_refused_with_a_reason() {
    let (agent, address) = agent(&["--speed", "max"]);
    let refused = |subprotocols: &[&str]| {
        let stream = TcpStream::connect(address).unwrap();
        open(stream, "/", subprotocols, &[]).unwrap().err().unwrap()
    };
    for subprotocols in [&[][..], &["rosbridge_v2"], &["foxglove.sdk.v9"]] {
        let refused = refused(subprotocols);
        assert_eq!(refused.status, 400, "{subprotocols:?}");
        assert!(refused.body.contains("foxglove.sdk.v1"), "{}", refused.body);
    }
    for subprotocol in SUBPROTOCOLS {
        let stream = TcpStream::connect(address).unwrap();
        assert!(
            open(stream, "/any/path", &[subprotocol], &[])
                .unwrap()
                .is_ok()
        );
    }
    let plain = local_agent::request(address, "GET", "/", "");
    assert_eq!(plain.status, 426);
    assert!(plain.body.contains("ws://"), "{}", plain.body);
    let count = agent.wait_for_metric("ros2probe_foxglove_refused_total", |count| count >= 4.0);
    assert_eq!(count, 4.0);
}

#[test]
fn foreign_pages_need_a_token_but_pages_of_viewers_and_of_this_host_do_not() {
    let (agent, address) = agent(&["--speed", "max"]);
    let with = |name: &str, value: &str| connect(address, "/", &[(name, value)]);
    for origin in [
        "https://app.foxglove.dev",
        "file://",
        "http://localhost:8080",
        "http://127.0.0.1",
    ] {
        assert!(with("origin", origin).is_ok(), "{origin}");
    }
    for origin in [
        "https://evil.example",
        "https://app.foxglove.dev.evil.example",
        "http://app.foxglove.dev",
        "http://localhost.evil.example",
        "null",
    ] {
        let refused = with("origin", origin).err().unwrap();
        assert_eq!(refused.status, 403, "{origin}");
        assert!(
            refused.body.contains("foxglove.origins"),
            "{}",
            refused.body
        );
    }
    for host in ["evil.example:8765", "localhost.evil.example"] {
        assert_eq!(with("host", host).err().unwrap().status, 403, "{host}");
    }
    let (status, token) = call_api(agent.api, "POST", "/page/token", "{}");
    assert_eq!(status, 200);
    let path = format!("/?token={}", token["token"].as_str().unwrap());
    let elsewhere = [("origin", "https://lichtblick.example")];
    assert!(connect(address, &path, &elsewhere).is_ok());
    let wrong = connect(address, "/?token=0123456789abcdef", &[])
        .err()
        .unwrap();
    assert_eq!(wrong.status, 401, "{wrong:?}");
    // A valid token does not permit a foreign host name, which may belong to a page with DNS
    // rebinding.
    let rebound = connect(address, &path, &[("host", "evil.example")]).err();
    assert_eq!(rebound.unwrap().status, 403);
}

#[test]
fn without_a_token_a_viewer_has_the_rights_of_loopback() {
    let directory = tempfile::tempdir().unwrap();
    let (token, file) = ("0123456789abcdef", directory.path().join("token"));
    fs::write(&file, token).unwrap();
    let configuration = directory.path().join("ros2probe.yaml");
    let text = format!("api: {{token_file: {}}}\n", file.display());
    fs::write(&configuration, text).unwrap();
    let configuration = configuration.to_str().unwrap();
    let (guarded, address) = agent(&["--speed", "max", "--config", configuration]);
    for path in ["/", "/?token=0123456789abcdeX"] {
        assert_eq!(
            connect(address, path, &[]).err().unwrap().status,
            401,
            "{path}"
        );
    }
    let path = format!("/?token={token}");
    let mut viewer = connect(address, &path, &[]).unwrap();
    viewer.wait_for_topics(&["/chatter"]).unwrap();
    viewer.subscribe("/chatter").unwrap();
    wait_for_viewers(&guarded, 1.0, 1.0);
    drop((viewer, guarded));

    let (agent, address) = agent(&["--speed", "max", "--api-loopback", "watch"]);
    let mut viewer = Viewer::connect(address).unwrap();
    viewer
        .wait_for_topics(&["/chatter", "/rp/topics/chatter"])
        .unwrap();
    viewer.subscribe("/chatter").unwrap();
    let status = viewer.wait_for("a status", |_, server_message| match server_message {
        ServerMessage::Status(status) => Some(status.clone()),
        _ => None,
    });
    let Status { level, message, .. } = status.unwrap();
    assert_eq!(level, 2);
    assert!(message.contains("rp foxglove"), "{message}");
    wait_for_viewers(&agent, 1.0, 0.0);
    let id = viewer.subscribe("/rp/topics/chatter").unwrap();
    let is_figure = |_: &Viewer, server_message: &ServerMessage| match server_message {
        ServerMessage::Data(data) => (data.subscription == id).then_some(()),
        _ => None,
    };
    viewer.wait_for("figures", is_figure).unwrap();
    let (_, health) = call_api(agent.api, "GET", "/health", "");
    let listener = &health["foxglove"];
    let url = format!("ws://localhost:{}/", address.port());
    assert_eq!(
        (&listener["address"], &listener["access"]),
        (&url.into(), &"watch".into())
    );
    assert_eq!(listener["clients"][0]["subscriptions"], 1, "{listener}");
    assert_eq!(agent.get("/metrics").status, 200);
}

/// Returns a frame of a client, masked with zeros or not masked.
fn frame(first: u8, payload: &[u8], is_masked: bool) -> Vec<u8> {
    let mut frame = vec![first, if is_masked { 0x80 | 127 } else { 127 }];
    frame.extend((payload.len() as u64).to_be_bytes());
    if is_masked {
        frame.extend([0; 4]);
    }
    frame.extend(payload);
    frame
}

#[test]
fn clients_that_violate_the_protocol_are_closed_with_a_code_and_use_no_resources() {
    let (mut agent, address) = agent(&["--speed", "max"]);
    agent.wait_for_log("ready");
    let mut first = Viewer::connect(address).unwrap();
    first.wait_for_topics(&["/chatter"]).unwrap();
    drop(first);
    wait_for_viewers(&agent, 0.0, 0.0);
    let before = descriptors(&agent);
    let subscriptions = |count: u32| {
        let entries: Vec<_> = (0..count)
            .map(|id| json!({"id": id, "channelId": id}))
            .collect();
        json!({"op": "subscribe", "subscriptions": entries})
            .to_string()
            .into_bytes()
    };
    let garbage: Vec<u8> = (0..100_000_u32).map(|i| (i * 7 + (i >> 8)) as u8).collect();
    let cases: [(&str, Vec<u8>, u16); 10] = [
        ("garbage", garbage, 1002),
        ("an unmasked frame", frame(0x81, b"{}", false), 1002),
        ("a reserved opcode", frame(0x83, b"{}", true), 1002),
        ("a continuation of nothing", frame(0x80, b"{}", true), 1002),
        (
            "text that is not UTF-8",
            frame(0x81, &[0xff, 0xfe], true),
            1007,
        ),
        (
            "text that is not JSON",
            frame(0x81, b"subscribe!", true),
            1007,
        ),
        (
            "a subscription with wrong fields",
            frame(0x81, br#"{"op":"subscribe"}"#, true),
            1007,
        ),
        (
            "a message that is too large",
            frame(0x81, &vec![b' '; 300 << 10], true),
            1009,
        ),
        (
            "a frame of an exabyte",
            frame(0x81, &[], true)[..2]
                .iter()
                .copied()
                .chain([0x10, 0, 0, 0, 0, 0, 0, 0])
                .chain([0; 4])
                .collect(),
            1009,
        ),
        (
            "more subscriptions than there may be",
            frame(0x81, &subscriptions(5_000), true),
            1008,
        ),
    ];
    for (name, bytes, code) in cases {
        let mut viewer = Viewer::connect(address).unwrap();
        viewer.wait_for_topics(&["/chatter"]).unwrap();
        viewer.subscribe("/chatter").unwrap();
        // The agent may close before it has read everything.
        let _ = viewer.stream().write_all(&bytes);
        let (closed, reason) = viewer
            .wait_for_close()
            .unwrap_or_else(|error| panic!("{name}: {error:#}"));
        assert_eq!(closed, code, "{name}: {reason}");
        assert!(!reason.is_empty(), "{name}");
        // After the close frame, the stream ends without further data.
        let mut rest = Vec::new();
        viewer.stream().set_read_timeout(Some(PATIENCE)).unwrap();
        let _ = viewer.stream().read_to_end(&mut rest);
        assert!(rest.is_empty(), "{name}: {} bytes", rest.len());
    }
    // Subscriptions to channels that do not exist are ignored, whatever their number.
    let mut viewer = Viewer::connect(address).unwrap();
    for part in 0..10_u32 {
        let ids = part * 1_000..(part + 1) * 1_000;
        let entries: Vec<_> = ids
            .map(|id| json!({"id": id, "channelId": id + 100_000}))
            .collect();
        viewer
            .send(&json!({"op": "subscribe", "subscriptions": entries}))
            .unwrap();
        let status = viewer.wait_for("a status", |_, server_message| match server_message {
            ServerMessage::Status(status) => Some(status.clone()),
            _ => None,
        });
        assert!(
            status
                .unwrap()
                .message
                .starts_with("1000 subscriptions were ignored")
        );
    }
    viewer
        .send_raw(Message::Binary(vec![1, 0, 0, 0, 0, 9].into()))
        .unwrap();
    viewer
        .send(&json!({"op": "advertise", "channels": []}))
        .unwrap();
    for what in ["binary messages", "`advertise`"] {
        let status = viewer.wait_for("a status", |_, server_message| match server_message {
            ServerMessage::Status(status) => Some(status.clone()),
            _ => None,
        });
        let message = status.unwrap().message;
        assert!(
            message.starts_with(what) && message.contains("read-only"),
            "{message}"
        );
    }
    viewer.wait_for_topics(&["/chatter"]).unwrap();
    drop(viewer);
    wait_for_viewers(&agent, 0.0, 0.0);
    let deadline = Instant::now() + PATIENCE;
    while descriptors(&agent) > before {
        assert!(
            Instant::now() < deadline,
            "{} of {before}",
            descriptors(&agent)
        );
        std::thread::sleep(Duration::from_millis(50));
    }
}

#[test]
fn a_busy_port_leads_to_one_warning_and_the_agent_continues() {
    let other = std::net::TcpListener::bind("127.0.0.1:0").unwrap();
    let address = other.local_addr().unwrap().to_string();
    let mut agent = LocalAgent::start(&mut rp(), &["--foxglove", &address, "--speed", "max"]);
    agent.wait_for_log("ready");
    let log = agent.log();
    let warnings: Vec<_> = log.lines().filter(|line| line.contains("WARN")).collect();
    assert_eq!(warnings.len(), 1, "{log}");
    assert!(
        warnings[0].contains("foxglove.listen") && warnings[0].contains(&address),
        "{log}"
    );
    let (_, health) = call_api(agent.api, "GET", "/health", "");
    assert!(
        health["foxglove"]["reason"]
            .as_str()
            .unwrap()
            .contains("in use"),
        "{health:#}"
    );
    let host = agent.api.to_string();
    let output = rp().args(["doctor", "--host", &host]).output().unwrap();
    let text = String::from_utf8_lossy(&output.stdout);
    assert!(text.contains("Foxglove viewers cannot connect"), "{text}");
    let refused = rp().args(["foxglove", "--host", &host]).output().unwrap();
    assert!(!refused.status.success());
}

#[test]
fn rp_foxglove_prints_an_address_with_which_a_viewer_gets_messages() {
    let (agent, address) = agent(&["--speed", "max"]);
    let host = agent.api.to_string();
    let output = rp().args(["foxglove", "--host", &host]).output().unwrap();
    let printed = String::from_utf8(output.stdout).unwrap();
    let path = printed
        .trim()
        .strip_prefix(&format!("ws://localhost:{}", address.port()));
    let path = path.unwrap_or_else(|| panic!("{printed}"));
    let elsewhere = [("origin", "https://lichtblick.example")];
    let mut viewer = connect(address, path, &elsewhere).unwrap();
    viewer.wait_for_topics(&["/chatter"]).unwrap();
    let page = agent.get("/metrics").body;
    assert_eq!(metric(&page, "ros2probe_foxglove_clients"), Some(1.0));
}
