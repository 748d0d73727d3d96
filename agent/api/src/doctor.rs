//! `/doctor`, and the output of `rp doctor --json`: the report about a host.

use std::borrow::Cow;

use serde::{Deserialize, Serialize};

/// A report about one host.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema), schema(as = DoctorReport))]
pub struct Report<'a> {
    /// Version of the program that examined.
    pub version: Cow<'a, str>,
    /// Name of the host.
    pub subject: Cow<'a, str>,
    /// Worst verdict of all findings.
    #[cfg_attr(feature = "openapi", schema(example = "warning"))]
    pub verdict: Cow<'a, str>,
    /// Findings by area.
    pub findings: Vec<Finding<'a>>,
}

/// Result of one check.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema), schema(as = DoctorFinding))]
pub struct Finding<'a> {
    /// Subject of the check: `agent`, `sight`, `kernel`, `privileges`, `interfaces`, `shell`,
    /// `processes`, `graph`, `buffers` or `clock`.
    pub area: Cow<'a, str>,
    /// Name of the check; it is stable.
    pub check: Cow<'a, str>,
    /// `ok`, `note`, `unknown` (not readable), `warning` or `problem`.
    pub verdict: Cow<'a, str>,
    /// Result in words.
    pub sentence: Cow<'a, str>,
    /// Values that the result is based on.
    pub evidence: Vec<Evidence<'a>>,
    /// Remedies, each sufficient by itself.
    pub remedies: Vec<Remedy<'a>>,
}

/// A value that a check has read.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema), schema(as = DoctorEvidence))]
pub struct Evidence<'a> {
    /// The value, or why it is missing.
    pub value: Cow<'a, str>,
    /// Its source: a file, a path of the API, or a system call.
    pub from: Cow<'a, str>,
}

/// One remedy.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema), schema(as = DoctorRemedy))]
pub struct Remedy<'a> {
    /// Where the line belongs: `command`, `configuration` (of the agent) or `elsewhere`.
    pub kind: Cow<'a, str>,
    /// The line. Words in capitals are placeholders.
    pub line: Cow<'a, str>,
    /// Further explanation.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[cfg_attr(feature = "openapi", schema(nullable = false))]
    pub comment: Option<Cow<'a, str>>,
}
