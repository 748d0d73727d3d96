//! `/live`: the lines of the stream that the web page reads.
//!
//! Repeated rows are arrays, to save bytes. New members and elements are only added at the end.

use std::borrow::Cow;

use serde::{Deserialize, Serialize};

use crate::events::Event;
use crate::recordings::BagTrigger;

/// A line of the stream: an object with one member.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema), schema(as = LiveLine))]
#[serde(rename_all = "snake_case")]
pub enum Line<'a> {
    /// The first line: the agent, and the meaning of the bits of flags and passages.
    Open(Open),
    /// The whole graph; sent first, and again after each change.
    Graph(Graph<'a>),
    /// The agent's state; sent first, and again after each change.
    Agent(Agent<'a>),
    /// All findings, the most severe first; sent again after each change.
    Findings(Vec<Finding>),
    /// Rates from before the stream was opened; sent once.
    History(History),
    /// Events since the previous line of this kind.
    Events(Events<'a>),
    /// Values that changed; the last line of each second, sent even if nothing changed.
    Values(Values),
    /// The last line of the stream.
    End(End),
}

/// The agent, and the meaning of the bits of flags and passages.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema), schema(as = LiveOpen))]
pub struct Open {
    /// Id of this run of the agent.
    pub run: String,
    /// Name of the agent's host.
    pub host: Option<String>,
    /// Version of the agent.
    pub version: Cow<'static, str>,
    /// Where the agent captures: `host`, `wire` or `replay`.
    pub source: Cow<'static, str>,
    /// Rights of this client: `read`, `watch` or `all`.
    pub access: String,
    /// Seconds between two batches of lines.
    pub interval_seconds: u32,
    /// Seconds that `/topics/{topic}/history` covers.
    pub history_seconds: u64,
    /// Whether the agent keeps a history of the last days (`/history`).
    #[serde(default)]
    pub keeps_history: bool,
    /// Whether the agent has the view of a fleet (`/fleet`).
    #[serde(default)]
    pub has_fleet: bool,
    /// Meaning of the bits of a topic's flags, starting with the lowest bit.
    pub flags: Vec<Cow<'static, str>>,
    /// Meaning of the bits of passages, starting with the lowest bit.
    pub passages: Vec<Cow<'static, str>>,
    /// The replayed capture; null for a live agent.
    pub replay: Option<Replay>,
}

/// The replayed capture.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema), schema(as = LiveReplay))]
pub struct Replay {
    /// Unix time of the first packet; null before it has been read.
    pub begin: Option<f64>,
    /// What triggered the bag in replay; null unless a snapshot wrote it.
    pub incident: Option<BagTrigger>,
}

/// Participants, nodes, topics and endpoints. Each has a number that is unique within the stream
/// and never reused.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema), schema(as = LiveGraph))]
pub struct Graph<'a> {
    /// Version of the graph; it increases with each change.
    pub version: u64,
    /// Participants.
    pub participants: Vec<Participant<'a>>,
    /// Nodes, one for each name in a domain.
    pub nodes: Vec<Node<'a>>,
    /// Topics, except topics of services and discovery.
    pub topics: Vec<Topic<'a>>,
    /// Writers.
    pub publishers: Vec<Endpoint<'a>>,
    /// Readers.
    pub subscriptions: Vec<Endpoint<'a>>,
}

/// `[id, GUID, domain, implementation, host, process id, process, control group, container]`. Each
/// of the last five is null when unknown. The last one is `container` with the first digits of the
/// id, or the systemd service; null for other control groups.
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
    #[serde(default)] pub Option<Cow<'a, str>>,
);

/// `[id, domain, name, ids of its participants, 1 if hidden]`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema), schema(as = LiveNode))]
pub struct Node<'a>(pub u32, pub u32, pub Cow<'a, str>, pub Vec<u32>, pub u8);

/// `[id, domain, name, DDS name, kind, types, 1 if hidden, 1 if vanished, 1 if measured, watched]`.
/// `watched` is the origin of a watch of exactly this name: 1 for the configuration, 2 for the
/// command line, 3 for a client, 0 without a watch. A glob that covers the topic adds 4.
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

/// `[topic, node or 0, participant, GUID, passages, reliability, durability]`. `passages` is a bit
/// set, 0 if no endpoint matches.
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

/// State of the agent itself.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema), schema(as = LiveAgent))]
pub struct Agent<'a> {
    /// The agent captures packets, and its state is fresh.
    pub ready: bool,
    /// Why the agent is not ready; null if it is.
    pub reason: Option<String>,
    /// The replay has reached its end.
    pub finished: bool,
    /// Packets, records and datagrams dropped because a buffer was full. Above 0, counts are lower
    /// bounds.
    pub dropped: u64,
    /// Number of writers whose announcement was missed.
    pub unknown_writers: usize,
    /// Topics that match a watch but are not measured because `limits.topics` is reached.
    pub topics_rejected: u64,
    /// Abilities, and whether the agent has each of them.
    pub abilities: Vec<Ability<'a>>,
    /// Number of active watches.
    pub watches: usize,
}

/// `[ability, 1 if the agent has it, why not]`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema), schema(as = LiveAbility))]
pub struct Ability<'a>(pub Cow<'static, str>, pub u8, pub Option<Cow<'a, str>>);

/// Severity of a finding.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema), schema(as = LiveSeverity))]
#[serde(rename_all = "lowercase")]
pub enum Severity {
    /// Something does not work.
    Error,
    /// Something may not work.
    Warning,
    /// Information that needs no action.
    Note,
}

/// A finding, described in words.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema), schema(as = LiveFinding))]
pub struct Finding {
    /// Stable id: it stays the same while the finding concerns the same problem.
    pub id: String,
    /// Kind of the finding: a kind of `diagnoses` in `/topics`, or `loss`, `watch_violated`,
    /// `watch_silent`, `agent_not_ready`, `agent_drops`, `unknown_writers`, `topics_rejected`,
    /// `zenoh_unseen`, `ability`.
    pub kind: Cow<'static, str>,
    /// Severity.
    pub severity: Severity,
    /// Domain id; null for findings about the agent.
    pub domain_id: Option<u32>,
    /// Number of the topic in the graph.
    pub topic: Option<u32>,
    /// Number of the node in the graph.
    pub node: Option<u32>,
    /// Unix time at which the problem began; null when unknown.
    pub since: Option<f64>,
    /// Description of the problem.
    pub text: String,
    /// Suggested remedy.
    pub remedy: Option<String>,
    /// GUID of the writer.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[cfg_attr(feature = "openapi", schema(nullable = false))]
    pub writer: Option<String>,
    /// GUID of the reader.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[cfg_attr(feature = "openapi", schema(nullable = false))]
    pub reader: Option<String>,
    /// QoS policies that differ.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    #[cfg_attr(feature = "openapi", schema(required = false))]
    pub policies: Vec<Cow<'static, str>>,
}

/// Rates of the last minutes, for small charts.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema), schema(as = LiveHistory))]
pub struct History {
    /// Seconds between two values.
    pub step_seconds: u32,
    /// Unix time at which each step ended.
    pub t: Vec<f64>,
    /// Messages per second, payload bytes per second and lost messages, each summed over all
    /// topics.
    pub totals: [Vec<f64>; 3],
    /// Messages per second of each topic.
    pub topics: Vec<Rates>,
}

/// `[topic, messages per second in each step]`; null for steps in which the topic was not measured.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema), schema(as = LiveRates))]
pub struct Rates(pub u32, pub Vec<Option<f64>>);

/// Events since the previous line of this kind.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema), schema(as = LiveEvents))]
pub struct Events<'a> {
    /// Number of events that were overwritten before they could be sent.
    pub missed: u64,
    /// The other events, in the form of `/events`.
    pub list: Vec<Event<'a>>,
}

/// Values that changed since the previous line of this kind.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema), schema(as = LiveValues))]
pub struct Values {
    /// Unix time of the values, by the source's clock.
    pub t: f64,
    /// Rows that changed since they were last sent.
    pub topics: Vec<Row>,
    /// Totals of all topics in the last second.
    pub totals: Totals,
    /// Progress of the replay; null for a live agent.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[cfg_attr(feature = "openapi", schema(nullable = false))]
    pub replay: Option<Progress>,
}

/// `[topic, messages per second, payload bytes per second, messages, messages that the worst
/// subscriber lost, messages lost in the last second, median latency, 99th percentile of latency,
/// flags, Unix time of the last message, messages that the worst subscriber expected]`. All
/// elements but topic and flags are null for a topic that is not measured.
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
    pub Option<u64>,
);

/// `[messages, payload bytes, lost messages, measured topics]`.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema), schema(as = LiveTotals))]
pub struct Totals(pub u64, pub u64, pub u64, pub u64);

/// `[share of the file that was read (0 to 1), 1 if the replay has finished, 1 if it stands still,
/// multiple of the speed of the capture or 0 without waiting]`.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema), schema(as = LiveProgress))]
pub struct Progress(
    pub Option<f64>,
    pub u8,
    #[serde(default)] pub u8,
    #[serde(default)] pub f64,
);

/// Why the stream ended.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema), schema(as = LiveEnd))]
pub struct End {
    /// The reason, in words.
    pub reason: Cow<'static, str>,
}

impl Row {
    /// Returns the row of a topic that is not measured and has no flags.
    #[must_use]
    pub const fn empty(topic: u32) -> Self {
        Self(
            topic, None, None, None, None, None, None, None, 0, None, None,
        )
    }
}

impl Finding {
    /// Returns the finding with a suggested remedy.
    #[must_use]
    pub fn with_remedy(self, remedy: impl Into<String>) -> Self {
        Self {
            remedy: Some(remedy.into()),
            ..self
        }
    }
}
