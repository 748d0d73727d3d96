//! `/snapshots`: the last seconds of topics, which the agent keeps in memory and writes on request.

use serde::{Deserialize, Serialize};

/// All snapshots.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(default)]
pub struct SnapshotList {
    /// Snapshots, in the configuration's order.
    pub snapshots: Vec<Snapshot>,
}

/// A snapshot: the most recent messages of some topics, kept in memory.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(default)]
pub struct Snapshot {
    /// Name of the snapshot in the configuration.
    pub name: String,
    /// Names and globs of the topics.
    pub topics: Vec<String>,
    /// Domain id of the topics.
    pub domain_id: u32,
    /// Time before a trigger that a bag covers, in seconds.
    pub seconds: u64,
    /// Time after a trigger that a bag covers, in seconds.
    pub seconds_after: u64,
    /// Maximum memory for the messages, in bytes.
    pub max_bytes: usize,
    /// Whether `trigger` contains `expectation`.
    pub on_violation: bool,
    /// Names of the events that trigger a bag.
    pub trigger: Vec<String>,
    /// Minimum time between two triggered bags, in seconds.
    pub min_interval_s: u64,
    /// Maximum number of triggered bags.
    pub max_count: usize,
    /// Maximum total size of the snapshot's bags, in bytes.
    pub max_total_bytes: u64,
    /// Number of messages in memory.
    pub messages: u64,
    /// Memory that the messages use, in bytes.
    pub bytes: u64,
    /// Messages dropped before `seconds` had passed because `max_bytes` was reached.
    pub crowded_out: u64,
    /// Number of bags written.
    pub written: u64,
    /// Number of bags that could not be written.
    pub failed: u64,
    /// Number of events that matched a trigger but did not start a bag.
    pub suppressed: u64,
    /// Number of old triggered bags that were removed for new bags.
    pub removed: u64,
}

/// The bag that was written from a snapshot.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(default)]
pub struct WrittenSnapshot {
    /// Name of the bag's directory.
    pub name: String,
    /// Path of the bag on the robot.
    pub directory: String,
    /// Number of messages in the bag.
    pub messages: u64,
}
