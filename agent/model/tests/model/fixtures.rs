//! Replays real ROS 2 traffic through the whole core and compares it with known facts.
//!
//! Each capture is replayed frame by frame in its own time. The core's graph, quality of service,
//! removal times, counts and losses must equal three sources. These are an independent decoder of
//! the same file (`*.facts.json`), the state of a real participant at the time (`ev: graph` lines),
//! and the nodes' logs. The captures in `data` suffice; if the full corpus lies beside the
//! repository, all of it is replayed.

mod replayed;
mod zenoh;

use ros2probe_wire::DomainId;
use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

use replayed::Replayed;
use ros2probe_model::facts::model_time::ModelTime;
use ros2probe_model::facts::wall_clock::WallClock;
use ros2probe_model::report::snapshot::Measurement;
use ros2probe_testing::truth::{self, Facts, GraphLine, Scenario};
use ros2probe_wire::names::DdsType;

/// Times in the facts are rounded to microseconds.
const ROUNDING: f64 = 2e-6;

// Coverage: UDP | Fast DDS 2.6 | Humble | exact
// Coverage: UDP | Cyclone DDS 0.10 | Humble | exact
// Coverage: UDP | Cyclone DDS 0.10 | Jazzy | exact
// Coverage: TCP | Fast DDS 2.6 | Humble | exact
#[test]
fn the_captures_in_the_repository_reproduce_their_ground_truth() {
    let scenarios =
        truth::scenarios(&Path::new(env!("CARGO_MANIFEST_DIR")).join("../testing/data"));
    assert!(scenarios.len() >= 8, "{scenarios:?}");
    scenarios.iter().for_each(check);
}

#[test]
#[ignore = "needs the corpus of captures: make test-corpus"]
fn the_whole_corpus_reproduces_its_ground_truth() {
    let scenarios = truth::scenarios(&ros2probe_testing::corpus());
    assert!(!scenarios.is_empty());
    scenarios.iter().for_each(check);
}

#[test]
fn samples_overwritten_in_a_keep_last_history_are_lost_as_in_the_subscribers_log() {
    for (label, lost) in [("fastrtps-udp", 8), ("cyclonedds", 78)] {
        let data = Path::new(env!("CARGO_MANIFEST_DIR")).join("../testing/data");
        let directory = data.join(label).join("keep-last-lossy-2ns");
        let [received] = &truth::received(&directory)[..] else {
            panic!("one subscriber")
        };
        assert_eq!(received.lost_between.len(), lost, "{label}");
        let replayed = Replayed::of(&directory.join("capture.pcap.gz"));
        compare_losses(label, received, &replayed);
        let topics = &replayed.end.topics;
        let topic = topics.iter().find(|topic| topic.name == received.topic);
        let delivered = topic.unwrap().received.as_deref().unwrap();
        assert_eq!(delivered.messages, received.count, "{label}");
        let counts = (delivered.lost(), delivered.irrelevant);
        assert_eq!(counts, (lost as u64, 0), "{label}");
    }
}

fn check(scenario: &Scenario) {
    let name = scenario.name();
    let facts = scenario.facts();
    let replayed = Replayed::of(&scenario.capture);
    participants(&name, &facts, &replayed);
    endpoints(&name, &facts, &replayed);
    disposals(&name, &facts, &replayed);
    leases(&name, &facts, &replayed);
    nodes(&name, &facts, &replayed);
    counts(&name, &facts, &replayed);
    losses(&name, &facts, &replayed);
    logged_losses(&name, scenario, &replayed);
    // The captures with the command line begin late and lack all large frames, so they do not show
    // everything that the nodes knew. Neither does a capture that begins within TCP connections. Two
    // nodes without a witness log no graph that stays for long enough.
    let others = ["cli-observed", "manual-xml", "tcp-peers"];
    let graphs = if others.iter().any(|other| name.contains(other)) {
        Vec::new()
    } else {
        scenario.graphs()
    };
    for (witness, lines) in graphs {
        graph(
            &format!("{name} as {witness} saw it"),
            &lines,
            &facts,
            &replayed,
        );
    }
    witnessed_removals(&name, scenario, &replayed);
    let truncated = name.contains("snap256");
    for error in &replayed.end.decode_errors {
        assert!(truncated && error.stage == "frame", "{name}: {error:?}");
    }
    for table in &replayed.end.tables {
        assert_eq!(table.evictions, 0, "{name}: {table:?}");
    }
}

fn participants(name: &str, facts: &Facts, replayed: &Replayed) {
    let theirs: BTreeSet<_> = facts.participants.keys().collect();
    assert_eq!(
        theirs,
        replayed.participants.keys().collect(),
        "{name}: participants"
    );
    for (guid, theirs) in &facts.participants {
        let ours = &replayed.participants[guid];
        let vendor = match theirs.vendor.as_str() {
            "1.16" => "Eclipse Cyclone DDS",
            _ => "eProsima Fast DDS",
        };
        let found = ours.vendor.to_string();
        assert!(
            found.contains(vendor) || vendor.contains(&found),
            "{ours:?}"
        );
        let lease = ours.lease.seconds();
        assert_eq!(lease, Some(theirs.lease), "{name}: lease of {guid}");
        assert_eq!(
            (ours.domain_id, ours.enclave.as_deref()),
            (DomainId(0), Some("/")),
            "{name}: {guid}"
        );
        let property = |key| theirs.property_list.get(key).map(String::as_str);
        if let Some(process) = property("__Pid") {
            assert_eq!(
                ours.process.id.map(|id| id.to_string()).as_deref(),
                Some(process)
            );
            assert_eq!(ours.process.host.as_deref(), property("__Hostname"));
            assert_eq!(ours.process.name.as_deref(), property("__ProcessName"));
        }
        let (ours, theirs) = (seconds(ours.first_seen), theirs.first_seen);
        // In a TCP connection that is older than the capture, the independent decoder waits for a
        // second frame.
        let may_be_earlier = if name.contains("manual-xml") {
            0.1
        } else {
            0.0
        };
        let is_same = (-ROUNDING..ROUNDING + may_be_earlier).contains(&(theirs - ours));
        assert!(is_same, "{name}: {guid} {ours} {theirs}");
    }
}

/// Returns the wall time in seconds. The clock is not set in a capture.
fn seconds(at: ModelTime) -> f64 {
    WallClock::default().wall_time(at).seconds()
}

fn endpoints(name: &str, facts: &Facts, replayed: &Replayed) {
    // An endpoint that appeared and vanished between two snapshots is only known from its events.
    let appeared: BTreeSet<_> = replayed
        .events
        .iter()
        .filter(|event| matches!(event.entity, "writer" | "reader") && event.event == "appeared")
        .map(|event| event.guid.to_string())
        .collect();
    let theirs: BTreeSet<_> = facts.endpoints.keys().cloned().collect();
    assert_eq!(theirs, appeared, "{name}: endpoints");
    let mut compared = 0;
    for (guid, theirs) in &facts.endpoints {
        let Some((topic, role, ours)) = replayed.endpoints.get(guid) else {
            continue;
        };
        compared += 1;
        let what = format!("{name}: {guid} on {}", theirs.topic);
        assert_eq!(
            (topic, *role),
            (&theirs.topic, theirs.kind.as_str()),
            "{what}"
        );
        let message_type = DdsType::parse(&theirs.type_name).unwrap().message();
        assert_eq!(ours.message_type, message_type.as_str(), "{what}");
        let role_default = if *role == "writer" {
            "RELIABLE"
        } else {
            "BEST_EFFORT"
        };
        assert_eq!(
            ours.qos.reliability.label(),
            theirs.reliability.as_deref().unwrap_or(role_default)
        );
        assert_eq!(
            ours.qos.durability.label(),
            theirs.durability.as_deref().unwrap_or("VOLATILE"),
            "{what}"
        );
        let history = match (&theirs.history, theirs.vendor.as_str()) {
            (Some(text), _) if text.starts_with("KEEP_ALL") => "KEEP_ALL".to_owned(),
            (Some(text), _) => text.replace('(', " ("),
            (None, "1.16") => "KEEP_LAST (1)".to_owned(),
            (None, _) => "UNKNOWN".to_owned(),
        };
        assert_eq!(ours.history(), history, "{what}");
        let lifespan = theirs.lifespan.as_ref().and_then(serde_json::Value::as_f64);
        assert_eq!(ours.qos.lifespan.seconds(), lifespan, "{what}");
        assert_eq!(
            (ours.qos.deadline.finite(), ours.qos.liveliness.label()),
            (None, "AUTOMATIC")
        );
        let hash = theirs
            .user_data
            .as_deref()
            .and_then(|data| data.split("typehash=").nth(1));
        let hash = hash.and_then(|rest| rest.split(';').next());
        assert_eq!(
            ours.type_hash.map(|hash| hash.to_string()).as_deref(),
            hash,
            "{what}"
        );
    }
    assert!(
        compared * 10 >= theirs.len() * 9,
        "{name}: {compared} of {}",
        theirs.len()
    );
}

/// A disposed entity is removed when the datagram of its disposal arrives.
fn disposals(name: &str, facts: &Facts, replayed: &Replayed) {
    let mut theirs: BTreeMap<String, f64> = BTreeMap::new();
    for event in &facts.events {
        theirs.entry(event.guid.clone()).or_insert(event.t);
    }
    for (guid, at) in &theirs {
        let ended = replayed.ended.get(guid);
        let Some(ended) = ended else {
            // The entity was disposed although it was never announced in this capture.
            assert!(!replayed.was_announced(guid), "{name}: {guid} lives on");
            continue;
        };
        let (ended, event) = (ended.0.seconds(), ended.1);
        match event {
            "disposed" => assert!((ended - at).abs() < ROUNDING, "{name}: {guid} {ended} {at}"),
            // Its participant was removed first.
            _ => assert!(
                event == "cascaded" && ended < *at,
                "{name}: {guid} {event} {ended} {at}"
            ),
        }
    }
    for (guid, (_, event)) in &replayed.ended {
        assert!(
            *event != "disposed" || theirs.contains_key(guid),
            "{name}: {guid}"
        );
    }
}

/// An entity without a disposal is removed when its lease expires after its last datagram.
fn leases(name: &str, facts: &Facts, replayed: &Replayed) {
    for (guid, participant) in &replayed.participants {
        let Some((ended, event)) = replayed.ended.get(guid) else {
            continue;
        };
        if *event != "expired" {
            continue;
        }
        let lease = facts.participants[guid].lease;
        let silent = ended.seconds() - seconds(participant.last_seen);
        assert!(
            (silent - lease).abs() < 1e-6,
            "{name}: {guid} was silent for {silent} s"
        );
    }
}

/// Node names follow `ros_discovery_info` sample by sample.
fn nodes(name: &str, facts: &Facts, replayed: &Replayed) {
    let mut newest: BTreeMap<&str, u64> = BTreeMap::new();
    let mut names: BTreeMap<&str, BTreeSet<String>> = BTreeMap::new();
    let mut theirs = Vec::new();
    for sample in &facts.ros_discovery_info {
        let known = newest.entry(&sample.writer).or_default();
        if sample.seq <= *known || !replayed.is_alive(&sample.gid, sample.t) {
            continue;
        }
        *known = sample.seq;
        let now: BTreeSet<_> = sample.nodes.iter().map(truth::FactsNode::name).collect();
        let before = names.insert(&sample.gid, now.clone()).unwrap_or_default();
        theirs.extend(
            before
                .difference(&now)
                .map(|node| (node.clone(), "disposed", sample.t)),
        );
        theirs.extend(
            now.difference(&before)
                .map(|node| (node.clone(), "appeared", sample.t)),
        );
    }
    let mut ours: Vec<_> = replayed
        .events
        .iter()
        .filter(|event| event.entity == "node" && event.event != "cascaded")
        .map(|event| (event.name.to_string(), event.event, seconds(event.at)))
        .collect();
    // The changes of one sample have no order.
    ours.sort_by(|one, other| {
        let kind = |event: &str| event != "disposed";
        let by_time = one.2.total_cmp(&other.2);
        by_time.then_with(|| (kind(one.1), &one.0).cmp(&(kind(other.1), &other.0)))
    });
    assert_eq!(theirs.len(), ours.len(), "{name}: {theirs:?} {ours:?}");
    for (theirs, ours) in theirs.iter().zip(&ours) {
        assert_eq!((&theirs.0, theirs.1), (&ours.0, ours.1), "{name}");
        assert!(
            (theirs.2 - ours.2).abs() < ROUNDING,
            "{name}: {theirs:?} {ours:?}"
        );
    }
}

/// Compares samples and bytes per topic.
fn counts(name: &str, facts: &Facts, replayed: &Replayed) {
    let mut theirs: BTreeMap<&str, (u64, Option<u64>)> = BTreeMap::new();
    for (guid, writer) in &facts.writers {
        if !guid.ends_with("03") || writer.topic == "?" || writer.topic == "ros_discovery_info" {
            continue;
        }
        let (messages, bytes) = theirs.entry(&writer.topic).or_insert((0, Some(0)));
        *messages += writer.distinct_seqs - writer.frag_samples_incomplete;
        *bytes = bytes.and_then(|bytes| Some(bytes + writer.bytes()?));
    }
    for (topic, (messages, bytes)) in theirs {
        let ours = replayed.measurement(topic);
        assert_eq!(ours.messages, messages, "{name}: messages of {topic}");
        if let Some(bytes) = bytes {
            assert_eq!(ours.bytes, bytes, "{name}: bytes of {topic}");
        }
        assert_eq!(
            ours.interarrival.count(),
            intervals(facts, topic, &ours),
            "{name}: {topic}"
        );
    }
    let unknown: BTreeMap<_, _> = facts
        .writers
        .iter()
        .filter(|(guid, writer)| guid.ends_with("03") && writer.topic == "?")
        .map(|(guid, writer)| {
            (
                guid.clone(),
                writer.distinct_seqs - writer.frag_samples_incomplete,
            )
        })
        .filter(|(_, messages)| *messages > 1)
        .collect();
    let strangers = replayed.end.unknown_writers.iter();
    let mut strangers: BTreeMap<_, _> = strangers
        .map(|each| (each.guid.to_string(), each.measurement.messages))
        .collect();
    // The independent decoder cannot reassemble truncated fragments; this is the 10 Hz point cloud.
    if let Some(cloud) = strangers.remove("0110f04d1e86334b8f3fc2bb.00001403") {
        assert_eq!((name.contains("snap256"), cloud), (true, 29), "{name}");
    }
    assert_eq!(strangers, unknown, "{name}: unknown writers");
}

/// Counts one interval between two consecutive messages of one writer.
fn intervals(facts: &Facts, topic: &str, ours: &Measurement) -> u64 {
    let writers = facts
        .writers
        .values()
        .filter(|writer| writer.topic == topic);
    ours.messages - writers.filter(|writer| writer.complete() > 0).count() as u64
}

/// The lost sequence numbers on the wire are exact: missing ones and incomplete ones.
fn losses(name: &str, facts: &Facts, replayed: &Replayed) {
    let mut theirs: BTreeMap<&str, BTreeSet<u64>> = BTreeMap::new();
    for (guid, writer) in &facts.writers {
        if !replayed.measured.contains(guid) {
            continue;
        }
        let incomplete = writer
            .frags_missing
            .keys()
            .map(|number| number.parse().unwrap());
        let lost: BTreeSet<u64> = writer
            .missing_in_range
            .iter()
            .copied()
            .chain(incomplete)
            .collect();
        if !lost.is_empty() {
            theirs.insert(guid, lost);
        }
    }
    let ours: BTreeMap<&str, BTreeSet<u64>> = replayed
        .losses
        .iter()
        .map(|(guid, lost)| (guid.as_str(), lost.clone()))
        .collect();
    assert_eq!(ours, theirs, "{name}: lost sequence numbers");
    for topic in &replayed.end.topics {
        let Some(measurement) = &topic.measurement else {
            continue;
        };
        let writers = facts
            .writers
            .iter()
            .filter(|(_, writer)| topic.dds_name == writer.topic);
        let lost: usize = writers
            .map(|(guid, _)| ours.get(guid.as_str()).map_or(0, BTreeSet::len))
            .sum();
        assert_eq!(measurement.lost, lost as u64, "{name}: {}", topic.name);
    }
}

/// For small best-effort messages, the wire's losses equal those of the subscriber's log.
fn logged_losses(name: &str, scenario: &Scenario, replayed: &Replayed) {
    if !name.contains("loss-small") {
        return;
    }
    for received in scenario.received() {
        compare_losses(name, &received, replayed);
    }
}

/// Compares losses; a writer's sequence number is the logged sequence plus one.
fn compare_losses(name: &str, received: &truth::Received, replayed: &Replayed) {
    let theirs: BTreeSet<_> = received.lost_between.iter().map(|seq| seq + 1).collect();
    let topic = format!("rt{}", received.topic);
    let (_, ours) = replayed
        .losses
        .iter()
        .find(|(guid, _)| replayed.topic_of(guid) == Some(topic.as_str()))
        .unzip();
    assert_eq!(ours.cloned().unwrap_or_default(), theirs, "{name}: {topic}");
    let messages = replayed.measurement(&topic).messages;
    assert_eq!(messages, received.count, "{name}: {topic}");
}

/// Compares the graph at times at which it was stable for a real participant.
fn graph(name: &str, lines: &[GraphLine], facts: &Facts, replayed: &Replayed) {
    const SETTLED: u64 = 500_000_000;
    let mut compared = 0;
    for (line, next) in lines.iter().zip(lines.iter().skip(1)) {
        if next.t - line.t < 2 * SETTLED {
            continue;
        }
        let at = line.t + SETTLED;
        // A node lists itself before it announces itself.
        let reported = facts
            .ros_discovery_info
            .iter()
            .filter(|sample| sample.t < at as f64 / 1e9);
        let reported: BTreeSet<_> = reported
            .flat_map(|sample| sample.nodes.iter().map(truth::FactsNode::name))
            .collect();
        if !line.nodes.iter().all(|node| reported.contains(node)) {
            continue;
        }
        compared += u64::from(same_graph(name, line, at, replayed));
    }
    assert!(
        compared > 0 || lines.len() < 3,
        "{name}: nothing to compare"
    );
}

/// Compares a line with the graph at `at`. Returns whether the graph is known at that time.
fn same_graph(name: &str, line: &GraphLine, at: u64, replayed: &Replayed) -> bool {
    let Some(view) = replayed.view_at(at) else {
        return false;
    };
    let nodes: BTreeSet<_> = line.nodes.iter().cloned().collect();
    assert_eq!(view.nodes, nodes, "{name}: nodes at {}", line.t);
    let topics: BTreeMap<_, _> = line
        .topics
        .iter()
        .map(|(topic, facts)| (topic.clone(), (facts.types.clone(), facts.pubs, facts.subs)))
        .collect();
    assert_eq!(view.topics, topics, "{name}: topics at {}", line.t);
    if let Some(services) = &line.services {
        assert_eq!(&view.services, services, "{name}: services at {}", line.t);
    }
    true
}

/// A node is removed when the real participant that stayed to the end removes it.
fn witnessed_removals(name: &str, scenario: &Scenario, replayed: &Replayed) {
    let Some((_, lines)) = scenario
        .graphs()
        .into_iter()
        .find(|(role, _)| role == "late")
    else {
        return;
    };
    let mut removals = 0;
    for (before, after) in lines.iter().zip(lines.iter().skip(1)) {
        for node in before
            .nodes
            .iter()
            .filter(|node| !after.nodes.contains(node))
        {
            let ours = replayed.events.iter().find(|event| {
                event.entity == "node" && event.event != "appeared" && *event.name == **node
            });
            let ours = ours.unwrap_or_else(|| panic!("{name}: {node} stays"));
            let late = after.t as f64 / 1e9 - seconds(ours.at);
            // The witness polls every 50 ms, and later on a busy machine.
            assert!(
                (-0.1..0.5).contains(&late),
                "{name}: {node} went {late} s apart"
            );
            removals += 1;
        }
    }
    // No participant leaves during that capture.
    let none_leaves = name.contains("manual-xml");
    assert!(none_leaves || removals >= 3, "{name}: {removals}");
}
