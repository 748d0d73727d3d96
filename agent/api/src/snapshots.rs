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
    /// Seconds of messages that are kept.
    pub seconds: u64,
    /// Largest amount of memory for the messages, in bytes.
    pub max_bytes: usize,
    /// Whether a bag is written when an expectation is violated.
    pub on_violation: bool,
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
