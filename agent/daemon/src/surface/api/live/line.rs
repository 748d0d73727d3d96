//! The lines of `GET /live`, declared once, for the stream and for the OpenAPI document.
//!
//! Rows are arrays where there are many of them. Members and elements are only ever added at the
//! end.

use std::borrow::Cow;

use ros2probe_model::names::TypeName;
use ros2probe_wire::Guid;
use serde::Serialize;
use utoipa::ToSchema;

use super::super::endpoint::text;
use ros2probe_api::events::Event;

/// One line: an object with one member.
#[derive(Debug, Serialize, ToSchema)]
#[serde(rename_all = "snake_case")]
#[schema(as = LiveLine)]
pub(in super::super) enum Line<'a> {
    /// The first line: the agent, and the meaning of flags and passages.
    Open(Open),
    /// The whole structure; again when it has changed.
    Graph(Graph<'a>),
    /// The agent; again when something has changed.
    Agent(Agent<'a>),
    /// Everything that is wrong, the worst first; again when something has changed.
    Findings(Vec<Finding>),
    /// Rates of the time before the stream was opened, once.
    History(History),
    /// Events since the stream was opened.
    Events(Events<'a>),
    /// Figures that have changed; the last line of each second, also where nothing has.
    Values(Values),
    /// Nothing will follow.
    End(End),
}

/// The agent, and the meaning of flags and passages.
#[derive(Debug, Serialize, ToSchema)]
#[schema(as = LiveOpen)]
pub(in super::super) struct Open {
    /// Of this run of the agent.
    pub run: String,
    /// Name of its host.
    pub host: Option<String>,
    /// Version of the agent.
    pub version: &'static str,
    /// Where it looks: `host`, `wire` or `replay`.
    pub source: &'static str,
    /// Rights of this client: `read`, `watch` or `all`.
    pub access: String,
    /// Time between two batches of lines.
    pub interval_seconds: u32,
    /// How far `/topics/{topic}/history` reaches back.
    pub history_seconds: u64,
    /// What the bits of a topic's flags mean, from the lowest one on.
    pub flags: &'static [&'static str],
    /// What the bits of passages mean, likewise.
    pub passages: Vec<&'static str>,
    /// Where the capture begins; null for a live agent.
    pub replay: Option<Replay>,
}

/// The capture that is replayed.
#[derive(Clone, Debug, Serialize, ToSchema)]
#[schema(as = LiveReplay)]
pub(in super::super) struct Replay {
    /// Unix time of its first packet; null before that is read.
    pub begin: Option<f64>,
}

/// Participants, nodes, topics and endpoints. Numbers that stand for them are valid within one
/// stream, where none is used twice.
#[derive(Debug, Default, Serialize, ToSchema)]
#[schema(as = LiveGraph)]
pub(in super::super) struct Graph<'a> {
    /// Counts up.
    pub version: u64,
    /// Participants.
    pub participants: Vec<Participant<'a>>,
    /// Nodes, one for each name of a domain.
    pub nodes: Vec<Node<'a>>,
    /// Topics, without those below services and discovery.
    pub topics: Vec<Topic<'a>>,
    /// Writers.
    pub publishers: Vec<Endpoint<'a>>,
    /// Readers.
    pub subscriptions: Vec<Endpoint<'a>>,
}

/// `[id, GUID, domain, implementation, host, process id, process, control group]`; the last four
/// are null where they are not known.
#[derive(Debug, Serialize, ToSchema)]
#[schema(as = LiveParticipant)]
pub(in super::super) struct Participant<'a>(
    pub u32,
    #[serde(serialize_with = "text")]
    #[schema(value_type = String)]
    pub Guid,
    pub u32,
    #[schema(value_type = String)] pub Cow<'a, str>,
    pub Option<&'a str>,
    pub Option<u32>,
    pub Option<&'a str>,
    pub Option<&'a str>,
);

/// `[id, domain, name, ids of its participants, 1 if hidden]`.
#[derive(Debug, Serialize, ToSchema)]
#[schema(as = LiveNode)]
pub(in super::super) struct Node<'a>(pub u32, pub u32, pub &'a str, pub Vec<u32>, pub u8);

/// `[id, domain, name, DDS name, kind, types, 1 if hidden, 1 if vanished, 1 if measured, watched]`.
/// `watched` is 1 for the configuration, 2 for the command line, 3 for a client, 0 for no watch of
/// this name; 4 is added where a glob covers it.
#[derive(Debug, Serialize, ToSchema)]
#[schema(as = LiveTopic)]
pub(in super::super) struct Topic<'a>(
    pub u32,
    pub u32,
    pub &'a str,
    pub &'a str,
    pub &'a str,
    #[schema(value_type = Vec<String>)] pub &'a [TypeName],
    pub u8,
    pub u8,
    pub u8,
    pub u8,
);

/// `[topic, node or 0, participant, GUID, passages, reliability, durability]`; passages are a set of
/// bits, empty without a counterpart.
#[derive(Debug, Serialize, ToSchema)]
#[schema(as = LiveEndpoint)]
pub(in super::super) struct Endpoint<'a>(
    pub u32,
    pub u32,
    pub u32,
    #[serde(serialize_with = "text")]
    #[schema(value_type = String)]
    pub Guid,
    pub u8,
    pub &'a str,
    pub &'a str,
);

/// The agent itself.
#[derive(Debug, Serialize, ToSchema)]
#[schema(as = LiveAgent)]
pub(in super::super) struct Agent<'a> {
    /// It observes the robot.
    pub ready: bool,
    /// Why not.
    pub reason: Option<String>,
    /// A replay has come to its end.
    pub finished: bool,
    /// Packets, records and datagrams lost for want of room: above 0, counts are lower bounds.
    pub dropped: u64,
    /// Senders whose announcement was missed.
    pub unknown_writers: usize,
    /// Topics that a watch matched but `limits.topics` kept out.
    pub topics_rejected: u64,
    /// Everything it may be able to observe.
    pub abilities: Vec<Ability<'a>>,
    /// Watches in force.
    pub watches: usize,
}

/// `[ability, 1 if it has it, why not]`.
#[derive(Debug, Serialize, ToSchema)]
#[schema(as = LiveAbility)]
pub(in super::super) struct Ability<'a>(pub &'static str, pub u8, pub Option<&'a str>);

/// How bad a finding is.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, ToSchema)]
#[serde(rename_all = "lowercase")]
#[schema(as = LiveSeverity)]
pub(in super::super) enum Severity {
    /// Something does not work.
    Error,
    /// Something may not work.
    Warning,
    /// Good to know.
    Note,
}

/// One thing that is wrong, in words.
#[derive(Clone, Debug, PartialEq, Serialize, ToSchema)]
#[schema(as = LiveFinding)]
pub(in super::super) struct Finding {
    /// The same as long as it is about the same.
    pub id: String,
    /// Which: as in `diagnoses` of `/topics`, or `loss`, `watch_violated`, `watch_silent`,
    /// `agent_not_ready`, `agent_drops`, `unknown_writers`, `topics_rejected` or `ability`.
    #[schema(value_type = String)]
    pub kind: &'static str,
    /// How bad.
    pub severity: Severity,
    /// Its domain; null for the agent.
    pub domain_id: Option<u32>,
    /// Its topic in the graph.
    pub topic: Option<u32>,
    /// Its node in the graph.
    pub node: Option<u32>,
    /// Unix time since when, where that is known.
    pub since: Option<f64>,
    /// What is wrong.
    pub text: String,
    /// What helps.
    pub remedy: Option<String>,
    /// GUID of the writer.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[schema(nullable = false)]
    pub writer: Option<String>,
    /// GUID of the reader.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[schema(nullable = false)]
    pub reader: Option<String>,
    /// Policies that differ.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    #[schema(value_type = Vec<String>, required = false)]
    pub policies: Vec<&'static str>,
}

/// Rates of the last minutes, for small charts.
#[derive(Debug, Default, Serialize, ToSchema)]
#[schema(as = LiveHistory)]
pub(in super::super) struct History {
    /// Time between two values.
    pub step_seconds: u32,
    /// Unix time at which each step ended.
    pub t: Vec<f64>,
    /// Messages a second, payload bytes a second and lost messages of all topics.
    pub totals: [Vec<f64>; 3],
    /// Messages a second by topic.
    pub topics: Vec<Rates>,
}

/// `[topic, messages a second in each step]`, null where it was not measured.
#[derive(Debug, Serialize, ToSchema)]
#[schema(as = LiveRates)]
pub(in super::super) struct Rates(pub u32, pub Vec<Option<f64>>);

/// Events.
#[derive(Debug, Serialize, ToSchema)]
#[schema(as = LiveEvents)]
pub(in super::super) struct Events<'a> {
    /// Events that were overwritten before they could be sent.
    pub missed: u64,
    /// The others, in the form of `/events`.
    pub list: Vec<Event<'a>>,
}

/// Figures.
#[derive(Debug, Default, Serialize, ToSchema)]
#[schema(as = LiveValues)]
pub(in super::super) struct Values {
    /// Unix time of the facts, in the source's clock.
    pub t: f64,
    /// Rows that differ from those that were sent last.
    pub topics: Vec<Row>,
    /// Of all topics in the last second.
    pub totals: Totals,
    /// How far a replay is.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[schema(nullable = false)]
    pub replay: Option<Progress>,
}

/// `[topic, messages a second, payload bytes a second, messages, lost messages, lost in the last
/// second, median latency, its 99th percentile, flags, Unix time of the last message]`. All but
/// topic and flags are null while it is not measured.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, ToSchema)]
#[schema(as = LiveRow)]
pub(in super::super) struct Row(
    pub u32,
    pub Option<f64>,
    pub Option<f64>,
    pub Option<u64>,
    pub Option<u64>,
    pub Option<u32>,
    pub Option<f64>,
    pub Option<f64>,
    pub u32,
    pub Option<f64>,
);

/// `[messages, payload bytes, lost messages, measured topics]`.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, ToSchema)]
#[schema(as = LiveTotals)]
pub(in super::super) struct Totals(pub u64, pub u64, pub u64, pub u64);

/// `[part of the file that was read, 1 if all of it was]`.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, ToSchema)]
#[schema(as = LiveProgress)]
pub(in super::super) struct Progress(pub Option<f64>, pub u8);

/// Why nothing follows.
#[derive(Debug, Serialize, ToSchema)]
#[schema(as = LiveEnd)]
pub(in super::super) struct End {
    /// In words.
    #[schema(value_type = String)]
    pub reason: &'static str,
}

impl Row {
    /// Nothing is measured and nothing is wrong.
    pub(in super::super) fn empty(topic: u32) -> Self {
        Self(topic, None, None, None, None, None, None, None, 0, None)
    }
}

impl Line<'_> {
    /// Appends it to `lines`.
    pub(in super::super) fn write(&self, lines: &mut Vec<u8>) {
        // Plain numbers and strings into memory: nothing that could fail.
        let _ = serde_json::to_writer(&mut *lines, self);
        lines.push(b'\n');
    }
}
