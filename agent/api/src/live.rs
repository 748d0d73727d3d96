//! `/live`: the lines of the stream that the page follows.
//!
//! Rows are arrays where there are many of them. Members and elements are only ever added at the
//! end.

use std::borrow::Cow;

use serde::{Deserialize, Serialize};

use crate::events::Event;

/// One line: an object with one member.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema), schema(as = LiveLine))]
#[serde(rename_all = "snake_case")]
pub enum Line<'a> {
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
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema), schema(as = LiveOpen))]
pub struct Open {
    /// Of this run of the agent.
    pub run: String,
    /// Name of its host.
    pub host: Option<String>,
    /// Version of the agent.
    pub version: Cow<'static, str>,
    /// Where it looks: `host`, `wire` or `replay`.
    pub source: Cow<'static, str>,
    /// Rights of this client: `read`, `watch` or `all`.
    pub access: String,
    /// Time between two batches of lines.
    pub interval_seconds: u32,
    /// How far `/topics/{topic}/history` reaches back.
    pub history_seconds: u64,
    /// What the bits of a topic's flags mean, from the lowest one on.
    pub flags: Vec<Cow<'static, str>>,
    /// What the bits of passages mean, likewise.
    pub passages: Vec<Cow<'static, str>>,
    /// Where the capture begins; null for a live agent.
    pub replay: Option<Replay>,
}

/// The capture that is replayed.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema), schema(as = LiveReplay))]
pub struct Replay {
    /// Unix time of its first packet; null before that is read.
    pub begin: Option<f64>,
}

/// Participants, nodes, topics and endpoints. Numbers that stand for them are valid within one
/// stream, where none is used twice.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema), schema(as = LiveGraph))]
pub struct Graph<'a> {
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
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema), schema(as = LiveParticipant))]
pub struct Participant<'a>(
    pub u32,
    pub String,
    pub u32,
    pub Cow<'a, str>,
    pub Option<Cow<'a, str>>,
    pub Option<u32>,
    pub Option<Cow<'a, str>>,
    pub Option<Cow<'a, str>>,
);

/// `[id, domain, name, ids of its participants, 1 if hidden]`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema), schema(as = LiveNode))]
pub struct Node<'a>(pub u32, pub u32, pub Cow<'a, str>, pub Vec<u32>, pub u8);

/// `[id, domain, name, DDS name, kind, types, 1 if hidden, 1 if vanished, 1 if measured, watched]`.
/// `watched` is 1 for the configuration, 2 for the command line, 3 for a client, 0 for no watch of
/// this name; 4 is added where a glob covers it.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema), schema(as = LiveTopic))]
pub struct Topic<'a>(
    pub u32,
    pub u32,
    pub Cow<'a, str>,
    pub Cow<'a, str>,
    pub Cow<'a, str>,
    pub Vec<Cow<'a, str>>,
    pub u8,
    pub u8,
    pub u8,
    pub u8,
);

/// `[topic, node or 0, participant, GUID, passages, reliability, durability]`; passages are a set of
/// bits, empty without a counterpart.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema), schema(as = LiveEndpoint))]
pub struct Endpoint<'a>(
    pub u32,
    pub u32,
    pub u32,
    pub String,
    pub u8,
    pub Cow<'a, str>,
    pub Cow<'a, str>,
);

/// The agent itself.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema), schema(as = LiveAgent))]
pub struct Agent<'a> {
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
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema), schema(as = LiveAbility))]
pub struct Ability<'a>(pub Cow<'static, str>, pub u8, pub Option<Cow<'a, str>>);

/// How bad a finding is.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema), schema(as = LiveSeverity))]
#[serde(rename_all = "lowercase")]
pub enum Severity {
    /// Something does not work.
    Error,
    /// Something may not work.
    Warning,
    /// Good to know.
    Note,
}

/// One thing that is wrong, in words.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema), schema(as = LiveFinding))]
pub struct Finding {
    /// The same as long as it is about the same.
    pub id: String,
    /// Which: as in `diagnoses` of `/topics`, or `loss`, `watch_violated`, `watch_silent`,
    /// `agent_not_ready`, `agent_drops`, `unknown_writers`, `topics_rejected` or `ability`.
    pub kind: Cow<'static, str>,
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
    #[cfg_attr(feature = "openapi", schema(nullable = false))]
    pub writer: Option<String>,
    /// GUID of the reader.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[cfg_attr(feature = "openapi", schema(nullable = false))]
    pub reader: Option<String>,
    /// Policies that differ.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    #[cfg_attr(feature = "openapi", schema(required = false))]
    pub policies: Vec<Cow<'static, str>>,
}

/// Rates of the last minutes, for small charts.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema), schema(as = LiveHistory))]
pub struct History {
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
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema), schema(as = LiveRates))]
pub struct Rates(pub u32, pub Vec<Option<f64>>);

/// Events.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema), schema(as = LiveEvents))]
pub struct Events<'a> {
    /// Events that were overwritten before they could be sent.
    pub missed: u64,
    /// The others, in the form of `/events`.
    pub list: Vec<Event<'a>>,
}

/// Figures.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema), schema(as = LiveValues))]
pub struct Values {
    /// Unix time of the facts, in the source's clock.
    pub t: f64,
    /// Rows that differ from those that were sent last.
    pub topics: Vec<Row>,
    /// Of all topics in the last second.
    pub totals: Totals,
    /// How far a replay is.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[cfg_attr(feature = "openapi", schema(nullable = false))]
    pub replay: Option<Progress>,
}

/// `[topic, messages a second, payload bytes a second, messages, lost messages, lost in the last
/// second, median latency, its 99th percentile, flags, Unix time of the last message]`. All but
/// topic and flags are null while it is not measured.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema), schema(as = LiveRow))]
pub struct Row(
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
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema), schema(as = LiveTotals))]
pub struct Totals(pub u64, pub u64, pub u64, pub u64);

/// `[part of the file that was read, 1 if all of it was]`.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema), schema(as = LiveProgress))]
pub struct Progress(pub Option<f64>, pub u8);

/// Why nothing follows.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema), schema(as = LiveEnd))]
pub struct End {
    /// In words.
    pub reason: Cow<'static, str>,
}

impl Row {
    /// Nothing is measured and nothing is wrong.
    #[must_use]
    pub const fn empty(topic: u32) -> Self {
        Self(topic, None, None, None, None, None, None, None, 0, None)
    }
}

impl Finding {
    /// The same with what helps.
    #[must_use]
    pub fn with_remedy(self, remedy: impl Into<String>) -> Self {
        Self {
            remedy: Some(remedy.into()),
            ..self
        }
    }
}
