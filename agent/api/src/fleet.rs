//! `/fleet`, and the output of `rp fleet --json`: the robots that deliver to an engine, and what
//! differs from the others.

use std::collections::BTreeMap;
use std::fmt;

use serde::{Deserialize, Serialize};

/// What an agent knows of the robots that deliver to its engine.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct FleetAnswer {
    /// Unix time of the engine's last answer in seconds; null before the first one.
    pub at: Option<f64>,
    /// Why the last request to the engine failed; null if it succeeded.
    pub problem: Option<String>,
    /// Robots, those in most trouble first.
    pub robots: Vec<Robot>,
    /// How many of them were compared.
    #[serde(default)]
    pub comparison: Comparison,
    /// Incidents of the robots; null if the configuration has no store.
    #[serde(default)]
    pub incidents: Option<Incidents>,
}

/// The robots of a fleet, those in most trouble first.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Fleet {
    /// Robots.
    pub robots: Vec<Robot>,
    /// How many of them were compared.
    #[serde(default)]
    pub comparison: Comparison,
    /// Their incidents, if a store was read.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub incidents: Option<Incidents>,
}

/// A robot and its incidents: `rp fleet ROBOT --json`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct RobotWithIncidents {
    /// The robot.
    #[serde(flatten)]
    pub robot: Robot,
    /// Its incidents, if a store was read.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub incidents: Option<Incidents>,
}

/// Bags that robots wrote because of an event or a request, at the destination of `rp ship`.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema), schema(as = FleetIncidents))]
#[serde(default)]
pub struct Incidents {
    /// Unix time of the last successful reading in seconds; null before the first one.
    pub at: Option<f64>,
    /// Why the last reading failed; null if it succeeded.
    pub problem: Option<String>,
    /// Incidents, the latest delivery first.
    pub bags: Vec<Incident>,
    /// Number of complete bags whose manifests were not read: older ones, or not yet.
    pub unread: u64,
    /// Number of bags whose delivery is not complete.
    pub unfinished: u64,
    /// Whether the store has more objects than were listed.
    pub is_cut: bool,
}

/// A bag of an incident, from its manifest.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema), schema(as = FleetIncident))]
#[serde(default)]
pub struct Incident {
    /// Name of the robot.
    pub robot: String,
    /// Name of the bag's directory at the destination, below that of the robot.
    pub bag: String,
    /// Name of the snapshot in the robot's configuration.
    pub snapshot: String,
    /// Name of the trigger, `request` or `signal`.
    pub trigger: String,
    /// Name of the event that met the trigger.
    pub event: Option<String>,
    /// Topic of the event.
    pub topic: Option<String>,
    /// Time of the earliest message, RFC 3339; null without messages.
    pub start: Option<String>,
    /// Time of the latest message, RFC 3339; null without messages.
    pub end: Option<String>,
    /// Warnings and errors of the robot in that time: numbers by names of events. Null if its agent
    /// did not answer.
    pub findings: Option<BTreeMap<String, u64>>,
    /// Number of messages.
    pub messages: u64,
    /// Size of its files in bytes.
    pub bytes: u64,
    /// Whether the recording ended in order. If not, `rp bag reindex` completes it.
    pub is_complete: bool,
}

/// The comparison of the robots in reach.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema), schema(as = FleetComparison))]
pub struct Comparison {
    /// Number of robots in reach.
    pub in_reach: usize,
    /// Number of robots in reach from which on they are compared.
    pub minimum: usize,
}

impl Comparison {
    /// Returns whether enough robots are in reach.
    #[must_use]
    pub const fn is_possible(&self) -> bool {
        self.in_reach >= self.minimum
    }
}

/// State of a robot, the worst one first.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema), schema(as = FleetState))]
pub enum State {
    /// No sample arrived lately.
    OutOfReach,
    /// Its agent captures no packets, or its figures are old.
    NotReady,
    /// Expectations are violated.
    Violated,
    /// There are findings about its graph.
    Findings,
    /// None of these.
    Ok,
}

/// A robot.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema), schema(as = FleetRobot))]
pub struct Robot {
    /// Value of the label `instance`.
    pub name: String,
    /// Its state.
    pub state: State,
    /// Age of its last sample in seconds.
    pub age_s: f64,
    /// Version of its agent.
    pub version: Option<String>,
    /// Number of nodes.
    pub nodes: usize,
    /// Number of topics.
    pub topics: usize,
    /// Fraction of the messages of the last 5 minutes that subscribers lost.
    pub loss: Option<f64>,
    /// Violated expectations: topic and expectation.
    pub violated: Vec<(String, String)>,
    /// Findings by kind, without unmatched endpoints, which healthy robots have, too.
    pub findings: BTreeMap<String, u64>,
    /// What differs from the other robots.
    pub differences: Vec<Difference>,
    /// Address of its own page, if the configuration has one.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub page: Option<String>,
}

/// A property in which a robot differs from most others.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema), schema(as = FleetDifference))]
pub struct Difference {
    /// What the property belongs to.
    pub part: Part,
    /// Name of the property.
    pub what: String,
    /// Its value; null if the robot does not have it.
    pub here: Option<String>,
    /// The usual value; null if the others do not have it.
    pub usual: Option<String>,
    /// Number of robots with the usual value.
    pub robots: usize,
    /// Number of compared robots.
    pub of: usize,
    /// The difference as one line.
    pub text: String,
}

/// A part of a robot that is compared.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema), schema(as = FleetPart))]
pub enum Part {
    /// Nodes of the graph.
    Nodes,
    /// Topics of the graph, and their types.
    Topics,
    /// Numbers of publishers and subscriptions of topics.
    Endpoints,
    /// Quality of service of topics.
    Qos,
    /// Rates of topics.
    Rates,
    /// The agent itself.
    Agent,
}

impl State {
    /// Returns the text for people.
    #[must_use]
    pub const fn label(self) -> &'static str {
        match self {
            Self::OutOfReach => "out of reach",
            Self::NotReady => "not ready",
            Self::Violated => "violated",
            Self::Findings => "findings",
            Self::Ok => "ok",
        }
    }
}

impl Part {
    /// All parts. The first three are the graph.
    pub const ALL: [Self; 6] = [
        Self::Nodes,
        Self::Topics,
        Self::Endpoints,
        Self::Qos,
        Self::Rates,
        Self::Agent,
    ];

    /// Returns the text for people.
    #[must_use]
    pub const fn label(self) -> &'static str {
        match self {
            Self::Nodes => "nodes",
            Self::Topics => "topics",
            Self::Endpoints => "publishers and subscriptions",
            Self::Qos => "quality of service",
            Self::Rates => "rates",
            Self::Agent => "agent",
        }
    }
}

/// A property that every robot either has or not.
pub const PRESENT: &str = "present";

impl fmt::Display for Difference {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self {
            what, robots, of, ..
        } = self;
        match (&self.here, &self.usual) {
            (None, Some(usual)) if usual == PRESENT => write!(f, "{what} is missing")?,
            (Some(here), None) if here == PRESENT => write!(f, "{what} is only here")?,
            (None, Some(usual)) => write!(f, "{what}: none, usually {usual}")?,
            (Some(here), None) => write!(f, "{what}: {here}, usually none")?,
            (Some(here), Some(usual)) => write!(f, "{what}: {here}, usually {usual}")?,
            (None, None) => write!(f, "{what}")?,
        }
        write!(f, " ({robots} of {of})")
    }
}
