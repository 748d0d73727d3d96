//! `/history`: the history on disk.

use serde::{Deserialize, Serialize};

/// Header of an answer with `true` if its oldest lines are missing.
pub const TRUNCATED_HEADER: &str = "ros2probe-truncated";

/// A noun whose answer the history keeps.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(rename_all = "snake_case")]
pub enum KeptNoun {
    /// `/parameters`.
    Parameters,
    /// `/diagnostics`.
    Diagnostics,
    /// `/transforms`.
    Transforms,
    /// `/clocks`.
    Clocks,
    /// `/chains`.
    Chains,
    /// `/actions`.
    Actions,
    /// `/services`.
    Services,
    /// `/health`.
    Health,
    /// `/logs` with all messages that the agent had.
    Logs,
    /// `/participants`.
    Participants,
    /// `/nodes`.
    Nodes,
    /// `/graph`.
    Graph,
    /// Details of each topic, without measurements and histograms; not of the topics of services and
    /// of discovery.
    Topics,
}

impl KeptNoun {
    /// All nouns. If they are too large together, the last ones are left out.
    pub const ALL: [Self; 13] = [
        Self::Parameters,
        Self::Diagnostics,
        Self::Transforms,
        Self::Clocks,
        Self::Chains,
        Self::Actions,
        Self::Services,
        Self::Health,
        Self::Logs,
        Self::Participants,
        Self::Nodes,
        Self::Graph,
        Self::Topics,
    ];

    /// Returns the word in the path.
    #[must_use]
    pub const fn label(self) -> &'static str {
        match self {
            Self::Parameters => "parameters",
            Self::Diagnostics => "diagnostics",
            Self::Transforms => "transforms",
            Self::Clocks => "clocks",
            Self::Chains => "chains",
            Self::Actions => "actions",
            Self::Services => "services",
            Self::Health => "health",
            Self::Logs => "logs",
            Self::Participants => "participants",
            Self::Nodes => "nodes",
            Self::Graph => "graph",
            Self::Topics => "topics",
        }
    }
}

/// Size and reach of the history on disk.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(default)]
pub struct DiskHistory {
    /// Whether a history is kept on disk.
    pub is_kept: bool,
    /// Size of its files.
    pub bytes: u64,
    /// Maximum size, `page.history_bytes`.
    pub limit_bytes: u64,
    /// Reach of the rows of one second and of the states of one minute.
    pub seconds: Option<HistorySpan>,
    /// Reach of the rows of ten seconds and of the states of ten minutes.
    pub tens: Option<HistorySpan>,
    /// Reach of the answers of `/history/moment/{noun}`.
    pub answers: Option<HistorySpan>,
    /// Minutes that this run of the agent wrote.
    pub writes: u64,
    /// Minutes that could not be written.
    pub failed_writes: u64,
}

/// Begin and end of a part of the history.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(default)]
pub struct HistorySpan {
    /// Unix time of the oldest row.
    pub begin_timestamp_seconds: f64,
    /// Unix time of the latest row.
    pub end_timestamp_seconds: f64,
}

/// Usage of the robot's processes over some time.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(default)]
pub struct ProcessHistory {
    /// Seconds between two rows, at least.
    pub interval_seconds: u32,
    /// Whether processes that ended early are missing.
    pub is_truncated: bool,
    /// The processes.
    pub processes: Vec<ProcessColumns>,
}

/// Usage of one process. All columns have the same length.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(default)]
pub struct ProcessColumns {
    /// Process id.
    pub process_id: u32,
    /// Its script, or the name of its program.
    #[cfg_attr(feature = "openapi", schema(example = "robot.py"))]
    pub process: String,
    /// Unix time at which each row ends.
    pub times: Vec<f64>,
    /// CPU time divided by time: 1 is one busy core.
    pub cpu_cores: Vec<f64>,
    /// Resident memory at the end.
    pub memory_bytes: Vec<u64>,
}
