//! Findings in words, each with its topic or node, its start and its remedy. The texts contain no
//! rapidly changing numbers, so the list is sent only after real changes.

use std::collections::HashMap;

use ros2probe_wire::{DomainId, Guid, GuidPrefix, RtpsDuration};

use super::inside;
use super::measured;
use super::robot;
use super::structure::Ids;
use crate::agent_facts::{Ability, AgentFacts, SourceKind};
use crate::missed_announcements;
use ros2probe_api::live::{Finding, Severity};
use ros2probe_model::facts::diagnosis::{Diagnosis, Policies, Policy, TopicKey};
use ros2probe_model::facts::names::NodeName;
use ros2probe_model::graph::zenoh::Unseen;
use ros2probe_model::measure::history::Past;
use ros2probe_model::report::snapshot::{EndpointFacts, Snapshot};

/// Maximum number of findings in a list.
const MAX_FINDINGS: usize = 512;

/// Input of the findings.
pub(super) struct FindingInputs<'a> {
    pub(super) snapshot: &'a Snapshot,
    pub(super) agent: &'a AgentFacts,
    pub(super) past: &'a Past,
    pub(super) ids: &'a Ids,
    /// Why the agent is not ready.
    pub(super) unready: Option<&'a str>,
}

/// Returns all findings, the most severe first.
pub(super) fn findings(circumstances: &FindingInputs<'_>) -> Vec<Finding> {
    let mut list = of_agent(circumstances);
    list.extend(of_graph(circumstances));
    list.extend(measured::of_watches(circumstances));
    list.extend(measured::losses(circumstances));
    list.sort_by(|one, other| {
        (one.severity, &one.kind, &one.id).cmp(&(other.severity, &other.kind, &other.id))
    });
    list.truncate(MAX_FINDINGS);
    list
}

/// Returns a warning about a node.
pub(super) fn of_node(
    kind: &'static str,
    ids: &Ids,
    (domain_id, node): (DomainId, &NodeName),
    text: String,
) -> Finding {
    let about = format!("{domain_id}|{node}");
    Finding {
        domain_id: Some(domain_id.0),
        node: ids.node(domain_id, node),
        ..finding(kind, Severity::Warning, &about, text)
    }
}

pub(super) fn finding(
    kind: &'static str,
    severity: Severity,
    about: &str,
    text: String,
) -> Finding {
    Finding {
        id: format!("{kind}|{about}"),
        kind: kind.into(),
        severity,
        domain_id: None,
        topic: None,
        node: None,
        since: None,
        text,
        remedy: None,
        writer: None,
        reader: None,
        policies: Vec::new(),
    }
}

fn of_agent(all: &FindingInputs<'_>) -> Vec<Finding> {
    let (agent, snapshot) = (all.agent, all.snapshot);
    let mut list = Vec::new();
    if let Some(reason) = all.unready {
        let text = format!("The agent does not see the robot: {reason}");
        let unready = finding("agent_not_ready", Severity::Error, "", text);
        list.push(unready.with_remedy("rp doctor"));
    }
    let dropped = dropped(agent);
    if dropped > 0 {
        let text =
            "The agent dropped packets because a buffer was full: its counts are lower bounds"
                .to_owned();
        let drops = finding("agent_drops", Severity::Warning, "", text);
        list.push(drops.with_remedy("raise capture.ring_bytes and capture.record_ring_bytes"));
    }
    if !snapshot.unknown_writers.is_empty() {
        let text = "Writers are active whose announcement was missed; their topics are unknown";
        let unknown = finding("unknown_writers", Severity::Warning, "", text.to_owned());
        let remedy = missed_announcements::remedy(snapshot);
        list.push(unknown.with_remedy(remedy.unwrap_or(missed_announcements::DISCOVER_COMMAND)));
    }
    if snapshot.topics_rejected > 0 {
        let text = "Watched topics are not measured: limits.topics is reached".to_owned();
        let rejected = finding("topics_rejected", Severity::Warning, "", text);
        list.push(rejected.with_remedy("raise limits.topics, or watch fewer topics"));
    }
    list.extend(unseen_zenoh(snapshot));
    list.extend(unseen(agent));
    list
}

/// Returns one finding for each reason why Zenoh connections cannot be read.
fn unseen_zenoh(snapshot: &Snapshot) -> Vec<Finding> {
    let unseen = snapshot.zenoh.iter().flat_map(|zenoh| zenoh.unseen());
    let findings = unseen.map(|(reason, connections)| {
        let connections = match connections {
            1 => "1 connection".to_owned(),
            many => format!("{many} connections"),
        };
        let which = format!("{connections} of Zenoh {}", reason.in_words());
        let unseen = |severity, text| finding("zenoh_unseen", severity, reason.label(), text);
        match reason {
            Unseen::SharedMemory => {
                let text = format!(
                    "The agent cannot read the payloads of {which}; rates and sizes are right"
                );
                unseen(Severity::Note, text)
            }
            _ => unseen(Severity::Warning, format!("The agent cannot read {which}"))
                .with_remedy("capture.inside: topics    # counts them inside the processes"),
        }
    });
    findings.collect()
}

/// Returns one note for each missing ability with a known reason, and one note for all abilities
/// that the source lacks.
fn unseen(agent: &AgentFacts) -> Vec<Finding> {
    let mut list = Vec::new();
    let mut lacking = Vec::new();
    for ability in Ability::ALL {
        if agent.abilities.contains(&ability) {
            continue;
        }
        let mut blind = agent.missing_abilities.iter();
        let Some((_, reason)) = blind.find(|(blind, _)| *blind == ability) else {
            // Otherwise causes are observed while a client requests them, or late calls are off.
            if ability != Ability::LateCauses {
                lacking.push(object(ability));
            }
            continue;
        };
        let text = format!("The agent does not see {}: {reason}", object(ability));
        list.push(finding("ability", Severity::Note, ability.label(), text));
    }
    if !lacking.is_empty() {
        let source = match agent.source {
            SourceKind::Host => "The agent captures at the sockets of this host",
            SourceKind::Wire => "The agent captures on network interfaces",
            SourceKind::Replay => "A capture file contains only packets",
        };
        let text = format!("{source}. It does not show {}", lacking.join(", "));
        list.push(finding("ability", Severity::Note, "source", text));
    }
    list
}

/// Describes what an ability observes.
const fn object(ability: Ability) -> &'static str {
    match ability {
        Ability::Subscribers => "what each subscriber receives",
        Ability::Sent => "messages that leave this host",
        Ability::SocketLosses => "losses in the buffers of sockets",
        Ability::ReassemblyLosses => "losses in IP reassembly",
        Ability::Owners => "the processes of sockets",
        Ability::Containers => "the sockets of containers",
        Ability::Forwarded => "traffic without a local socket",
        Ability::SharedMemory => "messages through shared memory",
        Ability::SharedMemoryExact => "each single message through shared memory",
        Ability::Inside => "messages that only calls inside processes show",
        Ability::LateCauses => "all causes of late calls",
    }
}

/// Returns the number of packets, records and datagrams dropped because a ring was full.
pub(super) fn dropped(agent: &AgentFacts) -> u64 {
    let packets: u64 = agent
        .interfaces
        .iter()
        .filter_map(|each| each.dropped)
        .sum();
    packets + agent.records_dropped + agent.pieces_dropped
}

fn of_graph(all: &FindingInputs<'_>) -> Vec<Finding> {
    let snapshot = all.snapshot;
    let ends = Ends::new(snapshot);
    let list = snapshot.diagnoses.list.iter();
    // A finding has no time if the list of times is shorter.
    let times = snapshot
        .diagnosed
        .iter()
        .map(Some)
        .chain(std::iter::repeat(None));
    let found = list.zip(times).map(|(diagnosis, since)| {
        let mut finding = in_words(all, diagnosis, &ends);
        finding.since = since.map(|since| snapshot.wall_time(*since).seconds());
        if let Some(topic) = diagnosis.topic() {
            finding.domain_id = Some(topic.domain_id.0);
            finding.topic = all.ids.topic(topic.domain_id, &topic.dds_name);
        }
        finding
    });
    found.collect()
}

fn in_words(all: &FindingInputs<'_>, diagnosis: &Diagnosis, ends: &Ends<'_>) -> Finding {
    let kind = diagnosis.kind();
    match diagnosis {
        Diagnosis::QosIncompatible {
            topic,
            writer,
            reader,
            policies,
        } => incompatible(kind, topic, (*writer, *reader), policies, ends),
        Diagnosis::TypeConflict { topic, types } => {
            let types: Vec<&str> = types.iter().map(AsRef::as_ref).collect();
            let text = format!(
                "{} has several types, whose endpoints cannot communicate: {}",
                topic.name,
                types.join(", ")
            );
            let about = format!("{}|{}", topic.domain_id, topic.dds_name);
            finding(kind, Severity::Error, &about, text)
                .with_remedy("rename one of the topics, or use one type")
        }
        Diagnosis::TypeHashConflict {
            topic,
            message_type,
            ..
        } => {
            let text = format!(
                "{} has several definitions of {message_type}, which endpoints misread",
                topic.name
            );
            let about = format!("{}|{}|{message_type}", topic.domain_id, topic.dds_name);
            finding(kind, Severity::Error, &about, text)
                .with_remedy("build all nodes with one version of the interface package")
        }
        Diagnosis::DuplicateNode {
            domain_id, node, ..
        } => {
            let text = format!("Several nodes have the name {node}");
            let found = of_node(kind, all.ids, (*domain_id, node), text);
            found.with_remedy("give each node a name or a namespace of its own")
        }
        Diagnosis::UnmatchedPublisher {
            topic,
            writer,
            reason,
        } => Finding {
            writer: Some(writer.to_string()),
            ..unmatched(kind, topic, *writer, reason.label(), ends, PUBLISHER_WORDS)
        },
        Diagnosis::UnmatchedSubscription {
            topic,
            reader,
            reason,
        } => Finding {
            reader: Some(reader.to_string()),
            ..unmatched(kind, topic, *reader, reason.label(), ends, SUBSCRIBER_WORDS)
        },
        Diagnosis::HangingCall { topic, writer } => {
            let text = format!(
                "{} calls {} and receives no reply",
                ends.owner_name(*writer),
                topic.name
            );
            let about = format!("{}|{}|{writer}", topic.domain_id, topic.dds_name);
            Finding {
                writer: Some(writer.to_string()),
                ..finding(kind, Severity::Warning, &about, text)
            }
        }
        Diagnosis::NodeInSeveralDomains { node, domains, .. } => {
            let listed: Vec<_> = domains.iter().map(DomainId::to_string).collect();
            let text = format!("{node} is in several domains: {}", listed.join(", "));
            let first = domains.first().copied();
            Finding {
                domain_id: first.map(|id| id.0),
                node: first.and_then(|domain_id| all.ids.node(domain_id, node)),
                ..finding(kind, Severity::Warning, node, text)
            }
            .with_remedy("start all of its processes with the same ROS_DOMAIN_ID")
        }
        Diagnosis::SlowCallback { .. }
        | Diagnosis::ExecutorWait { .. }
        | Diagnosis::LateCallback { .. }
        | Diagnosis::IntraProcessOverflow { .. }
        | Diagnosis::ReaderQueueOverflow { .. }
        | Diagnosis::ObservationSuspended { .. } => inside::in_words(all.ids, diagnosis),
        Diagnosis::RestampingNode { topic, node, input } => {
            let text = format!(
                "{node} gives {} new stamps instead of those of {input}: chains end there",
                topic.name
            );
            let about = format!("{}|{}|{node}", topic.domain_id, topic.dds_name);
            Finding {
                node: all.ids.node(topic.domain_id, node),
                ..finding(kind, Severity::Note, &about, text)
            }
            .with_remedy("copy the stamp of the input into the header of the output")
        }
        Diagnosis::BuffersByCpu {
            topic,
            writer,
            reader,
            backends,
        } => {
            let why = match reader {
                Some(reader) => format!("{} takes no buffers", ends.owner_name(*reader)),
                None => "it is transient local".to_owned(),
            };
            let text = format!(
                "{} sends {} through the CPU instead of {}: {why}",
                ends.owner_name(*writer),
                topic.name,
                backends.join(", ")
            );
            let about = format!("{}|{}|{writer}", topic.domain_id, topic.dds_name);
            let found = Finding {
                writer: Some(writer.to_string()),
                reader: reader.map(|reader| reader.to_string()),
                ..finding(kind, Severity::Note, &about, text)
            };
            found.with_remedy("end subscriptions of older distributions and of other middleware")
        }
        Diagnosis::LogErrors { .. }
        | Diagnosis::DiagnosticError { .. }
        | Diagnosis::TransformFault { .. }
        | Diagnosis::NearMiss { .. }
        | Diagnosis::NodeInactive { .. }
        | Diagnosis::ParameterDrift { .. }
        | Diagnosis::MixedTime { .. }
        | Diagnosis::WrongStamps { .. }
        | Diagnosis::SharedMemoryFault { .. }
        | Diagnosis::ClocksApart { .. } => robot::in_words(all.ids, diagnosis),
        Diagnosis::LossyLink { link, .. } => {
            let text = format!(
                "TCP repeats many segments from {} to {} ({}): the network between them loses packets",
                link.source,
                link.destination,
                link.protocol.label()
            );
            let about = format!(
                "{}|{}|{}",
                link.protocol.label(),
                link.source,
                link.destination
            );
            finding(kind, Severity::Warning, &about, text)
                .with_remedy("look at the radio, the cable or the load of that link")
        }
        Diagnosis::SlowChain {
            topic,
            from,
            max_latency,
        } => {
            let text = format!(
                "The chain from {from} to {} takes longer than {} ms",
                topic.name,
                max_latency.as_secs_f64() * 1e3
            );
            let about = format!("{}|{}|{from}", topic.domain_id, topic.dds_name);
            finding(kind, Severity::Warning, &about, text)
                .with_remedy("run `rp chain` to see which hop takes the time")
        }
    }
}

/// Role of an endpoint, and its counterpart.
const PUBLISHER_WORDS: [&str; 2] = ["publishes", "subscription"];
const SUBSCRIBER_WORDS: [&str; 2] = ["subscribes to", "publisher"];

/// Describes an endpoint without a counterpart.
fn unmatched(
    kind: &'static str,
    topic: &TopicKey,
    endpoint: Guid,
    reason: &str,
    ends: &Ends<'_>,
    [verb, counterpart]: [&str; 2],
) -> Finding {
    let (owner, why) = (
        ends.owner_name(endpoint),
        missing_counterpart(reason, counterpart),
    );
    let text = format!("{owner} {verb} {}, and {why}", topic.name);
    let about = format!("{}|{}|{endpoint}", topic.domain_id, topic.dds_name);
    let found = finding(kind, severity_of_unmatched(reason), &about, text);
    match reason {
        "unreachable" => found.with_remedy(
            "on the host with 127.0.0.1, unset ROS_LOCALHOST_ONLY, or set ROS_AUTOMATIC_DISCOVERY_RANGE=SUBNET",
        ),
        _ => found,
    }
}

/// Describes a writer and a reader with incompatible QoS.
fn incompatible(
    kind: &'static str,
    topic: &TopicKey,
    (writer, reader): (Guid, Guid),
    policies: &Policies,
    ends: &Ends<'_>,
) -> Finding {
    let differ: Vec<_> = policies
        .iter()
        .map(|policy| ends.difference(policy, writer, reader))
        .collect();
    let text = format!(
        "{} sends nothing to {} on {}: {}",
        ends.owner_name(writer),
        ends.owner_name(reader),
        topic.name,
        differ.join("; ")
    );
    let about = format!("{}|{}|{writer}|{reader}", topic.domain_id, topic.dds_name);
    Finding {
        writer: Some(writer.to_string()),
        reader: Some(reader.to_string()),
        policies: policies.iter().map(|each| each.label().into()).collect(),
        ..finding(kind, Severity::Error, &about, text)
    }
    .with_remedy("let the publisher offer what the subscription requests, or request less")
}

/// Returns why an endpoint has no counterpart.
fn missing_counterpart(reason: &str, counterpart: &str) -> String {
    match reason {
        "unreachable" => format!(
            "every {counterpart} is on another host, and one of the two announces only 127.0.0.1"
        ),
        "qos" => format!("no {counterpart} has a matching QoS"),
        "type" => format!("every {counterpart} has another type"),
        "partition" => format!("every {counterpart} is in another partition"),
        _ => format!("there is no {counterpart}"),
    }
}

/// Returns the severity. An endpoint without any counterpart is common, but an endpoint with only
/// incompatible counterparts is not.
fn severity_of_unmatched(reason: &str) -> Severity {
    match reason {
        "unreachable" | "qos" | "type" | "partition" => Severity::Warning,
        _ => Severity::Note,
    }
}

/// Endpoints by GUID, and the nodes of their participants.
struct Ends<'a> {
    endpoints: HashMap<Guid, &'a EndpointFacts>,
    nodes: HashMap<GuidPrefix, Vec<&'a NodeName>>,
}

impl<'a> Ends<'a> {
    fn new(snapshot: &'a Snapshot) -> Self {
        let about = snapshot.diagnoses.list.iter();
        // Without findings, no lookup is needed.
        if about.len() == 0 {
            return Self {
                endpoints: HashMap::new(),
                nodes: HashMap::new(),
            };
        }
        let topics = snapshot.topics.iter();
        let all = topics.flat_map(|topic| topic.publishers.iter().chain(&topic.subscriptions));
        let mut nodes: HashMap<_, Vec<_>> = HashMap::new();
        for node in &snapshot.nodes {
            let known = nodes.entry(node.participant.prefix).or_default();
            known.push(&node.name);
        }
        Self {
            endpoints: all.map(|endpoint| (endpoint.guid, endpoint)).collect(),
            nodes,
        }
    }

    /// Returns the node of an endpoint. If no node announces it, those of its participant are
    /// named. Without these, it is the GUID.
    fn owner_name(&self, guid: Guid) -> String {
        let endpoint = self.endpoints.get(&guid);
        if let Some(node) = endpoint.and_then(|endpoint| endpoint.node.as_ref()) {
            return node.to_string();
        }
        match self.nodes.get(&guid.prefix).map(Vec::as_slice) {
            Some([node]) => format!("the participant of {node}"),
            Some([one, other]) => format!("the participant of {one} and {other}"),
            Some([one, others @ ..]) => {
                format!("the participant of {one} and {} others", others.len())
            }
            _ => guid.to_string(),
        }
    }

    /// Describes what the writer offers and the reader requests.
    fn difference(&self, policy: Policy, writer: Guid, reader: Guid) -> String {
        let value = |guid: Guid| {
            let endpoint = self.endpoints.get(&guid)?;
            let qos = &endpoint.qos;
            let milliseconds = |duration: RtpsDuration| match duration.finite() {
                Some(duration) => format!("{} ms", duration.as_millis()),
                None => "infinite".to_owned(),
            };
            match policy {
                Policy::Reliability => Some(qos.reliability.to_string()),
                Policy::Durability => Some(qos.durability.to_string()),
                Policy::Deadline => Some(milliseconds(qos.deadline)),
                Policy::Liveliness => Some(format!(
                    "{}, {}",
                    qos.liveliness,
                    milliseconds(qos.liveliness_lease)
                )),
                Policy::Ownership => Some(qos.ownership.to_string()),
                Policy::LatencyBudget
                | Policy::DestinationOrder
                | Policy::Presentation
                | Policy::DataRepresentation => None,
            }
        };
        let name = policy.label().replace('_', " ");
        match (value(writer), value(reader)) {
            (Some(offered), Some(requested)) => {
                format!("{name} offered {offered}, requested {requested}")
            }
            _ => format!("{name} differs"),
        }
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;
    use std::time::Instant;

    use super::*;
    use ros2probe_model::facts::diagnosis::Diagnoses;
    use ros2probe_model::graph::zenoh::ZenohFacts;
    use ros2probe_model::report::snapshot::NodeFacts;
    use ros2probe_wire::EntityId;

    #[test]
    fn findings_beyond_the_cap_are_dropped_and_the_most_severe_stay() {
        let list = (0..2 * MAX_FINDINGS).map(|number| Diagnosis::DuplicateNode {
            domain_id: DomainId(0),
            node: format!("/node_{number}").into(),
            participants: Vec::new(),
        });
        let snapshot = Snapshot {
            diagnoses: Arc::new(Diagnoses {
                list: list.collect(),
                ..Diagnoses::default()
            }),
            ..Snapshot::default()
        };
        let found = findings(&FindingInputs {
            snapshot: &snapshot,
            agent: &AgentFacts::new(SourceKind::Wire, Instant::now()),
            past: &Past::default(),
            ids: &Ids::default(),
            unready: Some("no packet was seen"),
        });
        assert_eq!(found.len(), MAX_FINDINGS);
        let first = found.first().unwrap();
        assert_eq!(
            (&*first.kind, first.severity),
            ("agent_not_ready", Severity::Error)
        );
        assert!(found.is_sorted_by_key(|each| each.severity));
    }

    #[test]
    fn an_endpoint_without_a_node_is_named_by_the_nodes_of_its_participant() {
        let reader = Guid::new(GuidPrefix([7; 12]), EntityId::PARTICIPANT);
        let node = |name: &str| NodeFacts {
            domain_id: DomainId(0),
            name: name.into(),
            participant: reader,
            writers: Vec::new(),
            readers: Vec::new(),
        };
        let finding = Diagnosis::DuplicateNode {
            domain_id: DomainId(0),
            node: "/lidar".into(),
            participants: Vec::new(),
        };
        let mut snapshot = Snapshot {
            nodes: vec![node("/lidar")],
            diagnoses: Arc::new(Diagnoses {
                list: vec![finding],
                ..Diagnoses::default()
            }),
            ..Snapshot::default()
        };
        let owner = |snapshot: &Snapshot| Ends::new(snapshot).owner_name(reader);
        assert_eq!(owner(&snapshot), "the participant of /lidar");
        snapshot.nodes.push(node("/imu"));
        assert_eq!(owner(&snapshot), "the participant of /lidar and /imu");
        snapshot.nodes.push(node("/base"));
        assert_eq!(owner(&snapshot), "the participant of /lidar and 2 others");
        snapshot.nodes.clear();
        assert_eq!(owner(&snapshot), reader.to_string());
    }

    #[test]
    fn each_reason_for_unread_zenoh_connections_is_described() {
        let found = |unseen| {
            let snapshot = Snapshot {
                zenoh: Some(ZenohFacts {
                    unseen,
                    ..ZenohFacts::default()
                }),
                ..Snapshot::default()
            };
            unseen_zenoh(&snapshot)
        };
        let text = |list: &[Finding]| -> Vec<String> {
            list.iter().map(|each| each.text.clone()).collect()
        };
        assert!(found([0; 6]).is_empty());
        assert_eq!(
            text(&found([1; 6])),
            [
                "The agent cannot read 1 connection of Zenoh encrypted with TLS",
                "The agent cannot read 1 connection of Zenoh encrypted with QUIC",
                "The agent cannot read 1 connection of Zenoh with another version of the wire \
                 format than 9",
                "The agent cannot read 1 connection of Zenoh with compressed batches",
                "The agent cannot read 1 connection of Zenoh with the low-latency transport",
                "The agent cannot read the payloads of 1 connection of Zenoh with shared memory; \
                 rates and sizes are right",
            ]
        );
        let two = found([2, 0, 0, 0, 0, 3]);
        assert_eq!(
            text(&two),
            [
                "The agent cannot read 2 connections of Zenoh encrypted with TLS",
                "The agent cannot read the payloads of 3 connections of Zenoh with shared \
                 memory; rates and sizes are right",
            ]
        );
        // Counting inside the processes does not provide payloads either.
        let remedies = two.iter().map(|each| each.remedy.is_some());
        assert_eq!(remedies.collect::<Vec<_>>(), [true, false]);
    }

    #[test]
    fn each_blind_spot_of_a_source_is_described() {
        let mut agent = AgentFacts::new(SourceKind::Replay, Instant::now());
        let text = |agent: &AgentFacts| -> Vec<String> {
            let notes = unseen(agent).into_iter();
            notes.map(|note| note.text).collect()
        };
        let lacking = text(&agent);
        assert_eq!(lacking.len(), 1, "{lacking:?}");
        assert!(
            lacking[0]
                .starts_with("A capture file contains only packets. It does not show what each")
                && lacking[0].contains("losses in the buffers of sockets"),
            "{lacking:?}"
        );
        let reason = "the kernel is too old".to_owned();
        agent
            .missing_abilities
            .push((Ability::SocketLosses, reason));
        let both = text(&agent);
        assert_eq!(
            both[0],
            "The agent does not see losses in the buffers of sockets: the kernel is too old"
        );
        let reason = "it has no types".to_owned();
        agent.missing_abilities.push((Ability::LateCauses, reason));
        let causes = "The agent does not see all causes of late calls: it has no types";
        assert!(text(&agent).iter().any(|note| note == causes));
        agent.missing_abilities.pop();
        assert!(both.len() == 2 && !both[1].contains("buffers"), "{both:?}");
        agent.abilities = Ability::ALL.to_vec();
        assert!(text(&agent).is_empty());
    }
}
