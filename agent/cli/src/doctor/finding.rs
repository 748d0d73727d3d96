//! Result of a check: one sentence, its evidence and its remedies. This module reads nothing.

use serde::Serialize;

/// Severity of a finding, from good to bad.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Severity {
    /// The check passed.
    Ok,
    /// A limit of visibility by configuration or by design.
    Note,
    /// The check could not read its input.
    Unknown,
    /// Some answers are wrong or incomplete.
    Warning,
    /// Observation is broken.
    Problem,
}

/// Subject of a check.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Area {
    /// The agent itself.
    Agent,
    /// Visible traffic of this host.
    Sight,
    /// Features of the kernel.
    Kernel,
    /// Permissions of this shell and of the agent.
    Privileges,
    /// Network interfaces.
    Interfaces,
    /// ROS variables of this shell.
    Shell,
    /// ROS processes of this host.
    Processes,
    /// Participants, topics and nodes in the agent's graph.
    Graph,
    /// Buffers of sockets and of IP reassembly.
    Buffers,
    /// Clock synchronization.
    Clock,
}

/// Result of one check.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct Finding {
    /// Subject of the check.
    pub area: Area,
    /// Name of the check, stable across hosts and versions.
    pub check: &'static str,
    /// Severity of the result.
    #[serde(rename = "verdict")]
    pub severity: Severity,
    /// Result in plain text.
    pub sentence: String,
    /// Values that the result is based on.
    pub evidence: Vec<Evidence>,
    /// Remedies, each sufficient by itself.
    pub remedies: Vec<Remedy>,
}

/// A value that the check read.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct Evidence {
    /// The value, or the reason for its absence.
    pub value: String,
    /// Source of the value: a file, a path of the API, or a system call.
    pub from: String,
}

/// One remedy.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct Remedy {
    /// Where the line belongs.
    pub kind: RemedyTarget,
    /// Line to paste. Words in capitals are placeholders.
    pub line: String,
    /// Further explanation.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub comment: Option<String>,
}

/// Where the line of a remedy belongs.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum RemedyTarget {
    /// A shell.
    Command,
    /// The agent's configuration file.
    Configuration,
    /// Settings of another program, named in the comment.
    Elsewhere,
}

impl Area {
    /// Returns the heading of the area.
    #[must_use]
    pub const fn title(self) -> &'static str {
        match self {
            Self::Agent => "Agent",
            Self::Sight => "What it sees",
            Self::Kernel => "Kernel",
            Self::Privileges => "Privileges",
            Self::Interfaces => "Interfaces",
            Self::Shell => "ROS in this shell",
            Self::Processes => "ROS processes",
            Self::Graph => "Graph",
            Self::Buffers => "Buffers",
            Self::Clock => "Clock",
        }
    }
}

impl Severity {
    /// All severities, from bad to good.
    pub const ALL: [Self; 5] = [
        Self::Problem,
        Self::Warning,
        Self::Unknown,
        Self::Note,
        Self::Ok,
    ];

    /// Returns the label in the printed report.
    #[must_use]
    pub const fn label(self) -> &'static str {
        match self {
            Self::Ok => "ok",
            Self::Note => "note",
            Self::Unknown => "unknown",
            Self::Warning => "warning",
            Self::Problem => "problem",
        }
    }
}

impl Finding {
    /// Creates a finding without evidence and remedies.
    pub fn new(
        area: Area,
        check: &'static str,
        severity: Severity,
        sentence: impl Into<String>,
    ) -> Self {
        Self {
            area,
            check,
            severity,
            sentence: sentence.into(),
            evidence: Vec::new(),
            remedies: Vec::new(),
        }
    }

    /// Adds evidence.
    #[must_use]
    pub fn seen(mut self, value: impl Into<String>, from: impl Into<String>) -> Self {
        let (value, from) = (value.into(), from.into());
        self.evidence.push(Evidence { value, from });
        self
    }

    /// Adds a command. In this and the next two methods, four spaces and `#` begin a comment.
    #[must_use]
    pub fn remedy(self, line: impl Into<String>) -> Self {
        self.with(RemedyTarget::Command, line.into())
    }

    /// Adds a line of the agent's configuration.
    #[must_use]
    pub fn configure(self, line: impl Into<String>) -> Self {
        self.with(RemedyTarget::Configuration, line.into())
    }

    /// Adds a setting of another program, named in the comment.
    #[must_use]
    pub fn elsewhere(self, line: impl Into<String>) -> Self {
        self.with(RemedyTarget::Elsewhere, line.into())
    }

    fn with(mut self, kind: RemedyTarget, line: String) -> Self {
        let (line, comment) = match line.split_once("    # ") {
            Some((line, comment)) => (line.to_owned(), Some(comment.to_owned())),
            None => (line, None),
        };
        self.remedies.push(Remedy {
            kind,
            line,
            comment,
        });
        self
    }
}
