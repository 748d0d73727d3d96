//! `/doctor`, and the output of `rp doctor --json`: a report about a host, with one sentence, the
//! evidence and the remedies of each check.

use std::borrow::Cow;

use serde::{Deserialize, Serialize};

/// Findings about one subject.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema), schema(as = DoctorReport))]
pub struct Report {
    /// Version of the program that examined.
    pub version: Cow<'static, str>,
    /// Subject of the report: a host, a remote agent or a capture.
    pub subject: String,
    /// Worst severity of all findings.
    #[serde(rename = "verdict")]
    pub severity: Severity,
    /// Findings by area, in print order.
    pub findings: Vec<Finding>,
}

/// Severity of a finding, from good to bad.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema), schema(as = DoctorVerdict))]
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
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema), schema(as = DoctorArea))]
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
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema), schema(as = DoctorFinding))]
pub struct Finding {
    /// Subject of the check.
    pub area: Area,
    /// Name of the check, stable across hosts and versions.
    pub check: Cow<'static, str>,
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
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema), schema(as = DoctorEvidence))]
pub struct Evidence {
    /// The value, or the reason for its absence.
    pub value: String,
    /// Source of the value: a file, a path of the API, or a system call.
    pub from: String,
}

/// One remedy.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema), schema(as = DoctorRemedy))]
pub struct Remedy {
    /// Where the line belongs.
    pub kind: RemedyTarget,
    /// Line to paste. Words in capitals are placeholders.
    pub line: String,
    /// Further explanation.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[cfg_attr(feature = "openapi", schema(nullable = false))]
    pub comment: Option<String>,
}

/// Where the line of a remedy belongs.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema), schema(as = DoctorRemedyTarget))]
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
            check: Cow::Borrowed(check),
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

impl Report {
    /// Creates a report of a program of this version about `subject`.
    #[must_use]
    pub fn new(version: &'static str, subject: impl Into<String>, findings: Vec<Finding>) -> Self {
        let worst = findings.iter().map(|finding| finding.severity).max();
        Self {
            version: Cow::Borrowed(version),
            subject: subject.into(),
            severity: worst.unwrap_or(Severity::Ok),
            findings,
        }
    }

    /// Returns whether any finding is a problem.
    #[must_use]
    pub fn has_problems(&self) -> bool {
        self.severity == Severity::Problem
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn report(severities: &[Severity]) -> Report {
        let finding = |severity: &Severity| Finding::new(Area::Kernel, "x", *severity, "x");
        Report::new("1", "robot1", severities.iter().map(finding).collect())
    }

    #[test]
    fn only_a_finding_with_severity_problem_counts_as_a_problem() {
        assert!(!report(&[]).has_problems());
        assert!(!report(&[Severity::Ok, Severity::Warning, Severity::Unknown]).has_problems());
        assert!(report(&[Severity::Problem, Severity::Ok]).has_problems());
    }

    #[test]
    fn a_report_serializes_to_json() {
        let json = serde_json::to_value(report(&[Severity::Warning])).unwrap();
        assert_eq!(json["verdict"], "warning");
        assert_eq!(json["findings"][0]["area"], "kernel");
        assert_eq!(json["findings"][0]["evidence"], serde_json::json!([]));
    }
}
