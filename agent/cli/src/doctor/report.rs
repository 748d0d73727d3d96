//! Report: all findings about one subject, in print order.

use serde::Serialize;

use super::finding::{Finding, Severity};
use ros2probe_daemon::escape::visible;

/// Findings about one subject.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct Report {
    /// Version of `rp`.
    pub version: &'static str,
    /// Subject of the report: a host, a remote agent or a capture.
    pub subject: String,
    /// Worst severity of all findings.
    #[serde(rename = "verdict")]
    pub severity: Severity,
    /// Findings by area, in print order.
    pub findings: Vec<Finding>,
}

impl Report {
    /// Creates a report about `subject`.
    #[must_use]
    pub fn new(subject: impl Into<String>, findings: Vec<Finding>) -> Self {
        let worst = findings.iter().map(|finding| finding.severity).max();
        Self {
            version: env!("CARGO_PKG_VERSION"),
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

    /// Returns the number of findings of each severity, as text.
    #[must_use]
    pub fn headline(&self) -> String {
        let count = |severity: Severity| {
            let of_it = self
                .findings
                .iter()
                .filter(|each| each.severity == severity);
            match (of_it.count(), severity) {
                (0, _) => None,
                (count, Severity::Ok | Severity::Unknown) | (count @ 1, _) => {
                    Some(format!("{count} {}", severity.label()))
                }
                (count, _) => Some(format!("{count} {}s", severity.label())),
            }
        };
        let counts: Vec<_> = Severity::ALL.into_iter().filter_map(count).collect();
        let (version, subject) = (self.version, visible(&self.subject));
        format!("rp doctor {version} on {subject}: {}", counts.join(", "))
    }
}

#[cfg(test)]
mod tests {
    use super::super::finding::Area;
    use super::*;

    fn report(severities: &[Severity]) -> Report {
        let finding = |severity: &Severity| Finding::new(Area::Kernel, "x", *severity, "x");
        Report::new("robot1", severities.iter().map(finding).collect())
    }

    #[test]
    fn only_a_finding_with_severity_problem_counts_as_a_problem() {
        assert!(!report(&[]).has_problems());
        assert!(!report(&[Severity::Ok, Severity::Warning, Severity::Unknown]).has_problems());
        assert!(report(&[Severity::Problem, Severity::Ok]).has_problems());
    }

    #[test]
    fn the_headline_counts_the_worst_severity_first() {
        let report = report(&[
            Severity::Ok,
            Severity::Ok,
            Severity::Warning,
            Severity::Problem,
            Severity::Problem,
        ]);
        assert!(
            report
                .headline()
                .ends_with("on robot1: 2 problems, 1 warning, 2 ok")
        );
    }

    #[test]
    fn a_report_serializes_to_json() {
        let json = serde_json::to_value(report(&[Severity::Warning])).unwrap();
        assert_eq!(json["verdict"], "warning");
        assert_eq!(json["findings"][0]["area"], "kernel");
        assert_eq!(json["findings"][0]["evidence"], serde_json::json!([]));
    }
}
