//! Tests that reach every cap of the configuration. Existing entries work as before. The next entry
//! is refused or evicts another one, as the table states, and is counted. Later entries are
//! accepted again.

mod driven;
mod table;

use std::collections::{BTreeMap, BTreeSet};
use std::fmt::Write as _;
use std::io::{Read as _, Write as _};
use std::net::{SocketAddrV4, TcpStream};
use std::ops::{Deref, DerefMut};
use std::path::Path;
use std::sync::Arc;
use std::time::Instant;

use crate::rp;
use ros2probe_daemon::agent_facts::{AgentFacts, SourceKind};
use ros2probe_daemon::config::{Limit, Limits};
use ros2probe_daemon::subscriptions::{
    Caps, Depth, Item, Overflow, Request, Selection, Subscription, Subscriptions, Topic,
};
use ros2probe_daemon::surface::MetricSources;
use ros2probe_model::facts::dispatch::{Dispatch, Sample, SampleOutcome};
use ros2probe_model::observe::observer::Settings;
use ros2probe_model::report::snapshot::Snapshot;
use ros2probe_testing::local_agent::{self, LocalAgent, PATIENCE, call_api, metric};
use ros2probe_testing::model::domain::VirtualDomain;
use ros2probe_testing::model::forge::{Message, SEDP_WRITERS, SPDP};
use ros2probe_testing::model::host::{BOB, CapturePoint, Host};
use ros2probe_testing::viewer;
use ros2probe_wire::{DomainId, EntityId, Guid, GuidPrefix, SequenceNumber, Timestamp};
use tokio_util::sync::CancellationToken;

/// Lease of each participant, in seconds.
const LEASE: u32 = 10_000;

/// Returns how much of a cap is used, and how often the cap was reached.
fn limit_usage(limits: Limits, snapshot: Snapshot, limit: Limit) -> (u64, u64) {
    let settings = ros2probe_daemon::settings_cell::Settings {
        limits,
        ..ros2probe_daemon::settings_cell::Settings::default()
    };
    let sources = MetricSources::new(SourceKind::Wire, settings);
    let state = sources
        .latest
        .publish(snapshot, AgentFacts::new(SourceKind::Wire, Instant::now()));
    sources.limits.note(&state);
    let facts = sources.limits.facts(&sources.latest.state());
    let facts = facts
        .into_iter()
        .find(|facts| facts.limit == limit)
        .unwrap();
    assert_eq!(facts.cap, limits.get(limit) as u64);
    (facts.used, facts.reached)
}

/// A domain in virtual time. A model with some caps observes all its traffic.
struct World {
    limits: Limits,
    domain: VirtualDomain,
}

impl Deref for World {
    type Target = VirtualDomain;

    fn deref(&self) -> &VirtualDomain {
        &self.domain
    }
}

impl DerefMut for World {
    fn deref_mut(&mut self) -> &mut VirtualDomain {
        &mut self.domain
    }
}

impl World {
    fn new(limits: Limits) -> Self {
        let settings = Settings::default().with_limits(&limits);
        Self {
            limits,
            domain: VirtualDomain::new(&["/**"], settings),
        }
    }

    fn standing(&self, limit: Limit) -> (u64, u64) {
        limit_usage(self.limits, self.snapshot(), limit)
    }
}

fn prefix(number: u8) -> GuidPrefix {
    GuidPrefix([1, 0x10, 0, 0, 0, 0, 0, 0, 0, 0, 7, number])
}

fn writer(participant: u8, number: u8) -> Guid {
    Guid::new(prefix(participant), EntityId([0, 0, number, 3]))
}

#[test]
fn participants_beyond_the_cap_are_left_out_until_one_leaves() {
    let mut world = World::new(Limits {
        participants: 2,
        ..Limits::default()
    });
    for _ in 0..4 {
        (1..=2).for_each(|number| world.participant(prefix(number), LEASE));
        world.wait(1_000);
    }
    world.participant(prefix(3), LEASE);
    assert_eq!(world.standing(Limit::Participants), (2, 1));
    // Samples of existing writers are still counted.
    world.endpoint(writer(1, 1), 1, "rt/a");
    world.sample(writer(1, 1), 1);
    assert_eq!(world.snapshot().topics[0].publishers.len(), 1);
    let guid = Guid::new(prefix(2), EntityId::PARTICIPANT);
    world.put(Message::from(prefix(2)).dispose_by_hash(SPDP, 2, guid));
    world.participant(prefix(3), LEASE);
    assert_eq!(world.standing(Limit::Participants), (2, 1));
    let known = world.snapshot().participants;
    assert!(known.iter().any(|known| known.guid.prefix == prefix(3)));
}

#[test]
fn endpoints_beyond_the_cap_are_left_out_until_one_is_removed() {
    let mut world = World::new(Limits {
        endpoints: 2,
        ..Limits::default()
    });
    for _ in 0..4 {
        world.participant(prefix(1), LEASE);
        world.wait(1_000);
    }
    for (number, topic) in [(1, "rt/a"), (2, "rt/b"), (3, "rt/c")] {
        world.endpoint(writer(1, number), number.into(), topic);
    }
    assert_eq!(world.standing(Limit::Endpoints), (2, 1));
    for number in 1..=10 {
        world.sample(writer(1, 1), number);
    }
    let messages = |world: &World, name: &str| {
        let topics = world.snapshot().topics;
        let topic = topics.into_iter().find(|topic| topic.name == name)?;
        Some(topic.measurement?.messages)
    };
    assert_eq!(messages(&world, "/a"), Some(10));
    world.put(Message::from(prefix(1)).dispose_by_hash(SEDP_WRITERS, 4, writer(1, 2)));
    world.endpoint(writer(1, 3), 5, "rt/c");
    assert_eq!(world.standing(Limit::Endpoints), (2, 1));
    assert_eq!(messages(&world, "/c"), Some(0));
}

#[test]
fn topics_beyond_the_cap_are_listed_but_not_measured_until_one_is_removed() {
    let mut world = World::new(Limits {
        topics: 2,
        ..Limits::default()
    });
    world.participant(prefix(1), LEASE);
    for (number, topic) in [(1, "rt/a"), (2, "rt/b"), (3, "rt/c")] {
        world.endpoint(writer(1, number), number.into(), topic);
    }
    assert_eq!(world.standing(Limit::Topics), (2, 1));
    assert_eq!(world.snapshot().topics.len(), 3);
    world.put(Message::from(prefix(1)).dispose_by_hash(SEDP_WRITERS, 4, writer(1, 1)));
    world.wait(2_000);
    world.sample(writer(1, 3), 1);
    world.sample(writer(1, 2), 1);
    let counted: BTreeMap<_, _> = world
        .snapshot()
        .topics
        .into_iter()
        .filter_map(|topic| Some((topic.name, topic.measurement?.messages)))
        .collect();
    assert_eq!((counted["/b"], counted["/c"]), (1, 1));
    assert_eq!(world.standing(Limit::Topics), (2, 1));
}

#[test]
fn unknown_writers_beyond_the_cap_are_not_followed_until_one_is_forgotten() {
    let mut world = World::new(Limits {
        unknown_writers: 2,
        ..Limits::default()
    });
    for number in 1..=50 {
        world.sample(writer(1, 1), number);
        world.sample(writer(1, 2), number);
        world.wait(100);
    }
    world.sample(writer(1, 3), 1);
    let (used, reached) = world.standing(Limit::UnknownWriters);
    assert_eq!((used, reached), (2, 1));
    for number in 51..=400 {
        world.sample(writer(1, 1), number);
        world.wait(100);
    }
    for number in 2..=50 {
        world.sample(writer(1, 3), number);
        world.wait(100);
    }
    assert_eq!(world.standing(Limit::UnknownWriters), (2, 1));
    let known = world.snapshot().unknown_writers;
    let known: Vec<_> = known.iter().map(|known| known.guid).collect();
    assert_eq!(known, [writer(1, 1), writer(1, 3)]);
}

#[test]
fn flows_beyond_the_cap_are_tracked_once_others_expire() {
    let limits = Limits {
        flows: 2,
        ..Limits::default()
    };
    let mut host = Host::with(Settings::default().with_limits(&limits));
    let bob = host.reader(BOB, 7411);
    let at = |port: u16| CapturePoint {
        address: SocketAddrV4::new([10, 0, 0, 9].into(), port),
        ..bob.wire()
    };
    for number in 1..=10 {
        (1..=3).for_each(|port| host.data(at(port), number));
    }
    assert_eq!(limit_usage(limits, host.snapshot(), Limit::Flows), (2, 10));
    assert!(
        host.deliveries()
            .iter()
            .all(|each| each.delivered.messages == 10)
    );
    assert_eq!(host.measurement().messages, 10);
    for number in 11..=60 {
        (2..=3).for_each(|port| host.data(at(port), number));
        host.wait(400);
    }
    let ports: Vec<_> = host
        .deliveries()
        .iter()
        .map(|each| each.destination.port())
        .collect();
    assert_eq!(ports, [2, 3]);
    let (used, reached) = limit_usage(limits, host.snapshot(), Limit::Flows);
    host.data(at(3), 61);
    assert_eq!(used, 2);
    assert_eq!(
        limit_usage(limits, host.snapshot(), Limit::Flows),
        (2, reached)
    );
}

fn sample(number: u64) -> Dispatch {
    let topic = Topic {
        domain_id: DomainId(0),
        name: "/points".into(),
        dds_name: "rt/points".into(),
        message_type: "a/msg/B".into(),
        offered: None,
    };
    Dispatch {
        to: [1].into(),
        outcome: SampleOutcome::Sample(Arc::new(Sample {
            topic: Arc::new(topic),
            time: Timestamp(number),
            writer: writer(1, 1),
            sequence_number: SequenceNumber(number),
            source_timestamp: None,
            header_stamp: None,
            size: 1_000,
            sampled: false,
            payload: Some(vec![7; 1_000].into()),
        })),
    }
}

fn numbers(subscription: &mut Subscription) -> Vec<u64> {
    let items = std::iter::from_fn(|| subscription.try_next());
    let number = |item| match item {
        Item::Sample(sample) => Some(sample.sequence_number.0),
        _ => None,
    };
    items.filter_map(number).collect()
}

#[test]
fn messages_beyond_the_bytes_of_all_queues_evict_the_oldest_until_the_queue_is_read() {
    let sources = MetricSources::new(SourceKind::Wire, Default::default());
    let caps = Caps {
        subscriptions: 1,
        bytes: 4_500,
    };
    let all = Subscriptions::new(Arc::clone(&sources.latest), caps, CancellationToken::new());
    let all = Arc::new(all);
    let request = || Request {
        topics: Selection::all(),
        domain_id: None,
        depth: Depth::Payloads,
        queue_bytes: 1 << 20,
        overflow: Overflow::DropOldest,
        is_clock_complete: false,
        latched: true,
        label: "test".to_owned(),
    };
    let mut reader = all.open(request()).unwrap();
    assert!(all.open(request()).is_err());
    let standing = |limit| {
        let mut agent = AgentFacts::new(SourceKind::Wire, Instant::now());
        agent.subscriptions = all.facts();
        let state = sources.latest.publish(Snapshot::default(), agent);
        sources.limits.note(&state);
        let mut facts = sources.limits.facts(&sources.latest.state()).to_vec();
        facts.retain(|facts| facts.limit == limit);
        (facts[0].used, facts[0].reached)
    };
    assert_eq!(standing(Limit::Subscriptions), (1, 1));
    (1..=6).for_each(|number| all.deliver(vec![sample(number)], None));
    assert_eq!(standing(Limit::PayloadBytes), (4_000, 2));
    assert_eq!(numbers(&mut reader), [3, 4, 5, 6]);
    all.deliver(vec![sample(7)], None);
    assert_eq!(standing(Limit::PayloadBytes), (1_000, 2));
    assert_eq!(numbers(&mut reader), [7]);
    drop(reader);
    assert!(all.open(request()).is_ok());
}

/// Starts an agent with these limits that replays slowly and may write bags.
fn agent(directory: &Path, limits: &str) -> LocalAgent {
    agent_on(&local_agent::capture(), directory, "0.2", limits)
}

fn agent_on(capture: &Path, directory: &Path, speed: &str, limits: &str) -> LocalAgent {
    let configuration = directory.join("ros2probe.yaml");
    let bags = directory.join("bags");
    let text = format!(
        "limits: {{{limits}}}\nwatch: [/a, /b]\n\
         recordings: {{directory: {}, reserve_percent: 0, reserve_bytes: 0}}\n",
        bags.display()
    );
    std::fs::write(&configuration, text).unwrap();
    let configuration = configuration.to_str().unwrap();
    LocalAgent::replay(
        &mut rp(),
        capture,
        &["--speed", speed, "--config", configuration],
    )
}

/// Waits until this number of entries is used and the cap was reached this number of times.
fn wait_for(agent: &LocalAgent, limit: &str, used: f64, reached: f64) {
    let series = |name: &str| format!("{name}{{limit=\"{limit}\"}}");
    agent.wait_for_metric(&series("ros2probe_limit_used"), |value| value == used);
    agent.wait_for_metric(&series("ros2probe_limit_reached_total"), |value| {
        value == reached
    });
}

#[test]
fn watches_beyond_the_cap_are_refused_for_clients_and_for_a_reload() {
    let directory = tempfile::tempdir().unwrap();
    let mut agent = agent(directory.path(), "watches: 3");
    assert_eq!(call_api(agent.api, "POST", "/watch/c", "").0, 201);
    let (status, problem) = call_api(agent.api, "POST", "/watch/d", "");
    assert_eq!(status, 409, "{problem}");
    assert_eq!(problem["type"], "urn:ros2probe:problem:too-many-watches");
    let detail = problem["detail"].as_str().unwrap();
    assert!(detail.contains("limits.watches"), "{detail}");
    wait_for(&agent, "watches", 3.0, 1.0);
    // Existing watches can be changed.
    let changed = r#"{"max_silence_s": 5}"#;
    assert_eq!(call_api(agent.api, "PUT", "/watch/c", changed).0, 200);
    assert_eq!(call_api(agent.api, "POST", "/watch/a", "").0, 200);

    let file = directory.path().join("ros2probe.yaml");
    let text = std::fs::read_to_string(&file).unwrap();
    std::fs::write(&file, text.replace("[/a, /b]", "[/a, /b, /e]")).unwrap();
    agent.signal("-HUP");
    let line = agent.wait_for_log("the configuration was not reloaded");
    assert!(line.contains("limits.watches"), "{line}");
    wait_for(&agent, "watches", 3.0, 2.0);
    assert_eq!(call_api(agent.api, "GET", "/watch/e", "").0, 404);
    assert_eq!(call_api(agent.api, "DELETE", "/watch/c", "").0, 204);
    assert_eq!(call_api(agent.api, "POST", "/watch/d", "").0, 201);
    wait_for(&agent, "watches", 3.0, 2.0);
}

#[test]
fn recordings_beyond_the_cap_are_refused_until_one_ends() {
    let directory = tempfile::tempdir().unwrap();
    let agent = agent(directory.path(), "recordings: 1");
    assert_eq!(
        call_api(agent.api, "POST", "/recordings", r#"{"name": "one"}"#).0,
        201
    );
    let (status, problem) = call_api(agent.api, "POST", "/recordings", r#"{"name": "two"}"#);
    assert_eq!(status, 409, "{problem}");
    assert_eq!(problem["type"], "urn:ros2probe:problem:too-many-recordings");
    assert!(!directory.path().join("bags/two").exists());
    wait_for(&agent, "recordings", 1.0, 1.0);
    assert_eq!(
        call_api(agent.api, "GET", "/recordings/one", "").1["state"],
        "recording"
    );
    assert_eq!(call_api(agent.api, "DELETE", "/recordings/one", "").0, 200);
    wait_for(&agent, "recordings", 0.0, 1.0);
    assert_eq!(
        call_api(agent.api, "POST", "/recordings", r#"{"name": "two"}"#).0,
        201
    );
}

#[test]
fn clients_beyond_the_cap_are_refused_until_one_leaves() {
    let directory = tempfile::tempdir().unwrap();
    let limits = "api_clients: 2, metrics_clients: 2";
    let agent = agent(directory.path(), limits);
    let stream = || {
        let address = agent.api;
        let mut stream = TcpStream::connect(address).unwrap();
        stream.set_read_timeout(Some(PATIENCE)).unwrap();
        // The agent has begun its answer, so it does not close this client for another one.
        let request = format!("GET /events HTTP/1.1\r\nHost: {address}\r\n\r\n");
        stream.write_all(request.as_bytes()).unwrap();
        assert!(stream.read(&mut [0; 4096]).unwrap() > 0);
        stream
    };
    let status = || local_agent::request(agent.api, "GET", "/health", "");
    let (_one, two) = (stream(), stream());
    let refused = status();
    assert_eq!(refused.status, 503, "{}", refused.body);
    assert!(
        refused.headers.contains("retry-after: 1"),
        "{}",
        refused.headers
    );
    assert!(
        refused.body.contains("limits.api_clients"),
        "{}",
        refused.body
    );
    drop(two);
    let deadline = Instant::now() + PATIENCE;
    while status().status != 200 {
        assert!(Instant::now() < deadline, "no place was given back");
    }
    // Connections without a request are closed for the next client.
    let idle: Vec<_> = (0..8)
        .map(|_| TcpStream::connect(agent.address).unwrap())
        .collect();
    assert_eq!(agent.get("/healthz").status, 200);
    drop(idle);
    let page = agent.get("/metrics").body;
    for key in ["api_clients", "metrics_clients"] {
        let reached = metric(
            &page,
            &format!("ros2probe_limit_reached_total{{limit=\"{key}\"}}"),
        );
        assert!(reached.unwrap() >= 1.0, "{key}");
        let cap = metric(&page, &format!("ros2probe_limit{{limit=\"{key}\"}}"));
        assert_eq!(cap, Some(2.0));
    }
}

#[test]
fn viewers_beyond_the_cap_are_refused_until_one_leaves() {
    let directory = tempfile::tempdir().unwrap();
    let configuration = directory.path().join("ros2probe.yaml");
    std::fs::write(&configuration, "limits: {foxglove_clients: 2}\n").unwrap();
    let configuration = configuration.to_str().unwrap();
    let arguments = ["--foxglove", "127.0.0.1:0", "--config", configuration];
    let mut agent = LocalAgent::start(&mut rp(), &arguments);
    let address = agent.wait_for_address("serving viewers");
    let connect = || {
        let stream = TcpStream::connect(address).unwrap();
        viewer::open(stream, "/", &viewer::SUBPROTOCOLS, &[]).unwrap()
    };
    let (_one, two) = (connect().unwrap(), connect().unwrap());
    let refused = connect().err().unwrap();
    assert_eq!(refused.status, 503, "{refused:?}");
    assert!(
        refused.body.contains("limits.foxglove_clients"),
        "{refused:?}"
    );
    drop(two);
    let deadline = Instant::now() + PATIENCE;
    while connect().is_err() {
        assert!(Instant::now() < deadline, "no place was given back");
    }
    let page = agent.get("/metrics").body;
    let series = "ros2probe_limit_reached_total{limit=\"foxglove_clients\"}";
    assert!(metric(&page, series).unwrap() >= 1.0);
}

/// Returns a capture of this number of UDP datagrams, with only the first IP fragment of each.
fn incomplete_datagrams(count: u16) -> Vec<u8> {
    let mut capture = Vec::new();
    capture.extend_from_slice(&0xa1b2_c3d4_u32.to_le_bytes());
    capture.extend_from_slice(&[2, 0, 4, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 4, 0, 1, 0, 0, 0]);
    for number in 0..count {
        let mut frame = vec![2; 12];
        frame.extend_from_slice(&[8, 0, 0x45, 0]);
        frame.extend_from_slice(&1_500_u16.to_be_bytes());
        frame.extend_from_slice(&number.to_be_bytes());
        // More fragments follow. The protocol is UDP, without a checksum.
        frame.extend_from_slice(&[0x20, 0, 64, 17, 0, 0, 10, 0, 0, 1, 10, 0, 0, 2]);
        frame.extend_from_slice(&7_400_u16.to_be_bytes());
        frame.extend_from_slice(&7_400_u16.to_be_bytes());
        frame.extend_from_slice(&2_008_u16.to_be_bytes());
        frame.extend_from_slice(&[0, 0]);
        frame.extend_from_slice(b"RTPS\x02\x01\x01\x10");
        frame.resize(14 + 1_500, 0);
        let length = u32::try_from(frame.len()).unwrap().to_le_bytes();
        capture.extend_from_slice(&1_700_000_000_u32.to_le_bytes());
        capture.extend_from_slice(&u32::from(number).to_le_bytes());
        capture.extend_from_slice(&length);
        capture.extend_from_slice(&length);
        capture.extend_from_slice(&frame);
    }
    capture
}

#[test]
fn fragments_beyond_the_cap_in_bytes_evict_the_oldest() {
    let directory = tempfile::tempdir().unwrap();
    let capture = directory.path().join("torn.pcap");
    std::fs::write(&capture, incomplete_datagrams(100)).unwrap();
    let limits = "reassembly_bytes: 65536";
    let mut agent = agent_on(&capture, directory.path(), "max", limits);
    agent.wait_for_log("ready");
    let series = |name: &str| format!("{name}{{limit=\"reassembly_bytes\"}}");
    let reached = agent.wait_for_metric(&series("ros2probe_limit_reached_total"), |n| n > 0.0);
    let page = agent.get("/metrics").body;
    let used = metric(&page, &series("ros2probe_limit_used")).unwrap();
    assert!((30_000.0..=65_536.0).contains(&used), "{used}");
    assert!((50.0..100.0).contains(&reached), "{reached}");
}

#[test]
fn a_reached_limit_is_reported_by_readyz_metrics_health_and_rp_doctor() {
    let directory = tempfile::tempdir().unwrap();
    let limits = "participants: 1, recordings: 1";
    let mut agent = agent_on(&local_agent::capture(), directory.path(), "max", limits);
    agent.wait_for_log("ready");
    let at_limit = |limit: &str| format!("ros2probe_at_limit{{limit=\"{limit}\"}}");
    agent.wait_for_metric(&at_limit("participants"), |value| value == 1.0);
    let page = agent.get("/metrics").body;
    assert_eq!(metric(&page, &at_limit("topics")), Some(0.0));
    let answer = agent.get("/readyz");
    assert_eq!(answer.status, 200);
    let degraded = answer.body.strip_prefix("ready\ndegraded: ").unwrap();
    let reason = "at a limit: participants (1 of 1, ";
    assert!(degraded.starts_with(reason), "{degraded}");
    let (_, health) = call_api(agent.api, "GET", "/health", "");
    assert_eq!(health["ready"], true);
    assert_eq!(health["degraded"], degraded.trim_end());
    assert_eq!(health["limits"][0]["at_limit"], true, "{health:#}");
    assert_eq!(health["limits"][2]["at_limit"], false, "{health:#}");
    let address = agent.api.to_string();
    let doctor = ["doctor", "--json", "--host", &address];
    let output = rp().args(doctor).output().unwrap();
    assert_eq!(output.status.code(), Some(1));
    let report: serde_json::Value = serde_json::from_slice(&output.stdout).unwrap();
    assert_eq!(report["verdict"], "problem");
    let findings = report["findings"].as_array().unwrap();
    let found = findings.iter().find(|found| found["check"] == "limits");
    assert_eq!(found.unwrap()["verdict"], "problem", "{report:#}");
}

/// Returns the exit code and the standard error of `rp`.
fn run_failing(arguments: &[&str]) -> (Option<i32>, String) {
    let output = rp().args(arguments).output().unwrap();
    let stderr = String::from_utf8_lossy(&output.stderr).into_owned();
    (output.status.code(), stderr)
}

#[test]
fn a_configuration_for_a_newer_rp_is_refused_with_one_line() {
    let directory = tempfile::tempdir().unwrap();
    let mut agent = agent(directory.path(), "");
    let file = directory.path().join("ros2probe.yaml");
    let before = std::fs::read_to_string(&file).unwrap();
    std::fs::write(&file, format!("version: 2\nclouds: all\n{before}")).unwrap();
    let path = file.to_str().unwrap();
    let capture = local_agent::capture();
    let start = [
        "run",
        "--config",
        path,
        "--replay",
        capture.to_str().unwrap(),
    ];
    for arguments in [&["check-config", path][..], &start] {
        let (code, stderr) = run_failing(arguments);
        assert_eq!(code, Some(78), "{stderr}");
        assert_eq!(stderr.lines().count(), 1, "{stderr}");
        for part in [":1:10: version: is 2", "reads up to 1", "upgrade rp"] {
            assert!(stderr.contains(part), "{stderr}");
        }
    }
    agent.signal("-HUP");
    let line = agent.wait_for_log("the configuration was not reloaded");
    assert!(line.contains("version: is 2"), "{line}");
    assert_eq!(call_api(agent.api, "GET", "/watch/a", "").0, 200);
    // The same configuration with a version, and without one.
    for same in [format!("version: 1\n{before}"), before] {
        std::fs::write(&file, same).unwrap();
        assert_eq!(run_failing(&["check-config", path]).0, Some(0));
        agent.signal("-HUP");
        agent.wait_for_log("the configuration was reloaded");
    }
}
