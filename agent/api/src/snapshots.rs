//! `/snapshots`: the last seconds of topics, which the agent keeps and writes on request.

use serde::{Deserialize, Serialize};

/// All snapshots.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(default)]
pub struct SnapshotList {
    /// In the configuration's order.
    pub snapshots: Vec<Snapshot>,
}

/// What is kept of some topics.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(default)]
pub struct Snapshot {
    /// Its name in the configuration.
    pub name: String,
    /// Names and globs.
    pub topics: Vec<String>,
    /// Their domain.
    pub domain_id: u32,
    /// How much is kept at most.
    pub seconds: u64,
    /// How much memory that may take.
    pub max_bytes: usize,
    /// Whether it is written when an expectation is violated.
    pub on_violation: bool,
    /// Messages in memory.
    pub messages: u64,
    /// Memory they take.
    pub bytes: u64,
    /// Messages that were young enough and had to go for want of room.
    pub crowded_out: u64,
    /// Bags written so far.
    pub written: u64,
    /// Bags that could not be.
    pub failed: u64,
}

/// A bag of a snapshot.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(default)]
pub struct WrittenSnapshot {
    /// Name of its directory.
    pub name: String,
    /// Where it lies on the robot.
    pub directory: String,
    /// Messages in it.
    pub messages: u64,
}
